"""Faces of bodies that are flush with each other or with scenery reflect as one wall does, with one id."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_labs.stability.formulas import C, mirrored
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
from caviar_protocol.topics import Channel
from caviar_services.channel.base import ChannelModel

F = 28e9
TX, RX = np.array([-7.0, -9.0, 2.0]), np.array([6.0, -7.0, 1.5])
FLUSH = 1.0
"""[m] y of the faces that are flush; the point of reflection is at x = 0.22."""

MODES = ("enumerated", "launched")


@pytest.fixture(scope="module", params=MODES)
def model(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ChannelModel[Any]:
    """A channel between bodies alone, and one wall far behind them."""
    folder = tmp_path_factory.mktemp("wall")
    wall = Plate("wall", [(-30, FLUSH, 0), (-5, FLUSH, 0), (-5, FLUSH, 6), (-30, FLUSH, 6)], "metal")
    return sionna(F, write_scenery(folder, [wall]), candidates=request.param, bodies=3, max_depth=2)


def box(name: str, x: tuple[float, float], flush: float = FLUSH, depth: float = 2.5) -> Thing:
    """A body from one x to another, its front at y = ``flush``."""
    return Thing(name, ((x[0] + x[1]) / 2, flush + depth / 2, 1.5), (x[1] - x[0], depth, 3.0))


def reflections(model: ChannelModel[Any], things: Sequence[Thing], tx: Array = TX, rx: Array = RX) -> Channel:
    return measure(model, scene([antenna("t", "tx", tx), antenna("r", "rx", rx)], things))


def assert_one_surface(frames: Sequence[Channel], tx: Array = TX, rx: Array = RX) -> None:
    """One reflection in each frame, of the length of its image, and always the same."""
    length = np.linalg.norm(mirrored(tx, np.array([0, FLUSH, 0]), np.array([0.0, 1.0, 0.0])) - rx)
    ids = set()
    for channel in frames:
        (path,) = np.flatnonzero((channel.interactions != 0).any(1))
        assert channel.tau[path] * C == pytest.approx(length, abs=1e-4)
        assert abs(channel.a[0, path]) == pytest.approx(C / F / (4 * np.pi * length), rel=2e-2)
        ids.add(int(channel.id[path]))
    assert len(ids) == 1


@pytest.mark.parametrize("overlap", [0.0, 1.5])
def test_flush_boxes_that_pass_the_point_of_reflection_are_one_surface(
    model: ChannelModel[Any], overlap: float
) -> None:
    along = [*np.arange(0.17, 0.27, 0.01), *np.arange(0.216, 0.225, 0.001)]
    frames = []
    for seam in along:
        pair = [box("a", (seam - 3.0, seam + overlap / 2)), box("b", (seam - overlap / 2, seam + 4.0))]
        frames.append(reflections(model, pair))
    assert_one_surface(frames)


def test_a_box_that_slides_along_another_keeps_their_surface(model: ChannelModel[Any]) -> None:
    still = box("b", (-0.5, 3.0))
    slid = [box("a", (end - 2.5, end)) for end in np.arange(-0.45, 1.5, 0.25)]
    assert_one_surface([reflections(model, [still, one]) for one in slid])


def test_a_box_flush_at_a_wall_is_one_surface_with_it(model: ChannelModel[Any]) -> None:
    """From points of the wall to points of the box, as the receiver goes along."""
    kiosk = box("kiosk", (-5.0, -2.0))
    ids = set()
    for x in np.arange(-4.0, 3.0, 0.5):
        rx = np.array([x, -9.0, 1.5])
        channel = reflections(model, [kiosk], rx=rx)
        assert_one_surface([channel], rx=rx)
        ids |= set(channel.id[(channel.interactions != 0).any(1)].tolist())
    assert len(ids) == 1


def test_of_faces_that_are_not_quite_flush_the_front_one_reflects(model: ChannelModel[Any]) -> None:
    still = box("b", (-3.0, 3.0))
    for ahead in (-3e-3, -1e-3, -5e-4, -1e-4, 1e-4, 5e-4, 1e-3, 3e-3):
        channel = reflections(model, [still, box("a", (-2.0, 2.0), FLUSH - ahead)])
        front = np.array([0, FLUSH - max(ahead, 0.0), 0])
        length = np.linalg.norm(mirrored(TX, front, np.array([0.0, 1.0, 0.0])) - RX)
        (path,) = np.flatnonzero((channel.interactions != 0).any(1))
        assert channel.tau[path] * C == pytest.approx(length, abs=1e-8)


def test_flush_boxes_that_are_apart_are_two_surfaces(model: ChannelModel[Any]) -> None:
    apart = [box("a", (-4.0, -0.5)), box("b", (-0.4, 4.0))]
    ids = []
    for rx in (RX, RX + np.array([-4.0, 0.0, 0.0])):
        channel = reflections(model, apart, rx=rx)
        ids += channel.id[(channel.interactions != 0).any(1)].tolist()
    assert len(set(ids)) == 2


def test_the_id_of_a_surface_does_not_depend_on_which_body_stands_for_what(
    model: ChannelModel[Any], tmp_path: Path
) -> None:
    """Names count: with another body before it in the pool, the same surface keeps its id."""
    pair = [box("m", (-4.0, 0.0)), box("n", (0.0, 4.0))]
    far = Thing("a", (0.0, 60.0, 1.0))
    assert_one_surface([reflections(model, pair), reflections(model, [*pair, far])])
