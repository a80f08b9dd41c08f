"""The paths of two keyframes side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import (
    BoolArray,
    Complex128Array,
    Float64Array,
    Int32Array,
    Int64Array,
    UInt8Array,
    UInt64Array,
)
from caviar_protocol.errors import PayloadError
from caviar_protocol.topics import Channel, Interaction


@dataclass(frozen=True, eq=False)
class End:
    """What a keyframe says about the K joined paths; where it lacks one, what the other keyframe says."""

    tau: Float64Array
    """[s], Shape ``[K]``."""
    departure: Float64Array
    """Unit vectors, Shape ``[K, 3]``; likewise ``arrival``, from RX towards the wave."""
    arrival: Float64Array
    doppler_ratio: Float64Array
    """Doppler shift over carrier frequency, Shape ``[K]``."""
    gain: Complex128Array
    """a·exp(+j2πfτ)·τ [s]: amplitude without carrier phase and spreading, Shape ``[C, K]``."""
    points: Float64Array
    """[m], Shape ``[K, D, 3]``."""


@dataclass(frozen=True, eq=False)
class Joined:
    """K paths that one of two keyframes has, or both."""

    tx: tuple[str, ...]
    """Devices that both keyframes have; likewise ``rx``."""
    rx: tuple[str, ...]
    object_names: tuple[str, ...]
    pair: Int64Array
    """TX index · number of RX + RX index, Shape ``[K]``."""
    id: UInt64Array
    types: UInt8Array
    """`Interaction`, Shape ``[K, D]``."""
    objects: Int32Array
    """Index into ``object_names``, −1 where none, Shape ``[K, D]``."""
    before: BoolArray
    """The earlier keyframe has it, Shape ``[K]``; likewise ``after``."""
    after: BoolArray
    ends: tuple[End, End]
    los: tuple[BoolArray, BoolArray]
    """As in `Channel`, of both keyframes, Shape ``[T, R]``."""

    @property
    def kept(self) -> BoolArray:
        """Paths of both keyframes, Shape ``[K]``."""
        return self.before & self.after

    @property
    def specular(self) -> BoolArray:
        """Paths that images straighten: reflected and transmitted alone, Shape ``[K]``."""
        bends = (self.types == Interaction.DIFFRACTION) | (self.types == Interaction.SCATTERING)
        specular: BoolArray = ~bends.any(1)
        return specular


def join(before: Channel, after: Channel) -> Joined:
    """Paths by TX, RX and id.

    Raises `PayloadError` for products with other carriers or of other rungs.
    """
    if before.carriers != after.carriers or before.rung != after.rung:
        raise PayloadError(
            f"keyframes must be of one rung and the same carriers, not {before.rung!r} with "
            f"{[c.name for c in before.carriers]} and {after.rung!r} with {[c.name for c in after.carriers]}"
        )
    tx = tuple(name for name in before.tx if name in after.tx)
    rx = tuple(name for name in before.rx if name in after.rx)
    names = tuple(sorted({*before.object_names, *after.object_names}))
    depth = max(before.interactions.shape[1], after.interactions.shape[1])
    first, second, pair = _rows(before, after, tx, rx)
    has, gets = first >= 0, second >= 0
    tables = [_Table.of(channel, names, depth) for channel in (before, after)]

    def either(field: str) -> np.ndarray[tuple[int, ...], np.dtype[np.generic]]:
        one, other = (getattr(table, field) for table in tables)
        return np.concatenate([one, other])[np.where(has, first, len(one) + second)]

    ends = (
        _end(tables, np.where(has, first, len(before.tau) + second)),
        _end(tables, np.where(gets, len(before.tau) + second, first)),
    )
    return Joined(
        tx=tx,
        rx=rx,
        object_names=names,
        pair=pair,
        id=either("id").astype(np.uint64),
        types=either("types").astype(np.uint8),
        objects=either("objects").astype(np.int32),
        before=has,
        after=gets,
        ends=ends,
        los=(_los(before, tx, rx), _los(after, tx, rx)),
    )


def _rows(
    before: Channel, after: Channel, tx: Sequence[str], rx: Sequence[str]
) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Rows in both products of all joined paths, −1 where one lacks it, and their pairs."""
    first, second, pairs = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for number, (sender, receiver) in enumerate((t, r) for t in tx for r in rx):
        old, new = before.pair(sender, receiver), after.pair(sender, receiver)
        _, i, j = np.intersect1d(before.id[old], after.id[new], return_indices=True)
        died = np.setdiff1d(np.arange(old.stop - old.start), i)
        born = np.setdiff1d(np.arange(new.stop - new.start), j)
        first += [old.start + i, old.start + died, np.full(len(born), -1)]
        second += [new.start + j, np.full(len(died), -1), new.start + born]
        pairs.append(np.full(len(i) + len(died) + len(born), number))
    return np.concatenate(first), np.concatenate(second), np.concatenate(pairs)


def _los(channel: Channel, tx: Sequence[str], rx: Sequence[str]) -> BoolArray:
    rows, columns = [channel.tx.index(name) for name in tx], [channel.rx.index(name) for name in rx]
    los: BoolArray = channel.los[np.ix_(rows, columns)]
    return los


@dataclass(frozen=True, eq=False)
class _Table:
    """A product's paths, with the depth and the object names of both."""

    channel: Channel
    id: UInt64Array
    types: UInt8Array
    objects: Int32Array
    points: Float64Array

    @classmethod
    def of(cls, channel: Channel, names: Sequence[str], depth: int) -> _Table:
        more = depth - channel.interactions.shape[1]
        index = np.array([*(names.index(name) for name in channel.object_names), -1], np.int32)
        return cls(
            channel,
            channel.id,
            np.pad(channel.interactions, ((0, 0), (0, more))),
            np.pad(index[channel.objects], ((0, 0), (0, more)), constant_values=-1),
            np.pad(channel.points, ((0, 0), (0, more), (0, 0))),
        )


def _end(tables: Sequence[_Table], rows: Int64Array) -> End:
    """Rows of both tables, one after the other."""
    channels = [table.channel for table in tables]
    frequency = np.array([carrier.frequency_hz for carrier in channels[0].carriers])[:, None]
    tau = np.concatenate([channel.tau for channel in channels])[rows]
    a = np.concatenate([channel.a for channel in channels], axis=1)[:, rows]
    doppler = np.concatenate([channel.doppler for channel in channels], axis=1)[:, rows]
    return End(
        tau=tau,
        departure=unit_vectors(np.concatenate([channel.aod for channel in channels])[rows]),
        arrival=unit_vectors(np.concatenate([channel.aoa for channel in channels])[rows]),
        doppler_ratio=(doppler / frequency).mean(0),
        gain=a * tau / carrier_phase(frequency, tau),
        points=np.concatenate([table.points for table in tables])[rows],
    )


def unit_vectors(angles: Float64Array) -> Float64Array:
    """Of directions (zenith, azimuth) [rad], Shape ``[K, 2]`` to ``[K, 3]``."""
    zenith, azimuth = angles[:, 0], angles[:, 1]
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=-1)


def carrier_phase(frequency: Float64Array, tau: Float64Array) -> Complex128Array:
    """exp(−j2πfτ), Shape ``[C, K]`` for ``frequency`` of Shape ``[C, 1]``."""
    # The whole turns of f·τ go first: they are millions, and only the rest is a phase.
    turns = frequency * tau
    phase: Complex128Array = np.exp(-2j * np.pi * (turns - np.round(turns)))
    return phase
