"""Experiments: TOML files of what is trained, how, and with which seeds.

>>> experiment = parse_experiment('''
... [experiment]
... name = "beams"
... seeds = [1, 2]
... steps = 50_000
...
... [environment]
... id = "caviar/BeamSelection-v0"
... members = 8
...
... [environment.options]
... scenario = "geometric"
... observe = ["position", "last_beam", "last_rate"]
...
... [algorithm]
... name = "dqn"
... gamma = 0.0
... ''')
>>> experiment.algorithm.given()
{'gamma': 0.0}

A key that does not exist is refused with file, line and the near name, as in scenarios.
"""

from __future__ import annotations

import hashlib
import importlib
import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import gymnasium
import msgspec

import caviar_clients.envs as _registered  # noqa: F401
from caviar_protocol.arrays import described, quantity
from caviar_protocol.errors import ScenarioError, suggestion
from caviar_protocol.scenario import absolute_paths, find_scenario, load_scenario, read_toml
from caviar_protocol.scenario.conversion import Place, Source, convert_table
from caviar_services.registry import find_modules_in

Count = Annotated[int, quantity("1", "whole number above 0", ge=1, le=2**40)]
Rows = Annotated[int, quantity("1", "whole number above 0", ge=1, le=2**20)]
"""Of a batch: more take all memory, or hours for one step."""
Repeats = Annotated[int, quantity("1", "whole number above 0", ge=1, le=10_000)]
Share = Annotated[float, quantity("1", "from 0 to 1", ge=0, le=1)]
Rate = Annotated[float, quantity("1", "learning rate", gt=0, le=10)]
Positive = Annotated[float, quantity("1", "above 0", gt=0)]
Seed = Annotated[int, quantity("1", "seed", ge=0, le=2**31 - 1)]
"""Of PyTorch and NumPy, which take 32 bits; those of the environment's episodes follow from it."""
Name = Annotated[
    str,
    described(
        "name of a folder: letters, digits, dots, dashes and underscores",
        min_length=1,
        max_length=64,
        pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$",
    ),
]


class Subject(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table ``[experiment]``: its name, its seeds and how long each is trained."""

    name: Name
    seeds: tuple[Seed, ...]
    """Each is trained by itself, into a folder of its own."""
    steps: Count
    """Steps of the environment, of all members together, for each seed."""
    checkpoint_steps: Count = 10_000
    """Steps between checkpoints, at least: an episode has ended between two of them. All episodes begin anew
    after each, so that a training that goes on from there is the same as one that was never interrupted."""

    def __post_init__(self) -> None:
        check_seeds(self.seeds)


def check_seeds(seeds: tuple[int, ...]) -> None:
    """Check the seeds of an experiment.

    Args:
        seeds: In the order of the file.

    Raises:
        ValueError: There is none, or one twice.
    """
    if not seeds:
        raise ValueError("seeds is empty; write at least one: seeds = [1]")
    if len(set(seeds)) != len(seeds):
        raise ValueError(f"seeds {list(seeds)} has one twice; each is trained once")


class EnvironmentSpec(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table ``[environment]``: what is learned in."""

    id: str
    """As ``gymnasium.make`` takes it: ``caviar/BeamSelection-v0``, or ``module:Name-v0`` of your own, whose
    module is imported, from the folder of the file too, and registers it."""
    members: Annotated[int, quantity("1", "environments at once", ge=1, le=4096)] = 1
    options: Mapping[str, Any] = {}
    """Arguments of the environment; a text ``file:PATH`` is a path relative to the folder of the file."""

    def spec(self) -> gymnasium.envs.registration.EnvSpec:
        """Registered entry of the environment, of whose id ``gymnasium.spec`` takes no module.

        Raises:
            ImportError: Its module cannot be imported; the text says why.
            gymnasium.error.Error: Nothing is registered by this name.
        """
        module, separator, name = self.id.rpartition(":")
        if separator:
            _import(module)
        return gymnasium.spec(name)


class _Algorithm(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="name"):
    """Keys that algorithms share. A hyper-parameter that is left out is the library's default."""

    own: ClassVar[tuple[str, ...]] = ("library", "final_learning_rate", "policy_network")

    library: Literal["stable-baselines3"] = "stable-baselines3"
    learning_rate: Rate | None = None
    final_learning_rate: Rate | None = None
    """Reached at the last step, in proportion to the steps; without it the rate stays as it is."""
    gamma: Share | None = None
    """Discount. A beam has no influence on the next channel: 0 fits beam selection."""
    max_grad_norm: Positive | None = None

    @property
    def called(self) -> str:
        """Name of the class of Stable-Baselines3."""
        return str(self.__struct_config__.tag).upper()

    def given(self) -> dict[str, Any]:
        """The hyper-parameters that the file gives, by their names in the library."""
        found = {name: getattr(self, name) for name in self.__struct_fields__ if name not in self.own}
        return {name: value for name, value in found.items() if value is not None}


class Dqn(_Algorithm, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="dqn"):
    """Deep Q network, for actions that are one choice out of some."""

    buffer_size: Count | None = None
    """Transitions that are kept; more than ``steps`` take no more memory."""
    learning_starts: Annotated[int, quantity("1", "steps", ge=0)] | None = None
    """Steps before the first that is learned from; below ``steps`` of the experiment."""
    batch_size: Rows | None = None
    tau: Share | None = None
    train_freq: Count | None = None
    gradient_steps: Annotated[int, quantity("1", "-1: as many as steps", ge=-1, le=10_000)] | None = None
    target_update_interval: Count | None = None
    exploration_fraction: Share | None = None
    exploration_initial_eps: Share | None = None
    exploration_final_eps: Share | None = None


class _OnPolicy(_Algorithm, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Keys that PPO and A2C share."""

    n_steps: Count | None = None
    gae_lambda: Share | None = None
    ent_coef: Annotated[float, quantity("1", "weight of the entropy", ge=0)] | None = None
    vf_coef: Annotated[float, quantity("1", "weight of the value", ge=0)] | None = None
    normalize_advantage: bool | None = None


class Ppo(_OnPolicy, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="ppo"):
    """Proximal policy optimization."""

    batch_size: Rows | None = None
    n_epochs: Repeats | None = None
    clip_range: Share | None = None
    clip_range_vf: Positive | None = None
    target_kl: Positive | None = None


class A2c(_OnPolicy, frozen=True, kw_only=True, forbid_unknown_fields=True, tag="a2c"):
    """Advantage actor-critic."""

    rms_prop_eps: Positive | None = None
    use_rms_prop: bool | None = None


Units = Annotated[int, quantity("1", "units of a layer", ge=1, le=2**16)]
MOST_WEIGHTS = 2**27
"""Between hidden layers: 0.5 GB, and twice as much for what the optimizer remembers."""


class Network(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table ``[network]``: of the policy; without it, that of the library."""

    layers: tuple[Units, ...] | None = None
    """Units of each hidden layer."""
    activation: Literal["relu", "tanh"] | None = None

    def __post_init__(self) -> None:
        layers = self.layers or ()
        weights = sum(a * b for a, b in pairwise(layers))
        if weights > MOST_WEIGHTS or len(layers) > 100:
            raise ValueError(
                f"layers = {list(layers)[:8]} has {len(layers)} layers, {weights:,} weights between them; "
                f"write 100 layers at most, with {MOST_WEIGHTS:,} weights"
            )


class Encoding(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Table ``[features.PART]``: what the network gets of a part x of the observation.

    z = (x − offset) / scale, and sin(kπz) and cos(kπz) of k = 1 … waves. A network of two layers can hardly
    tell two neighbouring beams of 64 apart from one number; from waves as short as a beam is wide it can.
    """

    offset: float | tuple[float, ...] = 0.0
    """One for all numbers of the part, or one for each."""
    scale: float | tuple[float, ...] = 1.0
    """Above 0; the waves repeat after twice as much."""
    waves: int | tuple[int, ...] = 0
    """From 0 to 1024."""


class Experiment(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An experiment: what is trained, how, and with which seeds."""

    not_in_file: ClassVar[tuple[str, ...]] = ("source", "written")

    experiment: Subject
    environment: EnvironmentSpec
    algorithm: Dqn | Ppo | A2c
    network: Network = Network()
    features: Mapping[str, Encoding] = {}
    """By part of the observation; what is not named goes into the network as it is."""
    source: Source = Source()
    written: Mapping[str, Any] | msgspec.UnsetType = msgspec.UNSET
    """The environment's options as the file has them, where ``file:`` paths are relative."""

    def recorded(self) -> Experiment:
        """The experiment without its places and with the file's own paths: the same wherever it lies."""
        environment = self.environment
        if not isinstance(self.written, msgspec.UnsetType):
            environment = msgspec.structs.replace(environment, options=self.written)
        return msgspec.structs.replace(self, environment=environment, source=Source(), written=msgspec.UNSET)

    def digest(self) -> str:
        """SHA-256 of what decides how a seed is trained: all but the list of seeds, and the scenario's file.

        Raises:
            ScenarioError: The scenario cannot be read, or breaks a rule.
        """
        subject = msgspec.structs.replace(self.experiment, seeds=(0,))
        made = msgspec.structs.replace(self.recorded(), experiment=subject)
        scenario = self.environment.options.get("scenario")
        content = b""
        if isinstance(scenario, str):
            try:
                load_scenario(scenario)
            except ScenarioError as error:
                raise self.place("environment", "options", "scenario").error(str(error)) from error
            content = find_scenario(scenario).read_bytes()
        encoded = msgspec.json.encode(made, order="deterministic")
        return hashlib.sha256(encoded + b"\n" + content).hexdigest()

    def place_of_option(self, message: str) -> Place:
        """Place of the option of the environment that an error is about.

        Args:
            message: Of the error. It is about an option with whose name it begins, or whose value it quotes.
        """
        options, place = self.environment.options, self.place("environment", "options")
        named = [name for name in options if re.match(rf"{re.escape(name)}(?![\w])", message)]
        quoted = [name for name, value in options.items() if any(repr(t) in message for t in _texts(value))]
        found = named or quoted
        return place.at(found[0]) if len(found) == 1 else place

    def place(self, *names: str) -> Place:
        """Place of a key in the file."""
        place = Place("", self.source)
        for name in names:
            place = place.at(name)
        return place


def _texts(value: object) -> Iterator[str]:
    """All texts of an option."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from _texts(item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _texts(item)


def experiment_text(path: Path | str) -> str:
    """Text of the file of an experiment.

    Args:
        path: TOML file.

    Raises:
        ScenarioError: It cannot be read.
    """
    try:
        return Path(path).read_bytes().decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ScenarioError(f"cannot be read: {why}; give a TOML file of an experiment", str(path)) from error


def load_experiment(path: Path | str) -> Experiment:
    """Read and check the file of an experiment of reinforcement learning.

    Args:
        path: TOML file.

    Raises:
        ScenarioError: The file cannot be read or breaks a rule; the text has file, line, key, value and what
            to write instead.
    """
    return parse_experiment(experiment_text(path), str(path), Path(path).parent)


def parse_experiment(text: str, file: str = "", folder: Path | None = None) -> Experiment:
    """Check an experiment that is given as text.

    Args:
        text: TOML.
        file: What errors call it.
        folder: What its ``file:`` paths are relative to, and where the module of an environment is looked for
            after all other places; by default the working directory.

    Raises:
        ScenarioError: As of `load_experiment`.

    Example:
        >>> try:
        ...     parse_experiment("[network]\\nlayer = [64]", "my.toml")
        ... except ScenarioError as error:
        ...     print(error)
        my.toml:2: network.layer: unknown key 'layer'; did you mean 'layers'?
    """
    table, source = read_toml(text, file)
    subject = table.get("experiment")
    if isinstance(subject, dict) and (kind := subject.pop("kind", "reinforcement")) != "reinforcement":
        known = 'write "reinforcement" or "classification"'
        raise Place("experiment", source).at("kind").error(f"is {kind!r}, {known}")
    made = convert_table(Experiment, table, Place("", source))
    place = Place("environment", source).at("options")
    options = absolute_paths(dict(made.environment.options), folder or Path(), place)
    environment, written = (
        msgspec.structs.replace(made.environment, options=options),
        made.environment.options,
    )
    made = msgspec.structs.replace(made, environment=environment, source=source, written=written)
    for place_of_modules in (folder or Path(), Path()):  # processes started from here look there, too
        find_modules_in(place_of_modules)
    _check_options(made)
    _check_steps(made)
    _check_encodings(made)
    return made


def _check_options(experiment: Experiment) -> None:
    """Refuse an environment that does not exist, and options that it does not take."""
    place, given = experiment.place("environment"), experiment.environment.options
    try:
        spec = experiment.environment.spec()
    except ImportError as error:
        raise place.at("id").error(str(error)) from error
    except gymnasium.error.Error as error:
        module, separator, name = experiment.environment.id.rpartition(":")
        registered = [one.id for one in gymnasium.registry.values() if _is_of(one, module)]
        registered = registered or [one for one in gymnasium.registry if one.startswith("caviar/")]
        where = (
            f"module {module!r} registers no environment {name!r}"
            if separator
            else (f"no environment is called {name!r}")
        )
        raise place.at("id").error(f"{where}; {suggestion(name, registered)}") from error
    known, takes_any = _arguments(spec.entry_point)
    for name in given:
        if name not in known and not takes_any:
            raise place.at("options").at(name).error(f"unknown option {name!r}; {suggestion(name, known)}")
    for name, is_required in known.items():
        if is_required and name not in given:
            raise place.at("options").error(f"lacks {name!r}, which {experiment.environment.id} needs")


def _check_steps(experiment: Experiment) -> None:
    """Refuse what needs more steps than are trained: nothing would be learned."""
    steps, algorithm = experiment.experiment.steps, experiment.algorithm
    if experiment.environment.members > steps:
        raise experiment.place("environment", "members").error(
            f"is {experiment.environment.members}, and {steps} steps of all members together are trained; "
            "write fewer, or more steps below [experiment]"
        )
    for name in ("learning_starts", "train_freq", "n_steps"):
        value = getattr(algorithm, name, None)
        # The first steps that are learned from are the one after.
        if value is not None and value > steps - (name == "learning_starts"):
            raise experiment.place("algorithm", name).error(
                f"is {value}, and {steps} steps are trained: nothing would be learned; write a smaller "
                "number, or more steps below [experiment]"
            )


# By key of an encoding: what each of its numbers fulfils, and what to write. The network computes with 32
# bits, of which the least positive number is about 1e-38.
_ENCODINGS: dict[str, tuple[Callable[[float], bool], str]] = {
    "scale": (lambda value: 1e-30 <= value <= 1e30, "write numbers > 0, from 1e-30 to 1e30"),
    "offset": (lambda value: abs(value) <= 1e30, "write finite numbers"),
    "waves": (lambda value: 0 <= value <= 1024, "write whole numbers from 0 to 1024"),
}


def _check_encodings(experiment: Experiment) -> None:
    for name, encoding in experiment.features.items():
        for key, (is_right, remedy) in _ENCODINGS.items():
            given = getattr(encoding, key)
            if not all(map(is_right, given if isinstance(given, tuple) else (given,))):
                raise experiment.place("features", name, key).error(f"is {given}, {remedy}")


def _import(module: str) -> None:
    """Import the module of an environment.

    Raises:
        ImportError: That fails; the text says why.
    """
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise ImportError(
            f"module {module!r} cannot be imported: {error}; modules are looked for beside the "
            "experiment, in the current folder, among what is installed and in PYTHONPATH"
        ) from error
    except Exception as error:  # whatever the module of a user raises, or a name that is none
        raise ImportError(
            f"module {module!r} cannot be imported: {type(error).__name__}: {error}; write "
            "module:Name-v0, and look whether python -c 'import MODULE' succeeds"
        ) from error


def _is_of(spec: gymnasium.envs.registration.EnvSpec, module: str) -> bool:
    """Check whether an environment is defined in a module, or in one below it."""
    made = spec.entry_point
    name = made.partition(":")[0] if isinstance(made, str) else getattr(made, "__module__", None)
    if not name:  # a function made from text belongs to none
        return False
    return name == module or name.startswith(f"{module}.")


_NOT_OPTIONS = ("self", "render_mode", "num_envs")


def _arguments(entry_point: Any) -> tuple[dict[str, bool], bool]:
    """Arguments of an environment, and whether each is required; and whether it takes any other, too."""
    made = (
        gymnasium.envs.registration.load_env_creator(entry_point)
        if isinstance(entry_point, str)
        else entry_point
    )
    inits = (
        [vars(cls)["__init__"] for cls in inspect.getmro(made) if "__init__" in vars(cls)]
        if inspect.isclass(made)
        else [made]
    )
    found: dict[str, bool] = {}
    for init in inits:
        parameters = inspect.signature(init).parameters.values()
        for parameter in parameters:
            if (
                parameter.kind not in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
                and parameter.name not in _NOT_OPTIONS
            ):
                found.setdefault(parameter.name, parameter.default is parameter.empty)
        # Others go on to the base class, where there is a place for them.
        if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
            return found, False
    return found, True
