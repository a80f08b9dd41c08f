"""Forecasts of frame rates, against runs whose rate follows by hand."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import msgspec
import numpy as np
import pytest
from recording_builders import record_run
from rich.console import Console

from caviar_clients.replay.recorded import RecordedRun
from caviar_labs.budget import forecast, rounded_up
from caviar_labs.cli.measure import budget_run, forecast_lines
from caviar_labs.latencies import Timing, measured_rate, outcomes_of, timings_of
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.recording import Recording

pytestmark = pytest.mark.slow

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"
FRAMES = 40
MS = 1_000_000


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    """A run of world, channel, link, agent and recorder; budgets are 20 ms, of the recorder 100 ms."""
    return RecordedRun(Recording(record_run(tmp_path_factory.mktemp("runs") / "smoke", frames=FRAMES)))


def timed(run: RecordedRun, **milliseconds: float | Mapping[int, float]) -> RecordedRun:
    """The run, had its services taken so long; a mapping gives frames that take another time than 1 ms."""
    latencies = {}
    for name, takes in milliseconds.items():
        count = FRAMES + (name == "agent")
        by_frame = dict.fromkeys(range(count), 1.0) | dict(takes) if isinstance(takes, Mapping) else None
        values = list(by_frame.values()) if by_frame else [takes] * count
        latencies[f"latency_ns/{name}"] = np.array([round(float(v) * MS) for v in values], np.int64)  # type: ignore[arg-type]
    finished = np.arange(FRAMES, dtype=np.int64) * 10 * MS
    np.savez_compressed(run.recording.directory / "latency.npz", finished_ns=finished, **latencies)  # type: ignore[arg-type]
    return run


def test_the_slowest_of_a_pipeline_sets_the_rate(smoke: RecordedRun) -> None:
    """The link is heard by the agent one frame later, so that both are one loop: 2 + 3 ms."""
    found = forecast(timed(smoke, world=1, channel=12, link=3, agent=2, recorder=4))
    assert found.rates["wait"] == pytest.approx(1000 / 12, rel=1e-6)
    assert found.bound.service == "channel"
    by_name = {service.name: service for service in found.services}
    assert by_name["channel"].without == pytest.approx(1000 / 5, rel=1e-6)
    assert by_name["channel"].alone == pytest.approx(1000 / 12, rel=1e-6)
    assert found.bound.gain == pytest.approx(12 / 5, rel=1e-6)
    assert found.bound.realtime_factor == 1.0
    assert by_name["world"].without == pytest.approx(1000 / 12, rel=1e-6)


def test_a_loop_over_two_services_takes_their_sum(smoke: RecordedRun) -> None:
    found = forecast(timed(smoke, world=1, channel=3, link=6, agent=8, recorder=4))
    assert found.rates["wait"] == pytest.approx(1000 / 14, rel=1e-6)
    assert found.bound.service == "agent"


def test_a_run_that_its_latencies_do_not_explain_is_told(smoke: RecordedRun) -> None:
    """It had 100 frames/s; services that take 10 ms explain that, ones of 2 ms do not."""
    explained = forecast(timed(smoke, world=1, channel=10, link=3, agent=2, recorder=4))
    assert explained.predicted == pytest.approx(100.0)
    assert not any("where its latencies lead to" in note for note in explained.notes)
    other = forecast(timed(smoke, world=1, channel=2, link=1, agent=1, recorder=1))
    assert any("100.0 frames/s where its latencies lead to 500.0" in note for note in other.notes)


def test_how_much_faster_a_service_has_to_be_for_real_time(smoke: RecordedRun) -> None:
    """Real time is 10 frames/s, the channel takes 250 ms: 2.5 times as fast."""
    found = forecast(timed(smoke, world=1, channel=250, link=3, agent=2, recorder=4))
    assert found.bound.realtime_factor == pytest.approx(2.5, rel=1e-2)
    hopeless = forecast(timed(smoke, world=120, channel=250, link=3, agent=2, recorder=4))
    assert hopeless.bound.realtime_factor is None
    assert "not enough" in " ".join(forecast_lines(hopeless))


def test_policies_differ_where_a_frame_overruns_its_budget(smoke: RecordedRun) -> None:
    """Frame 20 of the channel takes 70 ms instead of 1, with a budget of 20 ms; under hold frames go on."""
    found = forecast(timed(smoke, world=1, channel={20: 70.0}, link=1, agent=1, recorder=1))
    channel = next(service for service in found.services if service.name == "channel")
    link = next(service for service in found.services if service.name == "link")
    assert channel.misses["wait"] == 1
    assert channel.substituted["wait"] == 0
    assert channel.misses["hold"] >= 3  # it is busy in the frames that follow too
    assert link.substituted["hold"] == 0
    assert link.substituted["drop"] == channel.substituted["drop"] >= 3
    assert found.rates["hold"] > found.rates["wait"]


def test_suggested_budgets_are_the_99th_percentile_and_a_margin(smoke: RecordedRun) -> None:
    found = forecast(timed(smoke, world=1, channel=12.3, link=3, agent=2, recorder=4))
    channel = next(service for service in found.services if service.name == "channel")
    assert channel.suggested_ms == 15  # 14.76
    assert [rounded_up(v) for v in (0.001, 0.123, 1.0, 9.91, 10.0, 1218.6)] == [
        0.1,
        0.13,
        1.0,
        10.0,
        10.0,
        1300,
    ]


def test_latencies_of_a_service_that_missed_frames_are_told_to_their_frames(
    smoke: RecordedRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frame 3 was answered while 4 and 5 were missed, so its latency comes after theirs; 8 was skipped."""
    causes = {
        3: "channel missed frame 3 (hold, budget 20.0 ms)",
        4: "channel missed frame 4 (hold, budget 20.0 ms), still busy with frame 3",
        5: "channel missed frame 5 (hold, budget 20.0 ms), still busy with frame 3",
        8: "world failed in frame 8: fog",
    }
    recording = Recording(smoke.recording.path)
    plain = recording.entry

    def entry(index: int) -> object:
        found = plain(index)
        cause = causes.get(found.frame)
        missed = GrantInput(topic="channel", source="channel", status=Status.ABSENT, cause=cause or "")
        return msgspec.structs.replace(found, inputs=(missed,)) if cause else found

    monkeypatch.setattr(recording, "entry", entry)
    run = RecordedRun(recording)
    told = dict(outcomes_of(run, "channel"))
    assert [told[0, n] for n in (2, 3, 4, 5, 6, 8)] == [
        "answered", "late", "busy", "busy", "answered", "skipped",
    ]  # fmt: skip
    values = [1, 2, 3, 20, 20, 45, 7, 8, *range(10, FRAMES + 1)]
    np.savez_compressed(
        recording.directory / "latency.npz",
        **{"finished_ns": np.arange(3), "latency_ns/channel": np.array(values, np.int64)},  # type: ignore[arg-type]
    )
    timing = timings_of(run)["channel"]
    assert timing.exact
    assert [timing.times.get((0, n)) for n in range(10)] == [1, 2, 3, 45, None, None, 7, 8, None, 10]
    assert timing.at(0, 4) == timing.typical


def test_latencies_that_are_not_one_a_frame_are_told(smoke: RecordedRun) -> None:
    timed(smoke, world=1, channel=12, link=3, agent=2, recorder=4)
    with np.load(smoke.recording.directory / "latency.npz") as archive:
        arrays = {key: archive[key] for key in archive.files}
    arrays["latency_ns/channel"] = arrays["latency_ns/channel"][:-3]
    np.savez_compressed(smoke.recording.directory / "latency.npz", **arrays)
    found = forecast(smoke)
    assert any("latencies of channel" in note for note in found.notes)
    assert found.rates["wait"] == pytest.approx(1000 / 12, rel=1e-6)


def test_a_frame_without_a_latency_takes_the_median() -> None:
    timing = Timing({(0, 0): 5}, 7, 9, exact=True)
    assert (timing.at(0, 0), timing.at(0, 1)) == (5, 7)


def test_the_measured_rate_leaves_out_the_warm_up(smoke: RecordedRun) -> None:
    assert measured_rate(timed(smoke, world=1)) == pytest.approx(100.0)


def test_figures_are_written_as_json(smoke: RecordedRun, tmp_path: Path) -> None:
    timed(smoke, world=1, channel=12, link=3, agent=2, recorder=4)
    with (tmp_path / "screen").open("w") as file:
        budget_run(smoke.recording.path, Console(width=80, file=file), tmp_path / "budget.json")
    found = json.loads((tmp_path / "budget.json").read_text())
    assert found["bound"]["service"] == "channel"
    screen = (tmp_path / "screen").read_text()
    assert "channel bounds the frame rate under wait" in screen
    assert "suggested" in screen


def test_a_file_that_cannot_be_written_is_named_before_anything_is_worked_out(
    smoke: RecordedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("caviar_labs.budget.forecast", lambda _: pytest.fail("worked out"))
    with pytest.raises(RunError, match=r"cannot write .*: Is a directory"):
        budget_run(smoke.recording.path, Console(), tmp_path)


@pytest.mark.parametrize("content", [None, b"", b"PK\x03\x04nonsense"])
def test_a_run_without_latencies_is_told(smoke: RecordedRun, content: bytes | None) -> None:
    file = smoke.recording.directory / "latency.npz"
    file.unlink(missing_ok=True)
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(RecordingError, match=r"latency\.npz"):
        forecast(smoke)
