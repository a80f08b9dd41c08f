"""Triangles that lie in one plane: what a specular path meets is a plane of an object, not a triangle.

The largest triangle defines a plane and claims every smaller one within tolerance of it; of the rest, again
the largest, and so on. Taken one after the other this costs as many comparisons as there are planes times
triangles. Here planes are points in a space of four coordinates, unit normal and offset, which is cut into
cells: only triangles that share a cell are compared, and all triangles that are the largest of each of their
cells define their planes at once: a greedy clustering over a hash grid. The result is that of the sequence.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_space.meshes import Mesh
from caviar_space.vectors import cross, ranges

# Room for rounding beyond the tolerances, so that no pair within them falls into separate cells.
_SLACK = 1.001

# Width of a cell in tolerances: narrow ones make many copies of a triangle, wide ones many comparisons.
_CELL = 2.0

# Meshes of more triangles than the first are searched for planes that hold one of so many of them.
_LARGE, _MANY = 20_000, 50

# Comparisons at once, about.
_AT_ONCE = 1_000_000

LieIn = Callable[[Int64Array, Int64Array], BoolArray]
"""Whether triangles lie in the planes of others, given by their numbers."""

# Normals are turned to this side; along no axis, so that few of a scene are at its border.
_HEMISPHERE = np.array([0.5377, 0.3071, 0.7852])


def coplanar(
    triangles: Float64Array, normals: Float64Array, mesh: Int64Array, distance: Float64Array, angle: float
) -> Int64Array:
    """For each triangle, the first of its mesh in whose plane it lies and that defines one, Shape ``[F]``.

    Args:
        triangles: Corners [m], Shape ``[F, 3, 3]``, each with an area; the earlier one defines the plane of
            both.
        normals: Unit normals, of either sense, Shape ``[F, 3]``.
        mesh: Number of the mesh that each is of, Shape ``[F]``.
        distance: Of corners from the plane at most [m], by mesh.
        angle: [rad] between both normals at most.
    """

    def lie_in(these: Int64Array, others: Int64Array) -> BoolArray:
        across = np.sqrt((cross(normals[these], normals[others]) ** 2).sum(1))
        near = np.flatnonzero(across <= angle)
        these, others = these[near], others[near]
        off = np.einsum("fcx,fx->fc", triangles[these] - triangles[others, :1], normals[others])
        lie = np.zeros(len(across), np.bool_)
        lie[near] = (np.abs(off) <= distance[mesh[these], None]).all(1)
        return lie

    plane = np.full(len(triangles), len(triangles))
    defined = np.zeros(len(triangles), np.bool_)
    for number in np.flatnonzero(np.bincount(mesh) > _LARGE).tolist():
        _claim_large_planes(np.flatnonzero(mesh == number), plane, defined, lie_in)
    rest = np.flatnonzero((plane == len(triangles)) & ~defined)
    _claim_by_cells(rest, *_cells(triangles[rest], normals[rest], mesh[rest], distance, angle), plane, lie_in)
    defining: Int64Array = np.minimum(plane, np.arange(len(triangles)))
    return defining


def _claim_large_planes(triangles: Int64Array, plane: Int64Array, defined: BoolArray, lie_in: LieIn) -> None:
    """Let the triangles of a mesh define planes one after the other, as long as each claims many of them."""
    while len(triangles) > _LARGE:
        first, others = triangles[0], triangles[1:]
        defined[first] = True
        lie = lie_in(others, np.full(len(others), first))
        plane[others[lie]] = first
        triangles = others[~lie]
        if lie.sum() * _MANY < len(others):
            return


def _claim_by_cells(
    rows: Int64Array, entry: Int64Array, cell: Int64Array, plane: Int64Array, lie_in: LieIn
) -> None:
    """Let triangles define planes all at once that are the first of each of their cells, until none is left.

    ``entry`` and ``cell`` are what `_cells` returned for the triangles ``rows``.
    """
    entry = rows[entry]
    begin = np.flatnonzero(_begins(cell))
    size = np.diff(np.append(begin, len(cell)))
    copies = np.bincount(entry, minlength=len(plane))
    pending = copies > 0
    waiting = np.arange(len(entry))
    while len(waiting):
        cells = cell[waiting]
        starts = np.flatnonzero(_begins(cells))
        cells, first = cells[starts], np.minimum.reduceat(entry[waiting], starts)
        defining, count = np.unique(first, return_counts=True)
        defining = defining[count == copies[defining]]
        some = np.isin(first, defining)
        cells, first = cells[some], first[some]
        for part in np.split(np.arange(len(cells)), _parts(size[cells])):
            of, held = ranges(begin[cells[part]], size[cells[part]])
            these, by = entry[held], first[part][of]
            # Of several planes that of the earliest triangle, also where a later one has claimed it before.
            later = np.flatnonzero(plane[these] > by)
            these, by = these[later], by[later]
            lie = (these > by) & lie_in(these, by)
            np.minimum.at(plane, these[lie], by[lie])
            pending[these[lie]] = False
        pending[defining] = False
        waiting = waiting[pending[entry[waiting]]]


def _parts(sizes: Int64Array) -> Int64Array:
    """Cuts of these sizes into parts of about `_AT_ONCE` together."""
    number = np.cumsum(sizes) // _AT_ONCE
    return np.flatnonzero(number[1:] != number[:-1]) + 1


def _cells(
    triangles: Float64Array, normals: Float64Array, mesh: Int64Array, distance: Float64Array, angle: float
) -> tuple[Int64Array, Int64Array]:
    """Triangles and the cells, numbered from 0, that each may share with others of its plane, sorted by cell.

    Cells of one triangle alone are left out.
    """
    corner, reach = _about_middles(triangles[:, 0], mesh, len(distance))
    number = np.arange(len(triangles))
    side = normals @ _HEMISPHERE
    normals = np.where(side[:, None] < 0, -normals, normals)
    border = np.flatnonzero(np.abs(side) <= 2 * angle)
    number = np.concatenate([number, border])
    normals = np.concatenate([normals, -normals[border]])
    offset = np.einsum("fx,fx->f", corner[number], normals)
    # Offsets of planes that differ in the normal, too: by the angle times the distance of the corner.
    width = _SLACK * np.maximum(distance + angle * reach, 1e-300)
    place = np.column_stack([normals / (_SLACK * angle), offset / width[mesh[number]]])
    low = np.floor((place - 0.5) / _CELL).astype(np.int64)
    spans = np.floor((place + 0.5) / _CELL).astype(np.int64) > low
    low -= low.min(0, initial=0)
    strides = np.cumprod([1, *(low.max(0, initial=0) + 2)[:-1]])
    parts = []
    for step in itertools.product((0, 1), repeat=4):
        rows = np.flatnonzero((spans | ~np.array(step, np.bool_)).all(1))
        parts.append((number[rows], (low[rows] + step) @ strides))
    triangle, key = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(key) if len(distance) == 1 else np.lexsort((key, mesh[triangle]))
    triangle, key = triangle[order], key[order]
    cell = np.cumsum(_begins(key) | _begins(mesh[triangle])) - 1
    shared = np.bincount(cell, minlength=1)[cell] > 1
    triangle, cell = triangle[shared], cell[shared]
    return triangle, np.cumsum(_begins(cell)) - 1


def _about_middles(points: Float64Array, mesh: Int64Array, meshes: int) -> tuple[Float64Array, Float64Array]:
    """Points [m] relative to the means of those of their meshes, Shape ``[F, 3]``, and the farthest of each
    mesh, by mesh."""
    counts = np.maximum(np.bincount(mesh, minlength=meshes), 1)
    means = np.stack([np.bincount(mesh, axis, meshes) for axis in points.T], axis=-1) / counts[:, None]
    points = points - means[mesh]
    reach = np.zeros(meshes)
    np.maximum.at(reach, mesh, np.sqrt(np.einsum("fx,fx->f", points, points)))
    return points, reach


def _begins(values: Int64Array) -> BoolArray:
    """Mask of the beginnings of runs of equal values."""
    begins = np.ones(len(values), np.bool_)
    begins[1:] = values[1:] != values[:-1]
    return begins


# Farthest corner from the plane, as a part of the mesh's extent; float32 corners are within 1e-7.
_OFF_PLANE = 2e-5

# [rad] Largest angle between the normals of a plane's triangles.
_ANGLE = 2e-4

# Corners this near, as a part of a mesh's extent, are one.
_SAME_CORNER = 1e-6

# [m]; a point this near a triangle is one of it.
_RIM = 1e-3


def plane_numbers(mesh: Mesh) -> Int32Array:
    """Number of the plane that each triangle of a mesh lies in, Shape ``[F]``.

    Planes are numbered in the order of their first triangles, so a number stays what it is while the
    mesh moves, turns and is stretched: what lies in one plane does so afterwards. Triangles need not touch:
    a path has one point in a plane at most. A triangle without area is a plane of its own.

    Args:
        mesh: Any.

    Example:
        >>> from caviar_space.meshes import unit_box
        >>> plane_numbers(unit_box()).tolist()
        [0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    """
    return plane_numbers_of([mesh])[0]


def plane_numbers_of(meshes: Sequence[Mesh]) -> list[Int32Array]:
    """`plane_numbers` of each of many meshes, all at once.

    Args:
        meshes: Any.
    """
    if not meshes:
        return []
    counts = [len(mesh.faces) for mesh in meshes]
    of = np.repeat(np.arange(len(meshes)), counts)
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    normal = cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    flat = area > 0
    normal[flat] /= area[flat, None]
    extents = [float(np.ptp(mesh.vertices, axis=0).max()) if len(mesh.vertices) else 0.0 for mesh in meshes]
    # The largest triangle's normal is the most exact one: it defines the plane.
    order = np.argsort(-area, kind="stable")
    order = order[flat[order]]
    distance = _OFF_PLANE * np.array(extents)
    first = np.arange(len(of))
    first[order] = order[coplanar(corners[order], normal[order], of[order], distance, _ANGLE)]
    ends = np.cumsum(counts)
    return [_in_order(label) for label in np.split(first, ends[:-1])]


def _in_order(label: Int64Array) -> Int32Array:
    """Labels renumbered in the order in which they first occur."""
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int32)
    rank[np.argsort(first)] = np.arange(len(first), dtype=np.int32)
    return rank[inverse.reshape(-1)]


# [m]; of two faces in about one plane rays meet the one that lies above the other by more than this.
_ABOVE = 2e-4


def shared_planes(table: PlaneTable, material: Int64Array) -> Int64Array:
    """Number of the infinite plane that each plane of a table is a part of, Shape ``[P]``.

    The first planes, which stand still, share one where they agree to a grid of 1e-4 in the
    normal and 1 mm in the offset: the walls of a row of houses reflect as one. Different materials share one
    only where rays cannot tell which lies above the other. The others are on their own.

    Args:
        table: Planes of faces.
        material: Number of the material of each plane that stands still, Shape ``[S]``.
    """
    count = len(material)
    if not count:
        return np.arange(len(table.normal))
    normal, middle = table.normal[:count], (table.low[:count].min(0) + table.high[:count].max(0)) / 2
    # One of both directions of a normal: that whose first component of some size is positive.
    leading = np.argmax(np.abs(normal) > 1e-3, axis=1)
    normal = normal * np.where(np.take_along_axis(normal, leading[:, None], 1) < 0, -1.0, 1.0)
    offset = ((table.origin[:count] - middle) * normal).sum(1)
    cells = np.round(np.column_stack([normal * 1e4, offset * 1e3])).astype(np.int64)
    flat = np.flatnonzero((normal != 0).any(1))
    label = np.arange(len(table.normal))
    _, cell = np.unique(cells[flat], axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    label[flat] = _apart_by_material(table, flat, cell, offset, material)
    return _in_order(label).astype(np.int64)


def _apart_by_material(
    table: PlaneTable, flat: Int64Array, cell: Int64Array, offset: Float64Array, material: Int64Array
) -> Int64Array:
    """For each of the planes ``flat``, one of its cell that it shares its plane with: any, unless a plane of
    another material lies above or below it there, by a gap that rays resolve."""
    order = np.lexsort((offset[flat], cell))
    begins = _begins(cell[order])
    first = np.flatnonzero(begins)
    least, most = (reduce.reduceat(material[flat[order]], first) for reduce in (np.minimum, np.maximum))
    starts, ends = first, np.append(first[1:], len(order))
    for start, end in zip(starts[least < most], ends[least < most], strict=True):
        planes = flat[order[start:end]]
        low, high, of = table.low[planes], table.high[planes] + _RIM, material[planes]
        for gap in np.flatnonzero(np.diff(offset[planes]) > _ABOVE) + 1:
            touch = (low[:gap, None] <= high[None, gap:] + _RIM) & (
                low[None, gap:] <= high[:gap, None] + _RIM
            )
            begins[start + gap] = (touch.all(2) & (of[:gap, None] != of[None, gap:])).any()
    found = np.empty_like(flat)
    found[order] = flat[order][np.flatnonzero(begins)[np.cumsum(begins) - 1]]
    return found


class PlaneTable:
    """Table of the planes of many meshes: a triangle of each, and the box around all of its triangles.

    Args:
        numbers: Plane of each triangle, counted through all meshes from 0, Shape ``[F]``.
        faces: Corners of each triangle, Shape ``[F, 3]``.
    """

    def __init__(self, numbers: Int64Array, faces: Int64Array) -> None:
        self._faces = faces
        self._numbers = numbers
        self._corners = np.zeros((0, 3))
        self._order = np.argsort(numbers, kind="stable")
        count = int(numbers.max(initial=-1)) + 1
        self._begin = np.searchsorted(numbers[self._order], np.arange(count))
        self._sizes = np.diff(np.append(self._begin, len(numbers)))
        self.triangle = np.zeros(count, np.int64)
        """The triangle that stands for each plane."""
        self.origin = np.zeros((count, 3))
        """A point of each plane [m]."""
        self.normal = np.zeros((count, 3))
        """Unit normal; 0 where a plane has no area."""
        self.low = np.zeros((count, 3))
        """Box around the triangles of each plane [m]."""
        self.high = np.zeros((count, 3))
        # Of triangles, over the axes: planes of thousands are searched, the ground with all floors on it.
        self._lows, self._highs = np.zeros((2, 3, len(numbers)))
        # All planes of a surface, by each of them but the first.
        self._joined: Mapping[int, Int64Array] = {}

    def update(self, corners: Float64Array, planes: Int64Array | None = None) -> None:
        """Find planes anew.

        Args:
            corners: Of all meshes [m], Shape ``[V, 3]``; the table keeps them.
            planes: Numbers of those that have moved; None: all.
        """
        self._corners = corners
        if planes is None:
            planes = np.arange(len(self._begin))
        if not len(planes):
            return
        order, sizes = self.triangles_of(planes)
        begin = np.cumsum(sizes) - sizes
        triangles = corners[self._faces[order]]
        a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
        normal = cross(b - a, c - a)
        square = np.einsum("fc,fc->f", normal, normal)
        largest = np.maximum.reduceat(square, begin)
        hits = np.flatnonzero(square == np.repeat(largest, sizes))
        chosen = hits[np.searchsorted(hits, begin)]
        self.triangle[planes] = order[chosen]
        self.origin[planes] = a[chosen]
        length = np.sqrt(largest)[:, None]
        self.normal[planes] = normal[chosen] / np.where(length > 0, length, 1.0)
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        self._lows[:, order], self._highs[:, order] = low.T, high.T
        self.low[planes] = np.minimum.reduceat(low, begin)
        self.high[planes] = np.maximum.reduceat(high, begin)

    def join(self, groups: Sequence[Int64Array]) -> None:
        """Take planes for one surface, until `update` is called for the first of each group: the box of the
        first is around all of them.

        Args:
            groups: Planes of each surface, in ascending order.
        """
        self._joined = {plane: group for group in groups for plane in group[1:].tolist()}
        if groups:
            planes, begin = np.concatenate(groups), np.cumsum([0, *map(len, groups[:-1])])
            self.low[planes[begin]] = np.minimum.reduceat(self.low[planes], begin)
            self.high[planes[begin]] = np.maximum.reduceat(self.high[planes], begin)

    def corners_of(self, triangles: Int64Array) -> Float64Array:
        """Corners of triangles [m], Shape ``[N, 3, 3]``.

        Args:
            triangles: Numbers, Shape ``[N]``.
        """
        corners: Float64Array = self._corners[self._faces[triangles]]
        return corners

    def triangles_of(self, planes: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Numbers of the triangles of planes, plane after plane, and how many each has.

        Args:
            planes: Numbers.
        """
        sizes = self._sizes[planes]
        return self._order[ranges(self._begin[planes], sizes)[1]], sizes

    def touching(
        self, planes: Int64Array, low: Float64Array, high: Float64Array
    ) -> tuple[Int64Array, Int64Array]:
        """Triangles of planes whose box touches another one.

        Args:
            planes: Numbers, Shape ``[N]``.
            low, high: Of a box for each plane [m], Shape ``[N, 3]`` each.

        Returns:
            Row of the plane, and the triangle, in ascending order of both, Shape ``[M]`` each.
        """
        row, place = ranges(self._begin[planes], self._sizes[planes])
        triangle = self._order[place]
        for axis in range(3):
            kept = (self._lows[axis, triangle] <= high[row, axis]) & (
                low[row, axis] <= self._highs[axis, triangle]
            )
            row, triangle = row[kept], triangle[kept]
        return row, triangle

    def first_holding(self, triangles: Int64Array, points: Float64Array) -> Int64Array:
        """Find the first triangle of the same surface that holds a point too.

        Where faces coincide, the floor of a house and the ground below it, or two houses' common wall, a ray
        hits whichever was looked at first, which depends on the rays beside it.

        Args:
            triangles: That hold the points, Shape ``[N]``.
            points: [m], Shape ``[N, 3]``.
        """
        if not len(triangles):
            return triangles
        plane = self._numbers[triangles]
        # At an acute corner a rim reaches farther than its width.
        hit, candidate = self.touching(plane, points - 100 * _RIM, points + 100 * _RIM)
        held = _holds(self._corners[self._faces[candidate]], points[hit])
        first = triangles.copy()
        # Within a plane triangles are in ascending order.
        hits, where = np.unique(hit[held], return_index=True)
        first[hits] = candidate[held][where]
        for row, group in enumerate(map(self._joined.get, plane.tolist()) if self._joined else ()):
            if group is None:
                continue
            others = np.sort(self.triangles_of(group)[0])
            others = others[others < first[row]]
            holding = others[_holds(self.corners_of(others), points[np.full(len(others), row)])]
            first[row] = holding[0] if len(holding) else first[row]
        return first


def _holds(triangles: Float64Array, points: Float64Array) -> BoolArray:
    """Test whether points lie in triangles of their plane or at most `_RIM` outside, Shape ``[N]``."""
    normal = cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normal, axis=1)
    inside: BoolArray = length > 0
    normal /= np.where(inside, length, 1.0)[:, None]
    for corner in range(3):
        edge = triangles[:, (corner + 1) % 3] - triangles[:, corner]
        across = (cross(edge, points - triangles[:, corner]) * normal).sum(1)
        inside &= across >= -_RIM * np.linalg.norm(edge, axis=1)
    return inside


def two_sided_planes(mesh: Mesh, numbers: Int32Array) -> BoolArray:
    """Test whether the planes of a mesh can be met from both sides, by number, Shape ``[N]``.

    From outside of a closed surface whose normals lead outwards, only front faces are met. Every side of a
    triangle then belongs to as many triangles that go along it one way as the other.

    Args:
        mesh: Any.
        numbers: Plane of each triangle, Shape ``[F]``.

    Example:
        >>> from caviar_space.meshes import unit_box
        >>> two_sided_planes(unit_box(), plane_numbers(unit_box())).any()
        np.False_
    """
    count = int(numbers.max(initial=-1)) + 1
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if float(np.einsum("fc,fc->", corners[:, 0] - corners.mean((0, 1)), normal)) <= 0 or not is_closed(mesh):
        return np.ones(count, np.bool_)
    # Two parts of one plane may face each other's back.
    order = np.argsort(-np.einsum("fc,fc->f", normal, normal), kind="stable")
    largest = np.zeros((count, 3))
    largest[numbers[order[::-1]]] = normal[order[::-1]]
    against: Float64Array = np.einsum("fc,fc->f", normal, largest[numbers])
    two_sided = np.zeros(count, np.bool_)
    two_sided[numbers[against < 0]] = True
    return two_sided


def is_closed(mesh: Mesh) -> bool:
    """Test whether a mesh encloses a volume, with all normals to one side.

    Args:
        mesh: Any.
    """
    extent = float(np.ptp(mesh.vertices, axis=0).max()) if len(mesh.vertices) else 0.0
    if extent == 0:
        return False
    cells = np.round(mesh.vertices / (_SAME_CORNER * extent)).astype(np.int64)
    corner = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)[mesh.faces]
    some = (corner != np.roll(corner, -1, axis=1)).all(1)
    sides = np.stack([corner[some], np.roll(corner[some], -1, axis=1)], axis=-1).reshape(-1, 2)
    return _counted(sides) == _counted(sides[:, ::-1])


def _counted(sides: Int64Array) -> Sequence[list[int]]:
    found, counts = np.unique(sides, axis=0, return_counts=True)
    rows: list[list[int]] = np.column_stack([found, counts]).tolist()
    return rows


COPLANAR = 1e-5
"""[m]; faces are in one plane to this, and `COPLANAR_RELATIVE` of their coordinates: about what float32 tells
apart. One that stands farther behind another is hidden by it where they overlap."""


COPLANAR_RELATIVE = 1.2e-7


# [rad]; between the normals of coplanar faces, at most.
_JOINED_ANGLE = 3e-5

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
    """Finds the faces of bodies that are one surface with others: coplanar ones that touch or overlap.

    Two lorries side by side with flush walls, or a kiosk flush with a façade, reflect as one wall does. Taken
    for two planes, a wave would be reflected by each where both overlap, and by the one or the other, at
    random, where a ray meets what coincides. So in each frame such faces are joined: they have one number, by
    which chains of planes go, and one id.

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
        if not len(one) + len(body):  # the usual frame
            return self.none
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
        reach = 2.0 * _JOINED_ANGLE
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
        """First triangle of scenery, for pairs of planes, whose box the body's face touches; −1: none."""
        low, high = self._table.low[body] - _TOUCHING, self._table.high[body] + _TOUCHING
        own, triangles = self._table.touching(still, low, high)
        found = np.full(len(body), np.iinfo(np.int64).max)
        np.minimum.at(found, own, triangles)
        return np.where(found < np.iinfo(np.int64).max, found, -1)

    def _coplanar(self, one: Int64Array, other: Int64Array) -> BoolArray:
        """Mask of pairs of planes of which all corners of the one are in the other."""
        if not len(one):
            return np.zeros(0, np.bool_)
        table = self._table
        across = np.abs(cross(table.normal[one], table.normal[other])).max(1)
        within: BoolArray = across <= _JOINED_ANGLE
        rows = np.flatnonzero(within)
        triangles, sizes = table.triangles_of(one[rows])
        own = np.repeat(rows, sizes)
        places = table.corners_of(triangles)
        height = np.einsum("ntc,nc->nt", places - table.origin[other[own]][:, None], table.normal[other[own]])
        slack = COPLANAR + COPLANAR_RELATIVE * np.abs(places).max((1, 2))
        off = np.abs(height).max(1) > slack
        within[own[off]] = False
        return within
