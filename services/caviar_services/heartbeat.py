"""The heartbeat connection of a service: a thread of its own, a socket of its own (clause 2)."""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections.abc import Callable

import zmq

from caviar_protocol.codec import decode_message, encode_message
from caviar_protocol.errors import ProtocolError
from caviar_protocol.host import SignOfLife
from caviar_protocol.keys import Credentials
from caviar_protocol.messages import Attach, Heartbeat, HeartbeatAck, Welcome
from caviar_services.handshake import dress

_log = logging.getLogger("caviar.heartbeat")


class HeartbeatThread(threading.Thread):
    """Tells the broker that this process lives, and watches that the broker does.

    ``gone`` is called in this thread when the broker has been silent for longer than the run's
    liveness, at least two heartbeats are unanswered, and then no more.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        endpoint: str,
        name: str,
        welcome: Welcome,
        gone: Callable[[], None],
        credentials: Credentials | None = None,
    ) -> None:
        super().__init__(name="heartbeat", daemon=True)
        self._context, self._endpoint, self._gone = context, endpoint, gone
        self._credentials = credentials
        self._attach = Attach(epoch=welcome.epoch, attempt=welcome.attempt, name=name)
        self._interval = welcome.heartbeat_ns / 1e9
        self._liveness = welcome.liveness_ns / 1e9
        self._lock = threading.Lock()
        self._progress, self._phase, self._grace_ns = 0, "", 0
        self._sign = SignOfLife()
        self._halt = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self.broker_silence: float | None = None
        """For how long the broker has been silent [s], once that is too long; None while it lives."""

    def progress(self, phase: str, grace_s: float = 0.0) -> None:
        """Say what the service is doing, and that it advances."""
        with self._lock:
            self._progress += 1
            self._phase, self._grace_ns = phase, round(grace_s * 1e9)

    def stop(self) -> None:
        """End the thread and wait for it."""
        os.eventfd_write(self._halt, 1)
        self.join(timeout=1.0)
        if not self.is_alive():
            os.close(self._halt)

    def run(self) -> None:
        """Send heartbeats until told to stop, or until the broker is silent for too long."""
        with self._context.socket(zmq.DEALER) as socket:
            socket.linger = 0
            dress(socket, self._endpoint, self._credentials)
            socket.connect(self._endpoint)
            socket.send(encode_message(self._attach), zmq.NOBLOCK)
            self._beat(socket)
        if self.broker_silence is not None:
            self._gone()

    def _beat(self, socket: zmq.Socket[bytes]) -> None:
        poller = zmq.Poller()
        poller.register(socket, zmq.POLLIN)
        poller.register(self._halt, zmq.POLLIN)
        due, sequence, answered, silence = time.monotonic(), 0, 0, 0.0
        while True:
            began = time.monotonic()
            if began >= due:
                socket.send(self._heartbeat(sequence), zmq.NOBLOCK)
                sequence += 1
                due = began + self._interval
            ready = dict(poller.poll(math.ceil((due - began) * 1000)))
            if self._halt in ready:
                return
            if socket in ready and self._heard(socket):
                answered, silence = sequence, 0.0
                self._sign.give()
                continue
            # Only time in which this thread really listened counts as silence: while somebody else
            # holds the interpreter's lock, answers wait in the socket.
            silence += min(time.monotonic() - began, self._interval)
            if silence > self._liveness and sequence - answered >= 2:
                self.broker_silence = silence
                return

    def _heartbeat(self, sequence: int) -> bytes:
        with self._lock:
            return encode_message(
                Heartbeat(
                    sequence=sequence, progress=self._progress, phase=self._phase, grace_ns=self._grace_ns
                )
            )

    @staticmethod
    def _heard(socket: zmq.Socket[bytes]) -> bool:
        """Take all that has come: whether an answer was among it."""
        heard = False
        while True:
            try:
                message = decode_message(socket.recv(zmq.NOBLOCK))
            except zmq.Again:
                return heard
            except ProtocolError as error:
                _log.warning("the broker sent what is no message: %s", error)
                continue
            if isinstance(message, HeartbeatAck):
                heard = True
            else:
                _log.warning("the broker says on the heartbeat connection: %s", message)
