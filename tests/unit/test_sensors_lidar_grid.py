"""The quantised grid, against cases worked out by hand."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from caviar_protocol.arrays import Float32Array, Float64Array
from caviar_protocol.topics import AntennaDevice, LidarDevice, Scene
from caviar_services.sensors.lidar import GridSettings, antenna_positions, occupancy, quantised

ROSSLYN = GridSettings(
    minimum_m=(744.0, 429.0, 0.0), maximum_m=(767.0, 679.0, 10.0), cells=(20, 200, 10), tx="bs", rx="me"
)
"""The grid of the beam-selection challenge: steps of 1.15, 1.25 and 1 m."""


def cloud(*points: tuple[float, float, float]) -> Float32Array:
    return np.array(points, dtype=np.float32).reshape(-1, 3)


def ranges(*values: float) -> Float32Array:
    return np.array(values, dtype=np.float32)


def test_the_challenge_grid_has_its_steps() -> None:
    assert ROSSLYN.shape == (20, 200, 10)
    assert ROSSLYN.cell == pytest.approx((1.15, 1.25, 1.0), abs=1e-12)


@pytest.mark.parametrize(
    ("point", "index"),
    [
        ((744.0, 429.0, 0.0), (0, 0, 0)),
        ((744.57, 429.62, 0.49), (0, 0, 0)),  # below half a step
        ((744.58, 429.63, 0.51), (1, 1, 1)),  # above half a step
        ((746.0, 560.0, 4.0), (2, 105, 4)),  # the challenge's transmitter: 1.74, 104.8, 4
        ((767.0, 679.0, 10.0), (19, 199, 9)),  # 20, 200, 10, clipped
        ((700.0, 900.0, -5.0), (0, 199, 0)),
        ((744.0, 429.0, 2.5), (0, 0, 2)),  # half to even
    ],
)
def test_a_point_goes_to_the_nearest_index(
    point: tuple[float, float, float], index: tuple[int, int, int]
) -> None:
    assert tuple(quantised(np.array([point]), ROSSLYN)[0]) == index


def test_obstacles_transmitters_and_receivers_are_marked() -> None:
    """Receivers stand over transmitters over obstacles; nothing else is marked."""
    points = cloud((745.15, 430.25, 1.0), (745.15, 430.25, 1.1), (746.3, 560.25, 4.0), (748.6, 429.0, 3.0))
    grid = occupancy(
        points,
        ranges(5, 5, 10, 20),
        [(746.0, 560.0, 4.0), (748.6, 429.0, 3.0)],
        [(748.6, 429.0, 3.0)],
        ROSSLYN,
    )
    marked = {tuple(cell): int(grid.occupancy[tuple(cell)]) for cell in np.argwhere(grid.occupancy).tolist()}
    assert marked == {(1, 1, 1): 1, (2, 105, 4): -1, (4, 0, 3): -2}
    assert grid.origin == (744.0, 429.0, 0.0)


def test_low_and_far_points_are_dropped() -> None:
    """At 0.2 m height and at 100 m range a point is dropped, above and nearer it is kept."""
    low, high = np.float32(0.2), np.nextafter(np.float32(0.2), np.float32(1))
    points = np.array(
        [[744, 429, low], [745.15, 429, high], [746.3, 429, 3], [747.45, 429, 3]], dtype=np.float32
    )
    settings = msgspec.structs.replace(ROSSLYN, min_height_m=float(low))
    distance = ranges(10, 10, 100, float(np.nextafter(np.float32(100), np.float32(0))))
    grid = occupancy(points, distance, [], [], settings)
    assert np.argwhere(grid.occupancy).tolist() == [[1, 0, 0], [3, 0, 3]]


def test_an_empty_scan_gives_an_empty_grid() -> None:
    grid = occupancy(cloud(), ranges(), [], [], ROSSLYN)
    assert grid.occupancy.shape == (20, 200, 10)
    assert not grid.occupancy.any()


def test_cells_are_counted_from_their_size() -> None:
    """250 m of 1.25 m are 200 cells; what is left over takes one more."""
    settings = GridSettings(minimum_m=(0, 0, 0), maximum_m=(250, 10, 1), cell_m=(1.25, 3, 2))
    assert settings.shape == (200, 4, 1)
    assert settings.cell == (1.25, 3, 2)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"cells": None}, "either cells or cell_m"),
        ({"cell_m": (1, 1, 1)}, "either cells or cell_m"),
        ({"cells": (1, 0, 1)}, "greater than 0"),
        ({"maximum_m": (1, 1, 0)}, "greater than 0"),
        ({"cells": (1000, 1000, 1000)}, "more than"),
        ({"orign_m": (0, 0, 0)}, "orign_m"),
    ],
)
def test_a_wrong_grid_is_refused(change: dict[str, Any], word: str) -> None:
    told = {"minimum_m": (0, 0, 0), "maximum_m": (1, 1, 1), "cells": (2, 2, 2)} | change
    with pytest.raises(msgspec.ValidationError, match=word):
        msgspec.convert({key: value for key, value in told.items() if value is not None}, GridSettings)


def antenna_scene() -> Scene:
    def rows(*values: tuple[float, ...]) -> Float64Array:
        return np.array(values, dtype=np.float64)

    return Scene(
        names=("car1", "car2"),
        classes=("car", "car"),
        assets=("", ""),
        position=rows((10, 0, 1), (20, 5, 1)),
        orientation=rows((1, 0, 0, 0), (0, 0, 0, 1)),  # car2 is turned by half a turn
        velocity=rows((0, 0, 0), (0, 0, 0)),
        dimensions=rows((4, 2, 1.5), (4, 2, 1.5)),
        devices=(
            AntennaDevice(name="bs", role="tx", position=(0.0, 0.0, 8.0)),
            AntennaDevice(name="car1/ue", parent="car1", role="rx", position=(1.0, 0.0, 1.0)),
            AntennaDevice(name="car2/ue", parent="car2", role="both", position=(1.0, 0.5, 1.0)),
            LidarDevice(name="car2/lidar", parent="car2", position=(0.0, 0.0, 1.0)),
            LidarDevice(name="fixed", position=(0.0, 0.0, 3.0)),
        ),
    )


def test_by_default_the_receiver_is_the_one_on_the_sensors_carrier() -> None:
    """At its place on the turned carrier; as a receiver it is not marked as a transmitter too."""
    scene = antenna_scene()
    settings = msgspec.structs.replace(ROSSLYN, tx="*", rx="")
    tx, rx = antenna_positions(scene, scene.devices[3], settings)  # type: ignore[arg-type]
    assert tx == [(0.0, 0.0, 8.0)]
    np.testing.assert_allclose(rx, [(19.0, 4.5, 2.0)])


def test_a_fixed_sensor_has_no_receiver_of_its_own() -> None:
    scene = antenna_scene()
    _, rx = antenna_positions(scene, scene.devices[4], msgspec.structs.replace(ROSSLYN, rx=""))  # type: ignore[arg-type]
    assert rx == []


def test_patterns_choose_the_antennas() -> None:
    scene = antenna_scene()
    settings = msgspec.structs.replace(ROSSLYN, tx="nobody", rx="car?/ue")
    tx, rx = antenna_positions(scene, scene.devices[4], settings)  # type: ignore[arg-type]
    assert tx == []
    np.testing.assert_allclose(rx, [(11.0, 0.0, 2.0), (19.0, 4.5, 2.0)])
