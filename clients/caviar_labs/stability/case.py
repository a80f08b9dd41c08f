"""Cases of `caviar measure stability`: definition, comparison of answers, list, running and reporting."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from caviar_labs.stability.lab import Lab
from caviar_protocol.errors import CaviarError
from caviar_protocol.host import has_extra


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """Expected and given answer of a case."""

    expected: str
    """From a formula, or the class of the error that is the documented answer."""
    got: str
    """From a model."""
    right: bool


@dataclass(frozen=True, kw_only=True)
class Case:
    """One question with a known answer."""

    group: str
    name: str
    ask: Callable[[Lab], Outcome]
    traced: bool
    """Whether it needs the ray tracer."""

    @property
    def title(self) -> str:
        return f"{self.group}: {self.name}"


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """A row of the table."""

    group: str
    case: str
    expected: str
    got: str
    verdict: str
    """``right``, ``wrong``, or ``not run`` where the ray tracer that the case needs is not installed."""
    seconds: float


CASES: list[Case] = []
"""All cases of the modules that are imported."""


def case(group: str, name: str, traced: bool = True) -> Callable[[Ask], Ask]:
    """Decorate a function that asks a question, to put it among the cases.

    Args:
        group: One of `GROUPS`.
        name: In the group.
        traced: Whether the case needs the ray tracer.
    """

    def register(ask: Ask) -> Ask:
        CASES.append(Case(group=group, name=name, ask=ask, traced=traced))
        return ask

    return register


Ask = Callable[[Lab], Outcome]


def close(
    unit: str, expected: float | complex, got: float | complex, relative: float = 0.0, absolute: float = 0.0
) -> Outcome:
    """Tell whether a number is as expected, within the larger of two tolerances.

    Args:
        unit: Of the numbers, for the table.
        expected: From a formula.
        got: From a model.
        relative: Tolerance as a part of the expected number.
        absolute: Tolerance in the unit.

    Example:
        >>> close("m", 2.0, 2.01, relative=0.01)
        Outcome(expected='2 m ± 1 %', got='2.01 m', right=True)
    """
    limit = max(relative * abs(expected), absolute)
    tolerance = f"± {absolute:.2g}" if absolute >= relative * abs(expected) else f"± {100 * relative:.2g} %"
    return Outcome(
        expected=f"{_number(expected)} {unit} {tolerance}".replace("  ", " "),
        got=f"{_number(got)} {unit}".strip(),
        right=bool(np.isfinite(got) and abs(got - expected) <= limit),
    )


def equal(expected: object, got: object, what: str = "") -> Outcome:
    """Tell whether two things are the same."""
    return Outcome(
        expected=f"{expected} {what}".strip(), got=f"{got} {what}".strip(), right=bool(expected == got)
    )


def refused(error: type[CaviarError], words: str, call: Callable[[], object]) -> Outcome:
    """Tell whether a call raises an error of exactly this class, with these words in its text."""
    expected = f"{error.__name__}: … {words} …"
    try:
        answer = call()
    except CaviarError as raised:
        right = type(raised) is error and words in str(raised)
        return Outcome(expected=expected, got=f"{type(raised).__name__}: {raised}", right=right)
    return Outcome(expected=expected, got=f"no error, {type(answer).__name__}", right=False)


def all_of(*outcomes: Outcome) -> Outcome:
    """Several answers to one question, all of which have to be right."""
    return Outcome(
        expected="; ".join(o.expected for o in outcomes),
        got="; ".join(o.got for o in outcomes),
        right=all(o.right for o in outcomes),
    )


def worst(errors: Sequence[float], limit: float, unit: str, what: str) -> Outcome:
    """Tell whether all of many errors are within a limit.

    Args:
        errors: Without a sign; none or a NaN among them is wrong.
        limit: That none may exceed.
        unit: Of both.
        what: Has these errors, for the table.
    """
    largest = float(np.max(errors)) if len(errors) else float("nan")
    return Outcome(
        expected=f"{what}: error ≤ {limit:.2g} {unit}".strip(),
        got=f"at most {largest:.2g} {unit} in {len(errors)}",
        right=bool(largest <= limit),
    )


def _number(value: float | complex) -> str:
    if isinstance(value, complex):
        return f"{value.real:.6g}{value.imag:+.6g}j"
    return f"{value:.9g}"


EXTRA = "channel"
"""Extra of the distribution that brings the ray tracer."""

MODULES = ("waves", "limits", "motion")
"""Modules with cases."""

GROUPS = (
    "frequency",
    "distance",
    "grazing",
    "material",
    "foliage",
    "place",
    "mesh",
    "paths",
    "array",
    "input",
    "speed",
    "jump",
    "flush",
    "edge",
)
"""Groups in the order of the table."""


def cases() -> Sequence[Case]:
    """All cases, group by group."""
    for module in MODULES:
        import_module(f"caviar_labs.stability.{module}")
    return tuple(sorted(CASES, key=lambda known: GROUPS.index(known.group)))


def run(chosen: Sequence[Case], progress: Callable[[int, Case], None] | None = None) -> list[Result]:
    """Ask the chosen cases, one after the other.

    A case that raises an error of its own is wrong. Cases that trace are ``not run`` where the ray tracer is
    not
    installed: that says nothing about physics.

    Args:
        chosen: Of `cases`.
        progress: Called with number and case before each case that runs.
    """
    has_tracer = has_extra(EXTRA)
    results: list[Result] = []
    with TemporaryDirectory(prefix="caviar-stability-") as folder:
        lab = Lab(Path(folder))
        for number, case in enumerate(chosen):
            if case.traced and not has_tracer:
                results.append(_not_run(case))
                continue
            if progress is not None:
                progress(number, case)
            begin = time.perf_counter()
            outcome = _asked(case, lab)
            results.append(
                Result(
                    group=case.group,
                    case=case.name,
                    expected=outcome.expected,
                    got=outcome.got.replace(f"{folder}/", "…/"),
                    verdict="right" if outcome.right else "wrong",
                    seconds=round(time.perf_counter() - begin, 3),
                )
            )
    return results


def _not_run(case: Case) -> Result:
    return Result(
        group=case.group,
        case=case.name,
        expected="an answer of the ray tracer",
        got=f"needs the extra {EXTRA!r}",
        verdict="not run",
        seconds=0.0,
    )


def _asked(case: Case, lab: Lab) -> Outcome:
    try:
        with np.errstate(all="ignore"):
            return case.ask(lab)
    except Exception as error:  # whatever goes wrong in a case is its answer
        return Outcome(expected="an answer", got=f"{type(error).__name__}: {error}", right=False)


def wrong(results: Sequence[Result]) -> list[Result]:
    """Results with another answer than expected."""
    return [result for result in results if result.verdict == "wrong"]


def markdown(results: Sequence[Result]) -> str:
    """The table for the documentation."""
    lines = ["| Case | Expected | Got | Verdict |", "|---|---|---|---|"]
    for result in results:
        cells = (f"{result.group}: {result.case}", result.expected, result.got, result.verdict)
        lines.append("| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |")
    return "\n".join(lines) + "\n"
