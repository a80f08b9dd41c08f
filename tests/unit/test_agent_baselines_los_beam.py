"""Agent `los-beam`: the beams along the straight line, from the scene alone."""

from __future__ import annotations

import math

import pytest
from link_builders import antenna, frame_of, given, scene_of

from caviar_protocol.topics import Action, BeamChoice
from caviar_services.agent.base import AgentSettings
from caviar_services.agent.baselines import LosBeamAgent
from caviar_services.service import RunInfo


def choice(bs_yaw: float, rx_yaw: float, azimuth: float) -> BeamChoice:
    """A BS with 16 columns at the origin, a receiver with 8 at 40 m."""
    position = (40 * math.cos(azimuth), 40 * math.sin(azimuth), 0.0)
    scene = scene_of(
        antenna("bs", "tx", (1, 16), yaw=bs_yaw), antenna("r", "rx", (1, 8), position, yaw=rx_yaw)
    )
    agent = LosBeamAgent(AgentSettings(), RunInfo(name="los"))
    product = agent.step(frame_of(given("scene", scene))).products["action"]
    assert isinstance(product, Action)
    (command,) = product.commands
    assert isinstance(command, BeamChoice)
    return command


def test_boresight_to_boresight_is_beam_0_at_both_ends_on_every_carrier() -> None:
    assert choice(0.0, math.pi, 0.0) == BeamChoice(tx="bs", rx="r", tx_beam=0, rx_beam=0)


@pytest.mark.parametrize("tx_beam", [1, 3, 7, 9, 13, 15])
def test_tx_beam_is_that_of_the_angle_from_the_arrays_own_boresight(tx_beam: int) -> None:
    """Beam k of 16 looks to sin φ = 2k/16, from the right for k > 8; the BS is turned by 100°."""
    turns = tx_beam / 16 - (tx_beam > 8)
    turned = math.radians(100)
    azimuth = turned + math.asin(2 * turns)
    assert choice(turned, azimuth + math.pi, azimuth).tx_beam == tx_beam


def test_turning_the_receiver_moves_its_beam_the_other_way() -> None:
    """A receiver that turns left by asin(2/8) sees the BS one beam further to its right."""
    step = math.asin(2 / 8)
    assert [choice(0.0, math.pi + turn * step, 0.0).rx_beam for turn in (-1, 0, 1)] == [1, 0, 7]
