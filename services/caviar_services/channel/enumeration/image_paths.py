"""Paths of reflections at chains of faces, over an edge or not: points by the image method, in float64,
visibility and transmission.

A slab that transmits does not bend a path. So a chain of reflections with an obstacle on a segment is a path
nevertheless where everything that its segments cross lets waves through, and the crossings are not too many
(`crossings`).

Paths over an edge (`edge_paths`) have their point there by Keller's law.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_services.channel.enumeration.edge_beams import EdgeChains, EdgeTargets
from caviar_services.channel.enumeration.image_beams import ChainPairs, Targets
from caviar_services.channel.enumeration.obstacle_trees import ObstacleTrees
from caviar_services.channel.propagation.image_method import keller_point
from caviar_services.channel.propagation.utd import beyond_edges, slab
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_space.materials import DRAWN
from caviar_space.planes import COPLANAR, COPLANAR_RELATIVE, PlaneTable
from caviar_space.rectangles import FaceRectangles
from caviar_space.vectors import Rows

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
    targets: Targets, pairs: ChainPairs, transmitter: Float64Array, receivers: Float64Array
) -> ImagePaths:
    """Pairs whose reflections all lie in a triangle of their face, by the image method.

    Args:
        targets: Faces of the chains.
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
    points, good = targets.reflections(
        chain, np.broadcast_to(transmitter, (len(chain), 3)), receivers[receiver]
    )
    return ImagePaths(chain[good], receiver[good], points[good])


def unhidden(
    scene: SionnaScene,
    look: ObstacleTrees,
    faces: FaceRectangles,
    paths: ImagePaths,
    transmitter: Float64Array,
    receivers: Float64Array,
) -> BoolArray:
    """Mask of paths without an obstacle on their segments, Shape ``[P]``.

    A segment is free if a ray along it first meets the surface at its end, or something within `AT_END` of it
    that does not stand in front of it: rays that end before would lose what grazes.

    Args:
        scene: The scene.
        look: Obstacles of the scene.
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
    """Test whether planes hide points of other planes that rays met right behind them.

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
    look: ObstacleTrees,
    faces: FaceRectangles,
    paths: ImagePaths,
    transmitter: Float64Array,
    receivers: Float64Array,
    most: Int64Array,
) -> tuple[Crossings, BoolArray]:
    """Surfaces that the segments of paths cross.

    Args:
        scene: The scene.
        look: Obstacles of the scene.
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
        """Crossings of segments with planes of triangles: share of the segment, point [m], and unit normal
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


@dataclass(frozen=True, eq=False)
class EdgePaths(Rows):
    """P paths of at most D interactions, one of which is a diffraction."""

    chain: Int64Array
    """Face at each reflection, −1 at the edge and past the last, Shape ``[P, D]``."""
    bend: Int64Array
    """Which interaction is at the edge, Shape ``[P]``."""
    count: Int64Array
    """Interactions, Shape ``[P]``."""
    edge: Int64Array
    """Among `EdgeTargets`, Shape ``[P]``."""
    receiver: Int64Array
    """Shape ``[P]``."""
    points: Float64Array
    """The receiver past the last [m], Shape ``[P, D, 3]``."""


def edge_paths(
    targets: Targets,
    edges: EdgeTargets,
    candidates: Sequence[EdgeChains],
    transmitter: Float64Array,
    receivers: Float64Array,
    depth: int,
) -> EdgePaths:
    """Candidates that are paths: reflections lie in triangles of their faces, and both segments at the edge
    run outside of its wedge.

    Args:
        targets: Faces of the chains.
        edges: Edges of the chains.
        candidates: From `edge_chains`.
        transmitter: Position [m], Shape ``[3]``.
        receivers: Positions [m], Shape ``[R, 3]``.
        depth: Interactions of a path at most, D.

    Returns:
        Paths sorted by receiver, number of interactions, edge and surfaces. Of paths by way of faces that are
        one surface, the first one.
    """
    parts = [_with_points(targets, edges, chains, transmitter, receivers, depth) for chains in candidates]
    none = np.zeros(0, np.int64)
    parts.append(EdgePaths(np.zeros((0, depth), np.int64), none, none, none, none, np.zeros((0, depth, 3))))
    found = EdgePaths.joined(parts)
    # Surfaces instead of faces: coplanar faces that touch give the same path once each.
    surfaces = np.full(found.chain.shape, -1)
    surfaces[found.chain >= 0] = edges.surface_of_face[found.chain[found.chain >= 0]]
    number = edges.number[found.edge]
    keys = np.column_stack([found.receiver, found.count, number, found.bend, surfaces])
    return found.take(np.unique(keys, axis=0, return_index=True)[1])


def _with_points(
    targets: Targets,
    edges: EdgeTargets,
    chains: EdgeChains,
    transmitter: Float64Array,
    receivers: Float64Array,
    depth: int,
) -> EdgePaths:
    start = np.broadcast_to(transmitter, (len(chains.edge), 3))
    ends = receivers[chains.receiver]
    source, target = start, ends
    for column in chains.before.T:
        source = targets.faces.mirrored(source, column)
    for column in chains.behind.T:
        target = targets.faces.mirrored(target, column)
    wedge = edges.ends[chains.edge]
    with np.errstate(invalid="ignore", divide="ignore"):  # of what lies on the line of an edge
        place = keller_point(source, target, wedge)
        good = np.isfinite(place).all(1) & ~beyond_edges(place, wedge)
    # Both rays at the edge have to run outside of the wedge, in front of one of its faces at least.
    good &= edges.outside(source, chains.edge) & edges.outside(target, chains.edge)
    rows = np.flatnonzero(good)
    before, one = targets.reflections(chains.before[rows], start[rows], place[rows])
    rows, before = rows[one], before[one]
    behind, other = targets.reflections(chains.behind[rows], ends[rows], place[rows])
    rows, before, behind = rows[other], before[other], behind[other]
    # In the order of the path: reflections before, the edge, reflections after, which count from the
    # receiver.
    i, j = before.shape[1], behind.shape[1]
    chain = np.full((len(rows), depth), -1)
    chain[:, :i], chain[:, i + 1 : i + 1 + j] = chains.before[rows], chains.behind[rows, ::-1]
    points = np.repeat(ends[rows][:, None], depth, axis=1)
    points[:, :i], points[:, i], points[:, i + 1 : i + 1 + j] = before, place[rows], behind[:, ::-1]
    return EdgePaths(
        chain,
        np.full(len(rows), i),
        np.full(len(rows), i + j + 1),
        chains.edge[rows],
        chains.receiver[rows],
        points,
    )


def unhidden_over_edges(
    scene: SionnaScene,
    look: ObstacleTrees,
    faces: FaceRectangles,
    edges: EdgeTargets,
    paths: EdgePaths,
    transmitter: Float64Array,
    receivers: Float64Array,
) -> BoolArray:
    """Mask of paths without an obstacle on their segments, Shape ``[P]``; the arguments are those of
    `unhidden`.

    Both faces of an edge are no obstacle to a segment that ends there: what a ray meets of them is rounding.
    """
    total, depth = paths.chain.shape
    free = np.ones(total, np.bool_)
    if not total:
        return free
    rows = np.arange(total)
    start, end = np.broadcast_to(transmitter, (total, 1, 3)), receivers[paths.receiver][:, None]
    corners = np.concatenate([start, paths.points, end], axis=1)
    segments = []
    for d in range(depth + 1):
        lane = rows[paths.count >= d]
        one, other = (
            _Ends.of(scene, faces, edges, paths, lane, d),
            _Ends.of(scene, faces, edges, paths, lane, d + 1),
        )
        before, after = corners[lane, d], corners[lane, d + 1]
        # The last ray goes from the receiver, which is off every surface and needs no lift.
        backward = paths.count[lane] == d if d else np.zeros(len(lane), np.bool_)
        lifted = one.lifted(before, after), other.lifted(after, before)
        first = np.where(backward[:, None], lifted[1], lifted[0])
        # A ray ends on a face, but beside an edge: on it, rounding would put the end into one of both faces.
        last = np.where(
            backward[:, None],
            np.where(one.bends[:, None], lifted[0], before),
            np.where(other.bends[:, None], lifted[1], after),
        )
        wanted = np.where(backward[:, None], one.surfaces, other.surfaces)
        plane = np.where(backward, one.plane, other.plane)
        segments.append((lane, first, last, wanted, plane))
    owner, first, last, wanted, plane = (np.concatenate(column) for column in zip(*segments, strict=True))
    behind, met = look.nearest(first, last)
    other = (behind < 0) & (met[:, None] != wanted).all(1)
    hidden = other & (behind < -AT_END)
    near = np.flatnonzero(other & ~hidden & (plane >= 0))
    hidden[near] = in_front(scene.plane_table, met[near], plane[near], last[near])
    free[owner[hidden]] = False
    return free


@dataclass(frozen=True, eq=False)
class _Ends:
    """Face, edge or antenna at one end of each of N segments."""

    normals: Float64Array
    """Unit normals of faces, for edges between both faces, 0 at antennas, Shape ``[N, 3]``."""
    bends: BoolArray
    """Which of them are at an edge."""
    plane: Int64Array
    """Of a face, −1 elsewhere."""
    surfaces: Int64Array
    """Surfaces that a ray may meet there, −1 for none, Shape ``[N, 2]``."""

    @classmethod
    def of(
        cls,
        scene: SionnaScene,
        faces: FaceRectangles,
        edges: EdgeTargets,
        paths: EdgePaths,
        rows: Int64Array,
        corner: int,
    ) -> _Ends:
        """Ends at a corner of paths by its index; 0 is the transmitter."""
        count = len(rows)
        inner = (paths.count[rows] >= corner) & (corner > 0)
        d = min(max(corner - 1, 0), paths.chain.shape[1] - 1)
        bends = inner & (paths.bend[rows] == d)
        at_face = np.flatnonzero(inner & ~bends)
        normals, surfaces = np.zeros((count, 3)), np.full((count, 2), -1)
        plane = np.full(count, -1)
        face = paths.chain[rows[at_face], d]
        normals[at_face], plane[at_face] = faces.normal[face], faces.plane[face]
        surfaces[at_face] = scene.joined.label[faces.plane[face]][:, None]
        edge = paths.edge[rows[bends]]
        normals[bends], surfaces[bends] = edges.outward[edge], edges.surfaces[edge]
        return cls(normals, bends, plane, surfaces)

    def lifted(self, points: Float64Array, towards: Float64Array) -> Float64Array:
        """Points `OFF_SURFACE` off faces, on the side of ``towards``; off edges, away from the wedge."""
        side = np.sign(np.einsum("nc,nc->n", towards - points, self.normals))
        side = np.where(self.bends, 1.0, side)
        off: Float64Array = points + OFF_SURFACE * side[:, None] * self.normals
        return off
