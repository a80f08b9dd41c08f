"""Paths that the ray tracer found, as it holds them, and how they are read from its buffer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from caviar_protocol.arrays import (
    BoolArray,
    Complex128Array,
    Float64Array,
    Int64Array,
    UInt8Array,
)
from caviar_protocol.topics import Interaction
from caviar_services.channel.propagation.patterns import spherical_basis

_POLE = 1.2e-5
"""Below this horizontal part of a direction Sionna RT sets its azimuth to 0 (100 float32 epsilons)."""

_TYPES = np.zeros(17, np.uint8)
_TYPES[[1, 2, 4, 8]] = (
    Interaction.REFLECTION,
    Interaction.SCATTERING,
    Interaction.TRANSMISSION,
    Interaction.DIFFRACTION,
)
"""Interaction of each flag of `sionna.rt.constants.InteractionType`."""


@dataclass(frozen=True, eq=False)
class Traced:
    """P paths from one transmitter, of at most D interactions."""

    receiver: Int64Array
    """Index of the receiver, Shape ``[P]``."""
    transfer: Complex128Array
    """Dyad from the field sent to the field received, world axes, without carrier phase; Shape
    ``[C, P, 3, 3]`` with C carriers."""
    types: UInt8Array
    """`Interaction` of each point, Shape ``[P, D]``."""
    shapes: Int64Array
    """Process-local id of the shape at each point, Shape ``[P, D]``."""
    primitives: Int64Array
    """Triangle of that shape, Shape ``[P, D]``."""
    points: Float64Array
    """Interaction points [m], Shape ``[P, D, 3]``."""
    edge: Int64Array
    """Number of the edge that diffracts each path, −1 for none, Shape ``[P]``; of an edge, ``shapes`` and
    ``primitives`` say its first face."""
    hidden: BoolArray
    """Paths that only other elements than the centres of the arrays have, Shape ``[P]``."""
    settled: BoolArray
    """Paths that all corners of both arrays are known to have, Shape ``[P]``."""
    lost: int
    """How many more candidates were found than ``max_paths`` of each receiver."""

    def take(self, which: BoolArray) -> Traced:
        """These paths."""
        return Traced(
            receiver=self.receiver[which],
            transfer=self.transfer[:, which],
            types=self.types[which],
            shapes=self.shapes[which],
            primitives=self.primitives[which],
            points=self.points[which],
            edge=self.edge[which],
            hidden=self.hidden[which],
            settled=self.settled[which],
            lost=self.lost,
        )

    def seen_from(self, first: int) -> Traced:
        """The same with receivers counted from this one on."""
        return replace(self, receiver=self.receiver + first)


def nothing(carriers: int, depth: int, lost: int) -> Traced:
    """No paths."""
    return Traced(
        receiver=np.zeros(0, np.int64),
        transfer=np.zeros((carriers, 0, 3, 3), np.complex128),
        types=np.zeros((0, depth), np.uint8),
        shapes=np.zeros((0, depth), np.int64),
        primitives=np.zeros((0, depth), np.int64),
        points=np.zeros((0, depth, 3)),
        edge=np.zeros(0, np.int64),
        hidden=np.zeros(0, np.bool_),
        settled=np.zeros(0, np.bool_),
        lost=lost,
    )


def joined(parts: Sequence[Traced], carriers: int, depth: int) -> Traced:
    """All of these paths, part by part."""
    if len(parts) == 1:
        return parts[0]
    parts = [nothing(carriers, depth, 0), *parts]
    return Traced(
        receiver=np.concatenate([part.receiver for part in parts]),
        transfer=np.concatenate([part.transfer for part in parts], axis=1),
        types=np.concatenate([part.types for part in parts]),
        shapes=np.concatenate([part.shapes for part in parts]),
        primitives=np.concatenate([part.primitives for part in parts]),
        points=np.concatenate([part.points for part in parts]),
        edge=np.concatenate([part.edge for part in parts]),
        hidden=np.concatenate([part.hidden for part in parts]),
        settled=np.concatenate([part.settled for part in parts]),
        lost=sum(part.lost for part in parts),
    )


def geometry(buffer: Any) -> tuple[UInt8Array, Int64Array, Int64Array, Float64Array]:
    """Types, shapes, triangles and points that a buffer holds, each of Shape ``[P, D]`` or ``[P, D, 3]``."""
    import drjit as dr

    depth = buffer.max_depth
    vertices = (buffer.vertices_x, buffer.vertices_y, buffer.vertices_z)
    dr.eval(vertices, buffer.interaction_types, buffer.shapes, buffer.primitives)
    return (
        _TYPES[buffer.interaction_types.numpy()[:, :depth]],
        buffer.shapes.numpy()[:, :depth].astype(np.int64),
        buffer.primitives.numpy()[:, :depth].astype(np.int64),
        np.stack([v.numpy()[:, :depth] for v in vertices], axis=-1).astype(np.float64),
    )


def read(
    buffer: Any,
    carriers: int,
    transmitter: Float64Array,
    receivers: Float64Array,
    lost: int,
) -> Traced:
    """The paths of a solver's buffer, from a transmitter [3] to receivers [R, 3], positions in metres."""
    import drjit as dr

    dr.eval(buffer.a, buffer.valid)
    receiver = buffer.target_indices.numpy().astype(np.int64)
    types, shapes, primitives, points = geometry(buffer)
    jones = np.empty((carriers, len(receiver), 2, 2), np.complex128)
    for carrier, taken, sent in np.ndindex(carriers, 2, 2):
        amplitude = buffer.a[2 * carrier + taken][sent]
        jones[carrier, :, taken, sent] = dr.real(amplitude).numpy()
        jones[carrier, :, taken, sent] += 1j * dr.imag(amplitude).numpy()
    return Traced(
        receiver=receiver,
        transfer=_dyad(jones, transmitter, receivers[receiver], points, types),
        types=types,
        shapes=shapes,
        primitives=primitives,
        points=points,
        edge=edge_numbers(buffer, types),
        hidden=np.zeros(len(receiver), np.bool_),
        settled=np.zeros(len(receiver), np.bool_),
        lost=lost,
    )


def edge_numbers(buffer: Any, types: UInt8Array) -> Int64Array:
    """Number of the edge in each path that is diffracted, −1 in others, Shape ``[P]``."""
    wedges = buffer.diffracting_wedges
    if wedges is None:
        return np.full(len(types), -1)
    number = wedges.local_edge.numpy().astype(np.int64)
    return np.where((types == Interaction.DIFFRACTION).any(1), number, -1)


def _dyad(
    jones: Complex128Array,
    transmitter: Float64Array,
    receivers: Float64Array,
    points: Float64Array,
    types: UInt8Array,
) -> Complex128Array:
    """World-axes dyads, Shape ``[C, P, 3, 3]``, of Jones matrices between spherical bases.

    The bases are those of the directions that the solver saw, which are of float32 positions.
    """
    count = (types != 0).sum(1)
    rows = np.arange(len(count))
    start = np.broadcast_to(transmitter.astype(np.float32).astype(np.float64), receivers.shape)
    end = receivers.astype(np.float32).astype(np.float64)
    padded = np.concatenate([points, end[:, None]], axis=1) if points.shape[1] else end[:, None]
    direct = count == 0
    first = np.where(direct[:, None], end, padded[:, 0])
    last = np.where(direct[:, None], start, padded[rows, np.maximum(count - 1, 0)])
    sent = np.stack(spherical_basis(_unit(first - start), _POLE), axis=-2)
    taken = np.stack(spherical_basis(_unit(last - end), _POLE), axis=-2)
    return np.stack([np.einsum("pix,pij,pjy->pxy", taken, of_carrier, sent) for of_carrier in jones])


def _unit(vectors: Float64Array) -> Float64Array:
    length = np.sqrt((vectors**2).sum(-1, keepdims=True))
    unit: Float64Array = vectors / np.where(length > 0, length, 1.0)
    return unit
