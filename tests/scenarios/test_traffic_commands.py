"""An agent drives a vehicle of SUMO and switches a traffic light in a whole run, among people who walk."""

from __future__ import annotations

import importlib.util
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
"""It departs 75 s after SUMO begins, and is there from frame 1 on."""
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


def played(folder: Path, agent: str) -> Recording:
    """Recording of `crossing` in free space, with an agent."""
    text = (SCENARIOS / "crossing.toml").read_text("utf-8")
    text = re.sub(r"^\[services\.channel\.settings\]\n(.+\n)*", "", text, flags=re.MULTILINE)
    text = re.sub(r"^scenery = .*\n", "", text, flags=re.MULTILINE)
    text = text.replace('use = "sionna-rt"', 'use = "free-space"')
    text = text.replace('use = "los-beam"', f'use = "{agent}"')
    text = text.replace("file:crossing/", f"file:{SCENARIOS}/crossing/")
    folder.mkdir()
    (folder / "conductor.py").write_text(AGENT, "utf-8")
    (folder / "run.toml").write_text(text, "utf-8")
    finished = run(folder / "run.toml", folder / "runs", "--embedded", "--frames", str(FRAMES))
    assert finished.status == 0, finished.output
    return Recording(finished.directory)


def motion(recording: Recording) -> tuple[np.ndarray, float]:
    """Place along the street [m] and speed [m/s] of the car in each frame, and how far people walked [m]."""
    found, walked = [], 0.0
    for frame in recording:
        scene = frame.scene()
        assert scene is not None
        speed = np.linalg.norm(scene.velocity, axis=1)
        walked += float(speed[[kind == "pedestrian" for kind in scene.classes]].sum()) * 0.1
        if CAR in scene.names:
            row = scene.names.index(CAR)
            found.append((scene.position[row, 0], speed[row]))
    return np.array(found), walked


def test_a_car_that_is_commanded_to_stand_stands_and_people_walk_on(tmp_path: Path) -> None:
    recording = played(tmp_path / "one", "conductor:Conductor")
    (driven, walked), (left, _) = map(motion, (recording, played(tmp_path / "left", "los-beam")))
    assert len(driven) == len(left) == FRAMES - 1
    assert driven[:STOPPED, 1].min() > 5
    assert driven[STOPPED + 35 :, 1].max() < 0.1
    # Left alone it drives on, up to the queue before the junction.
    assert left[-1, 0] - driven[-1, 0] > 2
    assert walked > 50
    kinds = {type(c).__name__ for _, p in recording.products("action") for c in p.payload.commands}
    assert kinds == {"BeamChoice", "DriveCommand", "SignalCommand"}
