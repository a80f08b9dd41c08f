"""Answers from textbooks. Nothing here comes from the models: a wrong sign there cannot be the same here.

Rotations, Fresnel's coefficients and images are written out once more; no module of the services is imported.
"""

from __future__ import annotations

import cmath
import math

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array

Field = Float64Array | Complex128Array

C = 299_792_458.0
"""Speed of light [m/s]."""
EPSILON_0 = 8.8541878128e-12
"""Permittivity of vacuum [F/m]."""


def friis(distance: float, frequency: float) -> float:
    """Amplitude λ/(4πd) between isotropic antennas (Friis, 1946), for a distance [m] and a frequency [Hz].

    Example:
        >>> round(-20 * math.log10(friis(100.0, 28e9)), 2)  # path loss [dB]
        101.39
    """
    return C / frequency / (4 * math.pi * distance)


def phase(length: float, frequency: float) -> complex:
    """exp(−j2πfd/c) for a length [m] and a frequency [Hz]."""
    # Of the fraction of a wavelength that is left over: of millions of turns, rounding would take the digits.
    return cmath.exp(-2j * math.pi * ((length * frequency / C) % 1.0))


def spherical_wave(length: float, frequency: float) -> complex:
    """λ/(4πd) · exp(−j2πd/λ): amplitude and phase between isotropic antennas."""
    return friis(length, frequency) * phase(length, frequency)


def doppler(closing_speed: float, frequency: float) -> float:
    """Shift f·v/c [Hz] of a path that shortens by v [m/s], to first order in v/c.

    Example:
        >>> round(doppler(30.0, 28e9))
        2802
    """
    return frequency * closing_speed / C


def vegetation(length: float, gamma: float, most: float = math.inf) -> float:
    """Attenuation [dB] of a path of some length [m] in vegetation of γ [dB/m], at most ``most`` (ITU-R
    P.833-10, eq. 1)."""
    return gamma * length if math.isinf(most) else most * (1 - math.exp(-gamma * length / most))


def permittivity(relative: float, conductivity: float, frequency: float) -> complex:
    """Complex relative permittivity ε_r − jσ/(2πfε₀), with the conductivity σ [S/m] and the frequency f
    [Hz]."""
    return complex(relative, -conductivity / (2 * math.pi * frequency * EPSILON_0))


def itu_permittivity(a: float, b: float, c: float, d: float, frequency: float) -> complex:
    """Complex relative permittivity from the constants of ITU-R P.2040-3, table 3: ε_r = a·f^b and σ = c·f^d
    [S/m] with f in GHz."""
    ghz = frequency / 1e9
    return permittivity(a * ghz**b, c * ghz**d, frequency)


def fresnel(cosine: float, eta: complex) -> tuple[complex, complex]:
    """Reflection coefficients of a half-space, from the cosine of the angle with the normal.

    For the field across the plane of incidence and within it (ITU-R P.2040-3, eqs. 31a and 31b: the second is
    +1 at a perfect conductor).

    Example:
        >>> [round(r.real, 3) for r in fresnel(1.0, 4.0)]
        [-0.333, 0.333]
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
    """Lengths of the direct and the reflected path over flat ground [m], and the cosine of incidence.

    Example:
        >>> over_ground(3.0, 3.0, 8.0)
        (8.0, 10.0, 0.6)
    """
    direct = math.hypot(distance, height_tx - height_rx)
    bounced = math.hypot(distance, height_tx + height_rx)
    return direct, bounced, (height_tx + height_rx) / bounced


def two_rays(heights: tuple[float, float], distance: float, eta: complex, frequency: float) -> complex:
    """H of vertical antennas over flat ground of a permittivity (`permittivity`): direct and reflected ray.

    Heights are those of both antennas, the distance is that along the ground [m].
    """
    direct, bounced, cosine = over_ground(*heights, distance)
    along = fresnel(cosine, eta)[1]
    return spherical_wave(direct, frequency) + along * spherical_wave(bounced, frequency)


def mirrored(point: Float64Array, origin: Float64Array, normal: Float64Array) -> Float64Array:
    """Image of a point in a plane with a unit normal."""
    image: Float64Array = point - 2 * np.dot(point - origin, normal) * normal
    return image


def reflected(field: Field, k_in: Float64Array, normal: Float64Array, eta: complex) -> Complex128Array:
    """Field of a wave along a unit vector after its reflection at a half-space, Shape ``[3]``."""
    k_out = k_in - 2 * np.dot(k_in, normal) * normal
    across, along = fresnel(abs(float(np.dot(k_in, normal))), eta)
    s = unit(np.cross(k_in, normal))
    p_in, p_out = np.cross(k_in, s), np.cross(k_out, s)
    sent: Complex128Array = across * np.dot(field, s) * s + along * np.dot(field, p_in) * p_out
    return sent


def vertical(k: Float64Array) -> Float64Array:
    """Field of an upright vertical isotropic element towards a unit vector: θ̂."""
    theta, phi = np.arccos(k[2]), np.arctan2(k[1], k[0])
    return np.array([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)])


def horizontal(k: Float64Array) -> Float64Array:
    """Field of an upright horizontal isotropic element towards a unit vector: φ̂."""
    phi = np.arctan2(k[1], k[0])
    return np.array([-np.sin(phi), np.cos(phi), 0.0])


def unit(vector: Float64Array) -> Float64Array:
    """A vector over its length."""
    along: Float64Array = vector / np.linalg.norm(vector)
    return along


def turn(yaw: float, pitch: float, roll: float) -> Float64Array:
    """Rz(yaw) · Ry(pitch) · Rx(roll) [rad], written out, Shape ``[3, 3]``."""
    (cz, sz), (cy, sy), (cx, sx) = ((math.cos(angle), math.sin(angle)) for angle in (yaw, pitch, roll))
    rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    turned: Float64Array = rz @ ry @ rx
    return turned


def room_images(
    size: tuple[float, float, float], source: Float64Array, target: Float64Array, order: int
) -> list[tuple[int, float]]:
    """Order and length [m] of every path of at most ``order`` reflections in a box from the origin on.

    Image (i, j, k) has |i| + |j| + |k| reflections and stands at 2⌈i/2⌉·L + (−1)^i·x on each axis (Allen and
    Berkley, 1979); there are 4n² + 2 of order n.

    Example:
        >>> len(room_images((4.0, 5.0, 3.0), np.array([1.0, 1.0, 1.0]), np.array([2.0, 3.0, 1.5]), order=2))
        25
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
