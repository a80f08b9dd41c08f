"""Checkpoints of a training: model, optimizer and replay buffer, each a folder that is there whole or not;
and its lock, which one process holds until it ends, however it ends.

Numbers and arrays alone, which are read without running what a file says; a model saved by Stable-Baselines3
has pickled objects.

A checkpoint is written beside the one before and gets its name when all of it is on the disk; then the one
before is removed. A process that dies in the middle leaves a folder ``….partial``, which nothing reads.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np

from caviar_clients.files import writing
from caviar_protocol.errors import RunError
from caviar_protocol.files import sync_file

_WEIGHTS, _STATE, _BUFFER = "weights.pt", "state.json", "replay_buffer.npz"
_PARTIAL = ".partial"


def newest_checkpoint(folder: Path) -> Path | None:
    """Find the checkpoint of the most steps.

    Args:
        folder: Of the checkpoints of one seed; it may not exist.
    """
    # A copy that a user made of one is none, nor is a draft.
    found = [path for path in folder.glob("[0-9]*") if path.is_dir() and path.name.isdecimal()]
    return max(found, default=None, key=lambda path: int(path.name))


def save_checkpoint(folder: Path, model: Any) -> Path:
    """Write a checkpoint, and remove those before it.

    Args:
        folder: Of the checkpoints of one seed; it is made where it lacks.
        model: Of Stable-Baselines3.

    Raises:
        RunError: The disk refuses; the checkpoint before is still there.
    """
    import torch

    with written_checkpoint(folder, model.num_timesteps) as draft:
        torch.save(model.get_parameters(), draft / _WEIGHTS)
        (draft / _STATE).write_bytes(msgspec.json.encode(_numbers(model)))
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None:
            np.savez(draft / _BUFFER, **_content(buffer))
    return folder / f"{model.num_timesteps:012d}"


@contextmanager
def written_checkpoint(folder: Path, number: int) -> Iterator[Path]:
    """Make the folder of a checkpoint, which gets its name when the block has ended; then those before go.

    Args:
        folder: Of the checkpoints of one seed; it is made where it lacks.
        number: Of steps, or of epochs.

    Yields:
        A folder to write files into.

    Raises:
        RunError: The disk refuses; the checkpoint before is still there.
    """
    done = folder / f"{number:012d}"
    draft = done.with_name(done.name + _PARTIAL)
    with writing(draft / _WEIGHTS):
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(parents=True)
        yield draft
        for file in draft.iterdir():
            sync_file(file)
        sync_file(draft)
        if done.exists():  # of a process that was killed before it removed what it had written again
            shutil.rmtree(done)
        draft.rename(done)
        sync_file(folder)
    for path in folder.iterdir():
        if path != done:
            shutil.rmtree(path, ignore_errors=True)


def load_checkpoint(path: Path, model: Any) -> Any:
    """Read a checkpoint into a model.

    Args:
        path: From `newest_checkpoint`.
        model: Of Stable-Baselines3, made anew as the one that was saved was.

    Returns:
        The model, as it was when it was saved; its environments begin new episodes.

    Raises:
        RunError: It cannot be read.
    """
    import torch

    try:
        model.set_parameters(torch.load(path / _WEIGHTS, weights_only=True, map_location="cpu"), device="cpu")
        state = msgspec.json.decode((path / _STATE).read_bytes())
        window = model._stats_window_size
        model.ep_info_buffer = deque(state.pop("ep_info_buffer"), maxlen=window)
        model.ep_success_buffer = deque(maxlen=window)  # no environment here says is_success
        for name, value in state.items():
            setattr(model, name, value)
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None:
            with np.load(path / _BUFFER) as content:
                _fill(buffer, content)
    except Exception as error:  # whatever a damaged file makes the libraries raise
        raise RunError(
            f"checkpoint {path} cannot be read: {error}; remove the folder to train this seed anew"
        ) from error
    return model


def _numbers(model: Any) -> dict[str, Any]:
    """Numbers that a model counts, beside weights and arrays."""
    found = {name: value for name, value in vars(model).items() if type(value) in (int, float, bool)}
    episodes = [{name: float(value) for name, value in one.items()} for one in model.ep_info_buffer or ()]
    return {**found, "ep_info_buffer": episodes}


def _arrays(buffer: Any) -> dict[str, Any]:
    """The arrays of a replay buffer, by the names that they have in the file."""
    found = {name: getattr(buffer, name) for name in ("actions", "rewards", "dones", "timeouts")}
    for name in ("observations", "next_observations"):
        value = getattr(buffer, name)
        parts = value.items() if isinstance(value, dict) else [("", value)]
        found |= {f"{name}/{part}": array for part, array in parts}
    return found


def _content(buffer: Any) -> dict[str, Any]:
    filled = buffer.buffer_size if buffer.full else buffer.pos
    return {
        "position": np.array([buffer.pos, buffer.full], np.int64),
        **{name: array[:filled] for name, array in _arrays(buffer).items()},
    }


def _fill(buffer: Any, content: Any) -> None:
    position, full = content["position"].tolist()
    buffer.pos, buffer.full = position, bool(full)
    for name, array in _arrays(buffer).items():
        saved = content[name]
        array[: len(saved)] = saved


@contextmanager
def locked(file: Path, what: str, patience_s: float = 0.0) -> Iterator[None]:
    """Keep other processes from training the same; the lock ends with the process, however it ends.

    Args:
        file: Of the lock; it is made, with the folders to it.
        what: Is trained, as the error's subject.
        patience_s: How long the process before may take to its end.

    Raises:
        RunError: Another process trains it, or the disk refuses.
    """
    while True:
        with writing(file):
            stream = file.open("a+")
        with stream:
            _lock(stream, what, patience_s)
            if not _is_still_at(file, stream):  # the process before has removed the folder that it had made
                continue
            stream.truncate(0)
            stream.write(str(os.getpid()))
            stream.flush()
            yield
            return


def _is_still_at(file: Path, stream: IO[str]) -> bool:
    try:
        return os.path.samestat(file.stat(), os.fstat(stream.fileno()))
    except FileNotFoundError:
        return False


def _lock(stream: IO[str], what: str, patience_s: float) -> None:
    until = time.monotonic() + patience_s
    while True:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            # A child whose parent was killed ends at its next report.
            if time.monotonic() > until:
                stream.seek(0)
                holder = stream.read() or "that has just begun"
                raise RunError(
                    f"{what} is being trained by process {holder}; wait for it, or end it"
                ) from None
            time.sleep(0.05)
        else:
            return
