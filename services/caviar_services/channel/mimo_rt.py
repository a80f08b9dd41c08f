"""Rung ``mimo-rt``: every antenna pair traced.

Each transmitting element is a source, each receiving element a target of the same tracer that finds the
paths between the arrays' centres. So every pair has reflection coefficients, element patterns and visibility
of its own: the reference for the rungs below, at the price of one trace for each transmitting element.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, Int64Array
from caviar_protocol.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Carrier, ChannelMatrix
from caviar_services.channel.assemble import Antenna, Located
from caviar_services.channel.geometry import path_geometry
from caviar_services.channel.patterns import radiated_field
from caviar_services.channel.sionna_scene import SionnaScene
from caviar_services.channel.sionna_tracer import Traced, Tracer
from caviar_services.channel.specular import refined_points
from caviar_services.channel.spherical import elements
from caviar_services.channel.visibility import Elements

LANE_BYTES = 40
"""Memory of the solver for each ray, interaction and target."""


def targets_at_once(memory_gib: float, samples: int, max_depth: int, elements_in_all: int) -> int:
    """Receiving elements of one launch that stays within a memory bound: at least one."""
    most = int(memory_gib * 2**30 / (LANE_BYTES * samples * max(max_depth, 1)))
    return max(1, min(most, elements_in_all))


class ElementTracer:
    """Makes the matrices of a frame, by traces between elements.

    Parameters
    ----------
    tracer
        Set up for the options of the scenario.
    scene
        Of the frame.
    at_once
        Receiving elements of one launch; fewer are filled up with parked ones.
    los
        Whether straight paths count.
    """

    def __init__(self, tracer: Tracer, scene: SionnaScene, at_once: int, los: bool) -> None:
        self._tracer = tracer
        self._scene = scene
        self._at_once = at_once
        self._los = los

    def __call__(
        self,
        carriers: Sequence[Carrier],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> tuple[ChannelMatrix, ...]:
        made: list[ChannelMatrix] = []
        for carrier, properties in enumerate(carriers):
            wavelength = SPEED_OF_LIGHT / properties.frequency_hz
            receive = elements(receivers, wavelength)
            owner = np.repeat(np.arange(len(receivers)), [antenna.array.size for antenna in receivers])
            for t, transmitter in enumerate(transmitters):
                columns = [
                    self._column(carrier, wavelength, transmitter, source, receivers, receive, owner)
                    for source in elements([transmitter], wavelength).positions
                ]
                h = np.stack(columns, axis=1)
                ends = np.cumsum([antenna.array.size for antenna in receivers])
                made += [
                    ChannelMatrix(carrier=carrier, tx=t, rx=r, h=h[receive.first[r] : end])
                    for r, end in enumerate(ends.tolist())
                ]
        return tuple(made)

    def _column(
        self,
        carrier: int,
        wavelength: float,
        transmitter: Antenna,
        source: Float64Array,
        receivers: Sequence[Antenna],
        receive: Elements,
        owner: Int64Array,
    ) -> Complex128Array:
        """H of one transmitting element and all receiving ones, Shape ``[elements of all receivers]``."""
        itself = np.array([receiver.name == transmitter.name for receiver in receivers], bool)
        column = np.zeros(len(owner), np.complex128)
        for begin, traced in self._launches(source, receive.positions):
            target = begin + traced.receiver
            wanted = ~itself[owner[target]]
            if not self._los:
                wanted &= (traced.types != 0).any(1)
            traced, target = traced.take(wanted), target[wanted]
            a = self._amplitudes(
                carrier,
                wavelength,
                traced,
                transmitter,
                source,
                receivers,
                owner[target],
                receive.positions[target],
            )
            # The tracer's order may change with threads, and a sum with its order.
            order = np.lexsort([a.imag, a.real, target])
            finite = order[np.isfinite(a[order])]
            np.add.at(column, target[finite], a[finite])
        return column

    def _launches(self, source: Float64Array, targets: Float64Array) -> Iterator[tuple[int, Traced]]:
        for begin in range(0, len(targets), self._at_once):
            chosen = targets[begin : begin + self._at_once]
            padded = np.tile(self._scene.parking, (self._at_once, 1))
            padded[: len(chosen)] = chosen
            traced = self._tracer.trace(source, padded)
            yield begin, traced.take(traced.receiver < len(chosen))

    def _amplitudes(
        self,
        carrier: int,
        wavelength: float,
        traced: Traced,
        transmitter: Antenna,
        source: Float64Array,
        receivers: Sequence[Antenna],
        receiver: Int64Array,
        ends: Float64Array,
    ) -> Complex128Array:
        """Shape ``[P]``, with the phase of lengths in float64."""
        start = np.broadcast_to(source, ends.shape)
        planes = self._scene.planes(traced.shapes, traced.primitives)
        points = refined_points(start, traced.points, ends, traced.types, planes)
        still = np.zeros_like(ends)
        geometry = path_geometry(
            start, points, ends, (traced.types != 0).sum(1), still, np.zeros_like(points), still
        )
        sent = radiated_field(transmitter.array, transmitter.rotation, geometry.departure)
        taken = np.zeros_like(ends)
        for r in np.unique(receiver).tolist():
            mine = receiver == r
            taken[mine] = radiated_field(receivers[r].array, receivers[r].rotation, geometry.arrival[mine])
        turns = geometry.tau * SPEED_OF_LIGHT / wavelength
        phase = np.exp(-2j * np.pi * (turns - np.round(turns)))
        a: Complex128Array = np.einsum("pi,pij,pj->p", taken, traced.transfer[carrier], sent) * phase
        return a
