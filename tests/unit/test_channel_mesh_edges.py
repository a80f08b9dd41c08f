"""Which edges diffract: of one mesh, where meshes meet, and of open surfaces."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from caviar_services.channel.sionna.diffracting_edges import MeshEdges, mesh_edges
from caviar_space.meshes import Mesh, box, unit_box
from caviar_space.planes import plane_numbers

Array = np.ndarray[tuple[int, ...], np.dtype[Any]]
FAR = np.array([1e3, -2e3, 50.0])
TOLERANCE = 1e-3


def found(*meshes: Mesh, free: bool = False) -> tuple[MeshEdges, Array]:
    """Edges of meshes, and all their vertices."""
    begin = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    faces = np.concatenate([mesh.faces.astype(np.int64) + b for mesh, b in zip(meshes, begin, strict=False)])
    numbers = [plane_numbers(mesh).astype(np.int64) for mesh in meshes]
    first = np.cumsum([0, *(int(number.max()) + 1 for number in numbers)])
    parts = np.concatenate([number + f for number, f in zip(numbers, first, strict=False)])
    return mesh_edges(vertices, faces, parts, TOLERANCE, free), vertices


def lines(edges: MeshEdges, vertices: Array) -> set[frozenset[tuple[float, ...]]]:
    """Both ends of each edge, to 1 cm."""
    return {frozenset(tuple(np.round(end, 2) + 0.0) for end in vertices[ends]) for ends in edges.ends}


def quad(*corners: tuple[float, float, float]) -> Mesh:
    return Mesh(np.array(corners, float), np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def test_a_box_has_twelve_edges_whether_its_corners_are_shared_or_not() -> None:
    whole = unit_box()
    apart = Mesh(whole.vertices[whole.faces].reshape(-1, 3), np.arange(36, dtype=np.int32).reshape(-1, 3))
    assert len(lines(*found(whole))) == 12
    assert lines(*found(whole)) == lines(*found(apart))
    assert len(found(whole)[0].sides[0]) == 24


@pytest.mark.parametrize("shift", [0.0, 0.9e-3])
def test_each_side_as_a_mesh_of_its_own_makes_the_same_edges(shift: float) -> None:
    """Corners up to 0.9 mm from each other are one."""
    whole = box((0, 9), (0, 7), (0, 5))
    rng = np.random.default_rng(3)
    sides = [
        Mesh(whole.vertices + FAR + shift * rng.uniform(-0.3, 0.3, (8, 3)), whole.faces[i : i + 2])
        for i in range(0, 12, 2)
    ]
    edges, vertices = found(*sides)
    assert len(edges) == 12
    assert np.linalg.norm(np.diff(vertices[edges.ends], axis=1), axis=2).sum() == pytest.approx(84, abs=0.02)


def test_a_border_that_another_mesh_divides_is_divided_likewise() -> None:
    """A roof over two walls in one line: one edge for each pair of faces."""
    roof = quad((0, 0, 5), (10, 0, 5), (10, 8, 5), (0, 8, 5))
    walls = [quad((x, 0, 0), (x + w, 0, 0), (x + w, 0, 5), (x, 0, 5)) for x, w in ((0, 4), (4, 6))]
    edges, vertices = found(roof, *walls)
    assert lines(edges, vertices) == {
        frozenset({(0.0, 0.0, 5.0), (4.0, 0.0, 5.0)}),
        frozenset({(4.0, 0.0, 5.0), (10.0, 0.0, 5.0)}),
    }
    assert (edges.triangles[:, 0] < 2).all()
    assert (np.diff(edges.triangles, axis=1) > 0).all()


def test_an_edge_of_many_triangles_is_one() -> None:
    """A wall and a roof of four triangles a side each: the sides in one line are one edge."""
    x = np.linspace(0, 8, 5)
    low, high, back = ([(at, y, z) for at in x] for y, z in ((0, 0), (0, 5), (6, 5)))
    vertices = np.array([*low, *high, *back])
    steps = np.arange(4)
    strips = [np.stack([steps + a, steps + 1 + a, steps + 1 + a + 5], axis=-1) for a in (0, 5)] + [
        np.stack([steps + a, steps + 6 + a, steps + 5 + a], axis=-1) for a in (0, 5)
    ]
    edges, _ = found(Mesh(vertices, np.concatenate(strips).astype(np.int32)))
    assert lines(edges, vertices) == {frozenset({(0.0, 0.0, 5.0), (8.0, 0.0, 5.0)})}


@pytest.mark.parametrize(
    ("lift", "faces", "count", "free"),
    [
        (0.0, [[0, 1, 2], [0, 2, 3]], 0, 4),  # a wall, and its rim
        (0.0, [[0, 1, 2], [0, 3, 2]], 0, 4),  # one face seen from behind
        (0.05, [[0, 1, 2], [0, 2, 3]], 1, 5),
        (0.05, [[0, 1, 2]], 0, 3),
        (0.0, [[0, 1, 2], [0, 1, 2]], 0, 3),  # twice in one place: a sheet
    ],
)
def test_faces_in_one_plane_have_none(lift: float, faces: list[list[int]], count: int, free: int) -> None:
    """A quadrilateral far out, with a slope; free edges only where they are asked for."""
    corners = np.array([[0, 0, 0], [9, 0, 4], [9, 7, 4], [0, 7, lift]], float) + FAR
    mesh = Mesh(corners, np.array(faces, np.int32))
    assert len(found(mesh)[0]) == count
    with_free, _ = found(mesh, free=True)
    assert len(with_free) == free
    assert int(with_free.is_free.sum()) == free - count


def test_where_many_faces_meet_the_widest_sector_of_air_tells() -> None:
    """Two houses with a wall in common: no edge where their roofs are one plane; one, of both roofs, where
    these slope down from the wall; none in the valley between roofs that slope up from it."""
    for drop, count in ((0.0, 0), (1.0, 1), (-1.0, 0)):
        wall = quad((0, 0, 0), (0, 8, 0), (0, 8, 5), (0, 0, 5))
        roofs = [quad((0, 0, 5), (x, 0, 5 - drop), (x, 8, 5 - drop), (0, 8, 5)) for x in (-6, 6)]
        edges, _ = found(wall, Mesh(wall.vertices[::-1].copy(), wall.faces), *roofs)
        assert len(edges) == count
        assert (edges.triangles >= 4).all()  # of the roofs


def test_without_triangles_there_are_none() -> None:
    assert len(found(Mesh(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32)))[0]) == 0
    assert (
        len(mesh_edges(np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros(0, np.int64), 1e-3, True)) == 0
    )


def test_a_sliver_between_two_faces_is_none_of_them() -> None:
    """A triangle without width along the edge of roof and wall, where the wall has one corner more."""
    vertices = np.array([[0, 0, 5], [4, 0, 5], [9, 0, 5], [9, 7, 5], [0, 7, 5], [0, 0, 0], [9, 0, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [5, 1, 0], [5, 6, 1], [6, 2, 1]], np.int32)
    edges, _ = found(Mesh(vertices, faces))
    assert lines(edges, vertices) == {frozenset({(0.0, 0.0, 5.0), (9.0, 0.0, 5.0)})}
