"""Numbers, pieces and planes of the triangles of the ray tracer's shapes, in float64.

A shape holds many pieces of scenery or many bodies. Ray tracers tell a shape and a triangle within it; here
triangles are numbered through all shapes, in the order of the shapes, and each belongs to a piece and lies
in a plane of it.

Coplanar faces of bodies that touch or overlap one another or scenery are one surface (`CoplanarFaces`).

The geometry of scenery may give other fields than its author expects, which is warned of once, before the
run. Of faces of two materials in one plane (`coinciding_materials`) waves meet one. Of a closed thin wall
(`closed_walls`) the ray tracer takes each face as a slab of its material's thickness, so that a wave crosses
such a wall twice.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_protocol.messages import WARNING
from caviar_services.channel.sionna.scene_loading import Shape
from caviar_space.meshes import Body, Mesh
from caviar_space.obstacles import Surfaces
from caviar_space.planes import (
    CoplanarFaces,
    JoinedFaces,
    PlaneTable,
    plane_numbers,
    plane_numbers_of,
    shared_planes,
    two_sided_planes,
)
from caviar_space.walls import LYING, overlapping_pieces, wall_thickness

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
    material = np.repeat(np.arange(len(shapes)), [len(shape.meshes) for shape in shapes])
    found = overlapping_pieces(meshes, material, plane)
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
                apart = wall_thickness(mesh, own - own.min(), _THICKNESSES * thickness)
            if apart:
                found.append((name, shape.material.name, apart, thickness))
    if not found:
        return ()
    name, material, apart, thickness = found[0]
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    note = (
        f"{WARNING}{name!r}{more} is a closed wall, {apart:.3g} m between its faces: each face is a slab of "
        f"{thickness:g} m of {material!r}, so that waves cross two slabs; set solid_walls_m, or make it one "
        "open sheet"
    )
    return (note,)


SurfaceNames = tuple[tuple[str, int], ...]
"""Objects, and planes of each, that surfaces of several objects are known by."""


class NumberedTriangles:
    """The triangles of shapes, of which the last ones may move; bodies are their last pieces.

    Args:
        shapes: In world coordinates.
        ids: Process-local number of each shape.
        bodies: What may move, in the order of the pieces.
        unit_meshes: Of the bodies, by asset.
        centre: What the ray tracer's coordinates are relative to [m], Shape ``[3]``.
        moving: How many shapes may move, one of each material of bodies.
    """

    def __init__(
        self,
        shapes: Sequence[Shape],
        ids: Int64Array,
        bodies: Sequence[Body],
        unit_meshes: Mapping[str, Mesh],
        centre: Float64Array,
        moving: int = 1,
    ) -> None:
        self.centre = centre
        """What the ray tracer's coordinates are relative to [m], Shape ``[3]``."""
        self.version = 0
        """Counts how often anything has moved."""
        self._bodies = tuple(bodies)
        meshes = [mesh for shape in shapes for mesh in shape.meshes]
        self._number_shapes(shapes, ids, moving)
        corners = np.array([len(mesh.vertices) for mesh in meshes])
        before = self._first_vertices = np.cumsum(corners) - corners
        self.vertices = np.concatenate([mesh.vertices for mesh in meshes])
        """All vertices as they stand [m], Shape ``[V, 3]``."""
        faces = [mesh.faces + begin for mesh, begin in zip(meshes, before, strict=True)]
        self.triangle_vertices = np.concatenate(faces)
        """Vertices of each triangle, Shape ``[F, 3]``."""
        self.names = tuple(name for shape in shapes for name in shape.names)
        """What the indices of `object_index` stand for while no body stands for an object."""
        self._piece_of = {body: piece for piece, body in enumerate(self._bodies, self.first_body_piece)}
        # Planes are found in the ray tracer's coordinates, where float64 loses nothing to a far origin.
        self.relative = self.vertices - centre
        """All vertices as they stand, in the ray tracer's coordinates [m], Shape ``[V, 3]``."""
        self.joined: JoinedFaces
        """Which faces are one surface."""
        material = np.repeat(np.arange(len(shapes)), [len(shape.meshes) for shape in shapes])
        self._number_planes(meshes, material, unit_meshes)
        last = [mesh for shape in shapes[-moving:] for mesh in shape.meshes]
        self._vertices = self.vertices[len(self.vertices) - sum(len(mesh.vertices) for mesh in last) :]
        self._first_moving = len(self.triangle_vertices) - sum(len(mesh.faces) for mesh in last)
        self.surfaces = Surfaces(self.vertices[self.triangle_vertices], self._points_outside)
        """All triangles, in world coordinates."""

    def count_from(self, centre: Float64Array) -> None:
        """Move everything to stand about another centre as it stood about the last.

        Args:
            centre: [m], Shape ``[3]``.
        """
        self.vertices += centre - self.centre
        self.centre = centre
        self.version += 1
        self.surfaces.move(np.arange(len(self.triangle_vertices)), self.vertices[self.triangle_vertices])

    def move(self, vertices: Float64Array) -> bool:
        """Move the bodies.

        Args:
            vertices: All that may move [m], Shape ``[V, 3]``.

        Returns:
            Whether any has moved.
        """
        changed = _any(vertices != self._vertices)
        if not changed.any():
            return False
        self._vertices[:] = vertices
        self.version += 1
        first = len(self.vertices) - len(vertices)
        self.relative[first:][changed] = vertices[changed] - self.centre
        # Most bodies of the pool stand for nothing: only what has moved is looked at.
        moved = _any(changed[self.triangle_vertices[self._first_moving :] - first])
        triangles = self._first_moving + np.flatnonzero(moved)
        planes = np.zeros(len(self.plane_table.triangle), np.bool_)
        planes[self.plane_of[triangles]] = True
        # Boxes of joined surfaces are around all of their planes: they are made anew.
        planes[[group[0] for group in self.joined.groups]] = True
        self.plane_table.update(self.relative, np.flatnonzero(planes))
        # Find the faces that are one surface now.
        before, self.joined = self.joined, self._coplanar.find()
        self.plane_table.join(self.joined.groups)
        if before.groups or self.joined.groups:
            self.surface_of = self.joined.label[self.plane_of]
        self.surfaces.move(triangles, self.vertices[self.triangle_vertices[triangles]])
        return True

    def surface_names(self, triangles: Int64Array, names: Sequence[str]) -> tuple[Int32Array, SurfaceNames]:
        """Name surfaces so that paths by way of them are known in other frames.

        A surface of several planes has the name of the first scenery that its bodies touch, else the least
        of its names.

        Args:
            triangles: Numbers, of any Shape.
            names: Of all pieces, as `SionnaScene.place` returned them.

        Returns:
            The number of the plane within its object, or where a body's face is one surface with others, −1
            minus the place of that surface among the second: object and plane of each such surface.
        """
        numbers = self._face_of[triangles].astype(np.int32)
        if not self.joined.groups:  # the usual frame
            return numbers, ()
        of, known = self.plane_of[triangles], []
        surface = np.where(of >= self.first_moving_plane, self.joined.label[of], -1)
        met = set(np.unique(surface).tolist())
        for group in self.joined.groups:
            if int(group[0]) not in met:
                continue
            its = surface == group[0]
            # Named by scenery, a surface has the same name whichever bodies stand at it.
            touched = self.joined.scenery.get(int(group[0]))
            members = self.plane_table.triangle[group] if touched is None else np.array([touched])
            pieces = self.piece_of(members).tolist()
            known.append(
                min((names[piece], int(self._face_of[t])) for piece, t in zip(pieces, members, strict=True))
            )
            numbers[its] = -len(known)
        return numbers, tuple(known)

    def begin_of(self, piece: int) -> tuple[int, int]:
        """Numbers of the first vertex and the first triangle of a piece.

        Args:
            piece: Its number.
        """
        return int(self._first_vertices[piece]), int(self._first_triangles[piece])

    @property
    def first_body_piece(self) -> int:
        """Number of the piece that is the first body; those of scenery come before."""
        return len(self.names) - len(self._bodies)

    @property
    def scenery_digest(self) -> bytes:
        """Digest of all triangles at rest and of their planes."""
        digest = hashlib.blake2b(digest_size=20)
        faces = self.triangle_vertices[: self._first_moving]
        still = self.vertices[: len(self.vertices) - len(self._vertices)]
        for part in (still - self.centre, faces, self.plane_of[: self._first_moving]):
            digest.update(np.ascontiguousarray(part).tobytes())
        return digest.digest()

    def bodies_of(self, asset: str) -> Int64Array:
        """Numbers of the bodies of an asset, counted through all bodies.

        Args:
            asset: Or the kind of body (`body_kind`).
        """
        return np.flatnonzero([of == asset for of, _ in self._bodies])

    def face_numbers(self, asset: str) -> Int32Array:
        """Number of the plane of each triangle of a body of an asset, within it.

        Args:
            asset: It has one body at least.
        """
        piece = self.first_body_piece + int(self.bodies_of(asset)[0])
        ends = np.append(self._first_triangles, len(self.triangle_vertices))
        return self._face_of[ends[piece] : ends[piece + 1]]

    def piece_of(self, triangles: Int64Array) -> Int64Array:
        """Number of the piece that each triangle is of.

        Args:
            triangles: Numbers, of any Shape.
        """
        return np.searchsorted(self._first_triangles, triangles, side="right") - 1

    def enclosing(self, position: Float64Array) -> int:
        """Find the piece that a point is inside; −1: none.

        A ray from inside of a closed surface crosses it an odd number of times. Walls and roof of one
        building may be pieces of their own, and houses mostly have no floor: so all pieces at rest count as
        one surface, and rays go upwards, from shallow to steep. All but one have to agree, so that a roof
        without walls, a screen or a slit does not count.

        Args:
            position: [m], Shape ``[3]``.
        """
        found: Counter[int] = Counter()
        for met in self.surfaces.above(position):
            found[self._left(met)] += 1
            # One ray may slip through a gap between walls.
            if found[-1] > 1:
                return -1
        del found[-1]
        return found.most_common(1)[0][0]

    def _left(self, met: Int64Array) -> int:
        """Piece that a ray leaves for good which meets these triangles, nearest first; −1: none."""
        pieces = self.piece_of(met)
        is_body = pieces >= self.first_body_piece
        bodies, crossings = np.unique(pieces[is_body], return_counts=True)
        # Bodies are closed: one that is left more often than entered is around the point.
        odd = bodies[crossings % 2 == 1]
        if len(odd):
            return int(odd[0])
        scenery = pieces[~is_body]
        return int(scenery[0]) if len(scenery) % 2 else -1

    def planes(self, shapes: Int64Array, primitives: Int64Array) -> tuple[Float64Array, Float64Array]:
        """A corner [m] and the normal (of any length) of triangles, each of Shape ``[..., 3]``, in float64.

        Args:
            shapes: Process-local shapes; anything follows for no shape.
            primitives: Triangles of these.
        """
        a, b, c = np.moveaxis(self.triangles(shapes, primitives), -2, 0)
        return a, np.cross(b - a, c - a)

    def triangles(self, shapes: Int64Array, primitives: Int64Array) -> Float64Array:
        """The corners [m] of triangles, Shape ``[..., 3, 3]``, in float64: those of scenery as they stand in
        its files, those of moving bodies where they were placed last.

        Args:
            shapes, primitives: See `planes`.
        """
        return self.corners(self.triangle_numbers(shapes, primitives))

    def triangle_numbers(self, shapes: Int64Array, primitives: Int64Array) -> Int64Array:
        """Numbers, through all shapes, of triangles.

        Args:
            shapes, primitives: See `planes`.
        """
        number = self._offsets[self._where(shapes)] + primitives
        # The number of no shape is beyond all others and must not lead out of the table.
        clipped: Int64Array = np.clip(number, 0, len(self.triangle_vertices) - 1)
        return clipped

    def corners(self, triangles: Int64Array) -> Float64Array:
        """Corners of triangles [m], Shape ``[..., 3, 3]``; float64.

        Args:
            triangles: Numbers, of any Shape.
        """
        corners: Float64Array = self.vertices[self.triangle_vertices[triangles]]
        return corners

    def shapes_of(self, triangles: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Process-local shape of triangles, and their numbers within it.

        Args:
            triangles: Numbers, of any Shape.
        """
        # Shapes are held by their process-local number, triangles count in the order of shapes.
        order = np.argsort(self._offsets)
        where = order[np.searchsorted(self._offsets[order], triangles, side="right") - 1]
        return self._ids[where], triangles - self._offsets[where]

    def moved_triangles(
        self, triangles: Int64Array, before: tuple[str, ...], now: tuple[str, ...]
    ) -> Int64Array:
        """Numbers of the same triangles of the same objects, where `place` has given bodies to others since.

        Args:
            triangles: Numbers, of any Shape.
            before, now: What `place` returned then and last.

        Returns:
            Numbers now; −1 where an object has left or has another mesh.
        """
        # The usual frame: the same objects have the same bodies.
        if before == now:
            return triangles
        first = self.first_body_piece
        place = {name: number for number, name in enumerate(now[first:], start=first)}
        piece = self.piece_of(triangles)
        moved = np.arange(len(now))
        for number, name in enumerate(before[first:], start=first):
            there = place.get(name, -1)
            is_same = there >= 0 and self._bodies[there - first][0] == self._bodies[number - first][0]
            moved[number] = there if is_same else -1
        start = self._first_triangles[moved[piece]] + triangles - self._first_triangles[piece]
        return np.where(moved[piece] >= 0, start, -1)

    def is_body(self, shapes: NDArray[np.uint32]) -> BoolArray:
        """Test whether shapes are of moving bodies.

        Args:
            shapes: Process-local shapes, of any Shape.
        """
        return np.isin(shapes, self._body_ids)

    def object_index(self, shapes: Int64Array, primitives: Int64Array) -> Int32Array:
        """Index into the names of `place` of triangles; −1 for no shape.

        Args:
            shapes, primitives: See `planes`.
        """
        where = self._where(shapes)
        piece = self.piece_of(self._offsets[where] + primitives)
        return np.where(self._ids[where] == shapes, piece, -1).astype(np.int32)

    def _number_shapes(self, shapes: Sequence[Shape], ids: Int64Array, moving: int) -> None:
        """Number the triangles of shapes and of their pieces."""
        counts = [[len(mesh.faces) for mesh in shape.meshes] for shape in shapes]
        totals = np.array([sum(count) for count in counts], np.int64)
        self.offset_by_shape = np.zeros(int(ids.max(initial=0)) + 1, np.int64)
        """Number of the first triangle of each process-local shape."""
        self.offset_by_shape[ids] = np.cumsum(totals) - totals
        self._body_ids = ids[-moving:] if self._bodies else ids[:0]
        # Sorted, so that shapes are looked up by bisection: their numbers count through the whole process.
        order = np.argsort(ids)
        self._ids, self._shape_order = ids[order], order
        self._offsets = (np.cumsum(totals) - totals)[order]
        faces = np.concatenate([np.array(count, np.int64) for count in counts])
        self._first_triangles = np.cumsum(faces) - faces

    def _number_planes(
        self, meshes: Sequence[Mesh], material: Int64Array, unit_meshes: Mapping[str, Mesh]
    ) -> None:
        """Number the planes of these pieces, whose materials are numbered; bodies, each of which is a point
        yet, by their unit meshes."""
        still = len(meshes) - len(self._bodies)
        of_asset = {asset: plane_numbers(mesh) for asset, mesh in unit_meshes.items()}
        numbers = plane_numbers_of(meshes[:still])
        # A body is a point until it stands for an object, and a point has no planes.
        numbers += [of_asset[asset] for asset, _ in self._bodies]
        self._face_of = np.concatenate(numbers)
        counts = np.array([int(number.max(initial=-1)) + 1 for number in numbers], np.int64)
        before = np.cumsum(counts) - counts
        parts = np.concatenate([number + first for number, first in zip(numbers, before, strict=True)])
        faces = self.triangle_vertices.astype(np.int64)
        apart = PlaneTable(parts.astype(np.int64), faces)
        apart.update(self.relative)
        self.part_of = parts.astype(np.int64)
        """Plane face of each triangle, numbered through all objects, of which none share any."""
        shared = shared_planes(apart, np.repeat(material[:still], counts[:still]))
        self.plane_of = shared[parts]
        """Infinite plane of each triangle, numbered through all objects."""
        self.first_moving_plane = int(len(apart.normal) and int(shared.max()) + 1 - int(counts[still:].sum()))
        """Number of the first plane of a body; those of scenery come before."""
        self.plane_table = PlaneTable(self.plane_of, faces)
        self.plane_table.update(self.relative)
        two_sided = {asset: two_sided_planes(mesh, of_asset[asset]) for asset, mesh in unit_meshes.items()}
        sides = [np.zeros(0, np.bool_), *(two_sided[asset] for asset, _ in self._bodies)]
        self._coplanar = CoplanarFaces(
            self.plane_table, self.first_moving_plane, counts[still:], np.concatenate(sides)
        )
        self.joined = self._coplanar.none
        self.surface_of = self.plane_of
        """Number of the surface that each triangle is of: that of its plane, or of the first of the planes
        that are one surface with it."""

    def _points_outside(self, triangle: int, normal: Float64Array) -> bool:
        """Test whether a triangle's normal points away from its piece, or up from one that lies.

        Scenery has faces of either sense, so their order of corners says nothing.
        """
        piece = int(self.piece_of(np.array(triangle)))
        if triangle < self._first_moving and abs(normal[2]) > LYING:
            return bool(normal[2] > 0)
        ends = [*self._first_triangles.tolist(), len(self.triangle_vertices)]
        corners = self.vertices[self.triangle_vertices[ends[piece] : ends[piece + 1]]].reshape(-1, 3)
        middle = (corners.min(0) + corners.max(0)) / 2
        return bool((self.vertices[self.triangle_vertices[triangle, 0]] - middle) @ normal >= 0)

    def _where(self, shapes: Int64Array) -> Int64Array:
        return np.minimum(np.searchsorted(self._ids, shapes), len(self._ids) - 1)


def _any(mask: BoolArray) -> BoolArray:
    """Rows of a mask in which any of three columns is true: NumPy reduces short rows one by one."""
    return mask[:, 0] | mask[:, 1] | mask[:, 2]
