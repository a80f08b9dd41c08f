"""Rung ``spherical``: the paths of ``siso-rt``, with the exact length of each between any two elements.

H[m, n] = Σ_p a_p · (s_p[m, n] / s_p) · exp(−j2πf(d_p[m, n] − d_p)/c), over the paths that elements m and n
have, with the length d and the spreading s between the elements (s = 1/d but for diffraction and scattering,
see `element_paths`) and d_p, s_p those between the arrays' centres, which a_p belongs to.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from caviar_protocol.arrays import Complex64Array, Complex128Array, Float64Array, Int64Array
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Carrier, ChannelMatrix
from caviar_services.channel.arrays.channel_matrices import Blocks, Located, joined
from caviar_services.channel.arrays.element_gains import ElementGains
from caviar_services.channel.arrays.element_paths import Bend, ElementPaths, Lengths, Surfaces
from caviar_services.channel.arrays.element_visibility import Elements, Look, Visibility, elements, visibility
from caviar_services.channel.paths import Antenna
from caviar_services.channel.wideband import Bins

_BINS = 1 << 20
"""Subcarriers or taps times element pairs that are computed at once."""

_LANES = 1 << 15
"""Element pairs times paths computed at once: what stays in a processor's cache."""


class SphericalWaves:
    """Makes the matrices of a frame.

    Coefficients of reflection, transmission, diffraction and scattering are those of the path between the
    arrays' centres, as in ``siso-rt``. Pattern and polarisation are each element's own, to first order in the
    size of the arrays (`element_gains`). Subarrays, of one panel and one polarisation, are looked at one by
    one.

    Parameters
    ----------
    surfaces
        What the paths meet, in the order of the model's table.
    look
        Asks this frame's scene.
    traced_from
        Transmitters and receivers off the surfaces that they are at: there their elements look.
    carriers
        Of the product.
    memory
        For looking at pairs of elements [bytes] at most; what is kept of each path comes on top.
    """

    def __init__(
        self,
        surfaces: Surfaces,
        look: Look,
        traced_from: tuple[Sequence[Antenna], Sequence[Antenna]],
        carriers: Sequence[Carrier],
        memory: int,
    ) -> None:
        self._carriers = carriers
        self._made: list[_Field] = []
        self._split: _Split
        self._memory = memory
        self._surfaces = surfaces
        self._look = look
        self._sources, self._targets = traced_from

    def __call__(
        self,
        carriers: Sequence[Carrier],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> tuple[ChannelMatrix, ...]:
        fields = self._fields(carriers, transmitters, receivers, located)
        split = self._split
        return tuple(
            ChannelMatrix(carrier=carrier, tx=pair // len(receivers), rx=pair % len(receivers), h=h)
            for carrier, field in enumerate(fields)
            for pair, h in enumerate(split.joined(list(field.matrices(split.offsets))))
        )

    def responses(
        self,
        bins: Sequence[Bins],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> Iterator[Complex64Array]:
        fields = self._fields(self._carriers, transmitters, receivers, located)
        split = self._split
        for asked in bins:
            doppler = located.geometry.doppler_ratio[split.path] * asked.carrier.frequency_hz
            yield from split.joined(list(fields[asked.index].responses(split, asked, doppler)))

    def _fields(
        self,
        carriers: Sequence[Carrier],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> Sequence[_Field]:
        """The field of each carrier, made once: the parts of a product share it."""
        if self._made:
            return self._made
        split = self._split = _Split.of(transmitters, receivers, located.pair)
        paths = ElementPaths(self._surfaces.take(located.row[split.path]))
        tx, rx = np.divmod(located.pair[split.path], max(len(receivers), 1))
        start, end = _positions(transmitters)[tx], _positions(receivers)[rx]
        # Amplitudes of paths that bend are as traced, those of others of their true length.
        traced = _positions(self._sources)[tx, None], _positions(self._targets)[rx, None]
        of_bent = paths.lengths(slice(0, len(tx)), *traced).spreading[:, 0, 0]
        bent = paths.bend != Bend.NONE
        without_spreading = np.where(
            bent, 1 / np.where(bent, of_bent, 1.0), SPEED_OF_LIGHT * located.geometry.tau[split.path]
        )
        towards = paths.ends(start, end)
        ends = split.transmitter, split.receiver
        for carrier, properties in enumerate(carriers):
            wavelength = SPEED_OF_LIGHT / properties.frequency_hz
            transmit, receive = elements(split.transmit, wavelength), elements(split.receive, wavelength)
            looking = elements(_parts(self._sources), wavelength), elements(_parts(self._targets), wavelength)
            seen = visibility(paths, *ends, *looking, self._look, self._memory)
            self._made.append(
                _Field(
                    paths=paths,
                    seen=_far_enough(seen, paths, ends, (transmit, receive), wavelength),
                    transmit=transmit,
                    receive=receive,
                    transmitter=split.transmitter,
                    receiver=split.receiver,
                    gains=ElementGains(
                        (split.transmit, split.receive),
                        ends,
                        towards,
                        located.transfer[carrier][split.path] * without_spreading[:, None, None],
                        wavelength,
                    ),
                    wavelength=wavelength,
                )
            )
        return self._made


@dataclass(frozen=True, eq=False)
class _Split:
    """Paths between devices as paths between their subarrays, which are uniform arrays."""

    transmit: list[Antenna]
    """Subarrays of all transmitters, in order; ``receive`` likewise."""
    receive: list[Antenna]
    of_transmitter: list[range]
    """Subarrays of each transmitter; ``of_receiver`` likewise."""
    of_receiver: list[range]
    path: Int64Array
    """Which path between devices each is, Shape ``[Q]``, sorted by pair of subarrays."""
    transmitter: Int64Array
    """Subarray that each starts at, Shape ``[Q]``."""
    receiver: Int64Array
    offsets: Int64Array
    """As in `Located`, by pair of subarrays."""

    @classmethod
    def of(cls, transmitters: Sequence[Antenna], receivers: Sequence[Antenna], pair: Int64Array) -> _Split:
        of_transmitter, of_receiver = _ranges(transmitters), _ranges(receivers)
        bounds = np.searchsorted(pair, np.arange(len(transmitters) * len(receivers) + 1))
        found, sizes, sent, taken = [np.zeros(0, np.int64)], [0], list[int](), list[int]()
        for t, sending in enumerate(of_transmitter):
            for s in sending:
                for r, receiving in enumerate(of_receiver):
                    between = t * len(receivers) + r
                    mine = np.arange(bounds[between], bounds[between + 1])
                    found += [mine] * len(receiving)
                    sizes += [len(mine)] * len(receiving)
                    sent += [s] * len(receiving)
                    taken += receiving
        return cls(
            transmit=_parts(transmitters),
            receive=_parts(receivers),
            of_transmitter=of_transmitter,
            of_receiver=of_receiver,
            path=np.concatenate(found),
            transmitter=np.repeat(np.array(sent, np.int64), sizes[1:]),
            receiver=np.repeat(np.array(taken, np.int64), sizes[1:]),
            offsets=np.cumsum(sizes),
        )

    @property
    def pair(self) -> list[int]:
        """Pair of devices that each pair of subarrays is of."""
        of_t, of_r = (_owners(ranges) for ranges in (self.of_transmitter, self.of_receiver))
        return [t * len(self.of_receiver) + r for t in of_t for r in of_r]

    def joined(self, blocks: list[Blocks]) -> Iterator[Blocks]:
        """Of each pair of devices, from what is of each pair of subarrays, Shape ``[..., M, N]``."""
        for sent in self.of_transmitter:
            for taken in self.of_receiver:
                yield joined([[blocks[s * len(self.receive) + r] for s in sent] for r in taken])


def _owners(ranges: Sequence[range]) -> list[int]:
    return [number for number, parts in enumerate(ranges) for _ in parts]


def _parts(antennas: Sequence[Antenna]) -> list[Antenna]:
    return [part for antenna in antennas for part in antenna.subarrays]


def _ranges(antennas: Sequence[Antenna]) -> list[range]:
    ends = np.cumsum([0, *(len(antenna.subarrays) for antenna in antennas)]).tolist()
    return [range(begin, end) for begin, end in pairwise(ends)]


@dataclass(frozen=True, eq=False)
class _Field:
    """All paths of a frame on one carrier, between elements."""

    paths: ElementPaths
    seen: Visibility
    transmit: Elements
    receive: Elements
    transmitter: Int64Array
    """Antenna that each path starts at, Shape ``[P]``."""
    receiver: Int64Array
    gains: ElementGains
    wavelength: float

    def matrices(self, offsets: Int64Array) -> Iterator[Complex128Array]:
        """H of each pair of antennas, in order."""
        for pairs, sizes in _groups(offsets, self.transmit, self.receive):
            begin, end = int(offsets[pairs.start]), int(offsets[pairs.stop])
            at_once = max(1, _LANES // (sizes[0] * sizes[1]))
            if pairs.stop - pairs.start == 1:
                h = np.zeros(sizes, np.complex128)
                for row in range(begin, end, at_once):
                    h += self._waves(slice(row, min(row + at_once, end)), sizes).sum(0)
                yield h
            else:
                waves = self._waves(slice(begin, end), sizes)
                for first, last in pairwise((offsets[pairs.start : pairs.stop + 1] - begin).tolist()):
                    yield waves[first:last].sum(0)

    def responses(self, split: _Split, asked: Bins, doppler: Float64Array) -> Iterator[Complex64Array]:
        """What is asked, of each pair of subarrays in order, Shape ``[J, M, N]``."""
        arrays = [(rx.size, tx.size) for tx in self.transmit.arrays for rx in self.receive.arrays]
        ends = pairwise(split.offsets.tolist())
        for pair, sizes, (begin, end) in zip(split.pair, arrays, ends, strict=True):
            response = np.zeros((asked.count, *sizes), np.complex64)
            at_once = max(1, _BINS // (asked.count * sizes[1]))
            for row in range(begin, end):
                wave = self._waves(slice(row, row + 1), sizes)[0]
                tau = self._between(slice(row, row + 1), sizes).length[0] / SPEED_OF_LIGHT
                for first in range(0, sizes[0], at_once):
                    m = slice(first, first + at_once)
                    weights = asked.weights(pair, tau[m], doppler[row])
                    response[:, m] += weights * wave[m]
            yield response

    def _between(self, rows: slice, sizes: tuple[int, int]) -> Lengths:
        """Lengths and spreading of some paths between all elements, Shape ``[p, M, N]``."""
        tx, rx = self.transmitter[rows], self.receiver[rows]
        transmit = self.transmit.first[tx, None] + np.arange(sizes[1])
        receive = self.receive.first[rx, None] + np.arange(sizes[0])
        return self.paths.lengths(rows, self.transmit.positions[transmit], self.receive.positions[receive])

    def _waves(self, rows: slice, sizes: tuple[int, int]) -> Complex128Array:
        """What each of some paths adds to H, Shape ``[p, M, N]``."""
        tx, rx = self.transmitter[rows], self.receiver[rows]
        between = self._between(rows, sizes)
        turns = between.length
        turns *= -1 / self.wavelength
        turns -= np.round(turns)
        turns *= 2 * np.pi
        waves = np.empty(turns.shape, np.complex128)
        np.cos(turns, out=waves.real)
        np.sin(turns, out=waves.imag)
        if len(tx):
            arrays = self.transmit.arrays[tx[0]], self.receive.arrays[rx[0]]
            sent, taken = self.gains.of(rows, *arrays)
            waves *= taken[:, :, None] + sent[:, None]
        waves *= between.spreading
        for path in np.flatnonzero(~self.seen.every[rows]).tolist():
            waves[path] *= self.seen.some.get(rows.start + path, False)
        return waves


def _far_enough(
    seen: Visibility,
    paths: ElementPaths,
    antennas: tuple[Int64Array, Int64Array],
    ends: tuple[Elements, Elements],
    wavelength: float,
) -> Visibility:
    """Without direct paths of elements closer than one wavelength, which antennas have none of either."""
    every, some = seen.every.copy(), dict(seen.some)
    transmit, receive = ends
    for path in np.flatnonzero((paths.surfaces.types == 0).all(1)).tolist():
        sent, taken = transmit.of(antennas[0][path]), receive.of(antennas[1][path])
        low = np.maximum(sent.min(0), taken.min(0))
        high = np.minimum(sent.max(0), taken.max(0))
        if (low - high).max() >= wavelength:
            continue
        far = np.sqrt(((taken[:, None] - sent) ** 2).sum(-1)) >= wavelength
        some[path] = far if every[path] else far & some.get(path, False)
        every[path] = False
    return Visibility(every, some)


def _positions(antennas: Sequence[Antenna]) -> Float64Array:
    return np.array([antenna.position for antenna in antennas]).reshape(-1, 3)


def _groups(
    offsets: Int64Array, transmit: Elements, receive: Elements
) -> Iterator[tuple[range, tuple[int, int]]]:
    """Consecutive pairs of the same arrays, as many as are computed at once, and these sizes."""
    arrays = [(rx, tx) for tx in transmit.arrays for rx in receive.arrays]
    begin = 0
    while begin < len(arrays):
        sizes = (arrays[begin][0].size, arrays[begin][1].size)
        most = offsets[begin] + _LANES // (sizes[0] * sizes[1])
        end = begin + 1
        while end < len(arrays) and offsets[end + 1] <= most and arrays[end] == arrays[begin]:
            end += 1
        yield range(begin, end), sizes
        begin = end
