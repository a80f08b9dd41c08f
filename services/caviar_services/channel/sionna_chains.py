"""The chains of planes that the rays of a launch went along, and the points at which they were scattered.

A chain is a sequence of planes that some ray went along. Chains come from the transmitter's launch alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Int32Array, Int64Array
from caviar_services.channel.sionna_launch import DIFFRACTED, REFLECTED, REFRACTED, SCATTERED, Launch
from caviar_services.channel.sionna_scene import SionnaScene


@dataclass(frozen=True, eq=False)
class Chains:
    """C specular chains, or specular ends behind a scattering point."""

    ray: Int64Array
    """The first ray that went along each, Shape ``[C]``."""
    depth: Int64Array
    """Interactions of each, Shape ``[C]``."""
    planes: Int32Array
    """Plane at each interaction that is a reflection, −1 elsewhere, Shape ``[C, D]``."""
    straight: BoolArray
    """Whether a chain has but reflections and transmissions, Shape ``[C]``."""

    def take(self, which: BoolArray) -> Chains:
        """These chains."""
        return Chains(self.ray[which], self.depth[which], self.planes[which], self.straight[which])


def chains_of(launch: Launch, scene: SionnaScene, max_depth: int) -> Chains:
    """All chains that rays of a launch went along, shortest first, then in a stable order."""
    ray = np.zeros(0, np.int64)
    chain = np.zeros(0, np.int64)
    planes, straight = np.full((1, max_depth), -1, np.int32), np.ones(1, np.bool_)
    found: list[Chains] = []
    for d, bounce in enumerate(launch.bounces):
        kinds = bounce.kind.numpy()
        if d == 0:
            ray = np.flatnonzero(kinds)
            chain = np.zeros(len(ray), np.int64)
        else:
            going = kinds[ray] != 0
            ray, chain = ray[going], chain[going]
        if not len(ray):
            break
        # Neighbouring rays mostly meet the same: only the first of each run is looked at.
        begins = _begins(launch, d, ray, chain)
        heads = np.flatnonzero(begins)
        kind, plane, token, tokens = _tokens(launch, d, ray[heads], scene)
        key = chain[heads] * tokens + token
        _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
        kind, plane, first = kind[first], plane[first], heads[first]
        before = chain[first]
        planes, straight = planes[before], straight[before] & ((kind == REFLECTED) | (kind == REFRACTED))
        planes[:, d] = np.where(kind == REFLECTED, plane, -1)
        chain = inverse.reshape(-1)[np.cumsum(begins) - 1]
        specular = kind != SCATTERED
        found.append(
            Chains(
                ray[first][specular],
                np.full(int(specular.sum()), d + 1, np.int64),
                planes[specular],
                straight[specular],
            )
        )
    return Chains(
        _stacked([part.ray for part in found], (0,)),
        _stacked([part.depth for part in found], (0,)),
        np.concatenate([np.zeros((0, max_depth), np.int32), *(part.planes for part in found)]),
        np.concatenate([np.zeros(0, np.bool_), *(part.straight for part in found)]),
    )


def _begins(launch: Launch, d: int, ray: Int64Array, chain: Int64Array) -> BoolArray:
    """Which rays differ from those before them, in what they met or the chain that they come from."""
    bounce = launch.bounces[d]
    told_apart = [chain, *(column.numpy()[ray] for column in (bounce.kind, bounce.shape, bounce.primitive))]
    if launch.wedges is not None:
        told_apart += [side.numpy()[ray] for side in (launch.wedges.prim0, launch.wedges.primn)]
    begins = np.ones(len(ray), np.bool_)
    begins[1:] = False
    for column in told_apart:
        begins[1:] |= column[1:] != column[:-1]
    return begins


def _tokens(
    launch: Launch, d: int, ray: Int64Array, scene: SionnaScene
) -> tuple[Int64Array, Int64Array, Int64Array, int]:
    """Kind, plane, and what tells interactions of these rays apart: the plane of a reflection, the edge of a
    diffraction, else the kind alone; and how many of these there can be."""
    bounce = launch.bounces[d]
    kind = bounce.kind.numpy()[ray].astype(np.int64)
    shape = bounce.shape.numpy()[ray].astype(np.int64)
    plane = scene.surface_of[scene.triangle_numbers(shape, bounce.primitive.numpy()[ray].astype(np.int64))]
    planes = len(scene.plane_table.triangle)
    token = np.where(kind == REFLECTED, plane, planes + kind)
    edges = 0
    bent = kind == DIFFRACTED
    if bent.any():
        sides = np.stack([side.numpy()[ray[bent]] for side in (launch.wedges.prim0, launch.wedges.primn)])
        sides = np.sort(scene.triangle_numbers(shape[bent], sides.astype(np.int64)), axis=0)
        _, edge = np.unique(sides[0] * len(scene.plane_of) + sides[1], return_inverse=True)
        edges = int(edge.max()) + 1
        token[bent] = planes + 16 + edge.reshape(-1)
    return kind, plane, token, planes + 16 + edges


def _stacked(parts: list[Int64Array], empty: tuple[int, ...]) -> Int64Array:
    return np.concatenate([np.zeros(empty, np.int64), *parts])


def scattered_of(launch: Launch) -> tuple[Int64Array, Int64Array]:
    """Ray and depth of every interaction of a launch that is a diffuse reflection."""
    rays = [np.flatnonzero(bounce.kind.numpy() == SCATTERED) for bounce in launch.bounces]
    depths = [np.full(len(ray), d + 1, np.int64) for d, ray in enumerate(rays)]
    return _stacked(rays, (0,)), _stacked(depths, (0,))
