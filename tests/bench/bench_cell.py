"""Time of the link ``cell`` a frame, beside that of ``beams`` on the same frames, in one process.

Run as ``python tests/bench/bench_cell.py [--users 10] [--slots 1 10 20] [--nr] [--selective]
[--markdown FILE]``. All links get the same scenes, channels of the geometric model and choices of
``los-beam``, in turn; what a frame takes is the median over all frames, encoding and digest included.
"""

# ruff: noqa: T201 - a command that prints what it measured

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Payload
from caviar_protocol.cell.traffic import Traffic
from caviar_protocol.codec import encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.space.coordinates import quaternion_from_euler
from caviar_protocol.spec import table
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Scene
from caviar_services.agent.base import AgentSettings
from caviar_services.agent.baselines import LosBeamAgent
from caviar_services.channel.statistical.geometric import GeometricChannel
from caviar_services.channel.statistical.waves import GeometricSettings
from caviar_services.link.beams import BeamLink, BeamLinkSettings
from caviar_services.link.cell import CellLink
from caviar_services.link.terminals import CellSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo, Service

PERIOD_NS = 10_000_000
CARRIER = Carrier(name="mmwave", frequency_hz=28e9, bandwidth_hz=100e6)


def scene(number: int, users: int, stations: int) -> Scene:
    """Cars on a circle around the base stations."""
    names = tuple(f"car.{index:02}" for index in range(users))
    angle = 2 * np.pi * np.arange(users) / users + 1e-3 * number
    position = np.stack([40 * np.cos(angle), 40 * np.sin(angle), np.full(users, 0.75)], 1)
    devices = [
        AntennaDevice(
            name=f"bs.{index}",
            role="tx",
            position=(10.0 * index, 0.0, 10.0),
            orientation=quaternion_from_euler(math.pi * index),
            array=AntennaArray(columns=64),
            power_dbm=30.0,
        )
        for index in range(stations)
    ]
    devices += [
        AntennaDevice(name=f"{name}/rx", role="rx", parent=name, position=(0, 0, 1)) for name in names
    ]
    return Scene(
        names=names,
        classes=("car",) * users,
        assets=("",) * users,
        position=position,
        orientation=np.array([[1.0, 0, 0, 0]] * users),
        velocity=np.zeros((users, 3)),
        dimensions=np.full((users, 3), 2.0),
        devices=tuple(devices),
    )


def granted(number: int, service: str, payloads: Mapping[str, Payload]) -> Frame:
    """A frame with these inputs."""
    inputs = tuple(
        FrameInput(GrantInput(topic=topic, source=topic, status=Status.FRESH, frame=number), payload=payload)
        for topic, payload in payloads.items()
    )
    return Frame(
        episode=0,
        number=number,
        t_ns=number * PERIOD_NS,
        previous=number - 1,
        inputs=inputs,
        service=service,
        seed=1,
    )


def inputs(frames: int, users: int, stations: int) -> Iterator[dict[str, Payload]]:
    """What the links get in each frame."""
    channel = GeometricChannel(GeometricSettings(normalization="path-loss"), run_info("channel"))
    channel.prepare(Preparation(demand={"channel": frozenset({"h"})}))
    agent = LosBeamAgent(AgentSettings(), run_info("agent"))
    for number in range(frames):
        world = {"scene": scene(number, users, stations)}
        found = channel.step(granted(number, "channel", world)).products["channel"]
        action = agent.step(granted(number, "agent", world)).products["action"]
        yield {**world, "channel": found, "action": action}


def run_info(name: str) -> RunInfo:
    """A run at 28 GHz."""
    return RunInfo(name=name, seed=1, sampling_period_ns=PERIOD_NS, carriers=(CARRIER,))


def timed(links: Sequence[Service[Any]], frames: Sequence[dict[str, Payload]]) -> list[float]:
    """Median time of a frame [ms] of each link, with encoding and digest."""
    times: list[list[float]] = [[] for _ in links]
    for link in links:
        link.reset(0, 1, 0)
    for number, payloads in enumerate(frames):
        for link, measured in zip(links, times, strict=True):
            frame = granted(number, "link", payloads)
            begun = time.perf_counter()
            payload_digest(*encode_payload(link.step(frame).products["link"]))
            measured.append(time.perf_counter() - begun)
    return [1e3 * statistics.median(rows) for rows in times]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--users", type=int, default=10)
    parser.add_argument("--stations", type=int, default=1)
    parser.add_argument("--slots", type=int, nargs="+", default=[1, 10, 20])
    parser.add_argument("--frames", type=int, default=400)
    parser.add_argument("--load", type=float, default=0.5, help="of traffic, of what a lone user could get")
    parser.add_argument("--nr", action="store_true", help="also with Sionna SYS (extra `system`)")
    parser.add_argument("--selective", action="store_true", help="also with H of each slot")
    parser.add_argument("--markdown", type=Path, help="where the table is written too")
    options = parser.parse_args()
    frames = list(inputs(options.frames, options.users, options.stations))
    traffic = Traffic(model="poisson", rate_bit_s=options.load * 500e6 / options.users, max_age_s=0.1)
    cells = {
        f"cell, shannon, {slots} slot{'s' * (slots > 1)}": CellSettings(traffic=(traffic,), slots=slots)
        for slots in options.slots
    }
    if options.selective:
        cells |= {
            f"cell, shannon, {slots} slot{'s' * (slots > 1)}, H of each": CellSettings(
                traffic=(traffic,), slots=slots, selective=("time",)
            )
            for slots in options.slots
        }
    if options.nr:
        cells |= {
            f"cell, nr, {slots} slot{'s' * (slots > 1)}": CellSettings(
                traffic=(traffic,), slots=slots, rate_model="nr"
            )
            for slots in options.slots
        }
    beams = BeamLink(BeamLinkSettings(), run_info("link"))
    links: list[Service[Any]] = [
        beams,
        *(CellLink(settings, run_info("link")) for settings in cells.values()),
    ]
    for link in links:
        link.prepare(Preparation(demand={"link": frozenset()}))
    base, *found = timed(links, frames)
    rows = [("beams", f"{base:.2f}", "")]
    rows += [(name, f"{ms:.2f}", f"{ms - base:.2f}") for name, ms in zip(cells, found, strict=True)]
    stations = f", {options.stations} base stations" if options.stations > 1 else ""
    head = (f"link, {options.users} users{stations}", "ms a frame", "more than beams")
    text = f"## Times\n\n{table(head, rows)}\n"
    print(text)
    if options.markdown:
        options.markdown.write_text(text, "utf-8")


if __name__ == "__main__":
    main()
