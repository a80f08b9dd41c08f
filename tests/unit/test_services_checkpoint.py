"""Saved states: one form, and errors that say why one cannot be resumed from."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from caviar_protocol.errors import RunError
from caviar_protocol.topics import Carrier
from caviar_services.agent.baselines import RandomAgent, WaypointsAgent, WaypointsSettings
from caviar_services.checkpoint import Packed, restored, saved
from caviar_services.service import RunInfo


class Kept(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    numbers: Packed
    order: dict[str, int]


class Older(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    order: dict[str, str]


NUMBERS = np.array([[1.5, -0.0, np.inf], [1e-310, 2.0**0.5, -7.0]])
STATE = Kept(numbers=Packed.pack(NUMBERS, "<f8"), order={"b": 2, "a": 1})


def pilot(name: str = "pilot", speed: float = 6.0, **run: Any) -> WaypointsAgent:
    settings = WaypointsSettings(object="uav", waypoints_m=((1.0, 2.0, 3.0),), speed_m_s=speed)
    return WaypointsAgent(settings, RunInfo(name=name, **run))


def test_what_was_saved_comes_back_bit_by_bit() -> None:
    back = restored(pilot(), 1, Kept, saved(pilot(), 1, STATE))
    assert back.order == STATE.order
    array = back.numbers.array(np.float64)
    assert array.tobytes() == NUMBERS.tobytes()
    assert array.shape == (2, 3)
    array[0, 0] = 9.0  # it is no other's


def test_equal_states_give_equal_bytes() -> None:
    """Whatever order a mapping was filled in."""
    other = Kept(numbers=Packed.pack(np.asfortranarray(NUMBERS), "<f8"), order={"a": 1, "b": 2})
    assert saved(pilot(), 1, other) == saved(pilot(), 1, STATE)


@pytest.mark.parametrize(
    ("service", "version", "told"),
    [
        (pilot(), 2, "of version 1: this is version 2 of WaypointsAgent; use the release that saved it"),
        (pilot(speed=7.0), 1, "of another scenario: settings, seed, sampling period"),
        (pilot(seed=5), 1, "of another scenario"),
        (pilot("other"), 1, "'other' cannot go on from a saved state of another scenario"),
        (pilot(carriers=(Carrier(name="c", frequency_hz=1e9),)), 1, "of another scenario"),
    ],
)
def test_a_state_of_something_else_is_refused_with_the_remedy(
    service: WaypointsAgent, version: int, told: str
) -> None:
    with pytest.raises(RunError) as error:
        restored(service, version, Kept, saved(pilot(), 1, STATE))
    assert told in str(error.value)


def test_a_state_of_another_implementation_is_refused_by_name() -> None:
    agent = RandomAgent(RandomAgent.Settings(), RunInfo(name="pilot"))
    with pytest.raises(RunError, match=r"WaypointsAgent.*RandomAgent"):
        restored(agent, 1, Kept, saved(pilot(), 1, STATE))


def test_every_damage_is_found() -> None:
    """Each byte in turn, and each length."""
    whole = saved(pilot(), 1, STATE)
    for at in range(len(whole)):
        damaged = bytearray(whole)
        damaged[at] ^= 0x10
        for state in (bytes(damaged), whole[:at]):
            with pytest.raises(RunError, match="cannot go on from a saved state"):
                restored(pilot(), 1, Kept, state)


def test_a_struct_that_changed_without_its_version_is_refused() -> None:
    with pytest.raises(RunError, match="it is no state of WaypointsAgent"):
        restored(pilot(), 1, Older, saved(pilot(), 1, STATE))
