"""Cases of what a broker should never send: no client may crash, hang, or take it for something else."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable

from caviar_labs.conform.canonical import Answer
from caviar_labs.conform.case import Kit, case
from caviar_labs.conform.client import End, Failed, Fields, NotApplicable, pack
from caviar_labs.conform.lifecycle import BEATS, FEWEST_BEATS, attached_heart
from caviar_labs.conform.session import ACTIVE, ATTEMPT, EPOCH, Session
from caviar_labs.conform.street import Inputs

# Written out rather than imported: the kit is a second reading of SPEC.md, section Limits.
MAX_HEADER = 1 << 20
MAX_GROWTH = 256 << 20
"""[B] of memory that a message of a few bytes may cost."""
GOES_ON = "ERROR malformed or limit and the next frame, or an end with a status other than 0"

Variant = tuple[str, Callable[[Session], None]]


def survive(kit: Kit, variants: Iterable[Variant], codes: tuple[str, ...], *, pardoned: bool = False) -> str:
    """Send each variant to a session in an episode, then a GRANT: the client answers both, or ends.

    Args:
        kit: Brings the client into an episode, a new life where the last variant ended it.
        variants: Name of each, and what sends it.
        codes: Codes of ERROR that are right answers.
        pardoned: Whether the client may also let a variant pass without an answer.

    Returns:
        The ways in which the client survived, each once.
    """
    ways: dict[str, None] = {}
    for name, send in variants:
        session = kit.at(ACTIVE)
        send(session)
        ways[_survived(session, name, codes, pardoned)] = None
    return "; ".join(ways)


def _survived(session: Session, name: str, codes: tuple[str, ...], pardoned: bool) -> str:
    # The GRANT after it shows that the client is still of use, and how far its answers are: without one, a
    # client that ignores a variant and one that is about to refuse it look alike.
    probe, expected, way = session.grant(), f"for {name}: {GOES_ON}", ""
    got = session.reaction(expected)
    if isinstance(got, Answer):
        if got.kind == "ERROR" and got.fields["code"] in codes:
            way = f"ERROR {got.fields['code']}"
        elif got.kind == "DONE" and pardoned:
            way = "passed over"
            session.judge(got, probe)
        else:
            raise Failed(expected, str(got))
        got = session.reaction(expected)
    if isinstance(got, End):
        got.check_failure(expected)
        return f"it ended with status {got.status}" if got.status is not None else "it ended"
    session.judge(got, probe)
    return way


def _bytes(*parts: bytes) -> Callable[[Session], None]:
    return lambda session: session.send_bytes(*parts)


@case("garbage", "Wrong things and their answers", GOES_ON)
def garbage(kit: Kit) -> str:
    """Bytes that are no message are refused."""
    noise = random.Random(5).randbytes(64)  # noqa: S311 - a failure has to repeat, so the seed is fixed
    return survive(
        kit,
        [
            ("an empty part", _bytes(b"")),
            ("noise", _bytes(b"\xc1" + noise)),
            ("a list", _bytes(pack([1, 2, 3]))),
            ("a map without type", _bytes(pack({"frame": 0}))),
            ("an unknown type", _bytes(pack({"type": "NONSENSE"}))),
            ("a type that is a number", _bytes(pack({"type": 7}))),
            ("GRANT without its fields", _bytes(pack({"type": "GRANT"}))),
        ],
        ("malformed", "limit", "unexpected"),
    )


@case("truncated", "Transport; Wrong things", GOES_ON)
def truncated(kit: Kit) -> str:
    """A multipart message with parts too few or too many is refused."""
    # Without inputs there is nothing to leave out.
    session = kit.at(ACTIVE)
    _, parts = session.granting(session.frame, Inputs())

    def cut(by: int) -> Callable[[Session], None]:
        def send(session: Session) -> None:
            fields, parts = session.granting(session.frame, Inputs())
            kept = [*parts, b"", b""][: len(parts) + by]
            session.send("GRANT", fields, *kept)

        return send

    variants = [("two parts too many", cut(2)), ("one part too many", cut(1))]
    if parts:
        variants += [("the last body left out", cut(-1)), ("the last product left out", cut(-2))]
    return survive(kit, variants, ("malformed", "limit"))


@case("lying-counts", "Limits", GOES_ON + "; little memory")
def lying_counts(kit: Kit) -> str:
    """A length that announces more than there is costs nothing."""
    huge = b"\xff\xff\xff\xff"
    # A decoder that allocates a list of 2³² − 1 items ahead takes 32 GiB, or dies.
    before = kit.at(ACTIVE).client.memory()

    def header(tail: bytes) -> Callable[[Session], None]:
        return _bytes(b"\x82\xa4type\xa5GRANT\xa6inputs" + tail)

    def half(session: Session) -> None:
        fields, parts = session.granting(session.frame, Inputs())
        packed = pack({"type": "GRANT", **fields})
        session.send_bytes(packed[: len(packed) // 2], *parts)

    way = survive(
        kit,
        [
            ("a list of 2³² − 1", header(b"\xdd" + huge)),
            ("a map of 2³² − 1", _bytes(b"\xdf" + huge)),
            ("a string of 2³² − 1", header(b"\xdb" + huge)),
            ("half a header", half),
        ],
        ("malformed", "limit"),
    )
    after = kit.at(ACTIVE).client.memory()
    if before and after and after - before > MAX_GROWTH:
        raise Failed(f"at most {MAX_GROWTH >> 20} MiB more", f"{(after - before) >> 20} MiB more")
    return way


@case("oversized", "Limits", "ERROR limit and the next frame, or an end with a status other than 0")
def oversized(kit: Kit) -> str:
    """Headers above MAX_HEADER are refused, of messages and of payloads."""

    def padded(session: Session) -> None:
        session.grant(None, None, padding="x" * MAX_HEADER)

    def product(session: Session) -> None:
        fields, parts = session.granting(session.frame, Inputs())
        session.send("GRANT", fields, bytes(MAX_HEADER + 1), *parts[1:])

    variants = [("a header of more than 1 MiB", padded)]
    if kit.at(ACTIVE).granting(0, Inputs())[1]:
        variants.append(("a payload header of more than 1 MiB", product))
    return survive(kit, variants, ("limit", "malformed"))


@case(
    "deep",
    "Limits",
    "the GRANT's answer or an ERROR, and the next frame, or an end with another status than 0",
)
def deep(kit: Kit) -> str:
    """An unknown field may nest to any depth: it is survived."""

    def send(session: Session) -> None:
        fields, parts = session.granting(session.frame, Inputs())
        packed = pack({"type": "GRANT", **fields})
        # One entry more in the head of the map (a fixmap, 0x8n), since no packer nests so deep.
        session.send_bytes(
            bytes([packed[0] + 1]) + packed[1:] + b"\xa3abc" + b"\x91" * 200_000 + b"\xc0", *parts
        )

    return survive(kit, [("200,000 lists in each other", send)], ("limit", "malformed"), pardoned=True)


@case("undecodable-input", "Wrong things and their answers", "FAULT that names topic and source, or an end")
def undecodable_input(kit: Kit) -> str:
    """A product that cannot be decoded is named in FAULT."""
    ways: dict[str, None] = {}
    for spoil in ("header", "body"):
        session = kit.at(ACTIVE)
        fields, parts = session.granting(session.frame, Inputs(spoil=spoil))
        if not parts or (spoil == "body" and not any(parts[1::2])):
            continue
        frame = session.grant(None, Inputs(spoil=spoil))
        ways[_faulted(session, frame, _victim(fields, parts))] = None
    if not ways:
        raise NotApplicable("it has no inputs in every frame")
    # A client need not read what it does not use: then it cannot find anything wrong with it.
    if set(ways) == {"DONE"}:
        raise NotApplicable("it did not read the product: it answered DONE")
    return "; ".join(ways)


def _victim(fields: Fields, parts: list[bytes]) -> list[str]:
    """Topics and sources of the products that are there."""
    present = [entry for entry in fields["inputs"] if entry["status"] != "absent"]
    return [word for entry in present for word in (entry["topic"], entry["source"])]


def _faulted(session: Session, frame: int, names: list[str]) -> str:
    expected = "FAULT that names topic and source"
    got = session.reaction(expected)
    if isinstance(got, End):
        got.check_failure(expected)
        return "it ended" if got.status is None else f"it ended with status {got.status}"
    if got.kind == "DONE":
        session.judge(got, frame)
        return "DONE"
    if got.kind != "FAULT" or got.fields.get("frame") != frame:
        raise Failed(f"{expected}, of frame {frame}", str(got))
    session.check_identity(got)
    if sum(name in got.fields["message"] for name in names) < 2:
        raise Failed(expected, repr(got.fields["message"]))
    # The frame is decided by its FAULT, so the next GRANT is of the next frame.
    session.frame += 1
    session.step()
    return "FAULT, and the next frame"


@case("stale-grant", "clause 1; Wrong things", "ERROR unexpected; the GRANT is not used")
def stale_grant(kit: Kit) -> str:
    """A GRANT of another epoch or attempt is not used."""
    # Earlier and later ones: a client may compare by < where it has to compare by ≠.
    others: list[Fields] = [{"epoch": EPOCH - 1}, {"attempt": ATTEMPT - 1}, {"epoch": EPOCH + 1}]
    for other in others:
        session = kit.at(ACTIVE)
        session.grant(None, None, **other)
        _unexpected(session, f"a GRANT of {other}")
    return "ERROR unexpected each time, and the right GRANT is answered"


@case("other-episode", "clauses 1, 16", "ERROR unexpected; the GRANT is not used")
def other_episode(kit: Kit) -> str:
    """A GRANT of an episode without RESET is not used."""
    session = kit.at(ACTIVE)
    session.grant(None, None, episode=session.episode + 7)
    _unexpected(session, "a GRANT of another episode")
    return "ERROR unexpected, and the right GRANT is answered"


def _unexpected(session: Session, what: str) -> None:
    """Check that ERROR unexpected comes, and that the next frame is answered as without ``what``."""
    session.expect_error("unexpected", f"ERROR unexpected for {what}")
    session.step()


@case("unexpected", "Wrong things and their answers", "ERROR unexpected, and the next frame")
def unexpected(kit: Kit) -> str:
    """A message that only a service sends is not for a service."""
    session = kit.at(ACTIVE)
    session.send("RESET_DONE", {**session.who, "episode": session.episode})
    _unexpected(session, "RESET_DONE")
    session.send("BYE", session.who)
    _unexpected(session, "BYE")
    return "ERROR unexpected, and the next frame"


@case(
    "complaints",
    "Wrong things and their answers",
    "no answer; the next frame, or an end with another status than 0",
)
def complaints(kit: Kit) -> str:
    """STALE and ERROR are never answered, and an unknown code is a code."""
    ways: dict[str, None] = {}
    stale: Fields = {"of": "DONE", "epoch": EPOCH, "attempt": ATTEMPT, "episode": 0, "frame": 0}
    for kind, fields in (("STALE", stale), ("ERROR", {"code": "from-the-future", "message": "no"})):
        session = kit.at(ACTIVE)
        session.send(kind, fields)
        probe = session.grant()
        got = session.reaction("the next frame, or an end")
        if isinstance(got, Answer):
            session.judge(got, probe)
            ways["the next frame"] = None
        else:
            ways[got.check_failure(f"an end with another status than 0 after {kind}")] = None
    return "; ".join(ways)


@case(
    "heartbeat-noise",
    "clause 2; Heartbeats and liveness",
    "heartbeats and frames go on, or an end with a status other than 0",
)
def heartbeat_noise(kit: Kit) -> str:
    """Nonsense on the heartbeat connection does not silence the client."""
    session = kit.at(ACTIVE)
    attached_heart(session)  # a slow client is active before its heart beats, and the noise would be lost
    since = len(session.pulse.beats)
    session.wire.send_parts(session.pulse.route or b"", [b"\xc1noise"])
    session.listen(BEATS * session.heartbeat_s)
    end = session.client.ended()
    if end is not None:
        return end.check_failure("heartbeats, or an end with a status other than 0")
    count = len(session.pulse.beats) - since
    if count < FEWEST_BEATS:
        raise Failed(f"about {BEATS} HEARTBEATs after it, or an end", f"{count}, and it is still there")
    session.step()
    return "goes on"


CASES = (
    stale_grant,
    other_episode,
    unexpected,
    undecodable_input,
    deep,
    garbage,
    truncated,
    lying_counts,
    oversized,
    complaints,
    heartbeat_noise,
)
