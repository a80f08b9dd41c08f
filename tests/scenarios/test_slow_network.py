"""An agent behind a long way: 20 ms of delay in each direction, and 1 % of all segments lost."""

from __future__ import annotations

import os
import re
import time
from contextlib import closing
from pathlib import Path

import numpy as np
from scenarios_support import SCENARIOS, running
from slow_network import relayed

from caviar_clients.envs.base import BeamSelectionEnv
from caviar_protocol.recording import Recording

ENDPOINT = re.compile(r"waiting for .* at tcp://([\w.-]+):(\d+)")
FRAMES = 200
BUDGET_MS = 100
"""Of the agent: enough for the way there and back, and not for a segment that is sent again."""


def test_it_plays_to_the_end_and_is_told_which_actions_were_late(tmp_path: Path) -> None:
    """Under ``hold`` frames go on with the last beams; ``info`` says so of the frames of the recording."""
    scenario, out = tmp_path / "slow.toml", tmp_path / "out"
    text = (SCENARIOS / "remote.toml").read_text().replace("frames = 100", f"frames = {FRAMES}")
    place = text.index('use = "remote"')
    end = text.index("budget_ms = 20", place)
    text = text[:end] + f'budget_ms = {BUDGET_MS}\npolicy = "hold"' + text[end + len("budget_ms = 20") :]
    scenario.write_text(text)
    late: dict[int, bool] = {}
    with running(scenario, out, "--bind", "tcp://127.0.0.1:0") as (process, _):
        assert process.stdout is not None
        output, until = "", time.monotonic() + 30
        while not (found := ENDPOINT.search(output)):
            assert time.monotonic() < until, f"no endpoint came: {output}"
            output += os.read(process.stdout.fileno(), 65536).decode()
        with (
            relayed(found[1], int(found[2]), delay_s=0.02, loss=0.01) as relay,
            closing(BeamSelectionEnv(scenario, broker=f"tcp://127.0.0.1:{relay.port}")) as env,
        ):
            _, info = env.reset(seed=1)
            over = False
            while not over:
                decided = info["frame"]
                _, _, _, over, info = env.step(np.zeros(env.action_space.shape, np.int64))
                late[decided] = info["late"]
                for missed in range(decided + 1, decided + 1 + info["missed_frames"]):
                    late[missed] = True
            assert relay.lost > 0
        process.communicate(timeout=120)
    assert process.returncode == 0
    recorded = {
        frame.number: product.provenance.status != "fresh"
        for frame in Recording(next(out.iterdir())).frames()
        for product in frame.products
        if product.provenance.topic == "action"
    }
    assert sorted(late) == list(range(FRAMES))
    assert late == recorded
    assert 0 < sum(late.values()) < FRAMES / 2
