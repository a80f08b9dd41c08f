"""What a case is: a scripted exchange, tied to clauses, that ends in a verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import msgspec

if TYPE_CHECKING:
    from caviar_clients.conform.kit import Kit

Outcome = Literal["pass", "fail", "not applicable"]


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """How a client did in one case."""

    case: str
    title: str
    clauses: str
    """Where protocol/SPEC.md says so."""
    outcome: Outcome
    expected: str
    got: str
    seconds: float
    """[s] that the case took."""


class Failed(Exception):  # noqa: N818 - a verdict, not an error of this program
    """The client did something else than it should.

    Parameters
    ----------
    expected, got
        What should have come and what came, each as a phrase.
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
    """Make a case of a script."""
    return lambda run: Case(name, clauses, expected, run)
