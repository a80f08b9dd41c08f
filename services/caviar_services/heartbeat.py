"""The heartbeat connection of a service: a thread of its own, a socket of its own (clause 2)."""

from __future__ import annotations

import logging
import os
import select
import signal
import threading
import time

import zmq

from caviar_protocol.codec import decode_message, encode_message
from caviar_protocol.errors import ProtocolError
from caviar_protocol.messages import Attach, Heartbeat, HeartbeatAck, Welcome

_log = logging.getLogger("caviar.heartbeat")

TERMINATION_GRACE_S = 1.5
"""[s] from SIGTERM until the process is ended from this thread, for a service that is busy in
compiled code and cannot see the signal."""


class HeartbeatThread(threading.Thread):
    """Tells the broker that this process lives, and watches that the broker does.

    The same thread watches for SIGTERM through ``set_wakeup_fd``: a Python signal handler does not
    run while the main thread is inside a compiled call.
    """

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], endpoint: str, name: str, welcome: Welcome
    ) -> None:
        super().__init__(name="heartbeat", daemon=True)
        self._context, self._endpoint = context, endpoint
        self._attach = Attach(epoch=welcome.epoch, attempt=welcome.attempt, name=name)
        self._interval = welcome.heartbeat_ns / 1e9
        self._liveness = welcome.liveness_ns / 1e9
        self._lock = threading.Lock()
        self._progress, self._phase, self._grace_ns = 0, "", 0
        self._halt = threading.Event()
        self._silent_since: float | None = None

    def progress(self, phase: str, grace_s: float = 0.0) -> None:
        """Say what the service is doing, and that it advances."""
        with self._lock:
            self._progress += 1
            self._phase, self._grace_ns = phase, round(grace_s * 1e9)

    @property
    def broker_silence(self) -> float | None:
        """For how long the broker has been silent [s], once that is too long; None while it lives."""
        since = self._silent_since
        return None if since is None else time.monotonic() - since

    def stop(self) -> None:
        """End the thread and wait for it."""
        self._halt.set()
        self.join(timeout=2 * self._interval + 1.0)

    def run(self) -> None:
        """Send heartbeats until told to stop."""
        with self._context.socket(zmq.DEALER) as socket:
            socket.linger = 0
            socket.connect(self._endpoint)
            socket.send(encode_message(self._attach))
            heard, sequence = time.monotonic(), 0
            while not self._halt.is_set():
                if socket.poll(round(self._interval * 1000)):
                    heard = self._drain(socket, heard)
                    if self._halt.wait(self._interval / 2):
                        break
                self._silent_since = heard if time.monotonic() - heard > self._liveness else None
                socket.send(self._heartbeat(sequence))
                sequence += 1

    def _heartbeat(self, sequence: int) -> bytes:
        with self._lock:
            return encode_message(
                Heartbeat(
                    sequence=sequence, progress=self._progress, phase=self._phase, grace_ns=self._grace_ns
                )
            )

    @staticmethod
    def _drain(socket: zmq.Socket[bytes], heard: float) -> float:
        while socket.poll(0):
            try:
                if isinstance(decode_message(socket.recv(zmq.NOBLOCK)), HeartbeatAck):
                    heard = time.monotonic()
            except ProtocolError as error:
                _log.warning("the broker sent what is no message: %s", error)
        return heard


class Termination:
    """SIGTERM and SIGINT as a flag, and as a certain end.

    A flag alone would not end a process that is inside a long compiled call, so a thread waits for
    the signal too and ends the process `TERMINATION_GRACE_S` later.
    """

    def __init__(self) -> None:
        self.requested = False
        self._read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.signal(signal.SIGTERM, self._handle)
        signal.signal(signal.SIGINT, self._handle)
        signal.set_wakeup_fd(self._write, warn_on_full_buffer=False)
        self._done = threading.Event()
        threading.Thread(target=self._watch, name="termination", daemon=True).start()

    def _handle(self, *_: object) -> None:
        self.requested = True

    def _watch(self) -> None:
        while not self._done.is_set():
            select.select([self._read], [], [])
            if {signal.SIGTERM, signal.SIGINT} & set(os.read(self._read, 64)):
                if not self._done.wait(TERMINATION_GRACE_S):
                    os._exit(128 + signal.SIGTERM)
                return

    def finished(self) -> None:
        """The process ends by itself; do not force it."""
        self._done.set()
