"""The channel ``geometric`` of many episodes at once, with the formulas of the service as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.coordinates import Pose, unrotated
from caviar_protocol.space.scene import antennas
from caviar_services.channel.batch import BatchChannels, ChannelBatch, MemberSeed, SceneAt
from caviar_services.channel.statistical.waves import BLOCK, Draws, Line, superposed_waves, times, turned

if TYPE_CHECKING:
    from caviar_services.channel.statistical.geometric import GeometricChannel


class GeometricBatch(ChannelBatch):
    """Channels of M members, of which each draws what the service draws for its seed.

    Args:
        model: Prepared, with the settings and patterns of the run.
    """

    def __init__(self, model: GeometricChannel) -> None:
        self._model = model
        self._members: Sequence[MemberSeed] = ()
        self._block = -1
        self._draws: dict[tuple[str, str], Draws] = {}

    def begin(self, members: Sequence[MemberSeed]) -> None:
        self._members, self._block = tuple(members), -1

    def reach(self, number: int) -> int:
        _, row = self._model.block_of(number)
        return BLOCK if self._model.draws_last else BLOCK - row

    def width(self, members: int) -> int:
        return members * self._model.settings.components

    def channels(self, frames: Sequence[SceneAt]) -> BatchChannels:
        first = frames[0].scene
        transmitters, receivers = antennas(first, "tx"), antennas(first, "rx")
        sights = [self._model.sight(at.scene, transmitters, receivers) for at in frames]
        near = np.array([sight.near for sight in sights], np.bool_)
        free = np.array([sight.free for sight in sights], np.bool_)
        h, has_path = [], []
        for pair in range(len(transmitters) * len(receivers)):
            lines = [sight.lines[pair] for sight in sights]
            amplitude, matrices = self._pair(lines, frames[0].number, free[:, pair])
            apart = ~near[:, pair]
            h.append(matrices if apart.all() else np.where(apart[:, None, None, None], matrices, 0.0))
            has_path.append(amplitude.any(axis=-1) & apart[:, None])
        return BatchChannels(h, np.stack(has_path, axis=2), free)

    def _pair(
        self, lines: Sequence[Line], number: int, free: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
    ) -> tuple[Complex128Array, Complex128Array]:
        """Amplitudes, Shape ``[M, K, C, L]``, and H of a pair, Shape ``[M, K, C, Nr, Nt]``."""
        model, tx, rx = self._model, lines[0].tx, lines[0].rx
        made = model.components(self._drawn(tx.name, rx.name, number, len(lines)), free)
        phase = np.array([line.phase for line in lines])[..., None]
        parts = times((made.amplitude[..., 0], made.amplitude[..., 1]), (phase[:, :, 0], phase[:, :, 1]))
        amplitude = np.empty(parts[0].shape, np.complex128)
        amplitude.real, amplitude.imag = parts
        turn = np.moveaxis(made.turn, -1, 0)
        outwards, inwards = ([getattr(line, end) for line in lines] for end in ("outwards", "inwards"))
        departures = _local(outwards, turn[:4], [line.tx_pose for line in lines])
        arrivals: Float64Array | None = None
        if rx.array.size > 1 or model.has_path_gain:
            arrivals = _local(inwards, turn[4:], [line.rx_pose for line in lines])
        if model.has_path_gain and arrivals is not None:
            patterns = model.pattern_gain(tx.array, departures, rx.array, arrivals)
            # Of two devices at one place there is no gain, and no path.
            length = np.array([line.length or 1.0 for line in lines])[:, None]
            tau = np.array([line.delay for line in lines])[:, None] + made.excess
            amplitude *= model.path_gain(length, patterns, tau)
        transmit = steering_vector(tx.array, departures)
        receive = None
        if rx.array.size > 1 and arrivals is not None:
            receive = steering_vector(rx.array, arrivals)
        return amplitude, superposed_waves(amplitude, transmit, receive)

    def _drawn(self, tx: str, rx: str, number: int, count: int) -> Draws:
        """Draws of all members in some frames of a block, Shape ``[M, K]`` in place of ``[F]``."""
        model = self._model
        block, row = model.block_of(number)
        if block != self._block:
            self._draws.clear()
            self._block = block
        drawn = self._draws.get((tx, rx))
        if drawn is None:
            members = [model.draws(*member, (tx, rx), block) for member in self._members]
            drawn = Draws(*[np.stack(field) for field in zip(*members, strict=True)])
            self._draws[tx, rx] = drawn
        # Draws that last an episode are one row, which is that of every frame.
        rows = slice(None) if model.draws_last else slice(row, row + count)
        return Draws(
            gain=drawn.gain[:, rows],
            excess=drawn.excess[:, rows],
            excess_free=drawn.excess_free[:, rows],
            deviation=drawn.deviation[:, rows],
        )


def _local(lines: Sequence[Sequence[float]], turn: Float64Array, poses: Sequence[Pose]) -> Float64Array:
    """Directions of waves in the axes of a device.

    Args:
        lines: Of each frame, as `turned` takes them.
        turn: Deviations, Shape ``[4, M, K, L]``.
        poses: Of the device in each frame.

    Returns:
        Unit vectors, Shape ``[M, K, L, 3]``.
    """
    of_line = np.array(lines).T[..., None]
    orientation = np.array([pose.orientation for pose in poses]).T[..., None]
    vectors = turned(tuple(of_line), tuple(turn))
    return np.stack(unrotated(tuple(orientation), vectors), axis=-1)
