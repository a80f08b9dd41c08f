"""Sums over the paths of a pair, in blocks."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_services.channel.arrays.channel_matrices import summed


@pytest.mark.parametrize("shape", [(0, 3, 2), (1, 1, 1), (700, 8, 64), (100, 64, 64), (9, 300, 300)])
def test_sum_is_that_of_all_paths_one_by_one(shape: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(4)
    paths, nr, nt = shape
    receive = rng.normal(size=(paths, nr)) + 1j * rng.normal(size=(paths, nr))
    transmit = rng.normal(size=(paths, nt)) + 1j * rng.normal(size=(paths, nt))
    expected = np.zeros((nr, nt), np.complex128)
    for path in range(paths):
        expected += np.outer(receive[path], transmit[path])
    np.testing.assert_allclose(summed(receive, transmit), expected, rtol=1e-12, atol=1e-12)
