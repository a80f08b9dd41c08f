"""Values that the author of a scenario hardly means: a carrier of 28 Hz, a base station below the ground."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError, ScenarioError, SetupError
from caviar_protocol.multipath import TAPS_BEFORE
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.rules import scenario_error
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.topics.scene import Panel
from caviar_services.world.base import World
from caviar_space.mitsuba_xml import read_scenery
from caviar_space.scenery import scenery_assets, scenery_file, scenery_triangles

if TYPE_CHECKING:
    from caviar_clients.session.prepared import PreparedScenario

FREQUENCY_HZ = (100e6, 1e12)
"""The lower end of mobile radio; the upper end of Recommendation ITU-R P.676."""
NARROWEST_HZ = 1e3
"""Bandwidth below that of any carrier of NB-IoT (3.75 kHz)."""
POWER_DBM = (-100.0, 90.0)
"""From what an uplink leaves at a receiver, for channels of mean power 1, to a long-range radar."""
MOST_ELEMENTS = 2**16
"""Elements of one device: the channel of a pair of such is 64 GiB for each subcarrier."""
# Values beyond this are written in a larger unit: 2400 MHz, not 60,000 MHz.
_MOST_OF_A_UNIT = 10_000
WIDEST = 100.0
"""[wavelengths] between elements."""
FARTHEST_PANEL_M = 100.0
LOOKED_AT = 200
"""Positions of one object at most, spread evenly over its way."""


def implausible_values(prepared: PreparedScenario) -> list[str]:
    """Warn of implausible values; the run takes place all the same.

    Returns:
        A line for each value, with file, line, key and what may have been meant.

    Example:
        >>> from caviar_clients.session.prepared import prepare
        >>> implausible_values(prepare("smoke"))
        []
    """
    scenario = prepared.scenario
    found = [
        *_carriers(scenario),
        *_numerologies(scenario),
        *_powers(scenario),
        *_arrays(scenario),
        *_ladders(prepared),
        *_object_keys(prepared),
        *_positions(prepared),
    ]
    return [str(scenario_error(scenario, key, text)) for key, text in found]


LEAST_HZ = 1e6
"""Frequency below which a carrier is written in another unit: its wave is longer than any scene."""


def refuse_carriers(scenario: Scenario) -> None:
    """Refuse a carrier that can only be written in another unit, as 28 for 28 GHz.

    Raises:
        ScenarioError: One is below `LEAST_HZ`; the text has what may have been meant.
    """
    low, high = FREQUENCY_HZ
    for index, carrier in enumerate(scenario.carriers):
        if (frequency := carrier.frequency_hz) < LEAST_HZ:
            meant = _meant(frequency, low, high) or "; write it in Hz, as 28e9"
            usual = f"radio carriers are from {in_hertz(low)} to {in_hertz(high)}"
            key = f"carriers[{index}].frequency_hz"
            raise scenario_error(scenario, key, f"is {in_hertz(frequency)}; {usual}{meant}")


# Keys of the scenario, and what is implausible there.
_Warnings = Iterator[tuple[str, str]]


def _carriers(scenario: Scenario) -> _Warnings:
    low, high = FREQUENCY_HZ
    for index, carrier in enumerate(scenario.carriers):
        frequency, bandwidth = carrier.frequency_hz, carrier.bandwidth_hz
        if not low <= frequency <= high:
            usual = f"radio carriers are from {in_hertz(low)} to {in_hertz(high)}"
            key = f"carriers[{index}].frequency_hz"
            yield key, f"is {in_hertz(frequency)}; {usual}{_meant(frequency, low, high)}"
        elif bandwidth > frequency / 2:
            yield (
                f"carriers[{index}].bandwidth_hz",
                (
                    f"is {in_hertz(bandwidth)}, more than half of the frequency, {in_hertz(frequency)}; "
                    "write it in Hz"
                ),
            )
        if bandwidth < NARROWEST_HZ:
            yield (
                f"carriers[{index}].bandwidth_hz",
                f"is {in_hertz(bandwidth)}, narrower than any radio carrier; write it in Hz, as 100e6",
            )


def _numerologies(scenario: Scenario) -> _Warnings:
    """Subcarriers, taps and slots in another unit than meant, or too few to hold a channel."""
    frame_s = scenario.run.sampling_period_ns * 1e-9
    for index, carrier in enumerate(scenario.carriers):
        spacing, duration, slots = carrier.subcarrier_spacing_hz, carrier.slot_duration_s, carrier.slots
        key = f"carriers[{index}]"
        if carrier.subcarriers and spacing < NARROWEST_HZ:
            meant = f"; {spacing:g} kHz is written {spacing:g}e3" if spacing >= 1 else ""
            yield f"{key}.subcarrier_spacing_hz", f"is {in_hertz(spacing)}; OFDM has 1.25 kHz and more{meant}"
        # A path between two samples is spread over both sides of its delay.
        if 0 < carrier.taps <= TAPS_BEFORE:
            yield (
                f"{key}.taps",
                (
                    f"is {carrier.taps}: taps begin {TAPS_BEFORE} samples before the first path, so that "
                    f"these end before it; write {2 * TAPS_BEFORE + 1} or more"
                ),
            )
        # Of given instants no two need be a sampling period apart.
        if slots > 1 and slots * duration > frame_s * (1 + 1e-9) and not scenario.run.instants_s:
            yield (
                f"{key}.slot_duration_s",
                (
                    f"is {duration:g} s: {slots} slots take {slots * duration:g} s, a frame {frame_s:g} s; "
                    "shifts of Doppler hold within a frame, of which the next one has its own"
                ),
            )


def _arrays(scenario: Scenario) -> _Warnings:
    for index, device in enumerate(scenario.devices):
        array, key = device.array, f"devices[{index}].array"
        if array is None:
            continue
        if array.size > MOST_ELEMENTS:
            yield (
                key,
                (
                    f"has {array.size:,} elements ({array.rows} rows × {array.columns} columns × "
                    f"{len(array.polarizations)} polarizations × {max(1, len(array.panels))} panels); with "
                    f"more than {MOST_ELEMENTS:,} a frame may take minutes"
                ),
            )
        for name in ("vertical_spacing", "horizontal_spacing"):
            if getattr(array, name) > WIDEST:
                yield f"{key}.{name}", f"is {getattr(array, name):g} wavelengths; write it in wavelengths"
        # Elements at one place see the same wave: they are no second panel.
        seen: dict[Panel, int] = {}
        for number, panel in enumerate(array.panels):
            if math.hypot(*panel.position_m) > FARTHEST_PANEL_M:
                yield (
                    f"{key}.panels[{number}].position_m",
                    f"is {math.hypot(*panel.position_m):g} m from the device; panels are parts of one device",
                )
            if seen.setdefault(panel, number) != number:
                yield (
                    f"{key}.panels[{number}]",
                    f"is at the place and in the direction of panels[{seen[panel]}]; give it its own",
                )


def _ladders(prepared: PreparedScenario) -> _Warnings:
    """References of adaptive channels that know less than the rungs that they judge."""
    for channel in prepared.of_role("channel"):
        settings, place = channel.settings, channel.place
        if getattr(settings, "reference", None) is None:
            continue
        from caviar_services.channel.adaptive.controller import AdaptiveSettings, models

        if not isinstance(settings, AdaptiveSettings):
            continue
        *rungs, (_, reference) = models(settings, place)  # the reference stands last
        depth = getattr(reference, "max_depth", 0)
        deeper = [
            rung.label
            for rung, (_, own) in zip(settings.ladder, rungs, strict=True)
            if getattr(own, "max_depth", 0) > depth
        ]
        if deeper:
            yield (
                f"{place.key}.reference",
                (
                    f"has paths of {depth} interactions at most, fewer than {', '.join(deeper)}: what these "
                    "find beyond counts as an error; give it a max_depth of theirs"
                ),
            )


def _object_keys(prepared: PreparedScenario) -> _Warnings:
    """Keys of materials and foliage that no object and no piece of scenery of the run can have."""
    known = _objects_and_pieces(prepared)
    if known is None:
        return
    names, classes = known
    for channel in prepared.of_role("channel"):
        for setting in ("object_materials", "foliage"):
            for key in getattr(channel.settings, setting, ()):
                fits = key in classes or any(name == key or fnmatchcase(name, key) for name in names)
                if not fits:
                    near = get_close_matches(key, [*names, *classes], n=1)
                    hint = f"; did you mean {near[0]!r}?" if near else ""
                    at = channel.place.at(setting).at(key).key
                    yield at, f"is no object, class of objects or piece of scenery of the run{hint}"


def _objects_and_pieces(prepared: PreparedScenario) -> tuple[set[str], set[str]] | None:
    """Names of all objects and pieces of scenery, and all classes; None where they are not known yet."""
    if any(spec.role == "world" and spec.remote for spec in prepared.scenario.services.values()):
        return None
    names, classes = set[str](), set[str]()
    try:
        for world in prepared.of_role("world"):
            objects = world.cls.known_objects(world.settings) if issubclass(world.cls, World) else None
            if objects is None:
                return None
            scenery = world.settings.scenery
            pieces = read_scenery(scenery_file(scenery)).shapes if scenery else ()
            names.update(objects, (piece.name for piece in pieces))
            classes.update(objects.values())
    except (AssetError, ScenarioError, SetupError):
        return None  # the world refuses it itself, with the remedy
    return names, classes


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


def _positions(prepared: PreparedScenario) -> _Warnings:
    placed = [*_placed(prepared)]
    ground = _scenery_of(prepared.scenario) if placed else None
    if ground is None:
        return
    known: set[str] = set()
    for key, name, position in placed:
        wrong = ground.implausible(np.array(position)) if name not in known else ""
        if wrong:
            known.add(name)
            at = ", ".join(f"{number:g}" for number in position)
            yield key, f"{name!r} stands at ({at}) m, {wrong}"


def _placed(prepared: PreparedScenario) -> Iterator[tuple[str, str, Vector]]:
    """Key, name and position [m] of what stands at a place of its own: devices, and objects of worlds."""
    for index, device in enumerate(prepared.scenario.devices):
        if not device.on:
            yield f"devices[{index}].position_m", device.name, device.position_m
    for world in prepared.of_role("world"):
        try:
            placements = list(world.cls.placements(world.settings)) if issubclass(world.cls, World) else []
        except ScenarioError:
            continue  # the world refuses it itself, with the remedy
        for key, thing, positions in placements:
            for position in positions[:: max(1, math.ceil(len(positions) / LOOKED_AT))]:
                yield f"{world.place.key}.{key}", thing, position


class _Ground:
    """The scenery of a scenario: how far it reaches, and what is below its ground."""

    def __init__(self, triangles: Float64Array) -> None:
        from caviar_space.obstacles import Surfaces  # which a scenario without scenery does not need

        corners = triangles.reshape(-1, 3)
        self._low, self._high = corners.min(0), corners.max(0)
        self._surfaces = Surfaces(triangles, lambda triangle, normal: True)

    def implausible(self, position: Float64Array) -> str:
        """Fault of a position [m], Shape ``[3]``; empty: none."""
        if (position[:2] < self._low[:2]).any() or (position[:2] > self._high[:2]).any():
            return f"outside the scenery, which reaches {_span(self._low, self._high)}"
        # Under the ground, and not under a roof or a bridge: something is above and nothing below.
        above = np.array([*position[:2], self._high[2] + 1.0])
        below = np.array([*position[:2], self._low[2] - 1.0])
        if position[2] < self._low[2] or (
            self._surfaces.between(position, above) and not self._surfaces.between(position, below)
        ):
            return "below the ground"
        if position[2] > self._high[2] + float(np.linalg.norm(self._high - self._low)):
            return f"far above the scenery, which reaches {_span(self._low, self._high)}"
        return ""


def _scenery_of(scenario: Scenario) -> _Ground | None:
    """Load the scenery; None where there is none, or its world will refuse it, with the remedy."""
    worlds = [spec.settings for spec in scenario.services.values() if spec.role == "world"]
    try:
        found = [scenery_triangles(scenery_assets(str(each.get("scenery") or ""))) for each in worlds]
    except (AssetError, ScenarioError, SetupError):
        return None
    triangles = np.concatenate(found) if found else np.zeros((0, 3, 3))
    return _Ground(triangles) if len(triangles) else None


def _span(low: Sequence[float] | Float64Array, high: Sequence[float] | Float64Array) -> str:
    axes = zip("xyz", low, high, strict=True)
    return ", ".join(f"{axis} {a:.4g} to {b:.4g} m" for axis, a, b in axes)


def _meant(value_hz: float, low: float, high: float) -> str:
    """Hint at a frequency that is written in another unit; empty where no unit makes it plausible."""
    for exponent, unit in ((9, "GHz"), (6, "MHz"), (3, "kHz")):
        if value_hz < _MOST_OF_A_UNIT and low <= value_hz * 10.0**exponent <= high:
            return f"; {value_hz:g} {unit} is written {value_hz:g}e{exponent}"
    return f"; is it {in_hertz(value_hz / 1e3)}?" if low <= value_hz / 1e3 <= high else ""


def in_hertz(value_hz: float) -> str:
    """Write a frequency with a unit of suitable size.

    Example:
        >>> in_hertz(28e9), in_hertz(15e3)
        ('28 GHz', '15 kHz')
    """
    for factor, unit in ((1e12, "THz"), (1e9, "GHz"), (1e6, "MHz"), (1e3, "kHz")):
        if value_hz >= factor:
            return f"{value_hz / factor:g} {unit}"
    return f"{value_hz:g} Hz"
