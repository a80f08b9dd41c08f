"""Antennas at surfaces and near pairs: where they are traced from, and what stands between."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_protocol.topics import AntennaArray
from caviar_services.channel.paths import Antenna, PathTable, spread_anew, with_near_pairs
from caviar_space.meshes import box
from caviar_space.obstacles import CLEARANCE, Surfaces

BOX = box((0.0, 2.0), (0.0, 3.0), (0.0, 1.0))
TRIANGLES = BOX.vertices[BOX.faces]


def surfaces(outwards: bool = True) -> Surfaces:
    return Surfaces(TRIANGLES, lambda triangle, normal: outwards)


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        ((0.7, 1.9, 1.0), (0.7, 1.9, 1.0 + CLEARANCE)),
        ((0.7, 1.9, 1.004), (0.7, 1.9, 1.0 + CLEARANCE)),
        ((0.7, 1.9, 0.996), (0.7, 1.9, 1.0 - CLEARANCE)),
        ((0.7, 1.9, 1.5), (0.7, 1.9, 1.5)),
        ((-0.001, 1.9, 0.4), (-CLEARANCE, 1.9, 0.4)),
        ((0.7, 3.5, 1.0), (0.7, 3.5, 1.0)),
    ],
    ids=[
        "on the roof",
        "above it",
        "below it",
        "clear of it",
        "before a wall",
        "beside it, level with the roof",
    ],
)
def test_an_antenna_is_traced_from_off_the_surface_on_its_own_side(
    position: tuple[float, ...], expected: tuple[float, ...]
) -> None:
    assert surfaces().cleared(np.array(position)) == pytest.approx(expected, abs=1e-12)


def test_exactly_on_a_surface_it_is_outside() -> None:
    """Whatever the order of the triangle's corners."""
    assert surfaces(outwards=False).cleared(np.array([0.7, 1.9, 1.0]))[2] == pytest.approx(1 - CLEARANCE)


def test_in_a_corner_it_is_clear_of_both_faces() -> None:
    """Inside of the box, on the floor at a wall; at an edge from outside, clear of one is clear of all."""
    inside = surfaces().cleared(np.array([1.999, 1.5, 0.001]))
    assert inside == pytest.approx([2 - CLEARANCE, 1.5, CLEARANCE], abs=1e-12)
    edge = surfaces().cleared(np.array([2.0, 1.5, 1.0]))
    assert np.abs(edge - [2.0, 1.5, 1.0]).max() == pytest.approx(CLEARANCE)


def test_triangles_that_moved_are_where_they_are() -> None:
    moved = surfaces()
    moved.move(np.arange(len(TRIANGLES)), TRIANGLES + np.array([0.0, 0.0, 5.0]))
    assert moved.cleared(np.array([0.7, 1.9, 1.0])).tolist() == [0.7, 1.9, 1.0]
    assert moved.cleared(np.array([0.7, 1.9, 6.0]))[2] == pytest.approx(6 + CLEARANCE)


def test_triangles_without_area_hide_nothing_and_push_nobody() -> None:
    flat = np.array([[[0.0, 0, 0], [0, 0, 0], [0, 0, 0]], [[0, 0, 0], [1, 0, 0], [2, 0, 0]]])
    points = Surfaces(flat, lambda triangle, normal: True)
    assert points.cleared(np.array([0.5, 0.0, 0.0])).tolist() == [0.5, 0.0, 0.0]
    assert not points.between(np.array([0.5, -1, 0]), np.array([0.5, 1, 0]))


def test_what_stands_between_two_points() -> None:
    above, below, beside = np.array([0.5, 1.5, 1.01]), np.array([0.6, 1.4, 0.99]), np.array([0.5, 3.5, 1.01])
    assert surfaces().between(above, below)
    assert surfaces().between(below, above)
    assert not surfaces().between(above, beside)
    assert not surfaces().between(above, np.array([0.9, 1.5, 1.01]))  # along the roof


def antenna(name: str, x: float, z: float) -> Antenna:
    return Antenna(name, AntennaArray(), np.array([x, 1.5, z]), np.eye(3), np.zeros(3))


def test_near_pairs_have_their_line_of_sight_by_formula() -> None:
    """Of three receivers one is 3 cm away, one nearer than a wavelength of 1 cm, one below the roof."""
    pair = np.array([0, 1, 1, 3])
    types = np.array([[0], [0], [1], [0]], np.uint8)
    table = PathTable(
        pair=pair,
        transfer=np.full((2, 4, 3, 3), 7.0 + 0j),
        types=types,
        objects=np.zeros((4, 1), np.int32),
        points=np.zeros((4, 1, 3)),
        object_names=("roof",),
        object_velocity=np.zeros((1, 3)),
    )
    tx = antenna("t", 1.0, 1.01)
    receivers = [
        antenna("a", 1.03, 1.01),
        antenna("b", 1.002, 1.01),
        antenna("c", 1.0, 0.99),
        antenna("d", 9, 3),
    ]
    los = np.array([False, False, True, True])
    wavelengths = np.array([0.01, 0.005])
    found, too_close = with_near_pairs(table, los, [tx], receivers, wavelengths, surfaces())
    assert los.tolist() == [True, True, False, True]
    assert too_close == 1
    assert found.pair.tolist() == [1, 3, 0]  # the reflection of b, the far pair, and the new path of a
    assert found.types[:, 0].tolist() == [1, 0, 0]
    assert found.transfer[:, 2] == pytest.approx(
        np.eye(3) * (wavelengths / (4 * np.pi * 0.03))[:, None, None]
    )
    assert found.objects[2].tolist() == [-1]


def test_elements_that_see_each_other_past_the_centres_keep_their_straight_path() -> None:
    """Two pairs 4 cm apart with a wall of the box in between: what only elements beside the centres have is
    still theirs, by formula and hidden; the pair without such elements has nothing."""
    tx, receivers = antenna("t", -0.02, 0.5), [antenna(name, 0.02, 0.5) for name in "ab"]
    table = PathTable(
        pair=np.array([0]),
        transfer=np.ones((1, 1, 3, 3), np.complex128),
        types=np.zeros((1, 1), np.uint8),
        objects=np.full((1, 1), -1, np.int32),
        points=np.zeros((1, 1, 3)),
        hidden=np.array([True]),
        traced=np.array([7]),
        object_names=(),
        object_velocity=np.zeros((0, 3)),
    )
    los = np.zeros(2, bool)
    found, _ = with_near_pairs(table, los, [tx], receivers, np.array([0.01]), surfaces())
    assert not los.any()
    assert found.pair.tolist() == [0]
    assert found.hidden is not None
    assert found.hidden.tolist() == [True]
    assert found.traced is not None
    assert found.traced.tolist() == [-1]
    assert found.transfer[0, 0] == pytest.approx(np.eye(3) * 0.01 / (4 * np.pi * 0.04))


def test_a_device_and_itself_are_no_pair() -> None:
    both = antenna("t", 1.0, 5.0)
    empty = PathTable(
        pair=np.zeros(0, np.int64),
        transfer=np.zeros((1, 0, 3, 3), np.complex128),
        types=np.zeros((0, 1), np.uint8),
        objects=np.zeros((0, 1), np.int32),
        points=np.zeros((0, 1, 3)),
        object_names=(),
        object_velocity=np.zeros((0, 3)),
    )
    los = np.array([False])
    found, too_close = with_near_pairs(empty, los, [both], [both], np.array([0.1]), surfaces())
    assert (len(found.pair), too_close, los.tolist()) == (0, 0, [False])


def test_the_field_of_specular_paths_follows_their_length() -> None:
    specular = np.array([True, True, False])
    scaled = spread_anew(
        np.ones((2, 3, 3, 3), np.complex128), specular, np.array([2.0, 5, 5]), np.array([4.0, 0, 4])
    )
    assert scaled[:, :, 0, 0].real.tolist() == [[0.5, 1.0, 1.0]] * 2
