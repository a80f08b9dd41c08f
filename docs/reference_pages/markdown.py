"""Pieces of Markdown that several generators of pages need."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from caviar_protocol import spec


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Lines of a table, and an empty one after it."""
    yield from (spec.table(head, rows), "")


def toctree(names: Iterable[str], *options: str) -> Iterator[str]:
    """Lines of a table of contents, and an empty one after it."""
    yield from ("```{toctree}", *options, "", *names, "```", "")
