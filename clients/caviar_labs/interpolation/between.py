"""A channel between two keyframes, and the bound on its error.

The bound holds as long as paths of both keyframes are there all the time, and none that neither has comes and
goes. Lengths and directions of reflected and transmitted paths are then exact where scenes are given and
surfaces do not turn, or where all moves uniformly. What else it takes, amplitudes, acceleration that Doppler
shifts alone tell of, surfaces that turn, edges, is estimated from what both keyframes disagree on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from caviar_labs.interpolation.course import (
    Course,
    Courses,
    End,
    Joined,
    Places,
    ends_of,
    places,
    velocities,
)
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
from caviar_protocol.space.antenna_arrays import element_positions, steering_vector
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT, angles, unit_vectors
from caviar_protocol.topics import AntennaDevice, Channel, ChannelMatrix, Scene
from caviar_protocol.topics.channel import PLANE_WAVES
from caviar_services.channel.arrays.channel_matrices import carrier_phase
from caviar_services.channel.paths import Antenna

CURVATURE = 4.0
"""|G''|/|G| over direction [1/rad²] that antennas, Fresnel's coefficients and polarisation are expected to
stay below: 1 for a dipole, 2.1 for the element of 3GPP TR 38.901, and each at both ends."""
ALLOWANCE = 1.1
"""How much stronger than at its keyframe a path may be that the other lacks."""
OF_COEFFICIENTS = 1e-6
"""Relative error of coefficients in float32."""


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A channel that was traced, its time and its scene.

    Raises:
        PayloadError: The scene lacks a device of the channel.
    """

    t_s: float
    """Time [s]."""
    channel: Channel
    scene: Scene | None = None
    """Absent: motion is known from Doppler shifts alone."""

    def __post_init__(self) -> None:
        if self.scene is None:
            return
        known = {device.name for device in self.scene.devices}
        missing = [name for name in (*self.channel.tx, *self.channel.rx) if name not in known]
        if missing:
            raise PayloadError(f"the scene of the keyframe at {self.t_s} s lacks the device {missing[0]!r}")


@dataclass(frozen=True, eq=False)
class Between:
    """A channel at an instant between keyframes. C carriers, T transmitters, R receivers."""

    channel: Channel
    bound_db: Float64Array
    """Bound on ‖H − Ĥ‖²/‖H‖² [dB], without matrices on that of the sum of the amplitudes; ∞ where nothing is
    promised, as where more may be missing than is there; −∞ where no path is. Shape ``[C, T, R]``."""
    changed: BoolArray
    """Pairs of which paths are born or die, Shape ``[T, R]``."""


class Interpolation:
    """Channels between two keyframes.

    Paths of both keyframes, by TX, RX and id, exist all the time between them. The amplitude without carrier
    phase and 1/τ is interpolated as a complex number: in magnitude and phase it would have to guess turns,
    and could not pass through zero as it does at Brewster's angle. The phase comes from the delay, see
    `course`. A path of one keyframe fades towards the other: where the instant of the change is unknown, that
    has 2/3 of the mean squared error of switching in the middle, and no jump. Devices that one keyframe lacks
    are left out.

    Args:
        before: The earlier keyframe.
        after: The later one, of the same rung and carriers.

    Raises:
        PayloadError: The keyframes are in the wrong order, or of different rungs or carriers.

    Example:
        >>> from caviar_labs.stability.lab import Thing, antenna, free_space, measure, scene
        >>> devices = [antenna("bs", "tx", (0, 0, 9)), antenna("rx", "rx", (0, 0, 1), parent="car")]
        >>> def street(t_s):  # a car at 10 m/s
        ...     return scene(devices, [Thing("car", (50 + 10 * t_s, 5, 1), velocity=(10, 0, 0))])
        >>> model = free_space(28e9)
        >>> ends = [Keyframe(t, measure(model, street(t)), street(t)) for t in (0.0, 0.1)]
        >>> made = Interpolation(*ends).at(0.04, street(0.04))
        >>> exact = measure(model, street(0.04)).tau
        >>> bool(abs(made.channel.tau - exact).max() < 1e-15), bool((made.bound_db < -40).all())
        (True, True)
    """

    def __init__(self, before: Keyframe, after: Keyframe) -> None:
        if not before.t_s < after.t_s:
            raise PayloadError(
                f"the keyframe at {after.t_s} s is not later than that at {before.t_s} s; pass them in order"
            )
        self._keyframes = before, after
        self._joined = join(before.channel, after.channel)
        self._h = after.t_s - before.t_s
        at_ends = None
        if before.scene is not None and after.scene is not None:
            at_ends = places(before.scene, self._joined), places(after.scene, self._joined)
        self._known = at_ends is not None
        self._by_places = Courses(self._joined, self._h, at_ends)
        self._frequency = np.array([carrier.frequency_hz for carrier in before.channel.carriers])

    def at(self, t_s: float, scene: Scene | None = None, with_h: bool = False) -> Between:
        """The channel at a time between both keyframes.

        Points of paths are on the straight line between those at both keyframes.

        Args:
            t_s: Time [s].
            scene: Of that time, where it is known: with those of the keyframes it gives the motion of ends
                and objects, whatever their acceleration. Matrices need the antennas in it.
            with_h: Whether matrices are made.

        Raises:
            PayloadError: The time is outside of the interval; matrices are asked for without a scene, or of a
                rung whose matrices do not follow from its paths; or an antenna has several subarrays.
        """
        before, after = self._keyframes
        if not before.t_s <= t_s <= after.t_s:
            raise PayloadError(f"{t_s} s is not between the keyframes at {before.t_s} s and {after.t_s} s")
        if with_h and (scene is None or before.channel.rung not in PLANE_WAVES):
            raise PayloadError(
                f"matrices between keyframes need the scene of the instant and a rung of plane waves "
                f"({', '.join(PLANE_WAVES)}), not {before.channel.rung!r}; take with_h=False"
            )
        if scene is not None:
            _refuse_subarrays(scene)
        # Where all three scenes are known, positions give lengths exactly; else Doppler shifts give the
        # motion.
        s = (t_s - before.t_s) / self._h
        now = None if scene is None or not self._known else places(scene, self._joined)
        course = (self._by_doppler if now is None else self._by_places).at(s, now)
        ends = None if scene is None else ends_of(scene, self._joined)
        a = self._amplitudes(s, course)
        h = self._matrices(a, course, ends) if with_h and ends is not None else ()
        error = self._error(s, a, course, ends if with_h else None, known=now is not None)
        return Between(
            channel=self._channel(s, a, course, h, self._doppler(s, course, now, scene)),
            bound_db=self._bound_db(error, a, h),
            changed=self._per_pair(~self._joined.kept[None]).reshape(self._shape) > 0,
        )

    @cached_property
    def _by_doppler(self) -> Courses:
        return Courses(self._joined, self._h, None)

    @property
    def _shape(self) -> tuple[int, int]:
        return len(self._joined.tx), len(self._joined.rx)

    def _amplitudes(self, s: float, course: Course) -> Complex128Array:
        """Shape ``[C, K]``."""
        first, last = (end.gain for end in self._joined.ends)
        gain = (1 - s) * self._joined.before * first + s * self._joined.after * last
        tau = course.length / SPEED_OF_LIGHT
        phase = carrier_phase(self._keyframes[0].channel.carriers, tau)
        a: Complex128Array = gain * phase / np.where(tau > 0, tau, np.inf)
        return a

    def _error(
        self,
        s: float,
        a: Complex128Array,
        course: Course,
        ends: tuple[list[Antenna], list[Antenna]] | None,
        known: bool,
    ) -> Float64Array:
        """Error of each path's amplitude, as a root mean square over the elements, Shape ``[C, K]``."""
        joined = self._joined
        first, last = (np.abs(end.gain) for end in joined.ends)
        most = np.maximum(first, last)
        tau = np.maximum(course.length / SPEED_OF_LIGHT, np.finfo(np.float64).tiny)
        change = np.abs(joined.ends[0].gain - joined.ends[1].gain)
        of_gain = 2 * s * (1 - s) * (change + CURVATURE / 2 * self._by_places.turn**2 * most)
        wave_number = 2 * np.pi * self._frequency[:, None] / SPEED_OF_LIGHT
        turned = wave_number * course.length_error + self._steering_error(course, ends)
        kept = (of_gain + OF_COEFFICIENTS * most) / tau + np.abs(a) * np.minimum(turned, 2.0)
        # Whether a path of one keyframe is there yet, or still, is unknown: all of it may be missing, or what
        # is left of it too much; and where its phase is not known either, both.
        followed = joined.specular & known
        alone = ALLOWANCE * most / tau + np.where(followed, 0.0, np.abs(a))
        return np.where(joined.kept, kept, alone if 0 < s < 1 else 0.0)

    def _steering_error(
        self, course: Course, ends: tuple[list[Antenna], list[Antenna]] | None
    ) -> Float64Array:
        """Root mean square over the elements of the phases' errors [rad], Shape ``[1, K]``."""
        if ends is None:
            return np.zeros((1, len(course.length)))
        tx, rx = np.divmod(self._joined.pair, max(len(ends[1]), 1))
        spans = [np.array([_span(antenna) for antenna in of]) for of in ends]
        error: Float64Array = 2 * np.pi * (spans[0][tx] + spans[1][rx]) * course.direction_error
        return error[None]

    def _matrices(
        self, a: Complex128Array, course: Course, ends: tuple[list[Antenna], list[Antenna]]
    ) -> tuple[ChannelMatrix, ...]:
        found = []
        for carrier in range(len(self._frequency)):
            for tx, sender in enumerate(ends[0]):
                for rx, receiver in enumerate(ends[1]):
                    mine = self._joined.pair == tx * len(ends[1]) + rx
                    transmit = steering_vector(sender.array, course.departure[mine] @ sender.rotation)
                    receive = steering_vector(receiver.array, course.arrival[mine] @ receiver.rotation)
                    h = (receive * a[carrier, mine, None]).T @ transmit
                    found.append(ChannelMatrix(carrier=carrier, tx=tx, rx=rx, h=h))
        return tuple(found)

    def _doppler(self, s: float, course: Course, now: Places | None, scene: Scene | None) -> Float64Array:
        """Doppler shift over carrier frequency, Shape ``[K]``."""
        if now is None or scene is None:
            return -course.rate / SPEED_OF_LIGHT
        moves = velocities(scene, self._joined)
        return -self._by_places.rates(course, now, moves, self._points(s)) / SPEED_OF_LIGHT

    def _points(self, s: float) -> Float64Array:
        return (1 - s) * self._joined.ends[0].points + s * self._joined.ends[1].points

    def _per_pair(self, values: Float64Array | BoolArray) -> Float64Array:
        """Sums over the paths of each pair, Shape ``[C, K]`` to ``[C, T·R]``."""
        pairs = self._shape[0] * self._shape[1]
        return np.array([np.bincount(self._joined.pair, row, pairs) for row in values])

    def _bound_db(
        self, error: Float64Array, a: Complex128Array, h: tuple[ChannelMatrix, ...]
    ) -> Float64Array:
        """By ‖H‖ ≥ ‖Ĥ‖ − ‖H − Ĥ‖."""
        most = self._per_pair(error)
        # Without matrices, the sum of the amplitudes stands for H of single elements.
        there = np.abs(self._per_pair(a.real) + 1j * self._per_pair(a.imag))
        if h:
            sizes = [np.linalg.norm(m.h) / np.sqrt(m.h.size) for m in h]
            there = np.array(sizes).reshape(most.shape)
        # More missing than there is: no bound; nothing missing of nothing: exact.
        with np.errstate(divide="ignore", invalid="ignore"):
            bound = 20 * np.log10(most / (there - most))
        bound = np.where(most < there, bound, np.inf)
        bound = np.where((most == 0) & (there == 0), -np.inf, bound)
        return bound.reshape(len(self._frequency), *self._shape)

    def _channel(
        self,
        s: float,
        a: Complex128Array,
        course: Course,
        h: tuple[ChannelMatrix, ...],
        doppler_ratio: Float64Array,
    ) -> Channel:
        joined, like = self._joined, self._keyframes[0].channel
        tau = course.length / SPEED_OF_LIGHT
        aod, aoa = angles(course.departure), angles(course.arrival)
        order = _order(joined, tau, aod, aoa)
        pairs = self._shape[0] * self._shape[1]
        return Channel(
            rung=like.rung,
            options=like.options,
            carriers=like.carriers,
            tx=joined.tx,
            rx=joined.rx,
            # A line of sight is there or not: that of the nearer keyframe.
            los=joined.los[0 if s < 0.5 else 1],
            offsets=np.searchsorted(joined.pair[order], np.arange(pairs + 1)).astype(np.int64),
            object_names=joined.object_names,
            id=joined.id[order],
            a=a[:, order],
            tau=tau[order],
            aod=aod[order],
            aoa=aoa[order],
            doppler=self._frequency[:, None] * doppler_ratio[order],
            interactions=joined.types[order],
            points=self._points(s)[order],
            objects=joined.objects[order],
            h=h,
        )


def _refuse_subarrays(scene: Scene) -> None:
    """Raise `PayloadError` for an antenna with several subarrays: amplitudes of a product are those between
    two of them, which may be others at the next keyframe."""
    for device in scene.devices:
        if isinstance(device, AntennaDevice) and not device.array.is_uniform:
            raise PayloadError(
                f"device {device.name!r} has dual polarization or several panels, whose channels cannot be "
                "interpolated; trace the instant"
            )


def _order(joined: Joined, tau: Float64Array, aod: Float64Array, aoa: Float64Array) -> Int64Array:
    """The order that `Channel` promises."""
    keys = [joined.pair, (joined.types != 0).sum(1), *joined.types.T, *joined.objects.T]
    keys += [tau, *aod.T, *aoa.T]
    return np.lexsort(keys[::-1]).astype(np.int64)


def _span(antenna: Antenna) -> float:
    """Root mean square distance of the elements from their centre [wavelengths]."""
    return float(np.sqrt((element_positions(antenna.array) ** 2).sum(1).mean()))


def join(before: Channel, after: Channel) -> Joined:
    """Paths of two products side by side, by TX, RX and id.

    Raises:
        PayloadError: The products have different carriers or rungs.
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
        # Ids name interactions and objects, so that a path is the same one at both keyframes.
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
        # The last entry is that of −1, no object.
        index = np.array([*(names.index(name) for name in channel.object_names), -1], np.int32)
        return cls(
            channel,
            channel.id,
            np.pad(channel.interactions, ((0, 0), (0, more))),
            np.pad(index[channel.objects], ((0, 0), (0, more)), constant_values=-1),
            np.pad(channel.points, ((0, 0), (0, more), (0, 0))),
        )


def _end(tables: Sequence[_Table], rows: Int64Array) -> End:
    """Ends of the paths at one keyframe: ``rows`` are those of both tables, one after the other."""
    channels = [table.channel for table in tables]
    frequency = np.array([carrier.frequency_hz for carrier in channels[0].carriers])[:, None]
    # Of a path that this keyframe lacks, ``rows`` point to the other keyframe.
    tau = np.concatenate([channel.tau for channel in channels])[rows]
    a = np.concatenate([channel.a for channel in channels], axis=1)[:, rows]
    doppler = np.concatenate([channel.doppler for channel in channels], axis=1)[:, rows]
    return End(
        tau=tau,
        departure=unit_vectors(np.concatenate([channel.aod for channel in channels])[rows]),
        arrival=unit_vectors(np.concatenate([channel.aoa for channel in channels])[rows]),
        doppler_ratio=(doppler / frequency).mean(0),
        gain=a * tau / carrier_phase(channels[0].carriers, tau),
        points=np.concatenate([table.points for table in tables])[rows],
    )
