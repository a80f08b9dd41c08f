"""Rung ``mimo-rt``: every antenna pair traced.

Each transmitting element is a source, each receiving element a target of the same tracer that finds the
paths between the arrays' centres. So every pair has reflection coefficients, element patterns and visibility
of its own: the reference for the rungs below, at the price of one trace for each transmitting element.

Sionna RT moves images by up to a millimetre before it asks whether a face is met, so at the edge of a face
its answer is that of a neighbouring element. Paths of reflections alone are asked for once more, without.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, Int64Array
from caviar_protocol.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Carrier, ChannelMatrix, Interaction
from caviar_services.channel.assemble import Antenna, Located
from caviar_services.channel.atmosphere import amplitude_factor
from caviar_services.channel.geometry import path_geometry
from caviar_services.channel.patterns import radiated_field
from caviar_services.channel.sionna_reach import Corners
from caviar_services.channel.sionna_scene import SionnaScene
from caviar_services.channel.sionna_tracer import Traced, Tracer
from caviar_services.channel.specular import refined_points
from caviar_services.channel.visibility import Elements, elements


class ElementTracer:
    """Makes the matrices of a frame, by traces between elements.

    Parameters
    ----------
    tracer
        Set up for the options of the scenario.
    scene
        Of the frame.
    lanes
        Candidates looked at together at most.
    los
        Whether straight paths count.
    """

    def __init__(self, tracer: Tracer, scene: SionnaScene, lanes: int, los: bool) -> None:
        self._tracer = tracer
        self._scene = scene
        self._lanes = lanes
        self._los = los
        self.counts: list[Int64Array] = []
        """Paths between elements in this frame, of each carrier and transmitter: Shape ``[M, N]``, M elements
        of all receivers."""

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
                    self._column(carrier, wavelength, transmitter, source, receivers, receive, owner, located)
                    for source in elements([transmitter], wavelength).positions
                ]
                h = np.stack([column for column, _ in columns], axis=1)
                self.counts.append(np.stack([count for _, count in columns], axis=1))
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
        located: Located,
    ) -> tuple[Complex128Array, Int64Array]:
        """H of one transmitting element and M receiving ones, Shape ``[M]``, and how many paths each has."""
        itself = np.array([receiver.name == transmitter.name for receiver in receivers], bool)
        column = np.zeros(len(owner), np.complex128)
        others = np.flatnonzero(~itself[owner])
        targets = receive.positions[others]
        corners = Corners(source[None], targets[:, None])
        traced = self._tracer.trace(source, targets, lanes=self._lanes, corners=corners)
        mirrored = ((traced.types == 0) | (traced.types == Interaction.REFLECTION)).all(1)
        traced = traced.take(~mirrored | traced.hidden | traced.settled)
        if not self._los:
            traced = traced.take((traced.types != 0).any(1))
        target = others[traced.receiver]
        ends = receive.positions[target]
        a, tau = self._amplitudes(
            carrier, wavelength, traced, transmitter, source, receivers, owner[target], ends
        )
        if located.absorption_db_per_km is not None:
            per_km = located.absorption_db_per_km[carrier : carrier + 1]
            a = a * amplitude_factor(per_km, tau)[0]
        # The tracer's order may change with threads, and a sum with its order.
        order = np.lexsort([a.imag, a.real, target])
        finite = order[np.isfinite(a[order])]
        np.add.at(column, target[finite], a[finite])
        return column, np.bincount(target[finite], minlength=len(owner))

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
    ) -> tuple[Complex128Array, Float64Array]:
        """With the phase of lengths in float64, and the delays [s], Shape ``[P]`` each."""
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
        return a, geometry.tau
