"""`caviar measure tradeoff` from beginning to end, with few settings on small scenarios."""

from __future__ import annotations

import json
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from scenarios_support import SCENARIOS, caviar, run, scenario_file

from caviar_clients.cli import shared
from caviar_labs.cli import measure
from caviar_labs.cli.measure import trade
from caviar_labs.tradeoff import ladder
from caviar_labs.tradeoff.ladder import Setting
from caviar_labs.tradeoff.report import Options
from caviar_labs.tradeoff.scenes import scenes_of
from caviar_protocol.errors import RunError, SetupError

KEYS = ("time_ms_median", "factor", "nmse_db", "beam_top1", "beam_top5", "capacity_error_bps_hz")
STRANGE = Setting(label="strange", use="free-space", settings={"colour": 3})
SMALL = (
    Setting(label="free-space", use="free-space"),
    Setting(label="geometric", use="geometric", settings={"normalization": "path-loss"}),
    STRANGE,
)


@pytest.fixture
def small_ladder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ladder, "LADDER", SMALL)
    monkeypatch.setattr(ladder, "REFERENCES", ("strange", "free-space"))
    monkeypatch.setattr(ladder, "BASELINES", ("geometric",))


def compared(
    source: Path, folder: Path, frames: int = 3, seconds: float = 240.0, **options: Any
) -> tuple[dict[str, Any], str]:
    """What the JSON says, and the screen."""
    screen = StringIO()
    trade(
        source,
        frames,
        Options(**{"parts": ("ladder",), "seconds": seconds, **options}),
        folder / "t.json",
        folder / "pictures",
        Console(file=screen, width=160),
    )
    return json.loads((folder / "t.json").read_text()), screen.getvalue()


@pytest.mark.usefixtures("small_ladder")
def test_settings_are_measured_against_reference_and_baseline(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    report, screen = compared(SCENARIOS / "smoke.toml", tmp_path)
    assert (report["reference"], report["baseline"], report["scenes"]) == ("free-space", "geometric", 3)
    rows = {row["setting"]: row for row in report["rows"]}
    assert list(rows) == ["free-space", "geometric"]
    assert all(rows[name][key] is not None for name in rows for key in KEYS)
    own = rows["free-space"]
    assert own["users"] == 6  # two receivers in three scenes
    assert (own["nmse_db"], own["beam_top1"], own["capacity_error_bps_hz"]) == (-200.0, 1.0, 0.0)
    assert own["factor"] > 0
    assert (own["paths"], rows["geometric"]["paths"]) == (2, 6)
    assert rows["geometric"]["factor"] == 1
    assert rows["geometric"]["nmse_db"] > -30  # two of its three waves are drawn
    assert rows["geometric"]["measurements"] == 9
    (skipped,) = report["skipped"]
    assert skipped["setting"] == "strange"
    assert "unknown key 'colour'" in skipped["reason"]
    assert "not measured: strange" in screen
    text = (tmp_path / "pictures" / "tradeoff.md").read_text()
    assert "| geometric" in text  # with a star where it is on the front
    assert (tmp_path / "pictures" / "pareto.png").stat().st_size > 5000


@pytest.mark.usefixtures("small_ladder")
@pytest.mark.exhaustive
def test_a_recording_gives_the_figures_of_its_scenario(tmp_path: Path) -> None:
    """Errors do not depend on the machine's speed: scenes and draws are the same."""
    pytest.importorskip("matplotlib")
    recorded = run(SCENARIOS / "smoke.toml", tmp_path / "runs", "--embedded").directory
    one, _ = compared(recorded, tmp_path / "recording")
    other, _ = compared(SCENARIOS / "smoke.toml", tmp_path / "scenario")
    for mine, theirs in zip(one["rows"], other["rows"], strict=True):
        assert {key: mine[key] for key in KEYS[2:]} == {key: theirs[key] for key in KEYS[2:]}


@pytest.mark.usefixtures("small_ladder")
def test_keyframes_have_a_table_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(ladder, "BASELINES", ("free-space",))
    report, _ = compared(SCENARIOS / "smoke.toml", tmp_path, parts=("ladder", "keyframes"))
    rows = {row["setting"]: row for row in report["rows"] if row["block"] == "keyframes"}
    assert list(rows) == ["free-space", *(f"free-space, keyframes every {n}" for n in (2, 5, 10))]
    assert rows["free-space, keyframes every 5"]["within_bound"] == 1.0
    assert "## Between keyframes" in (tmp_path / "pictures" / "tradeoff.md").read_text()


@pytest.mark.exhaustive
@pytest.mark.usefixtures("small_ladder")
def test_receivers_can_be_few(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    report, _ = compared(SCENARIOS / "smoke.toml", tmp_path, receivers=1)
    assert report["receivers"] == 1
    assert [row["users"] for row in report["rows"]] == [3, 3]


@pytest.mark.exhaustive
@pytest.mark.channel
@pytest.mark.sumo
def test_deeper_tracing_comes_nearer_and_takes_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    lines = [
        Setting(label=label, use="sionna-rt", settings={"samples": samples, "max_depth": depth})
        for label, samples, depth in (("d0", 1000, 0), ("d1", 10_000, 1), ("d3", 300_000, 3))
    ]
    monkeypatch.setattr(ladder, "LADDER", tuple(lines))
    monkeypatch.setattr(ladder, "REFERENCES", ("d3",))
    monkeypatch.setattr(ladder, "BASELINES", ("d0",))
    report, _ = compared(SCENARIOS / "street-canyon.toml", tmp_path, frames=2, seconds=60.0, receivers=4)
    d0, d1, d3 = report["rows"]
    assert d0["nmse_db"] > d1["nmse_db"] > d3["nmse_db"] == -200.0
    assert d0["path_gain_error_db"] > d1["path_gain_error_db"] > 0
    assert d3["factor"] > 1
    assert d3["memory_mib"] > d0["memory_mib"]


def test_an_unknown_label_is_refused_with_a_near_one() -> None:
    finished = caviar("measure", "tradeoff", SCENARIOS / "smoke.toml", "--reference", "siso-rt 1e6 d33")
    assert finished.status == 1
    assert "did you mean 'siso-rt 1e6 d3'?" in finished.output
    finished = caviar("measure", "tradeoff", SCENARIOS / "smoke.toml", "--part", "lader")
    assert finished.status == 1
    assert "did you mean 'ladder'?" in finished.output


def test_a_scenario_with_an_error_is_refused_as_by_a_run(tmp_path: Path) -> None:
    scenario = scenario_file(tmp_path, [('use = "free-space"', 'use = "free-spaec"')])
    finished = caviar("measure", "tradeoff", scenario)
    assert finished.status == 1
    assert "did you mean 'free-space'?" in finished.output


def test_a_file_that_cannot_be_written_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    finished = caviar("measure", "tradeoff", SCENARIOS / "smoke.toml", "--json", tmp_path / "file" / "t.json")
    assert finished.status == 1
    assert "cannot write" in finished.output


def test_all_extras_that_lack_are_named_at_once_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (measure, shared):
        monkeypatch.setattr(module, "has_extra", lambda _: False)
    with pytest.raises(SetupError, match=r"'caviar-sim\[channel,plot,world\]'"):
        trade(SCENARIOS / "street-canyon.toml", 3, Options(), None, tmp_path / "trade", Console(quiet=True))
    assert not list(tmp_path.iterdir())


def test_a_comparison_that_fails_leaves_no_empty_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise RunError("the worlds fail")

    monkeypatch.setattr("caviar_labs.tradeoff.scenes.scenes_of", fails)
    monkeypatch.setattr(measure, "has_extra", lambda _: True)
    json_file, kept = tmp_path / "t.json", tmp_path / "trade" / "kept"
    kept.parent.mkdir()
    kept.touch()
    with pytest.raises(RunError, match="the worlds fail"):
        trade(SCENARIOS / "smoke.toml", 3, Options(), json_file, tmp_path / "trade", Console(quiet=True))
    assert sorted(tmp_path.rglob("*")) == [kept.parent, kept]


def test_scenes_are_spread_over_the_episode() -> None:
    found = scenes_of(SCENARIOS / "smoke.toml", 4)
    assert [instant.frame for instant in found.instants] == [0, 33, 66, 99]
    assert [instant.t_ns for instant in found.instants] == [n * 100_000_000 for n in (0, 33, 66, 99)]
