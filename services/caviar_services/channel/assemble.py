"""From the paths a model found to the canonical `Channel` product (contract, clauses 20 and 21).

`outage_counts` says why users have no path in it. That is for the report of the run: it is no part of the
product, and costs something only where a user has no path.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import msgspec
import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from caviar_protocol.errors import PayloadError, suggestion
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT, angles
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import (
    Carrier,
    Channel,
    ChannelMatrix,
    ChannelOptions,
    ChannelResponse,
    ChannelTaps,
    Scene,
)
from caviar_protocol.topics.channel import INSIDE_PREFIX, Cause
from caviar_protocol.topics.scene import AntennaDevice, Device
from caviar_services.channel.arrays.channel_matrices import (
    Located,
    Matrices,
    PlaneWaves,
    Wideband,
    bins_of,
    carrier_phase,
    subarray_amplitudes,
    wideband_parts,
)
from caviar_services.channel.paths import (
    Antenna,
    PathGeometry,
    PathTable,
    antenna_fields,
    path_ends,
    path_geometry,
    stable_ids,
)
from caviar_services.channel.propagation.atmosphere import amplitude_factor

Part = TypeVar("Part", ChannelMatrix, ChannelResponse, ChannelTaps)


@dataclass(frozen=True, kw_only=True)
class Product:
    """Header of a product: all that it says about itself beside its paths."""

    rung: str
    options: ChannelOptions
    carriers: tuple[Carrier, ...]
    with_h: bool
    wideband: frozenset[str] = frozenset()
    """Wideband parts in demand."""
    absorption_db_per_km: Float64Array | None = None
    """By the air, on each carrier, Shape ``[C]``; None: no atmosphere."""
    rounds_h: bool = False
    """Whether H is rounded to single precision."""


def assemble(
    product: Product,
    transmitters: Sequence[Antenna],
    receivers: Sequence[Antenna],
    table: PathTable,
    los: BoolArray,
    matrices: Matrices | None = None,
) -> tuple[Channel, frozenset[int]]:
    """Make the canonical product of the paths that a model found.

    Antennas, phase and absorption are applied, paths that are not finite dropped, the others sorted.

    Args:
        product: What the product says about itself.
        transmitters: T antennas where they are in this frame.
        receivers: R antennas.
        table: The paths, in any order.
        los: Whether the line of sight is free, Shape ``[T, R]``.
        matrices: Makes H, and its wideband parts, where they are in demand; None: `PlaneWaves`.

    Returns:
        The product, and the numbers of the pairs of which paths were dropped.

    Example:
        The paths of a model, and what becomes of them, are in `docs/howto/channel-models.md`.
    """
    table = _canonical_names(table)
    row = np.arange(len(table.pair))
    with np.errstate(invalid="ignore"):  # what is not finite is dropped and counted below
        (start, end), (start_velocity, end_velocity) = (
            path_ends(table.pair, transmitters, receivers, field) for field in ("position", "velocity")
        )
        geometry = path_geometry(
            start,
            table.points,
            end,
            (table.types != 0).sum(1),
            start_velocity,
            table.point_velocity,
            end_velocity,
        )
        a = _amplitudes(product.carriers, table, geometry, transmitters, receivers)
        if product.absorption_db_per_km is not None:
            a = a * amplitude_factor(product.absorption_db_per_km, geometry.tau)
    finite = _finite(table, geometry, a)
    dropped = len(finite) - int(np.count_nonzero(finite))
    dropped_pairs: frozenset[int] = frozenset()
    if dropped:
        dropped_pairs = frozenset(table.pair[~finite].tolist())
        table, geometry, a, row = table.take(finite), geometry.take(finite), a[:, finite], row[finite]
    aod, aoa = angles(geometry.departure), angles(geometry.arrival)
    # Pairs that ascend, with one path each, as in free space, are in order.
    if np.count_nonzero(table.pair[1:] > table.pair[:-1]) < len(table.pair) - 1:
        order = _order(table, geometry, aod, aoa, a)
        table, geometry, a, row = table.take(order), geometry.take(order), a[:, order], row[order]
        aod, aoa = aod[order], aoa[order]

    pairs = len(transmitters) * len(receivers)
    # Paths are sorted by pair by now.
    offsets = np.searchsorted(table.pair, np.arange(pairs + 1)).astype(np.int64)
    h: tuple[ChannelMatrix, ...] = ()
    wideband = Wideband()
    if product.with_h or product.wideband:
        transfer, absorption = table.transfer, product.absorption_db_per_km
        if absorption is not None:
            transfer = transfer * amplitude_factor(absorption, geometry.tau)[..., None, None]
        located = Located(row, table.pair, offsets, geometry, a, transfer, absorption)
        made = (matrices or PlaneWaves)(product.carriers, transmitters, receivers, located)
        if product.with_h:
            # Rounded values stay of the protocol's type: zeros at their ends compress.
            h = tuple(
                ChannelMatrix(
                    carrier=index,
                    tx=pair // len(receivers),
                    rx=pair % len(receivers),
                    h=between.astype(np.complex64).astype(np.complex128) if product.rounds_h else between,
                )
                for index in range(len(product.carriers))
                for pair, between in enumerate(made.matrices(index))
            )
        if product.wideband:
            bins = bins_of(product.wideband, product.carriers, geometry.tau, offsets)
            responses = (response for asked in bins for response in made.responses(asked))
            wideband = wideband_parts(bins, responses, len(receivers))
    # H is made by now; the list of paths is that of the centres of the arrays.
    if table.hidden is not None and table.hidden.any():
        shown = ~table.hidden
        table, geometry, a = table.take(shown), geometry.take(shown), a[:, shown]
        aod, aoa = aod[shown], aoa[shown]
        offsets = np.searchsorted(table.pair, np.arange(pairs + 1)).astype(np.int64)
    frequency = np.array([carrier.frequency_hz for carrier in product.carriers])
    # As wide as the deepest path, so that equal paths are equal bytes whatever `max_depth` is.
    depth = int((table.types != 0).sum(1).max(initial=0))
    channel = Channel(
        rung=product.rung,
        options=product.options,
        carriers=product.carriers,
        tx=tuple(antenna.name for antenna in transmitters),
        rx=tuple(antenna.name for antenna in receivers),
        los=los,
        offsets=offsets,
        object_names=table.object_names,
        id=stable_ids(table),
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
        hf=wideband.hf,
        taps=wideband.taps,
    )
    return channel, dropped_pairs


def _canonical_names(table: PathTable) -> PathTable:
    """Names that occur, sorted; points and objects past the last interaction set to their filler."""
    if not table.types.shape[1]:
        if not table.object_names:
            return table
        return replace(table, object_names=(), object_velocity=np.zeros((0, 3)), object_turning=None)
    used = table.types != 0
    objects = np.where(used, table.objects, -1)
    occurring = np.unique(objects[used])
    # Only names that occur, sorted: a product does not depend on what else is in the scene.
    order = sorted(occurring.tolist(), key=table.object_names.__getitem__)
    # The last entry stays −1, which is where the index −1 points.
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
        object_turning=None if table.object_turning is None else table.object_turning.take(order),
        faces=None if table.faces is None else np.where(used, table.faces, 0).astype(np.int32),
        joined_faces=table.joined_faces,
        hidden=table.hidden,
    )


def _amplitudes(
    carriers: Sequence[Carrier],
    table: PathTable,
    geometry: PathGeometry,
    transmitters: Sequence[Antenna],
    receivers: Sequence[Antenna],
) -> Complex128Array:
    """a = field_rx · transfer · field_tx · exp(−j2πfτ), Shape ``[C, P]``.

    Of devices with several subarrays, between the two that most power passes between.
    """
    tx, rx = np.divmod(table.pair, max(len(receivers), 1))
    sent = antenna_fields(transmitters, tx, geometry.departure)
    taken = antenna_fields(receivers, rx, geometry.arrival, arrival=True)
    phase = carrier_phase(carriers, geometry.tau)
    a: Complex128Array = np.einsum("pi,cpij,pj->cp", taken, table.transfer, sent) * phase
    for t, transmitter in enumerate(transmitters):
        for r, receiver in enumerate(receivers):
            if len(transmitter.subarrays) * len(receiver.subarrays) > 1:
                rows = np.flatnonzero(table.pair == t * len(receivers) + r)
                every = subarray_amplitudes(
                    (transmitter, receiver),
                    (geometry.departure[rows], geometry.arrival[rows]),
                    table.transfer[:, rows],
                    phase[:, rows],
                )
                # A pair of subarrays without a finite amplitude is not chosen.
                power = np.nansum(np.abs(every) ** 2, axis=(2, 3))
                a[:, rows] = every[np.unravel_index(np.argmax(power), power.shape)]
    return a


def _finite(table: PathTable, geometry: PathGeometry, a: Complex128Array) -> BoolArray:
    # A sum of squares is finite only where each of its terms is: six quick looks are enough in most frames.
    numbers = (a, geometry.tau, geometry.doppler_ratio, geometry.departure, geometry.arrival, table.points)
    if sum([np.vdot(values, values).real for values in numbers]) < math.inf:
        return np.ones(len(geometry.tau), np.bool_)
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


def restricted(
    channel: Channel, transmitters: Sequence[AntennaDevice], receivers: Sequence[AntennaDevice]
) -> Channel:
    """The product without what its devices do not use: those that name carriers have no others.

    Args:
        channel: As a model makes it, for all pairs on all carriers, or restricted already.
        transmitters: Devices in the order of `Channel.tx`.
        receivers: Devices in the order of `Channel.rx`.

    Raises:
        PayloadError: A device names a carrier that the run does not have.
    """
    devices = (*transmitters, *receivers)
    if channel.used is not None or not any(device.carriers for device in devices):
        return channel
    names = [carrier.name for carrier in channel.carriers]
    for device in devices:
        if unknown := [name for name in device.carriers if name not in names]:
            raise PayloadError(
                f"device {device.name!r} uses the carrier {unknown[0]!r}; {suggestion(unknown[0], names)}"
            )
    used: BoolArray = np.array(
        [[[t.uses(name) and r.uses(name) for r in receivers] for t in transmitters] for name in names], bool
    ).reshape(len(names), len(transmitters), len(receivers))
    if used.all():
        return channel
    pair = np.repeat(np.arange(len(channel.offsets) - 1), np.diff(channel.offsets))
    on_path = used.reshape(len(names), -1)[:, pair]
    kept = on_path.any(0)
    # Names, depth and offsets are those of the paths that are left, as if no others had been found.
    objects, types = channel.objects[kept], channel.interactions[kept]
    occurring = np.unique(objects[objects >= 0])
    index = np.full(len(channel.object_names) + 1, -1, np.int32)
    index[occurring] = np.arange(len(occurring))
    depth = int((types != 0).sum(1).max(initial=0))

    def used_alone(parts: tuple[Part, ...]) -> tuple[Part, ...]:
        return tuple(part for part in parts if used[part.carrier, part.tx, part.rx])

    return msgspec.structs.replace(
        channel,
        used=used,
        offsets=np.searchsorted(pair[kept], np.arange(len(channel.offsets))).astype(np.int64),
        object_names=tuple(channel.object_names[i] for i in occurring.tolist()),
        id=channel.id[kept],
        a=np.where(on_path, channel.a, 0.0)[:, kept],
        tau=channel.tau[kept],
        aod=channel.aod[kept],
        aoa=channel.aoa[kept],
        doppler=channel.doppler[:, kept],
        interactions=types[:, :depth],
        points=channel.points[kept, :depth],
        objects=index[objects[:, :depth]],
        h=used_alone(channel.h),
        hf=used_alone(channel.hf),
        taps=used_alone(channel.taps),
    )


class Surroundings(Protocol):
    """Knowledge of a channel model about places, in the state of the last frame."""

    @property
    def extent(self) -> tuple[Float64Array, Float64Array] | None:
        """Lowest and highest corner [m] of the scenery, Shape ``[3]`` each; None: there is none."""

    def enclosing(self, position: Float64Array) -> str:
        """Name the object that a point is inside.

        Args:
            position: Of the point [m], Shape ``[3]``.

        Returns:
            The name; empty where there is none.
        """


def outage_counts(
    channel: Channel, scene: Scene, surroundings: Surroundings, dropped_pairs: Collection[int] = ()
) -> dict[str, int]:
    """Users without a path by `Cause`, and the antennas that stand inside an object, for a report.

    Args:
        channel: The product of a frame.
        scene: The scene that it was made of.
        surroundings: What the model knows about places.
        dropped_pairs: Pairs of which paths were dropped, for values that are not finite.
    """
    offsets = channel.offsets
    # The usual frame: every pair has a path on every carrier, and nothing is looked for. Counting takes a
    # quarter of the time that `all` takes for a few paths.
    everyone = np.count_nonzero(offsets[1:] > offsets[:-1]) == len(offsets) - 1
    if everyone and np.count_nonzero(channel.a) == channel.a.size:
        return {}
    users = _users_without_path(channel)
    ends = _Ends(channel, scene, surroundings)
    causes: Counter[Cause] = Counter()
    for p in np.flatnonzero(users).tolist():
        t, r = divmod(p, len(channel.rx))
        if channel.tx[t] != channel.rx[r]:
            cause = Cause.NOT_FINITE if p in dropped_pairs else ends.cause(t, r)
            causes[cause] += int(users[p])
    counts = {cause.count_name: number for cause, number in causes.items()}
    return counts | {f"{INSIDE_PREFIX}{name} in {around}": 1 for name, around in ends.inside.items()}


def _users_without_path(channel: Channel) -> Int64Array:
    """For each pair, the carriers on which no path has an amplitude, Shape ``[T·R]``."""
    paths = np.diff(channel.offsets)
    reached: BoolArray = np.zeros((len(channel.carriers), len(paths)), np.bool_)
    carrier, path = np.nonzero(channel.a)
    reached[carrier, np.repeat(np.arange(len(paths)), paths)[path]] = True
    if channel.used is not None:
        reached |= ~channel.used.reshape(reached.shape)
    lacking: Int64Array = np.count_nonzero(~reached, axis=0)
    return lacking


class _Ends:
    """The antennas of a frame; each place is looked at once, whatever number of pairs it is in."""

    def __init__(self, channel: Channel, scene: Scene, surroundings: Surroundings) -> None:
        self._channel, self._scene, self._surroundings = channel, scene, surroundings
        self._devices: Mapping[str, Device] = {device.name: device for device in scene.devices}
        self._positions: dict[str, Float64Array] = {}
        self._around: dict[str, str] = {}
        lowest_hz = min((carrier.frequency_hz for carrier in channel.carriers), default=np.inf)
        self._wavelength = SPEED_OF_LIGHT / lowest_hz

    @property
    def inside(self) -> dict[str, str]:
        """Antennas that stand inside an object, and its name."""
        return {name: around for name, around in sorted(self._around.items()) if around}

    def cause(self, t: int, r: int) -> Cause:
        """Cause for which a pair has no path."""
        channel = self._channel
        names = channel.tx[t], channel.rx[r]
        start, end = (self._position(name) for name in names)
        around = [self._enclosing(name) for name in names]  # of both, since both are to be named
        if any(around):
            return Cause.INSIDE
        if np.linalg.norm(end - start) < self._wavelength:
            return Cause.TOO_CLOSE
        # A free line of sight whose path is missing was lost by the model, not by the world.
        if channel.los[t, r]:
            return Cause.NOT_FOUND
        return Cause.OUT_OF_RANGE if self._is_beside(start) or self._is_beside(end) else Cause.BLOCKED

    def _position(self, name: str) -> Float64Array:
        if name not in self._positions:
            self._positions[name] = np.array(device_pose(self._scene, self._devices[name]).position)
        return self._positions[name]

    def _enclosing(self, name: str) -> str:
        if name not in self._around:
            self._around[name] = self._surroundings.enclosing(self._position(name))
        return self._around[name]

    def _is_beside(self, position: Float64Array) -> bool:
        """Test whether a place is beside the scenery or below it; above it, the sky goes on."""
        if self._surroundings.extent is None:
            return False
        low, high = self._surroundings.extent
        return bool((position < low).any() or (position[:2] > high[:2]).any())
