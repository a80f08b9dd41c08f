"""From the paths of a product to its channel matrices H."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

from caviar_protocol.arrays import Complex64Array, Complex128Array, Float64Array, Int64Array
from caviar_protocol.topics import Carrier, ChannelMatrix
from caviar_services.antenna import steering_vector
from caviar_services.channel.geometry import PathGeometry
from caviar_services.channel.paths import Antenna
from caviar_services.channel.stacked import summed
from caviar_services.channel.wideband import Bins, superposed


@dataclass(frozen=True, eq=False)
class Located:
    """P paths in the order of the product, as matrices are made of them."""

    row: Int64Array
    """Row of each in the model's `PathTable`, Shape ``[P]``."""
    pair: Int64Array
    offsets: Int64Array
    """As in `Channel`: paths of a pair are ``offsets[pair]`` to ``offsets[pair + 1]``."""
    geometry: PathGeometry
    a: Complex128Array
    """As in `Channel`, Shape ``[C, P]``."""
    transfer: Complex128Array
    """As in `PathTable`, Shape ``[C, P, 3, 3]``, with absorption by the air."""
    absorption_db_per_km: Float64Array | None
    """As in `Product`."""


class Matrices(Protocol):
    """Makes the matrices of a product from its paths, at the carriers and over the band."""

    def __call__(
        self,
        carriers: Sequence[Carrier],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> tuple[ChannelMatrix, ...]:
        """H of every carrier and pair, carriers slowest."""

    def responses(
        self,
        bins: Sequence[Bins],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> Iterator[Complex64Array]:
        """What `Bins` ask for, of each of them and each pair, pairs fastest; Shape ``[J, Nr, Nt]`` each."""


class PlaneWaves:
    """H[m, n] = Σ_p a[p] · receive[p, m] · transmit[p, n]: delays and phases within an array are those at
    the carrier, so that its beams point where they do there on every subcarrier (no beam squint)."""

    def __call__(
        self,
        carriers: Sequence[Carrier],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> tuple[ChannelMatrix, ...]:
        return plane_waves(carriers, transmitters, receivers, located)

    def responses(
        self,
        bins: Sequence[Bins],
        transmitters: Sequence[Antenna],
        receivers: Sequence[Antenna],
        located: Located,
    ) -> Iterator[Complex64Array]:
        geometry = located.geometry
        steered = list(_steered(transmitters, receivers, located))
        for asked in bins:
            doppler = geometry.doppler_ratio * asked.carrier.frequency_hz
            for pair, (mine, receive, transmit) in enumerate(steered):
                weights = asked.weights(pair, geometry.tau[mine], doppler[mine])
                waves = receive[:, :, None] * transmit[:, None, :]
                yield superposed(weights * located.a[asked.index, mine], waves)


def plane_waves(
    carriers: Sequence[Carrier],
    transmitters: Sequence[Antenna],
    receivers: Sequence[Antenna],
    located: Located,
) -> tuple[ChannelMatrix, ...]:
    """H[m, n] = Σ_p a[p] · receive[p, m] · transmit[p, n] of every carrier and pair."""
    a = located.a
    steered = list(_steered(transmitters, receivers, located))
    return tuple(
        ChannelMatrix(
            carrier=carrier,
            tx=pair // len(receivers),
            rx=pair % len(receivers),
            h=summed(receive * a[carrier, mine, None], transmit),
        )
        for carrier in range(len(carriers))
        for pair, (mine, receive, transmit) in enumerate(steered)
    )


def _steered(
    transmitters: Sequence[Antenna], receivers: Sequence[Antenna], located: Located
) -> Iterator[tuple[slice, Complex128Array, Complex128Array]]:
    """Of each pair: its paths, and the phases of receiving and transmitting elements, Shape ``[p, N]``."""
    geometry = located.geometry
    for pair, (begin, end) in enumerate(pairwise(located.offsets.tolist())):
        tx, rx = divmod(pair, len(receivers))
        mine = slice(begin, end)
        transmit = _steering(transmitters[tx], geometry.departure[mine])
        yield mine, _steering(receivers[rx], geometry.arrival[mine]), transmit


def _steering(antenna: Antenna, directions: Float64Array) -> Complex128Array:
    return steering_vector(antenna.array, directions @ antenna.rotation)
