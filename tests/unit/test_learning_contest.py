"""Contests of agents: each gets what it gets in a run of its own, and pays for its pilots."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from rich.console import Console
from typer.testing import CliRunner

from caviar_clients.cli.learning import _evaluation_tables, evaluate_command
from caviar_clients.cli.main import app
from caviar_clients.learning.contest import Contest, episodes_of, made_player
from caviar_clients.learning.evaluate import KINDS, Evaluation, Interval, evaluate
from caviar_clients.session.embedded import EmbeddedRun
from caviar_clients.session.prepared import prepare
from caviar_protocol.errors import CaviarError, RunError, ScenarioError
from caviar_protocol.recording import Recording
from caviar_services.agent.policy import CARD_KEY, PolicyCard, write_card

pytestmark = pytest.mark.slow

FRAMES = 60


@pytest.mark.parametrize("use", ["ucb", "last-sweep", "random", "hierarchical-sweep"])
def test_an_agent_gets_what_it_gets_in_a_run_of_its_own(use: str, tmp_path: Path) -> None:
    """Beside others: with two users, its own feedback and its own random numbers."""
    scenario = prepare("smoke", frames=FRAMES).scenario
    names = dict.fromkeys(["los-beam", use, "thompson"])
    with Contest(scenario, {name: made_player(scenario, name) for name in names}) as contest:
        played = contest.play(5)[use]
    spec = replace(scenario.services["agent"], use=use)
    alone = replace(
        scenario, run=replace(scenario.run, seed=5), services={**scenario.services, "agent": spec}
    )
    outcome = EmbeddedRun(alone, tmp_path).run()
    assert not outcome.error, outcome.error
    link = Recording(tmp_path)["link"]
    assert len(played.abs_y) == 2 * FRAMES
    np.testing.assert_array_equal(played.abs_y.reshape(FRAMES, 2), link.abs_y)


def test_pilots_are_paid_for_with_spectral_efficiency() -> None:
    scenario = prepare("geometric", frames=FRAMES).scenario
    dear = {"pilot_us": 500.0}  # 64 of them take 32 ms of 100 ms
    agents = {
        "oracle": made_player(scenario, "oracle"),
        "exhaustive-sweep": made_player(scenario, "exhaustive-sweep", dear),
        "last-sweep": made_player(scenario, "last-sweep", {**dear, "period": 4}),
    }
    with Contest(scenario, agents) as contest:
        found = contest.play(1)
    best, swept = found["oracle"], found["exhaustive-sweep"]
    np.testing.assert_array_equal(swept.abs_y, best.abs_y)
    np.testing.assert_array_equal(best.best, best.abs_y)
    np.testing.assert_allclose(swept.net_efficiency, 0.68 * best.net_efficiency, rtol=1e-12)
    assert (best.pilots, swept.pilots, found["last-sweep"].pilots) == (0, 64, 16)


def test_episodes_of_one_seed_follow_each_other_and_repeat() -> None:
    scenario = prepare("geometric", frames=20).scenario
    with Contest(scenario, {"ucb": made_player(scenario, "ucb")}) as contest:
        first = [contest.play(seed)["ucb"].abs_y for seed in episodes_of([3, 4, 3], 2)]
    np.testing.assert_array_equal(first[0], first[4])
    np.testing.assert_array_equal(first[1], first[5])
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first[0], first[2])


def test_users_that_are_not_served_do_not_count() -> None:
    scenario = prepare("smoke", frames=10).scenario
    one = ("car/rx",)
    with Contest(scenario, {"a": made_player(scenario, "los-beam", {}, one)}, one) as contest:
        assert len(contest.play(1)["a"].abs_y) == 10


def test_settings_that_do_not_fit_are_refused_by_name() -> None:
    scenario = prepare("geometric", frames=10).scenario
    with pytest.raises(ScenarioError, match=r"ucb\.discount"):
        made_player(scenario, "ucb", {"discount": 2.0})
    with pytest.raises(ScenarioError, match=r"fingerprint: lacks 'file'"):
        made_player(scenario, "fingerprint")


def test_a_setting_is_written_as_agent_setting_and_value() -> None:
    asked = ["policy", "evaluate", "none.onnx", "--on", "geometric", "--set", "ucb=3"]
    ended = CliRunner().invoke(app, asked)
    assert ended.exit_code != 0
    assert "write agent, setting and value" in str(ended.exception)


def model_of(file: Path, name: str, kind: int, shape: list[int], nodes: list[Any]) -> Path:
    """Write a model with a card for `geometric`; each node has an output."""
    onnx = pytest.importorskip("onnx")
    kinds = {"scores": onnx.TensorProto.FLOAT}
    outputs = [(of, kinds.get(of, onnx.TensorProto.INT64)) for node in nodes for of in node.output]
    made = onnx.helper.make_graph(
        nodes,
        "policy",
        [onnx.helper.make_tensor_value_info(name, kind, shape)],
        [onnx.helper.make_tensor_value_info(*output, None) for output in outputs],
    )
    model = onnx.helper.make_model(made, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    card = PolicyCard(observe=("aod",), codebooks=((64, 1),))
    onnx.helper.set_model_props(model, {CARD_KEY: write_card(card)})
    onnx.save(model, str(file))
    return file


@pytest.mark.parametrize(
    ("name", "kind", "shape", "output", "expected"),
    [
        (
            "aod",
            "DOUBLE",
            [1, 1],
            "action",
            r"takes 'aod' as tensor\(double\), and it is observed as float32",
        ),
        ("aod", "FLOAT", [1, 7], "action", r"takes 'aod' of shape \[1, 7\], and the scenario's is \[1, 1\]"),
        ("aoa", "FLOAT", [1, 1], "action", "takes aoa, and aod is observed"),
        ("aod", "FLOAT", [1, 1], "beams", "gives beams and no 'action'"),
    ],
)
def test_a_model_that_does_not_fit_what_is_observed_is_refused(
    name: str, kind: str, shape: list[int], output: str, expected: str, tmp_path: Path
) -> None:
    onnx = pytest.importorskip("onnx")
    node = onnx.helper.make_node("Cast", [name], [output], to=onnx.TensorProto.INT64)
    file = model_of(tmp_path / "p.onnx", name, getattr(onnx.TensorProto, kind), shape, [node])
    with pytest.raises(ScenarioError, match=rf"policy p\.onnx {expected}"):
        evaluate(file, "geometric", [1000])


@pytest.mark.parametrize(
    ("kind", "values", "expected"),
    [
        ("INT64", [], r"gives 0 index\(es\), and the scenario has 1 user"),
        ("INT64", [1, 2], r"gives 2 index\(es\), and the scenario has 1 user"),
        ("FLOAT", [math.nan], "chooses pair nan of 64 for place 0"),
        ("INT64", [-5], "chooses pair -5 of 64 for place 0"),
        ("INT64", [64], "chooses pair 64 of 64 for place 0"),
    ],
)
def test_a_model_that_gives_no_pair_of_beams_is_refused(
    kind: str, values: list[float], expected: str, tmp_path: Path
) -> None:
    onnx = pytest.importorskip("onnx")
    tensor = onnx.helper.make_tensor("v", getattr(onnx.TensorProto, kind), [len(values)], values)
    node = onnx.helper.make_node("Constant", [], ["action"], value=tensor)
    file = model_of(tmp_path / "p.onnx", "aod", onnx.TensorProto.FLOAT, [1, 1], [node])
    with pytest.raises(CaviarError, match=expected):
        evaluate(file, "geometric", [1000])


def test_candidates_of_a_policy_are_tried_by_pilots(tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    scores = onnx.helper.make_tensor(
        "v", onnx.TensorProto.FLOAT, [1, 1, 64], [float(i % 7) for i in range(64)]
    )
    chosen = onnx.helper.make_tensor("w", onnx.TensorProto.INT64, [1], [6])
    constants = [
        onnx.helper.make_node("Constant", [], [name], value=value)
        for name, value in (("scores", scores), ("action", chosen))
    ]
    file = model_of(tmp_path / "p.onnx", "aod", onnx.TensorProto.FLOAT, [1, 1], constants)
    bare = model_of(tmp_path / "q.onnx", "aod", onnx.TensorProto.FLOAT, [1, 1], constants[1:])
    with pytest.raises(ScenarioError, match=r"gives action and no 'scores'.*candidates = 1"):
        evaluate(bare, "geometric", [1], against={"policy": {"candidates": 2}})
    scenario = prepare("geometric", frames=20).scenario
    players = {
        str(k): made_player(scenario, "policy", {"file": str(file), "candidates": k, "pilot_us": 100.0})
        for k in (1, 5, 64)
    }
    with Contest(scenario, players | {"oracle": made_player(scenario, "oracle")}) as contest:
        found = contest.play(seed=1)
    assert [found[k].pilots for k in ("1", "5", "64", "oracle")] == [0, 5, 64, 0]
    assert np.array_equal(found["64"].abs_y, found["oracle"].abs_y)
    # Pairs 6, 13, 20, 27, 34; 6 alone without pilots.
    assert (found["5"].abs_y >= found["1"].abs_y).all()
    assert (found["5"].abs_y > found["1"].abs_y).any()
    left = 1 - 64 * 100e-6 / (scenario.run.sampling_period_ns / 1e9)
    assert np.allclose(found["64"].net_efficiency, left * found["oracle"].net_efficiency)


def test_settings_of_what_is_always_compared_with_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match=r"'random'.*users"):
        evaluate(tmp_path / "p.onnx", "geometric", [1000], against={"random": {"users": "uav/*"}})


def test_figures_that_cannot_be_written_are_known_before_the_first_episode(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"cannot write .*: Is a directory"):
        evaluate_command([tmp_path / "none.onnx"], "geometric", json=tmp_path)


def test_the_tables_of_an_evaluation_are_whole_at_80_columns() -> None:
    """Also of a traced channel, whose |y| has an exponent, and of what hardly receives anything."""
    means = {
        "policy": Interval(1.234e-5, 5.678e-7, 20),
        "hierarchical-sweep": Interval(1.234567e-8, 1.9e-12, 20),
        "my_module:AgentOfALongName": Interval(9.87e-13, 4.3e-14, 20),
        "optimum": Interval(2.5e-5, float("nan"), 1),
    }
    made = Evaluation(
        policy="policy.onnx",
        scenario="street-canyon",
        found={name: dict.fromkeys(KINDS, mean) for name, mean in means.items()},
        frames={"all": 1_000_000, "LOS": 600_000, "NLOS": 400_000},
        power={
            "policy": 2.0,
            "random": 0.5,
            "hierarchical-sweep": 1.0,
            "my_module:AgentOfALongName": 0.0,
            "optimum": 4.0,
        },
        efficiency=dict.fromkeys(means, Interval(24.17, 0.0251, 20)),
        pilots=dict.fromkeys(means, 6.4),
        by_episode={},
    )
    console = Console(width=80, record=True, file=io.StringIO())
    for table in _evaluation_tables(made):
        console.print(table)
    text = console.export_text()
    assert "mean |y| in 10⁻⁶" in text
    for row in (
        "│ policy                 │    12.34 ± 0.57 │",
        "│ hierarchical-sweep     │ 0.01235 ± 2e-06 │",
        "│ my_module:AgentOfALong │   1e-06 ± 4e-08 │",
        "│ optimum                │              25 │",
        "│ policy                  │     6.0 │     3.0 │            6.4 │ 24.17 ± 0.025 │",
        "│ my_module:AgentOfALongN │         │         │            6.4 │ 24.17 ± 0.025 │",
    ):
        assert row in text
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 80
