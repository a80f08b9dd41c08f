"""What moving objects and single pieces of scenery are made of, by name or class.

Beside the materials of ITU-R P.2040 there are those that it lacks (`OTHER_MATERIALS`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from fnmatch import fnmatchcase

Constants = tuple[float, float]
"""Relative permittivity and conductivity [S/m]."""

_EPSILON_0 = 8.8541878128e-12
"""Permittivity of vacuum [F/m] (CODATA 2018)."""


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
    permittivity = complex(4.0, -0.0002 / (omega * _EPSILON_0))
    for strength, relaxation_s, alpha in ((32.0, 7.234e-12, 0.0), (1100.0, 32.481e-9, 0.20)):
        permittivity += strength / (1 + (1j * omega * relaxation_s) ** (1 - alpha))
    return permittivity.real, -permittivity.imag * omega * _EPSILON_0


def _abs_plastic(gigahertz: float) -> Constants:
    """ABS, of which bumpers and housings are made: ε = 2.7 and tan δ = 0.008 at 11 GHz (B. Riddle,
    J. Baker-Jarvis and J. Krupka, "Complex permittivity measurements of common plastics over variable
    temperatures", IEEE Trans. Microw. Theory Tech. 51(3), 2003), taken as the same at other frequencies."""
    return 2.7, 2.7 * 0.008 * 2 * math.pi * gigahertz * 1e9 * _EPSILON_0


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
