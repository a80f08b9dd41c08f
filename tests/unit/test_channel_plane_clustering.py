"""Triangles of one plane, all at once: as one after the other, of any mesh and of many."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from caviar_space import planes
from caviar_space.meshes import Mesh, unit_box
from caviar_space.planes import plane_numbers, plane_numbers_of

Array = NDArray[np.float64]


def one_after_the_other(mesh: Mesh) -> list[int]:
    """The largest triangle claims all within 2e-5 of the extent and 2e-4 rad of its plane, and so on."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    normals /= np.where(areas > 0, areas, 1.0)[:, None]
    within = 2e-5 * float(np.ptp(mesh.vertices, axis=0).max())
    label = np.full(len(corners), -1)
    for first in np.argsort(-areas, kind="stable").tolist():
        if label[first] < 0:
            near = (label < 0) & (areas > 0) & (areas[first] > 0)
            near &= np.linalg.norm(np.cross(normals, normals[first]), axis=1) <= 2e-4
            near &= np.abs((corners - corners[first, 0]) @ normals[first]).max(1) <= within
            near[first] = True
            label[near] = first
    order = {plane: number for number, plane in enumerate(dict.fromkeys(label.tolist()))}
    return [order[plane] for plane in label.tolist()]


def terrain(side: int, rough: float, rng: np.random.Generator) -> Mesh:
    """Heights at random [m] above squares of 1 m, turned and moved; triangles in any order and sense."""
    x, y = np.meshgrid(np.arange(side + 1.0), np.arange(side + 1.0))
    points = np.stack([x, y, rng.normal(size=x.shape) * rough], axis=-1).reshape(-1, 3)
    i = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
    lower = np.stack([i[:-1, :-1], i[:-1, 1:], i[1:, 1:]], axis=-1)
    upper = np.stack([i[:-1, :-1], i[1:, 1:], i[1:, :-1]], axis=-1)
    faces = rng.permutation(np.concatenate([lower, upper]).reshape(-1, 3))
    flipped = rng.random(len(faces)) < 0.5
    faces[flipped] = faces[flipped, ::-1]
    turned, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return Mesh(points @ turned + rng.uniform(-300, 300, 3), faces.astype(np.int32))


@pytest.mark.parametrize("rough", [0.0, 1e-5, 5e-5, 1e-4, 2e-4, 1e-3, 0.1])
@pytest.mark.parametrize("seed", range(2))
def test_planes_are_those_found_one_after_the_other(rough: float, seed: int) -> None:
    """From one plane, by some hundreds that overlap, to one for each triangle."""
    mesh = terrain(16, rough, np.random.default_rng(seed))
    assert plane_numbers(mesh).tolist() == one_after_the_other(mesh)


@pytest.mark.parametrize("many", [1, 50, 10_000])
def test_large_planes_are_claimed_one_by_one_as_long_as_that_pays(
    many: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planes, "_LARGE", 10)
    monkeypatch.setattr(planes, "_MANY", many)
    monkeypatch.setattr(planes, "_AT_ONCE", 100)
    for rough in (0.0, 5e-5, 2e-4):
        mesh = terrain(16, rough, np.random.default_rng(3))
        assert plane_numbers(mesh).tolist() == one_after_the_other(mesh)


def test_meshes_are_apart_also_where_they_coincide() -> None:
    rng = np.random.default_rng(5)
    far = Mesh(unit_box().vertices * 1e4 + 3e5, unit_box().faces)
    none = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    meshes = [unit_box(), terrain(5, 1e-4, rng), unit_box(), none, far]
    together = plane_numbers_of(meshes)
    assert [numbers.tolist() for numbers in together] == [plane_numbers(mesh).tolist() for mesh in meshes]
    assert plane_numbers_of([]) == []


@pytest.mark.exhaustive
@pytest.mark.parametrize(("rough", "least", "most"), [(0.0, 1, 1), (0.05, 980_000, 10**6)])
def test_a_million_triangles(rough: float, least: int, most: int) -> None:
    """One plane of all, and nearly one for each."""
    mesh = terrain(707, rough, np.random.default_rng(1))
    found = int(plane_numbers(mesh).max()) + 1
    assert len(mesh.faces) == 999_698
    assert least <= found <= most
