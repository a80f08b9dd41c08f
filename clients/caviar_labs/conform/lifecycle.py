"""Cases of joining and leaving: HELLO, heartbeats, scenery, RESET; SHUTDOWN, refusals, a silent broker.

A case is a script that plays the broker. What it returns is shown as «got»; the first line of its docstring
is the title that ``caviar conform --list`` prints.
"""

from __future__ import annotations

import hashlib
from typing import Any

from caviar_labs.conform.canonical import Answer
from caviar_labs.conform.case import Kit, case
from caviar_labs.conform.client import End, Failed, Fields, NotApplicable
from caviar_labs.conform.session import ACTIVE, ATTEMPT, CONNECTING, EPOCH, JOINED, READY, Session
from caviar_labs.conform.street import Inputs
from caviar_protocol.topics import PAYLOADS

BEATS = 10
"""Heartbeats that are due while they are counted."""
# A third of them: a client, and the kit itself, lose time slices on a machine with more processes than cores.
FEWEST_BEATS = BEATS // 3


@case("hello", "clauses 1, 3; Versions", "HELLO of version 1.x, with a role, and topics that exist")
def hello(kit: Kit) -> str:
    """HELLO comes first and declares name, role, inputs and outputs."""
    said, rules = kit.at(CONNECTING).hello, kit.rules
    version = said["version"]
    if version[0] != 1:
        raise Failed("version 1.x", f"{version[0]}.{version[1]}")
    for key, wanted in (("name", rules.name), ("role", rules.role)):
        if wanted and said[key] != wanted:
            raise Failed(f"{key} {wanted!r}", repr(said[key]))
    _check_topics(said)
    inputs = ", ".join(item["topic"] for item in said.get("inputs", [])) or "nothing"
    outputs = ", ".join(said.get("outputs", [])) or "nothing"
    return f"{said['role']} {said['name']!r}, version {version[0]}.{version[1]}: {inputs} → {outputs}"


def _check_topics(said: Fields) -> None:
    inputs = [(item["topic"], item.get("lag", 0)) for item in said.get("inputs", [])]
    outputs = said.get("outputs", [])
    for topic, lag in inputs:
        if topic not in PAYLOADS and not (topic == "*" and said["role"] == "recorder"):
            raise Failed(f"topics among {', '.join(PAYLOADS)}", f"the input {topic!r}")
        if lag == 0 and topic in outputs:
            raise Failed("no cycle within lag 0", f"{topic!r} as input of lag 0 and as output")
    for topic in outputs:
        if topic not in PAYLOADS:
            raise Failed(f"topics among {', '.join(PAYLOADS)}", f"the output {topic!r}")
    # With another lag a topic may be there twice: now, and as it was a frame before.
    if len(set(inputs)) < len(inputs) or len(set(outputs)) < len(outputs):
        raise Failed("each topic once", f"inputs {inputs}, outputs {outputs}")


@case(
    "attach", "clause 2; Heartbeats and liveness", "ATTACH on a second connection, as WELCOME and HELLO said"
)
def attach(kit: Kit) -> str:
    """After WELCOME the heartbeat connection is attached."""
    session = kit.at(JOINED)
    attached = attached_heart(session)
    right = {"type": "ATTACH", "epoch": EPOCH, "attempt": ATTEMPT, "name": session.hello["name"]}
    if attached != right:
        raise Failed(str(right), str(attached))
    return f"ATTACH of {attached['name']!r} in epoch {EPOCH}, attempt {ATTEMPT}"


def attached_heart(session: Session) -> Fields:
    """Wait for ATTACH of this life and return its fields; raises `Failed` where none comes."""
    for _ in range(round(session.rules.timeout_s / 0.05)):
        if session.pulse.attached:
            return session.pulse.attached[0]
        end = session.client.ended()
        if end is not None:
            raise Failed("ATTACH", str(end))
        session.listen(0.05)
    raise Failed("ATTACH on a second connection", f"none within {session.rules.timeout_s:g} s")


@case(
    "heartbeats",
    "clause 15; Heartbeats and liveness",
    "HEARTBEAT every heartbeat_ns, sequence from 0 without gaps, progress that never falls",
)
def heartbeats(kit: Kit) -> str:
    """Heartbeats come as often as asked, also past an unasked HEARTBEAT_ACK."""
    session = kit.at(JOINED)
    attached_heart(session)
    session.listen(BEATS / 2 * session.heartbeat_s)
    # A late acknowledgement, as of a broker that was busy: the client has sent others since.
    session.beat_back("HEARTBEAT_ACK", {"sequence": 0})
    session.listen(BEATS / 2 * session.heartbeat_s)
    return check_beats(session, 0)


def check_beats(session: Session, since: int) -> str:
    """Check all HEARTBEATs of a life, and that enough of them came in the time of `BEATS`.

    Args:
        session: The life.
        since: Number of HEARTBEATs that had come when that time began.

    Returns:
        How many came, for the verdict.
    """
    beats = session.pulse.beats
    if session.pulse.wrong:
        raise Failed("ATTACH, then only HEARTBEAT on the heartbeat connection", session.pulse.wrong[0])
    if len(beats) - since < FEWEST_BEATS:
        raise Failed(
            f"about {BEATS} HEARTBEATs in {BEATS * session.heartbeat_s:g} s", f"{len(beats) - since}"
        )
    numbers = [fields["sequence"] for fields in beats]
    if numbers != list(range(len(numbers))):
        raise Failed("sequence 0, 1, 2, …", f"{numbers[:12]}")
    progress = [fields.get("progress", 0) for fields in beats]
    if progress != sorted(progress):
        raise Failed("progress that never falls", f"{progress[:12]}")
    return f"{len(beats) - since} in {BEATS * session.heartbeat_s:g} s"


@case(
    "ready", "clauses 1, 3, 4; Connections and states", "READY with the geometry's digest and what is owned"
)
def ready(kit: Kit) -> str:
    """PREPARE is answered with READY."""
    session = kit.at(READY)
    said, role = session.ready, session.hello["role"]
    geometry = said.get("geometry", "")
    # Clause 4: the geometry is the digest of all names and digests, so that two services agree on every file.
    chain = "".join(
        f"{asset['name']}\0{asset['digest']}\0"
        for asset in sorted(session.assets, key=lambda asset: str(asset["name"]).encode())
    )
    right = hashlib.sha256(chain.encode()).hexdigest() if session.assets else ""
    if geometry != right and (geometry or role == "world"):
        recipe = "hash name NUL digest NUL of each asset, in ascending order of names"
        raise Failed(f"geometry {right or '(empty)'}: {recipe}", geometry or "none")
    if role == "world" and not said.get("prefixes"):
        raise Failed("prefixes of the names of the world's objects", "none")
    if role != "agent" and (said.get("actuators") or "seed" in said):
        raise Failed("actuators and seed of agents only", f"some of a {role}")
    owned = [*said.get("prefixes", []), *said.get("actuators", [])]
    return f"READY, geometry {geometry[:12] + '…' if geometry else 'none'}, owns {owned or 'nothing'}"


@case(
    "scenery",
    "clause 4; Scenery",
    "files fetched, or served, from any offset, with the digest that was announced",
)
def scenery(kit: Kit) -> str:
    """Scenery is exchanged in pieces, and known by its digest."""
    session = kit.at(READY)
    if session.hello["role"] == "world":
        return _world_scenery(session)
    geometry = session.ready.get("geometry", "")
    if not session.fetched and not geometry:
        raise NotApplicable("it uses no scenery")
    for asset in session.assets:
        if asset["size"] and asset["digest"] not in session.fetched:
            # The kit marks its files anew in each run, so that no cache has them.
            raise Failed(f"ASSET_GET of {asset['name']}, which no cache has", "READY without it")
    return f"{len(session.assets)} files, {sum(session.fetched.values())} B in pieces"


def _world_scenery(session: Session) -> str:
    session.send("ASSET_GET", {"digest": "0" * 64})
    session.expect_error("unknown-asset", "ERROR unknown-asset for a digest that it did not offer")
    if not session.offered:
        return "offers none, and says so when asked"
    # From the middle, as one that resumes asks, and from the end, where a part without a byte is right.
    name, data = max(session.offered.items(), key=lambda item: len(item[1]))
    digest = hashlib.sha256(data).hexdigest()
    for offset in (len(data) // 2, len(data)):
        session.send("ASSET_GET", {"digest": digest, "offset": offset})
        answer = session.receive("ASSET_DATA")
        chunk = answer.parts[1] if answer.kind == "ASSET_DATA" else None
        right = chunk is not None and data.startswith(chunk, offset) and bool(chunk) == (offset < len(data))
        if not right or answer.fields["size"] != len(data):
            raise Failed(f"ASSET_DATA of {name} from byte {offset}", str(answer))
    return f"offers {len(session.offered)} files, serves them from any offset"


@case(
    "early-grant",
    "clause 1; Connections and states",
    "ERROR unexpected, and RESET_DONE to the RESET after it",
)
def early_grant(kit: Kit) -> str:
    """A GRANT that comes before RESET is not used."""
    session = kit.at(READY)
    # Of the episode that the next RESET begins: only its order is wrong.
    session.episode = 0
    session.grant(0)
    session.expect_error("unexpected")
    session.reset(0)
    return "ERROR unexpected, then RESET_DONE"


@case("reset", "clauses 1, 16", "RESET_DONE with epoch, attempt and episode")
def reset(kit: Kit) -> str:
    """RESET is answered with RESET_DONE."""
    return f"RESET_DONE of episode {kit.at(ACTIVE).episode}"


@case("observe", "Observers", "OBSERVED of each OBSERVE, and an end with status 0 after SHUTDOWN")
def observe(kit: Kit) -> str:
    """Each OBSERVE is acknowledged, with a product, without any, and with fields that are not known."""
    session = kit.at(CONNECTING)
    said = session.hello
    if kit.rules.role != "observer":
        raise NotApplicable("it is no observer (--role observer)")
    if "observe" not in said.get("capabilities", []) or said.get("inputs") or said.get("outputs"):
        raise Failed("the capability 'observe', and no inputs or outputs", str(said))
    session.welcome()
    entries, parts = Inputs().of([{"topic": "scene"}], 0)
    frame = {"state": "running", "frame": 0, "inputs": entries}
    news: tuple[tuple[Fields, list[bytes]], ...] = (
        ({"state": "joining"}, []),
        (frame, parts),
        (frame | {"colour": {"of": [1, 2.5]}}, parts),
        ({"state": "running", "paused": True, "frame": 0}, []),
    )
    for sequence, (fields, further) in enumerate(news):
        session.send("OBSERVE", {"sequence": sequence, **fields}, *further)
        answer = session.expect("OBSERVED")
        if answer.fields["sequence"] != sequence:
            raise Failed(f"OBSERVED with sequence {sequence}", str(answer.fields))
    session.send("SHUTDOWN", {"reason": "the case ends here"})
    end = session.ended(session.rules.timeout_s, "its end after SHUTDOWN")
    if end.status not in (0, None):
        raise Failed("status 0", str(end))
    return f"OBSERVED of {len(news)}, {end}"


JOINING = (hello, observe, attach, heartbeats, ready, scenery, early_grant, reset)


SILENCE_S = 0.5
"""[s] of liveness where the broker falls silent."""
ATTEMPTS = 5
"""Lives of a client of which one has to be answered in time."""
TOLERANCE_S = 2.0
"""[s] that an end may take beyond that: interpreters with many libraries take long to end."""
SIGTERM_S = 2.0
"""[s] that a service has after SIGTERM (SPEC.md, «Connections and states»)."""


def _bye(session: Session, seconds: float) -> None:
    """BYE comes, and nothing after it."""
    while (answer := session.receive("BYE", seconds)).kind != "BYE":
        # The answer to a frame that was granted before may be on its way.
        if answer.kind not in ("DONE", "FAULT"):
            raise Failed("BYE", str(answer))
    session.check_identity(answer)


def _gone(session: Session, seconds: float, expected: str) -> End:
    end = session.ended(seconds, expected)
    rest = session.poll(0.0)
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
    for _ in range(ATTEMPTS):
        session = kit.fresh()
        # Twice the liveness with answers comes first: a client that counts from its start would pass else.
        session.welcome(heartbeat_s=SILENCE_S / 10, liveness_s=SILENCE_S)
        session.prepare()
        longest = session.listen(2 * SILENCE_S)
        early = session.client.ended()
        # On a machine that is so busy that the kit was silent itself, the client may be right to end.
        if early is None or longest < SILENCE_S / 2:
            break
    if early is not None:
        raise Failed("a client that stays while it is answered", str(early))
    session.silent = True
    end = session.ended(SILENCE_S + TOLERANCE_S, f"its end after {SILENCE_S:g} s of silence")
    return end.check_failure("a status other than 0")


@case("other-major", "Versions", "an end with a status other than 0")
def other_major(kit: Kit) -> str:
    """WELCOME of another major version, of which only type and version can be read, is the end."""
    session = kit.fresh()
    # Without epoch or scenario: what else a later version has there cannot be known.
    session.send("WELCOME", {"version": [2, 0], "era": "a later one"})
    end = session.ended(session.rules.timeout_s, "an end with a status other than 0")
    return end.check_failure("a status other than 0")


@case("refused", "Wrong things and their answers", "the message of REFUSE printed, and a status other than 0")
def refused(kit: Kit) -> str:
    """REFUSE is printed and is the end."""
    message = "another one of that name is here"
    session = kit.fresh()
    session.send("REFUSE", {"code": "name-taken", "message": message})
    end = session.ended(session.rules.timeout_s, "an end with a status other than 0")
    end.check_failure("a status other than 0")
    if end.status is not None and message not in end.output:
        raise Failed(f"{message!r} printed", str(end))
    return str(end)


@case("later-minor", "Versions", "a life as with the version that it knows")
def later_minor(kit: Kit) -> str:
    """A later minor version is accepted, and fields that are not known are ignored."""
    session = kit.fresh()
    strange: dict[str, Any] = {"colour": {"of": [1, 2.5, "a later version"]}}
    session.welcome(version=[1, 99], **strange)
    session.begin_episode(**strange)
    session.step(None, **strange)
    kit.discard()
    return "ATTACH, READY, RESET_DONE, DONE"


@case("no-demand", "clause 5", "READY all the same, and BYE after SHUTDOWN")
def no_demand(kit: Kit) -> str:
    """A service without a consumer is prepared, and neither reset nor granted."""
    session = kit.fresh()
    if session.hello["role"] in ("agent", "recorder") or not session.hello.get("outputs"):
        raise NotApplicable("it is there for its own sake")
    session.welcome()
    session.prepare(demand=False)
    return _leaves(session)


@case("canonical", "Canonical form; clause 20", "headers in canonical form, in every message")
def canonical(kit: Kit) -> str:
    """Every header that came was in canonical form."""
    # Last of all cases: it judges what came in the others, and none of them fails for form alone.
    if not kit.seen.headers:
        raise NotApplicable("no message came")
    if kit.seen.odd:
        raise Failed("headers in canonical form", "; ".join(kit.seen.odd[:3]))
    return "all of them"


LEAVING = (shutdown, early_shutdown, sigterm, silence, other_major, refused, later_minor, no_demand)
