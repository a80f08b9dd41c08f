"""The paths of two keyframes side by side, and how ends and images move between them."""

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
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import Channel, Interaction, Scene
from caviar_services.channel.paths import Antenna


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


@dataclass(frozen=True, eq=False)
class Places:
    """Positions [m] or, of two instants' difference, displacements [m]; or velocities [m/s]."""

    start: Float64Array
    """Of each path's TX, Shape ``[K, 3]``."""
    end: Float64Array
    """Of each path's RX, Shape ``[K, 3]``."""
    objects: Float64Array
    """Of what stands at each of its points, Shape ``[K, D, 3]``; 0 for scenery."""

    def __sub__(self, other: Places) -> Places:
        return Places(self.start - other.start, self.end - other.end, self.objects - other.objects)

    def scaled(self, factor: float) -> Places:
        """All times a factor."""
        return Places(factor * self.start, factor * self.end, factor * self.objects)

    @property
    def most(self) -> Float64Array:
        """Sum of the lengths, objects twice, as a mirror moves an image: Shape ``[K]``."""
        moved: Float64Array = (
            np.linalg.norm(self.start, axis=-1)
            + np.linalg.norm(self.end, axis=-1)
            + 2 * np.linalg.norm(self.objects, axis=-1).sum(-1)
        )
        return moved


def ends_of(scene: Scene, joined: Joined) -> tuple[list[Antenna], list[Antenna]]:
    """Transmitters and receivers of the joined paths in a scene.

    Raises `PayloadError` where it lacks one of them.
    """
    found = []
    for role, names in (("tx", joined.tx), ("rx", joined.rx)):
        devices = {device.name: device for device in antennas(scene, role)}
        missing = [name for name in names if name not in devices]
        if missing:
            raise PayloadError(
                f"the scene lacks {role} {missing[0]!r}, which the keyframes have; pass that of the instant, "
                "or none"
            )
        found.append([Antenna.of(scene, devices[name]) for name in names])
    return found[0], found[1]


def places(scene: Scene, joined: Joined) -> Places:
    """Positions in a scene."""
    return _of(scene, joined, "position")


def velocities(scene: Scene, joined: Joined) -> Places:
    """Velocities in a scene."""
    return _of(scene, joined, "velocity")


def _of(scene: Scene, joined: Joined, field: str) -> Places:
    transmitters, receivers = ends_of(scene, joined)
    tx, rx = np.divmod(joined.pair, max(len(joined.rx), 1))
    index = {name: number for number, name in enumerate(scene.names)}
    values = np.concatenate([getattr(scene, field), np.zeros((1, 3))])
    named = [values[index.get(name, -1)] for name in joined.object_names]
    of_objects = np.array([*named, np.zeros(3)])
    return Places(
        np.array([getattr(antenna, field) for antenna in transmitters]).reshape(-1, 3)[tx],
        np.array([getattr(antenna, field) for antenna in receivers]).reshape(-1, 3)[rx],
        of_objects[joined.objects],
    )


def corners(places: Places, points: Float64Array, joined: Joined) -> Float64Array:
    """TX, points, RX of each path; points behind the last lie on RX: Shape ``[K, D + 2, 3]``."""
    inside = np.where((joined.types != 0)[..., None], points, places.end[:, None])
    return np.concatenate([places.start[:, None], inside, places.end[:, None]], axis=1)


def normals(corners: Float64Array, joined: Joined) -> Float64Array:
    """Of the mirrors, from the way the wave turns there; 0 where nothing is reflected: ``[K, D, 3]``."""
    segment = np.diff(corners, axis=1)
    length = np.linalg.norm(segment, axis=-1, keepdims=True)
    along = segment / np.where(length > 0, length, 1.0)
    turn = np.diff(along, axis=1)
    size = np.linalg.norm(turn, axis=-1, keepdims=True)
    mirror: BoolArray = (joined.types == Interaction.REFLECTION)[..., None]
    return np.where(mirror & (size > 0), turn / np.where(size > 0, size, 1.0), 0.0)


def image_moves(moved: Places, normals: Float64Array) -> tuple[Float64Array, Float64Array]:
    """How the vectors TX → image of RX and RX → image of TX [m] change, Shape ``[K, 3]`` each.

    A mirror with normal n that moves by o moves the image of a point that moves by x by
    x − 2n(n·x) + 2n(n·o): exact while the mirror does not turn.
    """
    depth = normals.shape[1]
    to_end, to_start = moved.end, moved.start
    for d in reversed(range(depth)):
        to_end = _mirrored(to_end, normals[:, d], moved.objects[:, d])
    for d in range(depth):
        to_start = _mirrored(to_start, normals[:, d], moved.objects[:, d])
    return to_end - moved.start, to_start - moved.end


def _mirrored(move: Float64Array, normal: Float64Array, mirror: Float64Array) -> Float64Array:
    across = ((mirror - move) * normal).sum(-1, keepdims=True)
    moved: Float64Array = move + 2 * across * normal
    return moved
