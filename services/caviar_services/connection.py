"""The connections of a service to its broker: ordered messages with bounded waits, and heartbeats.

`Connection` carries everything that is ordered. A `HeartbeatThread` has a socket of its own (contract,
clause 2) and watches that the broker lives. `Handshake` explains why a broker with keys does not let a
service in. `Termination` is the order to end, which both obey.
"""

from __future__ import annotations

import logging
import math
import os
import struct
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import zmq

from caviar_protocol import messages as m
from caviar_protocol.codec import check_parts, decode_message, encode_message, message_type
from caviar_protocol.errors import ProtocolError, RunError, VersionError
from caviar_protocol.fields import MAX_BODY
from caviar_protocol.host import SignOfLife
from caviar_protocol.keys import BROKER_KEY_VARIABLE, KEY_VARIABLE, Credentials
from caviar_protocol.messages import Attach, Heartbeat, HeartbeatAck, Welcome

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


class Termination:
    """The order to end, as a flag, and as a certain end of the process."""

    def __init__(self) -> None:
        self.requested = False
        self._called_off: list[threading.Event] = []

    def enforce(self, grace_s: float, status: int, last_words: str) -> threading.Event:
        """See to it that the process ends, unless it does so itself in time.

        Args:
            grace_s: Time until it is ended by force [s].
            status: Its exit status then.
            last_words: What it writes to standard error then.

        Returns:
            Set this event to call it off.
        """
        called_off = threading.Event()
        self._called_off.append(called_off)

        def end() -> None:
            if not called_off.wait(grace_s):
                self.end(status, last_words)

        threading.Thread(target=end, name="end", daemon=True).start()
        return called_off

    def end(self, status: int, last_words: str) -> None:
        """End the process at once. Arguments as for `enforce`."""
        sys.stderr.write(f"{last_words}\n")
        # Not `sys.exit`: a thread that is not the main one would end alone, and a call that does not return
        # keeps the interpreter from ending.
        os._exit(status)

    def finished(self) -> None:
        """Everything is closed; the process ends by itself."""
        for called_off in self._called_off:
            called_off.set()


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

    Used by one thread; the heartbeat thread that `beat` starts has a socket of its own.

    Args:
        name: Name of the service.
        endpoint: ZeroMQ address of the broker.
        termination: The order to end, which `receive` obeys.
        credentials: For a broker with keys.

    Raises:
        RunError: The address is none, or the keys are impossible.
    """

    def __init__(
        self, name: str, endpoint: str, termination: Termination, credentials: Credentials | None = None
    ) -> None:
        self.name, self.endpoint, self._credentials = name, endpoint, credentials
        self._termination = termination
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.linger = LINGER_MS
        # A wait in the socket itself: a poller would cost two calls more for each message.
        self._socket.rcvtimeo = POLL_MS
        self._socket.sndtimeo = SEND_TIMEOUT_MS
        # libzmq drops a connection on which more comes, before it is in memory.
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_BODY)
        self._heartbeat: HeartbeatThread | None = None
        self._rejoin_s = 0.0
        # Calls off the end of the process that the broker's silence brings about.
        self._end: threading.Event | None = None
        # What came while a step waited for something outside of the run.
        self._kept: deque[tuple[m.Message, Sequence[zmq.Frame]]] = deque()
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
        """Start the heartbeats.

        Args:
            welcome: Says how often, and how long the broker may be silent.
        """
        self._rejoin_s = welcome.rejoin_ns / 1e9
        self._heartbeat = HeartbeatThread(
            self._context, self.endpoint, self.name, welcome, self._broker_is_gone, self._credentials
        )
        self._heartbeat.start()

    def progress(self, phase: str, grace_s: float = 0.0) -> None:
        """Say in the next heartbeat what is being done, and that it advances.

        Args:
            phase: What is being done.
            grace_s: How long it may stay silent [s]; 0: the scenario's ``stall_s``.
        """
        if self._heartbeat is not None:
            self._heartbeat.progress(phase, grace_s)

    def send(self, message: m.Message, *parts: bytes) -> None:
        """Send a message.

        Args:
            message: The message.
            parts: What follows it.

        Raises:
            Disconnected: The broker takes no messages any more.
        """
        self.send_parts([encode_message(message), *parts])

    def send_parts(self, parts: Sequence[Any]) -> None:
        """Send what is encoded already; large parts are not copied. As of `send`."""
        send = self._socket.send
        try:
            for part in parts[:-1]:
                send(part, _MORE, len(part) < COPIED)
            send(parts[-1], 0, len(parts[-1]) < COPIED)
        except zmq.Again as error:
            self._handshake.check()  # a refused key leaves no connection to send on
            raise Disconnected(f"the broker at {self.endpoint} takes no messages") from error

    def receive(self, timeout_s: float | None = None) -> tuple[m.Message, Sequence[zmq.Frame]]:
        """Wait for the next message.

        Args:
            timeout_s: How long to wait [s]; None: as long as the broker lives.

        Returns:
            The message and its further parts.

        Raises:
            Terminated: SIGTERM came.
            RunOver: SHUTDOWN came.
            Disconnected: The broker is silent for longer than its liveness, or does not know this service any
                more.
            UnansweredError: ``timeout_s`` is over.
        """
        until = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            if self._termination.requested:
                raise Terminated
            received = self._kept.popleft() if self._kept else self._next()
            if received is not None:
                return received
            self._check_broker()
            if until is not None and time.monotonic() > until:
                raise UnansweredError(
                    f"no answer from a broker at {self.endpoint} within {timeout_s:g} s; "
                    "is `caviar broker` running there?"
                )

    def attend(self) -> None:
        """Look for orders in the middle of a step; other messages are kept for `receive`.

        Raises:
            Terminated, RunOver, Disconnected: As for `receive`.
        """
        if self._termination.requested:
            raise Terminated
        while self._socket.poll(0):
            received = self._next()
            if received is not None:
                self._kept.append(received)
        self._check_broker()

    def _check_broker(self) -> None:
        """Raise `Disconnected` where the broker is silent for longer than its liveness."""
        self._handshake.check()
        silence = self._heartbeat.broker_silence if self._heartbeat else None
        if silence is not None:
            raise Disconnected(self._silence(silence))

    def abandon(self) -> None:
        """Close both connections, which are lost, at once."""
        self._socket.linger = 0
        self.close()
        if self._end is not None:  # asked after the end of the heartbeat thread, which sets it
            self._end.set()

    def close(self) -> None:
        """End the heartbeats and close both connections."""
        if self._heartbeat is not None:
            self._heartbeat.stop()
        self._handshake.close()
        self._socket.close()
        self._context.term()

    def _next(self) -> tuple[m.Message, Sequence[zmq.Frame]] | None:
        """Message that comes within `POLL_MS`, unless it is nothing, or nonsense, which is answered."""
        receive = self._socket.recv
        try:
            part = receive(0, False)
        except zmq.Again:
            return None
        # Not `recv_multipart`: it asks the socket, by an option of its, what each frame knows already.
        parts = [part]
        while part.more:
            part = receive(0, False)
            parts.append(part)
        try:
            message = decode_message(parts[0].buffer)
            check_parts(message, parts)
        except VersionError as error:
            raise RunError(f"the broker at {self.endpoint} cannot be talked to: {error}") from error
        except ProtocolError as error:
            _log.warning("the broker sent what is no message: %s", error)
            self.send(m.Error(code=error.code, message=str(error)))
            return None
        if type(message) is m.Grant:
            return message, parts[1:]
        # An exception, since it ends whatever the service waits for: a frame, scenery, WELCOME.
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
    """Describe a message for an error text: its type, and for an ERROR or REFUSE what it says.

    Args:
        message: The message.

    Example:
        >>> describe(m.Shutdown(reason="done"))
        'SHUTDOWN'
    """
    text = f": {message.message}" if isinstance(message, m.Error | m.Refuse) else ""
    return f"{message_type(message)}{text}"


_EVENT = struct.Struct("=HI")
_WATCHED = (
    int(zmq.EVENT_HANDSHAKE_SUCCEEDED)
    | int(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL)
    | int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL)
    | int(zmq.EVENT_HANDSHAKE_FAILED_AUTH)
)
CONNECT_TIMEOUT_MS = 1000
"""[ms] after which an attempt to connect that is not answered is followed by another one."""
REPEATED = 3
"""Handshakes in a row that fail without a reason being given, which a broker that is just starting or
ending may cause once."""


def dress(socket: zmq.Socket[Any], endpoint: str, credentials: Credentials | None) -> None:
    """Give a socket what it needs before it connects. Raises `zmq.ZMQError` for impossible keys."""
    socket.setsockopt(zmq.IPV6, int("[" in endpoint))
    # The system sends the packet that opens a connection again after 1, 3, 7 and 15 s: after an outage of
    # 8 s it would be silent for 7 s more.
    socket.setsockopt(zmq.CONNECT_TIMEOUT, CONNECT_TIMEOUT_MS)
    if credentials is not None:
        credentials.apply_to(socket)


class Handshake:
    """Watches whether a socket, not connected yet, comes to terms with its broker."""

    def __init__(
        self, context: zmq.Context[Any], socket: zmq.Socket[Any], endpoint: str, with_keys: bool
    ) -> None:
        address = f"inproc://handshake-{id(self)}"
        socket.monitor(address, _WATCHED)
        self._watched = socket
        self._monitor = context.socket(zmq.PAIR)
        self._monitor.rcvhwm = 0  # no limit: a success that is dropped would leave failures counted
        self._monitor.connect(address)
        self._endpoint, self._with_keys = endpoint, with_keys
        self._failures = 0

    def check(self) -> None:
        """Raises `RunError` with the remedy, where the two do not come to terms."""
        while (kind := self._next()) is not None:
            if kind == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self._failures = 0
                continue
            self._failures += 1
            if kind == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
                raise RunError(
                    f"the broker at {self._endpoint} refused the key: it is not authorized there, or barred "
                    "for a while; on the broker's machine:  "
                    "caviar keys authorize NAME.pub --name NAME --role ROLE"
                )
            if kind == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL or self._failures >= REPEATED:
                raise RunError(self._disagreement())

    def close(self) -> None:
        """Stop watching."""
        if not self._monitor.closed:
            self._watched.disable_monitor()
            self._monitor.close(0)

    def _next(self) -> int | None:
        try:
            header, _ = self._monitor.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return None
        kind, _ = _EVENT.unpack(header)
        return int(kind)

    def _disagreement(self) -> str:
        if self._with_keys:
            return (
                f"there is no secure connection to {self._endpoint}: the broker's public key is not the one "
                f"given (--broker-key or {BROKER_KEY_VARIABLE}), or that broker has no keys"
            )
        return (
            f"{self._endpoint} does not let this service in: a broker there asks for keys "
            f"(--key and --broker-key, or {KEY_VARIABLE} and {BROKER_KEY_VARIABLE}), or it is no broker"
        )


_heartbeat_log = logging.getLogger("caviar.heartbeat")


class HeartbeatThread(threading.Thread):
    """Tells the broker that this process lives, and watches that the broker does.

    Args:
        context: Of the socket that the thread opens.
        endpoint: ZeroMQ address of the broker.
        name: Name of the service.
        welcome: Says how often to beat, and how long the broker may be silent.
        gone: Called once, in this thread, when the broker has been silent for longer than the run's liveness
            and at least two heartbeats are unanswered.
        credentials: For a broker with keys.
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
        # A descriptor, so that one poller waits for the socket and for the end at once.
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
        """Send heartbeats until `stop`, or until the broker is silent for too long."""
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
                self._sign.touch()
                continue
            # Only time in which this thread really listened counts as silence: while another thread
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
                _heartbeat_log.warning("the broker sent what is no message: %s", error)
                continue
            if isinstance(message, HeartbeatAck):
                heard = True
            else:
                _heartbeat_log.warning("the broker says on the heartbeat connection: %s", message)
