"""Options of a ray-traced channel that cannot contribute in a scene are switched off, and it is said why.

Diffraction doubles the time of a frame, whether or not it finds a path; and whoever asked for an effect
learns that there is none of it. What is switched off here changes no path: that is done only where the
ray tracer could find none, to which tests that compare both hold it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.messages import WARNING
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_services.channel.sionna.materials import Constants
from caviar_services.channel.sionna.ray_launcher import LaunchOptions

# Permittivity of vacuum [F/m] (CODATA 2018).
_EPSILON_0 = 8.8541878128e-12

DRAWN = 2.0**-26
"""A ray is sent through a surface with a probability; below this one none ever is.

The ray tracer draws from multiples of 2⁻²³ below 1, and probabilities are float32: one below 2⁻²⁵ is
lost beside that of a reflection. The factor of two is a margin.
"""

# Half of the smallest float32 above 0.
_VANISHED = 2.0**-150

# Options that are on only where the user asked for them.
_ASKED_FOR = frozenset({"refraction", "diffraction", "scattering"})

# Angles [rad] between ray and normal at which slabs are looked at.
_INCIDENCE = np.radians(np.linspace(0.0, 89.9, 900))


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


def contributing(
    options: LaunchOptions, surfaces: UsedSurfaces, frequencies_hz: Sequence[float]
) -> tuple[LaunchOptions, tuple[str, ...]]:
    """The options without those that cannot contribute, and a note for each that was switched off."""
    off: dict[str, str] = {}
    if options.max_depth == 0:
        off = dict.fromkeys(("reflection", "refraction", "diffraction", "scattering"), "max_depth is 0")
    elif not surfaces.materials:
        nothing = "there is neither scenery nor a body"
        off = dict.fromkeys(("reflection", "refraction", "diffraction", "scattering"), nothing)
    else:
        if not any(material.scattering_coefficient > 0 for material in surfaces.materials):
            off["scattering"] = "no material has a scattering_coefficient above 0"
        if options.refraction and not any(
            _transmits(material, options, frequencies_hz) for material in surfaces.materials
        ):
            told = ", ".join(_strongest(material, frequencies_hz) for material in surfaces.materials)
            off["refraction"] = f"no ray is ever sent through a material ({told} at most)"
        if not surfaces.has_edges:
            off["diffraction"] = "no two faces meet at an edge"
    off = {name: reason for name, reason in off.items() if getattr(options, name)}
    left = replace(options, **dict.fromkeys(off, False))
    # An effect that is on by default, or off by a setting, needs no note: the user did not ask for it.
    asked = frozenset() if options.max_depth == 0 else _ASKED_FOR
    notes = tuple(
        f"{WARNING * (name in asked)}{name} is switched off: {reason}" for name, reason in off.items()
    )
    if not (left.reflection or left.refraction or left.diffraction or left.scattering):
        left = replace(left, max_depth=0)
    return left, notes


def slab(
    cosine: Float64Array,
    constants: Constants | tuple[Float64Array, Float64Array],
    thickness_m: float | Float64Array,
    frequency_hz: float,
) -> tuple[Complex128Array, Complex128Array]:
    """Reflection and transmission coefficients of a slab in air for waves that come in at these angles.

    Recommendation ITU-R P.2040-3, eqs. 37, 43 and 44; both of Shape ``[2, N]``, TE and TM. Slabs
    may be one or N.
    """
    permittivity, conductivity = constants
    eta = permittivity - 1j * conductivity / (2 * np.pi * frequency_hz * _EPSILON_0)
    root = np.sqrt(eta - (1 - cosine**2))
    single = np.stack([(cosine - root) / (cosine + root), (eta * cosine - root) / (eta * cosine + root)])
    through = np.exp(-2j * np.pi * thickness_m * frequency_hz / SPEED_OF_LIGHT * root)
    many = 1 - (single * through) ** 2
    return single * (1 - through**2) / many, (1 - single**2) * through / many


def _transmits(material: SurfaceMaterial, options: LaunchOptions, frequencies_hz: Sequence[float]) -> bool:
    """Whether a ray can be sent through on any carrier at any incidence."""
    rough = material.scattering_coefficient**2
    returned = options.reflection * (1 - rough) + options.scattering * rough
    for constants, frequency in zip(material.constants, frequencies_hz, strict=True):
        back, through = (
            (np.abs(part) ** 2).sum(0)
            for part in slab(np.cos(_INCIDENCE), constants, material.thickness_m, frequency)
        )
        # Where nothing returns, what passes is not lost beside it: it has to vanish itself.
        smallest = np.where(returned * back > 0, DRAWN * returned * back, _VANISHED)
        if (through >= smallest).any():
            return True
    return False


def _strongest(material: SurfaceMaterial, frequencies_hz: Sequence[float]) -> str:
    """``concrete −93 dB``, of the carrier and incidence at which most passes."""
    most = max(
        float(np.abs(slab(np.cos(_INCIDENCE), constants, material.thickness_m, frequency)[1]).max())
        for constants, frequency in zip(material.constants, frequencies_hz, strict=True)
    )
    level = "−∞" if most < 1e-30 else f"−{-20 * np.log10(most):.0f}"
    return f"{material.name} {level} dB"
