"""Checkpoints of a training: model, optimizer and replay buffer, each a folder that is there whole or not.

A checkpoint is written beside the one before and gets its name when all of it is on the disk; then the one
before is removed. A process that dies in the middle leaves a folder ``….partial``, which nothing reads.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.files import writing
from caviar_protocol.errors import RunError
from caviar_protocol.files import sync_file

_MODEL, _BUFFER = "model.zip", "replay_buffer.npz"
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
    done = folder / f"{model.num_timesteps:012d}"
    draft = done.with_name(done.name + _PARTIAL)
    with writing(draft / _MODEL):
        shutil.rmtree(draft, ignore_errors=True)
        draft.mkdir(parents=True)
        model.save(draft / _MODEL)
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None:
            np.savez(draft / _BUFFER, **_content(buffer))
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
    return done


def load_checkpoint(path: Path, algorithm: Any, envs: Any) -> Any:
    """Read a checkpoint.

    Args:
        path: From `newest_checkpoint`.
        algorithm: Class of Stable-Baselines3 that it is of.
        envs: A ``VecEnv`` with the spaces of the training.

    Returns:
        The model, as it was when it was saved; its environments begin new episodes.

    Raises:
        RunError: It cannot be read.
    """
    try:
        model = algorithm.load(path / _MODEL, env=envs, device="cpu")
        buffer = getattr(model, "replay_buffer", None)
        if buffer is not None:
            with np.load(path / _BUFFER) as content:
                _fill(buffer, content)
    except Exception as error:  # whatever a damaged file makes the libraries raise
        raise RunError(
            f"checkpoint {path} cannot be read: {error}; remove the folder to train this seed anew"
        ) from error
    return model


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
