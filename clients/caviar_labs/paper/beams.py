"""``caviar paper beams``: beam selection learnt from a generated dataset, beside published figures.

Networks of several seeds rank the pairs of beams by position, by LIDAR and by both
(`caviar_clients.learning`), each trained with all episodes of training and with shares of them. They are
judged on episodes of the dataset that none was trained on, and on another city. What a call has done already
is not done again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from caviar_clients.datasets.generate import Outcome, generate
from caviar_clients.datasets.plan import PRESETS, apply_preset, plan_dataset
from caviar_clients.datasets.reader import Dataset
from caviar_clients.files import write_file
from caviar_clients.learning.campaign import train_experiments
from caviar_clients.learning.classification import Classification, parse_classification
from caviar_clients.learning.dataset_evaluation import DatasetEvaluation, evaluate_on_dataset
from caviar_clients.learning.training import POLICY, Progress, read_result, seed_folder
from caviar_protocol.errors import RunError
from caviar_protocol.scenario import load_scenario, shipped_scenarios

MODELS = ("position", "lidar", "fusion")
"""Networks that are compared."""
SHARES = (8, 4, 2, 1)
"""Parts of the episodes of training, as one over these, of the learning curve."""
CITIES = ("district", "district-b")
"""Scenarios of both cities, of which data are generated where none are given."""
PRESET = "s008"
TEST = 0.2
"""Share of the episodes that no network is trained on."""
EPOCHS = 60
_QUICK_EPOCHS = 12

_SECONDS = {"position": 0.4, "lidar": 2.0, "fusion": 2.2}
"""Of training on a thousand users for the whole, relative to each other: for the time left."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Data and trainings of the experiment."""

    folder: Path
    """Of experiments and trainings, and of data that are generated."""
    data: Path | None = None
    """Dataset with topics ``scene``, ``channel`` and ``lidar``; None: it is generated."""
    other: Path | None = None
    """Of another city; None: generated where ``data`` is, else none."""
    episodes: int = PRESETS[PRESET].episodes
    """Of each dataset that is generated."""
    seeds: int = 5
    """Of training: 1, 2, …"""
    epochs: int = EPOCHS
    models: tuple[str, ...] = MODELS
    """The first is what the others are compared with."""
    shares: tuple[int, ...] = SHARES
    jobs: int = 1
    """Trainings at a time."""

    def quick(self) -> Settings:
        """The same in a form of a few minutes, of which little can be concluded."""
        return replace(
            self,
            seeds=min(self.seeds, 2),
            epochs=_QUICK_EPOCHS,
            shares=(4, 1),
            episodes=min(self.episodes, 60),
        )


@dataclass(frozen=True)
class Report:
    """Results of the experiment."""

    held_out: DatasetEvaluation
    """On episodes of the dataset that no network was trained on; methods are named by `experiment_name`."""
    other: DatasetEvaluation | None
    """On the other city, of networks that were trained on all episodes of training."""
    scenes: Mapping[int, int]
    """Scenes of training and validation by share."""
    parameters: Mapping[str, int]
    """Of each network."""
    models: tuple[str, ...]
    """Networks, the first of which the others are compared with."""
    seconds: Mapping[str, float]
    """Of the training of a seed on all episodes, the mean over seeds."""
    seeds: int


def experiment_name(model: str, share: int) -> str:
    """Name of the experiment of a network and a share of the episodes.

    Args:
        model: One of `MODELS`.
        share: One of `SHARES`.

    Example:
        >>> experiment_name("lidar", 1), experiment_name("lidar", 4)
        ('lidar', 'lidar-of-4')
    """
    return model if share == 1 else f"{model}-of-{share}"


def experiment(
    settings: Settings, progress: Callable[[str, float], None] = lambda what, share: None
) -> Report:
    """Generate, train and judge what is not there yet.

    Args:
        settings: What.
        progress: Called with what is done, and the share of the expected time that has passed, of each of
            generation and the rest.

    Returns:
        Figures of all networks and baselines.

    Raises:
        RunError: The folder was begun with other values, or episodes cannot be generated.
        ScenarioError: A dataset lacks what is observed, or has too few episodes.
        SetupError: The extra ``learning`` is not installed.
    """
    data, other = settings.data, settings.other
    if data is None:
        for name in CITIES:
            if name not in shipped_scenarios():
                raise RunError(f"there is no scenario {name!r} to generate from; name a dataset with --data")
        made = [settings.folder / f"data-{name}" for name in CITIES]
        for folder, name in zip(made, CITIES, strict=True):
            _generate(folder, name, settings.episodes, progress)
        data, other = made[0], other or made[1]
    whole = Dataset(data)
    count = len(whole) - round(len(whole) * TEST)
    experiments = {
        (model, share): _written(settings, data, model, share, -(-count // share))
        for share in settings.shares
        for model in settings.models
    }
    root = settings.folder / "training"
    _train(experiments, root, settings, progress)
    files = {
        key: [seed_folder(root / one.experiment.name, seed) / POLICY for seed in one.experiment.seeds]
        for key, one in experiments.items()
    }
    held_out = evaluate_on_dataset(
        [file for of in files.values() for file in of],
        data,
        report=lambda what, share: progress(what, 0.8 + 0.1 * share),
    )
    elsewhere = None
    if other is not None:
        elsewhere = evaluate_on_dataset(
            [file for (_, share), of in files.items() if share == 1 for file in of],
            other,
            data,
            report=lambda what, share: progress(what, 0.9 + 0.1 * share),
        )
    whole_runs = {model: experiments[model, 1] for model in settings.models}
    return Report(
        models=settings.models,
        held_out=held_out,
        other=elsewhere,
        scenes={share: _scenes(whole, experiments[settings.models[0], share]) for share in settings.shares},
        parameters={model: _parameters(root, one) for model, one in whole_runs.items()},
        seconds={model: _seconds(root, one) for model, one in whole_runs.items()},
        seeds=settings.seeds,
    )


class _Silent:
    """Tells of a generation how much of it is done."""

    def __init__(self, what: str, progress: Callable[[str, float], None], episodes: int) -> None:
        self._what, self._progress, self._left, self._done = what, progress, episodes, 0

    def note(self, text: str) -> None:
        """Nothing is shown."""

    def traffic(self, now_s: float, end_s: float) -> None:
        self._progress(f"{self._what}: traffic", 0.0)

    def tried(self, done: int, of: int, phase: str) -> None:
        """Nothing is shown."""

    def estimated(self, found: object, free: int | None, episodes: int, workers: int) -> None:
        self._left = max(episodes, 1)

    def returned(self) -> None:
        """Nothing is shown."""

    def ended(self, result: object) -> None:
        self._done += 1
        self._progress(f"{self._what}: {self._done:,} of {self._left:,} episodes", self._done / self._left)


def _generate(folder: Path, city: str, episodes: int, progress: Callable[[str, float], None]) -> None:
    scenario = apply_preset(PRESETS[PRESET], load_scenario(city))
    observer = _Silent(f"{PRESET} of {city}", progress, episodes)
    outcome: Outcome = generate(plan_dataset(scenario, episodes=episodes), folder, observer)
    if outcome.failed:
        number, error = next(iter(outcome.failed.items()))
        raise RunError(
            f"{len(outcome.failed)} episodes of {folder} failed, the first is {number}: {error}; the same "
            "command tries them again"
        )


def _written(settings: Settings, data: Path, model: str, share: int, episodes: int) -> Classification:
    """Write the file of an experiment, and read it."""
    name = experiment_name(model, share)
    text = f"""# Trained by caviar paper beams; caviar policy train takes a copy of it.
[experiment]
kind = "classification"
name = "{name}"
seeds = {list(range(1, settings.seeds + 1))}
epochs = {settings.epochs}

[data]
dataset = "{data.resolve()}"
test = {TEST}
episodes = {episodes}

[model]
name = "{model}"
"""
    file = settings.folder / f"{name}.toml"
    write_file(file, text)
    return parse_classification(text, str(file), settings.folder)


def _train(
    experiments: Mapping[tuple[str, int], Classification],
    root: Path,
    settings: Settings,
    progress: Callable[[str, float], None],
) -> None:
    weight = {
        (one.experiment.name, seed): _SECONDS[model] / share
        for (model, share), one in experiments.items()
        for seed in one.experiment.seeds
    }
    done = dict.fromkeys(weight, 0.0)
    for one in experiments.values():
        for seed in one.experiment.seeds:
            done[one.experiment.name, seed] = float(read_result(root / one.experiment.name, seed) is not None)

    def report(name: str, now: Progress) -> None:
        done[name, now.seed] = min(1.0, now.steps / now.total)
        share = sum(weight[key] * done[key] for key in weight) / sum(weight.values())
        progress(f"{name}, seed {now.seed}", 0.8 * share)

    # The longest first: at the end no core waits for another one.
    ordered = sorted(experiments.items(), key=lambda entry: -_SECONDS[entry[0][0]] / entry[0][1])
    train_experiments([one for _, one in ordered], root, settings.jobs, report)


def _scenes(dataset: Dataset, one: Classification) -> int:
    train, validation, _ = one.split()
    table = dataset.select(sorted(train + validation)).table("episodes")
    return int(table["scenes"].sum())


def _parameters(root: Path, one: Classification) -> int:
    import torch

    from caviar_clients.learning.supervised import MODEL

    file = seed_folder(root / one.experiment.name, one.experiment.seeds[0]) / MODEL
    weights = torch.load(file, weights_only=True)
    # Buffers, of which the names say what they are, are no parameters.
    constant = ("offset", "scale", "waves")
    return sum(v.numel() for name, v in weights.items() if name.rpartition(".")[2] not in constant)


def _seconds(root: Path, one: Classification) -> float:
    found = [read_result(root / one.experiment.name, seed) for seed in one.experiment.seeds]
    times = [result.seconds for result in found if result is not None]
    return sum(times) / len(times)
