"""Measured figures of the documentation: one file holds them, and pages show what is in it.

`docs/figures.json` has a table by name, each with the command that measured it, the date, the commit and the
machine. A page shows a table, or some of its columns, between two comments::

    <!-- table: keyframes | setting; time ms; NMSE dB -->
    <!-- end -->

and a single figure, by table, row and column, within a sentence::

    about <!-- figure: keyframes | siso-rt 1e5 d3, keyframes every 2 | NMSE dB -->−7.4<!-- end --> dB

``python docs/figures.py measure [NAME …]`` runs the commands that tables come from, and takes these over: in
a short form of minutes, or in the long one with ``--full``. ``python docs/figures.py record NAME FILE`` takes
over a single table from the Markdown that a command wrote (``caviar measure stability --markdown``,
``tests/bench``), and ``python docs/figures.py render`` writes into all pages what the file says. A test
compares pages and file.
"""

from __future__ import annotations

import argparse
import difflib
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple, TypedDict

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ROOT / "docs" / "figures.json"
FOLDERS = ("docs", "protocol", "broker", "services", "clients", "deploy", "examples")
"""Where pages are, beside the root."""
CODE = ("protocol/*.py", "broker/*.py", "services/*.py", "clients/*.py", "deploy/*.toml", "tests/bench/*.py")
"""What figures depend on."""

_BENCH, _CAVIAR = "python tests/bench/bench_enumerated.py", "caviar measure tradeoff street-canyon"
_BASE = "'siso-rt enumerated d3'"
_STATED = "python tests/bench/bench_stated_errors.py"
_BROKER = "python tests/bench/bench_broker.py --services 2 4 8 --kinds bare broker --transport tcp ipc"
_DIFFUSE, _FOLLOW = "python tests/bench/bench_diffuse.py", "python tests/bench/bench_follow.py"


class Measurement(NamedTuple):
    """A command that writes tables."""

    short: str
    """Takes some minutes; ``{out}`` is where it writes."""
    full: str
    file: str
    """That the tables are in, below ``{out}``."""
    tables: Mapping[str, str]
    """By name, a part of the heading above each."""


MEASUREMENTS: Mapping[str, Measurement] = {
    "beams": Measurement(
        "caviar paper beams --quick --out {out}",
        "caviar paper beams --out {out}",
        "beams.md",
        {
            "beams": "Beam selection, held-out",
            "beams-other": "Beam selection, another city",
            "beams-kinds": "line of sight, held-out",
            "beams-worth": "sensors are worth, held-out",
            "beams-worth-other": "sensors are worth, another city",
        },
    ),
    "broker": Measurement(
        f"{_BROKER} --rounds 3 --markdown {{out}}/broker.md",
        f"{_BROKER} --markdown {{out}}/broker.md",
        "broker.md",
        {"broker-transports": ""},
    ),
    "crowd": Measurement(
        "python tests/bench/bench_crowd.py --frames 3 --markdown {out}/crowd.md",
        "python tests/bench/bench_crowd.py --markdown {out}/crowd.md",
        "crowd.md",
        {"crowd": ""},
    ),
    "datasets": Measurement(
        "python tests/bench/bench_datasets.py --seconds 20 --markdown {out}/datasets.md",
        "python tests/bench/bench_datasets.py --markdown {out}/datasets.md",
        "datasets.md",
        {"dataset-costs": "Cost of scenes", "dataset-workers": "Scenes a second"},
    ),
    "detail": Measurement(
        "python tests/bench/bench_detail.py --frames 10 --rounds 1 --markdown {out}/detail.md",
        "python tests/bench/bench_detail.py --markdown {out}/detail.md",
        "detail.md",
        {"mesh-detail": ""},
    ),
    "devices": Measurement(
        "python tests/bench/bench_devices.py --frames 12 --markdown {out}/devices.md",
        "python tests/bench/bench_devices.py --frames 50 --rounds 3 --markdown {out}/devices.md",
        "devices.md",
        {"devices": ""},
    ),
    "diffuse": Measurement(
        f"{_DIFFUSE} --paths 300 500 0 --scenes 10 --markdown {{out}}/diffuse.md",
        f"{_DIFFUSE} --paths 300 500 0 --markdown {{out}}/diffuse.md",
        "diffuse.md",
        {"diffuse-paths": ""},
    ),
    "enumerated": Measurement(
        f"{_BENCH} --scene street-canyon uav munich --frames 4 --rays 500000 --launches 2 --own-rays 500000 "
        "--own-launches 2 --markdown {out}/enumerated.md",
        f"{_BENCH} --scene street-canyon uav munich --own-launches 6 --markdown {{out}}/enumerated.md",
        "enumerated.md",
        {"enumerated": ""},
    ),
    "fig8": Measurement(
        "caviar paper fig8 --seeds 1 --out {out}",
        "caviar paper fig8 --out {out}",
        "fig8.md",
        {
            "fig8-geometric": "drawn in each frame",
            "fig8-quasi-static": "drawn once an episode",
            "fig8-munich": "Munich",
            "fig8-worst-seed": "worst seed",
        },
    ),
    "engine-worlds": Measurement(
        "python tests/bench/bench_engine_worlds.py --rounds 1 --markdown {out}/engines.md",
        "python tests/bench/bench_engine_worlds.py --markdown {out}/engines.md",
        "engines.md",
        {"engine-worlds": ""},
    ),
    "follow": Measurement(
        f"{_FOLLOW} --frames 60 --markdown {{out}}/follow.md",
        f"{_FOLLOW} --markdown {{out}}/follow.md",
        "follow.md",
        {"followed-rays": ""},
    ),
    "human-blockage": Measurement(
        "python tests/bench/bench_human_blockage.py --markdown {out}/human-blockage.md",
        "python tests/bench/bench_human_blockage.py --markdown {out}/human-blockage.md",
        "human-blockage.md",
        {"human-blockage": ""},
    ),
    "keyframes": Measurement(
        f"{_CAVIAR} --part keyframes --baseline {_BASE} --reference {_BASE} --minutes 3 --out {{out}}",
        f"{_CAVIAR} --part keyframes --baseline {_BASE} --reference {_BASE} --minutes 13 --out {{out}}",
        "tradeoff.md",
        {"tradeoff-keyframes": "keyframes"},
    ),
    "learner": Measurement(
        "python tests/bench/bench_learner.py district --frames 60 --seeds 2 --markdown {out}/learner.md",
        "python tests/bench/bench_learner.py district --frames 200 --markdown {out}/learner.md",
        "learner.md",
        {"learner": ""},
    ),
    "panda3d": Measurement(
        "python tests/bench/bench_panda3d.py --frames 60 --wall --markdown {out}/panda3d.md",
        "python tests/bench/bench_panda3d.py --wall --markdown {out}/panda3d.md",
        "panda3d.md",
        {"panda3d-frames": ""},
    ),
    "pizza": Measurement(
        "caviar paper pizza --quick --out {out}",
        "caviar paper pizza --out {out}",
        "pizza.md",
        {"pizza-pairs": "Pairs of agents", "pizza-ratios": "The trained pair over the baseline"},
    ),
    "processes": Measurement(
        "python tests/bench/bench_processes.py street-canyon --markdown {out}/processes.md",
        "python tests/bench/bench_processes.py street-canyon --frames 400 --markdown {out}/processes.md",
        "processes.md",
        {"processes": ""},
    ),
    "quadrotor": Measurement(
        "python tests/bench/bench_quadrotor.py --rounds 2 --markdown {out}/quadrotor.md",
        "python tests/bench/bench_quadrotor.py --markdown {out}/quadrotor.md",
        "quadrotor.md",
        {"quadrotor-frames": ""},
    ),
    "shared-memory": Measurement(
        "python tests/bench/bench_shared_memory.py --repeat 1 --markdown {out}/shared-memory.md",
        "python tests/bench/bench_shared_memory.py --markdown {out}/shared-memory.md",
        "shared-memory.md",
        {"shared-memory": ""},
    ),
    "simplify": Measurement(
        "python tests/bench/bench_simplify.py --positions 40 --markdown {out}/simplify.md",
        "python tests/bench/bench_simplify.py --markdown {out}/simplify.md",
        "simplify.md",
        {"simplify": ""},
    ),
    "stability": Measurement(
        "caviar measure stability --markdown {out}/stability.md",
        "caviar measure stability --markdown {out}/stability.md",
        "stability.md",
        {"stability": ""},
    ),
    "stated-errors-canyon": Measurement(
        f"{_STATED} --seeds 3 --frames 30 --out {{out}}/canyon.md",
        f"{_STATED} --rungs 1e4,1e5,d1,d2 --frames 40 --out {{out}}/canyon.md",
        "canyon.md",
        {"stated-errors-canyon": ""},
    ),
    "stated-errors-munich": Measurement(
        f"{_STATED} --scene munich --seeds 3 --frames 20 --out {{out}}/munich.md",
        f"{_STATED} --scene munich --frames 40 --out {{out}}/munich.md",
        "munich.md",
        {"stated-errors-munich": ""},
    ),
    "tradeoff": Measurement(
        f"{_CAVIAR} --part ladder --minutes 5 --out {{out}}",
        f"{_CAVIAR} --part ladder --part spacing --part arrays --part convergence --minutes 13 --out {{out}}",
        "tradeoff.md",
        {
            "tradeoff-ladder": "The ladder",
            "tradeoff-spacing": "Ray spacing",
            "tradeoff-arrays": "Elements of the arrays",
            "tradeoff-convergence": "Convergence",
        },
    ),
    "cell": Measurement(
        "python tests/bench/bench_cell.py --nr --selective --frames 200 --markdown {out}/cell.md",
        "python tests/bench/bench_cell.py --nr --selective --frames 1000 --markdown {out}/cell.md",
        "cell.md",
        {"cell-times": "Times"},
    ),
    "policy": Measurement(
        "python tests/bench/bench_policy.py --rounds 1 --markdown {out}/policy.md",
        "python tests/bench/bench_policy.py --markdown {out}/policy.md",
        "policy.md",
        {"policy-times": ""},
    ),
    "wideband": Measurement(
        "python tests/bench/bench_wideband.py --sionna --frames 5 --markdown {out}/wideband.md",
        "python tests/bench/bench_wideband.py --sionna --markdown {out}/wideband.md",
        "wideband.md",
        {"wideband-times": "Times", "wideband-sionna": "Sionna RT"},
    ),
}
"""What tables come from, by the name that ``measure`` takes."""

_TABLE = re.compile(
    r"^(?P<indent> *)(?P<begin><!-- table: (?P<what>.*?) -->\n).*?(?P<end><!-- end -->)$",
    re.DOTALL | re.MULTILINE,
)
_FIGURE = re.compile(r"(?P<begin><!-- figure: (?P<what>.*?) -->)[^<\n]*(?P<end><!-- end -->)")


class Table(TypedDict):
    """One measured table."""

    command: str
    date: str
    commit: str
    """Of the code that was measured."""
    machine: str
    columns: list[str]
    rows: list[list[str]]
    """Cells as they are shown; the first of a row is its name."""


class FigureError(Exception):
    """A page asks for a figure that is not there, or a file has no such table."""


def load() -> dict[str, Table]:
    """All figures."""
    tables: dict[str, Table] = json.loads(FIGURES.read_text(encoding="utf-8"))
    return tables


def save(tables: Mapping[str, Table]) -> None:
    """Write all figures, sorted by name."""
    text = json.dumps(dict(sorted(tables.items())), indent=1, ensure_ascii=False)
    # A row a line: a new measurement then is a change that can be read.
    text = re.sub(r"\[\n\s+(\"[^\]]*?\")\n\s+\]", lambda m: "[" + re.sub(r"\n\s+", " ", m[1]) + "]", text)
    FIGURES.write_text(text + "\n", encoding="utf-8")


# --- pages --------------------------------------------------------------------------------------


def pages() -> Iterator[Path]:
    """All pages of the documentation."""
    yield from sorted(ROOT.glob("*.md"))
    for folder in FOLDERS:
        yield from sorted((ROOT / folder).rglob("*.md"))


def rendered(text: str, tables: Mapping[str, Table]) -> str:
    """A page with the figures of the file in their places. Raises `FigureError` for one that is not there."""

    def table(found: re.Match[str]) -> str:
        indent, body = found["indent"], _as_markdown(found["what"], tables)
        lines = [indent + line if line else "" for line in body.split("\n")]
        return "".join([indent, found["begin"], "\n".join(lines), indent, found["end"]])

    def figure(found: re.Match[str]) -> str:
        return found["begin"] + _cell(found["what"], tables) + found["end"]

    return _FIGURE.sub(figure, _TABLE.sub(table, text))


def _as_markdown(what: str, tables: Mapping[str, Table]) -> str:
    name, _, chosen = (part.strip() for part in what.partition("|"))
    table = _known(name, tables, "table")
    places = list(range(len(table["columns"])))
    if chosen:
        places = [_column(name, column.strip(), table) for column in chosen.split(";")]
    numbers = [sum(bool(re.match(r"[−–\d]", row[i])) for row in table["rows"]) for i in places]
    lines = [
        [table["columns"][i] for i in places],
        ["---:" if at and 2 * count > len(table["rows"]) else "---" for at, count in enumerate(numbers)],
        *([row[i] for i in places] for row in table["rows"]),
    ]
    body = "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
    source = f"*`{table['command']}`, {table['date']}, commit {table['commit']}, on {table['machine']}.*"
    return f"\n{body}\n\n{source}\n\n"


def _cell(what: str, tables: Mapping[str, Table]) -> str:
    name, row, column = (part.strip() for part in what.split("|"))
    table = _known(name, tables, "table")
    cells = _known(row, {r[0]: r for r in table["rows"]}, f"row of {name}")
    return cells[_column(name, column, table)]


def _column(name: str, column: str, table: Table) -> int:
    if table["columns"].count(column) > 1:
        raise FigureError(f"{name} has {column!r} more than once; show the whole table")
    return _known(column, {c: i for i, c in enumerate(table["columns"])}, f"column of {name}")


def _known(name: str, among: Mapping[str, Any], what: str) -> Any:
    if name not in among:
        near = difflib.get_close_matches(name, among, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(among)}"
        raise FigureError(f"there is no {what} {name!r}; {hint}")
    return among[name]


# --- measurements -------------------------------------------------------------------------------


def markdown_tables(text: str) -> Iterator[tuple[str, list[str], list[list[str]]]]:
    """Each table of a Markdown text: the heading above it, its columns and its rows."""
    heading = ""
    for block in re.split(r"\n\s*\n", text):
        lines = [line.strip() for line in block.strip().splitlines()]
        heading = next((line.lstrip("# ") for line in reversed(lines) if line.startswith("#")), heading)
        rows = [_cells(line) for line in lines if line.startswith("|")]
        if len(rows) > 2 and set("".join(rows[1])) <= set("-: "):
            yield heading, rows[0], rows[2:]


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in re.split(r"(?<!\\)\|", line.strip().strip("|"))]


def record(name: str, file: Path, heading: str, command: str, commit: str, machine: str, date: str) -> None:
    """Take a table over from what a command wrote: the one below this heading, or the only one."""
    found = [table for table in markdown_tables(file.read_text(encoding="utf-8")) if heading in table[0]]
    if len(found) != 1:
        below = f" below a heading with {heading!r}" if heading else ""
        raise FigureError(f"{file} has {len(found)} tables{below}; name one by --heading")
    _, columns, rows = found[0]
    tables = load() if FIGURES.is_file() else {}
    tables[name] = Table(
        command=command, date=date, commit=commit, machine=machine, columns=columns, rows=rows
    )
    save(tables)


def measure(measurement: Measurement, full: bool) -> None:
    """Run a command in its short or full form, and take over the tables that it wrote, as far as there are
    any: a short form leaves some as they are."""
    command = measurement.full if full else measurement.short
    begun = f"{datetime.now(UTC):%Y-%m-%d}"
    with TemporaryDirectory(prefix="caviar-figures-") as folder:
        words = shlex.split(command.format(out=folder))
        beside = Path(sys.executable).with_name(words[0])
        words[0] = str(beside) if beside.exists() else words[0]
        finished = subprocess.run(words, cwd=ROOT, check=False)  # noqa: S603
        if finished.returncode:
            raise FigureError(
                f"{command!r} ended with status {finished.returncode}; its tables stay as they are"
            )
        written = Path(folder) / measurement.file
        headings = [heading for heading, _, _ in markdown_tables(written.read_text(encoding="utf-8"))]
        shown = re.sub(r" --(out|markdown) {out}\S*", "", command)
        for name, heading in measurement.tables.items():
            if any(heading in found for found in headings):
                record(name, written, heading, shown, _commit(), _machine(), begun)


def _commit() -> str:
    """The commit that is checked out, with ``-dirty`` where code differs from it: what another measurement
    wrote into pages changes no figure."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()  # noqa: S603

    changed = git("status", "--porcelain", "--untracked-files=no", "--", *CODE)
    return git("rev-parse", "--short=7", "HEAD") + ("-dirty" if changed else "")


def _machine() -> str:
    from caviar_services.recorder.base import machine

    found = machine()
    return f"{found.get('cpu_count', '?')} cores of {found.get('cpu', '?')}, {found.get('gpu', 'no GPU')}"


def main() -> int:
    """Entry point; status 1 with a line on what is wrong."""
    parser = argparse.ArgumentParser(description="Measured figures of the documentation.")
    commands = parser.add_subparsers(dest="action", required=True)
    commands.add_parser("render", help="write the figures into all pages")
    measuring = commands.add_parser(
        "measure", help="run the commands that tables come from, and take these over"
    )
    measuring.add_argument("name", nargs="*", help=f"of {', '.join(MEASUREMENTS)}; by default all")
    measuring.add_argument("--full", action="store_true", help="the long form of each")
    recording = commands.add_parser("record", help="take a table over from Markdown that a command wrote")
    recording.add_argument("name", help="name of the table")
    recording.add_argument("file", type=Path, help="what the command wrote")
    recording.add_argument("--command", required=True, help="the command, for the reader")
    recording.add_argument("--heading", default="", help="part of the heading above the table")
    recording.add_argument("--commit", help="that was measured; by default the checkout's")
    recording.add_argument("--machine", help="by default this one")
    recording.add_argument("--date", default=f"{datetime.now(UTC):%Y-%m-%d}", help="by default today")
    options = parser.parse_args()
    try:
        if options.action == "measure":
            for name in options.name or MEASUREMENTS:
                measure(_known(name, MEASUREMENTS, "measurement"), options.full)
        if options.action == "record":
            where = (options.commit or _commit(), options.machine or _machine(), options.date)
            record(options.name, options.file, options.heading, options.command, *where)
        tables = load()
        for page in pages():
            text = page.read_text(encoding="utf-8")
            if (new := rendered(text, tables)) != text:
                page.write_text(new, encoding="utf-8")
                sys.stdout.write(f"{page.relative_to(ROOT)}\n")
    except FigureError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
