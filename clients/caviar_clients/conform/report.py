"""Verdicts as Markdown and JSON."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

import msgspec

from caviar_clients.conform.case import Outcome, Verdict

_NUMBER = re.compile(r"\b[0-9a-f]{64}\b|\d+")
OUTCOMES: tuple[Outcome, ...] = ("pass", "fail", "not applicable")


def summary(verdicts: Sequence[Verdict]) -> str:
    """Counts in one line."""
    counts = Counter(verdict.outcome for verdict in verdicts)
    seconds = sum(verdict.seconds for verdict in verdicts)
    words = [f"{counts[o]} {'failed' if o == 'fail' else 'passed' if o == 'pass' else o}" for o in OUTCOMES]
    return f"{', '.join(words)}, in {seconds:.1f} s"


def repeated(verdicts: Sequence[Verdict]) -> list[str]:
    """A line for cases in which the same came, but for numbers and digests: they may have one cause."""
    causes: dict[str, list[Verdict]] = {}
    for verdict in verdicts:
        if verdict.outcome == "fail":
            causes.setdefault(_NUMBER.sub("…", verdict.got), []).append(verdict)
    return [
        f"{len(alike)} cases failed with the same words ({', '.join(verdict.case for verdict in alike)}), "
        f"maybe for one cause: expected {alike[0].expected}; got {alike[0].got}"
        for alike in sorted(causes.values(), key=len, reverse=True)
        if len(alike) > 1
    ]


def as_json(verdicts: Sequence[Verdict]) -> str:
    """An object with ``verdicts`` and how many of each outcome there are."""
    counts = Counter(verdict.outcome for verdict in verdicts)
    content: dict[str, object] = {outcome: counts[outcome] for outcome in OUTCOMES}
    content["verdicts"] = list(verdicts)
    return msgspec.json.format(msgspec.json.encode(content), indent=2).decode() + "\n"


def as_markdown(verdicts: Sequence[Verdict]) -> str:
    """A table, with what failed alike and the summary below."""
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
    causes = [f"- {line}" for line in repeated(verdicts)]
    return "\n".join([*lines, "", *causes, *([""] if causes else []), summary(verdicts), ""])


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("\\", "\\\\").replace("|", "\\|")
