"""Experiments of kind ``classification``: TOML files of what ranks the beams of a dataset's users.

>>> experiment = parse_classification('''
... [experiment]
... kind = "classification"
... name = "beams"
... seeds = [1, 2]
...
... [data]
... dataset = "data/s008"
... test = 0.2
...
... [model]
... name = "position"
... ''')
>>> experiment.observe
('position', 'departure', 'aoa')
"""

from __future__ import annotations

import hashlib
import importlib
import random
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import msgspec

from caviar_clients.datasets.reader import Dataset
from caviar_clients.learning.experiment import (
    Count,
    Experiment,
    Name,
    Positive,
    Rate,
    Rows,
    Seed,
    check_seeds,
    experiment_text,
    parse_experiment,
)
from caviar_clients.learning.networks import OBSERVED
from caviar_clients.learning.samples import Selection, dataset_key
from caviar_protocol.arrays import quantity
from caviar_protocol.errors import CaviarError, suggestion
from caviar_protocol.scenario import absolute_paths, read_toml
from caviar_protocol.scenario.conversion import Place, Source, convert_table
from caviar_services.registry import find_modules_in

KIND = "classification"
Share = Annotated[float, quantity("1", "share of the episodes", ge=0, lt=1)]


class ClassifierSubject(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table ``[experiment]``: its name, its seeds, and how long each is trained at most."""

    kind: Literal["classification"]
    name: Name
    seeds: tuple[Seed, ...]
    """Each is trained by itself, into a folder of its own. They draw weights and the order of users."""
    epochs: Count = 60
    """Passes over the users at most."""

    def __post_init__(self) -> None:
        check_seeds(self.seeds)


class DataSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table ``[data]``: users that are learned from. Parts of a dataset are whole episodes."""

    dataset: str
    """Folder or address; ``file:`` and a path that is relative to the folder of the file."""
    test: Share = 0.0
    """Part that no seed sees: for ``caviar policy evaluate --on`` this dataset. 0: another one, such as
    another city, is the test."""
    validation: Annotated[float, quantity("1", "share of the others", gt=0, lt=1)] = 0.15
    """Part of the other episodes, by whose loss training stops."""
    split_seed: Annotated[int, quantity("1", "seed", ge=0, le=2**31 - 1)] = 0
    episodes: Count | None = None
    """Of training and validation, at most: the first ones of the drawn order."""
    users: tuple[str, ...] = ("*",)
    """Receivers, as names with ``*`` and ``?``; likewise ``transmitters``."""
    transmitters: tuple[str, ...] = ("*",)
    carrier: str = ""
    """By its name; empty: the first of the scenario."""

    def selection(self) -> Selection:
        """Users that are samples."""
        return Selection(self.users, self.transmitters, self.carrier)


class LabelSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table ``[label]``: what the network's scores are held against."""

    order: Literal["tx-rx", "rx-tx"] = "tx-rx"
    """Index of a pair in the network: ``tx_beam·Nr + rx_beam``, or ``rx_beam·Nt + tx_beam`` as in the
    training data of the ITU challenge. An exported policy always has the first."""
    target: Literal["best", "amplitude", "power"] = "power"
    """``best``: the best pair alone. ``amplitude``: a distribution in proportion to |y| of the pairs that are
    within ``within_db`` of the best, as in the ITU challenge; ``power``: to |y|²."""
    within_db: Positive = 6.0
    """[dB]."""


class ModelSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table ``[model]``: the network."""

    name: str
    """``position``, ``lidar``, ``image``, ``fusion``, or ``module:Class`` of your own, a `BeamModel`
    (`caviar_clients.learning.networks`)."""
    observe: tuple[str, ...] = ()
    """Parts of the observation; empty: those that the model is called after."""
    options: Mapping[str, Any] = {}
    """Arguments of the class."""


class TrainingSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table ``[training]``: Adam with decoupled weight decay, and early stopping."""

    batch_size: Rows = 128
    learning_rate: Rate = 3e-3
    final_learning_rate: Rate = 1e-4
    """Reached after ``epochs``, in proportion to these."""
    weight_decay: Annotated[float, quantity("1", "of the weights", ge=0, le=10)] = 0.1
    patience: Count = 15
    """Epochs without a lower loss of validation after which training stops; the weights of the lowest
    stay."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """``auto``: a GPU where PyTorch has one. A training that goes on on another device is another one in its
    last bits."""


class Classification(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A supervised experiment."""

    not_in_file: ClassVar[tuple[str, ...]] = ("source", "written")

    experiment: ClassifierSubject
    data: DataSpec
    model: ModelSpec
    label: LabelSpec = LabelSpec()
    training: TrainingSpec = TrainingSpec()
    source: Source = Source()
    written: str = ""
    """The dataset as the file has it."""

    @property
    def observe(self) -> tuple[str, ...]:
        """Parts that are observed."""
        return self.model.observe or OBSERVED[self.model.name]

    def recorded(self) -> Classification:
        """The experiment without its places and with the file's own paths: the same wherever it lies."""
        data = msgspec.structs.replace(self.data, dataset=self.written or self.data.dataset)
        return msgspec.structs.replace(self, data=data, source=Source(), written="")

    def digest(self) -> str:
        """SHA-256 of what decides how a seed is trained: all but the list of seeds, and the dataset's
        content.

        Raises:
            ScenarioError: The dataset cannot be read.
        """
        subject = msgspec.structs.replace(self.experiment, seeds=(0,))
        made = msgspec.structs.replace(self.recorded(), experiment=subject)
        encoded = msgspec.json.encode(made, order="deterministic")
        return hashlib.sha256(encoded + dataset_key(self.dataset()).encode()).hexdigest()

    def dataset(self) -> Dataset:
        """The dataset, of all its episodes.

        Raises:
            ScenarioError: It cannot be read.
        """
        try:
            return Dataset(self.data.dataset)
        except CaviarError as error:
            raise self.place("data", "dataset").error(str(error)) from error

    def split(self) -> tuple[list[int], list[int], list[int]]:
        """Episodes of training, validation and test, each in ascending order.

        Raises:
            ScenarioError: A part gets no episode.
        """
        dataset, data = self.dataset(), self.data
        order = sorted(dataset.episodes)
        random.Random(data.split_seed).shuffle(order)  # noqa: S311 - no secret; it is the same on all machines
        count = round(len(order) * data.test)
        test, rest = order[:count], order[count:][: data.episodes]
        held = max(1, round(len(rest) * data.validation))
        if len(rest) <= held or (data.test and not test):
            raise self.place("data").error(
                f"{len(order)} episodes leave {len(rest) - held} to train, {min(held, len(rest))} for "
                f"validation and {len(test)} to test; generate more, or change the shares"
            )
        return sorted(rest[held:]), sorted(rest[:held]), sorted(test)

    def place(self, *names: str) -> Place:
        """Place of a key in the file."""
        place = Place("", self.source)
        for name in names:
            place = place.at(name)
        return place


def load_any_experiment(path: Path | str) -> Experiment | Classification:
    """Read and check the file of an experiment of either kind.

    Args:
        path: TOML file; ``kind`` below its ``[experiment]`` says which: ``classification``, or
            ``reinforcement``, which is meant without it.

    Raises:
        ScenarioError: The file cannot be read or breaks a rule; the text has file, line, key, value and what
            to write instead.
    """
    text, folder = experiment_text(path), Path(path).parent
    subject = read_toml(text, str(path))[0].get("experiment")
    if isinstance(subject, dict) and subject.get("kind") == KIND:
        return parse_classification(text, str(path), folder)
    return parse_experiment(text, str(path), folder)


def parse_classification(text: str, file: str = "", folder: Path | None = None) -> Classification:
    """Check a supervised experiment that is given as text.

    Args:
        text: TOML.
        file: What errors call it.
        folder: What its ``file:`` paths are relative to, and where the module of a model is looked for after
            all other places; by default the working directory.

    Raises:
        ScenarioError: It breaks a rule; the text has file, line, key, value and what to write instead.
    """
    table, source = read_toml(text, file)
    made = convert_table(Classification, table, Place("", source))
    written = made.data.dataset
    path = absolute_paths(written, folder or Path(), Place("data", source).at("dataset"))
    data = msgspec.structs.replace(made.data, dataset=path)
    made = msgspec.structs.replace(made, data=data, source=source, written=written)
    for place_of_modules in (folder or Path(), Path()):
        find_modules_in(place_of_modules)
    _check_model(made)
    return made


def _check_model(made: Classification) -> None:
    name, place = made.model.name, made.place("model", "name")
    if ":" not in name:
        if name not in OBSERVED:
            raise place.error(
                f"no model is called {name!r}; {suggestion(name, OBSERVED)} One of your own is module:Class"
            )
        return
    model_class(made)
    if not made.model.observe:
        raise made.place("model").error("lacks 'observe', the parts that a class of your own gets")


def model_class(experiment: Classification) -> Any:
    """Import the class of a model of the user's own.

    Args:
        experiment: Names it, as ``module:Class``.

    Raises:
        ScenarioError: It cannot be imported, or is no module of PyTorch.
    """
    module, _, name = experiment.model.name.partition(":")
    place = experiment.place("model", "name")
    try:
        found = getattr(importlib.import_module(module), name)
    except Exception as error:  # whatever the module of a user raises
        raise place.error(
            f"{experiment.model.name!r} cannot be imported: {type(error).__name__}: {error}; modules are "
            "looked for beside the experiment, in the current folder, among what is installed and in "
            "PYTHONPATH"
        ) from error
    from caviar_clients.learning.networks import BeamModel

    if not (isinstance(found, type) and issubclass(found, BeamModel)):
        raise place.error(
            f"{experiment.model.name!r} is no BeamModel; let it inherit from "
            "caviar_clients.learning.networks.BeamModel"
        )
    return found
