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

from caviar_broker.core import events as ev
from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.assets import is_mesh_name
from caviar_protocol.recording import Recording
from caviar_protocol.scenario import load_scenario

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
    path = scenario(tmp_path, objects=6, meshes=2, first=3, last=8, wrong=["nan", "faces", "none"], faces=600)
    whole = run(path, tmp_path / "whole", timeout=120)
    assert whole.status == 0, whole.output
    embedded = run(path, tmp_path / "embedded", "--embedded", timeout=120)
    assert embedded.status == 0, embedded.output
    assert digest_of(whole.directory) == digest_of(embedded.directory)
    recording = Recording(whole.directory)
    scenes = [frame.scene() for frame in recording.frames()]
    used = {name for scene in scenes if scene is not None for name in scene.assets if name}
    assert len(recording.meshes) == 2
    assert len(used) == 5, "objects with meshes that are none keep their names, and are boxes"
    told = [json.loads(line) for line in (whole.directory / "events.jsonl").read_text().splitlines()]
    reasons = sorted(line["text"] for line in told if line["kind"] == "refused")
    assert len(reasons) == 3
    for name in used - recording.meshes.keys():
        assert any(reason.startswith(name) for reason in reasons)
    for why in ("vertex 3 is at", "has 600 faces, the run takes 500", "has no faces"):
        assert any(why in reason for reason in reasons), reasons
    assert [asset.name for asset in recording.metadata.assets if is_mesh_name(asset.name)] == []
    again = caviar("replay", whole.directory, "--out", tmp_path / "again", timeout=120)
    assert again.status == 0, again.output
    directory = next((tmp_path / "again").glob("*/"))
    assert digest_of(directory) == digest_of(whole.directory)
    assert Recording(directory).meshes.keys() == recording.meshes.keys()


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
    directory = next(out.glob("*/"))
    told = [json.loads(line) for line in (directory / "events.jsonl").read_text().splitlines()]
    assert {line["service"] for line in told if line["kind"] == "back"} == {"channel"}
    assert digest_of(directory) == digest_of(whole.directory)


@pytest.mark.exhaustive
@pytest.mark.channel
def test_memory_is_flat_after_objects_with_meshes_of_their_own_went(tmp_path: Path) -> None:
    """Six waves of 50 objects with five meshes each, none of which was there before."""
    path = scenario(tmp_path, channel=TRACED, frames=6 * 32, objects=50, meshes=5, first=2, last=6, period=32)
    resident = []

    def note(finished: ev.FrameFinished) -> None:
        if finished.frame % 32 == 31:
            resident.append(int(Path("/proc/self/statm").read_text().split()[1]) * 4096 / 2**20)

    out = tmp_path / "run"
    out.mkdir()
    outcome = EmbeddedRun(load_scenario(str(path)), out, on_frame=note).run()
    assert outcome.error == ""
    assert len(Recording(out).meshes) == 30
    # The first wave compiles kernels.
    assert resident[-1] - resident[0] < 20, f"{resident} MiB after each wave"
    off = [frame for frame in range(6 * 32) if spawned_in(Recording(out), frame)]
    assert off == [32 * wave + frame for wave in range(6) for frame in range(2, 7)]


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
