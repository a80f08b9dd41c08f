"""Manoeuvres of a vehicle, as AirSim's motion calls ask for them: a command a frame, until one is done.

A manoeuvre sees where the vehicle is in a frame, and answers with a command of the protocol, which holds
until the next frame. All is in ENU; time is simulated. A manoeuvre that is done goes on commanding: the
vehicle stays where it is until another one follows.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import NamedTuple

from caviar_protocol.space.coordinates import Vector
from caviar_protocol.topics import VelocityCommand, WaypointCommand

STILL_M_S = 0.05
"""[m/s] below which a vehicle counts as standing still."""
ARRIVED_M_S = 0.5
"""[m/s] below which a vehicle that is near its target has arrived."""
STUCK_NS = 10_000_000_000
"""[ns] that a vehicle may stand still on its way; then something is in the way, and the manoeuvre fails."""
LANDED_NS = 500_000_000
"""[ns] without sinking after which a vehicle that descends has landed."""
SINKS_M = 0.01
"""[m] by which it has to get lower to count as sinking."""
LANDED_FRAMES = 2
Command = WaypointCommand | VelocityCommand


class Flown(NamedTuple):
    """A vehicle in a frame."""

    t_ns: int
    """Simulated time [ns]."""
    position: Vector
    """[m]"""
    velocity: Vector
    """[m/s]"""
    yaw: float
    """Counter-clockwise from east [rad]."""


def deadline(now_ns: int, timeout_s: float) -> float:
    """End of a time that begins now [ns]; of AirSim's 3·10³⁸ s, never."""
    return now_ns + timeout_s * 1e9 if timeout_s < 1e9 else math.inf


class Heading(NamedTuple):
    """Heading of a vehicle while it moves; with neither field, that of its motion."""

    yaw: float | None = None
    """Counter-clockwise from east [rad]."""
    rate: float | None = None
    """Counter-clockwise [rad/s]."""


ALONG = Heading()


class Manoeuvre(ABC):
    """One motion call. In every frame the vehicle is looked at, and then commanded until the next one.

    Args:
        name: Of the object that is flown.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.result: bool | None = None
        """What the call returns once it is done; None: it is under way."""
        self._begun = False

    def look(self, now: Flown) -> None:
        """Judge whether the manoeuvre is done, once it has begun.

        Args:
            now: The vehicle in this frame.
        """
        if self._begun and self.result is None:
            self.result = self.judge(now)

    def fly(self, now: Flown) -> Command:
        """Command the vehicle until the next frame; the first command begins the manoeuvre.

        Args:
            now: The vehicle in this frame.
        """
        if not self._begun:
            self._begun = True
            self.begin(now)
        return self.command(now) if self.result is None else self.rest(now)

    @abstractmethod
    def begin(self, now: Flown) -> None:
        """Note place and time of the beginning."""

    @abstractmethod
    def judge(self, now: Flown) -> bool | None:
        """Success or failure; None: neither yet."""

    @abstractmethod
    def command(self, now: Flown) -> Command:
        """Command until the next frame."""

    def rest(self, now: Flown) -> Command:
        """Command once the manoeuvre is done: brake, and stay."""
        return VelocityCommand(object=self.name, velocity=(0.0, 0.0, 0.0))


class Hover(Manoeuvre):
    """Brake, and stay; done when the vehicle stands still."""

    def begin(self, now: Flown) -> None:
        """See `Manoeuvre`."""

    def judge(self, now: Flown) -> bool | None:
        """See `Manoeuvre`."""
        return True if math.hypot(*now.velocity) <= STILL_M_S else None

    def command(self, now: Flown) -> Command:
        """See `Manoeuvre`."""
        return self.rest(now)


class FlyPath(Manoeuvre):
    """Fly to points, one after the other; done at the last one, at rest.

    Args:
        name: Of the object that is flown.
        points: At least one [m].
        speed: At most [m/s].
        reach: So near a point counts as reached [m].
        timeout_s: Simulated time in which the last one has to be reached [s].
        yaw: Heading on the way; None: along it.

    Example:
        >>> path = FlyPath("uav", [(0.0, 0.0, 5.0), (9.0, 0.0, 5.0)], speed=3.0, reach=0.5)
        >>> path.fly(Flown(0, (0.0, 0.0, 4.8), (0.0, 0.0, 0.1), 0.0)).position
        (9.0, 0.0, 5.0)
    """

    def __init__(
        self,
        name: str,
        points: Sequence[Vector],
        speed: float,
        reach: float,
        timeout_s: float = math.inf,
        yaw: float | None = None,
    ) -> None:
        super().__init__(name)
        self._yaw = yaw
        self._points, self._speed, self._reach, self._timeout_s = list(points), speed, reach, timeout_s
        self._until = math.inf
        self._moved_ns = 0

    def begin(self, now: Flown) -> None:
        """See `Manoeuvre`."""
        self._moved_ns, self._until = now.t_ns, deadline(now.t_ns, self._timeout_s)
        self._drop_reached(now)

    def judge(self, now: Flown) -> bool | None:
        """See `Manoeuvre`."""
        self._drop_reached(now)
        speed = math.hypot(*now.velocity)
        if speed > STILL_M_S:
            self._moved_ns = now.t_ns
        near = len(self._points) == 1 and math.dist(now.position, self._points[0]) <= self._reach
        if near and speed <= ARRIVED_M_S:
            return True
        return False if now.t_ns >= self._until or now.t_ns - self._moved_ns >= STUCK_NS else None

    def command(self, now: Flown) -> Command:
        """See `Manoeuvre`."""
        return WaypointCommand(object=self.name, position=self._points[0], speed=self._speed, yaw=self._yaw)

    def rest(self, now: Flown) -> Command:
        """Stay at the last point, or where it failed."""
        return self.command(now) if self.result else super().rest(now)

    def _drop_reached(self, now: Flown) -> None:
        while len(self._points) > 1 and math.dist(now.position, self._points[0]) <= self._reach:
            del self._points[0]


class FlyVelocity(Manoeuvre):
    """Keep a velocity for a time, then brake.

    Args:
        name: Of the object that is flown.
        velocity: [m/s]
        duration_s: Simulated time [s]; the vehicle brakes in the first frame at its end.
        height: Height to be kept or reached instead of the vertical velocity [m].
        climb: Vertical speed at most, on the way to it [m/s].
        heading: Meanwhile.
    """

    def __init__(
        self,
        name: str,
        velocity: Vector,
        duration_s: float,
        height: float | None = None,
        climb: float = 0.0,
        heading: Heading = ALONG,
    ) -> None:
        super().__init__(name)
        self._heading = heading
        self._velocity, self._duration_s = velocity, duration_s
        self._height, self._climb = height, climb
        self._until = math.inf

    def begin(self, now: Flown) -> None:
        """See `Manoeuvre`."""
        self._until = deadline(now.t_ns, self._duration_s)

    def judge(self, now: Flown) -> bool | None:
        """See `Manoeuvre`."""
        return True if now.t_ns >= self._until else None

    def command(self, now: Flown) -> Command:
        """See `Manoeuvre`."""
        x, y, z = self._velocity
        if self._height is not None:
            # A time constant of 1 s: limits of acceleration make it overshoot by little.
            z = max(-self._climb, min(self._climb, self._height - now.position[2]))
        yaw, rate = self._heading
        return VelocityCommand(object=self.name, velocity=(x, y, z), yaw=yaw, yaw_rate=rate)


class Land(Manoeuvre):
    """Descend until something bears the vehicle: it does not sink any more.

    Args:
        name: Of the object that is flown.
        speed: [m/s]
        timeout_s: Simulated time in which it has to be down [s].
    """

    def __init__(self, name: str, speed: float, timeout_s: float) -> None:
        super().__init__(name)
        self._speed, self._timeout_s = speed, timeout_s
        self._until = math.inf
        self._lowest = 0.0
        self._since_ns, self._frames = 0, 0

    def begin(self, now: Flown) -> None:
        """See `Manoeuvre`."""
        self._until = deadline(now.t_ns, self._timeout_s)
        self._lowest, self._since_ns = now.position[2], now.t_ns

    def judge(self, now: Flown) -> bool | None:
        """See `Manoeuvre`."""
        self._frames += 1
        if now.position[2] < self._lowest - SINKS_M:
            self._lowest, self._since_ns, self._frames = now.position[2], now.t_ns, 0
        # Frames as well as time: of long frames the first may show a vehicle that has yet to sink.
        if self._frames >= LANDED_FRAMES and now.t_ns - self._since_ns >= LANDED_NS:
            return True
        return False if now.t_ns >= self._until else None

    def command(self, now: Flown) -> Command:
        """See `Manoeuvre`."""
        return VelocityCommand(object=self.name, velocity=(0.0, 0.0, -self._speed))


class Turn(Manoeuvre):
    """Brake, and turn to a yaw.

    Args:
        name: Of the object that is flown.
        yaw: Counter-clockwise from east [rad].
        margin: That is near enough [rad].
        timeout_s: Simulated time in which it has to be done [s].
    """

    def __init__(self, name: str, yaw: float, margin: float, timeout_s: float = math.inf) -> None:
        super().__init__(name)
        self._yaw, self._margin, self._timeout_s = yaw, margin, timeout_s
        self._until = math.inf

    def begin(self, now: Flown) -> None:
        """See `Manoeuvre`."""
        self._until = deadline(now.t_ns, min(self._timeout_s, STUCK_NS / 1e9))

    def judge(self, now: Flown) -> bool | None:
        """See `Manoeuvre`."""
        if abs(math.remainder(self._yaw - now.yaw, math.tau)) <= self._margin:
            return True
        return False if now.t_ns >= self._until else None

    def command(self, now: Flown) -> Command:
        """See `Manoeuvre`."""
        return VelocityCommand(object=self.name, velocity=(0.0, 0.0, 0.0), yaw=self._yaw)
