"""Faults of a scene's geometry that rays meet: found, counted, and named with their places.

Corners in one cell of a grid of `WELD_M` are one. A part is what hangs together by corners within a piece: of
a mesh that holds a whole quarter, one house.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_scenes.opened import OpenedScene
from caviar_space.ground import STEEP, are_ground
from caviar_space.mesh_detail import piece_numbers
from caviar_space.meshes import Mesh
from caviar_space.vectors import cross
from caviar_space.walls import overlapping_pieces, planes_of, solid_wall

WELD_M = 1e-4
"""Grid of corners that are one [m]."""
THIN_M = 0.5
"""Closed bodies up to this thickness are walls [m]."""
SLIVER_M = 1e-3
"""A triangle lower than this is a sliver [m]."""
GAP_M = 0.5
"""A part this far above the ground, and above all others, floats [m]."""

_BOTTOM_M = 0.1
_SHEET = 0.6
_WALLS = 0.02
_CELL_M = 40.0


@dataclass(frozen=True)
class Kind:
    """A kind of fault."""

    name: str
    effect: str
    remedy: str
    wrong: bool = False
    """Whether received powers are wrong by it."""


KINDS = {
    kind.name: kind
    for kind in (
        Kind("thin closed wall", "with refraction, waves cross two slabs in place of one",
             'repair folds it, or solid_walls_m of the channel', wrong=True),
        Kind("duplicate face", "with refraction, a slab more is crossed; reflections are drawn among both",
             "repair drops it", wrong=True),
        Kind("overlapping materials", "waves meet the first piece's material alone",
             "leave one out, or move it 1 mm to the side that it is met from", wrong=True),
        Kind("open foliage", "a run refuses foliage that encloses no volume", "close it", wrong=True),
        Kind("hole", "rays enter the body, and leave it elsewhere", "close it in the program it is from"),
        Kind("mixed normals", "faces of one body count as met from both sides, which is slower",
             "repair turns them"),
        Kind("inside out", "faces count as met from both sides, which is slower", "repair turns it"),
        Kind("floating", "rays pass below it", "move it down, or leave it out"),
        Kind("sunken", "no ray meets it", "leave it out: simplify does"),
        Kind("sliver", "time, and edges that diffract nothing", "repair drops it"),
    )
}  # fmt: skip
"""By name; those that make received powers wrong come first."""


@dataclass(frozen=True)
class Fault:
    """A fault at one place."""

    kind: str
    piece: str
    place: tuple[float, float, float]
    """[m]"""
    note: str = ""


class Parts:
    """Triangles of all pieces, with the connected parts that they are of.

    Args:
        meshes: Of the pieces [m].
    """

    def __init__(self, meshes: Sequence[Mesh]) -> None:
        self.meshes = meshes
        corners: list[Float64Array] = [mesh.vertices[mesh.faces] for mesh in meshes]
        self.triangles: Float64Array = np.concatenate([np.zeros((0, 3, 3)), *corners]).astype(np.float64)
        """Shape ``[F, 3, 3]`` [m]."""
        self.piece: Int64Array = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
        """Number of the piece of each triangle, Shape ``[F]``."""
        grid = np.round(self.triangles.reshape(-1, 3) / WELD_M).astype(np.int64)
        points, origin, corner = np.unique(grid, axis=0, return_index=True, return_inverse=True)
        self.points: Float64Array = self.triangles.reshape(-1, 3)[origin]
        """Corners [m], Shape ``[V, 3]``."""
        self.corner: Int64Array = corner.reshape(-1, 3)
        """Numbers of the corners of each triangle, equal in all pieces, Shape ``[F, 3]``."""
        # A corner of two pieces is one of each.
        own, ids = np.unique(self.corner + self.piece[:, None] * len(points), return_inverse=True)
        ids = ids.reshape(-1, 3)
        stand_in = np.repeat(np.arange(len(own), dtype=float)[:, None], 3, axis=1)
        self.part = piece_numbers(Mesh(stand_in, ids.astype(np.int32)))
        """Number of the part of each triangle, Shape ``[F]``."""
        sides = np.stack([ids, np.roll(ids, -1, axis=1)], axis=-1).reshape(-1, 2)
        real = sides[:, 0] != sides[:, 1]
        sides, owner = sides[real], np.repeat(self.part, 3)[real]
        ends, first, edge, count = np.unique(
            np.sort(sides, axis=1), axis=0, return_index=True, return_inverse=True, return_counts=True
        )
        ways = np.bincount(edge.reshape(-1), np.where(sides[:, 0] < sides[:, 1], 1, -1), len(ends))
        self.edges: Int64Array = own[ends] % max(len(points), 1)
        """Corners of each edge of each piece, Shape ``[E, 2]``."""
        self.edge_part: Int64Array = owner[first]
        """Part that each edge is of, Shape ``[E]``."""
        self.is_open: BoolArray = count % 2 == 1
        """Whether an odd number of triangles is at an edge, Shape ``[E]``."""
        self.is_mixed: BoolArray = (count % 2 == 0) & (ways != 0)
        """Whether of two triangles at an edge one faces out and the other in, Shape ``[E]``."""
        _, place, pieces = np.unique(self.edges, axis=0, return_inverse=True, return_counts=True)
        self.is_rim: BoolArray = (count == 1) & (pieces[place.reshape(-1)] == 1)
        """Whether an edge is open and no other piece has it, Shape ``[E]``: roofs may close walls."""

    @property
    def count(self) -> int:
        """Number of parts."""
        return int(self.part.max(initial=-1)) + 1

    def sums(self, values: Float64Array) -> Float64Array:
        """Sums of a value of each triangle over the triangles of each part, Shape ``[P]``."""
        total: Float64Array = np.bincount(self.part, values, self.count).astype(np.float64)
        return total

    def boxes(self) -> tuple[Float64Array, Float64Array]:
        """Lowest and highest corners of parts [m], Shape ``[P, 3]`` each."""
        low, high = np.full((self.count, 3), np.inf), np.full((self.count, 3), -np.inf)
        np.minimum.at(low, self.part, self.triangles.min(1))
        np.maximum.at(high, self.part, self.triangles.max(1))
        return low, high

    def first(self) -> Int64Array:
        """First triangle of each part, Shape ``[P]``."""
        first: Int64Array = np.unique(self.part, return_index=True)[1]
        return first

    def normals(self) -> Float64Array:
        """Areas of triangles times their normals [m²], Shape ``[F, 3]``."""
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        return cross(b - a, c - a) / 2

    def volumes(self) -> Float64Array:
        """Volume within each part [m³], below 0 where its normals lead inwards, Shape ``[P]``."""
        low, high = self.boxes()
        a = self.triangles[:, 0] - ((low + high) / 2)[self.part]
        return self.sums(np.einsum("fx,fx->f", a, self.normals()) / 3)

    def closed(self) -> BoolArray:
        """Whether each part has no open edge, Shape ``[P]``."""
        closed: BoolArray = np.bincount(self.edge_part, self.is_open, self.count) == 0
        return closed

    def duplicates(self) -> BoolArray:
        """Triangles that are there a second time: in their piece, or in another one with the same front.

        The common wall of two houses, each of which has it with the outside in front, is none.
        """
        order = np.sort(self.corner, axis=1)
        _, group = np.unique(order, axis=0, return_inverse=True)
        # Even permutations of the corners have the same front.
        turned = (np.diff(self.corner, axis=1) < 0).sum(1) + (self.corner[:, 0] > self.corner[:, 2])
        front = turned % 2
        again = np.zeros(len(order), np.bool_)
        for key in (group * 2 + front, group * (len(self.meshes) + 1) + self.piece):
            first = np.unique(key, return_index=True)[1]
            other = np.ones(len(key), np.bool_)
            other[first] = False
            again |= other
        double: BoolArray = again & ~self.slivers()
        return double

    def slivers(self) -> BoolArray:
        """Triangles that are lower than `SLIVER_M`, or have no area."""
        sides = np.linalg.norm(np.roll(self.triangles, -1, axis=1) - self.triangles, axis=2).max(1)
        low: BoolArray = 2 * np.linalg.norm(self.normals(), axis=1) <= SLIVER_M * sides
        return low

    def mesh(self, part: int) -> Mesh:
        """Mesh of a part, corners that are one joined."""
        used, faces = np.unique(self.corner[self.part == part], return_inverse=True)
        return Mesh(self.points[used], faces.reshape(-1, 3).astype(np.int32))


def check(scene: OpenedScene, thin_m: float = THIN_M) -> list[Fault]:
    """Find the faults of a scene, kind by kind in the order of `KINDS`.

    Args:
        scene: The scene.
        thin_m: Closed bodies up to this thickness are walls [m].
    """
    names = list(scene.meshes)
    parts = Parts(list(scene.meshes.values()))
    low, high = parts.boxes()
    owner = parts.piece[parts.first()]
    leaves = np.isin(owner, [names.index(name) for name in scene.foliage])
    faults: list[Fault] = []

    def put(kind: str, piece: int, place: Any, note: str = "") -> None:
        x, y, z = (round(float(value), 2) for value in place)
        faults.append(Fault(kind, names[piece], (x, y, z), note))

    def put_parts(kind: str, which: Any, notes: Sequence[str] | None = None) -> None:
        for number, part in enumerate(np.flatnonzero(which).tolist()):
            put(kind, int(owner[part]), (low[part] + high[part]) / 2, notes[number] if notes else "")

    closed = parts.closed()
    mixed = np.bincount(parts.edge_part, parts.is_mixed, parts.count).astype(np.int64)
    volume = parts.volumes()
    shortest = np.ptp(np.stack([low, high]), axis=0)
    # A plate fits no box that is thinner than it; of those that stand aslant the volume says more.
    size = parts.sums(np.linalg.norm(parts.normals(), axis=1))
    plates = closed & ~leaves & (mixed == 0) & (2 * np.abs(volume) <= 1.05 * thin_m * size)
    for part in np.flatnonzero(plates & (shortest.max(1) > thin_m)).tolist():
        if found := solid_wall(parts.mesh(part), thin_m):
            put("thin closed wall", int(owner[part]), (low[part] + high[part]) / 2, f"{found[1]:.3g} m")
    again = parts.duplicates() & ~leaves[parts.part]
    for triangle in np.flatnonzero(again).tolist():
        put("duplicate face", int(parts.piece[triangle]), parts.triangles[triangle].mean(0))
    for one, other, place in _overlaps(scene, names):
        put("overlapping materials", one, place, f"with {names[other]}")
    put_parts("open foliage", leaves & ~closed)
    ends = parts.points[parts.edges][..., 2]
    raised = parts.is_rim & (ends.max(1, initial=-np.inf) > low[parts.edge_part, 2] + _BOTTOM_M)
    holes = np.bincount(parts.edge_part, raised, parts.count).astype(np.int64)
    sheet = np.linalg.norm([parts.sums(axis) for axis in parts.normals().T], axis=0) > _SHEET * size
    open_bodies = (holes > 0) & ~sheet & ~leaves
    put_parts("hole", open_bodies, [f"{count} open edges" for count in holes[open_bodies]])
    some = closed & (mixed > 0)
    put_parts("mixed normals", some, [f"{count} edges" for count in mixed[some]])
    put_parts("inside out", closed & (mixed == 0) & (volume < -1e-9))
    for kind, which in _off_ground(parts, low, high).items():
        put_parts(kind, which & ~leaves)
    for triangle in np.flatnonzero(parts.slivers()).tolist():
        put("sliver", int(parts.piece[triangle]), parts.triangles[triangle].mean(0))
    return faults


def _overlaps(scene: OpenedScene, names: Sequence[str]) -> list[tuple[int, int, Float64Array]]:
    """Pairs of pieces of different materials that overlap in one plane, and a place of the second."""
    solid = [i for i, name in enumerate(names) if name not in scene.foliage and len(scene.meshes[name].faces)]
    radio = [getattr(scene.shapes[names[i]].radio, "name", "") for i in solid]
    # As the channel has them: material by material.
    order = sorted(range(len(solid)), key=lambda i: radio.index(radio[i]))
    meshes = [scene.meshes[names[solid[i]]] for i in order]
    material = np.unique([radio.index(radio[i]) for i in order], return_inverse=True)[1].reshape(-1)
    if len(np.unique(material)) < 2:
        return []
    pairs = overlapping_pieces(meshes, material, planes_of(meshes, material))
    return [(solid[order[a]], solid[order[b]], meshes[b].vertices.mean(0)) for a, b in sorted(pairs)]


def _off_ground(parts: Parts, low: Float64Array, high: Float64Array) -> dict[str, BoolArray]:
    """Parts that float, and that lie below the ground, by kind of fault."""
    normals = parts.normals()
    size = np.linalg.norm(normals, axis=1)
    steep = np.bincount(parts.piece, size * (np.abs(normals[:, 2]) < STEEP * size), len(parts.meshes))
    flat = steep <= _WALLS * np.bincount(parts.piece, size, len(parts.meshes))
    # Ground is the lowest of what has no walls: what lies below all of that is none.
    top = np.full(len(parts.meshes), -np.inf)
    np.maximum.at(top, parts.piece, parts.triangles[..., 2].max(1))
    lowest = parts.triangles[flat[parts.piece], :, 2].min(initial=np.inf)
    above = np.flatnonzero(top >= lowest).tolist()
    level = np.isin(
        parts.piece, np.array(above, np.int64)[are_ground([parts.meshes[piece] for piece in above])]
    )
    body = np.ones(parts.count, np.bool_)
    body[parts.part[level]] = False
    ground = _heights(parts.triangles[level], ((low + high) / 2)[:, :2])
    known = body & np.isfinite(ground)
    floating = known & (low[:, 2] > ground + GAP_M)
    # What stands on a roof, or hangs at a wall, touches another part's box.
    wide = (high - low)[:, 0] > _CELL_M
    narrow, large = np.flatnonzero(body & ~wide), np.flatnonzero(body & wide)
    narrow = narrow[np.argsort(low[narrow, 0], kind="stable")]
    starts = low[narrow, 0]
    for part in np.flatnonzero(floating).tolist():
        ends = low[part, 0] - GAP_M - _CELL_M, high[part, 0] + GAP_M
        near = np.concatenate([narrow[slice(*np.searchsorted(starts, ends))], large])
        touch = (low[near] <= high[part] + GAP_M).all(1) & (high[near] >= low[part] - GAP_M).all(1)
        floating[part] = not (touch & (near != part)).any()
    return {"floating": floating, "sunken": known & (high[:, 2] < ground - 1e-3)}


def _heights(ground: Float64Array, places: Float64Array) -> Float64Array:
    """Highest z of triangles, Shape ``[T, 3, 3]``, at x and y, Shape ``[N, 2]``; NaN: none is there."""
    a, b, c = np.moveaxis(ground, 1, 0)
    area = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    lying = np.abs(area) > 1e-12
    ground, area = ground[lying], area[lying]
    low, high = ground[..., :2].min(1), ground[..., :2].max(1)
    found = np.full(len(places), np.nan)
    # Cell by cell, since most triangles are in few of them.
    cell = np.floor(places / _CELL_M).astype(np.int64)
    order = np.lexsort(cell.T)
    begins = np.flatnonzero((np.diff(cell[order], axis=0, prepend=np.nan) != 0).any(1))
    for rows in np.split(order, begins[1:]):
        p = places[rows, None]
        near = ((low <= p.max((0, 1))) & (high >= p.min((0, 1)))).all(1)
        a, b, c = np.moveaxis(ground[near], 1, 0)
        u = ((p[..., 0] - a[:, 0]) * (c - a)[:, 1] - (p[..., 1] - a[:, 1]) * (c - a)[:, 0]) / area[near]
        v = ((b - a)[:, 0] * (p[..., 1] - a[:, 1]) - (b - a)[:, 1] * (p[..., 0] - a[:, 0])) / area[near]
        within = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9)
        z = np.where(within, a[:, 2] + u * (b - a)[:, 2] + v * (c - a)[:, 2], -np.inf)
        found[rows] = z.max(1, initial=-np.inf)
    return np.where(np.isfinite(found), found, np.nan)
