"""Element patterns as field vectors: gain, direction of the field, turning with the device."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_protocol.space.coordinates import direction, quaternion_from_euler, rotation_matrix
from caviar_protocol.topics import AntennaArray
from caviar_services.channel.propagation.patterns import radiated_field, spherical_basis

UPRIGHT = np.eye(3)
PATTERNS = ("iso", "dipole", "hw_dipole", "tr38901")


def directions(count: int = 400, seed: int = 0) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("polarization", ["V", "H"])
def test_the_field_is_transverse(pattern: str, polarization: str) -> None:
    rotation = rotation_matrix(quaternion_from_euler(0.7, -0.4, 1.1))
    k = directions()
    field = radiated_field(AntennaArray(pattern=pattern, polarization=polarization), rotation, k)
    assert np.abs((field * k).sum(1)).max() < 1e-12


@pytest.mark.parametrize(("pattern", "gain"), [("iso", 1.0), ("dipole", 1.5), ("hw_dipole", 1.643)])
def test_gain_towards_the_horizon(pattern: str, gain: float) -> None:
    field = radiated_field(AntennaArray(pattern=pattern), UPRIGHT, direction(np.pi / 2, 2.1)[None])
    assert (field**2).sum() == pytest.approx(gain, rel=1e-12)


@pytest.mark.parametrize(("pattern", "share"), [("iso", 1.0), ("dipole", 1.0), ("hw_dipole", 1.643 / 1.6409)])
def test_lossless_patterns_radiate_what_they_are_fed(pattern: str, share: float) -> None:
    """The mean gain over the sphere is 1 (the half-wave dipole has 1.6409, rounded up by Balanis)."""
    z = (np.arange(4000) + 0.5) / 2000 - 1
    k = np.stack([np.sqrt(1 - z**2), np.zeros_like(z), z], axis=1)
    gain = (radiated_field(AntennaArray(pattern=pattern), UPRIGHT, k) ** 2).sum(1)
    assert gain.mean() == pytest.approx(share, abs=5e-4)


@pytest.mark.parametrize(
    ("zenith_deg", "azimuth_deg", "gain_db"),
    [
        (90, 0, 8.0),
        (90, 32.5, 5.0),
        (122.5, 0, 5.0),
        (57.5, -32.5, 2.0),
        (90, 180, -22.0),
        (0, 0, 8 - 12 * (90 / 65) ** 2),
    ],
)
def test_sector_antenna_of_3gpp(zenith_deg: float, azimuth_deg: float, gain_db: float) -> None:
    """3 dB down at half the 65° width in each plane, floor 30 dB below the 8 dBi maximum."""
    k = direction(np.radians(zenith_deg), np.radians(azimuth_deg))[None]
    field = radiated_field(AntennaArray(pattern="tr38901"), UPRIGHT, k)
    assert 10 * np.log10((field**2).sum()) == pytest.approx(gain_db, abs=1e-9)


def test_vertical_field_points_down_towards_the_horizon() -> None:
    """θ̂ at the horizon is −z; φ̂ at azimuth 0 is +y."""
    k = np.array([[1.0, 0.0, 0.0]])
    assert radiated_field(AntennaArray(), UPRIGHT, k)[0] == pytest.approx([0, 0, -1])
    assert radiated_field(AntennaArray(polarization="H"), UPRIGHT, k)[0] == pytest.approx([0, 1, 0])


def test_the_pattern_turns_with_the_device() -> None:
    """Turning device and direction together turns the field with them."""
    rotation = rotation_matrix(quaternion_from_euler(-2.0, 0.5, 0.9))
    array = AntennaArray(pattern="tr38901", polarization="H")
    k = directions()
    turned = radiated_field(array, rotation, k @ rotation.T)
    assert turned == pytest.approx(radiated_field(array, UPRIGHT, k) @ rotation.T, abs=1e-12)


def test_the_basis_is_right_handed_everywhere_and_defined_at_the_poles() -> None:
    k = np.concatenate([directions(), [[0, 0, 1.0], [0, 0, -1.0]]])
    theta_hat, phi_hat = spherical_basis(k)
    assert np.cross(theta_hat, phi_hat) == pytest.approx(k, abs=1e-12)
    assert theta_hat[-2:] == pytest.approx(np.array([[1, 0, 0], [-1, 0, 0]]))


def test_a_half_wave_dipole_is_silent_along_its_axis() -> None:
    k = np.array([[0.0, 0.0, 1.0], [1e-12, 0.0, -1.0]])
    assert not radiated_field(AntennaArray(pattern="hw_dipole"), UPRIGHT, k).any()
