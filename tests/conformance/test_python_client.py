"""The reference world in Python: short, in whole runs, and killed; test_conform_kit.py has it judged."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import engine_worlds as worlds
import pytest
from scenarios_support import ROOT, blocks, eventually, recorded_below

from caviar_protocol.assets import is_mesh_name
from caviar_protocol.recording import Recording
from caviar_protocol.topics import Lidar

pytestmark = pytest.mark.slow

WORLD = ROOT / "clients" / "python" / "world.py"
SCENARIO = ROOT / "clients" / "js" / "world.toml"
"""Of the reference world in JavaScript, whose objects have the same names."""
KILLED_AFTER = 25
"""Frames: more than between two checkpoints, so that the world takes its state over."""


def played(scenario: Path, folder: Path, frames: int, *, kill: bool = False) -> tuple[str, Recording]:
    """Digest and recording of a run with the world, over ZeroMQ."""
    with worlds.waiting_run(scenario, folder, frames=frames) as run:
        command = (sys.executable, str(WORLD), run.endpoint, "world")
        if kill:
            with run.agent(*command) as first:
                eventually(lambda: recorded_below(run.out) >= KILLED_AFTER, 60, "some frames are recorded")
                first.kill()
        with run.agent(*command) as world:
            digest = run.digest()
            assert world.wait(60) == 0
        assert ("back: world" in run.output) == kill
    return digest, Recording(next(run.out.glob("*/")))


def test_it_has_at_most_80_lines_of_code() -> None:
    lines = [line.strip() for line in WORLD.read_text("utf-8").splitlines()]
    assert 40 < sum(bool(line) and not line.startswith("#") for line in lines) <= 80


def test_killed_and_started_again_it_goes_on_with_the_same_digest(tmp_path: Path) -> None:
    scenario = tmp_path / "bare.toml"
    scenario.write_text(worlds.BARE, "utf-8")
    (digest, recording), (again, _) = (
        played(scenario, tmp_path / name, 90, kill=kill) for name, kill in (("whole", False), ("cut", True))
    )
    assert again == digest
    scenes = [frame.scene() for frame in recording]
    there = [scene.names for scene in scenes if scene is not None]
    assert there[0] == ("car", "truck.0", "uav")
    assert there[70] == ("car", "uav")
    # The mesh of the truck came while the run went on.
    assert scenes[0] is not None
    assert is_mesh_name(scenes[0].assets[1])
    assert set(recording.meshes) == {scenes[0].assets[1]}


@pytest.mark.exhaustive
def test_a_run_of_300_frames_with_channel_lidar_link_and_recorder_and_the_same_digest_after_a_kill(
    tmp_path: Path,
) -> None:
    digest, recording = played(SCENARIO, tmp_path / "whole", worlds.FRAMES)
    assert played(SCENARIO, tmp_path / "cut", worlds.FRAMES, kill=True)[0] == digest
    assert len(recording) == worlds.FRAMES
    topics = {product.provenance.topic for product in recording.frame(0, worlds.FRAMES - 1).products}
    assert topics == {"scene", "channel", "lidar", "action", "link"}
    lidar = recording.product(0, 20, "lidar", "lidar")
    assert isinstance(lidar, Lidar)
    assert {"ground", "building"} <= {lidar.object_names[i] for i in lidar.scans[0].object.tolist()}


@pytest.mark.exhaustive
def test_the_first_world_of_the_guide_plays_the_scenario_of_the_guide(tmp_path: Path) -> None:
    page = ROOT / "docs" / "howto" / "python-client.md"
    for _, text in blocks(page):
        if found := re.match(r"# (street\.\w+)\n", text):
            (tmp_path / found[1]).write_text(text, "utf-8")
    with worlds.waiting_run(tmp_path / "street.toml", tmp_path, frames=20) as run:
        with run.agent(sys.executable, str(tmp_path / "street.py"), run.endpoint, "world"):
            run.digest()
        recording = Recording(next(run.out.glob("*/")))
    last = recording.frame(0, 19).scene()
    assert last is not None
    assert [device.name for device in last.devices] == ["bs", "car/rx"]
