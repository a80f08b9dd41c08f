"""Rankings of pairs of beams for the users of a dataset, and their figures.

The figures are those of the ITU challenge ML5G-PHY on beam selection (2020): top-k accuracy, and the
throughput ratio Σ log2(1 + max y of the first k) / Σ log2(1 + max y) with y = |Wᴴ H F| of matrices W and F
that are not normalised, so sqrt(Nr·Nt) times |y|; and beside them rates at the SNR of the link, and outage.

Each is a ratio of sums over users, and episodes are what is independent: intervals are Student's, of the
linearised ratio over episodes (Cochran, "Sampling Techniques", 3rd ed., section 6.4); over several seeds of a
training the variance of the mean over seeds is added to that over episodes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from caviar_clients.learning.evaluate import KINDS, Interval, student_95
from caviar_clients.learning.samples import Samples
from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array

TOP = (1, 5, 10)
"""Numbers of beams that are tried."""
SUCCESS = 0.9
"""Share of users whose best pair is among those that are tried, for `beams_needed`."""
OUTAGE_DB = 0.0
"""SNR [dB] below which a user is out of service."""
FIGURES = tuple(f"{name}_{k}" for name in ("top", "throughput", "rate", "outage") for k in TOP)
"""Names of the figures: ``top_1``, share of users whose best pair is the first; ``throughput_5``, the
challenge's ratio of the best of five; ``rate_10``, likewise of log2(1 + SNR); ``outage_1``, share below
`OUTAGE_DB`."""


@dataclass(frozen=True, eq=False)
class Terms:
    """Terms of the figures of one ranking, summed over the users of each of E episodes."""

    over: Mapping[str, Float64Array]
    """Numerator by figure, Shape ``[E]``."""
    under: Mapping[str, Float64Array]
    """Denominator."""
    rank: Int64Array
    """Place of the best pair of each user in the ranking, from 0; P where it is not in it. Shape ``[N]``."""


def terms_of(samples: Samples, order: Int64Array, outage_db: float = OUTAGE_DB) -> Terms:
    """Sum up the terms of the figures of a ranking.

    Args:
        samples: N users, all with a path.
        order: Indices of pairs, best first, Shape ``[N, K]``; −1 where a ranking ends.
        outage_db: SNR below which a user is out of service [dB].

    Returns:
        Terms by episode, in ascending order of episodes.
    """
    abs_y = samples.abs_y.astype(np.float64)
    hits = order == samples.best[:, None]
    rank = np.where(hits.any(1), hits.argmax(1), abs_y.shape[1])
    found = np.where(order < 0, 0.0, np.take_along_axis(abs_y, np.maximum(order, 0), axis=1))
    best_of = np.maximum.accumulate(found, axis=1)
    best = np.take_along_axis(abs_y, samples.best[:, None], axis=1)[:, 0]
    scale = math.sqrt(math.prod(samples.beams))
    _, episode = np.unique(samples.episode[samples.scene], return_inverse=True)
    over, under = dict[str, Float64Array](), dict[str, Float64Array]()

    def summed(values: Float64Array | BoolArray) -> Float64Array:
        found: Float64Array = np.bincount(episode, values.astype(np.float64)).astype(np.float64)
        return found

    for k in TOP:
        y = best_of[:, min(k, best_of.shape[1]) - 1]
        snr = samples.power_over_noise * y**2
        columns = {
            "top": (rank < k, np.ones(len(y))),
            "throughput": (np.log2(1 + scale * y), np.log2(1 + scale * best)),
            "rate": (np.log2(1 + snr), np.log2(1 + samples.power_over_noise * best**2)),
            "outage": (snr < 10 ** (outage_db / 10), np.ones(len(y))),
        }
        for name, (numerator, denominator) in columns.items():
            over[f"{name}_{k}"], under[f"{name}_{k}"] = summed(numerator), summed(denominator)
    return Terms(over, under, rank)


def beams_needed(ranks: Sequence[Int64Array], pairs: int) -> int | None:
    """Find how many beams have to be tried until `SUCCESS` of the users have their best one.

    Args:
        ranks: Of rankings of the same users, as of `Terms`; the mean over them counts.
        pairs: Number of pairs.

    Returns:
        None where even all that is ranked does not do.

    Example:
        >>> beams_needed([np.arange(10)], 16)
        9
    """
    counts = np.mean([np.bincount(rank, minlength=pairs + 1)[:pairs] for rank in ranks], axis=0)
    reached = np.cumsum(counts) >= SUCCESS * len(ranks[0]) - 1e-9
    return int(reached.argmax()) + 1 if reached.any() else None


def interval(runs: Sequence[Terms], figure: str) -> Interval:
    """A figure of one method, the mean over its runs, with its 95 % interval over episodes and runs.

    Args:
        runs: A seed of the training each, on the same episodes.
        figure: One of `FIGURES`.
    """
    return _interval([_Ratio.of(run, figure) for run in runs])


def difference(runs: Sequence[Terms], others: Sequence[Terms], figure: str) -> Interval:
    """A figure of one method less that of another one on the same users, with the interval of the paired
    differences.

    Args:
        runs: Of the one.
        others: Of the other; as many, or one that each is held against.
        figure: One of `FIGURES`.
    """
    if len(others) == 1:
        others = [others[0]] * len(runs)
    elif len(others) != len(runs):  # seeds cannot be paired
        runs, others = [_mean_terms(runs)], [_mean_terms(others)]
    ratios = [(_Ratio.of(a, figure), _Ratio.of(b, figure)) for a, b in zip(runs, others, strict=True)]
    return _interval([_Ratio(a.value - b.value, a.parts - b.parts) for a, b in ratios])


def _mean_terms(runs: Sequence[Terms]) -> Terms:
    over = {name: np.mean([run.over[name] for run in runs], axis=0) for name in runs[0].over}
    return Terms(over, runs[0].under, runs[0].rank)


@dataclass(frozen=True, eq=False)
class _Ratio:
    value: float
    parts: Float64Array
    """Of each episode: what it adds to the value, so that their sum is the linearised error."""

    @classmethod
    def of(cls, run: Terms, figure: str) -> _Ratio:
        over, under = run.over[figure], run.under[figure]
        total = under.sum()
        if total <= 0:
            return cls(math.nan, np.full(len(over), math.nan))
        value = float(over.sum() / total)
        return cls(value, (over - value * under) / total)


def _interval(ratios: Sequence[_Ratio]) -> Interval:
    values = np.array([ratio.value for ratio in ratios])
    episodes, seeds = len(ratios[0].parts), len(ratios)
    if episodes < 2 or math.isnan(values.mean()):
        return Interval(float(values.mean()), math.nan, episodes)
    parts = np.mean([ratio.parts for ratio in ratios], axis=0)
    of_episodes = float((parts**2).sum() * episodes / (episodes - 1))
    of_seeds = float(values.var(ddof=1)) / seeds if seeds > 1 else 0.0
    variance = of_episodes + of_seeds
    if variance <= 0:
        return Interval(float(values.mean()), 0.0, episodes)
    # Degrees of freedom of a sum of two variances (Welch and Satterthwaite).
    below = of_episodes**2 / (episodes - 1) + (of_seeds**2 / (seeds - 1) if seeds > 1 else 0.0)
    degrees = max(1, math.floor(variance**2 / below))
    return Interval(float(values.mean()), student_95(degrees) * math.sqrt(variance), episodes)


def kinds_of(samples: Samples) -> dict[str, Samples]:
    """Users with a path: all of them, and those with and without a line of sight.

    Args:
        samples: Of a dataset.
    """
    masks = (samples.has_path, samples.has_path & samples.los, samples.has_path & ~samples.los)
    return {kind: samples.where(mask) for kind, mask in zip(KINDS, masks, strict=True)}
