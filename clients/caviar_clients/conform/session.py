"""One life of a client, from HELLO to BYE, as a broker that follows a script sees it; scenery included."""

from __future__ import annotations

import hashlib
import math
import tempfile
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from caviar_clients.conform import canonical, street
from caviar_clients.conform.case import Failed
from caviar_clients.conform.client import BY_HAND_S, Client, End
from caviar_clients.conform.street import Inputs
from caviar_clients.conform.wire import Fields, Received, Wire, in_order
from caviar_protocol.fields import PARTS_SINCE, parse_version
from caviar_protocol.topics import PARTS

CHUNK = 700
"""[B] of an ASSET_DATA from the kit, so that even small files take several."""


def known_parts(topic: str, hello: Fields) -> list[str]:
    """Parts of a topic that the version of a client has."""
    spoken = tuple(hello["version"])
    return [
        part
        for part in PARTS.get(topic, ())
        if spoken >= parse_version(PARTS_SINCE.get(f"{topic}.{part}", "1.0"))
    ]


def _preparation(session: Session, topics: list[str], inputs: Inputs) -> Fields:
    """What PREPARE holds beside epoch and attempt."""
    order: Fields = {}
    if topics:
        known = {topic: known_parts(topic, session.hello) for topic in topics}
        order["demand"] = [{"topic": t, **({"parts": parts} if parts else {})} for t, parts in known.items()]
    if session.hello["role"] != "world":
        files = street.scenery(session.rules.mark)
        session.served = {hashlib.sha256(data).hexdigest(): data for data in files.values()}
        session.assets = [
            {"name": name, "digest": hashlib.sha256(data).hexdigest(), "size": len(data)}
            for name, data in files.items()
        ]
        order["assets"] = session.assets
    order["producers"] = {topic: list(names) for topic, names in sorted(inputs.sources.items())}
    if session.hello["role"] != "world":
        order["prefixes"] = {world: street.PREFIXES[world] for world in inputs.sources["scene"]}
    return order


def _serve_asset(session: Session, get: Fields) -> None:
    """Answer an ASSET_GET of the client."""
    digest, offset = get["digest"], get.get("offset", 0)
    data = session.served.get(digest)
    if data is None or offset > len(data):
        raise Failed("ASSET_GET of an asset of PREPARE", f"one of {digest[:12]}… from byte {offset}")
    chunk = data[offset : offset + CHUNK]
    session.fetched[digest] = session.fetched.get(digest, 0) + len(chunk)
    session.send("ASSET_DATA", {"digest": digest, "offset": offset, "size": len(data)}, chunk)


def _fetch_scenery(session: Session, offer: Fields) -> None:
    """Take a world's scenery, each file in as many parts as the world makes of it."""
    if session.hello["role"] != "world":
        raise Failed("READY", "ASSET_OFFER, which only worlds send")
    for asset in offer["assets"]:
        data = b""
        while True:
            session.send("ASSET_GET", {"digest": asset["digest"], "offset": len(data)})
            answer = session.receive("ASSET_DATA")
            if answer.kind == "READY":
                session.early.append(answer)
                answer = session.receive("ASSET_DATA")
            if answer.kind != "ASSET_DATA" or answer.fields["offset"] != len(data):
                raise Failed(f"ASSET_DATA from byte {len(data)}", str(answer))
            data += answer.parts[1]
            if len(data) >= asset["size"]:
                break
            if not answer.parts[1]:
                raise Failed("at least one byte of an ASSET_DATA before the end", "none")
        if hashlib.sha256(data).hexdigest() != asset["digest"]:
            raise Failed(f"bytes of {asset['name']} with the digest of its offer", "others")
        session.offered[asset["name"]] = data
    session.assets = list(offer["assets"])


EPOCH, ATTEMPT = 3, 2
"""Not 1, so that a client which does not repeat what it is told shows."""
SEED = 11
VERSION = (1, 4)
"""Of the protocol that the kit plays."""
CAPABILITIES = ("assets", "checkpoint", "episodes", "parts")
"""What a broker of that version has."""
LEFT_OVER = 100_000
"""Messages of a life that are thrown away before the next one, at most."""
LEAVING_S = 1.0
"""[s] that the connections of a life that is over are given to end."""
PATIENCE = 12
"""Times the time-out that a case, or a life in it, may take altogether."""
CONNECTING, JOINED, READY, ACTIVE, OVER = range(5)


@dataclass(frozen=True)
class Rules:
    """What the user told the kit about the client."""

    timeout_s: float = 5.0
    name: str = ""
    role: str = ""
    settings: Fields = field(default_factory=dict)
    directory: str | None = None
    """Where each life of a recorder gets a folder of its own."""
    mark: str = ""
    """Makes the scenery of this run unlike that of any other, so that no cache has it."""


@dataclass
class Seen:
    """What is remembered over all lives of a client."""

    headers: int = 0
    """How many messages came."""
    odd: list[str] = field(default_factory=list)
    """Headers that were not in canonical form, each kind once."""
    fetched: dict[str, int] = field(default_factory=dict)
    """Bytes of each asset, by digest, that the client asked for: it may keep them for its next life."""
    until: float = math.inf
    """When the case, or this life in it, has to be over, whatever the client still sends."""

    def allow(self, seconds: float) -> None:
        """From now on so much time."""
        self.until = time.monotonic() + seconds


@dataclass
class Pulse:
    """What came over the heartbeat connection."""

    route: bytes | None = None
    attached: list[Fields] = field(default_factory=list)
    beats: list[tuple[float, Fields]] = field(default_factory=list)
    """Each HEARTBEAT with the time [s] at which it came."""
    wrong: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Answer:
    """A message on the ordered connection, read and judged."""

    kind: str
    fields: Fields
    parts: list[bytes]

    def __str__(self) -> str:
        told = ("code", "message", "frame")
        words = {key: str(value)[:300] for key, value in self.fields.items() if key in told}
        return f"{self.kind} {words}" if words else self.kind


class Session:
    """Plays the broker for one life of the client."""

    def __init__(self, wire: Wire, client: Client, rules: Rules, seen: Seen) -> None:
        self.wire, self.client, self.rules = wire, client, rules
        self.stage, self.hello, self.ready = CONNECTING, Fields(), Fields()
        self.pulse, self.silent = Pulse(), False
        self.episode, self.frame, self.completed = -1, 0, -1
        """Of the episode, the frame that is granted next and the one completed last; −1: none."""
        self.assets: list[Fields] = []
        self.fetched = seen.fetched
        self.offered: dict[str, bytes] = {}
        """A world's scenery by name."""
        self.liveness_s = self.heartbeat_s = 0.0
        self._seen = seen
        self._route: bytes | None = None
        self._inbox: deque[Received] = deque()
        self.served: dict[str, bytes] = {}
        """Scenery that the kit has, by digest."""
        self.early: deque[Answer] = deque()
        """READY that came before the world's scenery was here, as it may."""

    @property
    def heard(self) -> bool:
        """Whether the client has sent anything."""
        return self._route is not None

    # --- receiving -----------------------------------------------------------------------------------

    def receive(self, expected: str, seconds: float | None = None) -> Answer:
        """The next message on the ordered connection; `Failed` where none comes or the client ends."""
        got = self.take(seconds)
        if isinstance(got, Answer):
            return got
        raise Failed(expected, str(got) if got else f"nothing within {self._seconds(seconds):g} s")

    def take(self, seconds: float | None = None) -> Answer | End | None:
        """The next message, or how the client ended, or None when the time is over."""
        now = time.monotonic()
        if now > self._seen.until:
            raise Failed(f"an end within {PATIENCE * self.rules.timeout_s:g} s", "ever more messages")
        until = now + self._seconds(seconds)
        while not self._inbox:
            end = self.client.ended() if self._route or self.client.start_s < BY_HAND_S else None
            heard = self.pump(0.02 if end is None else 0.1)
            if self._inbox:
                break
            if end is not None and not heard:
                return end
            if time.monotonic() > until:
                return None
        received = self._inbox.popleft()
        fields = canonical.checked(received)
        self._seen.headers += 1
        odd = canonical.not_canonical(received)
        if odd and odd not in self._seen.odd:
            self._seen.odd.append(odd)
        return Answer(fields["type"], fields, received.parts)

    def reaction(self) -> Answer | End | None:
        """As `take`; a client that says BYE first, as closing a WebSocket does, has ended all the same."""
        got = self.take()
        if isinstance(got, Answer) and got.kind == "BYE":
            return self.ended(self.rules.timeout_s, "its end after BYE")
        return got

    def pump(self, seconds: float) -> bool:
        """Take one message from the wire, and answer it where it is a heartbeat; whether there was one."""
        received = self.wire.poll(seconds)
        if received is None:
            return False
        if received.route == self.pulse.route or (self._route and received.kind == "ATTACH"):
            self._heard(received)
        elif self._route is None or received.route == self._route:
            self._route = received.route
            self._inbox.append(received)
        return True

    def listen(self, seconds: float) -> None:
        """Answer heartbeats for a while."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.pump(0.02)

    def _heard(self, received: Received) -> None:
        self.pulse.route = received.route
        try:
            fields = canonical.checked(received)
        except Failed as wrong:
            self.pulse.wrong.append(wrong.got)
            return
        if fields["type"] == "ATTACH":
            self.pulse.attached.append(fields)
        elif fields["type"] == "HEARTBEAT":
            self.pulse.beats.append((time.monotonic(), fields))
        else:
            self.pulse.wrong.append(fields["type"])
        if not self.silent:
            self.wire.send(received.route, {"type": "HEARTBEAT_ACK", "sequence": fields.get("sequence", 0)})

    def _seconds(self, seconds: float | None) -> float:
        return self.rules.timeout_s if seconds is None else seconds

    # --- sending -------------------------------------------------------------------------------------

    @property
    def who(self) -> Fields:
        """What stands in every message of this life (clause 1)."""
        return {"epoch": EPOCH, "attempt": ATTEMPT}

    def send(self, kind: str, fields: Fields | None = None, *parts: bytes) -> None:
        """Send a message on the ordered connection."""
        self.wire.send(self._route or b"", {"type": kind, **(fields or {})}, *parts)

    def send_bytes(self, *parts: bytes) -> None:
        """Send what may be no message."""
        self.wire.send_parts(self._route or b"", list(parts))

    def beat_back(self, kind: str, fields: Fields) -> None:
        """Send a message on the heartbeat connection."""
        self.wire.send(self.pulse.route or b"", {"type": kind, **fields})

    # --- the life of a client --------------------------------------------------------------------------

    def begin(self) -> None:
        """Start the client and wait for its HELLO."""
        self.client.start()
        self._seen.until = math.inf
        answer = self.receive("HELLO", self.client.start_s)
        self._seen.allow(PATIENCE * self.rules.timeout_s)
        if answer.kind != "HELLO":
            raise Failed("HELLO as the first message", str(answer))
        self.hello = answer.fields

    def welcome(self, heartbeat_s: float = 0.05, liveness_s: float = 3.0, **more: Any) -> None:
        """WELCOME; ``more`` are other values of its fields."""
        self.heartbeat_s, self.liveness_s = heartbeat_s, liveness_s
        is_recorder = self.hello["role"] == "recorder"
        directory = tempfile.mkdtemp(dir=self.rules.directory) if is_recorder else ""
        common = [name for name in self.hello.get("capabilities", []) if name in CAPABILITIES]
        fields: Fields = {
            "version": list(VERSION),
            "run": "conformance",
            **self.who,
            "capabilities": common,
            "heartbeat_ns": round(heartbeat_s * 1e9),
            "liveness_ns": round(liveness_s * 1e9),
            "seed": SEED,
            "settings": in_order(self.rules.settings),
            "scenario": in_order(street.briefing(self.hello, directory)),
        }
        fields = {key: value for key, value in fields.items() if value not in ([], {})}
        self.send("WELCOME", fields | more)
        self.stage = JOINED

    def prepare(self, *, demand: bool = True, inputs: Inputs | None = None, **more: Any) -> Answer:
        """PREPARE, and the exchange of scenery, up to READY."""
        hello = self.hello
        topics = [topic for topic in hello.get("outputs", []) if demand]
        self.send("PREPARE", {**self.who, **_preparation(self, topics, inputs or Inputs()), **more})
        while True:
            answer = self.early.popleft() if self.early else self.receive("READY")
            match answer.kind:
                case "ASSET_GET":
                    _serve_asset(self, answer.fields)
                case "ASSET_OFFER":
                    _fetch_scenery(self, answer.fields)
                case "READY":
                    self.check_identity(answer)
                    self.ready, self.stage = answer.fields, READY
                    return answer
                case _:
                    raise Failed("READY", str(answer))

    def reset(self, episode: int, *, seed_episode: int = 0, **more: Any) -> None:
        """RESET and its RESET_DONE."""
        fields: Fields = {**self.who, "episode": episode, "seed": SEED, "t0_ns": 0}
        if seed_episode:
            fields["seed_episode"] = seed_episode
        self.send("RESET", fields | more)
        answer = self.receive("RESET_DONE")
        if answer.kind != "RESET_DONE" or answer.fields["episode"] != episode:
            raise Failed(f"RESET_DONE of episode {episode}", str(answer))
        self.check_identity(answer)
        self.episode, self.frame, self.completed, self.stage = episode, 0, -1, ACTIVE

    # --- frames --------------------------------------------------------------------------------------

    def grant(self, frame: int | None = None, inputs: Inputs | None = None, **more: Any) -> int:
        """Send GRANT, of the next frame by default; the frame."""
        number = self.frame if frame is None else frame
        fields, parts = self.granting(number, inputs or Inputs(), **more)
        self.send("GRANT", fields, *parts)
        return number

    def granting(self, frame: int, inputs: Inputs, **more: Any) -> tuple[Fields, list[bytes]]:
        """Fields of a GRANT without its type, and the parts behind it."""
        entries, parts = inputs.of(self.hello.get("inputs", []), frame)
        fields: Fields = {**self.who, "episode": self.episode, "frame": frame}
        if self.completed >= 0:
            fields["previous_frame"] = self.completed
        fields |= {"t_ns": frame * street.PERIOD_NS, "budget_ns": 1_000_000_000}
        if entries:
            fields["inputs"] = entries
        return fields | more, parts

    def done(self, frame: int) -> Answer:
        """The DONE of a frame, judged."""
        return self.judge(self.receive(f"DONE of frame {frame}"), frame)

    def judge(self, answer: Answer, frame: int) -> Answer:
        """A DONE of this frame, or `Failed`."""
        if answer.kind != "DONE":
            raise Failed(f"DONE of frame {frame}", str(answer))
        self.check_identity(answer)
        got = (answer.fields["episode"], answer.fields["frame"])
        if got != (self.episode, frame):
            raise Failed(
                f"DONE of episode {self.episode}, frame {frame}", f"one of episode {got[0]}, frame {got[1]}"
            )
        canonical.check_products(answer.fields, answer.parts, self.hello.get("outputs", []))
        self.completed, self.frame = max(frame, self.completed), max(self.frame, frame + 1)
        return answer

    def step(self, inputs: Inputs | None = None, **more: Any) -> Answer:
        """Grant the next frame and judge its DONE."""
        return self.done(self.grant(None, inputs, **more))

    def check_identity(self, answer: Answer) -> None:
        """Epoch and attempt are those of WELCOME (clause 1)."""
        got = (answer.fields["epoch"], answer.fields["attempt"])
        if got != (EPOCH, ATTEMPT):
            raise Failed(f"epoch {EPOCH} and attempt {ATTEMPT} in {answer.kind}", f"{got[0]} and {got[1]}")

    # --- the end -------------------------------------------------------------------------------------

    def ended(self, seconds: float, expected: str) -> End:
        """How the client ends within this time; messages that still come are let be."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.pump(0.01)
            end = self.client.ended()
            if end is not None:
                self.stage = OVER
                return end
        raise Failed(expected, f"it is still there after {seconds:.1f} s")

    def close(self) -> None:
        """Let the client leave, or make it."""
        if self.stage in (JOINED, READY, ACTIVE) and self.client.ended() is None:
            self.send("SHUTDOWN", {"reason": "the case is over"})
            try:
                self.ended(min(self.rules.timeout_s, 2.0), "")
            except Failed:
                self.stage = OVER
        self.stage = OVER
        self.client.dispose()
        # What is on its way when a process ends comes before its connections are seen to end.
        until = time.monotonic() + LEAVING_S
        for _ in range(LEFT_OVER):
            late = time.monotonic() > until
            if self.wire.poll(0.0 if late else 0.01) is None and (late or not self.wire.connections):
                break
