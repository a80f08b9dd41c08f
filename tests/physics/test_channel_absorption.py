"""Absorption on traced paths: each loses over its whole length, on each carrier its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from caviar_labs.stability.formulas import C
from caviar_labs.stability.lab import Plate, antenna, measure, scene, sionna, write_scenery

pytestmark = pytest.mark.channel

DB_PER_KM = np.array([14.778317, 0.380843])
"""P.676-12 at 60 and 90 GHz, 1013.25 hPa, 15 °C, 7.5 g/m³ (ITU-Rpy 0.4.0)."""


def test_every_path_loses_over_its_whole_length(tmp_path: Path) -> None:
    """Line of sight of 240 m and a reflection of 470 m, with matrices."""
    corners = [(-400, -400, 0), (400, -400, 0), (400, 400, 0), (-400, 400, 0)]
    assets = write_scenery(tmp_path, [Plate("ground", corners)])
    ends = scene([antenna("t", "tx", (-110, 7, 190)), antenna("r", "rx", (126, -31, 212))])
    air, vacuum = (
        measure(sionna((60e9, 90e9), assets, max_depth=1, **settings), ends)
        for settings in ({"atmosphere": {}}, {})
    )
    assert air.interactions[:, 0].tolist() == [0, 1]
    metres = np.array([np.linalg.norm([236, -38, 22]), np.linalg.norm([236, -38, 402])])
    np.testing.assert_allclose(air.tau * C, metres, rtol=1e-6)
    lost_db = 20 * np.log10(np.abs(vacuum.a / air.a))
    np.testing.assert_allclose(lost_db, DB_PER_KM[:, None] * metres / 1000, rtol=1e-5)
    assert [m.h[0, 0] for m in air.h] == pytest.approx(air.a.sum(1).tolist())
    assert air.options.absorption_db_per_km == pytest.approx(DB_PER_KM.tolist(), rel=1e-5)
