"""Triangles, errors and processor times of scenes that are simplified within errors of received power.

    python tests/bench/bench_simplify.py [--scenario SCENARIO …] [--error-db DB …] [--markdown FILE]

Each scenario is simplified for each error as ``caviar scene simplify`` does; errors are those at positions
that did not choose what is left out. A scenario that is a file is called by its stem.
"""

# ruff: noqa: T201 - what it measures is printed

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from caviar_scenes.simplification import Simplified, simplify

HEAD = (
    "| scenario and error | triangles | left | median dB | 90 % dB | largest dB | CPU ms | CPU ms left |\n"
    "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |\n"
)


def row(found: Simplified) -> str:
    error, (triangles, left), (before, after) = found.held_out, found.triangles, found.frame_ms
    largest = f"{error.max_db:.2f}" if error.max_db < 1e3 else "lost"
    name = f"{Path(found.scenario).stem}, {found.error_db:g} dB"
    errors = f"{error.median_db:.3f} | {error.p90_db:.3f} | {largest}"
    return f"| {name} | {triangles} | {left} | {errors} | {before:.0f} | {after:.0f} |\n"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scenario", nargs="+", default=["uav-munich"])
    parser.add_argument("--error-db", nargs="+", type=float, default=[0.1, 0.5, 2.0])
    parser.add_argument("--positions", type=int, default=100)
    parser.add_argument("--markdown", type=Path, help="where the figures go as a table")
    options = parser.parse_args()
    text = HEAD
    for scenario in options.scenario:
        for error_db in options.error_db:
            with tempfile.TemporaryDirectory() as folder:
                found = simplify(scenario, error_db, Path(folder) / "scene", options.positions)
            text += row(found)
            print(row(found), end="", flush=True)
            for tried in found.tried:
                print("  ", *tried, flush=True)
    if options.markdown:
        options.markdown.write_text(text, "utf-8")


if __name__ == "__main__":
    main()
