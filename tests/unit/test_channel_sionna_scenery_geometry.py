"""What is warned of in the geometry of scenery: materials that coincide, and walls that are closed."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from caviar_services.channel.sionna.scene_loading import Shape
from caviar_services.channel.sionna.triangle_numbering import closed_walls, coinciding_materials
from caviar_space.meshes import Mesh, box, joined
from caviar_space.planes import PlaneTable, plane_numbers_of, shared_planes

HOUSE, SECOND = box((0.0, 8.0), (0.0, 9.0), (0.0, 6.0)), box((8.0, 20.0), (0.0, 9.0), (0.0, 7.0))


def sheet(origin: tuple[float, ...], one: tuple[float, ...], other: tuple[float, ...]) -> Mesh:
    """A parallelogram between two edges [m]."""
    a, u, v = np.array(origin, float), np.array(one, float), np.array(other, float)
    return Mesh(np.stack([a, a + u, a + u + v, a + v]), np.array([[0, 1, 2], [0, 2, 3]], np.int32))


GROUND = sheet((-50, -50, 0), (100, 0, 0), (0, 100, 0))
LAWN = sheet((30, 30, 0), (50, 0, 0), (0, 7, 0))
ROAD = box((-20.0, -10.0), (-50.0, 50.0), (-0.3, 0.0))
POSTER = sheet((2, 0, 1), (3, 0, 0), (0, 0, 2))
TURNED = sheet((2, 0, 1), (0, 0, 2), (3, 0, 0))


def shape(material: str, thickness: float = 0.2, **pieces: Mesh) -> Shape:
    made = SimpleNamespace(name=material, thickness=[thickness])
    return Shape(f"of-{material}", made, list(pieces), list(pieces.values()))


@pytest.mark.parametrize(
    ("first", "second", "warns"),
    [
        ({"ground": GROUND}, {"lawn": LAWN}, True),
        ({"ground": GROUND}, {"road": ROAD}, True),
        ({"house": HOUSE}, {"poster": POSTER}, True),
        ({"house": HOUSE}, {"poster": TURNED}, True),
        ({"ground": GROUND}, {"house": HOUSE}, False),
        ({"house": HOUSE}, {"second": SECOND}, False),
        ({"ground": GROUND}, {"beside": sheet((50, -50, 0), (9, 0, 0), (0, 99, 0))}, False),
        ({"lawn": LAWN}, {"corner": sheet((92, 30, 0), (-50, 30, 0), (9, 30, 0))}, False),
        ({"ground": GROUND, "lawn": LAWN}, {}, False),
    ],
    ids=["lawn", "road", "poster", "its back", "floor", "common wall", "beside", "corner", "one material"],
)
def test_materials_that_overlap_where_waves_come_are_named(
    first: dict[str, Mesh], second: dict[str, Mesh], warns: bool
) -> None:
    shapes = [shape("grey", **first), shape("green", **second)]
    meshes = [*first.values(), *second.values()]
    whole = joined(meshes)
    numbers = plane_numbers_of(meshes)
    counts = [int(number.max()) + 1 for number in numbers]
    parts = np.concatenate([n + sum(counts[:i]) for i, n in enumerate(numbers)]).astype(np.int64)
    table = PlaneTable(parts, whole.faces.astype(np.int64))
    table.update(whole.vertices)
    material = np.repeat([0] * len(first) + [1] * len(second), counts)
    notes = coinciding_materials(shapes, shared_planes(table, material)[parts])
    assert bool(notes) is warns
    for note in notes:
        assert all(f"{word!r}" in note for word in (*first, *second, "grey", "green"))
        assert f"waves meet {next(iter(first))!r} alone" in note


TURN = np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
WALL = box((0.0, 9.0), (5.0, 5.2), (0.0, 3.0))


@pytest.mark.parametrize(
    ("mesh", "apart"),
    [
        (WALL, "0.2 m"),
        (Mesh(WALL.vertices, WALL.faces[:, ::-1]), "0.2 m"),
        (joined([HOUSE, box((30.0, 30.3), (0.0, 9.0), (0.0, 6.0))]), "0.3 m"),
        (
            Mesh(WALL.vertices @ np.array([[0.6, 0.8, 0], [-0.8, 0.6, 0], [0, 0, 1]]) + 4e4, WALL.faces),
            "0.2 m",
        ),
        (Mesh(WALL.vertices, WALL.faces[:-1]), ""),
        (POSTER, ""),
        (HOUSE, ""),
        (joined([HOUSE, box((8.2, 20.0), (0.0, 9.0), (0.0, 6.0))]), ""),
    ],
    ids=["wall", "inside out", "one of two", "turned, far", "open", "sheet", "house", "gap between houses"],
)
def test_a_closed_wall_is_named(mesh: Mesh, apart: str) -> None:
    shapes = [shape("air", 0.2, other=WALL), shape("c", 0.2, wall=mesh)]
    face = np.concatenate(plane_numbers_of([WALL, mesh])).astype(np.int64)
    notes = closed_walls(shapes, face, {"of-c"})
    assert [apart in note and "'wall'" in note and "'c'" in note for note in notes] == [True] * bool(apart)
