"""Absorption by oxygen and water vapour: Recommendation ITU-R P.676-13, Annex 1 (line by line).

The specific attenuation γ [dB/km] of air is 0.1820·f·N″ with f in GHz; N″ is the imaginary part of the
refractivity, summed over 44 lines of oxygen and 35 of water vapour, with the dry continuum. A path of length
d loses γ·d over all of its length, whatever it meets, so that its amplitude falls by 10^(−γ·d/20).
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, quantity
from caviar_protocol.errors import ScenarioError
from caviar_protocol.space.coordinates import SPEED_OF_LIGHT

FREQUENCIES_GHZ = (1.0, 1000.0)
"""Lowest and highest frequency that Annex 1 is defined for [GHz]."""

# ρ·T/e of water vapour [g·K/(m³·hPa)] (eq. 4).
_SPECIFIC_GAS = 216.7


class Atmosphere(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Air that absorbs, the same along all paths. The defaults are those of the Recommendation's figures.

    The ranges hold what the surface of the Earth has, and more; what lies outside is most likely of
    another unit.
    """

    temperature_k: Annotated[float, quantity("K", "temperature T", ge=180, le=350)] = 288.15
    pressure_hpa: Annotated[
        float,
        quantity(
            "hPa", "pressure p of dry air; a barometer shows it and the vapour's ρT/216.7", ge=0, le=1200
        ),
    ] = 1013.25
    water_vapour_g_m3: Annotated[float, quantity("g/m³", "water vapour density ρ", ge=0, le=100)] = 7.5


def specific_attenuation(atmosphere: Atmosphere, frequency_hz: float) -> float:
    """Specific attenuation γ of air (P.676-13, eq. 1).

    Args:
        atmosphere: Temperature, pressure and humidity.
        frequency_hz: From 1 to 1000 GHz [Hz].

    Returns:
        γ [dB/km].

    Raises:
        ScenarioError: The frequency is outside of that range.

    Example:
        >>> round(specific_attenuation(Atmosphere(), 60e9), 1)  # the oxygen lines around 60 GHz
        14.8
    """
    f = frequency_hz / 1e9
    low, high = FREQUENCIES_GHZ
    if not low <= f <= high:
        raise ScenarioError(
            f"absorption of the atmosphere (ITU-R P.676) is defined for {low:g}–{high:g} GHz, a carrier is "
            f"at {f:g} GHz; choose a carrier within, or leave atmosphere out"
        )
    theta = 300 / atmosphere.temperature_k
    p = atmosphere.pressure_hpa
    e = atmosphere.water_vapour_g_m3 * atmosphere.temperature_k / _SPECIFIC_GAS
    refractivity = _oxygen(f, p, e, theta) + _continuum(f, p, e, theta) + _water_vapour(f, p, e, theta)
    return 0.1820 * f * refractivity


def amplitude_factor(db_per_km: Float64Array, tau: Float64Array) -> Float64Array:
    """Factors of amplitudes by absorption: 10^(−γ·d/20) with d = c·τ.

    Args:
        db_per_km: γ of each carrier [dB/km], Shape ``[C]``.
        tau: Delay of each path [s], Shape ``[..., P]``.

    Returns:
        Factors of Shape ``[..., C, P]``.

    Example:
        >>> km = np.array([1e3 / SPEED_OF_LIGHT])
        >>> (20 * np.log10(amplitude_factor(np.array([15.0]), km))).round(6).tolist()
        [[-15.0]]
    """
    km = SPEED_OF_LIGHT / 1000 * tau
    factor: Float64Array = 10 ** (-db_per_km[:, None] * km[..., None, :] / 20)
    return factor


def _oxygen(f: float, p: float, e: float, theta: float) -> float:
    """N″ of the oxygen lines (eqs. 2 to 7)."""
    centre, a1, a2, a3, a4, a5, a6 = _lines("oxygen")
    strength = a1 * 1e-7 * p * theta**3 * np.exp(a2 * (1 - theta))
    width = a3 * 1e-4 * (p * theta ** (0.8 - a4) + 1.1 * e * theta)
    width = np.sqrt(width**2 + 2.25e-6)  # Zeeman splitting
    interference = (a5 + a6 * theta) * 1e-4 * (p + e) * theta**0.8
    return float((strength * _shape(f, centre, width, interference)).sum())


def _water_vapour(f: float, p: float, e: float, theta: float) -> float:
    """N″ of the lines of water vapour (eqs. 2 to 7)."""
    centre, b1, b2, b3, b4, b5, b6 = _lines("water_vapour")
    strength = b1 * 1e-1 * e * theta**3.5 * np.exp(b2 * (1 - theta))
    width = b3 * 1e-4 * (p * theta**b4 + b5 * e * theta**b6)
    width = 0.535 * width + np.sqrt(0.217 * width**2 + 2.1316e-12 * centre**2 / theta)  # Doppler broadening
    return float((strength * _shape(f, centre, width, np.zeros_like(width))).sum())


def _shape(f: float, centre: Float64Array, width: Float64Array, interference: Float64Array) -> Float64Array:
    """F of each line (eq. 5)."""
    below, above = centre - f, centre + f
    shape: Float64Array = (
        f
        / centre
        * (
            (width - interference * below) / (below**2 + width**2)
            + (width - interference * above) / (above**2 + width**2)
        )
    )
    return shape


def _continuum(f: float, p: float, e: float, theta: float) -> float:
    """N″ of the dry continuum: Debye spectrum of oxygen, pressure-induced nitrogen (eqs. 8 and 9)."""
    d = 5.6e-4 * (p + e) * theta**0.8
    if d == 0:  # no air: the width of the Debye spectrum, which is divided by, is 0
        return 0.0
    debye = 6.14e-5 / (d * (1 + (f / d) ** 2))
    nitrogen = 1.4e-12 * p * theta**1.5 / (1 + 1.9e-5 * f**1.5)
    continuum: float = f * p * theta**2 * (debye + nitrogen)
    return continuum


@lru_cache
def _lines(gas: str) -> Float64Array:
    """Table of the lines of a gas: frequency f0 [GHz] and six coefficients, Shape ``[7, L]``."""
    return np.loadtxt(Path(__file__).with_name(f"{gas}_lines.csv"), delimiter=",").T
