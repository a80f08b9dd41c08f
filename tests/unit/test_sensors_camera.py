"""The camera service where it has nothing to trace."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from caviar_protocol.errors import ScenarioError, SetupError
from caviar_protocol.scenario.conversion import convert_settings
from caviar_services.registry import load
from caviar_services.sensors.camera import CameraSensors, CameraSettings
from caviar_services.service import Frame, Preparation, RunInfo


def test_it_is_registered() -> None:
    assert load("sensors", "camera") is CameraSensors


def test_importing_it_imports_no_ray_tracer() -> None:
    """In a fresh interpreter, since other tests import Mitsuba."""
    code = "import sys, caviar_services.sensors.camera; sys.exit(bool({'mitsuba', 'drjit'} & {*sys.modules}))"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0


def test_without_demand_it_loads_and_produces_nothing(tmp_path: Path) -> None:
    """The description does not exist, and is not missed."""
    service = CameraSensors(CameraSettings(), RunInfo(name="camera"))
    prepared = service.prepare(Preparation(demand={}, assets={"scenery/a.xml": tmp_path / "a.xml"}))
    assert "not run" in prepared.notes[0]
    assert service.step(Frame(episode=0, number=0, t_ns=0)).products == {}
    service.release_memory()


def test_without_mitsuba_the_command_that_installs_it_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    service = CameraSensors(CameraSettings(), RunInfo(name="camera"))
    with pytest.raises(SetupError, match=r"pip install 'caviar-sim\[sensors\]'"):
        service.prepare(Preparation(demand={"depth": frozenset()}))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"sun_elevation_deg": 91}, r"sun_elevation_deg"),
        ({"colours": {"car": [1, 0]}}, r"colours"),
        ({"colors": {}}, r"colours"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_by_name(settings: dict[str, object], words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        convert_settings(CameraSettings, settings)
