"""An adaptive channel that takes over what another one had learned, on a clock that only rungs move."""

from __future__ import annotations

import pytest
from adaptive_rungs import LADDER, Time, adaptive, channel_of, frame, labels, rung

from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import RunError
from caviar_services.channel.adaptive.channel import AdaptiveChannel
from caviar_services.service import StepResult

SPLIT, FRAMES = 30, 90


def stepped(channel: AdaptiveChannel, first: int, last: int) -> list[StepResult]:
    """Frames on a machine whose load changes, so that rungs come and go."""
    results = []
    for number in range(first, last):
        Time.load = 1.0 + 0.15 * (number * 7 % 5) + (2.0 if number % 40 > 25 else 0.0)
        results.append(channel.step(frame(number, budget_ms=160.0)))
    return results


def counted(result: StepResult) -> dict[str, int]:
    """What a frame reports beside its product; what a rung remembers for its reports alone is not saved."""
    return {name: count for name, count in result.counts.items() if name not in ("births", "deaths")}


def test_another_process_decides_as_this_one_would_have() -> None:
    """The same durations lead to the same rungs, predictions and stated errors."""
    first = adaptive(calibrate_every=4)
    stepped(first, 0, SPLIT)
    state = first.checkpoint()
    expected = stepped(first, SPLIT, FRAMES)
    assert len(set(labels(expected))) > 1
    second = adaptive(calibrate_every=4)
    second.restore(state)
    assert second.checkpoint() == state
    found = stepped(second, SPLIT, FRAMES)
    for one, two in zip(expected, found, strict=True):
        assert (one.decisions, one.fidelity) == (two.decisions, two.fidelity)
        assert counted(one) == counted(two)
        assert one.measured["rung-predicted"] == two.measured["rung-predicted"]
        assert encode_payload(channel_of(one)) == encode_payload(channel_of(two))
    assert second.checkpoint() == first.checkpoint()


def test_frames_that_are_repeated_on_another_machine_have_the_same_bytes_where_rungs_are_imposed() -> None:
    """Durations are other ones there; stated errors come from the state, and from the rungs imposed."""
    first = adaptive(calibrate_every=4)
    stepped(first, 0, SPLIT)
    state = first.checkpoint()
    expected = stepped(first, SPLIT, FRAMES)
    second = adaptive(calibrate_every=4)
    second.restore(state)
    Time.load = 9.0
    for number, result in enumerate(expected, SPLIT):
        again = second.step(frame(number, budget_ms=160.0, imposed=result.decisions["rung"]))
        assert encode_payload(channel_of(again)) == encode_payload(channel_of(result))


def test_a_state_of_another_ladder_is_refused() -> None:
    state = adaptive().checkpoint()
    with pytest.raises(RunError, match="another scenario"):
        adaptive(ladder=[*LADDER, rung("highest", 300)]).restore(state)
