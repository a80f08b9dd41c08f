"""Flight in a scenery: free airspace, addresses in any order, boxes to keep out of, energy."""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caviar_protocol.space.coordinates import Vector
from caviar_space.obstacles import Obstacles, Surfaces
from caviar_space.scenery import scenery_triangles

MOST_ADDRESSES = 8
"""Of an episode: the shortest tour over all of them is found exactly, over all of their subsets."""


class Deliveries:
    """Addresses of one episode, and which of them are still to be flown to, in any order.

    Args:
        addresses: Points [m], 1 to `MOST_ADDRESSES`.
        reach_m: Distance at which an address is delivered to [m].

    Raises:
        ValueError: There are too many addresses, or none.

    Example:
        >>> street = Deliveries([(30.0, 0.0, 5.0), (10.0, 0.0, 5.0)], reach_m=2.0)
        >>> street.tour_m((0.0, 0.0, 5.0))  # the near one first
        30.0
        >>> street.deliver((9.0, 0.0, 5.0))
        1
        >>> street.delivered, street.is_done
        ((False, True), False)
    """

    def __init__(self, addresses: Sequence[Vector], reach_m: float) -> None:
        if not 1 <= len(addresses) <= MOST_ADDRESSES:
            raise ValueError(f"{len(addresses)} addresses; write 1 to {MOST_ADDRESSES}")
        self.addresses = tuple(addresses)
        self._reach = reach_m
        # Bit i of a set stands for address i.
        self._left = (1 << len(addresses)) - 1
        self._onward = _shortest_tours(self.addresses)

    @property
    def delivered(self) -> tuple[bool, ...]:
        """Mask of the addresses that are delivered to."""
        return tuple(not self._left >> i & 1 for i in range(len(self.addresses)))

    @property
    def is_done(self) -> bool:
        """True once every address is delivered to."""
        return self._left == 0

    def tour_m(self, position: Vector) -> float:
        """Length of the shortest tour from a place over all addresses that are left [m]; 0 without any.

        The straight way, whatever stands in it. It changes by no more than what is flown.

        Args:
            position: Where the object is [m].
        """
        first, _ = self._next(position)
        return first

    def next_address(self, position: Vector) -> Vector | None:
        """Give the first address of the shortest tour from a place [m]; None: all are delivered to."""
        _, index = self._next(position)
        return None if index is None else self.addresses[index]

    def _next(self, position: Vector) -> tuple[float, int | None]:
        tours = [
            (math.dist(position, self.addresses[i]) + self._onward[self._left & ~(1 << i)][i], i)
            for i in range(len(self.addresses))
            if self._left >> i & 1
        ]
        return min(tours, default=(0.0, None))

    def deliver(self, position: Vector) -> int:
        """Deliver to every address that is in reach of a place.

        Args:
            position: Where the object is [m].

        Returns:
            How many addresses that are.
        """
        reached = [
            i
            for i, address in enumerate(self.addresses)
            if self._left >> i & 1 and math.dist(position, address) <= self._reach
        ]
        for i in reached:
            self._left &= ~(1 << i)
        return len(reached)


def _shortest_tours(addresses: Sequence[Vector]) -> list[list[float]]:
    """Length of the shortest way from each address over a set of others, by set and address [m].

    By dynamic programming over the sets (Held and Karp 1962); sets are whole numbers, with a bit an address.
    """
    count = len(addresses)
    apart = [[math.dist(a, b) for b in addresses] for a in addresses]
    tours = [[0.0] * count for _ in range(1 << count)]
    for left, i in itertools.product(range(1, 1 << count), range(count)):
        onward = [apart[i][j] + tours[left & ~(1 << j)][j] for j in range(count) if left >> j & 1]
        tours[left][i] = min(onward)
    return tours


@dataclass(frozen=True)
class Box:
    """A box along the world's axes."""

    low: Vector
    """Lowest corner [m]."""
    high: Vector
    """Highest corner [m]."""

    def meets(self, start: Vector, end: Vector) -> bool:
        """Tell whether the straight way between two points meets the box. By slabs (Kay and Kajiya 1986).

        Example:
            >>> box = Box((10.0, -5.0, 0.0), (20.0, 5.0, 30.0))
            >>> box.meets((0.0, 0.0, 10.0), (40.0, 0.0, 10.0)), box.meets((0.0, 0.0, 40.0), (40.0, 0.0, 40.0))
            (True, False)
        """
        enters, leaves = 0.0, 1.0
        for low, high, a, b in zip(self.low, self.high, start, end, strict=True):
            if a == b:
                if not low <= a <= high:
                    return False
                continue
            near, far = sorted(((low - a) / (b - a), (high - a) / (b - a)))
            enters, leaves = max(enters, near), min(leaves, far)
        return enters <= leaves


# Zeng, Xu and Zhang, "Energy Minimization for Wireless Communication With Rotary-Wing UAV", IEEE Trans.
# Wireless Commun. 18(4), 2019, table I: a rotor of 0.4 m, weight 20 N.
_WEIGHT_N = 20.0
_BLADE_PROFILE_W = 79.86
_INDUCED_W = 88.63
_TIP_SPEED = 120.0
_INDUCED_SPEED = 4.03
_DRAG = 0.6 * 1.225 * 0.05 * 0.503
"""Fuselage drag ratio × density of air [kg/m³] × rotor solidity × area of the rotor's disc [m²]."""


def rotary_wing_power(velocity: Vector) -> float:
    """Propulsion power of a rotary-wing UAV of 20 N in steady flight [W].

    Level flight: Zeng, Xu and Zhang 2019, eq. 12, of blade profile, induced and parasite power. A climb adds
    weight times rate of climb; a descent gives nothing back.

    Args:
        velocity: [m/s], z upwards.

    Example:
        >>> round(rotary_wing_power((0.0, 0.0, 0.0)), 2)  # hovering: blade profile and induced power
        168.49
        >>> round(rotary_wing_power((10.0, 0.0, 0.0)), 1)  # flying forward costs less
        126.0
    """
    x, y, z = velocity
    speed = math.hypot(x, y)
    ratio = speed**2 / (2 * _INDUCED_SPEED**2)
    # √(1 + r²) − r, as the paper has it, loses all digits at high speed: it is one over √(1 + r²) + r.
    induced = _INDUCED_W / math.sqrt(math.sqrt(1 + ratio**2) + ratio)
    profile = _BLADE_PROFILE_W * (1 + 3 * speed**2 / _TIP_SPEED**2)
    return profile + induced + 0.5 * _DRAG * speed**3 + _WEIGHT_N * max(0.0, z)


def greatest_power(max_speed_m_s: float) -> float:
    """Greatest power within a speed, in any direction [W].

    Args:
        max_speed_m_s: [m/s].

    Example:
        >>> greatest_power(12.0) > rotary_wing_power((12.0, 0.0, 0.0))
        True
    """
    climbs = np.linspace(0.0, math.pi / 2, 181).tolist()
    speeds = np.linspace(0.0, max_speed_m_s, 61).tolist()
    return max(
        rotary_wing_power((v * math.cos(climb), 0.0, v * math.sin(climb)))
        for v, climb in itertools.product(speeds, climbs)
    )


TRIES = 10_000
"""Points that are drawn at most, until one is free."""


class Airspace:
    """The points of a box that are free for an object: clear of scenery, and outside of buildings.

    Args:
        low, high: Corners [m] of the box that it keeps within.
        clearance: Least distance [m] of its centre from scenery.
        scenery: Files of the run's scenery, by asset name.
        is_allowed: Tells of a point [m] whether the object may be there.
    """

    def __init__(
        self,
        low: Vector,
        high: Vector,
        clearance: float,
        scenery: Mapping[str, Path],
        is_allowed: Callable[[Vector], bool] = lambda point: True,
    ) -> None:
        self.low, self.high = low, high
        self._is_allowed = is_allowed
        self._clearance = clearance
        triangles = scenery_triangles(scenery)
        # What ends below the box is no obstacle: an object may fly low over the ground.
        self._obstacles = Obstacles(triangles[triangles[..., 2].max(axis=1) > low[2]])
        self._surfaces = Surfaces(triangles, lambda triangle, normal: True)

    def within(self, low: Vector, high: Vector) -> Airspace:
        """Take another box [m] in the same scenery, which is not loaded again."""
        other = copy.copy(self)
        other.low, other.high = low, high
        return other

    def is_free(self, point: Vector) -> bool:
        """Tell whether the object can be at a point [m]."""
        if not all(a <= x <= b for a, x, b in zip(self.low, point, self.high, strict=True)):
            return False
        if not self._is_allowed(point):
            return False
        if self._obstacles.distance(point, self._clearance) < self._clearance:
            return False
        return not self._surfaces.encloses(np.array(point))

    def draw(
        self,
        random: np.random.Generator,
        near: Vector | None = None,
        distance: tuple[float, float] = (0.0, np.inf),
    ) -> Vector | None:
        """Draw a free point.

        Args:
            random: Generator of the draw.
            near: Point from which the distance is measured [m]; None: any distance is right.
            distance: Least and greatest distance [m].

        Returns:
            A point [m], uniform among those that fit; None where `TRIES` draws found none.
        """
        # By rejection, which needs no volume of what is free: a city leaves most of its air.
        for _ in range(TRIES):
            x, y, z = random.uniform(self.low, self.high).tolist()
            far = 0.0 if near is None else float(np.linalg.norm(np.subtract((x, y, z), near)))
            if distance[0] <= far <= distance[1] and self.is_free((x, y, z)):
                return x, y, z
        return None
