"""World ``trajectory``: objects that follow timed waypoints, a UAV for instance."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Container, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, quantity
from caviar_protocol.errors import ScenarioError
from caviar_protocol.fields import PRINTABLE
from caviar_protocol.scenario.conversion import Place, csv_rows
from caviar_protocol.space.coordinates import Vector, quaternion_from_euler
from caviar_services.service import Preparation, Prepared, RunInfo
from caviar_services.world.base import ObjectState, World, WorldSettings, course_rate, reverses, turning
from caviar_space.meshes import SHAPES

COLUMNS = ("t_s", "x_m", "y_m", "z_m")
YAW_COLUMN = "yaw_deg"

# Horizontal speed [m/s] below which rounding would choose the course.
_SLOW = 1e-6

# [°]; a course that reverses by more at a waypoint turns the object round.
_ROUND_DEG = 90.0


Length = Annotated[float, quantity("m", "side of a bounding box", gt=0)]


class NamedObject(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Object that a scenario names, whatever moves it."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=100, pattern=PRINTABLE)]
    """Unique among the objects of the run; where agents fly the object, its actuator is ``motion:<name>``."""
    kind: str = "uav"
    """Class of the object: ``uav``, ``car``, …; one without a mesh of its own is a box."""
    dimensions_m: tuple[Length, Length, Length] = (0.6, 0.6, 0.25)
    """Length, width, height."""


class MovingObject(NamedObject, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One object and where it is when."""

    waypoints: str | tuple[tuple[float, ...], ...]
    """``file:PATH.csv``, or rows ``[t_s, x_m, y_m, z_m]`` or ``[t_s, x_m, y_m, z_m, yaw_deg]``.
    The point is the centre of the object; without a yaw it looks along its horizontal course."""


class TrajectorySettings(WorldSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the world ``trajectory``."""

    objects: tuple[MovingObject, ...] = ()
    """Objects along timed waypoints; none: a scene of what stands."""


class TrajectoryWorld(World[TrajectorySettings]):
    """Objects that follow timed waypoints; they rest before the first and after the last one.

    Args:
        settings: The objects and their waypoints.
        run: What the world knows about the run.

    Raises:
        ScenarioError: Two objects have one name, or waypoints are wrong; names the key.

    Example:
        >>> rows = ((0.0, 0.0, 0.0, 30.0), (4.0, 40.0, 0.0, 30.0))
        >>> settings = TrajectorySettings(objects=(MovingObject(name="uav", waypoints=rows),))
        >>> world = TrajectoryWorld(settings, RunInfo(name="world"))
        >>> [state.position for state in world.objects_at(2_000_000_000)]
        [(20.0, 0.0, 30.0)]
    """

    Settings: ClassVar[type[msgspec.Struct]] = TrajectorySettings
    batches = True

    def __init__(self, settings: TrajectorySettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._tracks: dict[str, tuple[MovingObject, Track]] = {}
        for index, thing in enumerate(settings.objects):
            key = f"services.{run.name}.settings.objects[{index}]"
            name = unique_name(settings, thing, self._tracks, key)
            self._tracks[name] = (thing, Track(read_waypoints(thing.waypoints, f"{key}.waypoints")))

    @classmethod
    def placements(cls, settings: TrajectorySettings) -> Iterable[tuple[str, str, Sequence[Vector]]]:
        """The waypoints of all objects."""
        for index, thing in enumerate(settings.objects):
            key = f"objects[{index}].waypoints"
            yield key, thing.name, [waypoint.position for waypoint in read_waypoints(thing.waypoints, key)]

    @classmethod
    def known_objects(cls, settings: TrajectorySettings) -> Mapping[str, str] | None:
        """Names of all objects, with the prefix."""
        return {(settings.prefix or "") + thing.name: thing.kind for thing in settings.objects}

    def prefixes(self) -> tuple[str, ...]:
        """The setting, or all names, which are known."""
        known = self.known_objects(self.settings) or {}
        return (self.settings.prefix,) if self.settings.prefix else tuple(known)

    def mesh_classes(self) -> tuple[str, ...]:
        """The classes of the objects, those that have a mesh."""
        known = self.known_objects(self.settings) or {}
        return tuple(sorted(set(known.values()) & SHAPES.keys()))

    def prepare(self, preparation: Preparation) -> Prepared:
        """As `World.prepare`, with a note for each object that a waypoint turns round at once."""
        prepared = super().prepare(preparation)
        notes = [
            f"object {name!r} turns round at once at waypoint {waypoint} (t_s = {t:g}), where its course "
            f"reverses, and has no angular velocity there; if it drives backwards, write {YAW_COLUMN}"
            for name, (_, track) in self._tracks.items()
            for waypoint, t in track.reversals()[:1]
        ]
        return replace(prepared, notes=(*prepared.notes, *notes))

    def begin(self, episode: int, seed: int) -> None:
        """Every episode is the same: nothing here is random."""

    def objects_at(self, elapsed_ns: int) -> Iterable[ObjectState]:
        """All objects, at all times."""
        t = elapsed_ns / 1e9
        # The velocity once for all three that need it.
        for name, (thing, track) in self._tracks.items():
            velocity = track.velocity(t)
            yield ObjectState(
                name=name,
                class_=thing.kind,
                position=track.position(t),
                orientation=quaternion_from_euler(track.yaw(t, velocity)),
                velocity=velocity,
                dimensions=thing.dimensions_m,
                angular_velocity=(0.0, 0.0, track.yaw_rate(t, velocity)),
            )


def unique_name(settings: WorldSettings, thing: NamedObject, taken: Container[str], key: str) -> str:
    """Name of an object in the scene: the prefix of the world, and its own.

    Args:
        settings: The settings of the world.
        thing: The object.
        taken: Names of the objects before it.
        key: Key of the object in the scenario, for the error.

    Raises:
        ScenarioError: The name is taken.
    """
    name = (settings.prefix or "") + thing.name
    if name in taken:
        raise ScenarioError(f"a second object is named {name!r}; give it another name", key=key)
    return name


class Waypoint(NamedTuple):
    """Place of an object at an instant."""

    t: float
    """[s]"""
    position: Vector
    """[m]"""
    yaw: float | None = None
    """[rad]; None: along the course."""


class Track:
    """Position, velocity and yaw over time, from waypoints.

    The velocity is the exact derivative of the position. Without a given yaw the object looks
    along its horizontal course; while it hovers, climbs or descends on the spot it turns evenly
    from the course before to the one after.

    Args:
        waypoints: In the order of time; all of them have a yaw, or none has.

    Example:
        >>> track = Track([Waypoint(0.0, (0.0, 0.0, 30.0)), Waypoint(4.0, (40.0, 0.0, 30.0))])
        >>> track.position(2.0), track.velocity(2.0), track.yaw(2.0)
        ((20.0, 0.0, 30.0), (15.0, 0.0, 0.0), 0.0)
    """

    def __init__(self, waypoints: Sequence[Waypoint]) -> None:
        times = np.array([w.t for w in waypoints])
        self._curve = MonotoneCurve(times, np.array([w.position for w in waypoints]))
        yaws = [w.yaw for w in waypoints if w.yaw is not None]
        self._given = MonotoneCurve(times, np.unwrap(yaws)[:, None]) if yaws else None
        steps = np.diff(self._curve.points, axis=0)
        self._moving: list[bool] = np.any(steps[:, :2], axis=1).tolist()
        self._hover = self._hover_yaws()

    def position(self, t: float) -> Vector:
        """[m] at instant ``t`` [s]."""
        x, y, z = self._curve.at(t)
        return (x, y, z)

    def velocity(self, t: float) -> Vector:
        """[m/s] at instant ``t`` [s]."""
        x, y, z = self._curve.at(t, 1)
        return (x, y, z)

    def yaw(self, t: float, velocity: Vector | None = None) -> float:
        """Yaw at an instant.

        Args:
            t: The instant [s].
            velocity: Velocity there [m/s]; None: it is computed.

        Returns:
            [rad], counter-clockwise from +x.
        """
        if self._given is not None:
            return self._given.at(t)[0]
        times = self._curve.times
        k = self._curve.segment(t)
        if k < 0:
            return self._hover[0][0] if t < times[0] else self._hover[-1][1]
        if self._moving[k]:
            return self._course(t, k, velocity or self.velocity(t))
        start, end = self._hover[k]
        s = (t - float(times[k])) / float(times[k + 1] - times[k])
        # 3s² − 2s³: the turn begins and ends at rest, so the yaw rate has no jump.
        return start + (end - start) * s * s * (3 - 2 * s)

    def yaw_rate(self, t: float, velocity: Vector) -> float:
        """Derivative of `yaw`, and 0 where the course reverses (`world.base.reverses`).

        Args:
            t: The instant [s].
            velocity: Velocity there [m/s].

        Returns:
            [rad/s], counter-clockwise.
        """
        if self._given is not None:
            return turning(self._given.at(t, 1)[0])
        k = self._curve.segment(t)
        if k < 0:
            return 0.0
        if self._moving[k]:
            return course_rate(velocity, self._curve.at(t, 2)) if math.hypot(*velocity[:2]) > _SLOW else 0.0
        start, end = self._hover[k]
        length = float(self._curve.times[k + 1] - self._curve.times[k])
        s = (t - float(self._curve.times[k])) / length
        return turning((end - start) * 6 * s * (1 - s) / length)

    def reversals(self) -> list[tuple[int, float]]:
        """Number and instant [s] of each waypoint at which the course turns round on the spot."""
        if self._given is not None:
            return []
        steps = np.diff(self._curve.points, axis=0)
        found = []
        for k in range(1, len(steps)):
            t = float(self._curve.times[k])
            (ax, ay), (bx, by) = steps[k - 1 : k + 1, :2].tolist()
            angle = math.degrees(abs(math.atan2(ax * by - ay * bx, ax * bx + ay * by)))
            velocity = self.velocity(t)
            rests = math.hypot(*velocity[:2]) <= _SLOW
            if angle > _ROUND_DEG and (rests or reverses(velocity, self._curve.at(t, 2))):
                found.append((k, t))
        return found

    def _course(self, t: float, k: int, velocity: Vector) -> float:
        vx, vy, _ = velocity
        if math.hypot(vx, vy) > _SLOW:
            return math.atan2(vy, vx)
        # At a point of rest the velocity has no direction: it is the limit on the nearer side.
        begin, end = self._curve.times[k], self._curve.times[k + 1]
        return self._limit(k, at_end=bool(t - begin > end - t))

    def _limit(self, k: int, at_end: bool) -> float:
        """Course with which a segment that moves begins or ends."""
        curve = self._curve
        here, there = (k + 1, k) if at_end else (k, k + 1)
        vx, vy, _ = curve.slopes[here].tolist()
        if math.hypot(vx, vy) > _SLOW:
            return math.atan2(vy, vx)
        # Beside a point of rest the velocity is along ±p″, which there is 6·step − 2·length·slope
        # with the slope at the segment's other point.
        length = curve.times[k + 1] - curve.times[k]
        ax, ay, _ = (3 * (curve.points[k + 1] - curve.points[k]) - length * curve.slopes[there]).tolist()
        return math.atan2(ay, ax)

    def _hover_yaws(self) -> list[tuple[float, float]]:
        """Yaw at the beginning and the end of each segment; one entry for a single waypoint."""
        count = max(len(self._curve.times) - 1, 1)
        moving = [k for k in range(len(self._curve.times) - 1) if self._moving[k]]
        if not moving:
            return [(0.0, 0.0)] * count
        yaws: list[tuple[float, float]] = []
        for k in range(count):
            if k in moving:
                yaws.append((self._limit(k, at_end=False), self._limit(k, at_end=True)))
                continue
            before = [m for m in moving if m < k]
            after = [m for m in moving if m > k]
            start = self._limit(before[-1] if before else after[0], at_end=bool(before))
            end = self._limit(after[0], at_end=False) if after else start
            turn = math.remainder(end - start, 2 * math.pi)
            first = (before[-1] if before else -1) + 1
            yaws.append(self._share(k, first, after[0] if after else count, start, turn))
        return yaws

    def _share(self, k: int, first: int, last: int, start: float, turn: float) -> tuple[float, float]:
        """The part of a turn that falls on hovering segment ``k`` of ``first`` to ``last`` − 1."""
        times = self._curve.times
        whole = float(times[last] - times[first])
        return (
            start + turn * float(times[k] - times[first]) / whole,
            start + turn * float(times[k + 1] - times[first]) / whole,
        )


def read_waypoints(source: str | Sequence[Sequence[float]], key: str = "") -> list[Waypoint]:
    """Read waypoints from a CSV file or from rows.

    The file has one header line, ``t_s,x_m,y_m,z_m`` or with ``yaw_deg`` last; lines that
    begin with ``#`` and empty lines are skipped.

    Args:
        source: Absolute path of the file, or rows ``[t_s, x_m, y_m, z_m]``, each with ``yaw_deg`` or none.
        key: Key of the waypoints in the scenario, for errors.

    Raises:
        ScenarioError: A value is no finite number, or instants do not increase; names file and line, or key.

    Example:
        >>> read_waypoints([[0.0, 0.0, 0.0, 30.0], [4.0, 40.0, 0.0, 30.0]])[1].position
        (40.0, 0.0, 30.0)
    """
    if isinstance(source, str):
        return _from_csv(Path(source), key)
    rows = [(f"{key}[{index}]", "", None, list(row)) for index, row in enumerate(source)]
    widths = {len(row) for *_, row in rows}
    if widths not in ({len(COLUMNS)}, {len(COLUMNS) + 1}):
        raise ScenarioError(
            f"needs rows of one length, [{', '.join(COLUMNS)}] or with {YAW_COLUMN} last", key=key
        )
    return _checked(rows)


# Key, file, line, values: what an error names.
_Row = tuple[str, str, int | None, list[float]]


def _from_csv(path: Path, key: str) -> list[Waypoint]:
    file = str(path)
    if not path.is_absolute():
        raise ScenarioError(f'{file!r} is relative to nothing; write "file:{file}"', key=key)
    form = f"{','.join(COLUMNS)} or add ,{YAW_COLUMN}"
    read = csv_rows(path, Place(key), [COLUMNS, (*COLUMNS, YAW_COLUMN)], "waypoints: ", form)
    rows: list[_Row] = []
    header = read[0].cells if read else []
    for number, line, cells in read[1:]:
        if len(cells) != len(header):
            raise ScenarioError(
                f"has {len(cells)} columns, write {len(header)}: {','.join(header)}", file, line=number
            )
        try:
            rows.append(("", file, number, [float(cell) for cell in cells]))
        except ValueError as error:
            raise ScenarioError(f"{line!r} holds something that is no number", file, line=number) from error
    if not rows:
        raise ScenarioError(f"holds no waypoint; write {','.join(COLUMNS)}, then one a line", file, key)
    return _checked(rows)


def _checked(rows: Sequence[_Row]) -> list[Waypoint]:
    waypoints: list[Waypoint] = []
    for key, file, line, values in rows:
        if not all(map(math.isfinite, values)):
            raise ScenarioError(f"{values} is not finite; write numbers", file, key, line)
        t, x, y, z, *yaw = values
        if waypoints and t <= waypoints[-1].t:
            raise ScenarioError(
                f"t_s = {t} does not come after {waypoints[-1].t}; order the waypoints by time",
                file,
                key,
                line,
            )
        waypoints.append(Waypoint(t, (x, y, z), math.radians(yaw[0]) if yaw else None))
    return waypoints


class MonotoneCurve:
    """Piecewise cubic through points, once continuously differentiable, at rest at both ends.

    Between two points each coordinate is monotone, so that a landing never dips below its last
    height: slopes are the weighted harmonic means of F. N. Fritsch and J. Butland, "A method for
    constructing local monotone piecewise cubic interpolants", SIAM J. Sci. Stat. Comput. 5 (1984),
    eq. (5). Before the first and after the last point the curve stays where it is.

    Args:
        times: Increasing instants [s], Shape ``[K]``, K ≥ 1.
        points: Values there, Shape ``[K, D]``.

    Example:
        >>> curve = MonotoneCurve(np.array([0.0, 2.0]), np.array([[0.0], [8.0]]))
        >>> curve.at(1.0), curve.at(1.0, order=1), curve.at(3.0)
        ([4.0], [6.0], [8.0])
    """

    # SciPy's PchipInterpolator has the same slopes inside, other ones at the ends, and would make SciPy a
    # dependency of every world.

    def __init__(self, times: Float64Array, points: Float64Array) -> None:
        self.times = times
        self.points = points
        self.slopes = _slopes(times, points)
        # Evaluated at one instant at a time, which is faster with numbers than with arrays of three.
        self._instants: list[float] = times.tolist()
        self._ends: tuple[list[float], list[float]] = points[0].tolist(), points[-1].tolist()
        self._segments = [self._coefficients(k) for k in range(len(times) - 1)]

    def _coefficients(self, k: int) -> tuple[float, float, list[tuple[float, float, float, float]]]:
        """Begin and length [s] of a segment, and the cubic of each coordinate over s from 0 to 1."""
        length = self.times[k + 1] - self.times[k]
        step = self.points[k + 1] - self.points[k]
        d0, d1 = self.slopes[k] * length, self.slopes[k + 1] * length
        c2, c3 = 3 * step - 2 * d0 - d1, d0 + d1 - 2 * step
        return (
            self._instants[k],
            float(length),
            list(zip(*np.array([self.points[k], d0, c2, c3]).tolist(), strict=True)),
        )

    def segment(self, t: float) -> int:
        """Index of the segment that holds an instant; −1 where the curve rests.

        Args:
            t: The instant [s].
        """
        if not self._instants[0] <= t < self._instants[-1]:
            return -1
        return bisect_right(self._instants, t) - 1

    def at(self, t: float, order: int = 0) -> list[float]:
        """Evaluate the curve or a derivative.

        The second derivative jumps at the points; there it is that of the segment that begins.

        Args:
            t: The instant [s].
            order: Of the derivative: 0 (the value), 1 or 2.

        Returns:
            D numbers.
        """
        k = self.segment(t)
        if k < 0:
            ends = self._ends[0 if t < self._instants[0] else 1]
            return list(ends) if order == 0 else [0.0] * len(ends)
        begin, length, cubics = self._segments[k]
        s = (t - begin) / length
        if order == 0:
            return [p + s * (d0 + s * (c2 + s * c3)) for p, d0, c2, c3 in cubics]
        if order == 1:
            return [(d0 + s * (2 * c2 + s * 3 * c3)) / length for _, d0, c2, c3 in cubics]
        return [(2 * c2 + s * 6 * c3) / length**2 for _, _, c2, c3 in cubics]


def _slopes(times: Float64Array, points: Float64Array) -> Float64Array:
    """Slopes at the points by Fritsch and Butland's eq. (5), 0 at both ends, Shape ``[K, D]``."""
    slopes = np.zeros_like(points)
    if len(times) < 3:
        return slopes
    length = np.diff(times)[:, None]
    secant = np.diff(points, axis=0) / length
    before, after = secant[:-1], secant[1:]
    w1, w2 = 2 * length[1:] + length[:-1], length[1:] + 2 * length[:-1]
    # 0 where the secants differ in sign: an extremum stays at its point, and the curve does not overshoot it.
    same_sign = before * after > 0
    safe_before, safe_after = np.where(same_sign, before, 1.0), np.where(same_sign, after, 1.0)
    slopes[1:-1] = np.where(same_sign, (w1 + w2) / (w1 / safe_before + w2 / safe_after), 0.0)
    return slopes
