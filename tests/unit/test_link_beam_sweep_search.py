"""The sweep of all beam pairs against eq. (1) written out, and the best pairs of eq. (2)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from link_builders import random_h

from caviar_protocol.space.antenna_arrays import dft_codebook, pointing_directions, steering_vector
from caviar_protocol.space.beams import BeamPairs, beam_gains, best_pairs
from caviar_protocol.topics import AntennaArray


@pytest.mark.parametrize(
    ("tx", "rx"), [((1, 5), (4, 1)), ((3, 2), (2, 4)), ((1, 1), (1, 3)), ((4, 3), (1, 1)), ((2, 3), (3, 3))]
)
def test_sweep_equals_the_product_of_eq_1_pair_by_pair(tx: tuple[int, int], rx: tuple[int, int]) -> None:
    tx_array, rx_array = AntennaArray(rows=tx[0], columns=tx[1]), AntennaArray(rows=rx[0], columns=rx[1])
    h = random_h(7, rx_array.size, tx_array.size)
    swept = beam_gains(h, tx_array, rx_array)
    assert swept.shape == (tx_array.size, rx_array.size)
    for p in range(tx_array.size):
        for q in range(rx_array.size):
            w = dft_codebook(rx_array)[q]
            f = dft_codebook(tx_array)[p].conj()
            assert swept[p, q] == pytest.approx(abs(w.conj() @ h @ f), rel=1e-12, abs=1e-19)


def test_a_batch_is_swept_like_its_members() -> None:
    tx, rx = AntennaArray(rows=2, columns=4), AntennaArray(rows=3, columns=1)
    h = np.stack([random_h(seed, rx.size, tx.size) for seed in range(4)])
    np.testing.assert_array_equal(beam_gains(h, tx, rx), [beam_gains(one, tx, rx) for one in h])


def test_a_path_on_both_grids_has_the_full_gain_and_leaks_into_no_other_pair() -> None:
    """|y| = sqrt(Nr·Nt)·|a| on the matched pair; DFT beams are orthogonal on their grid."""
    tx, rx = AntennaArray(rows=4, columns=4), AntennaArray(rows=1, columns=4)
    a = 3e-6 * np.exp(0.7j)
    at = steering_vector(tx, pointing_directions(tx, 5)[0])
    ar = steering_vector(rx, pointing_directions(rx, 3)[0])
    swept = beam_gains(a * np.outer(ar, at), tx, rx)
    expected = np.zeros((16, 4))
    expected[5, 3] = math.sqrt(64) * 3e-6
    np.testing.assert_allclose(swept, expected, rtol=1e-12, atol=1e-18)


def test_sweep_keeps_the_energy_of_h() -> None:
    """Unitary codebooks: Σ|y|² = ‖H‖² (Parseval)."""
    tx, rx = AntennaArray(rows=3, columns=5), AntennaArray(rows=2, columns=2)
    h = random_h(1, rx.size, tx.size)
    assert np.sum(beam_gains(h, tx, rx) ** 2) == pytest.approx(np.sum(np.abs(h) ** 2), rel=1e-12)


@given(
    values=st.lists(st.integers(0, 4), min_size=1, max_size=30),
    columns=st.integers(1, 4),
    k=st.integers(1, 40),
)
def test_best_pairs_are_sorted_and_ties_go_to_the_lowest_index(
    values: list[int], columns: int, k: int
) -> None:
    """Against Python's stable sort of all pairs; few distinct values make many ties."""
    rows = max(1, len(values) // columns)
    grid = np.resize(np.array(values, dtype=np.float64), (rows, columns))
    pairs = [(p, q) for p in range(rows) for q in range(columns)]
    expected = sorted(pairs, key=lambda pair: -grid[pair])[:k]
    best = BeamPairs(*(found[0] for found in best_pairs(grid[None], k)))
    assert list(zip(best.tx_beam.tolist(), best.rx_beam.tolist(), strict=True)) == expected
    assert best.abs_y.tolist() == [grid[pair] for pair in expected]


def test_a_single_element_at_each_end_is_a_sweep_of_one_pair() -> None:
    """For one channel matrix, and for several at once."""
    single = AntennaArray()
    assert beam_gains(np.full((1, 1), 3.0 - 4.0j), single, single).tolist() == [[5.0]]
    assert beam_gains(np.full((2, 1, 1), 2.0j), single, single).tolist() == [[[2.0]], [[2.0]]]
