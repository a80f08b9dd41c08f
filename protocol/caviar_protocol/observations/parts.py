"""Parts of the observation, each a class: angles, positions, the link of the frame before, packets, sensors.

To add one: a subclass of `Part` here, and a line in `OBSERVATION_PARTS`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import reduce
from operator import add
from typing import Any, ClassVar, NamedTuple, Protocol, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import Float64Array, Payload
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.messages import Input
from caviar_protocol.observations.users import KnownScenario, Users, spec_name
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.space.beams import beam_gains
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.space.scene import Pair, device_pose, device_velocity, directions
from caviar_protocol.topics import Camera, Channel, Depth, Lidar, Scene

P = TypeVar("P", bound=Payload)


class ObservedFrame(Protocol):
    """Parts of a frame that are read: `caviar_services.service.Frame` in a run, products of one in a
    recording."""

    def payloads(self, topic: str, cls: type[P]) -> Mapping[str, P]:
        """Payloads of a topic that are present, by source."""


class Bounds(NamedTuple):
    """Bounds, shape and dtype of the values of a part, as a `gymnasium.spaces.Box` takes them."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: Any


class LinkFigures(Protocol):
    """Figures of a link that are read: a `Link`, with one number for each user, or a link of many episodes,
    with a row of users for each of them."""

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
    """Products and users of a frame, from which observations are read."""

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
    per_user: bool = False
    """Whether axis 0 of its values holds the places one after the other; else all users share them."""

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

    per_user = True
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


class OfLink(Part):
    """A number for each place out of the link of the frame before; 0 in frame 0 and for an empty place."""

    per_user = True
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
        """Number of all carriers of a pair: the mean of theirs."""
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


class LastMagnitude(OfLink):
    """|y| of the frame before, the mean over carriers; 0 in frame 0. Shape ``[U]``."""

    low = -FAR  # as it was: a trained policy is tied to its bounds

    def _of_user(self, link: LinkFigures, user: int, pair: Pair) -> Float64Array:
        return link.abs_y[..., user]


class LastRate(OfLink):
    """Spectral efficiency [bit/s/Hz] of the beams of the frame before, the mean over carriers: what a
    receiver feeds back. 0 in frame 0. Shape ``[U]``."""

    def _of_user(self, link: LinkFigures, user: int, pair: Pair) -> Float64Array:
        return link.spectral_efficiency[..., user]


class LastBeam(OfLink):
    """The pair of beams of the frame before, by its index ``i = tx_beam·Nr + rx_beam`` as
    ``(i + 1) / (Nt·Nr)``; 0 in frame 0 and where none was chosen. Shape ``[U]``."""

    high = 1.0

    def _of_user(self, link: LinkFigures, user: int, pair: Pair) -> Float64Array:
        tx_beam, receive = link.tx_beam[..., user], pair.beams[1]
        share = (tx_beam * receive + link.rx_beam[..., user] + 1) / (pair.beams[0] * receive)
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


class _OfPackets(OfLink):
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
    """Bits that wait in the buffer after the frame before [Mbit], all carriers together; 0 in frame 0. Shape
    ``[U]``."""

    field, unit = "buffered", 1e6


class Waiting(_OfPackets):
    """Age of the oldest packet that waits after the frame before [s], on any carrier; 0 in frame 0. Shape
    ``[U]``."""

    field = "waiting"

    def _together(self, numbers: Sequence[Float64Array]) -> Float64Array:
        return reduce(np.maximum, numbers)


class LastThroughput(_OfPackets):
    """Throughput in the frame before [Mbit/s], on all carriers together; 0 in frame 0. Shape
    ``[U]``."""

    field, unit = "throughput", 1e6


class Spectrum(Part):
    """Spatial spectrum of the lowest carrier: |y| of each pair of beams of the codebooks there over the
    greatest, by ``tx_beam·Nr + rx_beam``; zeros without a path. It tells where to look on a carrier that is
    higher, as for the agent ``out-of-band``. Shape ``[U·Nt·Nr]``."""

    inputs = (Input(topic="channel", parts=("h",)),)
    per_user = True

    def __init__(self, scenario: KnownScenario, users: Users, sensor: str) -> None:
        super().__init__(scenario, users, sensor)
        sizes = {place.beams for place in users.places}
        if len(sizes) > 1:
            shown = ", ".join(f"{tx} × {rx}" for tx, rx in sorted(sizes))
            raise ScenarioError(f"observation 'spectrum' is of users with the same codebooks, not of {shown}")
        self._pairs = users.places[0].beam_pairs

    @property
    def bounds(self) -> Bounds:
        return Bounds(0, 1, (len(self.users) * self._pairs,), np.float32)

    def read(self, moment: Moment) -> NDArray[np.float32]:
        values = np.zeros((len(self.users), self._pairs), np.float32)
        for channel in moment.frame.payloads("channel", Channel).values():
            frequencies = [carrier.frequency_hz for carrier in channel.carriers]
            lowest = frequencies.index(min(frequencies))
            h = {(channel.tx[m.tx], channel.rx[m.rx]): m.h for m in channel.h if m.carrier == lowest}
            for place, pair in moment.users:
                if (matrix := h.get((pair.tx.name, pair.rx.name))) is not None:
                    gains = beam_gains(matrix, pair.tx.array, pair.rx.array).reshape(-1)
                    if (most := gains.max()) > 0:
                        values[place] = gains / most
        return values.reshape(-1)


class _OfSensor(Part):
    """Product of one sensor; of a sensor that is on several objects, that of each user's object, and
    zeros for a user without."""

    def __init__(self, scenario: KnownScenario, users: Users, sensor: str) -> None:
        super().__init__(scenario, users, sensor)
        spec = next(d for d in scenario.devices if d.name == sensor)
        self.per_user = spec.count > 1
        if self.per_user and not users.on_objects_of(spec):
            raise ScenarioError(
                f"{spec.kind} {sensor!r} is on up to {spec.count} objects {spec.on!r}, of which none carries "
                f"a receiver that is served: {', '.join(users.receivers)}; observe one that is on one object"
            )
        self._one = self._bounds_of_one(scenario, spec)

    @property
    def bounds(self) -> Bounds:
        shape = self._one.shape
        return self._one._replace(shape=(len(self.users), *shape)) if self.per_user else self._one

    def read(self, moment: Moment) -> NDArray[Any] | None:
        seen = {name: value for name, value in self._seen(moment) if spec_name(name) == self.sensor}
        for name, value in seen.items():
            if value.shape != self._one.shape:
                raise PayloadError(
                    f"{name} shows {list(value.shape)}, and the policy observes {list(self._one.shape)}; use "
                    "the grid, or the size of the picture, that it was trained with"
                )
        if not self.per_user:
            return next(iter(seen.values()), None)
        found = np.zeros(self.bounds.shape, self._one.dtype)
        for place, pair in moment.users:
            if (own := f"{pair.rx.parent}/{self.sensor}") in seen:
                found[place] = seen[own]
        return found

    @abstractmethod
    def _bounds_of_one(self, scenario: KnownScenario, spec: DeviceSpec) -> Bounds:
        """Bounds of what one sensor sees."""

    @abstractmethod
    def _seen(self, moment: Moment) -> Iterator[tuple[str, NDArray[Any]]]:
        """Names of the sensors of a frame, and what they see."""


class LidarGrid(_OfSensor):
    """Occupancy grid of a LIDAR: 0 free, 1 obstacle, −1 TX, −2 RX. Shape ``[X, Y, Z]``; of a LIDAR on several
    objects ``[U, X, Y, Z]``, each user's own."""

    inputs = (Input(topic="lidar", parts=("grid",)),)
    needs_sensor = "lidar"

    def _bounds_of_one(self, scenario: KnownScenario, spec: DeviceSpec) -> Bounds:
        return Bounds(-2, 1, _grid_shape(scenario), np.int8)

    def _seen(self, moment: Moment) -> Iterator[tuple[str, NDArray[Any]]]:
        for lidar in moment.frame.payloads("lidar", Lidar).values():
            yield from ((s.sensor, s.grid.occupancy) for s in lidar.scans if s.grid is not None)


class DepthImage(_OfSensor):
    """Depth image [m] of a camera; 0: nothing is hit. Shape ``[H, W]``; of a camera on several objects
    ``[U, H, W]``, each user's own."""

    inputs = (Input(topic="depth"),)
    needs_sensor = "camera"

    def _bounds_of_one(self, scenario: KnownScenario, spec: DeviceSpec) -> Bounds:
        width, height = spec.size_px
        return Bounds(0, FAR, (height, width), np.float32)

    def _seen(self, moment: Moment) -> Iterator[tuple[str, NDArray[Any]]]:
        for depth in moment.frame.payloads("depth", Depth).values():
            yield from ((image.sensor, image.depth) for image in depth.images)


class CameraImage(_OfSensor):
    """RGB image of a camera. Shape ``[H, W, 3]``; of a camera on several objects ``[U, H, W, 3]``, each
    user's own."""

    inputs = (Input(topic="camera"),)
    needs_sensor = "camera"

    def _bounds_of_one(self, scenario: KnownScenario, spec: DeviceSpec) -> Bounds:
        width, height = spec.size_px
        return Bounds(0, 255, (height, width, 3), np.uint8)

    def _seen(self, moment: Moment) -> Iterator[tuple[str, NDArray[Any]]]:
        for camera in moment.frame.payloads("camera", Camera).values():
            yield from ((image.sensor, image.rgb) for image in camera.images)


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


OBSERVATION_PARTS: Mapping[str, type[Part]] = {
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
    "spectrum": Spectrum,
    "lidar_grid": LidarGrid,
    "depth": DepthImage,
    "camera": CameraImage,
}
"""Parts by name. One of a sensor may name it after a colon: ``camera:dash``."""
