"""The loop's waits: on time, ended by whatever comes, and none that cannot end."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator

import pytest
import zmq

from caviar_broker import event_loop as loop_module
from caviar_broker.event_loop import EventLoop, raise_priority

MS = 1_000_000

Socket = zmq.Socket[bytes]


@pytest.fixture
def pair() -> Iterator[tuple[Socket, Socket]]:
    """Two connected sockets."""
    with zmq.Context() as context, context.socket(zmq.PAIR) as one, context.socket(zmq.PAIR) as other:
        one.bind("inproc://pair")
        other.connect("inproc://pair")
        yield one, other


def least_overshoot(loop: EventLoop, wait_ns: int, times: int = 20) -> int:
    """By how much a wait is late at least: what a busy machine adds comes and goes [ns]."""
    found = []
    for _ in range(times):
        began = time.monotonic_ns()
        assert loop.poll(wait_ns) == []
        found.append(time.monotonic_ns() - began - wait_ns)
    return min(found)


@pytest.mark.parametrize("wait_ns", [300_000, 1_400_000, 2_500_000, 7_700_000])
def test_a_wait_ends_on_time_and_never_early(pair: tuple[Socket, Socket], wait_ns: int) -> None:
    """The poller alone would round up to whole milliseconds."""
    loop = EventLoop()
    loop.watch(pair[0], lambda: None)
    assert 0 <= least_overshoot(loop, wait_ns) < 200_000


def test_a_message_ends_a_wait_in_every_part_of_it(pair: tuple[Socket, Socket]) -> None:
    loop = EventLoop()
    loop.watch(pair[0], lambda: None)
    pair[1].send(b"here already")
    assert loop.poll(3600_000 * MS) == [pair[0]]
    assert loop.poll_sockets(time.monotonic_ns() + 3600_000 * MS) == [pair[0]]
    pair[0].recv()
    assert loop.poll_sockets(time.monotonic_ns() + MS) == []


def test_a_descriptor_is_seen_by_a_wait_of_any_length(pair: tuple[Socket, Socket]) -> None:
    """Short waits are waits for sockets; a descriptor must not starve beside them."""
    loop = EventLoop()
    read, write = os.pipe()
    try:
        loop.watch(pair[0], lambda: None)
        loop.watch(read, lambda: None)
        os.write(write, b"x")
        assert loop.poll(0) == loop.poll(MS // 2) == loop.poll(50 * MS) == [read]
        loop.unwatch(read)
        assert loop.poll(0) == []
    finally:
        os.close(read)
        os.close(write)


def test_a_socket_whose_descriptor_select_cannot_take_is_polled(
    pair: tuple[Socket, Socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(loop_module, "SELECTABLE", 0)
    loop = EventLoop()
    loop.watch(pair[0], lambda: None)
    assert least_overshoot(loop, 3 * MS, 3) >= 0
    pair[1].send(b"x")
    assert loop.poll(MS) == [pair[0]]


def test_a_socket_that_is_not_watched_any_more_is_not_waited_for(pair: tuple[Socket, Socket]) -> None:
    loop = EventLoop()
    loop.watch(pair[0], lambda: None)
    loop.unwatch(pair[0])
    pair[1].send(b"x")
    assert loop.poll(MS) == []
    assert loop.poll_sockets(time.monotonic_ns() + MS) == []


@pytest.mark.parametrize(
    ("real_time", "nice", "told"),
    [(True, True, "real time"), (False, True, "niceness -10"), (False, False, "niceness 3")],
)
def test_the_broker_takes_the_best_place_that_it_is_permitted(
    monkeypatch: pytest.MonkeyPatch, real_time: bool, nice: bool, told: str
) -> None:
    asked = []

    def permitted(name: str, allowed: bool) -> None:
        def call(*arguments: object) -> None:
            asked.append(name)
            if not allowed:
                raise PermissionError(1, "Operation not permitted")

        monkeypatch.setattr(os, name, call)

    permitted("sched_setscheduler", real_time)
    permitted("setpriority", nice)
    monkeypatch.setattr(os, "getpriority", lambda *_: 3)
    assert raise_priority() == told
    assert asked[0] == "sched_setscheduler"


def test_what_another_thread_polls_meanwhile_is_not_called_for_again() -> None:
    """A callback may wait for a disk: then a standby serves, and empties what was ready before."""
    loop, called, fds = EventLoop(), list[str](), [os.eventfd(1, os.EFD_NONBLOCK) for _ in range(2)]

    def first() -> None:
        called.append("first")
        loop.poll()

    loop.watch(fds[0], first)
    loop.watch(fds[1], lambda: called.append("second"))
    loop.call(sorted(loop.poll(), key=fds.index))
    assert called == ["first"]
    for fd in fds:
        os.close(fd)
