"""One flown object: a point whose velocity changes by a bounded acceleration.

Between sub-steps the acceleration is constant, so that ``x = v₀·t + a·t²/2`` holds exactly.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from caviar_protocol.coordinates import Vector
from caviar_services.world.obstacles import Obstacles

LIMITED_SPEED = "limited-speed"
"""The command asked for more than the greatest speed."""

STOPPED_BY_OBSTACLE = "stopped-by-obstacle"
"""Scenery was in the way, and there was no way along it."""

SLID_ALONG_OBSTACLE = "slid-along-obstacle"
"""Scenery was in the way; the motion went on along its surface."""

STOPPED_BY_GEOFENCE = "stopped-by-geofence"
"""A bound of the permitted box, or the ground, was in the way."""

_HOVERING = 0.05
"""Horizontal speed [m/s] below which an object keeps its yaw."""

_STANDSTILL = 0.01
"""Share of the speed below which what is left along a surface counts as none."""


_ROUNDING = 1e-9
"""[m]"""

_REST: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Limits:
    """What an object may do."""

    speed: float
    """Greatest speed [m/s]."""
    acceleration: float
    """Greatest acceleration [m/s²]."""
    clearance: float
    """Least distance from obstacles [m]."""
    low: Vector
    high: Vector
    """Corners of the permitted box [m]."""


@dataclass(frozen=True, kw_only=True)
class Motion:
    """What an object is told: a velocity, or a target and the speed with which to go there."""

    velocity: Vector = (0.0, 0.0, 0.0)
    target: Vector | None = None
    speed: float = 0.0


class Flyer:
    """Position, velocity and yaw of one object."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.obstacles = Obstacles.none()
        self.reset((0.0, 0.0, 0.0), 0.0)

    def reset(self, position: Vector, yaw: float) -> None:
        """At rest at a position [m], with a yaw [rad]."""
        self.position: Vector = position
        self.velocity: Vector = (0.0, 0.0, 0.0)
        self.yaw = yaw

    def fly(self, motion: Motion | None, steps: Iterable[float]) -> Counter[str]:
        """Move through sub-steps of these lengths [s]; without a motion brake and hover.

        Returns what limited the motion, each at most once.
        """
        events: set[str] = set()
        wanted = motion or Motion()
        asked = math.hypot(*wanted.velocity) if wanted.target is None else wanted.speed
        if asked > self.limits.speed:
            events.add(LIMITED_SPEED)
        for dt in steps:
            before = self.velocity
            after = _towards(before, self._desired(wanted, dt), self.limits.acceleration * dt)
            self._move(before, after, dt, events)
            vx, vy, _ = self.velocity
            if math.hypot(vx, vy) > _HOVERING:
                self.yaw = math.atan2(vy, vx)
        return Counter(events)

    def _desired(self, motion: Motion, dt: float) -> Vector:
        """Velocity [m/s] to have at the end of a sub-step."""
        if motion.target is None:
            speed = math.hypot(*motion.velocity)
            return _scaled(motion.velocity, min(1.0, self.limits.speed / speed)) if speed else motion.velocity
        way = _sum(motion.target, self.position, -1.0)
        distance = math.hypot(*way)
        if distance == 0.0:
            return (0.0, 0.0, 0.0)
        now = math.hypot(*self.velocity)
        # The greatest v with (now + v)·dt/2 + v²/2a ≤ distance: what is then left is the way in
        # which v brakes to rest. Closer than one sub-step the next one has to end at rest.
        half = self.limits.acceleration * dt / 2
        root = half * half + self.limits.acceleration * (2 * distance - now * dt)
        brake = math.sqrt(root) - half if root > 0 else 0.0
        speed = min(motion.speed, self.limits.speed, brake, distance / dt - now / 2)
        return _scaled(way, max(speed, 0.0) / distance)

    def _move(self, before: Vector, after: Vector, dt: float, events: set[str]) -> None:
        mean = _scaled(_sum(before, after), 0.5)
        length = math.hypot(*mean) * dt
        pieces = max(1, math.ceil(length / (self.limits.clearance / 2)))
        for _ in range(pieces):
            step = _scaled(mean, dt / pieces)
            taken, after = self._permitted(step, after, events)
            if taken is not step:
                mean = _scaled(taken, pieces / dt)
            self.position = _clamped(_sum(self.position, taken), self.limits.low, self.limits.high)
        self.velocity = after

    def _permitted(self, step: Vector, velocity: Vector, events: set[str]) -> tuple[Vector, Vector]:
        """What of a step may be taken, and the velocity then."""
        wish = step
        end = _sum(self.position, step)
        inside = _clamped(end, self.limits.low, self.limits.high)
        if inside != end:
            events.add(STOPPED_BY_GEOFENCE)
            step = _sum(inside, self.position, -1.0)
            velocity = _masked(velocity, inside, end)
            if inside == self.position:
                return _REST, velocity
        taken = self.obstacles.slide(self.position, step, self.limits.clearance)
        if taken is step:
            return taken, velocity
        end = _sum(self.position, taken)
        leaves = max(map(abs, _sum(_clamped(end, self.limits.low, self.limits.high), end, -1.0))) > _ROUNDING
        if leaves or math.hypot(*taken) <= _STANDSTILL * math.hypot(*wish):
            events.add(STOPPED_BY_OBSTACLE)
            return _REST, _REST
        events.add(SLID_ALONG_OBSTACLE)
        return taken, _scaled(taken, math.hypot(*velocity) / math.hypot(*step))


def _towards(now: Vector, desired: Vector, most: float) -> Vector:
    """``now`` changed towards ``desired``, by at most ``most``."""
    change = _sum(desired, now, -1.0)
    size = math.hypot(*change)
    return desired if size <= most else _sum(now, change, most / size)


def _sum(a: Vector, b: Vector, factor: float = 1.0) -> Vector:
    return (a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2])


def _scaled(v: Vector, factor: float) -> Vector:
    return (v[0] * factor, v[1] * factor, v[2] * factor)


def _clamped(v: Vector, low: Vector, high: Vector) -> Vector:
    x, y, z = (min(max(c, a), b) for c, a, b in zip(v, low, high, strict=True))
    return (x, y, z)


def _masked(v: Vector, a: Vector, b: Vector) -> Vector:
    """``v`` without the components in which ``a`` and ``b`` differ."""
    x, y, z = (c if p == q else 0.0 for c, p, q in zip(v, a, b, strict=True))
    return (x, y, z)
