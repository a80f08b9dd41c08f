"""Payloads of the topics: what services exchange about a frame.

Each topic is a row of `TOPICS`. All coordinates are right-handed ENU
metres, angles radians, yaw counter-clockwise from +x, stamps whole nanoseconds. Payloads are
canonical (contract, clause 20): names instead of ids of one process, a stated order, no wall
time.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from caviar_protocol.arrays import Payload
from caviar_protocol.fields import Role
from caviar_protocol.topics.channel import (
    Carrier,
    Channel,
    ChannelMatrix,
    ChannelOptions,
    ChannelResponse,
    ChannelTaps,
    Interaction,
)
from caviar_protocol.topics.link import (
    Action,
    AttitudeCommand,
    BeamChoice,
    DriveCommand,
    Link,
    PathCommand,
    RoadStop,
    SignalCommand,
    UserSchedule,
    VelocityCommand,
    WaypointCommand,
)
from caviar_protocol.topics.scene import AntennaArray, AntennaDevice, CameraDevice, LidarDevice, Panel, Scene
from caviar_protocol.topics.sensors import (
    Camera,
    CameraImage,
    Depth,
    DepthImage,
    Intrinsics,
    Lidar,
    LidarScan,
    OccupancyGrid,
    Segmentation,
    SegmentationImage,
)


class Topic(NamedTuple):
    """A topic: what travels, who makes it, and what reads it.

    Classes and functions that import this package are named, ``module:name`` of `caviar_protocol`.
    """

    payload: type[Payload]
    role: Role
    """Of the services that produce it."""
    arrays: str
    """Class of its arrays in a recording (`caviar_protocol.recording.arrays.TopicArrays`)."""
    check: str = ""
    """Function that says what is wrong with the numbers of a payload; that of scenes has its own way."""
    parts: Mapping[str, str] = {}
    """What is computed only where a consumer asks for it (contract, clause 5): name of the part, and field of
    the payload, or of each of its scans or images, that holds it."""


# One place for codec, recorder, checks and SPEC.md: a topic that is not here does not travel.
TOPICS: dict[str, Topic] = {
    "scene": Topic(Scene, "world", "recording.scene:SceneArrays"),
    # `hf` of 100 pairs of 4 × 32 elements with 264 subcarriers is 27 MB in every frame.
    "channel": Topic(
        Channel,
        "channel",
        "recording.topics:ChannelArrays",
        "validation:wrong_channel",
        {"h": "h", "hf": "hf", "taps": "taps"},
    ),
    "lidar": Topic(
        Lidar, "sensors", "recording.scene:LidarArrays", "validation:wrong_lidar", {"grid": "grid"}
    ),
    "camera": Topic(Camera, "sensors", "recording.scene:CameraArrays", "validation:wrong_images"),
    "depth": Topic(
        Depth, "sensors", "recording.scene:DepthArrays", "validation:wrong_images", {"normals": "normals"}
    ),
    "segmentation": Topic(
        Segmentation,
        "sensors",
        "recording.scene:SegmentationArrays",
        "validation:wrong_images",
        {"materials": "material"},
    ),
    "action": Topic(Action, "agent", "recording.topics:ActionArrays", "validation:wrong_action"),
    "link": Topic(Link, "link", "recording.topics:LinkArrays", "validation:wrong_link"),
}
"""All topics by name."""
PAYLOADS: dict[str, type[Payload]] = {name: topic.payload for name, topic in TOPICS.items()}
"""Payload class of each topic."""
PARTS: dict[str, tuple[str, ...]] = {name: (*topic.parts,) for name, topic in TOPICS.items() if topic.parts}
"""Names of the parts of each topic that has some."""


def topics_of(*roles: Role) -> tuple[str, ...]:
    """List the topics that services of some roles produce.

    Args:
        roles: The roles.

    Example:
        >>> topics_of("sensors")
        ('lidar', 'camera', 'depth', 'segmentation')
    """
    return tuple(name for name, topic in TOPICS.items() if topic.role in roles)
