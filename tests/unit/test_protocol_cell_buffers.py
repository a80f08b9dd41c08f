"""Packet buffers: against a loop over packets, exact sums, states, the delay of a queue with a formula."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
import pytest

from caviar_protocol.arrays import Int64Array
from caviar_protocol.cell.buffers import NEVER, UNBOUNDED, PacketBuffers


class Case(NamedTuple):
    """Buffers, and what comes and goes in each slot, Shape ``[S, N]``."""

    packet_bits: Int64Array
    max_age: Int64Array
    max_packets: Int64Array
    packets: Int64Array
    bits: Int64Array

    def buffers(self) -> PacketBuffers:
        return PacketBuffers(self.packet_bits, self.max_age, self.max_packets)


def random_case(seed: int, count: int, slots: int) -> Case:
    rng = np.random.default_rng(seed)
    return Case(
        packet_bits=rng.integers(1, 50, count),
        max_age=rng.choice([1, 2, 5, 20, NEVER], count),
        max_packets=rng.choice([1, 5, 30, UNBOUNDED], count),
        packets=rng.poisson(rng.uniform(0, 3, (slots, 1)), (slots, count)),
        bits=rng.integers(0, 120, (slots, count)) * (rng.random((slots, count)) < 0.6),
    )


def packet_by_packet(case: Case, n: int) -> list[int]:
    """Totals, what waits, and the age of the oldest packet of one buffer, by a loop over its packets."""
    size, queue = int(case.packet_bits[n]), deque[list[int]]()
    arrived = sent = dropped = delivered = delay = 0
    for slot, (packets, bits) in enumerate(zip(case.packets[:, n], case.bits[:, n], strict=True)):
        while queue and slot - queue[0][0] >= case.max_age[n]:
            dropped += queue.popleft()[1]
        for _ in range(packets):
            arrived += size
            if len(queue) < case.max_packets[n]:
                queue.append([slot, size])
            else:
                dropped += size
        left = int(bits)
        while queue and left:
            part = min(left, queue[0][1])
            queue[0][1] -= part
            left -= part
            sent += part
            if not queue[0][1]:
                delivered += 1
                delay += slot - queue.popleft()[0] + 1
    oldest = len(case.packets) - queue[0][0] if queue else 0
    waiting = sum(rest for _, rest in queue)
    return [arrived, sent, dropped, delivered, delay, waiting, len(queue), oldest]


@pytest.mark.parametrize("seed", range(8))
def test_every_number_is_that_of_a_loop_over_packets(seed: int) -> None:
    case = random_case(seed, 7, 300)
    buffers = case.buffers()
    for packets, bits in zip(case.packets, case.bits, strict=True):
        buffers.begin_slot(packets)
        buffers.serve(bits)
    found = [*buffers.totals, buffers.waiting, buffers.waiting_packets, buffers.oldest]
    assert np.stack(found, 1).tolist() == [packet_by_packet(case, n) for n in range(7)]


def balance_holds(seed: int, count: int, slots: int) -> PacketBuffers:
    case = random_case(seed, count, slots)
    buffers = case.buffers()
    for packets, bits in zip(case.packets, case.bits, strict=True):
        before = buffers.waiting
        buffers.begin_slot(packets)
        sent = buffers.serve(bits)
        assert (sent <= bits).all()
        assert (buffers.waiting >= 0).all()
        assert (buffers.waiting <= before + packets * case.packet_bits).all()
    totals = buffers.totals
    assert (totals.arrived == case.packets.sum(0) * case.packet_bits).all()
    assert (totals.arrived == totals.sent + totals.dropped + buffers.waiting).all()
    # What waits follows from the rows of the window too, of which no sum above knows.
    inside = buffers.waiting_packets * case.packet_bits
    assert ((inside - case.packet_bits < buffers.waiting) & (buffers.waiting <= inside)).all()
    return buffers


def test_arrived_is_sent_and_dropped_and_waiting_over_a_million_random_slots() -> None:
    """1,000 buffers, 1,000 slots: packets, capacities, ages and bounds at random, in whole bits."""
    totals = balance_holds(3, 1000, 1000).totals
    assert min(totals.sent.sum(), totals.dropped.sum()) > 1e6


@pytest.mark.exhaustive
@pytest.mark.parametrize("seed", range(20))
def test_the_balance_holds_over_many_more_slots(seed: int) -> None:
    balance_holds(seed, 50, 50_000)


def test_a_state_goes_on_as_if_nothing_had_been() -> None:
    """Whatever is kept in between, equal buffers have equal states."""
    case = random_case(11, 6, 400)
    whole, parts = case.buffers(), case.buffers()
    for slot, (packets, bits) in enumerate(zip(case.packets, case.bits, strict=True)):
        for buffers in (whole, parts):
            buffers.begin_slot(packets)
            buffers.serve(bits)
        if slot % 37 == 0:
            state = parts.state()
            parts = case.buffers()
            parts.restore(state)
    states = whole.state(), parts.state()
    assert all((states[0][name] == states[1][name]).all() for name in states[0])
    with pytest.raises(ValueError, match=r"6 buffers.*are 2"):
        PacketBuffers(np.array([1, 1])).restore(states[0])


def test_buffers_keep_what_they_have_when_others_come_and_go() -> None:
    case = random_case(5, 5, 200)
    alone, moved = case.buffers(), case.buffers()
    order = np.arange(5)
    for slot, (packets, bits) in enumerate(zip(case.packets, case.bits, strict=True)):
        alone.begin_slot(packets)
        alone.serve(bits)
        moved.begin_slot(packets[order])
        moved.serve(bits[order])
        if slot == 100:
            sources = np.array([3, 0, 4])
            kept = [array[sources] for array in case[:3]]
            moved, order = moved.rearranged(sources, PacketBuffers(*kept)), sources
    assert all((a[order] == b).all() for a, b in zip(alone.totals, moved.totals, strict=True))
    fresh = PacketBuffers(case.packet_bits[[0, 1]], case.max_age[[0, 1]])
    made = moved.rearranged(np.array([1, -1]), fresh)
    assert made.waiting.tolist() == [moved.waiting[1], 0]


@pytest.mark.parametrize("name", ["packet_bits", "max_age", "max_packets"])
def test_sizes_and_bounds_below_1_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} is 0 at least; write 1 or more"):
        PacketBuffers(**{"packet_bits": np.array([1, 1]), name: np.array([3, 0])})


# Discrete time, Poisson arrivals at the beginning of slots with mean ρ, one packet sent a slot. L packets are
# in the system in a slot, and L' = L − [L > 0] + A in the next. E[L'²] = E[L²] and P(L > 0) = ρ give
# E[L] = ρ + ρ²/(2(1 − ρ)), and Little's law the mean delay, slot of service included (H. Bruneel and
# B. G. Kim, Discrete-Time Models for Communication Systems Including ATM, 1993, section 1.2).
def mean_delay(load: float) -> float:
    return 1 + load / (2 * (1 - load))


@pytest.mark.parametrize("load", [0.5, 0.9])
def test_the_mean_delay_of_a_slotted_queue_is_that_of_the_formula(load: float) -> None:
    """Within 2 %: 2,000 queues, 4,000 slots after a start of 1,000; packets of 7 bits, 7 bits a slot."""
    rng = np.random.default_rng(17)
    buffers = PacketBuffers(np.full(2000, 7))
    before = buffers.totals
    for slot in range(5000):
        if slot == 1000:
            before = buffers.totals
        buffers.begin_slot(rng.poisson(load, 2000))
        buffers.serve(np.full(2000, 7))
    totals = buffers.totals
    delivered = (totals.delivered - before.delivered).sum()
    assert delivered > 3e6
    assert (totals.delay - before.delay).sum() / delivered == pytest.approx(mean_delay(load), rel=0.02)
