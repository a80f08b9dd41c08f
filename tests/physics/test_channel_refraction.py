"""Options beside reflection lose none of it: ``refraction``, ``diffraction``, with rays and enumerated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from same_paths import SCENES, things

from caviar_labs.stability.lab import (
    Array,
    Plate,
    Thing,
    antenna,
    measure,
    scene,
    sionna,
    write_scenery,
)
from caviar_protocol.topics import Channel, Interaction, Scene
from caviar_space.scenery import scenery_assets

pytestmark = pytest.mark.channel

Key = tuple[int, int]


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache that no other test has."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))


def keys(channel: Channel) -> list[Key]:
    """Receiver and id of each path."""
    receiver = np.repeat(np.arange(len(channel.rx)), np.diff(channel.offsets))
    return list(zip(receiver.tolist(), channel.id.tolist(), strict=True))


def reflections(channel: Channel) -> dict[Key, Array]:
    """Amplitudes of the paths that have no other interaction, by key."""
    only = (channel.interactions == 0) | (channel.interactions == Interaction.REFLECTION)
    return {key: channel.a[:, row] for row, key in enumerate(keys(channel)) if only[row].all()}


def glass_street(folder: Path) -> dict[str, Path]:
    """Two rows of panes that let most of each wave through, on lossy ground."""
    plates = [Plate("ground", [(-60, -30, 0), (60, -30, 0), (60, 30, 0), (-60, 30, 0)])]
    for row, y in enumerate((-7.0, 8.0)):
        for number in range(8):
            x, turned = -40.0 + 10.0 * number, 0.4 * (-1) ** number
            corners = [(x, y, 0), (x + 8, y + turned, 0), (x + 8, y + turned, 9), (x, y, 9)]
            plates.append(Plate(f"pane-{row}-{number}", corners, "glass", 0.006))
    return write_scenery(folder, plates)


def street(count: int) -> Scene:
    rng = np.random.default_rng(8)
    places = rng.uniform((-35, -11, 1), (35, 12, 4), (count, 3))
    devices = [antenna(f"r{i}", "rx", place) for i, place in enumerate(places)]
    cars = [Thing("car", (5.0, -2.0, 0.8)), Thing("van", (-12.0, 3.0, 1.3), (6.0, 2.0, 2.5))]
    return scene([antenna("t", "tx", (-3.0, 0.5, 6.0)), *devices], cars)


@pytest.mark.parametrize("candidates", ["launched", "enumerated"])
@pytest.mark.parametrize(
    "options",
    [
        {"refraction": True},
        pytest.param({"refraction": True, "diffraction": True}, marks=pytest.mark.exhaustive),
    ],
)
def test_no_reflection_is_lost_and_none_is_there_twice(
    tmp_path: Path, candidates: str, options: dict[str, Any]
) -> None:
    """Few rays, most of which go through the panes: with the options there are all reflected paths of the
    launch without them, with the same amplitudes, and others beside."""
    settings = {"candidates": candidates, "samples": 2_000, "samples_per_frame": 2_000, "max_depth": 3}
    assets, at = glass_street(tmp_path), street(10)
    plain = measure(sionna(28e9, assets, **settings), at)
    mixed = measure(sionna(28e9, assets, **settings, **options), at)
    without, with_options = reflections(plain), reflections(mixed)
    assert len(without) > 60
    assert without.keys() <= with_options.keys()
    largest = np.abs(plain.a).max()
    assert max(np.abs(a - with_options[key]).max() for key, a in without.items()) < 1e-4 * largest
    assert len(set(keys(mixed))) == len(mixed.id)
    assert len(mixed.id) > len(plain.id) + 3


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", ["simple_street_canyon_with_cars", "munich"])
@pytest.mark.parametrize("candidates", ["launched", "enumerated"])
@pytest.mark.parametrize("frequency", [3.5e9, 28e9])
def test_bundled_scenes_lose_no_reflection(name: str, candidates: str, frequency: float) -> None:
    """40 receivers about the transmitter, with traffic."""
    assets = {key: file for key, file in scenery_assets(f"sionna:{name}").items() if isinstance(file, Path)}
    middle = np.array(SCENES[name][0])
    places = middle + np.random.default_rng(4).uniform((-40, -40, -26), (40, 40, -8), (40, 3))
    places[:, 2] = np.maximum(places[:, 2], 1.5)
    devices = [antenna(f"r{i}", "rx", place) for i, place in enumerate(places)]
    at = scene([antenna("t", "tx", middle), *devices], things(4, name))
    settings = {"candidates": candidates, "max_depth": 3, "samples": 100_000, "bodies": 12}
    plain = measure(sionna(frequency, assets, **settings), at)
    mixed = measure(sionna(frequency, assets, **settings, refraction=True), at)
    without, with_refraction = reflections(plain), reflections(mixed)
    assert len(without) > 50
    assert without.keys() <= with_refraction.keys()
    assert len(set(keys(mixed))) == len(mixed.id)
