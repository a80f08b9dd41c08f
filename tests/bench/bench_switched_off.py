"""Time of a frame with options that cannot contribute, left on and switched off, as the channel does.

    python tests/bench/bench_switched_off.py --json switched_off.json

The same ten receivers; the paths found are compared bit by bit.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import numpy as np

from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.topics import AntennaDevice, Carrier, Channel, Scene
from caviar_services.channel.sionna import model as sionna_model
from caviar_services.channel.sionna.ray_launcher import LaunchOptions
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo
from caviar_space.materials import UsedSurfaces
from caviar_space.scenery import scenery_assets

METAL = {
    name: {"relative_permittivity": 1.0, "conductivity_s_per_m": 1e7}
    for name in ("brick", "concrete", "glass", "marble", "wood")
}
"""Everything is of metal."""

CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "refraction, street canyon of metal": (
        "simple_street_canyon",
        {"refraction": True, "materials": METAL},
    ),
    "scattering, street canyon": ("simple_street_canyon", {"scattering": True}),
    "diffraction, floor and wall": ("floor_wall", {"diffraction": True}),
    "no surfaces": ("", {}),
}
FIELDS = ("offsets", "id", "a", "tau", "interactions", "points", "objects", "los")


def left_on(
    options: LaunchOptions, surfaces: UsedSurfaces, frequencies: Sequence[float]
) -> tuple[LaunchOptions, tuple[str, ...]]:
    """In place of `contributing`."""
    return options, ()


def prepared(scenery: str, settings: dict[str, Any]) -> tuple[sionna_model.SionnaChannel, tuple[str, ...]]:
    """A model, and the notes on what was switched off."""
    named = scenery_assets(f"sionna:{scenery}") if scenery else {}
    assets = {name: file for name, file in named.items() if isinstance(file, Path)}
    run = RunInfo(name="channel", seed=1, carriers=(Carrier(name="c", frequency_hz=28e9),))
    model = sionna_model.SionnaChannel(msgspec.convert({"bodies": 0, **settings}, SionnaSettings), run)
    notes = model.prepare(Preparation(demand={"channel": frozenset()}, assets=assets)).notes
    return model, tuple(note for note in notes if "switched off" in note)


def standing() -> Frame:
    """A frame with a transmitter and ten receivers."""
    places = np.random.default_rng(2).uniform((-20, -4, 1), (20, 4, 4), (10, 3)).tolist()
    antennas = [
        AntennaDevice(name=f"r{i}", role="rx", position=(x, y, z)) for i, (x, y, z) in enumerate(places)
    ]
    empty = np.zeros((0, 3))
    scene = Scene(
        names=(),
        classes=(),
        assets=(),
        position=empty,
        orientation=np.zeros((0, 4)),
        velocity=empty,
        dimensions=empty,
        devices=(*antennas, AntennaDevice(name="t", role="tx", position=(-25.0, 1.0, 6.0))),
    )
    source = FrameInput(GrantInput(topic="scene", source="world", status=Status.FRESH), payload=scene)
    return Frame(episode=0, number=0, t_ns=0, inputs=(source,))


def timed(model: sionna_model.SionnaChannel, frame: Frame) -> tuple[float, Channel]:
    """Time [ms] and product of a frame."""
    begin = time.perf_counter()
    channel = model.step(frame).products["channel"]
    assert isinstance(channel, Channel)
    return (time.perf_counter() - begin) * 1e3, channel


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--json", type=Path, help="write the rows here")
    options = parser.parse_args()
    rows = []
    for case, (scenery, settings) in CASES.items():
        without, notes = prepared(scenery, settings)
        with mock.patch.object(sionna_model, "contributing", left_on):
            full, _ = prepared(scenery, settings)
        times = np.zeros((options.frames, 2))
        for number in range(options.frames):  # in turn: what else the machine does slows both
            times[number, 0], channel = timed(without, standing())
            times[number, 1], reference = timed(full, standing())
        off, on = np.median(times, axis=0).tolist()
        same = all(getattr(channel, f).tobytes() == getattr(reference, f).tobytes() for f in FIELDS)
        rows.append(
            {"case": case, "notes": notes, "on_ms": on, "off_ms": off, "factor": on / off, "same_paths": same}
        )
        print(json.dumps(rows[-1], ensure_ascii=False), flush=True)
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2, ensure_ascii=False) + "\n", "utf-8")


if __name__ == "__main__":
    main()
