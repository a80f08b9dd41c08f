"""Cases that end a life, or that need one of their own."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from caviar_clients.conform.case import Failed, NotApplicable, case
from caviar_clients.conform.client import End
from caviar_clients.conform.session import ACTIVE, Answer, Session

if TYPE_CHECKING:
    from caviar_clients.conform.kit import Kit

SILENCE_S = 0.5
"""[s] of liveness where the broker falls silent."""
TOLERANCE_S = 2.0
"""[s] that an end may take beyond that."""
SIGTERM_S = 2.0
"""[s] that a service has after SIGTERM, as SPEC.md says."""


def _bye(session: Session, seconds: float) -> None:
    """BYE comes, and nothing after it."""
    while True:
        answer = session.receive("BYE", seconds)
        if answer.kind == "BYE":
            break
        if answer.kind not in ("DONE", "FAULT"):
            raise Failed("BYE", str(answer))
    session.check_identity(answer)


def _gone(session: Session, seconds: float, expected: str) -> End:
    end = session.ended(seconds, expected)
    rest = session.take(0.0)
    if isinstance(rest, Answer):
        raise Failed("nothing after BYE", str(rest))
    return end


def _leaves(session: Session) -> str:
    grace_s = session.rules.timeout_s
    session.send("SHUTDOWN", {"reason": "the case ends here", "grace_ns": round(grace_s * 1e9)})
    _bye(session, grace_s)
    end = _gone(session, grace_s, "its end within the grace of SHUTDOWN")
    if end.status not in (0, None):
        raise Failed("status 0", str(end))
    return f"BYE, {end}"


@case("shutdown", "Connections and states", "BYE within grace_ns, nothing after it, status 0")
def shutdown(kit: Kit) -> str:
    """SHUTDOWN is answered with BYE, and the process ends with status 0."""
    return _leaves(kit.at(ACTIVE))


@case("early-shutdown", "Connections and states", "BYE within grace_ns, status 0")
def early_shutdown(kit: Kit) -> str:
    """SHUTDOWN may come right after WELCOME."""
    session = kit.fresh()
    session.welcome()
    return _leaves(session)


@case("sigterm", "Connections and states", f"BYE, and an end within {SIGTERM_S:g} s")
def sigterm(kit: Kit) -> str:
    """SIGTERM makes a service say BYE and end."""
    session = kit.at(ACTIVE)
    session.step()
    if not session.client.terminate():
        raise NotApplicable("the kit did not start the client")
    _bye(session, SIGTERM_S)
    end = _gone(session, SIGTERM_S, f"its end within {SIGTERM_S:g} s of SIGTERM")
    return f"BYE, {end}"


@case("silence", "clause 15", "an end with a status other than 0, after liveness_ns and not before")
def silence(kit: Kit) -> str:
    """A client whose broker is silent ends by itself."""
    session = kit.fresh()
    session.welcome(heartbeat_s=SILENCE_S / 10, liveness_s=SILENCE_S)
    session.prepare()
    session.listen(2 * SILENCE_S)
    early = session.client.ended()
    if early is not None:
        raise Failed("a client that stays while it is answered", str(early))
    session.silent = True
    end = session.ended(SILENCE_S + TOLERANCE_S, f"its end after {SILENCE_S:g} s of silence")
    if end.status == 0 or end.crashed:
        raise Failed("a status other than 0", str(end))
    return str(end)


@case("other-major", "Versions", "an end with a status other than 0")
def other_major(kit: Kit) -> str:
    """WELCOME of another major version, of which only type and version can be read, is the end."""
    session = kit.fresh()
    session.send("WELCOME", {"version": [2, 0], "era": "a later one"})
    end = session.ended(session.rules.timeout_s, "an end with a status other than 0")
    if end.status == 0 or end.crashed:
        raise Failed("a status other than 0", str(end))
    return str(end)


@case("refused", "Wrong things and their answers", "the message of REFUSE printed, and a status other than 0")
def refused(kit: Kit) -> str:
    """REFUSE is printed and is the end."""
    message = "another one of that name is here"
    session = kit.fresh()
    session.send("REFUSE", {"code": "name-taken", "message": message})
    end = session.ended(session.rules.timeout_s, "an end with a status other than 0")
    if end.status == 0 or end.crashed:
        raise Failed("a status other than 0", str(end))
    if end.status is not None and message not in end.output:
        raise Failed(f"{message!r} printed", str(end))
    return str(end)


@case("later-minor", "Versions", "a life as with the version that it knows")
def later_minor(kit: Kit) -> str:
    """A later minor version is accepted, and fields that are not known are ignored."""
    session = kit.fresh()
    strange: dict[str, Any] = {"colour": {"of": [1, 2.5, "a later version"]}}
    session.welcome(version=[1, 99], **strange)
    session.prepare(**strange)
    session.reset(0, **strange)
    session.step(None, **strange)
    kit.discard()
    return "ATTACH, READY, RESET_DONE, DONE"


@case("no-demand", "clause 5", "READY all the same, and BYE after SHUTDOWN")
def no_demand(kit: Kit) -> str:
    """A service whose outputs nobody asks for is prepared, and neither reset nor granted."""
    session = kit.fresh()
    if session.hello["role"] in ("agent", "recorder") or not session.hello.get("outputs"):
        raise NotApplicable("it is there for its own sake")
    session.welcome()
    session.prepare(demand=False)
    return _leaves(session)


@case("canonical", "Canonical form; clause 20", "headers in canonical form, in every message")
def canonical(kit: Kit) -> str:
    """Every header that came was in canonical form."""
    if not kit.seen.headers:
        raise NotApplicable("no message came")
    if kit.seen.odd:
        raise Failed("headers in canonical form", "; ".join(kit.seen.odd[:3]))
    return "all of them"


CASES = (shutdown, early_shutdown, sigterm, silence, other_major, refused, later_minor, no_demand)
