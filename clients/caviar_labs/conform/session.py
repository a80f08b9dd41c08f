"""One life of a client, from HELLO to BYE, as a broker that follows a script sees it; scenery included.

A life passes the stages `CONNECTING` (HELLO came), `JOINED` (WELCOME was sent), `READY`, `ACTIVE` (in an
episode) and `OVER`. Cases drive it with `Session.welcome`, `Session.prepare`, `Session.reset` and
`Session.step`, each of which raises `Failed` where the client answers something else than it should.
"""

from __future__ import annotations

import hashlib
import math
import tempfile
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from caviar_labs.conform import canonical, street
from caviar_labs.conform.canonical import Answer
from caviar_labs.conform.client import (
    BY_HAND_S,
    Client,
    End,
    Failed,
    Fields,
    Received,
    Rules,
    Wire,
    in_order,
)
from caviar_labs.conform.street import Inputs

CHUNK = 700
"""[B] of an ASSET_DATA from the kit, so that even small files take several."""
EPOCH, ATTEMPT = 3, 2
"""Neither is 1, so that a client that sends constants instead of WELCOME's values is found."""
SEED = 11
VERSION = (1, 7)
"""Version of the protocol that the kit plays."""
CAPABILITIES = ("assets", "checkpoint", "episodes", "geometry", "observe", "parts")
"""Capabilities of a broker of that version."""
LEFT_OVER = 100_000
"""Messages of a life that are discarded before the next one, at most."""
LEAVING_S = 1.0
"""[s] for the connections of a life that is over to end."""
PATIENCE = 12
"""Times the time-out that a case, or a life in it, may take altogether."""
CONNECTING, JOINED, READY, ACTIVE, OVER = range(5)


@dataclass
class Seen:
    """Findings that are kept over all lives of a client."""

    headers: int = 0
    """Number of messages that came."""
    odd: list[str] = field(default_factory=list)
    """Headers that were not in canonical form, each kind once."""
    fetched: dict[str, int] = field(default_factory=dict)
    """Bytes of each asset, by digest, that the client asked for: it may keep them for its next life."""
    until: float = math.inf
    """When the case, or this life in it, has to be over, whatever the client still sends [s]."""

    def allow(self, seconds: float) -> None:
        """Set the end of the case to ``seconds`` from now."""
        self.until = time.monotonic() + seconds


@dataclass
class Pulse:
    """Messages that came over the heartbeat connection."""

    route: bytes | None = None
    attached: list[Fields] = field(default_factory=list)
    beats: list[Fields] = field(default_factory=list)
    """Each HEARTBEAT."""
    wrong: list[str] = field(default_factory=list)
    """What came beside ATTACH and HEARTBEAT."""


class Session:
    """Plays the broker for one life of a client.

    Args:
        wire: The kit's socket.
        client: Starts the client and says how it ended.
        rules: What the user states about it.
        seen: Memory over all lives, which this one adds to.
    """

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
        self.heartbeat_s = 0.0
        self._seen = seen
        self._route: bytes | None = None
        self._inbox: deque[Received] = deque()
        # Scenery that the kit has, by digest.
        self._served: dict[str, bytes] = {}
        # READY may overtake the world's last ASSET_DATA: a world states its geometry from its own files.
        self._early: deque[Answer] = deque()

    @property
    def heard(self) -> bool:
        """Tell whether the client has sent anything."""
        return self._route is not None

    # --- receiving -----------------------------------------------------------------------------------

    def receive(self, expected: str, seconds: float | None = None) -> Answer:
        """Return the next message on the ordered connection.

        Args:
            expected: What should come, for the verdict.
            seconds: Time for it [s]; None: the client's time-out.

        Raises:
            Failed: Nothing comes in time, or the client ends.
        """
        got = self.poll(seconds)
        if isinstance(got, Answer):
            return got
        raise Failed(expected, str(got) if got else self._nothing_within(seconds))

    def expect(self, kind: str, expected: str = "", seconds: float | None = None) -> Answer:
        """Return the next message, which has to be of this kind and, where it says, of this life."""
        answer = self.receive(expected or kind, seconds)
        if answer.kind != kind:
            raise Failed(expected or kind, str(answer))
        if "epoch" in answer.fields:
            self.check_identity(answer)
        return answer

    def expect_error(self, code: str, expected: str = "") -> None:
        """Check that the next message is an ERROR with this code."""
        expected = expected or f"ERROR {code}"
        answer = self.receive(expected)
        if (answer.kind, answer.fields.get("code")) != ("ERROR", code):
            raise Failed(expected, str(answer))

    def poll(self, seconds: float | None = None) -> Answer | End | None:
        """Return the next message, or how the client ended, or None when the time is over."""
        now = time.monotonic()
        # A client that sends without pause never lets a wait run out: the case as a whole has an end, too.
        if now > self._seen.until:
            raise Failed(f"an end within {PATIENCE * self.rules.timeout_s:g} s", "ever more messages")
        until = now + (self.rules.timeout_s if seconds is None else seconds)
        while not self._inbox:
            # A client started by hand has no connection before its first message, and has not ended then.
            end = self.client.ended() if self._route or self.client.start_s < BY_HAND_S else None
            # What a process sent last is on its way when its end is seen: it gets a longer look.
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

    def reaction(self, expected: str) -> Answer | End:
        """Return how the client reacts: a message, or its end; silence raises `Failed`.

        A client that says BYE first, as one that closes a WebSocket does, has ended all the same.
        """
        got = self.poll()
        if got is None:
            raise Failed(expected, self._nothing_within(None))
        if isinstance(got, Answer) and got.kind == "BYE":
            return self.ended(self.rules.timeout_s, "its end after BYE")
        return got

    def pump(self, seconds: float) -> bool:
        """Take one message from the wire, and answer it where it is a heartbeat; whether there was one."""
        received = self.wire.poll(seconds)
        if received is None:
            return False
        if received.route == self.pulse.route or (self._route and received.kind == "ATTACH"):
            self._take_heartbeat(received)
        elif self._route is None or received.route == self._route:
            self._route = received.route
            self._inbox.append(received)
        return True

    def listen(self, seconds: float) -> float:
        """Answer heartbeats for a while [s]; the longest time in it without a look at them [s]."""
        last = time.monotonic()
        until, longest = last + seconds, 0.0
        while (left := until - last) > 0:
            self.pump(min(left, 0.02))
            before, last = last, time.monotonic()
            longest = max(longest, last - before)
        return longest

    def _take_heartbeat(self, received: Received) -> None:
        self.pulse.route = received.route
        try:
            fields = canonical.checked(received)
        except Failed as wrong:
            self.pulse.wrong.append(wrong.got)
            return
        if fields["type"] == "ATTACH":
            self.pulse.attached.append(fields)
        elif fields["type"] == "HEARTBEAT":
            self.pulse.beats.append(fields)
        else:
            self.pulse.wrong.append(fields["type"])
        if not self.silent:
            self.beat_back("HEARTBEAT_ACK", {"sequence": fields.get("sequence", 0)})

    def _nothing_within(self, seconds: float | None) -> str:
        return f"nothing within {self.rules.timeout_s if seconds is None else seconds:g} s"

    # --- sending -------------------------------------------------------------------------------------

    @property
    def who(self) -> Fields:
        """Fields of every message of this life (clause 1)."""
        return {"epoch": EPOCH, "attempt": ATTEMPT}

    def send(self, kind: str, fields: Fields | None = None, *parts: bytes) -> None:
        """Send a message on the ordered connection."""
        self.wire.send(self._route or b"", {"type": kind, **(fields or {})}, *parts)

    def send_bytes(self, *parts: bytes) -> None:
        """Send parts that need not be a message."""
        self.wire.send_parts(self._route or b"", list(parts))

    def beat_back(self, kind: str, fields: Fields) -> None:
        """Send a message on the heartbeat connection."""
        self.wire.send(self.pulse.route or b"", {"type": kind, **fields})

    # --- the life of a client --------------------------------------------------------------------------

    def begin(self) -> None:
        """Start the client and wait for its HELLO."""
        self.client.start()
        # The start of an interpreter with its libraries counts neither for the case nor for the time-out.
        self._seen.until = math.inf
        answer = self.receive("HELLO", self.client.start_s)
        self._seen.allow(PATIENCE * self.rules.timeout_s)
        if answer.kind != "HELLO":
            raise Failed("HELLO as the first message", str(answer))
        self.hello = answer.fields

    def begin_episode(self, inputs: Inputs | None = None, **more: Any) -> None:
        """Take a client that said HELLO into episode 0; ``more`` are fields of PREPARE and RESET."""
        if self.stage == CONNECTING:
            self.welcome()
        self.prepare(inputs=inputs, **more)
        self.reset(0, **more)

    def welcome(self, heartbeat_s: float = 0.05, liveness_s: float = 3.0, **more: Any) -> None:
        """Send WELCOME.

        Args:
            heartbeat_s: Period of heartbeats [s].
            liveness_s: Silence after which the client has to end by itself [s].
            more: Other values of its fields.
        """
        self.heartbeat_s = heartbeat_s
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
        # Fields that equal their default are left out in canonical form, as a broker leaves them out.
        fields = {key: value for key, value in fields.items() if value not in ([], {})}
        self.send("WELCOME", fields | more)
        self.stage = JOINED

    def prepare(self, *, demand: bool = True, inputs: Inputs | None = None, **more: Any) -> Answer:
        """Send PREPARE, exchange scenery, and return READY.

        Args:
            demand: Whether anything takes the client's outputs.
            inputs: Sources of its inputs.
            more: Other values of the fields of PREPARE.
        """
        topics = [topic for topic in self.hello.get("outputs", []) if demand]
        self.send("PREPARE", {**self.who, **self._preparation(topics, inputs or Inputs()), **more})
        while True:
            answer = self._early.popleft() if self._early else self.receive("READY")
            match answer.kind:
                case "ASSET_GET":
                    self._serve_asset(answer.fields)
                case "ASSET_OFFER":
                    self._fetch_scenery(answer.fields)
                case "READY":
                    self.check_identity(answer)
                    self.ready, self.stage = answer.fields, READY
                    return answer
                case _:
                    raise Failed("READY", str(answer))

    def reset(self, episode: int, *, seed_episode: int = 0, **more: Any) -> None:
        """Send RESET and wait for its RESET_DONE.

        Args:
            episode: Number of the episode.
            seed_episode: Episode whose seed it has; 0: the field is left out.
            more: Other values of the fields of RESET.
        """
        fields: Fields = {**self.who, "episode": episode, "seed": SEED, "t0_ns": 0}
        if seed_episode:
            fields["seed_episode"] = seed_episode
        self.send("RESET", fields | more)
        answer = self.expect("RESET_DONE")
        if answer.fields["episode"] != episode:
            raise Failed(f"RESET_DONE of episode {episode}", str(answer))
        self.episode, self.frame, self.completed, self.stage = episode, 0, -1, ACTIVE

    # --- scenery -------------------------------------------------------------------------------------

    def _preparation(self, topics: list[str], inputs: Inputs) -> Fields:
        """Fields of PREPARE beside epoch and attempt."""
        order: Fields = {}
        if topics:
            known = {topic: street.known_parts(topic, self.hello) for topic in topics}
            order["demand"] = [
                {"topic": t, **({"parts": parts} if parts else {})} for t, parts in known.items()
            ]
        is_world = self.hello["role"] == "world"
        if not is_world:
            files = street.scenery(self.rules.mark)
            digests = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
            self._served = {digests[name]: data for name, data in files.items()}
            self.assets = [
                {"name": name, "digest": digests[name], "size": len(data)} for name, data in files.items()
            ]
            order["assets"] = self.assets
        order["producers"] = {topic: list(names) for topic, names in sorted(inputs.sources.items())}
        if not is_world:
            order["prefixes"] = {world: street.PREFIXES[world] for world in inputs.sources["scene"]}
        return order

    def serve(self, digest: str, data: bytes) -> None:
        """Have a file that the client may ask for.

        Args:
            digest: Its SHA-256.
            data: Its bytes.
        """
        self._served[digest] = data

    def serving(self, kind: str) -> Answer:
        """Return the next message but ASSET_GETs, which are answered; it has to be of this kind.

        Args:
            kind: Type of the message.
        """
        while (answer := self.receive(kind)).kind == "ASSET_GET":
            self._serve_asset(answer.fields)
        if answer.kind != kind:
            raise Failed(kind, str(answer))
        self.check_identity(answer)
        return answer

    def _serve_asset(self, get: Fields) -> None:
        """Answer an ASSET_GET of the client."""
        digest, offset = get["digest"], get.get("offset", 0)
        data = self._served.get(digest)
        if data is None or offset > len(data):
            raise Failed("ASSET_GET of an asset of PREPARE", f"one of {digest[:12]}… from byte {offset}")
        chunk = data[offset : offset + CHUNK]
        self.fetched[digest] = self.fetched.get(digest, 0) + len(chunk)
        self.send("ASSET_DATA", {"digest": digest, "offset": offset, "size": len(data)}, chunk)

    def _fetch_scenery(self, offer: Fields) -> None:
        """Take a world's scenery."""
        if self.hello["role"] != "world":
            raise Failed("READY", "ASSET_OFFER, which only worlds send")
        for asset in offer["assets"]:
            self.offered[asset["name"]] = self.fetch(asset)
        self.assets = list(offer["assets"])

    def fetch(self, asset: Fields) -> bytes:
        """Return a file of a world, in as many parts as the world makes of it.

        Args:
            asset: As in ASSET_OFFER.
        """
        data = b""
        while True:
            self.send("ASSET_GET", {"digest": asset["digest"], "offset": len(data)})
            answer = self.receive("ASSET_DATA")
            if answer.kind == "READY":
                self._early.append(answer)
                answer = self.receive("ASSET_DATA")
            if answer.kind != "ASSET_DATA" or answer.fields["offset"] != len(data):
                raise Failed(f"ASSET_DATA from byte {len(data)}", str(answer))
            data += answer.parts[1]
            if len(data) >= asset["size"]:
                break
            if not answer.parts[1]:
                raise Failed("at least one byte of an ASSET_DATA before the end", "none")
        if hashlib.sha256(data).hexdigest() != asset["digest"]:
            raise Failed(f"bytes of {asset['name']} with the digest of its offer", "others")
        return data

    # --- frames --------------------------------------------------------------------------------------

    def grant(self, frame: int | None = None, inputs: Inputs | None = None, **more: Any) -> int:
        """Send GRANT and return its frame.

        Args:
            frame: Number of the frame; None: the next one.
            inputs: How its inputs are to be; None: fresh and complete.
            more: Other values of its fields.
        """
        number = self.frame if frame is None else frame
        fields, parts = self.granting(number, inputs or Inputs(), **more)
        self.send("GRANT", fields, *parts)
        return number

    def granting(self, frame: int, inputs: Inputs, **more: Any) -> tuple[Fields, list[bytes]]:
        """Return the fields of a GRANT without its type, and the parts after it."""
        entries, parts = inputs.of(self.hello.get("inputs", []), frame)
        fields: Fields = {**self.who, "episode": self.episode, "frame": frame}
        if self.completed >= 0:
            fields["previous_frame"] = self.completed
        fields |= {"t_ns": frame * street.PERIOD_NS, "budget_ns": 1_000_000_000}
        if entries:
            fields["inputs"] = entries
        return fields | more, parts

    def done(self, frame: int) -> Answer:
        """Receive the DONE of a frame and judge it."""
        return self.judge(self.receive(f"DONE of frame {frame}"), frame)

    def judge(self, answer: Answer, frame: int) -> Answer:
        """Check that an answer is the DONE of a frame with right products, and return it."""
        if answer.kind != "DONE":
            raise Failed(f"DONE of frame {frame}", str(answer))
        self.check_identity(answer)
        self.check_frame(answer, frame)
        canonical.check_products(answer.fields, answer.parts, self.hello.get("outputs", []))
        self.completed, self.frame = max(frame, self.completed), max(self.frame, frame + 1)
        return answer

    def step(self, inputs: Inputs | None = None, **more: Any) -> Answer:
        """Grant the next frame and judge its DONE."""
        return self.done(self.grant(None, inputs, **more))

    def check_identity(self, answer: Answer) -> None:
        """Check that epoch and attempt are those of WELCOME (clause 1)."""
        got = (answer.fields["epoch"], answer.fields["attempt"])
        if got != (EPOCH, ATTEMPT):
            raise Failed(f"epoch {EPOCH} and attempt {ATTEMPT} in {answer.kind}", f"{got[0]} and {got[1]}")

    def check_frame(self, answer: Answer, frame: int) -> None:
        """Check that an answer is of a frame of the present episode."""
        got = (answer.fields["episode"], answer.fields["frame"])
        if got != (self.episode, frame):
            raise Failed(
                f"{answer.kind} of episode {self.episode}, frame {frame}",
                f"one of episode {got[0]}, frame {got[1]}",
            )

    # --- the end -------------------------------------------------------------------------------------

    def ended(self, seconds: float, expected: str) -> End:
        """Return how the client ends within this time [s]; messages that still come are ignored.

        Args:
            seconds: Time for it [s].
            expected: What should come, for the verdict.

        Raises:
            Failed: It does not end in time.
        """
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
        # What is on its way when a process ends comes before its connections are seen to end: a heartbeat
        # left in the socket would be the first message of the next life.
        until = time.monotonic() + LEAVING_S
        for _ in range(LEFT_OVER):
            late = time.monotonic() > until
            if self.wire.poll(0.0 if late else 0.01) is None and (late or not self.wire.connections):
                break
