"""What a quadrotor is commanded, what its battery is like, and the state that its flight goes on from."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.space.coordinates import UnitQuaternion, Vector
from caviar_services.world.quadrotor.airframe import Body, Rotors

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
