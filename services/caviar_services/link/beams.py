"""Link ``beams``: analog beamforming with DFT codebooks at both ends, scored frame by frame.

Every beam pair of every user is swept each frame (`beam_sweep`), so that the chosen pair stands beside the
best one (paper, eq. 2) and beside the pair along the straight line (the baseline of section 4). The link has
no state: what a user gets follows from the channel and the choices of the frame alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Int32Array, Int64Array, quantity
from caviar_protocol.cell.rates import shannon
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.space.scene import directions
from caviar_protocol.topics import Carrier, Channel, Link, Scene
from caviar_protocol.topics.scene import Device
from caviar_services.channel.batch import ChannelBatch, SceneAt
from caviar_services.link.base import (
    Choices,
    LinkModel,
    UserChannels,
    Users,
    channels_of,
    choices_of,
    noise_power,
    require_channel,
    transmit_power,
    users_of,
)
from caviar_services.link.batch import LinkBatch
from caviar_services.link.beam_sweep import Pairs, Swept, best_pairs, sweep_users
from caviar_services.link.interference import Interferers
from caviar_services.service import Frame, StepResult

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


class BeamLinkSettings(SweepSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the link ``beams``."""

    reward: RewardKind = "abs_y"
    """``abs_y``: |y| (paper, section 4); ``normalised``: |y| over that of the best pair; ``snr``:
    linear; ``spectral_efficiency``."""
    interference: bool = False
    """Whether users hear the transmitters that serve others on their carrier in the same frame: each spreads
    its power evenly over all its users with beams. Spectral efficiency and bit rate follow from the SINR."""


B = TypeVar("B", bound=SweepSettings)


class SweepingLink(LinkModel[B]):
    """Base of links that score the chosen beams of a frame beside all others.

    Args:
        settings: Noise, cap of the spectral efficiency, and how many pairs are listed.
        run: What the link knows about the run.
    """

    # Of the last frame. Devices and carriers seldom change from frame to frame; comparing them is cheaper
    # than naming all users and their noise anew.
    _budget: Budget | None = None

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
            budget = self._budget = Budget.of(scene, channel.carriers, self.settings)
        users = budget.users
        choices = choices_of(frame, users)
        channels = channels_of(channel, users)
        swept = sweep_users(users, channels.h)
        scores = _score(scene, users, choices, swept, self.settings.top_k)
        without_path = sum([h is None for h in channels.h])
        return Scored(channel, scene, budget, choices, channels, swept, scores, without_path)

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


class BeamLink(SweepingLink[BeamLinkSettings]):
    """Scores the agents' beam pairs against the best pair and the straight-line pair.

    Args:
        settings: Noise, cap of the spectral efficiency, reward, and how many pairs are listed.
        run: What the link knows about the run.

    Example:
        >>> from caviar_services.service import RunInfo
        >>> from caviar_services.testing.samples import granted
        >>> link = BeamLink(BeamLinkSettings(top_k=1), RunInfo(name="link"))
        >>> found = link.step(granted(link.inputs, 0, "link")).products["link"]
        >>> found.rx, bool((found.abs_y <= found.top_abs_y[:, 0]).all())
        (('car.1/rx', 'truck.2/rx'), True)
    """

    Settings = BeamLinkSettings
    batches = True

    @classmethod
    def computes_batches(cls, settings: Mapping[str, object]) -> bool:
        """Whether many episodes can be computed at once: without interference."""
        return super().computes_batches(settings) and not settings.get("interference", False)

    def batch(
        self, channels: ChannelBatch, members: int, frames: int, scene_at: Callable[[int], SceneAt]
    ) -> LinkBatch:
        """Make the links of many episodes at once."""
        # Late: it is made of what this module has.
        from caviar_services.link.beam_batch import BeamBatch

        return BeamBatch(self.settings, self.run.carriers, channels, members, frames, scene_at)

    _interferers: tuple[Users, Interferers] | None = None

    def step(self, frame: Frame) -> StepResult:
        """Compute the link of a frame.

        Raises:
            PayloadError: As of `SweepingLink.score`.
            ProductError: As of `SweepingLink.score`.
        """
        scored = self.score(frame)
        fields = self.fields(scored, self.settings.reward)
        if self.settings.interference:
            self._add_interference(scored, fields)
        return StepResult(
            products={"link": Link(**fields)},
            fidelity=scored.channel.rung,
            counts={name: count for name, count in self.counts(scored).items() if count},
        )

    def _add_interference(self, scored: Scored, fields: dict[str, Any]) -> None:
        """Put the SINR into the fields, and what follows from it."""
        users, choices, budget = scored.budget.users, scored.choices, scored.budget
        if self._interferers is None or self._interferers[0] is not users:
            self._interferers = users, Interferers.of(users)
        rise = self._interferers[1].noise_rise(
            scored.swept, budget.power_over_noise, choices.tx_beam, choices.rx_beam
        )
        sinr = fields["snr"] / (1 + rise)
        efficiency = shannon(sinr, self.settings.max_spectral_efficiency)
        fields |= {
            "sinr": sinr,
            "spectral_efficiency": efficiency,
            "bit_rate": budget.bandwidth * efficiency,
        }
        if self.settings.reward == "spectral_efficiency":
            fields["reward"] = efficiency


@dataclass(frozen=True, eq=False)
class Budget:
    """What stays the same while the same devices are there; Shape ``[U]`` each."""

    devices: tuple[Device, ...]
    carriers: tuple[Carrier, ...]
    users: Users
    tx: tuple[str, ...]
    rx: tuple[str, ...]
    carrier: tuple[str, ...]
    bandwidth: Float64Array
    power_over_noise: Float64Array
    receive_beams: Int64Array
    """Beams of the receivers."""

    @classmethod
    def of(cls, scene: Scene, carriers: tuple[Carrier, ...], settings: SweepSettings) -> Budget:
        """Of the devices of a scene.

        Args:
            scene: Has the devices.
            carriers: C carriers.
            settings: Of the noise.
        """
        users = users_of(scene, carriers)
        figure, temperature = settings.noise_figure_db, settings.temperature_k
        noise = np.array([noise_power(user.carrier, figure, temperature) for user in users])
        return cls(
            devices=scene.devices,
            carriers=carriers,
            users=users,
            tx=tuple(user.tx.name for user in users),
            rx=tuple(user.rx.name for user in users),
            carrier=tuple(user.carrier.name for user in users),
            bandwidth=np.array([user.carrier.bandwidth_hz for user in users], dtype=np.float64),
            power_over_noise=np.array([transmit_power(user) for user in users]) / noise,
            receive_beams=np.array([user.rx.array.size for user in users], np.int64),
        )


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
    budget: Budget
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
    k = min(top_k, max((user.tx.array.size * user.rx.array.size for user in users), default=0))
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


def _listed(swept: Sequence[Swept], users: int, k: int) -> Pairs:
    """The best pairs of all users, Shape ``[U, k]``; −1 and |y| 0 where a user has fewer."""
    found = [best_pairs(group.abs_y, k) for group in swept]
    if len(swept) == 1 and found[0].abs_y.shape == (users, k):
        return found[0]  # all users in their order
    listed = Pairs(np.full((users, k), -1, np.int32), np.full((users, k), -1, np.int32), np.zeros((users, k)))
    for group, pairs in zip(swept, found, strict=True):
        length = pairs.abs_y.shape[1]
        listed.tx_beam[group.users, :length] = pairs.tx_beam
        listed.rx_beam[group.users, :length] = pairs.rx_beam
        listed.abs_y[group.users, :length] = pairs.abs_y
    return listed
