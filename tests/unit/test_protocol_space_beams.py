"""Arrays of several panels and polarizations: order of elements and beams, and codebooks over them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from link_builders import random_h

from caviar_protocol.space.antenna_arrays import (
    beam_gain,
    beam_towards,
    dft_beam,
    dft_codebook,
    pointing_directions,
    steering_vector,
    subarrays,
)
from caviar_protocol.space.beams import beam_gains, coupled_polarizations, straight_beams
from caviar_protocol.topics import AntennaArray, Panel

CROSS = AntennaArray(rows=2, columns=4, polarization="cross")
SIDES = (Panel(position_m=(0.0, 0.1, 0.0), yaw_deg=90.0), Panel(position_m=(0.0, -0.1, 0.0), yaw_deg=-90.0))
PHONE = AntennaArray(columns=4, polarization="VH", panels=SIDES)


def test_elements_are_in_order_of_panels_then_polarizations() -> None:
    parts = subarrays(PHONE)
    assert PHONE.size == 16
    assert [(part.first, part.array.polarization, part.position[1]) for part in parts] == [
        (0, "V", 0.1), (4, "H", 0.1), (8, "V", -0.1), (12, "H", -0.1)
    ]  # fmt: skip
    assert parts[0].towards((0.0, 1.0, 0.0)) == pytest.approx((1.0, 0.0, 0.0))
    (whole,) = subarrays(AntennaArray(rows=3))
    assert (whole.array, whole.elements) == (AntennaArray(rows=3), slice(0, 3))


@pytest.mark.parametrize("array", [CROSS, PHONE])
def test_a_codebook_has_the_beams_of_each_subarray_and_is_unitary(array: AntennaArray) -> None:
    codebook = dft_codebook(array)
    np.testing.assert_allclose(codebook @ codebook.conj().T, np.eye(array.size), atol=1e-13)
    np.testing.assert_allclose([dft_beam(array, k) for k in range(array.size)], codebook, atol=1e-15)
    for part in subarrays(array):
        np.testing.assert_array_equal(codebook[part.elements, part.elements], dft_codebook(part.array))
        assert np.count_nonzero(codebook[part.elements]) == part.array.size**2


@pytest.mark.parametrize(("tx", "rx"), [(CROSS, PHONE), (PHONE, AntennaArray(rows=3)), (CROSS, CROSS)])
def test_the_sweep_is_eq_1_beam_by_beam(tx: AntennaArray, rx: AntennaArray) -> None:
    h = random_h(3, rx.size, tx.size)
    expected = np.abs(dft_codebook(rx).conj() @ h @ dft_codebook(tx).conj().T).T
    np.testing.assert_allclose(beam_gains(h, tx, rx), expected, atol=1e-12)


@pytest.mark.parametrize("array", [CROSS, PHONE])
def test_beams_point_in_the_axes_of_the_device_and_are_found_from_there(array: AntennaArray) -> None:
    per_panel = len(array.polarizations)
    for beam in range(array.size):
        for direction in pointing_directions(array, beam):
            assert beam_gain(array, beam, direction) == pytest.approx(1.0, abs=1e-9)
            number = beam // (array.rows * array.columns)
            facing = subarrays(array)[number].towards(direction)
            if facing[0] < 1e-6:
                continue  # end-fire: both panels see it alike
            assert beam_towards(array, direction, number % per_panel) == beam


def test_straight_beams_take_the_panel_that_faces_and_the_polarizations_that_match() -> None:
    """The phone's left panel, and of its V and H the V, which the station's first polarization hears best."""
    station = AntennaArray(columns=8, polarization="VH")
    assert straight_beams(station, (1.0, 0.0, 0.0), PHONE, (0.0, 1.0, 0.0)) == (0, 0)
    assert straight_beams(station, (1.0, 0.0, 0.0), PHONE, (0.0, -1.0, 0.0)) == (0, 8)
    assert straight_beams(CROSS, (1.0, 0.0, 0.0), CROSS, (1.0, 0.0, 0.0)) == (0, 8)  # -45 is heard by +45


@pytest.mark.parametrize(
    ("transmit", "receive", "expected"),
    [("VH", "VH", (0, 0)), ("cross", "cross", (0, 1)), ("circular", "circular", (0, 0)), ("VH", "H", (1, 0)),
     ("RHCP", "circular", (0, 0)), ("LHCP", "circular", (0, 1)), ("V", "cross", (0, 0))],
)  # fmt: skip
def test_polarizations_that_couple(transmit: str, receive: str, expected: tuple[int, int]) -> None:
    arrays = (AntennaArray(polarization=polarization) for polarization in (transmit, receive))  # type: ignore[arg-type]
    assert coupled_polarizations(*arrays) == expected


def test_one_wave_between_dual_arrays_is_heard_with_full_gain_on_its_polarization() -> None:
    """|y| = sqrt(Nr·Nt)·|a| with the elements of one polarization at each end, and 0 on the others."""
    tx, rx = AntennaArray(columns=8, polarization="VH"), AntennaArray(columns=4, polarization="VH")
    at = steering_vector(subarrays(tx)[0].array, pointing_directions(tx, 3)[0])
    ar = steering_vector(subarrays(rx)[0].array, pointing_directions(rx, 1)[0])
    h = np.kron(np.diag([2e-6, 5e-6]), np.outer(ar, at))  # V to V and, stronger, H to H
    y = beam_gains(h, tx, rx)
    assert y[3, 1] == pytest.approx(2e-6 * math.sqrt(32))
    assert y[8 + 3, 4 + 1] == pytest.approx(5e-6 * math.sqrt(32))
    assert np.sort(y.ravel())[-3] < 1e-18
