"""A path keeps its name while ends and bodies move, and says when it is born and when it dies."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from same_paths import SCENES, model

from caviar_labs.stability.formulas import C
from caviar_labs.stability.lab import (
    Plate,
    Thing,
    antenna,
    frame_of,
    measure,
    scene,
    sionna,
    write_scenery,
)
from caviar_protocol.multipath import changes
from caviar_protocol.topics import Channel, Scene

pytestmark = pytest.mark.channel

CANYON = "simple_street_canyon_with_cars"


def drive(frame: int) -> Scene:
    """A receiver and two lorries that drive through the street, 0.4 m and 0.6 m a frame."""
    tx = antenna("t", "tx", SCENES[CANYON][0])
    rx = antenna("r", "rx", (-12.0 + 0.4 * frame, 1.5, 1.8))
    lorries = [
        Thing("a", (6.0 - 0.6 * frame, -2.5, 1.9), (9.0, 2.5, 3.8)),
        Thing("b", (-25.0 + 0.6 * frame, 4.5, 1.9), (9.0, 2.5, 3.8)),
    ]
    return scene([tx, rx], lorries)


def faces(channel: Channel) -> dict[int, tuple[object, ...]]:
    """Types and objects of each path, by id."""
    names = np.array([*channel.object_names, ""])
    return {
        int(number): (*types, *objects)
        for number, types, objects in zip(
            channel.id,
            channel.interactions.tolist(),
            names[channel.objects].tolist(),
            strict=True,
        )
    }


def test_ids_follow_paths_through_a_drive() -> None:
    """Over 30 frames a path with the same id is the same path: same interactions with the same objects, and a
    length that changes by no more than the ends and the mirrors moved. Most paths live on from each
    frame to the next, some come and go, and the counts of the service are those of the products."""
    street = model(CANYON, max_depth=3, samples=30_000)
    before = measure(street, drive(0))
    lived, born = 0, 0
    for frame in range(1, 30):
        after = measure(street, drive(frame))
        turnover = changes(before, after)
        assert len(set(after.id.tolist())) == len(after.id)
        mine, place_before, place_after = np.intersect1d(before.id, after.id, return_indices=True)
        moved = np.abs(after.tau[place_after] - before.tau[place_before]) * C
        assert (moved <= 0.4 + 3 * 2 * 0.6).all()
        old, new = faces(before), faces(after)
        assert all(strip(old[int(number)]) == strip(new[int(number)]) for number in mine)
        lived += len(mine)
        born += turnover.births
        before = after
    assert born > 0
    assert lived > 10 * born


def strip(what: tuple[object, ...]) -> tuple[object, ...]:
    """Without the fillers past the last interaction."""
    return tuple(part for part in what if part not in (0, ""))


def test_both_walls_of_one_object_have_ids_of_their_own(tmp_path: Path) -> None:
    """Between two walls of one object, the reflection by the near one changes place with that by the far one
    in the order of delays, as the receiver crosses the middle: the ids do not."""
    near, far = ([(-50, y, 0), (50, y, 0), (50, y, 9), (-50, y, 9)] for y in (-6, 6))
    both = Plate("walls", [*near, *far], faces=[(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)])
    assets = write_scenery(tmp_path, [both])
    channel = sionna(28e9, assets, max_depth=1)

    def sides(y: float) -> dict[str, int]:
        got = measure(channel, scene([antenna("t", "tx", (0, 0.5, 4)), antenna("r", "rx", (20, y, 3))]))
        reflected = got.interactions[:, 0] == 1
        return {
            "right" if point[0, 1] < 0 else "left": int(number)
            for point, number in zip(got.points[reflected], got.id[reflected], strict=True)
        }

    assert len(set(sides(-3.0).values())) == 2
    assert sides(-3.0) == sides(3.0)


def test_the_service_counts_births_and_deaths(tmp_path: Path) -> None:
    """A wall that drives away takes its reflection along; the first frame, and one after a gap, say
    nothing."""
    assets = write_scenery(
        tmp_path, [Plate("ground", [(-90, -90, 0), (90, -90, 0), (90, 90, 0), (-90, 90, 0)])]
    )
    channel = sionna(28e9, assets, max_depth=1)
    ends = [antenna("t", "tx", (0, 0, 4)), antenna("r", "rx", (20, 0, 3))]
    wall = Thing("wall", (10, 5, 3.5), (40, 0.5, 6.0))

    def counts(number: int, things: list[Thing]) -> dict[str, int]:
        result = channel.step(frame_of(scene(ends, things), number))
        return {name: value for name, value in result.counts.items() if name in ("births", "deaths")}

    assert counts(0, [wall]) == {}
    assert counts(1, [wall]) == {"births": 0, "deaths": 0}
    assert counts(2, []) == {"births": 0, "deaths": 1}
    assert counts(3, [wall]) == {"births": 1, "deaths": 0}
    assert counts(5, []) == {}
