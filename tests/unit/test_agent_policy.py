"""Policies as ONNX files: exported, served in a run, evaluated; and what does not fit is refused by name."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.learning.evaluate import evaluate, mean_of, student_95
from caviar_clients.learning.export import TRIALS, card_of, export_module
from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.errors import CaviarError, RunError, ScenarioError, SetupError
from caviar_protocol.observations import Moment, Observer, Users
from caviar_protocol.recording import Recording
from caviar_protocol.recording.reader import recorded_decisions
from caviar_protocol.scenario import Scenario, load_scenario
from caviar_services.agent.policy import PolicyModel

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

pytestmark = pytest.mark.slow

SCENARIOS = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"
BEAMS = 64


class Straight(torch.nn.Module):  # type: ignore[misc]
    """The beam towards the azimuth of departure, as if there were no elevation."""

    def forward(self, aod: Any) -> Any:
        return torch.remainder(torch.round(BEAMS * 0.5 * torch.sin(aod[:, 0])).to(torch.int64), BEAMS)


class Constant(torch.nn.Module):  # type: ignore[misc]
    """The same pair whatever is observed."""

    def __init__(self, pair: int) -> None:
        super().__init__()
        self.pair = pair

    def forward(self, aod: Any) -> Any:
        return aod[:, 0].to(torch.int64) * 0 + self.pair


class BeyondLater(torch.nn.Module):  # type: ignore[misc]
    """A pair that is not there, but where nothing is observed."""

    def forward(self, aod: Any) -> Any:
        return (aod[:, 0] != 0).to(torch.int64) * BEAMS


class NoSensors:
    """A frame of which scene and link alone are observed."""

    def payloads(self, topic: str, cls: type[Any]) -> dict[str, Any]:
        return {}


def made(
    folder: Path, module: Any, name: str = "policy.onnx", scenario: str = "geometric", **facts: Any
) -> Path:
    env = BeamSelectionEnv(scenario, observe=("aod",))
    card = card_of(env, algorithm="by hand", seeds=(1,), **facts)
    export_module(module, env.observation_space, folder / name, card)
    return folder / name


def with_policy(folder: Path, file: str = "policy.onnx", base: str = "geometric", more: str = "") -> Path:
    """A shipped scenario whose agent is the policy of a file in its folder."""
    text = (SCENARIOS / f"{base}.toml").read_text()
    settings = f'use = "policy"\nsettings.file = "file:{file}"\n{more}'
    assert 'use = "los-beam"' in text
    text = text.replace('use = "los-beam"', settings, 1).replace("frames = 500", "frames = 40", 1)
    path = folder / "scenario.toml"
    path.write_text(text)
    return path


def run(scenario: Scenario, folder: Path) -> Recording:
    folder.mkdir()
    outcome = EmbeddedRun(scenario, folder).run()
    assert not outcome.error, outcome.error
    return Recording(folder)


def test_a_served_policy_chooses_as_it_was_trained(tmp_path: Path) -> None:
    file = made(tmp_path, Straight())
    scenario = load_scenario(with_policy(tmp_path))
    recording = run(scenario, tmp_path / "run")
    # What it observed is read from the recording by the same code.
    users = Users(scenario, ("*",))
    observer = Observer(scenario, users, ("aod",))
    for scene, link in zip(recording["scene"], recording["link"], strict=True):
        moment = Moment(NoSensors(), scene, None, users.present(scene))
        wanted = Straight()(torch.from_numpy(observer.read(moment)["aod"][None]))
        assert link.tx_beam.tolist() == wanted.tolist()
    card = PolicyModel(file).card
    assert card is not None
    assert (card.observe, card.codebooks, card.algorithm) == (("aod",), ((BEAMS, 1),), "by hand")
    assert "torch" in card.versions


def test_the_digest_of_the_policy_stands_in_every_frame(tmp_path: Path) -> None:
    file = made(tmp_path, Straight())
    run(load_scenario(with_policy(tmp_path)), tmp_path / "run")
    digest = PolicyModel(file).digest
    decided = recorded_decisions(Recording(tmp_path / "run"))
    assert decided == {("agent", 0, frame): {"policy": digest} for frame in range(40)}


def test_a_replay_with_another_policy_is_refused(tmp_path: Path) -> None:
    made(tmp_path, Straight())
    scenario = load_scenario(with_policy(tmp_path))
    run(scenario, tmp_path / "run")
    decided = recorded_decisions(Recording(tmp_path / "run"))
    (tmp_path / "same").mkdir()
    assert not EmbeddedRun(scenario, tmp_path / "same", imposed=decided).run().error
    made(tmp_path, Constant(3))
    (tmp_path / "other").mkdir()
    error = EmbeddedRun(scenario, tmp_path / "other", imposed=decided).run().error
    assert "frame 0 was decided by the policy of SHA-256" in error


def test_ten_thousand_choices_are_those_of_the_library(tmp_path: Path) -> None:
    torch.manual_seed(3)
    layers = torch.nn.Sequential(
        torch.nn.Linear(1, 64),
        torch.nn.ReLU(),
        torch.nn.Linear(64, 64),
        torch.nn.ReLU(),
        torch.nn.Linear(64, BEAMS),
    )

    class Net(torch.nn.Module):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__()
            self.layers = layers

        def forward(self, aod: Any) -> Any:
            return self.layers(100 * torch.sin(7 * aod)).argmax(1)

    model = PolicyModel(made(tmp_path, Net()))
    seen = np.random.default_rng(5).uniform(-np.pi, np.pi, (10_000, 1)).astype(np.float32)
    with torch.no_grad():
        wanted = np.array([int(Net()(torch.from_numpy(row[None]))) for row in seen])
    found = np.array([int(model.act({"aod": row})[0]) for row in seen])
    assert (found == wanted).all()
    assert len(set(wanted.tolist())) > 3, "the network chooses"


def refused(scenario: Path, folder: Path) -> str:
    folder.mkdir()
    try:
        return EmbeddedRun(load_scenario(scenario), folder).run().error
    except CaviarError as error:
        return str(error)


def test_what_does_not_fit_is_refused_with_both_sides(tmp_path: Path) -> None:
    file = made(tmp_path, Straight())
    content = file.read_bytes()
    (tmp_path / "cut.onnx").write_bytes(content[: len(content) // 2])
    cut = refused(with_policy(tmp_path, "cut.onnx"), tmp_path / "a")
    line = with_policy(tmp_path).read_text().splitlines().index('settings.file = "file:policy.onnx"') + 1
    assert f"scenario.toml:{line}: services.agent.settings.file: policy cut.onnx is no ONNX model" in cut
    assert "export the policy again" in cut
    other = refused(with_policy(tmp_path, base="smoke"), tmp_path / "b")
    assert "was trained for 1 user(s) with beams 64 × 1, and the scenario has 2 user(s)" in other
    assert "services.agent.settings.file" in other or "scenario.toml" in other
    for keeps in (True, False):  # geometric has a receiver that turns with its UAV
        made(tmp_path, Straight(), "turned.onnx", keeps_heading=keeps)
        text = refused(with_policy(tmp_path, "turned.onnx"), tmp_path / f"turned-{keeps}")
        assert ("keeps_heading = true, and uav/rx" in text) == keeps
        assert bool(text) == keeps
    missing = refused(with_policy(tmp_path, "none.onnx"), tmp_path / "c")
    assert "none.onnx" in missing
    made(tmp_path, Constant(BEAMS), "beyond.onnx")
    text = refused(with_policy(tmp_path, "beyond.onnx"), tmp_path / "d")
    assert "scenario.toml:" in text
    assert "settings.file: policy" in text
    assert "policy beyond.onnx chooses pair 64 of 64 for place 0" in text
    made(tmp_path, BeyondLater(), "later.onnx")
    text = refused(with_policy(tmp_path, "later.onnx"), tmp_path / "e")
    assert "the policy chose pair 64 of 64 for uav/rx" in text


class Unstable(torch.nn.Module):  # type: ignore[misc]
    """A network that fails where nothing is observed."""

    def forward(self, aod: Any) -> Any:
        return torch.gather(torch.zeros(1, 4), 1, 99 * (1 - aod.to(torch.int64)))[:, 0].to(torch.int64)


@pytest.mark.parametrize(
    ("module", "dtype", "words"),
    [
        (
            Straight(),
            torch.float64,
            "takes 'aod' as tensor(double), and it is observed as float32; export the policy with inputs",
        ),
        (Unstable(), torch.float32, "cannot be run ("),
    ],
)
def test_a_model_that_cannot_be_run_is_refused_at_its_key(
    module: Any, dtype: Any, words: str, tmp_path: Path
) -> None:
    file = tmp_path / "bare.onnx"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter by tracing
        example = (torch.ones(1, 1, dtype=dtype),)
        torch.onnx.export(
            module, example, str(file), input_names=["aod"], output_names=["action"], dynamo=False
        )
    scenario = with_policy(tmp_path, "bare.onnx", more='settings.observe = ["aod"]')
    text = refused(scenario, tmp_path / "a")
    line = scenario.read_text().splitlines().index('settings.file = "file:bare.onnx"') + 1
    assert f"scenario.toml:{line}: services.agent.settings.file: policy bare.onnx {words}" in text
    assert "Traceback" not in text


def test_a_file_without_a_card_says_what_to_write(tmp_path: Path) -> None:
    file = tmp_path / "bare.onnx"
    example = (torch.zeros(1, 1),)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the exporter by tracing
        torch.onnx.export(
            Straight(), example, str(file), input_names=["aod"], output_names=["action"], dynamo=False
        )
    text = refused(with_policy(tmp_path, "bare.onnx"), tmp_path / "a")
    assert "has no card that says what it observes; write observe = ['aod']" in text
    more = 'settings.observe = ["aod"]'
    run(load_scenario(with_policy(tmp_path, "bare.onnx", more=more)), tmp_path / "b")
    wrong = refused(with_policy(tmp_path, "bare.onnx", more='settings.observe = ["aoa"]'), tmp_path / "c")
    assert "policy bare.onnx takes aod, and aoa is observed" in wrong
    wide = refused(with_policy(tmp_path, "bare.onnx", "smoke", 'settings.observe = ["aod"]'), tmp_path / "d")
    assert "takes 'aod' of shape [1, 1], and the scenario's is [1, 2]" in wide


def test_a_policy_leaves_other_transmitters_to_a_named_baseline(tmp_path: Path) -> None:
    second = """[[devices]]
name = "other"
kind = "antenna"
role = "tx"
position_m = [0.0, 9.0, 20.0]
array = { columns = 8 }
"""
    (tmp_path / "policy.onnx").touch()
    file = with_policy(tmp_path, more='settings.others = "los-beam"')
    file.write_text(file.read_text() + second)
    env = BeamSelectionEnv(file, observe=("aod",), transmitters="bs")
    assert env.action_space.n == BEAMS
    export_module(Constant(3), env.observation_space, tmp_path / "policy.onnx", card_of(env))
    for link in run(load_scenario(file), tmp_path / "run")["link"]:
        own = link.tx.index("bs")
        assert link.tx_beam[own] == 3
        assert link.abs_y[1 - own] == link.baseline_abs_y[1 - own] > 0
    with pytest.raises(ScenarioError, match=r"transmitter mast.*uav/rx.*bs"):
        BeamSelectionEnv(file, observe=("aod",), transmitters="mast")


def test_an_export_that_chooses_otherwise_is_refused(tmp_path: Path) -> None:
    env = BeamSelectionEnv("geometric", observe=("aod",))
    space, file = env.observation_space, tmp_path / "p.onnx"

    def export(otherwise: int) -> None:
        choices = iter([1] * otherwise + [0] * TRIALS)
        export_module(Constant(0), space, file, card_of(env), lambda _: np.array([next(choices)]))

    for often in (2, TRIALS):
        with pytest.raises(SetupError, match="the exported policy chooses"):
            export(otherwise=often)
        assert not file.exists()
    export(otherwise=1)  # a tie within rounding
    assert file.exists()


def test_evaluation_beside_the_baselines(tmp_path: Path) -> None:
    file = made(tmp_path, Straight())
    found = evaluate(file, "geometric", range(3))
    assert found.ratio("los-beam") == pytest.approx(1, abs=0.1)
    assert found.ratio("random") > 3
    assert found.frames["all"] == 1500
    assert found.frames["LOS"] + found.frames["NLOS"] == 1500
    assert found.found["optimum"]["NLOS"].mean > found.found["los-beam"]["NLOS"].mean
    with pytest.raises(ScenarioError, match="was trained for"):
        evaluate(file, "smoke", range(1))


def test_the_command_prints_and_writes_the_figures(tmp_path: Path) -> None:
    file = made(tmp_path, Straight())
    asked = [
        "policy",
        "evaluate",
        str(file),
        "--on",
        "geometric",
        "--seeds",
        "2",
        "--json",
        str(tmp_path / "f.json"),
    ]
    ended = CliRunner().invoke(app, asked)
    assert ended.exit_code == 0, ended.output
    assert "optimum" in ended.output
    figures = json.loads((tmp_path / "f.json").read_text())
    assert figures["frames"]["all"] == 1000
    assert figures["abs_y"]["policy"]["LOS"]["episodes"] == 2
    mine, its = (figures["episodes"]["abs_y"][m]["NLOS"] for m in ("policy", "optimum"))
    lacks = np.mean(mine) - np.mean(its)
    assert figures["policy_minus"]["optimum"]["NLOS"]["mean"] == pytest.approx(lacks)
    assert lacks < 0
    assert figures["episodes"]["seeds"] == [1000, 1001]
    assert figures["pilots"]["exhaustive-sweep"] == BEAMS
    assert figures["pilots"]["hierarchical-sweep"] == 12
    left = figures["spectral_efficiency"]
    assert left["exhaustive-sweep"]["mean"] < left["optimum"]["mean"]


def test_the_agents_to_compare_with_can_be_named_and_set(tmp_path: Path) -> None:
    file = made(tmp_path, Straight())
    asked = [
        "policy",
        "evaluate",
        str(file),
        "--on",
        "geometric",
        "--seeds",
        "1",
        "--json",
        str(tmp_path / "f.json"),
    ]
    more = ["--against", "ucb", "--set", "ucb.discount=0.9", "--set", "last-sweep.period=250"]
    ended = CliRunner().invoke(app, [*asked, *more])
    assert ended.exit_code == 0, ended.output
    pilots = json.loads((tmp_path / "f.json").read_text())["pilots"]
    assert list(pilots) == ["policy", "los-beam", "random", "optimum", "ucb", "last-sweep"]
    assert pilots["last-sweep"] == 2 * BEAMS / 500


@pytest.mark.parametrize(
    ("degrees", "quantile"), [(1, 12.7062), (2, 4.3027), (3, 3.1824), (4, 2.7764), (30, 2.0423)]
)
def test_students_quantile(degrees: int, quantile: float) -> None:
    assert student_95(degrees) == pytest.approx(quantile, rel=4e-3)


def test_a_mean_leaves_out_episodes_without_such_frames() -> None:
    found = mean_of([1.0, float("nan"), 3.0])
    assert (found.mean, found.episodes) == (2.0, 2)
    assert found.half_width == pytest.approx(12.706, rel=1e-4)


@pytest.mark.parametrize(
    ("name", "expected"), [(".", "is a folder; name the ONNX"), ("taken/p.onnx", "cannot write")]
)
def test_an_export_that_cannot_be_written_is_refused(name: str, expected: str, tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    env = BeamSelectionEnv("geometric")
    with pytest.raises(RunError, match=expected):
        export_module(Constant(0), env.observation_space, tmp_path / name, card_of(env))
    assert (tmp_path / "taken").read_text() == "a file"
