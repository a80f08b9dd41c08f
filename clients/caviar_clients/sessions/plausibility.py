"""Values of a scenario that are allowed and yet hardly meant: a frequency of 28 Hz, a base station below
the ground. They are warned of, and the run goes on."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError, ScenarioError, SetupError
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.scenario.rules import scenario_error, settings_place
from caviar_protocol.space.coordinates import Vector
from caviar_services.channel.propagation.clearance import Surfaces
from caviar_services.registry import load
from caviar_services.world.assets import scenery_assets
from caviar_services.world.base import World
from caviar_services.world.obstacles import scenery_triangles

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
