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
from caviar_services.channel.enumeration.obstacle_trees import AT_END, OFF_SURFACE, ObstacleTrees
from caviar_services.channel.propagation.image_method import keller_point
from caviar_services.channel.propagation.utd import beyond_edges, slab
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_space.materials import DRAWN
from caviar_space.rectangles import FaceRectangles
from caviar_space.vectors import Rows


@dataclass(frozen=True, eq=False)
class ImagePaths(Rows):
    """P paths of at most D interactions: reflections, and a diffraction at most."""

    chain: Int64Array
    """Face at each reflection, −1 at an edge and past the last, Shape ``[P, D]``."""
    bend: Int64Array
    """Which interaction is at an edge, −1 for none, Shape ``[P]``."""
    edge: Int64Array
    """Edge among `EdgeTargets`, −1 for none, Shape ``[P]``."""
    receiver: Int64Array
    """Index of the receiver, Shape ``[P]``."""
    points: Float64Array
    """Points of the interactions, the receiver's position past the last [m], Shape ``[P, D, 3]``."""

    @property
    def count(self) -> Int64Array:
        """Interactions of each path, Shape ``[P]``."""
        count: Int64Array = (self.chain >= 0).sum(1) + (self.bend >= 0)
        return count


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
    none = np.full(int(good.sum()), -1)
    return ImagePaths(chain[good], none, none, receiver[good], points[good])


def unhidden(
    scene: SionnaScene,
    obstacles: ObstacleTrees,
    faces: FaceRectangles,
    paths: ImagePaths,
    transmitter: Float64Array,
    receivers: Float64Array,
    edges: EdgeTargets | None = None,
) -> BoolArray:
    """Mask of paths without an obstacle on their segments (`path_kernels.unhidden`), Shape ``[P]``.

    Args:
        scene: The scene.
        obstacles: Its obstacles.
        faces: Faces of the paths.
        paths: Paths of the image method.
        transmitter: Position [m], Shape ``[3]``.
        receivers: Positions [m], Shape ``[R, 3]``.
        edges: Edges of the paths; None: they have none.
    """
    corners, planes, normals = _corners(faces, paths, transmitter, receivers)
    surfaces = np.where(planes >= 0, scene.joined.label[planes], -1)[..., None].repeat(2, axis=-1)
    if edges is not None:
        corner = np.arange(len(paths.bend)), paths.bend + 1
        normals[corner], surfaces[corner] = edges.outward[paths.edge], edges.surfaces[paths.edge]
    return obstacles.unhidden(corners, paths.count, paths.bend, normals, surfaces, planes)


def _corners(
    faces: FaceRectangles, paths: ImagePaths, transmitter: Float64Array, receivers: Float64Array
) -> tuple[Float64Array, Int64Array, Float64Array]:
    """Corners of paths, from the transmitter to the receiver [m], with the planes and the unit normals of the
    faces there, −1 and 0 for none; Shape ``[P, D + 2, …]`` each."""
    start = np.broadcast_to(transmitter, (len(paths.chain), 1, 3))
    corners = np.concatenate([start, paths.points, receivers[paths.receiver][:, None]], axis=1)
    planes, normals = np.full(corners.shape[:2], -1), np.zeros(corners.shape)
    path, d = np.nonzero(paths.chain >= 0)
    face = paths.chain[path, d]
    planes[path, d + 1], normals[path, d + 1] = faces.plane[face], faces.normal[face]
    return corners, planes, normals


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
    obstacles: ObstacleTrees,
    faces: FaceRectangles,
    paths: ImagePaths,
    transmitter: Float64Array,
    receivers: Float64Array,
    most: Int64Array,
) -> tuple[Crossings, BoolArray]:
    """Surfaces that the segments of paths cross.

    Args:
        scene: The scene.
        obstacles: Its obstacles.
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
        behind, triangle = obstacles.first_triangle(start[alive], segments.last[alive])
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
        corners, planes, normal = _corners(faces, paths, transmitter, receivers)
        surface = np.where(planes >= 0, scene.joined.label[planes], -1)
        path, number = np.nonzero(np.arange(corners.shape[1] - 1) <= paths.count[:, None])
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


def edge_paths(
    targets: Targets,
    edges: EdgeTargets,
    candidates: Sequence[EdgeChains],
    transmitter: Float64Array,
    receivers: Float64Array,
    depth: int,
) -> ImagePaths:
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
    parts.append(ImagePaths(np.zeros((0, depth), np.int64), none, none, none, np.zeros((0, depth, 3))))
    found = ImagePaths.joined(parts)
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
) -> ImagePaths:
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
    return ImagePaths(chain, np.full(len(rows), i), chains.edge[rows], chains.receiver[rows], points)
