"""Smooth motion of people who are moved by SUMO's models of pedestrians.

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
from collections.abc import Iterable
from dataclasses import dataclass

from caviar_protocol.space.coordinates import Vector

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
        """Whether a person is to be seen."""
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
        """What SUMO did, since this was last asked for, that no person does."""
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
