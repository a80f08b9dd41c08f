"""The free-space service: what it takes, what it makes, and where the formula ends."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_labs.stability.lab import channel_of, frame_of, scene
from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import ScenarioError
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.registry import load
from caviar_services.service import Preparation, RunInfo, StepResult

CARRIERS = (Carrier(name="a", frequency_hz=28e9), Carrier(name="b", frequency_hz=60e9))


def step(*devices: AntennaDevice, parts: frozenset[str] = frozenset()) -> StepResult:
    model = FreeSpaceChannel(FreeSpaceSettings(), RunInfo(name="channel", carriers=CARRIERS))
    model.prepare(Preparation(demand={"channel": parts}))
    return model.step(frame_of(scene(devices)))


def device(name: str, role: str, x: float) -> AntennaDevice:
    return AntennaDevice(name=name, role=role, position=(x, 0.0, 0.0), array=AntennaArray(columns=3))  # type: ignore[arg-type]


def test_it_is_registered_under_its_rung() -> None:
    assert load("channel", "free-space") is FreeSpaceChannel


def test_every_pair_has_its_line_of_sight() -> None:
    result = step(device("t", "tx", 0), device("u", "tx", -7), device("r", "rx", 30), device("s", "rx", 9))
    channel = channel_of(result)
    assert channel.tx == ("t", "u")
    assert channel.rx == ("r", "s")
    assert channel.offsets.tolist() == [0, 1, 2, 3, 4]
    assert channel.los.all()
    assert channel.h == ()
    assert channel.tau * 299792458.0 == pytest.approx([30, 9, 37, 16])
    assert result.fidelity == channel.rung == "free-space"
    assert result.counts["paths"] == 4


def test_matrices_follow_demand() -> None:
    result = step(device("t", "tx", 0), device("r", "rx", 30), parts=frozenset({"h"}))
    assert [m.h.shape for m in channel_of(result).h] == [(3, 3), (3, 3)]


def test_a_device_of_both_roles_has_no_path_to_itself() -> None:
    result = step(device("t", "tx", 0), device("x", "both", 20), parts=frozenset({"h"}))
    channel = channel_of(result)
    assert channel.tx == ("t", "x")
    assert channel.rx == ("x",)
    assert channel.offsets.tolist() == [0, 1, 1]
    assert result.counts["too_close"] == 1
    encode_payload(channel)


def test_closer_than_a_wavelength_there_is_no_far_field() -> None:
    """λ of the lowest carrier is 10.7 mm."""
    near = step(device("t", "tx", 0), device("r", "rx", 0.010))
    far = step(device("t", "tx", 0), device("r", "rx", 0.011))
    assert len(channel_of(near).tau) == 0
    assert near.counts["too_close"] == 1
    assert len(channel_of(far).tau) == 1
    assert np.abs(channel_of(far).a).max() < 1


@pytest.mark.parametrize("role", ["tx", "rx"])
def test_without_an_end_there_is_an_empty_channel_of(role: str) -> None:
    channel = channel_of(step(device("d", role, 0), parts=frozenset({"h"})))
    assert len(channel.tau) == 0
    assert channel.offsets.tolist() == [0]
    encode_payload(channel)


def test_a_run_without_carriers_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"\[\[carriers\]\]"):
        FreeSpaceChannel(FreeSpaceSettings(), RunInfo(name="channel"))
