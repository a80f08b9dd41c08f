"""One flown object: a point with bounded speed and acceleration that keeps clear of obstacles.

Time is cut into sub-steps of one length, counted from the instant at which the command last
changed, so that it makes no difference how a flight is cut into frames. In a sub-step the velocity
goes straight to a set-point with the greatest acceleration, and stays there. A sub-step is taken
where the way through it and to a stop after it is free. Otherwise the part of the set-point that
leads into what is in the way is taken off; at last the object brakes, the way for which was found
free before. So speed, acceleration and clearance hold at once, at any speed.

Commands of agents for flown objects, in the terms of what flies them: points and quadrotors.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from itertools import chain
from typing import Annotated, NamedTuple

import msgspec

from caviar_protocol.arrays import MAX_COORDINATE_M
from caviar_protocol.errors import PayloadError
from caviar_protocol.scene_validation import UNIT_TOLERANCE
from caviar_protocol.space.coordinates import Vector, dot
from caviar_protocol.topics import AttitudeCommand, PathCommand, VelocityCommand, WaypointCommand
from caviar_protocol.topics.link import MotionCommand
from caviar_services.world.base import course_rate
from caviar_services.world.quadrotor.control import Order
from caviar_space.obstacles import Obstacles

SUB_STEP_NS = 10_000_000
"""[ns]"""

LIMITED_SPEED = "limited-speed"
"""The command asked for more than the greatest speed."""

STOPPED_BY_OBSTACLE = "stopped-by-obstacle"
"""Scenery was in the way, and there was no way along it."""

SLID_ALONG_OBSTACLE = "slid-along-obstacle"
"""Scenery was in the way; the motion went on along its surface."""

STOPPED_BY_GEOFENCE = "stopped-by-geofence"
"""A bound of the permitted box, or the ground, was in the way."""

# Horizontal speed [m/s] below which an object keeps its yaw.
_HOVERING = 0.05

# Greatest rate [rad/s] of a heading that is commanded; along its course an object turns at once.
_TURNING = math.radians(120.0)

# Share of the speed below which what is left along a surface counts as none.
_STANDSTILL = 0.01

# [m] from its target at which an object is there.
_ARRIVED = 1e-6

# Sub-steps that are looked at together at most, while nothing is in the way.
_AT_ONCE = 8

# Planes that a set-point is bent along at once; where three meet the object brakes.
_CONTACTS = 3

# Share of the greatest speed by which a command that is scaled to it may miss it.
_ROUNDING = 1e-12

_H = SUB_STEP_NS / 1e9
_REST: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What an object may do.

    Example:
        >>> Limits(speed=10.0, acceleration=8.0, clearance=1.0, low=(-9.0,) * 3, high=(9.0,) * 3).kept
        1.0001
    """

    speed: float
    """Greatest speed [m/s]."""
    acceleration: float
    """Greatest acceleration [m/s²]."""
    clearance: float
    """Least distance from obstacles [m]."""
    low: Vector
    high: Vector
    """Corners of the permitted box [m]."""

    @property
    def kept(self) -> float:
        """``clearance``, and what a path bends away from its chord in a sub-step: a·h²/8 [m]."""
        return self.clearance + self.acceleration * _H**2 / 8

    def excess(self, place: Vector) -> float:
        """How far a place is beyond the bound that it exceeds most [m]; 0 and less: it is inside.

        Args:
            place: [m]
        """
        return max(max(low - at, at - high) for low, at, high in zip(self.low, place, self.high, strict=True))


class Motion(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Commanded motion: a velocity, or a target and the speed with which to go there.

    Example:
        >>> Motion(target=(10.0, 0.0, 30.0), speed=5.0).velocity
        (0.0, 0.0, 0.0)
    """

    velocity: Vector = (0.0, 0.0, 0.0)
    """[m/s]; without effect where there is a target."""
    target: Vector | None = None
    """[m]"""
    speed: float = 0.0
    """On the way to the target [m/s]."""
    at_once: bool = False
    """Whether it is put there before it moves."""
    yaw: float | None = None
    """Heading to turn to [rad]; None: that of ``yaw_rate``, and without it along the course."""
    yaw_rate: float | None = None
    """[rad/s]"""


_HOVER = Motion()


class _Piece(NamedTuple):
    """A sub-step: constant acceleration for ``ramp`` [s], then the constant velocity ``after``."""

    position: Vector
    velocity: Vector
    acceleration: Vector
    ramp: float
    after: Vector
    event: str = ""
    """What limited it."""

    def at(self, t: float) -> tuple[Vector, Vector]:
        """Position [m] and velocity [m/s] after a time [s]."""
        u = min(t, self.ramp)
        position = _sum(_sum(self.position, self.velocity, u), self.acceleration, 0.5 * u * u)
        if t < self.ramp:
            return position, _sum(self.velocity, self.acceleration, u)
        return _sum(position, self.after, t - self.ramp), self.after

    def acceleration_at(self, t: float) -> Vector:
        """[m/s²] up to a time [s]."""
        return self.acceleration if t <= self.ramp else _REST


class FlyerState(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """All that the further way of a `Flyer` follows from, beside commands and obstacles."""

    position: Vector = (0.0, 0.0, 0.0)
    """[m]"""
    velocity: Vector = _REST
    """[m/s]"""
    yaw: float = 0.0
    """[rad], counter-clockwise from +x."""
    motion: Motion = _HOVER
    """The command that it obeys."""
    begin: tuple[Vector, Vector] = ((0.0, 0.0, 0.0), _REST)
    """Position and velocity at the beginning of the sub-step under way."""
    begin_yaw: float = 0.0
    into_ns: Annotated[int, msgspec.Meta(ge=0, lt=SUB_STEP_NS)] = 0
    """How far into it."""
    pieces: list[_Piece] = []
    """It and those looked at after it."""
    at_once: Annotated[int, msgspec.Meta(ge=1, le=_AT_ONCE)] = _AT_ONCE
    """How many sub-steps are looked at together next."""
    yaw_rate: float = 0.0
    """[rad/s]"""

    def restart(self) -> None:
        """Count sub-steps from here on."""
        self.begin, self.begin_yaw = (self.position, self.velocity), self.yaw
        self.into_ns, self.pieces, self.at_once = 0, [], _AT_ONCE


class Flyer:
    """Moves one object, sub-step by sub-step.

    Args:
        limits: What the object may do.

    Example:
        >>> limits = Limits(speed=5.0, acceleration=2.0, clearance=1.0, low=(-9.0,) * 3, high=(9.0,) * 3)
        >>> flyer = Flyer(limits)
        >>> flyer.fly(Motion(velocity=(1.0, 0.0, 0.0)), 1_000_000_000)  # half a second to speed up
        Counter()
        >>> round(flyer.state.position[0], 6), flyer.state.velocity
        (0.75, (1.0, 0.0, 0.0))
    """

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.obstacles = Obstacles.none()
        self.state = FlyerState()

    def reset(self, position: Vector, yaw: float) -> None:
        """Put the object at rest.

        Args:
            position: Its centre [m].
            yaw: Counter-clockwise from +x [rad].
        """
        self.state = FlyerState(position=position, yaw=yaw)
        self.state.restart()

    def fly(self, motion: Motion | None, length_ns: int) -> Counter[str]:
        """Move for a time.

        Args:
            motion: What is commanded; None: brake and hover.
            length_ns: The time [ns].

        Returns:
            What limited the motion, each at most once.
        """
        state, events = self.state, set[str]()
        wanted = motion or _HOVER
        asked = math.hypot(*wanted.velocity) if wanted.target is None else wanted.speed
        # Counted, not refused: an agent that learns may ask for anything, and sees what came of it.
        if asked > self.limits.speed * (1 + _ROUNDING):
            events.add(LIMITED_SPEED)
        # The same command again, as agents send it in each frame, does not restart the count: so it makes no
        # difference how a flight is cut into frames.
        if wanted != state.motion:
            state.motion = wanted
            state.restart()
        state.into_ns += length_ns
        acceleration, turning = _REST, 0.0
        while state.into_ns >= SUB_STEP_NS:
            events.add(self._next().event)
            piece = state.pieces.pop(0)
            state.begin, acceleration = piece.at(_H), piece.acceleration_at(_H)
            state.begin_yaw, turning = self._heading(state.begin[1], state.begin_yaw, SUB_STEP_NS)
            state.into_ns -= SUB_STEP_NS
        state.position, state.velocity = state.begin
        if state.into_ns:
            events.add(self._next().event)
            state.position, state.velocity = self._next().at(state.into_ns / 1e9)
            acceleration = self._next().acceleration_at(state.into_ns / 1e9)
            state.yaw, turning = self._heading(state.velocity, state.begin_yaw, state.into_ns)
        else:
            state.yaw = state.begin_yaw
        if wanted.yaw is None and wanted.yaw_rate is None:
            is_on_course = math.hypot(*state.velocity[:2]) > _HOVERING
            turning = course_rate(state.velocity, acceleration) if is_on_course else 0.0
        state.yaw_rate = turning
        return Counter(events - {""})

    def _heading(self, velocity: Vector, yaw: float, length_ns: int) -> tuple[float, float]:
        """Yaw [rad] at the end of a time, and the rate of a commanded one [rad/s].

        Args:
            velocity: At the end [m/s].
            yaw: At the beginning [rad].
            length_ns: The time [ns].
        """
        motion, seconds = self.state.motion, length_ns / 1e9
        if motion.yaw is not None:
            left = math.remainder(motion.yaw - yaw, math.tau)
            if abs(left) <= _TURNING * seconds:
                return motion.yaw, 0.0
            rate = math.copysign(_TURNING, left)
        elif motion.yaw_rate is not None:
            rate = max(-_TURNING, min(_TURNING, motion.yaw_rate))
        else:
            vx, vy, _ = velocity
            return (math.atan2(vy, vx) if math.hypot(vx, vy) > _HOVERING else yaw), 0.0
        return math.remainder(yaw + rate * seconds, math.tau), rate

    def _next(self) -> _Piece:
        """The sub-step under way."""
        state = self.state
        if not state.pieces:
            # Looking at several at once is one question to the obstacles. Beside a wall mostly the answer is
            # no: then one is looked at, and twice as many each time that nothing is in the way.
            found = self._several()
            state.at_once = min(2 * state.at_once, _AT_ONCE) if found else 1
            state.pieces = found or [self._one()]
        return state.pieces[0]

    def _several(self) -> list[_Piece]:
        """The next sub-steps, if nothing is in their way."""
        at, pieces, places = self.state.begin, list[_Piece](), list[Vector]()
        for _ in range(self.state.at_once):
            wish = self._desired(*at)
            if wish == at[1] == _REST:
                if not pieces:
                    return [_Piece(at[0], _REST, _REST, 0.0, _REST)]
                break
            pieces.append(self._towards(*at, wish))
            at = pieces[-1].at(_H)
            # To the end of each, and to a stop after it: braking there was free, so it can be done any time.
            places += [at[0], self._stop(*at)]
        return [] if self._in_the_way(places)[1] else pieces

    def _one(self) -> _Piece:
        """The next sub-step, along what is in the way, or braking."""
        wish = self._desired(*self.state.begin)
        planes: list[Vector] = []
        event = ""
        for _ in range(_CONTACTS):
            bent = _bent(wish, planes)
            piece = self._towards(*self.state.begin, bent)
            end = piece.at(_H)
            plane, found = self._in_the_way([end[0], self._stop(*end)])
            if not found:
                if event == SLID_ALONG_OBSTACLE and math.hypot(*bent) <= _STANDSTILL * math.hypot(*wish):
                    event = STOPPED_BY_OBSTACLE
                return piece._replace(event=event)
            event = found
            planes.append(plane)
        stopped = STOPPED_BY_OBSTACLE if event == SLID_ALONG_OBSTACLE else event
        return self._towards(*self.state.begin, _REST)._replace(event=stopped)

    def _towards(self, position: Vector, velocity: Vector, after: Vector) -> _Piece:
        """The sub-step in which the velocity goes to ``after``, as far as it gets."""
        change = _sum(after, velocity, -1.0)
        size = math.hypot(*change)
        if size == 0.0:
            return _Piece(position, velocity, _REST, 0.0, after)
        most = self.limits.acceleration
        return _Piece(position, velocity, _scaled(change, most / size), size / most, after)

    def _stop(self, position: Vector, velocity: Vector) -> Vector:
        """Where an object comes to rest that brakes as hard as it can [m]."""
        return _sum(position, velocity, math.hypot(*velocity) / (2 * self.limits.acceleration))

    def _in_the_way(self, places: list[Vector]) -> tuple[Vector, str]:
        """What is in the way of straight lines to and between places: a unit vector away from it,
        and the event that it makes; empty where there is nothing."""
        here = self.state.begin[0]
        for place in places:
            for axis in range(3):
                if place[axis] < self.limits.low[axis] and place[axis] < here[axis]:
                    return _unit(axis, 1.0), STOPPED_BY_GEOFENCE
                if place[axis] > self.limits.high[axis] and place[axis] > here[axis]:
                    return _unit(axis, -1.0), STOPPED_BY_GEOFENCE
        ways = [_sum(place, here, -1.0) for place in places]
        plane = self.obstacles.in_the_way(here, ways, self.limits.kept)
        return (_REST, "") if plane is None else (plane, SLID_ALONG_OBSTACLE)

    def _desired(self, position: Vector, velocity: Vector) -> Vector:
        """Velocity [m/s] to strive for in a sub-step.

        On the way to a target it is the greatest w from which, braking as hard as it can, the object
        comes to rest there after this sub-step of length h. With the speed v towards the target, the
        ramp from v to w and the stop from w are as long as the way d:
        w·h ± (w − v)²/2a + w²/2a = d, with the sign of v − w.
        """
        motion, a = self.state.motion, self.limits.acceleration
        if motion.target is None:
            speed = math.hypot(*motion.velocity)
            return _scaled(motion.velocity, min(1.0, self.limits.speed / speed)) if speed else _REST
        way = _sum(motion.target, position, -1.0)
        d = math.hypot(*way)
        if d < _ARRIVED:
            return _REST
        v = dot(velocity, way) / d
        if d >= v * _H + v * abs(v) / (2 * a):
            slope = _H + v / a
            w = (d + v * v / (2 * a)) / slope if slope > 0.0 else math.inf
        else:
            square = (_H - v / a) ** 2 - (4 / a) * (v * v / (2 * a) - d)
            w = max(0.0, a / 2 * (v / a - _H + math.sqrt(square))) if square > 0.0 else 0.0
        return _scaled(way, min(w, motion.speed, self.limits.speed) / d)


def _bent(wish: Vector, planes: list[Vector]) -> Vector:
    """A velocity without what leads into planes, given by unit vectors away from them."""
    # Of two planes that both are in the way, what is left is the part along their line of intersection.
    if not planes:
        return wish
    found = _sum(wish, planes[-1], -min(dot(wish, planes[-1]), 0.0))
    if len(planes) == 1 or dot(found, planes[0]) >= 0.0:
        return found
    (ax, ay, az), (bx, by, bz) = planes
    crease = (ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)
    square = dot(crease, crease)
    return _scaled(crease, dot(wish, crease) / square) if square > 1e-12 else _REST


def _unit(axis: int, sign: float) -> Vector:
    x, y, z = (sign if axis == i else 0.0 for i in range(3))
    return (x, y, z)


def _sum(a: Vector, b: Vector, factor: float = 1.0) -> Vector:
    return (a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2])


def _scaled(v: Vector, factor: float) -> Vector:
    return (v[0] * factor, v[1] * factor, v[2] * factor)


def motion_of(agent: str, command: MotionCommand) -> Motion:
    """What a point is commanded.

    Args:
        agent: Which commands it.
        command: Its command.

    Raises:
        PayloadError: The command has a number that cannot be, or is none that a point obeys.
    """
    _check_numbers(agent, command)
    if isinstance(command, WaypointCommand):
        return Motion(target=command.position, speed=command.speed, at_once=command.at_once, yaw=command.yaw)
    if isinstance(command, VelocityCommand):
        return Motion(velocity=command.velocity, yaw=command.yaw, yaw_rate=command.yaw_rate)
    raise PayloadError(
        f"agent {agent!r} sends {type(command).__name__} to {command.object!r}, which flies as a point; "
        'write dynamics = "quadrotor" for it, or send waypoints or velocities'
    )


def order_of(agent: str, command: MotionCommand) -> Order:
    """What a quadrotor is commanded.

    Args:
        agent: Which commands it.
        command: Its command.

    Raises:
        PayloadError: The command has a number that cannot be.
    """
    _check_numbers(agent, command)
    if isinstance(command, WaypointCommand):
        return Order(target=command.position, speed=command.speed, yaw=command.yaw)
    if isinstance(command, VelocityCommand):
        return Order(velocity=command.velocity, yaw=command.yaw, yaw_rate=command.yaw_rate)
    if isinstance(command, PathCommand):
        return Order(points=command.points, speed=command.speed)
    norm = math.hypot(*command.orientation)
    if abs(norm - 1.0) > UNIT_TOLERANCE:
        raise PayloadError(
            f"agent {agent!r} commands {command}, whose orientation has norm {norm:.6g}; command a unit "
            "quaternion (w, x, y, z)"
        )
    w, x, y, z = command.orientation
    return Order(orientation=(w / norm, x / norm, y / norm, z / norm), thrust=command.thrust)


def _check_numbers(agent: str, command: MotionCommand) -> None:
    values: tuple[float, ...]
    if isinstance(command, VelocityCommand):
        values = (*command.velocity, command.yaw or 0.0, command.yaw_rate or 0.0)
    elif isinstance(command, AttitudeCommand):
        values = (*command.orientation, command.thrust)
    elif isinstance(command, PathCommand):
        values = (*chain.from_iterable(command.points), command.speed)
    else:
        values = (*command.position, command.speed, command.yaw or 0.0)
    if not all(map(math.isfinite, values)):
        raise PayloadError(f"agent {agent!r} commands {command}, which is not finite; command numbers")
    far = next((place for place in places(command) if max(map(abs, place)) > MAX_COORDINATE_M), None)
    if far is not None:
        raise PayloadError(
            f"agent {agent!r} commands {command.object!r} to {list(far)} m; command places at most "
            f"{MAX_COORDINATE_M:g} m from the origin"
        )


def places(command: MotionCommand) -> tuple[Vector, ...]:
    """Places to which a command leads [m].

    Args:
        command: Any; one for a velocity or an attitude leads to none.

    Example:
        >>> places(WaypointCommand(object="uav", position=(10.0, 0.0, 30.0), speed=5.0))
        ((10.0, 0.0, 30.0),)
    """
    if isinstance(command, WaypointCommand):
        return (command.position,)
    return command.points if isinstance(command, PathCommand) else ()


def place_outside(command: MotionCommand, limits: Limits) -> Vector | None:
    """The first place to which a command leads outside of the bounds [m]; None: there is none.

    Args:
        command: Any.
        limits: Of its object.
    """
    return next((place for place in places(command) if limits.excess(place) > 0.0), None)
