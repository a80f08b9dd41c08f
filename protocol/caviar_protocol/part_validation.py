"""Validation of the parts of products: whether those are there that consumers asked for, in the right shape.

A producer computes a part where a consumer asks for it (contract, clause 5). Nothing but `PartCheck` notices
one that leaves a part out, or that fills it for another numerology or other arrays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeAlias

from caviar_protocol.arrays import Payload
from caviar_protocol.scenario.schema import DeviceSpec, is_made_by
from caviar_protocol.topics import (
    TOPICS,
    Carrier,
    Channel,
    ChannelMatrix,
    ChannelResponse,
    ChannelTaps,
)

Indices: TypeAlias = tuple[int, int, int]
"""Carrier, TX and RX of an entry, as indices."""
Entry: TypeAlias = ChannelMatrix | ChannelResponse | ChannelTaps

_BINS = {"h": "", "hf": "subcarriers", "taps": "taps"}
"""Key of a carrier that says how many bins a part of a channel has."""
_AXES = {"h": "", "hf": "slots × subcarriers × ", "taps": "slots × taps × "}


class PartCheck:
    """Looks for the parts that the consumers of one process ask for.

    Args:
        demand: Parts by topic.
        carriers: Those of the scenario; empty: not known, and not compared.
        devices: Those of the scenario; sizes of arrays that are not among them are not compared.
    """

    def __init__(
        self,
        demand: Mapping[str, frozenset[str]],
        carriers: Sequence[Carrier] = (),
        devices: Sequence[DeviceSpec] = (),
    ) -> None:
        self.demand = demand
        self._carriers, self._devices = tuple(carriers), tuple(devices)
        # Elements of each device; None: the scenario has no such device.
        self._sizes: dict[str, int | None] = {}
        # Shapes of the entries of each part, for the carriers and devices of the last channel.
        self._expected: tuple[object, dict[str, dict[Indices, tuple[int | None, ...]]]] = (None, {})

    def __call__(self, topic: str, payload: Payload) -> str:
        """Error in the parts of a product; empty: none."""
        demand = self.demand.get(topic, frozenset())
        if isinstance(payload, Channel):
            entries: dict[str, Sequence[Entry]] = {"h": payload.h, "hf": payload.hf, "taps": payload.taps}
            if not (demand or payload.h or payload.hf or payload.taps):
                return ""
            names = [carrier.name for carrier in payload.carriers]
            known = [carrier.name for carrier in self._carriers]
            if known and names != known:
                return f"its carriers are {names}, by the scenario they are {known}"
            expected = self._shapes(payload)
            for part, found in entries.items():
                if (found or part in demand) and (
                    problem := _wrong_entries(part, found, expected[part], payload)
                ):
                    return problem
            return ""
        readings = getattr(payload, "images", getattr(payload, "scans", ()))
        for part in sorted(demand & TOPICS[topic].parts.keys()):
            for reading in readings:
                if getattr(reading, TOPICS[topic].parts[part]) is None:
                    return f"{_undelivered(part)} of {reading.sensor!r}"
        return ""

    def _shapes(self, channel: Channel) -> dict[str, dict[Indices, tuple[int | None, ...]]]:
        used = None if channel.used is None else channel.used.tobytes()
        axes = channel.carriers, channel.tx, channel.rx, used
        if self._expected[0] != axes:
            nt, nr = ([self._size(name) for name in names] for names in (channel.tx, channel.rx))
            found: dict[str, dict[Indices, tuple[int | None, ...]]] = {part: {} for part in _BINS}
            for c, carrier in enumerate(self._carriers or channel.carriers):
                for part, key in _BINS.items():
                    bins = (carrier.slots, getattr(carrier, key)) if key else ()
                    if 0 in bins:
                        continue
                    for t, transmitting in enumerate(nt):
                        for r, receiving in enumerate(nr):
                            if channel.uses(c, t, r):
                                found[part][c, t, r] = (*bins, receiving, transmitting)
            self._expected = axes, found
        return self._expected[1]

    def _size(self, name: str) -> int | None:
        """Elements of a device's array by the scenario."""
        if name not in self._sizes:
            self._sizes[name] = next(
                (_elements(spec) for spec in self._devices if is_made_by(spec, name)), None
            )
        return self._sizes[name]


def _wrong_entries(
    part: str, entries: Sequence[Entry], expected: Mapping[Indices, tuple[int | None, ...]], channel: Channel
) -> str:
    places = [(entry.carrier, entry.tx, entry.rx) for entry in entries]
    if places != [*expected] and (problem := _wrong_places(part, places, expected, channel)):
        return problem
    for entry, place in zip(entries, places, strict=True):
        shape = expected[place]
        if entry.h.shape != shape and not _has_shape(entry.h.shape, shape):
            wanted = ", ".join("any" if size is None else str(size) for size in shape)
            return (
                f"{part} of {_pair_name(place, channel)} has shape {entry.h.shape}, by the scenario it is "
                f"({wanted}): {_AXES[part]}RX elements × TX elements"
            )
    return ""


def _wrong_places(
    part: str, places: Sequence[Indices], expected: Mapping[Indices, object], channel: Channel
) -> str:
    """Error in the pairs that a part has entries for. A device is no pair with itself."""
    known = {*places}
    for place in expected:
        if place not in known and channel.tx[place[1]] != channel.rx[place[2]]:
            return f"{_undelivered(part)} for {_pair_name(place, channel)}"
    for index, place in enumerate(places):
        if place not in expected:
            return f"{part}[{index}] is of carrier, tx and rx {place}, for which there is no part {part!r}"
        if index and place <= places[index - 1]:
            earlier = _pair_name(places[index - 1], channel)
            return f"{part}[{index}] is of {_pair_name(place, channel)}, after {earlier}"
    return ""


def _undelivered(part: str) -> str:
    return f"part {part!r} is in demand (PREPARE said so), and there is none"


def _has_shape(shape: tuple[int, ...], expected: tuple[int | None, ...]) -> bool:
    """Whether a shape is as expected, as far as that is known."""
    return len(shape) == len(expected) and all(b in (a, None) for a, b in zip(shape, expected, strict=True))


def _pair_name(place: Indices, channel: Channel) -> str:
    c, t, r = place
    return f"{channel.tx[t]} → {channel.rx[r]} on {channel.carriers[c].name!r}"


def _elements(spec: DeviceSpec) -> int:
    return 1 if spec.array is None else spec.array.size
