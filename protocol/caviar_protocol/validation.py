"""Validation of products on the consumer's side: whether a product says what its topic allows.

The broker never looks into a payload, and a decoder checks types and shapes only. What a service
consumes therefore passes through one `ProductCheck` before the service sees it: a product with a
quaternion of norm 2, a negative dimension, a name twice or a number that is none is refused in the first
frame, and the error names the service that made it. `scene_validation` looks at scenes, `PartCheck` at
the parts that were asked for.

A producer computes a part where a consumer asks for it (contract, clause 5). Nothing but `PartCheck` notices
one that leaves a part out, or that fills it for another numerology or other arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pkgutil import resolve_name
from typing import Any, TypeAlias, get_type_hints

import msgspec
import numpy as np

from caviar_protocol.arrays import Payload, array_fields, attributes, require_finite
from caviar_protocol.digest import payload_digest
from caviar_protocol.errors import PayloadError, ProductError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario.schema import DeviceSpec, is_made_by
from caviar_protocol.scene_validation import (
    UNIT_TOLERANCE,
    SceneRules,
    numbers_are_right,
    wrong_description,
    wrong_number,
)
from caviar_protocol.topics import (
    TOPICS,
    Action,
    Camera,
    Carrier,
    Channel,
    ChannelMatrix,
    ChannelResponse,
    ChannelTaps,
    Depth,
    Lidar,
    Link,
    Segmentation,
    topics_of,
)
from caviar_protocol.topics.scene import Scene

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
    """Return whether a shape is as expected, as far as that is known."""
    return len(shape) == len(expected) and all(b in (a, None) for a, b in zip(shape, expected, strict=True))


def _pair_name(place: Indices, channel: Channel) -> str:
    c, t, r = place
    return f"{channel.tx[t]} → {channel.rx[r]} on {channel.carriers[c].name!r}"


def _elements(spec: DeviceSpec) -> int:
    return 1 if spec.array is None else spec.array.size


_MADE_OF_SCENES = frozenset(topics_of("channel", "link", "sensors"))
FIRST_LOOKS = 16
"""Products of each source that every consumer looks at, and of which it compares the digest."""

_MAX_AMPLITUDE = 1e9
"""Of paths and channels; antennas of 60 dBi each make 1e6 of a path without any loss."""
_MAX_TAP = 2**53
"""Of the first tap: doubles hold whole numbers up to here."""


class ContentRules(SceneRules, frozen=True, kw_only=True):
    """Rules for products, beside scenes; what is not known is not checked."""

    carriers: tuple[Carrier, ...] = ()
    """Of the scenario."""
    parts: Mapping[str, frozenset[str]] = {}
    """By topic: the parts of products that the consumer asks for."""


class ProductCheck:
    """Checks the products that one process consumes; one object for all frames of a run.

    Names, meshes and devices of a scene are looked at where they differ from those of the scene before,
    numbers in every frame.

    Args:
        rules: What the run says about products, once that is known (`adopt`).
    """

    def __init__(self, rules: SceneRules | None = None) -> None:
        self.rules = SceneRules()
        self._parts = PartCheck({})
        self.adopt(rules or self.rules)
        # Frames of whose scenes a product was made that is an input beside them.
        self._derived: frozenset[int] = frozenset()
        # Products that were looked at, by (topic, source).
        self._looks: dict[tuple[str, str], int] = {}
        # By (topic, source), the last product without bytes: in one process all consumers get one object.
        self._passed: dict[tuple[str, str], Payload] = {}
        # By world, the last header, or scene, of which names and devices are right.
        self._described: dict[str, bytes | Scene] = {}

    def adopt(self, rules: SceneRules) -> None:
        """Go by these rules; what consumers before asked for stays in demand."""
        self.rules = rules
        if isinstance(rules, ContentRules):
            demand = dict(self._parts.demand)
            for topic, parts in rules.parts.items():
                demand[topic] = demand.get(topic, frozenset()) | parts
            specs = [spec for published in rules.devices.values() for spec in published]
            self._parts = PartCheck(demand, rules.carriers, specs)

    def begin(self, inputs: Iterable[GrantInput]) -> None:
        """Take note of the inputs of the next grant, before they are checked.

        A channel looks at every scene before it computes with it, so a product that was made of a frame's
        scenes vouches for them. After the `FIRST_LOOKS` of a source, consumers that get the channel too do
        not look again: it would cost as much as a small service's own work.
        """
        self._derived = frozenset(
            [i.frame for i in inputs if i.topic in _MADE_OF_SCENES and i.status is Status.FRESH]
        )

    def is_due(self, entry: GrantInput) -> bool:
        """Return whether this consumer has to look at a product."""
        return not (entry.frame in self._derived and entry.topic == "scene" and self._is_familiar(entry))

    def digest(self, entry: GrantInput, header: bytes | memoryview, body: bytes | memoryview) -> None:
        """Compare the digest of one of the first products of a source with the one it stated.

        A service that computes digests wrongly does so from the first frame on.

        Raises:
            ProductError: They differ.
        """
        if not self._is_familiar(entry):
            check_digest(entry, header, body)

    def __call__(self, entry: GrantInput, payload: Payload, header: bytes = b"") -> None:
        """Check the content of a product.

        Args:
            entry: Its provenance.
            payload: The typed payload.
            header: Its encoded fields, where there are any: in one process products are not encoded.

        Raises:
            ProductError: The payload cannot be; the text names object, field and value.
        """
        key = entry.topic, entry.source
        if (not header and self._passed.get(key) is payload) or not self.is_due(entry):
            return
        if isinstance(payload, Scene):
            found = self._wrong_scene(payload, entry.source, header)
        else:
            found = wrong_values(payload) or self._parts(entry.topic, payload)
        if found:
            raise ProductError(entry.topic, entry.source, entry.frame, found)
        self._looks[key] = self._looks.get(key, 0) + 1
        # In one process all consumers get the same object: a look of the first counts for all.
        if not header:
            self._passed[key] = payload

    def _is_familiar(self, entry: GrantInput) -> bool:
        return self._looks.get((entry.topic, entry.source), 0) >= FIRST_LOOKS

    def _wrong_scene(self, scene: Scene, world: str, header: bytes) -> str:
        if not numbers_are_right(scene) and (found := wrong_number(scene)):
            return found
        known = self._described.get(world)
        if header:
            is_known = known == header  # every field but the arrays stands in the header
        else:
            is_known = isinstance(known, Scene) and _describe_the_same(known, scene)
        # Names and devices change only when an object comes or goes.
        if not is_known:
            if found := wrong_description(scene, world, self.rules):
                return found
            self._described[world] = header or scene
        return ""


def _describe_the_same(a: Scene, b: Scene) -> bool:
    return a.names == b.names and a.assets == b.assets and a.devices == b.devices


def check_digest(entry: GrantInput, header: bytes | memoryview, body: bytes | memoryview) -> None:
    """Check that bytes are those of the digest that their producer stated.

    Raises:
        ProductError: They are not; the text says how a digest is made.
    """
    digest = payload_digest(header, body)
    if digest != entry.digest:
        raise ProductError(
            entry.topic,
            entry.source,
            entry.frame,
            f"its digest is {digest}, its DONE said {entry.digest or 'none'}: hash the length of the header "
            "(8 bytes, little-endian), the header and the body",
        )


# --- values of the other topics, in every frame -----------------------------------------------------------


def wrong_values(payload: Payload) -> str:
    """Error in the numbers of a product that is no scene; empty: none."""
    judge = _JUDGES.get(type(payload))
    return "" if judge is None else judge(payload)


def wrong_channel(channel: Channel) -> str:
    """Error in a channel; empty: none."""
    found = _not_finite(channel)
    if not found and channel.tau.size and not _least(channel.tau) >= 0:
        index = int(np.argmin(channel.tau))
        found = f"tau[{index}] is {channel.tau[index]:g} s: a delay is at least 0"
    if not found and not math.isfinite(channel.expected_error_db or 0.0):
        found = f"expected_error_db is {channel.expected_error_db}: leave it out where it is not known"
    if found := found or _wrong_gains(channel, "a"):
        return found
    for name in ("h", "hf", "taps"):
        for index, entry in enumerate(getattr(channel, name)):
            if found := _wrong_gains(entry, "h"):
                return f"{name}[{index}]: {found}"
    for index, entry in enumerate(channel.taps):
        if abs(entry.first) > _MAX_TAP:
            return f"taps[{index}].first is {entry.first}: it is a sample, at most {_MAX_TAP} from delay 0"
    return ""


def _wrong_gains(payload: Payload, field: str) -> str:
    """Error in amplitude gains: numbers that are none, or that no antennas have."""
    values = getattr(payload, field)
    # A sum of squares bounds every term of it; of large responses one look is enough. BLAS warns of nothing.
    if np.vdot(values, values).real <= _MAX_AMPLITUDE**2:
        return ""
    if found := _not_finite(payload):
        return found
    strongest = float(np.abs(values.astype(np.complex128)).max())
    if strongest <= _MAX_AMPLITUDE:
        return ""
    return f"{field} has an amplitude gain of {strongest:g}: at most {_MAX_AMPLITUDE:g} is possible"


def wrong_link(link: Link) -> str:
    """Error in a link; empty: none."""
    found = _not_finite(link) or _negative(link.abs_y, "abs_y", "1") or _negative(link.snr, "snr", "1")
    found = found or _negative(link.sinr, "sinr", "1")
    if not found and link.arrived is not None:
        found = next(filter(None, (_negative(getattr(link, key), key, u) for key, u in _PACKETS)), "")
    return found


# Fields of a link with packets that are at least 0, and their units.
_PACKETS = (
    ("buffered", "bit"),
    ("arrived", "bit"),
    ("sent", "bit"),
    ("dropped", "bit"),
    ("delivered", "1"),
    ("delay", "s"),
    ("waiting", "s"),
    ("throughput", "bit/s"),
    ("blocks", "1"),
    ("block_errors", "1"),
)


def wrong_lidar(lidar: Lidar) -> str:
    """Error in scans; empty: none."""
    for scan in lidar.scans:
        found = _wrong_pose(scan) or _not_finite(scan) or _negative(scan.range, "range", "m")
        if found:
            return f"scan of {scan.sensor!r}: {found}"
    return ""


def wrong_images(payload: Camera | Depth | Segmentation) -> str:
    """Error in images; empty: none."""
    for image in payload.images:
        found = _wrong_pose(image) or _not_finite(image)
        if found := found or _negative(getattr(image, "depth", None), "depth", "m"):
            return f"image of {image.sensor!r}: {found}"
    return ""


def wrong_action(action: Action) -> str:
    """Error in an action; empty: none."""
    for index, command in enumerate(action.commands):
        if not _has_numbers(type(command)):
            continue
        try:
            require_finite(command)
        except PayloadError as error:
            return f"commands[{index}]: {error}"
    return ""


@cache
def _has_numbers(cls: type[msgspec.Struct]) -> bool:
    """Return whether a command has more than names and indices, as that for a beam has not."""
    return any(hint not in (str, int, bool) for hint in get_type_hints(cls).values())


def _wrong_pose(owner: Any) -> str:
    norm = math.hypot(*owner.orientation)
    if not abs(norm - 1) <= UNIT_TOLERANCE:
        return f"its orientation has norm {norm:.6g}: a unit quaternion (w, x, y, z) is needed"
    if not all(map(math.isfinite, owner.position)):
        return f"its position {owner.position} is not finite"
    return ""


def _negative(values: Any, field: str, unit: str) -> str:
    if values is None or not values.size or _least(values) >= 0:
        return ""
    return f"{field} is {values.min():g} {unit} at worst: it is at least 0"


FEW = 16
"""Numbers of an array up to which Python finds the least one sooner than NumPy, whose call takes 3 µs."""


def _least(values: Any) -> float:
    """The least number of an array that has some, all of them finite."""
    if values.size <= FEW and values.ndim == 1:
        return float(min(values.tolist()))
    return float(values.min())


def _not_finite(payload: Payload) -> str:
    """The first array element that is not finite; the sum of squares of the others is."""
    for values in _float_arrays(type(payload))(payload):
        if values is not None and not np.vdot(values, values).real < math.inf:
            try:
                require_finite(payload)
            except PayloadError as error:
                return str(error)
    return ""


_FLOATS = frozenset({"<f4", "<f8", "<c8", "<c16"})


@cache
def _float_arrays(cls: type[Payload]) -> Callable[[Payload], tuple[Any, ...]]:
    return attributes([name for name, field in array_fields(cls).items() if field.dtype in _FLOATS])


_JUDGES: dict[type[Payload], Callable[[Any], str]] = {
    topic.payload: resolve_name(f"caviar_protocol.{topic.check}") for topic in TOPICS.values() if topic.check
}
