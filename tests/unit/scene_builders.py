"""Small sources of scenes: glTF, CityJSON, 3D Tiles."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import pytest

trimesh = pytest.importorskip("trimesh")


def boxes() -> Any:
    """Two boxes of trimesh's, one of them turned."""
    one = trimesh.creation.box((4, 2, 3))
    one.apply_translation((1, 2, 3))
    one.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(name="Red Brick.001", baseColorFactor=[255, 0, 0, 255])
    )
    scene = trimesh.Scene()
    scene.add_geometry(one, node_name="house", geom_name="house")
    two = trimesh.creation.box((1, 1, 2))
    turn = trimesh.transformations.rotation_matrix(0.3, [1, 2, 3], [4, 5, 6])
    scene.add_geometry(two, node_name="tower", geom_name="tower", transform=turn)
    return scene


def glb(document: dict[str, Any], binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    chunks = (
        struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    )
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


SQUARE: dict[str, Any] = {
    "type": "CityJSON",
    "version": "1.0",
    "vertices": [
        [0, 0, 0],
        [4, 0, 0],
        [4, 4, 0],
        [0, 4, 0],
        [1, 1, 0],
        [1, 2, 0],
        [2, 2, 0],
        [2, 1, 0],
        [100, 50, 3],
    ],
    "CityObjects": {},
}


def surface(kind: str, lod: object, boundaries: list[Any], **more: Any) -> dict[str, Any]:
    return {"type": kind, "lod": lod, "boundaries": boundaries, **more}


BOX = {"box": [0, 0, 0, 10, 0, 0, 0, 10, 0, 0, 0, 10]}


def tile(error: float, uri: str = "", **more: Any) -> dict[str, Any]:
    return {
        "geometricError": error,
        "boundingVolume": BOX,
        **({"content": {"uri": uri}} if uri else {}),
        **more,
    }


def tileset(root: dict[str, Any]) -> str:
    return json.dumps(
        {"asset": {"version": "1.1"}, "geometricError": 100, "root": {"refine": "REPLACE", **root}}
    )


def content(place: tuple[float, float, float]) -> bytes:
    """A cube of 1 m whose lowest corner is at a place, in glTF's axes."""
    cube = trimesh.creation.box((1, 1, 1))
    cube.apply_translation(np.array(place) + 0.5)
    cube.vertices = cube.vertices[:, [0, 2, 1]] * [1, 1, -1]
    return bytes(trimesh.exchange.gltf.export_glb(trimesh.Scene(cube)))


def b3dm(model: bytes, table: dict[str, Any]) -> bytes:
    text = json.dumps(table).encode()
    return struct.pack("<4s6I", b"b3dm", 1, 28 + len(text) + len(model), len(text), 0, 0, 0) + text + model
