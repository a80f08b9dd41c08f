"""Link ``beams``: analog beamforming with DFT codebooks at both ends, scored frame by frame.

Every beam pair of every user is swept each frame (`beam_sweep`), so that the chosen pair stands beside the
best one (paper, eq. 2) and beside the pair along the straight line (the baseline of section 4). The link has
no state: what a user gets follows from the channel and the choices of the frame alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from caviar_protocol.cell.rates import shannon
from caviar_protocol.topics import Link
from caviar_services.channel.batch import ChannelBatch, SceneAt
from caviar_services.link.base import Users
from caviar_services.link.batch import LinkBatch
from caviar_services.link.beam_batch import BeamBatch
from caviar_services.link.beam_scores import RewardKind, Scored, SweepingLink, SweepSettings
from caviar_services.link.interference import Interferers
from caviar_services.service import Frame, StepResult


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
