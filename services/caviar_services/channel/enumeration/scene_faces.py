"""The plane faces of a scene, with the rectangles around their triangles, and which faces see one another.

A reflection happens at a point of a plane that lies in one of its triangles. The rectangle around the
triangles bounds where that can be: searches test against it first, and against the triangles last. Faces of
scenery are made once, those of moving bodies as they stand in a frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_services.channel.sionna.candidates import Faces
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_space.meshes import Mesh
from caviar_space.planes import two_sided_planes
from caviar_space.vectors import cross, ranges

RIM = 1e-4
"""[m]; a point this far outside of a triangle counts as inside, so that none falls between two triangles."""

# [m] by which rectangles are larger; more than the rim of their triangles.
_SLACK = 2e-3


@dataclass(frozen=True, eq=False)
class FaceRectangles:
    """F plane faces; coordinates in metres, relative to one origin.

    The triangles of all faces stand one face after the other.
    """

    plane: Int64Array
    """Number of the plane in the scene's table, Shape ``[F]``."""
    normal: Float64Array
    """Unit, Shape ``[F, 3]``."""
    offset: Float64Array
    """Of the plane along its normal [m], Shape ``[F]``."""
    centre: Float64Array
    """Of the rectangle [m], Shape ``[F, 3]``."""
    axes: Float64Array
    """Unit vectors along its sides, Shape ``[F, 2, 3]``."""
    half: Float64Array
    """Half of the lengths of its sides [m], Shape ``[F, 2]``."""
    two_sided: BoolArray
    """Whether both sides reflect; else only that of the normal can be met, Shape ``[F]``."""
    triangles: Float64Array
    """Corners along the axes from the centre [m], Shape ``[T, 3, 2]``."""
    sizes: Int64Array
    """Triangles of each face, Shape ``[F]``."""

    @property
    def radius(self) -> Float64Array:
        """Radius of the sphere around each rectangle [m], Shape ``[F]``."""
        radius: Float64Array = np.sqrt((self.half**2).sum(1))
        return radius

    @classmethod
    def of(
        cls,
        plane: Int64Array,
        triangles: Float64Array,
        sizes: Int64Array,
        along: Int64Array,
        normal: Float64Array,
        two_sided: BoolArray,
    ) -> FaceRectangles:
        """Rectangles around triangles of planes.

        Args:
            plane: As in the result; likewise ``normal``, none of which is 0, and ``two_sided``.
            triangles: Corners [m], face after face, Shape ``[T, 3, 3]``.
            sizes: How many of them each face has, at least one, Shape ``[F]``.
            along: Side of a triangle that each rectangle lies along (`narrowest_sides`), Shape ``[F]``.
            normal: See ``plane``.
            two_sided: See ``plane``.
        """
        count = len(plane)
        if not count:
            return cls.none()
        origin = triangles[along // 3, along % 3]
        side = triangles[along // 3, (along + 1) % 3] - origin
        # Corners lie in the plane to rounding only; the axes have to lie in it exactly.
        side = side - np.einsum("fc,fc->f", side, normal)[:, None] * normal
        side /= np.sqrt(np.einsum("fc,fc->f", side, side))[:, None]
        axes = np.stack([side, cross(normal, side)], axis=1)
        own = np.repeat(np.arange(count), sizes)
        flat = (triangles - origin[own][:, None]) @ axes[own].transpose(0, 2, 1)
        low, high = _extents(flat, np.cumsum(sizes) - sizes)
        middle = (low + high) / 2
        centre = origin + np.einsum("fa,fac->fc", middle, axes)
        return cls(
            plane=plane,
            normal=normal,
            offset=np.einsum("fc,fc->f", origin, normal),
            centre=centre,
            axes=axes,
            half=(high - low) / 2,
            two_sided=two_sided,
            triangles=flat - middle[own][:, None],
            sizes=sizes,
        )

    @classmethod
    def none(cls) -> FaceRectangles:
        """No faces."""
        return cls(
            plane=np.zeros(0, np.int64),
            normal=np.zeros((0, 3)),
            offset=np.zeros(0),
            centre=np.zeros((0, 3)),
            axes=np.zeros((0, 2, 3)),
            half=np.zeros((0, 2)),
            two_sided=np.zeros(0, np.bool_),
            triangles=np.zeros((0, 3, 2)),
            sizes=np.zeros(0, np.int64),
        )

    def __len__(self) -> int:
        return len(self.plane)

    def and_those(self, other: FaceRectangles) -> FaceRectangles:
        """These faces followed by others."""
        names = [field.name for field in fields(self)]
        both = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in names}
        return FaceRectangles(**both)

    def take(self, faces: Int64Array) -> FaceRectangles:
        """These faces, in this order."""
        rows = ranges(np.cumsum(self.sizes)[faces] - self.sizes[faces], self.sizes[faces])[1]
        columns = {
            field.name: getattr(self, field.name)[rows if field.name == "triangles" else faces]
            for field in fields(self)
        }
        return FaceRectangles(**columns)

    def mirrored(self, points: Float64Array, faces: Int64Array) -> Float64Array:
        """Images of points [m] in the planes of faces, both of N, Shape ``[N, 3]``."""
        return points - 2 * self.height(points, faces)[:, None] * self.normal[faces]

    def height(self, points: Float64Array, faces: Int64Array) -> Float64Array:
        """Height of points [m], Shape ``[N, 3]``, above the planes of N faces [m], Shape ``[N]``."""
        height: Float64Array = np.einsum("nc,nc->n", points, self.normal[faces]) - self.offset[faces]
        return height

    def in_rectangle(self, points: Float64Array, faces: Int64Array) -> BoolArray:
        """Whether points [m] of the planes of N faces lie in their rectangles; ``[N, 3]`` to ``[N]``."""
        flat = np.einsum("nc,nac->na", points - self.centre[faces], self.axes[faces])
        inside: BoolArray = (np.abs(flat) <= self.half[faces] + _SLACK).all(1)
        return inside

    def in_triangles(self, points: Float64Array, faces: Int64Array) -> BoolArray:
        """Whether points [m] of the planes of N faces lie in one of their triangles; ``[N, 3]`` to
        ``[N]``."""
        flat = np.einsum("nc,nac->na", points - self.centre[faces], self.axes[faces])
        sizes = self.sizes[faces]
        own, rows = ranges(np.cumsum(self.sizes)[faces] - sizes, sizes)
        corners = self.triangles[rows]
        sides = np.roll(corners, -1, axis=1) - corners
        towards = flat[own][:, None] - corners
        across = sides[..., 0] * towards[..., 1] - sides[..., 1] * towards[..., 0]
        area = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
        length = np.sqrt((sides**2).sum(-1))
        # Twice the area of the triangle of point and side over the side's length is the distance from the
        # side.
        within = (across * np.sign(area)[:, None] >= -RIM * length).all(1) & (area != 0)
        held = np.zeros(len(faces), np.bool_)
        held[own[within]] = True
        return held


def narrowest_sides(triangles: Float64Array, sizes: Int64Array) -> Int64Array:
    """Side of each face's largest triangle along which the rectangle around the face is smallest.

    Of two triangles that form a rectangle, this is never the diagonal, whose rectangle would be twice as
    large.

    Args:
        triangles: Corners [m], face after face, Shape ``[T, 3, 3]``.
        sizes: Number of triangles of each face, Shape ``[F]``.

    Returns:
        Three times the number of the triangle plus the number of the side, Shape ``[F]``.
    """
    begin = np.cumsum(sizes) - sizes
    own = np.repeat(np.arange(len(sizes)), sizes)
    normal = cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    square = np.einsum("fc,fc->f", normal, normal)
    hits = np.flatnonzero(square == np.maximum.reduceat(square, begin)[own]) if len(own) else own
    largest = hits[np.searchsorted(hits, begin)]
    best, least = 3 * largest, np.full(len(sizes), np.inf)
    for side in range(3):
        origin = triangles[largest, side]
        one = triangles[largest, (side + 1) % 3] - origin
        axes = np.stack([one, cross(normal[largest], one)], axis=1)
        length = np.sqrt(np.einsum("fac,fac->fa", axes, axes))[..., None]
        axes /= np.where(length > 0, length, 1.0)
        flat = (triangles - origin[own][:, None]) @ axes[own].transpose(0, 2, 1)
        low, high = _extents(flat, begin)
        area = np.where(length.all((1, 2)), np.prod(high - low, axis=1), np.inf)
        best, least = np.where(area < least, 3 * largest + side, best), np.minimum(area, least)
    return best


def _extents(flat: Float64Array, begin: Int64Array) -> tuple[Float64Array, Float64Array]:
    """Lowest and highest coordinates of runs of triangles ``[T, 3, 2]`` that begin at these."""
    a, b, c = flat[:, 0], flat[:, 1], flat[:, 2]
    low: Float64Array = np.minimum.reduceat(np.minimum(np.minimum(a, b), c), begin)
    high: Float64Array = np.maximum.reduceat(np.maximum(np.maximum(a, b), c), begin)
    return low, high


class SceneFaces:
    """Faces of a scene in the coordinates of its ray tracer.

    Args:
        scene: The scene; its bodies are where `SionnaScene.place` put them last.
        inner: Whether waves may be inside of closed bodies, so that the inner sides of their faces reflect
            too.
    """

    def __init__(self, scene: SionnaScene, inner: bool = False) -> None:
        self._scene = scene
        table = scene.plane_table
        first = scene.first_moving_plane
        triangles, sizes = table.triangles_of(np.arange(len(table.triangle)))
        piece = scene.piece_of(triangles)
        self._scenery = _faces_of(scene, np.arange(first))
        self._row = np.full(first, -1)
        self._row[self._scenery.plane] = np.arange(len(self._scenery))
        body_of = piece[np.cumsum(sizes) - sizes] - scene.first_body_piece
        # Number of the body that each moving plane is of.
        self._body_of = body_of[first:]
        self._two_sided = np.ones(len(self._body_of), np.bool_)
        # Side of each moving plane's rectangle, the first of its triangles having the sides 0 to 2.
        self._along = np.zeros(len(self._body_of), np.int64)
        for asset, mesh in scene.unit_meshes.items():
            numbers = scene.face_numbers(asset)
            both, along = two_sided_planes(mesh, numbers), _sides_of(mesh, numbers)
            for body in scene.bodies_of(asset):
                self._two_sided[self._body_of == body] = both | inner
                self._along[self._body_of == body] = along
        self._standing: tuple[int, ...] | None = None
        self._rows: tuple[Int64Array, Int64Array, Int64Array]

    def scenery(self, planes: Int64Array) -> FaceRectangles:
        """Faces of these planes of scenery, in ascending order; planes of no area are left out."""
        rows = self._row[np.unique(planes)]
        return self._scenery.take(rows[rows >= 0])

    def bodies(self) -> tuple[FaceRectangles, Int64Array]:
        """Faces of all standing bodies, body after body, and how many each of these has."""
        # Which rows are needed follows from which bodies stand, and is kept while these are the same.
        scene, standing = self._scene, self._scene.standing_bodies
        if standing != self._standing:
            planes = np.flatnonzero(np.isin(self._body_of, np.array(standing, np.int64)))
            self._rows = (planes, *scene.plane_table.triangles_of(planes + scene.first_moving_plane))
            self._standing = standing
        planes, triangles, sizes = self._rows
        normal = scene.plane_table.normal[planes + scene.first_moving_plane]
        flat = np.einsum("fc,fc->f", normal, normal) > 0
        if not flat.all():
            kept = np.flatnonzero(flat)
            triangles = triangles[ranges(np.cumsum(sizes)[kept] - sizes[kept], sizes[kept])[1]]
            planes, sizes, normal = planes[kept], sizes[kept], normal[kept]
        faces = FaceRectangles.of(
            planes + scene.first_moving_plane,
            scene.corners(triangles) - scene.centre,
            sizes,
            3 * (np.cumsum(sizes) - sizes) + self._along[planes],
            normal,
            self._two_sided[planes],
        )
        _, counts = np.unique(self._body_of[planes], return_counts=True)
        return faces, counts


def _faces_of(scene: SionnaScene, planes: Int64Array) -> FaceRectangles:
    """Faces of planes of scenery."""
    table = scene.plane_table
    triangles, sizes = table.triangles_of(planes)
    own = np.repeat(np.arange(len(planes)), sizes)
    used = (table.normal[planes] != 0).any(1)[own]
    corners = scene.corners(triangles[used]) - scene.centre
    sizes = np.bincount(own[used], minlength=len(planes))
    kept = np.flatnonzero(sizes)
    # Scenery has faces of either sense, so their order of corners says nothing.
    both = np.ones(len(kept), np.bool_)
    sizes = sizes[kept]
    along = narrowest_sides(corners, sizes)
    return FaceRectangles.of(planes[kept], corners, sizes, along, table.normal[planes[kept]], both)


def _sides_of(mesh: Mesh, numbers: Int32Array) -> Int64Array:
    """`narrowest_sides` of the planes of a mesh, counted from the first triangle of each plane."""
    order = np.argsort(numbers, kind="stable")
    sizes = np.bincount(numbers)
    return narrowest_sides(mesh.vertices[mesh.faces[order]], sizes) - 3 * (np.cumsum(sizes) - sizes)


# [m] off its plane that a ray starts, so that it does not meet the plane.
_OFF_PLANE = 1e-3

# Rays that are cast together, so that memory is bounded.
_PART = 1_000_000


def visible_pairs(look: Faces, faces: FaceRectangles, rays: int, seed: int) -> Int64Array:
    """Pairs of planes that see one another, found by rays in random directions from random points.

    Args:
        look: Casts the rays; no moving body should be in the scene.
        faces: Faces of the planes.
        rays: Rays from each face.
        seed: Seed of points and directions.

    Returns:
        Both planes of each pair, in both orders, sorted, Shape ``[M, 2]``.
    """
    rng = np.random.default_rng(seed)
    at_once = max(1, _PART // rays)
    found = [np.zeros((0, 2), np.int64)]
    for begin in range(0, len(faces), at_once):
        some = np.arange(begin, min(begin + at_once, len(faces)))
        face = np.repeat(some, rays)
        start = _points(faces.take(some), rays, rng)
        direction = rng.standard_normal((len(face), 3))
        direction /= np.sqrt((direction**2).sum(1))[:, None]
        # A ray leaves on the side of its plane that it points to.
        off = np.sign((direction * faces.normal[face]).sum(1))[:, None] * faces.normal[face] * _OFF_PLANE
        behind, plane = look.nearest(start + off, start + off + direction)
        hit = np.isfinite(behind)
        found.append(np.unique(np.column_stack([faces.plane[face], plane])[hit], axis=0))
    pairs = np.concatenate(found)
    pairs = pairs[np.isin(pairs[:, 1], faces.plane) & (pairs[:, 0] != pairs[:, 1])]
    return np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)


def seen_planes(look: Faces, points: Float64Array, planes: Int64Array, rays: int) -> BoolArray:
    """Planes that points see: those that rays in all directions meet first.

    Args:
        look: Casts the rays.
        points: Positions [m], Shape ``[R, 3]``.
        planes: Planes that are asked about, ascending, Shape ``[U]``.
        rays: Rays from each point.

    Returns:
        Whether each point sees each plane, Shape ``[R, U]``.
    """
    seen = np.zeros((len(points), len(planes) + 1), np.bool_)
    start = np.repeat(points, rays, axis=0)
    behind, plane = look.nearest(start, start + np.tile(_directions(rays), (len(points), 1)))
    place = np.searchsorted(planes, plane)
    known = np.isfinite(behind) & (np.append(planes, -1)[place] == plane)
    seen[np.repeat(np.arange(len(points)), rays), np.where(known, place, len(planes))] = True
    return seen[:, :-1]


@lru_cache(maxsize=4)
def _directions(rays: int) -> Float64Array:
    """Unit vectors that are spread evenly, on a Fibonacci lattice, Shape ``[N, 3]``."""
    number = np.arange(rays) + 0.5
    z, turn = 1 - 2 * number / rays, np.pi * (1 + math.sqrt(5.0)) * number
    flat = np.sqrt(1 - z**2)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])


def _points(faces: FaceRectangles, count: int, rng: np.random.Generator) -> Float64Array:
    """Random points of each face [m], uniform over its triangles, face after face."""
    corners = faces.triangles
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    ends = np.cumsum(area)
    last = np.cumsum(faces.sizes) - 1
    begin, whole = ends[last] - np.add.reduceat(area, last + 1 - faces.sizes), ends[last]
    drawn = begin[:, None] + rng.random((len(faces), count)) * (whole - begin)[:, None]
    triangle = np.clip(np.searchsorted(ends, drawn), (last + 1 - faces.sizes)[:, None], last[:, None])
    triangle = triangle.ravel()
    weights = rng.random((len(triangle), 2))
    weights = np.where((weights.sum(1) > 1)[:, None], 1 - weights, weights)
    flat = corners[triangle, 0] + weights[:, :1] * one[triangle] + weights[:, 1:] * other[triangle]
    face = np.repeat(np.arange(len(faces)), count)
    points: Float64Array = faces.centre[face] + np.einsum("na,nac->nc", flat, faces.axes[face])
    return points
