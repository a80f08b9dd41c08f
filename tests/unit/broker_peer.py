"""A service as a process of its own that goes wrong on order: ``broker_peer.py ENDPOINT LOCAL HOW``.

It plays the world up to its first grant, prints "granted", and then does what ``HOW`` says.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
import time

import msgpack
import zmq

ENDPOINT, LOCAL, HOW = sys.argv[1], sys.argv[2] == "local", sys.argv[3]


beating = threading.Event()
"""Set once the broker has heard a heartbeat."""


def identity() -> dict[str, object]:
    if not LOCAL:
        return {}
    from caviar_protocol.host import host_identity

    return {"host": host_identity(), "pid": os.getpid()}


def main() -> None:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.DEALER)
    socket.connect(ENDPOINT)

    def send(**fields: object) -> None:
        socket.send(msgpack.packb(fields))

    def receive(kind: str) -> dict[str, object]:
        assert socket.poll(20000)
        message = msgpack.unpackb(socket.recv_multipart()[0])
        assert message["type"] == kind, message
        return dict(message)

    send(type="HELLO", version=[1, 0], name="world", role="world", outputs=["scene"], **identity())
    welcome = receive("WELCOME")
    who = {key: welcome[key] for key in ("epoch", "attempt")}
    threading.Thread(target=beat, args=(context, who), daemon=True).start()
    receive("PREPARE")
    send(type="READY", **who)
    receive("RESET")
    send(type="RESET_DONE", episode=0, **who)
    receive("GRANT")
    assert beating.wait(20.0)
    sys.stdout.write("granted\n")
    sys.stdout.flush()
    if HOW == "wait":
        threading.Event().wait()
    elif HOW == "hold the interpreter":
        ctypes.PyDLL(None).usleep(2_000_000)
        digest = "0" * 64
        header = {
            "type": "DONE",
            "episode": 0,
            "frame": 0,
            "products": [{"topic": "scene", "digest": digest}],
        }
        socket.send_multipart([msgpack.packb(header | who), b"\x80", b""])
        threading.Event().wait()
    else:
        os._exit(int(HOW))


def beat(context: zmq.Context[zmq.Socket[bytes]], who: dict[str, object]) -> None:
    pulse = context.socket(zmq.DEALER)
    pulse.connect(ENDPOINT)
    pulse.send(msgpack.packb({"type": "ATTACH", "name": "world", **who}))
    sequence = answers = 0
    while True:
        pulse.send(msgpack.packb({"type": "HEARTBEAT", "sequence": sequence, "phase": "playing"}))
        sequence += 1
        until = time.monotonic() + 0.25
        while (left := until - time.monotonic()) > 0:
            if pulse.poll(left * 1000):
                pulse.recv()
                answers += 1
                if answers == 2:  # to ATTACH, and to the first heartbeat
                    beating.set()


main()
