"""Channels between keyframes beside those that were traced at the same instants, in a street."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest

from caviar_labs.interpolation import Interpolation, Keyframe
from caviar_labs.stability.lab import Thing, antenna, measure, scene, sionna
from caviar_protocol.topics import AntennaArray, Channel, Scene
from caviar_space.scenery import scenery_assets

FRAME_S = 0.1
FRAMES = 11
CARS = 5


def street(number: int) -> Scene:
    """Cars on two lanes, as fast as 14 m/s, that brake and accelerate by as much as 2 m/s²."""
    t = number * FRAME_S
    things, devices = [], [antenna("bs", "tx", (-20.0, 5.5, 9.3), AntennaArray(columns=16))]
    for car in range(CARS):
        way = 1 if car % 2 else -1
        speed, push = 9.0 + car, 2.0 * np.sin(1.7 * car + 0.4)
        x = way * (-35.0 + 17.3 * car * way + speed * t + push / 2 * t**2)
        velocity = (way * (speed + push * t), 0.0, 0.0)
        things.append(Thing(f"car{car}", (x, -2.0 * way + 0.13 * car, 0.76), velocity=velocity))
        roof = AntennaArray(columns=4)
        devices.append(antenna(f"rx{car}", "rx", (0.0, 0.0, 0.9), roof, parent=f"car{car}"))
    return scene(devices, things)


@cache
def traced() -> tuple[Channel, ...]:
    folder, assets = Path(mkdtemp()), {}
    for name, content in scenery_assets("sionna:simple_street_canyon").items():
        assets[name] = content if isinstance(content, Path) else folder / name
        if isinstance(content, bytes):
            assets[name].parent.mkdir(exist_ok=True, parents=True)
            assets[name].write_bytes(content)
    model = sionna(28e9, assets, samples=200_000, max_depth=3, bodies=CARS, refraction=False)
    return tuple(measure(model, street(number), number) for number in range(FRAMES))


def spaced(every: int, known: bool) -> list[tuple[float, float, bool, bool]]:
    """For each receiver and frame between: error and bound [dB], whether paths are born or die, and
    whether a path came or went that both keyframes have, or neither."""
    found = []
    channels = traced()
    for first in range(0, FRAMES - every, every):
        ends = [
            Keyframe(n * FRAME_S, channels[n], street(n) if known else None) for n in (first, first + every)
        ]
        between = Interpolation(*ends)
        for number in range(first + 1, first + every):
            got, truth = between.at(number * FRAME_S, street(number), with_h=True), channels[number]
            for rx, matrix in enumerate(truth.h):
                h, expected = got.channel.h[rx].h, matrix.h
                error = np.linalg.norm(h - expected) / np.linalg.norm(expected)
                error_db = 20 * np.log10(max(error, 1e-12))
                found.append(
                    (error_db, got.bound_db[0, 0, rx], got.changed[0, rx], _flickers(ends, truth, rx))
                )
    return found


def _flickers(ends: list[Keyframe], truth: Channel, rx: int) -> bool:
    ids = [set(c.id[c.pair("bs", c.rx[rx])].tolist()) for c in (ends[0].channel, truth, ends[1].channel)]
    return not (ids[0] & ids[2]) <= ids[1] <= (ids[0] | ids[2])


@pytest.mark.parametrize("every", [2, 5, 10])
@pytest.mark.parametrize("known", [True, False])
def test_no_error_is_beyond_its_bound(every: int, known: bool) -> None:
    """Whatever is born or dies, as long as what both keyframes have stays, and nothing else comes."""
    found = [entry for entry in spaced(every, known) if not entry[3]]
    assert len(found) >= 0.7 * (FRAMES // every) * (every - 1) * CARS
    assert [entry for entry in found if entry[0] > entry[1]] == []


@pytest.mark.parametrize("every", [2, 5])
def test_where_no_path_is_born_or_dies_channels_are_those_that_a_trace_finds(every: int) -> None:
    """With positions known, to −40 dB; half a second between keyframes is 7 m of way."""
    errors = [10 ** (e / 10) for e, _, changed, flickers in spaced(every, True) if not changed | flickers]
    assert len(errors) >= 5
    assert 10 * np.log10(np.mean(errors)) <= -40.0


def test_bounds_are_of_use() -> None:
    """Where no path is born or dies and positions are known, most bounds promise −10 dB or better."""
    bounds = [bound for _, bound, changed, _ in spaced(2, True) if not changed]
    assert np.median(bounds) <= -10.0
