"""Print the packages that pyproject.toml, beside this file or above it, asks for: a line each.

    python requirements.py [EXTRA] [--without NAME]... [--only NAME]

Without an extra those that every role needs; with one its own.
"""

import argparse
import sys
import tomllib
from pathlib import Path


def main() -> None:
    """Read the command line and pyproject.toml; print."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("extra", nargs="?")
    arguments.add_argument("--without", action="append", default=[], help="all packages but that one")
    arguments.add_argument("--only", default="", help="that package alone")
    asked = arguments.parse_args()
    here = Path(__file__).resolve().parent
    file = next(path for path in (here / "pyproject.toml", here.parent / "pyproject.toml") if path.exists())
    project = tomllib.loads(file.read_text())["project"]
    found = project["optional-dependencies"][asked.extra] if asked.extra else project["dependencies"]
    found = [
        line for line in found if line.startswith(asked.only) and not line.startswith(tuple(asked.without))
    ]
    sys.stdout.write("".join(f"{line}\n" for line in found))


if __name__ == "__main__":
    main()
