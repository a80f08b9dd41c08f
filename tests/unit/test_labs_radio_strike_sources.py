"""Trajectories of Radio-Strike: episode files, recordings, made-up ones, and what is wrong with others."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recording_builders import record_run

from caviar_labs.radio_strike.env import RadioStrikeEnv
from caviar_labs.radio_strike.rules import USERS
from caviar_labs.radio_strike.sources import (
    SYNTHETIC_EPISODES,
    episode_loaders,
    recorded_episodes,
    synthetic_episode,
)
from caviar_labs.radio_strike.trajectories import Episode, read_episode
from caviar_protocol.errors import RecordingError, ScenarioError
from caviar_protocol.recording import Recording

COLUMNS = [
    "timestamp", "obj", "pos_x", "pos_y", "pos_z", "orien_x", "orien_y", "orien_z", "orien_w",
    *(f"{kind}_{of}_{axis}" for kind in ("linear", "angular") for of in ("acc", "vel") for axis in "xyz"),
]  # fmt: skip
OBJECTS = ("uav1", "simulation_car1", "simulation_car2", "simulation_pedestrian1", "simulation_pedestrian2")


def episode_file(file: Path, steps: int = 4, seed: int = 1) -> np.ndarray:  # type: ignore[type-arg]
    """An episode file as the challenge has them; returns positions of all its objects."""
    position = np.random.default_rng(seed).uniform(-30, 30, (steps, len(OBJECTS), 3))
    with file.open("w", newline="") as text:
        writer = csv.writer(text)
        writer.writerow(COLUMNS)
        for step in range(steps):
            for number, name in enumerate(OBJECTS):
                moves = [0.5] * 12 if name == "uav1" else [""] * 12
                place = position[step, number].tolist()
                writer.writerow([1_600_000_000 + step * 10_000_000, name, *place, 0, 0, 0, 1, *moves])
    return position


# --- files --------------------------------------------------------------------------------------------------


def test_an_episode_file_has_the_three_users_among_its_objects(tmp_path: Path) -> None:
    position = episode_file(tmp_path / "ep0.csv")
    episode = read_episode(tmp_path / "ep0.csv")
    assert episode.position.tolist() == position[:, [0, 1, 3]].tolist()


def test_files_of_a_folder_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (10, 2, 1):
        episode_file(tmp_path / f"ep{number}.csv", steps=number)
    (tmp_path / "notes.txt").write_text("no episode")
    assert [load().steps for load in episode_loaders(tmp_path)] == [1, 2, 10]
    files = [tmp_path / "ep10.csv", str(tmp_path / "ep1.csv"), Episode("mine", np.ones((7, 3, 3)))]
    assert [load().steps for load in episode_loaders(files)] == [10, 1, 7]


def test_files_are_read_when_they_are_first_played(tmp_path: Path) -> None:
    episode_file(tmp_path / "ep0.csv", steps=2)
    (tmp_path / "ep1.csv").write_text("no episode")
    env = RadioStrikeEnv("legacy", episodes=tmp_path)
    env.reset(seed=1)
    for _ in range(2):
        env.step([0, 0])
    with pytest.raises(ScenarioError, match=r"ep1\.csv:1: has no column obj"):
        env.step([0, 0])


def cut_off_in_a_row(file: Path) -> None:
    file.write_text(file.read_text().rstrip()[:-60])


def cut_off_in_a_step(file: Path) -> None:
    lines = file.read_text().splitlines()
    file.write_text("\n".join(lines[:-2]) + "\n")


def without_column(file: Path) -> None:
    file.write_text(file.read_text().replace("pos_y", "pos_w", 1))


def without_user(file: Path) -> None:
    lines = [line for line in file.read_text().splitlines() if ",simulation_car1," not in line]
    file.write_text("\n".join(lines) + "\n")


def with_nan(file: Path) -> None:
    lines = file.read_text().splitlines()
    cells = lines[6].split(",")
    cells[3] = "nan"
    file.write_text("\n".join([*lines[:6], ",".join(cells), *lines[7:]]) + "\n")


def with_text(file: Path) -> None:
    with_nan(file)
    file.write_text(file.read_text().replace("nan", "here"))


def far_away(file: Path) -> None:
    with_nan(file)
    file.write_text(file.read_text().replace("nan", "3e9"))


def binary(file: Path) -> None:
    file.write_bytes(b"\x89PNG\r\n\xff\xfe")


def empty(file: Path) -> None:
    file.write_text("")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (cut_off_in_a_row, r"ep0\.csv:21: the row has \d+ of 21 columns; the file breaks off"),
        (
            cut_off_in_a_step,
            r"has 4 of uav1, 4 of simulation_car1, 3 of simulation_pedestrian1; the file",
        ),
        (without_column, r"ep0\.csv:1: has no column pos_y; an episode has obj,pos_x,pos_y,pos_z"),
        (without_user, r"ep0\.csv: has no row of simulation_car1; it needs uav1, simulation_car1"),
        (with_nan, r"ep0\.csv:7: pos_y is 'nan'; write a number of metres up to 100000"),
        (with_text, r"ep0\.csv:7: pos_y is 'here'; write a number"),
        (far_away, r"ep0\.csv:7: pos_y is '3e9'; write a number of metres up to 100000"),
        (binary, r"ep0\.csv: cannot be read: .*; name a CSV file of Radio-Strike"),
        (empty, r"ep0\.csv:1: has no column obj, pos_x, pos_y, pos_z"),
    ],
)
def test_a_wrong_episode_file_is_refused_with_file_line_and_remedy(
    tmp_path: Path, damage: Any, message: str
) -> None:
    file = tmp_path / "ep0.csv"
    episode_file(file)
    damage(file)
    with pytest.raises(ScenarioError, match=message):
        RadioStrikeEnv(episodes=file)


@pytest.mark.parametrize(
    ("position", "message"),
    [
        (np.ones((4, 2, 3)), r"mine: positions have shape \[4, 2, 3\]; write \[steps, 3, 3\]"),
        (np.ones((0, 3, 3)), r"positions have shape \[0, 3, 3\]"),
        (
            np.where(np.arange(36).reshape(4, 3, 3) == 13, np.nan, 1.0),
            "y of simulation_car1 in step 1 is nan",
        ),
        (np.zeros((1, 3, 3)), "uav1 in step 0 is where the base station is"),
    ],
)
def test_a_wrong_trajectory_is_refused(position: Any, message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        RadioStrikeEnv(episodes=Episode("mine", position))


# --- recordings ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded run of `smoke`: 100 frames of 100 ms."""
    folder = tmp_path_factory.mktemp("runs") / "smoke-1"
    record_run(folder)
    return folder


def test_a_recording_gives_trajectories_of_devices_and_objects_around_the_base_station(run: Path) -> None:
    recording = Recording(run)
    (episode,) = recorded_episodes(recording, users=("uav", "car", "car/rx"))
    scene = recording["scene"]
    station = scene.devices.select(names="bs").position[:, 0]
    assert episode.steps == 991
    for user, name in enumerate(("uav", "car")):
        east, north, up = (scene.select(names=name).position[:, 0] - station).T
        assert np.allclose(episode.position[::10, user].T, [north, east, -up], atol=1e-9)
        # In between straight lines: in the middle of two frames the mean of both.
        between = episode.position[5::10, user]
        assert np.allclose(between.T[0], (north[1:] + north[:-1]) / 2, atol=1e-9)
    above = episode.position[:, 1, 2] - episode.position[:, 2, 2]
    assert (above > 0).all()  # down: the receiver is on the car's roof


def test_a_run_directory_is_played_as_it_is(run: Path) -> None:
    env = RadioStrikeEnv(episodes=run, users=("uav/rx-uav", "car/rx", "car"), base_station="bs")
    env.reset(seed=1)
    total = 0
    truncated = False
    while not truncated:
        observation, _, _, truncated, _ = env.step([total % 3, 5])
        total += 1
    assert total == 991
    assert np.isfinite(observation).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, r"3 users are needed, and there are car/rx, uav/rx-uav; write users="),
        ({"users": ("uav", "car", "rx")}, "has no 'rx'"),
        ({"users": ("uav", "car", "car/rx"), "base_station": "b"}, "has no 'b'; did you mean 'bs'"),
    ],
)
def test_users_that_a_recording_does_not_have_are_refused(
    run: Path, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(RecordingError, match=message):
        RadioStrikeEnv(episodes=run, **arguments)


def test_a_folder_without_episodes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=str(tmp_path)):
        RadioStrikeEnv(episodes=tmp_path)


# --- made up ------------------------------------------------------------------------------------------------


def test_made_up_users_move_steadily_at_their_speeds_over_the_ground() -> None:
    for number in (0, 1, SYNTHETIC_EPISODES - 1):
        position = synthetic_episode(number).position
        speed = np.sqrt((np.diff(position, axis=0) ** 2).sum(2)) / 0.01
        # Cut corners are shorter.
        assert np.median(speed, axis=0) == pytest.approx([5.0, 6.0, 1.3])
        assert (speed.max(0) <= np.array([5.0, 6.0, 1.3]) + 1e-9).all()
        assert (position[:, :, 2] <= 8.4).all()
        assert np.sqrt((position**2).sum(2)).min() > 5
        assert len(position[0]) == len(USERS)
    assert not np.array_equal(synthetic_episode(1).position, synthetic_episode(2).position)
