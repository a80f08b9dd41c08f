"""Where the trajectories of Radio-Strike come from: its files, recordings of CAVIAR, or made up.

* `read_episode`: an episode file ``ep{N}.csv`` as AirSim wrote it, or the output of an agent of the original,
  in which each row has the position of the scheduled user;
* `recorded_episodes`: the episodes of any recording of CAVIAR, resampled to 10 ms;
* `synthetic_episode`: a flight, a drive and a walk of three minutes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from caviar_clients.envs.arguments import checked_names
from caviar_labs.radio_strike.rules import USERS
from caviar_labs.radio_strike.trajectories import SLOT_S, Episode, read_episode
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import RecordingError, ScenarioError, suggestion
from caviar_protocol.recording import Recording
from caviar_protocol.seeding import generator

# --- recordings ---------------------------------------------------------------------------------------------


def recorded_episodes(
    recording: Recording, users: Sequence[str] | None = None, base_station: str | None = None
) -> list[Episode]:
    """Take the trajectories of three users over from a recording.

    Args:
        recording: Has the topic ``scene``.
        users: Three devices or objects, by name; they take the places of UAV, car and pedestrian. None: the
            receivers, where there are three.
        base_station: Device or object, by name; None: the transmitter, where there is one.

    Returns:
        One for each episode of two frames at least, in straight lines between frames.

    Raises:
        RecordingError: A name is not there, a user is not there in all frames, or users and base station have
            to be named.

    Example:
        >>> recording = Recording("runs/smoke-20261122-101500")
        >>> episode, = recorded_episodes(recording, users=("uav", "car", "car/rx"))
        >>> episode.steps  # 9.9 s
        991
    """
    scene = recording["scene"]
    devices = scene.devices
    names = tuple(users) if users is not None else devices.antennas("rx")
    if len(names) != len(USERS):
        raise RecordingError(
            f"{recording.path}: {len(USERS)} users are needed, and there are {', '.join(names) or 'none'}; "
            f"write users=(…) with names of {', '.join((*devices.names, *scene.names))}"
        )
    stations = (base_station,) if base_station is not None else devices.antennas("tx")
    if len(stations) != 1:
        raise RecordingError(
            f"{recording.path}: of the transmitters {', '.join(stations) or '(none)'} one has to be named; "
            "write base_station=…"
        )
    every = (*stations, *names)
    for name in every:
        if name not in devices.names and name not in scene.names:
            hint = suggestion(name, (*devices.names, *scene.names))
            raise RecordingError(f"{recording.path} has no {name!r}; {hint}")
    paths = [
        (devices if name in devices.names else scene).select(names=name).position[:, 0] for name in every
    ]
    position, time, numbers = np.stack(paths, axis=1), scene.t_ns * 1e-9, scene.episode
    found = []
    for number in np.unique(numbers).tolist():
        frames = numbers == number
        if frames.sum() < 2:
            continue
        mine, at = position[frames], time[frames]
        gaps = np.argwhere(np.isnan(mine).any(2))
        if len(gaps):
            frame, index = gaps[0].tolist()
            raise RecordingError(
                f"{recording.path}: {every[index]!r} is not in frame {frame} of episode {number}; name users "
                "that are there in all frames"
            )
        east, north, up = np.moveaxis(mine[:, 1:] - mine[:, :1], -1, 0)
        at = at - at[0]
        steps = SLOT_S * np.arange(math.floor(at[-1] / SLOT_S + 1e-6) + 1)
        columns = np.stack([north, east, -up], axis=-1).reshape(len(at), -1).T
        resampled = np.array([np.interp(steps, at, column) for column in columns]).T
        source = f"{recording.path}, episode {number}"
        found.append(Episode(source, resampled.reshape(-1, len(USERS), 3)))
    if not found:
        raise RecordingError(f"{recording.path} has no episode of two frames; record a longer run")
    return found


# --- made up ------------------------------------------------------------------------------------------------

SYNTHETIC_STEPS = 18_000
"""Three minutes, as the episodes of the challenge have."""


def synthetic_episode(number: int, steps: int = SYNTHETIC_STEPS) -> Episode:
    """Make up trajectories.

    A UAV takes off and flies from point to point at 5 m/s, a car drives up and down a street at 6 m/s, a
    pedestrian walks about at 1.3 m/s. The antennas are 8.4 m above the ground.

    Args:
        number: Of the episode; the same number gives the same trajectories.
        steps: How many.

    Example:
        >>> synthetic_episode(0).position.shape
        (18000, 3, 3)
    """
    random = generator(0, number, "radio-strike")
    corners = random.uniform([-30.0, -30.0, -22.0], [40.0, 70.0, -6.0], (80, 3))
    flight = np.concatenate([[[14.0, -28.0, 6.4], [14.0, -28.0, corners[0, 2]]], corners])
    turns = np.stack([random.uniform([-40, 20], [-15, 50], (40, 2)), np.zeros((40, 2))])
    drive = np.stack([turns[0].ravel(), random.uniform(-14.0, -10.0, 80), np.full(80, 7.7)], axis=1)
    walk = random.uniform([8.0, 12.0, 7.4], [22.0, 40.0, 7.4], (80, 3))
    ways = ((flight, 5.0), (drive, 6.0), (walk, 1.3))
    position = np.stack([_along(points, speed, steps) for points, speed in ways], axis=1)
    return Episode(f"synthetic episode {number}", position)


def _along(points: Float64Array, speed: float, steps: int) -> Float64Array:
    """Positions on a way of straight lines at constant speed, Shape ``[steps, 3]``."""
    lengths = np.sqrt((np.diff(points, axis=0) ** 2).sum(1))
    way = np.concatenate([[0.0], np.cumsum(lengths)])
    at = speed * SLOT_S * np.arange(steps)
    return np.stack([np.interp(at, way, column) for column in points.T], axis=1)


# --- what environments play ---------------------------------------------------------------------------------

Source = str | Path | Episode | Recording

SYNTHETIC_EPISODES = 100
"""Made-up episodes that are played where no source is named."""


def episode_loaders(
    sources: Source | Iterable[Source] | None = None,
    users: Sequence[str] | None = None,
    base_station: str | None = None,
) -> list[Callable[[], Episode]]:
    """Find episodes, without reading the files yet.

    Args:
        sources: Files, folders with ``ep{N}.csv``, run directories, recordings or episodes; None: made-up
            ones.
        users: See `recorded_episodes`.
        base_station: See `recorded_episodes`.

    Returns:
        A function for each episode that reads it, in the order of the sources and of the numbers N.

    Raises:
        ScenarioError: A source is not there, or holds no episode.
        RecordingError: A recording has not what is needed.

    Example:
        >>> [load().steps for load in episode_loaders(Episode("hover", np.full((7, 3, 3), 10.0)))]
        [7]
    """
    if users is not None:
        users = checked_names("users", users)
    if sources is None:
        for name, value in (("users", users), ("base_station", base_station)):
            if value is not None:
                raise ScenarioError(
                    f"{name}={value!r} is of a recording; name its directory as episodes=…, or leave it out"
                )
        return [partial(synthetic_episode, number) for number in range(SYNTHETIC_EPISODES)]
    kinds = str | Path | Episode | Recording
    if not isinstance(sources, kinds | Iterable) or isinstance(sources, bytes):
        raise ScenarioError(f"episodes={sources!r}; write a path, or a list of paths or episodes")
    several = [sources] if isinstance(sources, kinds) else list(sources)
    for source in several:
        if not isinstance(source, kinds):
            raise ScenarioError(f"episodes has {source!r}; write paths, recordings and episodes")
    found = [load for source in several for load in _loaders(source, users, base_station)]
    if not found:
        raise ScenarioError("episodes=[]; name one source at least, or leave it out")
    return found


def _loaders(
    source: Source, users: Sequence[str] | None, base_station: str | None
) -> Iterator[Callable[[], Episode]]:
    if isinstance(source, str | Path):
        path = Path(source)
        if path.is_file() and path.suffix != ".mcap":
            yield partial(read_episode, path)
            return
        files = sorted(path.glob("ep*.csv"), key=_number) if path.is_dir() else []
        if files:
            yield from (partial(read_episode, file) for file in files)
            return
        if not path.exists():
            raise ScenarioError(
                f"episodes={str(path)!r}: there is no such file or folder; name an episode file, a folder "
                "with ep0.csv, ep1.csv, …, or a run directory"
            )
        source = Recording(path)
    made = [source] if isinstance(source, Episode) else recorded_episodes(source, users, base_station)
    yield from (partial(_given, episode) for episode in made)


def _given(episode: Episode) -> Episode:
    return episode


def _number(file: Path) -> tuple[int, str]:
    digits = "".join(character for character in file.stem if character.isdigit())
    return int(digits or 0), file.stem
