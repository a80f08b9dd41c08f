"""Receivers with a buffer on each carrier: what arrives for them, what waits, and who was served when."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.cell.buffers import NEVER, UNBOUNDED, PacketBuffers
from caviar_protocol.cell.traffic import Offered, Traffic, arrivals, traffic_model
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.seeding import generator
from caviar_services.checkpoint import Packed
from caviar_services.link.cell_settings import CellSettings
from caviar_services.link.nr import Adaptation
from caviar_services.service import Frame

Terminal = tuple[str, str]
"""Receiver and carrier, by name."""

BLOCK = 1024
"""Slots whose arrivals are drawn at once: a generator costs more than what one frame takes from it."""

_NO_TRAFFIC = Traffic(model="constant", rate_bit_s=0.0)


class TerminalState(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What terminals know from earlier frames."""

    names: tuple[Terminal, ...]
    buffers: dict[str, Packed]
    turns: Packed
    turn: int
    servers: tuple[str, ...]
    lost: Packed
    offset_db: Packed
    rise: Packed
    average: Packed


class Terminals:
    """The receivers of a frame on their carriers, T of them, in a stated order.

    Args:
        names: Receiver and carrier of each.
        settings: Traffic and slots.
        slot_s: Length of a slot [s].
    """

    def __init__(self, names: Iterable[Terminal], settings: CellSettings, slot_s: float) -> None:
        self.names = tuple(names)
        self._settings, self._slot_s = settings, slot_s
        self._traffic = [_traffic_of(rx, settings.traffic) for rx, _ in self.names]
        # By the entry: most terminals share one.
        self._offered = {id(entry): Offered.of(entry) for entry in self._traffic if entry.model != "full"}
        self.is_full: BoolArray = np.array([entry.model == "full" for entry in self._traffic], np.bool_)
        """Which always have something to send, Shape ``[T]``."""
        self.has_full = bool(self.is_full.any())
        self.buffers = PacketBuffers(
            np.array([entry.packet_bits for entry in self._traffic], np.int64),
            np.array([_slots(entry.max_age_s, slot_s) for entry in self._traffic], np.int64),
            np.array([entry.max_packets or UNBOUNDED for entry in self._traffic], np.int64),
        )
        self.turns: Int64Array = np.full(len(self.names), -1, np.int64)
        """Turn in which each was served last; −1: never."""
        self.turn = 0
        """Number of the next turn."""
        self.servers: tuple[str, ...] = ("",) * len(self.names)
        """Name of the transmitter that served each in the last frame; empty: none yet."""
        self.lost: Int64Array = np.zeros(len(self.names), np.int64)
        """Slots that each has still to wait, after its transmitter changed."""
        self.average: Float64Array = np.zeros(len(self.names))
        """Bits a slot that each was served, on average over the last slots."""
        self.adaptation = Adaptation(np.zeros(len(self.names)), np.ones(len(self.names)))
        """What link adaptation knows of each."""
        # Arrivals of a block of frames: number of the block, seeds, and packets, Shape [block slots, T].
        self._drawn: tuple[tuple[int, int, int], Int64Array] | None = None
        self._frames = max(1, BLOCK // settings.slots)

    def renamed(self, names: Iterable[Terminal]) -> tuple[Terminals, int]:
        """Terminals of another frame: those that are still there keep what they have.

        Args:
            names: Receiver and carrier of each.

        Returns:
            The terminals, and the bits that waited for those that left.
        """
        made = Terminals(names, self._settings, self._slot_s)
        gone = {name: index for index, name in enumerate(self.names)}
        sources = np.array([gone.pop(name, -1) for name in made.names], np.int64)
        left = int(self.buffers.waiting[list(gone.values())].sum())
        made.buffers = self.buffers.rearranged(sources, made.buffers)
        kept = sources >= 0
        made.turns[kept] = self.turns[sources[kept]]
        made.turn = self.turn
        made.lost[kept] = self.lost[sources[kept]]
        for values, before in zip(made.adaptation, self.adaptation, strict=True):
            values[kept] = before[sources[kept]]
        made.servers = tuple(self.servers[source] if source >= 0 else "" for source in sources.tolist())
        made.average[kept] = self.average[sources[kept]]
        return made, left

    def serve_by(self, servers: Sequence[str]) -> BoolArray:
        """Note the transmitters that serve in this frame.

        Args:
            servers: Name of that of each terminal.

        Returns:
            Which were served by another one before, Shape ``[T]``.
        """
        before, self.servers = self.servers, tuple(servers)
        if before == self.servers:
            return np.zeros(len(servers), np.bool_)
        changed = [old not in ("", new) for old, new in zip(before, self.servers, strict=True)]
        return np.array(changed, np.bool_)

    def arrivals(self, frame: Frame, number: int) -> Int64Array:
        """Packets that arrive in the slots of a frame; none for terminals that always have something to send.

        A terminal's packets depend on seed, episode, receiver, carrier and slot alone: who else is there
        changes nothing.

        Args:
            frame: The frame, for its seeds.
            number: Number of the frame that is asked for: that one, or an earlier one.

        Returns:
            Shape ``[slots, T]``.
        """
        block, within = divmod(number, self._frames)
        key = (block, frame.seed, frame.seed_episode)
        if self._drawn is None or self._drawn[0] != key:
            count = self._frames * self._settings.slots
            drawn = np.zeros((count, len(self.names)), np.int64)
            for index, ((rx, carrier), traffic) in enumerate(zip(self.names, self._traffic, strict=True)):
                if traffic.model == "full":
                    continue
                random = None
                if traffic_model(traffic.model, Place("traffic")).random:
                    stream = f"{frame.service}/traffic/{rx}/{carrier}"
                    random = generator(frame.seed, frame.seed_episode, stream, block)
                offered = self._offered[id(traffic)]
                drawn[:, index] = arrivals(offered, block * count, count, self._slot_s, random)
            self._drawn = key, drawn
        slots = self._settings.slots
        return self._drawn[1][within * slots : (within + 1) * slots]

    def state(self) -> TerminalState:
        """What outlives the frame."""
        return TerminalState(
            names=self.names,
            buffers={name: Packed.of(array, "<i8") for name, array in self.buffers.state().items()},
            turns=Packed.of(self.turns, "<i8"),
            turn=self.turn,
            servers=self.servers,
            lost=Packed.of(self.lost, "<i8"),
            offset_db=Packed.of(self.adaptation.offset_db, "<f8"),
            rise=Packed.of(self.adaptation.rise, "<f8"),
            average=Packed.of(self.average, "<f8"),
        )

    @classmethod
    def of_state(cls, state: TerminalState, settings: CellSettings, slot_s: float) -> Terminals:
        """The terminals of a state.

        Args:
            state: As `state` gave it, with the same settings.
            settings: As for `Terminals`.
            slot_s: As for `Terminals`.
        """
        made = cls(state.names, settings, slot_s)
        made.buffers.restore({name: packed.array(np.int64) for name, packed in state.buffers.items()})
        made.turns = state.turns.array(np.int64)
        made.turn = state.turn
        made.servers = state.servers
        made.lost = state.lost.array(np.int64)
        made.adaptation = Adaptation(state.offset_db.array(np.float64), state.rise.array(np.float64))
        made.average = state.average.array(np.float64)
        return made


def _traffic_of(rx: str, entries: Sequence[Traffic]) -> Traffic:
    """The first entry that fits a receiver."""
    fitting = (entry for entry in entries if any(fnmatchcase(rx, pattern) for pattern in entry.users))
    return next(fitting, _NO_TRAFFIC)


def _slots(age_s: float | None, slot_s: float) -> int:
    """An age in whole slots, at least one."""
    return NEVER if age_s is None else max(1, round(age_s / slot_s))
