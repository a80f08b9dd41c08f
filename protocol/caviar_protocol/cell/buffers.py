"""First-in, first-out buffers of packets that know the age of every packet, many of them at once.

All quantities are whole numbers, so that the balance

    arrived = sent + dropped + waiting

holds exactly, for every buffer, after every slot. A slot goes as follows: `PacketBuffers.begin_slot` drops
the packets that are too old and takes in those that arrive; `PacketBuffers.serve` sends bits, the oldest
first. A packet that arrives in a slot may leave in the same slot: its delay is then 1 slot, since it counts
from the beginning of the slot of arrival to the end of the one in which its last bit is sent.

The packets of a buffer have one size L. So the bits that left say which packet is the first of those that
wait: number ⌊left/L⌋, counted from the first that ever came. Beside them a buffer needs, for each slot, how
many packets had come by then, and the sum of their slots of arrival: delays of any number of packets are
then differences of two such sums, without a loop over packets.

Schedulers: which of the users of a transmitter are served in a slot.

A scheduler is a priority for each user; of those that may be served the greatest are. Arrays have users as
their last axis and any axes of transmitters, cells or environments before it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array

NEVER = 1 << 62
"""Age at which packets are dropped, in slots, of a buffer that keeps all of them."""

UNBOUNDED = 1 << 62
"""Packets that a buffer without a bound holds."""

_COLUMNS = 64
"""Slots that are remembered at first; doubled whenever packets wait longer."""


class Totals(NamedTuple):
    """What became of the packets of each buffer since it was empty, Shape ``[N]`` each."""

    arrived: Int64Array
    """[bit]; what found the buffer full counts too."""
    sent: Int64Array
    """[bit]; bits of packets of which the rest was dropped count too."""
    dropped: Int64Array
    """[bit]; what was too old, or found the buffer full."""
    delivered: Int64Array
    """Packets of which the last bit was sent."""
    delay: Int64Array
    """Sum of the delays of these [slot]."""


class PacketBuffers:
    """Buffers of packets with a common slot clock.

    Args:
        packet_bits: Size of each buffer's packets [bit], Shape ``[N]``.
        max_age: Slots that a packet may wait before it is dropped, Shape ``[N]``; `NEVER`.
        max_packets: Packets that each buffer holds at most, Shape ``[N]``; `UNBOUNDED`. A packet of which a
            part was sent counts as one.

    Raises:
        ValueError: A size, an age or a bound is below 1.

    Example:
        >>> buffers = PacketBuffers(np.array([100, 100]), max_age=np.array([2, NEVER]))
        >>> buffers.begin_slot(np.array([3, 1]))  # packets
        >>> buffers.serve(np.array([150, 500])).tolist()  # bits
        [150, 100]
        >>> for _ in range(2):
        ...     buffers.begin_slot(np.array([0, 0]))
        >>> buffers.totals.dropped.tolist(), buffers.waiting.tolist()
        ([150, 0], [0, 0])
    """

    def __init__(
        self,
        packet_bits: Int64Array,
        max_age: Int64Array | None = None,
        max_packets: Int64Array | None = None,
    ) -> None:
        self.packet_bits = np.array(packet_bits, np.int64)
        count = len(self.packet_bits)
        self.max_age = _column(max_age, NEVER, count)
        self.max_packets = _column(max_packets, UNBOUNDED, count)
        for name in ("packet_bits", "max_age", "max_packets"):
            if count and getattr(self, name).min() < 1:
                raise ValueError(f"{name} is {getattr(self, name).min()} at least; write 1 or more")
        self.slot = -1
        """Number of the slot under way; −1 before the first."""
        # Bits that were sent, dropped, that arrived; and of these those that found the buffer full: they are
        # dropped without ever being in it.
        self._bits = np.zeros((4, count), np.int64)
        # Packets that left; of these those that were delivered, and the sum of the slots at whose ends.
        self._packets = np.zeros((3, count), np.int64)
        # In which slots they had come is only looked up when it is asked for (`_settle`): packets up to which
        # it was, the sum of the slots of all of them, and of those that were delivered.
        self._settled = np.zeros((3, count), np.int64)
        # Row k: packets that came up to and with slot `_first + k`, and the sum of their slots. All packets
        # of row `_low` have left: it is what sums over later ones begin from.
        self._first = -1
        self._low, self._high = 0, 1
        self._until = np.zeros((2, _COLUMNS, count), np.int64)
        self._least_age = int(self.max_age.min(initial=NEVER))
        self._bounded = bool((self.max_packets < UNBOUNDED).any())

    def __len__(self) -> int:
        return len(self.packet_bits)

    @property
    def waiting(self) -> Int64Array:
        """Bits that wait in each buffer, Shape ``[N]``."""
        bits = self._bits
        waiting: Int64Array = bits[2] - bits[0] - bits[1]
        return waiting

    @property
    def waiting_packets(self) -> Int64Array:
        """Packets in each buffer, those of which a part was sent included, Shape ``[N]``."""
        packets: Int64Array = self._until[0, self._high - 1] - self._packets[0]
        return packets

    @property
    def totals(self) -> Totals:
        """Totals of the packets of each buffer since it was empty; a copy."""
        self._settle()
        sent, dropped, arrived, _ = self._bits.copy()
        _, delivered, departed = self._packets
        return Totals(arrived, sent, dropped, delivered.copy(), departed - self._settled[2])

    @property
    def oldest(self) -> Int64Array:
        """Slots that the oldest packet of each buffer has waited, that under way included; 0: none waits.

        Shape ``[N]``.
        """
        ages = self.slot - self._first - self._head(self._packets[0])
        return np.where(self.waiting_packets > 0, ages, 0)

    def begin_slot(self, packets: Int64Array) -> None:
        """Begin the next slot: drop what is too old, then take in what arrives.

        Args:
            packets: Packets that arrive in each buffer, Shape ``[N]``, none below 0.
        """
        self.slot += 1
        if self.slot - self._least_age - self._first >= self._low:
            self._drop_aged()
        if self._bounded:
            # Count packets that find the buffer full as arrived and dropped; return the others.
            admitted: Int64Array = np.minimum(packets, self.max_packets - self.waiting_packets)
            refused = (packets - admitted) * self.packet_bits
            self._bits[1:] += refused
            packets = admitted
        high = self._high
        if high == self._until.shape[1]:
            self._make_room()
            high = self._high
        until = self._until
        np.add(until[0, high - 1], packets, out=until[0, high])
        np.add(until[1, high - 1], packets * self.slot, out=until[1, high])
        self._high = high + 1
        self._bits[2] += packets * self.packet_bits

    def serve(self, bits: Int64Array) -> Int64Array:
        """Send bits of each buffer, the oldest first.

        Args:
            bits: How many can be sent, Shape ``[N]``, none below 0. Multiples of `packet_bits` send whole
                packets only.

        Returns:
            How many were, Shape ``[N]``.
        """
        counted, packets = self._bits, self._packets
        sent: Int64Array = np.minimum(bits, self.waiting)
        counted[0] += sent
        gone = (counted[0] + counted[1] - counted[3]) // self.packet_bits
        delivered = gone - packets[0]
        packets[0] = gone
        packets[1] += delivered
        delivered *= self.slot + 1
        packets[2] += delivered
        return sent

    def rearranged(self, sources: Int64Array, fresh: PacketBuffers) -> PacketBuffers:
        """Put buffers into another order, leave some out and add some that are empty.

        Args:
            sources: Index of each buffer among these, −1 for one that is new, Shape ``[M]``.
            fresh: Buffers of the same sizes and bounds as those that come out, of which the new ones are
                taken, M of them.

        Returns:
            M buffers, in the same slot.
        """
        kept = sources >= 0
        made = PacketBuffers(fresh.packet_bits, fresh.max_age, fresh.max_packets)
        made.slot, made._first, made._low, made._high = self.slot, self._first, self._low, self._high
        made._until = np.zeros((2, self._until.shape[1], len(sources)), np.int64)
        made._until[:, :, kept] = self._until[:, :, sources[kept]]
        for name in ("_bits", "_packets", "_settled"):
            getattr(made, name)[:, kept] = getattr(self, name)[:, sources[kept]]
        return made

    def state(self) -> dict[str, Int64Array]:
        """Content of the buffers as arrays of whole numbers; equal states are equal arrays."""
        # From the row that sums begin from: which rows before it are still there depends on when room was
        # made, and what is settled on when it was asked for.
        self._settle()
        low = self._trimmed_low()
        return {
            "clock": np.array([self.slot, self._first + low], np.int64),
            "until": self._until[:, low : self._high].copy(),
            "bits": self._bits.copy(),
            "packets": self._packets.copy(),
            "settled": self._settled.copy(),
        }

    def restore(self, state: Mapping[str, Int64Array]) -> None:
        """Take over a state.

        Args:
            state: As `state` gave it, of buffers with the same sizes and bounds.

        Raises:
            ValueError: It is a state of another number of buffers.
        """
        count, until = len(self), state["until"]
        if until.shape[2] != count:
            raise ValueError(f"the state is of {until.shape[2]} buffers, and there are {count}")
        self.slot, self._first = map(int, state["clock"])
        rows = until.shape[1]
        self._until = np.zeros((2, max(_COLUMNS, 2 * rows), count), np.int64)
        self._until[:, :rows] = until
        self._low, self._high = 0, rows
        self._bits[:] = state["bits"]
        self._packets[:] = state["packets"]
        self._settled[:] = state["settled"]

    def _head(self, packets: Int64Array) -> Int64Array:
        """Row of the last slot up to which no more than ``packets`` had come."""
        rows = self._until[0, self._low : self._high] <= packets
        head: Int64Array = rows.sum(0) + (self._low - 1)
        return head

    def _settle(self) -> None:
        """Look up in which slots the packets had come that were delivered since it was done last."""
        gone, settled = self._packets[0], self._settled
        if np.array_equal(gone, settled[0]):
            return
        head = self._head(gone)
        came, slots = self._until[:, head, np.arange(len(gone))]
        # The packets of the next slot that left are a part of those that came in it.
        slots = slots + (gone - came) * (self._first + head + 1)
        settled[2] += slots - settled[1]
        settled[:2] = gone, slots

    def _drop_aged(self) -> None:
        """Drop the packets that have waited for `max_age` slots."""
        # Rows of the newest slot of which packets are too old by now.
        rows = self.slot - self.max_age - self._first
        (found,) = (rows >= self._low).nonzero()
        if not len(found):
            return
        came, slots = self._until[:, rows[found], found]
        due = came > self._packets[0, found]
        if not due.any():
            return
        self._settle()
        found, came, slots = found[due], came[due], slots[due]
        sent, dropped, _, refused = self._bits[:, found]
        self._bits[1, found] += came * self.packet_bits[found] - (sent + dropped - refused)
        self._packets[0, found] = came
        self._settled[:2, found] = came, slots

    def _trimmed_low(self) -> int:
        """The last row of which all packets have left, in all buffers."""
        gone = (self._until[0, self._low : self._high] <= self._settled[0]).all(1)
        # A row holds the numbers of those before it, so that what is true of it is true of them.
        return self._low + max(0, int(gone.sum()) - 1)

    def _make_room(self) -> None:
        """Forget rows of which all packets have left; where that is less than half of them, double them."""
        self._settle()
        self._low = self._trimmed_low()
        rows, until = self._high - self._low, self._until
        if 2 * rows > until.shape[1]:
            self._until = np.zeros((2, 2 * until.shape[1], until.shape[2]), np.int64)
        self._until[:, :rows] = until[:, self._low : self._high].copy()
        self._first += self._low
        self._low, self._high = 0, rows


def _column(values: Int64Array | None, default: int, count: int) -> Int64Array:
    return np.full(count, default, np.int64) if values is None else np.array(values, np.int64)


def delays_in_seconds(totals: Totals, before: Totals, slot_s: float) -> Float64Array:
    """Mean delay of the packets that were delivered between two states of the same buffers.

    Args:
        totals: The later one.
        before: The earlier one.
        slot_s: Length of a slot [s].

    Returns:
        [s], Shape ``[N]``; 0 where none was delivered.

    Example:
        >>> buffers = PacketBuffers(np.array([100]))
        >>> before = buffers.totals
        >>> buffers.begin_slot(np.array([2]))
        >>> for _ in range(2):
        ...     _ = buffers.serve(np.array([100]))
        ...     buffers.begin_slot(np.array([0]))
        >>> delays_in_seconds(buffers.totals, before, 0.5).tolist()  # 1 and 2 slots
        [0.75]
    """
    count = totals.delivered - before.delivered
    mean: Float64Array = (totals.delay - before.delay) / np.maximum(count, 1) * slot_s
    return mean


Scheduler = Literal["round-robin", "max-rate", "proportional-fair"]


def round_robin(turns: Int64Array) -> Float64Array:
    """Priority of the user that was not served for longest; of equal ones the first.

    Args:
        turns: Turn in which each user was served last, as `note_turns` writes it; −1: never.

    Example:
        >>> chosen(round_robin(np.array([4, 3, 5])), np.array([True, True, True]), 1).tolist()
        [False, True, False]
    """
    return -turns.astype(np.float64)


def note_turns(turns: Int64Array, served: BoolArray, number: int) -> int:
    """Number the turns of the users that a slot served, those first that had waited longest.

    Args:
        turns: Turn in which each user was served last, Shape ``[U]``; changed in place.
        served: Which were served, Shape ``[U]``.
        number: Of the next turn.

    Returns:
        Number of the turn after these.

    Example:
        >>> turns = np.array([7, 4, 5])
        >>> note_turns(turns, np.array([True, False, True]), 8), turns.tolist()
        (10, [9, 4, 8])
    """
    (users,) = served.nonzero()
    # Users of one slot have turns of their own: with equal ones the first of them would always go before.
    if len(users) > 1:
        users = users[turns[users].argsort(kind="stable")]
    turns[users] = np.arange(number, number + len(users))
    return number + len(users)


def max_rate(rate: Float64Array) -> Float64Array:
    """Priority of the user for which the slot carries most, whatever the others get.

    Args:
        rate: Bits that the slot carries for each user if it is served: of a user with less to send, that.

    Example:
        >>> chosen(max_rate(np.array([100.0, 60.0])), np.array([True, True]), 1).tolist()
        [True, False]
    """
    return rate


def proportional_fair(rate: Float64Array, average: Float64Array) -> Float64Array:
    """Priority of the user with the greatest ratio of its rate to what it got on average.

    F. P. Kelly, "Charging and rate control for elastic traffic", 1997; as a scheduler: P. Viswanath,
    D. N. C. Tse and R. Laroia, "Opportunistic beamforming using dumb antennas", 2002, section II.

    Args:
        rate: Bits that the slot carries for each user if it is served: of a user with less to send, that.
        average: What each user was served on average [bit/slot], as `averaged` follows it.

    Example:
        >>> proportional_fair(np.array([100.0, 60.0]), np.array([50.0, 20.0])).tolist()
        [2.0, 3.0]
    """
    # Less than a bit a slot counts as one: a user that was never served has a finite priority.
    priority: Float64Array = rate / np.maximum(average, 1.0)
    return priority


def averaged(average: Float64Array, served: Int64Array, window: float) -> Float64Array:
    """Average of what users are served, exponentially weighted: ā ← (1 − 1/T)·ā + s/T.

    Args:
        average: ā [bit/slot].
        served: s, what each user was served in the slot [bit]; 0 for one that was not.
        window: T, the slots that the average forgets in, 1 or more.

    Example:
        >>> averaged(np.array([10.0]), np.array([30]), 4.0).tolist()
        [15.0]
    """
    following: Float64Array = average + (served - average) / window
    return following


def chosen(priority: Float64Array, eligible: BoolArray, count: int) -> BoolArray:
    """Choose users by priority, of equal ones the first.

    Args:
        priority: Of each user, finite, Shape ``[..., U]``.
        eligible: Users that may be served, of the same shape.
        count: Users that are served at once, at most.

    Returns:
        Which are served, Shape ``[..., U]``.

    Example:
        >>> chosen(np.array([1.0, 5.0, 5.0, 9.0]), np.array([True, True, True, False]), 2).tolist()
        [False, True, True, False]
    """
    found = np.zeros(eligible.shape, np.bool_)
    users = eligible.shape[-1]
    if not users:
        return found
    # On one flat axis: `put_along_axis` takes longer than all of the rest.
    rows = np.arange(0, eligible.size, users)
    if count == 1:
        rows += np.where(eligible, priority, -np.inf).argmax(-1).reshape(-1)
        found.reshape(-1)[rows] = True
    else:
        # Stable: users with equal priorities keep their order, on every machine.
        order = np.argsort(np.where(eligible, -priority, np.inf), axis=-1, kind="stable")[..., :count]
        found.reshape(-1)[order.reshape(len(rows), -1) + rows[:, None]] = True
    found &= eligible
    return found
