"""The agent of ``caviar paper pizza`` that chooses beams: what each beam is worth, by Q-learning.

A beam has no influence on the next channel, so that what a choice is worth is its spectral efficiency alone:
Q-learning with a discount of 0, from the feedback of the beam that was chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from caviar_labs.paper.pizza_radio import RadioTable
from caviar_labs.paper.pizza_town import Ways, draw_places, points_along
from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_services.agent.learner import Perceptron

STEP_M = 4.0
"""That the drone flies from one frame to the next at most: 8 m/s, two frames a second."""

_WAVES = 12
"""Sines and cosines of each coordinate."""
_HALF_M = np.array([85.0, 50.0])
_FLYING = 64
"""Drones that learn at the same time."""
_HIDDEN = (128, 128)
_RATE = 2e-3, 1e-4
"""Of learning, first and last."""
_EXPLORE = 1.0, 0.05
"""Share of beams at random, first and after half of the steps."""
_BATCH, _MEMORY = 256, 50_000
_FLIGHTS = 1500
"""Between places drawn at random, the shortest way."""


@dataclass(frozen=True, eq=False)
class Experience:
    """Spectral efficiency in the training."""

    efficiency: Float64Array
    """[bit/s/Hz] that the trained choices had near each receiver of the table, Shape ``[P]``."""
    figures: list[tuple[int, float]]
    """Step, and mean spectral efficiency of the choices since the figure before [bit/s/Hz]."""


class BeamAgent:
    """Chooses a beam by the drone's position and by the feedback of the frame before.

    Args:
        beams: Size of the codebook.
        scale: Spectral efficiency [bit/s/Hz] that feedback is divided by.
        draws: Draws the first weights.

    Example:
        >>> agent = BeamAgent(4, 10.0, np.random.default_rng(0))
        >>> agent.choose(np.zeros((2, 2)), np.array([-1, 3]), np.array([0.0, 5.0])).shape
        (2,)
    """

    def __init__(self, beams: int, scale: float, draws: np.random.Generator) -> None:
        self.beams, self.scale = beams, scale
        inputs = 2 + 8 * _WAVES + beams + 1
        self.network = Perceptron((inputs, *_HIDDEN, beams), draws)

    def features(self, places: Float64Array, last_beam: Int64Array, last: Float64Array) -> Float64Array:
        """Make what the network takes.

        Args:
            places: x and y [m], Shape ``[N, 2]``.
            last_beam: Beam of the frame before, −1: none; Shape ``[N]``.
            last: Its spectral efficiency [bit/s/Hz], Shape ``[N]``.

        Returns:
            Shape ``[N, F]``.
        """
        scaled = places / _HALF_M
        x, y = scaled.T
        # Waves along both axes and both diagonals: walls run along the former, shadows along the latter.
        along = np.stack([x, y, (x + y) / 2, (x - y) / 2], axis=1)
        angles = (np.pi * np.arange(1, _WAVES + 1) * along[..., None]).reshape(len(places), -1)
        known = (last_beam >= 0)[:, None] * (np.arange(self.beams) == last_beam[:, None])
        feedback = (last / self.scale)[:, None]
        return np.hstack([scaled, np.sin(angles), np.cos(angles), known * feedback, feedback])

    def choose(self, places: Float64Array, last_beam: Int64Array, last: Float64Array) -> Int64Array:
        """Choose the beams that are worth most; arguments as of `features`, Shape ``[N]``."""
        found: Int64Array = self.network.values(self.features(places, last_beam, last)).argmax(1)
        return found


def train_beams(
    table: RadioTable,
    steps: int,
    places: int,
    draws: np.random.Generator,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[BeamAgent, Experience]:
    """Train the agent while drones fly through the neighbourhood.

    Args:
        table: What every beam achieves.
        steps: Of each drone, with an update each.
        places: Drawn at random, which drones fly between.
        draws: All random numbers of the training.
        progress: Called with the share of the steps that is done.

    Returns:
        The agent, and what it experienced.
    """
    beams = table.efficiency.shape[1]
    agent = BeamAgent(beams, float(table.efficiency.max()), draws)
    flown = _flown(draws, places)
    flights = [_flight(draws, flown) for _ in range(_FLYING)]
    memory = np.zeros((_MEMORY, agent.features(np.zeros((1, 2)), np.array([-1]), np.zeros(1)).shape[1]))
    chosen_before, worth_before = np.zeros(_MEMORY, np.int64), np.zeros(_MEMORY)
    last_beam, last = np.full(_FLYING, -1), np.zeros(_FLYING)
    total, visits = np.zeros(len(table.places)), np.zeros(len(table.places))
    figures, recent, seen = list[tuple[int, float]](), list[float](), 0
    for step in range(steps):
        now = np.array([next(flight) for flight in flights])
        features = agent.features(now, last_beam, last)
        best = agent.network.values(features).argmax(1)
        done = step / steps
        explore = max(_EXPLORE[1], _EXPLORE[0] - 2 * done * (_EXPLORE[0] - _EXPLORE[1]))
        tries = draws.random(_FLYING) < explore
        beam = np.where(tries, draws.integers(beams, size=_FLYING), best)
        at = table.nearest(now)
        worth = table.efficiency[at, beam]
        rows = (seen + np.arange(_FLYING)) % _MEMORY
        memory[rows], chosen_before[rows], worth_before[rows] = features, beam, worth / agent.scale
        seen += _FLYING
        drawn = draws.integers(min(seen, _MEMORY), size=_BATCH)
        rate = _RATE[0] * (_RATE[1] / _RATE[0]) ** done
        agent.network.learn(memory[drawn], chosen_before[drawn], worth_before[drawn], rate)
        last_beam, last = beam, worth
        if done > 0.75:
            np.add.at(total, at[~tries], worth[~tries])
            np.add.at(visits, at[~tries], 1)
        recent.append(float(worth.mean()))
        if (step + 1) % max(1, steps // 20) == 0:
            figures.append((step + 1, float(np.mean(recent))))
            recent.clear()
            progress(step / steps)
    return agent, Experience(_experienced(table, total, visits), figures)


def _experienced(table: RadioTable, total: Float64Array, visits: Float64Array) -> Float64Array:
    """Means near each receiver; of those that nobody passed those of the nearest one that somebody did."""
    from scipy.spatial import cKDTree  # type: ignore[import-untyped]

    passed = visits > 0
    if not passed.any():
        return np.zeros(len(visits))
    means = total[passed] / visits[passed]
    found: Float64Array = means[cKDTree(table.places[passed]).query(table.places)[1]]
    return found


def _flown(draws: np.random.Generator, places: int) -> list[Float64Array]:
    """Places that drones fly over, frame by frame, from one place to another."""
    found = Ways(draw_places(draws, places)).cheapest()
    pairs = draws.integers(places, size=(_FLIGHTS, 2))
    return [points_along(found.way(a, b), STEP_M) for a, b in pairs.tolist() if a != b]


def _flight(draws: np.random.Generator, flown: list[Float64Array]) -> Iterator[Float64Array]:
    """One flight after the other, without an end. Lanes vary by a metre or two."""
    while True:
        way = flown[int(draws.integers(len(flown)))]
        yield from way + draws.uniform(-1.5, 1.5, way.shape)
