"""What is announced to agents that serve policies, and what comes of it."""

from __future__ import annotations

import pytest

from caviar_broker.core.policy_swaps import PolicySwaps
from caviar_protocol.policies import DECISION, EARLIER, NEXT, REFUSED, SHA256

FIRST, SECOND, THIRD = ("1" * 64, "2" * 64, "3" * 64)


@pytest.fixture
def swaps() -> PolicySwaps:
    return PolicySwaps({"agent": (FIRST,), "other": (THIRD,)})


def refuse(digest: str, serving: str) -> dict[str, str]:
    """Decisions of a frame in which an agent says that it cannot serve a policy."""
    return {DECISION: serving, REFUSED: f"{digest} it is torn"}


def test_nothing_is_announced_before_something_is_offered(swaps: PolicySwaps) -> None:
    assert swaps.announced("agent") == {}
    assert swaps.announced("no such agent") == {}
    assert swaps.note("agent", {DECISION: FIRST}, 0) == ""
    assert (swaps.state("agent").serving, swaps.state("agent").since) == (FIRST, 0)


def test_an_offer_is_announced_to_its_agent_until_the_next(swaps: PolicySwaps) -> None:
    swaps.offer("agent", SECOND)
    assert swaps.announced("agent") == {NEXT: SECOND}
    assert swaps.announced("other") == {}
    assert swaps.note("agent", {DECISION: FIRST}, 4) == ""
    assert "serves from frame 5 on" in swaps.note("agent", {DECISION: SECOND}, 5)
    assert swaps.note("agent", {DECISION: SECOND}, 6) == ""
    assert swaps.state("agent").since == 5
    assert swaps.announced("agent") == {NEXT: SECOND}, "an agent that comes back reads it again"
    swaps.offer("agent", THIRD)
    assert swaps.announced("agent") == {NEXT: THIRD}


def test_a_refusal_is_told_once_and_the_offer_before_it_stands(swaps: PolicySwaps) -> None:
    swaps.offer("agent", SECOND)
    swaps.note("agent", {DECISION: SECOND}, 5)
    swaps.offer("agent", THIRD)
    assert swaps.note("agent", refuse(THIRD, SECOND), 8) == f"policy {THIRD[:12]}… is refused: it is torn"
    assert swaps.note("agent", refuse(THIRD, SECOND), 9) == ""
    assert swaps.state("agent").refused == {THIRD: "it is torn"}
    assert swaps.announced("agent") == {NEXT: SECOND}
    assert swaps.settings("agent", {})[EARLIER] == [SECOND], "an agent that comes back does not ask for it"


def test_the_first_offer_refused_leaves_nothing_announced(swaps: PolicySwaps) -> None:
    swaps.offer("agent", SECOND)
    swaps.note("agent", refuse(SECOND, FIRST), 3)
    assert swaps.announced("agent") == {}
    assert swaps.settings("agent", {"file": "f"}) == {"file": "f", SHA256: FIRST, EARLIER: []}


def test_a_refusal_of_what_was_overtaken_leaves_the_later_offer(swaps: PolicySwaps) -> None:
    swaps.offer("agent", SECOND)
    swaps.offer("agent", THIRD)
    swaps.note("agent", refuse(SECOND, FIRST), 3)
    assert swaps.announced("agent") == {NEXT: THIRD}


def test_what_was_refused_may_be_offered_again(swaps: PolicySwaps) -> None:
    swaps.offer("agent", SECOND)
    swaps.note("agent", refuse(SECOND, FIRST), 3)
    swaps.offer("agent", SECOND)
    assert swaps.state("agent").refused == {}
    assert swaps.announced("agent") == {NEXT: SECOND}


def test_the_first_policy_may_come_back(swaps: PolicySwaps) -> None:
    for frame, digest in enumerate((SECOND, FIRST)):
        swaps.offer("agent", digest)
        assert f"from frame {frame} on" in swaps.note("agent", {DECISION: digest}, frame)
    assert swaps.settings("agent", {})[EARLIER] == [SECOND, FIRST]
    assert swaps.announced("agent") == {NEXT: FIRST}


def test_a_run_that_goes_on_announces_what_was_given_last() -> None:
    swaps = PolicySwaps({"agent": (FIRST, SECOND, THIRD)})
    assert swaps.announced("agent") == {NEXT: THIRD}
    assert swaps.settings("agent", {}) == {SHA256: FIRST, EARLIER: [SECOND, THIRD]}
    assert swaps.settings("link", {"a": 1}) == {"a": 1}
