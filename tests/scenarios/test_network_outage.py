"""A remote agent whose network is gone for a while: it comes back by itself, and nothing is lost."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from scenarios_support import caviar, environment, eventually, recorded_below, running, scenario_file

from caviar_protocol import keys as k

FRAMES = 300
WITHIN_S = 30.0
BACK_WITHIN_S = 3.0
"""[s] after the link's return, within which the agent is back."""


def ip(*words: str) -> None:
    """One command of iproute2."""
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


@dataclass
class Link:
    """A cable to another machine: a network namespace, which the agent's process lives in."""

    namespace: str
    device: str
    here: str
    """Address of this end."""

    def set(self, state: str) -> None:
        """Pull the cable (``down``), or plug it in (``up``)."""
        ip("link", "set", self.device, state)

    def command(self, *words: str) -> list[str]:
        """A command at the other end, where processes have other numbers, too."""
        other = ["unshare", "--pid", "--fork", "--kill-child", "--mount-proc"]
        return ["ip", "netns", "exec", self.namespace, *other, *words]


@pytest.fixture
def cable() -> Iterator[Link]:
    if shutil.which("ip") is None or shutil.which("unshare") is None:
        pytest.skip("network namespaces need iproute2 and util-linux")
    mark, number = uuid.uuid4().hex[:8], os.getpid() % 250
    found = Link(f"caviar-{mark}", f"cav{mark}", f"10.213.{number}.1")
    try:
        ip("netns", "add", found.namespace)
    except subprocess.CalledProcessError as error:
        pytest.skip(f"network namespaces are not allowed here: {error.stderr.strip()}")
    try:
        ip("link", "add", found.device, "type", "veth", "peer", "name", "eth0", "netns", found.namespace)
        ip("addr", "add", f"{found.here}/30", "dev", found.device)
        ip("-n", found.namespace, "addr", "add", f"10.213.{number}.2/30", "dev", "eth0")
        ip("-n", found.namespace, "link", "set", "eth0", "up")
        found.set("up")
        yield found
    finally:
        subprocess.run(["ip", "link", "del", found.device], check=False, capture_output=True)
        ip("netns", "del", found.namespace)


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    directory = tmp_path / "keys"
    for arguments in (["new", "broker"], ["new", "agent", "--role", "agent"]):
        assert caviar("keys", *arguments, "--directory", directory).status == 0
    return directory


@contextmanager
def remote_run(out: Path, scenario: Path, keys: Path, cable: Link) -> Iterator[tuple[Path, list[str]]]:
    """``caviar run`` with its agent at the other end of the cable: the run's directory, and what both
    printed once they have ended well."""
    arguments = ["--bind", f"tcp://{cable.here}:0", "--keys", str(keys)]
    outputs: list[str] = []
    with running(scenario, out, *arguments) as (process, mark):
        eventually(lambda: endpoint_below(out), WITHIN_S, "the broker listens")
        directory, endpoint = next(out.glob("*/")), endpoint_below(out)
        shown = {k.KEY_VARIABLE: str(keys / "agent.key"), k.BROKER_KEY_VARIABLE: str(keys / "broker.pub")}
        agent = [sys.executable, "-m", "caviar_clients", "service", "agent"]
        command = cable.command(*agent, "--use", "agent:random", "--broker", endpoint)
        with subprocess.Popen(
            command,
            env=environment(mark, **shown),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        ) as other:
            try:
                yield directory, outputs
                outputs.append(process.communicate(timeout=2 * WITHIN_S)[0])
                outputs.append(other.communicate(timeout=WITHIN_S)[0])
                assert (process.returncode, other.returncode) == (0, 0), outputs
            finally:
                other.kill()


def endpoint_below(out: Path) -> str:
    """Where the broker of the only run below a folder listens; empty before it does."""
    for path in out.glob("*/run.json"):
        endpoint = str(json.loads(path.read_text())["endpoint"])
        return "" if endpoint.endswith(":0") else endpoint
    return ""


def digest_of(directory: Path) -> str:
    return str(json.loads((directory / "summary.json").read_text())["digest"])


@pytest.mark.parametrize("seconds", [3.0, pytest.param(10.0, marks=pytest.mark.exhaustive)])
def test_an_agent_without_network_is_back_soon_after_it_returns_and_the_digest_is_the_same(
    tmp_path: Path, cable: Link, keys: Path, seconds: float
) -> None:
    scenario = scenario_file(tmp_path, [("frames = 100", f"frames = {FRAMES}")], base="remote")
    with remote_run(tmp_path / "peace", scenario, keys, cable) as (undisturbed, _):
        pass
    with remote_run(tmp_path / "outage", scenario, keys, cable) as (directory, outputs):
        eventually(lambda: recorded_below(tmp_path / "outage") > 20, WITHIN_S, "20 frames are recorded")
        cable.set("down")
        pulled = time.monotonic()
        eventually(lambda: time.monotonic() - pulled > seconds, 2 * seconds, "the outage is over")
        frames = recorded_below(tmp_path / "outage")
        cable.set("up")
        plugged = time.monotonic()
        eventually(lambda: recorded_below(tmp_path / "outage") > frames + 1, WITHIN_S, "frames are recorded")
        back_s = time.monotonic() - plugged
    sys.stdout.write(f"without network for {seconds:g} s, back {back_s:.2f} s after its return\n")
    assert digest_of(directory) == digest_of(undisturbed)
    assert frames < FRAMES - 1
    assert back_s < BACK_WITHIN_S
    run, agent = outputs
    assert "away: agent" in run
    assert "timeouts.rejoin_s" in run
    assert re.search(r"trying to come back for at most 30 s \(timeouts.rejoin_s\)", agent)
    assert "as attempt 2" in agent
