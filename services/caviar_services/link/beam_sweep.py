"""Link ``beams``: analog beamforming with DFT codebooks at both ends.

Each end has one RF chain and the DFT codebook of its array (paper, section 2.1). Every beam pair of every
user is swept each frame (eq. 1), so that the chosen pair stands beside the best one (eq. 2) and beside the
pair along the straight line (the baseline of section 4).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal, NamedTuple

import msgspec
import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array, Int32Array, Int64Array, quantity
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.beams import straight_beams
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.space.scene import directions
from caviar_protocol.topics import Carrier, Channel, Link, Scene
from caviar_protocol.topics.scene import AntennaArray, Device
from caviar_services.link.base import LinkModel
from caviar_services.link.users import Choices, User, UserChannels, Users, channels_of, choices_of, users_of
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
    _budget: _Budget | None = None

    def step(self, frame: Frame) -> StepResult:
        """Link of a frame. Raises `PayloadError` naming the agent or user at fault."""
        channel = frame.only("channel", Channel)
        if channel is None:
            raise PayloadError(f"{self.run.name} was granted frame {frame.number} without a channel")
        scene = frame.scene()
        budget = self._budget
        if budget is None or (budget.devices, budget.carriers) != (scene.devices, channel.carriers):
            budget = self._budget = _Budget.of(scene, channel.carriers, self.settings)
        users = budget.users
        choices = choices_of(frame, users)
        channels = channels_of(channel, users)
        scores = _score(scene, users, choices, channels, self.settings.top_k)
        without_path = sum([h is None for h in channels.h])
        counts = {
            "users-without-path": without_path - channels.unknown,  # what is unknown has no path either
            "users-without-channel": channels.unknown,
            "commands-for-absent-users": choices.outdated,
        }
        return StepResult(
            products={"link": self._link(budget, choices, channels, scores, without_path)},
            fidelity=channel.rung,
            counts={name: count for name, count in counts.items() if count},
        )

    def _link(
        self, budget: _Budget, choices: Choices, channels: UserChannels, scores: _Scores, without_path: int
    ) -> Link:
        settings = self.settings
        best = scores.top_abs_y[:, :1].reshape(-1)  # no column where there is no user
        snr = budget.power_over_noise * scores.abs_y**2
        efficiency = np.log2(1 + snr)
        if settings.max_spectral_efficiency is not None:
            efficiency = np.minimum(efficiency, settings.max_spectral_efficiency)
        match settings.reward:
            case "abs_y":
                reward = scores.abs_y
            case "normalised":
                reward = np.divide(scores.abs_y, best, out=np.zeros(len(best)), where=best > 0)
            case "snr":
                reward = snr
            case "spectral_efficiency":
                reward = efficiency
        return Link(
            tx=budget.tx,
            rx=budget.rx,
            carrier=budget.carrier,
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
            snr_best=budget.power_over_noise * best**2,
            spectral_efficiency=efficiency,
            bit_rate=budget.bandwidth * efficiency,
            reward=reward,
            no_path=without_path,
        )


@dataclass(frozen=True, eq=False)
class _Budget:
    """What stays the same while the same devices are there; Shape ``[U]`` each."""

    devices: tuple[Device, ...]
    carriers: tuple[Carrier, ...]
    users: Users
    tx: tuple[str, ...]
    rx: tuple[str, ...]
    carrier: tuple[str, ...]
    bandwidth: Float64Array
    power_over_noise: Float64Array

    @classmethod
    def of(cls, scene: Scene, carriers: tuple[Carrier, ...], settings: BeamLinkSettings) -> _Budget:
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


class _Scores(msgspec.Struct, frozen=True):
    """Fields of `Link` that come out of the sweep."""

    abs_y: Float64Array
    baseline_abs_y: Float64Array
    aod_azimuth: Float64Array
    aoa_azimuth: Float64Array
    top_tx_beam: Int32Array
    top_rx_beam: Int32Array
    top_abs_y: Float64Array


def _score(scene: Scene, users: Users, choices: Choices, channels: UserChannels, top_k: int) -> _Scores:
    """Sweep all pairs of all users and read off the chosen, the best and the baseline pairs."""
    towards_rx, towards_tx = directions(scene, users)
    k = min(top_k, max((user.tx.array.size * user.rx.array.size for user in users), default=0))
    chosen, baseline = [0.0] * len(users), [0.0] * len(users)
    tx_beams, rx_beams = choices.tx_beam.tolist(), choices.rx_beam.tolist()
    swept = sweep_users(users, channels.h)
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
    return _Scores(
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


SORTED_WHOLE = 256
"""Pairs up to which sorting all of them is faster than looking for the best first."""
SMALL = 32
"""Elements along an axis up to which a product of matrices is faster than a fast transform. From 64 on it
would be shared out to threads too, which on a busy machine wait for each other ten times as long."""


class Pairs(NamedTuple):
    """Beam pairs of U users, best first, Shape ``[U, k]`` each."""

    tx_beam: Int32Array
    rx_beam: Int32Array
    abs_y: Float64Array


def sweep(h: Complex128Array, tx: AntennaArray, rx: AntennaArray) -> Float64Array:
    """|y| of every pair of DFT beams, Shape ``[..., Nr, Nt]`` to ``[..., Nt, Nr]``.

    y = w* H f (paper, eq. 1) with the beams of `codebook.dft_codebook`. Both conj(w) and f have
    entries exp(−j2πkn/N)/sqrt(N), so the product over all pairs is a Fourier transform over the
    columns and rows of both arrays, and no codebook of N² entries has to be formed. Of several panels or
    polarizations each block is transformed by itself.
    """
    leading = h.shape[:-2]
    grids = (rx.size // (rx.columns * rx.rows), rx.columns, rx.rows)
    elements = h.reshape(*leading, *grids, tx.size // (tx.columns * tx.rows), tx.columns, tx.rows)
    y = elements
    for axis in (-5, -4, -2, -1):
        size = elements.shape[axis]
        if size > SMALL:
            y = np.fft.fft(y, axis=axis, norm="ortho")
        elif size > 1:
            y = (y.swapaxes(axis, -1) @ _fourier(size)).swapaxes(axis, -1)
    y = y.reshape(*leading, rx.size, tx.size)
    magnitude: Float64Array = np.abs(y.swapaxes(-1, -2))
    return magnitude


@lru_cache(maxsize=SMALL)
def _fourier(size: int) -> Complex128Array:
    """The unitary Fourier matrix, entries exp(−j2πkn/N)/sqrt(N)."""
    n = np.arange(size)
    matrix: Complex128Array = np.exp(-2j * np.pi * (np.outer(n, n) % size) / size) / np.sqrt(size)
    return matrix


def best_pairs(abs_y: Float64Array, k: int) -> Pairs:
    """The ``k`` pairs with the greatest |y|, Shape ``[U, Nt, Nr]``; all of them where there are fewer.

    The first one is eq. (2) of the paper. Of equal ones the lowest pair index
    ``tx_beam·Nr + rx_beam`` comes first.
    """
    flat = abs_y.reshape(len(abs_y), -1)
    k = min(k, flat.shape[1])
    if flat.shape[1] <= SORTED_WHOLE:
        order = (-flat).argsort(-1, "stable")[:, :k]
    else:
        order = np.array([_best_of_many(row, k) for row in flat])
    tx_beam, rx_beam = order.astype(np.int32), np.zeros(order.shape, np.int32)
    if abs_y.shape[2] > 1:
        tx_beam, rx_beam = np.divmod(tx_beam, np.int32(abs_y.shape[2]))
    if len(flat) > 1:
        order = order + np.arange(0, flat.size, flat.shape[1])[:, None]
    return Pairs(tx_beam, rx_beam, flat.take(order))


def _best_of_many(flat: Float64Array, k: int) -> Int64Array:
    """Indices of the ``k`` greatest, found without sorting all."""
    threshold = np.partition(flat, flat.size - k)[flat.size - k]
    candidates = np.flatnonzero(flat >= threshold)
    order: Int64Array = candidates[np.argsort(-flat[candidates], kind="stable")][:k]
    return order


class Swept(msgspec.Struct, frozen=True):
    """Users with equal arrays, swept as one batch."""

    users: list[int]
    abs_y: Float64Array
    """|y| of all beam pairs, Shape ``[len(users), Nt, Nr]``."""


def sweep_users(users: Users, h: Sequence[Complex128Array | None]) -> list[Swept]:
    """|y| of all beam pairs of the users with an H."""
    groups: dict[int, list[int]] = defaultdict(list)
    for index, (matrix, batch) in enumerate(zip(h, users.batch, strict=True)):
        if matrix is not None:
            groups[batch].append(index)
    swept = []
    for found in groups.values():
        first = users[found[0]]
        swept.append(Swept(found, sweep(np.array([h[u] for u in found]), first.tx.array, first.rx.array)))
    return swept
