"""Pages of the reference, generated from the code before Sphinx reads the sources.

Each page is written below ``docs/reference`` only where its text changed, so that a second build renders
what is new alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from . import api, commands, frame_path, scenario_keys


def generate(root: Path) -> None:
    """Write every generated page below the checkout ``root``, and remove pages of modules that are gone."""
    reference = root / "docs" / "reference"
    _replace(reference / "api", dict(api.pages()))
    _replace(reference / "commands", dict(commands.pages()))
    _replace(reference / "scenario", dict(scenario_keys.pages()))
    _replace(reference / "frame-path", dict(frame_path.pages()))


def _replace(folder: Path, pages: Mapping[str, str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for file in folder.iterdir():
        if file.name not in pages:
            file.unlink()
    for name, text in pages.items():
        file = folder / name
        # Sphinx renders anew what has another time of change, whatever its content is.
        if not file.exists() or file.read_text("utf-8") != text:
            file.write_text(text, encoding="utf-8")
