"""The benchmark of the journal, short: what it measures is bounded, and read back as it was written."""

from __future__ import annotations

from pathlib import Path

import bench_journal
import pytest

from caviar_broker import journal


@pytest.mark.parametrize("durability", ["none", "periodic", "frame"])
def test_a_journal_does_not_grow_with_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, durability: str
) -> None:
    """`bench_journal.grow` ends with an error where digest or frames read back are others."""
    monkeypatch.setattr(journal, "COMPACT_BYTES", 100_000)
    frames = 100 if durability == "frame" else 400
    found = bench_journal.grow(tmp_path, frames, durability)  # type: ignore[arg-type]
    assert found["bytes_per_frame"] > 1500
    assert found["most_bytes"] < 400_000
    assert not list(tmp_path.glob("*.partial"))
    assert len(list((tmp_path / "checkpoints").iterdir())) <= frames // bench_journal.CHECKPOINT_FRAMES
