"""Formats of other programs, in which ``caviar dataset export`` writes a dataset."""

from __future__ import annotations

import shutil
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path

from caviar_clients.datasets.reader import Dataset
from caviar_clients.files import writing
from caviar_protocol.errors import RunError, suggestion
from caviar_protocol.plugins import plugin_class, plugins

FORMAT_PLUGINS = "caviar.formats"
"""Group of entry points, each a subclass of `Format`, named as the format is."""


class Format(ABC):
    """A format of datasets. It reads what `caviar.dataset` gives, and decodes nothing of the wire itself."""

    @abstractmethod
    def write(self, dataset: Dataset, folder: Path) -> None:
        """Write a dataset.

        Args:
            dataset: Opened.
            folder: An empty one; what stands in it when this returns is the export.

        Raises:
            RunError: The dataset lacks what the format needs; names what to record.
        """


FORMATS: Mapping[str, type[Format]] = {}
"""Formats that come with this distribution, by name."""


def format_of(name: str) -> Format:
    """The format of a name.

    Args:
        name: Of the format, of `FORMATS` or of a plug-in.

    Raises:
        RunError: There is none of this name; names those there are.
        DeclarationError: A plug-in cannot be loaded, or is no `Format`.
    """
    cls = FORMATS.get(name) or plugin_class(FORMAT_PLUGINS, name, Format)  # type: ignore[type-abstract]  # compared, never made
    if cls is None:
        known = [*FORMATS, *plugins(FORMAT_PLUGINS)]
        hint = suggestion(name, known) if known else "no installed package adds one"
        raise RunError(f"--to {name!r} is no format of datasets; {hint}")
    return cls()


def export_dataset(dataset: Dataset, to: Format, out: Path) -> None:
    """Write a dataset in a format, whole or not at all.

    Args:
        dataset: Opened.
        to: The format.
        out: Folder that is made; it may be there, and empty.

    Raises:
        RunError: The folder holds something, or cannot be written; or as of `Format.write`.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RunError(f"{out} is there and not empty; choose another folder with --out")
    part = out.with_name(f"{out.name}.part")
    with writing(part):
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir()
        try:
            to.write(dataset, part)
            part.replace(out)
        finally:
            shutil.rmtree(part, ignore_errors=True)
