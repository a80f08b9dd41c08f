"""What stands still in a viewer: scenery by material, meshes of objects, and what ``about`` says of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array, Int32Array
from caviar_protocol.assets import is_mesh_name
from caviar_space.ground import are_ground
from caviar_space.meshes import Mesh, box, joined, object_meshes
from caviar_space.mitsuba_xml import find_scenery, read_scenery, world_mesh

MOST_TRIANGLES = 150_000
"""Triangles of all scenery that a page gets: software renderers draw a few of such pictures a second."""

# Colours [sRGB] where a description gives none: of façades, roofs and roads as one sees them from the air.
_COLORS = {
    "concrete": "#b8b4ab", "brick": "#b0705a", "plasterboard": "#e3ddd0", "wood": "#a98258",
    "glass": "#9cc3d5", "metal": "#8f99a5", "marble": "#d8d0c4", "wet_ground": "#8a8f78",
    "medium_dry_ground": "#a39a80", "very_dry_ground": "#c2b28f", "chipboard": "#b89a6f",
    "plywood": "#b89a6f", "ceiling_board": "#e0e0e0", "floorboard": "#a3825c",
}  # fmt: skip
_OTHER = "#b3b3b3"


@dataclass(frozen=True, eq=False)
class Group:
    """Scenery of one material and kind as one mesh.

    Args:
        material: Name of the material.
        color: sRGB, as ``#rrggbb``.
        kind: ``terrain``, ``building`` or ``foliage``.
        mesh: In the world [m].
        of: Triangles before thinning.
        parts: Name of each mesh, and its first triangle.
    """

    material: str
    color: str
    kind: str
    mesh: Mesh
    of: int
    parts: Sequence[tuple[str, int]]


class World:
    """Scenery and meshes of objects.

    Args:
        assets: Files by asset name.
        scenario: As it was resolved: foliage and boxes of its channel are drawn too.
        most: Triangles of all scenery.
    """

    def __init__(
        self, assets: Mapping[str, Path], scenario: Mapping[str, Any], most: int = MOST_TRIANGLES
    ) -> None:
        self._assets, self._most = assets, most
        services: Mapping[str, Any] = scenario.get("services") or {}
        self._channels: list[Mapping[str, Any]] = [
            spec["settings"]
            for spec in services.values()
            if isinstance(spec, dict)
            and spec.get("role") == "channel"
            and isinstance(spec.get("settings"), dict)
        ]

    @cached_property
    def groups(self) -> list[Group]:
        """Scenery by material and kind."""
        shapes = self._scenery()
        total = sum(len(mesh.faces) for _, _, _, mesh in shapes)
        level = are_ground([mesh for _, _, _, mesh in shapes])
        found: dict[tuple[str, str, str], list[tuple[str, Mesh]]] = {}
        for (name, material, color, mesh), is_ground in zip(shapes, level, strict=True):
            kind = "foliage" if material == "foliage" else "terrain" if is_ground else "building"
            found.setdefault((material, color, kind), []).append((name, mesh))
        share = min(1.0, self._most / max(total, 1))
        return [
            _group(material, color, kind, meshes, share) for (material, color, kind), meshes in found.items()
        ]

    @cached_property
    def objects(self) -> dict[str, Mesh]:
        """Unit meshes of objects by asset name; the box by the empty one."""
        files = {name: file for name, file in self._assets.items() if not is_mesh_name(name)}
        return object_meshes(files)

    def about(self) -> dict[str, Any]:
        """Materials, meshes and bounds, as the viewer asks for them."""
        groups, objects = self.groups, list(self.objects)
        corners = [group.mesh.vertices for group in groups if len(group.mesh.vertices)]
        low, high = (
            (np.min([c.min(0) for c in corners], 0), np.max([c.max(0) for c in corners], 0))
            if corners
            else (np.array([-50.0, -50.0, 0.0]), np.array([50.0, 50.0, 30.0]))
        )
        return {
            "materials": [
                {"name": group.material, "color": [c / 255 for c in bytes.fromhex(group.color[1:])]}
                for group in groups
            ],
            "meshes": [
                {
                    "id": str(number),
                    "name": group.material,
                    "material": number,
                    "kind": group.kind,
                    "triangles": len(group.mesh.faces),
                    "of": group.of,
                    "parts": [list(part) for part in group.parts],
                }
                for number, group in enumerate(groups)
            ],
            "assets": {name: f"object-{number}" for number, name in enumerate(objects)},
            "bounds": {"low": low.tolist(), "high": high.tolist()},
        }

    def mesh(self, name: str) -> bytes | None:
        """A mesh as the viewer asks for it: numbers of vertices and triangles, vertices [m] in single
        precision, triangles; None where there is no mesh of this id."""
        objects = list(self.objects.values())
        kind, _, number = name.rpartition("-")
        meshes = objects if kind == "object" else [group.mesh for group in self.groups] if not kind else []
        index = whole(number)
        if index is None or index >= len(meshes):
            return None
        mesh = meshes[index]
        sizes = np.array([len(mesh.vertices), len(mesh.faces)], "<u4")
        return b"".join(
            [sizes.tobytes(), mesh.vertices.astype("<f4").tobytes(), mesh.faces.astype("<u4").tobytes()]
        )

    def _scenery(self) -> list[tuple[str, str, str, Mesh]]:
        """Name, material, colour and mesh of each piece."""
        foliage = tuple(
            key.rstrip("*") for settings in self._channels for key in settings.get("foliage") or {}
        )
        description = find_scenery(self._assets)
        found = []
        for shape in read_scenery(description).shapes if description else ():
            is_foliage = bool(foliage) and shape.name.startswith(foliage)
            material = "foliage" if is_foliage else shape.itu_material or shape.material or "no material"
            color = "#6f9a5b" if is_foliage else _COLORS.get(shape.itu_material) or _srgb(shape.colour)
            found.append((shape.name, material, color, world_mesh(shape)))
        for settings in self._channels:
            for number, item in enumerate(settings.get("obstacles") or ()):
                ends = zip(item["minimum_m"], item["maximum_m"], strict=True)
                mesh = box(*((float(low), float(high)) for low, high in ends))
                found.append((f"obstacle {number}", "obstacle", _COLORS["concrete"], mesh))
        return found


def whole(text: str) -> int | None:
    """Read a whole number of an address, from 0 on and of 18 digits at most; None where it is none."""
    return int(text) if text.isascii() and text.isdigit() and len(text) <= 18 else None


def _srgb(linear: Sequence[float] | None) -> str:
    """Colour of linear sRGB as ``#rrggbb`` (IEC 61966-2-1); grey where there is none."""
    if linear is None:
        return _OTHER
    c = np.clip(np.asarray(linear, float), 0, 1)
    coded = np.where(c <= 0.0031308, 12.92 * c, 1.055 * c ** (1 / 2.4) - 0.055)
    return "#" + "".join(f"{round(255 * value):02x}" for value in coded)


def _group(material: str, color: str, kind: str, meshes: list[tuple[str, Mesh]], share: float) -> Group:
    thin = [_thinned(mesh, int(share * len(mesh.faces))) if share < 1 else mesh for _, mesh in meshes]
    starts = np.cumsum([0, *(len(mesh.faces) for mesh in thin)]).tolist()
    parts = [(name, start) for (name, _), start in zip(meshes, starts, strict=False)]
    return Group(material, color, kind, joined(thin), sum(len(mesh.faces) for _, mesh in meshes), parts)


def _thinned(mesh: Mesh, most: int) -> Mesh:
    """Merge vertices within cells of a grid until so few triangles are left; a mesh of few stays as it is."""
    most = max(most, 64)
    extent = float(np.ptp(mesh.vertices, axis=0).max(initial=0.0))
    cell = extent / 1024
    thin = mesh
    while len(thin.faces) > most:
        thin, cell = _clustered(mesh, cell), cell * 1.5
    return thin


def _clustered(mesh: Mesh, cell: float) -> Mesh:
    """Vertex clustering: vertices in one cell [m] become their mean (Rossignac and Borrel, 1993)."""
    places: Any = np.floor(mesh.vertices / cell).astype(np.int64)
    places -= places.min(0)
    size = places.max(0) + 1
    keys = (places[:, 0] * size[1] + places[:, 1]) * size[2] + places[:, 2]
    _, cluster, count = np.unique(keys, return_inverse=True, return_counts=True)
    vertices: Float64Array = np.stack([np.bincount(cluster, mesh.vertices[:, i]) for i in range(3)], 1)
    vertices /= count[:, None]
    faces: Int32Array = cluster[mesh.faces].astype(np.int32)
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, 1), axis=0, return_index=True)
    return Mesh(vertices, faces[np.sort(first)])
