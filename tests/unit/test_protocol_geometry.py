"""Meshes that worlds announce while a run goes on: their names, and what is refused."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import numpy as np
import pytest

from caviar_protocol.assets import (
    AssetStore,
    MeshCheck,
    digest_in,
    is_mesh_name,
    material_of,
    mesh_name,
    recorded_meshes,
    wrong_name,
)
from caviar_protocol.messages import Asset
from caviar_space.meshes import Mesh, fitted, ply, unit_box

BOX = unit_box()


def described(content: bytes) -> Asset:
    return Asset(name=mesh_name(content), digest=hashlib.sha256(content).hexdigest(), size=len(content))


def refusal(folder: Path, content: bytes, max_faces: int = 100) -> str:
    """Why a file is refused; empty: it is not."""
    store = AssetStore(folder)
    asset = store.add(mesh_name(content), content)
    return MeshCheck(store, max_faces).refusals([asset]).get(asset.name, "")


def moved(row: int, corner: tuple[float, float, float]) -> Mesh:
    vertices = BOX.vertices.astype(np.float64)
    vertices[row] = corner
    return Mesh(vertices, BOX.faces)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (ply(moved(3, (np.nan, 0.0, 0.0))), r"vertex 3 is at \[nan, 0.0, 0.0\]"),
        (ply(moved(5, (np.inf, 0.0, 0.0))), r"vertex 5 is at \[inf, 0.0, 0.0\]"),
        (ply(Mesh(BOX.vertices, BOX.faces[:0])), "has no faces"),
        (ply(Mesh(BOX.vertices, np.tile(BOX.faces, (9, 1)))), r"has 108 faces, the run takes 100 \(run"),
        (ply(Mesh(BOX.vertices * 2, BOX.faces)), r"spans \[-1.0, -1.0, -1.0\] to"),
        (ply(Mesh(BOX.vertices[:7], BOX.faces)), "faces refer to vertices 0 to 7 of 7"),
        (ply(BOX, "wodo"), "ITU-R P.2040 has no material 'wodo'; did you mean 'wood'"),
        (b"ply", "not a PLY file"),
        (b"", "not a PLY file"),
        (ply(BOX)[:-20], "not a PLY file"),
    ],
    ids=["nan", "inf", "no faces", "too many", "size", "vertex", "material", "header", "empty", "cut off"],
)  # fmt: skip
def test_a_file_that_is_no_mesh_is_refused_and_the_reason_names_what_is_wrong(
    tmp_path: Path, content: bytes, why: str
) -> None:
    assert re.search(why, refusal(tmp_path, content))


@pytest.mark.parametrize("content", [ply(BOX), ply(BOX, "metal")], ids=["plain", "of metal"])
def test_a_mesh_is_accepted(tmp_path: Path, content: bytes) -> None:
    assert refusal(tmp_path, content) == ""


def test_faces_are_counted_in_the_header_before_they_are_read(tmp_path: Path) -> None:
    """A header that announces millions of faces costs nothing, though not one of them follows."""
    content = ply(BOX).replace(b"element face 12", b"element face 99999999")
    assert "has 99999999 faces" in refusal(tmp_path, content)


def test_polygons_count_as_the_triangles_that_they_are_cut_into(tmp_path: Path) -> None:
    corners = [(-0.5, -0.5, -0.5), (0.5, -0.5, -0.5), (0.5, 0.5, 0.5), (-0.5, 0.5, 0.5)]
    lines = ["ply", "format ascii 1.0", "element vertex 4"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    lines += [" ".join(map(str, corner)) for corner in corners] + ["4 0 1 2 3"]
    content = "\n".join(lines).encode()
    assert refusal(tmp_path, content, max_faces=2) == ""
    assert "has 2 faces, the run takes 1" in refusal(tmp_path, content, max_faces=1)


def test_a_file_is_looked_into_once(tmp_path: Path) -> None:
    store = AssetStore(tmp_path)
    asset = store.add(mesh_name(b"ply"), b"ply")
    check = MeshCheck(store, 100)
    before = check.refusals([asset])
    store.path(asset.digest).unlink()
    assert check.refusals([asset]) == before != {}


def test_a_name_is_that_of_its_content_and_of_no_other() -> None:
    asset = described(b"ply")
    assert is_mesh_name(asset.name)
    assert digest_in(asset.name) == asset.digest
    assert wrong_name(asset) == ""
    for name in ("objects/crate.ply", mesh_name(b"other"), asset.name.upper(), f"{asset.name}\n"):
        wrong = Asset(name=name, digest=asset.digest, size=3)
        assert wrong_name(wrong) == f"its name has to be {asset.name}, after the SHA-256 of the file"
    assert not any(map(is_mesh_name, ("objects/crate.ply", asset.name.upper(), f"{asset.name}\n")))


def test_the_material_stands_in_the_header(tmp_path: Path) -> None:
    file = tmp_path / "crate.ply"
    for content, material in ((ply(BOX, "glass"), "glass"), (ply(BOX), ""), (b"", "")):
        file.write_bytes(content)
        assert material_of(file) == material
    assert material_of(tmp_path / "none.ply") == ""


def test_recorded_meshes_are_those_with_names_of_contents(tmp_path: Path) -> None:
    (tmp_path / "objects").mkdir()
    for name in ("objects/car.ply", mesh_name(b"a"), mesh_name(b"b")):
        (tmp_path / name).write_bytes(b"")
    assert list(recorded_meshes(tmp_path)) == sorted([mesh_name(b"a"), mesh_name(b"b")])
    assert recorded_meshes(tmp_path / "nowhere") == {}


def test_a_mesh_is_fitted_to_the_unit_box_and_back() -> None:
    rng = np.random.default_rng(3)
    mesh = Mesh(rng.normal(size=(20, 3)) * [4.0, 2.0, 1.0] + [7.0, 0.0, -3.0], BOX.faces)
    unit, dimensions, centre = fitted(mesh)
    np.testing.assert_allclose(unit.vertices.min(0), -0.5)
    np.testing.assert_allclose(unit.vertices.max(0), 0.5)
    np.testing.assert_allclose(unit.vertices * dimensions + centre, mesh.vertices)
