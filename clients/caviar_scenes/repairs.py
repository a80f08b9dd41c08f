"""Repair of a scene's geometry: what `caviar_scenes.checks` finds and a program can mend."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.errors import SetupError
from caviar_protocol.host import install_command
from caviar_scenes.checks import SLIVER_M, THIN_M, Parts
from caviar_scenes.opened import OpenedScene
from caviar_space.meshes import Mesh, joined
from caviar_space.walls import solid_walls

Repaired = dict[str, list[tuple[Mesh, float | None]]]
"""Meshes [m] and the thickness of their walls [m], by name of the piece; None: that of the material."""


@dataclass(frozen=True)
class Size:
    """Size of a piece."""

    triangles: int
    area_m2: float
    volume_m3: float
    """Within what is closed; the walls of a sheet have none."""


@dataclass(frozen=True)
class Change:
    """Change of a piece."""

    piece: str
    before: Size
    after: Size
    what: tuple[str, ...]


def repair(scene: OpenedScene, thin_m: float = THIN_M, union: bool = False) -> tuple[Repaired, list[Change]]:
    """Repair the pieces of a scene.

    Corners are welded, slivers and duplicate faces dropped, closed bodies turned with the outside in front,
    and closed plates folded to sheets of their thickness.

    Args:
        scene: The scene.
        thin_m: Plates up to this thickness are folded [m]; 0: none is.
        union: Whether closed bodies of one material that overlap become one.

    Raises:
        SetupError: Unions are asked for, and manifold3d is not installed.
    """
    names = list(scene.meshes)
    parts = Parts(list(scene.meshes.values()))
    said: dict[str, list[str]] = {name: [] for name in names}

    def count(which: BoolArray, what: str) -> None:
        for piece, number in zip(*np.unique(parts.piece[which], return_counts=True), strict=True):
            said[names[int(piece)]].append(f"{number} {what}")

    again, corner = parts.duplicates(), _without_short_sides(parts)
    flat = parts.slivers() & ((corner == np.roll(corner, -1, axis=1)).any(1) | ~parts.closed()[parts.part])
    count(flat, "slivers dropped")
    count(again, "duplicate faces dropped")
    kept = ~(flat | again)
    meshes: dict[str, Mesh] = {}
    for number, name in enumerate(names):
        used, faces = np.unique(corner[kept & (parts.piece == number)], return_inverse=True)
        mesh = Mesh(parts.points[used], faces.reshape(-1, 3).astype(np.int32))
        meshes[name], turned = _outward(mesh)
        if len(used) < len(scene.meshes[name].vertices):
            said[name].append(f"{len(scene.meshes[name].vertices) - len(used)} corners welded")
        if turned:
            said[name].append(f"{turned} faces turned")
    if union:
        _unite(scene, meshes, said)
    done: Repaired = {}
    for name, mesh in meshes.items():
        done[name] = [(mesh, None)] if len(mesh.faces) else []
        if thin_m > 0 and name not in scene.foliage and len(mesh.faces):
            done[name] = solid_walls(mesh, thin_m)
            said[name] += [f"folded to sheets of {t:g} m" for _, t in done[name] if t is not None]
    return done, [
        Change(name, _size(scene.meshes[name]), _size(joined([m for m, _ in done[name]])), tuple(what))
        for name, what in said.items()
        if what
    ]


def _without_short_sides(parts: Parts) -> Int64Array:
    """Corners of triangles where the ends of a sliver's side that is shorter than it may be are one."""
    low = parts.slivers()
    ends = np.stack([parts.corner, np.roll(parts.corner, -1, axis=1)], axis=-1)[low].reshape(-1, 2)
    short = np.linalg.norm(np.diff(parts.points[ends], axis=1)[:, 0], axis=1) <= SLIVER_M
    stands_for = np.arange(len(parts.points))
    for one, other in np.sort(ends[short], axis=1).tolist():
        stands_for[stands_for == stands_for[other]] = stands_for[one]
    return stands_for[parts.corner]


def _outward(mesh: Mesh) -> tuple[Mesh, int]:
    """Closed parts of a mesh with the outside in front, and how many faces that turned."""
    parts = Parts([mesh])
    closed = parts.closed() & (np.bincount(parts.part, minlength=parts.count) > 3)
    mixed = np.bincount(parts.edge_part, parts.is_mixed, parts.count) > 0
    turned = np.zeros(len(mesh.faces), np.bool_)
    for part in np.flatnonzero(closed & mixed).tolist():
        rows = np.flatnonzero(parts.part == part)
        turned[rows] = _against_first(parts.corner[rows])
    faces = np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces)
    inward = closed & (Parts([Mesh(mesh.vertices, faces)]).volumes() < 0)
    turned ^= inward[parts.part]
    return Mesh(mesh.vertices, np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces)), int(turned.sum())


def _against_first(faces: Int64Array) -> BoolArray:
    """Faces of one part that have the other side in front than the first, across the edges of two faces."""
    at: dict[tuple[int, int], list[int]] = {}
    sides = [list(zip(face, face[1:] + face[:1], strict=True)) for face in faces.tolist()]
    for number, of in enumerate(sides):
        for a, b in of:
            at.setdefault((min(a, b), max(a, b)), []).append(number)
    against = np.zeros(len(faces), np.bool_)
    seen, waiting = {0}, deque([0])
    while waiting:
        number = waiting.popleft()
        for a, b in sides[number]:
            for other in at[min(a, b), max(a, b)]:
                if other not in seen and len(at[min(a, b), max(a, b)]) == 2:
                    seen.add(other)
                    waiting.append(other)
                    against[other] = against[number] ^ ((a, b) in sides[other])
    return against


def _unite(scene: OpenedScene, meshes: dict[str, Mesh], said: Mapping[str, list[str]]) -> None:
    """Unite closed pieces of one material whose boxes overlap; the first of them is the union."""
    try:
        from manifold3d import Manifold, OpType
        from manifold3d import Mesh as Solid
    except ImportError as error:
        raise SetupError(
            f"unions need manifold3d, of the extra `scenes`; run: {install_command('scenes')}"
        ) from error
    solids, boxes = {}, {}
    for name, mesh in meshes.items():
        if name in scene.foliage or not len(mesh.faces) or not Parts([mesh]).closed().all():
            continue
        solid = Manifold(Solid(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)))
        if not solid.is_empty():
            solids[name], boxes[name] = solid, (mesh.vertices.min(0), mesh.vertices.max(0))
    left = list(solids)
    while left:
        group = [left.pop(0)]
        for one in group:
            material, (low, high) = scene.shapes[one].radio, boxes[one]
            near = [
                other
                for other in left
                if scene.shapes[other].radio == material
                and (boxes[other][0] <= high).all()
                and (boxes[other][1] >= low).all()
            ]
            group += near
            left = [name for name in left if name not in near]
        if len(group) == 1:
            continue
        made = Manifold.batch_boolean([solids[name] for name in group], OpType.Add).to_mesh()
        meshes[group[0]] = Mesh(
            made.vert_properties[:, :3].astype(np.float64), made.tri_verts.astype(np.int32)
        )
        said[group[0]].append(f"united with {len(group) - 1} pieces")
        for name in group[1:]:
            meshes[name] = Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
            said[name].append(f"united into {group[0]}")


def _size(mesh: Mesh) -> Size:
    if not len(mesh.faces):
        return Size(0, 0.0, 0.0)
    parts = Parts([mesh])
    areas: Float64Array = np.linalg.norm(parts.normals(), axis=1)
    volume = float(np.abs(parts.volumes())[parts.closed()].sum())
    return Size(len(mesh.faces), float(areas.sum()), volume)
