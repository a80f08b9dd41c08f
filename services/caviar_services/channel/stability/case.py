"""What a case is, how answers are compared, and the list of all cases."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np

from caviar_protocol.errors import CaviarError
from caviar_services.channel.stability.bench import Bench


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """What a case found."""

    expected: str
    """From a formula, or the class of the error that is the documented answer."""
    got: str
    right: bool


@dataclass(frozen=True, kw_only=True)
class Case:
    """One question with a known answer."""

    group: str
    name: str
    ask: Callable[[Bench], Outcome]
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
"""All cases, in the order of the table."""


def case(group: str, name: str, traced: bool = True) -> Callable[[Ask], Ask]:
    """Put a function among the cases."""

    def register(ask: Ask) -> Ask:
        CASES.append(Case(group=group, name=name, ask=ask, traced=traced))
        return ask

    return register


Ask = Callable[[Bench], Outcome]


def close(
    unit: str, expected: float | complex, got: float | complex, relative: float = 0.0, absolute: float = 0.0
) -> Outcome:
    """Whether a number is as expected, within the larger of two tolerances."""
    limit = max(relative * abs(expected), absolute)
    tolerance = f"± {absolute:.2g}" if absolute >= relative * abs(expected) else f"± {100 * relative:.2g} %"
    return Outcome(
        expected=f"{_number(expected)} {unit} {tolerance}".replace("  ", " "),
        got=f"{_number(got)} {unit}".strip(),
        right=bool(np.isfinite(got) and abs(got - expected) <= limit),
    )


def equal(expected: object, got: object, what: str = "") -> Outcome:
    """Whether two things are the same."""
    return Outcome(
        expected=f"{expected} {what}".strip(), got=f"{got} {what}".strip(), right=bool(expected == got)
    )


def refused(error: type[CaviarError], words: str, call: Callable[[], object]) -> Outcome:
    """Whether a call raises this error, with a text that holds these words."""
    expected = f"{error.__name__}: … {words} …"
    try:
        answer = call()
    except CaviarError as raised:
        right = type(raised) is error and words in str(raised)
        return Outcome(expected=expected, got=f"{type(raised).__name__}: {raised}", right=right)
    return Outcome(expected=expected, got=f"no error, {type(answer).__name__}", right=False)


def all_of(*outcomes: Outcome) -> Outcome:
    """Several answers to one question."""
    return Outcome(
        expected="; ".join(o.expected for o in outcomes),
        got="; ".join(o.got for o in outcomes),
        right=all(o.right for o in outcomes),
    )


def worst(errors: Sequence[float], limit: float, unit: str, what: str) -> Outcome:
    """Whether all of many errors are within a limit."""
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
