"""Presets of datasets: the columns of Table 2 of the paper, applied to any scenario.

Source: Oliveira et al., "Simulation of Machine Learning-Based 6G Systems in Virtual Worlds" (2021), Table 2
and the text around it. Of its sets s011 and s012 alone have arrays that turn with their vehicles; s012
is played with spherical waves, which stand for its arrays inside the ray tracer (MIMO-RT).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, Literal

from msgspec.structs import replace

from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import Carrier, DeviceSpec, Scenario, ServiceSpec, shipped_scenarios

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
    """Whether arrays on vehicles turn with them; else they keep their orientation in the world."""
    rung: Literal["siso-rt", "spherical"]
    """Paths between reference points and plane waves over the arrays, or a path for each antenna pair."""

    count: int = 10
    """Receivers."""

    @property
    def scenario(self) -> str:
        """Name of the shipped scenario that it is applied to where no other is given."""
        return f"canyon-{self.receivers}"


PRESETS: Mapping[str, Preset] = {
    preset.name: preset
    for preset in (
        Preset("s001", (60e9,), "mobile", 100, 30.0, 116, 50, False, "siso-rt"),
        Preset("s005", (2.8e9, 5e9), "fixed", 10, 35.0, 125, 80, False, "siso-rt"),
        Preset("s006", (28e9, 60e9), "fixed", 1, 35.0, 200, 10, False, "siso-rt"),
        Preset("s008", (60e9,), "mobile", NO_TIME_MS, 30.0, 2086, 1, False, "siso-rt"),
        Preset("s011", (60e9,), "mobile", 500, 6.0, 76, 20, True, "siso-rt"),
        Preset("s012", (60e9,), "fixed", 500, 6.0, 105, 20, True, "spherical"),
    )
}
"""The presets, by name."""


def apply_preset(preset: Preset, scenario: Scenario) -> Scenario:
    """Give a scenario the columns of a preset.

    Args:
        preset: The columns.
        scenario: Whose scenery, traffic, services and transmitters stay.

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
        devices=tuple(_device(preset, device) for device in _with_receivers(preset, scenario)),
        services={name: _service(preset, spec) for name, spec in scenario.services.items()},
    )


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
    if device.kind == "antenna" and device.on and not preset.arrays_turn:
        return replace(device, keeps_heading=True)
    return device


def _service(preset: Preset, spec: ServiceSpec) -> ServiceSpec:
    changes: dict[str, Any] = {}
    if spec.role == "world" and spec.use == "sumo":
        changes = {"between_episodes_s": preset.between_episodes_s}
    if spec.role == "channel" and spec.use == "sionna-rt":
        changes = {"rung": preset.rung}
    return replace(spec, settings={**spec.settings, **changes}) if changes else spec


def _error(scenario: Scenario, key: str, text: str) -> ScenarioError:
    return ScenarioError(text, scenario.source.file, key)
