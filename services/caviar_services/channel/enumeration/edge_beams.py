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

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.enumeration.image_beams import (
    ImageBeams,
    SceneryViews,
    Targets,
    by_scenery,
    first_beams,
    kernels,
    lit_bodies,
    longer_beams,
    next_beams,
    reflected_beams,
    scenery_beams,
    shown_scenery,
    spheres,
)
from caviar_services.channel.sionna.diffracting_edges import SceneEdges
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_space.rectangles import FaceRectangles

# Edges of scenery over which paths by way of bodies are enumerated; with more, rays look for such paths.
_FEW = 512

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
    sources = list(_from_transmitter(targets, scenery, transmitter))
    sinks = list(_from_receivers(targets, views, receivers, depth))
    every = np.arange(len(edges))
    sent = [_lit(targets, edges, every, sources[0], np.zeros(1, np.int64))]
    taken = [_lit(targets, edges, every, *sinks[0])]
    # A side with all reflections that a path may have leaves none to the other side: only edges that the
    # other side lights directly can be met there.
    of_sent, of_taken = (np.unique(side[0].pairs[:, 1]) for side in (taken, sent))
    for n, beams in enumerate(sources[1:], start=2):
        owner = np.zeros(len(beams), np.int64)
        sent.append(_lit(targets, edges, every if n < depth else of_sent, beams, owner))
    for n, (beams, owner) in enumerate(sinks[1:], start=2):
        taken.append(_lit(targets, edges, every if n < depth else of_taken, beams, owner))
    return [
        _meeting(targets, edges, one, other)
        for i, one in enumerate(sent)
        for j, other in enumerate(taken)
        if i + j < depth
    ]


@dataclass(frozen=True, eq=False)
class _Lit:
    """Pairs of a beam and an edge that the beam may light."""

    beams: ImageBeams
    owner: Int64Array
    """Receiver of each beam, Shape ``[B]``; 0 for beams of the transmitter."""
    pairs: Int64Array
    """Shape ``[N, 2]``."""


def _from_transmitter(
    targets: Targets, scenery: Int64Array, transmitter: Float64Array
) -> Iterator[ImageBeams]:
    """Beams of the transmitter after no reflection, one, and so on, up to one less than the depth."""
    depth, length = scenery.shape[1], (scenery >= 0).sum(1)
    yield _source_beams(transmitter[None])
    if depth == 1:
        return
    beams = first_beams(targets, transmitter, scenery[length == 1, 0])
    yield beams
    for n in range(2, depth):
        onward = next_beams if n == 2 else scenery_beams
        beams = onward(targets, beams, scenery[length == n, :n])
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
    chain = np.concatenate([views.face, bodies[place]])[:, None]
    beams = reflected_beams(targets, chain, receivers[owner])
    yield beams, owner
    for n in range(2, depth):
        # Beams of scenery alone come first; after the second reflection they are all that goes on.
        pairs = [shown_scenery(targets, beams.scenery_alone())]
        if n == 2:
            pairs += [by_scenery(targets, beams), lit_bodies(targets, beams)]
        none = np.zeros(0, np.int64)
        beams, owner = (
            longer_beams(targets, beams, none, np.zeros((0, n), np.int64), *pairs),
            owner[np.concatenate(pairs)[:, 0]],
        )
        yield beams, owner


def _source_beams(points: Float64Array) -> ImageBeams:
    """Beams without a reflection, which light everything around points [m], Shape ``[N, 3]``."""
    count = len(points)
    rows = np.zeros((count, kernels.WIDTH))
    rows[:, :3], rows[:, kernels.COSINE], rows[:, kernels.LIT_FROM] = points, -1.0, _EVERYWHERE
    rows[:, kernels.LAST] = -1
    return ImageBeams(np.zeros((count, 0), np.int64), np.zeros(count, np.bool_), rows)


def _lit(
    targets: Targets, edges: EdgeTargets, wanted: Int64Array, beams: ImageBeams, owner: Int64Array
) -> _Lit:
    """Edges, of the wanted ones in ascending order, that beams may light, except for edges of the face that
    reflected the beam last: they lie in the mirror's plane, and no wave goes from there to them."""
    own = np.full(len(beams), -2)
    if beams.chain.shape[1]:
        own = edges.surface_of_face[beams.chain[:, -1]]
    ends, every = edges.ends[wanted], np.arange(len(wanted) + 1)
    begin = np.append(np.flatnonzero(np.diff(edges.piece[wanted], prepend=-2)), len(wanted))
    pairs = kernels.lit_edges(
        beams.rows,
        spheres(ends, begin),
        begin,
        spheres(ends, every),
        ends,
        edges.normals[wanted],
        edges.surfaces[wanted],
        own,
        targets.slack,
    )
    pairs[:, 1] = wanted[pairs[:, 1]]
    return _Lit(beams, owner, pairs)


def _meeting(targets: Targets, edges: EdgeTargets, one: _Lit, other: _Lit) -> EdgeChains:
    """Pairs of a beam from each side that meet at an edge within both beams."""
    # Chains of scenery alone over an edge of scenery are left to rays.
    sent, edge, taken = kernels.meetings(
        one.beams.rows,
        one.pairs,
        one.beams.by_body,
        other.beams.rows,
        other.pairs,
        other.beams.by_body,
        edges.ends,
        edges.piece >= 0,
        targets.slack,
    ).T
    return EdgeChains(
        before=one.beams.chain[sent], edge=edge, behind=other.beams.chain[taken], receiver=other.owner[taken]
    )
