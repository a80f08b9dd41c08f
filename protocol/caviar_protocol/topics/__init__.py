"""Payloads of the topics: what services exchange about a frame.

Each topic has one payload class, found in `PAYLOADS`. All coordinates are right-handed ENU
metres, angles radians, yaw counter-clockwise from +x, stamps whole nanoseconds. Payloads are
canonical (contract, clause 20): names instead of ids of one process, a stated order, no wall
time.
"""

from __future__ import annotations

from caviar_protocol.arrays import Payload
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

# One place for codec, recorder, checks and SPEC.md: a topic that is not here does not travel.
PAYLOADS: dict[str, type[Payload]] = {
    "scene": Scene,
    "channel": Channel,
    "lidar": Lidar,
    "camera": Camera,
    "depth": Depth,
    "segmentation": Segmentation,
    "action": Action,
    "link": Link,
}
"""Payload class of each topic."""

# `hf` of 100 pairs of 4 × 32 elements with 264 subcarriers is 27 MB in every frame.
PARTS: dict[str, tuple[str, ...]] = {
    "channel": ("h", "hf", "taps"),
    "lidar": ("grid",),
    "depth": ("normals",),
    "segmentation": ("materials",),
}
"""Parts of a payload that are computed only where a consumer asks for them (contract, clause 5)."""
