"""Which paths could be: specular chains and scattering points of a launch, offered to every receiver.

A chain is a sequence of planes that some ray went along. Chains come from the transmitter's launch alone, and
every receiver is offered all of them: so its paths depend neither on which others are traced with it nor on
whether a ray happened to pass near it. Most chains cannot be a path to most receivers, which the
image method tells from the planes and the boxes around them before anything is traced.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_services.channel.sionna_launch import DIFFRACTED, REFLECTED, REFRACTED, SCATTERED, Launch
from caviar_services.channel.sionna_planes import PlaneTable
from caviar_services.channel.sionna_scene import SionnaScene
from caviar_services.columns import aligned_columns, aligned_indices

_SLACK = 0.1
"""[m] that a point may lie outside the box of its plane: more than float32 and the planes' tolerance do."""

_RELATIVE_SLACK = 1e-5
"""The same as a part of the largest coordinate."""

_GRAZING = 0.03
"""Sine of the angle to a plane below which the point in it is too uncertain to judge by."""


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


def chains_of(launch: Launch, scene: SionnaScene) -> Chains:
    """All chains that rays of a launch went along, shortest first, then in a stable order."""
    count = len(launch.bounces)
    ray = np.zeros(0, np.int64)
    chain = np.zeros(0, np.int64)
    planes, straight = np.full((1, count), -1, np.int32), np.ones(1, np.bool_)
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
        np.concatenate([np.zeros((0, count), np.int32), *(part.planes for part in found)]),
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
    plane = scene.plane_of[scene.triangle_numbers(shape, bounce.primitive.numpy()[ray].astype(np.int64))]
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


class Planes:
    """The planes of a frame on the ray tracer's side, to rule out chains by."""

    def __init__(self, table: PlaneTable) -> None:
        import mitsuba as mi

        rows = np.concatenate([table.origin, table.normal, table.low, table.high], axis=1).T
        reach = float(np.abs(rows).max(initial=0.0))
        columns = [mi.Float(column) for column in aligned_columns(rows)]
        self._slack = _SLACK + _RELATIVE_SLACK * reach
        self._origin, self._normal = mi.Point3f(*columns[:3]), mi.Vector3f(*columns[3:6])
        self._low, self._high = mi.Point3f(*columns[6:9]), mi.Point3f(*columns[9:12])

    def possible(self, chains: Chains, source: Any, targets: Any) -> tuple[Int64Array, Int64Array]:
        """Chain and target of each pair of them that could be a path.

        The source is mirrored at one plane after the other; from the target, the line to the last image has
        to meet the last plane between both ends and within the box around its triangles, and so on back.
        """
        import drjit as dr
        import mitsuba as mi

        count, receivers = len(chains.ray), dr.width(targets)
        if not count * receivers:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        per_chain = dr.opaque(mi.UInt, receivers)
        lane = dr.arange(mi.UInt, count * receivers)
        chain, target = lane // per_chain, lane % per_chain
        columns = [mi.UInt(aligned_indices(column + 1)) for column in chains.planes.T.astype(np.int64)]
        judged = dr.gather(mi.UInt, mi.UInt(aligned_indices(chains.straight)), chain) != 0
        plane = [dr.gather(mi.UInt, column, chain) for column in columns]
        images = [mi.Point3f(source)]
        for number in plane:
            images.append(dr.select(number > 0, self._mirrored(images[-1], number), images[-1]))
        here, possible, unsure = dr.gather(mi.Point3f, targets, target), mi.Bool(True), ~judged
        for number, image in zip(reversed(plane), reversed(images[1:]), strict=True):
            met, grazing, meets = self._met(here, image, number)
            unsure |= grazing & (number > 0)
            possible &= meets | unsure | (number == 0)
            here = dr.select(number > 0, met, here)
        kept: Any = dr.compress(possible)
        lanes = kept.numpy().astype(np.int64)
        return lanes // receivers, lanes % receivers

    def _mirrored(self, point: Any, number: Any) -> Any:
        import drjit as dr

        origin, normal = self._plane(number)
        return point - 2 * dr.dot(point - origin, normal) * normal

    def _plane(self, number: Any) -> tuple[Any, Any]:
        import drjit as dr
        import mitsuba as mi

        used = number > 0
        return dr.gather(mi.Point3f, self._origin, number - 1, used), dr.gather(
            mi.Vector3f, self._normal, number - 1, used
        )

    def _met(self, here: Any, image: Any, number: Any) -> tuple[Any, Any, Any]:
        """Where the line to an image meets a plane; whether it does so at too small an angle to tell;
        whether that may be a point of a path."""
        import drjit as dr
        import mitsuba as mi

        used = number > 0
        origin, normal = self._plane(number)
        line = image - here
        length, across = dr.norm(line), dr.dot(line, normal)
        grazing = dr.abs(across) < _GRAZING * length
        along = dr.dot(origin - here, normal) / dr.select(grazing, 1.0, across)
        met = here + along * line
        low = dr.gather(mi.Point3f, self._low, number - 1, used) - self._slack
        high = dr.gather(mi.Point3f, self._high, number - 1, used) + self._slack
        margin = self._slack / dr.maximum(dr.abs(across), 1e-9)
        between = (along > -margin) & (along < 1.0 + margin)
        return met, grazing, between & dr.all((met > low) & (met < high))


def first_of_each(receiver: Int64Array, count: int) -> BoolArray:
    """Which of these receivers' candidates are among the first ``count`` of each."""
    order = np.argsort(receiver, kind="stable")
    place = np.empty(len(receiver), np.int64)
    ranked = receiver[order]
    place[order] = np.arange(len(receiver)) - np.searchsorted(ranked, ranked)
    kept: BoolArray = place < count
    return kept


def scattered_of(launch: Launch) -> tuple[Int64Array, Int64Array]:
    """Ray and depth of every interaction of a launch that is a diffuse reflection."""
    rays = [np.flatnonzero(bounce.kind.numpy() == SCATTERED) for bounce in launch.bounces]
    depths = [np.full(len(ray), d + 1, np.int64) for d, ray in enumerate(rays)]
    return _stacked(rays, (0,)), _stacked(depths, (0,))


def positions(points: Float64Array) -> Any:
    """Positions [m], Shape ``[N, 3]``, as a `mitsuba.Point3f`."""
    import mitsuba as mi

    return mi.Point3f(*map(mi.Float, aligned_columns(points.T)))
