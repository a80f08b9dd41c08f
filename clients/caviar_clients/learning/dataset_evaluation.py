"""Policies beside baselines on the recorded users of a dataset: rankings of beams, LOS and NLOS apart."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.datasets.reader import Dataset
from caviar_clients.datasets.settings import fingerprint as settings_digest
from caviar_clients.learning import ranking_methods as methods
from caviar_clients.learning.evaluate import Interval
from caviar_clients.learning.rankings import (
    FIGURES,
    OUTAGE_DB,
    Terms,
    beams_needed,
    difference,
    interval,
    kinds_of,
    terms_of,
)
from caviar_clients.learning.samples import EVERYONE, Selection, read_samples
from caviar_protocol.errors import ScenarioError
from caviar_services.agent.policy import PolicyModel, TrainedOn

LEARNT = ("nearest users", "frequent pairs", "fingerprint")
"""Baselines that learn from other episodes."""


@dataclass(frozen=True, eq=False)
class DatasetEvaluation:
    """Figures of policies and baselines on the same users."""

    dataset: str
    episodes: tuple[int, ...]
    """Numbers of those that were judged."""
    users: Mapping[str, int]
    """Number of users with a path by kind: all, LOS, NLOS."""
    without_path: int
    """Users that no beam reaches; they are in no figure."""
    pairs: int
    """Pairs of beams that each user has."""
    pairs_used: int
    """Pairs that are the best of a user, of those in the figures."""
    entropy_bit: float
    """Of the best pair over the users [bit]."""
    terms: Mapping[str, Mapping[str, Sequence[Terms]]]
    """By method and kind, an entry for each seed of a policy."""
    pilots: Mapping[str, float]
    """Of a frame, of methods that send them to find their pair."""
    notes: tuple[str, ...] = ()
    """What was left out, and why."""

    @property
    def methods(self) -> tuple[str, ...]:
        """Names of policies, then of baselines."""
        return tuple(self.terms)

    def figure(self, method: str, kind: str, name: str) -> Interval:
        """A figure with its 95 % interval over episodes and seeds.

        Args:
            method: One of `methods`.
            kind: all, LOS or NLOS.
            name: One of `FIGURES`.
        """
        return interval(self.terms[method][kind], name)

    def difference(self, method: str, other: str, kind: str, name: str) -> Interval:
        """A figure of a method less that of another one, on the same users.

        Args:
            method: One of `methods`, and so is ``other``.
            other: What is subtracted.
            kind: all, LOS or NLOS.
            name: One of `FIGURES`.
        """
        return difference(self.terms[method][kind], self.terms[other][kind], name)

    def beams_needed(self, method: str, kind: str) -> int | None:
        """Beams to be tried until 90 % of the users have their best one; None: more than are ranked.

        Args:
            method: One of `methods`.
            kind: all, LOS or NLOS.
        """
        return beams_needed([run.rank for run in self.terms[method][kind]], self.pairs)

    def as_json(self) -> dict[str, Any]:
        """All figures, differences of each method to the first, and values of each episode."""
        first = self.methods[0]
        found: dict[str, Any] = {}
        for method, kinds in self.terms.items():
            found[method] = {
                "figures": {k: {n: vars(self.figure(method, k, n)) for n in FIGURES} for k in kinds},
                "beams_for_90_percent": {k: self.beams_needed(method, k) for k in kinds},
                "pilots": self.pilots.get(method),
                "minus_first": {
                    k: {n: vars(self.difference(method, first, k, n)) for n in FIGURES} for k in kinds
                },
                "by_episode": {
                    k: [{n: _ratios(run, n) for n in FIGURES} for run in runs] for k, runs in kinds.items()
                },
            }
        return {
            "dataset": self.dataset,
            "episodes": list(self.episodes),
            "users": dict(self.users),
            "users_without_path": self.without_path,
            "pairs": self.pairs,
            "pairs_used": self.pairs_used,
            "entropy_bit": self.entropy_bit,
            "first": first,
            "methods": found,
            "notes": list(self.notes),
        }


def _ratios(run: Terms, name: str) -> list[float]:
    with np.errstate(invalid="ignore", divide="ignore"):
        found: list[float] = (run.over[name] / run.under[name]).tolist()
    return found


def evaluate_on_dataset(
    files: Sequence[Path],
    location: str | Path,
    trained_on: str | Path | None = None,
    selection: Selection = EVERYONE,
    outage_db: float = OUTAGE_DB,
    report: Callable[[str, float], None] = lambda what, share: None,
) -> DatasetEvaluation:
    """Hold policies against baselines on the users of a dataset.

    Episodes that one of the policies was trained on are left out, as the cards say: of the dataset of their
    training the other episodes are judged, of another one all.

    Args:
        files: ONNX files with cards. Those of a folder ``NAME/seed-N`` are seeds of the method NAME.
        location: Folder of the dataset, or its address.
        trained_on: Of the dataset that baselines learn from; None: the first argument, where the policies
        were
            trained on it.
        selection: Users that are judged.
        outage_db: SNR below which a user is out of service [dB].
        report: Called with what is done, and the share that is done.

    Raises:
        ScenarioError: A file is no policy, has no card, or does not fit the dataset; or no episode is left.
        RecordingError: The dataset cannot be read, or lacks what is observed.
    """
    dataset = Dataset(location)
    models = [PolicyModel(file, f"policy {file}") for file in files]
    for file, model in zip(files, models, strict=True):
        if model.card is None:
            raise ScenarioError(f"policy {file} has no card; export it with caviar policy export or train")
    whole = dataset
    dataset = dataset.select(_held_out(dataset, [m.card.trained_on for m in models if m.card]))
    parts = dict.fromkeys(name for model in models for name in model.inputs)
    report("users are read", 0.0)
    samples = read_samples(
        dataset, tuple(parts), selection, lambda share: report("users are read", share / 2)
    )
    learnt, notes = _learnt(whole, trained_on, models)
    found: dict[str, list[methods.Ranking]] = {}
    for number, (file, model) in enumerate(zip(files, models, strict=True)):
        report(f"{file} ranks", 0.5 + 0.3 * number / len(files))
        ranking = methods.ranked_by_policy(model, samples, f"policy {file}")
        found.setdefault(method_name(file), []).append(ranking)
    found = _with_distinct_names(found)
    report("baselines rank", 0.8)
    if learnt is not None:
        users = read_samples(learnt, (), selection)
        found["nearest users"] = [methods.ranked_by_neighbours(users, samples)]
        found["frequent pairs"] = [methods.ranked_by_frequency(users, samples)]
    found["los-beam"] = [methods.ranked_along_the_line(samples)]
    agents = {
        "fingerprint": methods.fingerprint(learnt) if learnt is not None else None,
        "out-of-band": methods.out_of_band(dataset),
        "hierarchical-sweep": methods.hierarchical_sweep(),
        "exhaustive-sweep": methods.exhaustive_sweep(),
    }
    for name, agent in agents.items():
        if agent is not None:
            found[name] = [methods.ranked_by_agent(agent, dataset, samples, selection)]
    report("figures are counted", 0.95)
    kinds = kinds_of(samples)
    masks = {"all": samples.has_path, "LOS": samples.has_path & samples.los}
    masks["NLOS"] = samples.has_path & ~samples.los
    terms = {
        name: {
            kind: [terms_of(of_kind, ranking.order[masks[kind]], outage_db) for ranking in rankings]
            for kind, of_kind in kinds.items()
            if len(of_kind)
        }
        for name, rankings in found.items()
    }
    counts = np.bincount(samples.best[samples.has_path])
    shares = counts[counts > 0] / max(counts.sum(), 1)
    return DatasetEvaluation(
        dataset=dataset.name,
        episodes=dataset.episodes,
        users={kind: len(of_kind) for kind, of_kind in kinds.items()},
        without_path=int((~samples.has_path).sum()),
        pairs=samples.abs_y.shape[1],
        pairs_used=len(shares),
        entropy_bit=float(-(shares * np.log2(shares)).sum()),
        terms=terms,
        pilots={name: of[0].pilots for name, of in found.items() if of[0].pilots is not None},
        notes=tuple(notes),
    )


def method_name(file: Path) -> str:
    """Name of the method that a policy is a seed of: of the folder of its experiment, or of its file.

    Args:
        file: Of the policy.

    Example:
        >>> method_name(Path("training/lidar/seed-3/policy.onnx")), method_name(Path("mine.onnx"))
        ('lidar', 'mine')
    """
    return file.parent.parent.name if file.parent.name.startswith("seed-") else file.stem


def _with_distinct_names(found: dict[str, list[methods.Ranking]]) -> dict[str, list[methods.Ranking]]:
    taken = {*LEARNT, "los-beam", "out-of-band", "hierarchical-sweep", "exhaustive-sweep"}
    return {f"policy {name}" if name in taken else name: of for name, of in found.items()}


def _held_out(dataset: Dataset, trained: Sequence[TrainedOn | None]) -> list[int]:
    """Episodes that no policy was trained on."""
    digest = settings_digest(dataset.settings)
    seen = {
        number
        for one in trained
        if one is not None and one.fingerprint == digest
        for first, last in one.episodes
        for number in range(first, last + 1)
    }
    left = [number for number in dataset.episodes if number not in seen]
    if not left:
        raise ScenarioError(
            f"the policies were trained on all {len(dataset)} episodes of {dataset.location}; name another "
            "dataset, or train them with test = 0.2 below [data]"
        )
    return left


def _learnt(
    dataset: Dataset, other: str | Path | None, models: Sequence[PolicyModel]
) -> tuple[Dataset | None, list[str]]:
    """Episodes that baselines learn from: those of the policies' training."""
    trained = [m.card.trained_on for m in models if m.card and m.card.trained_on]
    whole = dataset if other is None else Dataset(other)
    digest = settings_digest(whole.settings)
    seen = {
        number
        for one in trained
        if one.fingerprint == digest
        for first, last in one.episodes
        for number in range(first, last + 1)
    } & set(whole.episodes)
    if seen:
        return whole.select(sorted(seen)), []
    if other is not None:
        raise ScenarioError(
            f"no policy was trained on {other}, as their cards say; name the dataset of training"
        )
    where = f" ({trained[0].dataset!r})" if trained else ""
    return None, [
        f"{', '.join(LEARNT)} left out: they learn from the training's dataset{where}; --trained-on names it"
    ]
