"""Antenna arrays: where the elements are, what they radiate, and the matrix that follows."""

from __future__ import annotations

import numpy as np

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.topics import AntennaArray


def element_positions(array: AntennaArray) -> Float64Array:
    """Element positions [wavelengths] in the device's axes, Shape ``[N, 3]``.

    Order of `AntennaArray`: down a column from +z to −z, columns from −y to +y.
    """
    y, z = _grid(array)
    positions = np.zeros((array.size, 3))
    positions[:, 1] = np.repeat(y, array.rows)
    positions[:, 2] = np.tile(z, array.columns)
    return positions


def steering(array: AntennaArray, rotation: Float64Array, directions: Float64Array) -> Complex128Array:
    """Plane-wave phases exp(+j2π k̂·r/λ) of the elements, Shape ``[P, N]``.

    Parameters
    ----------
    array
        The array; its elements stand at r in wavelengths of the carrier.
    rotation
        3×3 matrix that turns the device's axes into world axes.
    directions
        Unit vectors k̂ from the device to where the wave goes or comes from, in world axes,
        Shape ``[P, 3]``. An element that stands further in that direction has the shorter path.
    """
    y, z = _grid(array)
    local = directions @ rotation
    # k̂·r separates into rows and columns: rows + columns exponentials instead of rows · columns.
    columns = np.exp(2j * np.pi * local[:, 1:2] * y)
    rows = np.exp(2j * np.pi * local[:, 2:3] * z)
    phases: Complex128Array = (columns[:, :, None] * rows[:, None, :]).reshape(len(directions), array.size)
    return phases


def channel_matrix(
    a: Complex128Array, receive: Complex128Array, transmit: Complex128Array
) -> Complex128Array:
    """H[m, n] = Σ_p a[p] · receive[p, m] · transmit[p, n], Shape ``[Nr, Nt]``."""
    h: Complex128Array = (receive * a[:, None]).T @ transmit
    return h


def _grid(array: AntennaArray) -> tuple[Float64Array, Float64Array]:
    """y of each column and z of each row [wavelengths]."""
    y: Float64Array = (
        np.arange(array.columns, dtype=np.float64) - (array.columns - 1) / 2
    ) * array.horizontal_spacing
    z: Float64Array = (
        (array.rows - 1) / 2 - np.arange(array.rows, dtype=np.float64)
    ) * array.vertical_spacing
    return y, z


def spherical_basis(directions: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Unit vectors θ̂ and φ̂ at unit vectors ``directions``; each of Shape ``[..., 3]``.

    On the z axis, where they are not unique, those of azimuth 0.
    """
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    horizontal = np.hypot(x, y)
    pole = horizontal == 0
    safe = np.where(pole, 1.0, horizontal)
    cos_azimuth, sin_azimuth = np.where(pole, 1.0, x / safe), y / safe
    theta_hat = np.stack([z * cos_azimuth, z * sin_azimuth, -horizontal], axis=-1)
    phi_hat = np.stack([-sin_azimuth, cos_azimuth, np.zeros_like(z)], axis=-1)
    return theta_hat, phi_hat


def radiated_field(array: AntennaArray, rotation: Float64Array, directions: Float64Array) -> Float64Array:
    """Far field of one element in world axes, (θ̂, φ̂) components, Shape ``[P, 2]``.

    The squared norm is the gain towards each of the unit vectors ``directions`` [P, 3].
    Polarisation follows model 2 of 3GPP TR 38.901, section 7.3.2 (eqs. 7.3-4 and 7.3-5): the field is
    along θ̂ (``V``) or φ̂ (``H``) of the device's own axes.
    """
    local = directions @ rotation
    theta_hat, phi_hat = spherical_basis(local)
    field = _amplitude(array.pattern, local)[:, None] * (theta_hat if array.polarization == "V" else phi_hat)
    field = field @ rotation.T
    world_theta, world_phi = spherical_basis(directions)
    return np.stack([(field * world_theta).sum(-1), (field * world_phi).sum(-1)], axis=-1)


def _amplitude(pattern: str, local: Float64Array) -> Float64Array:
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
