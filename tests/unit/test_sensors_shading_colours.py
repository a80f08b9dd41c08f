"""Colours of things in pictures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from caviar_services.sensors.shading import (
    CLASSES,
    MATERIALS,
    OBJECT_SHADES,
    encoded,
    linear,
    object_colour,
    shape_colour,
)
from caviar_space.mitsuba_xml import SceneryShape


def shape(
    name: str = "wall", material: str = "m", itu: str = "", colour: tuple[float, float, float] | None = None
) -> SceneryShape:
    return SceneryShape(name, Path("wall.ply"), np.eye(4), material, itu, colour)


def test_srgb_there_and_back_again() -> None:
    """All 256 values of each channel, through linear light."""
    values = np.arange(256)
    there = np.array([linear((v / 255, v / 255, v / 255)) for v in values]).T
    np.testing.assert_array_equal(encoded(there.astype(np.float32)), np.stack([values] * 3))


def test_what_is_too_bright_is_white_and_below_zero_black() -> None:
    assert encoded(np.array([[7.0], [-1.0]], dtype=np.float32)).ravel().tolist() == [255, 0]


def test_a_chosen_colour_comes_first_then_the_scenerys_then_the_materials() -> None:
    painted = shape(itu="marble", colour=(0.1, 0.2, 0.3))
    np.testing.assert_allclose(shape_colour(painted, {"marble": (1.0, 0.0, 0.0)}), [1, 0, 0])
    np.testing.assert_allclose(shape_colour(painted, {"m": (0.0, 1.0, 0.0)}), [0, 1, 0])
    np.testing.assert_allclose(shape_colour(painted, {}), [0.1, 0.2, 0.3])
    np.testing.assert_allclose(shape_colour(shape(itu="marble"), {}), linear(MATERIALS["marble"]), rtol=0.25)


def test_the_parts_of_a_building_have_one_shade_and_buildings_differ() -> None:
    def shade(name: str, itu: str) -> float:
        return float(shape_colour(shape(f"{name}-itu_{itu}", itu=itu), {})[1] / linear(MATERIALS[itu])[1])

    assert shade("hall", "brick") == pytest.approx(shade("hall", "metal"))
    assert len({round(shade(f"house{i}", "brick"), 3) for i in range(20)}) > 15


@pytest.mark.parametrize("kind", [*CLASSES, "tram"])
def test_objects_of_a_class_are_shades_of_its_colour(kind: str) -> None:
    colours = np.array([object_colour(kind, f"{kind}.{i}", {}) for i in range(50)])
    base = colours.mean(axis=0)
    assert (np.abs(colours / base - 1) < 1.5 * OBJECT_SHADES).all()
    assert ((colours >= 0) & (colours <= 1)).all()
    np.testing.assert_array_equal(object_colour(kind, "a", {}), object_colour(kind, "a", {}))


def test_classes_can_be_told_apart() -> None:
    """Between the mean colours of any two classes lies more than a tenth in some channel."""
    colours = np.array([linear(colour) for colour in CLASSES.values()])
    apart = np.abs(colours[:, None] - colours[None]).max(axis=2)
    assert (apart[~np.eye(len(colours), dtype=bool)] > 0.1).all()
