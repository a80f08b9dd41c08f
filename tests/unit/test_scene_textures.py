"""Textures of imported models: kept by every step, shown by cameras, and noted where they are damaged."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scene_builders import glb

from caviar_scenes.materials import read_scene, with_materials
from caviar_scenes.opened import open_scene, write_changed
from caviar_scenes.views import Eye, camera
from caviar_space.imported_scenes import ImportedScene, cut_to_box, write_scene
from caviar_space.meshes import Mesh
from caviar_space.sources import read_source

Image = pytest.importorskip("PIL.Image")
PIXELS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [250, 200, 20]]], np.uint8)


def wall(file: Path, image: bytes | None = None, uv: Any = None, **texture: Any) -> ImportedScene:
    """A wall of 4 m by 4 m across y, as seen from the south, with a picture of four colours."""
    out = io.BytesIO()
    Image.fromarray(PIXELS).save(out, "PNG")
    places = np.array([[-2, 0, -5], [2, 0, -5], [2, 4, -5], [-2, 4, -5]], "<f4").tobytes()
    coordinates = np.array([[0, 1], [1, 1], [1, 0], [0, 0]] if uv is None else uv, "<f4")
    parts = [places, coordinates.tobytes(), np.array([0, 1, 2, 0, 2, 3], "<u4").tobytes()]
    parts.append(out.getvalue() if image is None else image)
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    kinds = (4, "VEC3"), (len(coordinates), "VEC2"), (6, "SCALAR")
    document = {
        "asset": {"version": "2.0"}, "nodes": [{"mesh": 0, "name": "wall"}],
        "meshes": [{"primitives": [
            {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
        ]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, **texture}}}],
        "textures": [{"source": 0}], "images": [{"bufferView": 3}], "buffers": [{"byteLength": starts[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": at, "byteLength": len(part)}
            for at, part in zip(starts, parts, strict=False)
        ],
        "accessors": [
            {"bufferView": n, "componentType": 5125 if n == 2 else 5126, "count": count, "type": kind}
            for n, (count, kind) in enumerate(kinds)
        ],
    }  # fmt: skip
    file.write_bytes(glb(document, b"".join(parts)))
    return read_source(file)


def corners_of(scene: ImportedScene, height: float = 2.0) -> list[list[int]]:
    """Colours that a camera sees of the wall: upper left and right, lower left and right."""
    eye = Eye({name: piece.mesh for name, piece in scene.pieces.items()})
    device = camera("", (0.0, 0.0, height), (90.0, 0.0, 0.0), 40.0, (60, 60))
    textures = [piece.texture for piece in scene.pieces.values()]
    drawn = eye.paint(device, np.full((len(textures), 3), 0.5), textures=textures)
    return drawn[[20, 20, 40, 40], [20, 40, 20, 40]].tolist()


@pytest.mark.slow
def test_cameras_see_textures_after_every_step(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    scene, colours = wall(tmp_path / "a.glb"), PIXELS.reshape(-1, 3).tolist()
    write_scene(scene, tmp_path / "a")
    again = read_scene(str(tmp_path / "a"))
    split, _ = with_materials(again, {"wall": ["glass", ""]})
    write_scene(split, tmp_path / "b")
    cut_to_box(scene, (-1.5, 4.0, 1.8, 6.0))
    for one in (again, read_scene(str(tmp_path / "b")), scene):
        assert corners_of(one) == colours
    opened = open_scene(str(tmp_path / "a"))
    mesh = opened.meshes["wall"]
    write_changed(opened, {"wall": [(mesh, None)]}, tmp_path / "same", {}, "")
    assert corners_of(read_scene(str(tmp_path / "same"))) == colours
    write_changed(opened, {"wall": [(Mesh(mesh.vertices, mesh.faces[1:]), None)]}, tmp_path / "less", {}, "")
    assert read_scene(str(tmp_path / "less")).pieces["wall"].texture is None
    assert not (tmp_path / "less" / "textures").exists()
    assert "textures of 1 pieces" in json.loads((tmp_path / "less" / "scene.json").read_bytes())["notes"][-1]
    turn = {"KHR_texture_transform": {"offset": [0, 1], "rotation": math.pi / 2}}  # clockwise by a quarter
    turned = corners_of(wall(tmp_path / "t.glb", extensions=turn))
    assert turned == [colours[2], colours[0], colours[3], colours[1]]


@pytest.mark.parametrize(
    "damage",
    [
        {"image": b"\x89PNG\r\n"}, {"uv": [[0, 1], [1, 1], [1, 0]]}, {"uv": [[0, math.nan]] * 4},
        {"texCoord": 1}, {"index": 7},
    ],
)  # fmt: skip
def test_a_damaged_texture_is_noted_and_left_out(tmp_path: Path, damage: dict[str, Any]) -> None:
    scene = wall(tmp_path / "a.glb", **damage)
    assert scene.pieces["wall"].texture is None
    assert any("textures of surfaces" in note for note in scene.notes)
