"""The figure of ``caviar paper radiostrike``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.plots.style import BLACK, BLUE, GREY, ORANGE, VERMILION, figure
from caviar_labs.paper.radio_strike import RULES, AgentName, Played, Report
from caviar_labs.radio_strike.rules import USERS
from caviar_protocol.arrays import Float64Array

_COLOURS: Mapping[AgentName, str] = {
    "B-Dummy": GREY,
    "straight line": BLUE,
    "B-A2C": ORANGE,
    "B-BeamOracle": BLACK,
}
_USERS = dict(zip(USERS, ("UAV", "car", "pedestrian"), strict=True))
_TITLES = {"legacy": "rules legacy: the original", "fixed": "rules fixed: without its defects"}


def draw(report: Report, file: Path) -> Path:
    """Draw returns over time, and bit rates of the published run beside those of the one played again.

    Args:
        report: What was played.
        file: PNG that is written.

    Returns:
        The file.
    """
    panels = len(RULES) + (report.published is not None)
    with figure(file, 4.8 * panels, 4.6) as drawn:
        axes = np.atleast_1d(drawn.subplots(1, panels))
        for one, rules in zip(axes, RULES, strict=False):
            _returns(one, report.played[rules])
            one.set_title(_TITLES[rules], loc="left")
        handles, labels = axes[0].get_legend_handles_labels()
        axes[0].legend(handles, labels, loc="best")
        if report.published is not None:
            _rates(axes[-1], report)
    return file


def _returns(axes: Any, played: Mapping[AgentName, Sequence[Played]]) -> None:
    for agent, episodes in played.items():
        steps = min(len(one.reward) for one in episodes)
        returns = np.array([one.reward[:steps].cumsum() for one in episodes])
        at = np.arange(1, steps + 1)
        axes.plot(at, returns.mean(0), color=_COLOURS[agent], label=agent)
        axes.fill_between(at, returns.min(0), returns.max(0), color=_COLOURS[agent], alpha=0.15, linewidth=0)
    axes.axhline(0, color=GREY, linewidth=0.8)
    axes.grid()
    axes.set_xlabel("step; traffic is dense for 1000, then light")
    axes.set_ylabel("return Σ r, mean and range of episodes")


def _rates(axes: Any, report: Report) -> None:
    published = report.published
    if published is None:
        return
    for (user, name), color in zip(enumerate(USERS), (VERMILION, BLUE, ORANGE), strict=True):
        mine = published.user == user
        again = np.concatenate([run.bit_rate[mine] for run in report.again])
        _shares(axes, again, color=color, linewidth=4.0, alpha=0.6, label=_USERS[name])
        # On top: where both agree, one line covers the other.
        _shares(axes, published.bit_rate[mine], color=BLACK, linewidth=1.0, linestyle="--")
    axes.plot([], [], color=BLACK, linewidth=1.0, linestyle="--", label="published")
    axes.grid()
    axes.legend(loc="lower right")
    axes.set_title("published run, played again", loc="left")
    axes.set_xlabel("bit rate [Gbit/s]")
    axes.set_ylabel("share of the user's steps below")


def _shares(axes: Any, rates: Float64Array, **style: Any) -> None:
    axes.plot(np.sort(rates), np.arange(1, len(rates) + 1) / len(rates), **style)
