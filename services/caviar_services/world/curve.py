"""Smooth curves through timed points, without overshoot."""

from __future__ import annotations

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

    def segment(self, t: float) -> int:
        """Index of the segment that holds instant ``t`` [s]; −1 where the curve rests."""
        if not self.times[0] <= t < self.times[-1]:
            return -1
        return int(np.searchsorted(self.times, t, side="right")) - 1

    def __call__(self, t: float, order: int = 0) -> Float64Array:
        """The derivative of an order (0: the value, 1, 2) at instant ``t`` [s], Shape ``[D]``.

        The second derivative jumps at the points; there it is that of the segment that begins.
        """
        k = self.segment(t)
        if k < 0:
            ends: Float64Array = self.points[0 if t < self.times[0] else -1]
            return ends.copy() if order == 0 else np.zeros_like(ends)
        length = self.times[k + 1] - self.times[k]
        s = (t - self.times[k]) / length
        step = self.points[k + 1] - self.points[k]
        d0, d1 = self.slopes[k] * length, self.slopes[k + 1] * length
        c2, c3 = 3 * step - 2 * d0 - d1, d0 + d1 - 2 * step
        if order == 0:
            value: Float64Array = self.points[k] + s * (d0 + s * (c2 + s * c3))
            return value
        if order == 1:
            first: Float64Array = (d0 + s * (2 * c2 + s * 3 * c3)) / length
            return first
        second: Float64Array = (2 * c2 + s * 6 * c3) / length**2
        return second


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
