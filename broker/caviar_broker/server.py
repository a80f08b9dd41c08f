"""Sockets and real time around the frame clock.

One ROUTER port carries everything. The loop sleeps until a message comes, a watched process dies or
the clock's next deadline is up; it never waits without a bound. Products are forwarded as the ZeroMQ
frames they came in, neither copied nor decoded.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import zmq

from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.core.plan import RunPlan
from caviar_broker.core.transitions import RunState
from caviar_broker.journal import JournalFile
from caviar_broker.processes import LocalProcess, watch
from caviar_broker.scenery import SceneryExchange
from caviar_broker.statistics import Statistics
from caviar_protocol import limits
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.codec import check_parts, decode_message, encode_message
from caviar_protocol.errors import AssetError, ProtocolError, RunError
from caviar_protocol.host import host_identity

PROCESS_CHECK_NS = 50_000_000
"""[ns] between looks at whether a local process is stopped; its death shows at once."""


class Observer(Protocol):
    """Who is told what happens in a run: the command line, a log, a page."""

    def notice(self, notice: ev.Notice) -> None:
        """Something the user should know."""

    def frame(self, frame: ev.FrameFinished, statistics: Statistics) -> None:
        """A frame is finished."""


@dataclass
class _Connection:
    """What is known of one routing id."""

    service: str
    heartbeat: bool


class BrokerServer:
    """Runs one plan on one port.

    Parameters
    ----------
    plan
        The run.
    endpoint
        Address to bind, ``tcp://127.0.0.1:0`` for any free port.
    journal
        Where decisions are written.
    observer
        Who is told.
    store
        Where scenery is kept.
    """

    def __init__(
        self,
        plan: RunPlan,
        endpoint: str,
        journal: JournalFile,
        observer: Observer,
        store: AssetStore | None = None,
    ) -> None:
        self.clock = FrameClock(plan, time.monotonic_ns())
        self.statistics = Statistics({s.name: s.budget_ns for s in plan.services})
        self.outcome: ev.Finished | None = None
        self.unwatched: set[str] = set()
        """Services whose death somebody else reports, who knows their exit status."""
        self._plan, self._journal, self._observer = plan, journal, observer
        self._scenery = SceneryExchange(store or AssetStore())
        self._deferred: dict[str, m.Ready] = {}
        self._connections: dict[bytes, _Connection] = {}
        self._routes: dict[str, bytes] = {}
        self._pulses: dict[str, bytes] = {}
        self._processes: dict[str, LocalProcess] = {}
        self._fds: dict[int, Callable[[], None]] = {}
        self._host = host_identity()
        self._replying: bytes = b""
        self._next_check = 0
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._open(endpoint)
        self.endpoint = self._socket.getsockopt_string(zmq.LAST_ENDPOINT)
        """Where services connect to."""
        self._poller = zmq.Poller()
        self._poller.register(self._socket, zmq.POLLIN)
        self._handlers: dict[type, Callable[[str, Any, Sequence[zmq.Frame]], None]] = {
            m.AssetOffer: self._asset_offer,
            m.AssetGet: self._asset_get,
            m.AssetData: self._asset_data,
            m.Ready: self._ready,
            m.ResetDone: self._reset_done,
            m.Done: self._done,
            m.Fault: self._fault,
            m.Bye: self._bye,
            m.Error: self._error,
        }

    def _open(self, endpoint: str) -> zmq.Socket[bytes]:
        socket = self._context.socket(zmq.ROUTER)
        liveness_ms = self._plan.limits.liveness // 1_000_000
        # A peer that is stopped or unreachable loses its connection before `liveness` is over, and
        # ROUTER_MANDATORY makes the next send to it fail: libzmq's own thread answers for a peer that
        # is merely busy, so a slow service is never taken for a dead one (clause 15).
        socket.setsockopt(zmq.ROUTER_MANDATORY, 1)
        socket.setsockopt(zmq.HEARTBEAT_IVL, max(1, liveness_ms // 3))
        socket.setsockopt(zmq.HEARTBEAT_TIMEOUT, max(1, liveness_ms // 2))
        socket.setsockopt(zmq.MAXMSGSIZE, limits.MAX_BODY)
        socket.linger = 500
        try:
            socket.bind(endpoint)
        except zmq.ZMQError as error:
            socket.close()
            self._context.term()
            raise RunError(
                f"cannot listen on {endpoint}: {error.strerror}; end what uses that port, or choose another "
                "with --bind tcp://127.0.0.1:PORT (0: any free one)"
            ) from error
        return socket

    # --- the loop ------------------------------------------------------------------------------------

    def watch_fd(self, fd: int, callback: Callable[[], None]) -> None:
        """Call back when a file descriptor is readable."""
        self._fds[fd] = callback
        self._poller.register(fd, zmq.POLLIN)

    def unwatch_fd(self, fd: int) -> None:
        """Undo `watch_fd`."""
        del self._fds[fd]
        self._poller.unregister(fd)

    def feed(self, event: ev.Event) -> None:
        """Give the clock an event from outside, and do what it wants."""
        self.clock.receive(event, time.monotonic_ns())
        self._perform()

    def run(self) -> ev.Finished:
        """Serve until the run is over."""
        try:
            while self.outcome is None:
                self._turn()
        finally:
            for process in self._processes.values():
                process.close()
            self._socket.close()
            self._context.term()
        return self.outcome

    def _turn(self) -> None:
        now = time.monotonic_ns()
        deadline = self.clock.next_deadline()
        wake = self._next_check if deadline is None else min(deadline, self._next_check)
        ready = self._poller.poll(max(0, -(-(wake - now) // 1_000_000)))
        for source, _ in ready:
            if source is self._socket:
                self._receive_all()
            elif source in self._fds:
                self._fds[source]()
        now = time.monotonic_ns()
        if now >= self._next_check:
            self._next_check = now + PROCESS_CHECK_NS
            self._check_peers()
        deadline = self.clock.next_deadline()
        if deadline is not None and deadline <= now:
            self.clock.expire(now)
            self._perform()

    def _receive_all(self) -> None:
        for _ in range(64):  # then look at deadlines again, however busy the port is
            try:
                parts = self._socket.recv_multipart(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            self._handle(parts)

    # --- what comes ----------------------------------------------------------------------------------

    def _handle(self, parts: list[zmq.Frame]) -> None:
        route = bytes(parts[0].buffer)
        try:
            message = decode_message(parts[1].buffer if len(parts) > 1 else b"")
            check_parts(message, parts[1:])
        except ProtocolError as error:
            self._refuse_bytes(route, error)
            return
        connection = self._connections.get(route)
        self._replying = route
        if isinstance(message, m.Hello):
            self._hello(route, message)
        elif isinstance(message, m.Attach):
            self._attach(route, message)
        elif connection is None:
            text = f"{_kind(message)} came before HELLO or ATTACH"
            self._reply(route, m.Error(code="unknown-peer", of=_kind(message), message=text))
        elif isinstance(message, m.Heartbeat) and connection.heartbeat:
            self._reply(route, m.HeartbeatAck(sequence=message.sequence))
            progressed = ev.Progressed(connection.service, message.progress, message.phase, message.grace_ns)
            self.feed(progressed)
        elif type(message) in self._handlers and not connection.heartbeat:
            self._handlers[type(message)](connection.service, message, parts[2:])
        else:
            text = f"{_kind(message)} is not for this connection of a broker"
            self._reply(route, m.Error(code="unexpected", of=_kind(message), message=text))

    def _refuse_bytes(self, route: bytes, error: ProtocolError) -> None:
        self._reply(route, m.Error(code=error.code, message=str(error)))
        connection = self._connections.get(route)
        if connection is not None:
            self.feed(ev.Violated(connection.service, f"sent what is not in the protocol: {error}"))

    def _hello(self, route: bytes, hello: m.Hello) -> None:
        before = self.clock.peer(hello.name)
        attempt = before.attempt if before else 0
        self._connections.setdefault(route, _Connection(hello.name, heartbeat=False))
        routes = dict(self._routes)
        self._routes[hello.name] = route  # WELCOME goes there
        self.clock.receive(ev.Joined(hello), time.monotonic_ns())
        peer = self.clock.peer(hello.name)
        if peer is None or peer.attempt == attempt:  # turned away: the one who has the name keeps it
            del self._connections[route]
            self._routes = routes
        elif hello.pid and hello.host and hello.host == self._host:
            self._watch(hello.name, hello.pid)
        self._perform()

    def _attach(self, route: bytes, attach: m.Attach) -> None:
        peer = self.clock.peer(attach.name)
        if peer is None or (attach.epoch, attach.attempt) != (self._plan.epoch, peer.attempt):
            self._reply(
                route, m.Error(code="unknown-peer", of="ATTACH", message=f"{attach.name!r} is not in the run")
            )
            return
        self._connections[route] = _Connection(attach.name, heartbeat=True)
        self._pulses[attach.name] = route
        self._reply(route, m.HeartbeatAck(sequence=0))

    def _asset_offer(self, service: str, message: m.AssetOffer, _: Sequence[zmq.Frame]) -> None:
        try:
            requests = self._scenery.offered(service, message.assets)
        except AssetError as error:
            self.feed(ev.Violated(service, f"offered wrong scenery: {error}"))
            return
        self.feed(ev.AssetsOffered(service, message.assets))
        for request in requests:
            self._reply(self._routes[service], request)

    def _asset_data(self, service: str, message: m.AssetData, parts: Sequence[zmq.Frame]) -> None:
        try:
            requests = self._scenery.taken(service, message, parts[0].buffer)
        except AssetError as error:
            self.feed(ev.Violated(service, f"sent wrong scenery: {error}"))
            return
        for request in requests:
            self._reply(self._routes[service], request)
        if self._scenery.complete(service) and service in self._deferred:
            self.feed(ev.ReadyReceived(service, self._deferred.pop(service)))

    def _asset_get(self, service: str, message: m.AssetGet, _: Sequence[zmq.Frame]) -> None:
        try:
            answer, chunk = self._scenery.read(message)
        except AssetError as error:
            refusal = m.Error(
                code="unknown-asset", of="ASSET_GET", subject=message.digest, message=str(error)
            )
            self._reply(self._routes[service], refusal)
        else:
            self._reply(self._routes[service], answer, chunk)

    def _ready(self, service: str, message: m.Ready, _: Sequence[zmq.Frame]) -> None:
        if self._scenery.complete(service):
            self.feed(ev.ReadyReceived(service, message))
        else:
            self._deferred[service] = message  # until its scenery is here

    def _reset_done(self, service: str, message: m.ResetDone, _: Sequence[zmq.Frame]) -> None:
        self.feed(ev.ResetDoneReceived(service, message))

    def _done(self, service: str, message: m.Done, parts: Sequence[zmq.Frame]) -> None:
        payloads = tuple(zip(parts[::2], parts[1::2], strict=True))
        self.feed(ev.DoneReceived(service, message, payloads))

    def _fault(self, service: str, message: m.Fault, _: Sequence[zmq.Frame]) -> None:
        self.feed(ev.FaultReceived(service, message))

    def _bye(self, service: str, message: m.Bye, _: Sequence[zmq.Frame]) -> None:
        self.feed(ev.ByeReceived(service, message.reason))

    def _error(self, service: str, message: m.Error, _: Sequence[zmq.Frame]) -> None:
        self._observer.notice(
            ev.Notice("note", service, f"could not use {message.of or 'a message'}: {message.message}")
        )

    # --- liveness ------------------------------------------------------------------------------------

    def _watch(self, service: str, pid: int) -> None:
        old = self._processes.pop(service, None)
        if old is not None:
            if old.fd in self._fds:
                self.unwatch_fd(old.fd)
            old.close()
        process = watch(pid)
        if process is None:
            return
        self._processes[service] = process
        if service not in self.unwatched:

            def died() -> None:
                self.unwatch_fd(process.fd)
                self.feed(ev.Lost(service, process.verdict()))

            self.watch_fd(process.fd, died)

    def _check_peers(self) -> None:
        """Look for local processes that are stopped, and probe remote ones."""
        for service, process in list(self._processes.items()):
            if process.stopped:
                self.feed(ev.Lost(service, f"its process {process.pid} is stopped (SIGSTOP or SIGTSTP)"))
        for service, route in list(self._pulses.items()):
            peer = self.clock.peer(service)
            if peer is None or not peer.present or service in self._processes or peer.heard_at is None:
                continue
            if time.monotonic_ns() - peer.heard_at > 2 * self._plan.limits.heartbeat:
                self._probe(service, route)

    def _probe(self, service: str, route: bytes) -> None:
        try:
            self._socket.send_multipart([route, encode_message(m.HeartbeatAck(sequence=0))], zmq.NOBLOCK)
        except zmq.Again:
            return
        except zmq.ZMQError as error:
            if error.errno != zmq.EHOSTUNREACH:
                raise
            self.feed(ev.Lost(service, "it is unreachable or stopped: its connection is gone"))

    # --- what goes -------------------------------------------------------------------------------------

    def _perform(self) -> None:
        """Carry out the clock's actions, until there are no more."""
        while actions := self.clock.actions():
            for action in actions:
                match action:
                    case ev.Send():
                        self._send(action)
                    case ev.Journal():
                        self._journal.write(action)
                        self.clock.receive(ev.Journaled(action.number), time.monotonic_ns())
                    case ev.Latency():
                        self.statistics.latency(action.service, action.elapsed_ns, action.missed)
                    case ev.FrameFinished():
                        self.statistics.frame(time.monotonic_ns())
                        self._observer.frame(action, self.statistics)
                    case ev.Notice():
                        self._observer.notice(action)
                    case ev.TurnAway():
                        self._reply(self._replying, action.refusal)
                    case ev.Finished():
                        self.outcome = action

    def _send(self, action: ev.Send) -> None:
        parts: list[Any] = [self._routes[action.service], encode_message(action.message)]
        for product in action.products:
            parts += product.payload
        try:
            self._socket.send_multipart(parts, zmq.NOBLOCK, copy=False)
        except zmq.ZMQError as error:
            if error.errno not in (zmq.EHOSTUNREACH, zmq.EAGAIN):
                raise
            if self.clock.state is not RunState.FINISHED:
                reason = (
                    "its connection is gone" if error.errno == zmq.EHOSTUNREACH else "it takes no messages"
                )
                self.clock.receive(
                    ev.Lost(action.service, f"it is unreachable: {reason}"), time.monotonic_ns()
                )

    def _reply(self, route: bytes, message: m.Message, *parts: bytes) -> None:
        """Answer a routing id; a peer that is gone meanwhile needs no answer."""
        try:
            self._socket.send_multipart([route, encode_message(message), *parts], zmq.NOBLOCK)
        except zmq.ZMQError as error:
            if error.errno not in (zmq.EHOSTUNREACH, zmq.EAGAIN):
                raise
            self._observer.notice(ev.Notice("note", "", f"{_kind(message)} reached nobody: {error.strerror}"))


def _kind(message: m.Message) -> str:
    return str(type(message).__struct_config__.tag)
