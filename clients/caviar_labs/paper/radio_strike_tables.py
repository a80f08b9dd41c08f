"""The tables of ``caviar paper radiostrike``, and what differs from what was published."""

from __future__ import annotations

from typing import Any

import numpy as np

from caviar_labs.paper.comparison import Comparison, number, with_interval, with_range
from caviar_labs.paper.radio_strike import RULES, Report, Settings
from caviar_labs.paper.radio_strike_published import PublishedRun
from caviar_labs.radio_strike.rules import USERS, RulesName

_ORIGIN = (
    "The paper has no figures of Radio-Strike; it announces the challenge, which published its code and "
    "one run of an oracle."
)
_PLAYED = (
    "Agents play {count} episodes of {source}, {steps:,} steps each at most; ± is the 95 % interval of "
    "the mean over episodes. The challenge's own are named by --episodes. Rewards depend on how far away "
    "users are, those of legacy most, where received power falls with the 8th power of the distance."
)
_RULES = (
    "Rules legacy give the rewards of the challenge's code for the same seed and trajectories. Rules "
    "fixed are another game (docs/howto/radio-strike.md): their rewards are not to be compared with "
    "those of legacy."
)
_TRAINED = (
    "B-A2C has the challenge's settings, but {steps:,} steps of training instead of those of 400 "
    "episodes. Under legacy each step from the 20th on says that the episode has ended: the library "
    "resets each time, and all that B-A2C sees in training are the zeros that a reset observes. "
    "Observations are not scaled, as in the challenge, bit rates of 1e9 beside metres: under fixed "
    "{share:.0f} % of its beams are one and the same."
)
_PUBLISHED = (
    "The published run was made by the first version of the code, not by that of the challenge: 64 "
    "antennas in a row, the base station elsewhere, other traffic and reward. It is played again by that "
    "version's rules and in the same places, with other random numbers: it had no seed. ± is what 95 % "
    "of single runs are within."
)
_FIGURES = (("|y|", "magnitude", 3), ("bit rate [Gbit/s]", "bit_rate", 3), ("packets sent a slot", "sent", 1))
"""Figures of the published run, by user: name, attribute, digits."""


def comparisons(report: Report, settings: Settings) -> list[Comparison]:
    """Make the tables of a report.

    Args:
        report: What was played.
        settings: How.
    """
    found = [_agents(report, rules) for rules in RULES]
    if report.published is not None:
        found.append(_published(report, report.published))
    return [*found, Comparison("What differs", (), (), [*_differences(report, settings), *report.notes])]


def _agents(report: Report, rules: RulesName) -> Comparison:
    rows = [
        (
            agent,
            with_interval([float(one.reward.mean()) for one in played]),
            with_interval([float(one.bit_rate.mean()) / 1e9 for one in played], 2),
            with_interval([100 * one.delivered for one in played], 1),
        )
        for agent, played in report.played[rules].items()
    ]
    columns = ("agent", "reward a step", "bit rate [Gbit/s]", "packets sent [%]")
    return Comparison(f"Agents of the challenge, rules {rules}", columns, rows)


def _published(report: Report, published: PublishedRun) -> Comparison:
    rows: list[tuple[str, ...]] = []
    for user, name in enumerate(USERS):
        mine = published.user == user
        for what, attribute, digits in _FIGURES:
            again = [float(getattr(run, attribute)[mine].mean()) for run in report.again]
            there = float(getattr(published, attribute)[mine].mean())
            rows.append((f"{name}: {what}", with_range(again, digits), number(there, digits)))
    near = [100 * float((np.abs(run.beam - published.beam) <= 1).mean()) for run in report.again]
    dropped = [float(run.dropped.sum()) for run in report.again]
    rows += [
        ("packets dropped", with_range(dropped, 0), number(float(published.dropped.sum()), 0)),
        ("return, Σ 0.4·R", with_range([run.score for run in report.again], 1), number(published.score, 1)),
        ("published beam or a neighbour [%]", with_range(near, 1), "100"),
    ]
    notes = [
        f"The law of the bit rate holds in all {len(published.user):,} rows to {published.rate_error():.0e}.",
        f"Played again {len(report.again)} times.",
    ]
    return Comparison("The published run", ("mean", "here", "published"), rows, notes)


def _differences(report: Report, settings: Settings) -> list[str]:
    count = len(next(iter(report.played["legacy"].values())))
    source = "made-up trajectories" if settings.episodes is None else "the trajectories that were named"
    found = [_ORIGIN, _PLAYED.format(count=count, source=source, steps=settings.steps), _RULES]
    if "B-A2C" in report.played["legacy"]:
        shares = [one.favourite for one in report.played["fixed"]["B-A2C"]]
        found.append(_TRAINED.format(steps=settings.train_steps, share=100 * float(np.mean(shares))))
    if report.published is not None:
        found.append(_PUBLISHED)
    return found


def figures_of(report: Report) -> dict[str, Any]:
    """Collect the figures of each episode and run, for a file.

    Args:
        report: What was played.
    """
    agents: dict[str, Any] = {}
    for rules, by_agent in report.played.items():
        for agent, played in by_agent.items():
            agents.setdefault(rules, {})[agent] = {
                "reward": [float(one.reward.mean()) for one in played],
                "bit_rate_gbit_s": [float(one.bit_rate.mean()) / 1e9 for one in played],
                "delivered": [one.delivered for one in played],
            }
    found: dict[str, Any] = {"agents": agents}
    if report.published is not None:
        found["return_of_the_published_run"] = report.published.score
        found["returns_of_runs_played_again"] = [run.score for run in report.again]
    return found
