"""Plane faces with the rectangle around their triangles: what images are mirrored in, and seen through.

A reflection happens at a point of a plane that lies in one of its triangles. The rectangle around the
triangles bounds where that can be: searches test against it first, and against the triangles last.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.propagation.geometry import cross

RIM = 1e-4
"""[m]; a point this far outside of a triangle is in it, so that none falls between two."""

_SLACK = 2e-3
"""[m] around rectangles; more than the rim of their triangles."""


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
        """Of the sphere around each rectangle [m], Shape ``[F]``."""
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

        Parameters
        ----------
        plane, normal, two_sided
            As in the result; no normal is 0.
        triangles
            Corners [m], face after face, Shape ``[T, 3, 3]``.
        sizes
            How many of them each face has, at least one, Shape ``[F]``.
        along
            Of each face, a side that its rectangle lies along (`narrowest_sides`), Shape ``[F]``.
        """
        count = len(plane)
        if not count:
            return cls.none()
        origin = triangles[along // 3, along % 3]
        side = triangles[along // 3, (along + 1) % 3] - origin
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
        """These faces and others behind them."""
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
        """How far points [m], Shape ``[N, 3]``, are in front of the planes of N faces [m], Shape ``[N]``."""
        height: Float64Array = np.einsum("nc,nc->n", points, self.normal[faces]) - self.offset[faces]
        return height

    def in_rectangle(self, points: Float64Array, faces: Int64Array) -> BoolArray:
        """Whether points of planes [m], Shape ``[N, 3]``, lie in the rectangles of N faces, Shape ``[N]``."""
        flat = np.einsum("nc,nac->na", points - self.centre[faces], self.axes[faces])
        inside: BoolArray = (np.abs(flat) <= self.half[faces] + _SLACK).all(1)
        return inside

    def in_triangles(self, points: Float64Array, faces: Int64Array) -> BoolArray:
        """Whether points of planes [m], Shape ``[N, 3]``, lie in a triangle of N faces, Shape ``[N]``."""
        flat = np.einsum("nc,nac->na", points - self.centre[faces], self.axes[faces])
        sizes = self.sizes[faces]
        own, rows = ranges(np.cumsum(self.sizes)[faces] - sizes, sizes)
        corners = self.triangles[rows]
        sides = np.roll(corners, -1, axis=1) - corners
        towards = flat[own][:, None] - corners
        across = sides[..., 0] * towards[..., 1] - sides[..., 1] * towards[..., 0]
        area = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
        length = np.sqrt((sides**2).sum(-1))
        within = (across * np.sign(area)[:, None] >= -RIM * length).all(1) & (area != 0)
        held = np.zeros(len(faces), np.bool_)
        held[own[within]] = True
        return held


def narrowest_sides(triangles: Float64Array, sizes: Int64Array) -> Int64Array:
    """Of each face, the side of its largest triangle that the smallest rectangle around it lies along.

    It is three times the number of the triangle plus that of the side. Of two triangles that are a
    rectangle it is never the diagonal, whose rectangle would be twice as large. The parameters are those of
    `FaceRectangles.of`.
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
    """Lowest and highest coordinates of triangles ``[T, 3, 2]``, of each run of them."""
    a, b, c = flat[:, 0], flat[:, 1], flat[:, 2]
    low: Float64Array = np.minimum.reduceat(np.minimum(np.minimum(a, b), c), begin)
    high: Float64Array = np.maximum.reduceat(np.maximum(np.maximum(a, b), c), begin)
    return low, high


def ranges(begin: Int64Array, sizes: Int64Array) -> tuple[Int64Array, Int64Array]:
    """The numbers of N ranges, one range after the other: the range that each is of, and the numbers."""
    own = np.repeat(np.arange(len(begin)), sizes)
    return own, np.arange(len(own)) - np.repeat(np.cumsum(sizes) - sizes - begin, sizes)
