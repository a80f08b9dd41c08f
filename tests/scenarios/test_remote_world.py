"""A world that was written from SPEC.md alone, in a real run: over ZeroMQ, over WebSocket, and killed."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from node_project import node_project
from scenarios_support import ROOT, eventually, recorded_below, running
from test_websocket_agent import HERE, WITHIN_S, WebRun, node_with_websocket

from caviar_protocol.recording import Recording

MINIMAL = ROOT / "clients" / "minimal"
FRAMES = 100


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config) -> Path:
    """The world with what it needs; skips by name where Node or npm is missing."""
    cache = pytestconfig.cache
    folder = cache.mkdir("minimal-node") if cache is not None else tmp_path_factory.mktemp("node")
    return node_project(MINIMAL / "node", "world.mjs", folder)


@contextmanager
def waiting_run(folder: Path) -> Iterator[WebRun]:
    out = folder / "out"
    options = ("--frames", str(FRAMES), "--http", "127.0.0.1:0")
    with running(MINIMAL / "world.toml", out, *options) as (process, mark):
        yield WebRun(process, mark, out)


@pytest.fixture(scope="module")
def undisturbed(project: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Digest and directory of the run with the world over ZeroMQ."""
    with waiting_run(tmp_path_factory.mktemp("zeromq")) as run:
        with run.agent("node", str(project / "world.mjs"), run.endpoint, "world") as world:
            digest = run.digest()
            assert world.wait(WITHIN_S) == 0
        return digest, next(run.out.glob("*/"))


def test_devices_are_where_the_scenario_puts_them(undisturbed: tuple[str, Path]) -> None:
    recording = Recording(undisturbed[1])
    scenes = [
        scene for scene in (recording.frame(0, frame).scene() for frame in (0, 30, 60)) if scene is not None
    ]
    names = [[device.name for device in scene.devices] for scene in scenes]
    assert names[0] == names[1] == ["bs", "car.a/rx", "uav/rx-uav"]
    assert names[2] == ["bs", "car.b/rx", "uav/rx-uav"]


def test_over_a_websocket_it_makes_the_same_run(
    project: Path, undisturbed: tuple[str, Path], tmp_path: Path
) -> None:
    modules = tmp_path / "node" / "node_modules"
    shutil.copytree(project / "node_modules" / "@msgpack", modules / "@msgpack")
    shim = modules / "zeromq"
    shim.mkdir()
    (shim / "package.json").write_text('{"name": "zeromq", "type": "module", "exports": "./index.mjs"}')
    shutil.copy(HERE / "websocket_zeromq.mjs", shim / "index.mjs")
    script = shutil.copy(MINIMAL / "node" / "world.mjs", tmp_path / "node")
    with waiting_run(tmp_path) as run, run.agent(*node_with_websocket(), str(script), run.url, "world"):
        assert run.digest() == undisturbed[0]


def test_killed_and_started_again_it_goes_on_with_the_same_digest(
    project: Path, undisturbed: tuple[str, Path], tmp_path: Path
) -> None:
    with waiting_run(tmp_path) as run:
        command = ("node", str(project / "world.mjs"), run.endpoint, "world")
        with run.agent(*command) as first:
            eventually(lambda: recorded_below(run.out) >= 5, WITHIN_S, "a few frames are recorded")
            first.send_signal(signal.SIGKILL)
        with run.agent(*command):
            assert run.digest() == undisturbed[0]
        assert "back: world" in run.output
