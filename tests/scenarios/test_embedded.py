"""A run in one process is the run of many: the same digest, the same blame, the same recording."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest
from scenarios_support import (
    SCENARIOS,
    Finished,
    caviar,
    eventually,
    marked,
    recorded_below,
    run,
    running,
    scenario_file,
)

from caviar_protocol.recording import Recording
from caviar_protocol.scenario import instants_ns, load_scenario

SICK = """
[services.sick]
role = "sensors"
use = "faulty:Raises"
budget_ms = 50
"""


def digest_of(finished: Finished) -> str:
    """The digest of the summary, which the recording has too."""
    assert finished.status == 0, finished.output
    summary: dict[str, str] = json.loads((finished.directory / "summary.json").read_text())
    assert caviar("inspect", "--digest", finished.directory).output.split() == [summary["digest"]]
    return summary["digest"]


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """The smoke scenario in one process."""
    folder = tmp_path_factory.mktemp("smoke")
    return run(scenario_file(folder), folder / "one", "--embedded")


def test_smoke_has_the_digest_of_the_distributed_run(smoke: Finished, tmp_path: Path) -> None:
    scenario = scenario_file(tmp_path)
    distributed = digest_of(run(scenario, tmp_path / "many"))
    assert digest_of(smoke) == distributed
    assert digest_of(run(scenario, tmp_path / "short", "--embedded", "--frames", "99")) != distributed


def test_frames_stand_at_the_instants_of_the_scenario(smoke: Finished, tmp_path: Path) -> None:
    """The objects are there, too: the same place at the same instant of an evenly spaced run."""
    finished = run(SCENARIOS / "instants.toml", tmp_path / "one", "--embedded")
    assert digest_of(finished) == digest_of(run(SCENARIOS / "instants.toml", tmp_path / "many"))
    planned = load_scenario(SCENARIOS / "instants.toml").run
    frames = list(Recording(finished.directory).frames())
    assert tuple(frame.t_ns for frame in frames) == instants_ns(planned.instants_s)
    places = {frame.t_ns: product.body for frame, product in Recording(smoke.directory).products("scene")}
    own = {frame.t_ns: product.body for frame, product in Recording(finished.directory).products("scene")}
    common = places.keys() & own.keys()
    assert len(common) == 12
    assert all(bytes(places[t]) == bytes(own[t]) for t in common)


@pytest.mark.exhaustive
@pytest.mark.channel
@pytest.mark.sumo
def test_street_canyon_has_the_digest_of_the_distributed_run(tmp_path: Path) -> None:
    """Ray tracer, LIDAR and traffic simulator side by side in one process, for a few frames."""
    for library in ("libsumo", "mitsuba", "sionna.rt"):
        pytest.importorskip(library, reason="needs the extras")
    arguments = (SCENARIOS / "street-canyon.toml", tmp_path / "one", "--frames", "12")
    embedded = digest_of(run(*arguments, "--embedded", timeout=120))
    assert digest_of(run(arguments[0], tmp_path / "many", "--frames", "12", timeout=120)) == embedded


@pytest.mark.exhaustive
@pytest.mark.channel
def test_cameras_have_the_same_digest_in_every_run(tmp_path: Path) -> None:
    """Pictures too: in one process with a channel beside them, whose variant is another, and distributed."""
    for library in ("mitsuba", "sionna.rt"):
        pytest.importorskip(library, reason="needs the extras")
    scenario = SCENARIOS / "cameras.toml"
    embedded, distributed = (
        digest_of(run(scenario, tmp_path / name, "--frames", "3", *how, timeout=120))
        for name, how in (("one", ["--embedded"]), ("many", []))
    )
    assert embedded == distributed


def test_realtime_pace_does_not_wait(tmp_path: Path) -> None:
    """A hundred frames of an hour each."""
    hours = ("sampling_period_ns = 100_000_000 ", "sampling_period_ns = 3_600_000_000_000 ")
    plain = digest_of(run(scenario_file(tmp_path, [hours]), tmp_path / "plain", "--embedded"))
    paced = scenario_file(tmp_path, [hours, ("frames = 100\n", 'frames = 100\npace = "realtime"\n')])
    assert digest_of(run(paced, tmp_path / "paced", "--embedded")) == plain


def test_a_service_that_raises_is_blamed_and_the_recording_readable(tmp_path: Path) -> None:
    changes = [
        ('"action", "link"]', '"action", "link", "lidar"]'),
        ("frames = 100\n", "frames = 100\nframes_in_flight = 1\n"),
    ]
    finished = run(scenario_file(tmp_path, changes, SICK), tmp_path / "out", "--embedded")
    assert finished.status == 1
    assert "sensors 'sick'" in finished.output
    assert "frame 5" in finished.output
    assert "ZeroDivisionError: the sensor's focal length is 0" in finished.output
    summary = json.loads((finished.directory / "summary.json").read_text())
    assert summary["frames"] == 5
    digest = caviar("inspect", "--digest", finished.directory)
    assert (digest.status, digest.output.split()) == (0, [summary["digest"]])


def test_a_service_that_ends_its_program_is_blamed(tmp_path: Path) -> None:
    """``sys.exit()`` in a plug-in ended the caller's program, with status 0 and without a word."""
    changes = [('"action", "link"]', '"action", "link", "lidar"]')]
    sick = SICK.replace("faulty:Raises", "faulty:Leaves")
    finished = run(scenario_file(tmp_path, changes, sick), tmp_path / "out", "--embedded")
    assert finished.status == 1
    assert "sensors 'sick'" in finished.output
    assert "it called sys.exit(0)" in finished.output


@pytest.mark.parametrize("option", [("--bind", "tcp://127.0.0.1:0"), ("--keys", "keys")])
def test_options_of_sockets_are_refused(tmp_path: Path, option: tuple[str, str]) -> None:
    finished = caviar("run", "smoke", "--embedded", "--out", tmp_path / "out", *option)
    assert finished.status == 1
    assert "an embedded run has no sockets" in finished.output
    assert not (tmp_path / "out").exists()


def test_ctrl_c_ends_it_cleanly(tmp_path: Path) -> None:
    arguments = ("--frames", "100000", "--embedded")
    with running(scenario_file(tmp_path), tmp_path / "out", *arguments) as (process, mark):
        eventually(lambda: recorded_below(tmp_path / "out") > 3, 20, "a few frames are recorded")
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=120)
        assert process.returncode == 130
        assert "stopped by Ctrl-C" in output
        assert marked(mark) == []


@pytest.mark.parametrize(
    ("sick", "ended"),
    [
        ("faulty:NeverAnswers", "ended at once, without a summary; what was recorded until then is in"),
        ("faulty:Computes", "ended at once, from within a call that does not return"),
    ],
)
def test_ctrl_c_names_the_service_that_hangs_and_a_second_one_ends_at_once(
    tmp_path: Path, sick: str, ended: str
) -> None:
    changes = [('"action", "link"]', '"action", "link", "lidar"]')]
    scenario = scenario_file(tmp_path, changes, SICK.replace("faulty:Raises", sick))
    with running(scenario, tmp_path / "out", "--embedded") as (process, mark):
        assert process.stdout is not None
        eventually(lambda: recorded_below(tmp_path / "out") >= 5, 20, "frames before the one that hangs")
        process.send_signal(signal.SIGINT)
        assert any(
            "stopped by Ctrl-C: waiting for sensors 'sick' in frame 5" in line for line in process.stdout
        )
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=120)
        assert process.returncode == 130
        assert ended in output
        assert marked(mark) == []
    assert recorded_below(tmp_path / "out") == 5
