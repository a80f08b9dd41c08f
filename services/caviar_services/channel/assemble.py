"""From the paths a model found to the canonical `Channel` product (contract, clauses 20 and 21)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

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
from caviar_protocol.coordinates import angles, rotation_matrix
from caviar_protocol.scene import device_pose, device_velocity
from caviar_protocol.topics import (
    AntennaArray,
    AntennaDevice,
    Carrier,
    Channel,
    ChannelMatrix,
    ChannelOptions,
    Scene,
)
from caviar_services.antenna import steering_vector
from caviar_services.channel.atmosphere import amplitude_factor
from caviar_services.channel.geometry import PathGeometry, path_geometry
from caviar_services.channel.patterns import radiated_field
from caviar_services.channel.stacked import summed


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

    @classmethod
    def of(cls, scene: Scene, device: AntennaDevice) -> Antenna:
        """The antenna of a device, composed with its parent's pose."""
        pose = device_pose(scene, device)
        return cls(
            device.name,
            device.array,
            np.array(pose.position),
            rotation_matrix(pose.orientation),
            device_velocity(scene, device),
        )


@dataclass(frozen=True, eq=False)
class PathTable:
    """Paths as a model found them: any order, no antennas applied, no carrier phase.

    P paths of at most D interactions, C carriers.
    """

    pair: Int64Array
    """TX index · number of RX + RX index, Shape ``[P]``."""
    transfer: Complex128Array
    """Dyad from the field sent to the field received, with spreading λ/(4πd) and without
    exp(−j2πfτ), in world axes; Shape ``[C, P, 3, 3]``, rows at RX, columns at TX."""
    types: UInt8Array
    """`Interaction` at each point, Shape ``[P, D]``; 0 behind the last."""
    objects: Int32Array
    """Index into ``object_names``, Shape ``[P, D]``; −1 behind the last."""
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
    absent: unknown."""

    def take(self, which: Int64Array | BoolArray) -> PathTable:
        """These paths, in this order."""
        return PathTable(
            pair=self.pair[which],
            transfer=self.transfer[:, which],
            types=self.types[which],
            objects=self.objects[which],
            points=self.points[which],
            object_names=self.object_names,
            object_velocity=self.object_velocity,
            faces=None if self.faces is None else self.faces[which],
            hidden=None if self.hidden is None else self.hidden[which],
            traced=None if self.traced is None else self.traced[which],
        )


@dataclass(frozen=True, kw_only=True)
class Product:
    """What a product says about itself beside its paths."""

    rung: str
    options: ChannelOptions
    carriers: tuple[Carrier, ...]
    with_h: bool
    absorption_db_per_km: Float64Array | None = None
    """By the air, on each carrier, Shape ``[C]``; None: no atmosphere."""


@dataclass(frozen=True, eq=False)
class Located:
    """P paths in the order of the product, as matrices are made of them."""

    row: Int64Array
    """Row of each in the model's `PathTable`, Shape ``[P]``."""
    pair: Int64Array
    offsets: Int64Array
    """As in `Channel`: paths of a pair are ``offsets[pair]`` to ``offsets[pair + 1]``."""
    geometry: PathGeometry
    a: Complex128Array
    """As in `Channel`, Shape ``[C, P]``."""
    transfer: Complex128Array
    """As in `PathTable`, Shape ``[C, P, 3, 3]``, with absorption by the air."""
    absorption_db_per_km: Float64Array | None
    """As in `Product`."""


Matrices = Callable[
    [Sequence[Carrier], Sequence[Antenna], Sequence[Antenna], Located], tuple[ChannelMatrix, ...]
]
"""Makes the matrices of a product from its paths."""


def assemble(
    product: Product,
    transmitters: Sequence[Antenna],
    receivers: Sequence[Antenna],
    table: PathTable,
    los: BoolArray,
    matrices: Matrices | None = None,
) -> Channel:
    """The canonical product: antennas, phase and absorption applied, non-finite paths dropped, sorted.

    ``matrices`` makes H where somebody asks for it: `plane_waves` unless the model has a way of its own.
    """
    table = _canonical_names(table)
    row = np.arange(len(table.pair))
    with np.errstate(invalid="ignore"):  # what is not finite is dropped and counted below
        geometry = _geometry(table, transmitters, receivers)
        a = _amplitudes(product.carriers, table, geometry, transmitters, receivers)
        if product.absorption_db_per_km is not None:
            a = a * amplitude_factor(product.absorption_db_per_km, geometry.tau)
    finite = _finite(table, geometry, a)
    dropped = len(finite) - int(np.count_nonzero(finite))
    if dropped:
        table, geometry, a, row = table.take(finite), _select(geometry, finite), a[:, finite], row[finite]
    aod, aoa = angles(geometry.departure), angles(geometry.arrival)
    if len(table.pair) > 1:
        order = _order(table, geometry, aod, aoa, a)
        table, geometry, a, row = table.take(order), _select(geometry, order), a[:, order], row[order]
        aod, aoa = aod[order], aoa[order]

    pairs = len(transmitters) * len(receivers)
    offsets = np.searchsorted(table.pair, np.arange(pairs + 1)).astype(np.int64)
    h: tuple[ChannelMatrix, ...] = ()
    if product.with_h:
        located = _located(product, row, table, offsets, geometry, a)
        h = (matrices or plane_waves)(product.carriers, transmitters, receivers, located)
    if table.hidden is not None and table.hidden.any():
        shown = ~table.hidden
        table, geometry, a = table.take(shown), _select(geometry, shown), a[:, shown]
        aod, aoa = aod[shown], aoa[shown]
        offsets = np.searchsorted(table.pair, np.arange(pairs + 1)).astype(np.int64)
    frequency = np.array([carrier.frequency_hz for carrier in product.carriers])
    depth = int((table.types != 0).sum(1).max(initial=0))
    return Channel(
        rung=product.rung,
        options=product.options,
        carriers=product.carriers,
        tx=tuple(antenna.name for antenna in transmitters),
        rx=tuple(antenna.name for antenna in receivers),
        los=los,
        offsets=offsets,
        object_names=table.object_names,
        id=_ids(table),
        a=a,
        tau=geometry.tau,
        aod=aod,
        aoa=aoa,
        doppler=frequency[:, None] * geometry.doppler_ratio,
        interactions=table.types[:, :depth],
        points=table.points[:, :depth],
        objects=table.objects[:, :depth],
        h=h,
        dropped=dropped,
    )


def _located(
    product: Product,
    row: Int64Array,
    table: PathTable,
    offsets: Int64Array,
    geometry: PathGeometry,
    a: Complex128Array,
) -> Located:
    transfer, absorption = table.transfer, product.absorption_db_per_km
    if absorption is not None:
        transfer = transfer * amplitude_factor(absorption, geometry.tau)[..., None, None]
    return Located(row, table.pair, offsets, geometry, a, transfer, absorption)


def _canonical_names(table: PathTable) -> PathTable:
    """Names that occur, sorted; points and objects behind the last interaction set to their filler."""
    if not table.types.shape[1]:
        return replace(table, object_names=(), object_velocity=np.zeros((0, 3)))
    used = table.types != 0
    objects = np.where(used, table.objects, -1)
    occurring = np.unique(objects[used])
    order = sorted(occurring.tolist(), key=table.object_names.__getitem__)
    index = np.full(len(table.object_names) + 1, -1, np.int32)
    index[order] = np.arange(len(order))
    return PathTable(
        pair=table.pair,
        transfer=table.transfer,
        types=table.types,
        objects=index[objects],
        points=np.where(used[..., None], table.points, 0.0),
        object_names=tuple(table.object_names[i] for i in order),
        object_velocity=table.object_velocity[order],
        faces=None if table.faces is None else np.where(used, table.faces, 0).astype(np.int32),
        hidden=table.hidden,
    )


def _geometry(
    table: PathTable, transmitters: Sequence[Antenna], receivers: Sequence[Antenna]
) -> PathGeometry:
    def stacked(antennas: Sequence[Antenna], field: str) -> Float64Array:
        return np.array([getattr(antenna, field) for antenna in antennas]).reshape(-1, 3)

    tx, rx = np.divmod(table.pair, max(len(receivers), 1))
    standing = np.concatenate([table.object_velocity, np.zeros((1, 3))])
    return path_geometry(
        start=stacked(transmitters, "position")[tx],
        points=table.points,
        end=stacked(receivers, "position")[rx],
        count=(table.types != 0).sum(1),
        start_velocity=stacked(transmitters, "velocity")[tx],
        point_velocity=standing[table.objects],
        end_velocity=stacked(receivers, "velocity")[rx],
    )


def _amplitudes(
    carriers: Sequence[Carrier],
    table: PathTable,
    geometry: PathGeometry,
    transmitters: Sequence[Antenna],
    receivers: Sequence[Antenna],
) -> Complex128Array:
    """a = field_rx · transfer · field_tx · exp(−j2πfτ), Shape ``[C, P]``."""
    tx, rx = np.divmod(table.pair, max(len(receivers), 1))
    sent = _fields(transmitters, tx, geometry.departure)
    taken = _fields(receivers, rx, geometry.arrival)
    frequency = np.array([carrier.frequency_hz for carrier in carriers])
    # The whole turns of f·τ go first: they are millions, and only the rest is a phase.
    turns = frequency[:, None] * geometry.tau
    phase = np.exp(-2j * np.pi * (turns - np.round(turns)))
    a: Complex128Array = np.einsum("pi,cpij,pj->cp", taken, table.transfer, sent) * phase
    return a


def _fields(antennas: Sequence[Antenna], which: Int64Array, directions: Float64Array) -> Float64Array:
    """Field of the antenna that each path has at one end, towards the path, Shape ``[P, 3]``."""
    if len(antennas) == 1:
        return radiated_field(antennas[0].array, antennas[0].rotation, directions)
    fields = np.zeros((len(which), 3))
    for index, antenna in enumerate(antennas):
        mine = which == index
        fields[mine] = radiated_field(antenna.array, antenna.rotation, directions[mine])
    return fields


def _select(geometry: PathGeometry, which: Int64Array | BoolArray) -> PathGeometry:
    return PathGeometry(
        geometry.tau[which], geometry.departure[which], geometry.arrival[which], geometry.doppler_ratio[which]
    )


def _finite(table: PathTable, geometry: PathGeometry, a: Complex128Array) -> BoolArray:
    finite: BoolArray = (
        np.isfinite(a).all(0)
        & np.isfinite(geometry.tau)
        & np.isfinite(geometry.doppler_ratio)
        & np.isfinite(geometry.departure).all(-1)
        & np.isfinite(geometry.arrival).all(-1)
        & np.isfinite(table.points).all((1, 2))
    )
    return finite


def _order(
    table: PathTable, geometry: PathGeometry, aod: Float64Array, aoa: Float64Array, a: Complex128Array
) -> Int64Array:
    """Permutation into the order that `Channel` promises.

    Floats are compared exactly, without quantising: a path's values do not depend on the
    order in which it was found, and a grid would only move the ambiguity to its borders.
    Amplitude breaks the ties of paths that agree in all else.
    """
    depth = table.types.shape[1]
    keys: list[np.ndarray[tuple[int, ...], np.dtype[np.generic]]] = [table.pair, (table.types != 0).sum(1)]
    keys += [table.types[:, d] for d in range(depth)]
    keys += [table.objects[:, d] for d in range(depth)]
    keys += [geometry.tau, aod[:, 0], aod[:, 1], aoa[:, 0], aoa[:, 1], a[0].real, a[0].imag]
    return np.lexsort(keys[::-1]).astype(np.int64)


def _ids(table: PathTable) -> UInt64Array:
    """Stable ids of sorted paths: hash of types, object names, faces, and rank among equals in the pair."""
    ids = np.zeros(len(table.pair), np.uint64)
    if not len(ids):
        return ids
    base, kind = _kinds(table)
    # In a stable order, so the rank follows the sorted paths: distance to the start of the run of equals.
    order = np.lexsort((kind, table.pair))
    place = np.arange(len(ids))
    first = np.ones(len(ids), np.bool_)
    ranked, pair = kind[order], table.pair[order]
    first[1:] = (ranked[1:] != ranked[:-1]) | (pair[1:] != pair[:-1])
    rank = np.empty(len(ids), np.int64)
    rank[order] = place - np.maximum.accumulate(np.where(first, place, 0))
    return _mix(base[kind] + rank.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15))


def _kinds(table: PathTable) -> tuple[UInt64Array, Int64Array]:
    """Hashes of the kinds of paths that occur, and which of them each path is."""
    depth = table.types.shape[1]
    if not depth:
        return np.array([_name_hash(())], np.uint64), np.zeros(len(table.pair), np.int64)
    faces = np.zeros_like(table.objects) if table.faces is None else table.faces
    discrete = np.concatenate([table.types.astype(np.int32), table.objects, faces], axis=1)
    kinds, kind = np.unique(discrete, axis=0, return_inverse=True)
    named = (
        tuple(
            (t, table.object_names[o], f)
            for t, o, f in zip(row[:depth], row[depth : 2 * depth], row[2 * depth :], strict=True)
            if t
        )
        for row in kinds.tolist()
    )
    return np.array([_name_hash(names) for names in named], np.uint64), kind.reshape(-1)


@lru_cache(maxsize=4096)
def _name_hash(kind: tuple[tuple[int, str, int], ...]) -> int:
    text = "\0".join(f"{interaction}\0{name}\0{face}" for interaction, name, face in kind)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def _mix(x: UInt64Array) -> UInt64Array:
    """Finaliser of SplitMix64 (Steele, Lea, Flood 2014): a bijection that spreads every bit."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


def plane_waves(
    carriers: Sequence[Carrier],
    transmitters: Sequence[Antenna],
    receivers: Sequence[Antenna],
    located: Located,
) -> tuple[ChannelMatrix, ...]:
    """H[m, n] = Σ_p a[p] · receive[p, m] · transmit[p, n] of every carrier and pair."""
    steered = []
    geometry, a = located.geometry, located.a
    for pair, (begin, end) in enumerate(pairwise(located.offsets.tolist())):
        tx, rx = divmod(pair, len(receivers))
        mine = slice(begin, end)
        transmit = _steering(transmitters[tx], geometry.departure[mine])
        receive = _steering(receivers[rx], geometry.arrival[mine])
        steered.append((tx, rx, mine, receive, transmit))
    return tuple(
        ChannelMatrix(carrier=carrier, tx=tx, rx=rx, h=summed(receive * a[carrier, mine, None], transmit))
        for carrier in range(len(carriers))
        for tx, rx, mine, receive, transmit in steered
    )


def _steering(antenna: Antenna, directions: Float64Array) -> Complex128Array:
    return steering_vector(antenna.array, directions @ antenna.rotation)
