"""Places, headings and classes of SUMO as those of a scene.

SUMO gives the centre of the front bumper on the ground, a heading in degrees clockwise from north, and a
slope in degrees, positive uphill; a scene has the centre of the bounding box and angles counter-clockwise
from +x. Steps of SUMO fit the sampling period of a run and the spacing of its episodes.

`People` smooths the motion of people who are moved by SUMO's models of pedestrians.
These models are made for flows of people, not for bodies that reflect and block waves. ``striping`` moves a
person at junctions by up to some 3.5 m in a step of 0.1 s, ``nonInteracting`` by more; ``jupedsim`` turns
people about from one step to the next; and the speed that SUMO states is not that with which the position
changes. Here a body walks after the place where SUMO has the person: with at most `FASTEST`, turned along the
way that it has gone, by at most `TURN_RATE`. Its velocity is its displacement over the step. What SUMO did
that no person does is counted.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from caviar_protocol.errors import ScenarioError
from caviar_protocol.space.coordinates import Pose, Vector, quaternion_from_euler

_NS_PER_MS = 1_000_000
# SUMO's car-following models are made for steps up to one second.
_LONGEST_STEP_MS = 1000


def step_length_ms(sampling_period_ns: int, step_ms: int | None) -> int:
    """Choose SUMO's step for a sampling period. SUMO steps whole milliseconds.

    Args:
        sampling_period_ns: Sampling period of the run [ns].
        step_ms: The step that is asked for [ms]; None: the sampling period.

    Returns:
        [ms]

    Raises:
        ScenarioError: The sampling period is no whole number of steps; says what to write.

    Example:
        >>> step_length_ms(100_000_000, None), step_length_ms(100_000_000, 20)
        (100, 20)
    """
    period_ms, rest = divmod(sampling_period_ns, _NS_PER_MS)
    if rest:
        near = " or ".join(str(ms * _NS_PER_MS) for ms in (period_ms, period_ms + 1) if ms)
        raise ScenarioError(
            f"SUMO steps whole milliseconds, and {sampling_period_ns} ns is none; write {near}",
            key="run.sampling_period_ns",
        )
    step = period_ms if step_ms is None else step_ms
    if (step_ms is None and period_ms > _LONGEST_STEP_MS) or not 1 <= step <= period_ms or period_ms % step:
        fitting = max(
            n for n in range(1, min(period_ms, max(step, 1), _LONGEST_STEP_MS) + 1) if period_ms % n == 0
        )
        raise ScenarioError(
            f"a step of {step} ms does not fit the sampling period of {period_ms} ms; "
            f"write step_ms = {fitting}",
            key="settings.step_ms",
        )
    return step


def check_spacing(between_episodes_s: float, step_ms: int) -> None:
    """Check that episodes can begin so far apart in one traffic.

    Args:
        between_episodes_s: From the beginning of an episode to that of the next [s].
        step_ms: SUMO's step [ms].

    Raises:
        ScenarioError: It is not a whole number of steps, or none at all.

    Example:
        >>> check_spacing(30.0, 100)
    """
    ms = between_episodes_s * 1000.0
    if not 0 < ms < math.inf or abs(ms / step_ms - round(ms / step_ms)) > 1e-6:
        raise ScenarioError(
            f"{between_episodes_s} s is not a whole number of SUMO's steps of {step_ms} ms, at least one",
            key="settings.between_episodes_s",
        )


class Placement(NamedTuple):
    """Placement of the road network in the scene: turned about its origin, then shifted.

    Example:
        >>> Placement((100.0, 0.0, 0.0)).yaw
        0.0
    """

    offset: Vector = (0.0, 0.0, 0.0)
    """[m]"""
    yaw: float = 0.0
    """[rad], counter-clockwise."""


class Heading(NamedTuple):
    """Direction in which a body on the road points [rad].

    Example:
        >>> Heading(0.0, 0.0).forward
        (1.0, 0.0, 0.0)
    """

    yaw: float
    slope: float

    @property
    def forward(self) -> Vector:
        """Unit vector out of the nose."""
        horizontal = math.cos(self.slope)
        return (math.cos(self.yaw) * horizontal, math.sin(self.yaw) * horizontal, math.sin(self.slope))

    @property
    def up(self) -> Vector:
        """Unit vector out of the roof."""
        horizontal = -math.sin(self.slope)
        return (math.cos(self.yaw) * horizontal, math.sin(self.yaw) * horizontal, math.cos(self.slope))


def heading(angle_deg: float, slope_deg: float, placement: Placement) -> Heading:
    """Convert a direction of SUMO: yaw = 90° − angle, turned with the network.

    Args:
        angle_deg: SUMO's angle, clockwise from north [°].
        slope_deg: SUMO's slope, positive uphill [°].
        placement: How the network lies in the scene.

    Example:
        >>> heading(90.0, 0.0, Placement())  # eastwards is +x
        Heading(yaw=0.0, slope=0.0)
    """
    return Heading(math.radians(90.0 - angle_deg) + placement.yaw, math.radians(slope_deg))


def in_scene(point: Vector, placement: Placement) -> Vector:
    """Convert a place of SUMO to one of the scene [m].

    Args:
        point: In SUMO's coordinates [m].
        placement: How the network lies in the scene.

    Example:
        >>> in_scene((1.0, 2.0, 0.0), Placement((10.0, 0.0, 0.0)))
        (11.0, 2.0, 0.0)
    """
    c, s = math.cos(placement.yaw), math.sin(placement.yaw)
    x, y, z = point
    dx, dy, dz = placement.offset
    return (c * x - s * y + dx, s * x + c * y + dy, z + dz)


def body_pose(bumper: Vector, towards: Heading, length: float, height: float, placement: Placement) -> Pose:
    """Pose of the bounding box of a body, which SUMO places by its front bumper.

    Args:
        bumper: Centre of the front bumper on the ground, in SUMO's coordinates [m].
        towards: Where the body points in the scene.
        length: Of the body [m].
        height: Of the body [m].
        placement: How the network lies in the scene.

    Example:
        >>> body_pose((10.0, 0.0, 0.0), Heading(0.0, 0.0), 4.0, 1.5, Placement()).position
        (8.0, 0.0, 0.75)
    """
    front = in_scene(bumper, placement)
    fx, fy, fz = towards.forward
    ux, uy, uz = towards.up
    back, rise = length / 2, height / 2
    position = (
        front[0] - back * fx + rise * ux,
        front[1] - back * fy + rise * uy,
        front[2] - back * fz + rise * uz,
    )
    # Positive pitch lowers the nose, a positive slope lifts it.
    return Pose(position, quaternion_from_euler(towards.yaw, -towards.slope))


_CLASS_OF: dict[str, str] = {
    "aircraft": "uav",
    "bicycle": "bicycle",
    "bus": "bus",
    "cable_car": "train",
    "coach": "bus",
    "container": "container",
    "delivery": "truck",
    "drone": "uav",
    "moped": "motorcycle",
    "motorcycle": "motorcycle",
    "pedestrian": "pedestrian",
    "rail": "train",
    "rail_electric": "train",
    "rail_fast": "train",
    "rail_urban": "train",
    "scooter": "bicycle",
    "ship": "ship",
    "subway": "train",
    "trailer": "truck",
    "tram": "train",
    "truck": "truck",
    "wheelchair": "pedestrian",
}


def object_class(type_id: str, vehicle_class: str, chosen: dict[str, str]) -> str:
    """Find the class of an object: as chosen for its vehicle type or its vClass, else by its vClass.

    A vClass that is not in the table drives on roads and is a ``car``.

    Args:
        type_id: SUMO's vehicle type.
        vehicle_class: SUMO's vClass.
        chosen: Class by vehicle type or vClass, which goes before the table.

    Example:
        >>> object_class("Lorry@17", "passenger", {"Lorry": "truck"}), object_class("t", "coach", {})
        ('truck', 'bus')
    """
    base_type = type_id.partition("@")[0]  # SUMO appends @VEHICLE to a type changed for one vehicle
    for key in (base_type, vehicle_class):
        if key in chosen:
            return chosen[key]
    return _CLASS_OF.get(vehicle_class, "car")


def distance_to_line(point: complex, line: Sequence[complex]) -> float:
    """Distance of a place from a line of straight pieces, both as x + jy [m].

    Args:
        point: The place.
        line: Ends of the pieces, at least two.

    Example:
        >>> distance_to_line(5 + 2j, [0j, 10 + 0j, 10 + 10j])
        2.0
    """
    distances = []
    for start, end in pairwise(line):
        along = end - start
        share = ((point - start) * along.conjugate()).real / abs(along) ** 2 if along else 0.0
        distances.append(abs(point - start - min(max(share, 0.0), 1.0) * along))
    return min(distances)


FASTEST = 3.0
"""[m/s]; of a person, where SUMO does not state a greater speed itself."""

TURN_RATE = 2 * math.pi
"""[rad/s]; of a body, at most."""

# The way after which a body turns along it [m]: people who stand sway by less, in the model `jupedsim`.
_COURSE_AFTER_M = 0.2

# A person so far from its body [m] was put elsewhere by SUMO. The jumps of `striping` are shorter.
_ELSEWHERE_M = 8.0

# Of SUMO's own angle in a step [rad].
_ABOUT = math.pi / 2

# A body stays this share below a bound, so that the rounding of positions does not lift it above.
_WITHIN = 1 - 1e-6

JUMPS = "person-jumps"
"""Count of a report: steps in which SUMO moved a person faster than people walk; the body walked after it."""
TURNS = "person-turns"
"""Count of a report: steps in which SUMO turned a person by more than 90°; the body turned gradually."""
PLACED = "persons-put-elsewhere"
"""Count of a report: bodies that are shown elsewhere at once, as SUMO moved the person too far to walk."""


@dataclass(slots=True)
class Body:
    """The body of a person, in SUMO's coordinates.

    Example:
        >>> Body((0.0, 0.0, 0.0), 0.0, (1.4, 0.0, 0.0)).yaw_rate
        0.0
    """

    position: Vector
    """Of its middle, on the ground [m]."""
    yaw: float
    """[rad], counter-clockwise from +x."""
    velocity: Vector
    """[m/s]"""
    yaw_rate: float = 0.0
    """[rad/s]"""


@dataclass(slots=True)
class _Walk:
    body: Body
    place: Vector
    angle: float
    course: float
    """Where the body turns to."""
    anchor: Vector
    """Where the body was when its course was last looked at."""


class People:
    """The bodies of all people who are to be seen.

    Args:
        step_s: SUMO's step [s].

    Example:
        >>> people = People(0.1)
        >>> people.step("p", (0.0, 0.0, 0.0), 0.0, 1.4)
        >>> people.step("p", (3.5, 0.0, 0.0), 0.0, 1.4)  # SUMO jumps
        >>> round(people.body("p").position[0], 3), people.taken_counts()
        (0.3, {'person-jumps': 1})
    """

    def __init__(self, step_s: float) -> None:
        self._step_s = step_s
        self._walks: dict[str, _Walk] = {}
        self._counts: Counter[str] = Counter()

    def __contains__(self, name: str) -> bool:
        """Return whether a person is to be seen."""
        return name in self._walks

    def clear(self) -> None:
        """Forget everybody: an episode begins."""
        self._walks.clear()
        self._counts.clear()

    def keep(self, names: Iterable[str]) -> None:
        """Forget all people but these: the others have arrived, or ride in vehicles.

        Args:
            names: Of the people who are to be seen.
        """
        kept = set(names)
        for name in [name for name in self._walks if name not in kept]:
            del self._walks[name]

    def taken_counts(self) -> dict[str, int]:
        """Counts, since they were last asked for, of what SUMO did that no person does."""
        counts = dict(self._counts)
        self._counts.clear()
        return counts

    def body(self, name: str) -> Body:
        """The body of a person after its last step.

        Args:
            name: Of the person.
        """
        return self._walks[name].body

    def step(self, name: str, place: Vector, angle: float, speed: float) -> None:
        """Let a body walk for one step after its person; a new one is put where the person is.

        Args:
            name: Of the person.
            place: Where SUMO has it [m].
            angle: Where SUMO turns it to [rad], counter-clockwise from +x.
            speed: That SUMO states [m/s].
        """
        walk = self._walks.get(name)
        if walk is None:
            self._walks[name] = _placed(place, angle, speed)
            return
        fastest = max(FASTEST, speed)
        self._counts[JUMPS] += math.dist(place, walk.place) > fastest * self._step_s
        self._counts[TURNS] += abs(math.remainder(angle - walk.angle, 2 * math.pi)) > _ABOUT
        if math.dist(place, walk.body.position) > _ELSEWHERE_M:
            self._counts[PLACED] += 1
            self._walks[name] = _placed(place, angle, speed)
        else:
            walk.place, walk.angle = place, angle
            self._walk(walk, fastest)
        # Counters keep zeros, which reports need not have.
        self._counts = +self._counts

    def _walk(self, walk: _Walk, fastest: float) -> None:
        body, step_s = walk.body, self._step_s
        way = tuple(b - a for a, b in zip(body.position, walk.place, strict=True))
        length, most = math.hypot(*way), fastest * step_s * _WITHIN
        share = min(1.0, most / length) if length else 0.0
        x, y, z = (a + share * d for a, d in zip(body.position, way, strict=True))
        dx, dy = x - walk.anchor[0], y - walk.anchor[1]
        if math.hypot(dx, dy) >= _COURSE_AFTER_M:
            walk.course, walk.anchor = math.atan2(dy, dx), (x, y, z)
        turn = math.remainder(walk.course - body.yaw, 2 * math.pi)
        turn = max(-TURN_RATE * step_s, min(TURN_RATE * step_s, turn))
        vx, vy, vz = (share * d / step_s for d in way)
        walk.body = Body((x, y, z), body.yaw + turn, (vx, vy, vz), turn / step_s)


def _placed(place: Vector, angle: float, speed: float) -> _Walk:
    velocity = (speed * math.cos(angle), speed * math.sin(angle), 0.0)
    return _Walk(Body(place, angle, velocity), place, angle, angle, place)
