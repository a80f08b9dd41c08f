"""Paths of reflections at chains of faces: points by the image method, in float64, visibility and
transmission.

A slab that transmits does not bend a path. So a chain of reflections with an obstacle on a segment is a path
nevertheless where everything that its segments cross lets waves through, and the crossings are not too many
(`crossings`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_services.channel.enumeration.beam_ends import ChainPairs
from caviar_services.channel.enumeration.scene_faces import FaceRectangles
from caviar_services.channel.paths import Rows
from caviar_services.channel.propagation.fresnel import slab
from caviar_services.channel.sionna.candidate_visibility import Faces
from caviar_services.channel.sionna.coplanar_faces import COPLANAR, COPLANAR_RELATIVE
from caviar_services.channel.sionna.materials import DRAWN
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_space.planes import PlaneTable

OFF_SURFACE = 2e-4
"""[m]; rays from face to face start this far from the first face, whose points float32 rounds."""

# Cosine between the normals of planes that count as parallel.
_PARALLEL = 1 - 1e-6

AT_END = 1e-3
"""[m]; what a ray meets this near to its end is what it ends at: two faces meet there, or are one."""


@dataclass(frozen=True, eq=False)
class ImagePaths(Rows):
    """P paths of at most D reflections."""

    chain: Int64Array
    """Faces that reflect, −1 past the last, Shape ``[P, D]``."""
    receiver: Int64Array
    """Index of the receiver, Shape ``[P]``."""
    points: Float64Array
    """Points of the reflections, the receiver's position past the last [m], Shape ``[P, D, 3]``."""


def image_paths(
    faces: FaceRectangles, pairs: ChainPairs, transmitter: Float64Array, receivers: Float64Array
) -> ImagePaths:
    """Pairs whose reflections all lie in a triangle of their face, by the image method.

    Args:
        faces: Faces of the chains.
        pairs: Candidates.
        transmitter: Position [m], Shape ``[3]``.
        receivers: Positions [m], Shape ``[R, 3]``.

    Returns:
        Paths sorted by receiver, number of reflections and chain, whether or not an obstacle hides them.
    """
    chain, count = pairs.chain, (pairs.chain >= 0).sum(1)
    # A fixed order, whatever order kernels found the pairs in: products have to be equal to the bit.
    order = np.lexsort((*chain.T[::-1], count, pairs.receiver))
    chain, receiver = chain[order], pairs.receiver[order]
    points, good = reflection_points(
        faces, chain, np.broadcast_to(transmitter, (len(chain), 3)), receivers[receiver]
    )
    return ImagePaths(chain[good], receiver[good], points[good])


def reflection_points(
    faces: FaceRectangles, chain: Int64Array, start: Float64Array, end: Float64Array
) -> tuple[Float64Array, BoolArray]:
    """Points where chains of faces reflect a wave on its way from a start to an end.

    Args:
        faces: Faces of the chains.
        chain: Faces in turn, −1 past the last, Shape ``[N, D]``.
        start: Position [m], Shape ``[N, 3]``; ``end`` likewise.
        end: See ``start``.

    Returns:
        Points, the end past the last [m], Shape ``[N, D, 3]``, and which rows have every point in a
        triangle of its face, on the side that reflects, Shape ``[N]``. Points of other rows are undefined.
    """
    depth, count = chain.shape[1], (chain >= 0).sum(1)
    images = [start]
    for d in range(depth):
        used = np.flatnonzero(count > d)
        image = images[-1].copy()
        image[used] = faces.mirrored(image[used], chain[used, d])
        images.append(image)
    # Back from the end: the line to the last image meets the last face at the last point, and so on. Rows
    # that miss a rectangle drop out at once; triangles, which cost most, are tested for the rows that are
    # left.
    here = end.copy()
    points = np.repeat(here[:, None], depth, axis=1)
    good = np.ones(len(chain), np.bool_)
    for d in reversed(range(depth)):
        rows = np.flatnonzero(good & (count > d))
        face, towards = chain[rows, d], images[d + 1][rows]
        near, far = faces.height(here[rows], face), faces.height(towards, face)
        # The line has to cross the plane between the end and the image, from the side that reflects.
        crosses = (near * far < 0) & ((near > 0) | faces.two_sided[face])
        good[rows[~crosses]] = False
        rows, face, towards, near, far = (part[crosses] for part in (rows, face, towards, near, far))
        met = here[rows] + (near / (near - far))[:, None] * (towards - here[rows])
        within = faces.in_rectangle(met, face)
        good[rows[~within]] = False
        here[rows], points[rows, d] = met, met
    rows = np.flatnonzero(good)
    path, place = np.nonzero(chain[rows] >= 0)
    path = rows[path]
    held = faces.in_triangles(points[path, place], chain[path, place])
    good[path[~held]] = False
    return points, good


def unhidden(
    scene: SionnaScene,
    look: Faces,
    faces: FaceRectangles,
    paths: ImagePaths,
    transmitter: Float64Array,
    receivers: Float64Array,
) -> BoolArray:
    """Which paths have no obstacle on their segments, Shape ``[P]``.

    A segment is free if a ray along it first meets the surface at its end, or something within `AT_END` of it
    that does not stand in front of it: rays that end before would lose what grazes.

    Args:
        scene: The scene.
        look: Casts the rays.
        faces: Faces of the paths.
        paths: Paths of the image method.
        transmitter: Position [m], Shape ``[3]``.
        receivers: Positions [m], Shape ``[R, 3]``.
    """
    count = (paths.chain >= 0).sum(1)
    end = receivers[paths.receiver]
    rows = np.arange(len(count))
    first, last, wanted, owner = [], [], [], []
    for d in range(paths.chain.shape[1] + 1):
        lane = rows[count >= d]
        before = paths.points[lane, d - 1] if d else np.broadcast_to(transmitter, (len(lane), 3))
        ends = count[lane] == d
        if d < paths.chain.shape[1]:
            arriving, face = paths.points[lane, d], paths.chain[lane, d]
        else:
            arriving, face = end[lane], np.full(len(lane), -1)
        plane = np.where(ends, -1, faces.plane[face] if len(faces) else -1)
        if d:
            # The last ray goes from the receiver, which is off every surface and needs no lift.
            mirror = paths.chain[lane, d - 1]
            normal = faces.normal[mirror]
            side = np.sign(np.einsum("nc,nc->n", arriving - before, normal))[:, None]
            lifted = before + OFF_SURFACE * side * normal
            start = np.where(ends[:, None], arriving, lifted)
            arriving = np.where(ends[:, None], before, arriving)
            plane = np.where(ends, faces.plane[mirror], plane)
        else:
            start = before
        first.append(start)
        last.append(arriving)
        wanted.append(plane)
        owner.append(lane)
    owners, planes = np.concatenate(owner), np.concatenate(wanted)
    free = np.ones(len(count), np.bool_)
    if len(owners):
        ends = np.concatenate(last)
        behind, met = look.nearest(np.concatenate(first), ends)
        other = (behind < 0) & (met != np.where(planes >= 0, scene.joined.label[planes], -1))
        hidden = other & (behind < -AT_END)
        near = np.flatnonzero(other & ~hidden & (planes >= 0))
        hidden[near] = in_front(scene.plane_table, met[near], planes[near], ends[near])
        free[owners[hidden]] = False
    return free


def in_front(table: PlaneTable, met: Int64Array, wanted: Int64Array, points: Float64Array) -> BoolArray:
    """Whether planes hide points of other planes that rays met right behind them.

    They do if both planes are parallel and farther apart than rounding.

    Args:
        table: Planes of the scene.
        met: Plane that each ray met first, Shape ``[N]``.
        wanted: Plane that each point lies in, Shape ``[N]``.
        points: Points [m], Shape ``[N, 3]``.
    """
    normal = table.normal[met]
    parallel = np.abs(np.einsum("nc,nc->n", normal, table.normal[wanted])) > _PARALLEL
    height = np.abs(np.einsum("nc,nc->n", points - table.origin[met], normal))
    hidden: BoolArray = parallel & (height > COPLANAR + COPLANAR_RELATIVE * np.abs(points).max(1))
    return hidden


# Surfaces at both ends of a segment, each of which a ray may meet once more by rounding.
_PASSED_TWICE = 2


@dataclass(frozen=True, eq=False)
class Crossings(Rows):
    """M places where segments of paths go through a surface, along each path in turn."""

    path: Int64Array
    """Index of the path, Shape ``[M]``."""
    segment: Int64Array
    """Index of the segment within its path, Shape ``[M]``."""
    along: Float64Array
    """Share of the segment before the place, from 0 to 1, Shape ``[M]``."""
    points: Float64Array
    """Position [m], Shape ``[M, 3]``."""
    triangle: Int64Array
    """Triangle of the surface, Shape ``[M]``."""


def crossings(
    scene: SionnaScene,
    look: Faces,
    faces: FaceRectangles,
    paths: ImagePaths,
    transmitter: Float64Array,
    receivers: Float64Array,
    most: Int64Array,
) -> tuple[Crossings, BoolArray]:
    """Surfaces that the segments of paths cross.

    Args:
        scene: The scene.
        look: Casts the rays.
        faces: Faces of the paths.
        paths: Paths of the image method that something hides.
        transmitter: Position [m], Shape ``[3]``.
        receivers: Positions [m], Shape ``[R, 3]``.
        most: Number of surfaces that each path may cross, Shape ``[P]``.

    Returns:
        The crossings, and which paths cross at most so many surfaces and no opaque one, Shape ``[P]``.
    """
    # Ray by ray from surface to surface, all segments at once, until each has reached its end.
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
        # A line crosses a plane once, and that of an end only there: a second hit is rounding.
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
    # A hidden path crosses something: one that crosses nothing is hidden by rounding at a face.
    count = np.bincount(path, minlength=len(good))
    good &= (count <= most) & (count > 0)
    places = Crossings(path, segments.number[rows], along, points, triangle).take(good[path])
    return places.take(np.lexsort((places.along, places.segment, places.path))), good


@dataclass(frozen=True, eq=False)
class _Segments:
    """Q segments of paths."""

    path: Int64Array
    """Index of the path, Shape ``[Q]``; ``number`` is that of the segment within it."""
    number: Int64Array
    first: Float64Array
    """Start [m], Shape ``[Q, 3]``; ``last`` is the end."""
    last: Float64Array
    lifted: Float64Array
    """The start, `OFF_SURFACE` off its surface."""
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
        """Where segments cross the planes of triangles: share of the segment, point [m], and unit normal
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
    """Triangles that a launched ray along unit vectors ``[N, 3]`` could pass on any carrier: the ray tracer
    draws transmission with a probability of at least `DRAWN`."""
    media = scene.media(scene.shapes_of(triangle)[0])
    cosine = np.abs(np.einsum("nc,nc->n", direction, _plane(scene, triangle)[0]))
    through = np.zeros(len(triangle), np.bool_)
    for carrier, wavelength in enumerate(scene.wavelengths):
        constants = media.permittivity[carrier], media.conductivity[carrier]
        back, passed = slab(cosine, constants, media.thickness, SPEED_OF_LIGHT / wavelength)
        through |= (np.abs(passed) ** 2).sum(0) >= DRAWN * (np.abs(back) ** 2).sum(0)
    return through
