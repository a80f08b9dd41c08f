"""Topic ``action``: what agents decide."""

from __future__ import annotations

from typing import Annotated

import msgspec

from caviar_protocol.arrays import Payload, Vector3, quantity


class BeamChoice(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="beam"):
    """Use this pair of codebook beams between a transmitter and a receiver.

    `Link` defines the beams by their index. The actuator is ``beam:<rx>``.
    """

    tx: str
    """Transmitting device."""
    rx: str
    """Receiving device."""
    tx_beam: Annotated[int, quantity("1", "index into the transmitter's codebook", ge=0)]
    rx_beam: Annotated[int, quantity("1", "index into the receiver's codebook", ge=0)] = 0
    carrier: str = ""
    """Name of the carrier; empty: every carrier."""


class WaypointCommand(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="waypoint"):
    """Fly or drive an object to a point. The actuator is ``motion:<object>``."""

    object: str
    """Object to be moved."""
    position: Vector3
    """Where to."""
    speed: Annotated[float, quantity("m/s", "at most", gt=0)]
    at_once: bool = False
    """Be there in the next frame, at rest, without the way between: to begin an episode elsewhere."""


class VelocityCommand(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="velocity"):
    """Give an object a velocity. The actuator is ``motion:<object>``."""

    object: str
    """Object to be moved."""
    velocity: Annotated[tuple[float, float, float], quantity("m/s", "in world axes")]


class UserSchedule(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, tag="schedule"):
    """Let a transmitter serve one receiver in this frame. The actuator is ``schedule:<tx>``."""

    tx: str
    """Transmitting device."""
    rx: str
    """Device that it serves."""


Command = BeamChoice | WaypointCommand | VelocityCommand | UserSchedule


class Action(Payload, frozen=True, kw_only=True, omit_defaults=True):
    """All commands of one agent in a frame, sorted by actuator, TX and carrier.

    At most one per actuator; of beam choices, one per actuator, TX and carrier.
    """

    commands: tuple[Command, ...]
    """Each with its ``type``."""
