"""Paths between single antenna elements, from the paths between the arrays' centres, in float64.

A path is straightened by images: the transmitter is mirrored at one plane after the other, and the
length of the path is then that of a straight line to the receiver. That holds for every antenna element
with the same planes, so each element pair's length is exact, however near the arrays are.

Two kinds of path bend at a place that no plane gives. A diffracted path goes over the point of its edge
where it is shortest (Keller 1962: incident and diffracted ray make the same angle with the edge), so
turned about the edge into one plane it is straight again. A scattered path keeps the points where it
was scattered.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.paths import Rows
from caviar_services.channel.propagation.image_method import image_points
from caviar_space.obstacles import CLEARANCE


class Bend(IntEnum):
    """What fixes the points of a path beside planes."""

    NONE = 0
    EDGE = 1
    POINTS = 2


@dataclass(frozen=True, eq=False)
class Surfaces(Rows):
    """What P paths of at most D interactions meet."""

    types: UInt8Array
    """`Interaction` at each point, Shape ``[P, D]``."""
    points: Float64Array
    """Interaction points [m] of the path between the arrays' centres, Shape ``[P, D, 3]``."""
    origin: Float64Array
    """A point [m] of the plane at each interaction, Shape ``[P, D, 3]``."""
    plane: Int64Array
    """Its number among the planes of the scene, Shape ``[P, D]``."""
    normal: Float64Array
    """Its normal, of any length, Shape ``[P, D, 3]``."""
    edge: Float64Array
    """Both ends [m] of the edge that a path is diffracted at, Shape ``[P, 2, 3]``; else anything."""
    outward: Float64Array
    """Direction away from the wedge at that edge, Shape ``[P, 3]``."""
    settled: BoolArray
    """Paths that all corners of both arrays are known to have, Shape ``[P]``."""


@dataclass(frozen=True, eq=False)
class Lengths:
    """Of P paths between M receiving and N transmitting elements."""

    length: Float64Array
    """[m], Shape ``[P, M, N]``."""
    spreading: Float64Array
    """What the amplitude of the wave is proportional to [1/m], Shape ``[P, M, N]``: one over the length;
    over the root of s·s'·(s + s') after an edge; over both legs after scattering. Such legs count as
    `CLEARANCE` at least, which antennas are traced with. Elements at one place send each other nothing."""


class ElementPaths:
    """Lengths and points of paths between any elements, by the affine maps that straighten the paths.

    Args:
        surfaces: What the paths between the arrays' centres meet.
    """

    def __init__(self, surfaces: Surfaces) -> None:
        self.surfaces = surfaces
        types = surfaces.types
        depth = types.shape[1]
        place = np.arange(depth)
        bends = (types == Interaction.DIFFRACTION) | (types == Interaction.SCATTERING)
        bent = bends.any(1) if depth else np.zeros(len(types), bool)
        self.first = np.where(bent, np.argmax(bends, 1) if depth else 0, depth)
        """Interaction where the planes on the transmitter's side end, Shape ``[P]``."""
        self.last = np.where(bent, depth - 1 - np.argmax(bends[:, ::-1], 1) if depth else 0, depth)
        self.bend = np.where(
            (types == Interaction.DIFFRACTION).any(1), Bend.EDGE, np.where(bent, Bend.POINTS, Bend.NONE)
        )
        mirror = types == Interaction.REFLECTION
        # A path that bends is straightened from both ends up to the bend; another one from the transmitter's
        # end alone.
        self._sent = self._map(mirror & (place < self.first[:, None]), range(depth))
        self._taken = self._map(mirror & (place > self.last[:, None]), reversed(range(depth)))
        self._straight = bool((self.bend == Bend.NONE).all())

    def _map(self, mirror: BoolArray, order: Iterable[int]) -> tuple[Float64Array, Float64Array]:
        """Linear part and offset of mirroring at planes one after the other; ``[P, 3, 3]`` and ``[P, 3]``."""
        linear = np.tile(np.eye(3), (len(mirror), 1, 1))
        offset = np.zeros((len(mirror), 3))
        for d in order:
            # Householder: I − 2nnᵀ/n², the identity where nothing is mirrored.
            normal = np.where(mirror[:, d, None], self.surfaces.normal[:, d], 0.0)
            square = (normal**2).sum(-1)
            scaled = 2 * normal / np.where(square > 0, square, 1.0)[:, None]
            height = ((offset - self.surfaces.origin[:, d]) * normal).sum(-1)
            linear = linear - scaled[:, :, None] * np.einsum("pi,pij->pj", normal, linear)[:, None]
            offset = offset - scaled * height[:, None]
        return linear, offset

    def ends(self, start: Float64Array, end: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Points that straight lines along paths lead to from both ends: the image of the other end, or of
        the point that bends the path.

        Args:
            start: Centre of the transmitter of each path [m], Shape ``[P, 3]``; ``end`` that of the receiver.
            end: See ``start``.

        Returns:
            Points [m] from the transmitters and from the receivers, Shape ``[P, 3]`` each.
        """
        rows = np.arange(len(start))
        points = self.surfaces.points
        bent = (self.bend != Bend.NONE)[:, None]
        straight = np.zeros_like(self.first) if not points.shape[1] else self.first
        from_tx, from_rx = end, _mapped(self._sent, rows, start[:, None])[:, 0]
        if bent.any():
            from_tx = np.where(bent, points[rows, np.minimum(straight, points.shape[1] - 1)], end)
            last = points[rows, np.minimum(self.last, points.shape[1] - 1)]
            from_rx = np.where(bent, _unmapped(self._taken, last), from_rx)
        return _unmapped(self._sent, from_tx), from_rx

    @property
    def image_turn(self) -> Float64Array:
        """Linear part of the map from a transmitter to its image at the receiver, Shape ``[P, 3, 3]``; 0 for
        paths that bend, whose last leg begins at the bend."""
        turn: Float64Array = self._sent[0] * (self.bend == Bend.NONE)[:, None, None]
        return turn

    def lengths(self, rows: slice, transmit: Float64Array, receive: Float64Array) -> Lengths:
        """Lengths of some paths between elements.

        Args:
            rows: Of the paths.
            transmit: Transmitting elements of each path [m], Shape ``[p, N, 3]``.
            receive: Receiving elements of each path [m], Shape ``[p, M, 3]``.
        """
        sent = _mapped(self._sent, rows, transmit)
        if self._straight:
            length = _distances(receive, sent)
            return Lengths(length, _one_over(length))
        taken = _mapped(self._taken, rows, receive)
        length = _distances(taken, sent)
        spreading = _one_over(length)
        bend = self.bend[rows]
        for which, kind in ((bend == Bend.EDGE, self._over_edge), (bend == Bend.POINTS, self._by_points)):
            some = np.flatnonzero(which)
            if len(some):
                length[some], spreading[some] = kind(some + (rows.start or 0), sent[some], taken[some])
        return Lengths(length, spreading)

    def _over_edge(
        self, paths: Int64Array, sent: Float64Array, taken: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        (z, rho), (height, radius) = (self._around_edge(paths, ends) for ends in (sent, taken))
        # Turned about the edge into one plane, both ends are on opposite sides of it.
        across = radius[:, :, None] + rho[:, None]
        length = np.hypot(across, height[:, :, None] - z[:, None])
        # s and s' share the length as the distances from the edge do
        share = length / np.where(across > 0, across, 1.0)
        sent_leg = np.maximum(rho[:, None] * share, CLEARANCE)
        taken_leg = np.maximum(radius[:, :, None] * share, CLEARANCE)
        return length, 1 / np.sqrt(sent_leg * taken_leg * (sent_leg + taken_leg))

    def _around_edge(self, paths: Int64Array, ends: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Place along the edge and distance from it [m] of ends ``[p, N, 3]``, each of Shape ``[p, N]``."""
        edge = self.surfaces.edge[paths]
        axis = edge[:, 1] - edge[:, 0]
        length = np.sqrt((axis**2).sum(-1))
        axis = axis / np.where(length > 0, length, 1.0)[:, None]
        away = ends - edge[:, :1]
        along = (away * axis[:, None]).sum(-1)
        radius = np.sqrt(((away - along[..., None] * axis[:, None]) ** 2).sum(-1))
        return along, radius

    def _by_points(
        self, paths: Int64Array, sent: Float64Array, taken: Float64Array
    ) -> tuple[Float64Array, Float64Array]:
        points = self.surfaces.points[paths]
        rows = np.arange(len(paths))
        first, last = self.first[paths], self.last[paths]
        steps = np.sqrt((np.diff(points, axis=1) ** 2).sum(-1))
        place = np.arange(steps.shape[1])
        inner = (place >= first[:, None]) & (place < last[:, None])
        between = np.where(inner, steps, 0.0).sum(-1)
        out = np.sqrt(((sent - points[rows, first][:, None]) ** 2).sum(-1))[:, None]
        back = np.sqrt(((taken - points[rows, last][:, None]) ** 2).sum(-1))[:, :, None]
        spreading = 1 / (np.maximum(out, CLEARANCE) * np.maximum(back, CLEARANCE))
        return out + back + between[:, None, None], spreading

    def corners(self, paths: Int64Array, start: Float64Array, end: Float64Array) -> Float64Array:
        """Interaction points of paths between single elements.

        Args:
            paths: Which paths, Shape ``[Q]``.
            start: Position of the transmitting element of each [m], Shape ``[Q, 3]``; ``end`` of the
                receiving one.
            end: See ``start``.

        Returns:
            Points [m], Shape ``[Q, D, 3]``; not finite where a path has none (a plane seen edge-on).
        """
        surfaces = self.surfaces
        types, plane = surfaces.types[paths], (surfaces.origin[paths], surfaces.normal[paths])
        found = image_points(start, end, np.where(self.bend[paths, None] == Bend.NONE, types, 0), *plane)
        bent = np.flatnonzero(self.bend[paths] != Bend.NONE)
        if len(bent):
            found[bent] = self._bent_corners(paths[bent], start[bent], end[bent])
        return found

    def _bent_corners(self, paths: Int64Array, start: Float64Array, end: Float64Array) -> Float64Array:
        surfaces = self.surfaces
        types, plane = surfaces.types[paths], (surfaces.origin[paths], surfaces.normal[paths])
        rows, place = np.arange(len(paths)), np.arange(types.shape[1])
        points = surfaces.points[paths]
        over = np.flatnonzero(self.bend[paths] == Bend.EDGE)
        if len(over):
            points[over, self.first[paths[over]]] = self._edge_points(paths[over], start[over], end[over])
        first, last = self.first[paths], self.last[paths]
        before, behind = place < first[:, None], place > last[:, None]
        sent = image_points(start, points[rows, first], np.where(before, types, 0), *plane)
        taken = image_points(points[rows, last], end, np.where(behind, types, 0), *plane)
        return np.where(before[..., None], sent, np.where(behind[..., None], taken, points))

    def _edge_points(self, paths: Int64Array, start: Float64Array, end: Float64Array) -> Float64Array:
        sent = _mapped(self._sent, paths, start[:, None])
        taken = _mapped(self._taken, paths, end[:, None])
        (z, rho), (height, radius) = (self._around_edge(paths, ends) for ends in (sent, taken))
        apart = rho + radius
        along = ((z * radius + height * rho) / np.where(apart > 0, apart, 1.0))[:, 0]
        edge = self.surfaces.edge[paths]
        axis = edge[:, 1] - edge[:, 0]
        length = np.sqrt((axis**2).sum(-1))
        point: Float64Array = edge[:, 0] + axis * (along / np.where(length > 0, length, 1.0))[:, None]
        return point


def _mapped(
    affine: tuple[Float64Array, Float64Array], rows: slice | Int64Array, points: Float64Array
) -> Float64Array:
    linear, offset = affine[0][rows], affine[1][rows]
    mapped: Float64Array = points @ linear.transpose(0, 2, 1) + offset[:, None]
    return mapped


def _unmapped(affine: tuple[Float64Array, Float64Array], points: Float64Array) -> Float64Array:
    """Points before the maps; these are reflections, so that the transpose of each is its inverse."""
    back: Float64Array = np.einsum("pij,pi->pj", affine[0], points - affine[1])
    return back


def _one_over(length: Float64Array) -> Float64Array:
    """0 for no length."""
    return np.divide(1.0, length, out=np.zeros_like(length), where=length > 0)


def _distances(receive: Float64Array, transmit: Float64Array) -> Float64Array:
    """Shape ``[p, M, N]``."""
    # Axis by axis and in place: an array of differences of three axes would leave the cache.
    square = np.zeros((len(receive), receive.shape[1], transmit.shape[1]))
    for axis in range(3):
        apart = receive[:, :, None, axis] - transmit[:, None, :, axis]
        apart *= apart
        square += apart
    return np.sqrt(square, out=square)
