"""Link ``cell``: packets, buffers, a scheduler and the slots of a frame, on top of the sweep of ``beams``.

A *terminal* is a receiver on a carrier. It has a buffer, in which packets arrive as the settings ``traffic``
say, and one transmitter serves it (`association`). In each slot a transmitter serves, on each of its
carriers, some of its terminals that have something to send and beams that an agent chose. What the slot
carries follows from bandwidth, rate model and SINR, with the interference of all that is sent in the same
slot (`slot_rates`); the oldest packets go first, and those that are too old are dropped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.cell.buffers import (
    Totals,
    averaged,
    chosen,
    delays_in_seconds,
    max_rate,
    note_turns,
    proportional_fair,
    round_robin,
)
from caviar_protocol.cell.link_adaptation import HIGHEST_SPECTRAL_EFFICIENCY
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.topics import Link
from caviar_services.checkpoint import restored, saved
from caviar_services.link.base import wrong_choice
from caviar_services.link.beam_scores import Scored, SweepingLink
from caviar_services.link.nr import Blocks, NrRates, load_blocks
from caviar_services.link.slot_rates import (
    Gains,
    Layout,
    ShannonRates,
    SlotRates,
    SlotSinr,
    associate,
    band_points,
    noise_rise,
    responses,
    swept_gains,
)
from caviar_services.link.terminals import (
    CellSettings,
    Terminals,
    TerminalState,
    check_cell_settings,
    check_traffic_users,
)
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, StepResult


@dataclass(frozen=True, eq=False)
class _Played:
    """What the slots of a frame gave each terminal, Shape ``[T]`` each."""

    blocks: Int64Array
    errors: Int64Array
    sinr: Float64Array
    """Mean over the slots that served it; 0 where none did."""


@dataclass(frozen=True, eq=False)
class _Serving:
    """Who serves whom, while that and the users stay the same."""

    layout: Layout
    transmitters: Int64Array
    """Index of the transmitter of each terminal, Shape ``[T]``."""
    users: Int64Array
    """Index of the user of each terminal with it, Shape ``[T]``."""
    members: BoolArray
    """Terminals of each transmitter and carrier, Shape ``[G, T]``."""

    @classmethod
    def of(cls, layout: Layout, transmitters: Int64Array) -> _Serving:
        users = layout.rows[np.arange(len(transmitters)), transmitters]
        groups = layout.carrier[users] * len(layout.transmitters) + transmitters
        numbers = np.array(list(dict.fromkeys(groups.tolist())), np.int64)
        return cls(layout, transmitters, users, groups == numbers[:, None])


class CellLink(SweepingLink[CellSettings]):
    """Buffers, traffic and scheduling of radio cells.

    Args:
        settings: Traffic, slots, scheduler, rate model, and what ``beams`` has.
        run: What the link knows about the run.

    Example:
        >>> from caviar_protocol.cell.traffic import Traffic
        >>> from caviar_services.testing.samples import CARRIERS, granted
        >>> video = Traffic(model="constant", rate_bit_s=2.4e6, packet_bits=12_000)
        >>> run = RunInfo(name="link", carriers=CARRIERS)
        >>> link = CellLink(CellSettings(traffic=(video,), slots=10), run)
        >>> found = link.step(granted(link.inputs, 0, "link")).products["link"]
        >>> found.arrived.tolist(), (found.sent + found.dropped + found.buffered).tolist()
        ([240000, 240000], [240000.0, 240000.0])
    """

    Settings = CellSettings
    checkpoints: ClassVar[bool] = True
    _layout: Layout | None = None
    _serving: _Serving | None = None
    _blocks: Mapping[str, Blocks]
    _terminals: Terminals | None = None

    @classmethod
    def check_settings(cls, settings: CellSettings, place: Place) -> None:
        """See `caviar_services.link.terminals.check_cell_settings`."""
        check_cell_settings(settings, place)

    def __init__(self, settings: CellSettings, run: RunInfo) -> None:
        if settings.rate_model == "capped" and settings.max_spectral_efficiency is None:
            settings = msgspec.structs.replace(settings, max_spectral_efficiency=HIGHEST_SPECTRAL_EFFICIENCY)
        super().__init__(settings, run)
        self._slot_s = run.sampling_period_ns * 1e-9 / settings.slots

    def prepare(self, preparation: Preparation) -> Prepared:
        """Load the tables of the rate model ``nr``.

        Raises:
            SetupError: Sionna SYS is not installed.
            ScenarioError: The band is to be looked at, and no carrier has subcarriers, or traffic is of no
                receiver; names the key.
        """
        prepared, settings = super().prepare(preparation), self.settings
        check_traffic_users(settings, self.run.devices, self.run.settings_place)
        if "frequency" in settings.selective and band_points(self.run.carriers).shape[1] == 1:
            key = self.run.settings_place.at("selective").key
            text = "'frequency' needs a carrier with 24 subcarriers or more; write `subcarriers` of a carrier"
            raise ScenarioError(text, key=key)
        if settings.rate_model != "nr":
            return prepared
        self._blocks = load_blocks(
            self.run.carriers, self._slot_s, settings.mcs_table, settings.users_per_slot, self.run.progress
        )
        return prepared

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Every episode begins with empty buffers."""
        self._terminals = None

    def checkpoint(self) -> bytes:
        """Buffers, and who was served when."""
        terminals = self._terminals or Terminals((), self.settings, self._slot_s)
        return saved(self, 1, terminals.state())

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        found = restored(self, 1, TerminalState, state)
        self._terminals = Terminals.of_state(found, self.settings, self._slot_s)

    def step(self, frame: Frame) -> StepResult:
        """Play the slots of a frame.

        Raises:
            PayloadError: As of `SweepingLink.score`.
            ProductError: As of `SweepingLink.score`; or an agent that chooses the transmitter of a receiver
                chose beams of several.
        """
        scored = self.score(frame)
        reward = self.settings.reward
        fields, counts = self.fields(scored, reward), self.counts(scored)
        if self.settings.rate_model == "nr":
            self._add_rates(scored, fields)
        layout = self._layout
        if layout is None or layout.users is not scored.budget.users:
            layout = self._layout = Layout.of(scored.budget.users)
        terminals, counts["bits-of-users-that-left"] = self._terminals_of(layout)
        before = terminals.buffers.totals
        # Traffic goes on in frames that were not granted; nothing is served then.
        for missed in range(frame.previous + 1, frame.number) if frame.previous >= 0 else ():
            for packets in terminals.arrivals(frame, missed):
                terminals.buffers.begin_slot(packets)
        serving, counts["handovers"] = self._associate(frame, layout, terminals, fields)
        has_beams = (fields["tx_beam"][serving.users] >= 0) & (fields["snr"][serving.users] > 0)
        rates = self._rates(frame, scored, terminals, serving, fields)
        played = self._play(frame, terminals, serving, rates, has_beams)
        of_terminals = self._outcome(terminals, before, played)
        count = len(layout.users)
        fields |= {name: _with_zeros(found, serving.users, count) for name, found in of_terminals.items()}
        if reward == "throughput":
            fields["reward"] = fields["throughput"]
        elif reward == "delay":
            fields["reward"] = -fields["delay"]
        return StepResult(
            products={"link": Link(**fields)},
            fidelity=scored.channel.rung,
            counts={name: count for name, count in counts.items() if count},
        )

    def _add_rates(self, scored: Scored, fields: dict[str, Any]) -> None:
        """Put into the fields what a user gets through that is served alone, at its SNR."""
        snr, rate = fields["snr"], np.zeros(len(scored.budget.users))
        for name, blocks in self._blocks.items():
            here = np.array([carrier == name for carrier in scored.budget.carrier], np.bool_) & (snr > 0)
            rate[here] = blocks.goodput(snr[here], self.settings.target_block_error) / self._slot_s
        fields |= {"bit_rate": rate, "spectral_efficiency": rate / scored.budget.bandwidth}
        if self.settings.reward == "spectral_efficiency":
            fields["reward"] = fields["spectral_efficiency"]

    def _terminals_of(self, layout: Layout) -> tuple[Terminals, int]:
        terminals, left = self._terminals, 0
        if terminals is None:
            terminals = Terminals(layout.names, self.settings, self._slot_s)
        elif terminals.names != layout.names:
            terminals, left = terminals.renamed(layout.names)
        self._terminals = terminals
        return terminals, left

    def _associate(
        self, frame: Frame, layout: Layout, terminals: Terminals, fields: dict[str, Any]
    ) -> tuple[_Serving, int]:
        """Choose the transmitters that serve in the frame; with them, how many handovers that makes."""
        settings, before = self.settings, self._serving
        if before is not None and before.layout is layout and len(layout.transmitters) == 1:
            terminals.serve_by(layout.transmitters * len(before.users))
            return before, 0
        chosen_users = fields["tx_beam"] >= 0
        if settings.association == "agent":
            _refuse_several(frame, layout, chosen_users)
        found = associate(
            layout,
            layout.servers(terminals.servers),
            fields["snr_best"],
            chosen_users,
            settings.association,
            settings.hysteresis_db,
        )
        changed = terminals.serve_by([layout.transmitters[x] for x in found.tolist()])
        terminals.lost[changed] = settings.handover_slots
        if before is None or before.layout is not layout or (before.transmitters != found).any():
            before = self._serving = _Serving.of(layout, found)
        return before, int(changed.sum())

    def _rates(
        self,
        frame: Frame,
        scored: Scored,
        terminals: Terminals,
        serving: _Serving,
        fields: dict[str, Any],
    ) -> SlotRates:
        """The rate model in the slots of a frame."""
        settings, layout, users = self.settings, serving.layout, serving.users
        within = settings.sharing == "space" and settings.users_per_slot > 1
        snr = fields["snr"][users][None, :, None]
        gains = swept_gains(scored)
        if settings.selective:
            gains = self._gains(scored)
            served = fields["tx_beam"][users] >= 0
            beams = (fields[name][users][served].astype(np.int64) for name in ("tx_beam", "rx_beam"))
            power = gains(users[served], *beams) * scored.budget.power_over_noise[users][served, None, None]
            snr = np.zeros((power.shape[1], len(users), power.shape[2]))
            snr[:, served] = np.moveaxis(power, 1, 0)
        rise = None
        if (settings.interference and len(layout.transmitters) > 1) or within:
            rise = noise_rise(scored, layout, users, gains, settings.interference, within)
        sinr = SlotSinr(snr, serving.members, settings.users_per_slot, settings.sharing, rise)
        if settings.rate_model == "nr":
            return NrRates(
                sinr,
                [self._blocks[carrier] for _, carrier in layout.names],
                terminals.adaptation,
                settings.target_block_error,
                settings.outer_loop_db,
                frame.generator("blocks"),
            )
        bandwidth = scored.budget.bandwidth[users]
        return ShannonRates(sinr, bandwidth, settings.max_spectral_efficiency, self._slot_s)

    def _gains(self, scored: Scored) -> Gains:
        """Gains of beams in each slot, and over the band, from the paths of the frame."""
        channel, selective = scored.channel, self.settings.selective
        count = self.settings.slots if "time" in selective else 1
        instants = np.arange(count, dtype=np.float64) * self._slot_s
        points = np.zeros((len(channel.carriers), 1))
        if "frequency" in selective:
            points = band_points(channel.carriers)

        def gains(users: Int64Array, tx_beams: Int64Array, rx_beams: Int64Array) -> Float64Array:
            known, scene = scored.budget.users, scored.scene
            y = responses(channel, scene, known, users, tx_beams, rx_beams, instants, points)
            power: Float64Array = y.real**2 + y.imag**2
            return power

        return gains

    def _play(
        self,
        frame: Frame,
        terminals: Terminals,
        serving: _Serving,
        rates: SlotRates,
        has_beams: BoolArray,
    ) -> _Played:
        """Play the slots of a frame, one after the other."""
        settings, buffers = self.settings, terminals.buffers
        slots, blocks, errors = np.zeros((3, len(has_beams)), np.int64)
        sinr = np.zeros(len(has_beams))
        for slot, packets in enumerate(terminals.arrivals(frame, frame.number)):
            offered = rates.offered(slot)
            if terminals.has_full:
                packets = packets + self._refill(terminals, offered)
            buffers.begin_slot(packets)
            # A slot of a user that has little to send carries little, whatever its rate.
            waiting = buffers.waiting
            least = np.minimum(offered, waiting)
            eligible = has_beams & (least > 0)
            if terminals.lost.any():
                eligible &= terminals.lost == 0
                terminals.lost -= terminals.lost > 0
            served = self._schedule(terminals, eligible, serving.members, least)
            carried = rates.carried(slot, served, waiting)
            sent = buffers.serve(np.where(served, carried.bits, 0))
            terminals.turn = note_turns(terminals.turns, served, terminals.turn)
            if settings.scheduler == "proportional-fair":
                terminals.average = averaged(terminals.average, sent, settings.average_slots)
            slots += served
            sinr += np.where(served, carried.sinr, 0.0)
            if settings.rate_model == "nr":
                blocks += np.where(served, carried.blocks, 0)
                errors += np.where(served, carried.errors, 0)
        if settings.rate_model != "nr":
            blocks = slots
        return _Played(blocks, errors, sinr / np.maximum(slots, 1))

    def _refill(self, terminals: Terminals, bits: Int64Array) -> Int64Array:
        """Packets that fill up the buffers of those that always have something to send, Shape ``[T]``."""
        buffers = terminals.buffers
        wanted = -(-bits // buffers.packet_bits) + 1 - buffers.waiting_packets
        return np.where(terminals.is_full, np.maximum(wanted, 0), 0)

    def _schedule(
        self, terminals: Terminals, eligible: BoolArray, members: BoolArray, carried: Int64Array
    ) -> BoolArray:
        """Which terminals are served in the slot, Shape ``[T]``."""
        match self.settings.scheduler:
            case "round-robin":
                priority = round_robin(terminals.turns)
            case "max-rate":
                priority = max_rate(carried.astype(np.float64))
            case "proportional-fair":
                priority = proportional_fair(carried.astype(np.float64), terminals.average)
        count = self.settings.users_per_slot
        if len(members) == 1:
            return chosen(priority, eligible, count)
        # Each terminal is a member of one, so that a column has one choice at most.
        of_each = chosen(priority, np.logical_and(members, eligible), count)
        served: BoolArray = np.logical_or.reduce(of_each, 0)
        return served

    def _outcome(self, terminals: Terminals, before: Totals, played: _Played) -> dict[str, Any]:
        """Fields of `Link` about packets, of the terminals."""
        buffers, totals = terminals.buffers, terminals.buffers.totals
        sent = totals.sent - before.sent
        frame_s = self._slot_s * self.settings.slots
        return {
            "serving": np.ones(len(sent), np.bool_),
            "buffered": buffers.waiting.astype(np.float64),
            "arrived": totals.arrived - before.arrived,
            "sent": sent,
            "dropped": totals.dropped - before.dropped,
            "delivered": totals.delivered - before.delivered,
            "delay": delays_in_seconds(totals, before, self._slot_s),
            "waiting": buffers.oldest * self._slot_s,
            "sinr": played.sinr,
            "throughput": sent / frame_s,
            "blocks": played.blocks,
            "block_errors": played.errors,
        }


def _refuse_several(frame: Frame, layout: Layout, chosen_users: BoolArray) -> None:
    """Refuse beams of several transmitters for one terminal."""
    several = ((layout.rows >= 0) & chosen_users[layout.rows]).sum(1) > 1
    if not several.any():
        return
    users = [layout.users[row] for row in layout.rows[several][0].tolist() if row >= 0 and chosen_users[row]]
    names = " and ".join(repr(user.tx.name) for user in users)
    raise wrong_choice(
        frame,
        users[-1],
        f"it chose beams of {names} for {users[0].rx.name!r} on carrier {users[0].carrier.name!r}; with "
        'association = "agent" choose those of one transmitter, which is to serve it',
    )


def _with_zeros(values: Any, users: Int64Array, count: int) -> Any:
    """Values of terminals in the places of the users that are served, and 0 in those of the others."""
    if len(users) == count:
        # One transmitter: terminals stand in the order of the users.
        return values
    spread = np.zeros(count, values.dtype)
    spread[users] = values
    return spread
