"""Contests of agents: each gets what it gets in a run of its own, and pays for its pilots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_clients.learning.contest import Contest, episodes_of, made_player
from caviar_clients.session.checks import checked_scenario
from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.errors import ScenarioError
from caviar_protocol.recording import Recording

pytestmark = pytest.mark.slow

FRAMES = 60


@pytest.mark.parametrize("use", ["ucb", "last-sweep", "random", "hierarchical-sweep"])
def test_an_agent_gets_what_it_gets_in_a_run_of_its_own(use: str, tmp_path: Path) -> None:
    """Beside others: with two users, its own feedback and its own random numbers."""
    scenario = checked_scenario("smoke", frames=FRAMES)
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
    scenario = checked_scenario("geometric", frames=FRAMES)
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
    scenario = checked_scenario("geometric", frames=20)
    with Contest(scenario, {"ucb": made_player(scenario, "ucb")}) as contest:
        first = [contest.play(seed)["ucb"].abs_y for seed in episodes_of([3, 4, 3], 2)]
    np.testing.assert_array_equal(first[0], first[4])
    np.testing.assert_array_equal(first[1], first[5])
    assert not np.array_equal(first[0], first[1])
    assert not np.array_equal(first[0], first[2])


def test_users_that_are_not_served_do_not_count() -> None:
    scenario = checked_scenario("smoke", frames=10)
    one = ("car/rx",)
    with Contest(scenario, {"a": made_player(scenario, "los-beam", {}, one)}, one) as contest:
        assert len(contest.play(1)["a"].abs_y) == 10


def test_settings_that_do_not_fit_are_refused_by_name() -> None:
    scenario = checked_scenario("geometric", frames=10)
    with pytest.raises(ScenarioError, match=r"ucb\.discount"):
        made_player(scenario, "ucb", {"discount": 2.0})
    with pytest.raises(ScenarioError, match=r"fingerprint: lacks 'file'"):
        made_player(scenario, "fingerprint")


def test_a_setting_is_written_as_agent_setting_and_value() -> None:
    asked = ["evaluate", "none.onnx", "--on", "geometric", "--set", "ucb=3"]
    ended = CliRunner().invoke(app, asked)
    assert ended.exit_code != 0
    assert "write agent, setting and value" in str(ended.exception)
