"""Rows for channels that are traced at every few frames alone."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from link_builders import CARRIER, antenna, scene_of
from msgspec.structs import replace

from caviar_clients.session.scenes import Instant, Scenes
from caviar_labs.tradeoff.errors import FLOOR_DB, Noise
from caviar_labs.tradeoff.keyframes import Traced, keyframe_rows, spaced
from caviar_labs.tradeoff.ladder import Setting
from caviar_labs.tradeoff.scenes import CONSECUTIVE, scenes_of
from caviar_labs.tradeoff.worker import Rung
from caviar_protocol.errors import RunError
from caviar_protocol.topics import Channel

pytestmark = pytest.mark.slow

NOISE = Noise(figure_db=9.0, temperature_k=290.0)
FREE_SPACE = Setting(label="free-space", use="free-space")
PERIOD_NS = 100_000_000
SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"


def driving(frames: int) -> Scenes:
    """A car that brakes by 3 m/s² below a station."""
    instants = []
    for number in range(frames):
        t = number / 10
        where = (20.0 + 15.0 * t - 1.5 * t**2, 4.0, 1.0)
        made = scene_of(
            antenna("bs", "tx", (1, 8), (0.0, 0.0, 10.0), power_dbm=30.0),
            antenna("car/rx", "rx", (2, 2), (0.0, 0.0, 1.0), parent="car"),
            objects={"car": (where, 0.0)},
        )
        velocity = np.array([[15.0 - 3.0 * t, 0.0, 0.0]])
        instants.append(Instant(number, number * PERIOD_NS, replace(made, velocity=velocity)))
    return Scenes(
        name="driving",
        origin="made by hand",
        instants=tuple(instants[:1]),
        carriers=(CARRIER,),
        devices=(),
        assets={},
        services={},
        seed=1,
        sampling_period_ns=PERIOD_NS,
        consecutive=tuple(instants),
    )


def rows(scenes: Scenes, setting: Setting = FREE_SPACE, **more: Any) -> Any:
    return keyframe_rows(setting, scenes, None, more.get("seconds", 60.0), lambda _: None)


def test_each_spacing_has_a_row_beside_that_of_all_frames() -> None:
    found = rows(driving(11))
    assert [row.setting for row in found] == [
        "free-space",
        *(f"free-space, keyframes every {n}" for n in (2, 5, 10)),
    ]
    every, *others = found
    assert (every.factor, every.nmse_db, every.within_bound) == (1.0, FLOOR_DB, None)
    for row in others:
        assert row.users == 10  # the first keyframe belongs to the interval before
        assert (row.with_bound, row.within_bound, row.beam_top1) == (1.0, 1.0, 1.0)
        assert row.nmse_db < -80  # the straight path of a car whose positions are known
        assert "frames 0 to 10, consecutive" in row.note


def test_a_scene_costs_its_share_of_the_keyframe_and_the_interpolation() -> None:
    """Keyframes that took 1 s, 5 frames apart, make a scene that took a little more than 0.2 s."""
    scenes = driving(6)
    rung = Rung(FREE_SPACE, scenes, None, products=True)
    traced = []
    for instant in scenes.consecutive:
        sample = rung.sample(instant)
        assert isinstance(sample.channel, Channel)
        slow = type(sample)(**{**vars(sample), "time_ms": 1000.0})
        traced.append(Traced(instant, slow, sample.channel))
    begin = time.perf_counter()
    found = spaced(traced, 5, NOISE)
    took_ms = (time.perf_counter() - begin) * 1e3
    assert len(found.times_ms) == 5
    assert 200.0 < found.times_ms[0] <= 200.0 + took_ms / 5


def test_few_frames_have_few_rows_or_none() -> None:
    assert [row.row for row in rows(driving(6))] == ["1", "2", "5"]
    with pytest.raises(RunError, match="no 3 consecutive frames"):
        rows(driving(2))


def test_what_takes_too_long_is_ended() -> None:
    with pytest.raises(RunError, match="no answer within"):
        rows(driving(6), seconds=0.01)


def test_consecutive_frames_are_the_middle_of_the_episode() -> None:
    found = scenes_of(SMOKE, 2)
    numbers = [instant.frame for instant in found.consecutive]
    assert numbers == list(range(numbers[0], numbers[0] + CONSECUTIVE))
    assert numbers[0] == 39
    assert [instant.frame for instant in found.instants] == [0, 99]
