"""Scenery from above: meshes as exporters write them become outlines of buildings."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from caviar_clients.plots.rays import footprints, with_boxes
from caviar_protocol.errors import AssetError
from caviar_protocol.space.ply import read_ply

QUADS = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]


def corners(low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    (x0, y0, z0), (x1, y1, z1) = low, high
    flat = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    return np.array([(*p, z0) for p in flat] + [(*p, z1) for p in flat])


def ply(
    file: Path, vertices: np.ndarray, faces: list[tuple[int, ...]], kind: str = "binary_little_endian"
) -> Path:
    """A PLY file as Blender writes it: float32, texture coordinates beside, lists of int32."""
    head = (
        f"ply\nformat {kind} 1.0\ncomment by hand\nelement vertex {len(vertices)}\n"
        "property float x\nproperty float y\nproperty float z\nproperty float s\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    if kind == "ascii":
        lines = [" ".join(map(str, (*v, 0.5))) for v in vertices]
        lines += [" ".join(map(str, (len(f), *f))) for f in faces]
        file.write_text(head + "\n".join(lines) + "\n")
        return file
    order = "<" if "little" in kind else ">"
    body = b"".join(struct.pack(f"{order}4f", *v, 0.5) for v in vertices)
    body += b"".join(struct.pack(f"{order}B{len(f)}i", len(f), *f) for f in faces)
    file.write_bytes(head.encode() + body)
    return file


def triangles(faces: list[tuple[int, ...]]) -> list[tuple[int, ...]]:
    return [(f[0], *f[i : i + 2]) for f in faces for i in range(1, len(f) - 1)]


@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("polygons", [True, False])
def test_every_kind_of_ply_gives_the_same_triangles(tmp_path, kind, polygons):
    box = corners((1, 2, 0), (4, 8, 10))
    vertices, faces = read_ply(ply(tmp_path / "a.ply", box, QUADS if polygons else triangles(QUADS), kind))
    np.testing.assert_allclose(vertices, box)
    assert [tuple(face) for face in faces.tolist()] == triangles(QUADS)


def test_a_roof_that_reaches_the_ground_is_no_ground(tmp_path) -> None:
    """A mesh apart from its walls, with a level piece at the height of the ground."""
    box, yard = corners((0, 0, 0), (10, 10, 20)), corners((4, 4, 0), (6, 6, 0))[:4]
    walls = ply(tmp_path / "walls.ply", box, QUADS[2:])
    roof = ply(tmp_path / "roof.ply", np.concatenate([box[4:], yard]), [(0, 1, 2, 3), (4, 5, 6, 7)])
    ground = ply(tmp_path / "ground.ply", corners((-50, -50, 0), (50, 50, 0))[:4], [(0, 1, 2, 3)])
    drawn = footprints((file, np.eye(4)) for file in (walls, roof, ground))
    assert drawn.faces.shape == (4, 3, 2)
    assert (drawn.faces.min(), drawn.faces.max()) == (0.0, 10.0)


def test_boxes_that_block_a_channel_are_footprints_too() -> None:
    boxes = [((20.0, 20.0, 0.0), (35.0, 30.0, 25.0)), ((0.0, 0.0, 0.0), (1.0, 2.0, 3.0))]
    drawn = with_boxes(None, boxes)
    assert edges_of(drawn) >= {frozenset({(20.0, 20.0), (35.0, 20.0)}), frozenset({(0.0, 2.0), (1.0, 2.0)})}
    (a, b), (c, d) = (drawn.faces[:, 1] - drawn.faces[:, 0]).T, (drawn.faces[:, 2] - drawn.faces[:, 0]).T
    assert np.abs(a * d - b * c).sum() / 2 == 152.0  # 15 m · 10 m and 1 m · 2 m, covered once
    assert (drawn.faces.shape, drawn.edges.shape) == ((4, 3, 2), (8, 2, 2))
    assert len(with_boxes(drawn, boxes).faces) == 8


def edges_of(shape) -> set[frozenset[tuple[float, float]]]:
    return {frozenset(tuple(np.round(end, 3)) for end in edge) for edge in shape.edges.tolist()}


def test_the_outline_of_a_box_is_its_rectangle_without_diagonals(tmp_path):
    box = corners((1, 2, 0), (4, 8, 10))
    shape = footprints([(ply(tmp_path / "a.ply", box, triangles(QUADS)), np.eye(4))])
    loop = [(1.0, 2.0), (4.0, 2.0), (4.0, 8.0), (1.0, 8.0)]
    assert edges_of(shape) == {frozenset((loop[i - 1], loop[i])) for i in range(4)}
    assert shape.faces.shape == (4, 3, 2)  # roof and floor


def test_vertices_repeated_for_each_face_are_one_corner(tmp_path):
    box = corners((1, 2, 0), (4, 8, 10))
    faces = triangles(QUADS)
    soup = np.array([box[i] for face in faces for i in face])
    numbered = [tuple(range(3 * n, 3 * n + 3)) for n in range(len(faces))]
    loose = footprints([(ply(tmp_path / "a.ply", soup, numbered), np.eye(4))])
    tight = footprints([(ply(tmp_path / "b.ply", box, faces), np.eye(4))])
    assert edges_of(loose) == edges_of(tight)


def test_ground_is_left_out_and_a_roof_without_walls_is_not(tmp_path):
    ground = ply(tmp_path / "ground.ply", corners((-50, -50, -0.1), (50, 50, 0)), triangles(QUADS))
    plate = np.array([[0, 0, 9.0], [5, 0, 9.0], [5, 5, 9.0], [0, 5, 9.0]])
    roof = ply(tmp_path / "roof.ply", plate, [(0, 1, 2), (0, 2, 3)])
    shape = footprints([(ground, np.eye(4)), (roof, np.eye(4))])
    assert shape.faces.max() == 5.0
    assert len(edges_of(shape)) == 4


def test_meshes_stand_where_their_transform_puts_them(tmp_path):
    turn = np.array([[0, -1, 0, 100], [1, 0, 0, 200], [0, 0, 1, 0], [0, 0, 0, 1.0]])  # 90° and away
    shape = footprints([(ply(tmp_path / "a.ply", corners((1, 2, 0), (4, 8, 10)), QUADS), turn)])
    assert shape.faces.reshape(-1, 2).min(axis=0).tolist() == pytest.approx([92, 201])
    assert shape.faces.reshape(-1, 2).max(axis=0).tolist() == pytest.approx([98, 204])


def test_nothing_gives_nothing():
    assert footprints([]).faces.shape == (0, 3, 2)


XYZ = b"property float x\nproperty float y\nproperty float z\n"
FACES = b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"


@pytest.mark.parametrize(
    "content",
    [
        b"obj\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\n" + XYZ + b"end_header\n0 0 0\n",
        b"ply\nformat ascii 1.0\nelement vertex 1\n" + XYZ + FACES + b"0 0 0\n3 0\n",
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n" + XYZ + FACES + b"\0\0",
        b"ply\nformat ascii 1.0\nelement vertex 1\n" + XYZ + FACES + b"0 0 0\n3 0 1 2\n",
    ],
)
def test_what_is_no_mesh_is_named(tmp_path, content):
    (tmp_path / "bad.ply").write_bytes(content)
    with pytest.raises(AssetError, match=r"bad\.ply"):
        read_ply(tmp_path / "bad.ply")
    with pytest.raises(AssetError, match="cannot be read"):
        read_ply(tmp_path / "missing.ply")
