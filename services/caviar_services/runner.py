"""The one runner that all services share: a `Service` on one side, the broker on the other.

It connects, negotiates, fetches scenery, warms up, steps, repeats a stored DONE, beats, turns
faults into messages, comes back after a lost connection, and stops within 2 s of SIGTERM. Every
wait has a deadline: what may last as long as the run does is bounded by the broker's heartbeats.
"""

from __future__ import annotations

import gc
import logging
import os
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import zmq

from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore, IncomingAsset
from caviar_protocol.codec import check_version, encode_message, message_type
from caviar_protocol.errors import AssetError, ProtocolError, RunError
from caviar_protocol.host import host_identity, trim_memory
from caviar_protocol.keys import Credentials
from caviar_protocol.keys import credentials as find_credentials
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.validation import ContentCheck
from caviar_services.connection import (
    Connection,
    Disconnected,
    RunOver,
    Terminated,
    UnansweredError,
    describe,
)
from caviar_services.process import TERMINATED, SignalTermination, Termination, restart_status
from caviar_services.registry import load
from caviar_services.service import Prepared, Service
from caviar_services.session import (
    Answers,
    Guard,
    content_rules_of,
    done_of,
    frame_of,
    hello_of,
    inputs_of,
    is_needed,
    preparation_of,
    ready_of,
    run_info,
)

TRIM_EVERY = 10
"""Frames after which free memory is given back to the system. Megabytes come and go in each frame in ever
other sizes, and what they leave behind would creep up for hours; in each frame it would cost page faults."""

CONNECT_TIMEOUT_S = 30.0
"""[s] until the broker has to answer HELLO, or a request for scenery."""
RETRY_S = 0.1
"""[s] between the first two attempts to take part again after the connections were lost; then twice that."""
MAX_RETRY_S = 1.0
"""[s] between attempts at most."""
ANSWER_S = 5.0
"""[s] that the broker gets to answer one attempt. One that it answers later counts as a loss for it."""

_log = logging.getLogger("caviar.service")


class NameTakenError(RunError):
    """The broker has a service of this name; perhaps it has yet to learn that its connection is lost."""


class Runner:
    """Runs one service until the broker ends the run.

    Parameters
    ----------
    name
        Name of the service in the run.
    cls, use
        Implementation, and what it is called.
    endpoint
        ZeroMQ address of the broker.
    connect_timeout_s
        Until the broker has to answer HELLO, or a request for scenery [s].
    termination
        How this runner is told to end; none: not by signals.
    own_process
        Whether the process is this service's own, so that its memory may be tuned for it.
    credentials
        For a broker with keys; None: what the environment says (`caviar_protocol.keys.credentials`).
    """

    def __init__(
        self,
        name: str,
        cls: type[Service[Any]],
        use: str,
        endpoint: str,
        connect_timeout_s: float = CONNECT_TIMEOUT_S,
        termination: Termination | None = None,
        *,
        own_process: bool = True,
        credentials: Credentials | None = None,
    ) -> None:
        self._own_process = own_process
        self.name, self.use, self.cls = name, use, cls
        self.ended = ""
        """Why the broker ended the run, once it did."""
        self._timeout_s = connect_timeout_s
        self._store = AssetStore()
        self._termination = termination or Termination()
        self._endpoint, self._credentials = endpoint, credentials or find_credentials()
        self._broker = self._connection()
        self._rejoin_s = 0.0
        """For how long the broker waits for this service once it has lost its connections [s]."""
        self._service: Service[Any] | None = None
        self._identity: dict[str, Any] = {}
        """``epoch`` and ``attempt``, which stand in every message (clause 1)."""
        self._reset_to: m.Reset | None = None
        self._answers = Answers()
        self._check = ContentCheck()
        self._handlers: Mapping[type, Callable[[Any, Sequence[zmq.Frame]], None]] = {
            m.Prepare: self._prepare,
            m.AssetGet: self._serve_asset,
            m.Reset: self._reset,
            m.Grant: self._grant,
            m.EpisodeEnd: self._episode_end,
            m.Checkpoint: self._checkpoint,
            m.Restore: self._restore,
        }

    def run(self) -> int:
        """Serve until SHUTDOWN; the exit status: 0 after it, 143 after SIGTERM.

        Raises `RunError` where there is no broker, it refuses this service, or it is gone for longer than it
        waits for this service to come back.
        """
        try:
            self._join(self._timeout_s)
            while True:
                try:
                    self._handle(*self._broker.receive())
                except Disconnected as loss:
                    self._rejoin(str(loss))
        except RunOver as order:
            if self._service is None and not self._identity:
                raise RunError(f"the run ended before {self.name!r} was in it: {order}") from order
            self.ended = str(order)
            self._bye(self.ended)
            return 0
        except Terminated as order:
            self._bye(str(order) or "SIGTERM")
            return TERMINATED
        finally:
            self._close()

    def _handle(self, message: m.Message, parts: Sequence[zmq.Frame]) -> None:
        if isinstance(message, m.Cancel | m.Stale | m.Error):
            return  # advisory: a step that has begun is finished; complaints are logged already
        if isinstance(message, m.Refuse):
            raise self._refused(message)
        handler = self._handlers.get(type(message))
        if handler is None:
            self._unexpected(message, "it is not for a service that is in the run")
            return
        epoch, attempt = self._identity["epoch"], self._identity["attempt"]
        if (getattr(message, "epoch", epoch), getattr(message, "attempt", attempt)) != (epoch, attempt):
            self._unexpected(message, f"this is attempt {attempt} in epoch {epoch}")
            return
        handler(message, parts)

    def _unexpected(self, message: m.Message, why: str) -> None:
        kind = message_type(message)
        self._broker.send(m.Error(code="unexpected", of=kind, message=f"{kind} is not used: {why}"))

    # --- joining -----------------------------------------------------------------------------------

    def _connection(self) -> Connection:
        return Connection(self.name, self._endpoint, self._termination, self._credentials)

    def _join(self, timeout_s: float) -> None:
        broker = self._broker
        broker.send(hello_of(self.name, self.use, self.cls, host_identity(), os.getpid()))
        message, _ = broker.receive(timeout_s)
        if isinstance(message, m.Refuse):
            raise self._refused(message)
        if not isinstance(message, m.Welcome):
            raise ProtocolError(f"the broker answered HELLO with {describe(message)}, not with WELCOME")
        check_version(message.version)
        self._identity = {"epoch": message.epoch, "attempt": message.attempt}
        self._rejoin_s = message.rejoin_ns / 1e9
        broker.beat(message)
        with self._reporting("settings"):
            settings = convert_settings(self.cls.Settings, message.settings)
            self._service = self.cls(settings, run_info(self.name, message, broker.progress))

    def _refused(self, message: m.Refuse) -> RunError:
        kind = NameTakenError if message.code == "name-taken" else RunError
        return kind(
            f"the broker at {self._endpoint} refused {self.name!r} ({message.code}): {message.message}"
        )

    def _rejoin(self, loss: str) -> None:
        """Take part again as a new incarnation, on new connections, within the time that the broker waits.

        What this service was is dropped, as where its process is started again: the broker has it prepared
        and reset anew, restored where it has state, and grants what it owes.
        """
        if not self._rejoin_s:
            raise RunError(
                f"{loss}; {self.name!r} gives up: the run does not wait until it has connected again "
                "(timeouts.rejoin_s of the scenario)"
            )
        hold_s, pause_s = self._rejoin_s, RETRY_S
        began = time.monotonic()
        _log.warning("%s; trying to come back for at most %g s (timeouts.rejoin_s)", loss, hold_s)
        self._forget()
        while True:
            self._broker.abandon()
            self._broker = self._connection()
            try:
                self._join(min(ANSWER_S, max(RETRY_S, began + hold_s - time.monotonic())))
            except (UnansweredError, NameTakenError, Disconnected) as failure:
                if time.monotonic() + pause_s > began + hold_s:
                    raise RunError(
                        f"{loss}; {self.name!r} gives up, it could not come back within {hold_s:g} s: "
                        f"{failure}; timeouts.rejoin_s of the scenario says for how long the run waits"
                    ) from failure
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, MAX_RETRY_S)
            else:
                away_s, attempt = time.monotonic() - began, self._identity["attempt"]
                _log.warning("back after %.1f s as attempt %d", away_s, attempt)
                return

    def _forget(self) -> None:
        """Drop what this service was in the run."""
        service, self._service = self._service, None
        self._identity, self._reset_to = {}, None
        self._answers.clear()
        if service is not None:
            service.close()

    # --- preparing ---------------------------------------------------------------------------------

    def _prepare(self, message: m.Prepare, _: Sequence[zmq.Frame]) -> None:
        service = self._running
        self._check.adopt(content_rules_of(service, message))
        with self._reporting("prepare"):
            prepared: Prepared | None = None
            assets: list[m.Asset] = []
            if is_needed(service, message):
                assets = [self._store.add(n, c) for n, c in sorted(service.scenery().items())]
                if assets:
                    self._broker.send(m.AssetOffer(**self._identity, assets=tuple(assets)))
                if service.needs_assets:
                    assets = self._fetch(message.assets)
                files = self._store.folder_of(assets) if assets else {}
                prepared = service.prepare(preparation_of(message, files))
            if self._own_process:
                # What was loaded stays: collections look only at what frames leave behind, all of it, soon.
                gc.collect()
                gc.freeze()
            self._broker.send(ready_of(self._identity, prepared, assets))

    def _fetch(self, assets: Sequence[m.Asset]) -> list[m.Asset]:
        """Get through the broker what this machine does not hold yet (clause 4)."""
        missing = [asset for asset in assets if not self._store.holds(asset)]
        for number, asset in enumerate(missing, 1):
            self._broker.progress(f"fetching scenery, file {number} of {len(missing)}")
            incoming = IncomingAsset(self._store, asset)
            complete = False
            while not complete:
                self._broker.send(m.AssetGet(digest=asset.digest, offset=incoming.offset))
                answer, chunk = self._asset_data(asset)
                complete = incoming.add_chunk(answer.offset, answer.size, chunk)
        return list(assets)

    def _asset_data(self, asset: m.Asset) -> tuple[m.AssetData, memoryview]:
        until = time.monotonic() + self._timeout_s
        while time.monotonic() < until:
            answer, parts = self._broker.receive(self._timeout_s)
            if isinstance(answer, m.AssetData) and answer.digest == asset.digest:
                return answer, parts[0].buffer
            if isinstance(answer, m.Error) and answer.subject == asset.digest:
                raise AssetError(f"the broker cannot deliver asset {asset.name!r}: {answer.message}")
            if not isinstance(answer, m.AssetGet | m.Cancel | m.Error):
                raise ProtocolError(f"asked for asset {asset.name!r}, got {describe(answer)}")
            self._handle(answer, parts)
        raise AssetError(f"the broker did not deliver asset {asset.name!r} within {self._timeout_s:g} s")

    def _serve_asset(self, message: m.AssetGet, _: Sequence[zmq.Frame]) -> None:
        try:
            chunk, size = self._store.read(message.digest, message.offset)
        except AssetError as error:
            self._broker.send(
                m.Error(code="unknown-asset", of="ASSET_GET", subject=message.digest, message=str(error))
            )
        else:
            self._broker.send(m.AssetData(digest=message.digest, offset=message.offset, size=size), chunk)

    # --- frames ------------------------------------------------------------------------------------

    def _reset(self, message: m.Reset, _: Sequence[zmq.Frame]) -> None:
        with self._reporting("reset", message.episode):
            self._broker.progress(f"reset to episode {message.episode}")
            self._answers.clear()
            self._running.reset(message.seed_episode, message.seed, message.t0_ns)
            self._reset_to = message
            self._broker.send(m.ResetDone(**self._identity, episode=message.episode))

    def _grant(self, grant: m.Grant, parts: Sequence[zmq.Frame]) -> None:
        reset = self._reset_to
        if reset is None or grant.episode != reset.episode:
            self._unexpected(grant, f"there was no RESET to episode {grant.episode}")
            return
        if self._answers.is_new(grant.frame):
            self._broker.progress(f"frame {grant.frame}")
            self._answers.put(grant.frame, self._answer(reset, grant, parts))
        answer = self._answers.get(grant.frame)
        if answer is None:
            self._unexpected(grant, f"frame {grant.frame} was answered long ago")
        else:
            self._broker.send_parts(answer)
        if grant.frame % TRIM_EVERY == TRIM_EVERY - 1:
            with self._reporting("release", grant.episode, grant.frame):
                self._running.release_memory()
                if self._own_process:
                    trim_memory()

    def _answer(self, reset: m.Reset, grant: m.Grant, parts: Sequence[zmq.Frame]) -> list[Any]:
        """DONE with its products, or FAULT, as it travels."""
        answer: list[Any] = []

        def failed(fault: m.Fault) -> None:
            answer.append(encode_message(fault))

        with Guard(self._identity, failed, "step", grant.episode, grant.frame) as guard:
            self._check.begin(grant.inputs)
            inputs = inputs_of(grant, [part.buffer for part in parts], self._check)
            frame = frame_of(self._running, reset, grant, inputs)
            started = time.monotonic_ns()
            result = self._running.step(frame)
            stepped = time.monotonic_ns()
            guard.phase = "encode"
            done, products = done_of(self._identity, self.use, grant, result, stepped - started)
            answer += [encode_message(done), *products]
        return answer

    def _episode_end(self, message: m.EpisodeEnd, _: Sequence[zmq.Frame]) -> None:
        with self._reporting("end of episode", message.episode):
            self._running.end_episode(message.frames)

    # --- state (clause 18) -----------------------------------------------------------------------------

    def _checkpoint(self, message: m.Checkpoint, _: Sequence[zmq.Frame]) -> None:
        if not self._keeps_state(message):
            return
        with self._reporting("checkpoint", message.episode, message.frame):
            self._broker.progress(f"saving the state after frame {message.frame}")
            state = self._running.checkpoint()
            done = m.CheckpointDone(**self._identity, episode=message.episode, frame=message.frame)
            self._broker.send(done, state)

    def _restore(self, message: m.Restore, parts: Sequence[zmq.Frame]) -> None:
        if not self._keeps_state(message):
            return
        with self._reporting("restore", message.episode, message.frame):
            self._broker.progress(f"restoring the state after frame {message.frame}")
            self._running.restore(parts[0].bytes)
            self._answers.go_on_behind(message.frame)
            self._broker.send(m.Ready(**self._identity))

    def _keeps_state(self, message: m.Checkpoint | m.Restore) -> bool:
        """Whether the message is for this service as it is."""
        reset = self._reset_to
        if not self.cls.checkpoints:
            self._unexpected(message, f"{self.use} has no state, and named no capability 'checkpoint'")
        elif reset is None or message.episode != reset.episode:
            self._unexpected(message, f"there was no RESET to episode {message.episode}")
        else:
            return True
        return False

    # --- what both need ------------------------------------------------------------------------------

    @property
    def _running(self) -> Service[Any]:
        if self._service is None:
            raise RunError(f"{self.name!r} could not be set up")
        return self._service

    def _reporting(self, phase: str, episode: int = 0, frame: int = -1) -> Guard:
        return Guard(self._identity, self._broker.send, phase, episode, frame)

    def _bye(self, reason: str) -> None:
        if self._identity:
            self._broker.send(m.Bye(**self._identity, reason=reason))

    def _close(self) -> None:
        try:
            if self._service is not None:
                self._service.close()
        finally:
            self._broker.close()
            self._termination.finished()


def run_service(
    name: str,
    role: str,
    use: str,
    endpoint: str,
    connect_timeout_s: float,
    credentials: Credentials | None = None,
    *,
    restarted: bool = False,
) -> int:
    """Run a registered implementation as the service ``name``; the exit status.

    ``restarted``: somebody starts this process again whenever that is not 0.
    """
    termination = SignalTermination(0 if restarted else TERMINATED)
    cls = load(role, use)
    runner = Runner(name, cls, use, endpoint, connect_timeout_s, termination, credentials=credentials)
    status = runner.run()
    return restart_status(status, runner.ended) if restarted else status
