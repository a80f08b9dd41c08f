"""An agent over a WebSocket in a real run: the same agents, and the same digest, as over ZeroMQ."""

from __future__ import annotations

import json
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from node_project import node_project
from scenarios_support import ROOT, environment, eventually, recorded_below, running, scenario_file

from caviar_broker.control.socket import ask
from caviar_protocol.errors import RunError

HERE = Path(__file__).parent
MINIMAL = ROOT / "clients" / "minimal"
WITHIN_S = 30.0
FRAMES = 300


class WebRun:
    """``caviar run --http`` of the shipped scenario that waits for an agent."""

    def __init__(self, process: subprocess.Popen[str], mark: str, out: Path) -> None:
        self.process, self.mark, self.out, self.output = process, mark, out, ""
        eventually(lambda: bool(self.served()), WITHIN_S, "HTTP is served")
        self.url = self.served().replace("http:", "ws:") + "/ws"

    def served(self) -> str:
        for directory in self.out.glob("*/"):
            try:
                return str(ask(directory, do="status")["status"].get("http", ""))
            except RunError:
                return ""
        return ""

    @property
    def endpoint(self) -> str:
        return str(ask(next(self.out.glob("*/")), do="status")["status"]["endpoint"])

    @contextmanager
    def agent(self, *command: str) -> Iterator[subprocess.Popen[bytes]]:
        with subprocess.Popen(command, env=environment(self.mark)) as process:
            try:
                yield process
            finally:
                process.kill()

    def digest(self) -> str:
        """Of the run, once it is over."""
        output, _ = self.process.communicate(timeout=2 * WITHIN_S)
        assert self.process.returncode == 0, output
        self.output = output
        return str(json.loads(next(self.out.glob("*/summary.json")).read_text())["digest"])


@contextmanager
def web_run(folder: Path, frames: int, *changes: tuple[str, str]) -> Iterator[WebRun]:
    scenario, out = scenario_file(folder, changes, base="remote"), folder / "out"
    with running(scenario, out, "--frames", str(frames), "--http", "127.0.0.1:0") as (process, mark):
        yield WebRun(process, mark, out)


@pytest.fixture(scope="module")
def over_zeromq(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Digest of the run with the minimal Python agent over ZeroMQ."""
    with web_run(tmp_path_factory.mktemp("zeromq"), FRAMES) as run:
        with run.agent(sys.executable, str(MINIMAL / "agent.py"), run.endpoint, "agent") as agent:
            digest = run.digest()
            assert agent.wait(WITHIN_S) == 0
        return digest


def python_agent(url: str) -> list[str]:
    return [sys.executable, str(HERE / "websocket_zmq.py"), str(MINIMAL / "agent.py"), url, "agent"]


def test_an_agent_over_a_websocket_plays_the_run_that_it_plays_over_zeromq(
    tmp_path: Path, over_zeromq: str
) -> None:
    with web_run(tmp_path, FRAMES) as run, run.agent(*python_agent(run.url)) as agent:
        assert run.digest() == over_zeromq
        assert agent.wait(WITHIN_S) == 0


@pytest.mark.exhaustive
def test_an_agent_with_the_websocket_of_node_plays_it_too(
    tmp_path: Path, over_zeromq: str, pytestconfig: pytest.Config
) -> None:
    command = node_with_websocket()
    cache = pytestconfig.cache
    source = cache.mkdir("minimal-node") if cache is not None else tmp_path
    project = node_project(MINIMAL / "node", "agent.mjs", source)
    folder = tmp_path / "node"
    messagepack = folder / "node_modules" / "@msgpack"
    shutil.copytree(project / "node_modules" / "@msgpack", messagepack)
    shim = folder / "node_modules" / "zeromq"
    shim.mkdir()
    (shim / "package.json").write_text('{"name": "zeromq", "type": "module", "exports": "./index.mjs"}')
    shutil.copy(HERE / "websocket_zeromq.mjs", shim / "index.mjs")
    shutil.copy(MINIMAL / "node" / "agent.mjs", folder)
    command += [str(folder / "agent.mjs")]
    with web_run(tmp_path, FRAMES) as run, run.agent(*command, run.url, "agent"):
        assert run.digest() == over_zeromq


def node_with_websocket() -> list[str]:
    """Node with a WebSocket of its own; skips by name where there is none."""
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    told = subprocess.run(["node", "--version"], capture_output=True, text=True, check=True).stdout
    major, minor = map(int, re.findall(r"\d+", told)[:2])
    if (major, minor) < (20, 10):
        pytest.skip(f"node {told.strip()} has no WebSocket; 20.10 has")
    return ["node"] if major >= 22 else ["node", "--experimental-websocket"]


def test_an_agent_that_is_killed_behind_its_websocket_is_noticed_and_blamed(tmp_path: Path) -> None:
    changes = ("connect_s = 120", "connect_s = 120\nrejoin_s = 0")
    with web_run(tmp_path, 100_000, changes) as run, run.agent(*python_agent(run.url)) as agent:
        eventually(lambda: recorded_below(run.out) >= 5, WITHIN_S, "a few frames are recorded")
        agent.send_signal(signal.SIGKILL)
        output, _ = run.process.communicate(timeout=120)
        assert run.process.returncode == 1
        assert "agent 'agent' died" in output


def test_an_agent_that_is_killed_behind_its_websocket_may_come_back(tmp_path: Path, over_zeromq: str) -> None:
    with web_run(tmp_path, FRAMES) as run:
        with run.agent(*python_agent(run.url)) as first:
            eventually(lambda: recorded_below(run.out) >= 5, WITHIN_S, "a few frames are recorded")
            first.send_signal(signal.SIGKILL)
        with run.agent(*python_agent(run.url)):
            assert run.digest() == over_zeromq
        assert "back: agent" in run.output
