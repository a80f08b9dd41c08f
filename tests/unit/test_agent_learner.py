"""Agent `learner`: its gradients, what it learns, and that it goes on from what was saved."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from link_builders import CARRIER, antenna, channel_of, frame_of, given, scene_of

from caviar_clients.session.prepared import prepare
from caviar_protocol.errors import CaviarError, ScenarioError
from caviar_protocol.messages import Status
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
QUICK = LearnerSettings(explore_frames=150, updates=4, hidden=(32,), waves=4)


def seen_from(number: int) -> Scene:
    """A receiver that goes to and fro around the transmitter."""
    azimuth = 1.2 * np.sin(0.11 * number)
    place = (20 * float(np.cos(azimuth)), 20 * float(np.sin(azimuth)), 0.0)
    return scene_of(antenna("bs", "tx", (1, 8)), antenna("rx", "rx", (1, 1), place))


class Player:
    """A learner and its link, with a mirror: the best beam is not the straight one, but the one opposite."""

    def __init__(self, settings: LearnerSettings = QUICK) -> None:
        self.agent, self.link = (
            LearnerAgent(settings, RUN),
            BeamLink(BeamLinkSettings(), RunInfo(name="link")),
        )
        self.agent.prepare(Preparation(demand={}))
        self.agent.reset(0, 1, 0)
        self.last: Link | None = None

    def step(self, number: int, status: Status = Status.FRESH) -> tuple[int, float]:
        """The beam that was chosen, and |y| over the best."""
        scene = seen_from(number)
        (pair,) = pairs_of(scene)
        at_tx, at_rx = directions(scene, [pair])
        straight = straight_beams(pair.tx.array, at_tx[0], pair.rx.array, at_rx[0])[0]
        inputs = [given("scene", scene)]
        if self.last is not None:
            inputs.append(given("link", self.last, status=status))
        action = self.agent.step(frame_of(*inputs, number=number, service="agent")).products["action"]
        h = 1e-5 * dft_codebook(ARRAY)[(8 - straight) % 8][None]
        channel = channel_of(("bs",), ("rx",), {("mmwave", "bs", "rx"): h})
        seen = [given("scene", scene), given("channel", channel), given("action", action)]
        link = self.link.step(frame_of(*seen, number=number)).products["link"]
        assert isinstance(link, Link)
        assert isinstance(action, Action)
        self.last = link
        (choice,) = action.commands
        assert isinstance(choice, BeamChoice)
        return choice.tx_beam, float(link.abs_y[0] / link.top_abs_y[0, 0])


def test_it_learns_where_paths_leave_while_it_serves() -> None:
    player = Player()
    reached = np.array([player.step(number)[1] for number in range(600)])
    assert reached[:100].mean() < 0.35
    assert reached[-150:].mean() > 0.8


def test_one_that_is_restored_chooses_on_as_before() -> None:
    player = Player(LearnerSettings(memory=30, explore_frames=60))
    for number in range(70):
        player.step(number)
    state, last = player.agent.checkpoint(), player.last
    expected = [player.step(number) for number in range(70, 110)]
    again = Player(LearnerSettings(memory=30, explore_frames=60))
    again.agent.restore(state)
    assert again.agent.checkpoint() == state
    again.last = last
    assert [again.step(number) for number in range(70, 110)] == expected
    assert again.agent.checkpoint() == player.agent.checkpoint(), "bit by bit"


def test_a_seed_leads_to_the_same_weights_and_another_one_elsewhere() -> None:
    states = []
    for seed in (1, 1, 2):
        player = Player()
        player.agent.reset(0, seed, 0)
        for number in range(10):
            player.step(number)
        states.append(player.agent.checkpoint())
    assert states[0] == states[1] != states[2]


def test_a_held_link_teaches_nothing_new() -> None:
    player = Player(LearnerSettings(explore_frames=1, explore_least=0.0))
    for number in range(5):
        player.step(number)
    (model,) = player.agent._models.values()
    player.step(5, Status.HELD)
    assert model.seen == 4
    player.step(6)
    assert model.seen == 5


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
