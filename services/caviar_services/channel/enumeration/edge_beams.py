"""Paths over an edge of a moving body, enumerated: edges that beams light from both sides.

A path over an edge is a chain of reflections from the transmitter to the edge and one from the receiver to
it. Beams say which edges each side lights (`image_beams`). Unfolded around the edge, the path is a straight
line between the images of both ends, which meets the edge at the point that J. B. Keller's law gives
("Geometrical Theory of Diffraction", 1962). Pairs of a chain before and a chain after are left out where
this point is beyond the ends of the edge or outside of a beam.

Enumerated are paths over one edge in which a body has the edge or a face. Each side has up to two reflections
at any faces, or any number at scenery alone. Where scenery has more than `_FEW` edges, only edges of bodies
are enumerated.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.enumeration.image_beams import (
    ImageBeams,
    SceneryViews,
    Targets,
    by_scenery,
    columns,
    filtered,
    first_beams,
    gathered,
    indices,
    lights_corner,
    lit_bodies,
    longer_beams,
    next_beams,
    numbers,
    pairs,
    places,
    reflected_beams,
    scenery_beams,
    shown_scenery,
)
from caviar_services.channel.sionna import dr, mi
from caviar_services.channel.sionna.diffracting_edges import SceneEdges
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_space.rectangles import FaceRectangles
from caviar_space.vectors import ranges

# Edges of scenery over which paths by way of bodies are enumerated; with more, rays look for such paths.
_FEW = 512

# Edges of a group at most; groups are tested by their spheres before edges are tested one by one.
_GROUP = 12

# Pairs of both sides that are tested together, so that memory is bounded.
_AT_ONCE = 1 << 22

# Offset of a plane that nothing is behind.
_EVERYWHERE = -1e30


class EdgeTargets:
    """E edges of a frame that beams may light: those of scenery, if these are few, then those of bodies.

    Coordinates are those of the ray tracer.

    Args:
        scene: The scene, whose bodies are where they were placed last.
        edges: All edges of the scene.
        faces: Faces of scenery, then those of standing bodies.
    """

    def __init__(self, scene: SionnaScene, edges: SceneEdges, faces: FaceRectangles) -> None:
        # Bodies that no object of the frame uses are in the scene, too, but do not stand in it.
        number, piece = edges.of_bodies
        standing = np.array(scene.standing_bodies, np.int64) + scene.first_body_piece
        kept = np.isin(piece, standing)
        still = np.arange(enumerated_scenery(edges))
        number = np.concatenate([still, number[kept]])
        piece = np.concatenate([np.full(len(still), -1), piece[kept]])
        wedges, is_edge = edges.faces(number)
        self.number = number[is_edge]
        """Index of each edge among all edges of the scene, Shape ``[E]``."""
        self.ends = edges.ends(self.number) - scene.centre
        """[m], Shape ``[E, 2, 3]``."""
        self.normals = wedges.normals[is_edge]
        """Unit, outward, of both faces, Shape ``[E, 2, 3]``."""
        self.outward = edges.outward(self.number)
        """Unit vectors between both normals, 0 at free edges, Shape ``[E, 3]``."""
        self.surfaces = scene.surface_of[edges.triangles[self.number]]
        """Of both faces, Shape ``[E, 2]``."""
        self.surface_of_face = scene.joined.label[faces.plane]
        """Surface of each face, Shape ``[F]``."""
        self.piece = piece[is_edge]
        """Of the body that each is of, −1 for scenery, in ascending order, Shape ``[E]``."""
        line = self.ends[:, 1] - self.ends[:, 0]
        length = np.sqrt((line**2).sum(1, keepdims=True))
        rows = [self.ends[:, 0], self.ends[:, 1], line / length, length, *np.moveaxis(self.normals, 1, 0)]
        column = columns(np.concatenate(rows, axis=1).T)
        self.a, self.b, self.along = (mi.Vector3f(*column[i : i + 3]) for i in (0, 3, 6))
        self.length = column[9]
        self.one, self.other = mi.Vector3f(*column[10:13]), mi.Vector3f(*column[13:])

    def __len__(self) -> int:
        return len(self.number)

    def outside(self, points: Float64Array, edges: Int64Array) -> BoolArray:
        """Test whether points [m], Shape ``[N, 3]``, are in front of at least one face of their edge,
        ``[N]``."""
        towards = points - self.ends[edges, 0]
        outside: BoolArray = (np.einsum("nc,nfc->nf", towards, self.normals[edges]) > 0).any(1)
        return outside


def enumerated_scenery(edges: SceneEdges) -> int:
    """Number of edges of scenery over which paths are enumerated; they are the first of all edges."""
    count = len(edges) - len(edges.of_bodies[0])
    return count if count <= _FEW else 0


class _Groups:
    """Edges in a hierarchy of spheres: pieces, and within these groups of neighbours."""

    def __init__(self, edges: EdgeTargets, wanted: BoolArray) -> None:

        rows = np.flatnonzero(wanted)
        _, first, sizes = np.unique(edges.piece[rows], return_index=True, return_counts=True)
        self.pieces = len(sizes)
        if not self.pieces:
            return
        ends = edges.ends[rows]
        low, high = np.minimum.reduceat(ends.min(1), first), np.maximum.reduceat(ends.max(1), first)
        own = np.repeat(np.arange(self.pieces), sizes)
        # Neighbours: edges of a piece in the order of their middles along the piece's longest side.
        along = ends.sum(1)[np.arange(len(rows)), np.argmax(high - low, axis=1)[own]]
        rows = rows[np.lexsort((along, own))]
        counts = -(-sizes // _GROUP)
        self.most = int(counts.max())
        """Largest number of groups of a piece."""
        of, number = ranges(np.zeros(self.pieces, np.int64), counts)
        begin = first[of] + number * _GROUP
        size = np.minimum(first[of] + sizes[of] - begin, _GROUP)
        self.edge = indices(rows)
        self.first_group, self.groups = indices(np.cumsum(counts) - counts), indices(counts)
        self.begin, self.size = indices(begin), indices(size)
        self.piece_sphere, self.group_sphere = (
            _spheres(edges.ends[rows], column) for column in (first, begin)
        )


def _spheres(ends: Float64Array, begin: Int64Array) -> tuple[Any, Any]:
    """Centres and radii of spheres around runs of edges that begin at these, in the ray tracer's arrays."""
    low, high = np.minimum.reduceat(ends.min(1), begin), np.maximum.reduceat(ends.max(1), begin)
    radius = np.sqrt(((high - low) ** 2).sum(1)) / 2
    return places((low + high) / 2), columns(radius[None])[0]


@dataclass(frozen=True, eq=False)
class EdgeChains:
    """N candidates for paths over an edge, all with I reflections before it and J after it."""

    before: Int64Array
    """Faces from the transmitter to the edge, Shape ``[N, I]``."""
    edge: Int64Array
    """Shape ``[N]``."""
    behind: Int64Array
    """Faces from the receiver back to the edge, Shape ``[N, J]``."""
    receiver: Int64Array
    """Shape ``[N]``."""


def edge_chains(
    targets: Targets,
    edges: EdgeTargets,
    scenery: Int64Array,
    views: SceneryViews,
    transmitter: Float64Array,
    receivers: Float64Array,
) -> list[EdgeChains]:
    """Candidates for paths over one edge, of all numbers of reflections.

    Args:
        targets: Faces.
        edges: Edges of the frame.
        scenery: As in `chain_pairs`; likewise the others.
        views: See ``scenery``.
        transmitter: See ``scenery``.
        receivers: See ``scenery``.
    """
    depth = scenery.shape[1]
    if not (depth and len(edges) and len(receivers)):
        return []
    # Reflections of both sides and the diffraction together are at most ``depth`` interactions.
    sources = list(_from_transmitter(targets, scenery, views, transmitter))
    sinks = list(_from_receivers(targets, views, receivers, depth))
    every = _Groups(edges, np.ones(len(edges), np.bool_))
    sent = [_lit(targets, edges, every, sources[0], np.zeros(1, np.int64))]
    taken = [_lit(targets, edges, every, *sinks[0])]
    # A side with all reflections that a path may have leaves none to the other side: only edges that the
    # other side lights directly can be met there.
    of_sent, of_taken = (
        _Groups(edges, np.isin(np.arange(len(edges)), side[0].edge)) for side in (taken, sent)
    )
    for n, beams in enumerate(sources[1:], start=2):
        owner = np.zeros(len(beams), np.int64)
        sent.append(_lit(targets, edges, every if n < depth else of_sent, beams, owner))
    for n, (beams, owner) in enumerate(sinks[1:], start=2):
        taken.append(_lit(targets, edges, every if n < depth else of_taken, beams, owner))
    return [
        chains
        for i, one in enumerate(sent)
        for j, other in enumerate(taken)
        if i + j < depth
        for chains in _meeting(targets, edges, one, other)
    ]


@dataclass(frozen=True, eq=False)
class _Lit:
    """Pairs of a beam and an edge that the beam may light."""

    beams: ImageBeams
    owner: Int64Array
    """Receiver of each beam, Shape ``[B]``; 0 for beams of the transmitter."""
    beam: Int64Array
    edge: Int64Array


def _from_transmitter(
    targets: Targets, scenery: Int64Array, views: SceneryViews, transmitter: Float64Array
) -> Iterator[ImageBeams]:
    """Beams of the transmitter after no reflection, one, and so on, up to one less than the depth."""
    depth, length = scenery.shape[1], (scenery >= 0).sum(1)
    yield _source_beams(transmitter[None])
    if depth == 1:
        return
    beams = first_beams(targets, transmitter, scenery[length == 1, 0])
    yield beams
    for n in range(2, depth):
        if not len(beams):
            return
        known = scenery[length == n, :n]
        two = n == 2
        beams = (
            next_beams(targets, beams, views.faces, known) if two else scenery_beams(targets, beams, known)
        )
        yield beams


def _from_receivers(
    targets: Targets, views: SceneryViews, receivers: Float64Array, depth: int
) -> Iterator[tuple[ImageBeams, Int64Array]]:
    """Beams of the receivers in the same order, with the receiver of each beam."""
    yield _source_beams(receivers), np.arange(len(receivers))
    if depth == 1:
        return
    faces = targets.faces
    bodies = np.arange(targets.first_body, len(faces))
    # Every receiver with every face of a body that it sees from the reflecting side; scenery by its views.
    height = receivers @ faces.normal[bodies].T - faces.offset[bodies]
    receiver, place = np.nonzero((height > 0) | faces.two_sided[bodies])
    owner = np.concatenate([views.receiver, receiver])
    chain = np.concatenate([views.faces[views.place], bodies[place]])[:, None]
    beams = reflected_beams(targets, chain, places(receivers[owner]), None)
    yield beams, owner
    for n in range(2, depth):
        if not len(beams):
            return
        parent, face = _onward(targets, beams, views) if n == 2 else shown_scenery(targets, beams, views)
        if n > 2:
            face = views.faces[face]
        chain = np.concatenate([beams.chain[parent], face[:, None]], axis=1)
        beams, owner = longer_beams(targets, beams, parent, chain), owner[parent]
        scenery = ~beams.by_body
        views = SceneryViews(
            views.faces, views.sights, owner[scenery], np.searchsorted(views.faces, chain[scenery, -1])
        )
        yield beams, owner


def _onward(targets: Targets, beams: ImageBeams, views: SceneryViews) -> tuple[Int64Array, Int64Array]:
    """Pairs of a beam and a face that it lights; beams of scenery alone, those of ``views``, come first."""
    view, place = shown_scenery(targets, beams, views)
    of_body = by_scenery(targets, beams, views.faces)
    by_body = filtered(partial(lights_corner, targets, beams), lit_bodies(targets, beams))
    parent = np.concatenate([view, numbers(of_body[0]), numbers(by_body[0])])
    return parent, np.concatenate([views.faces[place], numbers(of_body[1]), numbers(by_body[1])])


def _source_beams(points: Float64Array) -> ImageBeams:
    """Beams without a reflection, which light everything around points [m], Shape ``[N, 3]``."""
    count = len(points)
    none = places(np.zeros((count, 3)))
    cosine, lit_from = columns(np.tile([[-1.0], [_EVERYWHERE]], count))
    return ImageBeams(
        chain=np.zeros((count, 0), np.int64),
        by_body=np.zeros(count, np.bool_),
        image=places(points),
        sides=(none,),
        axis=places(np.tile([0.0, 0.0, 1.0], (count, 1))),
        cosine=cosine,
        last=indices(np.zeros(count, np.int64)),
        lit=none,
        lit_from=lit_from,
    )


def _lit(targets: Targets, edges: EdgeTargets, groups: _Groups, beams: ImageBeams, owner: Int64Array) -> _Lit:
    """Edges that beams may light, except for edges of the face that reflected the beam last."""
    none = np.zeros(0, np.int64)
    if not (len(beams) and groups.pieces):
        return _Lit(beams, owner, none, none)

    def near(beam: Any, piece: Any) -> Any:
        centre, radius = (gathered(column, piece) for column in groups.piece_sphere)
        return beams.light_cone(beam, centre, radius, targets.slack)

    def near_group(pair: Any, place: Any) -> Any:
        its = gathered(piece, pair)
        there = place < gathered(groups.groups, its)
        group = dr.select(there, gathered(groups.first_group, its) + place, 0)
        centre, radius = (gathered(column, group) for column in groups.group_sphere)
        of = gathered(beam, pair)
        there &= beams.light_cone(of, centre, radius, targets.slack)
        return there & beams.light(of, centre, radius + targets.slack)

    def shows(pair: Any, place: Any) -> Any:
        its = gathered(group, pair)
        there = place < gathered(groups.size, its)
        edge = gathered(groups.edge, dr.select(there, gathered(groups.begin, its) + place, 0))
        return there & _outside(targets, edges, beams, gathered(beam, pair), edge)

    def within(beam: Any, edge: Any) -> Any:
        return _in_beam(targets, edges, beams, beam, edge)

    beam, piece = pairs(len(beams), groups.pieces, near)
    pair, place = pairs(dr.width(beam), groups.most, near_group)
    if not dr.width(pair):
        return _Lit(beams, owner, none, none)
    beam, group = gathered(beam, pair), gathered(groups.first_group, gathered(piece, pair)) + place
    dr.eval(beam, group)
    pair, place = pairs(dr.width(beam), _GROUP, shows)
    if not dr.width(pair):
        return _Lit(beams, owner, none, none)
    edge = gathered(groups.edge, gathered(groups.begin, gathered(group, pair)) + place)
    of, at = (numbers(part) for part in filtered(within, (gathered(beam, pair), edge)))
    if beams.chain.shape[1]:
        # An edge of the mirror itself lies in the mirror's plane: no wave goes from there to it.
        last = edges.surface_of_face[beams.chain[of, -1]]
        own = (last[:, None] == edges.surfaces[at]).any(1)
        of, at = of[~own], at[~own]
    return _Lit(beams, owner, of, at)


def _outside(targets: Targets, edges: EdgeTargets, beams: ImageBeams, beam: Any, edge: Any) -> Any:
    """Test whether images are in front of at least one face of edges."""
    back = gathered(beams.image, beam) - gathered(edges.a, edge)
    one, other = dr.dot(back, gathered(edges.one, edge)), dr.dot(back, gathered(edges.other, edge))
    return dr.maximum(one, other) > -targets.slack


def _in_beam(targets: Targets, edges: EdgeTargets, beams: ImageBeams, beam: Any, edge: Any) -> Any:
    """Test whether edges may be lit: no side of the beam has both ends beyond it."""
    image, a, b = gathered(beams.image, beam), gathered(edges.a, edge), gathered(edges.b, edge)
    normal = gathered(beams.lit, beam)
    lit = dr.maximum(dr.dot(normal, a), dr.dot(normal, b)) > gathered(beams.lit_from, beam) - targets.slack
    for side in beams.sides:
        inward = gathered(side, beam)
        lit &= dr.maximum(dr.dot(inward, a - image), dr.dot(inward, b - image)) > -targets.slack
    return lit


def _meeting(targets: Targets, edges: EdgeTargets, one: _Lit, other: _Lit) -> Iterator[EdgeChains]:
    """Pairs of a beam from each side that meet at an edge within both beams."""
    order = np.argsort(other.edge, kind="stable")
    sizes = np.bincount(other.edge, minlength=len(edges))
    begin, sizes = (np.cumsum(sizes) - sizes)[one.edge], sizes[one.edge]
    part = np.cumsum(sizes) // _AT_ONCE
    for rows in np.split(np.arange(len(sizes)), np.flatnonzero(np.diff(part)) + 1):
        own, place = ranges(begin[rows], sizes[rows])
        if not len(own):
            continue
        first, second = rows[own], order[place]
        # Chains of scenery alone over an edge of scenery are left to rays.
        moving = edges.piece[one.edge[first]] >= 0
        moving |= one.beams.by_body[one.beam[first]] | other.beams.by_body[other.beam[second]]
        first, second = first[moving], second[moving]
        if not len(first):
            continue
        sent, taken = indices(one.beam[first]), indices(other.beam[second])
        edge = indices(one.edge[first])
        kept = _kept(targets, edges, (one.beams, sent), (other.beams, taken), edge)
        kept = kept[kept < len(first)]
        first, second = first[kept], second[kept]
        yield EdgeChains(
            before=one.beams.chain[one.beam[first]],
            edge=one.edge[first],
            behind=other.beams.chain[other.beam[second]],
            receiver=other.owner[other.beam[second]],
        )


def _kept(
    targets: Targets,
    edges: EdgeTargets,
    one: tuple[ImageBeams, Any],
    other: tuple[ImageBeams, Any],
    edge: Any,
) -> Int64Array:
    """Indices of the pairs of beams that meet at their edge, at the point of Keller's law."""
    origin, along = gathered(edges.a, edge), gathered(edges.along, edge)
    (s, from_source), (t, from_target) = (
        _unfolded(gathered(beams.image, beam) - origin, along) for beams, beam in (one, other)
    )
    # Keller's law: s − place over from_source is place − t over from_target.
    place = (s * from_target + t * from_source) / (from_source + from_target)
    meets = (place > -targets.slack) & (place < gathered(edges.length, edge) + targets.slack)
    point = origin + place * along
    for beams, beam in (one, other):
        meets &= beams.light(beam, point, targets.slack)
        meets &= dr.dot(gathered(beams.lit, beam), point) > gathered(beams.lit_from, beam) - targets.slack
    return numbers(dr.compress(meets))


def _unfolded(point: Any, along: Any) -> tuple[Any, Any]:
    """Coordinate of points along lines through the origin, and their distance from these lines."""
    s = dr.dot(point, along)
    return s, dr.norm(point - s * along)
