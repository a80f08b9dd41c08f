"""What the gains of a radio map mean to a receiver: received power, SINR, best server."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Coverage:
    """Gains of T transmitters in a grid of cells, and their powers.

    A receiver has one isotropic element that takes waves of both polarisations.
    """

    gain: Float64Array
    """Mean power gain over each cell with the beam that serves it, Shape ``[T, ny, nx]``; 0: no signal."""
    interference_gain: Float64Array
    """The same while a transmitter serves other cells, Shape ``[T, ny, nx]``."""
    power_w: Float64Array
    """Of the transmitters, Shape ``[T]``."""
    noise_w: float
    """Of the receiver, in the carrier's bandwidth."""

    @cached_property
    def rss(self) -> Float64Array:
        """Received power [W] from each transmitter that serves, Shape ``[T, ny, nx]``."""
        received: Float64Array = self.power_w[:, None, None] * self.gain
        return received

    @cached_property
    def sinr(self) -> Float64Array:
        """Received power over noise and what all other transmitters bring, Shape ``[T, ny, nx]``.

        SINR_k = P_k·g_k / (N_0 + Σ_{j≠k} P_j·i_j) with the gains g and i (`interference_gain`).
        """
        interference = self.power_w[:, None, None] * self.interference_gain
        # Not the sum less one's own: of float rounding, little would be left where one is far stronger.
        others = np.stack([np.delete(interference, t, axis=0).sum(axis=0) for t in range(len(self.power_w))])
        ratio: Float64Array = self.rss / (self.noise_w + others)
        return ratio

    @cached_property
    def best_server(self) -> Int32Array:
        """Index of the transmitter with the greatest received power, Shape ``[ny, nx]``; −1: no signal."""
        return np.where(self.rss.max(axis=0) > 0, self.rss.argmax(axis=0), -1).astype(np.int32)

    @property
    def has_signal(self) -> BoolArray:
        """Cells that any transmitter reaches, Shape ``[ny, nx]``."""
        return self.best_server >= 0

    def of_server(self, values: Float64Array) -> Float64Array:
        """Values of the best server, Shape ``[T, ny, nx]`` to ``[ny, nx]``; NaN where there is none."""
        chosen = np.take_along_axis(values, np.maximum(self.best_server, 0)[None], axis=0)[0]
        return np.where(self.has_signal, chosen, np.nan)


def decibels(values: Float64Array, reference: float = 1.0) -> Float64Array:
    """10·log10(values/reference) [dB]; NaN for 0 and for NaN."""
    positive = values > 0
    return np.where(positive, 10 * np.log10(np.where(positive, values, 1.0) / reference), np.nan)
