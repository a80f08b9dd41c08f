"""The control channel of a running broker: its user asks there what goes on, and has it pause, step or stop.

A Unix socket in the run's directory, served by the broker's own loop. A request is one line of JSON,
``{"do": "why"}``; so is its answer, ``{"ok": true, …}`` or ``{"ok": false, "error": TEXT}``. After
``subscribe`` come lines with ``event`` too. See docs/howto/control-a-run.md.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
import zmq

from caviar_broker.control.socket import ControlSocket
from caviar_broker.core import events as ev
from caviar_broker.server import BrokerServer, Listener
from caviar_broker.statistics import Statistics
from caviar_protocol.errors import AssetError
from caviar_protocol.policies import PolicyFolder

MAX_REQUEST = 1 << 12
"""[B] of a request."""
MAX_WAITING = 1 << 18
"""[B] that may wait for a client that does not read; beyond that the connection is cut."""
MAX_CONNECTIONS = 32
"""Clients at once; another one is hung up on, and reads that too many ask."""
FRAME_EVENT_NS = 50_000_000
"""[ns] between ``frame`` events at least."""
MAX_STEPS = 1_000_000_000
MAX_ANSWERS = 200
"""Answers to grants of a service that a client gets at once, the newest ones."""
NOTED = ("note", "refused")
"""Kinds of notices that a client may give."""
BLAMES = frozenset({"miss", "lost", "away", "fault", "skipped"})
"""Kinds of notices that name a culprit."""

Answer = dict[str, Any]


class ControlServer:
    """Answers questions about one broker.

    It is the server's listener, in front of the one that it is given, so it knows the last blame.

    Args:
        directory: Directory of the run; the socket is made there.
        listener: Gets everything too.

    Raises:
        RunError: Another broker serves that directory, or no socket can be made.
    """

    def __init__(self, directory: Path, listener: Listener) -> None:
        # Before the broker itself exists: a second broker is refused before it touches anything of the run.
        self._place = ControlSocket(directory)
        self._given = PolicyFolder(directory)
        self._listener = listener
        self._server: BrokerServer | None = None
        self._callers: dict[int, _Caller] = {}
        self._last_blame: Answer | None = None
        self._next_frame_event = 0
        self._serving: dict[str, str] = {}
        self._orders: dict[str, Callable[[Mapping[str, Any]], Answer]] = {
            "status": self._status,
            "why": self._why,
            "latencies": lambda _: {"ok": True, "latencies": self._figures()},
            "pause": lambda _: self._ordered(ev.PauseRequested(), "the run is paused: no new frame begins"),
            "resume": lambda _: self._ordered(ev.ResumeRequested(), "the run goes on"),
            "step": self._step,
            "stop": self._stop,
            "policies": self._policies,
            "swap": self._swap,
            "scenery": self._scenery,
            "answers": self._answers,
            "gateway": self._gateway,
            "serving": self._note_serving,
            "note": self._note,
        }

    def attach(self, server: BrokerServer) -> None:
        """Begin to answer, in the server's loop."""
        # In the loop and not in a thread: an answer is of one instant between two frames, without locks.
        self._server = server
        self._place.announce(run=server.clock.plan.run, pid=os.getpid(), broker=server.endpoint)
        server.loop.watch(self._place.socket.fileno(), self._accept)

    def close(self) -> None:
        """Send subscribers the outcome, hang up, and remove socket and note."""
        outcome = self.server.outcome if self._server is not None else None
        if outcome is not None:
            line = {"error": outcome.error, "culprit": outcome.culprit, "digest": outcome.digest}
            self._tell({"event": "finished", **line})
        for caller in tuple(self._callers.values()):
            caller.close()
        if self._server is not None:
            self._server.loop.unwatch(self._place.socket.fileno())
        self._place.close()

    @property
    def server(self) -> BrokerServer:
        """The broker that answers here."""
        assert self._server is not None  # noqa: S101  # requests come after `attach` only
        return self._server

    # --- what the server tells ------------------------------------------------------------------------

    def notice(self, notice: ev.Notice) -> None:
        """Keep a notice that names a culprit, and pass every notice on."""
        fields: Answer = {"kind": notice.kind, "service": notice.service, "text": notice.text}
        fields |= {"episode": notice.episode, "frame": notice.frame}
        if notice.kind in BLAMES:
            # The wall clock, which a user compares with logs; everything else here is monotonic.
            self._last_blame = {**fields, "at": time.time()}
        self._tell({"event": "notice", **fields})
        self._listener.notice(notice)

    def frame(self, frame: ev.FrameFinished, statistics: Statistics) -> None:
        """Pass a frame on; subscribers get one in 50 ms at most, which is as often as a person reads."""
        self._listener.frame(frame, statistics)
        # The frame path: without a client it costs this one look.
        if not self._callers:
            return
        now = time.monotonic_ns()
        if now >= self._next_frame_event:
            self._next_frame_event = now + FRAME_EVENT_NS
            line = {"episode": frame.episode, "frame": frame.frame, "t_ns": frame.t_ns}
            line |= {"frames": statistics.frames, "misses": statistics.misses, "lag_ns": frame.lag_ns}
            self._tell({"event": "frame", **line})

    def _tell(self, line: Answer) -> None:
        # A copy, since a caller that does not read is closed while it is sent to, and forgotten.
        for caller in tuple(self._callers.values()):
            if caller.subscribed:
                caller.say(line)

    # --- connections ----------------------------------------------------------------------------------

    def _accept(self) -> None:
        try:
            connection, _ = self._place.socket.accept()
        except OSError:
            return  # who called has hung up already
        if len(self._callers) >= MAX_CONNECTIONS:
            connection.close()
            return
        connection.setblocking(False)
        caller = _Caller(connection, self)
        self._callers[connection.fileno()] = caller

    def forget(self, fd: int) -> None:
        """Forget a connection that is closed."""
        self._callers.pop(fd, None)

    def answer(self, line: bytes) -> tuple[Answer, bool]:
        """Answer one request.

        Args:
            line: A JSON object; its ``id``, where it has one, comes back in the answer.

        Returns:
            The answer, and whether events are wanted from now on.
        """
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):  # what is nested too deep is no request
            request = None
        if not isinstance(request, dict):
            return _refusal('a request is one JSON object a line, such as {"do": "status"}'), False
        tag = {"id": request["id"]} if "id" in request else {}
        name = request.get("do")
        if name == "subscribe":
            return {"ok": True, **tag}, True
        order = self._orders.get(name) if isinstance(name, str) else None
        if order is None:
            known = ", ".join([*self._orders, "subscribe"])
            return {**_refusal(f"there is no request {name!r:.80}; choose one of {known}"), **tag}, False
        return {**order(request), **tag}, False

    # --- questions ------------------------------------------------------------------------------------

    def _status(self, _: Mapping[str, Any]) -> Answer:
        view = msgspec.to_builtins(self.server.clock.status(time.monotonic_ns()))
        statistics = self.server.statistics
        figures = self._figures()
        for service in view["services"]:
            service.update(figures[service["name"]])
        counts = {"frames_finished": statistics.frames, "misses": statistics.misses}
        rate = {"frames_per_second": round(statistics.recent_rate(time.monotonic_ns()), 3)}
        where = {"endpoint": self.server.endpoint, **self._serving}
        return {"ok": True, "status": {**view, **counts, **rate, **where, "last_blame": self._last_blame}}

    def _why(self, _: Mapping[str, Any]) -> Answer:
        view = self.server.clock.status(time.monotonic_ns())
        found = {
            "run": view.run,
            "state": view.state,
            "paused": view.paused,
            "episode": view.episode,
            "frame": view.frame,
            "late": any(wait.late for wait in view.waits),
            "waits": msgspec.to_builtins(view.waits),
            "last_blame": self._last_blame,
            "error": view.error,
        }
        return {"ok": True, "why": found}

    def _figures(self) -> dict[str, Answer]:
        return {
            name: msgspec.to_builtins(figures)
            for name, figures in self.server.statistics.recent_services().items()
        }

    def _scenery(self, _: Mapping[str, Any]) -> Answer:
        assets = msgspec.to_builtins(self.server.clock.scenery)
        return {"ok": True, "assets": assets, "store": str(self.server.store.folder)}

    def _answers(self, request: Mapping[str, Any]) -> Answer:
        """Answers to grants that came after the first so many of each service."""
        known = request.get("known", {})
        statistics = self.server.statistics
        found = {}
        for service in self.server.clock.plan.services:
            first = known.get(service.name, 0) if isinstance(known, dict) else 0
            newest = statistics.granted(service.name) - MAX_ANSWERS
            first = max(first if type(first) is int else 0, newest, 0)
            found[service.name] = {"first": first, "rows": statistics.answers(service.name, first).tolist()}
        return {"ok": True, "answers": found}

    # --- orders ---------------------------------------------------------------------------------------

    def _step(self, request: Mapping[str, Any]) -> Answer:
        frames = request.get("frames", 1)
        # The type and not an instance of it: true is an integer of Python.
        if type(frames) is not int or not 1 <= frames <= MAX_STEPS:
            return _refusal(f"frames is {frames!r:.80}, it is a whole number from 1 to {MAX_STEPS}")
        if not self.server.clock.status(time.monotonic_ns()).paused:
            return _refusal("the run is not paused; pause it first")
        return self._ordered(ev.StepRequested(frames), f"{frames} more frames begin")

    def _stop(self, request: Mapping[str, Any]) -> Answer:
        reason = request.get("reason") or "stopped at the broker's desk"
        if not isinstance(reason, str) or len(reason) > 500:
            return _refusal("reason is a text of at most 500 characters")
        return self._ordered(ev.StopRequested(reason), "")

    def _policies(self, _: Mapping[str, Any]) -> Answer:
        served = msgspec.to_builtins(self.server.clock.policies)
        return {"ok": True, "policies": served, "store": str(self.server.store.folder)}

    def _swap(self, request: Mapping[str, Any]) -> Answer:
        """Announce a policy that was put into the run's directory to the agent that shall serve it."""
        agent, digest = request.get("agent"), request.get("sha256")
        if not isinstance(agent, str) or agent not in self.server.clock.policies:
            known = ", ".join(self.server.clock.policies) or "none"
            return _refusal(f"agent is {agent!r:.80}; agents that serve policies: {known}")
        path = self._given.files(agent).get(str(digest))
        if path is None:
            return _refusal(f"sha256 is {digest!r:.80}, and there is no such file in policies/{agent}")
        # Who asks has put it there: to hash a large file here would hold up the frames of everybody. The
        # agent looks at the hash too.
        if not self.server.store.path(wanted := str(digest)).is_file():
            try:
                found = self.server.store.add(f"policies/{agent}.onnx", path)
            except AssetError as error:
                return _refusal(str(error))
            if found.digest != wanted:
                return _refusal(f"{path} has the SHA-256 {found.digest}: it was changed")
        text = f"policy {wanted[:12]}… is offered to {agent}"
        return self._ordered(ev.PolicyOffered(agent, wanted), text)

    def _ordered(self, event: ev.Event, text: str) -> Answer:
        if self.server.outcome is not None or self.server.clock.over:
            return _refusal("the run is over")
        if text:
            self.server.note("", text)
        self.server.feed(event)
        view = self.server.clock.status(time.monotonic_ns())
        return {"ok": True, "state": view.state, "paused": view.paused, "frame": view.frame}

    def _gateway(self, _: Mapping[str, Any]) -> Answer:
        """Place and key with which the gateway connects: who may ask here may read the keys folder, too."""
        access = self.server.access
        if access is None:
            return {"ok": True, "keys": None}
        pair = msgspec.to_builtins(access.gateway)
        return {"ok": True, "keys": str(access.directory.resolve()), **pair, "broker": access.pair.public}

    def _note_serving(self, request: Mapping[str, Any]) -> Answer:
        url = request.get("http")
        if not isinstance(url, str) or len(url) > 300:
            return _refusal("http is the address that is served")
        self._serving = {"http": url}
        self._place.announce(http=url)
        self.server.note("", f"HTTP is served at {url}")
        return {"ok": True}

    def _note(self, request: Mapping[str, Any]) -> Answer:
        service, text, kind = (
            request.get(k, d) for k, d in (("service", ""), ("text", ""), ("kind", "note"))
        )
        known = isinstance(service, str) and (not service or self.server.clock.member(service) is not None)
        if not known or not isinstance(text, str) or not 0 < len(text) <= 1000:
            return _refusal("a note has a text of 1 to 1000 characters, and a service of the run or none")
        if kind not in NOTED:
            return _refusal(f"a note is of one of the kinds {', '.join(NOTED)}")
        self.server.note(service, text, kind)
        return {"ok": True}


class _Caller:
    """One connection. One request is answered a turn, so that frames are never held up by many."""

    def __init__(self, connection: socket.socket, control: ControlServer) -> None:
        self.subscribed = False
        self._socket, self._control, self._fd = connection, control, connection.fileno()
        self._received, self._waiting = b"", bytearray()
        self._watched = 0
        self._watch()

    def _watch(self) -> None:
        """Wait for what is due: room for what waits, the turn of the next request, or a request."""
        # A socket is nearly always writable: waiting for that gives a request that is here already its turn,
        # after what else the loop has to do.
        events = zmq.POLLOUT if self._waiting or b"\n" in self._received else zmq.POLLIN
        if events != self._watched:
            loop, self._watched = self._control.server.loop, events
            loop.unwatch(self._fd)
            loop.watch(self._fd, self._turn, events)

    def _turn(self) -> None:
        if self._waiting:
            self._flush()
        elif b"\n" in self._received or self._receive():
            line, _, self._received = self._received.partition(b"\n")
            answer, events = self._control.answer(line)
            self.subscribed |= events
            self.say(answer)
        if self._watched:
            self._watch()

    def _receive(self) -> bool:
        """Read what came; whether that makes a request."""
        try:
            data = self._socket.recv(MAX_REQUEST)
        except BlockingIOError:
            return False
        except OSError:
            data = b""
        self._received += data
        # An end, an error, or more than any request has without an end of line.
        if not data or (len(self._received) > MAX_REQUEST and b"\n" not in self._received):
            self.close()
        return b"\n" in self._received and bool(self._watched)

    def say(self, line: Answer) -> None:
        """Send one line, as far as the socket takes it now; the rest waits."""
        self._waiting += json.dumps(line, ensure_ascii=False).encode() + b"\n"
        self._flush()
        if len(self._waiting) > MAX_WAITING:
            self.close()
        if self._watched:
            self._watch()

    def _flush(self) -> None:
        try:
            sent = self._socket.send(self._waiting)
        except BlockingIOError:
            return
        except OSError:
            self.close()
            return
        del self._waiting[:sent]

    def close(self) -> None:
        """Hang up."""
        if self._watched:
            self._watched = 0
            self._control.server.loop.unwatch(self._fd)
            self._control.forget(self._fd)
            self._socket.close()


def _refusal(text: str) -> Answer:
    return {"ok": False, "error": text}
