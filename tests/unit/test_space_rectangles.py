"""Rectangles around plane faces, and which faces can be met from behind."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_protocol.arrays import Float64Array
from caviar_services.channel.enumeration.image_beams import Targets
from caviar_space.meshes import Mesh, unit_box
from caviar_space.planes import plane_numbers, two_sided_planes
from caviar_space.rectangles import RIM, FaceRectangles, narrowest_sides
from caviar_space.vectors import ranges

L_SHAPE = np.array(
    [[0, 0], [4, 0], [4, 1], [0, 0], [4, 1], [0, 1], [0, 1], [1, 1], [1, 3], [0, 1], [1, 3], [0, 3]]
)
"""Corners of the four triangles of an L, in its plane [m]."""


def tilted(flat: Float64Array, seed: int) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Points of a plane that lies anyhow: a turned frame, where it stands, and the points [m]."""
    rng = np.random.default_rng(seed)
    frame, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    frame[2] = np.cross(frame[0], frame[1])
    origin = rng.uniform(-100, 100, 3)
    return frame, origin, origin + flat @ frame[:2]


def faces(seed: int = 1) -> tuple[FaceRectangles, Float64Array, Float64Array]:
    """A small triangle and the L, with frame and place of the L."""
    frame, origin, corners = tilted(L_SHAPE.astype(float), seed)
    small = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]])
    triangles, sizes = np.concatenate([small, corners.reshape(-1, 3, 3)]), np.array([1, 4])
    made = FaceRectangles.of(
        np.array([3, 7]),
        triangles,
        sizes,
        narrowest_sides(triangles, sizes),
        np.array([[0.0, 0, 1], frame[2]]),
        np.array([False, True]),
    )
    return made, frame, origin


def test_a_rectangle_is_as_small_as_its_triangles_are() -> None:
    """Along a side of the L, not along the diagonal that its two largest triangles share."""
    made, frame, origin = faces()
    assert np.allclose(np.sort(made.half[1]), [1.5, 2.0])
    assert np.allclose(made.centre[1], origin + np.array([2.0, 1.5]) @ frame[:2])
    assert np.allclose(made.radius[1], 2.5)


def test_points_are_held_by_triangles_and_not_by_the_rectangle_around_them() -> None:
    """With a rim beyond the border, and none between two triangles: waves there and back along the normal."""
    pytest.importorskip("numba")
    made, frame, origin = faces()
    flat = np.array(
        [
            [0.5, 2.9],
            [3.9, 0.5],
            [2.0, 0.5],
            [3.0, 2.0],
            [1.0 + RIM / 2, 2.0],
            [1.0 + 3 * RIM, 2.0],
            [4.1, 0.5],
        ]
    )
    points = origin + flat @ frame[:2]
    targets = Targets(made, np.zeros(0, np.int64), np.zeros((0, 2), np.int64))
    ends = points + 2.5 * frame[2]
    met, held = targets.reflections(np.ones((len(flat), 1), np.int64), ends, ends)
    assert held.tolist() == [True, True, True, False, True, False, False]
    assert np.allclose(met[held, 0], points[held])


def test_images_are_as_far_behind_as_points_are_in_front() -> None:
    made, frame, origin = faces()
    point = origin + np.array([0.3, 0.4, 2.5]) @ frame
    which = np.array([1])
    assert np.allclose(made.height(point[None], which), 2.5)
    assert np.allclose(made.mirrored(point[None], which), origin + np.array([0.3, 0.4, -2.5]) @ frame)


def test_faces_that_are_taken_keep_their_triangles() -> None:
    made, _, _ = faces()
    other = FaceRectangles.joined([made.take(np.array([1])), made.take(np.array([0]))])
    assert other.plane.tolist() == [7, 3]
    assert other.sizes.tolist() == [4, 1]
    assert np.array_equal(other.triangles, np.concatenate([made.triangles[1:], made.triangles[:1]]))


def test_ranges_follow_one_another() -> None:
    own, numbers = ranges(np.array([5, 0, 9]), np.array([2, 0, 3]))
    assert own.tolist() == [0, 0, 2, 2, 2]
    assert numbers.tolist() == [5, 6, 9, 10, 11]


class TestSides:
    def test_a_closed_surface_is_met_from_outside(self) -> None:
        box = unit_box()
        assert not two_sided_planes(box, plane_numbers(box)).any()

    def test_an_open_one_from_both_sides(self) -> None:
        box = unit_box()
        lid_off = Mesh(box.vertices, box.faces[2:])
        assert two_sided_planes(lid_off, plane_numbers(lid_off)).all()

    def test_one_whose_normals_lead_inwards_too(self) -> None:
        box = unit_box()
        inverted = Mesh(box.vertices, box.faces[:, ::-1].copy())
        assert two_sided_planes(inverted, plane_numbers(inverted)).all()

    def test_corners_at_one_place_close_it(self) -> None:
        """Each triangle with vertices of its own, as in many files."""
        box = unit_box()
        apart = Mesh(box.vertices[box.faces].reshape(-1, 3), np.arange(36, dtype=np.int32).reshape(-1, 3))
        assert not two_sided_planes(apart, plane_numbers(apart)).any()

    def test_parts_of_a_plane_that_face_each_others_back_are_met_from_both_sides(self) -> None:
        """Two boxes, one on the other: the bottom of the upper is in the plane of the lower's top."""
        low, high = unit_box(), unit_box()
        two = Mesh(
            np.concatenate([low.vertices, high.vertices * [0.5, 0.5, 1.0] + [0, 0, 1.0]]),
            np.concatenate([low.faces, high.faces + 8]).astype(np.int32),
        )
        numbers = plane_numbers(two)
        between = numbers[np.isclose(two.vertices[two.faces][:, :, 2], 0.5).all(1)]
        assert len(set(between.tolist())) == 1
        assert np.flatnonzero(two_sided_planes(two, numbers)).tolist() == [int(between[0])]
