"""Verdicts as Markdown and JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import msgspec

from caviar_clients.conform.case import Outcome, Verdict

OUTCOMES: tuple[Outcome, ...] = ("pass", "fail", "not applicable")


def summary(verdicts: Sequence[Verdict]) -> str:
    """Counts in one line."""
    counts = Counter(verdict.outcome for verdict in verdicts)
    seconds = sum(verdict.seconds for verdict in verdicts)
    words = [f"{counts[o]} {'failed' if o == 'fail' else 'passed' if o == 'pass' else o}" for o in OUTCOMES]
    return f"{', '.join(words)}, in {seconds:.1f} s"


def as_json(verdicts: Sequence[Verdict]) -> str:
    """An object with ``verdicts`` and how many of each outcome there are."""
    counts = Counter(verdict.outcome for verdict in verdicts)
    content: dict[str, object] = {outcome: counts[outcome] for outcome in OUTCOMES}
    content["verdicts"] = list(verdicts)
    return msgspec.json.format(msgspec.json.encode(content), indent=2).decode() + "\n"


def as_markdown(verdicts: Sequence[Verdict]) -> str:
    """A table, with the summary below."""
    lines = ["| case | clauses | verdict | expected | got |", "| --- | --- | --- | --- | --- |"]
    for verdict in verdicts:
        cells = (
            f"{verdict.case}: {verdict.title}",
            verdict.clauses,
            verdict.outcome,
            verdict.expected,
            verdict.got,
        )
        lines.append("| " + " | ".join(map(_cell, cells)) + " |")
    return "\n".join([*lines, "", summary(verdicts), ""])


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("\\", "\\\\").replace("|", "\\|")
