"""`caviar paper fig8`: files that ship, episodes held out, trainings, tables, pictures, mistakes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_clients.learning import campaign
from caviar_clients.learning.experiment import Experiment, load_experiment
from caviar_clients.learning.training import LOWEST_SEED
from caviar_labs.paper.fig8 import (
    FIRST_EPISODE,
    FLIGHTS,
    HELD_OUT,
    Report,
    Settings,
    done_seeds,
    experiment,
    shipped_files,
    write_files,
)
from caviar_labs.paper.fig8_figure import draw
from caviar_labs.paper.fig8_tables import comparisons, figures_of, ratios
from caviar_labs.paper.held_out import Episodes, recorded_episodes
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.scenario import find_scenario, load_scenario

pytest.importorskip("stable_baselines3")
pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

pytestmark = pytest.mark.slow

TINY = 0.01  # of the steps: 300 and 3,000
TUNED, ANGLE, DEFAULTS = "DQN, tuned", "DQN, tuned, angle alone", "DQN, defaults"


# --- what ships ---------------------------------------------------------------------------------------------


def experiments_in(folder: Path) -> dict[str, Experiment]:
    (folder / FLIGHTS).mkdir(exist_ok=True)  # is named by experiments, and read by none here
    names = [
        name for name in shipped_files() if name.endswith(("-defaults.toml", "-angle.toml", "-tuned.toml"))
    ]
    return {Path(name).stem: load_experiment(folder / name) for name in names}


def test_the_experiments_that_ship_are_named_after_their_files_and_can_be_trained_by_hand(
    tmp_path: Path,
) -> None:
    write_files(Settings(folder=tmp_path, seeds=3))
    loaded = experiments_in(tmp_path)
    assert len(loaded) == 7
    for name, one in loaded.items():
        assert one.experiment.name == name
        assert one.experiment.seeds == (1, 2, 3)
        assert one.experiment.steps == (30_000 if name.endswith("defaults") else 300_000)
        if name.endswith("defaults"):
            assert one.algorithm.given() == {}
            assert one.environment.options["observe"] == ["aod"]
        if name.startswith("quasi-static"):
            assert one.environment.options["scenario"] == str(tmp_path / "geometric-quasi-static.toml")


def test_the_angle_alone_is_learned_from_with_the_same_hyper_parameters(tmp_path: Path) -> None:
    write_files(Settings(folder=tmp_path))
    loaded = experiments_in(tmp_path)
    for channel in ("quasi-static", "munich"):
        tuned, angle = loaded[f"{channel}-tuned"], loaded[f"{channel}-angle"]
        assert (tuned.algorithm, tuned.network) == (angle.algorithm, angle.network)
        assert tuned.experiment.steps == angle.experiment.steps
        options = {key: value for key, value in tuned.environment.options.items() if key != "observe"}
        assert angle.environment.options == {**options, "observe": ["aod"]}


def test_no_policy_is_trained_on_what_it_is_judged_on(tmp_path: Path) -> None:
    write_files(Settings(folder=tmp_path))
    users = experiments_in(tmp_path)["munich-tuned"].environment.options["users"]
    held_out = {name.partition("/")[0] + "/*" for name in HELD_OUT}
    assert not set(users) & held_out
    assert len({*users, *held_out}) == 16
    assert FIRST_EPISODE + Settings(folder=tmp_path).episodes < LOWEST_SEED


def test_the_scenarios_differ_from_those_that_they_are_made_of_in_what_they_say(tmp_path: Path) -> None:
    write_files(Settings(folder=tmp_path))
    shipped = load_scenario("geometric")
    drawn_once = load_scenario(tmp_path / "geometric-quasi-static.toml")
    settings = shipped.services["channel"].settings
    assert drawn_once.services["channel"].settings == {**settings, "redraw": "episode"}
    assert drawn_once.devices == shipped.devices
    assert drawn_once.services["world"].settings == shipped.services["world"].settings
    flights = load_scenario(tmp_path / "munich-flights.toml")
    lone = load_scenario("uav-munich")
    assert flights.services["channel"].settings == lone.services["channel"].settings
    assert [device.position_m for device in flights.devices[1:]] == [lone.devices[1].position_m] * 16
    rows = (find_scenario("uav-munich").parent / "uav-munich" / "flight.csv").read_text().splitlines()
    wanted = np.array([line.split(",") for line in rows if line[:1].isdigit()], float)
    first, *others = (np.array(it["waypoints"]) for it in flights.services["world"].settings["objects"])
    np.testing.assert_array_equal(first, wanted)
    assert all(0 < np.abs(other - wanted).max() < 6 for other in others)


# --- training and playing -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Settings:
    """Of a run that has ended: two seeds on both geometric channels, hardly trained."""
    folder = tmp_path_factory.mktemp("fig8")
    return Settings(
        folder=folder, seeds=2, share=TINY, episodes=2, channels=("geometric", "quasi-static"), jobs=1
    )


@pytest.fixture(scope="module")
def report(settings: Settings) -> Report:
    shares: list[float] = []
    found = experiment(settings, lambda what, share: shares.append(share))
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    return found


def test_all_play_the_same_frames_between_nothing_and_the_optimum(report: Report) -> None:
    assert list(report.played["geometric"].chosen) == [DEFAULTS]
    played = report.played["quasi-static"]
    assert list(played.chosen) == [TUNED, ANGLE, DEFAULTS]
    assert played.angle_deg.shape == (2, 500)
    blocked = (played.angle_deg >= 20) & (played.angle_deg <= 30)
    np.testing.assert_array_equal(played.los, ~blocked)  # the paper's range
    begins = np.diff(blocked[0].astype(int)) == 1
    assert begins.sum() == 3
    for policies in played.chosen.values():
        assert len(policies) == 2
        for abs_y in policies:
            assert ((abs_y >= 0) & (abs_y <= played.optimum + 1e-9)).all()
    assert (played.los_beam <= played.optimum + 1e-9).all()
    assert played.los_beam[played.los].mean() > 0.99 * played.optimum[played.los].mean()


def test_a_second_call_trains_nothing_and_finds_the_same(
    report: Report, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(campaign, "train_seed", lambda *_: pytest.fail("trained again"))
    assert done_seeds(settings) == 8
    assert not list(settings.folder.glob("training/*/*/checkpoints"))  # the replay buffers
    again = experiment(replace(settings, channels=("geometric",)))
    mine, theirs = (figures_of(found)["channels"]["geometric"] for found in (again, report))
    assert mine == theirs


def test_the_same_seeds_lead_to_the_same_figures_elsewhere(
    report: Report, settings: Settings, tmp_path: Path
) -> None:
    one = replace(settings, folder=tmp_path, channels=("geometric",))
    mine, theirs = (figures_of(found)["channels"]["geometric"] for found in (experiment(one), report))
    assert mine == theirs


def test_a_folder_of_other_steps_or_another_scenario_is_refused(settings: Settings, report: Report) -> None:
    del report  # has filled the folder
    with pytest.raises(RunError, match=r"experiment\.steps.*300.*600"):
        experiment(replace(settings, share=2 * TINY, channels=("geometric",)))
    copy = settings.folder / "geometric-quasi-static.toml"
    text = copy.read_text()
    copy.write_text(text + "\n")
    with pytest.raises(RunError, match="is not that of this version; remove"):
        write_files(settings)
    copy.write_text(text)


def test_the_first_seeds_of_all_are_trained_before_the_second_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[tuple[str, int]] = []

    def train(wanted: Experiment, seed: int, *_: object) -> None:
        order.append((wanted.experiment.name, seed))

    monkeypatch.setattr(campaign, "train_seed", train)
    write_files(Settings(folder=tmp_path, seeds=2))
    loaded = experiments_in(tmp_path)
    names = ("quasi-static-tuned", "geometric-defaults")
    campaign.train_experiments([loaded[name] for name in names], tmp_path / "training")
    assert order == [(name, seed) for seed in (1, 2) for name in names]


def test_munich_is_left_out_with_the_remedy_where_there_is_no_ray_tracer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("caviar_labs.paper.fig8.has_extra", lambda name: False)
    tiny = Settings(folder=tmp_path, seeds=1, share=TINY, episodes=1, channels=("geometric", "munich"))
    found = experiment(tiny)
    assert list(found.played) == ["geometric"]
    assert "Munich is left out" in found.notes[0]
    assert "pip install" in found.notes[0]


# --- means, tables, pictures --------------------------------------------------------------------------------


def made_up() -> Episodes:
    """Two episodes of three frames: with a line of sight, without, and without a path."""
    ones = np.ones((2, 3))
    return Episodes(
        envs=None,
        reset={},
        period_s=0.1,
        angle_deg=25 * ones,
        has_path=np.array([[True, True, False]] * 2),
        los=np.array([[True, False, False]] * 2),
        optimum=8 * ones,
        los_beam=np.array([[6.0, 1.0, 9.0]] * 2),
        chosen={
            TUNED: [np.array([[6.0, 3.0, 9.0]] * 2), np.array([[5.0, 2.0, 9.0], [7.0, 2.0, 9.0]])],
            ANGLE: [np.array([[6.0, 1.0, 9.0]] * 2)] * 2,
        },
    )


def test_means_are_over_frames_with_a_path_line_of_sight_apart() -> None:
    played = made_up()
    assert played.means(TUNED, "all") == [4.5, 4.0]
    assert played.means(TUNED, "LOS") == [6.0, 6.0]
    assert ratios(played, TUNED, "NLOS") == [3.0, 2.0]
    assert played.means("los-beam", "all") == [3.5]


def test_the_tables_have_every_seed_and_the_worst_one_beside_what_is_wanted() -> None:
    found = comparisons(Report({"quasi-static": made_up()}, {"quasi-static-tuned": 300}, (1, 2)))
    means, seeds, worst, differences = found
    rows = {row[0]: row for row in means.rows}
    assert rows[TUNED][4] == "2.50 ± 6.35"  # 3 and 2: half of the difference is 0.5, Student's t 12.7
    assert ("DQN, tuned: NLOS", "3.00", "2.00") in seeds.rows
    assert [row[1:] for row in worst.rows] == [
        ("≥ 0.95", "1.000"),
        ("> 1", "2.00"),
        ("> 1", "1.14"),
        ("> 1", "2.00"),
    ]
    assert any("300 steps" in note for note in differences.notes)


def test_pictures_have_both_panels_of_each_channel(report: Report, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    files = draw(report, tmp_path, "fig8", "quick")
    assert [file.name for file in files] == ["fig8-geometric.png", "fig8-quasi-static.png"]
    assert all(file.stat().st_size > 20_000 for file in files)


# --- the command --------------------------------------------------------------------------------------------


def test_the_quick_form_says_so_wherever_it_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("caviar_labs.paper.fig8.QUICK", TINY)
    words = ["paper", "fig8", "--quick", "--seeds", "1", "--channel", "geometric", "--jobs", "1"]
    done = CliRunner().invoke(app, [*words, "--out", str(tmp_path)], catch_exceptions=False)
    assert done.exit_code == 0
    assert "quick form" in done.output
    assert "6.81" in done.output
    assert "quick form" in (tmp_path / "fig8-quick.md").read_text()
    assert json.loads((tmp_path / "fig8-quick.json").read_text())["steps"] == {"geometric-defaults": 300}
    assert (tmp_path / "fig8-quick-geometric.png").is_file()


def test_ctrl_c_says_what_is_done_and_leaves_no_empty_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("caviar_labs.paper.fig8.train_experiments", interrupted)
    words = ["paper", "fig8", "--channel", "geometric", "--out", str(tmp_path)]
    done = CliRunner().invoke(app, words)
    assert done.exit_code != 0
    assert "stopped with 0 trainings done; the same command goes on" in " ".join(done.output.split())
    assert [path.name for path in tmp_path.iterdir()] == ["fig8"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["fig8", "--channel", "quasistatic"],
            r"--channel 'quasistatic' does not exist; did you mean 'quasi-static'",
        ),
        (["fig8", "--out", "fig8.png"], r"--out fig8\.png: several pictures"),
        (["table3", "none.toml", "--out", "{out}"], "none"),
        (["table4", "--out", "table4.md"], r"--out .*table4\.md"),
    ],
)
def test_a_wrong_option_is_refused_and_nothing_is_written(
    tmp_path: Path, words: list[str], message: str
) -> None:
    out = tmp_path / "out"
    given = [word.format(out=out) for word in words]
    with pytest.raises(CaviarError, match=message):
        CliRunner().invoke(app, ["paper", *given], catch_exceptions=False)
    assert not out.exists()


@pytest.mark.parametrize(("table", "part"), [("table3", "spacing"), ("table4", "arrays")])
def test_tables_3_and_4_are_parts_of_the_trade_off(
    table: str, part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[object] = []
    monkeypatch.setattr("caviar_labs.cli.measure.trade", lambda *words: asked.extend(words))
    words = ["paper", table, "smoke", "--frames", "3", "--minutes", "0.5", "--out", str(tmp_path)]
    assert CliRunner().invoke(app, words, catch_exceptions=False).exit_code == 0
    source, frames, options, json_file, out, _ = asked
    assert (source, frames, out) == (Path("smoke"), 3, tmp_path / table)
    assert (options.parts, options.seconds) == ((part,), 30.0)  # type: ignore[attr-defined]
    assert json_file == tmp_path / table / "tradeoff.json"


def test_a_policy_is_judged_alike_in_a_batch_and_on_a_recording(
    settings: Settings, report: Report, tmp_path: Path
) -> None:
    """A run has the channel of the episode of its seed; scales differ by the norm of H in each frame."""
    import caviar

    scenario = settings.folder / "geometric-quasi-static.toml"
    run = caviar.run(scenario, frames=40, seed=FIRST_EPISODE, out=tmp_path, embedded=True)
    played = recorded_episodes(run, ["uav/rx"])
    played.play(TUNED, settings.folder / "training" / "quasi-static-tuned" / "seed-1" / "policy.onnx")
    played.close()
    batch = report.played["quasi-static"]
    assert played.los.shape == (1, 40)
    np.testing.assert_allclose(played.angle_deg, batch.angle_deg[:1, :40], rtol=1e-6)
    for mine, theirs in (
        (played.los_beam, batch.los_beam),
        (played.chosen[TUNED][0], batch.chosen[TUNED][0]),
    ):
        np.testing.assert_allclose(mine / played.optimum, theirs[:1, :40] / batch.optimum[:1, :40], atol=1e-6)
