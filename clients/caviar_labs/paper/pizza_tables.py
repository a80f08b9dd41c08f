"""The tables of ``caviar paper pizza``, and what differs from the paper."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_clients.learning.evaluate import student_95
from caviar_labs.paper.comparison import NOTHING, Comparison, with_interval
from caviar_labs.paper.pizza import BASELINE, PAIRS, TRAINED, Report
from caviar_labs.paper.pizza_flight import WORTHS
from caviar_protocol.arrays import Float64Array

MOST_TIME, LEAST_RATE = 1.10, 1.2
"""Targets of the trained pair, as ratios to the baseline."""

_TRIAL = (
    "A TRIAL (--quick): two episodes of two addresses and a training of seconds. Its figures say nothing "
    "about the agents; leave --quick out."
)
_PLAYED = (
    "{count} held-out episodes of {addresses} addresses each, the same for all pairs, played in the closed "
    "loop: the world moves the drone, rays are traced to where it is, the link has the beam that was chosen. "
    "Ratios are geometric means over the episodes, with the 95 % interval of Student's t on the logarithms "
    "of the paired ratios; ± are 95 % intervals of means over episodes."
)
_BASELINE = (
    "The baseline flies to the nearest address by the shortest way around the blocks (exact, over their "
    "corners) and uses the beam along the straight line. All pairs fly with the same controller: at most "
    "8 m/s, slower in turns and at addresses."
)
_TRAINING = (
    "The pair is trained by Q-learning in a table of what every beam achieves at {places:,} receivers, "
    "{cell:g} m apart, that the run's own channel and link give: beams from position and the feedback of the "
    "frame before, {beams:,} steps of 64 drones; the pilot's next address and one of {kinds} ways to it, "
    "{pilot:,} steps of 64 episodes. Starts and addresses of the held-out episodes are drawn anew from the "
    "same neighbourhood: the pair knows the place, not the round. The table has no drone in it, whose body "
    "the closed loop has."
)
_PAPER = (
    "The paper describes this experiment and shows a scene of it, but has no figures of it: there is nothing "
    "to compare with. Its drone flew in AirSim within the Unreal Engine, here in the world `flight` with "
    "bounds on speed and acceleration; its neighbourhood is not published, here it is the street canyon of "
    "Sionna RT, six blocks, with one base station on a roof. The drone stays at 8 m, below all roofs: above "
    "them no block would be in its way. It does not stop at an address: it passes within 3 m, at 2 m/s."
)


@dataclass(frozen=True)
class Ratio:
    """A ratio over paired episodes, and its 95 % interval."""

    mean: float
    low: float
    high: float
    episodes: int
    """That it is of: those in which neither is 0."""

    def __str__(self) -> str:
        if math.isnan(self.mean):
            return NOTHING
        if math.isnan(self.low):
            return f"{self.mean:.3f}"
        return f"{self.mean:.3f} [{self.low:.3f}, {self.high:.3f}]"


def ratio_of(ours: Float64Array, theirs: Float64Array) -> Ratio:
    """Geometric mean of the ratios of paired figures, with Student's 95 % interval of their logarithms.

    Args:
        ours, theirs: A figure of each episode, Shape ``[E]`` each.

    Example:
        >>> str(ratio_of(np.array([2.0, 8.0]), np.array([1.0, 4.0])))
        '2.000 [2.000, 2.000]'
    """
    kept = (ours > 0) & (theirs > 0)
    logs = np.log(ours[kept] / theirs[kept])
    count = len(logs)
    if not count:
        return Ratio(math.nan, math.nan, math.nan, 0)
    mean = float(logs.mean())
    if count == 1:
        return Ratio(math.exp(mean), math.nan, math.nan, 1)
    half = student_95(count - 1) * float(logs.std(ddof=1)) / math.sqrt(count)
    return Ratio(math.exp(mean), math.exp(mean - half), math.exp(mean + half), count)


def comparisons(report: Report) -> list[Comparison]:
    """Make the tables of a report.

    Args:
        report: What was played.
    """
    found = [_pairs(report), _targets(report), _episodes(report)]
    return [*found, Comparison("What differs", (), (), _differences(report))]


def _pairs(report: Report) -> Comparison:
    rows = []
    for pair in PAIRS:
        flights = report.flights[pair]
        delivered = sum(flight.delivered for flight in flights)
        rows.append(
            (
                pair,
                with_interval(report.seconds(pair).tolist(), 1),
                with_interval(report.rates(pair).tolist(), 0),
                with_interval([100 * float(flight.los.mean()) for flight in flights], 0),
                with_interval(
                    [_mean_rate(report, pair, index, los=False) for index in range(len(flights))], 0
                ),
                f"{delivered} of {len(flights) * report.settings.addresses}",
            )
        )
    columns = (
        "flight, beams", "time [s]", "mean rate [Mbit/s]", "in sight [%]", "rate out of sight [Mbit/s]",
        "delivered",
    )  # fmt: skip
    title = "Pairs of agents" + (" (trial)" if report.settings.quick else "")
    return Comparison(title, columns, rows)


def _mean_rate(report: Report, pair: str, index: int, *, los: bool) -> float:
    """Mean rate of an episode in sight, or out of it [Mbit/s]; not a number where there was no such frame."""
    flight = report.flights[pair][index]
    mine = flight.efficiency[flight.los == los]
    return float(mine.mean()) * report.bandwidth_hz / 1e6 if len(mine) else math.nan


def _targets(report: Report) -> Comparison:
    times, rates = _ratios(report, TRAINED)
    rows = [
        ("time", str(times), f"≤ {MOST_TIME:.2f}", "yes" if times.mean <= MOST_TIME else "no"),
        ("mean rate", str(rates), f"≥ {LEAST_RATE:.2f}", "yes" if rates.mean >= LEAST_RATE else "no"),
    ]
    for pair in PAIRS[1:3]:
        for name, ratio in zip(("time", "mean rate"), _ratios(report, pair), strict=True):
            rows.append((f"{name}: {pair}", str(ratio), "", ""))
    notes = _missed(report, times, rates)
    columns = ("ratio to the baseline", "mean [95 % interval]", "target", "reached")
    return Comparison("The trained pair over the baseline", columns, rows, notes)


def _missed(report: Report, times: Ratio, rates: Ratio) -> list[str]:
    notes = []
    if not times.mean <= MOST_TIME:
        notes.append(f"The time misses its target by {times.mean - MOST_TIME:.3f}.")
    if not rates.mean >= LEAST_RATE:
        notes.append(f"The mean rate misses its target by {LEAST_RATE - rates.mean:.3f}.")
    asked = report.settings.addresses
    unfinished = sum(flight.delivered < asked for pair in PAIRS for flight in report.flights[pair])
    if unfinished:
        notes.append(
            f"Flights that ended before the last delivery, whose time is the whole episode: {unfinished}."
        )
    if rates.episodes < len(report.rounds):
        kept = f"{rates.episodes} of {len(report.rounds)} episodes"
        notes.append(f"The ratio of rates is of {kept}: in others one pair had none.")
    return notes


def _ratios(report: Report, pair: str) -> tuple[Ratio, Ratio]:
    return (
        ratio_of(report.seconds(pair), report.seconds(BASELINE)),
        ratio_of(report.rates(pair), report.rates(BASELINE)),
    )


def _episodes(report: Report) -> Comparison:
    rows = []
    rates = {pair: report.rates(pair) for pair in (BASELINE, TRAINED)}
    for index in range(len(report.rounds)):
        theirs, ours = (report.flights[pair][index] for pair in (BASELINE, TRAINED))
        before, after = rates[BASELINE][index], rates[TRAINED][index]
        rows.append(
            (
                str(index + 1),
                f"{theirs.seconds:.1f}",
                f"{ours.seconds:.1f}",
                f"{ours.seconds / theirs.seconds:.2f}",
                f"{before:.0f}",
                f"{after:.0f}",
                f"{after / before:.2f}" if before else NOTHING,
                "".join(map(str, theirs.order)),
                "".join(map(str, ours.order)),
            )
        )
    columns = (
        "episode", "time [s], baseline", "trained", "ratio", "rate [Mbit/s], baseline", "trained", "ratio",
        "addresses in order, baseline", "trained",
    )  # fmt: skip
    return Comparison("Episodes", columns, rows)


def _differences(report: Report) -> list[str]:
    settings, table = report.settings, report.trained.table
    trained = _TRAINING.format(
        places=len(table.places),
        cell=settings.cell_m,
        beams=settings.beam_steps,
        kinds=len(WORTHS),
        pilot=settings.pilot_steps,
    )
    played = _PLAYED.format(count=len(report.rounds), addresses=settings.addresses)
    seconds = f"Trained in {report.training_s:.0f} s, played in {report.playing_s:.0f} s on this machine."
    return [*([_TRIAL] if settings.quick else []), played, _BASELINE, trained, _PAPER, seconds]


def figures_of(report: Report) -> dict[str, Any]:
    """Collect the figures of each episode, for a file.

    Args:
        report: What was played.
    """
    pairs: dict[str, Any] = {}
    for pair in PAIRS:
        flights = report.flights[pair]
        times, rates = _ratios(report, pair)
        pairs[pair] = {
            "seconds": [flight.seconds for flight in flights],
            "mean_rate_mbit_s": report.rates(pair).tolist(),
            "in_sight": [float(flight.los.mean()) for flight in flights],
            "delivered": [flight.delivered for flight in flights],
            "order": [flight.order for flight in flights],
            "ways": [[WORTHS[kind] for kind in flight.kinds] for flight in flights],
            "straight_beam": [float(flight.straight.mean()) for flight in flights],
            "time_ratio": _ratio_figures(times),
            "rate_ratio": _ratio_figures(rates),
        }
    experience = report.trained.experience
    return {
        "trial": report.settings.quick,
        "seed": report.settings.seed,
        "pairs": pairs,
        "episodes": [{"seed": one.seed, "places_m": one.places.tolist()} for one in report.rounds],
        "training": {
            "beams_bit_s_hz": experience.figures,
            "pilot_cost_frames": report.trained.pilot_figures,
        },
        "interval": "95 %, Student's t on the logarithms of the ratios of paired episodes",
    }


def _ratio_figures(ratio: Ratio) -> dict[str, float | None]:
    values = {"mean": ratio.mean, "low": ratio.low, "high": ratio.high}
    return {name: None if math.isnan(value) else value for name, value in values.items()}
