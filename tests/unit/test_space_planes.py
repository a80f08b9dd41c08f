"""Triangles merged into planes: those of an object by number, and those of a row of houses as one."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from caviar_space.meshes import Mesh, box, unit_box
from caviar_space.planes import PlaneTable, plane_numbers, shared_planes

Array = NDArray[np.float64]


def turned(seed: int) -> Array:
    """A random rotation."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else q[:, [1, 0, 2]]


def joined(meshes: list[Mesh]) -> tuple[Array, NDArray[np.int64], NDArray[np.int64], list[int]]:
    """Corners, faces and plane of each triangle of several meshes, and how many planes each has."""
    counts = [len(mesh.vertices) for mesh in meshes]
    before = np.cumsum([0, *counts[:-1]])
    numbers = [plane_numbers(mesh) for mesh in meshes]
    planes = [int(number.max()) + 1 for number in numbers]
    first = np.cumsum([0, *planes[:-1]])
    return (
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + b for mesh, b in zip(meshes, before, strict=True)]).astype(np.int64),
        np.concatenate([n + f for n, f in zip(numbers, first, strict=True)]).astype(np.int64),
        planes,
    )


def test_a_box_has_six_planes_in_the_order_of_its_triangles() -> None:
    assert plane_numbers(unit_box()).tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]


@pytest.mark.parametrize("seed", range(5))
def test_numbers_stay_while_a_body_is_stretched_turned_and_rounded_far_out(seed: int) -> None:
    """A box of a vehicle's size, 300 m out, in float32 as files hold it."""
    rng = np.random.default_rng(seed)
    body = unit_box()
    corners = (body.vertices * rng.uniform(1.5, 12.0, 3)) @ turned(seed).T + rng.uniform(-300, 300, 3)
    moved = Mesh(corners.astype(np.float32).astype(np.float64), body.faces)
    extent = np.ptp(moved.vertices, axis=0).max()
    assert extent > 1.5
    assert plane_numbers(Mesh(corners, body.faces)).tolist() == plane_numbers(body).tolist()
    assert plane_numbers(moved).max() >= 5


def test_triangles_of_one_plane_need_not_touch() -> None:
    """Two wings of a façade; a step of 5 cm between them makes two planes."""
    wings = [(0, 0, 0), (4, 0, 0), (4, 0, 3), (9, 0, 0), (13, 0, 0), (13, 0, 3)]
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    flush = Mesh(np.array(wings, np.float64), faces)
    stepped = Mesh(np.array(wings, np.float64) + np.repeat([[0, 0, 0], [0, 0.05, 0]], 3, axis=0), faces)
    assert plane_numbers(flush).tolist() == [0, 0]
    assert plane_numbers(stepped).tolist() == [0, 1]


def test_a_gentle_curve_is_not_one_plane() -> None:
    """Strips of a cylinder, 2° from each to the next, are planes of their own."""
    angle = np.radians(np.arange(10) * 2.0)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(10)], axis=1)
    corners = np.concatenate([ring, ring + np.array([0.0, 0.0, 1.0])])
    faces = [[i, i + 1, i + 11] for i in range(9)] + [[i, i + 11, i + 10] for i in range(9)]
    assert plane_numbers(Mesh(corners, np.array(faces, np.int32))).tolist() == [*range(9), *range(9)]


def test_a_triangle_without_area_is_a_plane_of_its_own() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], np.float64)
    assert plane_numbers(Mesh(corners, np.array([[0, 1, 2], [0, 1, 3]], np.int32))).tolist() == [0, 1]


def test_flush_houses_share_planes_and_bodies_do_not() -> None:
    """Two houses of one height in a row: front, back, floor and roof are four planes, the gable walls four
    more, two of which coincide. A body of the same height keeps its six."""
    houses = [box((0.0, 8.0), (0.0, 10.0), (0.0, 6.0)), box((8.0, 20.0), (0.0, 10.0), (0.0, 6.0))]
    corners, faces, planes, counts = joined([*houses, box((40.0, 44.0), (0.0, 10.0), (0.0, 6.0))])
    table = PlaneTable(planes, faces)
    table.update(corners)
    shared = shared_planes(table, np.zeros(counts[0] + counts[1], np.int64))
    assert len(set(shared[:12].tolist())) == 4 + 3
    assert len(set(shared[12:].tolist())) == 6
    assert not set(shared[:12].tolist()) & set(shared[12:].tolist())


@pytest.mark.parametrize(
    ("height", "planes_shared"), [(0.0, True), (1e-4, True), (4e-4, False), (-9e-4, False)]
)
def test_a_sheet_of_another_material_above_a_ground_has_a_plane_of_its_own(
    height: float, planes_shared: bool
) -> None:
    """Where both overlap, so that the upper one is met; a sheet elsewhere shares the ground's plane."""
    ground, there = square(0.0), square(height)
    elsewhere = Mesh(there.vertices + np.array([100.0, 0.0, 0.0]), there.faces)
    for sheet, expected in ((there, planes_shared), (elsewhere, True)):
        corners, faces, planes, _ = joined([ground, sheet])
        table = PlaneTable(planes, faces)
        table.update(corners)
        assert (len(set(shared_planes(table, np.array([0, 1])).tolist())) == 1) is expected
        assert len(set(shared_planes(table, np.array([0, 0])).tolist())) == 1


def square(z: float) -> Mesh:
    corners = np.array([[-9, -9, z], [9, -9, z], [9, 9, z], [-9, 9, z]], np.float64)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def test_the_largest_triangle_stands_for_a_plane_and_the_box_holds_all() -> None:
    corners = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1], [9, 9, 1], [2, 3, 1]], np.float64)
    table = PlaneTable(np.zeros(2, np.int64), np.array([[0, 1, 2], [0, 3, 4]]))
    table.update(corners)
    assert table.triangle.tolist() == [1]
    assert np.abs(table.normal).tolist() == [[0, 0, 1]]
    assert table.low.tolist() == [[0, 0, 1]]
    assert table.high.tolist() == [[9, 9, 1]]


def test_what_moves_is_taken_anew_and_the_rest_stays() -> None:
    corners, faces, planes, counts = joined([box((0.0, 8.0), (0.0, 10.0), (0.0, 6.0)), unit_box()])
    table = PlaneTable(planes, faces)
    table.update(corners)
    still = table.low[: counts[0]].copy()
    corners[8:] += [100.0, 0.0, 0.0]
    table.update(corners, np.arange(counts[0], counts[0] + counts[1]))
    assert np.array_equal(table.low[: counts[0]], still)
    assert table.low[counts[0] :, 0].min() == pytest.approx(99.5)


def test_where_faces_coincide_the_first_is_met() -> None:
    """The common wall of two houses, in the part that both have; beyond, the higher house is alone."""
    corners, faces, planes, counts = joined(
        [box((0.0, 8.0), (0.0, 10.0), (0.0, 6.0)), box((8.0, 20.0), (0.0, 10.0), (0.0, 9.0))]
    )
    table = PlaneTable(planes, faces)
    table.update(corners)
    table = PlaneTable(shared_planes(table, np.zeros(sum(counts), np.int64))[planes], faces)
    table.update(corners)
    wall = next(t for t in range(12, 24) if np.allclose(corners[faces[t], 0], 8.0))
    points = np.array([[8.0, 3.0, 2.0], [8.0, 3.0, 7.5]])
    first = table.first_holding(np.array([wall, wall]), points)
    assert first[0] < 12
    assert np.allclose(corners[faces[first[0]], 0], 8.0)
    assert first[1] >= 12
