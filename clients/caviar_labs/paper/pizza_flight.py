"""The agent of ``caviar paper pizza`` that flies: which address is next, and by which way, by Q-learning.

Its choices are the addresses that are left, each by one of several ways: the shortest one, and others that
make detours for the rate which the agent that chooses beams had there in its training. A reward is what the
way to the next address costs: its time, and the rate that is missed on it. Q-learning weighs what the choice
costs later: where it leaves the drone, and with which addresses.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from caviar_labs.paper.pizza_beams import STEP_M
from caviar_labs.paper.pizza_town import Found, Ways, draw_places, points_along
from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.agent.learner import Perceptron

WORTHS = (0.0, 2.0, 8.0)
"""What a metre at rate 0 costs beyond one at the best rate, of each kind of way; 0: the shortest."""

MISSED = 3.0
"""What a frame at rate 0 costs, beside the 1 that every frame costs."""

_EPISODES = 64
"""That are played at the same time."""
_HIDDEN = (64, 64)
_RATE = 3e-3, 1e-4
"""Of learning, first and last."""
_EXPLORE = 1.0, 0.1
"""Share of choices at random, first and after half of the steps."""
_SCALE = 40.0
"""Frames that costs are divided by."""

Rate = Callable[[Float64Array], Float64Array]
"""Share of the best rate at places, Shape ``[N, 2]`` to ``[N]``."""


@dataclass(frozen=True, eq=False)
class Legs:
    """The ways from every place to every other, of each kind."""

    found: tuple[Found, ...]
    """By kind of way."""
    frames: Float64Array
    """That a way takes at full speed, Shape ``[P, P, kinds]``."""
    missed: Float64Array
    """The same, each frame times the share of the best rate that it lacks; Shape as above."""

    @property
    def costs(self) -> Float64Array:
        """Costs of flying a way, Shape ``[P, P, kinds]``."""
        return self.frames + MISSED * self.missed


def legs_between(places: Float64Array, rate: Rate) -> Legs:
    """Find the ways between places.

    Args:
        places: x and y [m], Shape ``[P, 2]``.
        rate: What is known of the rate.
    """
    ways = Ways(places)
    found = tuple(ways.cheapest(rate, worth) for worth in WORTHS)
    count = len(places)
    frames, missed = (np.zeros((count, count, len(WORTHS))) for _ in range(2))
    for kind, one in enumerate(found):
        for start in range(count):
            flown = [points_along(one.way(start, end), STEP_M) for end in range(count)]
            lengths = [len(points) for points in flown]
            frames[start, :, kind] = lengths
            lacks = 1 - rate(np.concatenate(flown))
            sums = np.concatenate([[0.0], lacks.cumsum()])
            ends = np.cumsum(lengths)
            missed[start, :, kind] = sums[ends] - sums[ends - lengths]
    return Legs(found, frames, missed)


class Pilot:
    """Chooses the next address and the way to it.

    Args:
        addresses: Of an episode.
        draws: Draws the first weights.

    Example:
        >>> pilot = Pilot(2, np.random.default_rng(0))
        >>> costs = np.ones((3, 3, len(WORTHS)))
        >>> address, kind = pilot.choose(costs, costs, 0, np.array([True, False]))
        >>> address
        1
    """

    def __init__(self, addresses: int, draws: np.random.Generator) -> None:
        self.addresses = addresses
        kinds = len(WORTHS)
        # Of the ways to the address, and of those from there to the others, in ascending order of costs.
        features = 2 * kinds + addresses + 2 * (addresses - 1) + 1
        self.network = Perceptron((features, *_HIDDEN, kinds), draws)

    def features(
        self, frames: Float64Array, costs: Float64Array, at: Int64Array, left: BoolArray
    ) -> Float64Array:
        """Make what the network takes, of each address.

        Args:
            frames, costs: Of the ways between the episode's places, start first,
                Shape ``[E, N + 1, N + 1, kinds]``.
            at: Place where the drone is, 0: the start; Shape ``[E]``.
            left: Addresses that are left, Shape ``[E, N]``.

        Returns:
            Shape ``[E, N, F]``.
        """
        episodes, count = left.shape
        rows = np.arange(episodes)
        to_frames, to_costs = frames[rows, at, 1:] / _SCALE, costs[rows, at, 1:] / _SCALE
        least = costs[:, 1:, 1:].min(-1) / _SCALE
        # From the address to others that are left, and from those to their nearest one.
        others = left[:, None, :] & ~np.eye(count, dtype=np.bool_)
        onward = np.where(others, least, np.inf)
        between = np.where(others[..., None, :] & others[..., :, None], least[:, None], np.inf)
        between = np.where(np.eye(count, dtype=np.bool_), np.inf, between).min(-1)
        parts = [np.sort(part, axis=-1)[..., :-1] for part in (onward, between)]
        parts = [np.where(np.isfinite(part), part, 0.0) for part in parts]
        number = np.broadcast_to(left.sum(1)[:, None, None], (episodes, count, 1))
        which = (number == np.arange(1, count + 1)).astype(np.float64)
        total = parts[1].sum(-1, keepdims=True)
        return np.concatenate([to_frames, to_costs, which, *parts, total], axis=-1)

    def values(
        self, frames: Float64Array, costs: Float64Array, at: Int64Array, left: BoolArray
    ) -> Float64Array:
        """Estimate what each choice is worth; −∞ where it is none.

        Args:
            frames, costs, at, left: As of `features`.

        Returns:
            Shape ``[E, N, kinds]``.
        """
        features = self.features(frames, costs, at, left)
        found = self.network.values(features.reshape(-1, features.shape[-1]))
        return np.where(left[..., None], found.reshape(*left.shape, -1), -np.inf)

    def choose(self, frames: Float64Array, costs: Float64Array, at: int, left: BoolArray) -> tuple[int, int]:
        """Choose in one episode.

        Args:
            frames, costs: Shape ``[N + 1, N + 1, kinds]``.
            at: Place where the drone is.
            left: Shape ``[N]``.

        Returns:
            Place of the next address, from 1 on, and the kind of way.
        """
        worth = self.values(frames[None], costs[None], np.array([at]), left[None])[0]
        address, kind = np.unravel_index(int(worth.argmax()), worth.shape)
        return int(address) + 1, int(kind)


def train_pilot(
    rate: Rate,
    addresses: int,
    steps: int,
    places: int,
    draws: np.random.Generator,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[Pilot, list[tuple[int, float]]]:
    """Train the pilot on episodes with places drawn at random.

    Args:
        rate: What is known of the rate.
        addresses: Of an episode.
        steps: Choices in each of the episodes that are played at the same time, with an update each.
        places: Drawn at random, which the training's episodes are drawn from.
        draws: All random numbers of the training.
        progress: Called with the share of the steps that is done.

    Returns:
        The pilot; and step and mean cost of an episode [frames] since the figure before.
    """
    pilot = Pilot(addresses, draws)
    legs = legs_between(draw_places(draws, places), rate)
    all_frames, all_costs = legs.frames, legs.costs
    rows = np.arange(_EPISODES)
    figures, recent = list[tuple[int, float]](), list[float]()
    for first in range(0, steps, addresses):
        drawn = np.argsort(draws.random((_EPISODES, places)), axis=1)[:, : addresses + 1]
        frames, costs = (of[drawn[:, :, None], drawn[:, None, :]] for of in (all_frames, all_costs))
        at, left = np.zeros(_EPISODES, np.int64), np.ones((_EPISODES, addresses), np.bool_)
        done = first / steps
        explore = max(_EXPLORE[1], _EXPLORE[0] - 2 * done * (_EXPLORE[0] - _EXPLORE[1]))
        rate_of_learning = _RATE[0] * (_RATE[1] / _RATE[0]) ** done
        total = np.zeros(_EPISODES)
        for number in range(addresses):
            features = pilot.features(frames, costs, at, left)
            worth = pilot.values(frames, costs, at, left).reshape(_EPISODES, -1)
            chance = np.where(np.isfinite(worth), draws.random(worth.shape), -np.inf)
            tries = draws.random(_EPISODES) < explore
            address, kind = np.divmod(np.where(tries, chance.argmax(1), worth.argmax(1)), len(WORTHS))
            cost = costs[rows, at, address + 1, kind]
            total += cost
            at, left = address + 1, left & (np.arange(addresses) != address[:, None])
            target = -cost / _SCALE
            if number + 1 < addresses:
                target = target + pilot.values(frames, costs, at, left).max((1, 2))
            pilot.network.learn(features[rows, address], kind, target, rate_of_learning)
        recent.append(float(total.mean()))
        if (first // addresses + 1) % max(1, steps // addresses // 20) == 0:
            figures.append((first + addresses, float(np.mean(recent))))
            recent.clear()
            progress(done)
    return pilot, figures
