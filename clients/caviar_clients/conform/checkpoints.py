"""Cases of the capability ``checkpoint``: a state is saved, and taken over by the next life (clause 18)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from caviar_clients.conform import canonical
from caviar_clients.conform.case import Failed, NotApplicable, case
from caviar_clients.conform.session import ACTIVE, Answer, Session
from caviar_clients.conform.wrong import right_end

if TYPE_CHECKING:
    from caviar_clients.conform.kit import Kit

BEFORE, AFTER = 3, 3
"""Frames before the state is saved, and frames that are answered again behind it."""
NO_STATE = b"\xc1no state of any service"


@case("checkpoint", "clause 18", "CHECKPOINT_DONE of that frame, with the state in one part; the next frame")
def checkpoint(kit: Kit) -> str:
    """CHECKPOINT is answered with the client's state."""
    session = _with_capability(kit)
    session.step()
    state = _saved(session)
    again = _saved(session)
    session.step()
    return (
        f"{len(state)} B of state, twice"
        if state == again
        else f"{len(state)} B of state, then {len(again)} B"
    )


@case(
    "restore", "clauses 18, 19, 20", "READY, then the same products for the grants of before; the next frame"
)
def restore(kit: Kit) -> str:
    """A client that comes back takes its state over, and repeats what it did since."""
    _with_capability(kit)
    session = kit.fresh()
    _begin(session)
    for _ in range(BEFORE):
        session.step()
    state, saved = _saved(session), session.completed
    before = [_products(session, session.step()) for _ in range(AFTER)]
    session = kit.fresh()
    _begin(session)
    _restore(session, state, saved)
    for number, products in enumerate(before, start=saved + 1):
        if _products(session, session.step()) != products:
            raise Failed("the products of before, byte by byte", f"others in frame {number}")
    session.step()
    return f"the same products in {AFTER} frames behind the state of frame {saved}"


@case("wrong-state", "clause 18; Wrong things", "FAULT, or an end with a status other than 0")
def wrong_state(kit: Kit) -> str:
    """A state that is none is refused."""
    _with_capability(kit)
    session = kit.fresh()
    _begin(session)
    session.send("RESTORE", {**session.who, "episode": session.episode, "frame": 0}, NO_STATE)
    got = session.reaction()
    kit.discard()
    if isinstance(got, Answer):
        if got.kind != "FAULT":
            raise Failed("FAULT, or an end with a status other than 0", str(got))
        return f"FAULT: {got.fields['message'][:100]}"
    if got is None:
        raise Failed("FAULT, or an end", f"nothing within {session.rules.timeout_s:g} s")
    return right_end(got, "FAULT, or an end with a status other than 0")


def _with_capability(kit: Kit) -> Session:
    session = kit.at(ACTIVE)
    if "checkpoint" not in session.hello.get("capabilities", []):
        raise NotApplicable("it did not name the capability `checkpoint`")
    return session


def _begin(session: Session) -> None:
    session.welcome()
    session.prepare()
    session.reset(0)


def _saved(session: Session) -> bytes:
    """The state after the frame completed last."""
    frame = session.completed
    session.send("CHECKPOINT", {**session.who, "episode": session.episode, "frame": frame})
    answer = session.receive("CHECKPOINT_DONE")
    if answer.kind != "CHECKPOINT_DONE":
        raise Failed("CHECKPOINT_DONE", str(answer))
    session.check_identity(answer)
    got = (answer.fields["episode"], answer.fields["frame"])
    if got != (session.episode, frame):
        raise Failed(
            f"CHECKPOINT_DONE of episode {session.episode}, frame {frame}",
            f"one of episode {got[0]}, frame {got[1]}",
        )
    return answer.parts[1]


def _restore(session: Session, state: bytes, frame: int) -> None:
    session.send("RESTORE", {**session.who, "episode": session.episode, "frame": frame}, state)
    answer = session.receive("READY")
    if answer.kind != "READY":
        raise Failed("READY, in answer to RESTORE", str(answer))
    session.check_identity(answer)
    session.completed, session.frame = frame, frame + 1


def _products(session: Session, answer: Answer) -> dict[str, bytes]:
    return canonical.check_products(answer.fields, answer.parts, session.hello.get("outputs", []))


CASES = (checkpoint, restore, wrong_state)
