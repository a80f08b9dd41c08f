"""The vectors of SPEC.md, Worlds: devices of a scenario as a world publishes them, frame by frame."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest

from caviar_protocol.codec import decode_message, decode_payload, encode_payload
from caviar_protocol.messages import Welcome
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import Scene
from caviar_services.world.base import Mounts

VECTORS = Path(__file__).parents[2] / "protocol" / "vectors"
ARRIVALS = (("car.2", "uav"), ("car.1",), ("car.0",), (), ("car.2",))
"""Objects that come in each frame."""


def scene(frame: int) -> Scene:
    header, body = (VECTORS / f"mounts_{frame}{suffix}" for suffix in (".msgpack", ".body"))
    found = decode_payload("scene", header.read_bytes(), body.read_bytes())
    assert isinstance(found, Scene)
    return found


def test_the_worlds_of_this_repository_publish_what_the_vectors_say() -> None:
    welcome = decode_message((VECTORS / "welcome_mounts.msgpack").read_bytes())
    assert isinstance(welcome, Welcome)
    mounts = Mounts(msgspec.convert(welcome.scenario["devices"], tuple[DeviceSpec, ...]))
    order: list[str] = []
    for frame, new in enumerate(ARRIVALS):
        expected = scene(frame)
        dimensions = dict(zip(expected.names, map(tuple, expected.dimensions.tolist()), strict=True))
        order = [name for name in (*order, *new) if name in dimensions]
        devices = mounts.devices([(name, dimensions[name]) for name in order])
        got = msgspec.structs.replace(expected, devices=devices)
        assert encode_payload(got) == encode_payload(expected), f"frame {frame}"


@pytest.mark.parametrize(
    ("yaw", "pitch", "roll"), [(90.0, 30.0, -20.0), (60.0, 10.0, 0.0), (-130.0, -70.0, 155.0)]
)
def test_yaw_pitch_and_roll_turn_as_the_specification_says(yaw: float, pitch: float, roll: float) -> None:
    """Three rotation matrices, one after the other, against the quaternion's."""

    def about(axis: int, degrees: float) -> np.ndarray:
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        a, b = [i for i in range(3) if i != axis]
        turned = np.eye(3)
        turned[a, a] = turned[b, b] = c
        turned[a, b], turned[b, a] = (s, -s) if axis == 1 else (-s, s)
        return turned

    w, x, y, z = quaternion_from_euler(*np.radians([yaw, pitch, roll]).tolist())
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(matrix, about(2, yaw) @ about(1, pitch) @ about(0, roll), atol=1e-12)
