"""Paths that are followed by one channel, and then by another that takes over its state."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest
from same_paths import model
from test_channel_follow import CANYON, stepped, street

from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import RunError
from caviar_protocol.topics import AntennaDevice, Scene

FOLLOW, SAMPLES = 5, 10_000
SPLIT, FRAMES = 7, 14


def standing(frame: int) -> Scene:
    """Everything waits from two frames before the other channel takes over to two after."""
    return street(min(frame, SPLIT - 2) if frame < SPLIT + 2 else frame - 3)


def to_and_fro(frame: int) -> Scene:
    """Nothing moves but the transmitter, which comes back to where it was, and jumps at last."""
    still = street(3)
    x = 30.0 if frame == FRAMES - 1 else -31.0 + 0.5 * (frame % 3)
    devices = tuple(
        msgspec.structs.replace(d, position=(x, 5.0, 12.0))
        if isinstance(d, AntennaDevice) and d.name == "bs"
        else d
        for d in still.devices
    )
    return msgspec.structs.replace(still, devices=devices)


def leaving(frame: int) -> Scene:
    """Cars leave one by one, so that others get their bodies."""
    return street(frame, leaving=frame // 3)


@pytest.mark.parametrize(
    "scene",
    [
        pytest.param(street, marks=pytest.mark.exhaustive),
        leaving,
        pytest.param(standing, marks=pytest.mark.exhaustive),
        pytest.param(to_and_fro, marks=pytest.mark.exhaustive),
    ],
)
def test_another_channel_goes_on_bit_by_bit(scene: Callable[[int], Scene]) -> None:
    settings = {"follow": FOLLOW, "samples": SAMPLES}
    first, second = model(CANYON, **settings), model(CANYON, **settings)
    for channel in (first, second):
        channel.reset(0, 0, 0)
    for frame in range(SPLIT):
        stepped(first, frame, scene(frame))
    state = first.checkpoint()
    second.restore(state)
    assert second.checkpoint() == state
    for frame in range(SPLIT, FRAMES):
        one, two = stepped(first, frame, scene(frame)), stepped(second, frame, scene(frame))
        assert encode_payload(one) == encode_payload(two), f"frame {frame}"
        assert len(one.tau) > 5
    assert second.checkpoint() == first.checkpoint()


@pytest.mark.exhaustive
def test_without_its_state_another_channel_would_find_other_paths() -> None:
    """So the test above can fail: where chains are not known, a launch of all rays tells other ones."""
    settings = {"follow": FOLLOW, "samples": 2_000}
    first, second = model(CANYON, **settings), model(CANYON, **settings)
    for channel in (first, second):
        channel.reset(0, 0, 0)
    for frame in range(SPLIT):
        stepped(first, frame, street(frame))
    pairs = [(stepped(first, f, street(f)), stepped(second, f, street(f))) for f in range(SPLIT, FRAMES)]
    assert any(not np.array_equal(one.id, two.id) for one, two in pairs)


def test_each_frame_on_its_own_needs_next_to_nothing() -> None:
    channel = model(CANYON, samples=SAMPLES)
    channel.reset(0, 0, 0)
    stepped(channel, 0, street(0))
    state = channel.checkpoint()
    assert len(state) < 300
    channel.restore(state)
    following = model(CANYON, samples=SAMPLES, follow=FOLLOW)
    with pytest.raises(RunError, match="another scenario"):
        following.restore(state)
