"""Receivers with a buffer on each carrier: what arrives for them, what waits, and who was served when.

Settings of the link ``cell``: traffic, slots, scheduler, rates.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Annotated, Literal

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, quantity
from caviar_protocol.cell.buffers import NEVER, UNBOUNDED, PacketBuffers, Scheduler
from caviar_protocol.cell.traffic import Offered, Traffic, arrivals, check_traffic, traffic_model
from caviar_protocol.errors import suggestion
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.scenario.rules import patterns_overlap
from caviar_protocol.seeding import generator
from caviar_services.checkpoint import Packed
from caviar_services.link.beam_scores import RewardKind, SweepSettings
from caviar_services.link.nr import Adaptation
from caviar_services.link.slot_rates import AssociationRule, Sharing
from caviar_services.service import Frame

RateModel = Literal["shannon", "capped", "nr"]

CellReward = RewardKind | Literal["throughput", "delay"]


class CellSettings(SweepSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the link ``cell``, beside those of ``beams``."""

    reward: CellReward = "throughput"
    """As of ``beams``; or ``throughput`` [bit/s]; or ``delay``: minus the mean delay of the packets that were
    delivered in the frame [s]."""
    traffic: Annotated[tuple[Traffic, ...], msgspec.Meta(min_length=1)] = (Traffic(),)
    """What arrives for the receivers; a receiver that fits no entry has no traffic."""
    slots: Annotated[int, quantity("1", "of a frame, evenly long", ge=1, le=10_000)] = 1
    rate_model: RateModel = "shannon"
    """Spectral efficiency of a user: ``shannon``: log2(1 + SINR); ``capped``: this up to
    ``max_spectral_efficiency``, by default 7.4063 bit/s/Hz of 256-QAM (3GPP TS 38.214); ``nr``: transport
    blocks of 5G NR that fail at random, from the tables of Sionna SYS (extra ``system``)."""
    selective: tuple[Literal["time", "frequency"], ...] = ()
    """What of the channel changes within a frame, as its paths say: ``time``: H of each slot, by the Doppler
    shifts; ``frequency``: H over the band, by the delays, of ``nr`` only. Without, H is that of the frame's
    instant and of the carrier. For channels with plane waves."""
    mcs_table: Annotated[int, quantity("1", "of modulation and coding schemes", ge=1, le=2)] = 2
    """Of ``nr``: 1: up to 64-QAM, 2: up to 256-QAM (3GPP TS 38.214, tables 5.1.3.1-1 and -2)."""
    target_block_error: Annotated[float, quantity("1", "share of blocks that may fail", gt=0, lt=1)] = 0.1
    """Of ``nr``: schemes are chosen so that no more blocks are expected to."""
    outer_loop_db: Annotated[float, quantity("dB", "step after a failed block", ge=0, le=20)] = 1.0
    """Of ``nr``: by as much schemes are chosen more carefully after a failed block; 0: no outer loop."""
    scheduler: Scheduler = "round-robin"
    """Which users of a transmitter are served in a slot, of those with something to send and beams that an
    agent chose; where an agent schedules receivers, of these alone. ``round-robin``: who was not served for
    longest; ``max-rate``: for whom the slot carries most bits; ``proportional-fair``: this over what each got
    on average."""
    users_per_slot: Annotated[int, quantity("1", "served at once by a transmitter", ge=1, le=1024)] = 1
    """They share the power evenly, and the band as ``sharing`` says; each has beams of its own."""
    sharing: Sharing = "band"
    """``band``: users served at once have equal parts of the band; ``space``: each has all of it, and hears
    the beams of the others."""
    interference: bool = True
    """Whether users hear transmitters that serve others on their carrier in the same slot."""
    association: AssociationRule = "best"
    """Which transmitter serves a receiver on a carrier: ``best``: that whose best pair of beams brings most
    power; ``sticky``: the one before, until another one brings more by ``hysteresis_db``; ``agent``: that of
    which the agent chose beams, which may be one only; where it chose none, the one before."""
    hysteresis_db: Annotated[float, quantity("dB", "that another transmitter has to be better by", ge=0)] = (
        3.0
    )
    """Of ``sticky``."""
    handover_slots: Annotated[int, quantity("1", "without service after a handover", ge=0, le=10**6)] = 0
    """A handover is a change of the transmitter; packets stay in the buffer."""
    average_slots: Annotated[float, quantity("slot", "that the average of fairness forgets in", ge=1)] = 100.0
    """Of ``proportional-fair``."""


def check_traffic_users(settings: CellSettings, devices: Sequence[DeviceSpec], place: Place) -> None:
    """Refuse traffic of receivers that the scenario cannot have: a name that is misspelt would send nothing.

    Args:
        settings: The settings.
        devices: Of the scenario; none where they are not known.
        place: Where the settings stand.

    Raises:
        ScenarioError: No receiver fits; names the key, and the receivers.

    Example:
        >>> from caviar_protocol.errors import ScenarioError
        >>> from caviar_protocol.scenario import load_scenario
        >>> wrong = CellSettings(traffic=(Traffic(users=("car/*",)),))
        >>> try:
        ...     check_traffic_users(wrong, load_scenario("geometric").devices, Place("settings"))
        ... except ScenarioError as error:
        ...     print(error)
        settings.traffic[0].users[0]: 'car/*' is no receiver of the scenario; known: uav/rx
    """
    receivers = [device for device in devices if device.kind == "antenna" and device.role in ("rx", "both")]
    names = [f"{device.on}/{device.name}" if device.on else device.name for device in receivers]
    for index, entry in enumerate(settings.traffic if names else ()):
        mine = place.at("traffic").at(index).at("users")
        if not entry.users:
            raise mine.error('is empty, so that nothing arrives; write users = ["*"], or leave the entry out')
        for position, pattern in enumerate(entry.users):
            if not any(patterns_overlap(name, pattern) for name in names):
                text = f"{pattern!r} is no receiver of the scenario; {suggestion(pattern, names)}"
                raise mine.at(position).error(text)


# What a key belongs to: another key, and its value; with other values it has no effect.
_BELONGS: Mapping[str, tuple[str, str]] = {
    "average_slots": ("scheduler", "proportional-fair"),
    "mcs_table": ("rate_model", "nr"),
    "target_block_error": ("rate_model", "nr"),
    "outer_loop_db": ("rate_model", "nr"),
    "hysteresis_db": ("association", "sticky"),
}


def check_cell_settings(settings: CellSettings, place: Place) -> None:
    """Check what the types of settings do not say.

    Args:
        settings: The settings.
        place: Where they stand.

    Raises:
        ScenarioError: A key is missing or has no effect, or a trace is wrong; names key, or file and line.

    Example:
        >>> from caviar_protocol.errors import ScenarioError
        >>> try:
        ...     check_cell_settings(CellSettings(max_spectral_efficiency=5.55), Place("settings"))
        ... except ScenarioError as error:
        ...     print(error)
        settings.max_spectral_efficiency: has no effect with rate_model 'shannon'; write rate_model = "capped"
    """
    for index, entry in enumerate(settings.traffic):
        check_traffic(entry, place.at("traffic").at(index))
    if "frequency" in settings.selective and settings.rate_model != "nr":
        raise place.at("selective").error(
            f"'frequency' has no effect with rate_model {settings.rate_model!r}, for which the band is flat; "
            'write rate_model = "nr", or selective = ["time"]'
        )
    if settings.max_spectral_efficiency is not None and settings.rate_model != "capped":
        raise place.at("max_spectral_efficiency").error(
            f'has no effect with rate_model {settings.rate_model!r}; write rate_model = "capped"'
        )
    for key, (owner, value) in _BELONGS.items():
        found = getattr(settings, owner)
        if found != value and _is_given(settings, key, place):
            raise place.at(key).error(
                f'has no effect with {owner} {found!r}; leave it out, or write {owner} = "{value}"'
            )
    if settings.users_per_slot == 1 and _is_given(settings, "sharing", place):
        raise place.at("sharing").error(
            "has no effect with users_per_slot 1; leave it out, or write users_per_slot = 2 or more"
        )


def _is_given(settings: CellSettings, key: str, place: Place) -> bool:
    """Whether a key stands in the file; of settings made in Python, whether it is not its default."""
    return place.source.holds(place.at(key).key) or getattr(settings, key) != getattr(_DEFAULTS, key)


_DEFAULTS = CellSettings()


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
