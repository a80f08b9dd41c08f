"""Noise of sensors: models that turn what a ray tracer found into what a real sensor would have measured.

A model is one struct: its fields are the keys of ``noise`` in the settings of the service, and its method
`apply` changes the measurement of one LIDAR or camera in one frame. Without the key there is no noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import Float32Array, quantity
from caviar_protocol.errors import PayloadError, suggestion
from caviar_protocol.plugins import plugin_class, plugins
from caviar_protocol.scenario.conversion import Place, convert_table
from caviar_services.sensors.shading import encoded, linear

SENSORS = ("lidar", "camera")
"""Kinds of sensors that have noise; the same as in the devices of a scenario."""


class SensorNoise(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of noise models. A subclass adds its parameters as fields, and implements `apply`.

    Frozen, so that what a frame measures depends on that frame alone (contract, clause 19).

    Example:
        >>> class Fog(SensorNoise, frozen=True, kw_only=True, forbid_unknown_fields=True):
        ...     extinction_per_m: float = 0.01
        ...
        ...     def apply(self, values, random):
        ...         seen = np.exp(-2 * self.extinction_per_m * values)
        ...         return np.where(random.random(values.shape) < seen, values, np.nan)
        >>> ranges = np.full(1000, 50.0, np.float32)
        >>> bool(np.isnan(Fog().apply(ranges, np.random.default_rng(1))).mean() > 0.5)
        True
    """

    def apply(self, values: Float32Array, random: np.random.Generator) -> NDArray[Any]:
        """Measure what is there.

        Args:
            values: Of a LIDAR the ranges of its returns in ray order [m], Shape ``[N]``; of a camera the sRGB
                counts of its picture, 0 to 255, Shape ``[H, W, 3]``.
            random: Of this sensor in this frame; the only source of chance.

        Returns:
            New values of the same shape. A range that is not finite, or outside the range of the device, is a
            return that is lost; counts are rounded and clipped to 0 … 255.
        """
        raise NotImplementedError


class GaussianRange(SensorNoise, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Gaussian errors of a LIDAR's ranges, along the ray; returns are lost at random.

    Example:
        >>> noise = GaussianRange(range_std_m=0.02)
        >>> noise.apply(np.full(3, 10.0, np.float32), np.random.default_rng(1)).round(3).tolist()
        [10.007, 10.016, 10.007]
    """

    range_std_m: Annotated[float, quantity("m", "standard deviation of a range", ge=0, le=1000)] = 0.0
    dropout: Annotated[float, quantity("1", "share of returns that are lost", ge=0, le=1)] = 0.0

    def apply(self, values: Float32Array, random: np.random.Generator) -> NDArray[Any]:
        """See `SensorNoise.apply`."""
        measured = random.normal(values, self.range_std_m)
        measured[random.random(values.shape) < self.dropout] = np.nan
        return measured


class GaussianCounts(SensorNoise, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Gaussian errors of a picture's counts, independent in every pixel and colour."""

    std_counts: Annotated[float, quantity("1", "standard deviation, of 255 counts", ge=0, le=255)]

    def apply(self, values: Float32Array, random: np.random.Generator) -> NDArray[Any]:
        """See `SensorNoise.apply`."""
        return random.normal(values, self.std_counts)


class ShotNoise(SensorNoise, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Photon noise of a picture: the electrons of each pixel and colour are Poisson distributed.

    The mean is the full well times the linear intensity, and reading adds Gaussian noise: the linear camera
    model of EMVA Standard 1288, of a sensor that is exposed so that white just fills its wells.
    """

    full_well_e: Annotated[float, quantity("1", "electrons of a white pixel", gt=0, le=1e9)] = 10_000.0
    read_std_e: Annotated[float, quantity("1", "standard deviation of reading [e]", ge=0, le=1e9)] = 0.0

    def apply(self, values: Float32Array, random: np.random.Generator) -> NDArray[Any]:
        """See `SensorNoise.apply`."""
        electrons = random.poisson(linear(values / 255) * self.full_well_e)
        measured = random.normal(electrons, self.read_std_e) / self.full_well_e
        return encoded(measured.astype(np.float32))


NOISE: Mapping[str, type[SensorNoise]] = {
    "lidar:gaussian": GaussianRange,
    "camera:gaussian": GaussianCounts,
    "camera:shot": ShotNoise,
}
"""Noise models by ``SENSOR:NAME``; those of plug-ins are registered in `NOISE_PLUGINS`."""
NOISE_PLUGINS = "caviar.noise"
"""Group of entry points, each a subclass of `SensorNoise`, named ``lidar:NAME`` or ``camera:NAME``."""


def noise_models(sensor: str) -> dict[str, type[SensorNoise]]:
    """The noise models of a kind of sensor, built in and of plug-ins, by the name that a scenario has.

    Args:
        sensor: ``lidar`` or ``camera``.

    Raises:
        DeclarationError: A plug-in cannot be loaded, or is no subclass of `SensorNoise`.

    Example:
        >>> sorted(noise_models("camera"))
        ['gaussian', 'shot']
    """
    names = [name for name in (*plugins(NOISE_PLUGINS), *NOISE) if name.startswith(f"{sensor}:")]
    found = {name: NOISE.get(name) or plugin_class(NOISE_PLUGINS, name, SensorNoise) for name in names}
    return {name.partition(":")[2]: cls for name, cls in found.items() if cls is not None}


def noise_model(sensor: str, table: Mapping[str, Any] | None, place: Place) -> SensorNoise | None:
    """Make the noise model that a scenario describes; None where it describes none.

    Args:
        sensor: ``lidar`` or ``camera``.
        table: Key ``noise`` of the settings.
        place: Where that stands, for errors.

    Raises:
        ScenarioError: There is no such model, or a key of it is wrong; names key and value.
        DeclarationError: As for `noise_models`.

    Example:
        >>> noise_model("lidar", {"use": "gaussian", "range_std_m": 0.02}, Place("noise"))
        GaussianRange(range_std_m=0.02, dropout=0.0)
    """
    if table is None:
        return None
    models = noise_models(sensor)
    use = table.get("use", "")
    if use not in models:
        raise place.at("use").error(f"{use!r} is no noise model; {suggestion(str(use), models)}")
    return convert_table(models[use], {key: value for key, value in table.items() if key != "use"}, place)


def measured(noise: SensorNoise, values: Float32Array, random: np.random.Generator) -> Float32Array:
    """Apply a noise model.

    Args:
        noise: The model.
        values: As for `SensorNoise.apply`.
        random: The same.

    Returns:
        What `SensorNoise.apply` gives, in single precision.

    Raises:
        PayloadError: It gave another shape; names the class.
    """
    found: Float32Array = np.asarray(noise.apply(values, random), np.float32)
    if found.shape != values.shape:
        raise PayloadError(
            f"{type(noise).__name__}.apply made {found.shape} of values of shape {values.shape}; "
            "it has to keep the shape, and to mark a return that is lost with NaN"
        )
    return found
