"""Paths of reflections that go through what stands in their way, in float64.

A slab that transmits does not bend a path. So a chain of reflections that something hides is a path
nevertheless where all that its segments cross lets waves through, and there are not too many crossings.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_services.channel.enumeration.face_rectangles import FaceRectangles
from caviar_services.channel.enumeration.image_paths import AT_END, OFF_SURFACE, ImagePaths
from caviar_services.channel.sionna.candidate_visibility import Faces
from caviar_services.channel.sionna.materials import DRAWN, slab
from caviar_services.channel.sionna.scene import SionnaScene

_PASSED_TWICE = 2
"""Surfaces at the ends of a segment that rounding may show once more."""


@dataclass(frozen=True, eq=False)
class Crossings:
    """M places where segments of paths go through a surface."""

    path: Int64Array
    """Shape ``[M]``."""
    segment: Int64Array
    """From 0, Shape ``[M]``."""
    along: Float64Array
    """How far along the segment, from 0 to 1, Shape ``[M]``."""
    points: Float64Array
    """[m], Shape ``[M, 3]``."""
    triangle: Int64Array
    """Shape ``[M]``."""


def crossings(
    scene: SionnaScene,
    look: Faces,
    faces: FaceRectangles,
    paths: ImagePaths,
    transmitter: Float64Array,
    receivers: Float64Array,
    most: Int64Array,
) -> tuple[Crossings, BoolArray]:
    """What the segments of paths cross; positions in metres.

    ``most`` is how many surfaces each may cross, Shape ``[P]``. Returns the crossings, and which paths cross
    no more, none of which is opaque, Shape ``[P]``.
    """
    segments = _Segments.of(scene, faces, paths, transmitter, receivers)
    good = most > 0
    start, alive = segments.lifted.copy(), np.arange(len(segments.path))
    crossed = np.full((len(alive), int(most.max(initial=0)) + 1), -1)
    found: list[tuple[Any, ...]] = []
    for _ in range(int(most.max(initial=0)) + 1 + _PASSED_TWICE):
        alive = alive[good[segments.path[alive]]]
        if not len(alive):
            break
        behind, triangle = look.first_triangle(start[alive], segments.last[alive])
        on = behind < -AT_END
        alive, triangle = alive[on], triangle[on]
        along, points, side = segments.met(scene, alive, triangle)
        start[alive] = points + OFF_SURFACE * side
        surface = scene.surface_of[triangle]
        # A plane is crossed once, and that of an end only there: more is rounding.
        again = (surface[:, None] == np.column_stack([segments.ends[alive], crossed[alive]])).any(1)
        new = np.flatnonzero(~again)
        alive_new, path = alive[new], segments.path[alive[new]]
        opaque = ~_lets_through(scene, triangle[new], segments.direction[alive_new])
        good[path[opaque]] = False
        place = (crossed[alive_new] >= 0).sum(1)
        fits = place < crossed.shape[1]
        crossed[alive_new[fits], place[fits]] = surface[new][fits]
        found.append((alive_new, along[new], points[new], triangle[new]))
    else:
        good[segments.path[alive]] = False
    none = (np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros(0, np.int64))
    rows, along, points, triangle = (np.concatenate(column) for column in zip(none, *found, strict=True))
    path = segments.path[rows]
    count = np.bincount(path, minlength=len(good))
    good &= (count <= most) & (count > 0)
    kept = good[path]
    order = np.lexsort((along[kept], segments.number[rows[kept]], path[kept]))
    columns = (path, segments.number[rows], along, points, triangle)
    return Crossings(*(column[kept][order] for column in columns)), good


@dataclass(frozen=True, eq=False)
class _Segments:
    """Q segments of paths."""

    path: Int64Array
    number: Int64Array
    first: Float64Array
    last: Float64Array
    """[m], Shape ``[Q, 3]``, as `first`."""
    lifted: Float64Array
    """`first`, a little off its surface."""
    direction: Float64Array
    """Unit vectors, Shape ``[Q, 3]``."""
    ends: Int64Array
    """Surfaces at both ends, −1 for none, Shape ``[Q, 2]``."""

    @classmethod
    def of(
        cls,
        scene: SionnaScene,
        faces: FaceRectangles,
        paths: ImagePaths,
        transmitter: Float64Array,
        receivers: Float64Array,
    ) -> _Segments:
        count, rows = (paths.chain >= 0).sum(1), np.arange(len(paths.chain))
        start = np.broadcast_to(transmitter, (len(rows), 1, 3))
        corners = np.concatenate([start, paths.points, receivers[paths.receiver][:, None]], axis=1)
        mirror = np.pad(paths.chain, ((0, 0), (1, 1)), constant_values=-1)
        normal, surface = np.zeros(corners.shape), np.full(mirror.shape, -1)
        used = mirror >= 0
        normal[used] = faces.normal[mirror[used]]
        surface[used] = scene.joined.label[faces.plane[mirror[used]]]
        path, number = np.nonzero(np.arange(corners.shape[1] - 1) <= count[:, None])
        first, last = corners[path, number], corners[path, number + 1]
        direction = last - first
        direction = direction / np.sqrt((direction**2).sum(1, keepdims=True))
        side = np.sign(np.einsum("nc,nc->n", direction, normal[path, number]))[:, None]
        lifted = first + OFF_SURFACE * side * normal[path, number]
        ends = np.column_stack([surface[path, number], surface[path, number + 1]])
        return cls(path, number, first, last, lifted, direction, ends)

    def met(
        self, scene: SionnaScene, rows: Int64Array, triangle: Int64Array
    ) -> tuple[Float64Array, Float64Array, Float64Array]:
        """Where these segments cross the planes of triangles: how far along, points [m], and the unit normals
        towards the far side."""
        normal, origin = _plane(scene, triangle)
        first, line = self.first[rows], self.last[rows] - self.first[rows]
        with np.errstate(invalid="ignore", divide="ignore"):  # of a segment within a plane
            along = np.einsum("nc,nc->n", origin - first, normal) / np.einsum("nc,nc->n", line, normal)
        along = np.clip(np.nan_to_num(along), 0.0, 1.0)
        side = np.where(np.einsum("nc,nc->n", line, normal) < 0, -1.0, 1.0)[:, None]
        return along, first + along[:, None] * line, side * normal


def _plane(scene: SionnaScene, triangle: Int64Array) -> tuple[Float64Array, Float64Array]:
    """Unit normal and a corner of triangles [m], each of Shape ``[N, 3]``."""
    corners = scene.corners(triangle) - scene.centre
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.sqrt((normal**2).sum(1, keepdims=True)), corners[:, 0]


def _lets_through(scene: SionnaScene, triangle: Int64Array, direction: Float64Array) -> BoolArray:
    """Through which triangles a ray might be sent on any carrier that comes in along unit vectors ``[N, 3]``,
    as `contributing` has it."""
    media = scene.media(scene.shapes_of(triangle)[0])
    cosine = np.abs(np.einsum("nc,nc->n", direction, _plane(scene, triangle)[0]))
    through = np.zeros(len(triangle), np.bool_)
    for carrier, wavelength in enumerate(scene.wavelengths):
        constants = media.permittivity[carrier], media.conductivity[carrier]
        back, passed = slab(cosine, constants, media.thickness, SPEED_OF_LIGHT / wavelength)
        through |= (np.abs(passed) ** 2).sum(0) >= DRAWN * (np.abs(back) ** 2).sum(0)
    return through
