"""Neighbourhood of ``caviar paper pizza``: blocks, addresses, and ways around the blocks."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.errors import ScenarioError

BLOCKS_M = np.array(
    [
        [[-62.4, -36.5], [-31.0, -8.6]],
        [[31.5, -36.5], [62.6, -8.6]],
        [[-15.1, -36.5], [16.0, -8.6]],
        [[-62.4, 9.6], [-31.3, 37.5]],
        [[32.4, 10.3], [63.5, 38.2]],
        [[-15.1, 9.6], [16.0, 37.5]],
    ]
)
"""Lowest and highest x and y of each block of ``sionna:simple_street_canyon``, Shape ``[6, 2, 2]``. All are
higher than the drone may fly."""

HEIGHT_M = 8.0
"""At which the drone flies, and delivers."""

_KEPT_M = 3.5
"""From walls: the world's clearance, and what a curve needs."""
_LOW_M, _HIGH_M = np.array([-80.0, -46.0]), np.array([80.0, 46.0])
"""Of addresses and ways."""
_LATTICE_M = 8.0
"""Between the points that a way may turn at, beside the corners of the blocks."""
_SAMPLES = 16
"""Points of a straight line at which a cost is read."""
_TURN_M = 3.0
"""Metres that a turn counts: the drone brakes for it."""
_APART_M = 25.0
"""Least distance of the places of an episode."""
_TRIES = 10_000
"""Places that are drawn before all are drawn anew."""


@dataclass(frozen=True)
class Round:
    """Addresses and start of an episode."""

    seed: int
    start: Float64Array
    """x and y [m]."""
    addresses: Float64Array
    """x and y of each [m], Shape ``[N, 2]``."""

    @property
    def places(self) -> Float64Array:
        """The start, then the addresses, Shape ``[N + 1, 2]``."""
        return np.vstack([self.start, self.addresses])


def is_free(places: Float64Array, kept_m: float = _KEPT_M) -> BoolArray:
    """Tell which places are clear of all blocks.

    Args:
        places: x and y [m], Shape ``[..., 2]``.
        kept_m: Distance from the walls.

    Returns:
        Shape ``[...]``.

    Example:
        >>> is_free(np.array([[0.0, 0.0], [0.0, 20.0]])).tolist()
        [True, False]
    """
    low, high = BLOCKS_M[:, 0] - kept_m, BLOCKS_M[:, 1] + kept_m
    within = (places[..., None, :] > low) & (places[..., None, :] < high)
    return np.asarray(~within.all(-1).any(-1))


def is_clear(starts: Float64Array, ends: Float64Array) -> BoolArray:
    """Tell which straight lines meet no block, with the distance that is kept from walls. By slabs.

    Args:
        starts, ends: x and y [m], Shape ``[..., 2]``.

    Returns:
        Shape ``[...]``.

    Example:
        >>> bool(is_clear(np.array([-70.0, 0.0]), np.array([70.0, 0.0])))
        True
        >>> bool(is_clear(np.array([0.0, 0.0]), np.array([0.0, 42.0])))
        False
    """
    # A way along the edge of what is kept is clear.
    low, high = BLOCKS_M[:, 0] - _KEPT_M + 1e-6, BLOCKS_M[:, 1] + _KEPT_M - 1e-6
    a, way = starts[..., None, :], (ends - starts)[..., None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (low - a) / way, (high - a) / way
    enters, leaves = np.minimum(one, other), np.maximum(one, other)
    # Along an axis on which nothing moves, it is within the slab all the way, or never.
    still = np.broadcast_to(way == 0, enters.shape)
    inside = (a > low) & (a < high)
    enters = np.where(still, np.where(inside, -np.inf, np.inf), enters)
    leaves = np.where(still, np.where(inside, np.inf, -np.inf), leaves)
    meets = np.maximum(enters.max(-1), 0.0) < np.minimum(leaves.min(-1), 1.0)
    return np.asarray(~meets.any(-1))


def draw_places(draws: np.random.Generator, count: int, apart_m: float = 0.0) -> Float64Array:
    """Draw free places of the neighbourhood.

    Args:
        draws: Draws them.
        count: How many.
        apart_m: Least distance between any two.

    Returns:
        x and y [m], Shape ``[count, 2]``.
    """
    found: list[Float64Array] = []
    tries = 0
    while len(found) < count:
        tries += 1
        if tries % _TRIES == 0:  # those that were drawn leave no room for another one
            found.clear()
        place = draws.uniform(_LOW_M, _HIGH_M).round(1)
        if is_free(place) and all(np.hypot(*(place - other)) >= apart_m for other in found):
            found.append(place)
    return np.array(found)


def draw_round(seed: int, draws: np.random.Generator, addresses: int) -> Round:
    """Draw start and addresses of an episode.

    Args:
        seed: Of the episode, which it is called by.
        draws: Draws them.
        addresses: How many.
    """
    places = draw_places(draws, addresses + 1, _APART_M)
    return Round(seed, places[0], places[1:])


class Ways:
    """Cheapest ways between places, around the blocks: straight lines between turns.

    A way may turn at the corners of the blocks, so that the shortest one is exact, and at the points of a
    lattice over the free air.

    Args:
        places: x and y [m], Shape ``[P, 2]``, all of them free.

    Raises:
        ScenarioError: A place is not free.

    Example:
        >>> ways = Ways(np.array([[0.0, 0.0], [0.0, 42.0]]))
        >>> found = ways.cheapest()
        >>> float(found.cost[0, 1].round(1)) > 42.0, len(found.way(0, 1)) > 2
        (True, True)
    """

    def __init__(self, places: Float64Array) -> None:
        wrong = places[~is_free(places)]
        if len(wrong):
            raise ScenarioError(f"{wrong[0].tolist()} is within {_KEPT_M:g} m of a block; choose free places")
        self.nodes: Float64Array = np.vstack([places, _corners(), _lattice()])
        """Places first."""
        self.places = len(places)
        starts, ends = self.nodes[:, None], self.nodes[None]
        self._length: Float64Array = np.linalg.norm(ends - starts, axis=-1)
        clear = is_clear(starts, ends) & (self._length > 0)
        # Longer straight lines go over points of the lattice as well; places are joined to all they see.
        near = self._length <= 3 * _LATTICE_M
        self._ends = np.array(np.nonzero(clear))
        lattice = len(places) + len(_corners())
        both = (self._ends >= lattice).all(0)
        self._ends = self._ends[:, ~both | near[tuple(self._ends)]]

    def cheapest(
        self, rate: Callable[[Float64Array], Float64Array] | None = None, worth: float = 0.0
    ) -> Found:
        """Find the cheapest ways between all places.

        Args:
            rate: Share of the best rate at places, Shape ``[N, 2]`` to ``[N]``; None: a way costs its length.
            worth: What a metre at rate 0 costs beyond one at the best rate.

        Returns:
            The ways; a metre at the best rate costs 1.
        """
        # Late: the base install has no SciPy.
        from scipy.sparse import csr_array  # type: ignore[import-untyped]
        from scipy.sparse.csgraph import dijkstra  # type: ignore[import-untyped]

        one, other = self.nodes[self._ends[0]], self.nodes[self._ends[1]]
        length = self._length[tuple(self._ends)]
        along = np.ones_like(length)
        if rate is not None and worth:
            shares = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
            points = one[:, None] + shares[:, None] * (other - one)[:, None]
            along += worth * (1 - rate(points.reshape(-1, 2)).reshape(points.shape[:2]).mean(1))
        # The last straight line ends at a place, where the drone brakes on any way.
        graph = csr_array((length * along + _TURN_M, tuple(self._ends)), shape=self._length.shape)
        cost, before = dijkstra(graph, indices=np.arange(self.places), return_predecessors=True)
        return Found(self.nodes, cost[:, : self.places] - _TURN_M, before)


@dataclass(frozen=True, eq=False)
class Found:
    """Cheapest ways from every place to every other."""

    nodes: Float64Array
    """x and y [m] of what ways go over, places first."""
    cost: Float64Array
    """Of each way, Shape ``[P, P]``."""
    before: Int64Array
    """The node before each node on the way from each place, Shape ``[P, nodes]``."""

    def way(self, start: int, end: int) -> Float64Array:
        """The points of a way, both ends included.

        Args:
            start, end: Indices of two places.

        Returns:
            x and y [m], Shape ``[N, 2]``.

        Raises:
            ScenarioError: There is no way.
        """
        found = [end]
        while found[-1] != start:
            found.append(int(self.before[start, found[-1]]))
            if found[-1] < 0:
                places = self.nodes[[start, end]].tolist()
                raise ScenarioError(f"there is no way from {places[0]} to {places[1]}; choose other places")
        return self.nodes[found[::-1]]


def points_along(way: Float64Array, step_m: float) -> Float64Array:
    """Places on a way, one every so many metres.

    Args:
        way: Its turns [m], Shape ``[N, 2]``.
        step_m: Between two places.

    Returns:
        Shape ``[M, 2]``; the start of the way is left out.

    Example:
        >>> points_along(np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]]), 4.0).tolist()
        [[4.0, 0.0], [4.0, 4.0]]
    """
    lengths = np.concatenate([[0.0], np.linalg.norm(np.diff(way, axis=0), axis=1).cumsum()])
    at = np.arange(step_m, lengths[-1] + 1e-9, step_m)
    return np.stack([np.interp(at, lengths, axis) for axis in way.T], axis=1)


def _corners() -> Float64Array:
    """The corners of what is kept clear, as far as they are in the air that is flown in."""
    low, high = BLOCKS_M[:, 0] - _KEPT_M, BLOCKS_M[:, 1] + _KEPT_M
    found = np.array(
        [[x, y] for a, b in zip(low, high, strict=True) for x in (a[0], b[0]) for y in (a[1], b[1])]
    )
    return found[is_free(found)]


def _lattice() -> Float64Array:
    axes = (np.arange(a, b + 1e-9, _LATTICE_M) for a, b in zip(_LOW_M, _HIGH_M, strict=True))
    found = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    return found[is_free(found)]
