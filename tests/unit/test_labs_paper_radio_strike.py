"""`caviar paper radiostrike`: agents under both rules, the published run again, tables, picture, mistakes."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from test_labs_radio_strike import short_episode
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_labs.paper.comparison import Comparison, with_interval, with_range
from caviar_labs.paper.radio_strike import Report, Settings, StraightLine, experiment
from caviar_labs.paper.radio_strike_published import BASE_STATION_M, made_again, read_run
from caviar_labs.paper.radio_strike_tables import comparisons, figures_of
from caviar_protocol.errors import CaviarError, ScenarioError

pytestmark = pytest.mark.slow

HEADER = [
    "ue_name", "ue_number", "beam_index", "x", "y", "z", "dropped_packets", "sent_packets", "bit_rate",
    "channel_mag", "score", "packets",
]  # fmt: skip
NAMES = ("uav1", "simulation_car1", "simulation_pedestrian1")


def published(file: Path, steps: int = 60) -> Path:
    """A run like that of the challenge, of three users that stand still."""
    random = np.random.default_rng(1)
    places = np.array([[20.0, 3.0, -4.0], [40.0, -20.0, 7.0], [3.0, 33.0, 7.0]])
    with file.open("w", newline="") as text:
        writer = csv.writer(text)
        writer.writerow(HEADER)
        for step in range(steps):
            user, magnitude = step % 3, float(random.uniform(0.1, 0.5))
            rate = 0.1 * float(np.log2(1 + 440.35 * magnitude**2))
            place = places[user].tolist()
            writer.writerow([NAMES[user], user, 9, *place, 0.0, 450.0, rate, magnitude, 0.4 * rate, 150])
    return file


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> tuple[Report, Settings]:
    """Three short episodes for each agent but B-A2C."""
    file = published(tmp_path_factory.mktemp("run") / "run.csv")
    episodes = [short_episode(number, steps=150) for number in range(3)]
    settings = Settings(episodes, count=3, steps=120, train_steps=0, published=file, repeats=3)
    return experiment(settings), settings


def test_knowing_the_channel_is_better_than_knowing_the_place_and_that_better_than_chance(
    report: tuple[Report, Settings],
) -> None:
    found, _ = report
    for by_agent in found.played.values():
        means = {agent: np.mean([one.reward.mean() for one in played]) for agent, played in by_agent.items()}
        assert means["B-Dummy"] < means["straight line"] < means["B-BeamOracle"]
        assert all(len(one.reward) == 120 for played in by_agent.values() for one in played)


def test_the_tables_have_every_agent_and_figure_and_say_what_differs(report: tuple[Report, Settings]) -> None:
    found = comparisons(*report)
    legacy, fixed, run, differences = found
    assert [row[0] for row in legacy.rows] == ["B-Dummy", "straight line", "B-BeamOracle"]
    assert len(fixed.rows) == 3
    there = {row[0]: row[2] for row in run.rows}
    assert there["uav1: packets sent a slot"] == "450.0"
    assert there["packets dropped"] == "0"
    score = 0.4 * read_run(report[1].published).bit_rate.sum()  # type: ignore[arg-type]
    assert float(there["return, Σ 0.4·R"]) == pytest.approx(score, abs=0.05)
    text = " ".join(differences.notes)
    for part in (
        "no figures of Radio-Strike",
        "first version of the code",
        "B-A2C is left out: write --train-steps",
    ):
        assert part in text
    assert all("| --- |" in one.markdown() for one in found[:3])
    figures = json.loads(json.dumps(figures_of(report[0])))
    assert len(figures["agents"]["fixed"]["B-Dummy"]["reward"]) == 3
    assert len(figures["returns_of_runs_played_again"]) == 3


def test_the_same_seed_plays_the_same() -> None:
    settings = Settings(short_episode(1, steps=40), count=1, steps=30, train_steps=0, seed=3)
    one, other = figures_of(experiment(settings)), figures_of(experiment(settings))
    assert one == other != figures_of(experiment(Settings(settings.episodes, 1, 30, 0, seed=4)))


def test_the_straight_line_is_found_in_both_codebooks() -> None:
    """Straight below, where all antennas are in phase."""
    for rules in ("legacy", "fixed"):
        agent = StraightLine(rules)  # type: ignore[arg-type]
        agent.seen(2, np.array([1e-9, 1e-9, 8.0]))
        assert agent.beam(2) == 0
        agent.seen(2, np.array([30.0, 20.0, 8.0]))
        assert agent.beam(2) != 0


def test_the_published_run_is_made_again_within_its_own_spread(shared_data: Path) -> None:
    """Bit rates of each user, and the return, of five runs that differ in their random numbers alone."""
    run = read_run(shared_data / "radiostrike" / "data_output_optimun_traffic.csv")
    assert run.rate_error() < 1e-12
    assert run.score == pytest.approx(1445.18, abs=0.01)
    again = [made_again(run, seed) for seed in range(5)]
    assert np.mean([one.score for one in again]) == pytest.approx(run.score, rel=0.004)
    for user in range(3):
        mine = run.user == user
        for name, within in (("bit_rate", 0.02), ("magnitude", 0.03), ("sent", 0.01)):
            mean = np.mean([getattr(one, name)[mine].mean() for one in again])
            assert mean == pytest.approx(getattr(run, name)[mine].mean(), rel=within)
    assert not any(one.dropped.any() for one in again)
    assert np.mean([(np.abs(one.beam - run.beam) <= 1).mean() for one in again]) > 0.95


def test_rays_along_a_beam_have_the_amplitude_of_the_first_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Straight beside the row all antennas are in phase: 8 times the amplitudes of two rays, beam 0."""
    monkeypatch.setattr("caviar_labs.paper.radio_strike_published.SPREAD_DEG", 0.0)
    file = tmp_path / "run.csv"
    x, y, z = BASE_STATION_M
    with file.open("w", newline="") as text:
        writer = csv.writer(text)
        writer.writerow(HEADER)
        writer.writerows([["uav1", 0, 0, x, y + 40.0, z, 0, 1, 1, 1, 1, 1]] * 2000)
    again = made_again(read_run(file), seed=1)
    level = 20 * np.log10(299_792_458 / 60e9 / (4 * np.pi * 40) ** 2) + 90 + 25
    # The mean of 10^((|n| + |m|)/20) over two normal numbers is 1.2076.
    assert again.magnitude.mean() == pytest.approx(16 * 10 ** (level / 20) * 1.2076, rel=0.01)
    assert not again.beam.any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda text: text.replace("channel_mag", "channel"),
            r"run\.csv:1: has no column channel_mag; name data",
        ),
        (lambda text: text[: text.rindex(",0.4") - 30], r"run\.csv:60: the file breaks off: copy it again"),
        (lambda text: text.replace(",450.0,", ",nan,", 1), r"run\.csv:2: sent_packets is 'nan', no number"),
        (lambda text: text.replace("uav1,0,", "uav1,5,", 1), r"run\.csv:2: ue_number is not one of 0 to 2"),
        (lambda text: text.splitlines()[0] + "\n", r"run\.csv: has no row"),
    ],
)
def test_a_wrong_file_of_a_run_is_refused(tmp_path: Path, change: object, message: str) -> None:
    file = published(tmp_path / "run.csv")
    file.write_text(change(file.read_text()))  # type: ignore[operator]
    with pytest.raises(ScenarioError, match=message):
        read_run(file)


def test_intervals_are_of_means_and_ranges_of_single_runs() -> None:
    values = [1.0, 2.0, 3.0, 4.0]
    # Student's t of three degrees of freedom is 3.182, and the standard deviation 1.291.
    assert with_interval(values, 2) == "2.50 ± 2.05"
    assert with_range(values, 2) == "2.50 ± 4.59"
    assert with_interval([2.0]) == "2.000"
    assert "| \\|y\\| | 1 |" in Comparison("Bars", ("what", "value"), [("|y|", "1")]).markdown()
    assert Comparison("Only words", (), (), ["one"]).markdown() == "## Only words\n\n* one\n"


# --- the command --------------------------------------------------------------------------------------------


def test_the_command_writes_picture_tables_and_figures(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    run, out = published(tmp_path / "run.csv"), tmp_path / "out"
    words = ["paper", "radiostrike", "--count", "1", "--steps", "40", "--train-steps", "0"]
    done = CliRunner().invoke(
        app, [*words, "--published", str(run), "--out", str(out)], catch_exceptions=False
    )
    assert done.exit_code == 0
    assert "B-BeamOracle" in done.output
    assert "What differs" in (out / "radiostrike.md").read_text()
    assert (out / "radiostrike.png").stat().st_size > 5000
    assert json.loads((out / "radiostrike.json").read_text())["return_of_the_published_run"] > 0


def test_a_command_with_a_wrong_file_leaves_nothing_behind(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "out"
    words = ["paper", "radiostrike", "--episodes", str(tmp_path / "ep9.csv"), "--out", str(out)]
    with pytest.raises(CaviarError, match=r"ep9\.csv'.*no such file"):
        CliRunner().invoke(app, words, catch_exceptions=False)
    assert not out.exists()


def test_b_a2c_is_trained_and_played(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra `learning`")
    episodes = [short_episode(number, steps=60) for number in range(2)]
    found = experiment(Settings(episodes, count=1, steps=30, train_steps=25))
    assert len(found.played["legacy"]["B-A2C"][0].reward) == 30
    assert not [note for note in found.notes if "B-A2C" in note]
    alone = experiment(Settings(episodes[:1], count=1, steps=5, train_steps=5))
    assert "B-A2C was trained on the episodes that it plays" in alone.notes[0]
