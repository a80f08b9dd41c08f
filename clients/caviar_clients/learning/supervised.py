"""The training of one seed of a supervised experiment: epoch by epoch, a checkpoint after each.

The random numbers of an epoch follow from the seed and the number of the epoch alone. A training that goes on
after Ctrl-C or a kill is therefore the same, bit by bit, as one that was never interrupted.
"""

from __future__ import annotations

import hashlib
import itertools
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from caviar_clients.datasets.settings import fingerprint
from caviar_clients.files import writing
from caviar_clients.learning.checkpoints import locked, newest_checkpoint, written_checkpoint
from caviar_clients.learning.classification import Classification, model_class
from caviar_clients.learning.export import export_module, versions
from caviar_clients.learning.samples import Samples, stored_samples
from caviar_clients.learning.training import (
    CHECKPOINTS,
    CURVES,
    PATIENCE_S,
    POLICY,
    RESULT,
    Progress,
    SeedResult,
    curves,
    read_result,
    seed_folder,
)
from caviar_protocol.errors import RunError, ScenarioError, SetupError
from caviar_protocol.files import replace_file
from caviar_protocol.host import install_command
from caviar_protocol.observations import Users
from caviar_protocol.scenario import Scenario
from caviar_services.agent.policy import ACTION, SCORES, PolicyCard, PolicyModel, TrainedOn

SAMPLES = ".samples"
"""Folder beside those of experiments, of what they read of datasets."""
MODEL = "model.pt"
"""File of the weights of a seed, as ``torch.load`` takes them."""
TOP = (1, 5, 10)
_STATE = "state.pt"
_CHUNK = 1024
"""Users that are reduced, or judged, at once."""


def train_classifier(
    experiment: Classification,
    seed: int,
    folder: Path,
    report: Callable[[Progress], None] = lambda progress: None,
) -> SeedResult:
    """Train one seed, or go on with it, to its end.

    Args:
        experiment: What is trained.
        seed: One of its seeds.
        folder: Of the experiment.
        report: Called with the progress after each epoch.

    Returns:
        What it led to; the same at once where it was done before.

    Raises:
        ScenarioError: The dataset cannot be read, or the model does not fit; the text has file and line.
        RunError: Another process trains this seed, the disk refuses, or the loss is not finite.
        SetupError: The extra ``learning`` is not installed.
    """
    mine = seed_folder(folder, seed)
    with writing(mine / RESULT):
        mine.mkdir(parents=True, exist_ok=True)
    with locked(mine / "lock", f"seed {seed}", PATIENCE_S):
        done = read_result(folder, seed)
        return _train(experiment, seed, mine, report) if done is None else done


def _train(
    experiment: Classification, seed: int, mine: Path, report: Callable[[Progress], None]
) -> SeedResult:
    try:
        import onnx  # noqa: F401
        import torch
    except ImportError as error:
        raise SetupError(f"training needs {error.name}; run: {install_command('learning')}") from error
    torch.set_num_threads(1)  # sums in one order; seeds are trained side by side
    torch.manual_seed(seed)
    samples, learnt, held = samples_of(experiment, mine.parents[1] / SAMPLES)
    training, device = experiment.training, device_of(experiment)
    model = make_model(experiment, samples)
    rows = [Rows.read(model, samples, users, experiment) for users in (learnt, held)]
    model.fit(rows[0].reduced)
    model.to(device)
    optimizer = torch.optim.AdamW(
        model.parameters(), training.learning_rate, weight_decay=training.weight_decay
    )
    state = _State(model, optimizer)
    newest = newest_checkpoint(mine / CHECKPOINTS)
    if newest is not None:
        state.load(newest)
    total = experiment.experiment.epochs
    report(Progress(seed=seed, steps=state.epoch, total=total, figures=state.figures))
    with curves(mine / CURVES, purge_step=state.epoch or None) as logger:
        while state.epoch < total and state.waited < training.patience:
            began = time.monotonic()
            loss = _train_epoch(experiment, state, rows[0], seed, device)
            figures = _judge(experiment, model, rows[1], device)
            if not (math.isfinite(loss) and math.isfinite(figures["loss"])):
                raise RunError(
                    f"seed {seed} has diverged in epoch {state.epoch + 1}: its loss is {loss:g}. Give an "
                    "experiment of another name a smaller learning_rate"
                )
            state.take(figures, time.monotonic() - began)
            for name, value in {"train/loss": loss, **_named("validation", figures)}.items():
                logger.record(name, value)
            logger.dump(state.epoch)
            with written_checkpoint(mine / CHECKPOINTS, state.epoch) as draft:
                state.save(draft)
            report(Progress(seed=seed, steps=state.epoch, total=total, figures=state.figures))
    model.load_state_dict(state.best)
    model.cpu()
    with writing(mine / MODEL):
        torch.save(model.state_dict(), mine / MODEL)
    export_classifier(experiment, model, samples, mine / POLICY, seed, state.epoch, state.figures)
    result = SeedResult(
        seed=seed,
        steps=state.epoch,
        digest=experiment.digest(),
        seconds=state.seconds,
        policy=hashlib.sha256((mine / POLICY).read_bytes()).hexdigest(),
        figures=state.figures,
    )
    with writing(mine / RESULT):
        replace_file(mine / RESULT, msgspec.json.format(msgspec.json.encode(result), indent=2) + b"\n")
    report(Progress(seed=seed, steps=total, total=total, figures=state.figures))
    return result


def _named(prefix: str, figures: Mapping[str, float]) -> dict[str, float]:
    return {f"{prefix}/{name}": value for name, value in figures.items()}


def device_of(experiment: Classification) -> str:
    """Device of PyTorch that an experiment is trained on.

    Args:
        experiment: Says which.

    Raises:
        ScenarioError: It wants a GPU, and there is none.
    """
    import torch

    wanted = experiment.training.device
    if wanted == "cuda" and not torch.cuda.is_available():
        raise experiment.place("training", "device").error(
            "is 'cuda', and PyTorch finds no GPU here; write 'auto' or 'cpu'"
        )
    return "cuda" if wanted != "cpu" and torch.cuda.is_available() else "cpu"


def samples_of(
    experiment: Classification, folder: Path
) -> tuple[Samples, NDArray[np.int64], NDArray[np.int64]]:
    """Read what an experiment learns from.

    Args:
        experiment: Names dataset, users and parts.
        folder: Of what is read, for all experiments of a folder.

    Returns:
        The samples, and the positions of the users with a path that are trained on, and of those of
        validation.

    Raises:
        ScenarioError: The dataset cannot be read, has no such users, or lacks what is observed.
    """
    train, validation, _ = experiment.split()
    selection = experiment.data.selection()
    samples = stored_samples(folder, experiment.dataset(), experiment.observe, selection)
    episode = samples.episode[samples.scene]
    learnt, held = (np.flatnonzero(np.isin(episode, part) & samples.has_path) for part in (train, validation))
    if not len(learnt) or not len(held):
        raise experiment.place("data").error(
            f"{len(learnt)} users with a path to train, and {len(held)} for validation; generate "
            "more episodes"
        )
    if all(shape is None for shape in samples.row_shapes.values()):
        raise experiment.place("model").error(
            f"observes {', '.join(experiment.observe)}, which all users of a scene share: no pair of beams "
            "could be told for one of them; observe 'position', too"
        )
    return samples, learnt, held


def make_model(experiment: Classification, samples: Samples) -> Any:
    """Make the network of an experiment, with weights by PyTorch's generator.

    Args:
        experiment: Names it.
        samples: Have the shapes of what it observes.

    Raises:
        ScenarioError: The network does not take these parts or options.
    """
    from caviar_clients.learning.networks import SMALL, BeamNetwork

    shapes = {name: samples.row_shapes[name] or samples.observed[name].shape[1:] for name in samples.observed}
    name, options = experiment.model.name, dict(experiment.model.options)
    try:
        if ":" in name:
            return model_class(experiment)(shapes, samples.beams, **options)
        return BeamNetwork(shapes, samples.beams, **{"small": name in SMALL, **options})
    except ScenarioError as error:
        raise experiment.place("model").error(str(error)) from error
    except TypeError as error:
        raise experiment.place("model", "options").error(f"{name} does not take them: {error}") from error


@dataclass(eq=False)
class Rows:
    """Rows of some users, as a network's `reduce` gives them, and |y| of their pairs."""

    reduced: dict[str, Any]
    abs_y: Any
    """In the experiment's order of pairs, Shape ``[N, P]``."""

    @classmethod
    def read(cls, model: Any, samples: Samples, users: NDArray[np.int64], experiment: Classification) -> Rows:
        """Read and reduce the rows of some users."""
        import torch

        parts: dict[str, list[Any]] = {}
        with torch.no_grad():
            for start in range(0, len(users), _CHUNK):
                some = users[start : start + _CHUNK]
                rows = {
                    name: torch.from_numpy(
                        np.ascontiguousarray(
                            samples.observed[name][samples.scene[some]]
                            if shape is None
                            else samples.rows(name, some)
                        )
                    )
                    for name, shape in samples.row_shapes.items()
                }
                for name, value in model.reduce(rows).items():
                    # Pictures of many users fill the memory.
                    large = value.dim() > 2 and value.is_floating_point()
                    parts.setdefault(name, []).append(value.half() if large else value)
        abs_y = torch.from_numpy(samples.abs_y[users])
        if experiment.label.order == "rx-tx":
            abs_y = abs_y.reshape(-1, *samples.beams).transpose(1, 2).flatten(1)
        return cls({name: torch.cat(values) for name, values in parts.items()}, abs_y)

    def __len__(self) -> int:
        return len(self.abs_y)

    def batch(self, users: Any, device: str) -> tuple[dict[str, Any], Any]:
        """Rows and |y| of some of them."""
        rows = {name: values[users].to(device) for name, values in self.reduced.items()}
        rows = {n: v.float() if v.is_floating_point() else v for n, v in rows.items()}
        return rows, self.abs_y[users].to(device)


@dataclass(eq=False)
class _State:
    """State of a training between two epochs."""

    model: Any
    optimizer: Any
    epoch: int = 0
    waited: int = 0
    """Epochs since the lowest loss of validation."""
    seconds: float = 0.0
    best: dict[str, Any] = field(default_factory=dict)
    """Weights of the lowest loss."""
    figures: dict[str, float] = field(default_factory=dict)
    """Of these weights."""

    def take(self, figures: dict[str, float], seconds: float) -> None:
        self.epoch, self.waited, self.seconds = self.epoch + 1, self.waited + 1, self.seconds + seconds
        if not self.figures or figures["loss"] < self.figures["loss"]:
            self.waited, self.figures = 0, figures
            self.best = {name: value.detach().clone() for name, value in self.model.state_dict().items()}

    def save(self, folder: Path) -> None:
        import torch

        numbers = {
            "epoch": self.epoch,
            "waited": self.waited,
            "seconds": self.seconds,
            "figures": self.figures,
        }
        states = {
            "model": self.model.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "best": self.best,
        }
        torch.save({**numbers, **states}, folder / _STATE)

    def load(self, folder: Path) -> None:
        import torch

        device = next(self.model.parameters()).device
        try:
            found = torch.load(folder / _STATE, weights_only=True, map_location=device)
            self.model.load_state_dict(found.pop("model"))
            self.optimizer.load_state_dict(found.pop("optimizer"))
            for name, value in found.items():
                setattr(self, name, value)
        except Exception as error:  # whatever a damaged file makes the library raise
            raise RunError(
                f"checkpoint {folder} cannot be read: {error}; remove the folder to train this seed anew"
            ) from error


def _train_epoch(experiment: Classification, state: _State, rows: Rows, seed: int, device: str) -> float:
    """Train on all rows once, in an order of the epoch's own; returns the mean loss."""
    import torch

    training, total = experiment.training, 0.0
    done = state.epoch / experiment.experiment.epochs
    for group in state.optimizer.param_groups:
        group["lr"] = training.learning_rate + (training.final_learning_rate - training.learning_rate) * done
    (word,) = np.random.SeedSequence([seed, state.epoch]).generate_state(1)
    torch.manual_seed(int(word))  # of what a network of the user's own draws
    order = torch.randperm(len(rows))
    state.model.train()
    for users in order.split(training.batch_size):
        given, abs_y = rows.batch(users, device)
        state.optimizer.zero_grad()
        loss = loss_of(state.model(given), abs_y, experiment)
        loss.backward()
        state.optimizer.step()
        total += float(loss.detach()) * len(users)
    return total / len(rows)


def loss_of(scores: Any, abs_y: Any, experiment: Classification) -> Any:
    """Cross-entropy of scores, as logits, with the target of the experiment's label.

    Args:
        scores: Shape ``[N, P]``.
        abs_y: |y| of each pair, Shape ``[N, P]``.
        experiment: Has the label.
    """
    from torch.nn.functional import cross_entropy

    label = experiment.label
    if label.target == "best":
        return cross_entropy(scores, abs_y.argmax(1))
    weight = abs_y / abs_y.amax(1, keepdim=True)
    weight = weight * (weight >= 10 ** (-label.within_db / 20))
    if label.target == "power":
        weight = weight**2
    return cross_entropy(scores, weight / weight.sum(1, keepdim=True))


def _judge(experiment: Classification, model: Any, rows: Rows, device: str) -> dict[str, float]:
    """Loss and top-k accuracy of some rows."""
    import torch

    model.eval()
    total, found = 0.0, dict.fromkeys(TOP, 0)
    with torch.no_grad():
        for users in torch.arange(len(rows)).split(_CHUNK):
            given, abs_y = rows.batch(users, device)
            scores = model(given)
            total += float(loss_of(scores, abs_y, experiment)) * len(users)
            most = scores.topk(min(TOP[-1], scores.shape[1])).indices
            hit = most == abs_y.argmax(1, keepdim=True)
            for k in TOP:
                found[k] += int(hit[:, :k].sum())
    return {"loss": total / len(rows), **{f"top_{k}": hits / len(rows) for k, hits in found.items()}}


# --- export -----------------------------------------------------------------------------------------------


def export_classifier(
    experiment: Classification,
    model: Any,
    samples: Samples,
    file: Path,
    seed: int,
    epochs: int,
    figures: Mapping[str, float],
) -> PolicyCard:
    """Export a network as a policy: normalisation inside, observations as a run has them.

    Args:
        experiment: That it was trained by.
        model: Trained, on the CPU.
        samples: Have shapes and codebooks.
        file: Where the ONNX file goes.
        seed: Of the training.
        epochs: Of the training.
        figures: On the episodes of validation.

    Raises:
        RunError: The file cannot be written.
        SetupError: The exported policy chooses otherwise than the network.
    """
    import torch

    names, shapes = tuple(samples.observed), dict(samples.row_shapes)
    (tx, rx), order = samples.beams, experiment.label.order

    class Policy(torch.nn.Module):  # type: ignore[misc]  # torch is not looked at
        """Observations of all places in, an action and scores for each of them out."""

        def __init__(self) -> None:
            super().__init__()
            self.model = model

        def forward(self, *parts: Any) -> Any:
            given = dict(zip(names, parts, strict=True))
            rows = {n: given[n].reshape(-1, *shape) for n, shape in shapes.items() if shape is not None}
            count = next(iter(rows.values())).shape[0]
            rows |= {
                n: given[n].expand(count, *given[n].shape[1:]) for n, shape in shapes.items() if shape is None
            }
            scores = self.model(self.model.reduce({n: rows[n] for n in names}))
            if order == "rx-tx":
                scores = scores.reshape(-1, rx, tx).transpose(1, 2).flatten(1)
            return scores.argmax(1)[None], scores[None]

    dataset = experiment.dataset()
    train, validation, _ = experiment.split()
    scenario, data = dataset.settings["scenario"], experiment.data
    users = Users(msgspec.convert(scenario, Scenario), data.users, (), data.transmitters)
    card = PolicyCard(
        observe=names,
        codebooks=(samples.beams,),
        per_user=True,
        # Those of the dataset: what it learnt says nothing of another station of the scenario.
        transmitters=users.transmitters,
        keeps_heading=users.keeps_heading,
        scenario=scenario["run"]["name"],
        algorithm=f"classification by {experiment.model.name}",
        seeds=(seed,),
        steps=epochs,
        figures={f"validation_{name}": value for name, value in figures.items()},
        versions=versions(),
        trained_on=TrainedOn(
            dataset=dataset.name,
            fingerprint=fingerprint(dataset.settings),
            episodes=ranges(sorted(train + validation)),
        ),
    )
    two = {  # places: with one, the exporter would take its number for a constant
        name: spaces.Box(-1e6, 1e6, (2 * shape[0],) if len(shape) == 1 else (2, *shape), np.float32)
        if samples.observed[name].dtype == np.float32
        else spaces.Box(
            *_bounds(samples.observed[name].dtype), (2, *shape), samples.observed[name].dtype.type
        )
        for name, shape in ((n, s) for n, s in shapes.items() if s is not None)
    }
    shared = {
        name: spaces.Box(*_bounds(values.dtype), values.shape[1:], values.dtype.type)
        for name, values in samples.observed.items()
        if shapes[name] is None
    }
    policy = Policy().eval()

    def choose(observation: Mapping[str, NDArray[Any]]) -> NDArray[np.int64]:
        with torch.no_grad():
            action, _ = policy(*(torch.from_numpy(observation[name][None]) for name in names))
        return np.ravel(action.numpy())

    usual = _usual(samples, shapes)
    made = export_module(
        policy, spaces.Dict({n: (two | shared)[n] for n in names}), file, card, choose, usual,
        outputs=(ACTION, SCORES),
        any_size={ACTION: (1,), SCORES: (1,), **dict.fromkeys(two, (1,))},
    )  # fmt: skip
    _check_any_size(file, samples)
    return made


def _check_any_size(file: Path, samples: Samples) -> None:
    """Raise `SetupError` where what a policy ranks for a user depends on how many others there are."""
    model, scene = PolicyModel(file), {name: np.array(of[0]) for name, of in samples.observed.items()}
    otherwise = 0
    try:
        together = model.ranked(scene)[:, 0]
        for place in range(samples.places):
            alone = dict(scene)
            for name, shape in samples.row_shapes.items():
                if shape is not None:
                    row = scene[name].reshape(samples.places, *shape)[place]
                    alone[name] = row if len(shape) == 1 else row[None]
            (first, *_), *others = model.ranked(alone).tolist()
            if others:
                raise ValueError(f"{1 + len(others)} rankings for one user")  # noqa: TRY301 - one remedy
            otherwise += int(first != together[place])
    except Exception as error:  # of ONNX Runtime, whose exceptions have no common base
        reason = str(error).partition("\n")[0]
        raise SetupError(
            f"the exported policy is of a number of users ({reason}); in the network write "
            "x.shape[0], and not len(x), which PyTorch's exporter takes for a constant"
        ) from error
    if otherwise > 1:  # one may be a tie
        raise SetupError(
            "the exported policy ranks other pairs for a user alone than among others; a network ranks each "
            "user by itself"
        )


def _bounds(dtype: Any) -> tuple[float, float]:
    """Of the values of sensors, over which they are drawn to hold an exported policy against its network."""
    return {"int8": (-2, 1), "uint8": (0, 255)}.get(np.dtype(dtype).name, (0.0, 100.0))


def _usual(samples: Samples, shapes: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Mean and deviation of numbers, in the shape of two places."""
    found = {}
    for name, shape in shapes.items():
        if shape is not None and len(shape) == 1:
            rows = samples.rows(name, np.arange(min(len(samples), 4096)))
            found[name] = np.tile(rows.mean(0), 2), np.tile(rows.std(0), 2)
    return found


def ranges(numbers: list[int]) -> tuple[tuple[int, int], ...]:
    """First and last of each range of numbers that follow each other.

    Args:
        numbers: In ascending order.

    Example:
        >>> ranges([0, 1, 2, 5, 7, 8])
        ((0, 2), (5, 5), (7, 8))
    """
    groups = itertools.groupby(enumerate(numbers), lambda entry: entry[1] - entry[0])
    parts = [[number for _, number in group] for _, group in groups]
    return tuple((part[0], part[-1]) for part in parts)
