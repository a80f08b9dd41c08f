"""Reflection and transmission at surfaces: Fresnel's coefficients of slabs (ITU-R P.2040-3), in float64."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT
from caviar_space.vectors import cross, unit

# Permittivity of vacuum [F/m] (CODATA 2018).
EPSILON_0 = 8.8541878128e-12

# Sine of the angle between two directions below which they are one.
_ALONG = 1e-9


def slab(
    cosine: Float64Array,
    constants: tuple[float, float] | tuple[Float64Array, Float64Array],
    thickness_m: float | Float64Array,
    frequency_hz: float,
) -> tuple[Complex128Array, Complex128Array]:
    """Reflection and transmission coefficients of slabs in air (ITU-R P.2040-3, eqs. 37, 43 and 44).

    Args:
        cosine: Of the angles between rays and the normal, Shape ``[N]``.
        constants: Relative permittivity and conductivity [S/m], of one slab or of each ray's.
        thickness_m: Likewise [m].
        frequency_hz: Of the wave [Hz].

    Returns:
        Reflection and transmission of fields, TE and TM: Shape ``[2, N]`` each.

    Example:
        >>> back, through = slab(np.array([1.0]), (4.0, 0.0), 0.01, 7.5e9)  # a half of a wavelength in it
        >>> bool(np.allclose(back, 0.0, atol=2e-3)), bool(np.allclose(abs(through), 1.0, atol=1e-3))
        (True, True)
    """
    permittivity, conductivity = constants
    eta = permittivity - 1j * conductivity / (2 * np.pi * frequency_hz * EPSILON_0)
    root = np.sqrt(eta - (1 - cosine**2))
    # Coefficients of one face (eq. 37), then all bounces between both faces (eqs. 43 and 44).
    single = np.stack([(cosine - root) / (cosine + root), (eta * cosine - root) / (eta * cosine + root)])
    through = np.exp(-2j * np.pi * thickness_m * frequency_hz / SPEED_OF_LIGHT * root)
    many = 1 - (single * through) ** 2
    return single * (1 - through**2) / many, (1 - single**2) * through / many


@dataclass(frozen=True, eq=False)
class Media:
    """Materials of the surfaces at the interactions of P paths, on C carriers."""

    permittivity: Float64Array
    """Relative, Shape ``[C, P, D]``."""
    conductivity: Float64Array
    """[S/m], Shape ``[C, P, D]``."""
    thickness: Float64Array
    """[m], Shape ``[P, D]``."""
    scattering: Float64Array
    """Scattering coefficients, Shape ``[P, D]``."""


@dataclass(frozen=True, eq=False)
class Wall:
    """Slabs that P rays meet, at one wavelength [m]."""

    permittivity: Float64Array
    conductivity: Float64Array
    thickness: Float64Array
    scattering: Float64Array
    wavelength: float

    @classmethod
    def of(cls, media: Media, carrier: int, d: int, wavelength: float) -> Wall:
        """Slabs at interaction ``d`` of paths on a carrier, by its index and wavelength [m]."""
        constants = media.permittivity[carrier, :, d], media.conductivity[carrier, :, d]
        return cls(*constants, media.thickness[:, d], media.scattering[:, d], wavelength)

    def where(self, which: BoolArray, other: Wall) -> Wall:
        """These slabs where ``which`` is true, and those of another elsewhere."""
        return Wall(
            np.where(which, self.permittivity, other.permittivity),
            np.where(which, self.conductivity, other.conductivity),
            np.where(which, self.thickness, other.thickness),
            np.where(which, self.scattering, other.scattering),
            self.wavelength,
        )

    def take(self, rows: Int64Array) -> Wall:
        """Slabs of these rays."""
        return Wall(
            self.permittivity[rows],
            self.conductivity[rows],
            self.thickness[rows],
            self.scattering[rows],
            self.wavelength,
        )

    def dyad(self, k: Float64Array, normal: Float64Array, through: BoolArray) -> Complex128Array:
        """Dyads from the incoming field to the reflected one, or to that which goes through.

        Args:
            k: Unit vectors along incoming waves, Shape ``[P, 3]``.
            normal: Unit normals, Shape ``[P, 3]``.
            through: Waves that go through, Shape ``[P]``; the others are reflected, weaker by what scatters.

        Returns:
            Dyads of Shape ``[P, 3, 3]``.
        """
        across = (k * normal).sum(-1)
        frequency = SPEED_OF_LIGHT / self.wavelength
        back, passed = slab(np.abs(across), (self.permittivity, self.conductivity), self.thickness, frequency)
        # What a surface scatters is missing from the reflected field alone.
        te, tm = np.where(through, passed, back * np.sqrt(1 - self.scattering**2))
        s = unit(_perpendicular(k, normal))
        out = np.where(through[:, None], k, k - 2 * across[:, None] * normal)
        return _outer(te[:, None] * s, s) + _outer(tm[:, None] * cross(out, s), cross(k, s))


def reflection_fields(
    corners: Float64Array,
    count: Int64Array,
    normals: Float64Array,
    through: BoolArray,
    media: Media,
    wavelengths: Sequence[float],
) -> Complex128Array:
    """Fields of reflected and transmitted paths.

    Args:
        corners: TX, points of interactions, and RX in all places past the last one [m], ``[P, D + 2, 3]``.
        count: Interactions of each path, Shape ``[P]``.
        normals: Unit normal of the plane at each point, Shape ``[P, D, 3]``.
        through: Which of them let the wave through, Shape ``[P, D]``; the others reflect it.
        media: Materials at each point.
        wavelengths: Of the carriers [m].

    Returns:
        Dyads of `PathTable` with the spreading λ/(4πd) of the paths' lengths, Shape ``[C, P, 3, 3]``.

    Example:
        >>> nothing = np.zeros((1, 1, 0))
        >>> free = Media(nothing, nothing, nothing[0], nothing[0])
        >>> corners, none = np.array([[[0.0, 0, 0], [10.0, 0, 0]]]), np.zeros((1, 0))
        >>> fields = reflection_fields(corners, np.array([0]), np.zeros((1, 0, 3)), none > 0, free, [0.01])
        >>> [round(1e6 * abs(x)) for x in np.diag(fields[0, 0])]  # λ/(4πd), across the path alone
        [0, 80, 80]
    """
    steps = np.diff(corners, axis=1)
    lengths = np.sqrt(np.einsum("pdc,pdc->pd", steps, steps))
    directions = steps / np.where(lengths > 0, lengths, 1.0)[..., None]
    total = lengths.sum(1)
    first = directions[:, 0]
    # A field has no component along its direction.
    transverse = np.eye(3) - first[:, :, None] * first[:, None]
    fields = np.empty((len(wavelengths), len(count), 3, 3), np.complex128)
    for carrier, wavelength in enumerate(wavelengths):
        field = transverse + 0j
        for d in range(normals.shape[1]):
            rows = np.flatnonzero(count > d)
            wall = Wall(
                media.permittivity[carrier, rows, d],
                media.conductivity[carrier, rows, d],
                media.thickness[rows, d],
                media.scattering[rows, d],
                wavelength,
            )
            dyad = wall.dyad(directions[rows, d], normals[rows, d], through[rows, d])
            field[rows] = dyad @ field[rows]
        fields[carrier] = field * (wavelength / (4 * np.pi) / total)[:, None, None]
    return fields


def _perpendicular(k: Float64Array, normal: Float64Array) -> Float64Array:
    """Directions across both vectors; any direction across ``k`` where both are parallel."""
    across = cross(k, normal)
    axis = np.eye(3)[np.argmin(np.abs(k), axis=-1)]
    lost = (across**2).sum(-1, keepdims=True) < _ALONG**2
    perpendicular: Float64Array = np.where(lost, cross(k, axis), across)
    return perpendicular


def _outer(one: Complex128Array | Float64Array, other: Float64Array) -> Complex128Array:
    outer: Complex128Array = one.astype(np.complex128)[:, :, None] * other[:, None]
    return outer
