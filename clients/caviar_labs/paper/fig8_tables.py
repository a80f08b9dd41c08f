"""The tables of ``caviar paper fig8``, and what differs from the paper."""

from __future__ import annotations

from typing import Any

import numpy as np

from caviar_labs.paper.comparison import NOTHING, Comparison, number, with_interval
from caviar_labs.paper.fig8 import CHANNELS, ChannelName, Report
from caviar_labs.paper.held_out import KINDS, Episodes

PAPER = {"optimum": "6.81", "los-beam": "1.7", "DQN, defaults": "2.3"}
"""Averages of |y| that the paper states."""
TUNED, ANGLE = "DQN, tuned", "DQN, tuned, angle alone"

_SEEDS = (
    "Means over frames of {episodes} episodes that no policy was trained on; ± is the 95 % interval over "
    "the seeds of training ({seeds}), all judged on the same episodes. «of los-beam»: ratio of means."
)
_PAPER = (
    "The paper refers to others for the distributions of its multipath components, and says nothing of their "
    "powers or how long it trained. Here they are those of the scenario geometric. Its baseline has 1.7 on "
    "average, a quarter of the optimum, though it calls its results good wherever the line of sight is free, "
    "for most of the flight. Here los-beam is nearly the optimum there, and so far above 1.7."
)
_FRAME = (
    "With components drawn anew in each frame, what one frame shows says nothing of the next. Without a line "
    "of sight no beam is then better on average than those near the straight line, whatever is observed and "
    "learned. So the tuned DQN is shown where components last an episode, and in Munich."
)
_DEFAULTS = (
    "DQN, defaults: hyper-parameters of Stable-Baselines3, {defaults:,} steps, the reward |y|, and the angle "
    "alone, as in the paper, which used the defaults of Stable Baselines, its predecessor. Its discount of "
    "0.99 looks 100 frames ahead, though a beam has no influence on the next channel."
)
_TUNED = (
    "DQN, tuned: {tuned:,} steps in a vector of 32 environments, discount 0, the reward |y| over that of the "
    "best beam; it observes direction, position, and beam and rate of the frame before, as sines and cosines "
    "down to the width of a beam. DQN, tuned, angle alone: the same, but it observes the angle."
)
_ANGLE = (
    "θ is the azimuth of the UAV seen from the base station, by which the geometric model blocks the line of "
    "sight from 20° to 30°; the paper draws the angle of arrival at the UAV. Time is in seconds: the paper's "
    "axis goes to some 80,000 without a unit."
)
_MUNICH = (
    "Munich: sixteen flights, twelve of which are trained on, are traced once by Sionna RT; |y| is relative "
    "to the root mean square of the entries of H in each frame, at most 8, as in the geometric model. Frames "
    "without any path are left out. Flights differ by metres: the policy knows this neighbourhood, and no "
    "other one."
)


def comparisons(report: Report) -> list[Comparison]:
    """Make the tables of a report.

    Args:
        report: What was played.
    """
    found = [_means(report, channel) for channel in report.played]
    found += [_each_seed(report, channel) for channel in report.played]
    judged = [channel for channel, played in report.played.items() if TUNED in played.chosen]
    if judged:
        found.append(_held_against(report, judged))
    return [*found, Comparison("What differs", (), (), _differences(report))]


def _means(report: Report, channel: ChannelName) -> Comparison:
    played, like_paper = report.played[channel], channel == "geometric"
    rows: list[tuple[str, ...]] = []
    for method in _methods(played):
        cells = [method]
        for kind in KINDS:
            cells.append(with_interval(played.means(method, kind), 2))
            if kind != "all":
                cells.append(with_interval(ratios(played, method, kind), 3))
        rows.append((*cells, PAPER.get(method, NOTHING)) if like_paper else tuple(cells))
    columns = ("mean |y|", "all", "LOS", "LOS, of los-beam", "NLOS", "NLOS, of los-beam")
    counts = {kind: int(played.frames(kind).sum()) for kind in KINDS}
    notes = [
        _SEEDS.format(episodes=len(played.los), seeds=len(report.seeds)),
        f"{counts['all']:,} frames, {counts['NLOS']:,} of them without a line of sight.",
    ]
    return Comparison(CHANNELS[channel], (*columns, "paper, all") if like_paper else columns, rows, notes)


def _each_seed(report: Report, channel: ChannelName) -> Comparison:
    played = report.played[channel]
    rows = [
        (f"{agent}: {what}", *(number(value, digits) for value in values))
        for agent in played.chosen
        for what, digits, values in (
            ("all", 2, played.means(agent, "all")),
            ("LOS, of los-beam", 3, ratios(played, agent, "LOS")),
            ("NLOS", 2, played.means(agent, "NLOS")),
            ("NLOS, of los-beam", 2, ratios(played, agent, "NLOS")),
        )
    ]
    columns = ("|y| by seed", *map(str, report.seeds))
    return Comparison(f"Each seed, {channel}", columns, rows)


def _held_against(report: Report, channels: list[ChannelName]) -> Comparison:
    rows = []
    for channel in channels:
        played = report.played[channel]
        measured = (
            ("LOS, of los-beam", "≥ 0.95", ratios(played, TUNED, "LOS")),
            ("NLOS, of los-beam", "> 1", ratios(played, TUNED, "NLOS")),
            ("all, of the angle alone", "> 1", _over(played, TUNED, ANGLE, "all")),
            ("NLOS, of the angle alone", "> 1", _over(played, TUNED, ANGLE, "NLOS")),
        )
        rows += [
            (f"{channel}: {what}", wanted, number(min(values), 2 if values[0] > 1.1 else 3))
            for what, wanted, values in measured
        ]
    return Comparison("The tuned DQN, its worst seed", ("mean |y|", "wanted", "measured"), rows)


def _methods(played: Episodes) -> tuple[str, ...]:
    return ("optimum", "los-beam", *played.chosen)


def ratios(played: Episodes, method: str, kind: str) -> list[float]:
    """Mean |y| over that of ``los-beam``, an entry for each policy.

    Args:
        played: By whom.
        method: An agent, ``los-beam`` or ``optimum``.
        kind: Of the frames, one of `KINDS`.
    """
    (straight,) = played.means("los-beam", kind)
    return [mean / straight for mean in played.means(method, kind)]


def _over(played: Episodes, one: str, other: str, kind: str) -> list[float]:
    pairs = zip(played.means(one, kind), played.means(other, kind), strict=True)
    return [mine / theirs for mine, theirs in pairs]


def _differences(report: Report) -> list[str]:
    steps = report.steps
    defaults = next((count for name, count in steps.items() if name.endswith("-defaults")), 0)
    tuned = next((count for name, count in steps.items() if name.endswith("-tuned")), 0)
    found = [_PAPER, _FRAME, _DEFAULTS.format(defaults=defaults)]
    if tuned:
        found.append(_TUNED.format(tuned=tuned))
    found.append(_ANGLE)
    if "munich" in report.played:
        found.append(_MUNICH)
    return [*found, *report.notes]


def figures_of(report: Report) -> dict[str, Any]:
    """Collect the means of each seed, for a file.

    Args:
        report: What was played.
    """
    channels = {}
    for channel, played in report.played.items():
        channels[channel] = {
            "episodes": len(played.los),
            "frames": {kind: int(played.frames(kind).sum()) for kind in KINDS},
            "abs_y": {m: {k: _finite(played.means(m, k)) for k in KINDS} for m in _methods(played)},
        }
    return {"seeds": list(report.seeds), "steps": dict(report.steps), "paper": PAPER, "channels": channels}


def _finite(values: list[float]) -> list[float | None]:
    return [value if np.isfinite(value) else None for value in values]
