"""What a policy observes: parts by name, and the users that they are about.

Environments, training on recordings and agents that serve a trained policy read observations here, so that a
policy sees the same numbers wherever it decides. To add a part: one subclass of `Part`, one line in `PARTS`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import reduce
from operator import add
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import Float64Array, Payload
from caviar_protocol.errors import ScenarioError
from caviar_protocol.messages import Input
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.rules import patterns_overlap
from caviar_protocol.scenario.schema import ServiceSpec, owned_by
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.space.scene import Pair, device_pose, device_velocity, directions, pairs_of
from caviar_protocol.topics import AntennaArray, Camera, Depth, Lidar, Scene

P = TypeVar("P", bound=Payload)


class ObservedFrame(Protocol):
    """What is read of a frame: `caviar_services.service.Frame` in a run, products of one in a recording."""

    def payloads(self, topic: str, cls: type[P]) -> Mapping[str, P]:
        """Payloads of a topic that are present, by source."""


class KnownScenario(Protocol):
    """What is known of a scenario: a `Scenario`, or what a run says to its agents about it."""

    @property
    def devices(self) -> Sequence[DeviceSpec]:
        """All devices."""

    @property
    def services(self) -> Mapping[str, ServiceSpec]:
        """Services with their settings; empty where they are not known."""


@dataclass(frozen=True)
class KnownDevices:
    """What a run says to its agents about the scenario."""

    devices: Sequence[DeviceSpec]
    services: Mapping[str, ServiceSpec] = field(default_factory=dict)


class Bounds(NamedTuple):
    """Bounds, shape and dtype of the values of a part, as a `gymnasium.spaces.Box` takes them."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: Any


@dataclass(frozen=True)
class Place:
    """What one place of the observation and of the action stands for."""

    tx: AntennaArray
    rx: AntennaArray

    @property
    def beam_pairs(self) -> int:
        """Number of pairs of the two codebooks."""
        return self.tx.size * self.rx.size


class Users:
    """Places for all pairs that a scenario can have, by transmitter, then receiver.

    A device on a pattern (``on = "car.*"``, ``count = 10``) has ``count`` places; the pairs that are there
    fill them in the order of their names, and what is left stays empty. So spaces keep their size while
    users come and go.

    Args:
        scenario: Names the devices.
        patterns: Receivers that are served, as names with ``*`` and ``?``.
        without: Receivers among them that are not, in the same form; their places stay empty.

    Raises:
        ScenarioError: The patterns match no receiver; the text has those there are.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> users = Users(load_scenario("geometric"), ("*",))
        >>> len(users), users.places[0].beam_pairs
        (1, 64)
    """

    def __init__(self, scenario: KnownScenario, patterns: Sequence[str], without: Sequence[str] = ()) -> None:
        self._patterns, self._without = tuple(patterns), tuple(without)
        antennas = [d for d in scenario.devices if d.kind == "antenna"]
        self._groups: list[tuple[DeviceSpec, DeviceSpec]] = [
            (tx, rx)
            for tx in sorted((d for d in antennas if d.role in ("tx", "both")), key=_name)
            for rx in sorted((d for d in antennas if d.role in ("rx", "both")), key=_name)
            if rx is not tx and self._may_serve(rx)
        ]
        if not self._groups:
            receivers = (d for d in antennas if d.role in ("rx", "both"))
            names = ", ".join(_full_name(d) for d in receivers) or "none"
            raise ScenarioError(f"no receiver of the scenario is {' or '.join(patterns)}; there are: {names}")
        self._first: dict[tuple[str, str], int] = {}
        self.places: list[Place] = []
        """One for each pair there may be."""
        for tx, rx in self._groups:
            self._first[tx.name, rx.name] = len(self.places)
            # One object for all of a group: places of a pattern have the same arrays.
            self.places += [Place(_array(tx), _array(rx))] * (tx.count * rx.count)
        self._devices: object = None
        self._found: tuple[tuple[int, Pair], ...] = ()

    def __len__(self) -> int:
        return len(self.places)

    def present(self, scene: Scene) -> tuple[tuple[int, Pair], ...]:
        """Find the pairs of a scene that are served.

        Returns:
            Place and pair, in the order of the scene's pairs.
        """
        # A world makes a new tuple of devices where one comes or goes, and passes on the same one else.
        if scene.devices is not self._devices:
            self._devices, self._found = scene.devices, tuple(self._seated(scene))
        return self._found

    def _seated(self, scene: Scene) -> Iterator[tuple[int, Pair]]:
        taken: dict[tuple[str, str], int] = {}
        for pair in pairs_of(scene):
            group = _spec_name(pair.tx.name), _spec_name(pair.rx.name)
            if group in self._first and self._serves(pair.rx.name):
                place = self._first[group] + taken.get(group, 0)
                taken[group] = taken.get(group, 0) + 1
                yield place, pair

    def _serves(self, rx: str) -> bool:
        return owned_by(self._patterns, rx) and not (self._without and owned_by(self._without, rx))

    def _may_serve(self, rx: DeviceSpec) -> bool:
        # Names of objects are known at run time: two patterns are compared with each other here.
        return any(patterns_overlap(_full_name(rx), pattern) for pattern in self._patterns)


def _name(device: DeviceSpec) -> str:
    return device.name


def _full_name(device: DeviceSpec) -> str:
    """Name of a device in the run; a pattern where it is on one."""
    return f"{device.on}/{device.name}" if device.on else device.name


def _spec_name(device: str) -> str:
    """Name in the scenario of a device that may be mounted on an object."""
    return device.rpartition("/")[2]


def _array(device: DeviceSpec) -> AntennaArray:
    return device.array or AntennaArray()


class LinkFigures(Protocol):
    """What is read of a link: a `Link`, with one number for each user, or a link of many episodes, with a row
    of users for each of them."""

    @property
    def tx(self) -> tuple[str, ...]:
        """Transmitter of each user."""

    @property
    def rx(self) -> tuple[str, ...]:
        """Receiver of each user."""

    @property
    def tx_beam(self) -> NDArray[Any]:
        """Chosen TX beam, −1: none; Shape ``[..., U]`` as all below."""

    @property
    def rx_beam(self) -> NDArray[Any]:
        """Chosen RX beam."""

    @property
    def abs_y(self) -> Float64Array:
        """|y|."""

    @property
    def spectral_efficiency(self) -> Float64Array:
        """[bit/s/Hz]."""


class Moment(msgspec.Struct, frozen=True):
    """What is known at a frame, from which observations are read."""

    frame: ObservedFrame
    scene: Scene
    link: LinkFigures | None
    """Of the frame before; None in frame 0."""
    users: tuple[tuple[int, Pair], ...]
    """Place and pair of the users that are there."""


FAR = 1e6
"""Bound of what has none of its own: metres, metres a second, magnitudes."""


class Part(ABC):
    """One part of the observation.

    Args:
        scenario: Has the devices and their settings.
        users: The places.
        sensor: What stands after the colon of the part's name; empty: nothing.
    """

    inputs: ClassVar[tuple[Input, ...]] = ()
    """What it needs beside the scene and the link of the frame before."""
    needs_sensor: ClassVar[str] = ""
    """Kind of the device that it is of; empty: none."""

    def __init__(self, scenario: KnownScenario, users: Users, sensor: str) -> None:
        self.users, self.sensor = users, sensor

    @property
    @abstractmethod
    def bounds(self) -> Bounds:
        """Bounds, shape and dtype of its values."""

    @abstractmethod
    def read(self, moment: Moment) -> NDArray[Any] | None:
        """Read its value at a frame.

        Returns:
            A value within `bounds`; None where it is not known, and zeros are observed.
        """


class _PerUser(Part):
    """Numbers for each place; zeros for an empty one."""

    width: ClassVar[int] = 1
    bound: ClassVar[float] = FAR

    @property
    def bounds(self) -> Bounds:
        return Bounds(-self.bound, self.bound, (len(self.users) * self.width,), np.float32)

    def read(self, moment: Moment) -> NDArray[np.float32]:
        width = self.width
        values = np.zeros(len(self.users) * width, np.float32)
        # User by user is quicker than an array of places as index: 7 µs against 11 µs for 40 users.
        for (place, _), found in zip(moment.users, self._values(moment), strict=True):
            if width == 1:
                values[place] = found
            else:
                values[place * width : (place + 1) * width] = found
        return values

    @abstractmethod
    def _values(self, moment: Moment) -> Iterable[float | Vector | Float64Array]:
        """The numbers of each user that is there, one or three, in the order of ``moment.users``."""


class AngleOfArrival(_PerUser):
    """Azimuth [rad] of the transmitter from the receiver along the straight line, in the receiver's axes:
    what the position of a user tells (the paper, section 4). Shape ``[U]``."""

    bound = math.pi

    def _values(self, moment: Moment) -> Iterable[float | Vector | Float64Array]:
        _, at_rx = directions(moment.scene, [pair for _, pair in moment.users])
        return [math.atan2(y, x) for x, y, _ in at_rx]


class AngleOfDeparture(_PerUser):
    """Azimuth [rad] of the receiver from the transmitter along the straight line, in the transmitter's
    axes. Shape ``[U]``."""

    bound = math.pi

    def _values(self, moment: Moment) -> Iterable[float | Vector | Float64Array]:
        at_tx, _ = directions(moment.scene, [pair for _, pair in moment.users])
        return [math.atan2(y, x) for x, y, _ in at_tx]


class Departure(_PerUser):
    """Direction of the receiver from the transmitter along the straight line, a unit vector in the
    transmitter's axes, place by place. Beams of a row of elements are evenly spaced over its y. Shape
    ``[3·U]``."""

    width = 3
    bound = 1.0

    def _values(self, moment: Moment) -> Iterable[float | Vector | Float64Array]:
        at_tx, _ = directions(moment.scene, [pair for _, pair in moment.users])
        return [_within_one(direction) for direction in at_tx]


def _within_one(direction: Vector) -> Vector:
    # The length of a unit vector is 1 but for rounding, and a box has no room for more.
    x, y, z = (min(1.0, max(-1.0, value)) for value in direction)
    return x, y, z


class Position(_PerUser):
    """Position [m] of the receiver in the world, x, y, z place by place. Shape ``[3·U]``."""

    width = 3

    def _values(self, moment: Moment) -> Iterable[float | Vector | Float64Array]:
        return [device_pose(moment.scene, pair.rx).position for _, pair in moment.users]


class Velocity(_PerUser):
    """Velocity [m/s] of the receiver in world axes, place by place. Shape ``[3·U]``."""

    width = 3

    def _values(self, moment: Moment) -> Iterable[float | Vector | Float64Array]:
        return [device_velocity(moment.scene, pair.rx) for _, pair in moment.users]


class _OfLink(Part):
    """A number for each place out of the link of the frame before; 0 in frame 0 and for an empty place."""

    low: ClassVar[float] = 0.0
    high: ClassVar[float] = FAR
    _known: tuple[Any, Any, Any] | None = None  # what `_taken` was found for
    _taken: Sequence[tuple[int, Pair, Sequence[int]]] = ()

    @property
    def bounds(self) -> Bounds:
        return Bounds(self.low, self.high, (len(self.users),), np.float32)

    def read(self, moment: Moment) -> NDArray[np.float32]:
        link = moment.link
        if link is None:
            return np.zeros(len(self.users), np.float32)
        known = (link.tx, link.rx, moment.users)
        if known != self._known:
            self._known, self._taken = known, _taken_places(*known)
        values = np.zeros((*link.abs_y.shape[:-1], len(self.users)), np.float32)
        for place, pair, users in self._taken:
            # A bound that a number exceeds is far beyond what a policy tells apart.
            values[..., place] = np.minimum(
                self._together([self._of_user(link, u, pair) for u in users]), self.high
            )
        return values

    @abstractmethod
    def _of_user(self, link: LinkFigures, user: int, pair: Pair) -> Float64Array:
        """The number of one user, Shape ``[...]`` as the link has beside its users."""

    def _together(self, numbers: Sequence[Float64Array]) -> Float64Array:
        """What the numbers of a pair's carriers make: their mean."""
        # One after the other, so that a mean does not depend on how many are worked out at once.
        return reduce(add, numbers) / len(numbers)


def _taken_places(
    tx: Sequence[str], rx: Sequence[str], present: Sequence[tuple[int, Pair]]
) -> list[tuple[int, Pair, list[int]]]:
    """The places that are taken: pair, and its users in the link, one a carrier."""
    of_pair: dict[tuple[str, str], list[int]] = {}
    for index, names in enumerate(zip(tx, rx, strict=True)):
        of_pair.setdefault(names, []).append(index)
    # A pair that came in this frame has no link yet.
    taken = ((place, pair, of_pair.get((pair.tx.name, pair.rx.name), [])) for place, pair in present)
    return [entry for entry in taken if entry[2]]


class LastMagnitude(_OfLink):
    """|y| of the frame before, the mean over carriers; 0 in frame 0. Shape ``[U]``."""

    low = -FAR  # as it was: a trained policy is tied to its bounds

    def _of_user(self, link: LinkFigures, user: int, pair: Pair) -> Float64Array:
        return link.abs_y[..., user]


class LastRate(_OfLink):
    """Spectral efficiency [bit/s/Hz] of the beams of the frame before, the mean over carriers: what a
    receiver feeds back. 0 in frame 0. Shape ``[U]``."""

    def _of_user(self, link: LinkFigures, user: int, pair: Pair) -> Float64Array:
        return link.spectral_efficiency[..., user]


class LastBeam(_OfLink):
    """The pair of beams of the frame before, by its index ``i = tx_beam·Nr + rx_beam`` as
    ``(i + 1) / (Nt·Nr)``; 0 in frame 0 and where none was chosen. Shape ``[U]``."""

    high = 1.0

    def _of_user(self, link: LinkFigures, user: int, pair: Pair) -> Float64Array:
        tx_beam, receive = link.tx_beam[..., user], pair.rx.array.size
        share = (tx_beam * receive + link.rx_beam[..., user] + 1) / (pair.tx.array.size * receive)
        return np.where(tx_beam < 0, 0.0, share)


def require_packets(scenario: KnownScenario, what: str) -> None:
    """Raise `ScenarioError` for a scenario whose links are known to send no packets.

    Args:
        scenario: Has the links.
        what: Needs packets, for the error.
    """
    links = {name: spec.use for name, spec in scenario.services.items() if spec.role == "link"}
    if links and all(use == "beams" for use in links.values()):
        raise ScenarioError(
            f"{what} is of packets, and link {next(iter(links))!r} is 'beams', which sends none; "
            'write use = "cell" and its traffic'
        )


class _OfPackets(_OfLink):
    """A number of the packets of each place; 0 with a transmitter that does not serve the receiver."""

    field: ClassVar[str]
    """Of `Link`."""
    unit: ClassVar[float] = 1.0
    """What 1 is, in the unit of the field."""

    def __init__(self, scenario: KnownScenario, users: Users, sensor: str) -> None:
        super().__init__(scenario, users, sensor)
        require_packets(scenario, f"observation {self.field!r}")

    def _of_user(self, link: LinkFigures, user: int, pair: Pair) -> Float64Array:
        figure = getattr(link, self.field, None)
        if figure is None:
            raise ScenarioError(
                f"observation {self.field!r} is of packets, and the link of the run sends none"
            )
        found: Float64Array = figure[..., user] / self.unit
        return found

    def _together(self, numbers: Sequence[Float64Array]) -> Float64Array:
        return reduce(add, numbers)


class Buffered(_OfPackets):
    """What waits in the buffer after the frame before [Mbit], all carriers together; 0 in frame 0. Shape
    ``[U]``."""

    field, unit = "buffered", 1e6


class Waiting(_OfPackets):
    """Age of the oldest packet that waits after the frame before [s], on any carrier; 0 in frame 0. Shape
    ``[U]``."""

    field = "waiting"

    def _together(self, numbers: Sequence[Float64Array]) -> Float64Array:
        return reduce(np.maximum, numbers)


class LastThroughput(_OfPackets):
    """What came through in the frame before [Mbit/s], on all carriers together; 0 in frame 0. Shape
    ``[U]``."""

    field, unit = "throughput", 1e6


class LidarGrid(Part):
    """Occupancy grid of a LIDAR: 0 free, 1 obstacle, −1 TX, −2 RX. Shape ``[X, Y, Z]``."""

    inputs = (Input(topic="lidar", parts=("grid",)),)
    needs_sensor = "lidar"

    def __init__(self, scenario: KnownScenario, users: Users, sensor: str) -> None:
        super().__init__(scenario, users, sensor)
        self._shape = _grid_shape(scenario)

    @property
    def bounds(self) -> Bounds:
        return Bounds(-2, 1, self._shape, np.int8)

    def read(self, moment: Moment) -> NDArray[np.int8] | None:
        for lidar in moment.frame.payloads("lidar", Lidar).values():
            for scan in lidar.scans:
                if _spec_name(scan.sensor) == self.sensor and scan.grid is not None:
                    return scan.grid.occupancy
        return None


class DepthImage(Part):
    """Depth image [m] of a camera; 0: nothing is hit. Shape ``[H, W]``."""

    inputs = (Input(topic="depth"),)
    needs_sensor = "camera"

    def __init__(self, scenario: KnownScenario, users: Users, sensor: str) -> None:
        super().__init__(scenario, users, sensor)
        width, height = next(d.size_px for d in scenario.devices if d.name == sensor)
        self._shape = (height, width)

    @property
    def bounds(self) -> Bounds:
        return Bounds(0, FAR, self._shape, np.float32)

    def read(self, moment: Moment) -> NDArray[np.float32] | None:
        for depth in moment.frame.payloads("depth", Depth).values():
            for image in depth.images:
                if _spec_name(image.sensor) == self.sensor:
                    return image.depth
        return None


class CameraImage(DepthImage):
    """RGB image of a camera. Shape ``[H, W, 3]``."""

    inputs = (Input(topic="camera"),)

    @property
    def bounds(self) -> Bounds:
        return Bounds(0, 255, (*self._shape, 3), np.uint8)

    def read(self, moment: Moment) -> NDArray[Any] | None:
        for camera in moment.frame.payloads("camera", Camera).values():
            for image in camera.images:
                if _spec_name(image.sensor) == self.sensor:
                    return image.rgb
        return None


PARTS: Mapping[str, Callable[[KnownScenario, Users, str], Part]] = {
    "aoa": AngleOfArrival,
    "aod": AngleOfDeparture,
    "departure": Departure,
    "position": Position,
    "velocity": Velocity,
    "last_abs_y": LastMagnitude,
    "last_rate": LastRate,
    "last_beam": LastBeam,
    "last_throughput": LastThroughput,
    "buffered": Buffered,
    "waiting": Waiting,
    "lidar_grid": LidarGrid,
    "depth": DepthImage,
    "camera": CameraImage,
}
"""Parts by name. One of a sensor may name it after a colon: ``camera:dash``."""


def is_feedback(name: str) -> bool:
    """Whether a part is read from the link of the frame before alone, and from nothing of the scene.

    Args:
        name: Of the part, as in `PARTS`.

    Example:
        >>> is_feedback("last_beam"), is_feedback("position")
        (True, False)
    """
    cls = PARTS.get(name.partition(":")[0])
    return isinstance(cls, type) and issubclass(cls, _OfLink)


def part(scenario: KnownScenario, users: Users, name: str) -> Part:
    """Make a part of the observation.

    Args:
        scenario: Has the devices.
        users: The places.
        name: Of the part, as in `PARTS`; of a sensor's, the sensor may stand after a colon.

    Raises:
        ScenarioError: The part does not exist, or its sensor does not; the text has those there are.
    """
    kind, _, sensor = name.partition(":")
    cls: Any = PARTS.get(kind)
    if cls is None:
        near = get_close_matches(kind, PARTS, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ScenarioError(f"no observation is called {name!r}; {hint}there are: {', '.join(PARTS)}")
    device = cls.needs_sensor
    if not device:
        if sensor:
            raise ScenarioError(f"{name!r}: {kind!r} is not of a sensor; write {kind!r}")
        return cls(scenario, users, "")  # type: ignore[no-any-return]  # a subclass of Part
    names = [d.name for d in scenario.devices if d.kind == device]
    if not sensor and len(names) == 1:
        sensor = names[0]
    if sensor not in names:
        there = (
            ", ".join(f"{kind}:{n}" for n in names)
            or f"none, as the scenario has no device of kind {device!r}"
        )
        raise ScenarioError(f"observation {name!r} names no {device} of the scenario; there are: {there}")
    return cls(scenario, users, sensor)  # type: ignore[no-any-return]  # a subclass of Part


class Observer:
    """Reads some parts of the observation in every frame.

    Args:
        scenario: Has the devices.
        users: The places.
        names: Of the parts, as in `PARTS`.

    Raises:
        ScenarioError: A part does not exist, or its sensor does not; the text has those there are.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> scenario = load_scenario("geometric")
        >>> observer = Observer(scenario, Users(scenario, ("*",)), ("aoa", "last_abs_y"))
        >>> {name: bounds.shape for name, bounds in observer.bounds.items()}
        {'aoa': (1,), 'last_abs_y': (1,)}
    """

    def __init__(self, scenario: KnownScenario, users: Users, names: Iterable[str]) -> None:
        self._parts: dict[str, Part] = {name: part(scenario, users, name) for name in names}
        self.bounds: Mapping[str, Bounds] = {name: found.bounds for name, found in self._parts.items()}
        """Of each part, by name."""
        self._blank = {name: np.zeros(of.shape, of.dtype) for name, of in self.bounds.items()}

    @property
    def inputs(self) -> tuple[Input, ...]:
        """What the parts need beside the scene and the link of the frame before, one input for each topic."""
        return tuple({i.topic: i for found in self._parts.values() for i in found.inputs}.values())

    def read(self, moment: Moment) -> dict[str, NDArray[Any]]:
        """Read all parts at a frame; zeros stand for what is not known.

        Args:
            moment: What is known at the frame.
        """
        found = {}
        for name, of in self._parts.items():
            value = of.read(moment)
            # A copy: learners keep observations, and some write into them.
            found[name] = self._blank[name].copy() if value is None else value
        return found


def _grid_shape(scenario: KnownScenario) -> tuple[int, int, int]:
    """Shape of the grid as the LIDAR's settings have it, before there is a scan."""
    for spec in scenario.services.values():
        grid = spec.settings.get("grid") if spec.role == "sensors" else None
        if grid is None:
            continue
        # A grid has cells, or a box and the size of a cell, which the last cell may exceed.
        if "cells" in grid:
            x, y, z = grid["cells"]
            return int(x), int(y), int(z)
        extents = zip(grid["minimum_m"], grid["maximum_m"], grid["cell_m"], strict=True)
        x, y, z = (max(1, math.ceil((high - low) / edge - 1e-9)) for low, high, edge in extents)
        return x, y, z
    raise ScenarioError("observation 'lidar_grid' needs [services.<lidar>.settings.grid] in the scenario")
