"""Link ``beams``: analog beamforming with DFT codebooks at both ends, scored frame by frame.

Every beam pair of every user is swept each frame (`beam_sweep`), so that the chosen pair stands beside the
best one (paper, eq. 2) and beside the pair along the straight line (the baseline of section 4). The link has
no state: what a user gets follows from the channel and the choices of the frame alone.

Of many episodes at once all pairs are swept for some frames ahead, as one array: a beam has no influence on
the next frame (`BeamBatch`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.cell.link_adaptation import shannon
from caviar_protocol.space.beams import beam_gains, straight_beams
from caviar_protocol.space.scene import antennas, directions
from caviar_protocol.topics import Carrier, Link
from caviar_services.channel.base import BatchChannels, ChannelBatch, MemberSeed, SceneAt
from caviar_services.link.base import BatchLink, LinkBatch, User, Users
from caviar_services.link.beam_scores import Interferers, RewardKind, Scored, SweepingLink, SweepSettings
from caviar_services.link.link_budget import LinkBudget
from caviar_services.service import Frame, StepResult

HELD = 2**17
"""Complex numbers that are held at once while frames are computed ahead: they stay in the caches."""


class BeamLinkSettings(SweepSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the link ``beams``."""

    reward: RewardKind = "abs_y"
    """``abs_y``: |y| (paper, section 4); ``normalised``: |y| over that of the best pair; ``snr``:
    linear; ``spectral_efficiency``."""
    interference: bool = False
    """Whether users hear the transmitters that serve others on their carrier in the same frame: each spreads
    its power evenly over all its users with beams. Spectral efficiency and bit rate follow from the SINR."""


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


# --- many episodes at once ------------------------------------------------------------


class _Ahead(NamedTuple):
    """K frames whose beam pairs are swept; M is 1 where all members have the same channel."""

    first: int
    """Number of the first one."""
    frames: int
    budget: LinkBudget
    swept: list[Float64Array]
    """|y| of each user by the index of the pair, Shape ``[M, K, Nt·Nr]``."""
    best: Float64Array
    """Shape ``[M, K, U]``; ``baseline`` likewise."""
    baseline: Float64Array
    has_path: BoolArray
    """Shape ``[M, K, U]``."""
    los: BoolArray
    """Shape ``[K, U]``."""


class BeamBatch(LinkBatch):
    """Links of M members.

    Args:
        settings: Of the link.
        carriers: Of the run.
        channels: Of all members.
        members: M.
        frames: Of an episode.
        scene_at: The scene of a frame, by its number.
    """

    def __init__(
        self,
        settings: BeamLinkSettings,
        carriers: tuple[Carrier, ...],
        channels: ChannelBatch,
        members: int,
        frames: int,
        scene_at: Callable[[int], SceneAt],
    ) -> None:
        self._settings, self._carriers, self._channels = settings, carriers, channels
        self._members, self._frames, self._scene_at = np.arange(members), frames, scene_at
        self._ahead: _Ahead | None = None

    def begin(self, members: Sequence[MemberSeed]) -> None:
        self._channels.begin(members)
        self._ahead = None

    def step(self, number: int, beams: Int64Array) -> BatchLink:
        ahead = self._ahead
        if ahead is None or not 0 <= number - ahead.first < ahead.frames:
            ahead = self._ahead = self._sweep_from(number)
        row, budget, shape = number - ahead.first, ahead.budget, beams.shape
        abs_y = np.empty(shape)
        for u, swept in enumerate(ahead.swept):
            of_user = beams[:, u]
            members = self._members if len(swept) > 1 else 0
            abs_y[:, u] = np.where(of_user < 0, 0.0, swept[members, row, of_user])
        snr = budget.power_over_noise * abs_y**2
        # Of −1 the quotient is −1, too.
        tx_beam, rx_beam = np.divmod(beams, budget.receive_beams)
        return BatchLink(
            tx=budget.tx,
            rx=budget.rx,
            carrier=budget.carrier,
            has_path=np.broadcast_to(ahead.has_path[:, row], shape).copy(),
            los=np.broadcast_to(ahead.los[row], shape).copy(),
            tx_beam=tx_beam,
            rx_beam=np.where(tx_beam < 0, -1, rx_beam),
            abs_y=abs_y,
            top_abs_y=np.broadcast_to(ahead.best[:, row], shape)[..., None].copy(),
            baseline_abs_y=np.broadcast_to(ahead.baseline[:, row], shape).copy(),
            snr=snr,
            spectral_efficiency=shannon(snr, self._settings.max_spectral_efficiency),
        )

    def _sweep_from(self, number: int) -> _Ahead:
        first = self._scene_at(number)
        figure, temperature = self._settings.noise_figure_db, self._settings.temperature_k
        budget = LinkBudget.of(first.scene, self._carriers, figure, temperature)
        elements = max((user.beam_pairs for user in budget.users), default=1)
        each = self._channels.width(len(self._members)) * len(self._carriers) * elements
        count = max(1, min(self._channels.reach(number), self._frames - number, HELD // each))
        frames = [first]
        while len(frames) < count:
            following = self._scene_at(number + len(frames))
            if following.scene.devices != first.scene.devices:
                break
            frames.append(following)
        found = self._channels.channels(frames)
        # Number of the pair, and of the carrier, of each user.
        tx, rx = ([device.name for device in antennas(first.scene, role)] for role in ("tx", "rx"))
        names = [carrier.name for carrier in self._carriers]
        places = [
            (tx.index(user.tx.name) * len(rx) + rx.index(user.rx.name), names.index(user.carrier.name))
            for user in budget.users
        ]
        swept, best, baseline = [], [], []
        towards = [directions(at.scene, budget.users) for at in frames]
        for u, (user, (pair, carrier)) in enumerate(zip(budget.users, places, strict=True)):
            abs_y = _swept(found, user, pair, carrier)
            straight = [_straight(user, at_tx[u], at_rx[u]) for at_tx, at_rx in towards]
            swept.append(abs_y)
            best.append(abs_y.max(axis=-1))
            baseline.append(abs_y[:, np.arange(len(frames)), straight])
        pairs, of_carrier = ([place[axis] for place in places] for axis in range(2))
        return _Ahead(
            first=number,
            frames=len(frames),
            budget=budget,
            swept=swept,
            best=np.stack(best, axis=-1),
            baseline=np.stack(baseline, axis=-1),
            has_path=found.has_path[:, :, pairs, of_carrier],
            los=found.los[:, pairs],
        )


def _swept(found: BatchChannels, user: User, pair: int, carrier: int) -> Float64Array:
    """|y| of all beam pairs of a user, Shape ``[M, K, Nt·Nr]``."""
    h = np.ascontiguousarray(found.h[pair][:, :, carrier])
    abs_y = beam_gains(h, user.tx.array, user.rx.array)
    return abs_y.reshape(*h.shape[:2], -1)


def _straight(user: User, towards_rx: Sequence[float], towards_tx: Sequence[float]) -> int:
    """Index of the pair along the straight line."""
    sent, taken = straight_beams(user.tx.array, towards_rx, user.rx.array, towards_tx)
    return sent * user.beams[1] + taken
