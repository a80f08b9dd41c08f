"""Policies on their way: to agents on other machines, over deaths of the broker, and at a real pace."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from forked import Forked
from msgspec.structs import replace
from scenarios_support import (
    PRELOAD,
    Finished,
    caviar,
    environment,
    eventually,
    marked,
    pid_of,
    recorded_below,
    running,
)
from test_network_outage import endpoint_below

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from policy_files import constant_policy, scenario_with

from caviar_protocol.recording import Recording
from caviar_protocol.recording.reader import recorded_decisions
from caviar_services.agent.policy import CARD_KEY, PolicyModel, read_card, write_card

WITHIN_S = 40.0
OTHERS = {
    "world": "world:trajectory",
    "channel": "channel:geometric",
    "link": "link:beams",
    "recorder": "recorder:mcap",
}
"""Services of `geometric` beside its agent."""


def decided(directory: Path) -> list[str]:
    """SHA-256 of the policy of each frame."""
    found = recorded_decisions(Recording(directory))
    return [found["agent", 0, frame]["policy"] for frame in range(len(found))]


def replayed(directory: Path, out: Path) -> None:
    """A replay that computes everything again makes the same bytes."""
    again = caviar("replay", directory, "--again", "--out", out)
    assert again.status == 0, again.output
    assert "byte for byte" in again.output
    assert decided(next(out.glob("*/"))) == decided(directory)


def swapped(directory: Path, file: Path) -> Finished:
    done = caviar("policy", "swap", file, "--run", directory)
    assert done.status == 0, done.output
    return done


def carded(policy: Path, file: Path, observe: tuple[str, ...]) -> Path:
    """A policy as it is, with a card that says that it observes something else."""
    import onnx

    model = onnx.load(str(policy))
    card = replace(read_card(model.metadata_props[0].value), observe=observe)
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, {CARD_KEY: write_card(card)})
    file.write_bytes(model.SerializeToString())
    return file


@contextlib.contextmanager
def service(name: str, use: str, endpoint: str, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A service as on a machine of its own: another folder, and an empty cache."""
    folder.mkdir()
    command = [sys.executable, "-m", "caviar_clients", "service", name, "--use", use, "--broker", endpoint]
    with Forked(
        command, PRELOAD, cwd=folder, env=environment("travels", XDG_CACHE_HOME=str(folder / "cache")),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    ) as process:  # fmt: skip
        try:
            yield process
        finally:
            process.kill()


def test_an_agent_over_tcp_needs_no_copy_and_takes_a_swap(tmp_path: Path) -> None:
    first, second = (constant_policy(tmp_path / f"{pair}.onnx", pair) for pair in (3, 5))
    digests = [PolicyModel(file).digest for file in (first, second)]
    scenario, out = scenario_with(tmp_path, first.name, 400), tmp_path / "out"
    command = [sys.executable, "-m", "caviar_clients", "broker", str(scenario), "--out", str(out)]
    with contextlib.ExitStack() as started:
        broker = started.enter_context(
            Forked(
                [*command, "--bind", "tcp://127.0.0.1:0", "--pace", "4"], PRELOAD,
                env=environment("travels", XDG_CACHE_HOME=str(tmp_path / "here")),
                stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )
        )  # fmt: skip
        started.callback(broker.kill)
        eventually(lambda: endpoint_below(out), WITHIN_S, "the broker listens")
        directory, endpoint = next(out.glob("*/")), endpoint_below(out)
        first.unlink()  # what travels is the run's own copy
        for name, use in OTHERS.items():
            started.enter_context(service(name, use, endpoint, tmp_path / name))
        agent = started.enter_context(service("agent", "agent:policy", endpoint, tmp_path / "there"))
        eventually(lambda: recorded_below(out) > 5, WITHIN_S, "frames are recorded")
        swapped(directory, second)
        second.unlink()
        assert broker.wait(120) == 0
        assert agent.wait(WITHIN_S) == 0
    cached = " ".join(str(path) for path in (tmp_path / "there" / "cache").rglob("*") if path.is_file())
    assert all(digest in cached for digest in digests), "both came over the network"
    before = decided(directory)
    assert {*before} == {*digests}
    assert sum(a != b for a, b in pairwise(before)) == 1
    replayed(directory, tmp_path / "again")


@pytest.mark.exhaustive
def test_a_broker_that_dies_after_a_swap_is_followed_by_one_that_knows_it(tmp_path: Path) -> None:
    """And what was refused to somebody who did not wait is not what the agent comes back with."""
    first, second, torn = (tmp_path / f"{name}.onnx" for name in ("first", "second", "torn"))
    constant_policy(first, 3)
    constant_policy(second, 5)
    torn.write_bytes(second.read_bytes()[:150])
    digests = [PolicyModel(file).digest for file in (first, second)]
    scenario, out = scenario_with(tmp_path, first.name, 1500), tmp_path / "out"
    with running(scenario, out, "--pace", "4") as (process, mark):
        eventually(lambda: recorded_below(out) > 20, WITHIN_S, "frames are recorded")
        directory = next(out.glob("*/"))
        swapped(directory, second)
        # Nobody waits for what comes of it, so the run keeps the torn file.
        assert caviar("policy", "swap", torn, "--run", directory, "--wait", "0").status == 1
        events = directory / "events.jsonl"
        eventually(lambda: "is refused" in events.read_text(), WITHIN_S, "the agent refuses it")
        seen = recorded_below(out)
        for entry in [f"{process.pid} ", *marked(mark)]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(entry.split()[0]), signal.SIGKILL)
        process.communicate(timeout=120)
    second.unlink()
    resumed = caviar("run", "--resume", directory, timeout=180)
    assert resumed.status == 0, resumed.output
    assert resumed.leftovers == []
    before = decided(directory)
    assert len(before) == 1500 > seen
    assert sum(a != b for a, b in pairwise(before)) == 1
    assert (before[0], before[-1]) == tuple(digests)
    replayed(directory, tmp_path / "again")


@pytest.mark.exhaustive
def test_at_a_given_pace_no_frame_is_missed_while_policies_are_swapped(tmp_path: Path) -> None:
    files = [constant_policy(tmp_path / f"{pair}.onnx", pair) for pair in (3, 5, 9)]
    scenario, out = scenario_with(tmp_path, files[0].name, 100), tmp_path / "out"
    text = scenario.read_text()
    for name in ("agent", "link"):
        text = text.replace(f'role = "{name}"', f'role = "{name}"\npolicy = "hold"', 1)
    scenario.write_text(text.replace("budget_ms = 20", "budget_ms = 300"))
    # Slower than real time: a machine that runs other tests beside this one takes 100 ms for nothing.
    with running(scenario, out, "--pace", "0.3") as (process, _):
        eventually(lambda: recorded_below(out) > 10, WITHIN_S, "frames are recorded")
        directory = next(out.glob("*/"))
        for file in files[1:]:
            swapped(directory, file)
        # Its refusal quotes the card, which is longer than any message may be.
        refused = caviar(
            "swap", carded(files[0], tmp_path / "long.onnx", ("x" * 1_200_000,)), "--run", directory
        )
        assert refused.status == 1
        assert "no observation is called 'xxx" in refused.output
        assert len(refused.output) < 1000
        output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    assert len({*decided(directory)}) == 3
    summary = json.loads((directory / "summary.json").read_text())
    assert summary["frames"] == 100
    assert {name: summary["services"][name]["misses"] for name in ("agent", "link")} == {
        "agent": 0,
        "link": 0,
    }


def test_swaps_while_a_run_is_paused_and_its_agent_dies_begin_with_its_next_frames(tmp_path: Path) -> None:
    files = [constant_policy(tmp_path / f"{pair}.onnx", pair) for pair in (3, 5, 9)]
    digests = [PolicyModel(file).digest for file in files]
    more = "\n[timeouts]\nrejoin_s = 30.0\n"
    scenario, out = scenario_with(tmp_path, files[0].name, 4000, more), tmp_path / "out"
    with running(scenario, out, "--http", "127.0.0.1:0", "--pace", "10") as (process, mark):
        eventually(lambda: recorded_below(out) > 5, WITHIN_S, "frames are recorded")
        directory = next(out.glob("*/"))
        eventually(lambda: noted_url(directory), WITHIN_S, "HTTP is served")
        url = noted_url(directory)
        assert post(f"{url}/pause")[1]["paused"] is True
        for file in files[1:]:
            status, answer = post(f"{url}/policies/agent?wait=0", file.read_bytes())
            assert (status, answer["state"]) == (200, "offered")
        os.kill(pid_of(mark, "caviar_services agent"), signal.SIGKILL)
        assert post(f"{url}/resume")[1]["paused"] is False
        # Answered once a frame was decided by it: the same file again is no other order.
        status, answer = post(f"{url}/policies/agent?wait=40", files[2].read_bytes())
        assert (status, answer["state"]) == (200, "serving")
        seen = recorded_below(out)
        eventually(lambda: recorded_below(out) > seen + 5, WITHIN_S, "the run goes on")
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=120)
    before = decided(directory)
    assert len(before) > seen, output
    # The one in between was overtaken before it could decide a frame.
    assert [before[0], before[-1]] == [digests[0], digests[2]]
    assert before[answer["frame"] - 1 : answer["frame"] + 1] == [digests[0], digests[2]]
    assert {*before} == {digests[0], digests[2]}
    replayed(directory, tmp_path / "again")


def noted_url(directory: Path) -> str:
    """Where the HTTP process of a run serves; empty before it does."""
    try:
        return str(json.loads((directory / "control.json").read_text()).get("http", ""))
    except (OSError, json.JSONDecodeError):
        return ""


def post(url: str, content: bytes = b"") -> tuple[int, dict[str, Any]]:
    """Give an order over HTTP."""
    request = urllib.request.Request(url, content, method="POST")  # noqa: S310
    with urllib.request.urlopen(request, timeout=120) as answer:  # noqa: S310
        return answer.status, json.loads(answer.read())
