"""The ordered connection of a service to its broker: bounded waits, and what ends them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from typing import Any

import zmq

from caviar_protocol import limits
from caviar_protocol import messages as m
from caviar_protocol.codec import check_parts, decode_message, encode_message, message_type
from caviar_protocol.errors import ProtocolError, RunError, VersionError
from caviar_protocol.keys import Credentials
from caviar_services.handshake import Handshake, dress
from caviar_services.heartbeat import HeartbeatThread
from caviar_services.termination import Termination

_log = logging.getLogger("caviar.service")

_MORE = int(zmq.SNDMORE)  # pyzmq's flags are enumerations, which cost more than a small send
COPIED = 1 << 16
"""[B] Parts that are smaller are copied when they are sent, which is cheaper than to share them."""
POLL_MS = 50
"""[ms] between looks at the termination flag and the broker's heartbeat while waiting."""
SEND_TIMEOUT_MS = 5000
"""[ms] that a full queue to the broker is borne."""
LINGER_MS = 500
"""[ms] that closing waits until the last DONE and BYE are on their way."""
SILENCE_GRACE_S = 1.0
"""[s] from the broker's death, or from the end of the time in which it could be reached again, until a
service that is still busy is ended by force."""


class Terminated(BaseException):
    """SIGTERM came, or what the text says. An order, like KeyboardInterrupt, that no handler of errors
    shall swallow."""


class RunOver(BaseException):
    """SHUTDOWN came; the text is its reason. An order too."""


class Disconnected(BaseException):
    """The connections to the broker are lost; the text says how that is known. An order too, to the runner,
    which comes back or gives up."""


class UnansweredError(RunError):
    """The broker did not answer in time; it may later."""


class Connection:
    """Sends to and receives from the broker at ``endpoint`` for the service ``name``.

    Used by one thread; the heartbeat thread that `beat` starts has a socket of its own. ``credentials`` are
    for a broker with keys.
    """

    def __init__(
        self, name: str, endpoint: str, termination: Termination, credentials: Credentials | None = None
    ) -> None:
        self.name, self.endpoint, self._credentials = name, endpoint, credentials
        self._termination = termination
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.linger = LINGER_MS
        self._socket.rcvtimeo = POLL_MS
        self._socket.sndtimeo = SEND_TIMEOUT_MS
        self._socket.setsockopt(zmq.MAXMSGSIZE, limits.MAX_BODY)
        self._heartbeat: HeartbeatThread | None = None
        self._rejoin_s = 0.0
        self._end: threading.Event | None = None
        """Calls off the end of the process that the broker's silence brings about."""
        self._handshake = Handshake(self._context, self._socket, endpoint, credentials is not None)
        try:
            dress(self._socket, endpoint, credentials)
            self._socket.connect(endpoint)
        except zmq.ZMQError as error:
            self.close()
            raise RunError(
                f"cannot connect to {endpoint!r}: {error.strerror}; an address is like tcp://127.0.0.1:5570"
            ) from error

    def beat(self, welcome: m.Welcome) -> None:
        """Start the heartbeats."""
        self._rejoin_s = welcome.rejoin_ns / 1e9
        self._heartbeat = HeartbeatThread(
            self._context, self.endpoint, self.name, welcome, self._broker_is_gone, self._credentials
        )
        self._heartbeat.start()

    def progress(self, phase: str, grace_s: float = 0.0) -> None:
        """Say in the next heartbeat what is being done, and that it advances."""
        if self._heartbeat is not None:
            self._heartbeat.progress(phase, grace_s)

    def send(self, message: m.Message, *parts: bytes) -> None:
        """Send a message. Raises `Disconnected` where the broker takes none any more."""
        self.send_parts([encode_message(message), *parts])

    def send_parts(self, parts: Sequence[Any]) -> None:
        """Send what is encoded already; large parts are not copied."""
        send = self._socket.send
        try:
            for part in parts[:-1]:
                send(part, _MORE, len(part) < COPIED)
            send(parts[-1], 0, len(parts[-1]) < COPIED)
        except zmq.Again as error:
            raise Disconnected(f"the broker at {self.endpoint} takes no messages") from error

    def receive(self, timeout_s: float | None = None) -> tuple[m.Message, Sequence[zmq.Frame]]:
        """Next message and its further parts.

        Raises `Terminated` after SIGTERM, `RunOver` at SHUTDOWN, `Disconnected` when the broker is silent
        for longer than its liveness or does not know this service any more, and `UnansweredError` when
        ``timeout_s`` is over.
        """
        until = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            if self._termination.requested:
                raise Terminated
            received = self._next()
            if received is not None:
                return received
            self._handshake.check()
            silence = self._heartbeat.broker_silence if self._heartbeat else None
            if silence is not None:
                raise Disconnected(self._silence(silence))
            if until is not None and time.monotonic() > until:
                raise UnansweredError(
                    f"no answer from a broker at {self.endpoint} within {timeout_s:g} s; "
                    "is `caviar broker` running there?"
                )

    def abandon(self) -> None:
        """Close both connections, which are lost, at once."""
        self._socket.linger = 0
        self.close()
        if self._end is not None:  # asked behind the end of the heartbeat thread, which sets it
            self._end.set()

    def close(self) -> None:
        """End the heartbeats and close both connections."""
        if self._heartbeat is not None:
            self._heartbeat.stop()
        self._handshake.close()
        self._socket.close()
        self._context.term()

    def _next(self) -> tuple[m.Message, Sequence[zmq.Frame]] | None:
        """What comes within `POLL_MS`, unless it is nothing, or nonsense, which is answered."""
        try:
            parts = self._socket.recv_multipart(copy=False)
        except zmq.Again:
            return None
        try:
            message = decode_message(parts[0].buffer)
            check_parts(message, parts)
        except VersionError as error:
            raise RunError(f"the broker at {self.endpoint} cannot be talked to: {error}") from error
        except ProtocolError as error:
            _log.warning("the broker sent what is no message: %s", error)
            self.send(m.Error(code=error.code, message=str(error)))
            return None
        if isinstance(message, m.Shutdown):
            raise RunOver(message.reason)
        if isinstance(message, m.Error | m.Stale):
            _log.warning("the broker says: %s", message)
        if isinstance(message, m.Error) and message.code == "unknown-peer":
            raise Disconnected(
                f"the broker at {self.endpoint} does not know {self.name!r} any more ({message.message}): "
                "the connection was lost or the broker restarted"
            )
        return message, parts[1:]

    def _silence(self, seconds: float) -> str:
        return f"the broker at {self.endpoint} has been silent for {seconds:.1f} s"

    def _broker_is_gone(self) -> None:
        """Called by the heartbeat thread: the service may be in a call that never returns."""
        silence = (self._heartbeat.broker_silence if self._heartbeat else None) or 0.0
        words = f"caviar service {self.name}: {self._silence(silence)}; {self.name!r} gives up"
        self._end = self._termination.enforce(self._rejoin_s + SILENCE_GRACE_S, 1, words)


def describe(message: m.Message) -> str:
    """A message for an error text: its type, and for an ERROR what it says."""
    text = f": {message.message}" if isinstance(message, m.Error | m.Refuse) else ""
    return f"{message_type(message)}{text}"
