"""One flown quadrotor: what it is commanded, what follows from it slice by slice, and when its battery ends.

Time is cut into slices of 10 ms, counted from the beginning of the episode, so that it makes no difference
how a flight is cut into frames. In each slice the outer loops of the controller and the gust are computed
once, attitude loop, rotors and body in five steps of 2 ms, and contacts are looked for at its end.
"""

from __future__ import annotations

import copy
import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise

from caviar_protocol.space.coordinates import Vector, euler_from_quaternion, quaternion_from_euler
from caviar_services.world.flight_dynamics import LIMITED_SPEED, STOPPED_BY_GEOFENCE, Limits
from caviar_services.world.quadrotor.airframe import Airframe, Body, Plant, Rotors
from caviar_services.world.quadrotor.control import (
    BATTERY_EMPTY,
    BATTERY_LOW,
    HOVER,
    Attitude,
    Autopilot,
    Battery,
    Controller,
    Order,
    QuadrotorState,
    braking_speed,
)
from caviar_services.world.quadrotor.surroundings import (
    GROUND,
    SCENERY,
    Contact,
    Gusts,
    OnCollision,
    Wind,
    answered,
)

SLICE_NS = 10_000_000
"""[ns]"""

STEP_NS = 2_000_000
"""Step of the integration [ns]."""

_REST: Vector = (0.0, 0.0, 0.0)
_OFF: Rotors = (0.0, 0.0, 0.0, 0.0)

# [m/s] of a landing; faster than twice that, the ground counts as a collision.
_SINKING = 1.0

# [m/s] below which a body that was to stop is there.
_STANDING = 0.2

# Horizontal speed [m/s] of the set-point from which on the heading follows it.
_COURSE = 0.5

# Share of the greatest acceleration with which it brakes before bounds and at the end of a path.
_BRAKING = 0.5

# Yaw rate over the error of the heading [1/s].
_TURNING = 4.0

# z of the normal from which on a surface bears what lies on it: 45°.
_BEARS = 0.7

_ROUNDING = 1e-12


class Quadrotor:
    """Flies one quadrotor, slice by slice.

    Args:
        airframe: What it is made of.
        controller: Gains and limits of its controller.
        battery: Where the energy comes from.
        limits: Speed, acceleration and bounds of commands.
        wind: The air.
        on_collision: What it does when it touches something.
        restitution: Of a bounce.
        height: Of the body [m]: it stands half of it above the ground.
        plant: What moves the body; None: `Plant` of the airframe.

    Example:
        >>> limits = Limits(speed=5.0, acceleration=2.0, clearance=1.0, low=(-9.0,) * 3, high=(9.0,) * 3)
        >>> uav = Quadrotor(Airframe(), Controller(), Battery(), limits, Wind())
        >>> uav.reset((0.0, 0.0, 2.0), 0.0)
        >>> for _ in range(300):
        ...     events = uav.fly_slice(Order(velocity=(1.0, 0.0, 0.0)))
        >>> round(uav.state.body.velocity[0], 1)
        1.0
    """

    def __init__(
        self,
        airframe: Airframe,
        controller: Controller,
        battery: Battery,
        limits: Limits,
        wind: Wind,
        on_collision: OnCollision = "stop",
        restitution: float = 0.5,
        height: float = 0.25,
        plant: Plant | None = None,
    ) -> None:
        self.limits = limits
        self.on_collision: OnCollision = on_collision
        # The ground may lie below the bounds: what falls comes down to z = 0, or where it may fly.
        self.floor = min(limits.low[2], 0.5 * height)
        self._restitution = restitution
        self._hover: Rotors = (airframe.hover_speed,) * 4
        self._mass = airframe.mass_kg
        self._plant = plant or Plant(airframe)
        self._pilot = Autopilot(airframe, controller, limits.acceleration)
        self._controller = controller
        self._battery = battery
        self._wind = wind
        self._gusts = Gusts(wind) if wind.gusts == "dryden" and wind.speed_6m > 0.0 else None
        self._noise: Callable[[int], Sequence[float]] = _no_noise
        self._lengths: tuple[tuple[Vector, ...], list[float]] = ((), [])
        self.state = QuadrotorState(body=Body(_REST), rotors=self._hover)

    def reset(
        self, position: Vector, yaw: float, noise: Callable[[int], Sequence[float]] | None = None
    ) -> None:
        """Let it hover, with a full battery.

        Args:
            position: Its centre [m].
            yaw: Counter-clockwise from +x [rad].
            noise: `wind.NOISES` normal numbers for each slice, and for −1; None: as before.
        """
        self._noise = noise or self._noise
        body = Body(position, _REST, quaternion_from_euler(yaw))
        self.state = QuadrotorState(body=body, rotors=self._hover, yaw=yaw, hold=position)
        if self._gusts is not None:
            self._gusts.reset(self._noise(-1))
            self.state.gust = self._gusts.state

    def place(self, position: Vector, yaw: float | None = None) -> None:
        """Let it hover elsewhere, with battery and gust as they are.

        Args:
            position: Its centre [m].
            yaw: Its heading [rad]; None: as it is.
        """
        was = self.state
        yaw = was.yaw if yaw is None else yaw
        body = Body(position, _REST, quaternion_from_euler(yaw))
        self.state = QuadrotorState(
            body=body,
            rotors=self._hover,
            yaw=yaw,
            hold=position,
            gust=was.gust,
            energy_j=was.energy_j,
            counted_j=was.counted_j,
        )

    def fly_slice(self, order: Order | None, number: int = 0) -> set[str]:
        """Fly for a slice, without a look at contacts.

        Args:
            order: What is commanded; None: brake and hover.
            number: Of the slice, from the beginning of the episode.

        Returns:
            What limited the motion.
        """
        events = set[str]()
        self._advance(self.state, order or HOVER, SLICE_NS, number, events)
        return events

    def seen_after(self, length_ns: int, order: Order | None, number: int) -> QuadrotorState:
        """What it will be like within a slice.

        Args:
            length_ns: Since the end of the last slice [ns]; less than a slice.
            order: As for `fly_slice`.
            number: Of the slice that has begun.
        """
        if length_ns == 0:
            return self.state
        seen = copy.copy(self.state)
        self._advance(seen, order or HOVER, length_ns, number, set())
        return seen

    def touch(self, contacts: Sequence[Contact]) -> set[str]:
        """Answer contacts at the end of a slice.

        Args:
            contacts: What is touched, but for the ground at z = 0.

        Returns:
            What began to be touched, as names of `Contact.what`.
        """
        state, begun = self.state, set[str]()
        if state.mode == "landed":
            return begun
        down = state.body.velocity[2]
        ground = self.floor - state.body.position[2]
        if ground >= 0.0 and down <= 0.0:
            if down < -2.0 * _SINKING and GROUND not in state.touching:
                begun.add(GROUND)
            self._stand(state, ground)
        for contact in contacts:
            first = contact.what not in state.touching
            if first:
                begun.add(contact.what)
            if self.on_collision != "ignore":
                self._answer(state, contact, first)
        touching = {contact.what for contact in contacts} | ({GROUND} if ground >= 0.0 else set())
        if begun and state.mode == "flying" and self.on_collision in ("land", "fall"):
            state.mode = "landing" if self.on_collision == "land" else "falling"
        state.touching = tuple(sorted(touching))
        return begun

    def leaves(self, margin: float) -> bool:
        """Look at the end of a slice whether it drifted out of its bounds.

        Args:
            margin: How far beyond them it is left unmentioned, as gusts push it that far while it holds its
                place at a bound [m].

        Returns:
            Whether it did in this slice: once, until it has been inside again.
        """
        state, limits = self.state, self.limits
        x, y, z = state.body.position
        # What lands or falls goes down to the ground, wherever the lower bound is.
        excess = limits.excess((x, y, z if state.mode == "flying" else max(z, limits.low[2])))
        was, state.outside = state.outside, excess > (0.0 if state.outside else margin)
        return state.outside and not was

    def _answer(self, state: QuadrotorState, contact: Contact, first: bool) -> None:
        bounces = self.on_collision == "bounce" and state.mode == "flying"
        state.body = answered(
            state.body,
            contact,
            self._restitution if bounces and first else 0.0,
            stops=first and self.on_collision != "bounce" and state.mode == "flying",
        )
        if first:  # what the controller had gathered belongs to another motion
            state.reference, state.integral = state.body.velocity, _REST
        # On what moves it does not lie: that may drive on.
        bears = contact.what == SCENERY and contact.normal[2] > _BEARS
        if state.mode in ("landing", "falling") and bears:
            self._land(state)

    def _stand(self, state: QuadrotorState, depth: float) -> None:
        """Put the body on the ground, where friction holds it."""
        x, y, z = state.body.position
        bounce = 0.0
        if self.on_collision == "bounce" and state.mode == "flying":
            into = -state.body.velocity[2]
            bounce = self._restitution * into if into > 2.0 * _SINKING else 0.0
        state.body = state.body._replace(position=(x, y, z + depth), velocity=(0.0, 0.0, bounce), rates=_REST)
        if state.mode in ("landing", "falling"):
            self._land(state)

    def _land(self, state: QuadrotorState) -> None:
        yaw = euler_from_quaternion(state.body.orientation)[0]
        state.body = Body(state.body.position, _REST, quaternion_from_euler(yaw))
        state.mode, state.rotors, state.reference, state.integral = "landed", _OFF, _REST, _REST

    def _advance(
        self, state: QuadrotorState, order: Order, length_ns: int, number: int, events: set[str]
    ) -> None:
        if order != state.order:
            state.order, state.hold, state.along = order, None, 0.0
        if state.mode == "landed":
            return
        length = length_ns * 1e-9
        wanted = None if state.mode == "falling" else self._wanted(state, order, length, events)
        air = self._air(state, number, length)
        body, rotors, work = state.body, state.rotors, 0.0
        advance, commanded = self._plant.advance, self._pilot.rotors
        left = length_ns
        while left > 0:
            h = min(left, STEP_NS) * 1e-9
            commands = commanded(body, wanted) if wanted is not None else _OFF
            body, rotors, done = advance(body, rotors, commands, air, h)
            work += done
            left -= STEP_NS
        state.body, state.rotors = body, rotors
        self._discharge(
            state, work / self._battery.drive_efficiency + self._battery.avionics_w * length, events
        )

    def _discharge(self, state: QuadrotorState, energy_j: float, events: set[str]) -> None:
        state.energy_j += energy_j
        capacity = self._battery.capacity_wh
        if capacity is None:
            return
        left = 1.0 - state.energy_j / (3600.0 * capacity)
        if left <= 0.0:
            if state.mode != "falling":
                events.add(BATTERY_EMPTY)
            state.energy_j, state.mode = 3600.0 * capacity, "falling"
        elif left < self._battery.land_below and state.mode == "flying":
            events.add(BATTERY_LOW)
            state.mode = "landing"

    def _air(self, state: QuadrotorState, number: int, length: float) -> Vector:
        """Velocity of the air in a slice [m/s]."""
        mean = self._wind.velocity_m_s
        if self._gusts is None:
            return mean
        self._gusts.state = state.gust
        x, y, z = self._gusts.step(state.body.position, state.body.velocity, self._noise(number), length)
        state.gust = self._gusts.state
        return (mean[0] + x, mean[1] + y, mean[2] + z)

    def _wanted(self, state: QuadrotorState, order: Order, length: float, events: set[str]) -> Attitude:
        """The outer loops: attitude and thrust for a slice."""
        body = state.body
        if order.orientation is not None and state.mode == "flying":
            state.reference, state.integral = body.velocity, _REST
            state.yaw = euler_from_quaternion(order.orientation)[0]
            return Attitude(order.orientation, self._mass * order.thrust)
        wish = self._wish(state, order, length, events)
        before = state.reference
        state.reference = self._pilot.slewed(before, wish, length)
        x, y, z = state.reference
        forward = ((x - before[0]) / length, (y - before[1]) / length, (z - before[2]) / length)
        v = body.velocity
        error = (x - v[0], y - v[1], z - v[2])
        acceleration, state.integral = self._pilot.acceleration(error, state.integral, forward, length)
        rate = self._turn(state, wish, length)
        return self._pilot.attitude(body, acceleration, state.yaw, rate)

    def _turn(self, state: QuadrotorState, wish: Vector, length: float) -> float:
        """Turn the heading as ordered, or towards the course; gives its rate [rad/s]."""
        order = state.order
        if order.yaw is not None:
            wanted = _TURNING * math.remainder(order.yaw - state.yaw, 2.0 * math.pi)
        elif order.yaw_rate is not None:
            wanted = order.yaw_rate
        elif math.hypot(wish[0], wish[1]) < _COURSE:
            return 0.0
        else:
            wanted = _TURNING * math.remainder(math.atan2(wish[1], wish[0]) - state.yaw, 2.0 * math.pi)
        most = math.radians(self._controller.max_yaw_rate_deg_s)
        rate = max(-most, min(most, wanted))
        state.yaw = math.remainder(state.yaw + rate * length, 2.0 * math.pi)
        return rate

    def _wish(self, state: QuadrotorState, order: Order, length: float, events: set[str]) -> Vector:
        """Velocity to strive for [m/s]."""
        position, limits = state.body.position, self.limits
        if state.mode == "landing":
            x, y, _ = position if state.hold is None else state.hold
            state.hold = (x, y, position[2])
            side = self._pilot.towards(position, state.hold, limits.speed)
            return (side[0], side[1], -_SINKING)
        if order.asked_speed > limits.speed * (1.0 + _ROUNDING):
            events.add(LIMITED_SPEED)
        if order.target is not None:
            return self._pilot.towards(
                position, self._inside(order.target, events), min(order.speed, limits.speed)
            )
        if order.points:
            return self._along(state, order, length, events)
        if order.velocity != _REST:
            state.hold = None
            return self._within(position, order.velocity, events)
        if state.hold is None and math.hypot(*state.reference, *state.body.velocity) < _STANDING:
            state.hold = self._inside(position, set())
        return _REST if state.hold is None else self._pilot.towards(position, state.hold, limits.speed)

    def _inside(self, target: Vector, events: set[str]) -> Vector:
        """A point, or the nearest one within the bounds."""
        x, y, z = (
            max(a, min(b, t)) for a, b, t in zip(self.limits.low, self.limits.high, target, strict=True)
        )
        if (x, y, z) != target:
            events.add(STOPPED_BY_GEOFENCE)
        return (x, y, z)

    def _within(self, position: Vector, velocity: Vector, events: set[str]) -> Vector:
        """A velocity, at most the greatest speed, with which it comes to rest within the bounds."""
        limits, gain = self.limits, self._controller.position_1_s
        scale = min(1.0, limits.speed / max(math.hypot(*velocity), _ROUNDING))
        wish = []
        for at, v, low, high in zip(position, velocity, limits.low, limits.high, strict=True):
            up = braking_speed(high - at, gain, _BRAKING * limits.acceleration)
            down = -braking_speed(at - low, gain, _BRAKING * limits.acceleration)
            kept = max(down, min(up, scale * v))  # outside of the bounds, back to them
            if kept != scale * v:
                events.add(STOPPED_BY_GEOFENCE)
            wish.append(kept)
        x, y, z = wish
        return (x, y, z)

    def _along(self, state: QuadrotorState, order: Order, length: float, events: set[str]) -> Vector:
        """Velocity along a path: that of a point which runs along it, and waits for the body."""
        points = order.points
        if self._lengths[0] != points:
            ways = [math.dist(a, b) for a, b in pairwise(points)]
            self._lengths = points, list(accumulate(ways, initial=0.0))
        lengths = self._lengths[1]
        speed = min(order.speed, self.limits.speed)
        point, course = _point_at(points, lengths, state.along)
        lag = math.dist(self._inside(point, events), state.body.position)
        lead = max(1.0, 0.5 * speed)
        gain = self._controller.position_1_s
        pace = min(speed, braking_speed(lengths[-1] - state.along, gain, _BRAKING * self.limits.acceleration))
        pace *= max(0.0, min(1.0, 2.0 - lag / lead))
        state.along = min(lengths[-1], state.along + pace * length)
        x, y, z = self._pilot.towards(state.body.position, self._inside(point, events), speed)
        wish = (x + pace * course[0], y + pace * course[1], z + pace * course[2])
        # The course itself would lead out, and on.
        if any(self.limits.excess(corner) > 0.0 for corner in points):
            return self._within(state.body.position, wish, events)
        scale = min(1.0, self.limits.speed / max(math.hypot(*wish), _ROUNDING))
        return (scale * wish[0], scale * wish[1], scale * wish[2])


def _no_noise(number: int) -> Sequence[float]:
    return (0.0, 0.0, 0.0, 0.0, 0.0)


def _point_at(points: Sequence[Vector], lengths: list[float], along: float) -> tuple[Vector, Vector]:
    """Point [m] and unit direction of a path after a way along it [m]."""
    k = min(bisect_right(lengths, along), len(points) - 1)
    if k == 0 or lengths[k] == lengths[k - 1]:
        return points[k], _REST
    way = lengths[k] - lengths[k - 1]
    (ax, ay, az), (bx, by, bz) = points[k - 1], points[k]
    course = ((bx - ax) / way, (by - ay) / way, (bz - az) / way)
    s = along - lengths[k - 1]
    return (ax + s * course[0], ay + s * course[1], az + s * course[2]), course
