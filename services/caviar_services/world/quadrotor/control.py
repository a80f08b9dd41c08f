"""Controller of a quadrotor: position → velocity → attitude → body rates → rotors.

A cascade, as flight controllers have it. The velocity set-point follows from the way to the target with the
square-root profile of braking; its change is bounded by the greatest acceleration and fed forward. The
desired acceleration gives thrust and direction of the thrust (Mellinger and Kumar, "Minimum Snap Trajectory
Generation and Control for Quadrotors", ICRA 2011, section IV; Lee, Leok and McClamroch, "Geometric Tracking
Control of a Quadrotor UAV on SE(3)", CDC 2010). Attitude is controlled on quaternions (Brescianini, Hehn and
D'Andrea, "Nonlinear Quadrocopter Attitude Control", ETH Zurich, 2013):

    M = J·(−ω_a²·ε − 2·ζ·ω_a·(Ω − Ω_d)) + Ω × J·Ω,   ε = 2·sgn(w)·(x, y, z) of q_d⁻¹ ⊗ q

so that small errors obey ε̈ + 2·ζ·ω_a·ε̇ + ω_a²·ε = 0 but for the lag of the rotors.

What a quadrotor is commanded, what its battery is like, and the state that its flight goes on from.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.space.coordinates import UnitQuaternion, Vector, multiply
from caviar_services.world.quadrotor.airframe import GRAVITY, Airframe, Body, Rotors

COLLIDED = "collided/"
"""Begins the count of collisions; quadrotor and what it touched follow: ``collided/uav/scenery``."""

ENERGY = "energy-j/"
"""Begins the count of the energy that a quadrotor took from its battery [J]."""

BATTERY_LOW = "battery-low/"
"""Begins the count of the frame in which a quadrotor began to land since its battery was low."""

BATTERY_EMPTY = "battery-empty/"
"""Begins the count of the frame in which the rotors stopped for want of energy."""

_REST: Vector = (0.0, 0.0, 0.0)


class Battery(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the energy comes from: torque times speed at the rotors' shafts, over an efficiency.

    Example:
        >>> Battery(capacity_wh=77.0).drive_efficiency
        0.8
    """

    capacity_wh: (
        Annotated[float, quantity("Wh", "of the full battery; unset: it never ends", gt=0)] | None
    ) = None
    drive_efficiency: Annotated[float, quantity("1", "shaft power over electric power", gt=0, le=1)] = 0.8
    avionics_w: Annotated[float, quantity("W", "beside the rotors", ge=0)] = 10.0
    land_below: Annotated[float, quantity("1", "share of the capacity with which it lands", ge=0, lt=1)] = 0.1


class Order(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a quadrotor is commanded; without a target, points or an attitude, a velocity.

    Example:
        >>> Order(target=(10.0, 0.0, 30.0), speed=5.0).velocity
        (0.0, 0.0, 0.0)
    """

    velocity: Vector = _REST
    """[m/s]"""
    target: Vector | None = None
    """[m]"""
    points: tuple[Vector, ...] = ()
    """Corners of a path [m]."""
    speed: float = 0.0
    """To the target or along the path [m/s]."""
    orientation: UnitQuaternion | None = None
    thrust: float = 0.0
    """With an orientation: over the mass [m/s²]."""
    yaw: float | None = None
    """Heading to turn to [rad]; None: that of ``yaw_rate``, and without it along the course."""
    yaw_rate: float | None = None
    """[rad/s]"""

    @property
    def asked_speed(self) -> float:
        """[m/s]"""
        return self.speed if self.target is not None or self.points else math.hypot(*self.velocity)


HOVER = Order()


class QuadrotorState(msgspec.Struct, kw_only=True, forbid_unknown_fields=True):
    """All that the further way of a `Quadrotor` follows from, beside commands, obstacles and the seed."""

    body: Body
    rotors: Rotors
    """Speeds [rad/s]."""
    reference: Vector = _REST
    """Set-point of the velocity [m/s]."""
    integral: Vector = _REST
    """Of the velocity error [m/s²]."""
    yaw: float = 0.0
    """Set-point of the heading [rad]."""
    order: Order = HOVER
    hold: Vector | None = None
    """Where it hovers [m]."""
    along: float = 0.0
    """Way along the path [m]."""
    gust: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """State of the gust filters."""
    energy_j: float = 0.0
    """Taken from the battery in the episode."""
    counted_j: int = 0
    """Of these, how many were counted in frames."""
    mode: Literal["flying", "landing", "falling", "landed"] = "flying"
    outside: bool = False
    """Whether it drifted out of its geofence, and has not come back yet."""
    touching: tuple[str, ...] = ()
    """What it touched at the end of the last slice."""


# Share of the greatest acceleration with which the way to a target is braked: the rest is for errors.
_BRAKING = 0.6

# [m/s²] that the integral of the velocity error may reach, along each axis.
_MOST_INTEGRAL = 8.0

# [m/s²] upwards that is always kept, so that a fast descent does not turn the body over.
_LEAST_THRUST = 0.3 * GRAVITY


class Controller(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Gains and limits of the flight controller.

    Example:
        >>> Controller().attitude_rad_s
        12.0
    """

    position_1_s: Annotated[float, quantity("1/s", "velocity over position error", gt=0)] = 1.0
    velocity_1_s: Annotated[float, quantity("1/s", "acceleration over velocity error", gt=0)] = 3.0
    integral_1_s2: Annotated[float, quantity("1/s2", "acceleration over integrated velocity error", ge=0)] = (
        1.0
    )
    attitude_rad_s: Annotated[float, quantity("rad/s", "natural frequency of the attitude", gt=0)] = 12.0
    attitude_damping: Annotated[float, quantity("1", "damping ratio of the attitude", gt=0)] = 0.9
    max_tilt_deg: Annotated[float, quantity("°", "of the thrust from the vertical", gt=0, lt=90)] = 40.0
    max_yaw_rate_deg_s: Annotated[float, quantity("°/s", "of the commanded heading", gt=0)] = 120.0


class Attitude(NamedTuple):
    """What the attitude loop strives for."""

    orientation: UnitQuaternion
    thrust: float
    """[N] along the body's z."""
    yaw_rate: float = 0.0
    """[rad/s]"""


def braking_speed(distance: float, gain: float, acceleration: float) -> float:
    """Speed with which to go to a point: proportional near it, from afar the square root of braking.

    Args:
        distance: To the point [m].
        gain: Speed over distance near it [1/s].
        acceleration: With which is braked [m/s²].

    Returns:
        [m/s]; value and slope are continuous where the two meet.

    Example:
        >>> braking_speed(0.5, 1.0, 2.0), round(braking_speed(26.0, 1.0, 2.0), 6)
        (0.5, 10.0)
    """
    near = acceleration / (gain * gain)
    if distance <= near:
        return gain * distance
    return math.sqrt(2.0 * acceleration * (distance - 0.5 * near))


class Autopilot:
    """The loops of the controller, without a state: what they keep is in `quadrotor.state`.

    Args:
        airframe: The quadrotor.
        controller: Gains and limits.
        acceleration: Greatest acceleration of the velocity set-point [m/s²].

    Example:
        >>> pilot = Autopilot(Airframe(), Controller(), 4.0)
        >>> hover = pilot.attitude(Body((0.0, 0.0, 30.0)), (0.0, 0.0, 0.0), 0.0, 0.0)
        >>> round(hover.thrust, 3), hover.orientation
        (20.006, (1.0, 0.0, 0.0, 0.0))
    """

    def __init__(self, airframe: Airframe, controller: Controller, acceleration: float) -> None:
        self.controller = controller
        self._acceleration = acceleration
        self._mass = airframe.mass_kg
        self._inertia = airframe.inertia_kg_m2
        self._steepest = math.tan(math.radians(controller.max_tilt_deg))
        self._stiffness = controller.attitude_rad_s**2
        self._damping = 2.0 * controller.attitude_damping * controller.attitude_rad_s
        self._per_side = 1.0 / (4.0 * airframe.arm_m * math.sqrt(0.5))
        self._per_torque = airframe.thrust_n_s2 / (4.0 * airframe.torque_n_m_s2)
        self._thrust = airframe.thrust_n_s2
        self._most = airframe.thrust_n_s2 * airframe.max_rotor_rad_s**2

    def towards(self, position: Vector, target: Vector, speed: float) -> Vector:
        """Velocity with which to go to a target [m/s].

        Args:
            position: Where the body is [m].
            target: Where it is to be [m].
            speed: At most [m/s].
        """
        x, y, z = (b - a for a, b in zip(position, target, strict=True))
        distance = math.sqrt(x * x + y * y + z * z)
        if distance == 0.0:
            return (0.0, 0.0, 0.0)
        wish = braking_speed(distance, self.controller.position_1_s, _BRAKING * self._acceleration)
        scale = min(wish, speed) / distance
        return (scale * x, scale * y, scale * z)

    def slewed(self, reference: Vector, wish: Vector, length: float) -> Vector:
        """Velocity set-point after a step, its change bounded by the greatest acceleration.

        Args:
            reference: Before [m/s].
            wish: Where it goes [m/s].
            length: Of the step [s].
        """
        x, y, z = (b - a for a, b in zip(reference, wish, strict=True))
        size, most = math.sqrt(x * x + y * y + z * z), self._acceleration * length
        if size <= most:
            return wish
        scale = most / size
        return (reference[0] + scale * x, reference[1] + scale * y, reference[2] + scale * z)

    def acceleration(
        self, error: Vector, integral: Vector, forward: Vector, length: float
    ) -> tuple[Vector, Vector]:
        """Acceleration to strive for, and the integral after the step.

        Args:
            error: Set-point minus velocity [m/s].
            integral: Of the error, as an acceleration [m/s²].
            forward: Of the set-point [m/s²].
            length: Of the step [s].
        """
        gain, slow = self.controller.velocity_1_s, self.controller.integral_1_s2 * length
        i, j, k = (
            max(-_MOST_INTEGRAL, min(_MOST_INTEGRAL, old + slow * e))
            for old, e in zip(integral, error, strict=True)
        )
        wish = (
            forward[0] + gain * error[0] + i,
            forward[1] + gain * error[1] + j,
            forward[2] + gain * error[2] + k,
        )
        return wish, (i, j, k)

    def attitude(self, body: Body, wish: Vector, yaw: float, yaw_rate: float) -> Attitude:
        """Attitude and thrust that give an acceleration.

        Args:
            body: As it is.
            wish: The acceleration [m/s²].
            yaw: Heading [rad], counter-clockwise from +x.
            yaw_rate: Its derivative [rad/s].
        """
        x, y, z = wish[0], wish[1], max(wish[2] + GRAVITY, _LEAST_THRUST)
        side = math.hypot(x, y)
        if side > self._steepest * z:  # height before place
            x, y = x * self._steepest * z / side, y * self._steepest * z / side
        size = math.sqrt(x * x + y * y + z * z)
        # The shortest rotation from the vertical to the thrust, after the turn to the heading.
        w = math.sqrt(0.5 * (1.0 + z / size))
        tilt = (w, -y / (2.0 * size * w), x / (2.0 * size * w), 0.0)
        turned = multiply(tilt, (math.cos(0.5 * yaw), 0.0, 0.0, math.sin(0.5 * yaw)))
        a, b, c, d = body.orientation
        along = 2.0 * (b * d + a * c) * x + 2.0 * (c * d - a * b) * y + (1.0 - 2.0 * (b * b + c * c)) * z
        return Attitude(turned, max(0.0, self._mass * along), yaw_rate)

    def rotors(self, body: Body, wanted: Attitude) -> Rotors:
        """Commanded rotor speeds [rad/s].

        Args:
            body: As it is.
            wanted: What to strive for.
        """
        a, b, c, d = wanted.orientation
        w, x, y, z = body.orientation
        # q_d⁻¹ ⊗ q
        ew = a * w + b * x + c * y + d * z
        scale = -2.0 * self._stiffness if ew >= 0.0 else 2.0 * self._stiffness
        ex = a * x - b * w - c * z + d * y
        ey = a * y + b * z - c * w - d * x
        ez = a * z - b * y + c * x - d * w
        o, p, r = body.rates
        jx, jy, jz = self._inertia
        damping = self._damping
        mx = jx * (scale * ex - damping * o) + (jz - jy) * p * r
        my = jy * (scale * ey - damping * p) + (jx - jz) * r * o
        mz = jz * (scale * ez - damping * (r - wanted.yaw_rate)) + (jy - jx) * o * p
        # Rotor speeds of a thrust and moments; where they cannot be had, yaw gives way first.
        mean, roll, pitch = 0.25 * wanted.thrust, self._per_side * mx, self._per_side * my
        most = self._most
        span = abs(roll) + abs(pitch)
        if span > 0.5 * most:
            roll, pitch = roll * 0.5 * most / span, pitch * 0.5 * most / span
            span = 0.5 * most
        mean = min(max(mean, span), most - span)
        room = min(mean - span, most - span - mean)
        yaw = min(max(self._per_torque * mz, -room), room)
        k = self._thrust
        # At the bounds rounding may leave less than nothing.
        return (
            math.sqrt(max(mean + roll - pitch + yaw, 0.0) / k),
            math.sqrt(max(mean + roll + pitch - yaw, 0.0) / k),
            math.sqrt(max(mean - roll + pitch + yaw, 0.0) / k),
            math.sqrt(max(mean - roll - pitch - yaw, 0.0) / k),
        )
