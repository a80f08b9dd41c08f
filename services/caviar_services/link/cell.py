"""Link ``cell``: packets, buffers, a scheduler and the slots of a frame, on top of the sweep of ``beams``.

A *terminal* is a receiver on a carrier. It has a buffer, in which packets arrive as the settings ``traffic``
say, and one transmitter serves it: that from which its best pair of beams brings most power. In each slot a
transmitter serves, on each of its carriers, some of its terminals that have something to send and beams that
an agent chose. What the slot carries follows from bandwidth, SINR and rate model; the oldest packets go
first, and those that are too old are dropped.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.cell.buffers import Totals, delays_in_seconds
from caviar_protocol.cell.rates import HIGHEST_SPECTRAL_EFFICIENCY, slot_bits
from caviar_protocol.cell.scheduling import (
    averaged,
    chosen,
    max_rate,
    note_turns,
    proportional_fair,
    round_robin,
)
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.topics import Link
from caviar_services.checkpoint import restored, saved
from caviar_services.link.base import Users
from caviar_services.link.beams import SweepingLink
from caviar_services.link.cell_settings import CellSettings, check_cell_settings
from caviar_services.link.terminals import Terminals, TerminalState
from caviar_services.service import Frame, RunInfo, StepResult


@dataclass(frozen=True, eq=False)
class _Layout:
    """Which users are of which terminal, while the same users are there."""

    users: Users
    rows: Int64Array
    """Index of the user of each terminal and transmitter, Shape ``[T, X]``; −1: none."""
    groups: Int64Array
    """A number for each user, the same for those of one transmitter and carrier, Shape ``[U]``."""
    group_numbers: Int64Array
    """All of these, Shape ``[G, 1]``."""
    names: tuple[tuple[str, str], ...]
    """Receiver and carrier of each terminal."""

    @classmethod
    def of(cls, users: Users) -> _Layout:
        names = list(dict.fromkeys((user.rx.name, user.carrier.name) for user in users))
        transmitters = list(dict.fromkeys(user.tx.name for user in users))
        rows = np.full((len(names), len(transmitters)), -1, np.int64)
        groups: dict[tuple[str, str], int] = {}
        numbers = []
        for index, user in enumerate(users):
            tx, rx, carrier = user.tx.name, user.rx.name, user.carrier.name
            rows[names.index((rx, carrier)), transmitters.index(tx)] = index
            numbers.append(groups.setdefault((tx, carrier), len(groups)))
        return cls(users, rows, np.array(numbers, np.int64), np.arange(len(groups))[:, None], tuple(names))

    def best_servers(self, power: Float64Array) -> Int64Array:
        """The user of each terminal with the greatest power, of equal ones the first, Shape ``[T]``."""
        if self.rows.shape[1] <= 1:
            return self.rows[:, :1].reshape(-1)
        of_each = np.where(self.rows >= 0, power[self.rows], -1.0)
        best: Int64Array = self.rows[np.arange(len(self.rows)), of_each.argmax(1)]
        return best


@dataclass(frozen=True, eq=False)
class _Played:
    """What the slots of a frame gave each terminal, Shape ``[T]`` each."""

    serving: Int64Array
    """Index of the user by whose transmitter it is served."""
    blocks: Int64Array
    sinr: Float64Array
    """Sum over the slots that served it."""


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
    _layout: _Layout | None = None
    _terminals: Terminals | None = None

    @classmethod
    def check_settings(cls, settings: CellSettings, place: Place) -> None:
        """See `caviar_services.link.cell_settings.check_cell_settings`."""
        check_cell_settings(settings, place)

    def __init__(self, settings: CellSettings, run: RunInfo) -> None:
        if settings.rate_model == "capped" and settings.max_spectral_efficiency is None:
            settings = msgspec.structs.replace(settings, max_spectral_efficiency=HIGHEST_SPECTRAL_EFFICIENCY)
        super().__init__(settings, run)
        self._slot_s = run.sampling_period_ns * 1e-9 / settings.slots

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
            ProductError: As of `SweepingLink.score`.
        """
        scored = self.score(frame)
        reward = self.settings.reward
        fields, counts = self.fields(scored, reward), self.counts(scored)
        layout = self._layout
        if layout is None or layout.users is not scored.budget.users:
            layout = self._layout = _Layout.of(scored.budget.users)
        terminals, counts["bits-of-users-that-left"] = self._terminals_of(layout)
        before = terminals.buffers.totals
        # Traffic goes on in frames that were not granted; nothing is served then.
        for missed in range(frame.previous + 1, frame.number) if frame.previous >= 0 else ():
            for packets in terminals.arrivals(frame, missed):
                terminals.buffers.begin_slot(packets)
        played = self._play(frame, layout, terminals, fields)
        fields |= self._outcome(terminals, before, played, len(scored.budget.users))
        if reward == "throughput":
            fields["reward"] = fields["throughput"]
        elif reward == "delay":
            fields["reward"] = -fields["delay"]
        return StepResult(
            products={"link": Link(**fields)},
            fidelity=scored.channel.rung,
            counts={name: count for name, count in counts.items() if count},
        )

    def _terminals_of(self, layout: _Layout) -> tuple[Terminals, int]:
        terminals, left = self._terminals, 0
        if terminals is None:
            terminals = Terminals(layout.names, self.settings, self._slot_s)
        elif terminals.names != layout.names:
            terminals, left = terminals.renamed(layout.names)
        self._terminals = terminals
        return terminals, left

    def _play(self, frame: Frame, layout: _Layout, terminals: Terminals, fields: dict[str, Any]) -> _Played:
        """Play the slots of a frame, one after the other."""
        settings, buffers = self.settings, terminals.buffers
        serving = layout.best_servers(fields["snr_best"])
        snr = fields["snr"][serving]
        bits = slot_bits(fields["bit_rate"][serving], self._slot_s)
        has_beams = (fields["tx_beam"][serving] >= 0) & (bits > 0)
        members: BoolArray = layout.groups[serving] == layout.group_numbers
        blocks, sinr = np.zeros(len(serving), np.int64), np.zeros(len(serving))
        for packets in terminals.arrivals(frame, frame.number):
            if terminals.has_full:
                packets = packets + self._refill(terminals, bits)
            buffers.begin_slot(packets)
            # A slot of a user that has little to send carries little, whatever its rate.
            carried = np.minimum(bits, buffers.waiting)
            eligible = has_beams & (carried > 0)
            served = self._schedule(terminals, eligible, members, carried)
            shared = bits if settings.users_per_slot == 1 else _shared(bits, served, members)
            sent = buffers.serve(np.where(served, shared, 0))
            terminals.turn = note_turns(terminals.turns, served, terminals.turn)
            if settings.scheduler == "proportional-fair":
                terminals.average = averaged(terminals.average, sent, settings.average_slots)
            blocks += served
            sinr += np.where(served, snr, 0.0)
        return _Played(serving, blocks, sinr)

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

    def _outcome(self, terminals: Terminals, before: Totals, played: _Played, users: int) -> dict[str, Any]:
        """Fields of `Link` about packets."""
        buffers, totals = terminals.buffers, terminals.buffers.totals
        sent = totals.sent - before.sent
        frame_s = self._slot_s * self.settings.slots
        values: dict[str, Any] = {
            "buffered": buffers.waiting.astype(np.float64),
            "arrived": totals.arrived - before.arrived,
            "sent": sent,
            "dropped": totals.dropped - before.dropped,
            "delivered": totals.delivered - before.delivered,
            "delay": delays_in_seconds(totals, before, self._slot_s),
            "waiting": buffers.oldest * self._slot_s,
            "sinr": played.sinr / np.maximum(played.blocks, 1),
            "throughput": sent / frame_s,
            "blocks": played.blocks,
            "block_errors": np.zeros_like(played.blocks),
        }
        return {name: _with_zeros(array, played.serving, users) for name, array in values.items()}


def _shared(bits: Int64Array, served: BoolArray, members: BoolArray) -> Int64Array:
    """Bits of each terminal where those that a transmitter serves share its bandwidth evenly."""
    counts = (members & served).sum(1)
    share: Int64Array = bits // np.maximum((members * counts[:, None]).sum(0), 1)
    return share


def _with_zeros(values: Any, users: Int64Array, count: int) -> Any:
    """Values of terminals in the places of the users that are served, and 0 in those of the others."""
    if len(users) == count:
        # One transmitter: terminals stand in the order of the users.
        return values
    spread = np.zeros(count, values.dtype)
    spread[users] = values
    return spread
