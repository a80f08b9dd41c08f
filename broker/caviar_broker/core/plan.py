"""The plan of a run: what the core knows of it before it starts, and what WELCOME says to each service."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec

from caviar_protocol.fields import SINCE, Version, parse_version, required_knowledge
from caviar_protocol.messages import Asset, GrantInput, Policy, Role
from caviar_protocol.scenario import REMOTE_REJOIN_S, Scenario, ServiceSpec, instants_ns
from caviar_protocol.scenario.conversion import Source
from caviar_protocol.scenario.rules import resolved, world_of
from caviar_protocol.scenario.schema import published_array
from caviar_protocol.topics import AntennaArray

SECOND = 1_000_000_000
"""[ns]"""


def milliseconds(ns: int) -> str:
    """A duration as notices about frames have it."""
    return f"{ns / 1e6:.1f} ms"


def duration(ns: int) -> str:
    """A duration as blames have it: in seconds, or below one in milliseconds."""
    return f"{ns / 1e9:.3g} s" if ns >= SECOND else f"{ns / 1e6:.3g} ms"


@dataclass(frozen=True)
class Feature:
    """Something in the scenario that services of earlier protocol versions do not know."""

    key: str
    """Where it stands: ``devices[0].array.panels``."""
    text: str
    """What it is, for people."""
    since: Version


@dataclass(frozen=True)
class PatternFile:
    """A file of antennas that a device of the scenario names: a pattern of elements, or a codebook."""

    name: str
    """Of the asset that it travels as."""
    key: str
    """Where it stands: ``devices[0].array.pattern_file``, ``devices[0].array.codebook``."""
    path: str
    """On the machine of the broker."""
    world: str
    """The world that publishes the device."""
    asset: Asset | None
    """As it lies on the machine of the broker; None: it is not there, or what was recorded goes before it."""


@dataclass(frozen=True, kw_only=True)
class ServicePlan:
    """One service that the run expects."""

    name: str
    role: Role
    budget_ns: int
    use: str = ""
    """Implementation that the scenario names; empty: any."""
    remote: bool = False
    """Whether the user starts it, so that it may come back however early it was lost."""
    policy: Policy = "wait"
    max_in_flight: int = 1
    settings: Mapping[str, Any] = field(default_factory=dict)
    scenario: Mapping[str, Any] = field(default_factory=dict)
    """What WELCOME tells it about the scenario."""
    rejoin: int | None = None
    """How long its return is waited for [ns]; None: as `Timeouts` says."""
    features: tuple[Feature, ...] = ()
    """Of its devices: what the service has to know of later minor versions than 1.0."""

    # What a policy means, contract clause 9; cached, as they are asked in every frame. At the deadline
    #   wait   the frame waits for the answer;
    #   abort  the run ends;
    #   hold   consumers get the newest earlier product, held; without one it is absent;
    #   drop   the product is absent.

    @cached_property
    def waits_for_answer(self) -> bool:
        """True if frames wait for it after its deadline."""
        return self.policy == "wait"

    @cached_property
    def ends_run_when_late(self) -> bool:
        """True if the run ends at its deadline."""
        return self.policy == "abort"

    @cached_property
    def is_indispensable(self) -> bool:
        """True if no frame goes on without its answer."""
        return self.waits_for_answer or self.ends_run_when_late

    @cached_property
    def holds_last_product(self) -> bool:
        """True if its newest product is held for frames that it misses."""
        return self.policy == "hold"


@dataclass(frozen=True, kw_only=True)
class Timeouts:
    """Time-outs of the core [ns]; see `caviar_protocol.scenario.schema.Timeouts`."""

    connect: int = 30 * SECOND
    ready: int = 120 * SECOND
    reset: int = 60 * SECOND
    stall: int = 30 * SECOND
    shutdown: int = 2 * SECOND
    heartbeat: int = SECOND // 4
    liveness: int = 3 * SECOND // 2
    rejoin: int = 0
    """0: a service that dies ends the run."""


@dataclass(frozen=True, kw_only=True)
class RunPlan:
    """A run: its services, its frames, its rules."""

    run: str
    services: tuple[ServicePlan, ...]
    frames: int
    sampling_period_ns: int
    instants_ns: tuple[int, ...] = ()
    """Simulated time of each frame, where these are not evenly spaced."""
    episodes: int = 1
    """Number of the last episode, plus one."""
    first_episode: int = 0
    """Where the run begins: with the seeds that this episode has in a run from episode 0 on."""
    seed: int = 0
    realtime: bool = False
    """Whether frames wait until real time has come to them (clause 8)."""
    speed: float = 1.0
    """How many times as fast as real time, where they do."""
    record: tuple[str, ...] = ()
    """``topic`` or ``topic.part`` that is produced because it shall be recorded (clause 5)."""
    frames_in_flight: int = 4
    timeouts: Timeouts = Timeouts()
    epoch: int = 1
    ephemeral: bool = False
    """Whether nothing is kept of the run: no journal, digest or latencies. An embedded run without files."""
    source: Source = field(default_factory=Source)
    """Where the scenario was read from, to name the lines of what services find wrong in it."""
    patterns: tuple[PatternFile, ...] = ()
    """Pattern files that the scenario names, each once; the broker offers those that no world does."""
    policies: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """SHA-256 of the policies that agents were given, by name, the scenario's first (`policy_swaps`)."""
    max_faces: int = 2_000_000
    """Triangles that a mesh may have which a world announces while the run goes on."""
    checkpoint_frames: int = 0
    """Frames after which a service that can do so saves its state; 0: never."""
    imposed: Mapping[tuple[str, int, int], Mapping[str, str]] = field(default_factory=dict)
    """Decisions imposed in a replay, by (service, episode, frame) (clause 6)."""
    recorded: Mapping[tuple[str, int, int], tuple[GrantInput, ...]] = field(default_factory=dict)
    """Provenance of what replayed services had not in time, by (service, episode, frame)."""

    @property
    def remembers(self) -> bool:
        """True if services save their state."""
        return self.checkpoint_frames > 0 and not self.ephemeral

    def is_warm_up(self, service: ServicePlan, episode: int, frame: int) -> bool:
        """Return whether a service still compiles in a frame, which waits for it without a miss.

        It is the run's first one, under ``wait``.
        """
        return service.waits_for_answer and frame == 0 and episode == self.first_episode

    def t_ns(self, frame: int) -> int:
        """Simulated time of a frame of any episode [ns]; one past the last comes a period later."""
        if not self.instants_ns:
            return frame * self.sampling_period_ns
        # An agent's final grant comes after the last frame, where the scenario lists no instant.
        last = len(self.instants_ns) - 1
        return self.instants_ns[min(frame, last)] + max(0, frame - last) * self.sampling_period_ns


def plan_run(scenario: Scenario, run: str, welcome: Mapping[str, Mapping[str, Any]]) -> RunPlan:
    """Make the plan of a run.

    Args:
        scenario: A validated one, after `with_ownership`.
        run: Id of the run.
        welcome: What WELCOME says to each service about the scenario, by name (`briefings`).
    """
    t = scenario.timeouts
    return RunPlan(
        run=run,
        services=tuple(
            ServicePlan(
                name=name,
                role=spec.role,
                # A remote service says by itself what it is.
                use="" if spec.remote else spec.use,
                remote=spec.remote,
                budget_ns=round(spec.budget_ms * 1e6),
                policy=spec.policy,
                max_in_flight=spec.max_in_flight,
                settings=spec.settings,
                scenario=welcome.get(name, {}),
                # A remote service is started by hand, and so may come back where nothing is set.
                rejoin=round(REMOTE_REJOIN_S * SECOND) if spec.remote and t.rejoin_s is None else None,
                features=_features(scenario, name if spec.role == "world" else ""),
            )
            for name, spec in scenario.services.items()
        ),
        frames=scenario.run.frames,
        sampling_period_ns=scenario.run.sampling_period_ns,
        instants_ns=instants_ns(scenario.run.instants_s),
        episodes=scenario.run.episodes,
        seed=scenario.run.seed,
        # `fast` is an earlier word for `free`.
        realtime=scenario.run.pace not in ("free", "fast"),
        speed=1.0 if isinstance(scenario.run.pace, str) else scenario.run.pace,
        record=scenario.run.record,
        source=scenario.source,
        frames_in_flight=scenario.run.frames_in_flight,
        checkpoint_frames=scenario.run.checkpoint_frames,
        max_faces=scenario.run.max_faces,
        timeouts=Timeouts(
            connect=round(t.connect_s * SECOND),
            ready=round(t.ready_s * SECOND),
            reset=round(t.reset_s * SECOND),
            stall=round(t.stall_s * SECOND),
            shutdown=round(t.shutdown_s * SECOND),
            heartbeat=round(t.heartbeat_s * SECOND),
            liveness=round(t.liveness_s * SECOND),
            rejoin=round((t.rejoin_s or 0.0) * SECOND),  # not set: a local service that dies ends the run
        ),
    )


def _features(scenario: Scenario, world: str) -> tuple[Feature, ...]:
    """Features that a service has to know for the devices of a world, or of all for the empty name."""
    found = []
    for index, device in enumerate(scenario.devices):
        if world and world_of(scenario, index) != world:
            continue
        if device.carriers:
            text = f"carriers of device {device.name!r}"
            since = parse_version(SINCE["AntennaDevice.carriers"])
            found.append(Feature(f"devices[{index}].carriers", text, since))
        if device.array is not None:
            for field, value, since in required_knowledge(device.array):
                shown = repr(value) if isinstance(value, str) else f"{len(value)} of them"
                text = f"{field} ({shown}) of device {device.name!r}"
                found.append(Feature(f"devices[{index}].array.{field}", text, since))
    return tuple(found)


def briefings(scenario: Scenario, directory: Path) -> dict[str, dict[str, Any]]:
    """By service: carriers, devices, timing, and for the recorder where to write what.

    Worlds get the devices that they publish, all other services all of them, with their worlds.

    Args:
        scenario: A validated one.
        directory: Of the run, where the recorder writes.
    """
    # As the recording has it: a service and a reader of the recording see the same values.
    plain = resolved(scenario)
    # A codebook without the path of its file: worlds publish it as it stands here.
    codebooks = [published_array(device.array or AntennaArray()).codebook for device in scenario.devices]
    devices = [
        device
        | {"world": world_of(scenario, index)}
        | ({"array": device["array"] | {"codebook": codebooks[index]}} if device["array"] else {})
        for index, device in enumerate(plain["devices"])
    ]
    common = {
        "carriers": plain["carriers"],
        "sampling_period_ns": scenario.run.sampling_period_ns,
        "frames": scenario.run.frames,
        "episodes": scenario.run.episodes,
    }
    found = {}
    for name, spec in scenario.services.items():
        found[name] = common | {"devices": devices}
        if spec.role == "world":
            found[name]["devices"] = [device for device in devices if device["world"] == name]
        # The recorder alone writes files, and its metadata hold the whole scenario.
        if spec.role == "recorder":
            found[name] |= {"directory": str(directory), "resolved": plain}
    return found


def with_ownership(scenario: Scenario) -> Scenario:
    """The scenario with `ServiceSpec.users` of agents in their settings (contract, clause 17).

    An agent with ``users`` owns those; one without is a default agent and serves all others.
    """
    owned = tuple(
        pattern for spec in scenario.services.values() if spec.role == "agent" for pattern in spec.users
    )
    services = {name: _agent_settings(spec, owned) for name, spec in scenario.services.items()}
    return msgspec.structs.replace(scenario, services=services)


def _agent_settings(spec: ServiceSpec, owned: tuple[str, ...]) -> ServiceSpec:
    if spec.role != "agent" or not owned:
        return spec
    # A default agent gets what it may not serve in its settings: it cannot know the settings of the others.
    ownership: Mapping[str, Any] = {"users": spec.users} if spec.users else {"except_users": owned}
    return msgspec.structs.replace(spec, settings={**spec.settings, **ownership})
