"""Bandits: they find the best pair, follow it when it changes, and go on from what was saved."""

from __future__ import annotations

import numpy as np
import pytest
from link_builders import CARRIER, antenna, channel_of, frame_of, given, scene_of

from caviar_protocol.messages import Status
from caviar_protocol.space.antenna_arrays import dft_codebook
from caviar_protocol.topics import Action, BeamChoice, Link
from caviar_services.agent.bandits import Bandit, BanditAgent, BanditSettings, ThompsonAgent, UcbAgent
from caviar_services.link.beams import BeamLink, BeamLinkSettings
from caviar_services.service import RunInfo

RUN = RunInfo(name="agent", carriers=(CARRIER,))
SCENE = scene_of(antenna("bs", "tx", (1, 8)), antenna("rx", "rx", (1, 1), (9.0, 1.0, 0.0)))
KINDS = [UcbAgent, ThompsonAgent]


class Player:
    """An agent and its link, frame by frame, with one path towards a beam."""

    def __init__(self, agent: BanditAgent) -> None:
        self.agent, self.link = agent, BeamLink(BeamLinkSettings(), RunInfo(name="link"))
        self.last: Link | None = None
        agent.reset(0, 1, 0)

    def step(self, number: int, towards: int, status: Status = Status.FRESH) -> int:
        """The beam that was chosen."""
        codebook = dft_codebook(SCENE.devices[0].array)  # type: ignore[union-attr]  # an antenna
        h = 1e-5 * codebook[towards][None]
        seen = [given("scene", SCENE)]
        if self.last is not None:
            seen.append(given("link", self.last, status=status))
        action = self.agent.step(frame_of(*seen, number=number, service="agent")).products["action"]
        assert isinstance(action, Action)
        channel = channel_of(("bs",), ("rx",), {("mmwave", "bs", "rx"): h})
        frame = frame_of(
            given("scene", SCENE), given("channel", channel), given("action", action), number=number
        )
        link = self.link.step(frame).products["link"]
        assert isinstance(link, Link)
        self.last = link
        (choice,) = action.commands
        assert isinstance(choice, BeamChoice)
        return choice.tx_beam


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("towards", [2, 6])
def test_it_finds_the_best_pair(kind: type[BanditAgent], towards: int) -> None:
    player = Player(kind(BanditSettings(exploration=0.1), RUN))
    chosen = [player.step(number, towards) for number in range(300)]
    assert np.mean(np.array(chosen[150:]) == towards) > 0.8


@pytest.mark.parametrize("kind", KINDS)
def test_it_follows_when_the_best_pair_changes(kind: type[BanditAgent]) -> None:
    player = Player(kind(BanditSettings(exploration=0.1, discount=0.97), RUN))
    chosen = [player.step(number, 2 if number < 300 else 5) for number in range(600)]
    assert np.mean(np.array(chosen[500:]) == 5) > 0.6


@pytest.mark.parametrize("kind", KINDS)
def test_one_that_is_restored_chooses_on_as_before(kind: type[BanditAgent]) -> None:
    player = Player(kind(BanditSettings(cell_m=5.0), RUN))
    for number in range(40):
        player.step(number, 3)
    state, last = player.agent.checkpoint(), player.last
    expected = [player.step(number, 3) for number in range(40, 80)]
    again = Player(kind(BanditSettings(cell_m=5.0), RUN))
    again.agent.restore(state)
    again.last = last
    assert again.agent.checkpoint() == state
    assert [again.step(number, 3) for number in range(40, 80)] == expected


def test_draws_are_of_the_frame_and_the_user() -> None:
    """Another seed leads elsewhere; the order in which users come does not."""
    bandit = Bandit(50)
    bandit.learn(0, 1.0, 1.0)
    agent = ThompsonAgent(BanditSettings(exploration=1.0), RUN)
    picked = [agent.pick(bandit, frame_of(number=number).generator("a")) for number in range(20)]
    assert picked == [agent.pick(bandit, frame_of(number=number).generator("a")) for number in range(20)]
    assert len(set(picked)) > 5


def test_a_held_link_is_learnt_from_once() -> None:
    player = Player(UcbAgent(BanditSettings(), RUN))
    for number in range(5):
        player.step(number, 3)
    before = player.agent.checkpoint()
    player.step(5, 3, Status.HELD)
    player.agent.restore(before)
    (bandit,) = player.agent._bandits.values()
    plays = bandit.plays.sum()
    player.step(5, 3, Status.HELD)
    assert bandit.plays.sum() == plays
    player.step(6, 3)
    assert bandit.plays.sum() > plays


def test_cells_are_shared_by_receivers() -> None:
    scene = scene_of(
        antenna("bs", "tx", (1, 8)),
        antenna("a/rx", "rx", (1, 1), (9.0, 1.0, 0.0)),
        antenna("b/rx", "rx", (1, 1), (9.5, 1.0, 0.0)),
    )
    agent = UcbAgent(BanditSettings(cell_m=5.0), RUN)
    agent.reset(0, 1, 0)
    agent.step(frame_of(given("scene", scene), service="agent"))
    assert len(agent._bandits) == 1
    apart = UcbAgent(BanditSettings(), RUN)
    apart.step(frame_of(given("scene", scene), service="agent"))
    assert len(apart._bandits) == 2
