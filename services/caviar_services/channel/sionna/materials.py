"""Radio materials: ITU-R P.2040 in double precision, what a scenario changes, and what objects are made of.

Beside the materials of ITU-R P.2040 there are those that it lacks (`OTHER_MATERIALS`). Moving objects and
single pieces of scenery have materials by name, pattern or class.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Annotated, Any, Literal

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.errors import ScenarioError, suggestion
from caviar_protocol.scenario.conversion import Place
from caviar_services.channel.propagation.fresnel import EPSILON_0

Constants = tuple[float, float]
"""Relative permittivity and conductivity [S/m]."""

DRAWN = 2.0**-26
"""A ray is sent through a surface with a probability; below this one none ever is.

The ray tracer draws from multiples of 2⁻²³ below 1, and probabilities are float32: one below 2⁻²⁵ is
lost beside that of a reflection. The factor of two is a margin.
"""


@dataclass(frozen=True, kw_only=True)
class SurfaceMaterial:
    """What a surface in use is made of."""

    name: str
    constants: tuple[Constants, ...]
    """On each carrier."""
    thickness_m: float
    scattering_coefficient: float


@dataclass(frozen=True, kw_only=True)
class UsedSurfaces:
    """What waves can meet in a scene, at rest and moving."""

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
    permittivity = complex(4.0, -0.0002 / (omega * EPSILON_0))
    for strength, relaxation_s, alpha in ((32.0, 7.234e-12, 0.0), (1100.0, 32.481e-9, 0.20)):
        permittivity += strength / (1 + (1j * omega * relaxation_s) ** (1 - alpha))
    return permittivity.real, -permittivity.imag * omega * EPSILON_0


def _abs_plastic(gigahertz: float) -> Constants:
    """ABS, of which bumpers and housings are made: ε = 2.7 and tan δ = 0.008 at 11 GHz (B. Riddle,
    J. Baker-Jarvis and J. Krupka, "Complex permittivity measurements of common plastics over variable
    temperatures", IEEE Trans. Microw. Theory Tech. 51(3), 2003), taken as the same at other frequencies."""
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

    def of(self, name: str, cls: str = "") -> str:
        """Material of an object, or of a piece of scenery; empty where no key is for it."""
        return self.by_key.get(self.key_for(name, cls), "")

    def key_for(self, name: str, cls: str = "") -> str:
        """Key that counts for an object: its name, else the first pattern that matches it, else its class;
        empty where none of these is there."""
        if not self.by_key:
            return ""
        if name in self.by_key:
            return name
        patterns = (key for key in self.by_key if "*" in key and fnmatchcase(name, key))
        return next(patterns, cls if cls in self.by_key else "")

    def key_of(self, material: str) -> str:
        """The first key of a material."""
        return next(key for key, found in self.by_key.items() if found == material)

    def unmatched(self, named: Iterable[tuple[str, str]]) -> tuple[str, ...]:
        """Keys that count for none of these names and classes."""
        used = {self.key_for(name, cls) for name, cls in named}
        return tuple(key for key in self.by_key if key not in used)


def body_kind(asset: str, material: str) -> str:
    """Name of the bodies of a mesh and a material; those of ``body_material``, the empty string here, are
    called as the asset itself."""
    return f"{asset or 'the box'} of {material}" if material else asset


OBJECT_MATERIAL = "caviar-object-"
"""What the ray tracer's names of materials begin with that objects are given."""

BODY_THICKNESS = 0.1
"""[m]; of the walls of bodies, where a scenario does not say."""

OutsideRange = Literal["error", "nearest", "extrapolate"]
"""Where a carrier lies in none of the ranges that ITU-R P.2040 defines a material in: refuse it; take the
constants of the nearest end of a range; or follow the power law of that range beyond its end."""


class MaterialSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What to change about a material of the scenery; what is not given stays."""

    relative_permittivity: Annotated[float, quantity("1", "its real part", ge=1, le=1e30)] | None = None
    conductivity_s_per_m: Annotated[float, quantity("S/m", "its conductivity", ge=0, le=1e30)] | None = None
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
        """Whether both electric constants are given, so that no ITU material is needed."""
        return self.relative_permittivity is not None and self.conductivity_s_per_m is not None

    def missing(self, name: str) -> str:
        """What a material of the user's own, of this name, lacks; empty where neither constant is given."""
        lacking = [
            key for key in ("relative_permittivity", "conductivity_s_per_m") if getattr(self, key) is None
        ]
        return f"write materials.{name}.{lacking[0]} for one of your own, or " if len(lacking) == 1 else ""

    def applied(self, constants: Constants) -> Constants:
        """These constants with the changes."""
        permittivity, conductivity = constants
        if self.relative_permittivity is not None:
            permittivity = self.relative_permittivity
        if self.conductivity_s_per_m is not None:
            conductivity = self.conductivity_s_per_m
        return permittivity, conductivity


@dataclass(frozen=True, kw_only=True)
class MaterialPolicy:
    """What a scenario says about materials."""

    changes: Mapping[str, MaterialSettings] = field(default_factory=dict)
    """By name of the material in the scenery."""
    outside: OutsideRange = "error"
    key: str = field(default="settings", compare=False)
    """Of the settings in the scenario, for messages."""

    def of(self, name: str) -> MaterialSettings:
        return self.changes.get(name, MaterialSettings())


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
        """Whether the frequency lies outside all ranges."""
        return not self.taken_ghz[0] <= self.frequency_hz / 1e9 <= self.taken_ghz[1]

    @property
    def source(self) -> str:
        """What was taken in place of constants that are not defined, in short."""
        low, high = self.taken_ghz
        if self.policy == "extrapolate":
            return f"extrapolate {low:g}–{high:g} GHz"
        return f"nearest {_clamped(self.frequency_hz / 1e9, self.taken_ghz):g} GHz"


@dataclass(frozen=True, kw_only=True)
class OutsideUse:
    """That a material is used where ITU-R P.2040 does not define it."""

    name: str
    carrier: int
    """Index of the carrier."""
    itu: ItuMaterial
    constants: Constants
    """As used, with what the scenario changes."""

    def brief(self, carrier: str) -> str:
        """For the provenance: ``brick@mmwave: nearest 40 GHz``."""
        return f"{self.name}@{carrier}: {self.itu.source}"

    def note(self, carrier: str) -> str:
        """For the user, with the constants."""
        permittivity, conductivity = self.constants
        return (
            f"material {self.name!r} ({self.itu.label}) is defined for {_spans(self.itu.ranges_ghz)}; "
            f"on carrier {carrier!r} at {self.itu.frequency_hz / 1e9:g} GHz it has ({self.itu.source}) "
            f"relative permittivity {permittivity:.4g}, conductivity {conductivity:.4g} S/m"
        )


def itu_material(
    name: str, itu_type: str, frequency_hz: float, policy: MaterialPolicy, remedy: str = ""
) -> ItuMaterial:
    """A material by its ITU-R P.2040 type: a·f^b and c·f^d with f in GHz (P.2040-3, eqs. 28 and 29, table 3);
    or one of `OTHER_MATERIALS` by its name.

    Outside of all ranges the nearest one counts, by the distance [Hz] of its nearest end; of two equally
    near, the first of the table. Raises `ScenarioError` naming material, ranges and remedies under the policy
    ``error``; ``remedy`` stands in place of constants of the user's own.
    """
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    other = OTHER_MATERIALS.get(itu_type)
    table: Mapping[tuple[float, float], tuple[float, ...]] | None = ITU_MATERIALS_PROPERTIES.get(itu_type)
    if other is not None:
        table = {other.range_ghz: ()}
    if table is None:
        known = sorted({*ITU_MATERIALS_PROPERTIES, *OTHER_MATERIALS})
        raise ScenarioError(
            f"there is no ITU material {itu_type!r}; {policy.of(itu_type).missing(itu_type)}"
            f"{suggestion(itu_type, known)}",
            key=f"{policy.key}.{name}" if remedy else f"{policy.key}.materials.{name}",
        )
    gigahertz, label = frequency_hz / 1e9, itu_type if other else f"ITU {itu_type}"
    taken = next((r for r in table if r[0] <= gigahertz <= r[1]), None)
    evaluated = gigahertz
    if taken is None:
        if policy.outside == "error":
            own = f"give it relative_permittivity and conductivity_s_per_m in {policy.key}.materials.{name}"
            raise ScenarioError(
                f"material {name!r} ({label}) is defined for {_spans(tuple(table))}, the carrier is "
                f"at {gigahertz:g} GHz; choose a carrier within, {remedy or own}, or set outside_itu_range = "
                '"nearest" (constants of the nearest end) or "extrapolate" (power law of the nearest range)',
                key=f"{policy.key}.outside_itu_range",
            )
        taken = min(table, key=lambda r: abs(gigahertz - _clamped(gigahertz, r)))
        if policy.outside == "nearest":
            evaluated = _clamped(gigahertz, taken)
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


@contextmanager
def any_frequency() -> Iterator[None]:
    """While a scene is loaded, which Sionna RT does at 3.5 GHz, no material is outside its range.

    The materials then have constants that mean nothing: `freeze` and `set_materials` are to follow.
    """
    from sionna.rt.radio_materials import itu_material as module

    evaluate = module.itu_material
    module.itu_material = lambda name, frequency: (1.0, 0.0)
    try:
        yield
    finally:
        module.itu_material = evaluate


def freeze(scene: Any) -> None:
    """Let no change of the scene's frequency change a material."""
    for material in scene.radio_materials.values():
        if hasattr(material, "itu_type"):
            material.frequency_update_callback = None


@dataclass(frozen=True, eq=False)
class ObjectMaterial:
    """A material that objects are given, in the ray tracer."""

    name: str
    radio: Any
    """The `sionna.rt.RadioMaterial`."""
    itu: tuple[ItuMaterial, ...]
    """On each carrier; empty where its constants are the scenario's."""
    constants: tuple[Constants, ...]
    """On each carrier, as used."""


def object_materials(
    objects: ObjectMaterials, frequencies_hz: tuple[float, ...], policy: MaterialPolicy
) -> dict[str, ObjectMaterial]:
    """The materials that objects are given, by name.

    Raises `ScenarioError` naming the key for one that neither ITU-R P.2040 nor `OTHER_MATERIALS` has, without
    constants of the scenario's own.
    """
    from sionna.rt import RadioMaterial

    made = {}
    for name in objects.names:
        change, key = policy.of(name), Place("object_materials").at(objects.key_of(name)).key
        remedy = f"choose another material, give {policy.key}.materials.{name} constants of its own"
        itu: tuple[ItuMaterial, ...] = ()
        if not change.is_electric:
            itu = tuple(itu_material(key, name, f, policy, remedy) for f in frequencies_hz)
        defined = [of.constants for of in itu] or [(1.0, 0.0)] * len(frequencies_hz)
        constants = tuple(change.applied(of_carrier) for of_carrier in defined)
        radio = RadioMaterial(f"{OBJECT_MATERIAL}{name}", BODY_THICKNESS)
        _checked_change(radio, name, change, policy)
        radio.relative_permittivity, radio.conductivity = constants[0]
        made[name] = ObjectMaterial(name, radio, itu, constants)
    return made


def set_materials(
    scene: Any, frequency_hz: float, policy: MaterialPolicy, others: Iterable[str] = ()
) -> None:
    """Give all materials of a `sionna.rt.Scene` their constants at the carrier.

    Constants are set here rather than by Sionna RT, whose float32 frequency puts 60 GHz outside of
    a range that ends at 60 GHz; the scene's own materials are frozen. ``others`` are those that objects are
    given. Raises `ScenarioError` for an unknown name or a bad value.
    """
    materials = scene.radio_materials
    unknown = sorted(policy.changes.keys() - materials.keys() - set(others))
    if unknown:
        raise ScenarioError(
            f"the scenery has no material {unknown[0]!r}; it has: {', '.join(sorted(materials))}",
            key=f"{policy.key}.materials.{unknown[0]}",
        )
    for name, material in materials.items():
        itu = _itu_of(name, material, frequency_hz, policy)
        if itu is not None:
            material.relative_permittivity, material.conductivity = itu.constants
        _checked_change(material, name, policy.of(name), policy)
    scene.frequency = frequency_hz


def itu_materials(
    scene: Any, frequency_hz: float, policy: MaterialPolicy
) -> list[tuple[Any, ItuMaterial, Constants]]:
    """Materials of a `sionna.rt.Scene` that may differ between carriers, with their constants at one, as ITU
    defines them and as changed."""
    found = []
    for name, material in scene.radio_materials.items():
        itu = _itu_of(name, material, frequency_hz, policy)
        if itu is not None:
            found.append((material, itu, policy.of(name).applied(itu.constants)))
    return found


def _itu_of(name: str, material: Any, frequency_hz: float, policy: MaterialPolicy) -> ItuMaterial | None:
    """The ITU material that a material of the scene is; None for others, and for those that nothing needs."""
    if not hasattr(material, "itu_type") or policy.of(name).is_electric or not material.is_used:
        return None
    return itu_material(name, material.itu_type, frequency_hz, policy)


def _checked_change(material: Any, name: str, change: MaterialSettings, policy: MaterialPolicy) -> None:
    """Give a material what a scenario changes about it. Raises `ScenarioError` for a bad value."""
    try:
        for attribute, value in (
            ("relative_permittivity", change.relative_permittivity),
            ("conductivity", change.conductivity_s_per_m),
            ("scattering_coefficient", change.scattering_coefficient),
            ("xpd_coefficient", change.xpd_coefficient),
            ("thickness", change.thickness_m),
        ):
            if value is not None:
                setattr(material, attribute, value)
    except ValueError as error:
        raise ScenarioError(
            f"material {name!r}: {error}; correct it", key=f"{policy.key}.materials.{name}"
        ) from error


def _clamped(gigahertz: float, span: tuple[float, float]) -> float:
    """The frequency of a range that is nearest to this one."""
    return min(max(gigahertz, span[0]), span[1])


def _spans(ranges: tuple[tuple[float, float], ...]) -> str:
    return ", ".join(f"{low:g}–{high:g} GHz" for low, high in ranges)
