"""Environments of gymnasium at real brokers, and with the real ray tracer."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenarios_support import SCENARIOS, caviar, pid_of, running, scenario_file

from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.envs.uav_path import UavPathEnv
from caviar_clients.session.connected import ConnectedSession
from caviar_protocol.errors import PayloadError, RunError, ScenarioError
from caviar_protocol.messages import Input
from caviar_protocol.recording import Recording
from caviar_space.meshes import box, joined, ply

PARTS = ("aoa", "aod", "position", "velocity", "last_abs_y")
FRAMES, EPISODES, BEAMS = 60, 3, 64
WITHIN_S = 30.0
ENDPOINT = re.compile(r"waiting for 'agent' \(agent\) at (tcp://[\w.:-]+)[^\w.:-]")
REMOTE = ('use = "los-beam"', 'use = "remote"')


# --- at a broker ---------------------------------------------------------------------------------------


class Waiting:
    """``caviar run`` that waits for the agent of a process like this one."""

    def __init__(self, process: subprocess.Popen[str], mark: str, scenario: Path, out: Path) -> None:
        self._process, self.mark, self.scenario, self.out = process, mark, scenario, out
        self.output = ""
        self.endpoint = self._endpoint()

    def _endpoint(self) -> str:
        assert self._process.stdout is not None
        until = time.monotonic() + WITHIN_S
        while not (found := ENDPOINT.search(self.output)):
            ready, _, _ = select.select([self._process.stdout], [], [], max(0.0, until - time.monotonic()))
            data = os.read(self._process.stdout.fileno(), 65536) if ready else b""
            assert data, f"no endpoint came: {self.output}"
            self.output += data.decode()
        return found[1]

    def environment(self, **options: Any) -> BeamSelectionEnv:
        """An environment at the run."""
        return BeamSelectionEnv(self.scenario, **{"broker": self.endpoint, "observe": PARTS} | options)

    def ended(self) -> tuple[int, str]:
        """Status of the run, and what it printed."""
        output, _ = self._process.communicate(timeout=WITHIN_S)
        return self._process.returncode, self.output + output


@contextmanager
def waiting(
    folder: Path, frames: int = FRAMES, episodes: int = EPISODES, rejoin_s: float = 0.5, *arguments: str
) -> Iterator[Waiting]:
    """The shipped geometric scenario, shorter, with the agent's place free."""
    changes = [("frames = 500", f"frames = {frames}\nepisodes = {episodes}"), REMOTE]
    scenario = scenario_file(folder, changes, f"[timeouts]\nrejoin_s = {rejoin_s}\n", base="geometric")
    out = folder / "out"
    with running(scenario, out, "--bind", "tcp://127.0.0.1:0", *arguments) as (process, mark):
        yield Waiting(process, mark, scenario, out)


def hundred_steps(env: BeamSelectionEnv) -> list[Any]:
    """What 100 steps give: an episode of a chosen seed, one left in the middle, and one that follows it."""
    told: list[Any] = []
    index = 0
    for seed, steps in ((77, FRAMES), (78, 13), (None, 27)):
        observation, info = env.reset(seed=seed)
        told.append((plain(observation), plain(info)))
        for _ in range(steps):
            observation, reward, terminated, truncated, info = env.step(np.int64(11 * index % BEAMS))
            told.append((plain(observation), reward, terminated, truncated, plain(info)))
            index += 1
    assert index == 100
    return told


def plain(found: dict[str, Any]) -> dict[str, Any]:
    """Arrays as lists, which can be compared."""
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in found.items()}


def step_until(env: BeamSelectionEnv, until: float) -> None:
    """Steps for as long as the run goes on, and the clock is not there."""
    while time.monotonic() < until:
        env.step(np.int64(0))


def test_a_hundred_steps_are_equal_in_this_process_and_at_a_broker(tmp_path: Path) -> None:
    with waiting(tmp_path) as run:
        with closing(run.environment(broker=None)) as embedded:
            here = hundred_steps(embedded)
        with closing(run.environment()) as connected:
            there = hundred_steps(connected)
        assert there == here
        assert len({step[1] for step in here if len(step) == 5}) == 100, "every frame's reward is another one"
        status, output = run.ended()
    assert status == 1, "it was left in the middle of its third episode"
    assert "did not come back within 0.5 s (timeouts.rejoin_s): it left: the session was closed" in output


def test_an_environment_that_closes_after_the_last_episode_lets_the_run_end_well(tmp_path: Path) -> None:
    rewards = []
    with waiting(tmp_path, frames=20, episodes=2) as run:
        with closing(run.environment()) as env:
            for seed in (5, None):
                env.reset(seed=seed)
                truncated = False
                while not truncated:
                    _, reward, _, truncated, _ = env.step(np.int64(9))
                    rewards.append(reward)
        status, output = run.ended()
    assert status == 0, output
    assert len(rewards) == 40
    recording = Recording(next(run.out.glob("*/")))
    assert len(recording) == 40, "and every frame is recorded"


@pytest.mark.parametrize("steps", [0, pytest.param(7, marks=pytest.mark.exhaustive), FRAMES])
def test_an_environment_takes_over_a_place_that_was_left_and_begins_an_episode_of_its_own(
    tmp_path: Path, steps: int
) -> None:
    with waiting(tmp_path, rejoin_s=WITHIN_S) as run:
        left = run.environment()
        left.reset(seed=5)
        for _ in range(steps):
            left.step(np.int64(0))
        left.close()
        with closing(run.environment(broker=None)) as embedded:
            embedded.reset(seed=9)
            wanted = [embedded.step(np.int64(0))[1] for _ in range(8)]
        with closing(run.environment()) as env:
            assert env.reset(seed=9)[1] == {"frame": 0, "t_ns": 0}
            assert [env.step(np.int64(0))[1] for _ in range(8)] == wanted


def test_an_environment_takes_over_a_place_without_a_seed_at_the_next_episode(tmp_path: Path) -> None:
    with waiting(tmp_path, rejoin_s=WITHIN_S) as run:
        with closing(run.environment()) as left:
            left.reset(seed=5)
            left.step(np.int64(0))
        with closing(run.environment(broker=None)) as embedded:
            embedded.reset(seed=5)
            embedded.reset()
            wanted = [embedded.step(np.int64(0))[1] for _ in range(8)]
        with closing(run.environment()) as env:
            assert env.reset()[1] == {"frame": 0, "t_ns": 0}
            assert [env.step(np.int64(0))[1] for _ in range(8)] == wanted


def test_a_reset_after_the_last_episode_says_that_there_is_none(tmp_path: Path) -> None:
    with waiting(tmp_path, frames=4, episodes=1) as run, closing(run.environment()) as env:
        env.reset()
        while not env.step(np.int64(0))[3]:
            pass
        with pytest.raises(RunError, match=r"run\.episodes"):
            env.reset()
        assert run.ended()[0] == 0


def test_an_action_that_is_refused_leaves_the_run_as_it_was(tmp_path: Path) -> None:
    with waiting(tmp_path, frames=4, episodes=1) as run:
        with closing(run.environment()) as env:
            env.reset(seed=1)
            with pytest.raises(PayloadError, match=r"the action is .*64.*63"):
                env.step(np.int64(BEAMS))
            for _ in range(4):
                truncated = env.step(np.int64(0))[3]
            assert truncated
        assert run.ended()[0] == 0


def test_no_broker_at_the_address_is_told_in_time() -> None:
    address, began = "tcp://127.0.0.1:9", time.monotonic()  # port 9 is below what a process may open
    session = ConnectedSession(address, "agent", (Input(topic="scene"),), connect_timeout_s=1)
    with closing(session), pytest.raises(RunError, match=re.escape(address)):
        session.reset()
    assert time.monotonic() - began < 60


def test_an_environment_shows_its_key_to_a_broker_that_asks_for_one(tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    for arguments in (["new", "broker"], ["new", "agent", "--role", "agent"]):
        assert caviar("keys", *arguments, "--directory", keys).status == 0
    shown = {"key": keys / "agent.key", "broker_key": keys / "broker.pub"}
    with waiting(tmp_path, 4, 2, 20.0, "--keys", str(keys)) as run:
        with closing(run.environment()) as without, pytest.raises(RunError, match="asks for keys"):
            without.reset()
        with closing(run.environment(**shown)) as env:
            env.reset()
            for _ in range(4):
                *_, truncated, _ = env.step(np.int64(0))
            assert truncated
            env.reset()
            for _ in range(4):
                env.step(np.int64(0))
        assert run.ended()[0] == 0


def test_an_agent_that_the_run_does_not_wait_for_is_refused(tmp_path: Path) -> None:
    with waiting(tmp_path, frames=4, episodes=1) as run:
        session = ConnectedSession(run.endpoint, "agnet", (Input(topic="scene"),))
        with closing(session), pytest.raises(RunError, match=r"'agnet'.*'agent'"):
            session.reset()


def test_an_environment_of_another_scenario_does_not_begin_and_the_run_goes_on_without_it(
    tmp_path: Path,
) -> None:
    with waiting(tmp_path, frames=4, episodes=1) as run:
        with (
            closing(BeamSelectionEnv("smoke", broker=run.endpoint)) as wrong,
            pytest.raises(ScenarioError, match=r"64 elements.*'smoke'"),
        ):
            wrong.reset(seed=1)
        with closing(run.environment()) as env:
            env.reset(seed=1)
            for _ in range(4):
                truncated = env.step(np.int64(0))[3]
            assert truncated
        assert run.ended()[0] == 0


def test_a_broker_that_is_killed_ends_the_next_step_and_not_this_process(tmp_path: Path) -> None:
    with waiting(tmp_path, frames=10_000, rejoin_s=0.0) as run:  # no service is started again
        env = run.environment()
        with closing(env):
            env.reset(seed=1)
            env.step(np.int64(0))
            os.kill(pid_of(run.mark, "caviar_broker"), signal.SIGKILL)
            began = time.monotonic()
            with pytest.raises(RunError, match=re.escape(run.endpoint)):
                step_until(env, began + WITHIN_S)  # what was granted before may come yet
            assert time.monotonic() - began < WITHIN_S
            with pytest.raises(RunError):
                env.step(np.int64(0))
        env.close()
        assert run.ended()[0] != 0


def test_an_environment_outlives_its_broker_and_decides_nothing_twice(tmp_path: Path) -> None:
    def steps(env: BeamSelectionEnv, disturb: int = -1) -> list[float]:
        env.reset(seed=1)
        rewards = []
        for number in range(FRAMES):
            if number == disturb:
                os.kill(pid_of(run.mark, "caviar_broker"), signal.SIGKILL)
            rewards.append(float(env.step(np.int64(number % BEAMS))[1]))
        return rewards

    with waiting(tmp_path, episodes=1, rejoin_s=WITHIN_S) as run:
        with closing(run.environment()) as env:
            disturbed = steps(env, disturb=20)
        status, output = run.ended()
        assert status == 0, output
        assert "another one resumes the run" in output
        with closing(BeamSelectionEnv(run.scenario, observe=PARTS)) as env:
            assert steps(env) == disturbed


def test_a_session_that_is_closed_before_its_first_reset_lets_go_at_once(tmp_path: Path) -> None:
    with waiting(tmp_path) as run:
        session = ConnectedSession(run.endpoint, "agent", (Input(topic="scene"),))
        began = time.monotonic()
        session.close()
        assert time.monotonic() - began < 60
        session.close()


# --- in the air ----------------------------------------------------------------------------------------

pathfinding = pytest.mark.channel
MOUTH, INSIDE = (9.0, 178.0, 15.0), (23.0, 195.0, 14.0)
"""The mouth of the street in sight of the base station, and a point between the blocks [m]."""


@pathfinding
def test_flying_into_a_street_loses_the_line_of_sight_and_ends_at_the_goal() -> None:
    pytest.importorskip("sionna.rt", reason="sionna-rt is not installed")
    with closing(UavPathEnv(reach_m=2.0)) as env:
        low, high = (np.array(corner) for corner in (env._low, env._high))
        observation, _ = env.reset(seed=1, options={"start": (-2.0, 140.0, 18.0), "goal": INSIDE})
        seen: dict[str, list[bool]] = {"to the mouth": [], "into it": []}
        ended = False
        for leg, point in (("to the mouth", MOUTH), ("into it", INSIDE)):
            while not ended:
                way = np.array(point) - (low + (observation["position"] + 1) / 2 * (high - low))
                left = float(np.linalg.norm(way))
                if left < 2.0 and point is MOUTH:
                    break
                action = (way / max(left, 8.0)).astype(np.float32)
                observation, _, ended, truncated, info = env.step(action)
                assert env.observation_space.contains(observation)
                assert not truncated
                seen[leg].append(bool(info["los"][0]))
    assert all(seen["to the mouth"]), "the base station sees the mouth"
    assert seen["into it"][0]
    assert not any(seen["into it"][-5:]), "and not what is between the blocks"
    assert sorted(seen["into it"], reverse=True) == seen["into it"], "it is lost once"


@pathfinding
def test_the_same_seed_and_the_same_flight_give_the_same_channel() -> None:
    pytest.importorskip("sionna.rt", reason="sionna-rt is not installed")
    found = []
    with closing(UavPathEnv()) as env:
        for _ in range(2):
            env.reset(seed=3)
            steps = [env.step(np.array([0.2, 0.9, -0.1], np.float32)) for _ in range(8)]
            found.append([float(info["abs_y"][0]) for *_, info in steps])
    assert found[0] == found[1]
    assert len(set(found[0])) == 8


# --- a flight over open ground -----------------------------------------------------------------------


def open_ground(folder: Path) -> Path:
    """The shipped flight with the agent's place free, without a ray tracer, beside a house of its own."""
    text = (SCENARIOS / "uav-path.toml").read_text()
    for begin, end in (
        ("[services.channel.settings]", "[services.link]"),
        ("[services.agent.set", "[services.rec"),
    ):
        head, _, tail = text.partition(begin)
        text = head + tail[tail.index(end) :]
    house = box((-80.0, 40.0), (180.0, 280.0), (0.0, 60.0))
    ground = box((-150.0, 250.0), (-50.0, 350.0), (-1.0, 0.0))
    (folder / "town.ply").write_bytes(ply(joined([house, ground])))
    (folder / "town.xml").write_text(
        '<scene version="2.1.0"><shape type="ply" id="town">'
        '<string name="filename" value="town.ply"/></shape></scene>'
    )
    for old, new in (
        ('"sionna:munich"', '"file:town.xml"'),
        ('use = "sionna-rt"', 'use = "free-space"'),
        ('use = "waypoints"', 'use = "remote"'),
        ("frames = 60", "frames = 12\nepisodes = 3"),
    ):
        assert old in text
        text = text.replace(old, new, 1)
    path = folder / "scenario.toml"
    path.write_text(text + "\n[timeouts]\nrejoin_s = 0.5\n")
    return path


def two_flights(env: UavPathEnv) -> list[Any]:
    """What an episode of a seed gives, and one with a start of one's own that follows it."""
    told: list[Any] = []
    for seed, options in ((5, {}), (None, {"start": (0.0, 20.0, 30.0)})):
        observation, info = env.reset(seed=seed, options=options)
        told.append((plain(observation), plain(info)))
        ended = False
        while not ended:
            observation, reward, terminated, truncated, info = env.step(observation["goal"])
            told.append((plain(observation), reward, terminated, truncated, plain(info)))
            ended = terminated or truncated
    return told


def test_flights_of_version_1_are_equal_in_this_process_and_at_a_broker(tmp_path: Path) -> None:
    """The scenery, in which start and goal are looked for, comes from the broker."""
    scenario = open_ground(tmp_path)
    with running(scenario, tmp_path / "out", "--bind", "tcp://127.0.0.1:0") as (process, mark):
        run = Waiting(process, mark, scenario, tmp_path / "out")
        with closing(UavPathEnv(scenario)) as embedded:
            here = two_flights(embedded)
        with closing(UavPathEnv(scenario, broker=run.endpoint)) as connected:
            there = two_flights(connected)
    assert there == here
    assert len(here) == 2 + 2 * 11
