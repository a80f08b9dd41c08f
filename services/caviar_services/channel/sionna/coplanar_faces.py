"""Coplanar faces of bodies that touch or overlap one another or scenery: one surface.

Two lorries side by side with flush walls, or a kiosk flush with a façade, reflect as one wall does. Taken
for two planes, a wave would be reflected by each where both overlap, and by the one or the other, at random,
where a ray meets what coincides. So in each frame such faces are joined: they have one number, by which
chains of planes go, and one id.

The geometry of scenery may give other fields than its author expects, which is warned of once, before the
run. Of faces of two materials in one plane (`coinciding_materials`) waves meet one. Of a closed thin wall
(`closed_walls`) the ray tracer takes each face as a slab of its material's thickness, so that a wave crosses
such a wall twice.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.messages import WARNING
from caviar_services.channel.sionna.scene_loading import Shape
from caviar_space.meshes import Mesh
from caviar_space.planes import PlaneTable, is_closed
from caviar_space.vectors import cross, ranges

COPLANAR = 1e-5
"""[m]; faces are in one plane to this, and `COPLANAR_RELATIVE` of their coordinates: about what float32 tells
apart. One that stands farther behind another is hidden by it where they overlap."""

COPLANAR_RELATIVE = 1.2e-7

# [rad]; between the normals of coplanar faces, at most.
_ANGLE = 3e-5

# [m]; boxes around faces that are nearer touch.
_TOUCHING = 1e-3


@dataclass(frozen=True, eq=False)
class JoinedFaces:
    """The faces of a frame that are one surface."""

    label: Int64Array
    """Of each plane, the number of the surface that it is of: that of its first plane, Shape ``[P]``."""
    groups: tuple[Int64Array, ...] = ()
    """Planes of each surface that is more than one, in ascending order: those of scenery come first."""
    scenery: dict[int, int] = field(default_factory=dict)
    """By label, the first triangle of scenery that a face touches, for surfaces that scenery is a part of."""


class CoplanarFaces:
    """Finds the faces of bodies that are one surface with others.

    Args:
        table: Planes of scenery, and after them those of bodies, body after body.
        first: Number of the first plane of a body.
        sizes: How many planes each body has, Shape ``[V]``.
        two_sided: Of each plane of a body, whether both of its sides reflect, Shape ``[P − first]``; of
            others that face away from each other one at most is seen.
    """

    def __init__(self, table: PlaneTable, first: int, sizes: Int64Array, two_sided: BoolArray) -> None:
        self._table, self._first, self._sizes, self._two_sided = table, first, sizes, two_sided
        self._begin = first + np.cumsum(sizes) - sizes
        # Random weights: planes that differ hardly ever have the same sum. The seed is fixed, as is the
        # order.
        rng = np.random.default_rng(0)
        self._direction = rng.standard_normal(4)
        self._direction /= np.abs(self._direction).sum()
        self._reach = float(np.abs(table.origin[:first]).max(initial=1.0))
        still = np.flatnonzero((table.normal[:first] != 0).any(1))
        order = np.argsort(self._projected(still))
        self._still, self._keys = still[order], self._projected(still)[order]
        self.none = JoinedFaces(np.arange(len(table.normal)))

    def find(self) -> JoinedFaces:
        """Faces that are one surface as the table stands."""
        table = self._table
        moving = np.arange(self._first, len(table.normal))
        moving = moving[(table.normal[moving] != 0).any(1)]
        one, other = self._of_bodies()
        together = self._coplanar(one, other)
        one, other = one[together], other[together]
        body, still = self._with_scenery(moving)
        together = self._coplanar(body, still)
        body, still = body[together], still[together]
        triangle = self._touched(body, still)
        touching = triangle >= 0
        body, still, triangle = body[touching], still[touching], triangle[touching]
        if not len(one) + len(body):
            return self.none
        pairs = np.column_stack([np.append(other, still), np.append(one, body)])
        return self._joined(pairs, still, triangle)

    def _joined(self, pairs: Int64Array, still: Int64Array, triangle: Int64Array) -> JoinedFaces:
        """Surfaces of planes that are one, pair by pair, and the triangles of planes of scenery that these
        touch."""
        label = self.none.label.copy()
        members = np.unique(pairs)
        while True:
            # Labels spread along the pairs until none changes.
            least = np.minimum(label[pairs[:, 0]], label[pairs[:, 1]])
            before = label[members].copy()
            for side in (0, 1):
                np.minimum.at(label, pairs[:, side], least)
            if (label[members] == before).all():
                break
        groups = tuple(members[label[members] == first] for first in np.unique(label[members]))
        # Descending: of equal labels the dictionary keeps the last, the lowest triangle.
        order = np.argsort(-triangle)
        touched = dict(zip(label[still[order]].tolist(), triangle[order].tolist(), strict=True))
        return JoinedFaces(label, groups, touched)

    def _of_bodies(self) -> tuple[Int64Array, Int64Array]:
        """Planes of one body and of another whose boxes touch, that may be coplanar."""
        none = np.zeros(0, np.int64)
        if len(self._sizes) < 2:
            return none, none
        table, begin = self._table, self._begin - self._first
        flat = (table.normal[self._first :] != 0).any(1)[:, None]
        low = np.minimum.reduceat(np.where(flat, table.low[self._first :], np.inf), begin)
        high = np.maximum.reduceat(np.where(flat, table.high[self._first :], -np.inf), begin)
        some = np.flatnonzero(np.isfinite(low).all(1))
        # Sorted along x, only bodies whose extents overlap there are compared.
        some = some[np.argsort(low[some, 0], kind="stable")]
        last = np.searchsorted(low[some, 0], high[some, 0] + _TOUCHING, side="right")
        place, behind = ranges(np.arange(len(some)) + 1, np.maximum(last - np.arange(len(some)) - 1, 0))
        one, other = some[place], some[behind]
        touch = ((low[one] <= high[other] + _TOUCHING) & (low[other] <= high[one] + _TOUCHING)).all(1)
        one, other = one[touch], other[touch]
        if not len(one):
            return none, none
        pair, first = ranges(self._begin[one], self._sizes[one])
        row, second = ranges(self._begin[other[pair]], self._sizes[other[pair]])
        one, other = first[row], second
        touch = (
            (table.low[one] <= table.high[other] + _TOUCHING)
            & (table.low[other] <= table.high[one] + _TOUCHING)
        ).all(1)
        one, other = one[touch], other[touch]
        same = np.einsum("nc,nc->n", table.normal[one], table.normal[other])
        seen = (same > 0) | self._two_sided[one - self._first] | self._two_sided[other - self._first]
        kept = seen & (np.abs(same) > 0.5)
        return one[kept], other[kept]

    def _with_scenery(self, moving: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Planes of bodies and of scenery whose normals and offsets agree, about."""
        reach = 2.0 * _ANGLE
        found = [np.zeros((0, 2), np.int64)]
        for sign in (1.0, -1.0):
            key = sign * self._projected(moving)
            first = np.searchsorted(self._keys, key - reach)
            own, place = ranges(first, np.searchsorted(self._keys, key + reach, side="right") - first)
            found.append(np.column_stack([moving[own], self._still[place]]))
        body, still = np.concatenate(found).T
        table = self._table
        touch = (
            (table.low[body] <= table.high[still] + _TOUCHING)
            & (table.low[still] <= table.high[body] + _TOUCHING)
        ).all(1)
        return body[touch], still[touch]

    def _projected(self, planes: Int64Array) -> Float64Array:
        """Normals and offsets of planes as one number each, of opposite sign for the opposite normal: what
        hardly differs stands near in the order of these."""
        normal = self._table.normal[planes]
        offset = np.einsum("nc,nc->n", normal, self._table.origin[planes]) / self._reach
        projected: Float64Array = normal @ self._direction[:3] + offset * self._direction[3]
        return projected

    def _touched(self, body: Int64Array, still: Int64Array) -> Int64Array:
        """Of pairs of planes, the first triangle of scenery whose box the body's face touches; −1: none."""
        triangles, sizes = self._table.triangles_of(still)
        own = np.repeat(np.arange(len(still)), sizes)
        corners = self._table.corners_of(triangles)
        plane = body[own]
        touch = (corners.min(1) <= self._table.high[plane] + _TOUCHING) & (
            self._table.low[plane] <= corners.max(1) + _TOUCHING
        )
        hits = touch.all(1)
        found = np.full(len(body), np.iinfo(np.int64).max)
        np.minimum.at(found, own[hits], triangles[hits])
        return np.where(found < np.iinfo(np.int64).max, found, -1)

    def _coplanar(self, one: Int64Array, other: Int64Array) -> BoolArray:
        """Of pairs of planes, whether all corners of the one are in the other."""
        if not len(one):
            return np.zeros(0, np.bool_)
        table = self._table
        across = np.abs(cross(table.normal[one], table.normal[other])).max(1)
        within: BoolArray = across <= _ANGLE
        rows = np.flatnonzero(within)
        triangles, sizes = table.triangles_of(one[rows])
        own = np.repeat(rows, sizes)
        places = table.corners_of(triangles)
        height = np.einsum("ntc,nc->nt", places - table.origin[other[own]][:, None], table.normal[other[own]])
        slack = COPLANAR + COPLANAR_RELATIVE * np.abs(places).max((1, 2))
        off = np.abs(height).max(1) > slack
        within[own[off]] = False
        return within


# [m]; what overlaps, or stands out, by less does not.
_NEAR = 1e-3

# Vertical part of the normal of grounds and roofs, at least.
_LYING = 0.5

# Faces of a closed wall are no farther apart than this many thicknesses of its material.
_THICKNESSES = 2.0


def coinciding_materials(shapes: Sequence[Shape], plane: Int64Array) -> tuple[str, ...]:
    """Warn of pieces of different materials that overlap in one plane, where waves can meet them.

    A floor of a house on the ground, and the common wall of two houses, are inside: no wave comes there.

    Args:
        shapes: The scenery, one shape a material.
        plane: Number of the plane of each triangle, Shape ``[F]``.
    """
    pieces = [(name, shape) for shape in shapes for name in shape.names]
    meshes = [mesh for shape in shapes for mesh in shape.meshes]
    if len(shapes) < 2:
        return ()
    triangles = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    piece = np.repeat(np.arange(len(meshes)), [len(mesh.faces) for mesh in meshes])
    material = np.repeat(np.arange(len(shapes)), [len(shape.meshes) for shape in shapes])[piece]
    begin = np.flatnonzero(np.diff(piece, prepend=-1))
    order = np.lexsort((material, plane))
    starts = np.flatnonzero(np.diff(plane[order], prepend=-1))
    found: set[tuple[int, int]] = set()
    for rows in np.split(order, starts[1:]):
        if material[rows[0]] == material[rows[-1]]:
            continue
        a, b, c = np.moveaxis(triangles[rows], 1, 0)
        normals = cross(b - a, c - a)
        largest = int(np.einsum("fx,fx->f", normals, normals).argmax())
        length = float(np.linalg.norm(normals[largest]))
        if not length:
            continue
        normal = normals[largest] / length
        height = (triangles - a[largest]) @ normal
        sides: tuple[float, ...] = (1.0, -1.0)
        if abs(normal[2]) > _LYING:  # grounds and roofs are met from above
            sides = (1.0,) if normal[2] > 0 else (-1.0,)
        for side in sides:
            # What stands out of the plane on a side covers it there.
            covered = np.maximum.reduceat((side * height).max(1), begin) > _NEAR
            free = rows[~covered[piece[rows]]]
            flat = np.delete(triangles[free], int(np.abs(normal).argmax()), axis=2)
            for row, corners in zip(free.tolist(), flat, strict=True):
                others = free[material[free] > material[row]]
                over = others[_overlaps(corners, flat[material[free] > material[row]])]
                found.update((int(piece[row]), int(other)) for other in np.unique(piece[over]))
    if not found:
        return ()
    (one, of_one), (other, of_other) = (pieces[number] for number in min(found))
    more = f", as do {len(found) - 1} more pairs" if len(found) > 1 else ""
    note = (
        f"{WARNING}{one!r} of material {of_one.material.name!r} and {other!r} of {of_other.material.name!r} "
        f"overlap in one plane{more}: waves meet {one!r} alone there; leave one out, or move it a millimetre "
        "to the side that it is to be met from"
    )
    return (note,)


def _overlaps(triangle: Float64Array, others: Float64Array) -> BoolArray:
    """Whether triangles overlap one by more than `_NEAR`: none of their edges parts them (the separating axis
    theorem). Shapes ``[3, 2]`` and ``[N, 3, 2]`` [m]."""
    both = np.concatenate([np.broadcast_to(triangle, others.shape), others], axis=1)
    edges = np.concatenate([np.roll(part, -1, axis=1) - part for part in np.split(both, 2, axis=1)], axis=1)
    axes = np.stack([-edges[..., 1], edges[..., 0]], axis=-1)
    axes /= np.maximum(np.linalg.norm(axes, axis=-1, keepdims=True), 1e-300)
    at = np.einsum("nax,ncx->nac", axes, both)
    depth = np.minimum(at[..., :3].max(-1), at[..., 3:].max(-1)) - np.maximum(
        at[..., :3].min(-1), at[..., 3:].min(-1)
    )
    overlap: BoolArray = (depth > _NEAR).all(1)
    return overlap


def closed_walls(shapes: Sequence[Shape], face: Int64Array, transparent: Collection[str]) -> tuple[str, ...]:
    """Warn of closed meshes two faces of which are the two sides of one wall.

    Args:
        shapes: The scenery, one shape a material.
        face: Number of the flat face of each triangle, counted through all pieces, Shape ``[F]``.
        transparent: Ids of the shapes that waves go through.
    """
    found, begin = [], 0
    for shape in shapes:
        thickness = float(shape.material.thickness[0])
        for name, mesh in zip(shape.names, shape.meshes, strict=True):
            own = face[begin : begin + len(mesh.faces)]
            begin += len(mesh.faces)
            apart = 0.0
            if shape.id in transparent:
                apart = _wall(mesh, own - own.min(), _THICKNESSES * thickness)
            if apart:
                found.append((name, shape.material.name, apart, thickness))
    if not found:
        return ()
    name, material, apart, thickness = found[0]
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    note = (
        f"{WARNING}{name!r}{more} is a closed wall, {apart:.3g} m between its faces: each face is a slab of "
        f"{thickness:g} m of {material!r}, so that waves cross two slabs; make it one open sheet"
    )
    return (note,)


def _wall(mesh: Mesh, number: Int64Array, most: float) -> float:
    """Distance [m] of the nearest two faces of a closed mesh, at most ``most``, between which it is solid; 0
    where there are none."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - mesh.vertices.mean(0), 1, 0)
    areas = cross(b - a, c - a)
    count = int(number.max(initial=-1)) + 1
    normal = np.stack([np.bincount(number, axis, count) for axis in areas.T], axis=-1)
    size = np.linalg.norm(normal, axis=1)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for corner in (a, b, c):
        np.minimum.at(low, number, corner)
        np.maximum.at(high, number, corner)
    first = np.zeros(count, np.int64)
    first[number[::-1]] = np.arange(len(number))[::-1]
    # A closed mesh whose normals lead inwards has a volume below 0.
    outwards = np.sign(np.einsum("fx,fx->", a, areas))
    flat = np.flatnonzero(size > 0)
    normal = outwards * normal[flat] / size[flat, None]
    leading = np.take_along_axis(normal, np.abs(normal).argmax(1)[:, None], 1)[:, 0]
    line = np.round(normal * np.sign(leading)[:, None], 3) + 0.0
    offset = np.einsum("nx,nx->n", a[first[flat]], normal * np.sign(leading)[:, None])
    order = np.lexsort((offset, *line.T))
    here, there = order[:-1], order[1:]
    distance = offset[there] - offset[here]
    wall = (line[here] == line[there]).all(1) & (leading[here] < 0) & (leading[there] > 0)
    wall &= (distance > 0) & (distance <= most)
    reach = distance[:, None] + _NEAR
    low, high = low[flat], high[flat]
    wall &= ((low[here] < high[there] + reach) & (low[there] < high[here] + reach)).all(1)
    return float(distance[wall].min()) if wall.any() and is_closed(mesh) else 0.0
