"""Edges that diffract: borders of meshes, free edges, their ids, and the boundaries of light and shadow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_labs.stability.formulas import C
from caviar_labs.stability.lab import (
    Array,
    Plate,
    Thing,
    antenna,
    measure,
    pair_sums,
    scene,
    sionna,
    write_scenery,
)
from caviar_labs.stability.waves import around
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.topics import Channel, Interaction
from caviar_services.channel.base import ChannelModel

pytestmark = pytest.mark.channel

DIFFRACTED = int(Interaction.DIFFRACTION)
F = 28e9
STATION = (8.0, 5.0, 3.0)
"""Sees one wall of the corner; its light ends behind the edge x = y = 0."""

ONE = [(0, 0, 0), (0, 40, 0), (0, 40, 9), (0, 0, 9)]
OTHER = [(0, 0, 0), (-40, 0, 0), (-40, 0, 9), (0, 0, 9)]
GROUND = Plate("ground", [(-60, -60, 0), (60, -60, 0), (60, 60, 0), (-60, 60, 0)])


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """A cache that no other test has."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))


def corner(folder: Path, *plates: Plate, **settings: Any) -> ChannelModel[Any]:
    given = {"diffraction": True, "max_depth": 2, "samples": 50_000, "samples_per_frame": 50_000, "bodies": 1}
    given["receivers_at_once"] = None
    return sionna(F, write_scenery(folder, plates), **{**given, **settings})


def along(model: ChannelModel[Any], places: Array, things: list[Thing] | None = None) -> Channel:
    """The channels to receivers at these places, in their order."""
    devices = [antenna(f"r{i:05d}", "rx", place) for i, place in enumerate(places)]
    return measure(model, scene([antenna("t", "tx", STATION), *devices], things or []))


def test_a_corner_is_the_same_where_one_mesh_divides_the_border_and_the_other_does_not(
    tmp_path: Path,
) -> None:
    """Of two walls that are meshes of their own, one is halved: H is equal to 0.01 dB at 24 places, of which
    some have nothing but what the edge brings."""
    heights = (0.0, 4.5)
    halved = [
        Plate(f"half{i}", [(0, 0, z), (-40, 0, z), (-40, 0, z + 4.5), (0, 0, z + 4.5)])
        for i, z in enumerate(heights)
    ]
    levels, shadow = [], 0
    for number, other in enumerate(([Plate("other", OTHER)], halved)):
        channel = along(corner(tmp_path / str(number), Plate("one", ONE), *other), around(24))
        levels.append(20 * np.log10(np.abs(pair_sums(channel))))
        over = (channel.interactions == DIFFRACTED).any(1)
        shadow += sum(paths.all() for paths in np.split(over, channel.offsets[1:-1]))
    assert shadow >= 6
    assert np.abs(levels[1] - levels[0]).max() < 0.01


def test_enumerated_paths_are_continuous_in_steps_of_a_micrometre(tmp_path: Path) -> None:
    """As launched ones are (`measure stability`): across the line at which light ends, and that at which a
    wall's reflection ends, H changes by less than 3 % of free space from step to step; light ends once."""
    model = corner(tmp_path, Plate("one", ONE), Plate("other", OTHER), candidates="enumerated")
    steps = (np.arange(-60, 60) + 0.3) * 1e-6
    for image in (np.array(STATION[:2]), np.array([-STATION[0], STATION[1]])):
        onward = -image / np.linalg.norm(image)
        ground = onward * 10 + steps[:, None] * np.array([-onward[1], onward[0]])
        channel = along(model, np.column_stack([ground, np.full(len(steps), 2.0)]))
        free = C / F / (4 * np.pi * np.linalg.norm([*ground[0], 2.0] - np.array(STATION)))
        assert np.abs(np.diff(pair_sums(channel))).max() < 0.03 * free
        assert np.count_nonzero(np.diff(channel.los[0].astype(int))) == (image[0] > 0)


def walk(folder: Path, steps: int, frames: int, candidates: str) -> tuple[int, int]:
    """Steps of a path about a corner and a car, in so many frames: how many paths that are diffracted live
    on from step to step, and how many of these are another path under the same id."""
    plates = GROUND, Plate("one", ONE), Plate("other", OTHER)
    model = corner(folder, *plates, candidates=candidates)
    car = Thing("car", (3.0, -3.5, 0.76), quaternion=quaternion_from_euler(0.4))
    lived = swapped = 0
    last: dict[int, Array] = {}
    for places in np.array_split(around(steps), frames):
        channel = along(model, places, [car])
        for begin, end in zip(channel.offsets[:-1], channel.offsets[1:], strict=True):
            rows = np.arange(begin, end)[(channel.interactions[begin:end] == DIFFRACTED).any(1)]
            now = {int(channel.id[row]): channel.points[row] for row in rows}
            assert len(now) == len(rows)
            lived += len(last.keys() & now.keys())
            swapped += sum(np.abs(last[key] - now[key]).max() > 0.3 for key in last.keys() & now.keys())
            last = now
    return lived, swapped


@pytest.mark.exhaustive
@pytest.mark.parametrize("candidates", ["launched", "enumerated"])
def test_ids_stay_with_their_edges_over_ten_thousand_steps(tmp_path: Path, candidates: str) -> None:
    """From step to step, 4 mm on, no path is suddenly 30 cm away: edges are farther apart than that. The
    long form of a case of `caviar measure stability`."""
    lived, swapped = walk(tmp_path, 10_000, 20, candidates)
    assert lived > 45_000
    assert swapped == 0
