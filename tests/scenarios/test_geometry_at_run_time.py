"""Meshes that an engine brings while it runs, with real processes, the ray tracer, and a kill in between."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scenarios_support import caviar, eventually, pid_of, recorded_below, run, running

from caviar_protocol.geometry import is_mesh_name
from caviar_protocol.recording import Recording

pytestmark = pytest.mark.slow

TRACED = """use = "sionna-rt"
budget_ms = 60000

[services.channel.settings]
samples = 20000
max_depth = 1
bodies = 4"""
SCENARIO = """
[run]
name = "spawning"
frames = {frames}
record = ["channel"{lidar}]
max_faces = 500

[timeouts]
connect_s = 120.0
rejoin_s = 60.0

[[carriers]]
name = "c"
frequency_hz = 3.5e9

[services.world]
role = "world"
use = "spawner:{world}"
budget_ms = 2000

[services.world.settings]
{settings}

[services.channel]
role = "channel"
{channel}

[services.recorder]
role = "recorder"
use = "mcap"
budget_ms = 5000

[[devices]]
name = "bs"
kind = "antenna"
role = "tx"
position_m = [0.0, 0.0, 5.0]

[[devices]]
name = "rx"
kind = "antenna"
role = "rx"
position_m = [30.0, 3.6, 1.5]
"""
GEOMETRIC = 'use = "free-space"\nbudget_ms = 2000'


def scenario(
    folder: Path,
    *,
    channel: str = GEOMETRIC,
    frames: int = 12,
    world: str = "Spawning",
    extra: str = "",
    **settings: Any,
) -> Path:
    said = "\n".join(f"{key} = {json.dumps(value)}" for key, value in settings.items())
    path = folder / "spawning.toml"
    text = SCENARIO.format(frames=frames, world=world, settings=said, channel=channel, lidar="")
    path.write_text(text + extra)
    return path


def digest_of(directory: Path) -> str:
    return str(json.loads((directory / "summary.json").read_text())["digest"])


def test_a_recording_has_the_meshes_and_its_replay_announces_them_again(tmp_path: Path) -> None:
    path = scenario(tmp_path, objects=6, meshes=2, first=3, last=8, wrong=["nan"])
    whole = run(path, tmp_path / "whole", timeout=120)
    assert whole.status == 0, whole.output
    embedded = run(path, tmp_path / "embedded", "--embedded", timeout=120)
    assert embedded.status == 0, embedded.output
    assert digest_of(whole.directory) == digest_of(embedded.directory)
    recording = Recording(whole.directory)
    used = {name for name in recording["scene"].assets.ravel().tolist() if name}
    assert len(recording.meshes) == 2 < len(used) == 3, "the one that is none was refused, and is not kept"
    assert [asset.name for asset in recording.metadata.assets if is_mesh_name(asset.name)] == []
    again = caviar("replay", whole.directory, "--out", tmp_path / "again", timeout=120)
    assert again.status == 0, again.output
    directory = next((tmp_path / "again").glob("*/"))
    assert digest_of(directory) == digest_of(whole.directory)
    assert Recording(directory).meshes.keys() == recording.meshes.keys()
    refused = json.loads((whole.directory / "summary.json").read_text())
    assert "nan" in json.dumps(refused).lower() or "mesh-refused" in json.dumps(refused)


@pytest.mark.channel
def test_paths_off_spawned_objects_come_with_their_frame_and_a_killed_channel_changes_nothing(
    tmp_path: Path,
) -> None:
    path = scenario(tmp_path, channel=TRACED, frames=16, objects=9, meshes=3, first=5, last=9)
    whole = run(path, tmp_path / "whole", timeout=240)
    assert whole.status == 0, whole.output
    off = [spawned_in(Recording(whole.directory), frame) for frame in range(16)]
    assert [frame for frame, names in enumerate(off) if names] == [5, 6, 7, 8, 9]
    out = tmp_path / "broken"
    out.mkdir()
    with running(path, out) as (process, mark):
        eventually(lambda: recorded_below(out) >= 5, 200, "the frame before the change is recorded")
        os.kill(pid_of(mark, "caviar_services channel"), signal.SIGKILL)
        output, _ = process.communicate(timeout=240)
    assert process.returncode == 0, output
    assert digest_of(next(out.glob("*/"))) == digest_of(whole.directory)


def spawned_in(recording: Recording, frame: int) -> set[str]:
    """Objects by way of which paths of a frame come."""
    from caviar_protocol.topics import Channel

    item = next(i for i in recording.frame(0, frame).products if i.provenance.topic == "channel")
    channel = item.payload
    assert isinstance(channel, Channel)
    met = np.unique(channel.objects)
    return {
        channel.object_names[i]
        for i in met[met >= 0].tolist()
        if channel.object_names[i].startswith("spawned")
    }
