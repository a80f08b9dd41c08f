"""A client that does everything right but one thing: broken_client.py ENDPOINT NAME FAULT [ROLE]

FAULT ``none`` is the control. Nothing but pyzmq and msgpack.
"""

from __future__ import annotations

import hashlib
import os
import signal
import sys
import threading
import time
from typing import Any

import msgpack
import zmq
from broken_world import scene

if sys.argv[4:] == ["channel"]:
    from broken_channel import channel

ENDPOINT, NAME, FAULT = sys.argv[1:4]
ROLE = sys.argv[4] if len(sys.argv) > 4 else "agent"
MAX_HEADER = 1 << 20
KNOWN = {
    "CHECKPOINT",
    "RESTORE",
    "RESET",
    "GRANT",
    "PREPARE",
    "CANCEL",
    "EPISODE_END",
    "SHUTDOWN",
    "STALE",
    "ERROR",
    "ASSET_GET",
}
KNOWN_TO_BROKERS = {"HELLO", "READY", "RESET_DONE", "DONE", "FAULT", "BYE", "WELCOME", "REFUSE", "ASSET_DATA"}
INPUTS = {
    "agent": [{"topic": "scene"}, {"topic": "link", "lag": 1, "required": False}],
    "world": [],
    "channel": [{"topic": "scene"}],
    "recorder": [{"topic": "*", "required": False}],
}
OUTPUTS = {"agent": ["action"], "world": ["scene"], "recorder": [], "channel": ["channel"]}
ballast: list[bytes] = []
asked_to_stop = threading.Event()


def bad(*names: str) -> bool:
    """Whether one of these is what this client does wrong."""
    return FAULT in names


class Beat(threading.Thread):
    """The heartbeat connection."""

    def __init__(self, context: Any, welcome: dict[str, Any], who: dict[str, int]) -> None:
        super().__init__(daemon=True)
        self.context, self.welcome, self.who = context, welcome, who
        self.quiet = False

    def run(self) -> None:
        if bad("never attaches"):
            return
        with self.context.socket(zmq.DEALER) as pulse:
            pulse.linger = 0
            pulse.connect(ENDPOINT)
            epoch = {"epoch": 1} if bad("attaches to another epoch") else {}
            pulse.send(msgpack.packb({"type": "ATTACH", **self.who, **epoch, "name": NAME}))
            self.beat(pulse)

    def beat(self, pulse: Any) -> None:
        every, liveness = self.welcome["heartbeat_ns"] / 1e9, self.welcome["liveness_ns"] / 1e9
        sequence, heard = 0, time.monotonic()
        while True:
            number = sequence * 2 if bad("skips sequence numbers") else sequence
            progress = 100 - sequence if bad("progress falls") else sequence
            beat = {"type": "HEARTBEAT", "sequence": number, **({"progress": progress} if progress else {})}
            if bad("says BYE on the heartbeat connection"):
                beat = {"type": "BYE", **self.who}
            while bad("floods with heartbeats"):
                pulse.send(msgpack.packb({"type": "HEARTBEAT", "sequence": 0}))
            if not self.quiet:
                pulse.send(msgpack.packb(beat))
            sequence += 1
            time.sleep(every * (8 if bad("beats too slowly") else 1))
            while pulse.poll(0):
                if pulse.recv()[:1] == b"\xc1" and bad("stops beating at noise"):
                    self.quiet = True
                heard = time.monotonic()
            if time.monotonic() - heard > liveness and not bad("bears silence"):
                os._exit(0 if bad("ends well in silence") else 1)


class Client:
    """The ordered connection."""

    def __init__(self) -> None:
        self.context = zmq.Context()
        self.broker = self.context.socket(zmq.DEALER)
        self.broker.linger = 1000
        self.broker.connect(ENDPOINT)
        self.who: dict[str, int] = {}
        self.devices: list[dict[str, Any]] = []
        self.episode, self.last, self.lived = -1, -1, 0
        self.active = False
        self.counted = 0
        """Frames answered in this episode, on which products depend: its state."""
        self.stored: dict[int, list[bytes]] = {}
        self.queue: list[list[bytes]] = []
        self.heart: Beat | None = None

    def say(self, kind: str, *parts: bytes, **fields: Any) -> None:
        self.broker.send_multipart([msgpack.packb({"type": kind, **fields}), *parts])

    def hello(self) -> None:
        outputs = ["weather"] if bad("declares an unknown topic") else OUTPUTS[ROLE]
        self.say(
            "HELLO",
            version=[2, 0] if bad("speaks another version") else [1, 4],
            name="somebody" if bad("has another name") else NAME,
            role="channel" if bad("has another role") else ROLE,
            **({"inputs": INPUTS[ROLE]} if INPUTS[ROLE] else {}),
            **({"outputs": outputs} if outputs else {}),
            capabilities=["assets", "episodes", "checkpoint"],
            **({"implementation": ""} if bad("writes out a default") else {}),
            max_in_flight=4,
        )

    def run(self) -> int:
        self.hello()
        while True:
            if not self.broker.poll(20):
                if asked_to_stop.is_set():
                    self.say("BYE", **self.who)
                    return 143
                continue
            parts = self.broker.recv_multipart()
            status = self.handle(parts)
            if status is not None:
                return status

    def handle(self, parts: list[bytes]) -> int | None:
        try:
            fields = self.read(parts)
        except Exception as error:
            return self.refuse("malformed", str(error))
        if len(parts[0]) > MAX_HEADER or any(len(part) > MAX_HEADER for part in parts[1::2]):
            return (
                self.refuse("limit", "too large")
                if not bad("takes oversized headers")
                else self.on(fields, parts)
            )
        return self.on(fields, parts)

    def refuse(self, code: str, message: str) -> int | None:
        if bad("crashes at nonsense"):
            os.abort()
        if bad("hangs at nonsense"):
            time.sleep(60)
        if bad("ends well at nonsense"):
            return 0
        if not bad("passes over nonsense"):
            self.say("ERROR", code=code, message=message[:200])
        return None

    def read(self, parts: list[bytes]) -> dict[str, Any]:
        if bad("allocates what is announced") and b"\xff\xff\xff\xff" in parts[0]:
            ballast.append(b"x" * (400 << 20))
        fields = msgpack.unpackb(parts[0])
        kind = fields["type"]
        if kind not in KNOWN | KNOWN_TO_BROKERS:
            raise ValueError(f"no type {kind}")
        if kind == "GRANT":
            present = [i for i in fields.get("inputs", []) if i["status"] != "absent"]
            if fields["frame"] < 0:
                raise ValueError("no such frame")
            if len(parts) != 1 + 2 * len(present) and not bad("does not count parts"):
                raise ValueError("wrong number of parts")
        read: dict[str, Any] = fields
        return read

    def on(self, fields: dict[str, Any], parts: list[bytes]) -> int | None:
        kind = fields["type"]
        if kind in ("WELCOME", "REFUSE"):
            return self.joined(fields)
        if kind == "SHUTDOWN":
            return self.leave()
        handler = getattr(self, f"on_{kind.lower()}", None)
        if handler is None:
            if not bad("passes over what is not due"):
                self.say("ERROR", code="unexpected", message=kind)
            return None
        result: int | None = handler(fields, parts)
        return result

    def joined(self, fields: dict[str, Any]) -> int | None:
        if fields["type"] == "REFUSE":
            if not bad("says nothing when refused"):
                sys.stderr.write(f"{fields['message']}\n")
            return 0 if bad("ends well when refused") else 1
        if fields["version"][0] != 1 and not bad("stays with another major version"):
            return 1
        if bad("accepts its own minor version only") and fields["version"][1] > 1:
            return 1
        if "epoch" in fields:
            self.who = {"epoch": fields["epoch"], "attempt": fields["attempt"]}
            self.devices = fields["scenario"]["devices"]
            self.heart = Beat(self.context, fields, self.who)
            self.heart.start()
        return None

    def leave(self) -> int | None:
        if bad("does not leave before PREPARE") and self.heart and self.episode < 0:
            return None
        if bad("stays after SHUTDOWN"):
            time.sleep(60)
        if not bad("leaves without BYE"):
            self.say("BYE", **self.who)
        if bad("talks after BYE"):
            self.say("ERROR", code="unexpected", message="one more thing")
        return 3 if bad("ends badly after SHUTDOWN") else 0

    def on_prepare(self, fields: dict[str, Any], parts: list[bytes]) -> None:
        if bad("wants demand") and not fields.get("demand"):
            return
        who = {**self.who, "epoch": 1} if bad("is READY in another epoch") else self.who
        ready: dict[str, Any] = {}
        if bad("holds another geometry"):
            ready["geometry"] = "0" * 64
        if bad("claims scenery that it did not fetch"):
            chain = "".join(f"{a['name']}\0{a['digest']}\0" for a in fields["assets"])
            ready["geometry"] = hashlib.sha256(chain.encode()).hexdigest()
        if bad("asks for scenery again and again"):
            self.say("ASSET_GET", digest=fields["assets"][1]["digest"])
            return
        if ROLE == "world":
            fixed = [device["name"] for device in self.devices if not device.get("on")]
            ready["prefixes"] = [NAME + ".", *fixed]
        self.say("READY", **who, **ready)

    def on_asset_get(self, fields: dict[str, Any], parts: list[bytes]) -> None:
        if not bad("passes over unknown assets"):
            self.say("ERROR", code="unknown-asset", message="no such asset", subject=fields["digest"])

    def on_asset_data(self, fields: dict[str, Any], parts: list[bytes]) -> None:
        self.say("ASSET_GET", digest=fields["digest"])

    def on_reset(self, fields: dict[str, Any], parts: list[bytes]) -> None:
        if self.active:
            self.say("ERROR", code="unexpected", message="RESET without EPISODE_END")
            return
        self.active = True
        self.episode, self.last, self.stored, self.counted = fields["episode"], -1, {}, 0
        episode = 9 if bad("resets another episode") else self.episode
        if bad("stops beating in frames") and self.heart:
            self.heart.quiet = True
        self.say("RESET_DONE", **self.who, episode=episode)

    def on_cancel(self, fields: dict[str, Any], parts: list[bytes]) -> None:
        if bad("complains of CANCEL"):
            self.say("ERROR", code="unexpected", message="CANCEL")

    def on_checkpoint(self, fields: dict[str, Any], parts: list[bytes]) -> None:
        saved = {key: fields[key] for key in ("episode", "frame")}
        if bad("saves the state of another frame"):
            saved["frame"] += 1
        if not bad("saves no state"):
            self.say("CHECKPOINT_DONE", self.counted.to_bytes(8, "little"), **self.who, **saved)

    def on_restore(self, fields: dict[str, Any], parts: list[bytes]) -> None:
        if len(parts[1]) != 8 and not bad("takes any state"):
            self.say("FAULT", **self.who, phase="restore", message="this is no state of mine")
            return
        if not bad("forgets its state"):
            self.counted = int.from_bytes(parts[1][:8], "little")
        if not bad("is not READY after RESTORE"):
            self.say("READY", **self.who)

    def on_episode_end(self, fields: dict[str, Any], parts: list[bytes]) -> None:
        self.active = False

    def on_stale(self, fields: dict[str, Any], parts: list[bytes]) -> None:
        if bad("answers complaints"):
            self.say("ERROR", code="unexpected", message="STALE")

    on_error = on_stale

    def on_grant(self, fields: dict[str, Any], parts: list[bytes]) -> int | None:
        identity = {key: fields[key] for key in self.who}
        if (identity != self.who and not bad("takes grants of other epochs")) or (
            fields["episode"] != self.episode and not bad("takes grants of other episodes")
        ):
            self.say("ERROR", code="unexpected", message="GRANT is not due")
            return None
        frame, inputs = fields["frame"], fields.get("inputs", [])
        statuses = {entry["status"] for entry in inputs}
        sources = [entry["topic"] for entry in inputs]
        if (
            (bad("ends at a held input") and "held" in statuses)
            or (bad("ends at an absent input") and "absent" in statuses and frame)
            or (bad("ends at a late input") and "late" in statuses)
            or (bad("ends at an unknown field") and "shade" in fields)
            or (bad("wants one source of each topic") and len(set(sources)) < len(sources))
            or (bad("wants frames in order") and 0 <= self.last < frame - 1)
            or (bad("ends at a frame of the past") and frame < self.last and frame not in self.stored)
        ):
            return 1
        if frame not in self.stored or bad("computes anew"):
            self.stored[frame] = self.answer(fields, parts)
            self.last = max(frame, self.last)
        self.answered(self.stored[frame])
        return None

    def answered(self, parts: list[bytes]) -> None:
        """Send an answer; the faulty one keeps what is queued and answers the newest first."""
        if bad("answers the newest grant first") and self.broker.poll(50):
            self.queue.append(parts)
            return
        self.broker.send_multipart(parts)
        while self.queue:
            self.broker.send_multipart(self.queue.pop())

    def answer(self, grant: dict[str, Any], parts: list[bytes]) -> list[bytes]:
        self.lived, self.counted = self.lived + 1, self.counted + 1
        frame, episode = grant["frame"], self.episode
        done: dict[str, Any] = {"type": "DONE", **self.who, "episode": episode, "frame": frame}
        if bad("answers another frame"):
            done["frame"] = frame + 1
        if bad("answers another episode"):
            done["episode"] = episode + 1
        if bad("answers in another epoch"):
            done["epoch"] = 1
        try:
            for header in parts[1::2]:
                msgpack.unpackb(header)
        except ValueError as error:
            names = " ".join(f"{e['topic']} of {e['source']}" for e in grant["inputs"])
            message = "oh no" if bad("does not say which input") else f"{names}: {error}"
            done["type"], done["phase"], done["message"] = "FAULT", "step", message
            return [msgpack.packb(done)]
        measured = {"measured": {"step": time.monotonic_ns()}}
        silent = OUTPUTS[ROLE] == [] or bad("makes no product")
        if silent or (grant.get("final") and not bad("acts in the final grant")):
            return [msgpack.packb({**done, **measured})]
        header, body = self.product(frame)
        digest = hashlib.sha256(len(header).to_bytes(8, "little") + header + body).hexdigest()
        digest = digest.upper() if bad("writes digests in capitals") else digest
        digest = "0" * 64 if bad("states a false digest") else digest
        topic = "link" if bad("makes what it did not declare") else OUTPUTS[ROLE][0]
        entry = {"topic": topic, "digest": digest}
        done["products"] = [entry, entry] if bad("makes a topic twice") else [entry]
        return [msgpack.packb({**done, **measured}), *([header, body] * len(done["products"]))]

    def product(self, frame: int) -> tuple[bytes, bytes]:
        if ROLE == "world":
            return scene(NAME, self.devices, frame, FAULT)
        if ROLE == "channel":
            return channel(frame, FAULT)
        beam = self.lived if bad("remembers the episode before") else self.counted % 4
        command: dict[str, Any] = {"type": "beam", "tx": "bs", "rx": "car.1/rx", "tx_beam": beam}
        if bad("writes out a default in a payload"):
            command["rx_beam"] = 0
        if bad("makes what is no payload"):
            del command["rx"]
        return msgpack.packb({"commands": [command]}), b"\0" * 8 if bad("pads the body") else b""


def look_on() -> int:
    """The whole life of an observer; its exit status."""
    socket = zmq.Context.instance().socket(zmq.DEALER)
    socket.connect(ENDPOINT)

    def send(**fields: Any) -> None:
        socket.send(msgpack.packb(fields))

    hello = {"name": NAME, "role": ROLE, "capabilities": ["observe"], "subscriptions": [{"topic": "*"}]}
    send(type="HELLO", version=[1, 7], **hello)
    while True:
        message = msgpack.unpackb(socket.recv_multipart()[0])
        if message["type"] == "OBSERVE":
            send(type="OBSERVED", sequence=message["sequence"] + bad("acknowledges another"))
        elif message["type"] == "REFUSE" or message.get("version", [1])[0] != 1:
            sys.stderr.write(message.get("message", "another major version"))
            return 1
        elif message["type"] == "SHUTDOWN":
            return 0


if not bad("dies of SIGTERM"):
    signal.signal(
        signal.SIGTERM, signal.SIG_IGN if bad("ignores SIGTERM") else lambda *_: asked_to_stop.set()
    )
status = look_on() if ROLE == "observer" else Client().run()
zmq.Context.instance().destroy(linger=500)
sys.stderr.flush()
time.sleep(0.05)  # what is sent last is on its way
os._exit(status)
