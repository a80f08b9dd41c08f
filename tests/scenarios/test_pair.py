"""The pair of agents at a real broker: both places are taken by one program."""

from __future__ import annotations

import os
import re
import select
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from scenarios_support import SCENARIOS, running

pytest.importorskip("pettingzoo", reason="PettingZoo is not installed")
from caviar_clients.envs.pair import UavPairEnv

ENDPOINT = re.compile(r"waiting for .* at (tcp://[\w.:-]+\d)")
WITHIN_S = 30.0
EPISODE = [("frames = 121 ", "episodes = 2\nframes = 30 "), ('use = "los-beam"', 'use = "remote"')]


def remote_pair(folder: Path) -> Path:
    """The shipped scenario, shorter, with both agents' places free."""
    text = (SCENARIOS / "uav-pair.toml").read_text()
    begin, end = text.index("[services.pilot.settings]"), text.index("[services.beams]")
    text = (text[:begin] + text[end:]).replace('use = "waypoints"', 'use = "remote"')
    for before, after in EPISODE:
        assert before in text
        text = text.replace(before, after)
    path = folder / "remote.toml"
    path.write_text(text)
    return path


def episodes(env: UavPairEnv) -> list[object]:
    """Rewards and ways of two episodes."""
    told: list[object] = []
    for seed in (4, 5):
        env.reset(seed=seed)
        while env.agents:
            actions = {"pilot": np.array([1, 0, 0], np.float32), "beams": np.int64(len(told) % 32)}
            _, rewards, _, _, infos = env.step(actions)
            told.append((rewards, infos["pilot"]["distance_m"]))
    return told


def test_both_agents_at_a_broker_are_those_of_a_run_in_this_process(tmp_path: Path) -> None:
    scenario = remote_pair(tmp_path)
    with closing(UavPairEnv(scenario)) as env:
        here = episodes(env)
    with running(scenario, tmp_path / "out", "--bind", "tcp://127.0.0.1:0") as (process, _):
        assert process.stdout is not None
        output, until = "", time.monotonic() + WITHIN_S
        while not (found := ENDPOINT.search(output)):
            ready, _, _ = select.select([process.stdout], [], [], max(0.0, until - time.monotonic()))
            data = os.read(process.stdout.fileno(), 65536) if ready else b""
            assert data, f"no endpoint came: {output}"
            output += data.decode()
        with closing(UavPairEnv(scenario, broker=found[1])) as env:
            assert episodes(env) == here
        process.communicate(timeout=WITHIN_S)
    assert len(here) == 58
    assert process.returncode == 0
