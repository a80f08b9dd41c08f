"""Conformance tests of codebooks.

Conformance tests of noise models of sensors (`caviar_services.sensors.noise`).
"""

from __future__ import annotations

from typing import ClassVar

import msgspec
import numpy as np
import pytest

from caviar_protocol.arrays import Complex128Array, Float32Array
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.space.antenna_arrays import steering_vector
from caviar_protocol.space.beams import beam_gains
from caviar_protocol.space.codebooks import UNIT_NORM, Codebook, codebook_of
from caviar_protocol.topics import AntennaArray
from caviar_services.sensors.noise import SensorNoise, measured


class NoiseConformance:
    """Tests of a noise model: subclass in a test file and set ``noise`` and ``sensor``.

    Example:
        >>> from caviar_services.sensors.noise import GaussianRange
        >>> class TestGaussianRange(NoiseConformance):
        ...     sensor = "lidar"
        ...     noise = GaussianRange(range_std_m=0.02)
        >>> TestGaussianRange.__test__, NoiseConformance.__test__
        (True, False)
    """

    __test__ = False

    sensor: ClassVar[str]
    """``lidar`` or ``camera``."""
    noise: ClassVar[SensorNoise]
    """The model, with parameters that change something."""

    # pytest collects whatever class a test file imports; the base has nothing to test.
    def __init_subclass__(cls) -> None:
        cls.__test__ = hasattr(cls, "noise")

    @classmethod
    def values(cls) -> Float32Array:
        """Ranges from 1 to 90 m, or a picture of 20 to 230 counts."""
        random = np.random.default_rng(5)
        if cls.sensor == "lidar":
            return random.uniform(1.0, 90.0, 5000).astype(np.float32)
        return random.integers(20, 230, (40, 60, 3)).astype(np.float32)

    def test_the_generator_is_the_only_source_of_chance(self) -> None:
        """The same generator gives the same bytes, another one others; the values given stay as they are."""
        given = self.values()
        given.flags.writeable = False
        first, again, other = (measured(self.noise, given, np.random.default_rng(s)) for s in (1, 1, 2))
        assert first.tobytes() == again.tobytes()
        assert first.tobytes() not in (given.tobytes(), other.tobytes())

    def test_values_keep_their_shape_and_a_camera_loses_none(self) -> None:
        """A LIDAR may have no return at all."""
        for given in (self.values(), self.values()[:0]):
            found = measured(self.noise, given, np.random.default_rng(1))
            assert self.sensor == "lidar" or np.isfinite(found).all()

    def test_parameters_are_keys_of_a_scenario(self) -> None:
        """Every field is a value that TOML has, and its table makes an equal model."""
        table = msgspec.to_builtins(self.noise)
        assert convert_settings(type(self.noise), table) == self.noise


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
