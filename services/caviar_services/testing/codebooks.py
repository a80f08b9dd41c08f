"""Conformance tests of codebooks."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest

from caviar_protocol.arrays import Complex128Array
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.beams import beam_gains
from caviar_protocol.space.codebooks import UNIT_NORM, Codebook, codebook_of
from caviar_protocol.topics import AntennaArray


class CodebookConformance:
    """A codebook of unit-norm beams, by which beams are found and scored as its vectors say.

    Example:
        >>> class TestLearned(CodebookConformance):
        ...     arrays = (AntennaArray(columns=8, codebook="learned:v3"),)
    """

    arrays: ClassVar[tuple[AntennaArray, ...]]
    """Arrays that name the codebook, with its argument; one of several panels or polarizations among them."""

    @pytest.fixture
    def codebooks(self) -> list[Codebook]:
        """The codebook of each array."""
        return [codebook_of(array) for array in self.arrays]

    def test_beams_have_unit_norm(self, codebooks: list[Codebook]) -> None:
        for codebook in codebooks:
            assert codebook.vectors.shape == (codebook.beams, codebook.array.size)
            assert np.allclose(np.linalg.norm(codebook.vectors, axis=1), 1, rtol=0, atol=UNIT_NORM)
            for beam in (0, codebook.beams - 1):
                assert np.allclose(codebook.vector(beam), codebook.vectors[beam], rtol=0, atol=1e-12)

    def test_gains_of_pairs_are_those_of_the_vectors(self, codebooks: list[Codebook]) -> None:
        """|wᴴ H f| with w = c_r and f = conj(c_t), of random H, and the DFT at the other end too."""
        random = np.random.default_rng(1)
        for tx in (*codebooks, codebook_of(AntennaArray(columns=3))):
            for rx in codebooks:
                parts = random.normal(size=(2, 2, rx.array.size, tx.array.size))
                h: Complex128Array = parts[0] + 1j * parts[1]
                expected = np.abs(np.einsum("rm,fmn,tn->ftr", rx.vectors.conj(), h, tx.vectors.conj()))
                assert np.allclose(beam_gains(h, tx.array, rx.array), expected, rtol=1e-9, atol=1e-9)

    def test_the_beam_towards_a_direction_has_the_largest_gain(self, codebooks: list[Codebook]) -> None:
        """Of its subarray: |c_k* a(k̂)|, the same as `Codebook.gain` times sqrt(N)."""
        random = np.random.default_rng(2)
        for codebook in codebooks:
            for direction in random.normal(size=(20, 3)):
                direction /= np.linalg.norm(direction)
                best = codebook.beam_towards(direction.tolist())
                part, own = codebook.part_of(best)
                response = steering_vector(part.array, np.array(part.towards(direction.tolist())))
                gains = np.abs(codebook_of(part.array).vectors.conj() @ response)
                assert gains[own] >= gains.max() - 1e-9
                shown = codebook.gain(best, direction) * np.sqrt(part.array.size)
                assert shown == pytest.approx(gains[own], abs=1e-9)
