"""Beams with phase shifters of few bits lose what the theory of phase quantization says."""

from __future__ import annotations

import numpy as np
import pytest

from caviar_protocol.space.codebooks import codebook_of
from caviar_protocol.topics import AntennaArray


@pytest.mark.parametrize(("bits", "expected_db"), [(1, -3.92), (2, -0.91), (3, -0.22), (4, -0.056)])
def test_the_loss_towards_beam_centres_is_that_of_evenly_distributed_phase_errors(
    bits: int, expected_db: float
) -> None:
    """sinc²(1/2^b), with sinc x = sin(πx)/(πx), of the power gain of the DFT; within 0.02 dB in the mean.

    Wu and Zhang, "Beamforming optimization for wireless network aided by intelligent reflecting surface with
    discrete phase shifts", IEEE Trans. Commun. 68(3), 2020, proposition 1. Errors are evenly distributed
    where a beam has many phases: prime numbers of rows and columns leave none of them out.
    """
    dft = codebook_of(AntennaArray(rows=5, columns=61))
    quantized = codebook_of(AntennaArray(rows=5, columns=61, codebook=f"quantized:{bits}"))
    ratios = []
    for beam in range(dft.beams):
        centres = dft.pointing_directions(beam)
        if len(centres) and beam % 5 and beam // 5:  # those along an axis have but a few phases
            assert dft.gain(beam, centres[0]) == pytest.approx(1.0)
            ratios.append(quantized.gain(beam, centres[0]) ** 2)
    assert len(ratios) > 100
    assert expected_db == pytest.approx(20 * np.log10(np.sinc(2.0**-bits)), abs=0.01)
    assert 10 * np.log10(np.mean(ratios)) == pytest.approx(expected_db, abs=0.02)
