"""An agent drives a vehicle of SUMO and switches a traffic light in a whole run, among people who walk."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path

import numpy as np
import pytest
from scenarios_support import SCENARIOS, run

from caviar_protocol.recording import Recording

pytestmark = [
    pytest.mark.slow,
    pytest.mark.sumo,
    pytest.mark.skipif(importlib.util.find_spec("libsumo") is None, reason="needs the world extra"),
]

CAR = "traffic.east.15"
"""It departs at the beginning of frame 0, 75 s after that of SUMO."""
FRAMES = 60
STOPPED = 15
"""Frame in which the agent stops it."""
AGENT = f'''
from caviar_protocol.topics import DriveCommand, SignalCommand
from caviar_services.agent.baselines import LosBeamAgent


class Conductor(LosBeamAgent):
    """Stops one car, and keeps a light at one phase."""

    def other_actuators(self):
        return ("motion:{CAR}", "signal:traffic.junction-west")

    def other_commands(self, frame, scene):
        if frame.number >= {STOPPED} and "{CAR}" in scene.names:
            yield DriveCommand(object="{CAR}", speed=0.0)
        yield SignalCommand(signal="traffic.junction-west", phase=0)
'''


def played(folder: Path) -> tuple[str, Recording]:
    """Digest and recording of `crossing` in free space, with that agent."""
    text = (SCENARIOS / "crossing.toml").read_text("utf-8")
    text = re.sub(r"^\[services\.channel\.settings\]\n(.+\n)*", "", text, flags=re.MULTILINE)
    text = re.sub(r"^scenery = .*\n", "", text, flags=re.MULTILINE)
    text = text.replace('use = "sionna-rt"', 'use = "free-space"')
    text = text.replace('use = "los-beam"', 'use = "conductor:Conductor"')
    text = text.replace("file:crossing/", f"file:{SCENARIOS}/crossing/")
    folder.mkdir()
    (folder / "conductor.py").write_text(AGENT, "utf-8")
    (folder / "run.toml").write_text(text, "utf-8")
    finished = run(folder / "run.toml", folder / "runs", "--embedded", "--frames", str(FRAMES))
    assert finished.status == 0, finished.output
    summary = json.loads((finished.directory / "summary.json").read_text("utf-8"))
    return summary["digest"], Recording(finished.directory)


def test_a_car_that_is_commanded_to_stand_stands_and_people_walk_on(tmp_path: Path) -> None:
    (digest, recording), (again, _) = (played(tmp_path / name) for name in ("one", "two"))
    assert again == digest
    speeds, walked = [], 0.0
    for frame in recording:
        scene = frame.scene()
        assert scene is not None
        speed = np.linalg.norm(scene.velocity, axis=1)
        speeds.append(float(speed[scene.names.index(CAR)]))
        walked += float(speed[[kind == "pedestrian" for kind in scene.classes]].sum()) * 0.1
    assert min(speeds[5:STOPPED]) > 2
    assert max(speeds[STOPPED + 35 :]) < 0.1
    assert walked > 50
    # Of the agent's commands none was refused, and beams were chosen beside them.
    kinds = {type(c).__name__ for _, p in recording.products("action") for c in p.payload.commands}
    assert kinds == {"BeamChoice", "DriveCommand", "SignalCommand"}
