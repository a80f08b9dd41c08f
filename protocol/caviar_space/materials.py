"""Radio materials: ITU-R P.2040 in double precision, what a scenario changes, and what objects are made of.

Beside the materials of ITU-R P.2040 there are those that it lacks (`OTHER_MATERIALS`). Moving objects and
single pieces of scenery have materials by name, pattern or class.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Annotated, Literal

import msgspec
from msgspec.structs import replace

from caviar_protocol.arrays import quantity
from caviar_protocol.errors import ScenarioError, suggestion

EPSILON_0 = 8.8541878128e-12
"""Permittivity of vacuum [F/m] (CODATA 2018)."""

Constants = tuple[float, float]
"""Relative permittivity and conductivity [S/m]."""

DRAWN = 2.0**-26
"""A ray is sent through a surface with a probability; below this one none ever is.

The ray tracer draws from multiples of 2⁻²³ below 1, and probabilities are float32: one below 2⁻²⁵ is
lost beside that of a reflection. The factor of two is a margin.
"""


@dataclass(frozen=True, kw_only=True)
class SurfaceMaterial:
    """Material of a surface in use."""

    name: str
    constants: tuple[Constants, ...]
    """On each carrier."""
    thickness_m: float
    scattering_coefficient: float


@dataclass(frozen=True, kw_only=True)
class UsedSurfaces:
    """Surfaces that waves can meet in a scene, at rest and moving."""

    materials: tuple[SurfaceMaterial, ...]
    """Of all surfaces; empty where there are none."""
    has_edges: bool
    """Whether anything diffracts (`mesh_edges`)."""


@dataclass(frozen=True)
class OtherMaterial:
    """A material that ITU-R P.2040 lacks."""

    range_ghz: tuple[float, float]
    """Where its source holds."""
    constants: Callable[[float], Constants]
    """At a frequency [GHz]."""


def _dry_skin(gigahertz: float) -> Constants:
    """Cole-Cole model of dry skin (S. Gabriel, R. W. Lau and C. Gabriel, "The dielectric properties of
    biological tissues: III. Parametric models for the dielectric spectrum of tissues", Phys. Med. Biol. 41,
    1996, eq. 1 and table 1; the dispersions of strength 0 are left out)."""
    omega = 2 * math.pi * gigahertz * 1e9
    # ε∞ = 4 and σ = 0.0002 S/m; of each dispersion Δε, τ and α.
    permittivity = complex(4.0, -0.0002 / (omega * EPSILON_0))
    for strength, relaxation_s, alpha in ((32.0, 7.234e-12, 0.0), (1100.0, 32.481e-9, 0.20)):
        permittivity += strength / (1 + (1j * omega * relaxation_s) ** (1 - alpha))
    return permittivity.real, -permittivity.imag * omega * EPSILON_0


def _abs_plastic(gigahertz: float) -> Constants:
    """ABS, of which bumpers and housings are made: ε = 2.7 and tan δ = 0.008 at 11 GHz (B. Riddle,
    J. Baker-Jarvis and J. Krupka, "Complex permittivity measurements of common plastics over variable
    temperatures", IEEE Trans. Microw. Theory Tech. 51(3), 2003), taken as the same at other frequencies."""
    # σ = ω ε₀ ε′ tan δ
    return 2.7, 2.7 * 0.008 * 2 * math.pi * gigahertz * 1e9 * EPSILON_0


OTHER_MATERIALS: Mapping[str, OtherMaterial] = {
    "plastic": OtherMaterial((1.0, 100.0), _abs_plastic),
    "skin": OtherMaterial((0.1, 100.0), _dry_skin),
}


@dataclass(frozen=True)
class ObjectMaterials:
    """Materials of objects that differ from the others."""

    by_key: Mapping[str, str] = field(default_factory=dict)
    """Material by name of an object, by a pattern of names with ``*``, or by class."""

    @property
    def names(self) -> tuple[str, ...]:
        """The materials, sorted."""
        return tuple(sorted(set(self.by_key.values())))

    def material_for(self, name: str, cls: str = "") -> str:
        """Material of an object, or of a piece of scenery; empty where no key is for it.

        Args:
            name: Of the object or piece.
            cls: Class of the object; empty for scenery.

        Example:
            >>> materials = ObjectMaterials({"car": "glass", "bus.*": "metal"})
            >>> named = ("bus.3", "bus"), ("c7", "car"), ("wall", "")
            >>> [materials.material_for(*name_and_class) for name_and_class in named]
            ['metal', 'glass', '']
        """
        return self.by_key.get(self.key_for(name, cls), "")

    def key_for(self, name: str, cls: str = "") -> str:
        """Find the key that counts for an object: its name, else the first pattern that matches it, else its
        class.

        Args:
            name, cls: See `material_for`.

        Returns:
            The key; empty where there is none.
        """
        # Most scenarios have no keys, and every object of every frame is asked for.
        if not self.by_key:
            return ""
        if name in self.by_key:
            return name
        # Keys without a star are no patterns: names may have brackets, which fnmatch would interpret.
        patterns = (key for key in self.by_key if "*" in key and fnmatchcase(name, key))
        return next(patterns, cls if cls in self.by_key else "")

    def key_of(self, material: str) -> str:
        """The first key of a material.

        Args:
            material: One of `names`.
        """
        return next(key for key, found in self.by_key.items() if found == material)

    def unmatched(self, named: Iterable[tuple[str, str]]) -> tuple[str, ...]:
        """Keys that count for no object, in which a name is mostly misspelt.

        Args:
            named: Names and classes of objects and pieces of scenery.
        """
        used = {self.key_for(name, cls) for name, cls in named}
        return tuple(key for key in self.by_key if key not in used)


def body_kind(asset: str, material: str) -> str:
    """Name the bodies of a mesh and a material.

    Args:
        asset: File of the mesh; empty for the box.
        material: Empty for ``body_material``, whose bodies are called as the asset itself.

    Example:
        >>> body_kind("objects/car.ply", "glass")
        'objects/car.ply of glass'
    """
    return f"{asset or 'the box'} of {material}" if material else asset


OBJECT_MATERIAL = "caviar-object-"
"""What the ray tracer's names of materials begin with that objects are given."""

BODY_THICKNESS = 0.1
"""[m]; of the walls of bodies, where a scenario does not say."""


def of_thickness(name: str, thickness_m: float) -> str:
    """Name a material of the walls of one thickness [m].

    Example:
        >>> of_thickness("itu_concrete", 0.2), without_thickness("itu_concrete, solid 0.2 m")
        ('itu_concrete, solid 0.2 m', 'itu_concrete')
    """
    return f"{name}{_SOLID}{thickness_m:g} m"


def without_thickness(name: str) -> str:
    """Name of the material that one for a solid wall (`of_thickness`) is of."""
    return name.partition(_SOLID)[0]


_SOLID = ", solid "

OutsideRange = Literal["error", "nearest", "extrapolate"]
"""Where a carrier lies in none of the ranges that ITU-R P.2040 defines a material in: refuse it; take the
constants of the nearest end of a range; or follow the power law of that range beyond its end."""


class MaterialSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Changes of a material of the scenery; a key that is not given changes nothing."""

    # At most 1e12, where |R| is 1 to 1e-5: beyond it squares leave float32, and reflections are lost.
    relative_permittivity: Annotated[float, quantity("1", "its real part", ge=1, le=1e12)] | None = None
    conductivity_s_per_m: Annotated[float, quantity("S/m", "its conductivity", ge=0, le=1e12)] | None = None
    scattering_coefficient: (
        Annotated[float, quantity("1", "share of the reflected amplitude that is scattered", ge=0, le=1)]
        | None
    ) = None
    xpd_coefficient: (
        Annotated[float, quantity("1", "share of the scattered power in the other polarization", ge=0, le=1)]
        | None
    ) = None
    thickness_m: Annotated[float, quantity("m", "thickness of walls", gt=0)] | None = None

    @property
    def is_electric(self) -> bool:
        """True if both electric constants are given, so that no ITU material is needed."""
        return self.relative_permittivity is not None and self.conductivity_s_per_m is not None

    def missing(self, name: str) -> str:
        """Remedy for a material of the user's own that lacks a constant; empty where both or none are given.

        Args:
            name: Of the material.
        """
        lacking = [
            key for key in ("relative_permittivity", "conductivity_s_per_m") if getattr(self, key) is None
        ]
        return f"write materials.{name}.{lacking[0]} for one of your own, or " if len(lacking) == 1 else ""

    def applied(self, constants: Constants) -> Constants:
        """Change constants as the scenario says.

        Args:
            constants: As ITU-R P.2040 defines them.
        """
        # What is not given stays as the Recommendation has it.
        permittivity, conductivity = constants
        if self.relative_permittivity is not None:
            permittivity = self.relative_permittivity
        if self.conductivity_s_per_m is not None:
            conductivity = self.conductivity_s_per_m
        return permittivity, conductivity


@dataclass(frozen=True, kw_only=True)
class MaterialPolicy:
    """Policy of a scenario for materials."""

    changes: Mapping[str, MaterialSettings] = field(default_factory=dict)
    """By name of the material in the scenery."""
    outside: OutsideRange = "error"
    key: str = field(default="settings", compare=False)
    """Of the settings in the scenario, for messages."""

    def changes_of(self, name: str) -> MaterialSettings:
        """Changes of a material; of one for a solid wall (`of_thickness`) those of the other, but thickness.

        Args:
            name: Of the material.
        """
        base = without_thickness(name)
        found = self.changes.get(name) or self.changes.get(base, MaterialSettings())
        return found if base == name else replace(found, thickness_m=None)


@dataclass(frozen=True, kw_only=True)
class ItuMaterial:
    """A material of ITU-R P.2040 at one frequency."""

    itu_type: str
    frequency_hz: float
    ranges_ghz: tuple[tuple[float, float], ...]
    """Where the material is defined."""
    taken_ghz: tuple[float, float]
    """The range whose parameters were taken."""
    policy: OutsideRange
    constants: Constants

    @property
    def label(self) -> str:
        """Name of the material, with ITU where the Recommendation has it."""
        return self.itu_type if self.itu_type in OTHER_MATERIALS else f"ITU {self.itu_type}"

    @property
    def is_outside(self) -> bool:
        """True if the frequency lies outside all ranges."""
        return not self.taken_ghz[0] <= self.frequency_hz / 1e9 <= self.taken_ghz[1]

    @property
    def source(self) -> str:
        """Source of constants that are taken in place of undefined ones, in short."""
        low, high = self.taken_ghz
        if self.policy == "extrapolate":
            return f"extrapolate {low:g}–{high:g} GHz"
        return f"nearest {_clamped(self.frequency_hz / 1e9, self.taken_ghz):g} GHz"


@dataclass(frozen=True, kw_only=True)
class OutsideUse:
    """Use of a material where ITU-R P.2040 does not define it."""

    name: str
    carrier: int
    """Index of the carrier."""
    itu: ItuMaterial
    constants: Constants
    """As used, with what the scenario changes."""

    def brief(self, carrier: str) -> str:
        """For the provenance: ``brick@mmwave: nearest 40 GHz``.

        Args:
            carrier: Name of the carrier.
        """
        return f"{self.name}@{carrier}: {self.itu.source}"

    def note(self, carrier: str) -> str:
        """For the user, with the constants.

        Args:
            carrier: Name of the carrier.
        """
        permittivity, conductivity = self.constants
        return (
            f"material {self.name!r} ({self.itu.label}) is defined for {_spans(self.itu.ranges_ghz)}; "
            f"on carrier {carrier!r} at {self.itu.frequency_hz / 1e9:g} GHz it has ({self.itu.source}) "
            f"relative permittivity {permittivity:.4g}, conductivity {conductivity:.4g} S/m"
        )


def itu_material(
    name: str, itu_type: str, frequency_hz: float, policy: MaterialPolicy, remedy: str = ""
) -> ItuMaterial:
    """Evaluate a material of ITU-R P.2040, or one of `OTHER_MATERIALS`, at a frequency.

    Its constants are a·f^b and c·f^d with f in GHz (P.2040-3, eqs. 28 and 29, table 3). Outside of all
    ranges the nearest one counts, by the distance [Hz] of its nearest end; of two equally near, the first of
    the table.

    Args:
        name: Of the material in the scenario, for messages.
        itu_type: Its name in the Recommendation: ``concrete``.
        frequency_hz: [Hz].
        policy: What to do where the material is not defined.
        remedy: What an error proposes in place of constants of the user's own.

    Raises:
        ScenarioError: There is no such material, or it is not defined at the frequency under the policy
            ``error``; names material, ranges and remedies.
    """
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    other = OTHER_MATERIALS.get(itu_type)
    table: Mapping[tuple[float, float], tuple[float, ...]] | None = ITU_MATERIALS_PROPERTIES.get(itu_type)
    if other is not None:
        table = {other.range_ghz: ()}
    if table is None:
        known = sorted({*ITU_MATERIALS_PROPERTIES, *OTHER_MATERIALS})
        raise ScenarioError(
            f"there is no ITU material {itu_type!r}; {policy.changes_of(itu_type).missing(itu_type)}"
            f"{suggestion(itu_type, known)}",
            key=f"{policy.key}.{name}" if remedy else f"{policy.key}.materials.{name}",
        )
    # Compared in float64: as float32, 60 GHz lies outside of a range that ends at 60 GHz.
    gigahertz, label = frequency_hz / 1e9, itu_type if other else f"ITU {itu_type}"
    taken = next((r for r in table if r[0] <= gigahertz <= r[1]), None)
    evaluated = gigahertz
    if taken is None:
        if policy.outside == "error":
            # body_material and object_materials have remedies of their own: constants stand elsewhere.
            own = f"give it relative_permittivity and conductivity_s_per_m in {policy.key}.materials.{name}"
            raise ScenarioError(
                f"material {name!r} ({label}) is defined for {_spans(tuple(table))}, the carrier is "
                f"at {gigahertz:g} GHz; choose a carrier within, {remedy or own}, or set outside_itu_range = "
                '"nearest" (constants of the nearest end) or "extrapolate" (power law of the nearest range)',
                key=f"{policy.key}.outside_itu_range",
            )
        # Of two ranges that are as near, min takes the first.
        taken = min(table, key=lambda r: abs(gigahertz - _clamped(gigahertz, r)))
        if policy.outside == "nearest":
            # The power law of the range, at its end.
            evaluated = _clamped(gigahertz, taken)
    # Other materials have models of their own, ITU ones the power laws of table 3.
    if other is not None:
        constants = other.constants(evaluated)
    else:
        a, b, c, d = table[taken]
        constants = a * evaluated**b, c * evaluated**d
    return ItuMaterial(
        itu_type=itu_type,
        frequency_hz=frequency_hz,
        ranges_ghz=tuple(table),
        taken_ghz=taken,
        policy=policy.outside,
        constants=constants,
    )


def _clamped(gigahertz: float, span: tuple[float, float]) -> float:
    """The frequency of a range that is nearest to this one."""
    return min(max(gigahertz, span[0]), span[1])


def _spans(ranges: tuple[tuple[float, float], ...]) -> str:
    return ", ".join(f"{low:g}–{high:g} GHz" for low, high in ranges)
