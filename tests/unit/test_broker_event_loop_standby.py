"""The standby of the broker's loop: it serves while a call waits, and only then."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from caviar_broker import event_loop as standby
from caviar_broker.event_loop import Standby

LONG_S = 30.0


class Loop:
    """A loop that counts its turns by thread, and does in each what the test says."""

    def __init__(self, turn: Callable[[Loop], None]) -> None:
        self.turns: list[str] = []
        self.over = False
        self.standby = Standby(self._turn, lambda: self.over)
        self._body = turn

    def _turn(self) -> None:
        self.turns.append(threading.current_thread().name)
        self._body(self)


def test_a_quick_call_is_made_in_the_thread_that_serves() -> None:
    called: list[str] = []

    def turn(loop: Loop) -> None:
        loop.standby.call(lambda: called.append(threading.current_thread().name))
        assert not loop.standby.calling
        loop.over = len(loop.turns) == 3

    loop = Loop(turn)
    loop.standby.run()
    assert loop.turns == called == ["leader"] * 3
    loop.standby.close()


def test_the_standby_serves_while_a_call_waits_and_gives_the_loop_back() -> None:
    """Every turn of the standby falls within the call; the leader goes on after it, in the same turn."""
    answered, events = threading.Event(), list[str]()

    def wait() -> None:
        events.append("waits")
        assert answered.wait(LONG_S)

    def turn(loop: Loop) -> None:
        thread = threading.current_thread().name
        events.append(thread)
        if thread == "leader" and len(events) == 1:
            loop.standby.call(wait)
            events.append("goes on")
        elif thread == "leader":
            loop.over = True
        elif len(events) == 5:
            assert loop.standby.calling
            answered.set()

    loop = Loop(turn)
    loop.standby.run()
    others = events[2 : events.index("goes on")]
    assert events[:2] == ["leader", "waits"]
    assert len(others) >= 3
    assert set(others) == {"standby"}
    assert events[events.index("goes on") :] == ["goes on", "leader"]


def test_a_turn_of_the_standby_may_call_nothing_though_the_call_ends_meanwhile() -> None:
    """It would give the loop back to the leader by that, and wait for it for ever."""
    answered, allowed = threading.Event(), list[bool]()

    def turn(loop: Loop) -> None:
        if threading.current_thread().name == "standby":
            answered.set()
            until = time.monotonic() + LONG_S
            while loop.standby.calling_since is not None and time.monotonic() < until:
                threading.Event().wait(0.001)
            allowed.append(not loop.standby.calling)
        elif not allowed:
            loop.standby.call(lambda: assert_set(answered))
        else:
            allowed.append(not loop.standby.calling)
            loop.over = True

    def assert_set(event: threading.Event) -> None:
        assert event.wait(LONG_S)

    loop = Loop(turn)
    loop.standby.run()
    assert allowed == [False, True]
    loop.standby.close()


def test_a_loop_that_is_over_meanwhile_ends_though_the_call_goes_on_waiting() -> None:
    answered, came_back = threading.Event(), list[str]()

    def turn(loop: Loop) -> None:
        if threading.current_thread().name == "leader":
            loop.standby.call(lambda: answered.wait(LONG_S) and None)
            came_back.append("the leader")
        else:
            loop.over = True

    loop = Loop(turn)
    loop.standby.run()
    assert loop.standby.calling
    loop.standby.close()
    leader = next(thread for thread in threading.enumerate() if thread.name == "leader")
    answered.set()
    leader.join(LONG_S)
    assert not came_back, "what was to come after the call uses what is closed now"


@pytest.mark.parametrize("thread", ["leader", "standby"])
def test_what_a_turn_raises_is_raised_by_run(thread: str) -> None:
    answered = threading.Event()

    def turn(loop: Loop) -> None:
        if threading.current_thread().name == thread:
            answered.set()
            raise LookupError("a bug")
        loop.standby.call(lambda: answered.wait(LONG_S) and None)

    with pytest.raises(LookupError, match="a bug"):
        Loop(turn).standby.run()


def test_the_leader_is_not_relieved_before_it_has_waited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(standby, "PATIENCE_S", LONG_S)
    looks = threading.Event()

    def turn(loop: Loop) -> None:
        loop.standby.call(lambda: looks.wait(4 * standby.LOOK_S) and None)
        loop.over = True

    loop = Loop(turn)
    loop.standby.run()
    assert loop.turns == ["leader"]
