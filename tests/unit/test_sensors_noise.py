"""Noise of sensors: what the built-in models promise, and what a scenario and a plug-in say."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from caviar_protocol import plugins
from caviar_protocol.errors import CaviarError, PayloadError, ScenarioError
from caviar_protocol.scenario.conversion import Place
from caviar_services.sensors.camera import CameraSensors
from caviar_services.sensors.lidar import LidarSensors
from caviar_services.sensors.noise import (
    NOISE,
    GaussianCounts,
    GaussianRange,
    SensorNoise,
    ShotNoise,
    measured,
    noise_model,
)
from caviar_services.testing import NoiseConformance

COUNT = 200_000
"""Values whose mean and standard deviation are compared; five standard errors are the tolerance."""


class TestGaussianRange(NoiseConformance):
    sensor = "lidar"
    noise = GaussianRange(range_std_m=0.05, dropout=0.1)

    def test_mean_and_deviation_of_ranges_and_the_share_of_lost_returns(self) -> None:
        found = measured(self.noise, np.full(COUNT, 30.0, np.float32), np.random.default_rng(1))
        kept = found[np.isfinite(found)]
        assert len(kept) / COUNT == pytest.approx(0.9, abs=5 * math.sqrt(0.1 * 0.9 / COUNT))
        assert kept.mean() - 30.0 == pytest.approx(0.0, abs=5 * 0.05 / math.sqrt(len(kept)))
        assert kept.std(dtype=np.float64) == pytest.approx(0.05, rel=5 / math.sqrt(2 * len(kept)))


class TestGaussianCounts(NoiseConformance):
    sensor = "camera"
    noise = GaussianCounts(std_counts=4.0)

    def test_mean_and_deviation_of_counts(self) -> None:
        found = measured(self.noise, np.full((1, COUNT, 1), 120.0, np.float32), np.random.default_rng(1))
        assert found.mean(dtype=np.float64) == pytest.approx(120.0, abs=5 * 4 / math.sqrt(COUNT))
        assert found.std(dtype=np.float64) == pytest.approx(4.0, rel=5 / math.sqrt(2 * COUNT))


class TestShotNoise(NoiseConformance):
    sensor = "camera"
    noise = ShotNoise(full_well_e=2000.0, read_std_e=5.0)

    @pytest.mark.parametrize("counts", [60, 120, 200])
    def test_the_variance_of_electrons_is_their_mean_and_that_of_reading(self, counts: int) -> None:
        """Electrons through the curve of sRGB, whose slope is written out here (IEC 61966-2-1)."""
        found = measured(
            self.noise, np.full((1, COUNT, 1), counts, np.float32), np.random.default_rng(counts)
        )
        base = (counts / 255 + 0.055) / 1.055
        electrons = 2000.0 * base**2.4
        per_electron = 255 / (2000.0 * 2.4 / 1.055 * base**1.4)  # counts
        # A twelfth of a count² of rounding; the curve bends by a few percent within a deviation.
        wanted = math.sqrt((electrons + 5.0**2) * per_electron**2 + 1 / 12)
        assert found.std(dtype=np.float64) == pytest.approx(wanted, rel=0.04)
        assert found.mean(dtype=np.float64) == pytest.approx(counts, abs=0.05 * wanted)


def test_every_built_in_model_has_a_conformance_test() -> None:
    assert {type(cls.noise) for cls in NoiseConformance.__subclasses__()} >= set(NOISE.values())


@pytest.mark.parametrize(
    ("sensor", "table", "named"),
    [
        ("lidar", {"use": "gausian"}, "noise.use: 'gausian'"),
        ("lidar", {"range_std_m": 0.1}, "noise.use: ''"),
        ("lidar", {"use": "shot"}, "noise.use: 'shot'"),
        ("lidar", {"use": "gaussian", "range_std": 0.1}, "noise.range_std: .*range_std_m"),
        ("lidar", {"use": "gaussian", "dropout": 1.5}, "noise.dropout: is 1.5"),
        ("camera", {"use": "gaussian", "std_counts": -1.0}, "noise.std_counts: is -1"),
        ("camera", {"use": "gaussian"}, "noise: lacks 'std_counts'"),
    ],
)
def test_noise_that_cannot_be_is_refused_by_key_where_the_scenario_is_read(
    sensor: str, table: dict[str, object], named: str
) -> None:
    service = {"lidar": LidarSensors, "camera": CameraSensors}[sensor]
    with pytest.raises(ScenarioError, match=named):
        service.check_settings(service.Settings(noise=table), Place())


def test_a_model_that_changes_the_shape_is_named() -> None:
    class Fewer(SensorNoise, frozen=True):
        def apply(self, values, random):
            return values[1:]

    with pytest.raises(PayloadError, match=r"Fewer.*\(2,\).*\(3,\)"):
        measured(Fewer(), np.ones(3, np.float32), np.random.default_rng(1))


FOG = """\
import numpy as np
from caviar_services.sensors.noise import SensorNoise

class Fog(SensorNoise, frozen=True, kw_only=True, forbid_unknown_fields=True):
    \"\"\"Returns that are lost the more, the farther they come.\"\"\"

    extinction_per_m: float = 0.01

    def apply(self, values, random):
        seen = np.exp(-2 * self.extinction_per_m * values)
        return np.where(random.random(values.shape) < seen, values, np.nan)

WORDS = 3
"""


@pytest.fixture
def fog(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A distribution with a noise model, and with something that is none."""
    (tmp_path / "fog_of_mine.py").write_text(FOG)
    info = tmp_path / "fog_of_mine-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: fog-of-mine\nVersion: 1.0\n")
    points = "[caviar.noise]\nlidar:fog = fog_of_mine:Fog\ncamera:words = fog_of_mine:WORDS\n"
    (info / "entry_points.txt").write_text(points)
    monkeypatch.syspath_prepend(tmp_path)
    for cached in (plugins._all, plugins.plugins):
        cached.cache_clear()
    yield
    monkeypatch.undo()
    for cached in (plugins._all, plugins.plugins):
        cached.cache_clear()


@pytest.mark.usefixtures("fog")
def test_a_plug_in_is_a_model_by_its_name_and_one_that_is_none_is_refused_with_its_distribution() -> None:
    model = noise_model("lidar", {"use": "fog", "extinction_per_m": 0.02}, Place("noise"))
    assert type(model).__name__ == "Fog"
    far, near = (measured(model, np.full(COUNT, d, np.float32), np.random.default_rng(1)) for d in (50, 5))
    assert np.isfinite(far).mean() == pytest.approx(math.exp(-2.0), abs=0.005)
    assert np.isfinite(near).mean() == pytest.approx(math.exp(-0.2), abs=0.005)
    with pytest.raises(CaviarError, match="fog-of-mine"):
        noise_model("camera", {"use": "words"}, Place("noise"))
