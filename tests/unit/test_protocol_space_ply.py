"""Vertices of PLY files: every form of the format, at the precision of the file."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from caviar_protocol.errors import AssetError
from caviar_protocol.space.ply import read_ply

VERTICES = [(10_000.123456789, -2.5, 1e-3), (1 / 3, 7.0, -8.25), (0.0, 1e6 + 1 / 7, 4.0)]


def header(form: str, kind: str, *before: str) -> str:
    lines = ["ply", f"format {form} 1.0", "comment made by hand", *before, "element vertex 3"]
    # another property between, and the axes in an odd order
    lines += [f"property {kind} z", "property uchar red", f"property {kind} x", f"property {kind} y"]
    return "\n".join([*lines, "element face 1", "property list uchar int vertex_indices", "end_header", ""])


@pytest.mark.parametrize(
    ("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")], ids=["little", "big"]
)
@pytest.mark.parametrize(("kind", "code"), [("float", "f"), ("double", "d"), ("float64", "d")])
def test_binary_files_in_their_own_precision(
    tmp_path: Path, form: str, order: str, kind: str, code: str
) -> None:
    file = tmp_path / "a.ply"
    rows = [struct.pack(f"{order}{code}B{code}{code}", z, 200, x, y) for x, y, z in VERTICES]
    face = struct.pack(f"{order}Biii", 3, 0, 1, 2)
    file.write_bytes(b"".join([header(form, kind).encode(), *rows, face]))
    expected = np.array(VERTICES, order + code).astype(np.float64)
    assert np.array_equal(read_ply(file)[0], expected)


def test_text_is_read_as_it_is_written(tmp_path: Path) -> None:
    """Also where the header says float: what is written is what is meant."""
    file = tmp_path / "a.ply"
    body = "\n".join(f"{z!r} 200 {x!r} {y!r}" for x, y, z in VERTICES)
    file.write_text(header("ascii", "float") + body + "\n3 0 1 2\n")
    assert np.array_equal(read_ply(file)[0], VERTICES)


def test_elements_before_the_vertices_are_passed_over(tmp_path: Path) -> None:
    file = tmp_path / "a.ply"
    before = ["element material 2", "property int id", "element strip 2", "property list uchar short rows"]
    rows = struct.pack("<ii", 5, 6) + struct.pack("<Bhh", 2, 1, 2) + struct.pack("<Bh", 1, 3)
    rows += b"".join(struct.pack("<dBdd", z, 200, x, y) for x, y, z in VERTICES)
    rows += struct.pack("<Biii", 3, 0, 1, 2)
    file.write_bytes(header("binary_little_endian", "double", *before).encode() + rows)
    assert np.array_equal(read_ply(file)[0], VERTICES)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", r"not a PLY file that can be read \(it is empty\); export it again"),
        (b"solid x\n", "not a PLY file .*no line end_header; the file begins with b'solid x"),
        (b"solid x\nend_header\n", "not a PLY file .*no format"),
        (header("ascii", "float").encode() + b"1 2 3 4\n", "not a PLY file .*breaks off"),
        (header("binary_little_endian", "double").encode() + b"short", "not a PLY file"),
        (header("ascii", "half").encode(), "not a PLY file .*'half'"),
        (b"ply\nformat ascii 1.0\nend_header\n", "not a PLY file .*no element"),
        (
            header("ascii", "double").encode() + b"0 2 0 0 0 2 1 0 1e39 2 0 1 3 0 1 2\n",
            r"vertex 2 is at \[0.0, 1.0, 1e\+39\]; give every vertex finite coordinates of at most 1e\+09",
        ),
    ],
)
def test_what_is_no_mesh_is_named(tmp_path: Path, data: bytes, words: str) -> None:
    file = tmp_path / "bad.ply"
    file.write_bytes(data)
    with pytest.raises(AssetError, match=rf"bad\.ply: {words}"):
        read_ply(file)


@pytest.mark.parametrize("faces", [[(3, 0, 1, 2)], [(3, 2, 1, 0), (4, 0, 1, 2, 1)]], ids=["triangle", "quad"])
@pytest.mark.parametrize("form", ["ascii", "binary_big_endian"])
def test_faces_may_have_numbers_beside_their_corners(
    tmp_path: Path, form: str, faces: list[tuple[int, ...]]
) -> None:
    """Colours and flags, as modelling tools write them."""
    head = header(form, "double").replace("face 1", f"face {len(faces)}\nproperty ushort flag")
    head = head.replace("end_header", "property uchar red\nend_header")
    if form == "ascii":
        rows = "".join(f"{z!r} 200 {x!r} {y!r}\n" for x, y, z in VERTICES)
        data = (head + rows + "".join(f"7 {' '.join(map(str, face))} 255\n" for face in faces)).encode()
    else:
        data = head.encode() + b"".join(struct.pack(">dBdd", z, 200, x, y) for x, y, z in VERTICES)
        data += b"".join(struct.pack(f">HB{len(f) - 1}iB", 7, *f, 255) for f in faces)
    file = tmp_path / "a.ply"
    file.write_bytes(data)
    vertices, triangles = read_ply(file)
    assert np.array_equal(vertices, VERTICES)
    corners = [face[1:] for face in faces]
    assert triangles.tolist() == [[c[0], c[i], c[i + 1]] for c in corners for i in range(1, len(c) - 1)]


@pytest.mark.parametrize("first", range(6))
@pytest.mark.parametrize("sense", [1, -1])
def test_polygons_that_are_not_convex_are_cut_within_their_border(
    tmp_path: Path, first: int, sense: int
) -> None:
    """An L-shaped roof of 3 m² on a slope: triangles cover it once, all in its sense."""
    outline = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], np.float64)
    corners = np.column_stack([outline.sum(1), outline])[::sense]  # the header says z, x, y
    rows = "\n".join(" ".join(map(str, corner)) for corner in np.roll(corners, first, axis=0))
    head = header("ascii", "double").replace("vertex 3", "vertex 6").replace("property uchar red\n", "")
    file = tmp_path / "roof.ply"
    file.write_text(f"{head}{rows}\n6 0 1 2 3 4 5\n")
    vertices, triangles = read_ply(file)
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    areas = np.cross(b - a, c - a)[:, 2] / 2 * sense
    assert len(areas) == 4
    assert areas.min() >= 0
    assert areas.sum() == pytest.approx(3.0)
    middles = (a + b + c)[areas > 0, :2] / 3
    assert not (middles > 1).all(1).any()
