"""Commands of agents for flown objects, in the terms of what flies them: points and quadrotors."""

from __future__ import annotations

import math
from itertools import chain

from caviar_protocol.arrays import MAX_COORDINATE_M
from caviar_protocol.errors import PayloadError
from caviar_protocol.scene_validation import UNIT_TOLERANCE
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.topics import AttitudeCommand, PathCommand, VelocityCommand, WaypointCommand
from caviar_protocol.topics.link import MotionCommand
from caviar_services.world.flight_dynamics import Limits, Motion
from caviar_services.world.quadrotor.state import Order


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
