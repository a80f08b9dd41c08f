"""A place in a run that a process of the user's fills, in any language, and comes back to."""

from __future__ import annotations

import ast
import json
import os
import re
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from node_project import node_project
from scenarios_support import (
    ROOT,
    caviar,
    environment,
    eventually,
    pid_of,
    recorded_below,
    run,
    running,
    scenario_file,
)

MINIMAL = ROOT / "clients" / "minimal"
PYTHON, NODE = MINIMAL / "agent.py", MINIMAL / "node" / "agent.mjs"
MAX_LINES = 69
WITHIN_S = 30.0

Agent = Callable[[str, str], list[str]]
"""Command line of an agent, from endpoint and name."""


@pytest.fixture(scope="module", params=["python", pytest.param("node", marks=pytest.mark.exhaustive)])
def agent(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config
) -> Agent:
    """Each of the two minimal agents."""
    if request.param == "python":
        return python_agent
    cache = pytestconfig.cache
    folder = cache.mkdir("minimal-node") if cache is not None else tmp_path_factory.mktemp("node")
    script = node_project(NODE.parent, NODE.name, folder) / NODE.name
    return lambda endpoint, name: ["node", str(script), endpoint, name]


def python_agent(endpoint: str, name: str) -> list[str]:
    return [sys.executable, str(PYTHON), endpoint, name]


class Remote:
    """``caviar run`` with a remote agent, whose output is read line by line."""

    def __init__(self, process: subprocess.Popen[str], mark: str, out: Path) -> None:
        self._process, self.mark, self.out = process, mark, out
        self.output = ""
        self.endpoint = re.findall(r"tcp://[\w.:-]+", self.line("waiting for 'agent' (agent) at"))[0]

    def line(self, text: str) -> str:
        """The first line with a text, once it is there; it and what is before it are taken."""
        assert self._process.stdout is not None
        before, until = self.output, time.monotonic() + WITHIN_S
        while text not in self.output or not self.output.partition(text)[2].count("\n"):
            ready, _, _ = select.select([self._process.stdout], [], [], max(0.0, until - time.monotonic()))
            data = os.read(self._process.stdout.fileno(), 65536) if ready else b""
            assert data, f"{text!r} did not come: {before + self.output}"
            self.output += data.decode()
        head, _, tail = self.output.partition(text)
        rest, _, self.output = tail.partition("\n")
        return head.rpartition("\n")[2] + text + rest

    @contextmanager
    def agent(self, command: Agent, name: str = "agent") -> Iterator[subprocess.Popen[str]]:
        """An agent as a process of its own."""
        with subprocess.Popen(
            command(self.endpoint, name),
            env=environment(self.mark),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as process:
            try:
                yield process
            finally:
                process.kill()

    def killed_after(self, command: Agent, frames: int) -> None:
        """An agent that is killed once so many frames are recorded."""
        with self.agent(command) as process:
            eventually(lambda: recorded_below(self.out) >= frames, WITHIN_S, f"{frames} frames are recorded")
            process.send_signal(signal.SIGKILL)
            assert process.wait(WITHIN_S) == -signal.SIGKILL

    def ended(self) -> tuple[int, str]:
        """Status of the run, and what it printed since the last `line`."""
        output, _ = self._process.communicate(timeout=2 * WITHIN_S)
        return self._process.returncode, self.output + output

    def summary(self) -> dict[str, object]:
        """What ``caviar run`` wrote of the run."""
        found: dict[str, object] = json.loads(next(self.out.glob("*/summary.json")).read_text())
        return found


@contextmanager
def remote(folder: Path, frames: int, *changes: tuple[str, str], bind: str = "") -> Iterator[Remote]:
    """The shipped scenario with a remote agent."""
    scenario, out = scenario_file(folder, changes, base="remote"), folder / "out"
    arguments = ["--frames", str(frames), *(["--bind", bind] if bind else [])]
    with running(scenario, out, *arguments) as (process, mark):
        yield Remote(process, mark, out)


LONG = 500
"""Frames of a run that is disturbed in the middle."""


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> object:
    """Digest of such a run, undisturbed."""
    with (
        remote(tmp_path_factory.mktemp("undisturbed"), LONG) as waiting,
        waiting.agent(python_agent) as process,
    ):
        assert waiting.ended()[0] == 0
        assert process.wait(WITHIN_S) == 0
        return waiting.summary()["digest"]


def test_a_minimal_agent_plays_an_episode_and_its_choices_are_recorded(tmp_path: Path, agent: Agent) -> None:
    with remote(tmp_path, 100) as waiting, waiting.agent(agent) as process:
        status, output = waiting.ended()
        assert status == 0, output
        assert process.wait(WITHIN_S) == 0
        assert process.stdout is not None
        assert process.stdout.read() == ""
        summary = waiting.summary()
        assert summary["frames"] == 100
        mean, best = summary["mean_abs_y"], summary["mean_abs_y_best"]
        assert isinstance(mean, float)
        assert isinstance(best, float)
        assert 0.9 * best < mean < best, "the beams of the frame before are nearly the best ones"
        directory = next(waiting.out.glob("*/"))
    digest = caviar("inspect", "--digest", directory)
    assert digest.output.split() == [summary["digest"]]
    assert caviar("inspect", directory).status == 0


def test_a_killed_agent_that_is_started_again_rejoins_and_nothing_is_lost(
    tmp_path: Path, agent: Agent, undisturbed: object
) -> None:
    with remote(tmp_path, LONG) as waiting:
        waiting.killed_after(agent, 20)
        waiting.killed_after(agent, 120)  # started before the loss of the first was told, perhaps
        away = [waiting.line("away: agent"), waiting.line("away: agent")][-1]
        assert "at most 30 s (timeouts.rejoin_s)" in away
        example = f"python clients/minimal/agent.py {waiting.endpoint} agent"
        assert f"start it again as before (or, the example,  {example})" in away
        with waiting.agent(agent) as process:
            assert "came back after" in waiting.line("back: agent")
            status, output = waiting.ended()
            assert process.wait(WITHIN_S) == 0
        assert status == 0, output
        summary = waiting.summary()
    assert summary["frames"] == LONG
    assert summary["digest"] == undisturbed


def test_an_agent_that_stays_away_ends_the_run_with_blame(tmp_path: Path) -> None:
    changes = ("connect_s = 120", "connect_s = 120\nrejoin_s = 0.5")
    with remote(tmp_path, 100_000, changes) as waiting:
        waiting.killed_after(python_agent, 5)
        assert "at most 0.5 s (timeouts.rejoin_s)" in waiting.line("away: agent")
        status, output = waiting.ended()
    assert status == 1
    assert "agent 'agent' died and did not come back within 0.5 s (timeouts.rejoin_s)" in output


def test_the_place_waits_at_the_address_that_was_asked_for(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        bind = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    with remote(tmp_path, 10, bind=bind) as waiting, waiting.agent(python_agent):
        assert waiting.endpoint == bind
        assert waiting.ended()[0] == 0


def test_nobody_comes_and_the_place_is_named(tmp_path: Path) -> None:
    scenario = scenario_file(tmp_path, [("connect_s = 120", "connect_s = 8")], base="remote")
    finished = run(scenario, tmp_path / "out")
    assert finished.status == 1
    told = "agent 'agent' did not connect within 8 s (timeouts.connect_s); start agent while the run waits"
    assert told in finished.output
    assert finished.leftovers == []


def test_an_agent_of_another_name_is_refused_and_the_run_goes_on_waiting(
    tmp_path: Path, agent: Agent
) -> None:
    with remote(tmp_path, 10) as waiting:
        with waiting.agent(agent, "agnet") as process:
            assert process.wait(WITHIN_S) == 1
            assert process.stdout is not None
            assert "REFUSE: the run has no service 'agnet'; did you mean 'agent'?" in process.stdout.read()
        assert "the run has no service 'agnet'" in waiting.line("refused: agnet")
        with waiting.agent(agent):
            assert waiting.ended()[0] == 0


def test_an_agent_exits_when_the_broker_is_gone(tmp_path: Path, agent: Agent) -> None:
    with remote(tmp_path, 100_000) as waiting, waiting.agent(agent) as process:
        eventually(lambda: recorded_below(waiting.out) > 3, WITHIN_S, "a few frames are recorded")
        os.kill(pid_of(waiting.mark, "caviar_broker"), signal.SIGKILL)
        assert process.wait(WITHIN_S) == 1
        assert process.stdout is not None
        assert "no answer to a heartbeat" in process.stdout.read()


def test_a_run_in_one_process_refuses_a_remote_service_by_file_and_line(tmp_path: Path) -> None:
    scenario = scenario_file(tmp_path, base="remote")
    line = 1 + scenario.read_text()[: scenario.read_text().index('use = "remote"')].count("\n")
    finished = run(scenario, tmp_path / "out", "--embedded")
    assert finished.status == 1
    assert f"{scenario}:{line}" in finished.output
    assert "services.agent.use" in finished.output
    assert "without --embedded" in finished.output
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("source", [PYTHON, NODE], ids=["python", "node"])
def test_a_minimal_agent_fits_on_a_page(source: Path) -> None:
    assert len(source.read_text().splitlines()) <= MAX_LINES


def test_the_minimal_agents_need_nothing_but_zeromq_and_messagepack() -> None:
    imported = {
        alias.name.partition(".")[0]
        for node in ast.walk(ast.parse(PYTHON.read_text()))
        for alias in (node.names if isinstance(node, ast.Import) else ())
    }
    assert not any(isinstance(node, ast.ImportFrom) for node in ast.walk(ast.parse(PYTHON.read_text())))
    assert imported - sys.stdlib_module_names == {"zmq", "msgpack"}
    package = json.loads((NODE.parent / "package.json").read_text())
    modules = set(re.findall(r'from "([^"]+)"', NODE.read_text()))
    assert {name for name in modules if not name.startswith("node:")} == set(package["dependencies"])
    assert set(package["dependencies"]) == {"zeromq", "@msgpack/msgpack"}
