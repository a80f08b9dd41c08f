"""Smooth curves through timed points, without overshoot."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

from caviar_protocol.arrays import Float64Array


class MonotoneCurve:
    """Piecewise cubic through points, once continuously differentiable, at rest at both ends.

    Between two points each coordinate is monotone, so that a landing never dips below its last
    height: slopes are the weighted harmonic means of F. N. Fritsch and J. Butland, "A method for
    constructing local monotone piecewise cubic interpolants", SIAM J. Sci. Stat. Comput. 5 (1984),
    eq. (5). Before the first and after the last point the curve stays where it is.

    Parameters
    ----------
    times
        Increasing instants [s], Shape ``[K]``, K ≥ 1.
    points
        Values there, Shape ``[K, D]``.
    """

    def __init__(self, times: Float64Array, points: Float64Array) -> None:
        self.times = times
        self.points = points
        self.slopes = _slopes(times, points)
        # Evaluated a few numbers at a time, which is faster with numbers than with arrays of three.
        self._instants: list[float] = times.tolist()
        self._ends: tuple[list[float], list[float]] = points[0].tolist(), points[-1].tolist()
        self._segments = [self._coefficients(k) for k in range(len(times) - 1)]

    def _coefficients(self, k: int) -> tuple[float, float, list[tuple[float, float, float, float]]]:
        """Begin and length [s] of a segment, and the cubic of each coordinate over s from 0 to 1."""
        length = self.times[k + 1] - self.times[k]
        step = self.points[k + 1] - self.points[k]
        d0, d1 = self.slopes[k] * length, self.slopes[k + 1] * length
        c2, c3 = 3 * step - 2 * d0 - d1, d0 + d1 - 2 * step
        return (
            self._instants[k],
            float(length),
            list(zip(*np.array([self.points[k], d0, c2, c3]).tolist(), strict=True)),
        )

    def segment(self, t: float) -> int:
        """Index of the segment that holds instant ``t`` [s]; −1 where the curve rests."""
        if not self._instants[0] <= t < self._instants[-1]:
            return -1
        return bisect_right(self._instants, t) - 1

    def at(self, t: float, order: int = 0) -> list[float]:
        """The derivative of an order (0: the value, 1, 2) at instant ``t`` [s], D numbers.

        The second derivative jumps at the points; there it is that of the segment that begins.
        """
        k = self.segment(t)
        if k < 0:
            ends = self._ends[0 if t < self._instants[0] else 1]
            return list(ends) if order == 0 else [0.0] * len(ends)
        begin, length, cubics = self._segments[k]
        s = (t - begin) / length
        if order == 0:
            return [p + s * (d0 + s * (c2 + s * c3)) for p, d0, c2, c3 in cubics]
        if order == 1:
            return [(d0 + s * (2 * c2 + s * 3 * c3)) / length for _, d0, c2, c3 in cubics]
        return [(2 * c2 + s * 6 * c3) / length**2 for _, _, c2, c3 in cubics]

    def __call__(self, t: float, order: int = 0) -> Float64Array:
        """The same as an array, Shape ``[D]``."""
        return np.array(self.at(t, order))


def _slopes(times: Float64Array, points: Float64Array) -> Float64Array:
    slopes = np.zeros_like(points)
    if len(times) < 3:
        return slopes
    length = np.diff(times)[:, None]
    secant = np.diff(points, axis=0) / length
    before, after = secant[:-1], secant[1:]
    w1, w2 = 2 * length[1:] + length[:-1], length[1:] + 2 * length[:-1]
    same_sign = before * after > 0
    safe_before, safe_after = np.where(same_sign, before, 1.0), np.where(same_sign, after, 1.0)
    slopes[1:-1] = np.where(same_sign, (w1 + w2) / (w1 / safe_before + w2 / safe_after), 0.0)
    return slopes
