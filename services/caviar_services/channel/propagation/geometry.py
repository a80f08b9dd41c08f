"""Geometry in float64: delays, directions and Doppler shifts of paths from their corner points; vectors and
rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT


class Rows:
    """Base of frozen dataclasses whose arrays have a row for each path, candidate or chain.

    Fields that are no arrays are the same for all rows, and stay.

    Example:
        >>> @dataclass(frozen=True, eq=False)
        ... class Points(Rows):
        ...     x: Float64Array
        ...     unit: str
        >>> points = Points(np.array([1.0, 2.0]), "m")
        >>> Points.joined([points, points]).take(np.array([3, 0]))
        Points(x=array([2., 1.]), unit='m')
    """

    by_carrier: ClassVar[frozenset[str]] = frozenset()
    """Arrays whose second axis has the rows."""
    shared: ClassVar[frozenset[str]] = frozenset()
    """Arrays that are of all rows together."""

    def take(self, which: Int64Array | BoolArray) -> Self:
        """These rows, in this order.

        Args:
            which: Numbers of rows, or for each row whether it is taken.
        """
        # Without __init__, which sets each field of a frozen dataclass by a call.
        taken = object.__new__(type(self))
        for name, value in self.__dict__.items():
            if isinstance(value, np.ndarray) and name not in self.shared:
                value = value[:, which] if name in self.by_carrier else value[which]
            taken.__dict__[name] = value
        return taken

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """The rows of several, one at least, part by part; what is no array is that of the first.

        Args:
            parts: With arrays of one width.
        """
        made = object.__new__(cls)
        for name, value in parts[0].__dict__.items():
            if isinstance(value, np.ndarray) and name not in cls.shared:
                columns = [part.__dict__[name] for part in parts]
                value = np.concatenate(columns, axis=int(name in cls.by_carrier))
            made.__dict__[name] = value
        return made


@dataclass(frozen=True, eq=False)
class PathGeometry:
    """Delays, directions and Doppler shifts of P paths."""

    tau: Float64Array
    """Absolute delay [s], Shape ``[P]``."""
    departure: Float64Array
    """Unit vectors from TX along the first segment, world axes, Shape ``[P, 3]``."""
    arrival: Float64Array
    """Unit vectors from RX back along the last segment, world axes, Shape ``[P, 3]``."""
    doppler_ratio: Float64Array
    """Doppler shift over carrier frequency, Shape ``[P]``."""


def path_geometry(
    start: Float64Array,
    points: Float64Array,
    end: Float64Array,
    count: Int64Array,
    start_velocity: Float64Array,
    point_velocity: Float64Array,
    end_velocity: Float64Array,
) -> PathGeometry:
    """Compute delays, directions and Doppler shifts of paths start → points → end.

    Args:
        start: Position of TX of each path [m], Shape ``[P, 3]``; ``end`` that of RX.
        points: Interaction points [m], Shape ``[P, D, 3]``; entries from ``count`` on are ignored.
        end: See ``start``.
        count: Number of interactions of each path, Shape ``[P]``.
        start_velocity: Of TX [m/s], Shape ``[P, 3]``; ``end_velocity`` that of RX.
        point_velocity: Of the surface at each point [m/s], Shape ``[P, D, 3]``.
        end_velocity: See ``start_velocity``.

    Example:
        >>> row = lambda *values: np.array([values], np.float64)
        >>> point, none = np.zeros((1, 0, 3)), np.zeros(1, np.int64)
        >>> still, towards = row(0, 0, 0), row(-30, 0, 0)
        >>> made = path_geometry(row(0, 0, 0), point, row(300, 0, 0), none, still, point, towards)
        >>> made.departure.tolist(), round(float(made.doppler_ratio[0]) * 28e9)  # [Hz] at 28 GHz
        ([[1.0, 0.0, 0.0]], 2802)

    Doppler shift to first order in v/c, with unit vector k_i of the segment after corner i:
    f_D / f = Σ_i (v_i − v_{i+1})·k_i / c (a source that approaches raises the frequency).
    """
    paths = len(points)
    if not points.shape[1]:
        return _straight(end - start, end_velocity - start_velocity)
    corners = path_corners(start, points, end, count)
    velocity = path_corners(start_velocity, point_velocity, end_velocity, count)

    segment = np.diff(corners, axis=1)
    length = np.sqrt((segment**2).sum(-1))
    along = segment / np.where(length > 0, length, 1.0)[..., None]
    rows = np.arange(paths)
    return PathGeometry(
        tau=length.sum(-1) / SPEED_OF_LIGHT,
        departure=along[:, 0],
        arrival=-along[rows, count],
        doppler_ratio=-(np.diff(velocity, axis=1) * along).sum((1, 2)) / SPEED_OF_LIGHT,
    )


def path_corners(
    start: Float64Array, points: Float64Array, end: Float64Array, count: Int64Array
) -> Float64Array:
    """Corners of paths start → points → end, Shape ``[P, D + 2, 3]``; arguments are those of `path_geometry`.

    Unused corners are at the receiver, so that their segments have length zero.

    Example:
        >>> start, end = np.zeros((1, 3)), np.array([[8.0, 0.0, 0.0]])
        >>> unused = np.full((1, 1, 3), np.nan)
        >>> path_corners(start, unused, end, np.array([0])).tolist()
        [[[0.0, 0.0, 0.0], [8.0, 0.0, 0.0], [8.0, 0.0, 0.0]]]
    """
    corners = np.concatenate([start[:, None], points, end[:, None]], axis=1)
    unused = np.arange(corners.shape[1]) > count[:, None]
    return np.where(unused[..., None], end[:, None], corners)


def _straight(line: Float64Array, separation: Float64Array) -> PathGeometry:
    """Geometry of paths without interactions: TX to RX [m], and its change [m/s], Shape ``[P, 3]`` each."""
    length = np.sqrt((line**2).sum(-1))
    along = line / np.where(length > 0, length, 1.0)[:, None]
    return PathGeometry(
        tau=length / SPEED_OF_LIGHT,
        departure=along,
        arrival=-along,
        doppler_ratio=-(separation * along).sum(-1) / SPEED_OF_LIGHT,
    )
