"""Radio materials: ITU-R P.2040 evaluated in double precision, and what a scenario changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import msgspec

from caviar_protocol.errors import ScenarioError

OutsideRange = Literal["refuse", "nearest"]


class MaterialSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What to change about a material of the scenery; what is not given stays."""

    relative_permittivity: float | None = None
    conductivity_s_per_m: float | None = None
    scattering_coefficient: float | None = None
    xpd_coefficient: float | None = None
    thickness_m: float | None = None

    @property
    def is_electric(self) -> bool:
        """Whether both electric constants are given, so that no ITU material is needed."""
        return self.relative_permittivity is not None and self.conductivity_s_per_m is not None


def itu_constants(
    name: str, itu_type: str, frequency_hz: float, outside: OutsideRange
) -> tuple[float, float]:
    """Relative permittivity and conductivity [S/m] of an ITU material (P.2040, eqs. 28 and 29).

    Raises `ScenarioError` naming the material, its ranges and the remedies where the frequency is outside all
    of them, unless ``outside`` is ``nearest``: then the constants are those at the nearest end.
    """
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    table = ITU_MATERIALS_PROPERTIES.get(itu_type)
    if table is None:
        raise ScenarioError(
            f"there is no ITU material {itu_type!r}; known: {', '.join(sorted(ITU_MATERIALS_PROPERTIES))}"
        )
    gigahertz = frequency_hz / 1e9
    ranges: Sequence[tuple[float, float]] = list(table)
    inside = next((r for r in ranges if r[0] <= gigahertz <= r[1]), None)
    if inside is None:
        if outside == "refuse":
            spans = ", ".join(f"{low:g}–{high:g} GHz" for low, high in ranges)
            raise ScenarioError(
                f"material {name!r} (ITU {itu_type}) is defined for {spans}, the carrier is at "
                f"{gigahertz:g} GHz; choose a carrier within, give the material relative_permittivity and "
                f'conductivity_s_per_m in settings.materials.{name}, or set outside_itu_range = "nearest"'
            )
        inside = min(ranges, key=lambda r: min(abs(gigahertz - r[0]), abs(gigahertz - r[1])))
        gigahertz = min(max(gigahertz, inside[0]), inside[1])
    a, b, c, d = table[inside]
    return a * gigahertz**b, c * gigahertz**d


Constants = tuple[float, float]
"""Relative permittivity and conductivity [S/m]."""


def set_materials(
    scene: Any, frequency_hz: float, changes: Mapping[str, MaterialSettings], outside: OutsideRange
) -> None:
    """Give all materials of a `sionna.rt.Scene` their constants at the carrier.

    Constants are set here rather than by Sionna RT, whose float32 frequency puts 60 GHz outside of
    a range that ends at 60 GHz. Raises `ScenarioError` for an unknown name or a bad value.
    """
    materials = scene.radio_materials
    unknown = sorted(changes.keys() - materials.keys())
    if unknown:
        raise ScenarioError(
            f"the scenery has no material {unknown[0]!r}; it has: {', '.join(sorted(materials))}"
        )
    for name, material in materials.items():
        change = changes.get(name, MaterialSettings())
        try:
            _set_material(name, material, frequency_hz, change, outside)
        except ValueError as error:
            raise ScenarioError(f"material {name!r}: {error}; correct settings.materials.{name}") from error
    scene.frequency = frequency_hz


def itu_materials(
    scene: Any, frequency_hz: float, changes: Mapping[str, MaterialSettings], outside: OutsideRange
) -> list[tuple[Any, Constants]]:
    """Materials of a `sionna.rt.Scene` that may differ between carriers, with their constants at one."""
    found = []
    for name, material in scene.radio_materials.items():
        change = changes.get(name, MaterialSettings())
        if hasattr(material, "itu_type") and not change.is_electric:
            permittivity, conductivity = itu_constants(name, material.itu_type, frequency_hz, outside)
            if change.relative_permittivity is not None:
                permittivity = change.relative_permittivity
            if change.conductivity_s_per_m is not None:
                conductivity = change.conductivity_s_per_m
            found.append((material, (permittivity, conductivity)))
    return found


def _set_material(
    name: str, material: Any, frequency_hz: float, change: MaterialSettings, outside: OutsideRange
) -> None:
    if hasattr(material, "itu_type"):
        material.frequency_update_callback = None
        if not change.is_electric:
            constants = itu_constants(name, material.itu_type, frequency_hz, outside)
            material.relative_permittivity, material.conductivity = constants
    for attribute, value in (
        ("relative_permittivity", change.relative_permittivity),
        ("conductivity", change.conductivity_s_per_m),
        ("scattering_coefficient", change.scattering_coefficient),
        ("xpd_coefficient", change.xpd_coefficient),
        ("thickness", change.thickness_m),
    ):
        if value is not None:
            setattr(material, attribute, value)
