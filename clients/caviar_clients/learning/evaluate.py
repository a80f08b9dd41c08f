"""A policy beside its baselines: |y| on episodes of many seeds, with intervals, LOS and NLOS apart.

All of them are judged in the same frames: the beams of the straight line (``los-beam``) and of the best pair
(``optimum``) are in the link's product, ``random`` draws from the same codebooks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caviar_clients.envs.base import BeamSelectionEnv
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.errors import ScenarioError
from caviar_services.agent.policy import PolicyModel

METHODS = ("policy", "los-beam", "random", "optimum")
KINDS = ("all", "LOS", "NLOS")

Choose = Callable[[Mapping[str, NDArray[Any]]], Any]


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
    """What was measured: |y| by method and kind of frame."""

    policy: str
    scenario: str
    found: Mapping[str, Mapping[str, Interval]]
    """By method (`METHODS`), then by kind of frame (`KINDS`)."""
    frames: Mapping[str, int]
    """Users and frames of each kind."""

    def ratio(self, method: str, kind: str = "all") -> float:
        """Mean |y| of the policy over that of a method."""
        return self.found["policy"][kind].mean / self.found[method][kind].mean


def evaluate(
    file: Path,
    scenario: str | Path,
    seeds: Iterable[int],
    episodes: int = 1,
    progress: Callable[[int], None] = lambda done: None,
    **options: Any,
) -> Evaluation:
    """Evaluate a policy beside the baselines.

    Args:
        file: The ONNX file, with a card.
        scenario: File or name of the scenario.
        seeds: Of the episodes; none of them should be one of training.
        episodes: That follow each other from each seed on.
        progress: Called with the number of episodes that are done.
        options: Of `BeamSelectionEnv`, such as ``users``.

    Raises:
        ScenarioError: The file is no policy, has no card, or was trained for another codebook.
    """
    model = PolicyModel(file, f"policy {file.name}")
    if model.card is None:
        raise ScenarioError(f"policy {file.name} has no card; export it with caviar export-policy")
    env = BeamSelectionEnv(scenario, observe=model.card.observe, **options)
    sizes = tuple((place.tx.size, place.rx.size) for place in env.users.places)
    if sizes != model.card.codebooks:
        raise ScenarioError(
            f"policy {file.name} was trained for {list(model.card.codebooks)}, TX × RX beams of each user, "
            f"and {env.scenario.run.name!r} has {list(sizes)}; evaluate it where it was trained, or train it "
            "there"
        )
    means: dict[tuple[str, str], list[float]] = {(m, k): [] for m in METHODS for k in KINDS}
    counts = dict.fromkeys(KINDS, 0)
    rng, done = np.random.default_rng(0), 0
    highest = [tx * rx for tx, rx in sizes]
    ways: Mapping[str, Choose] = {"policy": model.act, "random": lambda seen: rng.integers(highest)}
    try:
        for seed in seeds:
            for method, choose in ways.items():
                for episode in range(episodes):
                    played = _episode(env, choose, None if episode else seed)
                    for kind in KINDS:
                        mine = played.of(kind)
                        means[method, kind].append(_mean(played.chosen[mine]))
                        if method == "policy":
                            counts[kind] += int(mine.sum())
                            means["los-beam", kind].append(_mean(played.straight[mine]))
                            means["optimum", kind].append(_mean(played.best[mine]))
            done += episodes
            progress(done)
    finally:
        env.close()
    found = {m: {k: mean_of(means[m, k]) for k in KINDS} for m in METHODS}
    return Evaluation(file.name, env.scenario.run.name, found, counts)


@dataclass(frozen=True)
class _Played:
    """|y| of an episode, by user and frame; those without a path are left out. Shape ``[N]`` each."""

    chosen: Float64Array
    straight: Float64Array
    best: Float64Array
    los: BoolArray

    def of(self, kind: str) -> BoolArray:
        """Which of them are of a kind."""
        if kind == "all":
            return np.ones(len(self.los), np.bool_)
        return self.los if kind == "LOS" else ~self.los


def _episode(env: BeamSelectionEnv, choose: Choose, seed: int | None) -> _Played:
    rows = []
    observation, _ = env.reset(seed=seed)
    over = False
    while not over:
        action = choose(observation)
        observation, _, terminated, truncated, info = env.step(action if len(action) > 1 else action[0])
        columns = (info["abs_y"], info["baseline_abs_y"], info["best_abs_y"], info["los"])
        rows.append(np.stack(columns, axis=1)[info["best_abs_y"] > 0])
        over = terminated or truncated
    found = np.concatenate(rows)
    return _Played(found[:, 0], found[:, 1], found[:, 2], found[:, 3] > 0)


def _mean(values: Float64Array) -> float:
    return float(values.mean()) if len(values) else math.nan
