"""Lengths and directions of paths between two keyframes, and how far off they may be.

The image of the receiver lies at L·d from the transmitter, L the path's length and d its direction of
departure. Where ends and surfaces move uniformly without turning, this vector changes linearly, so
that a straight line between both keyframes' vectors is exact for paths that are reflected and transmitted.
What it leaves, where something accelerates or a path bends about an edge, is a cubic Hermite polynomial
with the slopes at both keyframes (de Boor, A Practical Guide to Splines, 1978, chapter IV), or follows
from the positions where these are known.

Remainder of Hermite: |error| ≤ h⁴/384·max|r''''|. A distance f = |p + vt| has, with the closest
approach b = f·sin(angle), f'''' = 3v⁴·b²(4u² − b²)/f⁷, u² = f² − b². With x = u²/f² the factor
(1 − x)(5x − 1) lies in [−1, 1], hence |f''''| ≤ 3v⁴/f³.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

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
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import Interaction, Scene
from caviar_services.channel.paths import Antenna, path_geometry


@dataclass(frozen=True, eq=False)
class End:
    """State of the K joined paths at a keyframe; of one that it lacks, the state at the other keyframe."""

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

    Raises:
        PayloadError: The scene lacks one of them.
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
    # The last row is that of scenery, and of objects that this scene lacks.
    values = np.concatenate([getattr(scene, field), np.zeros((1, 3))])
    named = [values[index.get(name, -1)] for name in joined.object_names]
    of_objects = np.array([*named, np.zeros(3)])
    return Places(
        np.array([getattr(antenna, field) for antenna in transmitters]).reshape(-1, 3)[tx],
        np.array([getattr(antenna, field) for antenna in receivers]).reshape(-1, 3)[rx],
        of_objects[joined.objects],
    )


def corners(places: Places, points: Float64Array, joined: Joined) -> Float64Array:
    """TX, points, RX of each path; points past the last lie on RX: Shape ``[K, D + 2, 3]``."""
    inside = np.where((joined.types != 0)[..., None], points, places.end[:, None])
    return np.concatenate([places.start[:, None], inside, places.end[:, None]], axis=1)


def normals(corners: Float64Array, joined: Joined) -> Float64Array:
    """Normals of mirrors, from the turn of the path there; 0 where nothing is reflected; ``[K, D, 3]``."""
    segment = np.diff(corners, axis=1)
    length = np.linalg.norm(segment, axis=-1, keepdims=True)
    along = segment / np.where(length > 0, length, 1.0)
    # A mirror turns a ray along its normal.
    turn = np.diff(along, axis=1)
    size = np.linalg.norm(turn, axis=-1, keepdims=True)
    mirror: BoolArray = (joined.types == Interaction.REFLECTION)[..., None]
    return np.where(mirror & (size > 0), turn / np.where(size > 0, size, 1.0), 0.0)


def image_moves(moved: Places, normals: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Changes of the vectors TX → image of RX and RX → image of TX [m], Shape ``[K, 3]`` each.

    A mirror with normal n that moves by o moves the image of a point that moves by x by
    x − 2n(n·x) + 2n(n·o): exact while the mirror does not turn.
    """
    # The receiver is mirrored from its side of the path back, the transmitter from its side on.
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


ROUNDING_M = 1e-8
"""[m] What a length is off by in any case: float64 at 10 km has 2e-12 m, and a chain of mirrors some more."""
OF_THE_CORRECTION = 0.05
"""Share of the acceleration's correction that is not trusted, where only Doppler shifts tell of it."""


@dataclass(frozen=True, eq=False)
class Course:
    """Lengths and directions of K paths at an instant, and bounds on their errors."""

    length: Float64Array
    """[m], Shape ``[K]``."""
    departure: Float64Array
    """Unit vectors, Shape ``[K, 3]``; likewise ``arrival``."""
    arrival: Float64Array
    rate: Float64Array
    """Change of the length [m/s], Shape ``[K]``."""
    length_error: Float64Array
    """[m], Shape ``[K]``."""
    direction_error: Float64Array
    """[rad], Shape ``[K]``."""

    @classmethod
    def of(cls, to_end: Float64Array, to_start: Float64Array) -> Course:
        """From the vectors to the images of both ends [m], Shape ``[K, 3]`` each; no rate, no errors."""
        nothing = np.zeros(len(to_end))
        return cls(np.linalg.norm(to_end, axis=-1), _unit(to_end), _unit(to_start), nothing, nothing, nothing)


class Courses:
    """Lengths and directions of joined paths between both keyframes.

    Args:
        joined: The paths.
        seconds: From one keyframe to the other [s].
        at_ends: Positions at both keyframes; None: the motion is taken from the Doppler shifts.
    """

    def __init__(self, joined: Joined, seconds: float, at_ends: tuple[Places, Places] | None) -> None:
        self._joined, self._h, self._at_ends = joined, seconds, at_ends
        self._specular, self._kept = joined.specular, joined.kept
        lengths = [SPEED_OF_LIGHT * end.tau for end in joined.ends]
        self._shortest = np.maximum(np.minimum(*lengths), ROUNDING_M)
        self._to_end = [x[:, None] * end.departure for x, end in zip(lengths, joined.ends, strict=True)]
        self._to_start = [x[:, None] * end.arrival for x, end in zip(lengths, joined.ends, strict=True)]
        self._turn = np.maximum(
            _angle(joined.ends[0].departure, joined.ends[1].departure),
            _angle(joined.ends[0].arrival, joined.ends[1].arrival),
        )
        # Slopes of the remainder: what is left of the rates beyond the straight line between both images.
        moved = self._to_end[1] - self._to_end[0]
        chord = [(_unit(vector) * moved).sum(-1) / seconds for vector in self._to_end]
        self._slopes = [rate - along for rate, along in zip(self._rates(), chord, strict=True)]
        # The remainder of Hermite holds for the path and for the straight line that is taken from it.
        speed = np.linalg.norm(moved, axis=-1) / seconds
        bends = 3 * speed**4 / np.maximum(_closest(*self._to_end), ROUNDING_M) ** 3 + self._of_legs()
        self._remainder = np.where(self._specular, 0.0, seconds**4 / 384 * bends)
        self._mismatch = self._of_images()

    @property
    def turn(self) -> Float64Array:
        """Angle between a path's directions at both keyframes, the greater of both ends' [rad], ``[K]``."""
        return self._turn

    def at(self, s: float, now: Places | None) -> Course:
        """The course at an instant, for paths of both keyframes and of one.

        Args:
            s: Share of the interval that is over, from 0 to 1.
            now: Positions at the instant; None: they are not known.
        """
        if now is not None and self._at_ends is not None:
            course = self._known(s, now, self._at_ends)
        else:
            course = self._by_doppler(s)
        error = course.length_error + ROUNDING_M
        return replace(course, length=np.maximum(course.length, 0.0), length_error=error)

    def rates(self, course: Course, now: Places, moves: Places, points: Float64Array) -> Float64Array:
        """Change of the lengths [m/s] with the velocities ``moves``, where positions are known."""
        to_end, _ = image_moves(moves, self._normals)
        of_images = (course.departure * to_end).sum(-1)
        return np.where(self._specular, of_images, first_order(now, points, moves, self._joined))

    def _rates(self) -> list[Float64Array]:
        """Change of the lengths at both keyframes [m/s]: of uniform motion from one to the other where
        positions are known, else by the Doppler shifts (τ' = −f_D/f)."""
        joined = self._joined
        if self._at_ends is None:
            return [-SPEED_OF_LIGHT * end.doppler_ratio for end in joined.ends]
        mean = (self._at_ends[1] - self._at_ends[0]).scaled(1 / self._h)
        both = zip(self._at_ends, joined.ends, strict=True)
        return [first_order(place, end.points, mean, joined) for place, end in both]

    def _of_legs(self) -> Float64Array:
        """Bound on the fourth derivative of the way along points that stay on their surfaces [m/s⁴]."""
        if self._specular.all():
            return np.zeros(len(self._specular))
        if self._at_ends is None:  # the legs are unknown: as if each were half of the path
            speed = np.linalg.norm(self._to_end[1] - self._to_end[0], axis=-1) / self._h
            halves: Float64Array = 2 * 3 * speed**4 / (self._shortest / 2) ** 3
            return halves
        both = zip(self._at_ends, self._joined.ends, strict=True)
        legs = [np.diff(corners(place, end.points, self._joined), axis=1) for place, end in both]
        used = np.minimum(*(np.linalg.norm(leg, axis=-1) for leg in legs))
        speed = np.linalg.norm(legs[1] - legs[0], axis=-1) / self._h
        bends: Float64Array = np.where(used > 0, 3 * speed**4 / np.maximum(used, ROUNDING_M) ** 3, 0.0).sum(1)
        return bends

    def _of_images(self) -> Float64Array:
        """Distance of the later keyframe's image from where the moves put that of the earlier [m]."""
        if self._at_ends is None:
            return np.zeros(len(self._kept))
        before, after = self._at_ends
        points = self._joined.ends[0].points
        self._normals = normals(corners(before, points, self._joined), self._joined)
        for_born = normals(corners(after, points, self._joined), self._joined)
        self._normals = np.where(self._joined.before[:, None, None], self._normals, for_born)
        to_end, _ = image_moves(after - before, self._normals)
        off: Float64Array = np.linalg.norm(self._to_end[0] + to_end - self._to_end[1], axis=-1)
        off = np.where(self._specular & self._kept, off, 0.0)
        # An error of one path by way of an object may be that of another one that shows it at neither
        # keyframe.
        of_object = np.zeros(len(self._joined.object_names) + 1)
        for objects in self._joined.objects.T:
            np.maximum.at(of_object, objects, off)
        of_object[-1] = 0.0
        worst: Float64Array = np.maximum(off, of_object[self._joined.objects].max(1, initial=0.0))
        return worst

    def _known(self, s: float, now: Places, at_ends: tuple[Places, Places]) -> Course:
        """From where ends and objects are."""
        before, after = at_ends
        # Positions as they would be in uniform motion: only the deviation from it needs a correction.
        uniform = Places(
            *(
                (1 - s) * getattr(before, name) + s * getattr(after, name)
                for name in ("start", "end", "objects")
            )
        )
        # A path of one keyframe is followed from there, one of both from the straight line between them.
        origin = np.where(self._joined.before, 0.0, 1.0)
        share = np.where(self._kept, s, origin)
        base = _between(before, after, share)
        moved = now - base
        to_end, to_start = image_moves(moved, self._normals)
        straight = Course.of(_line(self._to_end, share) + to_end, _line(self._to_start, share) + to_start)
        # Mirrors that turn, and facets that count as one plane but lie beside it: a path may change from
        # one to the next at any time.
        off = self._mismatch if 0 < s < 1 else 0.0 * self._mismatch
        exact = replace(straight, length_error=off, direction_error=off / self._shortest)
        return _either(self._specular, exact, self._bent(s, now - uniform, uniform, share))

    def _bent(self, s: float, moved: Places, uniform: Places, share: Float64Array) -> Course:
        """Paths that no image straightens, from the deviation of known positions from uniform motion."""
        line = Course.of(_line(self._to_end, share), _line(self._to_start, share))
        points = (1 - s) * self._joined.ends[0].points + s * self._joined.ends[1].points
        change = first_order(uniform, points, moved, self._joined)
        correction, _ = self._hermite(s)
        most = moved.most
        length = line.length + np.where(self._kept, correction + change, 0.0)
        bump = 4 * s * (1 - s)  # 0 at both keyframes, 1 in the middle
        return replace(
            line,
            length=length,
            length_error=(bump**2 * self._remainder + most**2 / self._shortest) * self._kept,
            direction_error=bump * self._turn**2 / 4 + most / self._shortest,
        )

    def _by_doppler(self, s: float) -> Course:
        """From the Doppler shifts at both keyframes."""
        origin = np.where(self._joined.before, 0.0, 1.0)
        share = np.where(self._kept, s, origin)
        line = Course.of(_line(self._to_end, share), _line(self._to_start, share))
        correction, slope = self._hermite(s)
        moved = (self._to_end[1] - self._to_end[0]) / self._h
        rate = (line.departure * moved).sum(-1) + slope
        alone = np.where(self._joined.before, *self._rates())
        alone_length = line.length + alone * (s - origin) * self._h
        # Doppler shifts that tell of another mean speed than the lengths do, or of an acceleration that
        # changes: both make slopes that do not sum to zero.
        bump = 4 * s * (1 - s)
        disagreement = np.abs(self._slopes[0] + self._slopes[1]) / 2 * self._h * bump / 4
        error = disagreement + OF_THE_CORRECTION * np.abs(correction) + bump**2 * self._remainder
        return replace(
            line,
            length=np.where(self._kept, line.length + correction, alone_length),
            rate=np.where(self._kept, rate, alone),
            length_error=np.where(self._kept, error, 0.0),
            direction_error=np.where(
                self._kept,
                (2 * np.abs(correction) + disagreement) / self._shortest
                + np.where(self._specular, 0.0, bump * self._turn**2 / 4),
                0.0,
            ),
        )

    def _hermite(self, s: float) -> tuple[Float64Array, Float64Array]:
        """Hermite's cubic that is 0 at both ends and has their slopes [m], and its slope [m/s]."""
        first, last = self._slopes
        value = self._h * (first * s * (1 - s) ** 2 - last * s**2 * (1 - s))
        slope = first * (1 - s) * (1 - 3 * s) - last * s * (2 - 3 * s)
        return value, slope


def first_order(places: Places, points: Float64Array, moves: Places, joined: Joined) -> Float64Array:
    """Change of lengths to first order in moves [m] or, for velocities, in time [m/s]; Shape ``[K]``."""
    geometry = path_geometry(
        start=places.start,
        points=points,
        end=places.end,
        count=(joined.types != 0).sum(1),
        start_velocity=moves.start,
        point_velocity=moves.objects,
        end_velocity=moves.end,
    )
    return -SPEED_OF_LIGHT * geometry.doppler_ratio


def _between(before: Places, after: Places, share: Float64Array) -> Places:
    weight = share[:, None]
    return Places(
        (1 - weight) * before.start + weight * after.start,
        (1 - weight) * before.end + weight * after.end,
        (1 - weight[..., None]) * before.objects + weight[..., None] * after.objects,
    )


def _line(vectors: list[Float64Array], share: Float64Array) -> Float64Array:
    line: Float64Array = (1 - share)[:, None] * vectors[0] + share[:, None] * vectors[1]
    return line


def _unit(vectors: Float64Array) -> Float64Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Float64Array = vectors / np.where(length > 0, length, 1.0)
    return unit


def _angle(one: Float64Array, other: Float64Array) -> Float64Array:
    chord = np.linalg.norm(one - other, axis=-1)
    angle: Float64Array = 2 * np.arcsin(np.minimum(chord / 2, 1.0))
    return angle


def _closest(one: Float64Array, other: Float64Array) -> Float64Array:
    """Smallest length on the straight line between two vectors, Shape ``[K]``."""
    along = other - one
    square: Float64Array = (along**2).sum(-1)
    share: Float64Array = np.clip(-(one * along).sum(-1) / np.where(square > 0, square, 1.0), 0.0, 1.0)
    closest: Float64Array = np.linalg.norm(one + share[:, None] * along, axis=-1)
    return closest


def _either(which: BoolArray, one: Course, other: Course) -> Course:
    def of(field: str) -> Float64Array:
        a, b = getattr(one, field), getattr(other, field)
        chosen: Float64Array = np.where(which if a.ndim == 1 else which[:, None], a, b)
        return chosen

    return Course(
        **{
            name: of(name)
            for name in ("length", "departure", "arrival", "rate", "length_error", "direction_error")
        }
    )
