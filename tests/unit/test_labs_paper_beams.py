"""`caviar paper beams`: from datasets to tables and a picture; a second call trains nothing anew."""

from __future__ import annotations

from pathlib import Path

import pytest
from dataset_builders import SCENES, generated, written_scenario

from caviar_clients.learning.training import POLICY

pytest.importorskip("stable_baselines3", reason="needs the extra `learning`")
pytest.importorskip("matplotlib", reason="needs the extra `plot`")
pytest.importorskip("distributed", reason="needs the extra `datasets`")
pytestmark = pytest.mark.slow


def test_datasets_lead_to_tables_beside_published_figures(tmp_path: Path) -> None:
    from caviar_labs.paper.beams import Settings, experiment
    from caviar_labs.paper.beams_figure import draw
    from caviar_labs.paper.beams_tables import COLUMNS, PUBLISHED, comparisons, figures_of

    data = generated(written_scenario(tmp_path), tmp_path / "data", 10)
    other = generated(written_scenario(tmp_path, 'use = "random"'), tmp_path / "city", 3)
    settings = Settings(
        folder=tmp_path / "beams",
        data=data,
        other=other,
        seeds=2,
        epochs=3,
        models=("position",),
        shares=(2, 1),
    )
    made = experiment(settings)
    assert made.scenes == {2: 4 * SCENES, 1: 8 * SCENES}
    assert len(made.held_out.episodes) == 2
    assert made.other is not None
    assert made.other.episodes == (0, 1, 2)
    tables = comparisons(made)
    by_row = {row[0]: row for row in tables[0].rows}
    for name, figures in PUBLISHED:
        shown = dict(zip(COLUMNS, by_row[name][1:], strict=False))
        assert {column: text for column, text in shown.items() if text in figures.values()} == figures
    found = made.held_out.figure("position", "all", "top_1")
    assert by_row["position"][1].startswith(f"{100 * found.mean:.1f} ± ")
    assert "position-of-2" not in by_row
    curves = [table for table in tables if table.title.startswith("Learning curve")]
    assert [row[0] for row in curves[0].rows] == [f"{4 * SCENES:,}", f"{8 * SCENES:,}"]
    assert draw(made, tmp_path / "beams.png").read_bytes()[1:4] == b"PNG"
    assert figures_of(made)["scenes"] == {"2": 4 * SCENES, "1": 8 * SCENES}
    policies = {file: file.stat().st_mtime_ns for file in tmp_path.glob(f"beams/training/*/seed-*/{POLICY}")}
    assert len(policies) == 4
    experiment(settings)
    assert {file: file.stat().st_mtime_ns for file in policies} == policies
