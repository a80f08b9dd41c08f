"""Link ``beams``: analog beamforming with DFT codebooks at both ends.

Each end has one RF chain and the DFT codebook of its array (paper, section 2.1). Every beam
pair of every user is swept each frame, so that the chosen pair stands beside the best one and
beside the pair along the straight line (the baseline of section 4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, quantity
from caviar_protocol.coordinates import angles
from caviar_protocol.errors import PayloadError
from caviar_protocol.topics import Carrier, Channel, Link, Scene
from caviar_services.link.base import LinkModel
from caviar_services.link.choices import Choices, choices_of
from caviar_services.link.codebook import beam_towards
from caviar_services.link.sweep import best_pairs
from caviar_services.link.users import User, UserChannels, channels_of, directions, sweep_users, users_of
from caviar_services.service import Frame, StepResult

BOLTZMANN = 1.380649e-23
"""[J/K], exact (SI)."""

MAX_POWER_DBM = 200.0
"""A transmit power beyond this, either way, is a mistake of units and would overflow the SNR."""

RewardKind = Literal["abs_y", "normalised", "snr", "spectral_efficiency"]


class BeamLinkSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the link ``beams``."""

    top_k: Annotated[int, quantity("1", "best pairs listed per user", ge=1, le=4096)] = 10
    noise_figure_db: Annotated[float, quantity("dB", "of the receivers", ge=0, le=60)] = 9.0
    temperature_k: Annotated[float, quantity("K", "of the thermal noise", gt=0, le=1e6)] = 290.0
    max_spectral_efficiency: (
        Annotated[float, quantity("bit/s/Hz", "of the highest modulation and coding", gt=0, le=1e3)] | None
    ) = None
    """Cap of the spectral efficiency; absent: Shannon's bound as it is."""
    reward: RewardKind = "abs_y"
    """``abs_y``: |y| (paper, section 4); ``normalised``: |y| over that of the best pair; ``snr``:
    linear; ``spectral_efficiency``."""


class BeamLink(LinkModel[BeamLinkSettings]):
    """Scores the agents' beam pairs against the best pair and the straight-line pair."""

    Settings = BeamLinkSettings

    def step(self, frame: Frame) -> StepResult:
        """Link of a frame. Raises `PayloadError` naming the agent or user at fault."""
        channel = frame.only("channel", Channel)
        if channel is None:
            raise PayloadError(f"{self.run.name} was granted frame {frame.number} without a channel")
        scene = frame.scene()
        users = users_of(scene, channel.carriers)
        choices = choices_of(frame, users)
        channels = channels_of(channel, users)
        scores = _score(scene, users, choices, channels, self.settings.top_k)
        counts = {
            "users-without-path": int(np.sum(channels.known & ~channels.has_path)),
            "users-without-channel": int(np.sum(~channels.known)),
            "commands-for-absent-users": choices.outdated,
        }
        return StepResult(
            products={"link": self._link(users, choices, channels, scores)},
            fidelity=channel.rung,
            counts={name: count for name, count in counts.items() if count},
        )

    def _link(self, users: Sequence[User], choices: Choices, channels: UserChannels, scores: _Scores) -> Link:
        settings = self.settings
        bandwidth = np.array([user.carrier.bandwidth_hz for user in users], dtype=np.float64)
        noise = np.array(
            [noise_power(user.carrier, settings.noise_figure_db, settings.temperature_k) for user in users]
        )
        power_over_noise = np.array([transmit_power(user) for user in users]) / noise
        best = scores.top_abs_y.max(axis=1, initial=0.0)
        snr = power_over_noise * scores.abs_y**2
        efficiency = np.log2(1 + snr)
        if settings.max_spectral_efficiency is not None:
            efficiency = np.minimum(efficiency, settings.max_spectral_efficiency)
        rewards: dict[RewardKind, Float64Array] = {
            "abs_y": scores.abs_y,
            "normalised": np.divide(scores.abs_y, best, out=np.zeros(len(users)), where=best > 0),
            "snr": snr,
            "spectral_efficiency": efficiency,
        }
        return Link(
            tx=tuple(user.tx.name for user in users),
            rx=tuple(user.rx.name for user in users),
            carrier=tuple(user.carrier.name for user in users),
            has_path=channels.has_path,
            los=channels.los,
            tx_beam=choices.tx_beam,
            rx_beam=choices.rx_beam,
            abs_y=scores.abs_y,
            top_tx_beam=scores.top_tx_beam,
            top_rx_beam=scores.top_rx_beam,
            top_abs_y=scores.top_abs_y,
            baseline_abs_y=scores.baseline_abs_y,
            aod_azimuth=scores.aod_azimuth,
            aoa_azimuth=scores.aoa_azimuth,
            snr=snr,
            snr_best=power_over_noise * best**2,
            spectral_efficiency=efficiency,
            bit_rate=bandwidth * efficiency,
            reward=rewards[settings.reward],
            no_path=int(np.sum(~channels.has_path)),
        )


def noise_power(carrier: Carrier, noise_figure_db: float, temperature_k: float) -> float:
    """Thermal noise k·T·B·F [W] in the carrier's bandwidth (Recommendation ITU-R P.372, noise factor)."""
    return BOLTZMANN * temperature_k * carrier.bandwidth_hz * 10 ** (noise_figure_db / 10)


def transmit_power(user: User) -> float:
    """Transmit power [W] of a user's transmitter; `PayloadError` where it cannot be meant."""
    if not abs(user.tx.power_dbm) <= MAX_POWER_DBM:
        raise PayloadError(
            f"device {user.tx.name!r} transmits {user.tx.power_dbm} dBm; "
            f"power_dbm must lie within ±{MAX_POWER_DBM:g}"
        )
    return 10 ** ((user.tx.power_dbm - 30) / 10)


@dataclass(frozen=True)
class _Scores:
    """Fields of `Link` that come out of the sweep."""

    abs_y: Float64Array
    top_tx_beam: Int32Array
    top_rx_beam: Int32Array
    top_abs_y: Float64Array
    baseline_abs_y: Float64Array
    aod_azimuth: Float64Array
    aoa_azimuth: Float64Array


def _score(
    scene: Scene, users: Sequence[User], choices: Choices, channels: UserChannels, top_k: int
) -> _Scores:
    """Sweep all pairs of all users and read off the chosen, the best and the baseline pairs."""
    at_tx, at_rx = directions(scene, users)
    k = min(top_k, max((user.tx.array.size * user.rx.array.size for user in users), default=0))
    scores = _Scores(
        abs_y=np.zeros(len(users)),
        top_tx_beam=np.full((len(users), k), -1, dtype=np.int32),
        top_rx_beam=np.full((len(users), k), -1, dtype=np.int32),
        top_abs_y=np.zeros((len(users), k)),
        baseline_abs_y=np.zeros(len(users)),
        aod_azimuth=angles(at_tx)[:, 1],
        aoa_azimuth=angles(at_rx)[:, 1],
    )
    served: BoolArray = choices.tx_beam >= 0
    for u, abs_y in enumerate(sweep_users(users, channels.h)):
        if abs_y is None:
            continue
        best = best_pairs(abs_y, k)
        listed = len(best.abs_y)
        scores.top_tx_beam[u, :listed] = best.tx_beam
        scores.top_rx_beam[u, :listed] = best.rx_beam
        scores.top_abs_y[u, :listed] = best.abs_y
        if served[u]:
            scores.abs_y[u] = abs_y[choices.tx_beam[u], choices.rx_beam[u]]
        baseline = (beam_towards(users[u].tx.array, at_tx[u]), beam_towards(users[u].rx.array, at_rx[u]))
        scores.baseline_abs_y[u] = abs_y[baseline]
    return scores
