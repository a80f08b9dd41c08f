"""Cases up to frame 0: HELLO, heartbeats, scenery, RESET."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from caviar_clients.conform.case import Failed, NotApplicable, case
from caviar_clients.conform.session import ACTIVE, ATTEMPT, CONNECTING, EPOCH, JOINED, READY, Session
from caviar_clients.conform.wire import Fields
from caviar_protocol.topics import PAYLOADS

if TYPE_CHECKING:
    from caviar_clients.conform.kit import Kit

BEATS = 10
"""Heartbeats that are due while they are counted; a third of them has to come on a busy machine."""


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
    """ATTACH of this life, waited for; `Failed` where none comes."""
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
    session.beat_back("HEARTBEAT_ACK", {"sequence": 0})
    session.listen(BEATS / 2 * session.heartbeat_s)
    return _check_beats(session, 0)


def _check_beats(session: Session, since: int) -> str:
    beats = [fields for _, fields in session.pulse.beats]
    if session.pulse.wrong:
        raise Failed("ATTACH, then only HEARTBEAT on the heartbeat connection", session.pulse.wrong[0])
    if len(beats) - since < BEATS // 3:
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
            raise Failed(f"ASSET_GET of {asset['name']}, which nobody can have", "READY without it")
    return f"{len(session.assets)} files, {sum(session.fetched.values())} B in pieces"


def _world_scenery(session: Session) -> str:
    session.send("ASSET_GET", {"digest": "0" * 64})
    answer = session.receive("ERROR unknown-asset")
    if (answer.kind, answer.fields.get("code")) != ("ERROR", "unknown-asset"):
        raise Failed("ERROR unknown-asset for a digest that it did not offer", str(answer))
    if not session.offered:
        return "offers none, and says so when asked"
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
    session.episode = 0
    session.grant(0)
    answer = session.receive("ERROR unexpected")
    if (answer.kind, answer.fields.get("code")) != ("ERROR", "unexpected"):
        raise Failed("ERROR unexpected", str(answer))
    session.reset(0)
    return "ERROR unexpected, then RESET_DONE"


@case("reset", "clauses 1, 16", "RESET_DONE with epoch, attempt and episode")
def reset(kit: Kit) -> str:
    """RESET is answered with RESET_DONE."""
    return f"RESET_DONE of episode {kit.at(ACTIVE).episode}"


CASES = (hello, attach, heartbeats, ready, scenery, early_grant, reset)
