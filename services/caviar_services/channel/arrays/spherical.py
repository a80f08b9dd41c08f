"""Rung ``spherical``: the paths of ``siso-rt``, with the exact length of each between any two elements.

H[m, n] = Σ_p a_p · (s_p[m, n] / s_p) · exp(−j2πf(d_p[m, n] − d_p)/c), over the paths that elements m and n
have, with the length d and the spreading s between the elements (s = 1/d but for diffraction and scattering,
see `element_paths`) and d_p, s_p those between the arrays' centres, which a_p belongs to.

Seen from the elements of an array, a path that is near starts, and arrives, in different directions, and a
pattern that slopes weights it differently. That gain is computed at three places along each side of an array,
with the other array's centre, and is a parabola between them: to first order in the size of the arrays over
the length of the path, the gains of both ends add up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np

from caviar_protocol.arrays import Complex64Array, Complex128Array, Float64Array, Int64Array
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import AntennaArray, Carrier
from caviar_services.channel.arrays.channel_matrices import Bins, Blocks, Located, joined
from caviar_services.channel.arrays.element_paths import (
    Bend,
    ElementPaths,
    Elements,
    Lengths,
    Look,
    Surfaces,
    Visibility,
    elements,
    visibility,
)
from caviar_services.channel.paths import Antenna, path_ends
from caviar_services.channel.propagation.patterns import (
    ElementPattern,
    Field,
    FormulaPattern,
    off_pole,
    polarized_field,
)


class ElementGains:
    """Amplitudes of P paths at single elements, without spreading and carrier phase.

    Args:
        antennas: Transmitters and receivers.
        which: Transmitter and receiver of each path, Shape ``[P]`` each.
        towards: Where straight lines along the path from both lead [m], Shape ``[P, 3]`` each.
        turn: `ElementPaths.image_turn`, Shape ``[P, 3, 3]``.
        transfer: That of `PathTable`, times what takes its spreading out, Shape ``[P, 3, 3]``.
        wavelength: [m].
    """

    def __init__(
        self,
        antennas: tuple[Sequence[Antenna], Sequence[Antenna]],
        which: tuple[Int64Array, Int64Array],
        towards: tuple[Float64Array, Float64Array],
        turn: Float64Array,
        transfer: Complex128Array,
        wavelength: float,
    ) -> None:
        self._parts: dict[tuple[AntennaArray, AntennaArray], tuple[Complex128Array, Complex128Array]] = {}
        # Paths between arrays of one kind are computed together; most scenes have few kinds.
        self._place = np.zeros(len(transfer), np.int64)
        for arrays in {(tx.array, rx.array) for tx in antennas[0] for rx in antennas[1]}:
            ends = [
                np.array([antenna.array == array for antenna in side], bool)
                for side, array in zip(antennas, arrays, strict=True)
            ]
            rows = np.flatnonzero(ends[0][which[0]] & ends[1][which[1]])
            self._place[rows] = np.arange(len(rows))
            tx, rx = (
                _End.of(array, side, index[rows], to[rows], wavelength, arrival)
                for array, side, index, to, arrival in zip(
                    arrays, antennas, which, towards, (False, True), strict=True
                )
            )
            # An element beside the centre departs elsewhere, and its image arrives elsewhere. Taken together,
            # as near a pole both fields turn, and their product does not.
            sent = _between(
                rx.field(tx.nodes @ turn[rows].transpose(0, 2, 1)), transfer[rows], tx.field(-tx.nodes)
            )
            taken = _between(rx.field(-rx.nodes), transfer[rows], tx.field(rx.nodes @ turn[rows]))
            # Gains of both ends add up to first order; the centre is in both parts and is taken off once.
            # Nodes are odd in number along each side, so the middle one is the array's centre.
            self._parts[arrays] = (sent, taken - taken[:, [taken.shape[1] // 2]])

    def amplitudes(
        self, rows: slice, transmit: AntennaArray, receive: AntennaArray
    ) -> tuple[Complex128Array, Complex128Array]:
        """Two parts whose sums are the amplitudes of paths between these arrays.

        Args:
            rows: Of the paths.
            transmit: Array of the transmitter, N elements.
            receive: Array of the receiver, M elements.

        Returns:
            Parts of Shapes ``[p, N]`` and ``[p, M]``: the amplitude between n and m is the sum of the n-th
            and the m-th.
        """
        place = self._place[rows]
        sent, taken = self._parts[transmit, receive]
        return sent[place] @ _nodes(transmit)[1].T, taken[place] @ _nodes(receive)[1].T


@dataclass(frozen=True, eq=False)
class _End:
    """One end of P paths, whose antennas have arrays of one kind."""

    array: AntennaArray
    pattern: ElementPattern
    rotation: Float64Array
    """Shape ``[P, 3, 3]``."""
    away: Float64Array
    """From the array's centre to where the path leads [m], Shape ``[P, 3]``."""
    nodes: Float64Array
    """From the centre to the nodes of the array, world axes [m], Shape ``[P, K, 3]``."""
    arrival: bool

    @classmethod
    def of(
        cls,
        array: AntennaArray,
        antennas: Sequence[Antenna],
        which: Int64Array,
        towards: Float64Array,
        wavelength: float,
        arrival: bool,
    ) -> _End:
        rotation = np.array([antenna.rotation for antenna in antennas])[which]
        centre = np.array([antenna.position for antenna in antennas])[which]
        # Antennas of one array have the same pattern, as an array names its file.
        pattern = next((antenna.pattern for antenna in antennas if antenna.array == array), None)
        nodes = wavelength * _nodes(array)[0] @ rotation.transpose(0, 2, 1)
        pattern = pattern or FormulaPattern(array.pattern)
        return cls(array, pattern, rotation, towards - centre, nodes, arrival)

    def field(self, moved: Float64Array) -> Field:
        """Fields along the paths with the straight line changed by K vectors [m], Shape ``[P, K, 3]``."""
        away = self.away[:, None] + moved
        length = np.sqrt((away**2).sum(-1, keepdims=True))
        direction = away / np.where(length > 0, length, 1.0)
        rotation = np.repeat(self.rotation, away.shape[1], axis=0)
        local = (direction @ self.rotation).reshape(-1, 3)
        local = off_pole(local, direction.reshape(-1, 3), rotation, self.arrival)
        field = polarized_field(self.pattern, self.array.polarization, local).reshape(*away.shape)
        world: Field = field @ self.rotation.transpose(0, 2, 1)
        return world


def _between(taken: Field, transfer: Complex128Array, sent: Field) -> Complex128Array:
    """Amplitudes of P paths with K fields at each end, Shape ``[P, K]``."""
    amplitudes: Complex128Array = ((taken @ transfer) * sent).sum(-1)
    return amplitudes


@lru_cache(maxsize=256)
def _nodes(array: AntennaArray) -> tuple[Float64Array, Float64Array]:
    """Nodes in the axes of an array [wavelengths], Shape ``[K, 3]``, and their weights for its elements, at
    which Lagrange's polynomial through the nodes is evaluated."""
    across = _axis(array.columns)
    down = _axis(array.rows)
    width = (array.columns - 1) / 2 * array.horizontal_spacing
    height = (array.rows - 1) / 2 * array.vertical_spacing
    nodes = np.array([[0.0, y * width, -z * height] for y in across[0] for z in down[0]])
    # Element i is row i % rows of column i // rows.
    weights = np.einsum("ca,rb->crab", across[1], down[1]).reshape(array.size, -1)
    return nodes, weights


def _axis(count: int) -> tuple[Float64Array, Float64Array]:
    """Nodes along one side as parts of its half, and Lagrange's weights of each for ``count`` elements."""
    if count == 1:
        return np.zeros(1), np.ones((1, 1))
    at = np.linspace(-1.0, 1.0, count)
    return np.array([-1.0, 0.0, 1.0]), np.stack([at * (at - 1) / 2, 1 - at**2, at * (at + 1) / 2], axis=1)


# Subcarriers or taps times element pairs that are computed at once, so that memory is bounded.
_BINS = 1 << 20

# Element pairs times paths computed at once: what stays in a processor's cache.
_LANES = 1 << 15


@dataclass(frozen=True, eq=False)
class SphericalWaves:
    """Makes the matrices of a frame by exact lengths between elements.

    Coefficients of reflection, transmission, diffraction and scattering are those of the path between the
    arrays' centres, as in ``siso-rt``. Pattern and polarisation are each element's own, to first order in the
    size of the arrays. Subarrays, of one panel and one polarisation, are looked at one by one.
    """

    surfaces: Surfaces
    """What the paths meet, in the order of the model's table."""
    look: Look
    """Asks this frame's scene."""
    traced_from: tuple[Sequence[Antenna], Sequence[Antenna]]
    """Transmitters and receivers off the surfaces that they are at: there their elements look."""
    memory: int
    """For looking at pairs of elements [bytes] at most; what is kept of each path comes on top."""

    def __call__(
        self,
        carriers: Sequence[Carrier],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> _Fields:
        """The fields of all paths between elements; the arguments are those of `PlaneWaves`."""
        split = _Split.of(transmitters, receivers, located.pair)
        paths = ElementPaths(self.surfaces.take(located.row[split.path]))
        start, end = path_ends(located.pair[split.path], transmitters, receivers)
        # Amplitudes of paths that bend are as traced, those of others of their true length.
        traced = (ends[:, None] for ends in path_ends(located.pair[split.path], *self.traced_from))
        of_bent = paths.lengths(slice(0, len(start)), *traced).spreading[:, 0, 0]
        bent = paths.bend != Bend.NONE
        without_spreading = np.where(
            bent, 1 / np.where(bent, of_bent, 1.0), SPEED_OF_LIGHT * located.geometry.tau[split.path]
        )
        towards = paths.ends(start, end)
        ends = split.transmitter, split.receiver
        fields = []
        for carrier, properties in enumerate(carriers):
            wavelength = SPEED_OF_LIGHT / properties.frequency_hz
            transmit, receive = elements(split.transmit, wavelength), elements(split.receive, wavelength)
            sources, targets = (elements(_parts(side), wavelength) for side in self.traced_from)
            seen = visibility(paths, *ends, sources, targets, self.look, self.memory)
            fields.append(
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
                        paths.image_turn,
                        located.transfer[carrier][split.path] * without_spreading[:, None, None],
                        wavelength,
                    ),
                    wavelength=wavelength,
                )
            )
        return _Fields(fields, split, located.geometry.doppler_ratio[split.path])


@dataclass(frozen=True, eq=False)
class _Fields:
    """All paths of a frame between elements, on each carrier."""

    fields: Sequence[_Field]
    split: _Split
    doppler_ratio: Float64Array
    """Of each path between subarrays, Shape ``[Q]``."""

    def matrices(self, index: int) -> Iterator[Complex128Array]:
        return self.split.joined(list(self.fields[index].matrices(self.split.offsets)))

    def responses(self, asked: Bins) -> Iterator[Complex64Array]:
        doppler = self.doppler_ratio * asked.carrier.frequency_hz
        return self.split.joined(list(self.fields[asked.index].responses(self.split, asked, doppler)))


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
        # Paths are sorted by pair of devices; each is repeated for every pair of their subarrays.
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
        of_t, of_r = (
            [number for number, parts in enumerate(side) for _ in parts]
            for side in (self.of_transmitter, self.of_receiver)
        )
        return [t * len(self.of_receiver) + r for t in of_t for r in of_r]

    def joined(self, blocks: list[Blocks]) -> Iterator[Blocks]:
        """Blocks of each pair of devices, joined from those of each pair of subarrays, Shape ``[..., M,
        N]``."""
        for sent in self.of_transmitter:
            for taken in self.of_receiver:
                yield joined([[blocks[s * len(self.receive) + r] for s in sent] for r in taken])


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
            # One large matrix in parts that fit a cache, or many small ones in one call.
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
        """Responses of each pair of subarrays in order, Shape ``[J, M, N]``."""
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
        """Waves of some paths, which add up to H, Shape ``[p, M, N]``."""
        tx, rx = self.transmitter[rows], self.receiver[rows]
        between = self._between(rows, sizes)
        # In place: these arrays are the largest of a frame.
        turns = between.length
        turns *= -1 / self.wavelength
        turns -= np.round(turns)
        turns *= 2 * np.pi
        waves = np.empty(turns.shape, np.complex128)
        np.cos(turns, out=waves.real)
        np.sin(turns, out=waves.imag)
        if len(tx):
            arrays = self.transmit.arrays[tx[0]], self.receive.arrays[rx[0]]
            sent, taken = self.gains.amplitudes(rows, *arrays)
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
    """Visibility without direct paths between elements closer than one wavelength, where far-field gains do
    not hold: pairs of antennas have none there either."""
    every, some = seen.every.copy(), dict(seen.some)
    transmit, receive = ends
    for path in np.flatnonzero((paths.surfaces.types == 0).all(1)).tolist():
        sent, taken = transmit.positions_of(antennas[0][path]), receive.positions_of(antennas[1][path])
        # Bounding boxes first: only arrays that nearly touch need all distances.
        low = np.maximum(sent.min(0), taken.min(0))
        high = np.minimum(sent.max(0), taken.max(0))
        if (low - high).max() >= wavelength:
            continue
        far = np.sqrt(((taken[:, None] - sent) ** 2).sum(-1)) >= wavelength
        some[path] = far if every[path] else far & some.get(path, False)
        every[path] = False
    return Visibility(every, some)


def _groups(
    offsets: Int64Array, transmit: Elements, receive: Elements
) -> Iterator[tuple[range, tuple[int, int]]]:
    """Runs of consecutive pairs of the same arrays that are computed at once, and the sizes of their arrays.

    A matrix of few elements takes less time than the calls that make it: a run makes many in the same calls.
    """
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
