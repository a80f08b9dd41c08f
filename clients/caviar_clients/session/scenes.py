"""Scenes without channels: those of a scenario's worlds, or of a recording.

Of a scenario only the worlds run, and the agents that steer them, embedded in this process and free of pace.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import msgspec
from msgspec.structs import replace

from caviar_clients.session.embedded import EmbeddedRun
from caviar_clients.session.prepared import PreparedScenario, names_class, prepare
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.messages import Input, Role
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.scenario import DeviceSpec, ServiceSpec
from caviar_protocol.scenario.rules import with_overrides
from caviar_protocol.topics import Carrier, Scene
from caviar_services.service import Preparation, Prepared, Service, StepResult

KEEPER = "tradeoff-scenes"
"""Name of the service that keeps the scenes."""


@dataclass(frozen=True, eq=False)
class Instant:
    """A scene, with number and simulated time of its frame."""

    frame: int
    t_ns: int
    scene: Scene


@dataclass(frozen=True, kw_only=True, eq=False)
class Scenes:
    """Scenes, and what channel models need to know beside them.

    Args:
        name: Name of the scenario.
        origin: Where the scenes are from, in words.
        instants: The scenes, in the order of their frames.
        carriers: Carriers of the scenario.
        devices: Devices of the scenario.
        assets: Files of scenery by asset name.
        services: Services of the scenario, for the settings of its channel and link.
        seed: Seed of the run.
        sampling_period_ns: Time from frame to frame [ns].
        consecutive: Scenes of frames that follow each other; empty where there are none.
    """

    name: str
    origin: str
    instants: tuple[Instant, ...]
    carriers: tuple[Carrier, ...]
    devices: tuple[DeviceSpec, ...]
    assets: Mapping[str, Path]
    services: Mapping[str, ServiceSpec]
    seed: int
    sampling_period_ns: int
    consecutive: tuple[Instant, ...] = ()

    def with_instants(self, instants: tuple[Instant, ...]) -> Scenes:
        """Return a copy with other instants."""
        return dataclasses.replace(self, instants=instants)

    def settings_of(self, role: Role, use: str) -> dict[str, Any]:
        """Return the settings of the scenario's first service that is this implementation; {} without one."""
        found = (s.settings for s in self.services.values() if (s.role, s.use) == (role, use))
        return dict(next(found, {}))


def scene_at(path: Path, frame: int = 0, prepared: PreparedScenario | None = None) -> Scenes:
    """Take the scene of one frame of the first episode, as the only instant.

    Args:
        path: Scenario file, run directory or segment.
        frame: Number of the frame.
        prepared: The scenario of that file; None: it is prepared here.

    Raises:
        ScenarioError: The scenario is wrong.
        RecordingError: The recording is wrong, or has no scene in this frame.
        RunError: There is no such frame, or the worlds fail.
    """
    if is_recording(path):
        recording = Recording(path)
        episode = recording.entry(0).episode if len(recording) else 0
        found = recorded_instants([recording.frame(episode, frame)])
        if not found:
            raise RecordingError(f"frame {frame} of {path} has no scene; choose another with --frame")
        return recorded_scenes(recording, found)
    prepared = prepared or prepare(path)
    scenario = prepared.scenario
    if not 0 <= frame < scenario.run.frames:
        last = scenario.run.frames - 1
        raise RunError(f"--frame {frame}: scenario {scenario.run.name!r} has the frames 0 to {last}")
    # A world's scene may depend on every frame before: the run is cut after the frame, not begun at it.
    scenario = with_overrides(scenario, frames=frame + 1)
    every = simulated_scenes(path, dataclasses.replace(prepared, scenario=scenario))
    return dataclasses.replace(every, instants=every.instants[-1:])


def is_recording(path: Path) -> bool:
    """Tell whether a path is a run directory or a segment, and not a scenario."""
    return path.is_dir() or path.suffix == ".mcap"


def recorded_scenes(recording: Recording, instants: Sequence[Instant]) -> Scenes:
    """Put scenes of a recording beside what its scenario says.

    Raises:
        RecordingError: The scenario in the metadata cannot be read.
    """
    metadata = recording.metadata
    try:
        scenario = metadata.scenario
        carriers = msgspec.convert(scenario.get("carriers", ()), tuple[Carrier, ...])
        devices = msgspec.convert(scenario.get("devices", ()), tuple[DeviceSpec, ...])
        found = msgspec.convert(scenario.get("services", {}), dict[str, ServiceSpec])
    except msgspec.ValidationError as error:
        path = recording.directory
        raise RecordingError(f"{path}: the scenario in its metadata cannot be read: {error}") from error
    # A recording may be a stranger's: a class that it names is not loaded.
    services = {name: spec for name, spec in found.items() if not names_class(spec)}
    return Scenes(
        name=metadata.name,
        origin=f"recording {recording.directory.name}",
        instants=tuple(instants),
        carriers=carriers,
        devices=devices,
        assets=recording.assets,
        services=services,
        seed=metadata.seed,
        sampling_period_ns=metadata.sampling_period_ns,
    )


def recorded_instants(frames: Iterable[RecordedFrame]) -> list[Instant]:
    """Collect the scenes of those frames that have one."""
    scenes = ((frame, frame.scene()) for frame in frames)
    return [Instant(frame.number, frame.t_ns, scene) for frame, scene in scenes if scene is not None]


def simulated_scenes(path: Path, prepared: PreparedScenario) -> Scenes:
    """Run the worlds of a scenario for an episode, and keep the scene of each frame.

    Args:
        path: The scenario, as the user calls it.
        prepared: The same, as `prepare` returns it.

    Raises:
        RunError: The worlds fail.
    """
    scenario = prepared.scenario
    preparations: list[Preparation] = []
    # A class and not an object: an embedded run makes its services itself, as any other run does.
    keeper = type("Keeper", (Keeper,), {"on_prepare": staticmethod(preparations.append)})
    run = EmbeddedRun(worlds_only(prepared), None, seats={KEEPER: keeper})
    seat, instants = run.seats[KEEPER], list[Instant]()
    for _ in run.steps():
        if seat.frame is not None:
            instants.append(Instant(seat.frame.number, seat.frame.t_ns, seat.frame.scene()))
            seat.answer(StepResult())
    if run.outcome is None or run.outcome.error:
        raise RunError(run.outcome.error if run.outcome else "the worlds ended without an outcome")
    return Scenes(
        name=scenario.run.name,
        origin=f"scenario {path.name}, {scenario.run.frames} frame{'s' * (scenario.run.frames != 1)}",
        instants=tuple(instants),
        carriers=scenario.carriers,
        devices=scenario.devices,
        assets=preparations[0].assets if preparations else {},
        services=scenario.services,
        seed=scenario.run.seed,
        sampling_period_ns=scenario.run.sampling_period_ns,
    )


def worlds_only(prepared: PreparedScenario) -> PreparedScenario:
    """Reduce a scenario to one episode of its worlds and of the agents that need no channel.

    An agent that takes a channel or sensors cannot decide here; what it steers stays as it starts. A service
    that keeps the scenes takes the place of all others.
    """
    scenario = prepared.scenario

    def is_kept(name: str, spec: ServiceSpec) -> bool:
        if spec.role != "agent" or spec.remote:
            return spec.role == "world"
        inputs = prepared.services[name].cls.inputs
        return {given.topic for given in inputs if given.required} <= {"scene"}

    kept = {name: spec for name, spec in scenario.services.items() if is_kept(name, spec)}
    budget_ms = 1e3  # never reached: nothing is late in an embedded run
    # It has the role of sensors, since these may take scenes without making anything of them.
    kept[KEEPER] = ServiceSpec(role="sensors", use=KEEPER, budget_ms=budget_ms)
    run = replace(scenario.run, episodes=1, record=(), pace="free")
    return PreparedScenario(
        replace(scenario, services=kept, run=run),
        {name: service for name, service in prepared.services.items() if name in kept},
    )


class KeeperSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The keeper has no settings."""


class Keeper(Service[KeeperSettings]):
    """Takes scenes and produces nothing; its seat in the embedded run keeps them."""

    role: ClassVar[Role] = "sensors"
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"),)
    uses_scenery: ClassVar[bool] = True
    Settings = KeeperSettings
    on_prepare: ClassVar[Callable[[Preparation], None]]

    def prepare(self, preparation: Preparation) -> Prepared:
        type(self).on_prepare(preparation)
        return Prepared()

    def step(self, frame: Any) -> StepResult:
        """Never called: the seat answers."""
        raise RunError(f"{KEEPER} is answered by its seat")
