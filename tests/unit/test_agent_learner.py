"""Agent `learner`: its gradients, what it learns, and that it goes on from what was saved."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from link_builders import CARRIER, antenna, channel_of, frame_of, given, scene_of
from msgspec.structs import replace

from caviar_clients.session.prepared import prepare
from caviar_protocol.errors import CaviarError, ScenarioError
from caviar_protocol.scenario import DeviceSpec, find_scenario
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.antenna_arrays import dft_codebook
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.scene import directions, pairs_of
from caviar_protocol.topics import Action, AntennaArray, BeamChoice, Link, Scene
from caviar_services.agent.learner import LearnerAgent, LearnerSettings, Perceptron
from caviar_services.link.beams import BeamLink, BeamLinkSettings
from caviar_services.service import Preparation, RunInfo

ARRAY = AntennaArray(columns=8)
RUN = RunInfo(
    name="agent",
    carriers=(CARRIER,),
    devices=(
        DeviceSpec(name="bs", kind="antenna", role="tx", array=ARRAY),
        DeviceSpec(name="rx", kind="antenna", role="rx"),
    ),
)
QUICK = LearnerSettings(candidates=3, explore_frames=100, explore_least=0.1, updates=4, hidden=(32,), waves=4)


def seen_from(number: int) -> Scene:
    """A receiver that goes to and fro around the transmitter."""
    azimuth = 1.2 * np.sin(0.11 * number)
    place = (20 * float(np.cos(azimuth)), 20 * float(np.sin(azimuth)), 0.0)
    return scene_of(antenna("bs", "tx", (1, 8)), antenna("rx", "rx", (1, 1), place))


class Played(NamedTuple):
    """A frame of a `Player`."""

    tx_beam: int
    share: float
    """|y| over that of the best pair."""
    straight: float
    """The same of the pair along the straight line."""
    pilots: int


class Player:
    """A learner in front of a mirror: the best beam is the one opposite to the straight one, which has a
    third of its |y|."""

    def __init__(self, settings: LearnerSettings = QUICK, run: RunInfo = RUN) -> None:
        self.agent, self.link = (
            LearnerAgent(settings, run),
            BeamLink(BeamLinkSettings(), RunInfo(name="link")),
        )
        self.agent.prepare(Preparation(demand={}))
        self.agent.reset(0, 1, 0)

    def step(self, number: int) -> Played:
        scene = seen_from(number)
        (pair,) = pairs_of(scene)
        at_tx, at_rx = directions(scene, [pair])
        straight = straight_beams(pair.tx.array, at_tx[0], pair.rx.array, at_rx[0])[0]
        beams = dft_codebook(ARRAY)
        # Where both are one beam its |y| is that of the sum.
        h = (beams[(8 - straight) % 8] + beams[straight] / 3)[None] * 1e-5
        channel = channel_of(("bs",), ("rx",), {("mmwave", "bs", "rx"): h})
        seen = [given("scene", scene), given("channel", channel)]
        made = self.agent.step(frame_of(*seen, number=number, service="agent"))
        action = made.products["action"]
        link = self.link.step(frame_of(*seen, given("action", action), number=number)).products["link"]
        assert isinstance(link, Link)
        assert isinstance(action, Action)
        (choice,) = action.commands
        assert isinstance(choice, BeamChoice)
        best = link.top_abs_y[0, 0]
        shares = float(link.abs_y[0] / best), float(link.baseline_abs_y[0] / best)
        return Played(choice.tx_beam, *shares, made.counts["pilots"])


def test_it_learns_where_paths_leave_and_is_never_below_the_straight_line() -> None:
    player = Player()
    played = [player.step(number) for number in range(400)]
    assert all(one.share >= one.straight * (1 - 1e-12) for one in played)
    assert {one.pilots for one in played} == {3}
    reached = np.array([one.share for one in played])
    assert reached[:60].mean() < 0.75
    assert reached[-100:].mean() > 0.95


def test_with_noise_another_pair_serves_where_it_is_better_for_sure() -> None:
    """With pilots that the noise drowns the straight pair serves, with others the best one."""
    drowned = replace(QUICK, noise_figure_db=60.0, pilot_us=1e-6)
    heard = replace(QUICK, noise_figure_db=9.0)
    noisy = [Player(drowned).step(number) for number in range(40)]
    assert np.mean([one.share > one.straight for one in noisy]) < 0.2
    player = Player(heard)
    assert np.mean([player.step(number).share for number in range(300)][-80:]) > 0.9


def test_one_that_is_restored_chooses_on_as_before() -> None:
    settings = replace(QUICK, memory=30, explore_frames=60)
    player = Player(settings)
    for number in range(70):
        player.step(number)
    state = player.agent.checkpoint()
    expected = [player.step(number) for number in range(70, 110)]
    again = Player(settings)
    again.agent.restore(state)
    assert again.agent.checkpoint() == state
    assert [again.step(number) for number in range(70, 110)] == expected
    assert again.agent.checkpoint() == player.agent.checkpoint(), "bit by bit"


SCORES_OF_ONE = [float(beam == 5) for beam in range(8)]


def test_it_begins_from_the_ranking_of_a_policy_and_learns_what_is_different(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="needs the extra `policy`")
    policy_files = pytest.importorskip("policy_files", reason="needs onnx")
    file = policy_files.ranking_policy(tmp_path / "p.onnx", SCORES_OF_ONE)
    settings = replace(QUICK, policy=f"file:{file}", candidates=2, explore_least=0.0)
    shares = [Player(settings).step(number).share for number in range(60)]
    without = [Player(replace(settings, policy="")).step(number).share for number in range(60)]
    best = [Player(replace(settings, candidates=8)).step(number) for number in range(60)]
    opposite = [number for number, one in enumerate(best) if one.tx_beam == 5 and one.straight < 1]
    assert len(opposite) > 3
    assert [shares[number] for number in opposite] == [1.0] * len(opposite)
    assert np.mean([without[number] for number in opposite]) < 0.9
    # Of a station that it was not trained for it says nothing.
    of_one = policy_files.ranking_policy(tmp_path / "q.onnx", SCORES_OF_ONE, transmitter="bs")
    other = DeviceSpec(name="another", kind="antenna", role="tx", array=ARRAY)
    two = RunInfo(name="agent", carriers=RUN.carriers, devices=(other, *RUN.devices))
    given = replace(settings, policy=f"file:{of_one}")
    assert [Player(given, two).step(number).share for number in range(60)] == shares
    learning = Player(replace(settings, candidates=3, explore_least=0.3))
    reached = [learning.step(number).share for number in range(400)]
    assert np.mean(reached[-100:]) > np.mean(reached[:60]) + 0.1


def test_a_policy_that_ranks_nothing_is_refused_with_its_key(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime", reason="needs the extra `policy`")
    policy_files = pytest.importorskip("policy_files", reason="needs onnx")
    file = policy_files.ranking_policy(tmp_path / "p.onnx", SCORES_OF_ONE, with_scores=False)
    with pytest.raises(ScenarioError, match=r"settings\.policy.*p\.onnx gives action and no 'scores'"):
        Player(replace(QUICK, policy=f"file:{file}"))


def test_a_seed_leads_to_the_same_weights_and_another_one_elsewhere() -> None:
    states = []
    for seed in (1, 1, 2):
        player = Player()
        player.agent.reset(0, seed, 0)
        for number in range(10):
            player.step(number)
        states.append(player.agent.checkpoint())
    assert states[0] == states[1] != states[2]


@pytest.mark.parametrize("hidden", [(), (5,), (5, 4)])
def test_a_step_goes_down_the_gradient_of_the_squared_error(hidden: tuple[int, ...]) -> None:
    """Adam's first step is the learning rate along the sign of each derivative, here taken by differences."""
    rng = np.random.default_rng(3)
    sizes = (3, *hidden, 6)
    x, chosen, worth = rng.normal(size=(7, 3)), np.array([0, 2, 2, 5, 1, 0, 2]), rng.normal(size=7)

    def loss(network: Perceptron) -> float:
        return float(((network.values(x)[np.arange(7), chosen] - worth) ** 2).mean())

    network, stepped = (Perceptron(sizes, np.random.default_rng(8)) for _ in range(2))
    for number, offsets in enumerate(network._parameters):  # off the kinks, where there is no derivative
        moved = rng.normal(scale=0.3, size=offsets.shape)
        offsets += moved
        stepped._parameters[number] += moved
    stepped.learn(x, chosen, worth, 1e-3)
    checked = 0
    for before, after in zip(network._parameters, stepped._parameters, strict=True):
        for index in np.ndindex(before.shape):
            kept, ends = before[index], []
            for step in (1e-6, -1e-6):
                before[index] = kept + step
                ends.append(loss(network))
            before[index] = kept
            derivative = (ends[0] - ends[1]) / 2e-6
            moved = after[index] - kept
            if abs(derivative) > 1e-6:
                assert moved == pytest.approx(-1e-3 * np.sign(derivative), rel=0.02)
                checked += 1
            else:
                assert abs(moved) <= 1e-3
    assert checked > 10


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (LearnerSettings(observe=()), "is empty; write observe"),
        (LearnerSettings(observe=("aodd",)), "did you mean 'aod'"),
        (LearnerSettings(scale={"aoa": 2.0}), "'aoa' is not observed"),
        (LearnerSettings(observe=("camera",)), "camera"),
    ],
)
def test_what_it_cannot_observe_is_refused(settings: LearnerSettings, words: str) -> None:
    with pytest.raises(CaviarError, match=words):
        LearnerAgent(settings, RUN).prepare(Preparation(demand={}))


def test_a_part_that_does_not_exist_is_refused_with_its_key() -> None:
    with pytest.raises(ScenarioError, match=r"settings\.observe.*'aodd'"):
        LearnerAgent(LearnerSettings(observe=("aodd",)), RUN).prepare(Preparation(demand={}))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            'observe = ["aod", "buffered"]',
            "observe: observation 'buffered' is of packets, and link",
        ),
        ('observe = ["aodd"]', "observe: no observation is called 'aodd'; did you mean 'aod'?"),
        ('users = ["cra/*"]', "users: no receiver of the scenario is cra/*; there are: car/rx, uav/rx-uav"),
    ],
)
def test_what_the_scenario_does_not_have_is_refused_when_it_is_read(
    settings: str, words: str, tmp_path: Path
) -> None:
    text = find_scenario("smoke").read_text()
    assert 'use = "los-beam"' in text
    path = tmp_path / "my.toml"
    path.write_text(text.replace('use = "los-beam"', f'use = "learner"\nsettings.{settings}'))
    line = path.read_text().splitlines().index(f"settings.{settings}") + 1
    with pytest.raises(ScenarioError) as refused:
        prepare(path)
    assert f"my.toml:{line}: services.agent.settings.{words}" in str(refused.value)


def test_a_perceptron_that_could_not_serve_in_time_is_refused() -> None:
    settings = LearnerSettings(hidden=(4096, 4096))
    with pytest.raises(ScenarioError, match=r"settings\.hidden.*16,777,216"):
        LearnerAgent.check_settings(settings, Place("settings"))
