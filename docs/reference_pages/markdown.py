"""Pieces of Markdown that several generators of pages need."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Iterator


def prose(text: str) -> str:
    """Docstring markup as Markdown."""
    return re.sub(r"``([^`]+)``", r"`\1`", inspect.cleandoc(text))


def one_line(text: str) -> str:
    """A text as the cell of a table."""
    return " ".join(prose(text).split()).replace("|", "\\|")


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    """Lines of a table, and an empty one behind it."""
    columns = list(head)
    for cells in (columns, ["---"] * len(columns), *rows):
        yield "| " + " | ".join(one_line(cell) for cell in cells) + " |"
    yield ""


def toctree(names: Iterable[str], *options: str) -> Iterator[str]:
    """Lines of a table of contents, and an empty one behind it."""
    yield from ("```{toctree}", *options, "", *names, "```", "")
