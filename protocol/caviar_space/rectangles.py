"""Rectangles around the triangles of plane faces, which bound where a face can be met.

A reflection happens at a point of a plane that lies in one of its triangles: searches test against the
rectangle first, and against the triangles last.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_space.vectors import Rows, cross, ranges

RIM = 1e-4
"""[m]; a point this far outside of a triangle counts as inside, so that none falls between two triangles."""


@dataclass(frozen=True, eq=False)
class FaceRectangles(Rows):
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

    def __len__(self) -> int:
        return len(self.plane)

    def take(self, faces: Int64Array | BoolArray) -> FaceRectangles:
        """These faces, in this order."""
        rows = ranges(np.cumsum(self.sizes)[faces] - self.sizes[faces], self.sizes[faces])[1]
        return replace(super().take(faces), triangles=self.triangles[rows])

    def mirrored(self, points: Float64Array, faces: Int64Array) -> Float64Array:
        """Images of points [m] in the planes of faces, both of N, Shape ``[N, 3]``."""
        return points - 2 * self.height(points, faces)[:, None] * self.normal[faces]

    def height(self, points: Float64Array, faces: Int64Array) -> Float64Array:
        """Height of points [m], Shape ``[N, 3]``, above the planes of N faces [m], Shape ``[N]``."""
        height: Float64Array = np.einsum("nc,nc->n", points, self.normal[faces]) - self.offset[faces]
        return height


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
