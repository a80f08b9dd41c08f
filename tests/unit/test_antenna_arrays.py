"""DFT codebooks: unit norm, element order, and the beam towards a direction and back."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from caviar_protocol.errors import PayloadError
from caviar_protocol.space.antenna_arrays import (
    beam_towards,
    dft_codebook,
    element_positions,
    pointing_directions,
    steering_vector,
)
from caviar_protocol.topics import AntennaArray

SIZES = [(1, 1), (1, 8), (8, 1), (1, 5), (4, 3), (2, 7), (1, 64)]

arrays = st.builds(
    AntennaArray,
    rows=st.integers(1, 6),
    columns=st.integers(1, 9),
    vertical_spacing=st.floats(0.2, 1.6),
    horizontal_spacing=st.floats(0.2, 1.6),
)


@pytest.mark.parametrize(("rows", "columns"), SIZES)
def test_codebook_is_unitary_with_beams_of_unit_norm(rows: int, columns: int) -> None:
    codebook = dft_codebook(AntennaArray(rows=rows, columns=columns))
    np.testing.assert_allclose(np.linalg.norm(codebook, axis=1), 1, atol=1e-13)
    np.testing.assert_allclose(codebook @ codebook.conj().T, np.eye(rows * columns), atol=1e-13)


def test_planar_codebook_follows_the_element_order_of_the_array() -> None:
    """Against a double loop over beams and elements written from the definition in `Link`."""
    rows, columns = 3, 4
    codebook = dft_codebook(AntennaArray(rows=rows, columns=columns))
    for k in range(rows * columns):
        for i in range(rows * columns):
            p, q = k % rows, k // rows
            turns = p * (i % rows) / rows + q * (i // rows) / columns
            expected = cmath.exp(2j * math.pi * turns) / math.sqrt(rows * columns)
            assert codebook[k, i] == pytest.approx(expected, abs=1e-13)


def test_elements_run_down_a_column_and_columns_from_right_to_left() -> None:
    array = AntennaArray(rows=2, columns=3, vertical_spacing=0.8, horizontal_spacing=0.5)
    expected = [(0, y, z) for y in (-0.5, 0.0, 0.5) for z in (0.4, -0.4)]
    np.testing.assert_allclose(element_positions(array), expected, atol=1e-15)


def test_steering_vector_is_the_phase_of_each_elements_position() -> None:
    """Against exp(+j2π k̂·r) element by element, for several directions at once."""
    array = AntennaArray(rows=3, columns=2, vertical_spacing=0.6, horizontal_spacing=0.9)
    directions = np.random.default_rng(3).normal(size=(2, 5, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    vectors = steering_vector(array, directions)
    assert vectors.shape == (2, 5, 6)
    for index in np.ndindex(2, 5):
        for element, r in enumerate(element_positions(array)):
            expected = cmath.exp(2j * math.pi * float(directions[index] @ r))
            assert vectors[(*index, element)] == pytest.approx(expected, abs=1e-12)


@settings(deadline=None, max_examples=60)
@given(array=arrays, seed=st.integers(0, 2**32 - 1))
def test_beam_towards_is_the_argmax_over_the_whole_codebook(array: AntennaArray, seed: int) -> None:
    """For any direction, also behind the array, and any spacing."""
    directions = np.random.default_rng(seed).normal(size=(7, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    beams = [beam_towards(array, direction) for direction in directions.tolist()]
    for direction, beam in zip(directions, beams, strict=True):
        gains = [abs(np.vdot(c, steering_vector(array, direction))) for c in dft_codebook(array)]
        assert gains[beam] == pytest.approx(max(gains), rel=1e-12)


@settings(deadline=None, max_examples=60)
@given(array=arrays)
def test_a_beam_points_where_its_gain_is_full_and_is_found_from_there(array: AntennaArray) -> None:
    for beam in range(array.size):
        for direction in pointing_directions(array, beam):
            assert np.linalg.norm(direction) == pytest.approx(1, abs=1e-12)
            gain = abs(np.vdot(dft_codebook(array)[beam], steering_vector(array, direction)))
            assert gain == pytest.approx(math.sqrt(array.size), rel=1e-12)
            assert beam_towards(array, direction) == beam


def test_beams_of_a_half_wavelength_ula_wrap_from_left_to_right_at_end_fire() -> None:
    """Beam k of N = 8 has u_y = 2k/8 up to k = 4, which is +y and −y at once; then from the right."""
    array = AntennaArray(columns=8)
    first = [pointing_directions(array, beam)[0][1] for beam in (0, 1, 3, 5, 7)]
    assert first == pytest.approx([0, 0.25, 0.75, -0.75, -0.25])
    np.testing.assert_allclose(pointing_directions(array, 4), [(0, -1, 0), (0, 1, 0)], atol=1e-15)
    assert beam_towards(array, (0.0, 1.0, 0.0)) == 4
    assert beam_towards(array, (0.0, -1.0, 0.0)) == 4


def test_row_beams_turn_downwards_and_column_beams_to_the_left() -> None:
    """+y is left of boresight; rows are counted from the top."""
    array = AntennaArray(rows=4, columns=8)
    np.testing.assert_allclose(pointing_directions(array, 1)[0][1:], [0, -0.5], atol=1e-15)
    np.testing.assert_allclose(pointing_directions(array, 4)[0][1:], [0.25, 0], atol=1e-15)


def test_wide_spacing_has_grating_lobes_nearest_to_boresight_first() -> None:
    array = AntennaArray(columns=4, horizontal_spacing=1.0)
    np.testing.assert_allclose(pointing_directions(array, 0), [(1, 0, 0), (0, -1, 0), (0, 1, 0)], atol=1e-15)


def test_narrow_spacing_leaves_beams_without_a_real_direction() -> None:
    """At 0.25 λ only |k/N| ≤ 0.25 points anywhere."""
    array = AntennaArray(columns=8, horizontal_spacing=0.25)
    assert [len(pointing_directions(array, beam)) for beam in range(8)] == [1, 1, 1, 0, 0, 0, 1, 1]


def test_equal_gain_goes_to_the_lowest_index() -> None:
    """Halfway between beams 0 and 1 of two elements: u_y = ½."""
    array = AntennaArray(columns=2)
    assert beam_towards(array, (math.sqrt(0.75), 0.5, 0.0)) == 0


@pytest.mark.parametrize("beam", [-1, 6])
def test_unknown_beam_is_refused_with_the_size_of_the_codebook(beam: int) -> None:
    with pytest.raises(PayloadError, match=rf"beam {beam} does not exist, the codebook has beams 0 to 5"):
        pointing_directions(AntennaArray(rows=2, columns=3), beam)
