"""Wideband parts of a channel: responses over subcarriers, taps, and both over the slots of a frame.

`caviar_protocol.multipath` says what a path's delay and Doppler shift make of each subcarrier and tap,
`matrices` and the rungs have the waves between antenna elements; here they become the parts ``hf`` and
``taps``.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import msgspec
import numpy as np

from caviar_protocol.arrays import Complex64Array, Complex128Array, Float64Array, Int64Array
from caviar_protocol.errors import ScenarioError
from caviar_protocol.fields import MAX_BODY
from caviar_protocol.multipath import first_tap, subcarrier_weights, tap_weights
from caviar_protocol.scenario.rules import undefined_part
from caviar_protocol.topics import Carrier, ChannelResponse, ChannelTaps

Part = Literal["hf", "taps"]

# Products of elements in one product of matrices: OpenBLAS shares larger ones out to threads (`stacked`).
_PRODUCTS = 1 << 15
# Paths of one product of matrices.
_DEPTH = 32


class Wideband(msgspec.Struct, frozen=True):
    """The wideband parts of a `Channel`."""

    hf: tuple[ChannelResponse, ...] = ()
    taps: tuple[ChannelTaps, ...] = ()


@dataclass(frozen=True, eq=False)
class Bins:
    """What is asked of one carrier in one part: J = S·K subcarriers or S·L taps."""

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
        """What the amplitudes of a pair's paths are multiplied with, Shape ``[J, ...]``.

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

    In blocks that one thread multiplies: see `channel_matrices.summed`.

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
