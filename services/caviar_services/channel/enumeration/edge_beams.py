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
from functools import cached_property

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.enumeration.image_beams import (
    ImageBeams,
    SceneryViews,
    Targets,
    boxes,
    first_beams,
    kernels,
    next_beams,
    reflected_beams,
    source_beams,
)
from caviar_services.channel.sionna.diffracting_edges import SceneEdges
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_space.rectangles import FaceRectangles

# Edges of scenery over which paths by way of bodies are enumerated; with more, rays look for such paths.
_FEW = 512


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

    def arrays(self, wanted: Int64Array) -> tuple[Float64Array | Int64Array | BoolArray, ...]:
        """These edges, in ascending order, as `beam_kernels` takes them."""
        ends, piece = self.ends[wanted], self.piece[wanted]
        begin = np.append(np.flatnonzero(np.diff(piece, prepend=-2)), len(wanted))
        around = boxes(ends, begin), begin, boxes(ends, np.arange(len(wanted) + 1))
        return *around, ends, self.normals[wanted], self.surfaces[wanted], piece >= 0

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
    sent = [
        _Side(targets, edges, beams, np.zeros(len(beams), np.int64))
        for beams in _from_transmitter(targets, scenery, transmitter)
    ]
    taken = [_Side(targets, edges, *side) for side in _from_receivers(targets, views, receivers, depth)]
    found = []
    for i, j in ((i, total - i) for total in range(depth) for i in range(total + 1)):
        # Beams of more reflections are far more: edges are looked up for each of them.
        if i > j:
            one, edge, other = sent[i].meetings(taken[j])
        else:
            other, edge, one = taken[j].meetings(sent[i])
        chains = sent[i].beams.chain[one], taken[j].beams.chain[other]
        found.append(EdgeChains(chains[0], edge, chains[1], taken[j].owner[other]))
    return found


@dataclass(frozen=True, eq=False)
class _Side:
    """Beams from one side after so many reflections."""

    targets: Targets
    edges: EdgeTargets
    beams: ImageBeams
    owner: Int64Array
    """Receiver of each beam, Shape ``[B]``; 0 for beams of the transmitter."""

    @cached_property
    def _own(self) -> Int64Array:
        """Surface that reflected each beam last, −2 for none, Shape ``[B]``."""
        if not self.beams.chain.shape[1]:
            return np.full(len(self.beams), -2)
        return self.edges.surface_of_face[self.beams.chain[:, -1]]

    @cached_property
    def _lit(self) -> Int64Array:
        """Pairs of an edge and a beam that may light it, in the order of edges, Shape ``[N, 2]``."""
        every = self.edges.arrays(np.arange(len(self.edges)))
        beam, edge = kernels.lit_edges(self.beams.rows, self._own, every, self.targets.slack).T
        order = np.argsort(edge, kind="stable")
        return np.column_stack([edge[order], beam[order]])

    def meetings(self, other: _Side) -> tuple[Int64Array, Int64Array, Int64Array]:
        """Beams of this side, edges, and beams of the other side that meet there, within both beams."""
        # Chains of scenery alone over an edge of scenery are left to rays.
        lit = other._lit
        wanted, edge = np.unique(lit[:, 0], return_inverse=True)
        mine = self.beams.rows, self._own, self.beams.by_body
        theirs = other.beams.rows, np.column_stack([edge, lit[:, 1]]), other.beams.by_body
        met_at = self.edges.arrays(wanted), self.targets.slack
        beam, met, beam_of_other = kernels.meetings(*mine, *theirs, *met_at).T
        return beam, wanted[met], beam_of_other


def _from_transmitter(
    targets: Targets, scenery: Int64Array, transmitter: Float64Array
) -> Iterator[ImageBeams]:
    """Beams of the transmitter after no reflection, one, and so on, up to one less than the depth."""
    depth, length = scenery.shape[1], (scenery >= 0).sum(1)
    yield source_beams(transmitter[None])
    if depth == 1:
        return
    beams = first_beams(targets, transmitter, scenery[length == 1, 0])
    yield beams
    for n in range(2, depth):
        beams = next_beams(targets, beams, scenery[length == n, :n], by_bodies=n == 2)
        yield beams


def _from_receivers(
    targets: Targets, views: SceneryViews, receivers: Float64Array, depth: int
) -> Iterator[tuple[ImageBeams, Int64Array]]:
    """Beams of the receivers in the same order, with the receiver of each beam."""
    beams, owner = source_beams(receivers), np.arange(len(receivers))
    yield beams, owner
    if depth == 1:
        return
    faces = targets.faces
    bodies = np.arange(targets.first_body, len(faces))
    # Every receiver with every face of a body that it sees from the reflecting side; scenery by its views.
    height = receivers @ faces.normal[bodies].T - faces.offset[bodies]
    receiver, place = np.nonzero((height > 0) | faces.two_sided[bodies])
    owner = np.concatenate([views.receiver, receiver])
    beams = reflected_beams(targets, beams, owner, np.concatenate([views.face, bodies[place]]))
    yield beams, owner
    for n in range(2, depth):
        # Beams of scenery alone come first; after the second reflection they are all that goes on.
        first = beams.first_by_body
        pairs = kernels.shown_scenery(beams.rows[:first], targets.arrays)
        if n == 2:
            pairs = np.concatenate([pairs, kernels.lit_faces(beams.rows, first, targets.arrays)])
        beams, owner = reflected_beams(targets, beams, *pairs.T), owner[pairs[:, 0]]
        yield beams, owner
