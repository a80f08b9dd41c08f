"""Which faces of bodies are one surface with others."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_space.meshes import Mesh, box
from caviar_space.planes import CoplanarFaces, JoinedFaces, PlaneTable, plane_numbers

FACES = 6


Range = tuple[float, float]


def block(x: Range, y: Range, z: Range) -> Mesh:
    """A box."""
    made = box(x, y, z)
    return Mesh(made.vertices.astype(np.float64), made.faces)


def joined(*bodies: Mesh, scenery: Mesh | None = None, two_sided: bool = False) -> JoinedFaces:
    """Of boxes, of which the scenery, if any, is the first."""
    meshes = [*([] if scenery is None else [scenery]), *bodies]
    numbers, faces, corners = [], [], []
    for number, mesh in enumerate(meshes):
        numbers.append(plane_numbers(mesh).astype(np.int64) + FACES * number)
        faces.append(mesh.faces.astype(np.int64) + 8 * number)
        corners.append(mesh.vertices)
    table = PlaneTable(np.concatenate(numbers), np.concatenate(faces))
    table.update(np.concatenate(corners))
    first = FACES * (len(meshes) - len(bodies))
    sides = np.full(FACES * len(bodies), two_sided)
    return CoplanarFaces(table, first, np.full(len(bodies), FACES), sides).find()


def test_flush_boxes_side_by_side_share_the_four_faces_that_go_on() -> None:
    found = joined(block((0, 2), (0, 1), (0, 1)), block((2, 5), (0, 1), (0, 1)))
    assert [len(group) for group in found.groups] == [2, 2, 2, 2]
    assert all(found.label[group[1]] == group[0] for group in found.groups)


def test_faces_that_face_each_other_are_one_surface_only_where_both_sides_reflect() -> None:
    pair = block((0, 2), (0, 1), (0, 1)), block((2, 5), (0, 1), (0, 1))
    assert len(joined(*pair, two_sided=True).groups) == len(joined(*pair).groups) + 1


def test_a_row_of_boxes_is_one_surface() -> None:
    row = [block((x, x + 1), (0, 1), (0, 1 + x)) for x in (0, 2, 1)]
    groups = [group.tolist() for group in joined(*row).groups]
    assert sorted(len(group) for group in groups) == [3, 3, 3]  # front, back and floor


@pytest.mark.parametrize(("gap", "behind", "tilt"), [(0.01, 0.0, 0.0), (0.0, 1e-3, 0.0), (0.0, 0.0, 1e-3)])
def test_boxes_apart_or_of_other_planes_are_not(gap: float, behind: float, tilt: float) -> None:
    other = block((2 + gap, 5), (behind, 1 + 2 * behind), (behind, 1 + 2 * behind))
    tilted = other.vertices + tilt * (other.vertices[:, :1] - 2) * [0, 1, 1]
    assert not joined(block((0, 2), (0, 1), (0, 1)), Mesh(tilted, other.faces)).groups


def test_scenery_comes_first_and_names_the_surface_by_the_triangle_that_is_touched() -> None:
    found = joined(block((2, 4), (0, 1), (0, 1)), scenery=block((-9, 2), (0, 5), (0, 6)))
    assert [group[0] < FACES <= group[1] for group in found.groups] == [
        True
    ] * 3  # front, floor and where both meet
    assert sorted(found.scenery) == [group[0] for group in found.groups]
    assert all(0 <= triangle < 12 for triangle in found.scenery.values())


def test_bodies_of_no_size_are_not_joined() -> None:
    point = Mesh(np.zeros((8, 3)), block((0, 1), (0, 1), (0, 1)).faces)
    assert not joined(block((0, 1), (0, 1), (0, 1)), point, point).groups
