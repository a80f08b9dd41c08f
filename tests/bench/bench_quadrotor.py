"""CPU time of world ``flight`` in a frame of 100 ms, by dynamics of its UAV.

Run as ``python tests/bench/bench_quadrotor.py [--frames 300] [--rounds 5] [--markdown FILE]``. A UAV flies to
a waypoint at 60 m; beside a wall, one flies along it at half a metre. Each number is that of the round with
the least time: what other processes of the machine take is not the world's. MuJoCo, where it is installed.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import importlib.util
import time
from pathlib import Path

import numpy as np

from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.spec import table
from caviar_protocol.topics import Action, WaypointCommand
from caviar_services.service import Frame, FrameInput, RunInfo
from caviar_services.world.flight import FlightSettings, FlightWorld, FlownObject
from caviar_services.world.quadrotor.surroundings import Wind
from caviar_space.obstacles import Obstacles

PERIOD_NS = 100_000_000
WIND = Wind(velocity_m_s=(8.0, 0.0, 0.0))
GUSTS = Wind(velocity_m_s=(8.0, 0.0, 0.0), gusts="dryden")


def uav(**changes: object) -> FlownObject:
    """A UAV in free air."""
    plain: dict[str, object] = {
        "name": "uav",
        "start_m": (0.0, 0.0, 30.0),
        "max_speed_m_s": 12.0,
        "max_acceleration_m_s2": 4.0,
        "dynamics": "quadrotor",
    }
    return FlownObject(**{**plain, **changes})  # type: ignore[arg-type]


def facade() -> Obstacles:
    """60 m × 40 m of triangles with sides of a metre, half a metre beside the ball on its line of flight."""
    x, z = np.meshgrid(np.arange(60.0), np.arange(40.0), indexing="ij")
    corner = np.stack([x, np.full_like(x, 0.95), z], axis=-1).reshape(-1, 1, 3)
    lower = corner + np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]])
    upper = corner + np.array([[1, 0, 0], [1, 0, 1], [0, 0, 1]])
    return Obstacles(np.concatenate([lower, upper]))


def milliseconds(world: FlightWorld, frames: int) -> float:
    """Mean CPU time of a frame [ms]."""
    world.reset(0, 1, 0)
    command = WaypointCommand(object="uav", position=(60.0, 0.0, 30.0), speed=8.0)
    entry = GrantInput(topic="action", source="a", status=Status.FRESH, frame=0)
    inputs = (FrameInput(entry, payload=Action(commands=(command,))),)
    world.step(Frame(episode=0, number=0, t_ns=0))
    begin = time.process_time()
    for number in range(1, frames + 1):
        world.step(
            Frame(episode=0, number=number, t_ns=number * PERIOD_NS, previous=number - 1, inputs=inputs)
        )
    return (time.process_time() - begin) / frames * 1e3


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--markdown", type=Path, help="write the table of the documentation there")
    args = parser.parse_args()
    cases = {
        "a point": (uav(dynamics="point"), Wind(), False),
        "a quadrotor in wind": (uav(), WIND, False),
        "with gusts": (uav(), GUSTS, False),
        "with gusts, half a metre beside a wall": (uav(), GUSTS, True),
    }
    if importlib.util.find_spec("mujoco") is not None:
        cases["with gusts, engine `mujoco`"] = (uav(engine="mujoco"), GUSTS, False)
    rows = []
    for name, (thing, wind, wall) in cases.items():
        world = FlightWorld(FlightSettings(flown=(thing,), wind=wind), RunInfo(name="world"))
        if wall:
            world._fleet.obstacles["uav"] = facade()
        best = min(milliseconds(world, args.frames) for _ in range(args.rounds))
        rows.append((name, f"{best:.2f}"))
    text = table(("dynamics", "CPU ms a frame of 100 ms"), rows)
    print(text)
    if args.markdown:
        args.markdown.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
