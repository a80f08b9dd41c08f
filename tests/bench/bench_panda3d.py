"""What a frame of the world ``panda3d`` costs: its physics, and the pictures of its renderer.

Run as ``python tests/bench/bench_panda3d.py [--frames N] [--munich] [--wall] [--markdown FILE]``. Objects and
level are those of the scenario ``panda3d``; with ``--munich`` also Munich, with 38,936 triangles.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from caviar_bridges.panda3d.world import Panda3dSettings, Panda3dWorld
from caviar_protocol.scenario import DeviceSpec, load_scenario
from caviar_protocol.scenario.conversion import convert_settings
from caviar_services.service import Frame, Preparation, RunInfo

SCENARIOS = Path(__file__).resolve().parents[2] / "deploy" / "caviar_scenarios"
SIZES = ((320, 240), (640, 480), (1280, 720))
COLUMNS = ("of a frame", "CPU ms, median", "wall ms, median", "wall ms, 99 %", "frames/s")
"""The last three with ``--wall``, which says something on a machine that does nothing else."""


def camera(size: tuple[int, int], munich: bool) -> DeviceSpec:
    """A camera that looks along a street."""
    place: dict[str, Any] = (
        {"position_m": (-62.0, -84.0, 9.0), "yaw_deg": 160.0, "pitch_deg": 12.0}
        if munich
        else {"position_m": (-86.0, 5.0, 7.0), "yaw_deg": -4.0, "pitch_deg": 6.0}
    )
    return DeviceSpec(name="camera", kind="camera", size_px=size, field_of_view_deg=70.0, **place)


def measured(settings: Panda3dSettings, frames: int, *devices: DeviceSpec) -> tuple[str, ...]:
    """Cells of a row: the times of the frames of one episode, after ten that are not counted."""
    world = Panda3dWorld(settings, RunInfo(name="world", devices=devices))
    world.prepare(Preparation(demand={"camera": frozenset()} if devices else {}))
    world.reset(0, 1, 0)
    cpu, wall = [], []
    for number in range(frames + 10):
        began = time.process_time(), time.perf_counter()
        world.step(Frame(episode=0, number=number, t_ns=number * 100_000_000))
        cpu.append(1e3 * (time.process_time() - began[0]))
        wall.append(1e3 * (time.perf_counter() - began[1]))
    world.close()
    middle, slow = np.percentile(wall[10:], [50, 99])
    return (f"{np.median(cpu[10:]):.1f}", f"{middle:.1f}", f"{slow:.1f}", f"{1e3 / middle:.0f}")


def main() -> None:
    """Measure, print, and write where asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--munich", action="store_true", help="pictures of Munich too")
    parser.add_argument("--wall", action="store_true", help="wall times and frames a second too")
    parser.add_argument("--markdown", type=Path, help="file for the table")
    args = parser.parse_args()
    scenario = load_scenario(SCENARIOS / "panda3d.toml")
    settings = convert_settings(Panda3dSettings, scenario.services["engine"].settings)
    rows = [("physics alone: 4 vehicles, 1 UAV", *measured(settings, args.frames))]
    for size in SIZES:
        label = f"and a picture of {size[0]}×{size[1]}"
        rows.append((label, *measured(settings, args.frames, camera(size, munich=False))))
    if args.munich:
        munich = replace(settings, model="", scenery="sionna:munich")
        rows.append(
            (
                "and a picture of 640×480 in Munich",
                *measured(munich, args.frames, camera((640, 480), munich=True)),
            )
        )
    lines = [COLUMNS, ("---",) * len(COLUMNS), *rows]
    shown = len(COLUMNS) if args.wall else 2
    text = "\n".join("| " + " | ".join(cells[:shown]) + " |" for cells in lines)
    print(text)
    if args.markdown:
        args.markdown.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
