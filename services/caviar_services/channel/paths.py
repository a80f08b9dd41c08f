"""Paths between antennas as a channel model finds them, before any antenna is applied: tables, delays and
directions, stable ids, attenuation, and the lines of sight of near pairs.

An id is that of contract, clause 21: the same path has the same id in other frames and products. Points,
lengths and directions are those of an antenna's true position, from wherever it was traced
(`caviar_space.obstacles.CLEARANCE`).
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
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT, rotation_matrix
from caviar_protocol.space.scene import device_pose, device_velocity
from caviar_protocol.topics import AntennaArray, AntennaDevice, Scene
from caviar_services.channel.propagation.patterns import ElementPattern, Field, Patterns, radiated_field
from caviar_space.obstacles import Surfaces
from caviar_space.vectors import Rows, cross, equal_rows


@dataclass(frozen=True, eq=False)
class PathGeometry(Rows):
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
            None if patterns is None else patterns.element(device.array),
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
        >>> element = Patterns().element(AntennaArray())
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
    """Turning of K named objects."""

    centre: Float64Array
    """What they turn about [m], Shape ``[K, 3]``."""
    angular_velocity: Float64Array
    """In world axes [rad/s], Shape ``[K, 3]``."""

    def take(self, which: Sequence[int]) -> Turning:
        """Turning of some objects, in this order.

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
    first, kind = equal_rows(discrete)
    named = (
        tuple(
            (t, *(table.joined_faces[-1 - f] if f < 0 else (table.object_names[o], f)))
            for t, o, f in zip(row[:depth], row[depth : 2 * depth], row[2 * depth :], strict=True)
            if t
        )
        for row in discrete[first].tolist()
    )
    return np.array([_name_hash(names) for names in named], np.uint64), kind


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


NEAR_PAIR = 0.05
"""[m]; pairs nearer than this have their line of sight by formula, not from the ray tracer."""


def spread_anew(
    transfer: Complex128Array, specular: BoolArray, traced: Float64Array, length: Float64Array
) -> Complex128Array:
    """Dyads of paths that were traced with one length and have another.

    Args:
        transfer: As traced, Shape ``[C, P, 3, 3]``.
        specular: Paths of reflections and transmissions, whose field falls as one over the length, ``[P]``.
        traced: Length as traced [m], Shape ``[P]``.
        length: Length of the path [m], Shape ``[P]``.

    Example:
        >>> dyads = np.ones((1, 1, 3, 3), np.complex128)
        >>> spread_anew(dyads, np.array([True]), np.array([10.0]), np.array([20.0]))[0, 0, 0, 0]
        np.complex128(0.5+0j)
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        factor = np.where(specular & (length > 0), traced / length, 1.0)
    scaled: Complex128Array = transfer * factor[None, :, None, None]
    return scaled


def with_near_pairs(
    table: PathTable,
    los: BoolArray,
    transmitters: Sequence[Antenna],
    receivers: Sequence[Antenna],
    wavelengths: Float64Array,
    surfaces: Surfaces,
) -> tuple[PathTable, int]:
    """Paths with the lines of sight of near pairs by formula.

    A pair closer than one wavelength of a carrier is outside of the far field in which λ/(4πd) holds, and has
    no direct path; paths by way of surfaces stay.

    Args:
        table: Paths of all pairs.
        los: Whether the line of sight of each pair is free, Shape ``[T·R]``; corrected in place.
        transmitters: T antennas.
        receivers: R antennas.
        wavelengths: Of the carriers [m], Shape ``[C]``.
        surfaces: Of the scene.

    Returns:
        The paths, and the number of pairs that are too close for a direct one.
    """
    start, end = path_ends(np.arange(len(los)), transmitters, receivers)
    distance = np.sqrt(((end - start) ** 2).sum(-1))
    near = np.flatnonzero(distance < max(NEAR_PAIR, wavelengths.max()))
    tx, rx = np.divmod(near, max(len(receivers), 1))
    other = [transmitters[t].name != receivers[r].name for t, r in zip(tx.tolist(), rx.tolist(), strict=True)]
    near, tx, rx = near[other], tx[other], rx[other]
    if not len(near):
        return table, 0
    los[near] = [
        not surfaces.between(transmitters[t].position, receivers[r].position)
        for t, r in zip(tx.tolist(), rx.tolist(), strict=True)
    ]
    far = distance[near] >= wavelengths.max()
    straight = (table.types == 0).all(1)
    free = los[near]
    if table.hidden is not None:  # elements beside the centres may see each other where these do not
        free |= np.isin(near, table.pair[straight & table.hidden])
    table = table.take(~(straight & np.isin(table.pair, near)))
    direct = near[far & free]
    made = with_direct(table, direct, ~los[direct], distance[direct], wavelengths)
    return made, int(np.count_nonzero(~far))


def with_direct(
    table: PathTable, pairs: Int64Array, hidden: BoolArray, distance: Float64Array, wavelengths: Float64Array
) -> PathTable:
    """Paths with a direct one for each of N more pairs.

    Args:
        table: Paths.
        pairs: Numbers of the pairs, Shape ``[N]``.
        hidden: Whether only elements beside the centres have the direct path, Shape ``[N]``.
        distance: Of each pair [m], Shape ``[N]``.
        wavelengths: Of the carriers [m], Shape ``[C]``.
    """
    depth = table.types.shape[1]
    spreading = wavelengths[:, None] / (4 * np.pi * distance)
    made = spreading[:, :, None, None] * np.eye(3, dtype=np.complex128)
    empty = np.zeros((len(pairs), depth), np.uint8)
    return replace(
        table,
        pair=np.concatenate([table.pair, pairs]),
        transfer=np.concatenate([table.transfer, made], axis=1),
        types=np.concatenate([table.types, empty]),
        objects=np.concatenate([table.objects, np.full((len(pairs), depth), -1, np.int32)]),
        points=np.concatenate([table.points, np.zeros((len(pairs), depth, 3))]),
        hidden=None if table.hidden is None else np.concatenate([table.hidden, hidden]),
        traced=None if table.traced is None else np.concatenate([table.traced, np.full(len(pairs), -1)]),
        faces=None if table.faces is None else np.concatenate([table.faces, empty.astype(np.int32)]),
    )


def path_ends(
    pair: Int64Array, transmitters: Sequence[Antenna], receivers: Sequence[Antenna], field: str = "position"
) -> tuple[Float64Array, Float64Array]:
    """Positions [m] of TX and RX of paths, or another vector of theirs, each of Shape ``[P, 3]``.

    Args:
        pair: Pair of each path, Shape ``[P]``.
        transmitters, receivers: Antennas.
        field: Name of the vector in `Antenna`.
    """
    tx, rx = np.divmod(pair, max(len(receivers), 1))
    start, end = (
        np.array([getattr(antenna, field) for antenna in antennas]).reshape(-1, 3)
        for antennas in (transmitters, receivers)
    )
    return start[tx], end[rx]
