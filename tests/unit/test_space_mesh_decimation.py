"""Fewer triangles: never farther off than the tolerance, and never a hole."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from caviar_protocol.arrays import Float64Array
from caviar_services.channel.sionna.scene_loading import BodyPool, ObjectMaterials
from caviar_space.mesh_detail import LARGEST_TOLERANCE, decimated, welded, with_few_faces
from caviar_space.meshes import Mesh, box, ply, unit_box

pytestmark = pytest.mark.slow


def sphere(count: int) -> Mesh:
    """Closed, of a radius of 1 m: an octahedron whose triangles are split."""
    corners = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
    faces = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [1, 0, 5], [2, 1, 5], [3, 2, 5], [0, 3, 5]]
    triangles = corners[faces]
    for _ in range(count):
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        triangles = np.concatenate(
            [np.stack(three, 1) for three in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        )
    points = triangles.reshape(-1, 3)
    points = np.round(points / np.linalg.norm(points, axis=1)[:, None], 12)
    return welded(Mesh(points, np.arange(len(points), dtype=np.int32).reshape(-1, 3)))


def terrain(size: int, height: float, seed: int = 4) -> Mesh:
    """Open, with random heights [m] on a grid of 1 m."""
    x, y = np.meshgrid(np.arange(size), np.arange(size))
    z = np.random.default_rng(seed).uniform(0, height, x.size)
    corner = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).ravel()
    faces = np.concatenate(
        [
            np.column_stack([corner, corner + 1, corner + size + 1]),
            np.column_stack([corner, corner + size + 1, corner + size]),
        ]
    )
    return Mesh(np.column_stack([x.ravel(), y.ravel(), z]), faces.astype(np.int32))


def sides(mesh: Mesh) -> Counter[tuple[int, int]]:
    """How many triangles each side belongs to."""
    found: Counter[tuple[int, int]] = Counter()
    for a, b, c in mesh.faces.tolist():
        found.update(tuple(sorted(side)) for side in ((a, b), (b, c), (c, a)))  # type: ignore[misc]
    return found


def volume(mesh: Mesh) -> float:
    """Enclosed, by the divergence theorem."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return float((a * np.cross(b, c)).sum() / 6)


def heights(mesh: Mesh, points: Float64Array) -> Float64Array:
    """z of a surface over points (x, y)."""
    result = np.full(len(points), np.nan)
    for a, b, c in mesh.vertices[mesh.faces]:
        m = np.column_stack([b[:2] - a[:2], c[:2] - a[:2]])
        u, v = np.linalg.solve(m, (points - a[:2]).T)
        within = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9)
        result[within] = (a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2]))[within]
    return result


def test_a_box_cannot_be_simpler() -> None:
    for mesh in (unit_box(), box((3, 9), (-2, 4), (0, 11))):
        assert len(decimated(mesh, 0.1).faces) == 12


def test_what_lies_in_a_plane_becomes_few_triangles() -> None:
    """A flat grid of 1,800 triangles, inclined: two are left, and its outline stays."""
    flat = terrain(31, 0.0)
    inclined = Mesh(flat.vertices @ np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0], flat.faces)
    left = decimated(inclined, 1e-6)
    assert len(left.faces) == 2
    a, b, c = np.moveaxis(left.vertices[left.faces], 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(900.0)


@pytest.mark.parametrize(("tolerance", "at_most"), [(0.01, 1800), (0.05, 500), (0.2, 120)])
def test_a_sphere_stays_closed_and_within_the_tolerance(tolerance: float, at_most: int) -> None:
    mesh = sphere(4)
    left = decimated(mesh, tolerance)
    assert len(mesh.faces) == 2048
    assert len(left.faces) < at_most
    assert set(sides(left).values()) == {2}
    centres = np.linalg.norm(left.vertices[left.faces].mean(1), axis=1)
    assert (1 - centres).max() < tolerance
    assert volume(left) > volume(mesh) * (1 - tolerance)


def test_of_a_rough_field_only_what_is_within_the_tolerance_goes() -> None:
    """Random heights of up to 0.2 m: at 0.1 m some corners go, and the surface is nowhere 0.3 m off."""
    mesh = terrain(12, 0.2)
    left = decimated(mesh, 0.1)
    assert 2 < len(left.faces) < len(mesh.faces) * 0.7
    points = np.random.default_rng(1).uniform(0.5, 10.5, (500, 2))
    assert np.abs(heights(left, points) - heights(mesh, points)).max() < 0.3
    assert len(decimated(mesh, 1e-4).faces) == len(mesh.faces)


def test_corners_that_stay_do_not_move() -> None:
    mesh = terrain(9, 0.3)
    before = {tuple(vertex) for vertex in mesh.vertices.tolist()}
    assert {tuple(vertex) for vertex in decimated(mesh, 0.2).vertices.tolist()} < before


def test_a_step_of_the_roof_goes_with_the_tolerance() -> None:
    """A terrace of 0.4 m in a field stays at 0.3 m and goes at 0.5 m."""
    mesh = terrain(11, 0.0)
    mesh.vertices[(np.abs(mesh.vertices[:, :2] - 5) < 2.5).all(1), 2] = 0.4
    assert np.ptp(decimated(mesh, 0.3).vertices[:, 2]) == 0.4
    assert len(decimated(mesh, 0.3).faces) < len(mesh.faces)
    assert len(decimated(mesh, 0.5).faces) < len(decimated(mesh, 0.3).faces)


def test_the_result_follows_from_the_mesh_alone() -> None:
    a, b = (decimated(terrain(12, 0.2), 0.1) for _ in range(2))
    assert np.array_equal(a.vertices, b.vertices)
    assert np.array_equal(a.faces, b.faces)


def test_broken_meshes_are_survived() -> None:
    """A triangle without area, one twice, one turned round, three at a side."""
    corners = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0], [2, 0, 3], [8, 0, 0]], float)
    faces = [[0, 1, 2], [0, 1, 2], [0, 3, 2], [0, 1, 4], [0, 1, 5], [2, 2, 1]]
    left = decimated(Mesh(corners, np.array(faces, np.int32)), 0.5)
    assert np.isfinite(left.vertices).all()
    assert {0.0, 4.0, 3.0} <= set(left.vertices.ravel().tolist())


def test_welding_joins_places_and_drops_what_collapses() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0], [9, 9, 9]], float)
    mesh = welded(Mesh(corners, np.array([[0, 1, 2], [3, 4, 2], [0, 3, 1]], np.int32)))
    assert len(mesh.vertices) == 3
    assert len(mesh.faces) == 2


def test_few_faces_take_the_least_tolerance_that_leaves_them() -> None:
    ball = Mesh(sphere(4).vertices / 2, sphere(4).faces)
    few, off = with_few_faces(ball, 300)
    assert len(few.faces) <= 300 < len(decimated(ball, off / 2).faces)
    assert 0 < off < LARGEST_TOLERANCE
    # Corners that stay are those of the ball, and no side of a hole comes up.
    assert {*map(tuple, few.vertices.tolist())} <= {*map(tuple, ball.vertices.tolist())}
    assert set(sides(few).values()) == {2}
    assert with_few_faces(ball, 8)[1] == LARGEST_TOLERANCE


def test_bodies_of_objects_have_few_faces_and_say_so(tmp_path: Path) -> None:
    assets = {}
    for name, mesh in {"ball": Mesh(sphere(4).vertices / 2, sphere(4).faces), "brick": unit_box()}.items():
        assets[f"objects/{name}.ply"] = tmp_path / name
        assets[f"objects/{name}.ply"].write_bytes(ply(mesh))
    pool = BodyPool(assets, dict.fromkeys(assets, 1), {}, ObjectMaterials(), {}, (), 300)
    faces = {name: len(mesh.faces) for name, mesh in pool.meshes.items()}
    assert faces["objects/brick.ply"] == 12
    assert faces["objects/ball.ply"] <= 300
    (note,) = pool.notes
    assert f"'objects/ball.ply': 2,048 → {faces['objects/ball.ply']} faces" in note
    pool.use_meshes({"objects/later.ply": assets["objects/ball.ply"]})
    assert "'objects/later.ply': 2,048 →" in pool.notes[1]
