"""The scenes that all settings are measured on: those of a scenario's worlds, or of a recording.

Of a scenario only the worlds run, and the agents that steer them, embedded in this process and free of pace.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import msgspec
import numpy as np
from msgspec.structs import replace

from caviar_clients.session.embedded import EmbeddedRun
from caviar_clients.session.prepared import PreparedScenario, names_class, prepare
from caviar_protocol.errors import RecordingError, RunError, ScenarioError
from caviar_protocol.messages import Input, Role
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.scenario import DeviceSpec, Scenario, ServiceSpec
from caviar_protocol.scenario.rules import with_overrides
from caviar_protocol.space.scene import pairs_of
from caviar_protocol.topics import Carrier, Scene
from caviar_services.service import Preparation, Prepared, Service, StepResult

T = TypeVar("T")

CONSECUTIVE = 21
"""Consecutive frames that keyframes are measured on: two intervals of ten, and the frame before."""

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


def scenes_of(path: Path, frames: int, prepared: PreparedScenario | None = None) -> Scenes:
    """Take scenes, spread evenly over the first episode of a scenario or a recording.

    Args:
        path: Scenario file, run directory or segment.
        frames: Number of scenes, about: those without a transmitter or a receiver are left out.
        prepared: The scenario of that file; None: it is prepared here.

    Raises:
        ScenarioError: The scenario is wrong, or has no carrier.
        RecordingError: The recording is wrong, or holds no scene.
        RunError: The worlds fail, or no scene has both a transmitter and a receiver.

    Example:
        >>> scenes = scenes_of(Path("runs/smoke-20261122-101500"), 2)
        >>> len(scenes.instants), scenes.carriers[0].name
        (2, 'mmwave')
    """
    if is_recording(path):
        found = _of_recording(path, frames)
    else:
        prepared = prepared or prepare(path)
        instants, assets = _simulated(prepared)
        found = _planned(path, prepared.scenario, _spread(instants, frames), assets, _middle(instants))
    if not found.carriers:
        raise ScenarioError(
            "a channel needs at least one carrier; add [[carriers]] with name and frequency_hz",
            key="carriers",
        )
    # A scene without a pair has no channel: it would count as one that costs nothing.
    served = tuple(instant for instant in found.instants if pairs_of(instant.scene))
    if not served:
        raise RunError(
            f"none of the {len(found.instants)} scenes of {found.origin} has a transmitter and a receiver; "
            "there is no channel to compare"
        )
    return dataclasses.replace(found, instants=served, consecutive=_run(found.consecutive))


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
        recorded = recording.frame(episode, frame)
        instant = _instant(recorded)
        if instant is None:
            raise RecordingError(f"frame {frame} of {path} has no scene; choose another with --frame")
        return _recorded(recording, (instant,))
    prepared = prepared or prepare(path)
    scenario = prepared.scenario
    if not 0 <= frame < scenario.run.frames:
        last = scenario.run.frames - 1
        raise RunError(f"--frame {frame}: scenario {scenario.run.name!r} has the frames 0 to {last}")
    # A world's scene may depend on every frame before: the run is cut after the frame, not begun at it.
    scenario = with_overrides(scenario, frames=frame + 1)
    instants, assets = _simulated(dataclasses.replace(prepared, scenario=scenario))
    return _planned(path, scenario, instants[-1:], assets)


def is_recording(path: Path) -> bool:
    """Whether a path is a run directory or a segment, and not a scenario."""
    return path.is_dir() or path.suffix == ".mcap"


def _of_recording(path: Path, frames: int) -> Scenes:
    recording = Recording(path)
    first = recording.entry(0).episode if len(recording) else 0
    # Of the first episode alone, as of a scenario: another one has other objects of the same names.
    kept = [frame for frame in recording.frames() if frame.episode == first]
    instants = [instant for frame in _spread(kept, frames) if (instant := _instant(frame)) is not None]
    block = [instant for frame in _middle(kept) if (instant := _instant(frame)) is not None]
    if not instants:
        raise RecordingError(
            f'{path} holds no scene; record the topic: record = ["scene", …] in the table [run]'
        )
    return _recorded(recording, tuple(instants), tuple(block))


def _recorded(
    recording: Recording, instants: tuple[Instant, ...], consecutive: tuple[Instant, ...] = ()
) -> Scenes:
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
        instants=instants,
        carriers=carriers,
        devices=devices,
        assets=recording.assets,
        services=services,
        seed=metadata.seed,
        sampling_period_ns=metadata.sampling_period_ns,
        consecutive=consecutive,
    )


def _instant(frame: RecordedFrame) -> Instant | None:
    scene = frame.scene()
    return None if scene is None else Instant(frame.number, frame.t_ns, scene)


def _simulated(prepared: PreparedScenario) -> tuple[list[Instant], Mapping[str, Path]]:
    """Run the worlds of a scenario; their scene of each frame, and the files of their scenery."""
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
    return instants, preparations[0].assets if preparations else {}


def _planned(
    path: Path,
    scenario: Scenario,
    instants: Sequence[Instant],
    assets: Mapping[str, Path],
    consecutive: Sequence[Instant] = (),
) -> Scenes:
    return Scenes(
        name=scenario.run.name,
        origin=f"scenario {path.name}, {scenario.run.frames} frame{'s' * (scenario.run.frames != 1)}",
        instants=tuple(instants),
        carriers=scenario.carriers,
        devices=scenario.devices,
        assets=assets,
        services=scenario.services,
        seed=scenario.run.seed,
        sampling_period_ns=scenario.run.sampling_period_ns,
        consecutive=tuple(consecutive),
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


def _spread(entries: Sequence[T], count: int) -> list[T]:
    """Take ``count`` entries, evenly spread, the first and the last among them; all where there are fewer."""
    if len(entries) <= count:
        return list(entries)
    # Rounding may hit an entry twice where there are few.
    return [entries[i] for i in np.unique(np.linspace(0, len(entries) - 1, count).round().astype(int))]


def _middle(entries: Sequence[T]) -> list[T]:
    """Take `CONSECUTIVE` entries from the middle; all where there are fewer."""
    first = max(0, (len(entries) - CONSECUTIVE) // 2)
    return list(entries[first : first + CONSECUTIVE])


def _run(instants: Sequence[Instant]) -> tuple[Instant, ...]:
    """Find the longest run of frames with successive numbers that have a transmitter and a receiver."""
    runs: list[list[Instant]] = [[]]
    for instant in instants:
        if runs[-1] and instant.frame != runs[-1][-1].frame + 1:
            runs.append([])
        if pairs_of(instant.scene):
            runs[-1].append(instant)
        elif runs[-1]:
            runs.append([])
    # Of several equal ones the first, so that two comparisons take the same frames.
    longest: list[Instant] = max(runs, key=lambda run: len(run))
    return tuple(longest)
