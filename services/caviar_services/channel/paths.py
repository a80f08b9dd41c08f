"""Paths between antennas as a channel model finds them, before any antenna is applied, and their stable ids.

An id is that of contract, clause 21: the same path has the same id in other frames and products.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

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
from caviar_protocol.space.antenna_arrays import subarrays
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.space.scene import device_pose, device_velocity
from caviar_protocol.topics import AntennaArray, AntennaDevice, Scene
from caviar_services.channel.propagation.geometry import Rows
from caviar_services.channel.propagation.patterns import ElementPattern, Field, Patterns, radiated_field
from caviar_space.vectors import cross


@dataclass(frozen=True, eq=False)
class Antenna:
    """An antenna device where it is in this frame, in world axes."""

    name: str
    array: AntennaArray
    position: Float64Array
    """[m], Shape ``[3]``."""
    rotation: Float64Array
    """Turns device axes into world axes, Shape ``[3, 3]``."""
    velocity: Float64Array
    """[m/s], Shape ``[3]``."""
    pattern: ElementPattern | None = None
    """Of its elements; None: the one that the array names."""
    part: int = 0
    """Which of a device's subarrays this is."""

    @classmethod
    def of(cls, scene: Scene, device: AntennaDevice, patterns: Patterns | None = None) -> Antenna:
        """Place the antenna of a device in the world: its pose is composed with that of its parent.

        Args:
            scene: With the parent.
            device: Of the scene.
            patterns: Knows patterns from files; without it the antenna is not to be asked for its field.
        """
        pose = device_pose(scene, device)
        return cls(
            device.name,
            device.array,
            np.array(pose.position),
            rotation_matrix(pose.orientation),
            device_velocity(scene, device),
            None if patterns is None else patterns.of(device.array),
        )

    @cached_property
    def subarrays(self) -> tuple[Antenna, ...]:
        """Its uniform parts, one for each panel and polarization, as antennas where they stand."""
        # Most arrays are uniform: their only part is the antenna itself, and is not copied.
        if self.array.is_uniform:
            return (self,)
        return tuple(
            replace(
                self,
                array=part.array,
                position=self.position + self.rotation @ np.array(part.position),
                rotation=self.rotation @ rotation_matrix(part.orientation),
                part=number,
            )
            for number, part in enumerate(subarrays(self.array))
        )

    def radiated(self, directions: Float64Array, *, arrival: bool = False) -> Field:
        """Far field of an element of the first subarray.

        Args:
            directions: Unit vectors in world axes, Shape ``[P, 3]``.
            arrival: Whether the antenna receives.
        """
        first = self.subarrays[0]
        return radiated_field(first.array, first.rotation, directions, first.pattern, arrival=arrival)


def antenna_fields(
    antennas: Sequence[Antenna], which: Int64Array, directions: Float64Array, *, arrival: bool = False
) -> Field:
    """Field of the antenna that each path has at one end, towards the path, Shape ``[P, 3]``.

    Args:
        antennas: All at this end.
        which: Index of the antenna of each path, Shape ``[P]``.
        directions: Unit vectors from the antenna towards the path, Shape ``[P, 3]``.
        arrival: Whether the antennas receive.

    Example:
        >>> element = Patterns().of(AntennaArray())
        >>> mast = Antenna("bs", AntennaArray(), np.zeros(3), np.eye(3), np.zeros(3), element)
        >>> antenna_fields([mast], np.array([0]), np.array([[1.0, 0.0, 0.0]])).tolist()
        [[0.0, 0.0, -1.0]]
    """
    # With one base station, a mask over all paths would only copy them.
    if len(antennas) == 1:
        return antennas[0].radiated(directions, arrival=arrival)
    found: Field = np.zeros((len(which), 3))
    for index, antenna in enumerate(antennas):
        mine = which == index
        field = antenna.radiated(directions[mine], arrival=arrival)
        if np.iscomplexobj(field) and not np.iscomplexobj(found):
            found = found.astype(np.complex128)
        found[mine] = field
    return found


@dataclass(frozen=True, eq=False)
class Turning:
    """How K named objects turn."""

    centre: Float64Array
    """What they turn about [m], Shape ``[K, 3]``."""
    angular_velocity: Float64Array
    """In world axes [rad/s], Shape ``[K, 3]``."""

    def take(self, which: Sequence[int]) -> Turning:
        """Those of some objects, in this order.

        Args:
            which: Numbers of objects.
        """
        return Turning(self.centre[list(which)], self.angular_velocity[list(which)])

    def velocity(self, objects: Int32Array, points: Float64Array) -> Float64Array:
        """Velocity that turning adds to points of objects, ω × r [m/s], Shape ``[..., 3]``.

        Args:
            objects: Number of the object of each point, −1 for what stands, Shape ``[...]``.
            points: [m], Shape ``[..., 3]``.
        """
        centre = np.concatenate([self.centre, np.zeros((1, 3))])[objects]
        turning = np.concatenate([self.angular_velocity, np.zeros((1, 3))])[objects]
        return cross(turning, points - centre)


@dataclass(frozen=True, eq=False)
class PathTable(Rows):
    """Paths as a model found them: any order, no antennas applied, no carrier phase.

    P paths of at most D interactions, C carriers.
    """

    by_carrier = frozenset({"transfer"})
    shared = frozenset({"object_velocity"})
    pair: Int64Array
    """TX index · number of RX + RX index, Shape ``[P]``."""
    transfer: Complex128Array
    """Dyad from the field sent to the field received, with spreading λ/(4πd) and without
    exp(−j2πfτ), in world axes; Shape ``[C, P, 3, 3]``, rows at RX, columns at TX."""
    types: UInt8Array
    """`Interaction` at each point, Shape ``[P, D]``; 0 past the last."""
    objects: Int32Array
    """Index into ``object_names``, Shape ``[P, D]``; −1 past the last."""
    points: Float64Array
    """Interaction points [m], Shape ``[P, D, 3]``."""
    object_names: tuple[str, ...]
    object_velocity: Float64Array
    """Velocity [m/s] of each named object, Shape ``[len(object_names), 3]``."""
    hidden: BoolArray | None = None
    """Paths that only elements beside the arrays' centres have: they are in H alone, Shape ``[P]``; absent:
    none is."""
    traced: Int64Array | None = None
    """Number of each among the paths of all launches, Shape ``[P]``; −1 for paths by formula; absent:
    unknown."""
    faces: Int32Array | None = None
    """Number of the plane of each point within its object, the same in every frame, Shape ``[P, D]``;
    absent: unknown. Below 0: −1 minus the place of a surface in ``joined_faces``."""
    joined_faces: tuple[tuple[str, int], ...] = ()
    """Object and number of the plane that surfaces of several objects are known by."""
    object_turning: Turning | None = None
    """How named objects turn; absent: none does."""

    @property
    def point_velocity(self) -> Float64Array:
        """Velocity [m/s] of what stands at each point, there, Shape ``[P, D, 3]``."""
        # The index −1 of what is no object finds the row of zeros at the end.
        velocity: Float64Array = np.concatenate([self.object_velocity, np.zeros((1, 3))])[self.objects]
        if self.object_turning is not None:
            velocity = velocity + self.object_turning.velocity(self.objects, self.points)
        return velocity


def stable_ids(table: PathTable) -> UInt64Array:
    """Give paths ids that are the same in other frames and products.

    An id is a hash of types, object names, faces, and rank among equals in the pair.

    Args:
        table: Sorted.

    Returns:
        Shape ``[P]``.
    """
    ids = np.zeros(len(table.pair), np.uint64)
    if not len(ids):
        return ids
    base, kind = _kinds(table)
    place = np.arange(len(ids))
    # Of one kind alone, as lines of sight, each pair is a run of equals.
    if len(base) == 1:
        return _ids(base[kind], place - np.searchsorted(table.pair, table.pair))
    # In a stable order, so the rank follows the sorted paths: distance to the start of the run of equals.
    order = np.lexsort((kind, table.pair))
    first = np.ones(len(ids), np.bool_)
    ranked, pair = kind[order], table.pair[order]
    first[1:] = (ranked[1:] != ranked[:-1]) | (pair[1:] != pair[:-1])
    rank = np.empty(len(ids), np.int64)
    rank[order] = place - np.maximum.accumulate(np.where(first, place, 0))
    return _ids(base[kind], rank)


def _ids(base: UInt64Array, rank: Int64Array) -> UInt64Array:
    # 2⁶⁴ divided by the golden ratio is the increment of SplitMix64: neighbouring ranks differ in all bits.
    return _mix(base + rank.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15))


def _kinds(table: PathTable) -> tuple[UInt64Array, Int64Array]:
    """Hashes of the kinds of paths that occur, and which of them each path is."""
    depth = table.types.shape[1]
    if not depth:
        return np.array([_name_hash(())], np.uint64), np.zeros(len(table.pair), np.int64)
    faces = np.zeros_like(table.objects) if table.faces is None else table.faces
    objects = np.where(faces < 0, -1, table.objects)
    # Paths of one kind are equal rows of integers: names are hashed once a kind, not once a path.
    discrete = np.concatenate([table.types.astype(np.int32), objects, faces], axis=1)
    kinds, kind = np.unique(discrete, axis=0, return_inverse=True)
    named = (
        tuple(
            (t, *(table.joined_faces[-1 - f] if f < 0 else (table.object_names[o], f)))
            for t, o, f in zip(row[:depth], row[depth : 2 * depth], row[2 * depth :], strict=True)
            if t
        )
        for row in kinds.tolist()
    )
    return np.array([_name_hash(names) for names in named], np.uint64), kind.reshape(-1)


# Kinds of paths recur from frame to frame.
@lru_cache(maxsize=4096)
def _name_hash(kind: tuple[tuple[int, str, int], ...]) -> int:
    text = "\0".join(f"{interaction}\0{name}\0{face}" for interaction, name, face in kind)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def _mix(x: UInt64Array) -> UInt64Array:
    """Finaliser of SplitMix64 (Steele, Lea, Flood 2014): a bijection that spreads every bit."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
