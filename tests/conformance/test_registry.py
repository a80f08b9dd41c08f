"""Every registered implementation passes the conformance tests of its role.

A new line in the registry is tested by itself. Its settings are those of the first shipped
scenario that uses it, or none; its role's class says what is asked of it.
"""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from msgspec.structs import replace

from caviar_protocol.scenario import Scenario, load_scenario
from caviar_protocol.scenario.rules import world_of
from caviar_services.recorder.mcap import McapRecorder
from caviar_services.registry import load, registered
from caviar_services.testing import CONFORMANCE, ServiceConformance, samples
from caviar_services.testing.base import HEAVY

SCENARIOS = Path(__file__).resolve().parents[2] / "deploy" / "caviar_scenarios"

EXTRAS = {
    "channel:adaptive": "sionna",
    "world:sumo": "libsumo",
    "sensors:camera": "mitsuba",
    "world:flight": "sionna",
    "world:panda3d": "panda3d",
    "channel:sionna-rt": "sionna",
    "sensors:lidar": "mitsuba",
    "agent:policy": "onnx",
    "agent:mavlink": "pymavlink",
}
"""Package without which an implementation cannot run; a base install skips it."""

OVERRIDES: dict[str, dict[str, object]] = {
    "agent:airsim": {"listen": "127.0.0.1:0"},  # tests run side by side
    "channel:adaptive": {
        "ladder": [
            {"label": label, "settings": {"samples": samples}}
            for label, samples in (("2e2", 200), ("2e3", 2000))
        ],
        "common": {"max_depth": 2, "pool": {}, "bodies": 2},
        "calibrate_every": 2,
    },
    "channel:sionna-rt": {"samples": 2000, "pool": {}, "bodies": 2},
    "world:sumo-actuated": {"begin_s": 15.0},  # each life simulates until then
    "sensors:lidar": {"grid": {"minimum_m": [-60, -40, 0], "maximum_m": [80, 30, 12], "cells": [28, 14, 6]}},
}
"""What the small street of the tests needs in other sizes than the scenario."""

FOLLOWING: dict[str, dict[str, object]] = {
    "channel:adaptive": {"common": {"max_depth": 2, "pool": {}, "bodies": 2, "follow": 2}},
    "channel:sionna-rt": {"follow": 2},
}
"""With these settings a frame needs those before it."""


# Of files that settings name; removed when the process ends.
_FOLDER = TemporaryDirectory(prefix="caviar-registry-")


class _Made:
    """Settings that take a while: made when the first test asks for them, not when tests are collected."""

    def __init__(self, make: Callable[[], Mapping[str, Any]]) -> None:
        self._make = cache(make)

    def __get__(self, instance: object, owner: type) -> Mapping[str, Any]:
        return self._make()


@cache
def _heavy_imports() -> dict[str, list[str]]:
    """Heavy libraries that each implementation's module imports in a process of its own, by module.

    The processes are forks of one that has imported what all of them do.
    """
    modules = sorted({load(*key.split(":")).__module__ for key in registered()})
    program = f"""
import json, os, sys
import caviar_services.service
for module in {modules!r}:
    sys.stdout.flush()
    if os.fork() == 0:
        __import__(module)
        print(json.dumps([module, sorted({{m.partition(".")[0] for m in sys.modules}} & set({HEAVY!r}))]))
        sys.exit()
    if os.wait()[1]:
        sys.exit(f"{{module}} cannot be imported")
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return dict(map(json.loads, done.stdout.splitlines()))


def _test_importing_it_imports_nothing_heavy(self: ServiceConformance) -> None:
    """So that an agent or a broker does not carry a ray tracer."""
    assert _heavy_imports()[self.service_class.__module__] == []


def _example(role: str, name: str) -> tuple[Scenario, str] | None:
    """The first shipped scenario with this implementation, and the service's name there."""
    for path in sorted(SCENARIOS.glob("*.toml")):
        scenario = load_scenario(path)
        for service, spec in scenario.services.items():
            if (spec.role, spec.use) == (role, name):
                return scenario, service
    return None


def _first_beams() -> Path:
    """A policy that chooses the first pair of beams for each user, whatever their number."""
    import onnx
    from onnx import TensorProto, helper

    file = Path(_FOLDER.name) / "first-beams.onnx"
    nodes = [
        helper.make_node("Sub", ["aod", "aod"], ["zeros"]),
        helper.make_node("Cast", ["zeros"], ["action"], to=TensorProto.INT64),
    ]
    seen = helper.make_tensor_value_info("aod", TensorProto.FLOAT, [1, None])
    chosen = helper.make_tensor_value_info("action", TensorProto.INT64, [1, None])
    model = helper.make_model(
        helper.make_graph(nodes, "first-beams", [seen], [chosen]),
        opset_imports=[helper.make_opsetid("", 17)],
        ir_version=8,
    )
    onnx.save(model, str(file))
    return file


def _recorded_street() -> Path:
    """A run of the sample street, with products of all topics."""
    tests = type("Recorded", (CONFORMANCE["recorder"],), {"service_class": McapRecorder})
    directory: Path = tests.play(Path(_FOLDER.name)).directory  # type: ignore[attr-defined]
    return directory


def _tests_of(key: str) -> type[ServiceConformance]:
    role, _, name = key.partition(":")
    members: dict[str, object] = {
        "service_class": load(role, name),
        "__module__": __name__,
        "test_importing_it_imports_nothing_heavy": _test_importing_it_imports_nothing_heavy,
    }
    example = _example(role, name)
    if key == "agent:policy" and importlib.util.find_spec("onnx") is not None:
        members["settings"] = _Made(lambda: {"file": f"file:{_first_beams()}", "observe": ["aod"]})
    if key == "agent:fingerprint":
        members["settings"] = _Made(lambda: {"file": f"file:{_recorded_street()}"})
    if key == "agent:mavlink":
        members["settings"] = {"object": "car.a", "listen": "127.0.0.1:0"}
    if key == "agent:out-of-band":  # the street's channel has one carrier, of which it takes the spectrum
        members["settings"] = {"aid": samples.CARRIERS[0].name}
        higher = replace(samples.CARRIERS[0], name="higher", frequency_hz=60e9)
        members["carriers"] = (*samples.CARRIERS, higher)
    if example is not None:
        scenario, service = example
        members["settings"] = {**scenario.services[service].settings, **OVERRIDES.get(key, {})}
        if role == "world":
            members["devices"] = tuple(
                d for i, d in enumerate(scenario.devices) if world_of(scenario, i) == service
            )
    title = "Test" + "".join(word.capitalize() for word in f"{role}-{name}".split("-"))
    tests = type(title, (CONFORMANCE[role],), members)
    if key == "world:airsim":  # tests/unit/test_world_airsim.py has one
        tests = pytest.mark.skip(reason="the world airsim needs a simulator")(tests)
    package = EXTRAS.get(key)
    if package is not None and importlib.util.find_spec(package) is None:
        tests = pytest.mark.skip(reason=f"{key} needs {package}")(tests)
    return tests


for _key in registered():
    _tests = _tests_of(_key)
    globals()[_tests.__name__] = _tests
del _tests  # pytest would collect it by this name, too


@pytest.mark.parametrize("key", FOLLOWING)
def test_what_is_followed_goes_on_in_another_process(key: str, tmp_path: Path) -> None:
    """In the registry's tests each frame stands on its own; here none does."""
    pytest.importorskip("sionna")
    tests = _tests_of(key)
    tests.settings = {**tests.settings, **FOLLOWING[key]}
    tests().test_another_process_goes_on_with_the_same_bytes(tmp_path)
