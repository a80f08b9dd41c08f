"""The paper's second experiment: a drone delivers pizzas, one agent flies it, one chooses beams.

Section 2.2 of the paper. A trained pair of agents plays against flight around the blocks in nearest-address
order with the beam along the straight line: the same held-out episodes, in the closed loop. Each agent also
plays beside the other's baseline, so that it shows what comes of which.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from caviar_labs.paper.pizza_beams import BeamAgent, Experience, train_beams
from caviar_labs.paper.pizza_flight import Legs, Pilot, legs_between, train_pilot
from caviar_labs.paper.pizza_play import (
    ChoosesBeams,
    Flies,
    Flight,
    Loop,
    nearest_first,
    straight,
)
from caviar_labs.paper.pizza_radio import RadioTable, radio_table
from caviar_labs.paper.pizza_town import Round, draw_round
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.seeding import derive_seed, generator
from caviar_protocol.space.scene import Pair
from caviar_protocol.topics import Scene

SCENARIO = "pizza"

BASELINE, TRAINED = "nearest, los-beam", "both trained"
PAIRS = (BASELINE, "nearest, trained beams", "trained flight, los-beam", TRAINED)
"""Pairs of agents: who flies, who chooses beams."""


@dataclass(frozen=True)
class Settings:
    """Trainings and episodes of the experiment."""

    episodes: int = 20
    """That are held out."""
    addresses: int = 4
    """Of an episode."""
    cell_m: float = 2.5
    """Between the receivers of the radio table that the agents are trained in [m]."""
    beam_steps: int = 12_000
    """Of training of the agent that chooses beams, of 64 drones each."""
    pilot_steps: int = 8_000
    """Of training of the agent that flies, of 64 episodes each."""
    places: int = 240
    """Drawn at random, which training flies between."""
    seed: int = 1
    quick: bool = False
    """Whether it is a trial that trains too little to say anything."""

    def trial(self) -> Settings:
        """The same as a trial: a minute, and figures that say nothing."""
        return replace(
            self, episodes=2, addresses=2, cell_m=5.0, beam_steps=150, pilot_steps=200, places=30, quick=True
        )


@dataclass(frozen=True, eq=False)
class Trained:
    """A trained pair."""

    table: RadioTable
    beams: BeamAgent
    experience: Experience
    pilot: Pilot
    pilot_figures: list[tuple[int, float]]

    def rate(self, places: Float64Array) -> Float64Array:
        """Share of the best rate that the beams agent had near places in its training."""
        known = self.experience.efficiency
        share: Float64Array = known[self.table.nearest(places)] / max(float(known.max()), 1e-9)
        return share

    def flies(self, legs: Legs, at: int, left: BoolArray) -> tuple[int, int]:
        """Choose the next address and the way to it."""
        return self.pilot.choose(legs.frames, legs.costs, at, left)

    def chooses(self, place: Float64Array, scene: Scene, pair: Pair, last_beam: int, last: float) -> int:
        """Choose a beam."""
        return int(self.beams.choose(place[None], np.array([last_beam]), np.array([last]))[0])


@dataclass(frozen=True, eq=False)
class Report:
    """Trained agents, and the episodes that they and others played."""

    settings: Settings
    trained: Trained
    rounds: list[Round]
    flights: Mapping[str, list[Flight]]
    """By pair of agents; a flight for each round."""
    bandwidth_hz: float
    frame_s: float
    training_s: float
    """Wall time of the training, the radio table included."""
    playing_s: float
    """Wall time of the episodes."""

    def rates(self, pair: str) -> Float64Array:
        """Mean rate of each episode [Mbit/s]."""
        means = [float(flight.efficiency.mean()) for flight in self.flights[pair]]
        return np.array(means) * self.bandwidth_hz / 1e6

    def seconds(self, pair: str) -> Float64Array:
        """Time of each episode [s]."""
        return np.array([flight.seconds for flight in self.flights[pair]])


def experiment(
    settings: Settings, progress: Callable[[str, float], None] = lambda what, share: None
) -> Report:
    """Train the pair, and play all pairs in the held-out episodes.

    Args:
        settings: What is trained and played.
        progress: Called with what is done and the share of all that is done.

    Raises:
        SetupError: A library is missing.
        RunError: The co-simulation ended.
    """
    began = time.monotonic()
    trained = train(settings, lambda what, share: progress(what, 0.35 * share))
    training_s = time.monotonic() - began
    # Training draws places of its own: what is held out is drawn by other streams.
    rounds = [
        draw_round(
            derive_seed(settings.seed, index, "pizza/episode"),
            generator(settings.seed, index, "pizza/round"),
            settings.addresses,
        )
        for index in range(settings.episodes)
    ]
    players: dict[str, tuple[Flies, ChoosesBeams]] = {
        PAIRS[0]: (nearest_first, straight),
        PAIRS[1]: (nearest_first, trained.chooses),
        PAIRS[2]: (trained.flies, straight),
        PAIRS[3]: (trained.flies, trained.chooses),
    }
    flights: dict[str, list[Flight]] = {pair: [] for pair in PAIRS}
    with Loop(SCENARIO) as loop:
        for index, asked in enumerate(rounds):
            legs = legs_between(asked.places, trained.rate)
            for number, (pair, (flies, chooses)) in enumerate(players.items()):
                share = (index + number / len(players)) / len(rounds)
                progress(f"episode {index + 1} of {len(rounds)}: {pair}", 0.35 + 0.65 * share)
                flights[pair].append(loop.fly(asked, legs, flies, chooses))
        bandwidth_hz, frame_s = loop.bandwidth_hz, loop.frame_s
    playing_s = time.monotonic() - began - training_s
    return Report(settings, trained, rounds, flights, bandwidth_hz, frame_s, training_s, playing_s)


def train(settings: Settings, progress: Callable[[str, float], None] = lambda what, share: None) -> Trained:
    """Train the pair: first the beams, then the pilot, who goes by the rates that the beams agent had.

    Args:
        settings: How.
        progress: As of `experiment`.
    """
    progress("rays to a grid of receivers", 0.0)
    table = radio_table(SCENARIO, settings.cell_m)
    draws = {name: generator(settings.seed, 0, f"pizza/{name}") for name in ("beams", "pilot")}
    beams, experience = train_beams(
        table,
        settings.beam_steps,
        settings.places,
        draws["beams"],
        lambda share: progress("training the agent that chooses beams", 0.1 + 0.65 * share),
    )
    nobody = Pilot(settings.addresses, draws["pilot"])
    so_far = Trained(table, beams, experience, nobody, [])
    pilot, figures = train_pilot(
        so_far.rate,
        settings.addresses,
        settings.pilot_steps,
        settings.places,
        draws["pilot"],
        lambda share: progress("training the agent that flies", 0.75 + 0.25 * share),
    )
    return replace(so_far, pilot=pilot, pilot_figures=figures)
