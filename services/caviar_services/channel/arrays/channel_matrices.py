"""Channel matrices H from the paths of a product: what every rung gives, and arrays applied as plane
waves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Protocol, TypeVar

import numpy as np

from caviar_protocol.arrays import Complex64Array, Complex128Array, Float64Array, Int64Array
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.topics import Carrier
from caviar_services.antenna_arrays import steering_vector
from caviar_services.channel.paths import Antenna
from caviar_services.channel.propagation.geometry import PathGeometry
from caviar_services.channel.propagation.patterns import radiated_field
from caviar_services.channel.wideband import Bins, superposed

# Multiplications of one matrix product; OpenBLAS shares products of twice as many out to threads of its own.
_PRODUCTS = 32_768


def summed(receive: Complex128Array, transmit: Complex128Array) -> Complex128Array:
    """Σ_p receive[p, m] · transmit[p, n], Shape ``[Nr, Nt]``.

    Args:
        receive: Of each path and receiving element, Shape ``[P, Nr]``.
        transmit: Of each path and transmitting element, Shape ``[P, Nt]``.
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
        """What `Bins` ask for of each pair, Shape ``[J, Nr, Nt]`` each."""


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
        """Of a pair whose paths are the rows ``mine``."""
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
        """Of the paths between each subarray of the receiver and each of the transmitter, ``[R, T, p]``."""
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
    """exp(−j2πfτ), Shape ``[C, P]``; delays [s] have the Shape ``[P]``."""
    frequency = np.array([carrier.frequency_hz for carrier in carriers])
    # The whole turns of f·τ go first: they are millions, and only the rest is a phase.
    turns = frequency[:, None] * tau
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
        np.array([radiated_field(part.array, part.rotation, along, part.pattern) for part in end.subarrays])
        for end, along in zip(antennas, towards, strict=True)
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
