"""Sockets and real time around the frame clock.

One ROUTER port carries everything. The loop sleeps until a message comes, a watched process dies or
the clock's next deadline is up; it never waits without a bound. Products are forwarded as the ZeroMQ
frames they came in, neither copied nor decoded.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import zmq

from caviar_broker.assets import AssetExchange
from caviar_broker.connections import COMPLAINTS, Connections, Router
from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.core.plan import RunPlan
from caviar_broker.core.run import Resumption
from caviar_broker.core.transitions import RunState
from caviar_broker.event_loop import EventLoop, Standby
from caviar_broker.journal import JournalFile, JournalWriter
from caviar_broker.security.access import Access
from caviar_broker.security.limits import PeerLimits
from caviar_broker.statistics import Statistics
from caviar_broker.supervision import CHECK_NS, Watchdog
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.codec import check_parts, decode_message, encode_message
from caviar_protocol.errors import ProtocolError, one_line
from caviar_protocol.files import Durability, file_system_of
from caviar_protocol.host import SignOfLife

LOOK_NS, UNHURRIED_LOOK_NS = 1_000_000, 4_000_000
"""[ns] until deadlines are looked at again, however busy the port is; where none can come soon, longer."""
SOON_NS = 8_000_000
"""[ns] What is due within this time is waited for exactly; else waits may be a millisecond longer."""
LONG_NS = 10_000_000
"""[ns] Budgets from here on bring nothing that would be due before deadlines are looked at again."""
DISK_NOTE_S = 2.0
"""[s] that the disk may take for an entry of the journal before a notice says so."""
MESSAGES_A_TURN = 64
"""Messages taken before the clock is looked at again."""
PROMPT_BYTES = 1 << 16
"""[B] of products in journal entries that are written while services are at work: 10 MB take milliseconds,
which the next frame would wait for."""
# Actions that no service waits for: carried out once the services have their grants.
_CAN_WAIT = frozenset({ev.Notice, ev.Latency, ev.FrameFinished})


class Listener(Protocol):
    """Gets what happens in a run: the command line, a log, a page. Must not wait."""

    def notice(self, notice: ev.Notice) -> None:
        """Something the user should know."""

    def frame(self, frame: ev.FrameFinished, statistics: Statistics) -> None:
        """A frame is finished."""


class BrokerServer:
    """Runs one plan on one port.

    Args:
        plan: The run.
        endpoint: Address to bind, ``tcp://127.0.0.1:0`` for any free port.
        journal: Where decisions are written.
        listener: Gets notices and finished frames.
        store: Where scenery is kept.
        supervised: Services whose death a launcher reports, which knows their exit status and last words.
        access: The keys of those who may take part; None: every process of this machine may.
        peer_limits: What each peer may use of the broker.
        resumption: What another broker left of the run.
        durability: When entries of the journal have to be on the disk.
        sync_recording: Puts on the disk what is recorded here.
    """

    def __init__(
        self,
        plan: RunPlan,
        endpoint: str,
        journal: JournalFile,
        listener: Listener,
        store: AssetStore | None = None,
        supervised: Sequence[str] = (),
        access: Access | None = None,
        peer_limits: PeerLimits | None = None,
        resumption: Resumption | None = None,
        durability: Durability = "none",
        sync_recording: Callable[[], None] = lambda: None,
    ) -> None:
        self.clock = FrameClock(plan, time.monotonic_ns(), payload_size=_payload_size, resumption=resumption)
        self.statistics = Statistics({s.name: s.budget_ns for s in plan.services})
        self.outcome: ev.Finished | None = None
        self._plan, self._listener = plan, listener
        # Number of the last journal entry that the clock knows to be handed over.
        self._confirmed = 0
        # [s] for which the disk had taken nothing at the last notice; 0: it takes what comes.
        self._disk_told = 0.0
        self._sign = SignOfLife()
        self.store = store or AssetStore()
        """Where files that services fetch are kept."""
        self._assets = AssetExchange(
            store=self.store,
            clock=self.clock,
            feed=self.feed,
            reply=self._reply,
            note=self.note,
            max_faces=plan.max_faces,
        )
        # Services that were sent a grant, and have answered none since.
        self._owing: set[str] = set()
        # Whether the clock took answers that it has not acted upon yet.
        self._has_answers = False
        # Frames of the episode that were finished when it last acted.
        self._finished_frames = 0
        # Decisions that are not in the journal yet.
        self._entries: list[ev.Journal] = []
        # Notices, latencies and finished frames, in order: no service waits for these.
        self._later: list[ev.Action] = []
        # [B] of the products in them.
        self._entered_bytes = 0
        self._next_check = self._look_at = 0
        self._budgets_are_long = not plan.realtime and all(s.budget_ns >= LONG_NS for s in plan.services)
        self._unhurried = False
        self._router = Router(endpoint, plan.timeouts.liveness, access, peer_limits)
        self._guard = self._router.guard
        self.access = access
        """The keys of those who may take part; None: every process of this machine may."""
        self.disk_answers = True
        """Whether the disk took all of the journal by the end of the run."""
        self.endpoint = self._router.endpoint
        """Where services connect to."""
        self.loop = EventLoop()
        """Others may have descriptors watched by it."""
        self.loop.watch(self._router.socket, self._receive_all)
        self._journal = JournalWriter(journal, durability, sync_recording)
        self._standby = Standby(self._turn, lambda: self.outcome is not None)
        self.loop.watch(self._standby.fd, self._disk_answers_again, prompt=True)
        self._watchdog = Watchdog(
            clock=self.clock,
            heartbeat_ns=plan.timeouts.heartbeat,
            liveness_ns=plan.timeouts.liveness,
            probe=lambda route: self._router.send(route, encode_message(m.HeartbeatAck(sequence=0))),
            lost=lambda service, verdict: self.feed(ev.Lost(service, verdict)),
            warn=self.note,
            gone_words=self._guard.gone_words,
            supervised=set(supervised),
        )
        self._connections = Connections(
            clock=self.clock,
            epoch=plan.epoch,
            router=self._router,
            loop=self.loop,
            watchdog=self._watchdog,
            assets=self._assets,
            feed=self.feed,
            perform=self._perform,
            note=self.note,
        )
        self._observers = self._connections.observers
        # On the path of every frame: looked up without a detour.
        self._known, self._routes = self._connections.known, self._connections.routes
        self._handlers: dict[type, Callable[[str, Any, Sequence[zmq.Frame]], None]] = {
            m.Done: self._done,
            m.Ready: self._assets.handle_ready,
            m.ResetDone: lambda name, message, _: self.feed(ev.ResetDoneReceived(name, message)),
            m.Fault: lambda name, message, _: self.feed(ev.FaultReceived(name, message)),
            m.Bye: lambda name, message, _: self.feed(ev.ByeReceived(name, message.reason)),
            m.CheckpointDone: lambda name, message, parts: self.feed(
                ev.CheckpointReceived(name, message, parts[0])
            ),
            m.Error: self._error,
            m.GeometryDone: lambda name, message, _: self.feed(ev.GeometryDoneReceived(name, message)),
            m.AssetOffer: self._assets.handle_offer,
            m.AssetGet: self._assets.handle_get,
            m.AssetData: self._assets.handle_data,
        }
        self._performers: dict[type, Callable[[Any], None]] = {
            ev.Latency: self._latency,
            ev.Overdue: lambda a: self.statistics.decision(time.monotonic_ns() - a.due_ns),
            ev.Notice: self._listener.notice,
            ev.FrameFinished: self._frame_finished,
            ev.EpisodeFinished: lambda _: None,  # its frames are reported one by one
            ev.TurnAway: self._connections.turn_away,
            ev.Finished: lambda outcome: setattr(self, "outcome", outcome),
        }

    # --- the loop ------------------------------------------------------------------------------------

    def feed(self, event: ev.Event) -> None:
        """Give the clock an event from outside, and do what it wants."""
        self.clock.receive(event, time.monotonic_ns())
        self._perform()

    def _latency(self, action: ev.Latency) -> None:
        now = time.monotonic_ns()
        self.statistics.latency(
            action.service, action.elapsed_ns, action.missed, action.episode, action.frame, now
        )

    def run(self, begin: Callable[[], object] = lambda: None) -> ev.Finished:
        """Serve until the run is over, in threads that call ``begin`` first."""
        try:
            self._standby.run(begin)
        finally:
            self._watchdog.close()
            self._observers.end(self.clock.error or m.RUN_COMPLETE)
            self._router.close()
            self.disk_answers = not self._standby.calling and self._journal.close()
            self._standby.close()
        if self.outcome is None:
            raise AssertionError("the loop ended before the run")
        return self.outcome

    @property
    def cpu_s(self) -> float:
        """CPU time that serving took, without what ZeroMQ's threads do, once it is over [s]."""
        return self._standby.cpu_s

    def _turn(self) -> None:
        """Serve the messages that are there; without any, or after `LOOK_NS` at the latest, see to deadlines.

        Deadlines are looked for once in `LOOK_NS` at most: that costs as much as an answer. Where nothing can
        be due soon, it is `UNHURRIED_LOOK_NS`, and others than the port wait that long and a millisecond.
        """
        now = time.monotonic_ns()
        if now >= self._look_at:
            wake = self._check_deadlines(now)
            self._flush()
            self._unhurried = self._budgets_are_long and wake - now > SOON_NS
            self._look_at = min(now + (UNHURRIED_LOOK_NS if self._unhurried else LOOK_NS), wake)
            self.loop.call(self.loop.poll(0 if self._router.readable else wake - time.monotonic_ns()))
        elif self._unhurried and not self._standby.calling:
            self._receive_all(wait=True)
        elif self._router.readable:
            self._receive_all()
        else:
            self.loop.call(self.loop.poll_sockets(self._look_at))
        self._flush()

    def _flush(self) -> None:
        """Write journal entries that must not wait, then run deferred actions.

        The others are written with the last one of their frame, or when deadlines are looked at: one write
        for all of them saves a call of the system, and two turns through the clock, for each service.
        """
        if self._entered_bytes >= PROMPT_BYTES or self.clock.waits_for_journal or self.clock.over:
            self._write_journal()
        while self._later:
            later, self._later = self._later, []
            for action in later:
                self._performers[type(action)](action)

    def _check_deadlines(self, now: int) -> int:
        """Act on whatever is due; the instant of the next thing that will be [ns]."""
        if now >= self._next_check:
            self._next_check = now + CHECK_NS
            self._watchdog.check(now)
            self._sign.touch()
            self._guard.check(now)
            self._look_at_disk()
            self._observers.check(now)
        self._write_journal()
        now = time.monotonic_ns()  # the disk may have taken its time
        deadline = self.clock.next_deadline()
        if deadline is None:
            return self._next_check
        if deadline <= now:
            self.clock.expire(now)
            self._perform()
            return now
        return min(deadline, self._next_check)

    def _receive_all(self, wait: bool = False) -> None:
        """Take what is there; with ``wait``, what comes within a millisecond."""
        for _ in range(MESSAGES_A_TURN):
            received = self._router.receive(wait)
            if received is not None:
                self._handle(*received)
            elif wait:
                break
            # Where no service owes an answer, there is none to be taken together with this one.
            if not self._owing or not self._router.readable:
                break
            wait = False
        if self._has_answers:  # what services answer together is acted upon once
            self._has_answers = False
            finished = self.clock.finished_frames
            if finished != self._finished_frames:
                self._finished_frames = finished
                self._perform()
                self._hand_over_entries()  # the next frame relies on them
            self.clock.settle(time.monotonic_ns())
            self._perform()

    # --- what comes ----------------------------------------------------------------------------------

    def _handle(self, route: bytes, parts: list[zmq.Frame]) -> None:
        try:
            message = decode_message(parts[0].buffer)
            check_parts(message, parts)
        except ProtocolError as error:
            self._connections.unreadable(route, error)
            return
        connection = self._known.get(route)
        if connection is None:
            self._connections.from_stranger(route, message)
        elif connection.heartbeat:
            self._connections.from_pulse(route, connection.service, message)
        elif (handler := self._handlers.get(type(message))) is not None:
            handler(connection.service, message, parts[1:])
        else:
            where = "the ordered connection of a service that is in the run"
            self._connections.unexpected(route, message, where)

    # --- answers -------------------------------------------------------------------------------------

    def _done(self, service: str, message: m.Done, parts: Sequence[zmq.Frame]) -> None:
        event = ev.DoneReceived(service, message, tuple(zip(parts[::2], parts[1::2], strict=True)))
        if self._assets.holds_back(event):
            return
        self.clock.handle(event, time.monotonic_ns())
        self._has_answers = True
        self._owing.discard(service)

    def _error(self, service: str, message: m.Error, _: Sequence[zmq.Frame]) -> None:
        if self._assets.handle_error(service, message):
            return
        text = f"could not use {message.of or 'a message'}: {message.message}"
        self._connections.note_rarely(f"error {service}", text, service)

    # --- what goes -------------------------------------------------------------------------------------

    def _perform(self) -> None:
        """Carry out the clock's actions, until there are no more; `_flush` sees to those that can wait."""
        while actions := self.clock.actions():
            for action in actions:
                if type(action) is ev.Send:
                    self._send(action)
                elif type(action) is ev.Journal:
                    self._entries.append(action)
                    for product in action.products:
                        self._entered_bytes += _payload_size(product.payload)
                elif type(action) in _CAN_WAIT:
                    self._later.append(action)
                else:
                    self._performers[type(action)](action)

    def _write_journal(self) -> None:
        """Clause 18: nothing that relies on an entry is granted before the system has it.

        Written once a grant waits for it, after the last answer of a frame, and whenever deadlines are
        looked at; so services that answer one after the other cost one write.
        """
        while self._entries and not self._standby.calling:
            self._hand_over_entries()
            self.clock.settle(time.monotonic_ns())
            self._perform()

    def _disk_answers_again(self) -> None:
        os.eventfd_read(self._standby.fd)
        self._look_at_disk()

    def _hand_over_entries(self) -> None:
        if not self._entries or self._standby.calling:
            return
        entries, self._entries, self._entered_bytes = self._entries, [], 0
        finished = self.clock.episode, self.clock.finished_frames - 1
        snapshot = self.clock.snapshot() if self._journal.wants_snapshot else None
        self._standby.call(lambda: self._journal.write(entries, finished, snapshot))
        confirmed, error = self._journal.confirmed, self._journal.error
        if error is not None:
            self.clock.handle(ev.StopRequested(str(error)), time.monotonic_ns())
        elif confirmed > self._confirmed:
            self._confirmed = confirmed
            self.clock.handle(ev.Journaled(confirmed), time.monotonic_ns())

    def _look_at_disk(self) -> None:
        """Tell of a disk that takes nothing, and that it does again."""
        since, doing = self._standby.calling_since, self._journal.doing
        waited = 0.0 if since is None else time.monotonic() - since
        if waited >= DISK_NOTE_S and not self._disk_told:
            place = f"{self._journal.path} ({file_system_of(self._journal.path)})"
            limit = f"at most {self._plan.timeouts.stall / 1e9:g} s (timeouts.stall_s)"
            text = f"the disk does not answer: {doing} of {place} has waited for {waited:.1f} s"
            self.note("", f"{text}; the run waits for it, {limit}", "disk")
        elif self._disk_told and not waited:
            self.note("", f"the disk answers again, after some {self._disk_told:.1f} s", "disk")
        self._disk_told = waited if waited >= DISK_NOTE_S else 0.0

    def _frame_finished(self, action: ev.FrameFinished) -> None:
        self.clock.digest.fold()
        self.statistics.frame(time.monotonic_ns(), action.episode, action.lag_ns)
        self._listener.frame(action, self.statistics)
        if self._observers.known:
            self._observers.frame_finished()

    def _send(self, action: ev.Send) -> None:
        parts: list[Any] = []
        for product in action.products:
            parts += product.payload
        if action.attachment is not None:
            parts.append(action.attachment)
        route, message = self._routes[action.service], action.message
        if type(message) is m.Grant:
            self._owing.add(action.service)
        complains = isinstance(message, COMPLAINTS)
        reason = self._router.send(route, encode_message(message), parts, not complains)
        # A complaint that does not go is no verdict: who floods gets one for each message, and reads none.
        if not reason or complains or self.clock.state is RunState.FINISHED:
            return
        if not self._watchdog.cut_off(action.service):
            verdict = f"it is unreachable: {reason}"
            self.clock.receive(ev.Lost(action.service, verdict), time.monotonic_ns())

    def _reply(self, service: str, message: m.Message, *parts: bytes) -> None:
        self._connections.reply(self._routes[service], message, *parts)

    def note(self, service: str, text: str, kind: str = "note") -> None:
        """Tell the listener something about a service, or in general."""
        self._listener.notice(ev.Notice(kind, service, one_line(text), self.clock.episode))


def _payload_size(payload: Sequence[zmq.Frame]) -> int:
    return sum(map(len, payload))
