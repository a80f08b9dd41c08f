"""Tables and pictures of a comparison: what stands beside what, and where labels go."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

from caviar_labs.cli.measure import _other_reference
from caviar_labs.tradeoff.campaign import Skipped
from caviar_labs.tradeoff.errors import Row, error_fields
from caviar_labs.tradeoff.labels import Box, place_labels, spots
from caviar_labs.tradeoff.ladder import REFERENCES
from caviar_labs.tradeoff.plot import draw_convergence, draw_pareto, pareto_front
from caviar_labs.tradeoff.report import Options, Point, Report, answers, pareto_rows
from caviar_labs.tradeoff.tables import answer_sentences, level, markdown, significant

pytestmark = pytest.mark.slow


def row(setting: str, time_ms: float, nmse_db: float, **more: Any) -> Row:
    fields: dict[str, Any] = {
        **error_fields([]),
        "setting": setting,
        "block": "ladder",
        "column": "",
        "row": "",
        "rung": setting.partition(" ")[0],
        "time_ms_median": time_ms,
        "time_ms_p99": 2 * time_ms,
        "factor": time_ms / 100,
        "memory_mib": 3.0,
        "loaded_mib": 10.0,
        "prepare_s": 1.0,
        "measurements": 9,
        "scenes": 3,
        "receivers": 10.0,
        "paths": 70.0,
        "nmse_db": nmse_db,
        "path_gain_error_db": 10 ** (nmse_db / 20),
        **more,
    }
    return Row(**fields)


def report() -> Report:
    spacing = {"1": 80.0, "0.5": 100.0, "0.25": 250.0, "0.5 (diffuse)": 900.0}
    return Report(
        scenario="street",
        origin="made by hand",
        carriers_hz=(28e9,),
        scenes=3,
        receivers=10.0,
        reference="spherical 1e6",
        baseline="siso-rt 1e5",
        elapsed_s=60.0,
        machine={"cpu": "abacus"},
        rows=(
            row("free-space", 0.8, 4.0),
            row("siso-rt 1e5", 100.0, -10.0, note="2 of 3 scenes"),
            row("spherical 1e6", 2000.0, -200.0, path_gain_error_db=0.0),
            *(
                row(f"siso-rt {n}°", t, -9.0, block="ray spacing", column="siso-rt", row=n)
                for n, t in spacing.items()
            ),
            *(
                row(f"mimo-rt {n}", t, 0.0, block="arrays", column="mimo-rt", row=n)
                for n, t in (("64×2", 400.0), ("64×64", 6000.0))
            ),
        ),
        convergence=tuple(
            Point(
                paths=kind,
                samples=samples,
                seeds=2,
                time_ms_median=samples / 1e3,
                nmse_db=(-samples / 1e5, -samples / 2e5) if kind == "specular" else (),
                pair_nmse_db=-200.0 if kind == "specular" else -5.0,
                pair_gain_db_p95=0.3,
                pair_beam_top1=0.9,
                users=40,
            )
            for kind in ("specular", "diffuse")
            for samples in (10_000, 100_000)
        ),
        skipped=tuple(
            Skipped(setting=name, block="arrays", reason="no time")
            for name in ("mimo-rt 64×8", "mimo-rt 0.1°")
        ),
    )


def test_factors_stand_beside_the_papers() -> None:
    text = markdown(report())
    assert "| 0.25 | 660,047 | 2.5 (−9.0 dB) | 2.4 | 1.5 |" in text
    assert "| 0.5 (diffuse) | 165,012 | 9 (−9.0 dB) | 84.7 | 412.9 |" in text
    assert "| 0.1 | 4,125,296 | – | 11 | 4 |" in text
    assert "| 64 | 64 | 15 (6000 ms) | 12 |" in text
    assert "| 64 | 8 | – | 2.2 |" in text
    assert "RTX 2070" in text
    assert "abacus" in text


def test_the_front_and_the_answers_are_of_settings_that_had_the_whole_work() -> None:
    rows = (
        row("free-space", 1.0, 4.0),
        row("siso-rt d1", 40.0, -4.0),
        row("siso-rt d2", 60.0, -3.0),
        row("siso-rt d5", 900.0, -25.0),
        row("mimo-rt", 0.5, -60.0, receivers=2.0),
        row("siso-rt d5, keyframes", 0.1, -90.0, block="keyframes", note="of 3 scenes"),
        row("spherical 1e6", 2000.0, -200.0),
    )
    assert [r.setting for r in pareto_rows(rows, "spherical 1e6")] == [
        "free-space",
        "siso-rt d1",
        "siso-rt d5",
    ]
    found = answers(rows, "spherical 1e6", [-20.0, -30.0], [0.4, 50.0, 5000.0])
    assert [answer.setting for answer in found] == [
        "siso-rt d5",
        "spherical 1e6",
        None,
        "siso-rt d1",
        "spherical 1e6",
    ]
    made = msgspec.structs.replace(report(), rows=rows, answers=found)
    assert answer_sentences(made) == [
        "for −20.0 dB: siso-rt d5 (−25.0 dB, 900 ms)",
        "for −30.0 dB: spherical 1e6 (the reference itself, 2000 ms)",
        "for 0.4 ms: none; the fastest takes 0.5 ms",
        "for 50 ms: siso-rt d1 (−4.0 dB, 40 ms)",
        "for 5000 ms: spherical 1e6 (the reference itself, 2000 ms)",
    ]
    text = markdown(made)
    assert "| siso-rt d1 * | 40 |" in text
    assert "| siso-rt d2 | 60 |" in text
    assert "- for 50 ms: siso-rt d1 (−4.0 dB, 40 ms)" in text


def test_another_reference_than_the_finest_is_warned_of() -> None:
    finest = REFERENCES[0]
    skipped = (Skipped(setting=finest, block="ladder", reason="no answer"),)
    coarser = msgspec.structs.replace(report(), reference="siso-rt 1e6 d3", skipped=skipped)
    assert _other_reference(Options(), coarser) == (
        f"warning: errors are against 'siso-rt 1e6 d3', since '{finest}' was not measured: no answer, "
        "or name one that fits with --reference"
    )
    assert _other_reference(Options(), report()) == ""
    assert _other_reference(Options(reference="siso-rt 1e6 d3"), coarser) == ""


def test_the_text_says_what_was_not_measured_and_why() -> None:
    text = markdown(report())
    assert "- mimo-rt 64×8, mimo-rt 0.1°: no time" in text
    assert "- siso-rt 1e5: 2 of 3 scenes." in text


@pytest.mark.parametrize(
    ("value", "text"), [(None, "–"), (0.0, "0"), (0.01234, "0.012"), (3.456, "3.46"), (12345.6, "12346")]
)
def test_figures_have_three_digits(value: float | None, text: str) -> None:
    assert significant(value) == text


def test_levels_have_a_minus_sign() -> None:
    assert level(-3.14) == "−3.1"
    assert level(None) == "–"


def test_the_front_goes_down_from_the_fastest() -> None:
    """(3, 8) is slower and farther off than (2, 5)."""
    points = [(2.0, 5.0), (1.0, 9.0), (3.0, 8.0), (4.0, 1.0)]
    assert pareto_front(points) == [(1, 9), (2, 9), (2, 5), (4, 5), (4, 1)]


def test_a_label_may_stand_all_around_its_point() -> None:
    found = list(spots(100.0, 50.0, 40.0, 10.0, 1.0))
    assert min(spot.box.left for spot in found) < 30 < 170 < max(spot.box.right for spot in found)
    point = Box(99.0, 49.0, 101.0, 51.0)
    assert all(spot.box.overlap(point) == 0 for spot in found)


def test_labels_of_a_crowd_cover_nothing() -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure
    from matplotlib.text import Text

    axes = Figure(figsize=(8, 6)).subplots()
    points = [(1.0 + 0.02 * i, 1.0 + 0.03 * (i % 3)) for i in range(7)]
    for point in points:
        axes.plot(*point, "o", markersize=8)
    axes.set_xlim(0, 2)
    axes.set_ylim(0, 2)
    place_labels(axes, points, [f"setting number {i}" for i in range(7)])
    axes.figure.canvas.draw()
    renderer = axes.figure.canvas.get_renderer()
    texts = [text for text in axes.texts if text.get_text()]
    # Of the text alone: that of an annotation has its line in it.
    boxes = [Box(*Text.get_window_extent(text, renderer).extents) for text in texts]
    assert len(boxes) == 7
    assert not any(a.overlap(b) for i, a in enumerate(boxes) for b in boxes[i + 1 :])
    pixels = [axes.transData.transform(point) for point in points]
    assert not any(box.overlap(Box(x - 1, y - 1, x + 1, y + 1)) for box in boxes for x, y in pixels)


def test_pictures_are_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    for draw, name in ((draw_pareto, "pareto.png"), (draw_convergence, "convergence.png")):
        assert draw(report(), tmp_path / name).stat().st_size > 5000
