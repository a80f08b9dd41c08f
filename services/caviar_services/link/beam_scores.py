"""Scores of the chosen beam pairs of a frame: |y|, SNR, spectral efficiency, bit rate and reward.

Every beam pair of every user is swept (`beam_sweep`), so that the chosen pair stands beside the best one
(paper, eq. 2) and beside the pair along the straight line (the baseline of section 4).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Int32Array, quantity
from caviar_protocol.cell.rates import shannon
from caviar_protocol.space.beams import BeamPairs, best_pairs, straight_beams
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.space.scene import directions
from caviar_protocol.topics import Channel, Scene
from caviar_services.link.base import (
    Choices,
    LinkModel,
    UserChannels,
    Users,
    channels_of,
    choices_of,
    require_channel,
)
from caviar_services.link.beam_sweep import Swept, sweep_users
from caviar_services.link.link_budget import LinkBudget
from caviar_services.service import Frame

RewardKind = Literal["abs_y", "normalised", "snr", "spectral_efficiency"]


class SweepSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of all links that sweep the codebooks."""

    top_k: Annotated[int, quantity("1", "best pairs listed per user", ge=1, le=4096)] = 10
    noise_figure_db: Annotated[float, quantity("dB", "of the receivers", ge=0, le=60)] = 9.0
    temperature_k: Annotated[float, quantity("K", "of the thermal noise", gt=0, le=1e6)] = 290.0
    max_spectral_efficiency: (
        Annotated[float, quantity("bit/s/Hz", "of the highest modulation and coding", gt=0, le=1e3)] | None
    ) = None
    """Cap of the spectral efficiency; absent: Shannon's bound as it is."""


B = TypeVar("B", bound=SweepSettings)


class SweepingLink(LinkModel[B]):
    """Base of links that score the chosen beams of a frame beside all others.

    Args:
        settings: Noise, cap of the spectral efficiency, and how many pairs are listed.
        run: What the link knows about the run.
    """

    # Of the last frame. Devices and carriers seldom change from frame to frame; comparing them is cheaper
    # than naming all users and their noise anew.
    _budget: LinkBudget | None = None

    def score(self, frame: Frame) -> Scored:
        """Look up users, choices and channels of a frame, and sweep all beam pairs.

        Args:
            frame: The frame.

        Raises:
            PayloadError: There is no channel, or a user, or two agents, are at fault; the text names them.
            ProductError: An agent is at fault.
        """
        channel = require_channel(frame)
        scene = frame.scene()
        budget = self._budget
        if budget is None or (budget.devices, budget.carriers) != (scene.devices, channel.carriers):
            budget = self._budget = self._budget_of(scene, channel)
        users = budget.users
        choices = choices_of(frame, users)
        channels = channels_of(channel, users)
        swept = sweep_users(users, channels.h)
        scores = _score(scene, users, choices, swept, self.settings.top_k)
        without_path = sum([h is None for h in channels.h])
        return Scored(channel, scene, budget, choices, channels, swept, scores, without_path)

    def _budget_of(self, scene: Scene, channel: Channel) -> LinkBudget:
        settings = self.settings
        return LinkBudget.of(scene, channel.carriers, settings.noise_figure_db, settings.temperature_k)

    def counts(self, scored: Scored) -> dict[str, int]:
        """Events of a frame by name, those that did not happen too."""
        unknown = scored.channels.unknown
        return {
            "users-without-path": scored.without_path - unknown,  # what is unknown has no path either
            "users-without-channel": unknown,
            "commands-for-absent-users": scored.choices.outdated,
        }

    def fields(self, scored: Scored, reward_kind: str) -> dict[str, Any]:
        """Fields of `Link` that follow from the sweep: |y|, SNR, spectral efficiency, bit rate, reward.

        Args:
            scored: The frame.
            reward_kind: What the field ``reward`` is, one of `RewardKind`; |y| for any other.
        """
        settings, budget, scores = self.settings, scored.budget, scored.scores
        best = scores.top_abs_y[:, :1].reshape(-1)  # no column where there is no user
        # Beams have unit norm, so |y|² is the power gain of the pair; one RF chain an end carries one stream,
        # whose Shannon bound this is.
        snr = budget.power_over_noise * scores.abs_y**2
        efficiency = shannon(snr, settings.max_spectral_efficiency)
        reward = scores.abs_y
        match reward_kind:
            case "normalised":
                reward = np.divide(scores.abs_y, best, out=np.zeros(len(best)), where=best > 0)
            case "snr":
                reward = snr
            case "spectral_efficiency":
                reward = efficiency
        return {
            "tx": budget.tx,
            "rx": budget.rx,
            "carrier": budget.carrier,
            "has_path": scored.channels.has_path,
            "los": scored.channels.los,
            "tx_beam": scored.choices.tx_beam,
            "rx_beam": scored.choices.rx_beam,
            "abs_y": scores.abs_y,
            "top_tx_beam": scores.top_tx_beam,
            "top_rx_beam": scores.top_rx_beam,
            "top_abs_y": scores.top_abs_y,
            "baseline_abs_y": scores.baseline_abs_y,
            "aod_azimuth": scores.aod_azimuth,
            "aoa_azimuth": scores.aoa_azimuth,
            "snr": snr,
            "snr_best": budget.power_over_noise * best**2,
            "spectral_efficiency": efficiency,
            "bit_rate": budget.bandwidth * efficiency,
            "reward": reward,
            "no_path": scored.without_path,
        }


class Scores(msgspec.Struct, frozen=True):
    """Fields of `Link` that come out of the sweep."""

    abs_y: Float64Array
    baseline_abs_y: Float64Array
    aod_azimuth: Float64Array
    aoa_azimuth: Float64Array
    top_tx_beam: Int32Array
    top_rx_beam: Int32Array
    top_abs_y: Float64Array


class Scored(NamedTuple):
    """A frame with all beam pairs swept."""

    channel: Channel
    scene: Scene
    budget: LinkBudget
    choices: Choices
    channels: UserChannels
    swept: list[Swept]
    scores: Scores
    without_path: int
    """Users that no path reaches."""


def _score(scene: Scene, users: Users, choices: Choices, swept: Sequence[Swept], top_k: int) -> Scores:
    """Read off the chosen, the best and the baseline pairs of all users."""
    towards_rx, towards_tx = directions(scene, users)
    # Users with fewer pairs than others fill up with −1 (`_listed`), so that the lists are one array.
    k = min(top_k, max((user.beam_pairs for user in users), default=0))
    chosen, baseline = [0.0] * len(users), [0.0] * len(users)
    tx_beams, rx_beams = choices.tx_beam.tolist(), choices.rx_beam.tolist()
    for group in swept:
        for u, abs_y in zip(group.users, group.abs_y, strict=True):
            user = users[u]
            if tx_beams[u] >= 0:
                chosen[u] = abs_y[tx_beams[u], rx_beams[u]]
            baseline[u] = abs_y[straight_beams(user.tx.array, towards_rx[u], user.rx.array, towards_tx[u])]
    # One array of all numbers, cut up: nested lists take three times as long.
    numbers = np.array([*chosen, *baseline, *_azimuths(towards_rx), *_azimuths(towards_tx)], np.float64)
    abs_y, baseline_abs_y, aod_azimuth, aoa_azimuth = numbers.reshape(4, -1)
    best = _listed(swept, len(users), k)
    return Scores(
        abs_y=abs_y,
        baseline_abs_y=baseline_abs_y,
        aod_azimuth=aod_azimuth,
        aoa_azimuth=aoa_azimuth,
        top_tx_beam=best.tx_beam,
        top_rx_beam=best.rx_beam,
        top_abs_y=best.abs_y,
    )


def _azimuths(directions: Sequence[Vector]) -> list[float]:
    return [math.atan2(y, x) for x, y, _ in directions]


def _listed(swept: Sequence[Swept], users: int, k: int) -> BeamPairs:
    """The best pairs of all users, Shape ``[U, k]``; −1 and |y| 0 where a user has fewer."""
    found = [best_pairs(group.abs_y, k) for group in swept]
    if len(swept) == 1 and found[0].abs_y.shape == (users, k):
        return found[0]  # all users in their order
    listed = BeamPairs(
        np.full((users, k), -1, np.int32), np.full((users, k), -1, np.int32), np.zeros((users, k))
    )
    for group, pairs in zip(swept, found, strict=True):
        length = pairs.abs_y.shape[1]
        listed.tx_beam[group.users, :length] = pairs.tx_beam
        listed.rx_beam[group.users, :length] = pairs.rx_beam
        listed.abs_y[group.users, :length] = pairs.abs_y
    return listed
