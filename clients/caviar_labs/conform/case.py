"""Cases (scripted exchanges that end in a verdict), the `Kit` that plays them, and reports of verdicts."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import msgspec

from caviar_labs.conform.client import Client, Failed, NotApplicable, Rules, Wire
from caviar_labs.conform.session import CONNECTING, JOINED, PATIENCE, READY, Seen, Session
from caviar_protocol.errors import RunError

Outcome = Literal["pass", "fail", "not applicable"]


class Verdict(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of one case for a client.

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


LONGEST = 600
"""Characters of what came, in a verdict: a client's texts may have any length."""
HOPELESS_AFTER = 2
"""Lives in a row that may fail to get as far as a case needs, before all other cases fail without a try."""


OF_OBSERVERS = frozenset({"hello", "observe", "other-major", "refused", "canonical"})
"""Cases that an observer is judged by; all others are of services."""


def not_of_observers(kit: Kit) -> str:
    """A case does not apply to an observer."""
    raise NotApplicable("an observer is no service")


class Kit:
    """Access of a case to the client: its present life, or a new one.

    Args:
        wire: Socket that the client comes to.
        client: Starts it.
        rules: What the user states about it.
    """

    def __init__(self, wire: Wire, client: Client, rules: Rules) -> None:
        self.rules = rules
        self.seen = Seen()
        self._wire, self._client = wire, client
        self._session: Session | None = None
        # Why lives did not get as far as a case needed, since the last one that did.
        self._unborn: list[str] = []
        # Whether any life has sent anything: until then a status other than 0 is the command's own fault.
        self._heard = False

    # --- for the cases -----------------------------------------------------------------------------

    def at(self, stage: int) -> Session:
        """Return a session in this stage: the present one where it has not passed it, else a new life.

        Args:
            stage: `CONNECTING`, `JOINED`, `READY` or `ACTIVE`.

        Raises:
            Failed: The client does not get there.
        """
        # A life goes on from case to case as long as it can: starting the client takes most of the time.
        session = self._session
        if session is None or session.stage > stage or session.client.ended() is not None:
            session = self.fresh()
        try:
            if session.stage == CONNECTING and stage > CONNECTING:
                session.welcome()
            if session.stage == JOINED and stage > JOINED:
                session.prepare()
            if session.stage == READY and stage > READY:
                session.reset(0)
        except Failed as failed:
            # Once more from the start for the next case: this failure may be that case's own business.
            self._unborn.append(str(failed))
            raise
        self._unborn.clear()
        return session

    def fresh(self) -> Session:
        """End the present life and return a new one, which has said HELLO."""
        self.discard()
        if len(self._unborn) >= HOPELESS_AFTER:
            raise Failed("a client that gets as far as this case", f"none: {self._unborn[-1]}")
        self._session = Session(self._wire, self._client, self.rules, self.seen)
        try:
            self._session.begin()
        except Failed as failed:
            self._check_command(self._session)
            # No HELLO is hopeless at once: each further try would wait `START_S` for it.
            self._unborn += [str(failed)] * HOPELESS_AFTER
            raise
        self._heard = True
        return self._session

    def _check_command(self, session: Session) -> None:
        """Raise `RunError` where the command fails by itself: no life of the client has sent anything."""
        self._heard = self._heard or session.heard
        end = self._client.ended()
        if not self._heard and end is not None and end.status:
            raise RunError(f"the client did not connect: {end}; see --command")

    def discard(self) -> None:
        """End the present life."""
        if self._session is not None:
            session, self._session = self._session, None
            session.close()

    # --- the run -----------------------------------------------------------------------------------

    def judge(self, case: Case) -> Verdict:
        """Play one case; a client that goes wrong fails it, and only the kit's own errors are raised."""
        started = time.monotonic()
        if self.rules.role == "observer" and case.name not in OF_OBSERVERS:
            case = replace(case, run=not_of_observers)
        self.seen.allow(PATIENCE * self.rules.timeout_s)
        expected = case.expected
        outcome: Outcome = "pass"
        try:
            got = case.run(self)
        except NotApplicable as reason:
            outcome, got = "not applicable", str(reason)
        except Failed as failed:
            outcome, expected, got = "fail", failed.expected, failed.got
            # What is wrong with this life must not be blamed on the next case.
            self._drop()
        return Verdict(
            case=case.name,
            title=case.title,
            clauses=case.clauses,
            outcome=outcome,
            expected=expected,
            got=got[:LONGEST],
            seconds=round(time.monotonic() - started, 3),
        )

    def _drop(self) -> None:
        """End a life that went wrong, whatever that takes."""
        try:
            self.discard()
        except RunError as error:
            self._unborn += [str(error)] * HOPELESS_AFTER


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
