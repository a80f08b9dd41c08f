"""What one antenna element radiates, as a field vector in world axes."""

from __future__ import annotations

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.topics import AntennaArray


def spherical_basis(directions: Float64Array, pole: float = 0.0) -> tuple[Float64Array, Float64Array]:
    """Unit vectors θ̂ and φ̂ at unit vectors ``directions``; each of Shape ``[..., 3]``.

    Where the horizontal part is not longer than ``pole``, they are those of azimuth 0.
    """
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    horizontal = np.hypot(x, y)
    at_pole = horizontal <= pole
    safe = np.where(at_pole, 1.0, horizontal)
    cosine, sine = np.where(at_pole, 1.0, x / safe), np.where(at_pole, 0.0, y / safe)
    theta_hat, phi_hat = np.empty_like(directions), np.zeros_like(directions)
    theta_hat[..., 0], theta_hat[..., 1], theta_hat[..., 2] = z * cosine, z * sine, -horizontal
    phi_hat[..., 0], phi_hat[..., 1] = -sine, cosine
    return theta_hat, phi_hat


def radiated_field(array: AntennaArray, rotation: Float64Array, directions: Float64Array) -> Float64Array:
    """Far field of one element, in world axes, Shape ``[P, 3]``; its squared norm is the gain.

    Parameters
    ----------
    array
        Pattern and polarisation.
    rotation
        3×3 matrix that turns the device's axes into world axes.
    directions
        Unit vectors from the device outwards, in world axes, Shape ``[P, 3]``.

    Notes
    -----
    Polarisation is model 2 of 3GPP TR 38.901, section 7.3.2: the field is along θ̂ (``V``) or φ̂ (``H``) of
    the device's own axes.
    """
    local = directions @ rotation
    theta_hat, phi_hat = spherical_basis(local)
    field = element_amplitude(array.pattern, local)[:, None] * (
        theta_hat if array.polarization == "V" else phi_hat
    )
    world: Float64Array = field @ rotation.T
    return world


def element_amplitude(pattern: str, local: Float64Array) -> Float64Array:
    """Root of the gain of an element pattern towards unit vectors in device axes, Shape ``[P]``.

    ``iso``: 1. ``dipole``: short dipole along z (Balanis, Antenna Theory, eq. 4-26a, gain 1.5).
    ``hw_dipole``: half-wave dipole along z (eq. 4-84, gain 1.643). ``tr38901``: 3GPP TR 38.901,
    table 7.3-1 (gain 8 dBi, 65° beams, 30 dB floor).
    """
    sin_theta = np.hypot(local[:, 0], local[:, 1])
    if pattern == "iso":
        return np.ones(len(local))
    if pattern == "dipole":
        short: Float64Array = np.sqrt(1.5) * sin_theta
        return short
    if pattern == "hw_dipole":
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
