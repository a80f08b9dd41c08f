"""Carriages of a vehicle of SUMO: rigid bodies, both ends of each on the way by which the vehicle came.

SUMO has a train, or a lorry with its trailer, as one length along its lanes. As one rigid box the rear of a
train of 200 m leaves the track by 170 m where that turns by a right angle. Here each carriage follows the one
before it, coupled end to end.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

from caviar_protocol.space.coordinates import Vector

LENGTHS_M: Mapping[str, float] = {
    "rail": 25.0,
    "rail_electric": 25.0,
    "rail_fast": 25.0,
    "rail_urban": 18.0,
    "subway": 18.0,
    "tram": 8.0,
    "trailer": 9.0,
}
"""Length of a carriage by SUMO's vClass [m]; vehicles of other classes are one body."""


class Carriage(NamedTuple):
    """A carriage, in the coordinates of its way."""

    front: Vector
    """Middle of its front end, on the ground [m]."""
    rear: Vector
    """[m]"""
    velocity: Vector
    """Of its middle [m/s]."""
    yaw_rate: float
    """[rad/s], counter-clockwise."""


def carriage_count(length: float, carriage: float) -> int:
    """Number of carriages of equal length that are nearest to the length that is asked for.

    Args:
        length: Of the vehicle [m].
        carriage: Of a carriage [m]; 0: the vehicle is one body.

    Example:
        >>> carriage_count(200.0, 25.0), carriage_count(16.5, 9.0), carriage_count(4.5, 0.0)
        (8, 2, 1)
    """
    return max(1, round(length / carriage)) if carriage else 1


def carriages(way: Sequence[Vector], length: float, count: int, speed: float) -> list[Carriage]:
    """Place carriages of equal length on a way.

    Ends are as far apart as a carriage is long, in a straight line; so a train takes some more of a way that
    bends than its length. The end of a rigid body moves along its way as fast as keeps the distance:
    v₂ = v₁ (t₁ · u) / (t₂ · u) for the tangents t at both ends and the unit vector u along the body.

    Args:
        way: Points from the front of the first carriage backwards, at least two; beyond the last it goes
            straight on [m].
        length: Of all carriages [m].
        count: Of carriages.
        speed: Of the front along its way [m/s].

    Example:
        >>> corner = [(5.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 9.0, 0.0)]
        >>> [round(c.rear[1], 2) for c in carriages(corner, 14.0, 2, 1.0)]
        [4.9, 11.9]
    """
    each = length / count
    *_, before, last = way
    straight = _scaled(_minus(last, before), 2 * (length + each) / (math.dist(last, before) or 1.0))
    points = [*way, (last[0] + straight[0], last[1] + straight[1], last[2] + straight[2])]
    made: list[Carriage] = []
    front, at, fast = points[0], 0, speed
    for _ in range(count):
        rear, there = _point_at(points, at, front, each)
        u = _scaled(_minus(front, rear), 1 / each)
        ahead, behind = _tangent(points, at), _tangent(points, there)
        slow = fast * _dot(ahead, u) / max(_dot(behind, u), 0.1)  # over 84° nothing moves as a train does
        v, w = _scaled(ahead, fast), _scaled(behind, slow)
        middle = ((v[0] + w[0]) / 2, (v[1] + w[1]) / 2, (v[2] + w[2]) / 2)
        across = _minus(v, w)
        made.append(Carriage(front, rear, middle, (u[0] * across[1] - u[1] * across[0]) / each))
        front, at, fast = rear, there, slow
    return made


def _point_at(points: Sequence[Vector], at: int, origin: Vector, distance: float) -> tuple[Vector, int]:
    """First point of a way behind a segment's place that is so far from an origin, and its segment."""
    for k in range(at, len(points) - 1):
        a, b = points[k] if k > at else origin, points[k + 1]
        if math.dist(origin, b) < distance:
            continue
        # |a + t (b − a) − origin|² = distance², the root behind `a`.
        along, off = _minus(b, a), _minus(a, origin)
        square, half, rest = _dot(along, along), _dot(along, off), _dot(off, off) - distance**2
        t = (-half + math.sqrt(max(half * half - square * rest, 0.0))) / square
        return (a[0] + t * along[0], a[1] + t * along[1], a[2] + t * along[2]), k
    raise AssertionError("a way goes on longer than the train")


def _tangent(points: Sequence[Vector], k: int) -> Vector:
    """Unit vector forwards along a segment."""
    along = _minus(points[k], points[k + 1])
    return _scaled(along, 1 / (math.hypot(*along) or 1.0))


def _minus(a: Vector, b: Vector) -> Vector:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _scaled(a: Vector, by: float) -> Vector:
    return (a[0] * by, a[1] * by, a[2] * by)


def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


class Ways:
    """Ways by which vehicles came, from the lanes of their routes.

    Args:
        api: SUMO's, of a simulation that has begun.
    """

    def __init__(self, api: Any) -> None:
        self._api = api
        self._shapes: dict[str, list[Vector]] = {}

    def behind(self, vehicle: str, length: float) -> list[Vector]:
        """Way of a vehicle from its front bumper backwards [m], in SUMO's coordinates.

        Before the first lane of its route it is straight.

        Args:
            vehicle: On a lane.
            length: Of which the way is needed [m].
        """
        domain = self._api.vehicle
        front, lane = domain.getPosition3D(vehicle), domain.getLaneID(vehicle)
        if domain.isStoppedParking(vehicle):  # SUMO has it beside the lane, and on none
            lane = domain.getStops(vehicle, 1)[0].lane
            edge, _, number = lane.rpartition("_")
            front = self._api.simulation.convert3D(edge, domain.getLanePosition(vehicle), int(number))
        shape = self._shape(lane)
        drawn = sum(math.dist(a, b) for a, b in pairwise(shape))
        # What lies ahead of the front; a lane may be said to be longer or shorter than it is drawn.
        rest = drawn * domain.getLanePosition(vehicle) / (self._api.lane.getLength(lane) or 1.0)
        done = 0.0
        way = [front]
        passed: list[Vector] = []
        for a, b in pairwise(shape):
            if done >= rest - 1e-6:
                break
            passed.append(a)
            done += math.dist(a, b)
        way += reversed(passed)
        before = self._lanes_before(lane, domain.getRoute(vehicle), domain.getRouteIndex(vehicle))
        while sum(math.dist(a, b) for a, b in pairwise(way)) < 2 * length and (name := next(before, "")):
            way += reversed(self._shape(name))
        distinct = [way[0], *(b for a, b in pairwise(way) if math.dist(a, b) > 1e-6)]
        if len(distinct) < 2:
            angle = math.radians(90.0 - domain.getAngle(vehicle))
            distinct.append((front[0] - math.cos(angle), front[1] - math.sin(angle), front[2]))
        return distinct

    def _shape(self, lane: str) -> list[Vector]:
        """Points of a lane; libsumo gives them without heights."""
        if lane not in self._shapes:
            flat = [point[:2] for point in self._api.lane.getShape(lane)]
            passed = [0.0, *accumulate(math.dist(a, b) for a, b in pairwise(flat))]
            edge, _, number = lane.rpartition("_")
            scale = self._api.lane.getLength(lane) / (passed[-1] or 1.0)
            height = self._api.simulation.convert3D
            self._shapes[lane] = [
                (x, y, height(edge, at * scale, int(number))[2])
                for (x, y), at in zip(flat, passed, strict=True)
            ]
        return self._shapes[lane]

    def _lanes_before(self, lane: str, route: Sequence[str], index: int) -> Iterator[str]:
        """Lanes that lead to a lane, along a route backwards, with those within junctions."""
        for k in range(index if lane.startswith(":") else index - 1, -1, -1):
            found = [(own, [*inner, to]) for own, inner, to in self._links(route[k]) if lane in (*inner, to)]
            if not found:
                return
            own, passed = found[0]
            yield from reversed(passed[: passed.index(lane)])
            yield own
            lane = own

    def _links(self, edge: str) -> Iterator[tuple[str, list[str], str]]:
        """Lanes of an edge, those within the junction behind each, and the lane that they lead to."""
        for number in range(self._api.edge.getLaneNumber(edge)):
            for link in self._api.lane.getLinks(f"{edge}_{number}"):
                inner, via = [], link[4]
                while via:
                    inner.append(via)
                    further = self._api.lane.getLinks(via)
                    via = further[0][4] if further else ""
                yield f"{edge}_{number}", inner, link[0]
