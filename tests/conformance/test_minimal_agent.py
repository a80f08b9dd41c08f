"""The minimal agent in Python leaves between two messages, also where SIGTERM comes amid one."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

AGENT = Path(__file__).resolve().parents[2] / "clients/minimal/agent.py"
STUB = '''
import atexit, json, os, signal, sys, threading, types
import msgpack

IDS = {"epoch": 3, "attempt": 2}
SCRIPT = [
    {"type": "WELCOME", "version": [1, 3], **IDS, "heartbeat_ns": 10**9, "liveness_ns": 10**12},
    {"type": "RESET", **IDS, "episode": 0},
    {"type": "GRANT", **IDS, "episode": 0, "frame": 0, "inputs": []},
]
SENT = []

class Socket:
    """A DEALER whose SIGTERM comes after the first part of DONE; a second caller of `send` is in its way."""

    def __init__(self):
        self.linger, self.lock = 0, threading.Lock()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def connect(self, _):
        pass

    def send(self, part):
        self.send_multipart([part])

    def send_multipart(self, parts):
        if threading.current_thread() is not threading.main_thread():
            return
        entered = self.lock.acquire(timeout=1)
        SENT.append(["deadlock"] if not entered else [])
        kind = msgpack.unpackb(parts[0])["type"]
        for part in parts:
            SENT[-1].append(kind)
            if kind == "DONE":
                os.kill(os.getpid(), signal.SIGTERM)
                kind = "part"
        self.lock.release()

    def poll(self, milliseconds):
        if threading.current_thread() is not threading.main_thread():
            threading.Event().wait()
        return bool(SCRIPT)

    def recv_multipart(self):
        return [msgpack.packb(SCRIPT.pop(0))]

class Context:
    __enter__, __exit__ = Socket.__enter__, Socket.__exit__
    def socket(self, _):
        return Socket()

sys.modules["zmq"] = types.SimpleNamespace(Context=Context, DEALER=None)
atexit.register(lambda: print(json.dumps(SENT)))
sys.argv = sys.argv[1:]
exec(compile(open(sys.argv[0]).read(), sys.argv[0], "exec"))
'''
"""A ``zmq`` that plays a broker up to a GRANT, and prints the messages that the agent sends, part by part."""


def test_sigterm_amid_a_message_does_not_cut_it_off() -> None:
    command = [sys.executable, "-c", STUB, str(AGENT), "tcp://nowhere:1", "mine"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert json.loads(ended.stdout) == [["HELLO"], ["RESET_DONE"], ["DONE", "part", "part"], ["BYE"]], (
        ended.stderr
    )
    assert ended.returncode == 143
