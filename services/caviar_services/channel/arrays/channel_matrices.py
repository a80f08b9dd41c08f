"""Channel matrices H and the wideband parts ``hf`` and ``taps``: every array applied as plane waves.

`caviar_protocol.multipath` says what a path's delay and Doppler shift make of each subcarrier and tap, and
`PlaneWaves`, or a rung's own `Matrices`, has the waves between antenna elements. Here they become responses
over the subcarriers and taps of each slot of a frame (`Bins`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Literal, Protocol, TypeVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Complex64Array, Complex128Array, Float64Array, Int64Array
from caviar_protocol.errors import ScenarioError
from caviar_protocol.fields import MAX_BODY
from caviar_protocol.multipath import first_tap, subcarrier_weights, tap_weights
from caviar_protocol.scenario.rules import undefined_part
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Carrier, ChannelResponse, ChannelTaps
from caviar_services.channel.paths import Antenna, PathGeometry
from caviar_services.channel.propagation.patterns import radiated_field

Part = Literal["hf", "taps"]

# Multiplications of one matrix product; OpenBLAS shares products of twice as many out to threads of its own.
_PRODUCTS = 32_768

# Paths of one product of matrices.
_DEPTH = 32


class Wideband(msgspec.Struct, frozen=True):
    """The wideband parts of a `Channel`."""

    hf: tuple[ChannelResponse, ...] = ()
    taps: tuple[ChannelTaps, ...] = ()


@dataclass(frozen=True, eq=False)
class Bins:
    """Bins of one carrier in one wideband part: J = S·K subcarriers or S·L taps."""

    part: Part
    index: int
    """Of the carrier."""
    carrier: Carrier
    first: Int64Array
    """Sample of the first tap of each pair, Shape ``[pairs]``."""

    @property
    def count(self) -> int:
        """J."""
        carrier = self.carrier
        return carrier.slots * (carrier.subcarriers if self.part == "hf" else carrier.taps)

    def weights(self, pair: int, tau: Float64Array, doppler: Float64Array) -> Complex128Array:
        """Factors of the amplitudes of a pair's paths, Shape ``[J, ...]``.

        Args:
            pair: Number of the pair.
            tau: Delays [s], Shape ``[...]``.
            doppler: Doppler shifts [Hz], of a shape that broadcasts to that of ``tau``.
        """
        if self.part == "hf":
            found = subcarrier_weights(self.carrier, tau, doppler)
        else:
            found = tap_weights(self.carrier, tau, doppler, int(self.first[pair]))
        return found.reshape(self.count, *tau.shape)


def empty_parts(demand: Collection[str], carriers: Sequence[Carrier]) -> tuple[str, ...]:
    """Notes for the user on wideband parts in demand that no carrier has, so that they are empty.

    Args:
        demand: Parts in demand.
        carriers: Of the run.
    """
    found = [undefined_part(part, carriers) for part in sorted({"hf", "taps"} & set(demand))]
    return tuple(f"a part in demand is empty: {problem}" for problem in found if problem)


def check_size(demand: Collection[str], carriers: Sequence[Carrier], sent: int, taken: int) -> None:
    """Refuse parts that no product holds.

    Args:
        demand: Parts in demand.
        carriers: Carriers with their numerologies.
        sent: Elements of all transmitters together.
        taken: Elements of all receivers together.

    Raises:
        ScenarioError: They have more bytes than `MAX_BODY`; names the carrier's key that costs most.
    """
    sizes = {}
    for index, carrier in enumerate(carriers):
        bins = {"h": 2, "hf": carrier.slots * carrier.subcarriers, "taps": carrier.slots * carrier.taps}
        for part in bins.keys() & set(demand):
            sizes[part, index] = 8 * bins[part] * sent * taken
    total = sum(sizes.values())
    if total <= MAX_BODY:
        return
    part, index = max(sizes, key=sizes.__getitem__)
    key = {"h": "name", "hf": "subcarriers", "taps": "taps"}[part]
    carrier = carriers[index]
    raise ScenarioError(
        f"{part} of {carrier.name!r} takes {sizes[part, index] / 2**30:.3g} GiB between {sent} transmitting "
        f"and {taken} receiving elements in {carrier.slots} slots, and a product holds "
        f"{MAX_BODY / 2**30:g} GiB; write fewer subcarriers, taps or slots, or smaller arrays",
        key=f"carriers[{index}].{key}",
    )


def bins_of(
    parts: Collection[str], carriers: Sequence[Carrier], tau: Float64Array, offsets: Int64Array
) -> tuple[Bins, ...]:
    """List what is asked of the carriers that have the parts.

    Args:
        parts: ``hf``, ``taps`` or both.
        carriers: Of the run.
        tau: Delays [s], as in `Channel`.
        offsets: First path of each pair, as in `Channel`.
    """
    pairs = len(offsets) - 1
    found = []
    for index, carrier in enumerate(carriers):
        if "hf" in parts and carrier.subcarriers:
            found.append(Bins("hf", index, carrier, np.zeros(pairs, np.int64)))
        if "taps" in parts and carrier.taps:
            ends = pairwise(offsets.tolist())
            first = [first_tap(carrier, tau[begin:end]) for begin, end in ends]
            found.append(Bins("taps", index, carrier, np.array(first, np.int64)))
    return tuple(found)


def wideband_parts(bins: Sequence[Bins], responses: Iterable[Complex64Array], receivers: int) -> Wideband:
    """Make both parts of responses.

    Args:
        bins: What was asked for.
        responses: Of each of the bins and pairs, pairs fastest, each of Shape ``[J, Nr, Nt]``.
        receivers: How many.
    """
    hf: list[ChannelResponse] = []
    taps: list[ChannelTaps] = []
    rest = iter(responses)
    for asked in bins:
        for pair, first in enumerate(asked.first.tolist()):
            tx, rx = divmod(pair, receivers)
            response = next(rest)
            h = response.reshape(asked.carrier.slots, -1, *response.shape[1:])
            if asked.part == "hf":
                hf.append(ChannelResponse(carrier=asked.index, tx=tx, rx=rx, h=h))
            else:
                taps.append(ChannelTaps(carrier=asked.index, tx=tx, rx=rx, first=first, h=h))
    return Wideband(tuple(hf), tuple(taps))


def superposed(weights: Complex128Array, waves: Complex128Array) -> Complex64Array:
    """Σ_p weights[j, p] · waves[p, m, n] in single precision, Shape ``[J, Nr, Nt]``.

    In blocks that one thread multiplies: see `summed`.

    Args:
        weights: Of J bins and P paths, Shape ``[J, P]``.
        waves: Between Nr and Nt elements, Shape ``[P, Nr, Nt]``.
    """
    paths, *sizes = waves.shape
    columns = waves.reshape(paths, math.prod(sizes)).astype(np.complex64)
    single = weights.astype(np.complex64)
    total = np.zeros((len(weights), columns.shape[1]), np.complex64)
    for begin in range(0, paths, _DEPTH):
        block = slice(begin, begin + _DEPTH)
        product = _product(np.ascontiguousarray(single[:, block]), columns[block])
        total = product if not begin else np.add(total, product, out=total)
    return total.reshape(len(weights), *sizes)


def _product(left: Complex64Array, right: Complex64Array) -> Complex64Array:
    """Product of matrices, some rows at a time."""
    (count, depth), width = left.shape, right.shape[1]
    product = np.empty((count, width), np.complex64)
    rows = max(1, _PRODUCTS // max(1, depth * width))
    whole = count // rows * rows
    stacked = product[:whole].reshape(-1, rows, width)
    np.matmul(left[:whole].reshape(-1, rows, depth), right, out=stacked)
    np.matmul(left[whole:], right, out=product[whole:])
    return product


def summed(receive: Complex128Array, transmit: Complex128Array) -> Complex128Array:
    """Σ_p receive[p, m] · transmit[p, n], Shape ``[Nr, Nt]``.

    Args:
        receive: Of each path and receiving element, Shape ``[P, Nr]``.
        transmit: Of each path and transmitting element, Shape ``[P, Nt]``.

    Example:
        >>> summed(np.array([[1.0], [2.0]]), np.array([[1.0, 1j], [1.0, 1.0]]))
        array([[3.+0.j, 2.+1.j]])
    """
    # In blocks: NumPy's library shares a larger product out to threads, which beside those of the ray tracer
    # wait for a processor a hundred times as long as the product takes.
    total = np.zeros((receive.shape[1], transmit.shape[1]), np.complex128)
    size = max(4, _PRODUCTS // max(total.size, 1))
    for begin in range(0, len(receive), size):
        block = slice(begin, begin + size)
        total += receive[block].T @ transmit[block]
    return total


@dataclass(frozen=True, eq=False)
class Located:
    """P paths in the order of the product, as matrices are made of them."""

    row: Int64Array
    """Row of each in the model's `PathTable`, Shape ``[P]``."""
    pair: Int64Array
    """As in `PathTable`, ascending, Shape ``[P]``."""
    offsets: Int64Array
    """As in `Channel`: paths of a pair are ``offsets[pair]`` to ``offsets[pair + 1]``."""
    geometry: PathGeometry
    a: Complex128Array
    """As in `Channel`, Shape ``[C, P]``."""
    transfer: Complex128Array
    """As in `PathTable`, Shape ``[C, P, 3, 3]``, with absorption by the air."""
    absorption_db_per_km: Float64Array | None
    """As in `Product`."""


class PairMatrices(Protocol):
    """Matrices between the antennas of all pairs of a frame, transmitters slowest."""

    def matrices(self, index: int) -> Iterator[Complex128Array]:
        """H of each pair on a carrier, by its index, Shape ``[Nr, Nt]`` each."""

    def responses(self, asked: Bins) -> Iterator[Complex64Array]:
        """Responses of each pair in `Bins`, Shape ``[J, Nr, Nt]`` each."""


Matrices = Callable[[Sequence[Carrier], Sequence[Antenna], Sequence[Antenna], Located], PairMatrices]
"""Makes the matrices of a product from its carriers, transmitters, receivers and paths."""


class PlaneWaves:
    """H[m, n] = Σ_p a[p] · receive[p, m] · transmit[p, n]: delays and phases within an array are those at
    the carrier, so that its beams point where they do there on every subcarrier (no beam squint).

    With several subarrays the sum holds for each block of H, with the amplitudes between these two and the
    phases of their centres.

    Args:
        carriers: Of the product.
        transmitters: In its order; receivers likewise.
        receivers: See ``transmitters``.
        located: Its paths.
    """

    def __init__(
        self,
        carriers: Sequence[Carrier],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> None:
        self._carriers, self._geometry = carriers, located.geometry
        self._pairs = [
            _Steered.of(antennas, slice(*ends), located)
            for antennas, ends in zip(
                product(transmitters, receivers), pairwise(located.offsets.tolist()), strict=True
            )
        ]

    def matrices(self, index: int) -> Iterator[Complex128Array]:
        return (pair.h(index, self._carriers[index]) for pair in self._pairs)

    def responses(self, asked: Bins) -> Iterator[Complex64Array]:
        doppler = self._geometry.doppler_ratio * asked.carrier.frequency_hz
        for number, pair in enumerate(self._pairs):
            weights = asked.weights(number, self._geometry.tau[pair.mine], doppler[pair.mine])
            yield pair.response(asked.index, asked.carrier, weights)


@dataclass(frozen=True, eq=False)
class _Steered:
    """The p paths of a pair of devices, and the phases of the elements of their subarrays on each."""

    antennas: tuple[Antenna, Antenna]
    """Transmitter and receiver."""
    mine: slice
    located: Located
    transmit: list[Complex128Array]
    """Of each subarray of the transmitter, Shape ``[p, N]`` each; ``receive`` likewise."""
    receive: list[Complex128Array]

    @classmethod
    def of(cls, antennas: tuple[Antenna, Antenna], mine: slice, located: Located) -> _Steered:
        """Waves of a pair whose paths are the rows ``mine``."""
        towards = located.geometry.departure[mine], located.geometry.arrival[mine]
        transmit, receive = (
            [steering_vector(part.array, along @ part.rotation) for part in end.subarrays]
            for end, along in zip(antennas, towards, strict=True)
        )
        return cls(antennas, mine, located, transmit, receive)

    def h(self, index: int, carrier: Carrier) -> Complex128Array:
        """H on a carrier, which is the ``index``-th."""
        # A sum of outer products is one matrix product over the paths.
        a = self._amplitudes(index, carrier)
        return joined(
            [
                [summed(receive * a[r, t, :, None], transmit) for t, transmit in enumerate(self.transmit)]
                for r, receive in enumerate(self.receive)
            ]
        )

    def response(self, index: int, carrier: Carrier, weights: Complex128Array) -> Complex64Array:
        """Σ_p weights[j, p] · (what path p adds to H), Shape ``[J, Nr, Nt]``."""
        a = self._amplitudes(index, carrier)
        return joined(
            [
                [
                    superposed(weights * a[r, t], receive[:, :, None] * transmit[:, None, :])
                    for t, transmit in enumerate(self.transmit)
                ]
                for r, receive in enumerate(self.receive)
            ]
        )

    def _amplitudes(self, index: int, carrier: Carrier) -> Complex128Array:
        """Amplitudes of paths between each subarray of the receiver and each of the transmitter, ``[R, T,
        p]``."""
        located, mine = self.located, self.mine
        # The usual case: amplitudes of the product are those between the only subarrays.
        if len(self.transmit) * len(self.receive) == 1:
            return located.a[None, None, index, mine]
        geometry = located.geometry
        towards = geometry.departure[mine], geometry.arrival[mine]
        phase = carrier_phase([carrier], geometry.tau[mine])
        a = subarray_amplitudes(self.antennas, towards, located.transfer[index : index + 1, mine], phase)
        return a[:, :, 0] * _centre_phases(carrier, self.antennas, towards)


Blocks = TypeVar("Blocks", Complex64Array, Complex128Array)


def joined(rows: list[list[Blocks]]) -> Blocks:
    """One array of blocks between subarrays, Shape ``[..., M, N]``; a row has those of one receiving
    subarray."""
    return rows[0][0] if len(rows) * len(rows[0]) == 1 else np.block(rows)


def carrier_phase(carriers: Sequence[Carrier], tau: Float64Array) -> Complex128Array:
    """Carrier phases of paths.

    Args:
        carriers: C carriers.
        tau: Delays [s], Shape ``[P]``.

    Returns:
        exp(−j2πfτ), Shape ``[C, P]``.

    Example:
        >>> carrier_phase([Carrier(name="a", frequency_hz=1e9)], np.array([2.5e-10])).round(9)
        array([[0.-1.j]])
    """
    frequency = np.array([carrier.frequency_hz for carrier in carriers])
    return turn_phase(frequency[:, None] * tau)


def turn_phase(turns: Float64Array) -> Complex128Array:
    """exp(−j2πx) of numbers of turns x, of any Shape."""
    # The whole turns of f·τ go first: they are millions, and only the rest is a phase.
    phase: Complex128Array = np.exp(-2j * np.pi * (turns - np.round(turns)))
    return phase


def subarray_amplitudes(
    antennas: tuple[Antenna, Antenna],
    towards: tuple[Float64Array, Float64Array],
    transfer: Complex128Array,
    phase: Complex128Array,
) -> Complex128Array:
    """Amplitudes of paths between elements at the devices' positions, of each subarray of a receiver and each
    of a transmitter, Shape ``[R, T, C, P]``.

    Args:
        antennas: Transmitter and receiver.
        towards: Directions of departure and of arrival in world axes, Shape ``[P, 3]`` each.
        transfer: As in `PathTable`, Shape ``[C, P, 3, 3]``.
        phase: From `carrier_phase`, Shape ``[C, P]``.
    """
    sent, taken = (
        np.array(
            [
                radiated_field(part.array, part.rotation, along, part.pattern, arrival=arrival)
                for part in end.subarrays
            ]
        )
        for end, along, arrival in zip(antennas, towards, (False, True), strict=True)
    )
    amplitudes: Complex128Array = np.einsum("rpi,cpij,tpj->rtcp", taken, transfer, sent) * phase
    return amplitudes


def _centre_phases(
    carrier: Carrier, antennas: tuple[Antenna, Antenna], towards: tuple[Float64Array, Float64Array]
) -> Complex128Array:
    """Phases between the centres of subarrays relative to those between the devices, Shape ``[R, T, P]``."""
    nearer = [
        np.array([along @ (part.position - end.position) for part in end.subarrays])
        for end, along in zip(antennas, towards, strict=True)
    ]
    metres = nearer[1][:, None] + nearer[0][None]
    phases: Complex128Array = np.exp(2j * np.pi * carrier.frequency_hz / SPEED_OF_LIGHT * metres)
    return phases
