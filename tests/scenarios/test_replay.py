"""Recorded runs again, by the real command in real processes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from scenarios_support import SCENARIOS, Finished, caviar, run, scenario_file

from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.recording import Recording
from caviar_protocol.recording.reader import recorded_decisions

FRAMES = 20


def replayed(directory: Path, out: Path, *arguments: str, timeout: float = 60.0) -> Finished:
    """``caviar replay`` into an empty folder; the run's own directory is found there."""
    finished = caviar("replay", directory, "--out", out, *arguments, timeout=timeout)
    finished.directory = next(iter(sorted(out.glob("*/"))), Path())
    assert finished.status == 0, finished.output
    assert not finished.leftovers
    return finished


def products(directory: Path, *sources: str) -> list[tuple[GrantInput, ...]]:
    """Provenance of everything that consumers saw, by frame; of some sources, where these are named."""
    return [
        tuple(i for i in f.inputs if i.status is not Status.LATE and (not sources or i.source in sources))
        for f in Recording(directory).frames()
    ]


def digest(directory: Path) -> str:
    found: str = json.loads((directory / "summary.json").read_text())["digest"]
    assert found == Recording(directory).run_digest().digest
    return found


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the smallest scenario."""
    out = tmp_path_factory.mktemp("smoke")
    finished = run(SCENARIOS / "smoke.toml", out, "--frames", str(FRAMES))
    assert finished.status == 0, finished.output
    return finished.directory


def test_with_nothing_replaced_every_byte_is_that_of_the_recorded_run(smoke: Path, tmp_path: Path) -> None:
    again = replayed(smoke, tmp_path)
    assert "as recorded" in again.output
    assert "byte for byte" in again.output
    assert digest(again.directory) == digest(smoke)
    assert products(again.directory) == products(smoke)
    told = Recording(again.directory).metadata.scenario["replay"]
    assert told["recording"] == str(smoke)
    assert told["served"] == ["agent", "channel", "link", "world"]
    assert told["digest"] == digest(smoke)


def test_everything_again_is_the_same_too(smoke: Path, tmp_path: Path) -> None:
    again = replayed(smoke, tmp_path, "--again")
    assert digest(again.directory) == digest(smoke)


def test_another_agent_acts_in_the_recorded_world(smoke: Path, tmp_path: Path) -> None:
    """World and channel are served; the link follows the new actions."""
    other = replayed(smoke, tmp_path, "--replace", "agent=random")
    assert products(other.directory, "world", "channel") == products(smoke, "world", "channel")
    assert products(other.directory, "agent") != products(smoke, "agent")
    assert products(other.directory, "link") != products(smoke, "link")


@pytest.mark.exhaustive
def test_a_replay_can_be_replayed(smoke: Path, tmp_path: Path) -> None:
    other = replayed(smoke, tmp_path / "other", "--replace", "agent=random")
    again = replayed(other.directory, tmp_path / "again")
    assert products(again.directory) == products(other.directory)


def test_some_frames_and_in_one_process(smoke: Path, tmp_path: Path) -> None:
    short = replayed(smoke, tmp_path, "--frames", "7", "--embedded")
    assert products(short.directory) == products(smoke)[:7]
    assert "byte for byte" in short.output


def test_what_was_held_or_absent_is_so_again(tmp_path: Path) -> None:
    """With the recorded causes, though nothing is late in the replay; the bytes held are those of then."""
    changes = [
        (
            'use = "free-space"\nbudget_ms = 20',
            'use = "late_channel:LateChannel"\npolicy = "hold"\nbudget_ms = 100',
        )
    ]
    scenario = scenario_file(tmp_path, changes)
    late = run(scenario, tmp_path / "late", "--frames", str(FRAMES))
    assert late.status == 0, late.output
    statuses = {i.status for inputs in products(late.directory, "channel") for i in inputs}
    assert statuses == {Status.FRESH, Status.HELD}
    again = replayed(late.directory, tmp_path / "again")
    assert products(again.directory) == products(late.directory)
    assert digest(again.directory) == digest(late.directory)
    held = [
        [(p.provenance.digest, p.digest) for p in f.products if p.provenance.status is Status.HELD]
        for f in Recording(again.directory).frames()
    ]
    assert all(told == found for frame in held for told, found in frame)
    other = replayed(late.directory, tmp_path / "other", "--replace", "agent=random")
    assert products(other.directory, "channel") == products(late.directory, "channel")


@pytest.mark.exhaustive
def test_episodes_are_as_long_as_they_were(tmp_path: Path) -> None:
    scenario = scenario_file(tmp_path, [("frames = 100\n", "frames = 6\nepisodes = 3\n")])
    episodes = run(scenario, tmp_path / "run")
    assert episodes.status == 0, episodes.output
    again = replayed(episodes.directory, tmp_path / "again")
    assert products(again.directory) == products(episodes.directory)
    assert len(products(again.directory)) == 18


def test_what_is_wrong_is_told_before_anything_starts(smoke: Path, tmp_path: Path) -> None:
    for arguments, message in (
        (["--replace", "agnt=oracle"], "did you mean 'agent'?"),
        (["--set", "agent.user=3"], "services.agent.settings.user"),
    ):
        done = caviar("replay", smoke, "--out", tmp_path / "none", *arguments)
        assert done.status == 1
        assert message in done.output
        assert not (tmp_path / "none").exists()
    assert caviar("replay", tmp_path, "--out", tmp_path / "none").status == 1


@pytest.mark.exhaustive
@pytest.mark.sumo
@pytest.mark.channel
def test_an_adaptive_channel_is_served_and_repeated(tmp_path: Path) -> None:
    """Whatever rungs this machine's speed led to: served they are the same, and imposed too."""
    for library in ("libsumo", "mitsuba", "sionna.rt"):
        pytest.importorskip(library, reason="needs the extras")
    changes = [
        ('candidates = "enumerated"', 'candidates = "enumerated"\nsamples = 4_000'),
    ]
    scenario = scenario_file(tmp_path, changes, base="adaptive")
    text = scenario.read_text().replace("file:street", f"file:{SCENARIOS}/street")
    scenario.write_text(text)
    first = run(scenario, tmp_path / "run", "--frames", "6", timeout=300)
    assert first.status == 0, first.output
    served = replayed(first.directory, tmp_path / "served", timeout=300)
    repeated = replayed(first.directory, tmp_path / "repeated", "--again", timeout=300)
    assert digest(first.directory) == digest(served.directory) == digest(repeated.directory)
    taken = recorded_decisions(Recording(first.directory))
    assert recorded_decisions(Recording(served.directory)) == taken
    assert recorded_decisions(Recording(repeated.directory)) == taken
    coarse = replayed(first.directory, tmp_path / "coarse", "--set", "channel.fixed=d1", timeout=300)
    assert products(coarse.directory, "traffic") == products(first.directory, "traffic")
    rungs = recorded_decisions(Recording(coarse.directory))
    assert {rungs["channel", 0, number]["rung"] for number in range(6)} == {"d1"}


def test_budget_predicts_the_frame_rate_of_its_own_run(smoke: Path, tmp_path: Path) -> None:
    """Within 15 % on a machine left alone; here with room for one that is not."""
    file = tmp_path / "budget.json"
    done = caviar("measure", "budget", smoke, "--json", file)
    assert done.status == 0, done.output
    found = json.loads(file.read_text())
    measured = json.loads((smoke / "summary.json").read_text())["frames_per_second"]
    assert found["measured"] == pytest.approx(measured)
    assert found["predicted"] == found["rates"]["wait"] == pytest.approx(measured, rel=0.5)
    assert found["bound"]["service"] in {"world", "channel", "link", "agent", "recorder"}
