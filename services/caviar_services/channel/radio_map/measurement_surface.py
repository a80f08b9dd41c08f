"""The surface of a radio map: a grid of cells, level or draped over the ground."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.mesh.shapes import Mesh

Area = tuple[float, float, float, float]
"""Lowest x and y, highest x and y [m]."""


@dataclass(frozen=True, eq=False)
class MeasurementSurface:
    """Cells that are squares from above: ``nx`` along x, ``ny`` along y."""

    x: Float64Array
    """Edges of the columns [m], ascending, Shape ``[nx + 1]``."""
    y: Float64Array
    """Edges of the rows [m], ascending, Shape ``[ny + 1]``."""
    z: Float64Array
    """Height of the cells' corners [m], Shape ``[ny + 1, nx + 1]``; NaN where there is no ground."""

    @property
    def shape(self) -> tuple[int, int]:
        """``(ny, nx)``."""
        return len(self.y) - 1, len(self.x) - 1

    @property
    def is_level(self) -> bool:
        """Whether it is a horizontal plane without a gap."""
        return bool((self.z == self.z[0, 0]).all())

    @property
    def centres(self) -> Float64Array:
        """Middle of each cell [m], Shape ``[ny, nx, 3]``; NaN heights where a corner has no ground."""
        x, y = np.meshgrid((self.x[:-1] + self.x[1:]) / 2, (self.y[:-1] + self.y[1:]) / 2)
        z = self.z
        return np.stack([x, y, (z[:-1, :-1] + z[:-1, 1:] + z[1:, :-1] + z[1:, 1:]) / 4], axis=-1)

    @property
    def covered(self) -> BoolArray:
        """Cells that have ground at all four corners, Shape ``[ny, nx]``."""
        there: BoolArray = np.isfinite(self.centres[..., 2])
        return there

    def triangles(self) -> tuple[Mesh, Int64Array]:
        """Two triangles for each covered cell, with upward normals, and the flat index of their cells,
        Shape ``[F]``."""
        _, nx = self.shape
        x, y = np.meshgrid(self.x, self.y)
        vertices = np.stack([x, y, self.z], axis=-1).reshape(-1, 3)
        cells = np.flatnonzero(self.covered)
        first = cells // nx * (nx + 1) + cells % nx
        squares = first[:, None] + [0, 1, nx + 2, 0, nx + 2, nx + 1]
        faces = squares.reshape(-1, 3).astype(np.int32)
        used, compact = np.unique(faces, return_inverse=True)
        return Mesh(vertices[used], compact.reshape(-1, 3).astype(np.int32)), np.repeat(cells, 2)


def level_surface(area: Area, cell: float, z: float) -> MeasurementSurface:
    """A horizontal plane at the height ``z`` [m] in cells of ``cell`` [m]."""
    x, y = _edges(area, cell)
    return MeasurementSurface(x, y, np.full((len(y), len(x)), float(z)))


def draped_surface(area: Area, cell: float, height: float, ground: Float64Array) -> MeasurementSurface:
    """Cells ``height`` [m] above the highest ground at each of their corners.

    ``ground`` are triangles [m], Shape ``[F, 3, 3]``.
    """
    x, y = _edges(area, cell)
    return MeasurementSurface(x, y, heights(ground, x, y) + height)


def cell_counts(area: Area, cell: float) -> tuple[int, int]:
    """How many cells an area needs, ``(ny, nx)``."""
    x0, y0, x1, y1 = area
    return max(1, math.ceil((y1 - y0) / cell - 1e-9)), max(1, math.ceil((x1 - x0) / cell - 1e-9))


def _edges(area: Area, cell: float) -> tuple[Float64Array, Float64Array]:
    """Edges of columns and rows; what the last cell has too much is shared by both sides."""
    x0, y0, x1, y1 = area
    ny, nx = cell_counts(area, cell)
    left, bottom = (x0 + x1 - nx * cell) / 2, (y0 + y1 - ny * cell) / 2
    return np.linspace(left, left + nx * cell, nx + 1), np.linspace(bottom, bottom + ny * cell, ny + 1)


def heights(triangles: Float64Array, x: Float64Array, y: Float64Array) -> Float64Array:
    """Height [m] of the highest of some triangles over each point of a grid, Shape ``[len(y), len(x)]``.

    NaN where there is none. ``triangles`` has Shape ``[F, 3, 3]``, ``x`` and ``y`` ascend.
    """
    found = np.full((len(y), len(x)), -np.inf)
    low, high = triangles[..., :2].min(axis=1), triangles[..., :2].max(axis=1)
    columns = np.searchsorted(x, [low[:, 0] - _RIM, high[:, 0] + _RIM])
    rows = np.searchsorted(y, [low[:, 1] - _RIM, high[:, 1] + _RIM])
    for f in np.flatnonzero((columns[0] < columns[1]) & (rows[0] < rows[1])).tolist():
        at = slice(*rows[:, f].tolist()), slice(*columns[:, f].tolist())
        found[at] = np.maximum(found[at], _height_over(triangles[f], x[at[1]], y[at[0]]))
    return np.where(np.isfinite(found), found, np.nan)


# [m]; a corner of a cell this near to the border of the ground is over it.
_RIM = 1e-6


def _height_over(triangle: Float64Array, x: Float64Array, y: Float64Array) -> Float64Array:
    """Height of one triangle over a grid, −∞ beside it, by barycentric coordinates."""
    a, b, c = triangle
    (ux, uy, uz), (vx, vy, vz) = b - a, c - a
    area = ux * vy - uy * vx
    if abs(area) < 1e-12:  # upright: it has no height of its own
        return np.full((len(y), len(x)), -np.inf)
    px, py = np.meshgrid(x - a[0], y - a[1])
    s, t = (px * vy - py * vx) / area, (ux * py - uy * px) / area
    rim = _RIM * max(np.hypot(ux, uy), np.hypot(vx, vy)) / abs(area)
    inside = (s >= -rim) & (t >= -rim) & (s + t <= 1 + rim)
    return np.where(inside, a[2] + s * uz + t * vz, -np.inf)
