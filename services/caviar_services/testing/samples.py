"""A small street for conformance tests: scenery, scenes, and a product of every topic.

Everything is asymmetric and moves, so that a service which mixes up axes, objects or frames shows.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Payload
from caviar_protocol.codec import encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.messages import GrantInput, Input, Status
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import (
    PARTS,
    PAYLOADS,
    AntennaArray,
    AntennaDevice,
    Camera,
    CameraDevice,
    CameraImage,
    Carrier,
    Depth,
    DepthImage,
    Intrinsics,
    Lidar,
    LidarDevice,
    LidarScan,
    Scene,
    Segmentation,
    SegmentationImage,
)
from caviar_services.agent.base import AgentSettings
from caviar_services.agent.baselines import RandomAgent
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.link.beams import BeamLink, BeamLinkSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_space.meshes import SHAPES, Mesh, box, ply

SAMPLING_PERIOD_NS = 100_000_000
CARRIERS = (
    Carrier(
        name="mmwave",
        frequency_hz=28e9,
        bandwidth_hz=100e6,
        subcarriers=5,
        subcarrier_spacing_hz=480e3,
        taps=8,
        slots=2,
        slot_duration_s=5e-4,
    ),
)
# Of every kind of device one, and antennas of which no two have the same array: a model that swaps TX and RX,
# or rows and columns, gets shapes that do not fit.
DEVICES = (
    DeviceSpec(name="bs", kind="antenna", role="tx"),
    DeviceSpec(name="rx", kind="antenna", role="rx", on="*", count=2),
    DeviceSpec(name="lidar", kind="lidar", on="truck.2"),
    DeviceSpec(name="camera", kind="camera", on="truck.2"),
)
"""What a scenario with the devices of `scene` would say."""

_SCENERY = """\
<scene version="2.1.0">
  <bsdf type="itu-radio-material" id="mat-concrete">
    <string name="type" value="concrete"/>
    <float name="thickness" value="0.2"/>
  </bsdf>
  <shape type="ply" id="mesh-ground">
    <string name="filename" value="meshes/ground.ply"/>
    <boolean name="face_normals" value="true"/>
    <ref id="mat-concrete" name="bsdf"/>
  </shape>
  <shape type="ply" id="mesh-wall">
    <string name="filename" value="meshes/wall.ply"/>
    <boolean name="face_normals" value="true"/>
    <ref id="mat-concrete" name="bsdf"/>
  </shape>
</scene>
"""


def scenery(folder: Path) -> dict[str, Path]:
    """Write the street's ground, one wall and the meshes of its objects.

    Args:
        folder: Where the files are written, at their asset names as relative paths.

    Returns:
        File by asset name.
    """
    files: dict[str, bytes] = {"scenery/street.xml": _SCENERY.encode()}
    pieces: dict[str, Mesh] = {
        "ground": box((-60, 80), (-40, 30), (-1.0, 0.0)),
        "wall": box((-30, 50), (14, 16), (0.0, 12.0)),
    }
    files |= {f"scenery/meshes/{name}.ply": ply(mesh) for name, mesh in pieces.items()}
    files["objects/car.ply"] = ply(SHAPES["car"]())
    found = {}
    for name, content in files.items():
        found[name] = folder / name
        found[name].parent.mkdir(parents=True, exist_ok=True)
        found[name].write_bytes(content)
    return found


# Cached, like `product`: a channel and a link of the same frame are inputs of every role's tests.
@cache
def scene(frame: int) -> Scene:
    """A car with a receiver and a truck with a receiver, a LIDAR and a camera; a fixed base station.

    Args:
        frame: Number of the frame, `SAMPLING_PERIOD_NS` apart; objects move with constant velocities.

    Example:
        >>> scene(0).names, [device.name for device in scene(0).devices][:2]
        (('car.1', 'truck.2'), ['bs', 'car.1/rx'])
    """
    t = frame * SAMPLING_PERIOD_NS / 1e9
    # The car turns while it drives straight, which none does: so nothing can take the course for the yaw.
    yaws = (0.3 + 0.2 * t, math.pi - 0.1)
    return Scene(
        names=("car.1", "truck.2"),
        classes=("car", "truck"),
        assets=("objects/car.ply", ""),
        position=np.array([[-12.0 + 9.0 * t, 3.0 + 2.5 * t, 0.75], [24.0 - 6.0 * t, 7.0, 1.7]]),
        orientation=np.array([quaternion_from_euler(yaw) for yaw in yaws]),
        velocity=np.array([[9.0, 2.5, 0.0], [-6.0, 0.0, 0.0]]),
        dimensions=np.array([[4.6, 1.9, 1.5], [9.0, 2.5, 3.4]]),
        devices=(
            AntennaDevice(
                name="bs",
                position=(3.0, -18.0, 9.0),
                orientation=quaternion_from_euler(math.pi / 2, 0.15),
                role="tx",
                array=AntennaArray(rows=2, columns=8),
                power_dbm=30.0,
            ),
            AntennaDevice(
                name="car.1/rx",
                parent="car.1",
                position=(0.3, 0.0, 0.9),
                role="rx",
                array=AntennaArray(columns=3),
            ),
            CameraDevice(
                name="truck.2/camera", parent="truck.2", position=(5.0, 0.0, 0.5), width=32, height=20
            ),
            LidarDevice(
                name="truck.2/lidar", parent="truck.2", position=(0.0, 0.2, 2.3), beams=4, azimuth_steps=45
            ),
            AntennaDevice(
                name="truck.2/rx",
                parent="truck.2",
                position=(1.0, 0.4, 1.9),
                role="rx",
                array=AntennaArray(rows=2),
            ),
        ),
    )


@cache
def product(topic: str, frame: int) -> Payload:
    """Product of the street's services on a topic in a frame; the same bytes at every call.

    Args:
        topic: Name of the topic.
        frame: Number of the frame.

    Raises:
        ValueError: The street has no product of the topic.

    Example:
        >>> product("channel", 0).rx
        ('car.1/rx', 'truck.2/rx')
    """
    match topic:
        case "scene":
            return scene(frame)
        case "channel":
            channel = FreeSpaceChannel(FreeSpaceSettings(), _run("channel"))
            # Free space: closed form, no ray tracer, and a path to each receiver whatever stands around.
            channel.prepare(Preparation(demand={"channel": frozenset(PARTS["channel"])}))
            return channel.step(granted(channel.inputs, frame, "channel")).products["channel"]
        case "action":
            agent = RandomAgent(AgentSettings(), _run("agent"))
            return agent.step(granted((Input(topic="scene"),), frame, "agent")).products["action"]
        case "link":
            link = BeamLink(BeamLinkSettings(), _run("link"))
            link.prepare(Preparation(demand={"link": frozenset()}))
            return link.step(granted(link.inputs, frame, "link")).products["link"]
        case _:
            return _sensed(topic, frame)


def inputs(
    declared: Iterable[Input], frame: int, leave_out: Mapping[str, str] | None = None
) -> tuple[FrameInput, ...]:
    """The inputs of a grant as the runner hands them over: bytes with provenance.

    Args:
        declared: Inputs that a service declares.
        frame: Number of the frame. An input of frame −1 is absent.
        leave_out: Topics that are absent, with the cause.

    Example:
        >>> (channel,) = inputs([Input(topic="channel", lag=1)], 0)
        >>> channel.present, channel.provenance.cause
        (False, 'no frame before the first')
    """
    found = []
    for item in declared:
        for topic in sorted(PAYLOADS) if item.topic == "*" else (item.topic,):
            found.append(_input(topic, frame - item.lag, item.lag, (leave_out or {}).get(topic, "")))
    return tuple(found)


def source(topic: str) -> str:
    """Name of the service that publishes a topic in the street.

    Args:
        topic: Name of the topic.

    Example:
        >>> source("scene")
        'world'
    """
    return {"scene": "world", "action": "agent"}.get(topic, topic)


def _input(topic: str, computed: int, age: int, cause: str) -> FrameInput:
    # As in a run: a lagged input of the first frame is of the one before it, which there is not.
    if computed < 0:
        cause = "no frame before the first"
    if cause:
        return FrameInput(GrantInput(topic=topic, source=source(topic), status=Status.ABSENT, cause=cause))
    header, body = encode_payload(product(topic, computed))
    provenance = GrantInput(
        topic=topic,
        source=source(topic),
        status=Status.FRESH,
        frame=computed,
        t_ns=computed * SAMPLING_PERIOD_NS,
        age=age,
        digest=payload_digest(header, body),
    )
    return FrameInput(provenance, header, body)


def granted(declared: Iterable[Input], number: int, service: str) -> Frame:
    """A frame of the street as a service is granted it.

    Args:
        declared: Inputs that the service declares.
        number: Number of the frame.
        service: Name of the service.

    Example:
        >>> granted([Input(topic="scene")], 3, "agent").scene().names
        ('car.1', 'truck.2')
    """
    return Frame(
        episode=0,
        number=number,
        t_ns=number * SAMPLING_PERIOD_NS,
        inputs=inputs(declared, number),
        service=service,
        seed=1,
    )


def _run(name: str) -> RunInfo:
    return RunInfo(name=name, seed=1, carriers=CARRIERS, devices=DEVICES)


def _sensed(topic: str, frame: int) -> Payload:
    """Made-up sensor products with a few points and pixels that change from frame to frame."""
    # Not those of the sensor services: they need Mitsuba, which a test of an agent has no use for.
    pose: dict[str, Any] = {"position": (24.0, 7.0, 4.0), "orientation": (1.0, 0.0, 0.0, 0.0)}
    if topic == "lidar":
        points = np.array([[1.0, 2.0, 0.5], [3.0, -1.0, 0.25 * frame]], dtype="<f4")
        scan = LidarScan(
            sensor="truck.2/lidar",
            **pose,
            ray=np.array([3, 17], dtype="<i4"),
            points=points,
            points_world=points + np.float32(1.5),
            range=np.linalg.norm(points, axis=1).astype("<f4"),
            object=np.array([0, 1], dtype="<i4"),
        )
        return Lidar(object_names=("car.1", "wall"), scans=(scan,))
    optics: dict[str, Any] = {
        "sensor": "truck.2/camera",
        "intrinsics": Intrinsics(fx=16.0, fy=16.0, cx=2.0, cy=1.5),
        **pose,
    }
    pixels = (np.arange(12).reshape(3, 4) + frame) % 5
    match topic:
        case "camera":
            return Camera(images=(CameraImage(**optics, rgb=np.stack([pixels] * 3, -1).astype("|u1")),))
        case "depth":
            return Depth(images=(DepthImage(**optics, depth=pixels.astype("<f4") + np.float32(2)),))
        case "segmentation":
            image = SegmentationImage(**optics, object=(pixels % 2).astype("<i4"))
            return Segmentation(object_names=("car.1", "wall"), images=(image,))
        case _:
            raise ValueError(f"the street has no product of topic {topic!r}; add one to testing/samples.py")
