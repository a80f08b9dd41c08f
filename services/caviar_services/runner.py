"""The one runner that all services share: a `Service` on one side, the broker on the other.

It connects, negotiates, fetches scenery, warms up, steps, repeats a stored DONE, beats, turns
faults into messages, and stops within 2 s of SIGTERM. Every wait has a deadline: what may last
as long as the run does is bounded by the broker's heartbeats.
"""

from __future__ import annotations

import logging
import os
import time
import traceback
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import zmq

from caviar_protocol import limits
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore, Incoming
from caviar_protocol.codec import check_parts, check_version, decode_message, encode_message, encode_payload
from caviar_protocol.digest import geometry_digest, payload_digest
from caviar_protocol.errors import CaviarError, ProtocolError, RunError
from caviar_protocol.host import host_identity
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.tables import convert_settings
from caviar_protocol.topics import Carrier
from caviar_services.heartbeat import HeartbeatThread, Termination
from caviar_services.registry import load
from caviar_services.service import Frame, FrameInput, Preparation, Prepared, RunInfo, Service, StepResult

_log = logging.getLogger("caviar.service")

CONNECT_TIMEOUT_S = 30.0
"""[s] until the broker has to answer HELLO."""
POLL_MS = 50
"""[ms] between looks at the termination flag and the broker's heartbeat while waiting."""


class Terminated(Exception):  # noqa: N818  # an order, not an error
    """SIGTERM came."""


class Runner:
    """Runs one service until the broker ends the run.

    Parameters
    ----------
    name
        Name of the service in the run.
    role, use
        Registered implementation.
    endpoint
        ZeroMQ address of the broker.
    """

    def __init__(self, name: str, role: str, use: str, endpoint: str) -> None:
        self.name, self.use, self.endpoint = name, use, endpoint
        self.cls = load(role, use)
        self._store = AssetStore()
        self._termination = Termination()
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.DEALER)
        self._heartbeat: HeartbeatThread | None = None
        self._service: Service[Any] | None = None
        self._welcome: m.Welcome | None = None
        self._answers: OrderedDict[tuple[int, int], list[Any]] = OrderedDict()
        self._prepared = False
        self._handlers: Mapping[type, Callable[[Any, Sequence[zmq.Frame]], None]] = {
            m.Prepare: self._prepare,
            m.AssetGet: self._serve_asset,
            m.Reset: self._reset,
            m.Grant: self._grant,
            m.EpisodeEnd: self._episode_end,
            m.Cancel: self._ignore,
            m.Stale: self._complaint,
            m.Error: self._complaint,
        }

    def run(self) -> int:
        """Serve until SHUTDOWN; the exit status: 0 after it, 143 after SIGTERM."""
        self._socket.linger = 500
        self._socket.setsockopt(zmq.MAXMSGSIZE, limits.MAX_BODY)
        self._socket.connect(self.endpoint)
        try:
            self._join()
            while True:
                message, parts = self._receive()
                if isinstance(message, m.Shutdown):
                    self._bye(message.reason)
                    return 0
                handler = self._handlers.get(type(message))
                if handler is None:
                    kind = str(type(message).__struct_config__.tag)
                    self._send(m.Error(code="unexpected", of=kind, message=f"{kind} is not for a service"))
                else:
                    handler(message, parts)
        except Terminated:
            self._bye("SIGTERM")
            return 143
        finally:
            self._close()

    # --- joining -----------------------------------------------------------------------------------

    def _join(self) -> None:
        cls = self.cls
        self._send(
            m.Hello(
                version=m.PROTOCOL_VERSION,
                name=self.name,
                role=cls.role,
                inputs=cls.inputs,
                outputs=cls.outputs,
                capabilities=m.CAPABILITIES,
                implementation=self.use,
                host=host_identity(),
                pid=os.getpid(),
            )
        )
        message, _ = self._receive(CONNECT_TIMEOUT_S)
        if isinstance(message, m.Refuse):
            raise RunError(
                f"the broker at {self.endpoint} refused {self.name!r} ({message.code}): {message.message}"
            )
        if isinstance(message, m.Shutdown):
            raise RunError(f"the run ended before {self.name!r} was in it: {message.reason}")
        if not isinstance(message, m.Welcome):
            raise ProtocolError(f"the broker answered HELLO with {type(message).__name__}, not WELCOME")
        check_version(message.version)
        self._welcome = message
        self._heartbeat = HeartbeatThread(self._context, self.endpoint, self.name, message)
        self._heartbeat.start()
        with self._reporting("settings"):
            settings = convert_settings(cls.Settings, message.settings)
            self._service = cls(settings, self._run_info(message))

    def _run_info(self, welcome: m.Welcome) -> RunInfo:
        told = welcome.scenario
        return RunInfo(
            name=self.name,
            run=welcome.run,
            seed=welcome.seed,
            sampling_period_ns=int(told.get("sampling_period_ns", 1)),
            frames=int(told.get("frames", 1)),
            carriers=msgspec.convert(told.get("carriers", ()), tuple[Carrier, ...]),
            devices=msgspec.convert(told.get("devices", ()), tuple[DeviceSpec, ...]),
            scenario=told.get("resolved", {}),
            directory=Path(str(told.get("directory", "."))),
            progress=self._progress,
        )

    # --- preparing ---------------------------------------------------------------------------------

    def _prepare(self, message: m.Prepare, _: Sequence[zmq.Frame]) -> None:
        service = self._running
        with self._reporting("prepare"):
            prepared, geometry = Prepared(), ""
            if message.demand or service.role in ("agent", "recorder") or not service.outputs:
                offered = [self._store.add(n, c) for n, c in sorted(service.scenery().items())]
                if offered:
                    self._send(m.AssetOffer(**self._identity, assets=tuple(offered)))
                assets = self._fetch(message.assets) if service.uses_scenery else offered
                geometry = geometry_digest(assets)
                prepared = service.prepare(
                    Preparation(
                        demand={d.topic: frozenset(d.parts) for d in message.demand},
                        assets=self._store.folder_of(assets) if assets else {},
                        producers=message.producers,
                    )
                )
            self._send(
                m.Ready(
                    **self._identity,
                    geometry=geometry,
                    prefixes=prepared.prefixes,
                    actuators=prepared.actuators,
                    notes=prepared.notes,
                )
            )

    def _fetch(self, assets: Sequence[m.Asset]) -> list[m.Asset]:
        """Get through the broker what this machine does not hold yet (clause 4)."""
        missing = [asset for asset in assets if not self._store.has(asset.digest)]
        for number, asset in enumerate(missing, 1):
            self._progress(f"fetching scenery, file {number} of {len(missing)}")
            incoming = Incoming(self._store, asset)
            complete = False
            while not complete:
                self._send(m.AssetGet(digest=asset.digest, offset=incoming.offset))
                answer, parts = self._receive(CONNECT_TIMEOUT_S)
                if not isinstance(answer, m.AssetData) or answer.digest != asset.digest:
                    raise ProtocolError(f"asked for asset {asset.name!r}, got {answer}")
                complete = incoming.take(answer.offset, answer.size, parts[0].buffer)
        return list(assets)

    def _serve_asset(self, message: m.AssetGet, _: Sequence[zmq.Frame]) -> None:
        try:
            chunk, size = self._store.read(message.digest, message.offset)
        except CaviarError as error:
            self._send(
                m.Error(code="unknown-asset", of="ASSET_GET", subject=message.digest, message=str(error))
            )
        else:
            self._send(m.AssetData(digest=message.digest, offset=message.offset, size=size), chunk)

    # --- frames ------------------------------------------------------------------------------------

    def _reset(self, message: m.Reset, _: Sequence[zmq.Frame]) -> None:
        with self._reporting("reset", message.episode):
            self._progress(f"reset to episode {message.episode}")
            self._answers.clear()
            self._running.reset(message.episode, message.seed, message.t0_ns)
            self._send(m.ResetDone(**self._identity, episode=message.episode))

    def _grant(self, grant: m.Grant, parts: Sequence[zmq.Frame]) -> None:
        key = (grant.episode, grant.frame)
        if key not in self._answers:
            with self._reporting("step", grant.episode, grant.frame):
                self._progress(f"frame {grant.frame}")
                frame = self._frame(grant, parts)
                started = time.monotonic_ns()
                result = self._running.step(frame)
                self._answers[key] = self._answer(grant, result, started)
                if len(self._answers) > 2 * limits.MAX_IN_FLIGHT:
                    self._answers.popitem(last=False)
        if key in self._answers:
            self._socket.send_multipart(self._answers[key], copy=False)

    def _frame(self, grant: m.Grant, parts: Sequence[zmq.Frame]) -> Frame:
        inputs, taken = [], 0
        for entry in grant.inputs:
            if entry.status is m.Status.ABSENT:
                inputs.append(FrameInput(entry))
            else:
                inputs.append(FrameInput(entry, parts[taken].buffer, parts[taken + 1].buffer))
                taken += 2
        return Frame(
            episode=grant.episode,
            number=grant.frame,
            t_ns=grant.t_ns,
            previous=grant.previous_frame,
            final=grant.final,
            inputs=tuple(inputs),
            reports=grant.reports,
            service=self.name,
            seed=self._running.run.seed,
        )

    def _answer(self, grant: m.Grant, result: StepResult, started: int) -> list[Any]:
        headers, body_parts = [], list[Any]()
        stepped = time.monotonic_ns()
        for topic in sorted(result.products):
            header, body = encode_payload(result.products[topic])
            digest = payload_digest(header, body)
            headers.append(m.ProductHeader(topic=topic, digest=digest, fidelity=result.fidelity))
            body_parts += [header, body]
        done = m.Done(
            **self._identity,
            episode=grant.episode,
            frame=grant.frame,
            products=tuple(headers),
            decisions=dict(result.decisions),
            measured={**result.measured, "step": stepped - started, "encode": time.monotonic_ns() - stepped},
            counts=dict(result.counts),
            end_episode=result.end_episode,
        )
        return [encode_message(done), *body_parts]

    def _episode_end(self, message: m.EpisodeEnd, _: Sequence[zmq.Frame]) -> None:
        with self._reporting("end of episode", message.episode):
            self._running.end_episode(message.frames)

    # --- the connection ------------------------------------------------------------------------------

    def _receive(self, timeout_s: float | None = None) -> tuple[m.Message, Sequence[zmq.Frame]]:
        """Next message and its further parts.

        Raises `Terminated` after SIGTERM, `RunError` when the broker is silent for longer than its
        liveness, or after ``timeout_s``.
        """
        give_up = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            if self._termination.requested:
                raise Terminated
            if self._socket.poll(POLL_MS):
                parts = self._socket.recv_multipart(copy=False)
                try:
                    message = decode_message(parts[0].buffer)
                    check_parts(message, parts)
                except ProtocolError as error:
                    self._send(m.Error(code=error.code, message=str(error)))
                    continue
                return message, parts[1:]
            silence = self._heartbeat.broker_silence if self._heartbeat else None
            if silence is not None:
                raise RunError(
                    f"the broker at {self.endpoint} has been silent for {silence:.1f} s; {self.name!r} gives up"
                )
            if give_up is not None and time.monotonic() > give_up:
                raise RunError(
                    f"no answer from a broker at {self.endpoint} within {timeout_s:g} s; "
                    "is `caviar broker` running there?"
                )

    def _send(self, message: m.Message, *parts: bytes) -> None:
        self._socket.send_multipart([encode_message(message), *parts])

    @property
    def _identity(self) -> dict[str, Any]:
        if self._welcome is None:
            raise ProtocolError("the broker sent an order before WELCOME")
        return {"epoch": self._welcome.epoch, "attempt": self._welcome.attempt}

    @property
    def _running(self) -> Service[Any]:
        if self._service is None:
            raise RunError(f"{self.name!r} could not be set up")
        return self._service

    def _progress(self, phase: str, grace_s: float = 0.0) -> None:
        if self._heartbeat is not None:
            self._heartbeat.progress(phase, grace_s)

    def _reporting(self, phase: str, episode: int = 0, frame: int = -1) -> _Reporting:
        return _Reporting(self, phase, episode, frame)

    def report_fault(self, phase: str, episode: int, frame: int, error: Exception) -> None:
        """Turn an exception of the service into a FAULT."""
        known = isinstance(error, CaviarError)
        text = str(error) if known else f"{type(error).__name__}: {error}"
        detail = "" if known else "".join(traceback.format_exception(error))
        _log.error(detail or text)
        self._send(
            m.Fault(
                **self._identity,
                episode=episode,
                frame=frame,
                phase=phase,
                message=text[:2000],
                detail=detail[-20000:],
            )
        )

    def _bye(self, reason: str) -> None:
        if self._welcome is not None:
            self._send(m.Bye(**self._identity, reason=reason))

    def _close(self) -> None:
        try:
            if self._service is not None:
                self._service.close()
        finally:
            if self._heartbeat is not None:
                self._heartbeat.stop()
            self._socket.close()
            self._context.term()
            self._termination.finished()

    def _ignore(self, message: m.Message, _: Sequence[zmq.Frame]) -> None:
        """CANCEL is advisory: a step that has begun is finished."""

    def _complaint(self, message: m.Message, _: Sequence[zmq.Frame]) -> None:
        _log.warning("the broker says: %s", message)


class _Reporting:
    """Turns an exception of the service, inside a ``with``, into a FAULT message."""

    def __init__(self, runner: Runner, phase: str, episode: int, frame: int) -> None:
        self._runner, self._phase, self._episode, self._frame = runner, phase, episode, frame

    def __enter__(self) -> None:
        return None

    def __exit__(self, _: object, error: BaseException | None, __: object) -> bool:
        if not isinstance(error, Exception) or isinstance(error, Terminated):
            return False
        self._runner.report_fault(self._phase, self._episode, self._frame, error)
        return True


def run_service(name: str, role: str, use: str, endpoint: str) -> int:
    """Run a registered implementation as the service ``name``; the exit status."""
    return Runner(name, role, use, endpoint).run()
