"""The ray-traced rungs beside each other: time and agreement, in the street canyon with its traffic.

    python tests/bench/bench_ladder.py --json ladder.json

Takes frames of ``street-canyon`` with more receivers and arrays of other sizes, and
gives the same frames to every rung. Prints the time of ``spherical`` beyond ``siso-rt`` as a part of the
time of ``mimo-rt``, the NMSE of H of both against ``mimo-rt`` for receivers whose paths all element pairs
have and for the rest, and the time of a whole ``spherical`` frame with 64×64 elements in ratio to 64×2.

With few rays ``mimo-rt`` itself is noisy: a small face far away is met by rays from one element and
missed by those from its neighbour. So the figures are given for more than one number of rays.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
import importlib
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import msgspec
import numpy as np

from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario import Scenario, load_scenario
from caviar_protocol.topics import AntennaArray, AntennaDevice, Channel, Scene
from caviar_services.channel.arrays.mimo_rt import ElementTracer
from caviar_services.channel.base import ChannelModel, ChannelSettings, Modelled
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

SCENARIO = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "street-canyon.toml"


class Anything(ChannelSettings, frozen=True, kw_only=True):
    """Settings of the channel whose place is taken."""


class Onlooker(ChannelModel[Anything]):
    """Keeps what a channel service is given, and models nothing."""

    Settings: ClassVar[type[ChannelSettings]] = Anything
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
    """Frames of the scenario, and what its channel service gets before them."""

    run: RunInfo
    preparation: Preparation
    settings: dict[str, Any]
    scenes: tuple[Scene, ...]


def world(first: int, frames: int, receivers: int, seed: int | None = None) -> World:
    """Scenes of the scenario, from a frame on, with more vehicles that carry receivers.

    Args:
        first: Number of the first frame.
        frames: Number of scenes.
        receivers: Number of vehicles that carry a receiver.
        seed: Of the run; the scenario's, if ``None``.
    """
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
    if seed is not None:
        shorter = msgspec.structs.replace(shorter, seed=seed)
    _play(msgspec.structs.replace(scenario, run=shorter, services=alone, devices=devices))
    run, preparation, *scenes = Onlooker.seen
    preparation = Preparation(demand={"channel": frozenset({"h"})}, assets=preparation.assets)
    return World(run, preparation, settings, tuple(scenes[first:]))


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


def seen_by_all(counts: np.ndarray[Any, Any], product: Channel, elements: int) -> np.ndarray[Any, Any]:
    """Receivers whose paths all element pairs have: as many as there are between the centres."""
    paths = np.diff(product.offsets)
    alike: np.ndarray[Any, Any] = (counts.reshape(len(paths), elements, -1) == paths[:, None, None]).all(
        (1, 2)
    )
    return alike


def agreement(at: World, rungs: dict[str, Rung], frames: int, transmit: int, receive: int) -> dict[str, Any]:
    """Time of all rungs and NMSE of the lower ones against ``mimo-rt``."""
    reference = rungs["mimo-rt"]
    tracers: list[ElementTracer] = []
    original = reference.model._matrices

    def kept(*arguments: Any) -> Any:
        tracers.append(original(*arguments))  # type: ignore[arg-type]
        return tracers[-1]

    reference.model._matrices = kept  # type: ignore[method-assign, assignment]
    errors: dict[str, list[Any]] = {"siso-rt": [], "spherical": []}
    times: dict[str, list[float]] = {name: [] for name in rungs}
    every: list[Any] = []
    for number in range(frames):
        scene = with_arrays(at.scenes[number], transmit, receive)
        truth, took = reference(scene, number)
        times["mimo-rt"].append(took)
        every.append(seen_by_all(tracers[-1].counts[0], truth, receive))
        for name, found in errors.items():
            found.append(nmse_db(rungs[name](scene, number)[0], truth))
    for number in range(10 * frames):  # in turn, so that both meet the same disturbances
        scene = with_arrays(at.scenes[number % frames], transmit, receive)
        for name in errors:
            times[name].append(rungs[name](scene, number)[1])
    beyond = np.median(np.subtract(times["spherical"], times["siso-rt"]))
    whole = {name: float(np.median(values)) for name, values in times.items()}
    alike = np.concatenate(every)
    rows: dict[str, Any] = {
        "receivers": len(alike),
        "time_ms": {name: 1e3 * value for name, value in whole.items()},
        "spherical_beyond_siso_ms": 1e3 * float(beyond),
        "mimo_over_spherical_beyond_siso": whole["mimo-rt"] / max(float(beyond), 1e-9),
        "mimo_over_spherical_end_to_end": whole["mimo-rt"] / whole["spherical"],
        "receivers_that_all_elements_see": float(alike.mean()),
    }
    for name, found in errors.items():
        values = np.concatenate(found)
        rows[f"nmse_db_{name}"] = {
            "all_see": _spread(values[alike]),
            "rest": _spread(values[~alike]),
        }
    return rows


def _spread(values: np.ndarray[Any, Any]) -> dict[str, float]:
    if not len(values):
        return {}
    return {"best": float(values.min()), "median": float(np.median(values)), "worst": float(values.max())}


def growth(at: World, rung: Rung, frames: int) -> dict[str, float]:
    """Whole frames of 64×64 elements beside frames of 64×2, in turn."""
    times = np.array(
        [
            [rung(with_arrays(at.scenes[number % len(at.scenes)], 64, size), number)[1] for size in (2, 64)]
            for number in range(frames)
        ]
    )
    small, large = np.median(times[1:], axis=0)
    return {"ms_64x2": 1e3 * small, "ms_64x64": 1e3 * large, "ratio": large / small}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=3, help="scenes; mimo-rt is played each of them once")
    parser.add_argument("--first", type=int, default=140, help="frame of the scenario to begin with")
    parser.add_argument("--receivers", type=int, default=24, help="at most; as many as there are vehicles")
    parser.add_argument("--samples", type=int, nargs="+", default=[100_000, 4_000_000])
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args()
    at = world(options.first, options.frames, options.receivers)
    figures: dict[str, Any] = {}
    for samples in options.samples:
        rungs = {name: Rung(at, rung=name, samples=samples) for name in ("siso-rt", "spherical", "mimo-rt")}
        found = agreement(at, rungs, options.frames, 16, 4)
        found["spherical_frame"] = growth(at, rungs["spherical"], 16)
        figures[str(samples)] = found
        print(f"--- {samples:,} rays")
        print(json.dumps(found, indent=2))
    if options.json:
        options.json.write_text(json.dumps(figures, indent=2))


if __name__ == "__main__":
    # The scenario names a class of this file, so it has to be importable by its name.
    sys.path.insert(0, str(Path(__file__).parent))
    importlib.import_module(Path(__file__).stem).main()
