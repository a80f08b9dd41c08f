"""Scores of the chosen beam pairs of a frame: |y|, SNR, spectral efficiency, bit rate and reward.

Every beam pair of every user is swept (`sweep_users`), so that the chosen pair stands beside the best one
(paper, eq. 2) and beside the pair along the straight line (the baseline of section 4).

Each end has one RF chain and the DFT codebook of its array (paper, section 2.1). Every beam pair of every
user is swept each frame (eq. 1, `caviar_protocol.space.beams.beam_gains`).

Over the band and the slots of a frame the equivalent channel (eq. 1) of a pair of beams w and f is

    y(Δf, Δt) = w* H(Δf, Δt) f = Σ_p (w* r_p) · (t_pᵀ f) · a_p · exp(−j2π(Δf·(τ_p − Δt·ν_p/f_c) − ν_p·Δt))

with the phases r_p and t_p of the elements on path p: two numbers a path instead of a matrix a subcarrier
(`beam_responses`).

Interference (`Interferers`) comes from transmitters that serve others at the same time on the same carrier.

Receiver u listens with its beam w_u; a transmitter x serves its users v with beams f_v and spreads its power
P_x evenly over those that it serves at once or in turn, K_x of them. Beside the noise N_u there is

    I_u = Σ_x P_x · (1/K_x) · Σ_v |w_u* H_xu f_v|²   over all x that do not serve u,

and the SINR is S_u/(I_u + N_u).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int32Array, Int64Array, quantity
from caviar_protocol.cell.link_adaptation import shannon
from caviar_protocol.errors import PayloadError
from caviar_protocol.multipath import subcarrier_weights
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.beams import BeamPairs, beam_gains, best_pairs, straight_beams
from caviar_protocol.space.codebooks import beam_count, codebook_of
from caviar_protocol.space.coordinates import Vector, rotation_matrix
from caviar_protocol.space.scene import device_pose, directions
from caviar_protocol.topics import AntennaDevice, Channel, Scene
from caviar_protocol.topics.channel import PLANE_WAVES
from caviar_services.link.base import (
    Choices,
    LinkModel,
    UserChannels,
    Users,
    channels_of,
    choices_of,
    require_channel,
)
from caviar_services.link.link_budget import LinkBudget
from caviar_services.service import Frame


class Swept(msgspec.Struct, frozen=True):
    """Users with equal arrays, swept as one batch."""

    users: list[int]
    abs_y: Float64Array
    """|y| of all beam pairs, Shape ``[len(users), Nt, Nr]``."""


def sweep_users(users: Users, h: Sequence[Complex128Array | None]) -> list[Swept]:
    """Sweep all users that have an H, those with equal arrays as one batch.

    Args:
        users: The users.
        h: H of each user, Shape ``[Nr, Nt]``; None for a user without a path.

    Returns:
        A batch for each combination of arrays.

    Example:
        >>> from caviar_services.link.base import channels_of, users_of
        >>> from caviar_services.testing.samples import CARRIERS, product, scene
        >>> users = users_of(scene(0), CARRIERS)
        >>> [batch.abs_y.shape for batch in sweep_users(users, channels_of(product("channel", 0), users).h)]
        [(1, 16, 3), (1, 16, 2)]
    """
    groups: dict[int, list[int]] = defaultdict(list)
    for index, (matrix, group) in enumerate(zip(h, users.array_groups, strict=True)):
        if matrix is not None:
            groups[group].append(index)
    swept = []
    for found in groups.values():
        first = users[found[0]]
        stacked = np.array([h[u] for u in found])
        swept.append(Swept(found, beam_gains(stacked, first.tx.array, first.rx.array)))
    return swept


def beam_responses(
    channel: Channel, scene: Scene, users: Users, beams: Sequence[tuple[int, int]]
) -> list[Complex128Array]:
    """Compute y of each user's beam pair on the subcarriers and in the slots of its carrier.

    Args:
        channel: With its paths; on the rungs ``spherical`` and ``mimo-rt``, where an array does not see
            plane waves, with part ``hf``; so for arrays of dual polarization or several panels.
        scene: Of the same frame.
        users: Of that scene.
        beams: TX and RX beam of each user; a pair with −1 is not served.

    Returns:
        Of each user, Shape ``[S, K]`` with S slots and K subcarriers; zeros for a user that is not served,
        has no path, or is not in ``channel``.

    Raises:
        PayloadError: Naming the user, for a beam that its codebook does not have, or where part ``hf`` is
            missing.

    Example:
        >>> from caviar_services.link.base import users_of
        >>> from caviar_services.testing.samples import CARRIERS, product, scene
        >>> users = users_of(scene(0), CARRIERS)
        >>> responses = beam_responses(product("channel", 0), scene(0), users, [(0, 0)] * len(users))
        >>> [y.shape for y in responses]  # slots × subcarriers of the carrier
        [(2, 5), (2, 5)]
    """
    # Asked for by a service that needs it (part `hf`), so mostly there are none.
    matrices = {(response.carrier, response.tx, response.rx): response.h for response in channel.hf}
    rotations: dict[str, Float64Array] = {}
    found = []
    for user, indices, (tx_beam, rx_beam) in zip(users, users.channel_indices(channel), beams, strict=True):
        if indices is None or tx_beam < 0 or rx_beam < 0:
            found.append(np.zeros((user.carrier.slots, user.carrier.subcarriers), np.complex128))
            continue
        for beam, device in ((tx_beam, user.tx), (rx_beam, user.rx)):
            count = beam_count(device.array)
            if beam >= count:
                raise PayloadError(
                    f"beam {beam} of user {user} does not exist; the codebook of {device.name!r} has beams "
                    f"0 to {count - 1}"
                )
        ends = (
            codebook_of(user.tx.array).vector(tx_beam).conj(),
            codebook_of(user.rx.array).vector(rx_beam).conj(),
        )
        index, tx, rx = indices
        # The one amplitude of a path is that between two of its devices' subarrays.
        uniform = user.tx.array.is_uniform and user.rx.array.is_uniform
        if channel.rung in PLANE_WAVES and uniform:
            paths = channel.pair(user.tx.name, user.rx.name)
            sent = _gains(scene, user.tx, channel.aod[paths], ends[0], rotations)
            taken = _gains(scene, user.rx, channel.aoa[paths], ends[1], rotations)
            carrier = channel.carriers[index]
            weights = subcarrier_weights(carrier, channel.tau[paths], channel.doppler[index, paths])
            found.append(weights @ (channel.a[index, paths] * sent * taken))
        elif (index, tx, rx) in matrices:
            found.append((matrices[index, tx, rx] @ ends[0]) @ ends[1])
        else:
            raise PayloadError(
                f"the response of user {user} on rung {channel.rung!r} does not follow from paths; ask for "
                "part 'hf' of the channel in the inputs of this service"
            )
    return found


def _gains(
    scene: Scene,
    device: AntennaDevice,
    angles: Float64Array,
    beam: Complex128Array,
    rotations: dict[str, Float64Array],
) -> Complex128Array:
    """Gain of a beam on paths with these angles in world axes, Shape ``[P, 2]`` to ``[P]``."""
    if device.array.size == 1:
        return np.ones(len(angles), np.complex128)
    # Of one device for all its users: a base station is the transmitter of most of them.
    if device.name not in rotations:
        rotations[device.name] = rotation_matrix(device_pose(scene, device).orientation)
    sine = np.sin(angles[:, 0])
    directions = np.empty((len(angles), 3))
    directions[:, 0] = sine * np.cos(angles[:, 1])
    directions[:, 1] = sine * np.sin(angles[:, 1])
    directions[:, 2] = np.cos(angles[:, 0])
    gains: Complex128Array = steering_vector(device.array, directions @ rotations[device.name]) @ beam
    return gains


HIGHEST_SNR_DB = 60.0
"""Beyond it receivers are not linear, error vectors of transmitters hide the noise, and all beams carry the
highest rate: powers, losses or noise are not those of the field."""

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
        return LinkBudget.for_scene(scene, channel.carriers, settings.noise_figure_db, settings.temperature_k)

    def counts(self, scored: Scored) -> dict[str, int]:
        """Events of a frame by name, those that did not happen too."""
        unknown = scored.channels.unknown
        snr_best = scored.budget.power_over_noise[:, None] * scored.scores.top_abs_y[:, :1] ** 2
        return {
            "users-without-path": scored.without_path - unknown,  # what is unknown has no path either
            "users-without-channel": unknown,
            "commands-for-absent-users": scored.choices.outdated,
            "snr-above-60-db": int((snr_best > 10 ** (HIGHEST_SNR_DB / 10)).sum()),
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


def amplitudes(
    swept: Sequence[Swept], count: int, users: Int64Array, tx_beams: Int64Array, rx_beams: Int64Array
) -> Float64Array:
    """Look up |w* H f| of beams that need not be those of one user.

    Args:
        swept: All beam pairs of all users that have a path.
        count: Number of users, U.
        users: Index of the user whose H it is, any Shape.
        tx_beams: Index of f in the codebook of its transmitter, of the same Shape.
        rx_beams: Index of w in the codebook of its receiver, of the same Shape.

    Returns:
        |y|, of the same Shape; 0 without a path.
    """
    found = np.zeros(users.shape)
    for group in swept:
        place = np.full(count, -1, np.int64)
        place[group.users] = np.arange(len(group.users))
        where = place[users]
        if len(group.users) == count:
            return group.abs_y[where, tx_beams, rx_beams]
        here = where >= 0
        found[here] = group.abs_y[where[here], tx_beams[here], rx_beams[here]]
    return found


@dataclass(frozen=True, eq=False)
class Interferers:
    """Users that hear the transmitters of others, while the same users are there; K pairs of these."""

    victims: Int64Array
    """The user that hears, Shape ``[K]``."""
    culprits: Int64Array
    """The user that the other transmitter serves, on the same carrier."""
    between: Int64Array
    """The user of that transmitter and the victim's receiver."""
    groups: Int64Array
    """A number for each user, the same for those of one transmitter and carrier, Shape ``[U]``."""

    @classmethod
    def for_users(cls, users: Users) -> Interferers:
        """Make it for the users of a scene.

        Args:
            users: All of them.

        Example:
            >>> from caviar_services.link.base import users_of
            >>> from caviar_services.testing.samples import CARRIERS, scene
            >>> len(Interferers.for_users(users_of(scene(0), CARRIERS)).victims)  # one base station
            0
        """
        names = [(user.tx.name, user.rx.name, user.carrier.name) for user in users]
        index = {name: number for number, name in enumerate(names)}
        groups: dict[tuple[str, str], int] = {}
        numbers = [groups.setdefault((tx, carrier), len(groups)) for tx, _, carrier in names]
        found = [
            (victim, culprit, index[other, rx, carrier])
            for victim, (tx, rx, carrier) in enumerate(names)
            for culprit, (other, _, same) in enumerate(names)
            if tx != other and carrier == same and (other, rx, carrier) in index
        ]
        victims, culprits, between = np.array(found, np.int64).reshape(-1, 3).T.copy()
        return cls(victims, culprits, between, np.array(numbers, np.int64))

    def noise_rise(
        self,
        swept: Sequence[Swept],
        power_over_noise: Float64Array,
        tx_beam: Int32Array,
        rx_beam: Int32Array,
    ) -> Float64Array:
        """Interference over noise of all users where each transmitter serves all its users with beams.

        Args:
            swept: All beam pairs of all users that have a path.
            power_over_noise: Of each user, Shape ``[U]``.
            tx_beam: Chosen TX beam of each user, −1 for one that is not served, Shape ``[U]``.
            rx_beam: Chosen RX beam, likewise.

        Returns:
            I/N, Shape ``[U]``; 0 for users that are not served.
        """
        served: BoolArray = tx_beam >= 0
        heard = served[self.victims] & served[self.culprits]
        victims, culprits, between = self.victims[heard], self.culprits[heard], self.between[heard]
        sharing = np.bincount(self.groups[served], minlength=int(self.groups.max(initial=0)) + 1)
        beams = tx_beam[culprits].astype(np.int64), rx_beam[victims].astype(np.int64)
        gain = amplitudes(swept, len(served), between, *beams) ** 2
        rise = power_over_noise[between] * gain / sharing[self.groups[culprits]]
        # One after the other, in the order of the culprits: equal sums on every machine.
        return np.bincount(victims, rise, minlength=len(served)).astype(np.float64)
