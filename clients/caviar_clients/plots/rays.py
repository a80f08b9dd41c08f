"""The paths of a channel as a map shows them: routes that are known, and directions of those that are not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import Channel, Scene
from caviar_protocol.topics.channel import Interaction

PATHS_OF_A_PAIR = 25
"""Of a pair so many of the strongest paths are drawn."""

RANGE_DB = 50.0
"""Paths weaker than the strongest by more than this have the last colour."""

_STRAIGHT = np.cos(np.radians(0.5))
"""Cosine of the angle by which a straight path's directions may differ from the straight line."""


@dataclass(frozen=True, eq=False)
class Rays:
    """Paths seen from above; gains are those of the first carrier [dB].

    A path without interaction points is a line only if it leaves and arrives along the straight line
    between its ends. Otherwise, as with components that a statistical model draws, its route is
    unknown, and it has two ticks, one at either end.
    """

    lines: list[Float64Array]
    """x and y [m] of transmitter, points and receiver, Shape ``[N, 2]`` each."""
    gains: Float64Array
    """Shape ``[lines]``."""
    ends: Float64Array
    """Where ticks stand, x and y [m], Shape ``[T, 2]``."""
    towards: Float64Array
    """Directions of the ticks, unit vectors in space of which x and y are kept, Shape ``[T, 2]``."""
    tick_gains: Float64Array
    """Shape ``[T]``."""

    @property
    def all_gains(self) -> Float64Array:
        """Of lines and ticks."""
        return np.concatenate([self.gains, self.tick_gains])

    def ticks(self, length_m: float) -> Float64Array:
        """Both ends of each tick in x and y [m], Shape ``[T, 2, 2]``."""
        result: Float64Array = np.stack([self.ends, self.ends + length_m * self.towards], axis=1)
        return result


def rays(scene: Scene, channel: Channel | None) -> Rays:
    """The strongest paths of each pair whose devices are in the scene."""
    lines: list[Float64Array] = []
    gains: list[float] = []
    ticks: list[Float64Array] = []
    tick_gains: list[float] = []
    if channel is not None and len(channel.carriers):
        places = {d.name: np.array(device_pose(scene, d).position) for d in scene.devices}
        power = np.abs(channel.a[0]) ** 2
        used = channel.interactions != Interaction.NONE
        leaving, coming = unit_vectors(channel.aod), unit_vectors(channel.aoa)
        for tx in channel.tx:
            for rx in channel.rx:
                if tx not in places or rx not in places:
                    continue
                start, end = places[tx], places[rx]
                pair = channel.pair(tx, rx)
                strongest = np.argsort(-power[pair], kind="stable")[:PATHS_OF_A_PAIR] + pair.start
                strongest = strongest[power[strongest] > 0]
                known = used[strongest].any(axis=1)
                known |= _straight(start, end, leaving[strongest], coming[strongest])
                for path, is_known in zip(strongest, known, strict=True):
                    gain = 10 * float(np.log10(power[path]))
                    if is_known:
                        lines.append(np.vstack([start, channel.points[path][used[path]], end])[:, :2])
                        gains.append(gain)
                    else:
                        ticks += [np.stack([start, leaving[path]]), np.stack([end, coming[path]])]
                        tick_gains += [gain, gain]
    table = np.array(ticks).reshape(-1, 2, 3)
    return Rays(lines, np.array(gains), table[:, 0, :2], table[:, 1, :2], np.array(tick_gains))


def scale(gains: Float64Array) -> tuple[float, float]:
    """Limits of the colours [dB] for paths of these gains, of which there is at least one."""
    top = float(gains.max())
    return max(float(gains.min()), top - RANGE_DB) - 1e-9, top


def unit_vectors(angles: Float64Array) -> Float64Array:
    """Unit vectors of (zenith, azimuth) [rad], Shape ``[N, 2]`` to ``[N, 3]``."""
    zenith, azimuth = angles[:, 0], angles[:, 1]
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=-1)


def _straight(
    start: Float64Array, end: Float64Array, leaving: Float64Array, coming: Float64Array
) -> BoolArray:
    """Which paths leave towards the other end and come from where the wave started, Shape ``[N]``."""
    line = end - start
    distance = float(np.linalg.norm(line))
    if distance == 0:
        return np.ones(len(leaving), np.bool_)
    line = line / distance
    result: BoolArray = (leaving @ line >= _STRAIGHT) & (coming @ -line >= _STRAIGHT)
    return result
