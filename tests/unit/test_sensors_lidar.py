"""The LIDAR service where it has nothing to trace."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from caviar_protocol.errors import AssetError, ScenarioError, SetupError
from caviar_services.registry import load
from caviar_services.sensors.lidar import LidarSensors, LidarSettings
from caviar_services.service import Frame, Preparation, RunInfo


def test_it_is_registered() -> None:
    assert load("sensors", "lidar") is LidarSensors


def test_importing_it_imports_no_ray_tracer() -> None:
    """In a fresh interpreter, since other tests import Mitsuba."""
    code = "import sys, caviar_services.sensors.lidar; sys.exit(bool({'mitsuba', 'drjit'} & {*sys.modules}))"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0


def test_without_demand_it_loads_and_produces_nothing(tmp_path: Path) -> None:
    """The description does not exist, and is not missed."""
    service = LidarSensors(LidarSettings(), RunInfo(name="lidar"))
    prepared = service.prepare(Preparation(demand={}, assets={"scenery/a.xml": tmp_path / "a.xml"}))
    assert "not run" in prepared.notes[0]
    assert service.step(Frame(episode=0, number=0, t_ns=0)).products == {}


def test_a_grid_that_is_asked_for_must_be_described() -> None:
    service = LidarSensors(LidarSettings(), RunInfo(name="eyes"))
    with pytest.raises(ScenarioError, match=r"services\.eyes\.settings\.grid.*minimum_m"):
        service.prepare(Preparation(demand={"lidar": frozenset({"grid"})}))


def test_without_mitsuba_the_command_that_installs_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    service = LidarSensors(LidarSettings(), RunInfo(name="lidar"))
    with pytest.raises(SetupError, match=r"pip install 'caviar-sim\[sensors\]'"):
        service.prepare(Preparation(demand={"lidar": frozenset()}))


@pytest.mark.channel
def test_a_pool_for_an_unknown_mesh_is_refused() -> None:
    service = LidarSensors(LidarSettings(bodies={"objects/caar.ply": 3}), RunInfo(name="lidar"))
    with pytest.raises(ScenarioError, match=r"objects/caar\.ply"):
        service.prepare(Preparation(demand={"lidar": frozenset()}))


@pytest.mark.channel
def test_an_object_mesh_that_is_not_a_unit_mesh_is_refused(tmp_path: Path) -> None:
    from caviar_space.meshes import box, ply

    file = tmp_path / "car.ply"
    file.write_bytes(ply(box((-2.2, 2.2), (-0.9, 0.9), (0.0, 1.5))))
    service = LidarSensors(LidarSettings(), RunInfo(name="lidar"))
    with pytest.raises(AssetError, match=r"car\.ply.*-2\.2.*0\.5"):
        service.prepare(Preparation(demand={"lidar": frozenset()}, assets={"objects/car.ply": file}))


@pytest.mark.channel
@pytest.mark.parametrize("content", [b"", b"ply\nformat nonsense\n", b"not a mesh at all"])
def test_a_file_that_is_no_mesh_is_named(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "car.ply"
    file.write_bytes(content)
    service = LidarSensors(LidarSettings(), RunInfo(name="lidar"))
    with pytest.raises(AssetError, match=r"car\.ply"):
        service.prepare(Preparation(demand={"lidar": frozenset()}, assets={"objects/car.ply": file}))
