"""All seeds of experiments, several at a time, each in a process of its own; and an experiment's folder.

The folder has what the experiment was begun with, and a folder for each seed
(`caviar_clients.learning.training`). A second call goes on where the first one ended, however it ended.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import shutil
import signal
import warnings
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from difflib import get_close_matches
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import msgspec

from caviar_clients.files import writing
from caviar_clients.learning.checkpoints import locked, newest_checkpoint
from caviar_clients.learning.classification import Classification
from caviar_clients.learning.experiment import Experiment
from caviar_clients.learning.supervised import train_classifier
from caviar_clients.learning.training import (
    CHECKPOINTS,
    Progress,
    SeedResult,
    read_result,
    seed_folder,
    train_seed,
)
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.files import replace_file
from caviar_protocol.host import start_process

AnyExperiment: TypeAlias = Experiment | Classification
RECORD = "experiment.json"
"""What the folder was begun with."""
_LOCK = "lock"
_GOODBYE_S = 5.0


class _Record(msgspec.Struct, frozen=True):
    digest: str
    experiment: dict[str, Any]


def train_experiment(
    experiment: AnyExperiment,
    root: Path,
    jobs: int = 1,
    report: Callable[[Progress], None] = lambda progress: None,
) -> list[SeedResult]:
    """Train all seeds of an experiment, or go on with those that are left.

    Args:
        experiment: What is trained.
        root: Folder in which that of the experiment is made.
        jobs: Seeds at a time. 1: in this process; else each in a process of its own.
        report: Called with the progress of each seed, a few times a second.

    Returns:
        What each seed led to, in the order of the experiment.

    Raises:
        RunError: The folder was begun with other values, or a seed failed; the text says which.
        ScenarioError: Environment or algorithm do not go with the options.
        SetupError: The extra ``learning`` is not installed.
    """
    (found,) = train_experiments([experiment], root, jobs, lambda _, progress: report(progress))
    return found


def train_experiments(
    experiments: Sequence[AnyExperiment],
    root: Path,
    jobs: int = 1,
    report: Callable[[str, Progress], None] = lambda name, progress: None,
    keep_checkpoints: bool = True,
) -> list[list[SeedResult]]:
    """Train all seeds of several experiments, or go on with those that are left.

    Args:
        experiments: What is trained, in this order: the first seed of each, then the second ones, so that
            a training that is stopped has as many seeds of each as there was time for.
        root: Folder in which those of the experiments are made.
        jobs: Seeds at a time, of whatever experiments. 1: in this process; else each in a process of its own.
        report: Called with the name of an experiment and the progress of a seed, a few times a second.
        keep_checkpoints: Whether the last checkpoint of a seed stays when its policy is there; it has the
            replay buffer, some 30 MB.

    Returns:
        What each seed led to, by experiment, in the order of its seeds.

    Raises:
        RunError: A folder was begun with other values, or a seed failed; the text says which.
        ScenarioError: Environment or algorithm do not go with the options.
        SetupError: The extra ``learning`` is not installed.
    """
    left: list[_Training] = []

    def done(training: _Training) -> None:
        if not keep_checkpoints:
            shutil.rmtree(seed_folder(training.folder, training.seed) / CHECKPOINTS, ignore_errors=True)

    stepped: set[str] = set()

    def tell(name: str, progress: Progress) -> None:
        if progress.steps:
            stepped.add(name)
        report(name, progress)

    with ExitStack() as stack:
        for experiment in experiments:
            folder, subject = stack.enter_context(_held(experiment, root, stepped)), experiment.experiment
            for index, seed in enumerate(subject.seeds):
                if (done_before := read_result(folder, seed)) is None:
                    left.append(_Training(experiment, seed, folder, index))
                else:
                    steps = done_before.steps
                    tell(subject.name, Progress(seed=seed, steps=steps, total=steps))
        left.sort(key=lambda training: training.turn)
        if jobs == 1 or len(left) < 2:
            for one in left:
                _train(one.experiment, one.seed, one.folder, partial(tell, one.name))
                done(one)
        else:
            _train_in_processes(left, jobs, tell, done)
    found = []
    for experiment in experiments:
        folder = root / experiment.experiment.name
        results = (read_result(folder, seed) for seed in experiment.experiment.seeds)
        found.append([result for result in results if result is not None])
    return found


@contextmanager
def _held(experiment: AnyExperiment, root: Path, stepped: Container[str]) -> Iterator[Path]:
    """Keep the folder of an experiment from other commands while it is trained, and make it where it lacks.

    Where the block fails before a seed has taken a step, what was made is removed.

    Args:
        experiment: What is trained.
        root: What has the folder.
        stepped: Names of experiments of which a seed has taken a step.
    """
    folder = check_folder(experiment, root)
    made = [path for path in (folder, *folder.parents) if not path.exists()]  # the deepest first
    with locked(folder / _LOCK, f"{experiment.experiment.name!r} in {folder}"):
        file = check_folder(experiment, root) / RECORD
        is_new = folder in made and not file.exists()  # another command may have begun it meanwhile
        try:
            if not file.exists():
                now = _Record(experiment.digest(), _values(experiment))
                with writing(file):
                    replace_file(file, msgspec.json.format(msgspec.json.encode(now), indent=1))
            yield folder
        except Exception:
            if is_new and experiment.experiment.name not in stepped:
                shutil.rmtree(folder, ignore_errors=True)
                for path in made[1:]:
                    with suppress(OSError):  # something else is in it by now
                        path.rmdir()
            raise


def check_folder(experiment: AnyExperiment, root: Path) -> Path:
    """Find the folder of an experiment, and check that it was begun with the same values, or is not there.

    Args:
        experiment: What is trained; seeds may be added to it.
        root: What has the folder.

    Raises:
        RunError: The folder was begun with other values; the text names those that differ.
    """
    folder = root / experiment.experiment.name
    file = folder / RECORD
    now = _Record(experiment.digest(), _values(experiment))
    try:
        before = msgspec.json.decode(file.read_bytes(), type=_Record)
    except FileNotFoundError:
        if trained := sorted(path.name for path in folder.glob("seed-*")):
            raise RunError(
                f"{folder} has {', '.join(trained[:4])}, and no {RECORD} that says of what; give the "
                "experiment another name, or remove the folder"
            ) from None
        return folder
    except OSError as error:
        raise RunError(f"cannot read {file}: {error.strerror}; choose another folder with --out") from error
    except msgspec.DecodeError as error:
        raise RunError(f"{file} cannot be read: {error}; remove {folder} to train anew") from error
    if before.digest != now.digest:
        changes = list(_differences(before.experiment, now.experiment))
        what = "; ".join(changes[:4]) or "the file of the scenario is another one"
        raise RunError(
            f"{folder} was begun with other values: {what}. Put them back to go on with it; an experiment of "
            "another name begins anew"
        )
    return folder


def reached(experiment: AnyExperiment, root: Path) -> dict[int, int]:
    """Steps from which the training of each seed goes on; 0: from its beginning.

    Args:
        experiment: What is trained.
        root: Folder that has that of the experiment.
    """
    folder, found = root / experiment.experiment.name, dict[int, int]()
    for seed in experiment.experiment.seeds:
        newest = newest_checkpoint(seed_folder(folder, seed) / CHECKPOINTS)
        found[seed] = 0 if newest is None else int(newest.name)
    return found


def _values(experiment: AnyExperiment) -> dict[str, Any]:
    """The values of an experiment without its seeds, as plain tables."""
    # Through JSON, as the file has them: tuples are lists there.
    made: dict[str, Any] = msgspec.json.decode(msgspec.json.encode(experiment.recorded()))
    del made["source"], made["experiment"]["seeds"]
    return made


def _differences(before: Any, now: Any, key: str = "") -> Iterator[str]:
    """Each value that differs, by its key; of texts that are alike, what was probably meant."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for name in sorted({*before, *now}):
            yield from _differences(before.get(name), now.get(name), f"{key}.{name}" if key else name)
    elif isinstance(before, list) and isinstance(now, list) and len(before) == len(now):
        for at, (old, new) in enumerate(zip(before, now, strict=True)):
            yield from _differences(old, new, f"{key}[{at}]")
    elif before != now:
        is_near = isinstance(before, str) and isinstance(now, str) and get_close_matches(now, [before])
        meant = f" (did you mean {before!r}?)" if is_near else ""
        yield f"{key} was {before!r} and is {now!r}{meant}"


# --- processes ------------------------------------------------------------------------------------------


class _Training(NamedTuple):
    """The training of a seed."""

    experiment: AnyExperiment
    seed: int
    folder: Path
    turn: int
    """Place of the seed in the list of the experiment."""

    @property
    def name(self) -> str:
        return self.experiment.experiment.name


def _train(
    experiment: AnyExperiment, seed: int, folder: Path, report: Callable[[Progress], None]
) -> SeedResult:
    if isinstance(experiment, Classification):
        return train_classifier(experiment, seed, folder, report)
    return train_seed(experiment, seed, folder, report)


def _train_in_processes(
    trainings: Sequence[_Training],
    jobs: int,
    report: Callable[[str, Progress], None],
    done: Callable[[_Training], None],
) -> None:
    waiting, running = list(trainings), dict[Connection, tuple[_Training, Any]]()
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                training = waiting.pop(0)
                pipe, process = _start(training)
                running[pipe] = training, process
            ready = multiprocessing.connection.wait(list(running))
            for pipe in [pipe for pipe in running if pipe in ready]:
                training = running[pipe][0]
                if not _take(pipe, partial(report, training.name)):
                    _, process = running.pop(pipe)
                    process.join()
                    if process.exitcode:
                        raise RunError(_cause(process.exitcode))
                    done(training)
    finally:
        for _, process in running.values():
            process.terminate()
        for _, process in running.values():
            process.join(_GOODBYE_S)
            if process.is_alive():
                process.kill()


def _start(training: _Training) -> tuple[Connection, Any]:
    context = multiprocessing.get_context("spawn")  # what is forked has the threads of PyTorch no more
    pipe, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(theirs, *training[:3]), daemon=True)
    start_process(process)
    theirs.close()  # else the end of the process would not be seen: this one would hold the pipe open
    return pipe, process


def _take(pipe: Connection, report: Callable[[Progress], None]) -> bool:
    """Take what a process says; False: it has ended."""
    try:
        said = pipe.recv()
    except EOFError:
        return False
    if isinstance(said, Progress):
        report(said)
    elif isinstance(said, CaviarError):
        raise said
    else:
        warnings.warn(said, stacklevel=2)
    return True


def _cause(code: int) -> str:
    if code < 0:
        name = signal.Signals(-code).name
        return f"the process of a seed ended with signal {name}; was there enough memory?"
    return f"the process of a seed ended with status {code}; what it printed says why"


def _serve(pipe: Connection, experiment: AnyExperiment, seed: int, folder: Path) -> None:
    """Train a seed, and tell the parent; where the parent is gone, the next report ends this process."""
    os.environ["PYTHONSAFEPATH"] = ""  # of scripts that an environment starts, Python searches the folder
    warnings.showwarning = lambda message, *_, **__: pipe.send(str(message))
    try:
        _train(experiment, seed, folder, pipe.send)
    except CaviarError as error:
        pipe.send(error)
    except BrokenPipeError:
        os._exit(1)  # the caller's process is gone
