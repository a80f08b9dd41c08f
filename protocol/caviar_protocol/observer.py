"""Observer of a run: sees the newest finished frame of a broker, at any time, and holds nothing up.

An observer takes no part in the run: it is in no digest and no recording, and nothing waits for it. It
acknowledges what it got when it asks for the next: one that is slower than the run sees fewer frames, and
each of them is the newest.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import zmq

from caviar_protocol import messages as m
from caviar_protocol.arrays import Payload
from caviar_protocol.codec import check_parts, decode_message, decode_payload, encode_message
from caviar_protocol.errors import RunError
from caviar_protocol.fields import MAX_BODY
from caviar_protocol.keys import Credentials

EVERYTHING = (m.Subscription(topic="*"),)
TIMEOUT_S = 10.0
"""[s] in which the broker has to answer HELLO."""
LINGER_MS = 500
"""[ms] that closing waits until BYE is on its way."""
PROBE_MS, GONE_MS = 1000, 5000
"""[ms] between ZeroMQ's heartbeats, and without an answer until the broker counts as gone."""


@dataclass(frozen=True)
class ObservedProduct:
    """One product of a frame, as it travelled."""

    provenance: m.GrantInput
    """Topic, source, status, frame that it was made for, digest."""
    header: memoryview
    body: memoryview

    @cached_property
    def payload(self) -> Payload:
        """The decoded payload; raises `ProtocolError` where the bytes are none."""
        return decode_payload(self.provenance.topic, self.header, self.body)


@dataclass(frozen=True)
class Observation:
    """The newest finished frame of a run, or another state of it."""

    message: m.Observe
    """All that the broker said: `inputs` has what is absent, too."""
    products: Mapping[tuple[str, str], ObservedProduct]
    """By topic and source; empty where only the state is news."""

    @property
    def episode(self) -> int:
        """Episode of the frame."""
        return self.message.episode

    @property
    def frame(self) -> int:
        """Newest finished frame; −1: there is none yet."""
        return self.message.frame


class Observer:
    """Observer of the run of one broker: a context, and an iterator that ends with the run.

    For one thread. Between two observations it may take as long as `limits.observer_s` of the scenario, 10 s;
    then the broker disconnects it.

    Args:
        endpoint: ZeroMQ address of the broker.
        name: Unique in the run; with keys, the one that the key is authorized for.
        subscriptions: What to see; empty: each frame's number and no product.
        credentials: For a broker with keys.
        timeout_s: Time in which the broker has to answer [s].
        period_s: Least time from one observation to the next [s].

    Raises:
        RunError: No broker answers, or it refuses the observer; the text says why.

    Example:
        >>> Observer("tcp://127.0.0.1:9", name="eye", timeout_s=0.1)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        caviar_protocol.errors.RunError: no broker at tcp://127.0.0.1:9 answers within 0.1 s...
    """

    def __init__(
        self,
        endpoint: str,
        name: str = "observer",
        subscriptions: Sequence[m.Subscription] = EVERYTHING,
        credentials: Credentials | None = None,
        timeout_s: float = TIMEOUT_S,
        period_s: float = 0.0,
    ) -> None:
        self.endpoint, self._period_s = endpoint, period_s
        self.ended = ""
        """Why the run is over; empty while it goes on."""
        # Number of the OBSERVE that is not acknowledged, and when that may be sent [s].
        self._owed: int | None = None
        self._ready_at = 0.0
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._socket.linger = LINGER_MS
        self._socket.setsockopt(zmq.MAXMSGSIZE, MAX_BODY)
        self._socket.setsockopt(zmq.IPV6, int("[" in endpoint))
        self._socket.setsockopt(zmq.HEARTBEAT_IVL, PROBE_MS)
        self._socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, GONE_MS)
        self._monitor = self._socket.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._poller.register(self._monitor, zmq.POLLIN)
        try:
            if credentials is not None:
                credentials.apply_to(self._socket)
            self._socket.connect(endpoint)
            hello = m.Hello(
                version=m.PROTOCOL_VERSION,
                name=name,
                role="observer",
                capabilities=("observe",),
                subscriptions=tuple(subscriptions),
            )
            self._socket.send(encode_message(hello))
            self.welcome = self._welcomed(timeout_s)
            """What the broker said of the run: its id, epoch and seed."""
        except BaseException as error:
            self._close()
            if isinstance(error, zmq.ZMQError):
                raise RunError(f"cannot observe {endpoint!r}: {error.strerror}") from error
            raise

    def __enter__(self) -> Observer:
        """Observe until the block is left."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave."""
        self.close()

    def __iter__(self) -> Iterator[Observation]:
        """Yield observations until the run is over."""
        while (observation := self.receive()) is not None:
            yield observation

    def close(self) -> None:
        """Leave the run."""
        if not self._socket.closed and not self.ended:
            bye = m.Bye(epoch=self.welcome.epoch, attempt=self.welcome.attempt)
            self._socket.send(encode_message(bye), zmq.NOBLOCK)
        self._close()

    def receive(self, timeout_s: float | None = None) -> Observation | None:
        """Wait for the next observation.

        Args:
            timeout_s: How long [s]; None: until one comes, or the run is over.

        Returns:
            The observation; None where none came in time, or the run is over, as `ended` says.

        Raises:
            RunError: The connection is gone.
            ProtocolError: The broker sent what is not in the protocol.
        """
        until = None if timeout_s is None else time.monotonic() + timeout_s
        while not self.ended:
            now = time.monotonic()
            if self._owed is not None and now >= self._ready_at:
                self._socket.send(encode_message(m.Observed(sequence=self._owed)))
                self._owed = None
            if until is not None and now >= until:
                break
            waits = [until, self._ready_at if self._owed is not None else None]
            message, parts = self._next(min((at for at in waits if at is not None), default=None))
            match message:
                case m.Observe(sequence=number):
                    self._owed, self._ready_at = number, time.monotonic() + self._period_s
                    present = [entry for entry in message.inputs if entry.status is not m.Status.ABSENT]
                    pairs = zip(present, parts[::2], parts[1::2], strict=True)
                    products = {(e.topic, e.source): ObservedProduct(e, h, b) for e, h, b in pairs}
                    return Observation(message, products)
                case m.Shutdown(reason=reason):
                    self.ended = reason
                case m.Error(message=text) | m.Refuse(message=text):
                    raise RunError(f"the broker at {self.endpoint} refused the observer: {text}")
                case _:  # the time is up, or of a later minor version
                    pass
        return None

    def _welcomed(self, timeout_s: float) -> m.Welcome:
        message, _ = self._next(time.monotonic() + timeout_s)
        match message:
            case m.Welcome():
                if "observe" in message.capabilities:
                    return message
                raise RunError(f"the broker at {self.endpoint} is of an earlier version, without observers")
            case m.Refuse(message=text) | m.Error(message=text):
                raise RunError(f"the broker at {self.endpoint} refused the observer: {text}")
            case _:
                remedy = "is it running there, and does it ask for keys?"
                raise RunError(f"no broker at {self.endpoint} answers within {timeout_s:g} s; {remedy}")

    def _next(self, until: float | None) -> tuple[m.Message | None, list[memoryview]]:
        """The next message and its further parts; None where none comes until then [s]."""
        wait_ms = None if until is None else max(0, math.ceil((until - time.monotonic()) * 1e3))
        ready: dict[Any, int] = dict(self._poller.poll(wait_ms))
        if self._socket in ready:
            frames = self._socket.recv_multipart(copy=False)
            message = decode_message(frames[0].buffer)
            check_parts(message, frames)
            return message, [frame.buffer for frame in frames[1:]]
        if ready:
            raise RunError(f"the broker at {self.endpoint} has ended the connection, or is gone")
        return None, []

    def _close(self) -> None:
        if not self._socket.closed:
            self._socket.disable_monitor()
            self._monitor.close(0)
            self._socket.close()
            self._context.term()
