"""`caviar new NAME --scene FOLDER`: traffic, people, base stations and a UAV in an imported scene."""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from test_openstreetmap import HERE, town
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_protocol.errors import AssetError, RunError
from caviar_protocol.scenario import Scenario, load_scenario
from caviar_scenes.town import new_town, skyline_of
from caviar_space.imported_scenes import write_scene
from caviar_space.meshes import box
from caviar_space.sources import Request, read_source

pytest.importorskip("sumo")


@pytest.fixture(scope="module")
def city(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("town")
    scene = read_source(
        town().write(folder / "town.osm"), Request(origin=HERE, box_m=(-90.0, -95.0, 95.0, 95.0))
    )
    write_scene(scene, folder / "city")
    return folder / "city"


@pytest.fixture(scope="module")
def scenario(city: Path) -> Path:
    file = city.parent / "runs" / "town.toml"
    result = CliRunner().invoke(app, ["new", str(file), "--scene", str(city)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert re.search(r"\d+ vehicles and \d+ people at 300 s", result.stdout)
    return file


def devices(scenario: Scenario, role: str) -> list[object]:
    return [device for device in scenario.devices if getattr(device, "role", "") == role]


def test_base_stations_stand_on_roofs_and_the_uav_flies_above_them(scenario: Path) -> None:
    found = load_scenario(scenario)
    stations = devices(found, "tx")
    assert stations
    roofs = {12.0, 9.0, 20.0, 7.5, 10.5}
    for station in stations:
        assert min(abs(station.position_m[2] - 2.0 - roof) for roof in roofs) < 0.01  # type: ignore[attr-defined]
    waypoints = np.array(found.services["sky"].settings["objects"][0]["waypoints"])
    assert (waypoints[:, 3] >= 25.0).all()
    speed = np.linalg.norm(np.diff(waypoints[:, 1:], axis=0), axis=1) / np.diff(waypoints[:, 0])
    assert speed.max() < 9.0
    assert len(devices(found, "rx")) == 2


def test_traffic_is_sorted_and_on_the_roads_of_the_scene(scenario: Path, city: Path) -> None:
    root = ElementTree.parse(scenario.with_suffix(".rou.xml")).getroot()  # noqa: S314 - SUMO wrote it
    net = ElementTree.parse(city / "sumo" / "net.net.xml").getroot()  # noqa: S314 - SUMO wrote it
    roads = {edge.get("id") for edge in net.iter("edge")}
    trips = [*root.findall("vehicle"), *root.findall("person")]
    assert min(len(root.findall(kind)) for kind in ("vehicle", "person")) > 3
    departs = [float(trip.get("depart", "nan")) for trip in root if trip.tag in ("vehicle", "person")]
    assert departs == sorted(departs)
    used = {edge for trip in trips for part in trip for edge in part.get("edges", "").split()}
    assert used <= roads
    assert load_scenario(scenario).services["traffic"].settings["offset_m"] == [0, 0, 0.0]


def test_no_vehicle_is_in_a_building(scenario: Path, tmp_path: Path) -> None:
    picture = ["scene", "picture", str(scenario), "--out", str(tmp_path / "town.png"), "--frames", "100"]
    result = CliRunner().invoke(app, picture, catch_exceptions=False)
    counted = re.search(r"(\d+) objects in 100 frames, \d+ positions: (\d+) below a roof", result.stdout)
    assert counted is not None
    assert int(counted[1]) > 15
    assert counted[2] == "0"


def test_without_a_network_there_are_base_stations_and_a_uav(city: Path, tmp_path: Path) -> None:
    (tmp_path / "bare").mkdir()
    for name in ("scene.xml", "scene.json", "meshes"):
        (tmp_path / "bare" / name).symlink_to(city / name)
    said: list[str] = []
    new_town(tmp_path / "bare.toml", tmp_path / "bare", say=said.append)
    found = load_scenario(tmp_path / "bare.toml")
    assert said == [f"{tmp_path / 'bare'} has no network of roads: base stations and a UAV alone"]
    assert [spec.role for spec in found.services.values()] == [
        "world",
        "channel",
        "link",
        "agent",
        "recorder",
    ]
    assert devices(found, "tx")
    with pytest.raises(RunError, match="is there already"):
        new_town(tmp_path / "bare.toml", tmp_path / "bare")
    with pytest.raises(AssetError, match=r"has no scene\.xml"):
        new_town(tmp_path / "new.toml", tmp_path)


def test_a_station_sees_over_low_buildings_alone() -> None:
    skyline = skyline_of([box((10, 20), (-10, 10), (0, 6))], [box((-40, 40), (-40, 40), (-1, 0))])
    places = np.array([(30.0, 0.0, 1.5), (-30.0, 0.0, 1.5), (30.0, 30.0, 1.5)])
    assert skyline.sees(np.array((0.0, 0.0, 5.0)), places).tolist() == [False, True, True]
    assert skyline.sees(np.array((0.0, 0.0, 40.0)), places).tolist() == [True, True, True]
    assert skyline.at(np.array([(15.0, 0.0), (0.0, 0.0)])).tolist() == [6.0, -np.inf]
