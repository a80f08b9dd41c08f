"""Measured figures in the documentation come from one file, so that no two pages disagree."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[2]
MEASURED = ("channel.md", "adaptive-fidelity.md", "channel-stability.md", "channel-tradeoff.md")
"""Pages below docs/topics/ whose tables of measurements are all in the file."""


def module() -> ModuleType:
    spec = importlib.util.spec_from_file_location("figures", ROOT / "docs" / "figures.py")
    assert spec is not None
    assert spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


figures = module()

TABLE = {
    "command": "caviar measure",
    "date": "2026-01-02",
    "commit": "abcdef0",
    "machine": "2 cores",
    "columns": ["setting", "time ms", "NMSE dB"],
    "rows": [["a", "1.5", "−7.4"], ["b", "2", "–"]],
}
PAGE = """Text <!-- figure: t | a | NMSE dB -->?<!-- end --> dB, and more.

- item

  <!-- table: t | setting; NMSE dB -->
  <!-- end -->

<!-- table: t -->
old
<!-- end -->
"""


def test_every_page_shows_what_the_file_says() -> None:
    tables = figures.load()
    for page in figures.pages():
        text = page.read_text("utf-8")
        assert figures.rendered(text, tables) == text, f"{page}: run python docs/figures.py render"


def test_every_table_of_the_file_is_shown_and_says_where_it_is_from() -> None:
    shown = "".join(page.read_text("utf-8") for page in figures.pages())
    for name, table in figures.load().items():
        assert f"<!-- table: {name}" in shown, f"no page shows the table {name!r}"
        assert re.fullmatch(r"\d{4}-\d\d-\d\d", table["date"])
        assert re.fullmatch(r"[0-9a-f]{7,}", table["commit"]), (
            f"{name} was measured with changes not committed"
        )
        assert all(table[key] for key in ("command", "machine", "rows"))
        assert {len(row) for row in table["rows"]} == {len(table["columns"])}


@pytest.mark.parametrize("page", MEASURED)
def test_no_measured_table_stands_outside_of_the_file(page: str) -> None:
    """A level in dB, a time or a share in a cell is a measurement."""
    text = re.sub(
        r"<!-- table: .*?<!-- end -->", "", (ROOT / "docs" / "topics" / page).read_text("utf-8"), flags=re.S
    )
    for _, columns, rows in figures.markdown_tables(text):
        measured = [cell for row in rows for cell in row if re.match(r"−?[\d.,]+ (dB|ms|µs|s|%)", cell)]
        assert not measured, f"{page}: the table {columns} has {measured}; python docs/figures.py record"


def test_tables_and_figures_are_put_in_their_places() -> None:
    text = figures.rendered(PAGE, {"t": TABLE})
    assert "Text <!-- figure: t | a | NMSE dB -->−7.4<!-- end --> dB, and more." in text
    assert "  | setting | NMSE dB |\n  | --- | ---: |\n  | a | −7.4 |\n  | b | – |\n" in text
    assert "\n| setting | time ms | NMSE dB |\n| --- | ---: | ---: |\n| a | 1.5 | −7.4 |\n" in text
    assert "*`caviar measure`, 2026-01-02, commit abcdef0, on 2 cores.*" in text
    assert "old" not in text
    assert figures.rendered(text, {"t": TABLE}) == text


@pytest.mark.parametrize(
    ("page", "message"),
    [
        ("<!-- table: tt -->\n<!-- end -->", "no table 'tt'; did you mean 't'"),
        ("<!-- table: t | time -->\n<!-- end -->", "no column of t 'time'; did you mean 'time ms'"),
        ("<!-- figure: t | c | time ms --><!-- end -->", "no row of t 'c'; known: a, b"),
        ("<!-- figure: twice | a | x --><!-- end -->", "twice has 'x' more than once; show the whole table"),
    ],
)
def test_a_figure_that_is_not_there_is_an_error(page: str, message: str) -> None:
    with pytest.raises(figures.FigureError, match=re.escape(message)):
        figures.rendered(page, {"t": TABLE, "twice": TABLE | {"columns": ["setting", "x", "x"]}})


def test_a_table_is_taken_over_from_what_a_command_wrote(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "FIGURES", tmp_path / "figures.json")
    written = tmp_path / "out.md"
    written.write_text(
        "# One\n\n| a | b |\n| --- | ---: |\n| x \\| y | 1 |\n\n## Two\n\n| c |\n|---|\n| z |\n"
    )
    where = ("caviar measure", "abcdef0", "2 cores", "2026-01-02")
    figures.record("one", written, "One", *where)
    figures.record("two", written, "Two", *where)
    tables = figures.load()
    assert tables["one"]["rows"] == [["x \\| y", "1"]]
    assert tables["two"] == {
        "command": "caviar measure", "date": "2026-01-02", "commit": "abcdef0", "machine": "2 cores",
        "columns": ["c"], "rows": [["z"]],
    }  # fmt: skip
    with pytest.raises(figures.FigureError, match="has 2 tables; name one by --heading"):
        figures.record("any", written, "", *where)


def test_measuring_takes_over_the_tables_that_a_command_wrote_and_leaves_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "FIGURES", tmp_path / "figures.json")
    figures.save({"other": TABLE})
    lines = "# Head\\n\\n| a | b |\\n| --- | --- |\\n| {form} | 1 |\\n"
    command = "python -c \"open('{out}/t.md', 'w').write('" + lines + "')\" --out {out}"
    forms = [command.replace("{form}", form) for form in ("brief", "whole")]
    measurement = figures.Measurement(*forms, "t.md", {"one": "Head", "other": "Elsewhere"})
    figures.measure(measurement, full=False)
    assert figures.load()["one"]["rows"] == [["brief", "1"]]
    assert figures.load()["other"] == TABLE
    figures.measure(measurement, full=True)
    assert figures.load()["one"]["rows"] == [["whole", "1"]]
    assert "--out" not in figures.load()["one"]["command"]


def test_a_measurement_that_fails_leaves_the_file_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(figures, "FIGURES", tmp_path / "figures.json")
    figures.save({"one": TABLE})
    failing = figures.Measurement("python -c exit(3)", "", "t.md", {"one": ""})
    with pytest.raises(figures.FigureError, match="ended with status 3"):
        figures.measure(failing, full=False)
    assert figures.load() == {"one": TABLE}
