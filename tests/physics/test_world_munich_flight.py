"""The flight of ``uav-munich`` against the meshes of Munich: free air, and when it is in sight."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_protocol.errors import SetupError
from caviar_protocol.scenario import load_scenario
from caviar_services.drjit_setup import activate_llvm
from caviar_services.sensors.base import active_variant
from caviar_services.world.trajectory import Track, read_waypoints
from caviar_space.mitsuba_xml import read_scenery, world_mesh
from caviar_space.scenery import scenery_assets

pytestmark = [
    pytest.mark.channel,
    pytest.mark.skipif(importlib.util.find_spec("sionna") is None, reason="needs sionna-rt"),
]

VARIANT = "llvm_ad_rgb"


def distances(mi: Any, scene: Any, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance to the first hit of each ray [m]; infinite without one."""

    def columns(rows: np.ndarray) -> list[Any]:
        return [mi.Float(np.ascontiguousarray(rows[:, axis], dtype=np.float32)) for axis in range(3)]

    hits = scene.ray_intersect_preliminary(
        mi.Ray3f(mi.Point3f(*columns(origins)), mi.Vector3f(*columns(directions)))
    )
    return np.where(np.array(hits.is_valid()), np.array(hits.t), np.inf)


def merged(mi: Any, xml: Path) -> Any:
    """All meshes of a scenery as one Mitsuba scene."""
    meshes = [world_mesh(shape) for shape in read_scenery(xml).shapes]
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    mesh = mi.Mesh("munich", int(starts[-1]), sum(len(part.faces) for part in meshes))
    parameters = mi.traverse(mesh)
    vertices = np.concatenate([part.vertices for part in meshes])
    faces = np.concatenate([part.faces + start for part, start in zip(meshes, starts, strict=False)])
    parameters["vertex_positions"] = mi.Float(vertices.ravel().astype(np.float32))
    parameters["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
    parameters.update()
    return mi.load_dict({"type": "scene", "munich": mesh})


def test_the_flight_keeps_clear_and_is_out_of_sight_three_times(repository: Path) -> None:
    """5 m of free air around it above the take-off and landing, the base station in free air, and
    line of sight but for three intervals, a very short one among them (paper, section 4, Fig. 8)."""
    try:
        activate_llvm()
    except SetupError as error:
        pytest.skip(str(error))
    scenario = load_scenario(repository / "deploy" / "caviar_scenarios" / "uav-munich.toml")
    settings = scenario.services["world"].settings
    track = Track(read_waypoints(settings["objects"][0]["waypoints"]))
    period = scenario.run.sampling_period_ns / 1e9
    places = np.array([track.position(k * period) for k in range(scenario.run.frames)])
    station = np.array(next(d.position_m for d in scenario.devices if d.name == "bs"))
    rng = np.random.default_rng(7)
    around = rng.normal(size=(300, 3))
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    xml = scenery_assets(settings["scenery"])["scenery/munich.xml"]
    assert isinstance(xml, Path)
    with active_variant(VARIANT) as mi:
        scene = merged(mi, xml)
        fine = np.array([track.position(t) for t in np.arange(0.0, 96.0, 0.1).tolist()])
        high = fine[fine[:, 2] > 6.0]
        clearance = distances(
            mi, scene, np.repeat(high, len(around), axis=0), np.tile(around, (len(high), 1))
        ).min()
        overhead = distances(mi, scene, places, np.tile([0.0, 0.0, 1.0], (len(places), 1)))
        way = places - station
        length = np.linalg.norm(way, axis=1)
        seen = distances(mi, scene, np.tile(station, (len(places), 1)), way / length[:, None]) > length
        below_station = distances(mi, scene, station[None], np.array([[0.0, 0.0, -1.0]]))[0]
    assert clearance > 5.0
    assert np.isinf(overhead).all()  # never under a roof, so never inside a building
    assert 0.5 < below_station < 3.0
    changes = np.flatnonzero(np.diff(seen.astype(int)))
    assert seen[0]
    assert not seen[-1]
    assert len(changes) == 5  # lost, found, lost, found, lost
    lost = [(changes[i + 1] - changes[i]) * period for i in (0, 2)]
    assert lost[0] > 15.0
    assert lost[1] < 4.0
    assert 0.5 < seen.mean() < 0.8
