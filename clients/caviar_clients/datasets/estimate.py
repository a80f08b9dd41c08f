"""Estimate of time and space of a dataset, from three scenes that every worker plays beforehand."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import msgspec

from caviar_clients.datasets.directory import DatasetDirectory, rename_unless_there
from caviar_clients.datasets.episode import EpisodeTask, play_episode, work_folder
from caviar_clients.datasets.remote import RemoteDataset, is_address
from caviar_clients.datasets.texts import bytes_text
from caviar_protocol.errors import RunError
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import Scenario

FEW = 3
"""Scenes of the longer episode that is tried."""
ROW_B = 200
"""[B] of a row of the catalogue, with its index."""
SPARE = 1.05
"""So much more than the estimate has to be free on the disk."""
LEAST_B = 4096
"""[B] of a recording, which has a folder and three files, at the least."""
LEAST_SCENE_B = 100
"""[B] of the catalogue's rows of a scene, at the least."""
LEAST_FILES = 4
"""Of a recording, folder included."""


@dataclass(frozen=True)
class Trial:
    """Times and sizes of episodes that one worker played beforehand."""

    cold_s: float
    """Of the first one, which loads the scenery and compiles kernels."""
    scenes: tuple[int, ...] = ()
    """Of each later one."""
    wall_s: tuple[float, ...] = ()
    bytes: tuple[int, ...] = ()
    """On the disk."""
    error: str = ""
    """Why none could be played."""


@dataclass(frozen=True)
class Estimate:
    """Time and space that what is left of a dataset takes.

    Example:
        >>> trial = Trial(5.0, scenes=(1, 3), wall_s=(1.0, 2.0), bytes=(100_000, 300_000))
        >>> estimate([trial], episodes=10, scenes=5)
        Estimate(wall_s=30.0, bytes=5000000)
    """

    wall_s: float
    bytes: int


def estimate(trials: Sequence[Trial], episodes: int, scenes: int) -> Estimate:
    """Estimate time and space of episodes.

    Args:
        trials: Of the workers, which played at the same time.
        episodes: That are left.
        scenes: Of each.
    """
    each_s = fmean(_extrapolated(trial.scenes, trial.wall_s, scenes) for trial in trials)
    each_b = fmean(_extrapolated(trial.scenes, trial.bytes, scenes) for trial in trials)
    return Estimate(episodes * each_s / len(trials), round(episodes * each_b))


def _extrapolated(scenes: Sequence[int], values: Sequence[float], wanted: int) -> float:
    """Extrapolate to an episode of so many scenes: a part for the episode, and one for each scene."""
    low, high = min(scenes), max(scenes)
    at_low = fmean(value for count, value in zip(scenes, values, strict=True) if count == low)
    if low == high:
        return at_low * wanted / low
    at_high = fmean(value for count, value in zip(scenes, values, strict=True) if count == high)
    # Noise may make the longer episode the cheaper one: a scene takes something.
    slope = max((at_high - at_low) / (high - low), at_high / high * 0.1)
    return at_low + (wanted - low) * slope


def try_worker(scenario: Scenario, out: str, episodes: Sequence[int], cached: Mapping[str, bytes]) -> Trial:
    """Play three scenes beforehand, in a worker, and put the scenery into its place.

    Args:
        scenario: Of the episodes.
        out: Folder or address of the dataset.
        episodes: To be tried, three.
        cached: Files of the cache that these need.
    """
    began = time.monotonic()
    error = _put_scenery(scenario, out, episodes[0], cached)
    cold_s = time.monotonic() - began
    scenes = [1] * len(episodes) if scenario.run.frames == 1 else [1, min(FEW, scenario.run.frames)]
    done = list[tuple[int, float, int]]()
    for episode, count in zip(episodes, scenes, strict=False):
        began = time.monotonic()
        result = play_episode(
            EpisodeTask(_shortened(scenario, count), episode, out, trial=True, cached=cached)
        )
        if result.error:
            error = error or result.error
        else:
            rows = result.rows
            listed = len(rows.scenes) + len(rows.users) + len(rows.products) if rows is not None else 0
            size = int(result.measured["disk_b"]) + listed * ROW_B
            done.append((count, time.monotonic() - began, size))
    if not done:
        return Trial(cold_s, error=error)
    counts, walls, sizes = zip(*done, strict=True)
    return Trial(cold_s, counts, walls, sizes)


def _put_scenery(scenario: Scenario, out: str, episode: int, cached: Mapping[str, bytes]) -> str:
    """Play one scene with the scenery beside its recording, and move that to where all episodes have it."""
    name, recorder = next((n, s) for n, s in scenario.services.items() if s.role == "recorder")
    settings = {**recorder.settings, "copy_assets": True}
    services = {**scenario.services, name: msgspec.structs.replace(recorder, settings=settings)}
    shortened = _shortened(msgspec.structs.replace(scenario, services=services), 1)
    with work_folder(out, "scenery") as work:
        task = replace(
            EpisodeTask(shortened, episode, out, trial=True, cached=cached), kept=str(work / "episode")
        )
        result = play_episode(task)
        found = RunDirectory(work / "episode").assets
        if found.is_dir():
            if is_address(out):
                RemoteDataset(out).put_assets(found)
            else:
                rename_unless_there(found, DatasetDirectory(Path(out)).assets)
        return result.error


def _shortened(scenario: Scenario, scenes: int) -> Scenario:
    run = msgspec.structs.replace(scenario.run, frames=scenes, instants_s=scenario.run.instants_s[:scenes])
    return msgspec.structs.replace(scenario, run=run)


def check_least(folder: Path, episodes: int, scenes: int, *, has_recordings: bool) -> None:
    """Check that a dataset may fit the disk at all, before time is spent on traffic and trials.

    Args:
        folder: Of the dataset, or of the catalogue alone.
        episodes: That are left.
        scenes: Of each.
        has_recordings: Whether they lie there too.

    Raises:
        RunError: Its disk is too small, or has no room for so many files.
    """
    check_disk(folder, episodes * (scenes * LEAST_SCENE_B + LEAST_B * has_recordings))
    about = os.statvfs(folder)
    needed = episodes * LEAST_FILES
    # File systems that make room for files as they come say 0.
    if has_recordings and about.f_files and needed > about.f_favail:
        raise RunError(
            f"the disk of {folder} has room for {about.f_favail:,} files, and {episodes:,} episodes are "
            f"{needed:,} files and folders; give another --out, or fewer --episodes of more --scenes"
        )


def check_disk(folder: Path, needed: int) -> int:
    """Check that a dataset fits the disk.

    Args:
        folder: Of the dataset.
        needed: Space that it takes [B].

    Returns:
        What is free [B].

    Raises:
        RunError: It is too little; the text has both figures.
    """
    free = shutil.disk_usage(folder).free
    if needed * SPARE > free:
        raise RunError(
            f"the disk of {folder} is too small: {bytes_text(needed * SPARE)} are needed, "
            f"{bytes_text(free)} are free; free some, give another --out or "
            "fewer --episodes, or record less (record below [run])"
        )
    return free
