"""The training of one seed of an experiment: chunk by chunk, each from one checkpoint to the next.

A chunk is a function of its checkpoint and its number alone: all random numbers begin anew with a seed that
follows from both, and so do the episodes. A training that goes on after Ctrl-C or a kill is therefore the
same, step by step, as one that was never interrupted.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache, partial
from pathlib import Path
from typing import Any

import gymnasium
import msgspec
import numpy as np

from caviar_clients.files import writing
from caviar_clients.learning import features
from caviar_clients.learning.checkpoints import (
    load_checkpoint,
    locked,
    newest_checkpoint,
    save_checkpoint,
)
from caviar_clients.learning.experiment import Dqn, Experiment
from caviar_clients.learning.export import BeamEnv, export_policy
from caviar_clients.learning.features import check_encodings
from caviar_clients.learning.vec_env import stable_baselines3_env
from caviar_protocol.errors import CaviarError, RunError, ScenarioError, SetupError
from caviar_protocol.files import replace_file
from caviar_protocol.host import install_command

RESULT, POLICY, MODEL, CURVES, CHECKPOINTS = (
    "result.json",
    "policy.onnx",
    "model.zip",
    "curves",
    "checkpoints",
)
"""Files and folders of a seed."""
LOWEST_SEED = 2**30
"""Episodes of training have seeds from here on: lower ones are free for evaluation."""
REPORT_S = 0.2
"""[s] between reports of progress, at least."""
PATIENCE_S = 3.0
"""[s] that the process before has to end in, before its seed counts as being trained."""


class SeedResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of the training of one seed: its file `RESULT`."""

    seed: int
    steps: int
    digest: str
    """Of the experiment (`Experiment.digest`)."""
    seconds: float
    """Of training, interruptions left out."""
    mean_reward: float | None = None
    """Sum of rewards of an episode, the mean over the last hundred; None: no episode came to its end."""
    policy: str | None = None
    """SHA-256 of `POLICY`; None: the environment's actions are no beams, or it observes what no agent of a
    run can, and there is none."""
    figures: Mapping[str, float] = {}
    """Of a classifier on the episodes of validation, by name; ``steps`` are then epochs."""


class Progress(msgspec.Struct, frozen=True, kw_only=True):
    """Progress of the training of a seed."""

    seed: int
    steps: int
    total: int
    """Steps that it is trained, whole rollouts: at least those of the experiment."""
    rollout: int = 0
    """Steps of all members together from which an algorithm learns at once; 0: not known, as all is done."""
    mean_reward: float | None = None
    figures: Mapping[str, float] = {}
    """As of `SeedResult`."""


def seed_folder(folder: Path, seed: int) -> Path:
    """Folder of a seed in that of its experiment."""
    return folder / f"seed-{seed}"


def read_result(folder: Path, seed: int) -> SeedResult | None:
    """Read what the training of a seed led to.

    Args:
        folder: Of the experiment.
        seed: One of its seeds.

    Returns:
        None where the training has not come to its end.

    Raises:
        RunError: The file is damaged, or of another seed.
    """
    file = seed_folder(folder, seed) / RESULT
    try:
        found = msgspec.json.decode(file.read_bytes(), type=SeedResult)
    except FileNotFoundError:
        return None
    except (OSError, msgspec.DecodeError) as error:
        raise RunError(f"{file} cannot be read: {error}; remove it to train this seed again") from error
    if found.seed != seed:
        raise RunError(f"{file} is of seed {found.seed}; remove it to train seed {seed}")
    return found


def make_envs(experiment: Experiment) -> Any:
    """Make the environments of an experiment.

    Args:
        experiment: Says which, and how many.

    Returns:
        A ``VecEnv`` of Stable-Baselines3: computed together where the environment can be, one after the other
        where not.

    Raises:
        ScenarioError: The environment does not take these options; the text has file and line.
        SetupError: Stable-Baselines3 is not installed.
    """
    _require()
    from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

    environment, place = experiment.environment, experiment.place("environment", "options")
    options = dict(environment.options)
    spec = environment.spec()
    envs: Any = None
    try:
        if environment.members > 1 and spec.vector_entry_point is not None:
            try:
                together = gymnasium.make_vec(
                    environment.id, environment.members, autoreset_mode="SameStep", **options
                )
                envs = stable_baselines3_env(together)
            except (ScenarioError, TypeError):  # those of gymnasium begin episodes in their own way
                envs = None  # what is wrong with the options is wrong with a single one, too
        if envs is None:
            envs = DummyVecEnv([lambda: gymnasium.make(environment.id, **options)] * environment.members)
    except CaviarError as error:
        if isinstance(error, ScenarioError) and error.file:
            raise
        raise experiment.place_of_option(str(error)).error(str(error)) from error
    except TypeError as error:
        raise place.error(f"{environment.id} does not take them: {error}") from error
    place = experiment.place("features")
    check_encodings(envs.observation_space, experiment.features, place, partial(_other_users, experiment))
    return VecMonitor(envs)


def _other_users(experiment: Experiment, given: int, size: int) -> str:
    """Say what to write where the encoding of a part is of fewer users than the environment has."""
    remedy = "write one for all, or one for each"
    made = gymnasium.make(experiment.environment.id, **experiment.environment.options).unwrapped
    count = len(made.users) if isinstance(made, BeamEnv) else 1
    made.close()
    if not isinstance(made, BeamEnv) or count == 1 or size % count or given == size:
        return remedy
    names = made.users.receivers
    fewer = next((name for name in names if "*" not in name), names[0])
    return (
        f"{size // count} for each of {count} users. Choose these by the option `users` below "
        f'[environment.options], as users = ["{fewer}"] of {", ".join(names)}; or {remedy}'
    )


def train_seed(
    experiment: Experiment,
    seed: int,
    folder: Path,
    report: Callable[[Progress], None] = lambda progress: None,
) -> SeedResult:
    """Train one seed, or go on with it, to its end.

    Args:
        experiment: What is trained.
        seed: One of its seeds.
        folder: Of the experiment.
        report: Called with the progress, a few times a second.

    Returns:
        What it led to; the same at once where it was done before.

    Raises:
        ScenarioError: Environment or algorithm do not go with the options; the text has file and line.
        RunError: Another process trains this seed, the disk refuses, or a checkpoint is damaged.
        SetupError: The extra ``learning`` is not installed.

    Example:
        >>> from caviar_clients.learning.experiment import parse_experiment
        >>> experiment = parse_experiment('''
        ... experiment = { name = "beams", seeds = [1], steps = 200 }
        ... environment = { id = "caviar/BeamSelection-v0", options = { scenario = "geometric" } }
        ... algorithm = { name = "dqn", gamma = 0.0 }
        ... ''')
        >>> result = train_seed(experiment, 1, Path("training/beams"))
        >>> result.steps, Path("training/beams/seed-1/policy.onnx").is_file()
        (200, True)
    """
    mine = seed_folder(folder, seed)
    with writing(mine / RESULT):
        mine.mkdir(parents=True, exist_ok=True)
    with locked(mine / "lock", f"seed {seed}", PATIENCE_S):
        done = read_result(folder, seed)
        return _train(experiment, seed, mine, report) if done is None else done


def _train(experiment: Experiment, seed: int, mine: Path, report: Callable[[Progress], None]) -> SeedResult:
    _require()
    import torch

    torch.set_num_threads(1)  # sums in one order; and a small network is not worth the waiting of several
    total = experiment.experiment.steps
    envs = make_envs(experiment)
    try:
        newest = newest_checkpoint(mine / CHECKPOINTS)
        model = _new_model(experiment, envs, _chunk_seed(seed, 0))
        if newest is not None:
            load_checkpoint(newest, model)
        report(_progress(model, seed, total))
        with curves(mine / CURVES, purge_step=model.num_timesteps or None) as logger:
            model.set_logger(logger)
            callback = _reporting(lambda: report(_progress(model, seed, total)))
            while model.num_timesteps < total:
                with _explained(model, seed):
                    _train_chunk(model, total, seed, callback)
                save_checkpoint(mine / CHECKPOINTS, model)
        report(_progress(model, seed, total))
        with writing(mine / MODEL):
            model.save(mine / MODEL)
        policy = _export(experiment, model, mine / POLICY, seed)
    finally:
        envs.close()
    result = SeedResult(
        seed=seed,
        steps=model.num_timesteps,
        digest=experiment.digest(),
        seconds=model.trained_s,
        mean_reward=_mean_reward(model),
        policy=policy,
    )
    with writing(mine / RESULT):
        replace_file(mine / RESULT, msgspec.json.format(msgspec.json.encode(result), indent=2) + b"\n")
    return result


def _train_chunk(model: Any, total: int, seed: int, callback: Any) -> None:
    """Train up to the next checkpoint, with random numbers and episodes of the chunk's own."""
    began = time.monotonic()
    model.chunk_end, model.episodes_in_chunk = model.num_timesteps + model.checkpoint_steps, 0
    model.set_random_seed(_chunk_seed(seed, model.num_timesteps))  # of the environments, too
    model._last_obs = None  # so that the next episodes begin
    every = inspect.signature(model.learn).parameters["log_interval"].default
    model.learn(total - model.num_timesteps, callback, log_interval=every, reset_num_timesteps=False)
    model.trained_s += time.monotonic() - began


@contextmanager
def _explained(model: Any, seed: int) -> Iterator[None]:
    """Say why a chunk cannot be trained: no memory, or a network that has diverged."""
    import torch

    failed: Exception | None = None
    try:
        yield
    except (MemoryError, RuntimeError, ValueError) as error:
        if isinstance(error, MemoryError) or "allocate memory" in str(error):
            raise RunError(
                f"seed {seed} needs more memory than there is, at step {model.num_timesteps:,}: {error}; "
                "write a smaller batch_size, n_steps or buffer_size below [algorithm]"
            ) from error
        failed = error
    # PPO and A2C fail on what is no number; DQN goes on with it in silence.
    if not all(bool(torch.isfinite(values).all()) for values in model.policy.parameters()):
        raise RunError(
            f"seed {seed} has diverged: weights of its network are not finite after step "
            f"{model.num_timesteps:,}. The checkpoint before it stays. Give an experiment of another name a "
            "smaller learning_rate or max_grad_norm, or features and rewards of about 1"
        ) from failed
    if failed is not None:
        raise failed


def _chunk_seed(seed: int, steps: int) -> int:
    """Seed of the chunk that begins after so many steps: 31 bits, of which the highest is set."""
    (word,) = np.random.SeedSequence([seed, steps]).generate_state(1)
    return LOWEST_SEED + int(word) % LOWEST_SEED


# --- the model ------------------------------------------------------------------------------------------


def _require() -> None:
    try:
        import onnx  # noqa: F401
        import stable_baselines3  # noqa: F401
    except ImportError as error:
        raise SetupError(f"training needs {error.name}; run: {install_command('learning')}") from error


@cache
def _resumable(called: str) -> Any:
    """An algorithm that stops training where the chunk is over."""
    import stable_baselines3
    from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
    from stable_baselines3.common.type_aliases import RolloutReturn

    algorithm = getattr(stable_baselines3, called)
    stopped = (
        RolloutReturn(0, 0, continue_training=False) if issubclass(algorithm, OffPolicyAlgorithm) else False
    )

    class Resumable(algorithm):  # type: ignore[misc,valid-type]  # Stable-Baselines3 is not looked at
        """The algorithm, and what is saved with it."""

        checkpoint_steps = 0
        chunk_end = 0
        """Steps from which on the chunk is over when an episode has ended in it: the members of a batch may
        take more steps to the end of an episode than a chunk has, and no chunk may stop short of what comes
        late in an episode."""
        episodes_in_chunk = 0
        trained_s = 0.0
        """Of all processes that trained it [s]."""

        def collect_rollouts(self, *args: Any, **options: Any) -> Any:
            # Here all that was collected is stored and trained on, which no callback sees.
            if self.num_timesteps >= self.chunk_end and self.episodes_in_chunk:
                return stopped
            return super().collect_rollouts(*args, **options)

    return Resumable


class LinearRate:
    """A learning rate that falls in proportion to the steps.

    Args:
        first: At the beginning.
        last: At the end.

    Example:
        >>> LinearRate(1e-3, 0.0)(0.25)  # with a quarter of the steps left
        0.00025
    """

    def __init__(self, first: float, last: float) -> None:
        self.first, self.last = first, last

    def __call__(self, remaining: float) -> float:
        return self.last + (self.first - self.last) * remaining


def _new_model(experiment: Experiment, envs: Any, seed: int) -> Any:
    from torch import nn

    algorithm, network = experiment.algorithm, experiment.network
    cls, given, kwargs = _resumable(algorithm.called), algorithm.given(), dict[str, Any]()
    defaults = {name: p.default for name, p in inspect.signature(cls.__init__).parameters.items()}
    if algorithm.final_learning_rate is not None:
        rate = given.get("learning_rate", defaults["learning_rate"])
        given["learning_rate"] = LinearRate(rate, algorithm.final_learning_rate)
    if isinstance(algorithm, Dqn):
        # The memory of a buffer is taken at once; more than all steps are never in it.
        most = experiment.experiment.steps + experiment.environment.members
        given["buffer_size"] = min(given.get("buffer_size", defaults["buffer_size"]), most)
    if network.layers is not None:
        kwargs["net_arch"] = list(network.layers)
    if network.activation is not None:
        kwargs["activation_fn"] = {"relu": nn.ReLU, "tanh": nn.Tanh}[network.activation]
    if experiment.features:
        kwargs["features_extractor_class"] = features.EncodedParts
        kwargs["features_extractor_kwargs"] = {"encodings": dict(experiment.features)}
    policy = "MultiInputPolicy" if isinstance(envs.observation_space, gymnasium.spaces.Dict) else "MlpPolicy"
    try:
        model = cls(policy, envs, seed=seed, device="cpu", policy_kwargs=kwargs, **given)
    except (AssertionError, ValueError, MemoryError) as error:  # as the library refuses spaces and values
        raise experiment.place("algorithm").error(
            f"{algorithm.called} of Stable-Baselines3 does not take this: {error}"
        ) from error
    model.checkpoint_steps = experiment.experiment.checkpoint_steps
    return model


def _export(experiment: Experiment, model: Any, file: Path, seed: int) -> str | None:
    """Export the policy where its actions are beams, and all it observes are parts that the agent ``policy``
    can observe; returns the SHA-256 of the file."""
    made = gymnasium.make(experiment.environment.id, **experiment.environment.options).unwrapped
    # An environment of the user's own may be a wrapper, which observes or decides something else.
    learnt = model.observation_space, model.action_space
    if not isinstance(made, BeamEnv) or learnt != (made.observation_space, made.action_space):
        return None
    mean_reward = _mean_reward(model)
    export_policy(
        model,
        made,
        file,
        algorithm=f"Stable-Baselines3 {experiment.algorithm.called}",
        steps=int(model.num_timesteps),
        seeds=(seed,),
        figures={} if mean_reward is None else {"mean_reward": mean_reward},
    )
    return hashlib.sha256(file.read_bytes()).hexdigest()


# --- reports while it trains ------------------------------------------------------------------------------


def _progress(model: Any, seed: int, asked: int) -> Progress:
    frequency = model.train_freq.frequency if hasattr(model, "train_freq") else model.n_steps
    rollout = frequency * model.n_envs
    return Progress(
        seed=seed,
        steps=int(model.num_timesteps),
        total=-(-asked // rollout) * rollout,
        rollout=rollout,
        mean_reward=_mean_reward(model),
    )


def _mean_reward(model: Any) -> float | None:
    ended = model.ep_info_buffer
    return float(np.mean([float(episode["r"]) for episode in ended])) if ended else None


@contextmanager
def curves(folder: Path, purge_step: int | None) -> Iterator[Any]:
    """Make a logger of Stable-Baselines3 that writes a file of events, which TensorBoard shows as curves.

    Args:
        folder: Where the file is made.
        purge_step: TensorBoard drops numbers of older files from this step on: a training that goes on from
            a checkpoint takes the steps after it once more. None: it keeps all.

    Raises:
        RunError: The file cannot be written, also later, as on a disk that is full.
    """
    from stable_baselines3.common.logger import KVWriter, Logger
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event, SessionLog
    from tensorboardX.proto.summary_pb2 import Summary

    with writing(folder / "events"):  # two files of one second and machine differ by the process
        events = EventsWriter(str(folder / "events"), f".{os.getpid()}.0")

    def put(**fields: Any) -> None:
        # `SummaryWriter` would write in a thread of its own, and lose what that thread fails with.
        with writing(folder / "events"):
            events.write_event(Event(wall_time=time.time(), **fields))
            events.flush()  # so that curves are seen while the training goes on

    class Curves(KVWriter):  # type: ignore[misc]  # Stable-Baselines3 is not looked at
        """Writes the numbers of a training."""

        def write(
            self, key_values: Mapping[str, Any], key_excluded: Mapping[str, Any], step: int = 0
        ) -> None:
            kept = [
                Summary.Value(tag=key, simple_value=float(value))
                for key, value in key_values.items()
                if isinstance(value, int | float | np.number)
                and "tensorboard" not in (key_excluded[key] or ())
            ]
            if kept:
                put(step=step, summary=Summary(value=kept))

        def close(self) -> None:
            """The training that made the file closes it."""

    if purge_step is not None:
        put(step=purge_step, session_log=SessionLog(status=SessionLog.START))
    try:
        yield Logger(folder=None, output_formats=[Curves()])
    finally:
        events.close()


_BEAMS = {"abs_y": "beams/abs_y", "baseline_abs_y": "beams/los_beam", "best_abs_y": "beams/optimum"}


def _reporting(report: Callable[[], None]) -> Any:
    """A callback of Stable-Baselines3: tells the progress, and has |y| among the curves."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Reporting(BaseCallback):  # type: ignore[misc]  # Stable-Baselines3 is not looked at
        """Called after every step of the environments."""

        told = 0.0

        def _on_step(self) -> bool:
            infos = self.locals["infos"]
            self.model.episodes_in_chunk += int(np.sum(self.locals["dones"]))
            if _BEAMS.keys() <= infos[0].keys():
                for name, curve in _BEAMS.items():
                    self.logger.record_mean(curve, float(np.mean([info[name] for info in infos])))
            now = time.monotonic()
            if now - self.told >= REPORT_S:
                self.told = now
                report()
            return True

    return Reporting()
