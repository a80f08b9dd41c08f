"""Plan of a dataset: the scenario of its episodes, the settings that tell it from others, and presets."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec.structs import replace

from caviar_clients.datasets.settings import FORMAT
from caviar_clients.session.prepared import implemented, prepare
from caviar_protocol.digest import file_digest
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import Carrier, DeviceSpec, Scenario, ServiceSpec, shipped_scenarios
from caviar_protocol.scenario.rules import with_overrides
from caviar_services.drjit_setup import choose_variant
from caviar_services.recorder.provenance import code_digests, used_versions
from caviar_space.scenery import scenery_assets


@dataclass(frozen=True)
class DatasetPlan:
    """A dataset: episodes of one scenario.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> plan = plan_dataset(load_scenario("smoke"), episodes=3, scenes=2)
        >>> plan.episodes, plan.scenes, plan.scenario.run.frames
        (3, 2, 2)
    """

    scenario: Scenario
    """Of an episode: its frames are the scenes, and its recorder leaves out what differs from run to run."""
    episodes: int

    @property
    def scenes(self) -> int:
        """Number of scenes of an episode."""
        return self.scenario.run.frames

    def settings(self) -> dict[str, Any]:
        """All that the bytes of a recording follow from, beside the number of its episode, as plain values.

        Raises:
            ScenarioError: A file that the scenario names cannot be read.
            AssetError: Scenery lacks a file.
        """
        content = msgspec.to_builtins(self.scenario)
        content.pop("source", None)
        return {
            "format": FORMAT,
            "scenario": _without_folders(content),
            "files": _digests(_files(content)),
            "code": code_digests(content),
            "versions": used_versions(content),
            "device": choose_variant(),
        }


def plan_dataset(
    scenario: Scenario, *, episodes: int, scenes: int | None = None, seed: int | None = None
) -> DatasetPlan:
    """Make the plan of a dataset.

    Args:
        scenario: Whose episodes are played.
        episodes: How many.
        scenes: Of an episode; None: the frames of the scenario.
        seed: Of all random numbers; None: that of the scenario.

    Raises:
        ScenarioError: The scenario has no recorder ``mcap``, or a service elsewhere.
    """
    scenario = with_overrides(scenario, scenes, seed, "free")
    recorders = [name for name, spec in scenario.services.items() if spec.role == "recorder"]
    if len(recorders) != 1 or scenario.services[recorders[0]].use != "mcap":
        raise ScenarioError(
            'a dataset needs one recorder; add [services.recorder] with role = "recorder", use = "mcap"',
            scenario.source.file,
            "services",
        )
    for name, spec in scenario.services.items():
        if spec.remote:
            raise ScenarioError(
                f"{name!r} is a service elsewhere; the episodes of a dataset run in one process each: give "
                "it an implementation with use",
                scenario.source.file,
                f"services.{name}.use",
            )
    recorder = scenario.services[recorders[0]]
    settings = {
        "compression": "zstd",
        "only_named": True,
        **recorder.settings,
        "reproducible": True,
        "copy_assets": False,
    }
    services = {**scenario.services, recorders[0]: replace(recorder, settings=settings)}
    # A kill costs the episodes in progress, whatever the disk holds of them: each is synced as a whole.
    # Nor does a recording say how many episodes there are: a dataset may grow.
    run = replace(scenario.run, episodes=1, durability="none", checkpoint_frames=0)
    return DatasetPlan(prepare(replace(scenario, run=run, services=services)).scenario, episodes)


def with_own_traffic(scenario: Scenario) -> Scenario:
    """The scenario in which each episode has a traffic of its own, by its own seed.

    Args:
        scenario: Whose episodes may share one.
    """
    services = {
        name: replace(spec, settings={k: v for k, v in spec.settings.items() if k != "between_episodes_s"})
        for name, spec in scenario.services.items()
    }
    return replace(scenario, services=services)


def _without_folders(value: Any) -> Any:
    if isinstance(value, str) and value.startswith(("/", "file:/")):  # a codebook: ``file:PATH#SHA-256``
        return f"file:{Path(value).name}"
    if isinstance(value, Mapping):
        return {key: _without_folders(item) for key, item in value.items()}
    return [_without_folders(item) for item in value] if isinstance(value, list | tuple) else value


def _digests(files: Iterable[tuple[str, str, Path]]) -> dict[str, str]:
    """Digest of each file by its name; by key and name where several files of one name differ."""
    found: dict[str, dict[str, str]] = {}
    for key, name, path in files:
        found.setdefault(name, {})[key] = file_digest(path)
    digests: dict[str, str] = {}
    for name, by_key in found.items():
        if len(set(by_key.values())) == 1:
            digests[name] = next(iter(by_key.values()))
        else:
            digests |= {f"{key}: {name}": digest for key, digest in by_key.items()}
    return dict(sorted(digests.items()))


def _files(value: Any, key: str = "") -> Iterator[tuple[str, str, Path]]:
    """Key, name and path of each file that the settings name, and of those that scenery names in turn."""
    if isinstance(value, str) and value.startswith("/"):
        path = Path(value)
        if path.is_file():
            yield key, path.name, path
            if key.endswith(".scenery"):
                for name, mesh in scenery_assets(value).items():
                    if isinstance(mesh, Path) and mesh != path:
                        yield key, name, mesh
    elif isinstance(value, Mapping):
        for name, item in value.items():
            yield from _files(item, f"{key}.{name}" if key else name)
    elif isinstance(value, list | tuple):
        for at, item in enumerate(value):
            yield from _files(item, f"{key}[{at}]")


CAMERAS = ("left", "centre", "right")
"""Of ``--with camera``: as in the paper's pairs, beside the transmitter."""
CAMERA_PX = (960, 540)
CAMERA_TURN_DEG = 60.0
"""From one to the next."""


def with_cameras(scenario: Scenario) -> Scenario:
    """The scenario with three cameras beside its first standing transmitter, and their pictures recorded.

    Args:
        scenario: With a transmitter that stands.

    Raises:
        ScenarioError: It has none.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> scenario = with_cameras(load_scenario("canyon-mobile"))
        >>> [device.name for device in scenario.devices if device.kind == "camera"]
        ['left', 'centre', 'right']
    """
    standing = (d for d in scenario.devices if d.kind == "antenna" and d.role in ("tx", "both") and not d.on)
    tx = next(standing, None)
    if tx is None:
        raise ScenarioError(
            "has no transmitter that stands, beside which cameras could be; add cameras to the scenario",
            scenario.source.file,
            "devices",
        )
    x, y, z = tx.position_m
    cameras = tuple(
        DeviceSpec(
            name=name,
            kind="camera",
            # Above the array, whose elements are no obstacle.
            position_m=(x, y, z + 0.3),
            yaw_deg=tx.yaw_deg + turn * CAMERA_TURN_DEG,
            pitch_deg=tx.pitch_deg + 5.0,
            size_px=CAMERA_PX,
            field_of_view_deg=75.0,
        )
        for name, turn in zip(CAMERAS, (1, 0, -1), strict=True)
    )
    services = dict(scenario.services)
    if not any(spec.use == "camera" for spec in services.values()):
        services["camera"] = ServiceSpec(role="sensors", use="camera", budget_ms=5000.0)
    # Where none is named all are recorded, and that shall stay so.
    before = scenario.run.record or [
        topic
        for service in implemented(scenario).services.values()
        if service.spec.role != "sensors"
        for topic in service.cls.outputs
    ]
    topics = tuple(dict.fromkeys((*before, "camera")))
    return replace(
        scenario,
        run=replace(scenario.run, record=topics),
        services=services,
        devices=(*scenario.devices, *cameras),
    )


# --- presets ------------------------------------------------------------------------------------------------

# The columns of Table 2 of the paper, applied to any scenario. Source: Oliveira et al., "Simulation of
# Machine Learning-Based 6G Systems in Virtual Worlds" (2021), Table 2 and the text around it. Of its sets
# s011 and s012 alone have arrays that turn with their vehicles; s012 is played with spherical waves, which
# stand for its arrays inside the ray tracer (MIMO-RT).

NO_TIME_MS = 1000
"""[ms] Sampling period of a set whose episodes have one scene: SUMO's longest step."""


@dataclass(frozen=True)
class Preset:
    """One row of the table.

    Example:
        >>> PRESETS["s008"].episodes, PRESETS["s008"].frequencies_hz, PRESETS["s008"].receivers
        (2086, (60000000000.0,), 'mobile')
    """

    name: str
    frequencies_hz: tuple[float, ...]
    receivers: Literal["mobile", "fixed"]
    """On vehicles, or standing."""
    between_scenes_ms: int
    between_episodes_s: float
    episodes: int
    scenes: int
    arrays_turn: bool
    """Whether arrays on vehicles turn with them; else their rows of elements lie north–south in the world."""
    rung: Literal["siso-rt", "spherical"]
    """Paths between reference points and plane waves over the arrays, or a path for each antenna pair."""
    valid_channels: int
    """On a carrier, as the table rounds them."""

    count: int = 10
    """Receivers."""

    @property
    def scenario(self) -> str:
        """Name of the shipped scenario that it is applied to where no other is given."""
        return "district" if self.receivers == "mobile" else "district-fixed"


PRESETS: Mapping[str, Preset] = {
    preset.name: preset
    for preset in (
        Preset("s001", (60e9,), "mobile", 100, 30.0, 116, 50, False, "siso-rt", 41_000),
        Preset("s005", (2.8e9, 5e9), "fixed", 10, 35.0, 125, 80, False, "siso-rt", 100_000),
        Preset("s006", (28e9, 60e9), "fixed", 1, 35.0, 200, 10, False, "siso-rt", 20_000),
        Preset("s008", (60e9,), "mobile", NO_TIME_MS, 30.0, 2086, 1, False, "siso-rt", 11_000),
        Preset("s011", (60e9,), "mobile", 500, 6.0, 76, 20, True, "siso-rt", 13_000),
        Preset("s012", (60e9,), "fixed", 500, 6.0, 105, 20, True, "spherical", 21_000),
    )
}
"""The presets, by name."""


def apply_preset(preset: Preset, scenario: Scenario) -> Scenario:
    """Give a scenario the columns of a preset.

    Args:
        preset: The columns.
        scenario: Whose scenery, traffic, services and first transmitter stay.

    Returns:
        The scenario of the dataset's episodes, of the preset's name.

    Raises:
        ScenarioError: Its receivers are not those of the preset, or its world has no traffic of its own.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> scenario = apply_preset(PRESETS["s005"], load_scenario("canyon-fixed"))
        >>> scenario.run.name, scenario.run.frames, [carrier.name for carrier in scenario.carriers]
        ('s005', 80, ['2.8GHz', '5GHz'])
    """
    run = replace(
        scenario.run,
        name=preset.name,
        frames=preset.scenes,
        instants_s=(),
        episodes=preset.episodes,
        sampling_period_ns=preset.between_scenes_ms * 1_000_000,
    )
    return replace(
        scenario,
        run=run,
        carriers=_carriers(preset, scenario),
        devices=tuple(
            _device(preset, device)
            for device in _with_receivers(preset, scenario)
            if device.name not in further_transmitters(scenario)
        ),
        services={name: _service(preset, spec) for name, spec in scenario.services.items()},
    )


def further_transmitters(scenario: Scenario) -> list[str]:
    """Transmitters that stand beside the first one: the sets of the table have one, and presets that alone.

    Args:
        scenario: That a preset is applied to.
    """
    standing = [d.name for d in scenario.devices if d.kind == "antenna" and d.role == "tx" and not d.on]
    return standing[1:]


def find_preset(name: str) -> Preset | None:
    """The preset of a name; None where it is that of something else.

    Args:
        name: What a user wrote.

    Raises:
        ScenarioError: It looks like a preset, and there is none of this name.

    Example:
        >>> find_preset("smoke") is None
        True
        >>> find_preset("S8")
        Traceback (most recent call last):
            ...
        caviar_protocol.errors.ScenarioError: there is no preset 'S8'; did you mean 's008'? presets: s001, \
s005, s006, s008, s011, s012
    """
    if name in PRESETS or name in shipped_scenarios():
        return PRESETS.get(name)
    numbered = _NUMBERED.fullmatch(name)
    meant = f"s{int(numbered[1]):03d}" if numbered else ""
    near = [meant] if meant in PRESETS else get_close_matches(name.lower(), PRESETS, n=1, cutoff=0.7)
    if numbered or near:
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise ScenarioError(f"there is no preset {name!r}; {hint}presets: {', '.join(PRESETS)}")
    return None


# With another letter case or number of zeros, or with a sign between.
_NUMBERED = re.compile(r"[sS][-_ ]?([0-9]{1,4})")


def _carriers(preset: Preset, scenario: Scenario) -> tuple[Carrier, ...]:
    if not scenario.carriers:
        raise _error(
            scenario, "carriers", "has no carrier; add [[carriers]], whose bandwidth the preset keeps"
        )
    first = scenario.carriers[0]
    return tuple(
        replace(first, name=f"{frequency / 1e9:g}GHz", frequency_hz=frequency)
        for frequency in preset.frequencies_hz
    )


def _with_receivers(preset: Preset, scenario: Scenario) -> tuple[DeviceSpec, ...]:
    """The devices, those on vehicles as many as the preset has receivers."""
    receivers = [d for d in scenario.devices if d.kind == "antenna" and d.role == "rx"]
    if preset.receivers == "fixed":
        standing = [device for device in receivers if not device.on]
        if len(standing) != preset.count or len(receivers) != len(standing):
            moving = len(receivers) - len(standing)
            raise _error(
                scenario,
                "devices",
                f"{preset.name} has {preset.count} receivers that stand; the scenario has {len(standing)} "
                f"(antennas with role rx, without on) and {moving} on objects: write {preset.count} of these",
            )
        return scenario.devices
    mounted = [device for device in receivers if device.on]
    if len(mounted) != 1 or len(receivers) != 1:
        raise _error(
            scenario,
            "devices",
            f"{preset.name} has {preset.count} receivers on vehicles; the scenario has {len(receivers)} "
            'antennas with role rx: write one, with on = "…*"',
        )
    pattern = mounted[0].on
    return tuple(
        replace(device, count=preset.count) if device.on == pattern else device for device in scenario.devices
    )


def _device(preset: Preset, device: DeviceSpec) -> DeviceSpec:
    if device.kind != "antenna" or not device.on:
        return device
    if preset.arrays_turn:
        return replace(device, keeps_heading=False)
    return replace(device, keeps_heading=True, yaw_deg=0.0)


def _service(preset: Preset, spec: ServiceSpec) -> ServiceSpec:
    changes: dict[str, Any] = {}
    if spec.role == "world" and spec.use == "sumo":
        changes = {"between_episodes_s": preset.between_episodes_s}
    if spec.role == "channel" and spec.use == "sionna-rt":
        changes = {"rung": preset.rung}
    return replace(spec, settings={**spec.settings, **changes}) if changes else spec


def _error(scenario: Scenario, key: str, text: str) -> ScenarioError:
    return ScenarioError(text, scenario.source.file, key)
