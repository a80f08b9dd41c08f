"""Antenna patterns: the far field of one element, as a vector in world axes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.errors import AssetError, suggestion
from caviar_protocol.space.beams import jones
from caviar_protocol.topics import AntennaArray
from caviar_services.pattern_files import PatternTable

Field = Float64Array | Complex128Array
"""Complex where an element is circularly polarized, or its file says so."""


# [dBi]; mean gain over the sphere up to which no note is made: files round their values.
_TOLERANCE_DBI = 2.0

# Horizontal part of a unit vector below which it is rounding: 20 pm at 20 m.
_POLE = 1e-12


def spherical_basis(directions: Float64Array, pole: float = 0.0) -> tuple[Float64Array, Float64Array]:
    """Unit vectors θ̂ and φ̂ of spherical coordinates.

    Args:
        directions: Unit vectors, Shape ``[..., 3]``.
        pole: Length of the horizontal part up to which the azimuth counts as 0.

    Returns:
        θ̂ and φ̂, Shape ``[..., 3]`` each.

    Example:
        >>> theta_hat, phi_hat = spherical_basis(np.array([1.0, 0.0, 0.0]))
        >>> theta_hat.tolist(), phi_hat.tolist()
        ([0.0, 0.0, -1.0], [-0.0, 1.0, 0.0])
    """
    horizontal, cosine, sine = _azimuth(directions, pole)
    phi_hat = np.zeros_like(directions)
    phi_hat[..., 0], phi_hat[..., 1] = -sine, cosine
    return _theta_hat(directions, horizontal, cosine, sine), phi_hat


def _azimuth(directions: Float64Array, pole: float = 0.0) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Length of the horizontal part, cosine and sine of the azimuth, Shape ``[...]`` each."""
    x, y = directions[..., 0], directions[..., 1]
    horizontal: Float64Array = np.hypot(x, y)
    at_pole = horizontal <= pole
    # Few directions are at a pole: a look at all of them costs a third of the choices below.
    if not np.count_nonzero(at_pole):
        return horizontal, x / horizontal, y / horizontal
    safe = np.where(at_pole, 1.0, horizontal)
    return horizontal, np.where(at_pole, 1.0, x / safe), np.where(at_pole, 0.0, y / safe)


def _theta_hat(
    directions: Float64Array, horizontal: Float64Array, cosine: Float64Array, sine: Float64Array
) -> Float64Array:
    z, theta_hat = directions[..., 2], np.empty_like(directions)
    theta_hat[..., 0], theta_hat[..., 1], theta_hat[..., 2] = z * cosine, z * sine, -horizontal
    return theta_hat


class ElementPattern(ABC):
    """Far field of a vertically polarized element, before `polarized_field` turns it.

    A subclass implements `along_theta_phi`.
    """

    @abstractmethod
    def along_theta_phi(self, local: Float64Array) -> tuple[Field, Field | None]:
        """Components of the field, so that ``|E_θ|² + |E_φ|²`` is the gain as a factor.

        Args:
            local: Unit vectors in device axes, Shape ``[P, 3]``.

        Returns:
            E_θ and E_φ, Shape ``[P]`` each; E_φ may be None for 0 everywhere.
        """

    def amplitude(self, local: Float64Array) -> Float64Array:
        """Root of the gain of both polarizations together towards unit vectors in device axes, Shape
        ``[P]``."""
        along_theta, along_phi = self.along_theta_phi(local)
        amplitude: Float64Array = np.abs(along_theta)
        return amplitude if along_phi is None else np.hypot(amplitude, np.abs(along_phi))


@dataclass(frozen=True)
class FormulaPattern(ElementPattern):
    """A pattern by its name in `AntennaArray`; see `element_amplitude`.

    Example:
        >>> FormulaPattern("iso").amplitude(np.array([[1.0, 0.0, 0.0]])).tolist()
        [1.0]
    """

    name: str

    def along_theta_phi(self, local: Float64Array) -> tuple[Field, Field | None]:
        return element_amplitude(self.name, local), None


@dataclass(frozen=True, eq=False)
class TabulatedPattern(ElementPattern):
    """A pattern from a file, interpolated."""

    table: PatternTable

    def along_theta_phi(self, local: Float64Array) -> tuple[Field, Field | None]:
        zenith = np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])
        values = self.table.at(zenith, np.arctan2(local[:, 1], local[:, 0]))
        if self.table.is_field:
            return values[:, 0], values[:, 1]
        amplitude: Float64Array = 10 ** (values.real / 20)
        return amplitude, None


class Patterns:
    """Patterns of the elements of arrays: by formula, or from files.

    Args:
        tables: Patterns of files, by name of the asset.
    """

    def __init__(self, tables: Mapping[str, PatternTable] | None = None) -> None:
        self._tabulated = {name: TabulatedPattern(table) for name, table in (tables or {}).items()}

    def notes(self) -> tuple[str, ...]:
        """Notes on patterns whose mean gain over the sphere is above 0 dBi: they radiate more than they are
        fed."""
        means = {name: pattern.table.mean_gain_dbi for name, pattern in self._tabulated.items()}
        return tuple(
            f"pattern {name!r} has a mean gain of {mean:.1f} dBi over the sphere; an antenna has 0 dBi less "
            "its losses: check its gain, and the signs of its values"
            for name, mean in means.items()
            if mean > _TOLERANCE_DBI
        )

    def element(self, array: AntennaArray) -> ElementPattern:
        """The pattern of an array's elements.

        Raises:
            AssetError: The pattern is from a file that is not among the assets of the run.

        Example:
            >>> dipole = Patterns().element(AntennaArray(pattern="dipole"))
            >>> dipole.amplitude(np.array([[1.0, 0.0, 0.0]])).round(3)
            array([1.225])
        """
        if not array.pattern_file:
            return _formula(array.pattern)
        try:
            return self._tabulated[array.pattern_file]
        except KeyError:
            raise AssetError(
                f"there is no pattern {array.pattern_file!r} among the assets of the run; "
                + suggestion(array.pattern_file, self._tabulated)
            ) from None


@lru_cache(maxsize=16)
def _formula(name: str) -> FormulaPattern:
    return FormulaPattern(name)


def radiated_field(
    array: AntennaArray,
    rotation: Float64Array,
    directions: Float64Array,
    pattern: ElementPattern | None = None,
    *,
    arrival: bool = False,
) -> Field:
    """Far field of one element, in world axes, Shape ``[P, 3]``; its squared norm is the gain.

    Args:
        array: Pattern and polarization; of a dual one the first.
        rotation: 3×3 matrix that turns the device's axes into world axes.
        directions: Unit vectors from the device outwards, in world axes, Shape ``[P, 3]``.
        pattern: Of the element; None: the one that the array names.
        arrival: Whether the device receives, which decides the azimuth at a pole (`off_pole`).

    Example:
        >>> field = radiated_field(AntennaArray(pattern="dipole"), np.eye(3), np.array([[1.0, 0.0, 0.0]]))
        >>> field.round(3).tolist()  # along θ̂, which points down there
        [[0.0, 0.0, -1.225]]
    """
    local = off_pole(directions @ rotation, directions, rotation, arrival)
    field = polarized_field(pattern or _formula(array.pattern), array.polarizations[0], local)
    world: Field = field @ rotation.T
    return world


def off_pole(
    local: Float64Array, directions: Float64Array, rotation: Float64Array, arrival: bool
) -> Float64Array:
    """Directions in device axes, those at a pole moved off it to the azimuth that both ends of a path mean.

    At a pole of its axes the field of a vertical element has no azimuth, and the sign of a path depends on
    the choice. It is the limit of a receiver that comes from +x of the world (from +y along paths that are
    nearly parallel to x): the transmitter sees it on that side, and it sees the transmitter on the other.

    Args:
        local: Unit vectors in device axes, Shape ``[P, 3]``.
        directions: The same in world axes, Shape ``[P, 3]``.
        rotation: 3×3 matrix that turns the device's axes into world axes, or one each, Shape ``[P, 3, 3]``.
        arrival: Whether the device receives.

    Returns:
        Shape ``[P, 3]``.

    Example:
        >>> up = np.array([[0.0, 0.0, 1.0]])
        >>> [off_pole(up, up, np.eye(3), arrival).tolist() for arrival in (False, True)]
        [[[1e-12, 0.0, 1.0]], [[-1e-12, -0.0, 1.0]]]
    """
    at_pole = np.hypot(local[:, 0], local[:, 1]) <= _POLE
    if not np.count_nonzero(at_pole):
        return local
    side = np.where(np.abs(directions[at_pole, :1]) < 0.8, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    turned = rotation[at_pole] if rotation.ndim == 3 else rotation
    across = (side[:, None] @ turned)[:, 0, :2] * (-1.0 if arrival else 1.0)
    moved = local.copy()
    moved[at_pole, :2] = _POLE * across / np.hypot(across[:, :1], across[:, 1:])
    return moved


def polarized_field(pattern: ElementPattern, polarization: str, local: Float64Array) -> Field:
    """Far field of one element in its own axes.

    Linear polarizations are model 2 of 3GPP TR 38.901, section 7.3.2: the field of the vertical element is
    turned about the direction by the slant. Of a circular one the horizontal part follows, or leads, by 90°.

    Args:
        pattern: Of the element.
        polarization: As `AntennaArray` has it, a single one.
        local: Unit vectors in device axes, Shape ``[P, 3]``.

    Returns:
        Fields in device axes, Shape ``[P, 3]``.

    Example:
        >>> ahead = np.array([[1.0, 0.0, 0.0]])
        >>> polarized_field(FormulaPattern("iso"), "V", ahead).tolist()
        [[0.0, 0.0, -1.0]]
    """
    cosine, sine = jones(polarization)
    along_theta, along_phi = pattern.along_theta_phi(local)
    # Most elements are vertical, with a field along θ̂ alone.
    if sine == 0 and along_phi is None:
        vertical: Field = along_theta[:, None] * _theta_hat(local, *_azimuth(local))
        return vertical
    theta_hat, phi_hat = spherical_basis(local)
    co = theta_hat if sine == 0 else phi_hat if cosine == 0 else cosine * theta_hat + sine * phi_hat
    field: Field = along_theta[:, None] * co
    if along_phi is not None:
        field = field + along_phi[:, None] * (cosine * phi_hat - sine * theta_hat)
    return field


def element_amplitude(pattern: str, local: Float64Array) -> Float64Array:
    """Root of the gain of an element pattern by formula.

    Args:
        pattern: ``iso``: 1. ``dipole``: short dipole along z (Balanis, Antenna Theory, eq. 4-26a, gain 1.5).
            ``hw_dipole``: half-wave dipole along z (eq. 4-84, gain 1.643). ``tr38901``: 3GPP TR 38.901, table
            7.3-1 (gain 8 dBi, 65° beams, 30 dB floor).
        local: Unit vectors in device axes, Shape ``[P, 3]``; x is the boresight.

    Returns:
        Amplitudes, Shape ``[P]``.

    Example:
        >>> boresight = np.array([[1.0, 0.0, 0.0]])
        >>> 20 * np.log10(element_amplitude("tr38901", boresight))
        array([8.])
    """
    # Of the components, not by arccos: near the poles that loses half of the digits.
    sin_theta = np.hypot(local[:, 0], local[:, 1])
    if pattern == "iso":
        return np.ones(len(local))
    if pattern == "dipole":
        short: Float64Array = np.sqrt(1.5) * sin_theta
        return short
    if pattern == "hw_dipole":
        # On the axis cos(π/2·cos θ)/sin θ is 0/0; its limit is 0.
        on_axis = sin_theta < 1e-9
        along = np.abs(np.cos(np.pi / 2 * local[:, 2])) / np.where(on_axis, 1.0, sin_theta)
        half_wave: Float64Array = np.sqrt(1.643) * np.where(on_axis, 0.0, along)
        return half_wave
    zenith = np.arctan2(sin_theta, local[:, 2])
    azimuth = np.arctan2(local[:, 1], local[:, 0])
    width = np.radians(65.0)
    vertical = np.minimum(12 * ((zenith - np.pi / 2) / width) ** 2, 30.0)
    horizontal = np.minimum(12 * (azimuth / width) ** 2, 30.0)
    gain_db = 8.0 - np.minimum(vertical + horizontal, 30.0)
    amplitude: Float64Array = 10 ** (gain_db / 20)
    return amplitude
