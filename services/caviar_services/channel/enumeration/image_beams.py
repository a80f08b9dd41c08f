"""Beam tracing: chains of reflections by way of moving bodies, enumerated, and the receivers that they light.

Mirrored in a face, a transmitter is an image, and what it lights by way of that face is the pyramid from the
image through the face's rectangle. The next face mirrors the image and the last rectangle with it: a beam is
an image, the pyramids through its last two rectangles, and the side of the last plane that it lights (M. F.
Catedra et al., "Efficient ray-tracing techniques for three-dimensional analyses of propagation in mobile
communications", IEEE Antennas Propag. Mag. 40(2), 1998, cull by such beams). The test is conservative: it
leaves out nothing that a beam lights and keeps some that it does not light. Which chains are paths is decided
by the image method (`image_paths`).

Tests of beams are compiled loops (`beam_kernels`): a frame's pairs are too few for kernels of a ray tracer,
each of which costs its launch.

Where bodies are small, rays rarely meet them, so a launch misses most chains by way of them. `chain_pairs`
takes every sequence of faces with a face of a body in it for a candidate, and leaves out sequences that beams
cannot reach. With B for a face of a body and S for one of scenery, these are to a depth of three: B, SB, BS,
BB, SSB, SBS, SBB, BSS, BSB, BBS and BBB. The last reflection needs no beam of its own: it exists where the
receiver's image in the last face lies in the beam before it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.sionna import LateModule
from caviar_space.rectangles import RIM, FaceRectangles

kernels: Any = LateModule("caviar_services.channel.enumeration.beam_kernels", keeps=True)
path_kernels: Any = LateModule("caviar_services.channel.enumeration.path_kernels", keeps=True)

# [m] by which every target is larger in tests than its rounding can be.
_SLACK = 5e-3

# The same as a part of the largest coordinate: meshes come in float32.
_RELATIVE_SLACK = 2e-6


# Offset of a plane that nothing is behind.
_EVERYWHERE = -1e30


class Targets:
    """Targets of a frame's beams, as `beam_kernels` takes them: faces, and bodies by their boxes.

    Args:
        faces: Those of scenery first, then those of bodies, body after body.
        sizes: Number of faces of each body, Shape ``[V]``.
        sights: Pairs of faces of scenery that see one another, in both orders, sorted, Shape ``[M, 2]``.
    """

    def __init__(self, faces: FaceRectangles, sizes: Int64Array, sights: Int64Array) -> None:
        self.faces = faces
        self.first_body = len(faces) - int(sizes.sum())
        """Number of the first face of a body, and of faces of scenery."""
        self.begin = self.first_body + np.append(0, np.cumsum(sizes))
        """First face of each body, and one past the last, Shape ``[V + 1]``."""
        slack = _SLACK + _RELATIVE_SLACK * float(np.abs(faces.centre).max(initial=0.0))
        self.slack = slack
        """By which every target is larger in tests [m]."""
        u, v = (faces.axes[:, i] * faces.half[:, i, None] for i in (0, 1))
        corners = np.stack([-u - v, u - v, u + v, v - u], axis=1) + faces.centre[:, None]
        rows = [faces.centre.T, faces.radius, faces.normal.T, faces.offset, faces.two_sided]
        frames = np.zeros((len(faces), 5, 3))
        frames[:, :2], frames[:, 2, :2] = faces.axes, faces.half
        frames[:, 3], frames[:, 4] = faces.centre, faces.normal
        self.arrays = (
            np.ascontiguousarray(np.vstack(rows)),
            np.ascontiguousarray(corners),
            frames,
            boxes(corners, self.begin),
            self.begin,
            np.searchsorted(sights[:, 0], np.arange(self.first_body + 1)),
            np.ascontiguousarray(sights[:, 1]),
            slack,
        )
        """As `beam_kernels` takes them."""
        triangles = np.ascontiguousarray(faces.triangles), np.append(0, np.cumsum(faces.sizes))
        self._mirrors = self.arrays[0], frames, *triangles, RIM

    def reflections(
        self, chain: Int64Array, start: Float64Array, end: Float64Array
    ) -> tuple[Float64Array, BoolArray]:
        """Points where chains of faces reflect; see `path_kernels.reflections`."""
        rows = [np.require(part, requirements=("C", "W")) for part in (chain, start, end)]
        found: tuple[Float64Array, BoolArray] = path_kernels.reflections(*self._mirrors, *rows)
        return found


def boxes(corners: Float64Array, begin: Int64Array) -> Float64Array:
    """Boxes along the axes around the corners, Shape ``[F, N, 3]``, of each of V runs of rows that begin at
    ``begin[:-1]``: centre, radius of a sphere around it, and half the sides [m], Shape ``[7, V]``."""
    if len(begin) < 2:
        return np.zeros((7, 0))
    each = corners.shape[1]
    rows, first = corners[begin[0] :].reshape(-1, 3).T, each * (begin[:-1] - begin[0])
    low, high = np.minimum.reduceat(rows, first, axis=1), np.maximum.reduceat(rows, first, axis=1)
    centre = (low + high) / 2
    away = rows - np.repeat(centre, each * np.diff(begin), axis=1)
    radius = np.sqrt(np.maximum.reduceat((away**2).sum(0), first))
    return np.vstack([centre, radius, (high - low) / 2])


@dataclass(frozen=True, eq=False)
class ImageBeams:
    """B beams after n reflections each."""

    chain: Int64Array
    """Faces that reflected them, Shape ``[B, n]``."""
    by_body: BoolArray
    """Whether one of these is of a body, Shape ``[B]``."""
    rows: Float64Array
    """Image, cone and pyramids of each (`beam_kernels`), Shape ``[B, 37]``."""

    def __len__(self) -> int:
        return len(self.chain)

    @property
    def first_by_body(self) -> int:
        """Index of the first beam by way of a body: beams of scenery alone stand before it."""
        return int(np.argmax(self.by_body)) if self.by_body.any() else len(self)


def source_beams(points: Float64Array) -> ImageBeams:
    """Beams without a reflection, which light everything around points [m], Shape ``[N, 3]``."""
    rows = np.zeros((len(points), kernels.WIDTH))
    rows[:, :3], rows[:, kernels.COSINE], rows[:, kernels.LIT_FROM] = points, -1.0, _EVERYWHERE
    rows[:, kernels.LAST] = -1
    return ImageBeams(np.zeros((len(points), 0), np.int64), np.zeros(len(points), np.bool_), rows)


def reflected_beams(targets: Targets, beams: ImageBeams, parent: Int64Array, face: Int64Array) -> ImageBeams:
    """Beams after one more reflection of some beams, by their number, each at a face; Shape ``[B]`` both."""
    parent, face = np.ascontiguousarray(parent), np.ascontiguousarray(face)
    return ImageBeams(
        np.column_stack([beams.chain[parent], face]),
        beams.by_body[parent] | (face >= targets.first_body),
        kernels.reflected(targets.arrays, beams.rows, parent, face),
    )


def first_beams(targets: Targets, source: Float64Array, scenery: Int64Array) -> ImageBeams:
    """Beams of a transmitter [m], Shape ``[3]``, after one reflection: at given faces of scenery, then at all
    faces of bodies whose reflecting side the transmitter sees."""
    faces = targets.faces
    bodies = np.arange(targets.first_body, len(faces))
    shown = faces.normal[bodies] @ source > faces.offset[bodies]
    first = np.concatenate([scenery, bodies[shown | faces.two_sided[bodies]]])
    return reflected_beams(targets, source_beams(source[None]), np.zeros_like(first), first)


def next_beams(targets: Targets, beams: ImageBeams, known: Int64Array, by_bodies: bool = True) -> ImageBeams:
    """Beams after one more reflection.

    Args:
        targets: Faces that may reflect.
        beams: Beams after n reflections.
        known: Chains of scenery alone, Shape ``[K, n + 1]``. Each begins with the chain of one of ``beams``.
            Beams by way of scenery alone continue along these and no others.
        by_bodies: Whether beams by way of bodies are wanted.

    Returns:
        Beams of ``known`` first, as everywhere: `ImageBeams.first_by_body` divides the list. Then those by
        way of a body.
    """
    first = beams.first_by_body
    number = {tuple(row): number for number, row in enumerate(beams.chain[:first].tolist())}
    begun = np.array([number[tuple(row)] for row in known[:, :-1].tolist()], np.int64)
    if not by_bodies:
        return reflected_beams(targets, beams, begun, known[:, -1])
    parent, face = kernels.lit_faces(beams.rows, first, targets.arrays).T
    return reflected_beams(
        targets, beams, np.concatenate([begun, parent]), np.concatenate([known[:, -1], face])
    )


@dataclass(frozen=True, eq=False)
class SceneryViews:
    """W pairs of a receiver and a face of scenery that may reflect last before it."""

    receiver: Int64Array
    """Shape ``[W]``."""
    face: Int64Array
    """Shape ``[W]``."""


@dataclass(frozen=True, eq=False)
class ChainPairs:
    """N pairs of a chain and a receiver."""

    chain: Int64Array
    """Faces, −1 past the last, Shape ``[N, D]``."""
    receiver: Int64Array
    """Shape ``[N]``."""

    @classmethod
    def joined(cls, parts: list[tuple[Int64Array, Int64Array]], depth: int) -> ChainPairs:
        """All pairs of parts, whose chains may have any length up to ``depth``."""
        receiver = np.concatenate([receiver for _, receiver in parts])
        joined, end = np.full((len(receiver), depth), -1), 0
        for chain, _ in parts:
            begin, end = end, end + len(chain)
            joined[begin:end, : chain.shape[1]] = chain
        return cls(joined, receiver)


def chain_pairs(
    targets: Targets,
    scenery: Int64Array,
    views: SceneryViews,
    transmitter: Float64Array,
    receivers: Float64Array,
) -> ChainPairs:
    """All pairs of a chain and a receiver that may be a path: without a reflection, by way of scenery alone,
    and by way of bodies.

    Args:
        targets: Faces of scenery, then those of bodies, body after body.
        scenery: Chains of scenery alone that waves from the transmitter go along, as faces, −1 past the
            last, Shape ``[K, D]``; the beginnings of each chain are among them.
        views: Faces of scenery that may reflect last, and who sees them.
        transmitter: Position [m], Shape ``[3]``.
        receivers: Positions [m], Shape ``[R, 3]``.
    """
    depth = scenery.shape[1]
    # The chain without a reflection is a candidate for every receiver: the line of sight.
    every = np.arange(len(receivers))
    found = [(np.zeros((len(receivers), 0), np.int64), every)]
    if not (depth and len(targets.faces) and len(receivers)):
        return ChainPairs.joined(found, depth)
    length = (scenery >= 0).sum(1)

    points = np.ascontiguousarray(np.vstack([receivers.T, np.zeros((4, len(receivers)))]))
    receivers = np.ascontiguousarray(receivers)

    def add(beams: ImageBeams) -> None:
        beam, receiver = kernels.lit_points(beams.rows, points, targets.slack).T
        found.append((beams.chain[beam], receiver))

    beams = first_beams(targets, transmitter, scenery[length == 1, 0])
    add(beams)
    for n in range(2, depth):
        beams = next_beams(targets, beams, scenery[length == n, :n])
        add(beams)
    if depth > 1:
        # The last reflection needs no beams of its own: its faces are tested with the receivers at once.
        add(next_beams(targets, beams, scenery[length == depth], by_bodies=False))
        seen = receivers[views.receiver]
        images = reflected_beams(targets, source_beams(receivers), views.receiver, views.face).rows
        beam, view = kernels.ends_by_scenery(beams.rows, beams.first_by_body, images, targets.arrays, seen).T
        ends = np.column_stack([beam, views.face[view], views.receiver[view]])
        ends = np.concatenate([ends, kernels.ends_by_bodies(beams.rows, targets.arrays, receivers)])
        found.append((np.column_stack([beams.chain[ends[:, 0]], ends[:, 1]]), ends[:, 2]))
    return ChainPairs.joined(found, depth)
