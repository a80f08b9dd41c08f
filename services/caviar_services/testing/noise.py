"""Conformance tests of noise models of sensors (`caviar_services.sensors.noise`)."""

from __future__ import annotations

from typing import ClassVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float32Array
from caviar_protocol.scenario.conversion import convert_settings
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
