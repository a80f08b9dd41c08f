"""Rung ``mimo-rt``: every antenna pair traced.

Each transmitting element is a source, each receiving element a target of the same tracer that finds the
paths between the arrays' centres. So every pair has reflection coefficients, element patterns and visibility
of its own: the reference for the rungs below, at the price of one trace for each transmitting element.

Sionna RT moves images by up to a millimetre before it asks whether a face is met, so at the edge of a face
its answer is that of a neighbouring element. Paths of reflections alone are asked for once more, without.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np

from caviar_protocol.arrays import Complex64Array, Complex128Array, Float64Array, Int64Array
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Carrier, Interaction
from caviar_services.channel.arrays.channel_matrices import Bins, Located
from caviar_services.channel.arrays.element_paths import elements
from caviar_services.channel.paths import (
    Antenna,
    PathGeometry,
    PathTable,
    antenna_fields,
    path_ends,
    path_geometry,
    with_near_pairs,
)
from caviar_services.channel.propagation.atmosphere import amplitude_factor
from caviar_services.channel.propagation.attenuation import Attenuation
from caviar_services.channel.sionna.candidates import Corners
from caviar_services.channel.sionna.path_solver import Tracer
from caviar_services.channel.sionna.path_table import path_table
from caviar_services.channel.sionna.scene import SionnaScene


@dataclass(frozen=True, eq=False)
class ElementTracer:
    """Traces the paths between single antenna elements of a frame."""

    tracer: Tracer
    """Set up for the options of the scenario."""
    scene: SionnaScene
    """Of the frame."""
    velocity: Float64Array
    """Of each object of the scene [m/s], Shape ``[len(scene.names), 3]``."""
    wavelengths: Float64Array
    """Of the carriers [m]."""
    lanes: int
    """Candidates that are tested together at most."""
    los: bool
    """Whether straight paths count."""
    losses: Sequence[Attenuation] = ()
    """What paths lose in, of the frame: foliage, people."""

    def __call__(
        self,
        carriers: Sequence[Carrier],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> _TracedPairs:
        """Matrices that are traced when they are asked for; the arguments are those of `PlaneWaves`."""
        return _TracedPairs(self, carriers, transmitters, receivers, located)

    def elements(self, antennas: Sequence[Antenna], wavelength: float) -> list[_Element]:
        """All elements of antennas, in order; arrays are given in wavelengths [m]."""
        # A subarray has a pattern and axes of its own, so that each element stands for itself.
        parts = [part for antenna in antennas for part in antenna.subarrays]
        placed = elements(parts, wavelength)
        return [
            _Element(replace(part, position=at), replace(part, position=self.scene.surfaces.cleared(at)))
            for index, part in enumerate(parts)
            for at in placed.positions_of(index)
        ]

    def column(
        self,
        carrier: int,
        wavelength: float,
        source: _Element,
        targets: Sequence[_Element],
        absorption_db_per_km: Float64Array | None,
    ) -> _ElementPaths:
        """Paths from one transmitting element to M receiving ones.

        Args:
            carrier: Index of the carrier.
            wavelength: Its wavelength [m].
            source: The transmitting element.
            targets: Receiving elements; those of the source's device get no path.
            absorption_db_per_km: By the air on each carrier; None: no atmosphere.
        """
        others = np.flatnonzero([target.place.name != source.place.name for target in targets])
        ends = [targets[index] for index in others.tolist()]
        table = self._paths(source, ends)
        a, geometry = self._amplitudes(carrier, wavelength, table, source.place, [end.place for end in ends])
        target = others[table.pair]
        if absorption_db_per_km is not None:
            a = a * amplitude_factor(absorption_db_per_km[carrier : carrier + 1], geometry.tau)[0]
        # The tracer's order may change with threads, and a sum with its order.
        order = np.lexsort([a.imag, a.real, target])
        finite = order[np.isfinite(a[order])]
        doppler_hz = geometry.doppler_ratio[finite] * SPEED_OF_LIGHT / wavelength
        return _ElementPaths(len(targets), target[finite], a[finite], geometry.tau[finite], doppler_hz)

    def _paths(self, source: _Element, ends: Sequence[_Element]) -> PathTable:
        """Paths between one element and others, as between antennas of one element."""
        from_, to = source.traced.position, np.array([end.traced.position for end in ends]).reshape(-1, 3)
        corners = Corners(from_[None], to[:, None])
        traced = self.tracer.trace(from_, to, lanes=self.lanes, corners=corners)
        # Paths of reflections alone have been asked for once more, exactly: those that failed are dropped.
        mirrored = ((traced.types == 0) | (traced.types == Interaction.REFLECTION)).all(1)
        traced = traced.take(~mirrored | traced.hidden | traced.settled)
        # An array of one element has no corner beside its centre, so that no path is hidden from the centre
        # alone.
        traced = replace(traced, hidden=np.zeros(len(traced.hidden), np.bool_))
        names = self.scene.names
        places = [source.place], [end.place for end in ends]
        table = path_table(
            self.scene,
            [(traced.receiver, traced)],
            names,
            self.velocity,
            places,
            ([source.traced], [end.traced for end in ends]),
        )
        los = np.zeros(len(ends), np.bool_)
        table, _ = with_near_pairs(table, los, *places, self.wavelengths, self.scene.surfaces)
        for loss in self.losses:
            table = loss.attenuated(table, *path_ends(table.pair, *places))
        return table if self.los else table.take((table.types != 0).any(1))

    def _amplitudes(
        self, carrier: int, wavelength: float, table: PathTable, source: Antenna, targets: Sequence[Antenna]
    ) -> tuple[Complex128Array, PathGeometry]:
        """Amplitudes with the phase of lengths in float64, Shape ``[P]``, and the geometry of the paths."""
        ends = np.array([target.position for target in targets]).reshape(-1, 3)[table.pair]
        start = np.broadcast_to(source.position, ends.shape)
        with np.errstate(invalid="ignore"):  # what is not finite is left out
            geometry = path_geometry(
                start,
                table.points,
                ends,
                (table.types != 0).sum(1),
                np.broadcast_to(source.velocity, ends.shape),
                table.point_velocity,
                np.array([target.velocity for target in targets]).reshape(-1, 3)[table.pair],
            )
            sent = source.radiated(geometry.departure)
            parts = {(target.name, target.part): target for target in targets}
            number = {key: index for index, key in enumerate(parts)}
            which = np.array([number[target.name, target.part] for target in targets], np.int64)[table.pair]
            taken = antenna_fields(list(parts.values()), which, geometry.arrival, arrival=True)
            # The whole turns go first: they are millions, and only the rest is a phase.
            turns = geometry.tau * SPEED_OF_LIGHT / wavelength
            phase = np.exp(-2j * np.pi * (turns - np.round(turns)))
            a: Complex128Array = np.einsum("pi,pij,pj->p", taken, table.transfer[carrier], sent) * phase
        return a, geometry


class _TracedPairs:
    """The matrices of a frame: each transmitting element is traced once on each carrier."""

    def __init__(
        self,
        tracer: ElementTracer,
        carriers: Sequence[Carrier],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> None:
        self._tracer, self._carriers, self._transmitters = tracer, carriers, transmitters
        self._absorption = located.absorption_db_per_km
        self._receivers = receivers
        sizes = [antenna.array.size for antenna in receivers]
        # Receiving elements of each receiver, among those of all.
        self._rows = [slice(end - size, end) for end, size in zip(accumulate(sizes), sizes, strict=True)]
        # By carrier and transmitter: H and the wideband parts are made of the same traces, which cost most.
        self._columns: dict[tuple[int, int], list[_ElementPaths]] = {}

    def matrices(self, index: int) -> Iterator[Complex128Array]:
        for t in range(len(self._transmitters)):
            columns = self._traced(index, t)
            h = np.stack([column.summed() for column in columns], axis=1)
            yield from (h[rows] for rows in self._rows)

    def responses(self, asked: Bins) -> Iterator[Complex64Array]:
        for t in range(len(self._transmitters)):
            columns = self._traced(asked.index, t)
            for r, rows in enumerate(self._rows):
                pair = t * len(self._rows) + r
                of_elements = [
                    column.weighted(asked, pair, rows.start, rows.stop).astype(np.complex64)
                    for column in columns
                ]
                yield np.stack(of_elements, axis=-1)

    def _traced(self, carrier: int, t: int) -> list[_ElementPaths]:
        """Paths from each element of a transmitter to those of all receivers."""
        if (carrier, t) not in self._columns:
            wavelength = SPEED_OF_LIGHT / self._carriers[carrier].frequency_hz
            targets = self._tracer.elements(self._receivers, wavelength)
            self._columns[carrier, t] = [
                self._tracer.column(carrier, wavelength, source, targets, self._absorption)
                for source in self._tracer.elements([self._transmitters[t]], wavelength)
            ]
        return self._columns[carrier, t]


@dataclass(frozen=True, eq=False)
class _ElementPaths:
    """Paths from one transmitting element, sorted by the receiving one, Shape ``[P]`` each."""

    targets: int
    """Receiving elements M, of all receivers."""
    target: Int64Array
    a: Complex128Array
    tau: Float64Array
    """[s]."""
    doppler: Float64Array
    """[Hz]."""

    def summed(self) -> Complex128Array:
        """Sum of amplitudes at each receiving element, Shape ``[M]``."""
        column = np.zeros(self.targets, np.complex128)
        np.add.at(column, self.target, self.a)
        return column

    def weighted(self, asked: Bins, pair: int, begin: int, end: int) -> Complex128Array:
        """Responses in `Bins` at the receiving elements ``begin`` to ``end``, Shape ``[J, end − begin]``."""
        mine = slice(*np.searchsorted(self.target, [begin, end]).tolist())
        weights = asked.weights(pair, self.tau[mine], self.doppler[mine]) * self.a[mine]
        response = np.zeros((len(weights), end - begin), np.complex128)
        elements, first = np.unique(self.target[mine], return_index=True)
        if len(elements):
            response[:, elements - begin] = np.add.reduceat(weights, first, axis=1)
        return response


@dataclass(frozen=True, eq=False)
class _Element:
    """One element, as an antenna of its own."""

    place: Antenna
    """Where it stands."""
    traced: Antenna
    """Where it is traced from: off the surface that it is at."""
