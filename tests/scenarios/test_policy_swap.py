"""Policies that are swapped while a run of real processes goes on."""

from __future__ import annotations

import json
import os
import signal
import urllib.error
import urllib.request
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from scenarios_support import caviar, eventually, pid_of, recorded_below, running

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

from policy_files import constant_policy, scenario_with

from caviar_protocol.recording import Recording
from caviar_protocol.recording.reader import recorded_decisions
from caviar_services.agent.policy import PolicyModel


def decided(directory: Path) -> list[str]:
    """SHA-256 of the policy of each frame."""
    found = recorded_decisions(Recording(directory))
    return [found["agent", 0, frame]["policy"] for frame in range(len(found))]


def posted(url: str, content: bytes) -> tuple[int, dict[str, Any]]:
    request = urllib.request.Request(f"{url}/policies/agent", content, method="POST")  # noqa: S310
    try:
        with urllib.request.urlopen(request, timeout=120) as answer:  # noqa: S310
            return answer.status, json.loads(answer.read())
    except urllib.error.HTTPError as error:
        return error.code, json.loads(error.read())


def test_a_policy_is_swapped_while_the_run_goes_on_and_the_replay_is_the_same(tmp_path: Path) -> None:
    first, second, third = (constant_policy(tmp_path / f"{pair}.onnx", pair) for pair in (3, 5, 9))
    other = constant_policy(tmp_path / "other.onnx", 3, beams=(32, 1))
    torn = tmp_path / "torn.onnx"
    torn.write_bytes(second.read_bytes()[:150])
    digests = [PolicyModel(file).digest for file in (first, second, third)]
    scenario = scenario_with(tmp_path, first.name, 4000, "\n[timeouts]\nrejoin_s = 20.0\n")
    out = tmp_path / "out"
    out.mkdir()
    with running(scenario, out, "--http", "127.0.0.1:0", "--pace", "2") as (process, mark):
        eventually(lambda: recorded_below(out) > 20, 30, "frame 20 is recorded")
        directory = next(out.glob("*/"))
        swapped = caviar("policy", "swap", second, "--run", directory)
        assert swapped.status == 0, swapped.output
        assert "from frame" in swapped.output
        for bad, why in ((torn, "no ONNX model"), (other, "32 × 1"), (tmp_path / "no.onnx", "No such file")):
            refused = caviar("policy", "swap", bad, "--run", directory)
            assert refused.status == 1
            assert why in refused.output
        os.kill(pid_of(mark, "caviar_services agent"), signal.SIGKILL)
        eventually(lambda: '"back"' in (directory / "events.jsonl").read_text(), 30, "the agent came back")
        url = json.loads((directory / "control.json").read_text())["http"]
        status, answer = posted(url, third.read_bytes())
        assert (status, answer["state"], answer["sha256"]) == (200, "serving", digests[2])
        status, answer = posted(url, torn.read_bytes())
        assert (status, "no ONNX model" in answer["detail"]) == (409, True)
        assert caviar("policy", "swap", first, "--run", directory, "--agent", "link").status == 1
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=120)
    before = decided(directory)
    assert sorted({*before}) == sorted(digests), output
    # Each in one piece: also after the kill it served the policy that it had been given.
    assert sum(a != b for a, b in pairwise(before)) == 2
    assert {int(beam) for beam in Recording(directory)["link"].tx_beam.ravel()} == {3, 5, 9}
    first.unlink()  # the run has what decided its frames
    again = caviar("replay", directory, "--again", "--out", tmp_path / "again")
    assert again.status == 0, again.output
    assert "byte for byte" in again.output
    assert decided(next((tmp_path / "again").glob("*/"))) == before
