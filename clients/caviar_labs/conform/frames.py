"""Cases of frames and episodes (GRANT, DONE and what lies between), and of the capability ``checkpoint``.

With that capability a life's state is saved, and the next life takes it over (clause 18).
"""

from __future__ import annotations

from caviar_labs.conform import canonical, street
from caviar_labs.conform.canonical import Answer
from caviar_labs.conform.case import Kit, case
from caviar_labs.conform.client import End, Failed, NotApplicable
from caviar_labs.conform.lifecycle import BEATS, check_beats
from caviar_labs.conform.session import ACTIVE, Session
from caviar_labs.conform.street import HELD_FOR, Inputs

FRAMES = 4


@case(
    "frames",
    "clauses 6, 20, 21; Encoding, Digests, Payloads",
    "DONE of each frame, with valid, canonical products and right digests",
)
def frames(kit: Kit) -> str:
    """Each GRANT is answered with DONE and its products."""
    session = kit.at(ACTIVE)
    found: dict[str, int] = {}
    for _ in range(FRAMES):
        for entry in session.step().fields.get("products", []):
            found[entry["topic"]] = found.get(entry["topic"], 0) + 1
    missing = [topic for topic in session.hello.get("outputs", []) if topic not in found]
    if missing:
        raise Failed("every demanded output", f"no {', '.join(missing)} in {FRAMES} frames")
    return f"{FRAMES} frames: " + (", ".join(f"{n} of {t}" for t, n in sorted(found.items())) or "no product")


@case("repeated-grant", "clause 7", "the stored DONE, byte by byte")
def repeated_grant(kit: Kit) -> str:
    """A repeated GRANT is answered with the DONE of before."""
    session = kit.at(ACTIVE)
    answers = [session.step(), session.step()]
    for answer in reversed(answers):
        frame = answer.fields["frame"]
        session.send("GRANT", *_again(session, frame))
        again = session.done(frame)
        if again.parts != answer.parts:
            raise Failed(f"the same bytes for frame {frame}", _what_differs(answer, again))
    session.step()
    return "the same bytes, of the newest frame and of the one before"


# The GRANT of a frame that was answered before, as a broker that came back repeats it.
def _again(session: Session, frame: int) -> tuple[dict[str, object], *tuple[bytes, ...]]:
    fields, parts = session.granting(frame, Inputs())
    if frame:
        fields["previous_frame"] = frame - 1
    return fields, *parts


def _what_differs(first: Answer, second: Answer) -> str:
    differing = [key for key in first.fields if first.fields[key] != second.fields.get(key)]
    return f"others in {', '.join(differing)}" if differing else "another product"


@case("heartbeats-in-frames", "clause 15", "HEARTBEATs as often as asked while frames are computed")
def heartbeats_in_frames(kit: Kit) -> str:
    """Work does not hold heartbeats up."""
    # A client that answers in one thread with its heartbeats stops beating while it computes.
    session = kit.at(ACTIVE)
    since, period = len(session.pulse.beats), session.heartbeat_s
    for _ in range(BEATS):
        session.step()
        session.listen(period)
    return check_beats(session, since)


@case("cancel", "clause 7", "the DONE (or FAULT) that is due, and nothing for the CANCEL")
def cancel(kit: Kit) -> str:
    """CANCEL is advice: what was granted is still answered, another frame's is ignored."""
    session = kit.at(ACTIVE)
    session.send("CANCEL", {**session.who, "episode": session.episode, "frame": 900})
    frame = session.grant()
    session.send("CANCEL", {**session.who, "episode": session.episode, "frame": frame})
    # A client may take the advice and give the frame up, which FAULT says.
    answer = session.receive("DONE or FAULT")
    if answer.kind == "FAULT" and answer.fields.get("frame") == frame:
        session.frame += 1
    else:
        session.judge(answer, frame)
    session.step()
    return f"{answer.kind}, and the next frame"


@case("queued-grants", "clause 7; Connections and states", "answers in the order of the grants")
def queued_grants(kit: Kit) -> str:
    """Grants that are queued are answered in their order."""
    session = kit.at(ACTIVE)
    # All are sent before any answer is read: a client that takes the newest message first gives itself away.
    depth = session.hello.get("max_in_flight", 1)
    if depth == 1:
        raise NotApplicable("it queues no grants: max_in_flight is 1")
    first = session.frame
    count = min(depth, 4)
    for frame in range(first, first + count):
        session.grant(frame, None, **({"previous_frame": frame - 1} if frame else {}))
    for frame in range(first, first + count):
        session.done(frame)
    return f"{count} queued, answered in order"


@case("gap", "clause 6", "DONE of the granted frame, over the whole gap")
def gap(kit: Kit) -> str:
    """Frames may be left out: previous_frame says which was completed last."""
    session = kit.at(ACTIVE)
    session.step()
    # As a broker does in a real-time run, whose clock goes on while a service is late.
    frame = session.frame + 3
    session.done(session.grant(frame))
    return f"DONE of frame {frame}, where frame {frame - 4} was the last before it"


@case(
    "reordered-grants",
    "clause 7; Wrong things",
    "ERROR unexpected or that frame's answer; then the next frame",
)
def reordered_grants(kit: Kit) -> str:
    """A GRANT of a frame after those that were answered does no harm."""
    session = kit.at(ACTIVE)
    session.step()
    skipped = session.frame
    session.done(session.grant(skipped + 1))
    # The late GRANT states the frame that was complete when a broker would have sent it.
    completed, session.completed = session.completed, skipped - 1
    session.grant(skipped)
    session.completed = completed
    answer = session.receive("ERROR unexpected, or DONE")
    if answer.kind == "DONE":
        session.judge(answer, skipped)
    elif (answer.kind, answer.fields.get("code")) != ("ERROR", "unexpected") and answer.kind != "FAULT":
        raise Failed("ERROR unexpected, or DONE of that frame", str(answer))
    session.step()
    return f"{answer.kind}, and the next frame"


@case("held-inputs", "clauses 6, 9, 12", "DONE, from inputs of an earlier frame")
def held_inputs(kit: Kit) -> str:
    """Inputs may be held: they keep their own frame, and have an age."""
    session = kit.at(ACTIVE)
    if not session.hello.get("inputs"):
        raise NotApplicable("it has no inputs")
    # An older product needs frames before it.
    while session.frame < HELD_FOR + 1:
        session.step()
    session.step(Inputs(held=True))
    session.step()
    return f"DONE with inputs that are {HELD_FOR} frames old"


@case("absent-inputs", "clauses 6, 10", "DONE without what is not required")
def absent_inputs(kit: Kit) -> str:
    """Inputs that are not required may be absent, and have no parts."""
    session = kit.at(ACTIVE)
    optional = [i["topic"] for i in session.hello.get("inputs", []) if not i.get("required", True)]
    if not optional:
        raise NotApplicable("all its inputs are required")
    session.step()
    session.step(Inputs(without_optional=True))
    session.step()
    return f"DONE without {', '.join(optional)}"


@case("late-inputs", "clause 11", "DONE with a product of an earlier frame beside each one")
def late_inputs(kit: Kit) -> str:
    """Recorders get products that came too late, under their own frame's number."""
    session = kit.at(ACTIVE)
    if session.hello["role"] != "recorder":
        raise NotApplicable("only recorders get what came too late")
    session.step()
    session.step(Inputs(late=True))
    return "DONE"


@case("unknown-fields", "Versions; Arrays", "DONE, as if they were not there")
def unknown_fields(kit: Kit) -> str:
    """Fields and arrays of a later minor version are ignored."""
    session = kit.at(ACTIVE)
    session.step(Inputs(stranger=True), shade={"of": ["a", "later", "version"]})
    session.step()
    return "DONE"


@case("several-sources", "clause 3", "DONE, with inputs distinguished by topic and source")
def several_sources(kit: Kit) -> str:
    """A topic may have several sources."""
    doubled = Inputs(sources=street.DOUBLED)
    session = kit.fresh()
    topics = {item["topic"] for item in session.hello.get("inputs", [])}
    if not topics & {"scene", "action", "*"}:
        raise NotApplicable("none of its inputs has more than one source")
    session.begin_episode(doubled)
    for _ in range(2):
        session.step(doubled)
    kit.discard()
    return "DONE with two worlds and two agents"


@case("final-grant", "clause 16", "DONE without a product")
def final_grant(kit: Kit) -> str:
    """An agent's last grant of an episode has no action."""
    session = kit.at(ACTIVE)
    if session.hello["role"] != "agent":
        raise NotApplicable("only agents get one")
    session.step()
    _end_episode(session)
    kit.discard()
    return "DONE without a product"


def _end_episode(session: Session) -> None:
    frames_done = session.completed + 1
    if session.hello["role"] == "agent":
        # The agent gets what its last action led to, of the frame before, and nothing of this one.
        declared = [item for item in session.hello.get("inputs", []) if item.get("lag", 0)]
        entries, parts = Inputs().of(declared, session.frame)
        fields, _ = session.granting(session.frame, Inputs(), final=True)
        fields["inputs"] = entries
        session.send("GRANT", {key: value for key, value in fields.items() if value != []}, *parts)
        answer = session.done(session.frame)
        if answer.fields.get("products"):
            raise Failed("no product for the final grant", f"{len(answer.fields['products'])}")
    session.send("EPISODE_END", {**session.who, "episode": session.episode, "frames": frames_done})


@case("episodes", "clauses 16, 19, 20", "RESET_DONE after EPISODE_END, and for equal seeds equal products")
def episodes(kit: Kit) -> str:
    """Another RESET begins anew; the same seed gives the same bytes."""
    session = kit.at(ACTIVE)
    if "episodes" not in session.hello.get("capabilities", []):
        raise NotApplicable("it did not name the capability `episodes`")
    played = []
    # In a life of its own there was no frame yet: RESET comes after EPISODE_END, and that after a frame.
    if session.completed < 0:
        session.step()
    for _ in range(2):
        _end_episode(session)
        session.reset(session.episode + 1, seed_episode=1)
        answers = [session.step() for _ in range(FRAMES)]
        outputs = session.hello.get("outputs", [])
        played.append([canonical.check_products(a.fields, a.parts, outputs) for a in answers])
    for frame, (first, second) in enumerate(zip(*played, strict=True)):
        if first != second:
            raise Failed("equal products in two episodes with equal seeds", f"others in frame {frame}")
    return "two more episodes, equal byte by byte"


FRAMES_AND_EPISODES = (
    frames,
    repeated_grant,
    heartbeats_in_frames,
    cancel,
    queued_grants,
    gap,
    reordered_grants,
    held_inputs,
    absent_inputs,
    late_inputs,
    unknown_fields,
    episodes,
)
AFTERWARDS = (final_grant, several_sources)
"""Those that end a life."""


BEFORE, AFTER = 3, 3
"""Frames before the state is saved, and frames that are answered again after it."""
# Begins with the one byte that MessagePack never uses, so that no client reads it as a state.
NO_STATE = b"\xc1no state of any service"


@case("checkpoint", "clause 18", "CHECKPOINT_DONE of that frame, with the state in one part; the next frame")
def checkpoint(kit: Kit) -> str:
    """CHECKPOINT is answered with the client's state."""
    session = _with_capability(kit)
    session.step()
    # Twice, since saving must not change the state. Equal bytes are not asked for: a state may hold a clock.
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
    session.begin_episode()
    for _ in range(BEFORE):
        session.step()
    state, saved = _saved(session), session.completed
    before = [_products(session, session.step()) for _ in range(AFTER)]
    session = kit.fresh()
    session.begin_episode()
    _restore(session, state, saved)
    for number, products in enumerate(before, start=saved + 1):
        if _products(session, session.step()) != products:
            raise Failed("the products of before, byte by byte", f"others in frame {number}")
    session.step()
    return f"the same products in {AFTER} frames after the state of frame {saved}"


@case("wrong-state", "clause 18; Wrong things", "FAULT, or an end with a status other than 0")
def wrong_state(kit: Kit) -> str:
    """A state that is none is refused."""
    _with_capability(kit)
    expected = "FAULT, or an end with a status other than 0"
    session = kit.fresh()
    session.begin_episode()
    session.send("RESTORE", {**session.who, "episode": session.episode, "frame": 0}, NO_STATE)
    got = session.reaction(expected)
    kit.discard()
    if isinstance(got, End):
        return got.check_failure(expected)
    if got.kind != "FAULT":
        raise Failed(expected, str(got))
    return f"FAULT: {got.fields['message'][:100]}"


def _with_capability(kit: Kit) -> Session:
    session = kit.at(ACTIVE)
    if "checkpoint" not in session.hello.get("capabilities", []):
        raise NotApplicable("it did not name the capability `checkpoint`")
    return session


def _saved(session: Session) -> bytes:
    """Have the client save its state after the frame completed last."""
    frame = session.completed
    session.send("CHECKPOINT", {**session.who, "episode": session.episode, "frame": frame})
    answer = session.expect("CHECKPOINT_DONE")
    session.check_frame(answer, frame)
    return answer.parts[1]


def _restore(session: Session, state: bytes, frame: int) -> None:
    session.send("RESTORE", {**session.who, "episode": session.episode, "frame": frame}, state)
    session.expect("READY", "READY, in answer to RESTORE")
    session.completed, session.frame = frame, frame + 1


def _products(session: Session, answer: Answer) -> dict[str, bytes]:
    return canonical.check_products(answer.fields, answer.parts, session.hello.get("outputs", []))


CHECKPOINTS = (checkpoint, restore, wrong_state)
