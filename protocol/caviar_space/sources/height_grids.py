"""Grids of heights of the ground: GeoTIFF, by Pillow, and DTED (MIL-PRF-89020B)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError, SetupError, one_line
from caviar_protocol.host import install_command
from caviar_space.meshes import Mesh

WGS84 = "EPSG:4326"
STEP_M = 20.0
"""Side of the squares of ground that is not level [m]."""
# Tags of GeoTIFF 1.1 (OGC 19-008r4) and of GDAL: scale, tie point, keys, and the value of what is not known.
_SCALE, _TIE, _KEYS, _UNKNOWN = 33550, 33922, 34735, 42113
# Keys: whether a value is that of an area, system of projected and of geographic coordinates.
_RASTER, _PROJECTED, _GEOGRAPHIC = 1025, 3072, 2048


@dataclass(frozen=True, eq=False)
class HeightGrid:
    """Heights at the nodes of a grid."""

    heights: Float64Array
    """[m], NaN: not known; over y, southwards, and x, eastwards, Shape ``[Y, X]``."""
    corner: tuple[float, float]
    """x and y of the first one, in the system of the grid."""
    step: tuple[float, float]
    """Eastwards and southwards between two of them."""
    system: str = WGS84
    """Coordinates of the grid, by pyproj."""

    def at(self, longitude: Float64Array, latitude: Float64Array) -> Float64Array:
        """Interpolate heights, bilinearly [m]; NaN: outside, or not known.

        Args:
            longitude, latitude: [°], Shape ``[N]`` each.
        """
        from pyproj import Transformer

        x, y = Transformer.from_crs(WGS84, self.system, always_xy=True).transform(longitude, latitude)
        column, row = (x - self.corner[0]) / self.step[0], (self.corner[1] - y) / self.step[1]
        rows, columns = self.heights.shape
        outside = ~((column >= 0) & (column <= columns - 1) & (row >= 0) & (row <= rows - 1))
        column, row = np.where(outside, 0, column), np.where(outside, 0, row)
        i, j = (np.minimum(a.astype(int), n - 2) for a, n in ((row, rows), (column, columns)))
        v, u = row - i, column - j
        upper = (1 - u) * self.heights[i, j] + u * self.heights[i, j + 1]
        lower = (1 - u) * self.heights[i + 1, j] + u * self.heights[i + 1, j + 1]
        found: Float64Array = np.where(outside, np.nan, (1 - v) * upper + v * lower)
        return found


def read_heights(path: Path) -> HeightGrid:
    """Read a grid of heights.

    Args:
        path: ``.tif``, ``.tiff``, ``.dt0``, ``.dt1``, ``.dt2``.

    Raises:
        AssetError: The file is missing, damaged, or does not say where it lies.
        SetupError: Pillow, of the extra ``scenes``, is not installed.
    """
    try:
        if path.suffix.lower() in (".tif", ".tiff"):
            grid = _read_geotiff(path)
        elif re.fullmatch(r"\.dt[0-2]|\.dted", path.suffix.lower()):
            grid = _read_dted(path.read_bytes())
        else:
            raise AssetError(f"{path} is neither GeoTIFF (.tif) nor DTED (.dt0 to .dt2); convert it")
    except OSError as error:
        raise AssetError(f"cannot read {path}: {error.strerror or error}; get the file again") from error
    except (ValueError, KeyError, IndexError, TypeError, SyntaxError) as error:
        raise AssetError(f"{path} is damaged, or no grid of heights: {one_line(str(error))}") from error
    if min(grid.heights.shape) < 2 or not all(step > 0 for step in grid.step):
        raise AssetError(f"{path} has {grid.heights.shape} heights, {grid.step} apart; it needs 2 by 2")
    return grid


def _read_geotiff(path: Path) -> HeightGrid:
    try:
        from PIL import Image
    except ImportError as error:
        raise SetupError(f"GeoTIFF needs Pillow ({error}); run: {install_command('scenes')}") from error
    try:
        with Image.open(path, formats=["TIFF"]) as image:
            tags: Any = image.tag_v2  # type: ignore[attr-defined]
            heights, mode = np.asarray(image, np.float64), image.mode
            scale, tie, found = tags.get(_SCALE), tags.get(_TIE), tags.get(_KEYS)
            unknown = str(tags.get(_UNKNOWN, "nan")).strip("\0 ")
    except Image.DecompressionBombError as error:
        raise ValueError(str(error)) from error
    if mode not in ("F", "I", "I;16", "I;16B", "I;16S"):
        raise ValueError(f"its values are of the kind {mode}, and heights are one number of 16 or 32 bits")
    if not (scale and tie and found):
        raise ValueError("it has no scale, tie point or keys, so that its place is not known")
    rows = np.reshape(found, (-1, 4))[1:]
    keys = {int(key): int(value) for key, where, _, value in rows if where == 0}
    code = keys.get(_PROJECTED) or keys.get(_GEOGRAPHIC)
    if code is None or code == 32767:
        raise ValueError("its coordinates have no EPSG code; write one with gdalwarp -t_srs EPSG:4326")
    # A value is that of the middle of its area, of which the tie point has the corner.
    half = 0.0 if keys.get(_RASTER) == 2 else 0.5
    corner = tie[3] + (half - tie[0]) * scale[0], tie[4] - (half - tie[1]) * scale[1]
    heights = np.where(np.isclose(heights, float(unknown)), np.nan, heights)
    return HeightGrid(heights, corner, (float(scale[0]), float(scale[1])), f"EPSG:{code}")


def _read_dted(data: bytes) -> HeightGrid:
    if data[:3] != b"UHL":
        raise ValueError("it does not begin with UHL")
    text = data[:80].decode("ascii")

    def degrees(word: str) -> float:
        value = int(word[:3]) + int(word[3:5]) / 60 + int(word[5:7]) / 3600
        return -value if word[7] in "SW" else value

    west, south = degrees(text[4:12]), degrees(text[12:20])
    step = int(text[20:24]) / 36000, int(text[24:28]) / 36000
    columns, rows = int(text[47:51]), int(text[51:55])
    # A record a meridian, from south to north: sentinel and counts, heights, checksum.
    records = np.frombuffer(data[80 + 648 + 2700 :], np.uint8).reshape(columns, 8 + 2 * rows + 4)
    if (records[:, 0] != 0xAA).any():
        raise ValueError("a record does not begin with 0xAA")
    values = records[:, 8:-4].copy().view(">u2").astype(np.int64)
    heights = np.where(values & 0x8000, -(values & 0x7FFF), values).astype(np.float64)  # sign and magnitude
    heights[heights == -32767] = np.nan
    return HeightGrid(heights.T[::-1], (west, south + (rows - 1) * step[1]), step)


@dataclass(frozen=True, eq=False)
class Terrain:
    """Ground that is not level: heights at the nodes of squares, each of two triangles."""

    corner: tuple[float, float]
    """With the lowest x and y [m]."""
    heights: Float64Array
    """[m], over x and y, Shape ``[X, Y]``."""

    def at(self, places: Float64Array) -> Float64Array:
        """Heights of the triangles at x and y [m], Shape ``[N, 2]`` to ``[N]``."""
        cells = np.clip((places - self.corner) / STEP_M, 0, np.array(self.heights.shape) - 1.000001)
        (i, j), (u, v) = cells.astype(int).T, (cells % 1).T
        low, high = self.heights[i, j], self.heights[i + 1, j + 1]
        beside, beyond = self.heights[i + 1, j], self.heights[i, j + 1]
        found: Float64Array = np.where(
            u >= v,
            low + u * (beside - low) + v * (high - beside),
            low + v * (beyond - low) + u * (high - beyond),
        )
        return found

    def mesh(self) -> Mesh:
        """The triangles."""
        x, y = self.heights.shape
        nodes = np.stack(np.meshgrid(np.arange(x), np.arange(y), indexing="ij"), axis=-1).reshape(-1, 2)
        number = np.arange(x * y, dtype=np.int32).reshape(x, y)
        a, b, c, d = (
            part.ravel() for part in (number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:])
        )
        faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        return Mesh(np.column_stack([nodes * STEP_M + self.corner, self.heights.ravel()]), faces)
