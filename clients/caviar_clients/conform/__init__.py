"""Conformance kit for clients in any language: a broker that follows scripts, and a verdict per clause.

It shares no code with the product's broker and reads headers with the plain ``msgpack`` package, so that
it is a second reading of ``protocol/SPEC.md``. Only payloads are judged with `caviar_protocol`'s types.

`conform` takes a client through the cases, one life after another, and collects the verdicts. The cases are
in `lifecycle`, `frames`, `content` and `wrong`. `session` plays the broker for one life of the client, which
`client` starts, with the contents of `street`; `canonical` judges what comes.
"""

from __future__ import annotations

import difflib
import os
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from caviar_clients.conform import content, frames, lifecycle, wrong
from caviar_clients.conform.case import Case, Failed, NotApplicable, Outcome, Verdict
from caviar_clients.conform.client import ByHand, Client, Rules, Started, Wire
from caviar_clients.conform.session import CONNECTING, JOINED, PATIENCE, READY, Seen, Session
from caviar_protocol.errors import RunError, SetupError, suggestion
from caviar_protocol.keys import ROLES

__all__ = ["Case", "Kit", "Rules", "Verdict", "cases", "conform"]

LONGEST = 600
"""Characters of what came, in a verdict: a client's texts may have any length."""
HOPELESS_AFTER = 2
"""Lives in a row that may fail to get as far as a case needs, before all other cases fail without a try."""


def cases() -> tuple[Case, ...]:
    """Return all cases.

    Example:
        >>> [case.name for case in cases()[:2]]
        ['hello', 'attach']
    """
    # In the order in which they need the fewest lives: those that end one come last, and `canonical` judges
    # what came in all others.
    return (
        *lifecycle.JOINING,
        *frames.FRAMES_AND_EPISODES,
        *content.CASES,
        *wrong.CASES,
        *frames.CHECKPOINTS,
        *lifecycle.LEAVING,
        *frames.AFTERWARDS,
        lifecycle.canonical,
    )


class Kit:
    """What a case works with: the present life of the client, or a new one.

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


def chosen(names: Sequence[str]) -> list[Case]:
    """Return the cases of these names, or all; raises `SetupError` for a name that no case has."""
    known = {case.name: case for case in cases()}
    for name in names:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise SetupError(f"there is no case {name!r}; {hint}cases: {', '.join(known)}")
    return [case for case in known.values() if case.name in names or not names]


def conform(
    endpoint: str,
    *,
    command: str = "",
    names: Sequence[str] = (),
    rules: Rules | None = None,
    front: Callable[[str], AbstractContextManager[str]] = nullcontext,
    tell: Callable[[str], None] = lambda text: None,
    each: Callable[[Verdict], None] = lambda verdict: None,
) -> list[Verdict]:
    """Listen at an address and judge a client.

    Args:
        endpoint: ZeroMQ address to listen at; port 0 takes any.
        command: Starts the client, with ``{endpoint}`` and ``{name}`` filled in; empty: the user does, when
            ``tell`` asks for it.
        names: Cases to play; by default all.
        rules: What is known of the client.
        front: Serves clients in front of the kit's own endpoint, as a gateway does; yields the address that
            clients are given.
        tell: Shows the user a text.
        each: Gets each verdict as soon as there is one.

    Returns:
        The verdicts, in the order of the cases.

    Raises:
        SetupError: A case or role is unknown.
        RunError: The endpoint cannot be listened at, or the command cannot be started or fails before its
            client sends anything.

    Example:
        >>> client = "python -m caviar_services {name} --use agent:los-beam --broker {endpoint}"
        >>> [v.outcome for v in conform("tcp://127.0.0.1:0", command=client, names=["hello"])]
        ['pass']
    """
    picked, given = chosen(names), rules or Rules()
    if given.role and given.role not in ROLES:
        raise SetupError(f"no client has the role {given.role!r}; {suggestion(given.role, ROLES)}")
    wire = Wire(endpoint)
    verdicts = []
    # A client that was killed may still write: what it leaves is removed as far as it goes.
    temporary = TemporaryDirectory(prefix="caviar-conform-", ignore_cleanup_errors=True)
    with closing(wire), front(wire.endpoint) as address, temporary as folder:
        client: Client = ByHand(wire, address, tell, given.timeout_s)
        if command:
            client = Started(command, address, given.name or "client", Path(folder))
        kit = Kit(wire, client, replace(given, directory=folder, mark=os.urandom(8).hex()))
        try:
            for case in picked:
                verdicts.append(kit.judge(case))
                each(verdicts[-1])
            kit.discard()
        finally:
            if command:
                client.dispose()
    return verdicts
