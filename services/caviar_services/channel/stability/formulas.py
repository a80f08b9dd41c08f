"""Answers from textbooks. Nothing here comes from the models: a wrong sign there cannot be the same here."""

from __future__ import annotations

import cmath
import math

import numpy as np

from caviar_protocol.arrays import Float64Array

C = 299_792_458.0
"""Speed of light [m/s]."""
EPSILON_0 = 8.8541878128e-12
"""Permittivity of vacuum [F/m]."""


def friis(distance: float, frequency: float) -> float:
    """Amplitude λ/(4πd) between isotropic antennas (Friis, 1946)."""
    return C / frequency / (4 * math.pi * distance)


def phase(length: float, frequency: float) -> complex:
    """exp(−j2πfd/c), of the fraction of a wavelength that is left over."""
    return cmath.exp(-2j * math.pi * ((length * frequency / C) % 1.0))


def doppler(closing_speed: float, frequency: float) -> float:
    """Shift f·v/c [Hz] of a path that shortens by v [m/s], to first order."""
    return frequency * closing_speed / C


def vegetation(length: float, gamma: float, most: float = math.inf) -> float:
    """Attenuation [dB] of a path of some length [m] in vegetation of γ [dB/m], at most ``most`` (ITU-R
    P.833-10, eq. 1)."""
    return gamma * length if math.isinf(most) else most * (1 - math.exp(-gamma * length / most))


def permittivity(relative: float, conductivity: float, frequency: float) -> complex:
    """Complex relative permittivity ε_r − jσ/(2πfε₀)."""
    return complex(relative, -conductivity / (2 * math.pi * frequency * EPSILON_0))


def fresnel(cosine: float, eta: complex) -> tuple[complex, complex]:
    """Reflection coefficients of a half-space, from the cosine of the angle with the normal.

    For the field across the plane of incidence and within it (ITU-R P.2040-3, eqs. 31a and 31b: the second is
    +1 at a perfect conductor).
    """
    root = cmath.sqrt(eta - (1 - cosine**2))
    return (cosine - root) / (cosine + root), (eta * cosine - root) / (eta * cosine + root)


def slab(cosine: float, eta: complex, thickness: float, frequency: float) -> tuple[complex, complex]:
    """Reflection coefficients of a layer in air, as `fresnel` (ITU-R P.2040-3, eq. 43a)."""
    root = cmath.sqrt(eta - (1 - cosine**2))
    turn = cmath.exp(-2j * 2 * math.pi * frequency * thickness / C * root)
    across, along = fresnel(cosine, eta)
    return across * (1 - turn) / (1 - across**2 * turn), along * (1 - turn) / (1 - along**2 * turn)


def over_ground(height_tx: float, height_rx: float, distance: float) -> tuple[float, float, float]:
    """Lengths of the direct and the reflected path over flat ground [m], and the cosine of incidence."""
    direct = math.hypot(distance, height_tx - height_rx)
    bounced = math.hypot(distance, height_tx + height_rx)
    return direct, bounced, (height_tx + height_rx) / bounced


def mirrored(point: Float64Array, origin: Float64Array, normal: Float64Array) -> Float64Array:
    """Image of a point in a plane with a unit normal."""
    image: Float64Array = point - 2 * np.dot(point - origin, normal) * normal
    return image


def room_images(
    size: tuple[float, float, float], source: Float64Array, target: Float64Array, order: int
) -> list[tuple[int, float]]:
    """Order and length [m] of every path of at most ``order`` reflections in a box from the origin on.

    Image (i, j, k) has |i| + |j| + |k| reflections and stands at 2⌈i/2⌉·L + (−1)^i·x on each axis (Allen and
    Berkley, 1979); there are 4n² + 2 of order n.
    """
    found = []
    span = range(-order, order + 1)
    for i in span:
        for j in span:
            for k in span:
                count = abs(i) + abs(j) + abs(k)
                if count <= order:
                    image = [
                        2 * math.ceil(n / 2) * length + (-1) ** n * x
                        for n, length, x in zip((i, j, k), size, source.tolist(), strict=True)
                    ]
                    found.append((count, math.dist(image, target.tolist())))
    return found


def behind_half_plane(at: float, angle: float, s_in: float, s_out: float, frequency: float) -> float:
    """|H| deep in the shadow of a conducting half-plane, the field along its edge.

    A. Sommerfeld (1896), asymptotically: angles [rad] from the lit face, distances from the edge [m].
    """
    k = 2 * math.pi * frequency / C
    secants = 1 / math.cos((angle - at) / 2) - 1 / math.cos((angle + at) / 2)
    coefficient = abs(secants) / (2 * math.sqrt(2 * math.pi * k))
    return 1 / (2 * k) * coefficient / math.sqrt(s_in * s_out * (s_in + s_out))
