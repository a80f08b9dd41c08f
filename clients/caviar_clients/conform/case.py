"""Cases of the conformance kit (a scripted exchange that ends in a verdict), and reports of verdicts."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import msgspec

if TYPE_CHECKING:
    from caviar_clients.conform import Kit


Outcome = Literal["pass", "fail", "not applicable"]


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """How a client did in one case.

    Args:
        case: Name of the case.
        title: What it shows, in a sentence.
        clauses: Clauses and sections of protocol/SPEC.md that say so.
        outcome: ``pass``, ``fail`` or ``not applicable``.
        expected: What should have come.
        got: What came.
        seconds: Time that the case took [s].
    """

    case: str
    title: str
    clauses: str
    outcome: Outcome
    expected: str
    got: str
    seconds: float


class Failed(Exception):  # noqa: N818 - a verdict, not an error of this program
    """The client did something else than it should.

    Args:
        expected: What should have come, as a phrase.
        got: What came, as a phrase.
    """

    def __init__(self, expected: str, got: str) -> None:
        super().__init__(f"expected {expected}; got {got}")
        self.expected, self.got = expected, got


class NotApplicable(Exception):  # noqa: N818 - a verdict, not an error of this program
    """The case does not concern this client; the text says why."""


@dataclass(frozen=True)
class Case:
    """One case; ``run`` returns what came, or raises `Failed` or `NotApplicable`."""

    name: str
    clauses: str
    expected: str
    run: Callable[[Kit], str]

    @property
    def title(self) -> str:
        """First line of the script's docstring."""
        return (self.run.__doc__ or self.name).partition("\n")[0].rstrip(".")


def case(name: str, clauses: str, expected: str) -> Callable[[Callable[[Kit], str]], Case]:
    """Make a case of a script that plays the broker.

    Args:
        name: Name for ``--case``.
        clauses: Clauses and sections of protocol/SPEC.md that it is about.
        expected: What should come, for the verdict.

    Example:
        >>> def hello_again(kit):
        ...     'HELLO comes first.'
        ...     return kit.at(0).hello["name"]
        >>> case("hello-again", "clause 3", "HELLO")(hello_again).title
        'HELLO comes first'
    """
    return lambda run: Case(name, clauses, expected, run)


# Numbers and digests differ from case to case where the cause is the same.
_NUMBER = re.compile(r"\b[0-9a-f]{64}\b|\d+")
OUTCOMES: tuple[Outcome, ...] = ("pass", "fail", "not applicable")


def summary(verdicts: Sequence[Verdict]) -> str:
    """Count the outcomes in one line.

    Example:
        >>> summary([])
        '0 passed, 0 failed, 0 not applicable, in 0.0 s'
    """
    counts = Counter(verdict.outcome for verdict in verdicts)
    seconds = sum(verdict.seconds for verdict in verdicts)
    words = [f"{counts[o]} {'failed' if o == 'fail' else 'passed' if o == 'pass' else o}" for o in OUTCOMES]
    return f"{', '.join(words)}, in {seconds:.1f} s"


def repeated(verdicts: Sequence[Verdict]) -> list[str]:
    """Make a line for each group of cases that failed with the same words: they may have one cause.

    Args:
        verdicts: Verdicts of a run.

    Returns:
        A line for each group of two or more, the largest first.
    """
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
    """Write verdicts as a JSON object with ``verdicts`` and the number of each outcome.

    Example:
        >>> import json
        >>> json.loads(as_json([]))
        {'pass': 0, 'fail': 0, 'not applicable': 0, 'verdicts': []}
    """
    counts = Counter(verdict.outcome for verdict in verdicts)
    content: dict[str, object] = {outcome: counts[outcome] for outcome in OUTCOMES}
    content["verdicts"] = list(verdicts)
    return msgspec.json.format(msgspec.json.encode(content), indent=2).decode() + "\n"


def as_markdown(verdicts: Sequence[Verdict]) -> str:
    """Write verdicts as a Markdown table, with what failed alike and the summary below."""
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
