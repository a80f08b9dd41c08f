"""Axes of engines: against vectors that were made from rotation matrices, and there and back."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_protocol.space.coordinates import Pose, compose, quaternion_from_euler, rotated
from caviar_space.engine_axes import ENGINES, GODOT, NED, UNITY, UNREAL, EngineAxes, Motion

VECTORS: dict[str, Any] = json.loads((Path(__file__).parents[2] / "clients" / "axes.json").read_text())


def pose_of(entry: dict[str, Any]) -> Pose:
    return Pose(tuple(entry["position"]), tuple(entry["orientation"]))


def motion_of(entry: dict[str, Any]) -> Motion:
    return Motion(tuple(entry["velocity"]), tuple(entry["angular_velocity"]))


def assert_same(found: Pose, expected: Pose) -> None:
    np.testing.assert_allclose(found.position, expected.position, rtol=0, atol=1e-9)
    # q and −q are one rotation.
    assert abs(np.dot(found.orientation, expected.orientation)) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("axes", ENGINES.values(), ids=ENGINES)
@pytest.mark.parametrize("number", range(len(VECTORS["poses"])))
def test_poses_and_velocities_are_those_of_the_vectors(axes: EngineAxes, number: int) -> None:
    entry = VECTORS["poses"][number]
    enu, engine = pose_of(entry["enu"]), pose_of(entry[axes.name])
    assert_same(axes.from_enu(enu), engine)
    assert_same(axes.to_enu(engine), enu)
    there = axes.motion_from_enu(motion_of(entry["enu"]))
    np.testing.assert_allclose(there, motion_of(entry[axes.name]), rtol=0, atol=1e-9)
    np.testing.assert_allclose(axes.motion_to_enu(there), motion_of(entry["enu"]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("axes", ENGINES.values(), ids=ENGINES)
def test_meshes_are_those_of_the_vectors(axes: EngineAxes) -> None:
    given, expected = VECTORS["meshes"][axes.name], VECTORS["meshes"]["enu"]
    vertices, triangles = axes.mesh_to_enu(given["vertices"], given["triangles"])
    np.testing.assert_array_equal(vertices, expected["vertices"])
    np.testing.assert_array_equal(triangles, expected["triangles"])
    # Counter-clockwise as seen from outside: the volume that the triangles enclose is positive.
    corners = vertices[triangles]
    assert np.linalg.det(corners - vertices.mean(axis=0)).sum() > 0


@pytest.mark.parametrize(
    ("axes", "forward"),
    [(UNREAL, (1, 0, 0)), (UNITY, (0, 0, 1)), (GODOT, (0, 0, -1)), (NED, (1, 0, 0))],
    ids=lambda value: value.name if isinstance(value, EngineAxes) else "",
)
def test_forward_in_the_engine_is_forward_of_the_body(
    axes: EngineAxes, forward: tuple[int, int, int]
) -> None:
    turned = quaternion_from_euler(0.7, 0.2, -0.4)
    found = rotated(axes.from_enu(Pose((0.0, 0.0, 0.0), turned)).orientation, forward)
    expected = np.array(axes.world) @ rotated(turned, (1.0, 0.0, 0.0))
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("axes", [UNREAL, UNITY, GODOT], ids=lambda axes: axes.name)
def test_mounts_convert_like_poses_where_world_and_body_have_one_rule(axes: EngineAxes) -> None:
    body = Pose((3.0, -7.0, 2.0), quaternion_from_euler(1.1, -0.3, 0.2))
    mount = Pose((0.4, 0.1, -0.2), quaternion_from_euler(-0.5, 0.6, 0.9))
    assert_same(compose(axes.from_enu(body), axes.from_enu(mount)), axes.from_enu(compose(body, mount)))
