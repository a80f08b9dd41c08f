"""A policy beside its baselines: |y| on episodes of many seeds, with intervals, LOS and NLOS apart.

All of them play the same frames (`caviar_clients.learning.contest`). Baselines that measure beams pay for it:
their pilots are counted, and the spectral efficiency is what these leave of each frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.learning.contest import (
    Contest,
    EpisodeScore,
    episodes_of,
    made_player,
)
from caviar_clients.session.prepared import prepare
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import ScenarioError
from caviar_services.agent.policy import PolicyModel

METHODS = ("policy", "los-beam", "random", "optimum")
"""What every evaluation has."""
BASELINES = ("exhaustive-sweep", "hierarchical-sweep", "last-sweep", "ucb", "thompson")
"""Agents that can be compared with in any scenario, as they need no settings."""
KINDS = ("all", "LOS", "NLOS")
_AGENTS = {"los-beam": "los-beam", "random": "random", "optimum": "oracle"}


@dataclass(frozen=True)
class Interval:
    """A mean over episodes, and its 95 % confidence interval."""

    mean: float
    half_width: float
    episodes: int
    """Episodes that had such frames."""

    def __str__(self) -> str:
        return f"{self.mean:.4g} ± {self.half_width:.2g}" if self.episodes > 1 else f"{self.mean:.4g}"


def mean_of(values: Sequence[float]) -> Interval:
    """The mean of the means of episodes, with Student's 95 % interval.

    Args:
        values: A mean of each episode; those that are not a number are left out.

    Example:
        >>> str(mean_of([5.0, 6.0, 7.0]))
        '6 ± 2.5'
    """
    kept = np.array([value for value in values if not math.isnan(value)])
    count = len(kept)
    if not count:
        return Interval(math.nan, math.nan, 0)
    if count == 1:
        return Interval(float(kept[0]), math.nan, 1)
    spread = float(kept.std(ddof=1)) / math.sqrt(count)
    return Interval(float(kept.mean()), student_95(count - 1) * spread, count)


def student_95(degrees: int) -> float:
    """The 97.5 % quantile of Student's t, by the expansion of Cornish and Fisher (Abramowitz and Stegun,
    26.7.5); exact below three degrees of freedom.

    Args:
        degrees: Degrees of freedom, at least 1.

    Example:
        >>> round(student_95(1), 3), round(student_95(9), 3), round(student_95(99), 3)
        (12.706, 2.262, 1.984)
    """
    if degrees == 1:
        return math.tan(math.pi * 0.475)
    if degrees == 2:
        return 2 * 0.475 * math.sqrt(2 / (1 - (2 * 0.475) ** 2))
    z, n = 1.959963984540054, degrees
    terms = (
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return z + sum(term / float(n**power) for power, term in enumerate(terms, 1))


@dataclass(frozen=True)
class Evaluation:
    """Measured figures by method: those of `METHODS`, and the agents that were compared with."""

    policy: str
    scenario: str
    found: Mapping[str, Mapping[str, Interval]]
    """|y| by method, then by kind of frame (`KINDS`); with several transmitters or carriers also by station,
    as ``lamp on mm``."""
    frames: Mapping[str, int]
    """Users and frames of each kind."""
    power: Mapping[str, float]
    """Mean |y|² by method."""
    efficiency: Mapping[str, Interval]
    """Spectral efficiency [bit/s/Hz] that pilots leave, by method."""
    pilots: Mapping[str, float]
    """Of a frame, on average, by method."""
    by_episode: Mapping[str, Mapping[str, Sequence[float]]]
    """Mean |y| of each episode by method, then by kind of frame; NaN: it had no such frames."""

    def difference(self, method: str, kind: str = "all") -> Interval:
        """Mean |y| of the policy less that of a method in the same episodes, with the interval of the paired
        differences.

        Args:
            method: One of `found`.
            kind: One of `KINDS`.
        """
        mine, its = self.by_episode["policy"][kind], self.by_episode[method][kind]
        return mean_of([a - b for a, b in zip(mine, its, strict=True)])

    def ratio(self, method: str, kind: str = "all") -> float:
        """Mean |y| of the policy over that of a method."""
        return self.found["policy"][kind].mean / self.found[method][kind].mean


def evaluate(
    file: Path,
    scenario: str | Path,
    seeds: Iterable[int],
    episodes: int = 1,
    progress: Callable[[int], None] = lambda done: None,
    against: Mapping[str, Mapping[str, Any]] | None = None,
    users: str | Sequence[str] = "*",
    agent: str | None = None,
) -> Evaluation:
    """Evaluate a policy beside the baselines.

    Args:
        file: The ONNX file, with a card.
        scenario: File or name of the scenario.
        seeds: Of the episodes; none of them should be one of training.
        episodes: That follow each other from each seed on.
        progress: Called with the number of episodes that are done.
        against: Agents to compare with, beside those of `METHODS`, with their settings as in a scenario, and
            settings of the agent ``policy``;
            ``dict.fromkeys(BASELINES, {})`` for those that need none.
        users: Receivers that are served, and count, as names with ``*`` and ``?``.
        agent: Of the scenario, whose place is taken; None: the only one.

    Raises:
        ScenarioError: The file is no policy, has no card, or was trained for another codebook; or an agent to
            compare with does not fit the scenario.
    """
    called = f"policy {file.name or file}"
    for name, settings in (against or {}).items():
        if name in METHODS and name != "policy" and settings:
            raise ScenarioError(
                f"{name!r} is compared with as it is, without {', '.join(settings)}; name another agent"
            )
    model = PolicyModel(file, called)
    known = prepare(Path(scenario)).scenario
    served = (users,) if isinstance(users, str) else tuple(users)
    settings = {**(against or {}).get("policy", {}), "file": str(file)}
    players = {"policy": made_player(known, "policy", settings, served, agent)}
    for name, use in _AGENTS.items():
        players[name] = made_player(known, use, {}, served, agent)
    for name, settings in (against or {}).items():
        if name not in players:
            players[name] = made_player(known, name, settings, served, agent)
    episodes_played: dict[str, list[EpisodeScore]] = {method: [] for method in players}
    efficiency: dict[str, list[float]] = {method: [] for method in players}
    pilots: dict[str, list[float]] = {method: [] for method in players}
    transmitters = model.card.transmitters if model.card else ("*",)
    with Contest(known, players, served, agent, transmitters) as contest:
        for done, seed in enumerate(episodes_of(seeds, episodes), 1):
            for method, played in contest.play(seed).items():
                efficiency[method].append(_mean(played.net_efficiency))
                pilots[method].append(played.pilots)
                episodes_played[method].append(played)
            progress(done)
    stations = sorted({name for played in episodes_played["policy"] for name in played.station})
    kinds = (*KINDS, *(stations if len(stations) > 1 else ()))
    by_episode = {
        m: {k: tuple(_mean(p.abs_y[p.mask(k)]) for p in played) for k in kinds}
        for m, played in episodes_played.items()
    }
    return Evaluation(
        policy=file.name,
        scenario=known.run.name,
        found={m: {k: mean_of(means) for k, means in of.items()} for m, of in by_episode.items()},
        frames={k: sum(int(p.mask(k).sum()) for p in episodes_played["policy"]) for k in kinds},
        power={
            m: _mean(np.concatenate([p.abs_y.reshape(-1) ** 2 for p in played]))
            for m, played in episodes_played.items()
        },
        efficiency={method: mean_of(values) for method, values in efficiency.items()},
        pilots={method: float(np.mean(values)) for method, values in pilots.items()},
        by_episode=by_episode,
    )


def _mean(values: Float64Array) -> float:
    return float(values.mean()) if len(values) else math.nan
