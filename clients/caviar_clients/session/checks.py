"""Checks of a scenario before its run: implementations and their settings, plausible values, free airspace.

Values that are allowed and yet hardly meant (a frequency of 28 Hz, a base station below the ground) are
warned of, and the run goes on.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError, DeclarationError, ScenarioError, SetupError, suggestion
from caviar_protocol.scenario import Scenario, ServiceSpec, load_scenario
from caviar_protocol.scenario.conversion import Place, convert_settings
from caviar_protocol.scenario.rules import scenario_error, settings_place, with_overrides
from caviar_protocol.space.coordinates import Vector
from caviar_services.channel.propagation.clearance import Surfaces
from caviar_services.registry import find_modules_in, load, registered_names
from caviar_services.service import Service
from caviar_services.world.assets import scenery_assets
from caviar_services.world.base import World
from caviar_services.world.obstacles import Obstacles, scenery_triangles

TOPICS_OF: Mapping[str, tuple[str, ...]] = {
    "world": ("scene",),
    "channel": ("channel",),
    "sensors": ("lidar", "camera", "depth", "segmentation"),
    "link": ("link",),
    "agent": ("action",),
    "recorder": (),
}
"""What a remote service may produce, by its role; what it does produce it says when it joins."""


def checked_scenario(
    path: Path, frames: int | None = None, seed: int | None = None, pace: str | None = None
) -> Scenario:
    """Load a scenario and check it against the implementations it uses.

    Raises `ScenarioError` naming file, key and line for an implementation or a setting that does
    not exist, and for a topic to record that no implementation produces.
    """
    return check_implementations(with_overrides(load_scenario(path), frames, seed, pace))


def module_folders(scenario: Scenario) -> tuple[Path, ...]:
    """Where modules of services that are named ``module:Class`` may lie: beside the scenario, and here.

    Empty where no service is named so.
    """
    if not any(":" in spec.use for spec in scenario.services.values()):
        return ()
    beside = (Path(scenario.source.file).resolve().parent,) if scenario.source.file else ()
    return (*beside, Path.cwd())


def _check_keys(spec: ServiceSpec, implementation: type[Service[Any]], place: Place) -> None:
    """Raise `ScenarioError` for a setting that the implementation lacks, naming those that have it."""
    known = _settings_of(implementation)
    for key in spec.settings:
        if key in known:
            continue
        owners = [name for name in registered_names(spec.role) if key in _settings_named(spec.role, name)]
        has = f"{spec.use!r} has: {', '.join(known)}" if known else f"{spec.use!r} has no settings"
        if owners:
            hint = f"it is a setting of {' and '.join(map(repr, owners))}; "
        else:
            near = suggestion(key, known)
            hint = f"{near} " if near.startswith("did") else ""
        raise place.at(key).error(f"unknown key {key!r}; {hint}{has}")


def _settings_named(role: str, name: str) -> tuple[str, ...]:
    """Settings of a registered implementation; none of one that cannot be loaded here."""
    try:
        return _settings_of(load(role, name))
    except DeclarationError:
        return ()


def _settings_of(implementation: type[Service[Any]]) -> tuple[str, ...]:
    return tuple(field.encode_name for field in msgspec.structs.fields(implementation.Settings))


def check_implementations(scenario: Scenario) -> Scenario:
    """The scenario, checked as `checked_scenario` does."""
    for folder in module_folders(scenario):
        find_modules_in(folder)
    produced: set[str] = set()
    for name, spec in scenario.services.items():
        if spec.remote:
            produced.update(TOPICS_OF[spec.role])
            continue
        try:
            implementation = load(spec.role, spec.use)
        except DeclarationError as error:
            raise scenario_error(scenario, f"services.{name}.use", str(error)) from error
        place = settings_place(scenario, name)
        _check_keys(spec, implementation, place)
        implementation.check_settings(convert_settings(implementation.Settings, spec.settings, place), place)
        produced.update(implementation.outputs)
    for index, entry in enumerate(scenario.run.record):
        topic = entry.partition(".")[0]
        if topic not in produced:
            raise scenario_error(
                scenario,
                f"run.record[{index}]",
                f"no service of the run produces {topic!r}; remove it, or add a service that does",
            )
    return scenario


TRIES = 10_000
"""Points that are drawn at most, until one is free."""


class Airspace:
    """Points that are free for an object.

    Parameters
    ----------
    low, high
        Corners [m] of the box that it keeps within.
    clearance
        Least distance [m] of its centre from scenery.
    scenery
        Files of the run's scenery, by asset name.
    """

    def __init__(self, low: Vector, high: Vector, clearance: float, scenery: Mapping[str, Path]) -> None:
        self.low, self.high = low, high
        self._clearance = clearance
        triangles = scenery_triangles(scenery)
        self._obstacles = Obstacles(triangles[triangles[..., 2].max(axis=1) > low[2]])
        self._surfaces = Surfaces(triangles, lambda triangle, normal: True)

    def within(self, low: Vector, high: Vector) -> Airspace:
        """The same scenery, and another box [m]."""
        other = copy.copy(self)
        other.low, other.high = low, high
        return other

    def is_free(self, point: Vector) -> bool:
        """Whether the object can be at a point [m]."""
        if not all(a <= x <= b for a, x, b in zip(self.low, point, self.high, strict=True)):
            return False
        if self._obstacles.distance(point, self._clearance) < self._clearance:
            return False
        return not self._surfaces.encloses(np.array(point))

    def draw(
        self,
        random: np.random.Generator,
        near: Vector | None = None,
        distance: tuple[float, float] = (0.0, np.inf),
    ) -> Vector | None:
        """A free point [m], uniform in the box, and, where ``near`` is given, as far from it [m] as
        ``distance`` says; None where none was found."""
        for _ in range(TRIES):
            x, y, z = random.uniform(self.low, self.high).tolist()
            far = 0.0 if near is None else float(np.linalg.norm(np.subtract((x, y, z), near)))
            if distance[0] <= far <= distance[1] and self.is_free((x, y, z)):
                return x, y, z
        return None


FREQUENCY_HZ = (100e6, 1e12)
"""The lower end of mobile radio; the upper end of Recommendation ITU-R P.676."""
NARROWEST_HZ = 1e3
"""Bandwidth below that of any carrier of NB-IoT (3.75 kHz)."""
POWER_DBM = (-60.0, 90.0)
"""From a femtocell's uplink to a long-range radar."""
LOOKED_AT = 200
"""Positions of one object at most, spread evenly over its way."""


def implausible_values(scenario: Scenario) -> list[str]:
    """A warning for each implausible value, with file, line, key and what may have been meant."""
    found = [*_carriers(scenario), *_powers(scenario), *_positions(scenario)]
    return [str(scenario_error(scenario, key, text)) for key, text in found]


_Warnings = Iterator[tuple[str, str]]
"""Keys of the scenario, and what is implausible there."""


def _carriers(scenario: Scenario) -> _Warnings:
    low, high = FREQUENCY_HZ
    for index, carrier in enumerate(scenario.carriers):
        frequency, bandwidth = carrier.frequency_hz, carrier.bandwidth_hz
        if not low <= frequency <= high:
            usual = f"radio carriers are from {_si(low)} to {_si(high)}"
            key = f"carriers[{index}].frequency_hz"
            yield key, f"is {_si(frequency)}; {usual}{_meant(frequency, low, high)}"
        elif bandwidth > frequency / 2:
            yield (
                f"carriers[{index}].bandwidth_hz",
                f"is {_si(bandwidth)}, more than half of the frequency, {_si(frequency)}; write it in Hz",
            )
        if bandwidth < NARROWEST_HZ:
            yield (
                f"carriers[{index}].bandwidth_hz",
                f"is {_si(bandwidth)}, narrower than any radio carrier; write it in Hz, as 100e6",
            )


def _powers(scenario: Scenario) -> _Warnings:
    low, high = POWER_DBM
    for index, device in enumerate(scenario.devices):
        if device.role in ("tx", "both") and not low <= device.power_dbm <= high:
            meant = ""
            if device.power_dbm > high:
                meant = f"; {device.power_dbm:g} mW would be {10 * math.log10(device.power_dbm):.1f} dBm"
            yield (
                f"devices[{index}].power_dbm",
                f"is {device.power_dbm:g} dBm, beyond any transmitter's {low:g} to {high:g} dBm{meant}",
            )


class _Placed(NamedTuple):
    """Something that stands at a place of its own in the world."""

    key: str
    name: str
    position: Vector


def _positions(scenario: Scenario) -> _Warnings:
    placed = [*_placed_devices(scenario), *_placed_objects(scenario)]
    ground = _Ground.of(scenario) if placed else None
    if ground is None:
        return
    known: set[str] = set()
    for thing in placed:
        wrong = ground.implausible(np.array(thing.position)) if thing.name not in known else ""
        if wrong:
            known.add(thing.name)
            at = ", ".join(f"{number:g}" for number in thing.position)
            yield thing.key, f"{thing.name!r} stands at ({at}) m, {wrong}"


def _placed_devices(scenario: Scenario) -> Iterator[_Placed]:
    for index, device in enumerate(scenario.devices):
        if not device.on:
            yield _Placed(f"devices[{index}].position_m", device.name, device.position_m)


def _placed_objects(scenario: Scenario) -> Iterator[_Placed]:
    for name, spec in scenario.services.items():
        if spec.role != "world" or spec.remote:
            continue
        world = load(spec.role, spec.use)
        place = settings_place(scenario, name)
        if not issubclass(world, World):
            continue
        try:
            placements = list(world.placements(convert_settings(world.Settings, spec.settings, place)))
        except ScenarioError:
            continue  # the world says so itself, with what to write instead
        for key, thing, positions in placements:
            for position in positions[:: max(1, math.ceil(len(positions) / LOOKED_AT))]:
                yield _Placed(f"{place.key}.{key}", thing, position)


class _Ground:
    """The scenery of a scenario: how far it reaches, and where it is above what."""

    def __init__(self, triangles: Float64Array) -> None:
        corners = triangles.reshape(-1, 3)
        self._low, self._high = corners.min(0), corners.max(0)
        self._surfaces = Surfaces(triangles, lambda triangle, normal: True)

    @classmethod
    def of(cls, scenario: Scenario) -> _Ground | None:
        """None where there is no scenery, or it cannot be read: its world says so, with the remedy."""
        worlds = [spec for spec in scenario.services.values() if spec.role == "world"]
        try:
            found = [
                scenery_triangles(scenery_assets(str(spec.settings.get("scenery") or ""))) for spec in worlds
            ]
        except (AssetError, ScenarioError, SetupError):
            return None
        triangles = np.concatenate(found) if found else np.zeros((0, 3, 3))
        return cls(triangles) if len(triangles) else None

    def implausible(self, position: Float64Array) -> str:
        """What is wrong with a position [m], Shape ``[3]``; empty: nothing."""
        if (position[:2] < self._low[:2]).any() or (position[:2] > self._high[:2]).any():
            return f"outside the scenery, which reaches {_span(self._low, self._high)}"
        above = np.array([*position[:2], self._high[2] + 1.0])
        below = np.array([*position[:2], self._low[2] - 1.0])
        if position[2] < self._low[2] or (
            self._surfaces.between(position, above) and not self._surfaces.between(position, below)
        ):
            return "below the ground"
        if position[2] > self._high[2] + float(np.linalg.norm(self._high - self._low)):
            return f"far above the scenery, which reaches {_span(self._low, self._high)}"
        return ""


def _span(low: Sequence[float] | Float64Array, high: Sequence[float] | Float64Array) -> str:
    axes = zip("xyz", low, high, strict=True)
    return ", ".join(f"{axis} {a:.4g} to {b:.4g} m" for axis, a, b in axes)


def _meant(value_hz: float, low: float, high: float) -> str:
    """What a frequency may have been meant as, which was written in another unit."""
    for exponent, unit in ((9, "GHz"), (6, "MHz"), (3, "kHz")):
        if low <= value_hz * 10.0**exponent <= high:
            return f"; {value_hz:g} {unit} is written {value_hz:g}e{exponent}"
    return f"; is it {_si(value_hz / 1e3)}?" if low <= value_hz / 1e3 <= high else ""


def _si(value_hz: float) -> str:
    for factor, unit in ((1e12, "THz"), (1e9, "GHz"), (1e6, "MHz"), (1e3, "kHz")):
        if value_hz >= factor:
            return f"{value_hz / factor:g} {unit}"
    return f"{value_hz:g} Hz"
