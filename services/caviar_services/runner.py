"""Runs one `Service` in a process, or a thread, beside its broker: the shell with sockets around `session`.

It connects, joins, passes messages between the broker and the `ServiceSession`, comes back after a lost
connection, and stops within 2 s of SIGTERM. Every wait has a deadline: what may last as long as the run
does is bounded by the broker's heartbeats.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Sequence
from typing import Any

from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.codec import check_version
from caviar_protocol.errors import ProtocolError, RunError
from caviar_protocol.host import host_identity
from caviar_protocol.keys import Credentials
from caviar_protocol.keys import credentials as find_credentials
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
from caviar_services.service import Service
from caviar_services.session import ServiceSession

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

    Args:
        name: Name of the service in the run.
        cls: The implementation.
        use: What the implementation is called.
        endpoint: ZeroMQ address of the broker.
        connect_timeout_s: Time that the broker has to answer HELLO, or a request for scenery [s].
        termination: How this runner learns that it has to end; None: not by signals.
        own_process: Whether the process is this service's own, so that its memory may be tuned for it.
        credentials: For a broker with keys; None: what the environment says
            (`caviar_protocol.keys.credentials`).

    Raises:
        RunError: The address is none.
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
        self._rejoin_s = 0.0  # for how long the broker waits for this service that lost its connections [s]
        self._session = self._new_session()

    def run(self) -> int:
        """Serve until SHUTDOWN.

        Returns:
            The exit status: 0 after SHUTDOWN, 143 after SIGTERM.

        Raises:
            RunError: There is no broker, it refuses this service, or it is gone for longer than it waits for
                this service to come back.
        """
        try:
            self._join(self._timeout_s)
            while True:
                try:
                    self._serve()
                except Disconnected as loss:
                    self._rejoin(str(loss))
        except RunOver as order:
            if not self._session.joined:
                raise RunError(f"the run ended before {self.name!r} was in it: {order}") from order
            self.ended = str(order)
            self._session.leave(self.ended)
            return 0
        except Terminated as order:
            self._session.leave(str(order) or "SIGTERM")
            return TERMINATED
        finally:
            self._close()

    def _serve(self) -> None:
        """Pass messages to the session until an order or a loss ends that."""
        session = self._session
        while True:
            deadline = session.deadline
            try:
                message, parts = self._broker.receive(
                    None if deadline is None else deadline - time.monotonic()
                )
            except UnansweredError:
                session.expire(time.monotonic())
                continue
            if isinstance(message, m.Refuse):
                raise self._refused(message)
            session.receive(message, [part.buffer for part in parts], time.monotonic())

    # --- joining -----------------------------------------------------------------------------------

    def _connection(self) -> Connection:
        return Connection(self.name, self._endpoint, self._termination, self._credentials)

    def _new_session(self) -> ServiceSession:
        return ServiceSession(
            self.name,
            self.use,
            self.cls,
            self._send,
            self._store,
            progress=self._progress,
            tunes_memory=self._own_process,
            fetch_timeout_s=self._timeout_s,
        )

    def _send(self, message: m.Message, parts: Sequence[Any]) -> None:
        self._broker.send(message, *parts)

    def _progress(self, phase: str, grace_s: float = 0.0) -> None:
        self._broker.progress(phase, grace_s)

    def _join(self, timeout_s: float) -> None:
        broker = self._broker
        broker.send(self._session.hello(host_identity(), os.getpid()))
        message, _ = broker.receive(timeout_s)
        if isinstance(message, m.Refuse):
            raise self._refused(message)
        if not isinstance(message, m.Welcome):
            raise ProtocolError(f"the broker answered HELLO with {describe(message)}, not with WELCOME")
        check_version(message.version)
        self._rejoin_s = message.rejoin_ns / 1e9
        broker.beat(message)
        self._session.handle(message)

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
        old, self._session = self._session, self._new_session()
        old.close()
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
                away_s = time.monotonic() - began
                _log.warning("back after %.1f s as attempt %d", away_s, self._session.attempt)
                return

    def _close(self) -> None:
        try:
            self._session.close()
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
    """Run a registered implementation as the service ``name``.

    Args:
        name: Name of the service in the run.
        role: Role of the service.
        use: Registered name of the implementation, or ``module:Class``.
        endpoint: ZeroMQ address of the broker.
        connect_timeout_s: Time that the broker has to answer HELLO [s].
        credentials: For a broker with keys.
        restarted: Whether a supervisor starts this process again whenever its status is not 0.

    Returns:
        The exit status of the process.
    """
    termination = SignalTermination(0 if restarted else TERMINATED)
    cls = load(role, use)
    runner = Runner(name, cls, use, endpoint, connect_timeout_s, termination, credentials=credentials)
    status = runner.run()
    return restart_status(status, runner.ended) if restarted else status
