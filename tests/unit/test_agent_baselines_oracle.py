"""Agent `oracle`: what it chooses, nothing beats."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given as for_all
from hypothesis import settings
from hypothesis import strategies as st
from link_builders import CARRIER, antenna, channel_of, frame_of, given, random_h, scene_of

from caviar_protocol.errors import PayloadError
from caviar_protocol.topics import Action, BeamChoice, Carrier, Channel, Link, Scene
from caviar_services.agent.base import AgentSettings
from caviar_services.agent.baselines import OracleAgent
from caviar_services.link.beams import BeamLink, BeamLinkSettings
from caviar_services.service import RunInfo

SECOND = Carrier(name="second", frequency_hz=60e9)
SCENE = scene_of(
    antenna("bs", "tx", (2, 3)),
    antenna("a/rx", "rx", (1, 2), (9.0, 0.0, 0.0)),
    antenna("b/rx", "rx", (2, 2), (0.0, 9.0, 0.0)),
)


def decided(scene: Scene, channel: Channel, users: tuple[str, ...] = ("*",)) -> Action:
    agent = OracleAgent(AgentSettings(users=users), RunInfo(name="oracle"))
    product = agent.step(frame_of(given("scene", scene), given("channel", channel))).products["action"]
    assert isinstance(product, Action)
    return product


@settings(deadline=None, max_examples=40)
@for_all(seed=st.integers(0, 2**32 - 1))
def test_the_link_scores_the_oracle_as_the_best(seed: int) -> None:
    """On two carriers with channels of their own."""
    carriers = (CARRIER, SECOND)
    h = {
        (carrier.name, "bs", rx): random_h(seed + i, size, 6)
        for i, carrier in enumerate(carriers)
        for rx, size in (("a/rx", 2), ("b/rx", 4))
    }
    channel = channel_of(("bs",), ("a/rx", "b/rx"), h, carriers)
    action = decided(SCENE, channel)
    link = BeamLink(BeamLinkSettings(), RunInfo(name="link")).step(
        frame_of(given("scene", SCENE), given("channel", channel), given("action", action, "oracle"))
    )
    product = link.products["link"]
    assert isinstance(product, Link)
    assert len(product.rx) == 4
    np.testing.assert_array_equal(product.abs_y, product.top_abs_y[:, 0])


def test_a_user_without_a_path_gets_no_choice() -> None:
    channel = channel_of(("bs",), ("a/rx", "b/rx"), {("mmwave", "bs", "b/rx"): random_h(3, 4, 6)})
    commands = decided(SCENE, channel).commands
    assert [c.rx for c in commands if isinstance(c, BeamChoice)] == ["b/rx"]


def test_it_chooses_only_for_its_own_users() -> None:
    h = {("mmwave", "bs", rx): random_h(3, n, 6) for rx, n in (("a/rx", 2), ("b/rx", 4))}
    commands = decided(SCENE, channel_of(("bs",), ("a/rx", "b/rx"), h), ("a/*",)).commands
    assert [c.rx for c in commands if isinstance(c, BeamChoice)] == ["a/rx"]


def test_without_a_channel_it_says_so_by_name() -> None:
    agent = OracleAgent(AgentSettings(), RunInfo(name="oracle"))
    with pytest.raises(PayloadError, match="frame 2 without a channel"):
        agent.step(frame_of(given("scene", SCENE), number=2, service="oracle"))
