"""Paths over edges of bodies: points by the image method and Keller's law, in float64, and visibility."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.enumeration.edge_beams import EdgeChains, EdgeTargets
from caviar_services.channel.enumeration.image_paths import AT_END, OFF_SURFACE, in_front, reflection_points
from caviar_services.channel.enumeration.scene_faces import FaceRectangles
from caviar_services.channel.paths import Rows
from caviar_services.channel.propagation.image_method import keller_point
from caviar_services.channel.propagation.utd import beyond_edges
from caviar_services.channel.sionna.candidate_visibility import Faces
from caviar_services.channel.sionna.scene import SionnaScene


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
    faces: FaceRectangles,
    edges: EdgeTargets,
    candidates: Sequence[EdgeChains],
    transmitter: Float64Array,
    receivers: Float64Array,
    depth: int,
) -> EdgePaths:
    """Candidates that are paths: reflections lie in triangles of their faces, and both segments at the edge
    run outside of its wedge.

    Args:
        faces: Faces of the chains.
        edges: Edges of the chains.
        candidates: From `edge_chains`.
        transmitter: Position [m], Shape ``[3]``.
        receivers: Positions [m], Shape ``[R, 3]``.
        depth: Interactions of a path at most, D.

    Returns:
        Paths sorted by receiver, number of interactions, edge and surfaces. Of paths by way of faces that are
        one surface, the first one.
    """
    parts = [_with_points(faces, edges, chains, transmitter, receivers, depth) for chains in candidates]
    parts.append(_no_paths(depth))
    found = EdgePaths(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("chain", "bend", "count", "edge", "receiver", "points")
        )
    )
    # Surfaces instead of faces: coplanar faces that touch give the same path once each.
    keys = np.column_stack(
        [found.receiver, found.count, edges.number[found.edge], found.bend, _surfaces(edges, found.chain)]
    )
    return found.take(np.unique(keys, axis=0, return_index=True)[1])


def _no_paths(depth: int) -> EdgePaths:
    none = np.zeros(0, np.int64)
    return EdgePaths(np.zeros((0, depth), np.int64), none, none, none, none, np.zeros((0, depth, 3)))


def _surfaces(edges: EdgeTargets, chain: Int64Array) -> Int64Array:
    surfaces = np.full(chain.shape, -1)
    surfaces[chain >= 0] = edges.surface_of_face[chain[chain >= 0]]
    return surfaces


def _with_points(
    faces: FaceRectangles,
    edges: EdgeTargets,
    chains: EdgeChains,
    transmitter: Float64Array,
    receivers: Float64Array,
    depth: int,
) -> EdgePaths:
    start = np.broadcast_to(transmitter, (len(chains.edge), 3))
    ends = receivers[chains.receiver]
    source, target = _image(faces, chains.before, start), _image(faces, chains.behind, ends)
    wedge = edges.ends[chains.edge]
    with np.errstate(invalid="ignore", divide="ignore"):  # of what lies on the line of an edge
        place = keller_point(source, target, wedge)
        good = np.isfinite(place).all(1) & ~beyond_edges(place, wedge)
    # Both rays at the edge have to run outside of the wedge, in front of one of its faces at least.
    good &= edges.outside(source, chains.edge) & edges.outside(target, chains.edge)
    rows = np.flatnonzero(good)
    before, one = reflection_points(faces, chains.before[rows], start[rows], place[rows])
    rows, before = rows[one], before[one]
    behind, other = reflection_points(faces, chains.behind[rows], ends[rows], place[rows])
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


def _image(faces: FaceRectangles, chain: Int64Array, points: Float64Array) -> Float64Array:
    """Images of points [m] in all faces of chains of one length, Shape ``[N, 3]``."""
    for column in chain.T:
        points = faces.mirrored(points, column)
    return points


def unhidden_over_edges(
    scene: SionnaScene,
    look: Faces,
    faces: FaceRectangles,
    edges: EdgeTargets,
    paths: EdgePaths,
    transmitter: Float64Array,
    receivers: Float64Array,
) -> BoolArray:
    """Which paths have no obstacle on their segments, Shape ``[P]``; the arguments are those of `unhidden`.

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
    """What is at one end of each of N segments."""

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
        """Those of a corner of paths by its index; 0 is the transmitter."""
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
