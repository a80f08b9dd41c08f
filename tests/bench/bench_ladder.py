"""The ray-traced rungs beside each other: time and agreement, in the street canyon with its traffic.

    python tests/bench/bench_ladder.py --json ladder.json

Takes frames of ``deploy/scenarios/street-canyon.toml`` with more receivers and arrays of other sizes, and
gives the same frames to every rung. Prints the time of ``spherical`` beyond ``siso-rt`` as a part of the time of
``mimo-rt``, the NMSE of H of both against ``mimo-rt`` for receivers of which all elements see all paths and
for the rest, and the time of a whole ``spherical`` frame with 64×64 elements in ratio to 64×2.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import msgspec
import numpy as np

from caviar_clients.embedded.run import EmbeddedRun
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario_loader import load_scenario
from caviar_protocol.topics import AntennaArray, AntennaDevice, Channel, Scene
from caviar_services.channel.base import ChannelModel, Modelled
from caviar_services.channel.sionna_rt import SionnaChannel, SionnaSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

SCENARIO = Path(__file__).parents[2] / "deploy" / "scenarios" / "street-canyon.toml"


class Anything(msgspec.Struct, frozen=True):
    """Settings of the channel whose place is taken."""


class Onlooker(ChannelModel[Anything]):
    """Keeps what a channel service is given, and models nothing."""

    Settings: ClassVar[type[msgspec.Struct]] = Anything
    rung = "none"
    uses_scenery: ClassVar[bool] = True
    seen: ClassVar[list[Any]] = []

    def load(self, preparation: Preparation) -> tuple[str, ...]:
        self.seen[:] = [self.run, preparation]
        return ()

    def model(
        self,
        frame: Frame,
        scene: Scene,
        transmitters: Sequence[AntennaDevice],
        receivers: Sequence[AntennaDevice],
    ) -> Modelled:
        self.seen.append(scene)
        channel = Channel(
            rung=self.rung,
            carriers=self.run.carriers,
            tx=tuple(device.name for device in transmitters),
            rx=tuple(device.name for device in receivers),
            los=np.zeros((len(transmitters), len(receivers)), bool),
            offsets=np.zeros(len(transmitters) * len(receivers) + 1, np.int64),
            object_names=(),
            id=np.zeros(0, np.uint64),
            a=np.zeros((len(self.run.carriers), 0), np.complex128),
            tau=np.zeros(0),
            aod=np.zeros((0, 2)),
            aoa=np.zeros((0, 2)),
            doppler=np.zeros((len(self.run.carriers), 0)),
            interactions=np.zeros((0, 0), np.uint8),
            points=np.zeros((0, 0, 3)),
            objects=np.zeros((0, 0), np.int32),
        )
        return Modelled(channel=channel)


@dataclass(frozen=True)
class World:
    """Frames of the scenario, and what its channel service is told before them."""

    run: RunInfo
    preparation: Preparation
    settings: dict[str, Any]
    scenes: tuple[Scene, ...]


def world(first: int, frames: int, receivers: int) -> World:
    """Scenes of the scenario, from a frame on, with more vehicles that carry receivers."""
    scenario = load_scenario(SCENARIO)
    settings = scenario.services["channel"].settings
    alone = {
        "traffic": scenario.services["traffic"],
        "recorder": scenario.services["recorder"],
        "channel": msgspec.structs.replace(
            scenario.services["channel"], use=f"{__name__}:{Onlooker.__name__}", settings={}
        ),
    }
    devices = tuple(
        msgspec.structs.replace(device, count=receivers) if device.name == "rx" else device
        for device in scenario.devices
        if device.kind == "antenna"
    )
    shorter = msgspec.structs.replace(scenario.run, frames=first + frames, record=("channel",))
    _play(msgspec.structs.replace(scenario, run=shorter, services=alone, devices=devices))
    run, preparation, *scenes = _module().Onlooker.seen
    preparation = Preparation(demand={"channel": frozenset({"h"})}, assets=preparation.assets)
    return World(run, preparation, settings, tuple(scenes[first:]))


def _module() -> Any:
    import importlib

    return importlib.import_module(__name__)


def _play(scenario: Scenario) -> None:
    with TemporaryDirectory() as folder:
        EmbeddedRun(scenario, Path(folder)).run()


def with_arrays(scene: Scene, transmit: int, receive: int) -> Scene:
    """The scene with arrays of these many elements in a row."""

    def device(item: Any) -> Any:
        columns = transmit if item.role == "tx" else receive
        array = AntennaArray(columns=columns, pattern=item.array.pattern)
        return msgspec.structs.replace(item, array=array)

    return msgspec.structs.replace(scene, devices=tuple(device(item) for item in scene.devices))


class Rung:
    """A rung with settings of its own."""

    def __init__(self, at: World, **settings: Any) -> None:
        merged = msgspec.convert(at.settings | settings, SionnaSettings)
        self.model = SionnaChannel(merged, at.run)
        self.model.prepare(at.preparation)

    def __call__(self, scene: Scene, number: int) -> tuple[Channel, float]:
        """The product and the time it took [s]."""
        source = FrameInput(GrantInput(topic="scene", source="world", status=Status.FRESH), payload=scene)
        frame = Frame(episode=0, number=number, t_ns=number * 100_000_000, inputs=(source,))
        begin = time.perf_counter()
        result = self.model.step(frame)
        took = time.perf_counter() - begin
        channel = result.products["channel"]
        assert isinstance(channel, Channel)
        return channel, took


def nmse_db(got: Channel, reference: Channel) -> np.ndarray[Any, Any]:
    """Of each receiver's H [dB]."""
    values = []
    for one, other in zip(got.h, reference.h, strict=True):
        power = float((np.abs(other.h) ** 2).sum())
        error = float((np.abs(one.h - other.h) ** 2).sum())
        values.append(10 * np.log10(max(error, 1e-30) / power) if power else (-300.0 if not error else 300.0))
    return np.array(values)


if __name__ == "__main__":
    import sys

    sys.path.insert(0, str(Path(__file__).parent))
    from bench_ladder import *  # noqa: F403

    at = world(140, 3, 24)
    print(
        at.run.name,
        len(at.scenes),
        at.settings,
        [len(s.devices) for s in at.scenes],
        [len(s.names) for s in at.scenes],
    )
