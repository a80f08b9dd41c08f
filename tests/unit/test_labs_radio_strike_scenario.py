"""Scenario `radio-strike` and ``caviar/RadioStrike-v0`` are one world: equal beams have equal mean SNR."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode
from recording_builders import record_run

from caviar_labs.radio_strike.rules import FIXED, MAX_AGE, PACKET_BITS
from caviar_labs.radio_strike.vector_env import RadioStrikeVectorEnv
from caviar_protocol.recording import Recording

pytestmark = pytest.mark.slow

FRAMES, MEMBERS = 600, 32
RECEIVERS = ("uav/rx-uav", "car/rx-car", "pedestrian/rx-pedestrian")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first six seconds of the scenario: dense traffic."""
    return record_run(tmp_path_factory.mktemp("runs") / "radio-strike-1", "radio-strike", frames=FRAMES)


@pytest.mark.parametrize("user", range(3))
def test_beams_of_a_run_have_the_mean_snr_that_they_have_in_the_environment(run: Path, user: int) -> None:
    """Means over time: single slots have other rays. 600 of them are within 5 % of their mean."""
    link = Recording(run)["link"]
    receiver = link.rx.index(RECEIVERS[user])
    envs = RadioStrikeVectorEnv(MEMBERS, AutoresetMode.SAME_STEP, episodes=run, users=RECEIVERS)
    envs.reset(seed=1)
    snr = np.zeros((FRAMES - 1, MEMBERS))
    for frame, beam in enumerate(link.tx_beam[: FRAMES - 1, receiver].tolist()):
        *_, infos = envs.step(np.tile([user, beam], (MEMBERS, 1)))
        snr[frame] = FIXED.snr_scale * infos.get("final_info", infos)["channel_mag"] ** 2
    there = float(link.snr[: FRAMES - 1, receiver].mean())
    assert 10 * np.log10(there / snr.mean()) == pytest.approx(0.0, abs=0.6)


def test_the_traffic_of_the_scenario_is_that_of_the_environment(run: Path) -> None:
    link = Recording(run)["link"]
    for user, receiver in enumerate(RECEIVERS):
        arrived = link.arrived[:, link.rx.index(receiver)] / PACKET_BITS
        mean = FIXED.means[0][user]
        # A Poisson number's variance is its mean: within five standard deviations.
        assert abs(arrived.mean() - mean) < 5 * np.sqrt(mean / FRAMES)
    # The slot in which a packet arrives is the first of ten.
    assert round(float(link.waiting.max()) / 0.01) == MAX_AGE
