"""Which elements see a path is found out within ``memory_gib``, however many paths there are."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_labs.stability.lab import Plate, antenna, measure, scene, sionna, write_scenery
from caviar_protocol.topics import AntennaArray, Channel
from caviar_services.channel.arrays import spherical

pytestmark = pytest.mark.channel


@pytest.fixture(autouse=True)
def traced_memory() -> Iterator[None]:
    """Trace memory for the whole test: to stop it while threads of the ray tracer still drop arrays that
    they were lent ends the process (CPython's gh-128679), so that they get time to finish.
    """
    tracemalloc.start()
    yield
    time.sleep(1.0)
    tracemalloc.stop()


def diffuse(
    monkeypatch: pytest.MonkeyPatch, folder: Path, samples: int, memory_gib: float
) -> tuple[Channel, int]:
    """A canyon of rough walls, arrays of 64 and 4 elements, and the most memory [bytes] that looking took."""
    peaks: list[int] = []
    look = spherical.visibility

    def measured(*arguments: Any) -> Any:
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        try:
            return look(*arguments)
        finally:
            peaks.append(tracemalloc.get_traced_memory()[1] - before)

    monkeypatch.setattr(spherical, "visibility", measured)
    ground = [(-60, -20, 0), (60, -20, 0), (60, 20, 0), (-60, 20, 0)]
    wall = [(-60, -20, 0), (60, -20, 0), (60, -20, 20), (-60, -20, 20)]
    pole = [(10, -3, 0), (10.5, -3, 0), (10.5, -3, 9), (10, -3, 9)]
    plates = [Plate("ground", ground), Plate("wall", wall), Plate("pole", pole)]
    model = sionna(
        28e9,
        write_scenery(folder, plates),
        rung="spherical",
        scattering=True,
        max_depth=2,
        samples=samples,
        memory_gib=memory_gib,
        materials={f"skin-{plate.name}": {"scattering_coefficient": 0.4} for plate in plates},
    )
    places = np.random.default_rng(1).uniform((-50, -10, 1), (50, 10, 2), (6, 3))
    wide, small = AntennaArray(rows=8, columns=8), AntennaArray(rows=2, columns=2)
    devices = [antenna(f"r{i}", "rx", place, small) for i, place in enumerate(places)]
    channel = measure(model, scene([antenna("t", "tx", (0, -18, 8), wide), *devices]))
    monkeypatch.undo()
    return channel, max(peaks)


@pytest.mark.exhaustive
def test_memory_is_bounded_and_changes_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """With 32 MiB allowed, three times as many paths take no more than 48 MiB; with 4 GiB, H is the same."""
    few, low = diffuse(monkeypatch, tmp_path / "few", 1000, 1 / 32)
    many, high = diffuse(monkeypatch, tmp_path / "many", 3000, 1 / 32)
    free, most = diffuse(monkeypatch, tmp_path / "free", 3000, 4.0)
    assert len(many.tau) > 2.5 * len(few.tau) > 1000
    assert high < 1.2 * low
    assert high < 48 * 2**20 < most
    for one, other in zip(many.h, free.h, strict=True):
        assert one.h.tobytes() == other.h.tobytes()
