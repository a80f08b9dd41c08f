"""The scenario `cell`: packets in a whole run, killed links, pictures, traces that are wrong."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
from scenarios_support import caviar, eventually, pid_of, recorded_below, run, running, scenario_file

from caviar_protocol.recording import Recording

FRAMES = [("frames = 500\n", "frames = 250\ncheckpoint_frames = 7\n")]


def digest(directory: Path) -> str:
    text: str = json.loads((directory / "summary.json").read_text())["digest"]
    return text


def test_a_link_that_is_killed_goes_on_with_the_packets_that_waited(tmp_path: Path) -> None:
    """Twice in one run; the digest is that of an undisturbed one, and of one in one process."""
    scenario = scenario_file(tmp_path, FRAMES, extra="[timeouts]\nrejoin_s = 20.0\n", base="cell")
    whole = run(scenario, tmp_path / "whole", "--embedded")
    assert whole.status == 0, whole.output
    out = tmp_path / "broken"
    out.mkdir()
    with running(scenario, out) as (process, mark):
        for frame in (30, 120):
            eventually(lambda f=frame: recorded_below(out) > f, 30, f"frame {frame} is recorded")
            os.kill(pid_of(mark, "caviar_services link"), signal.SIGKILL)
        output, _ = process.communicate(timeout=120)
    assert process.returncode == 0, output
    directory = next(out.glob("*/"))
    told = [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]
    assert [line["service"] for line in told if line["kind"] == "back"] == ["link", "link"]
    assert digest(directory) == digest(whole.directory)
    link = Recording(directory)["link"]
    assert link.arrived.sum() > 1e9
    for rx in dict.fromkeys(link.rx):
        user = link.select(rx=rx)
        assert user.arrived.sum() == user.sent.sum() + user.dropped.sum() + user.buffered[-1].sum()


@pytest.mark.exhaustive
def test_pictures_have_one_of_the_packets(tmp_path: Path) -> None:
    done = run(scenario_file(tmp_path, [("frames = 500\n", "frames = 20\n")], base="cell"), tmp_path / "out")
    assert done.status == 0, done.output
    drawn = caviar("plot", done.directory)
    assert drawn.status == 0, drawn.output
    assert (done.directory / "traffic.png").read_bytes()[1:4] == b"PNG"


@pytest.mark.parametrize(
    ("row", "message"),
    [("1,-5", "rate_bit_s = -5; write a rate from 0"), ("1;5", "'1;5' is no pair of numbers")],
)
def test_a_trace_that_is_wrong_is_refused_before_anything_starts(
    row: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / "video.csv").write_text(f"t_s,rate_bit_s\n0,1e6\n{row}\n")
    change = ('model = "constant"               # a camera\'s video\nrate_bit_s = 60e6\n',
              'model = "trace"\nfile = "file:video.csv"\n')  # fmt: skip
    refused = run(scenario_file(tmp_path, [change], base="cell"), tmp_path / "out")
    assert refused.status != 0
    assert f"{tmp_path / 'video.csv'}:3: {message}" in refused.output
    assert not list((tmp_path / "out").glob("*/*.mcap"))
    assert not refused.leftovers
