"""From the paths of a product to its channel matrices H."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from caviar_protocol.arrays import Complex128Array, Float64Array, Int64Array
from caviar_protocol.topics import Carrier, ChannelMatrix
from caviar_services.antenna import steering_vector
from caviar_services.channel.geometry import PathGeometry
from caviar_services.channel.paths import Antenna
from caviar_services.channel.stacked import summed


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


Matrices = Callable[
    [Sequence[Carrier], Sequence[Antenna], Sequence[Antenna], Located], tuple[ChannelMatrix, ...]
]
"""Makes the matrices of a product from its paths."""


def plane_waves(
    carriers: Sequence[Carrier],
    transmitters: Sequence[Antenna],
    receivers: Sequence[Antenna],
    located: Located,
) -> tuple[ChannelMatrix, ...]:
    """H[m, n] = Σ_p a[p] · receive[p, m] · transmit[p, n] of every carrier and pair."""
    steered = []
    geometry, a = located.geometry, located.a
    for pair, (begin, end) in enumerate(pairwise(located.offsets.tolist())):
        tx, rx = divmod(pair, len(receivers))
        mine = slice(begin, end)
        transmit = _steering(transmitters[tx], geometry.departure[mine])
        receive = _steering(receivers[rx], geometry.arrival[mine])
        steered.append((tx, rx, mine, receive, transmit))
    return tuple(
        ChannelMatrix(carrier=carrier, tx=tx, rx=rx, h=summed(receive * a[carrier, mine, None], transmit))
        for carrier in range(len(carriers))
        for tx, rx, mine, receive, transmit in steered
    )


def _steering(antenna: Antenna, directions: Float64Array) -> Complex128Array:
    return steering_vector(antenna.array, directions @ antenna.rotation)
