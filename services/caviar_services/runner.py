"""Runs one `Service` in a process, or a thread, beside its broker: the shell with sockets around `session`.

It connects, joins, passes messages between the broker and the `ServiceSession`, comes back after a lost
connection, and stops within 2 s of SIGTERM. Every wait has a deadline: what may last as long as the run
does is bounded by the broker's heartbeats. `serve` is all that a process of a service does, and `main` its
command line.
"""

from __future__ import annotations

import argparse
import faulthandler
import io
import logging
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.codec import check_version
from caviar_protocol.errors import CaviarError, ProtocolError, RunError
from caviar_protocol.host import host_identity, steady_memory
from caviar_protocol.keys import Credentials
from caviar_protocol.keys import credentials as find_credentials
from caviar_protocol.messages import RUN_COMPLETE, STOPPED_BY, Input
from caviar_services.connection import (
    Connection,
    Disconnected,
    RunOver,
    Terminated,
    Termination,
    UnansweredError,
    describe,
)
from caviar_services.registry import find_modules_in, load, with_inputs
from caviar_services.service import Service
from caviar_services.session import ServiceSession

TERMINATION_GRACE_S = 1.5
"""[s] from SIGTERM until the process is ended by force, so that it is gone within 2 s."""

TERMINATED = 128 + signal.SIGTERM
"""Exit status of a service that a signal ended."""

CONNECT_TIMEOUT_S = 30.0
"""[s] until the broker has to answer HELLO, or a request for scenery."""
RETRY_S = 0.1
"""[s] between the first two attempts to take part again after the connections were lost; then twice that."""
MAX_RETRY_S = 1.0
"""[s] between attempts at most."""
ANSWER_S = 5.0
"""[s] that the broker gets to answer one attempt. One that it answers later counts as a loss for it."""

_log = logging.getLogger("caviar.service")


# A class of its own: of all refusals it alone may pass, once the broker has noticed the loss.
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

    @property
    def failed(self) -> bool:
        """Whether the service failed itself, and said so with a FAULT."""
        return self._session.failed

    def run(self) -> int:
        """Serve until SHUTDOWN.

        Returns:
            The exit status: 0 after SHUTDOWN, 1 where its reason blames this service, 143 after SIGTERM.

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
        # SHUTDOWN instead of WELCOME: the run ended while this service was starting.
        except RunOver as order:
            if not self._session.joined:
                raise RunError(f"the run ended before {self.name!r} was in it: {order}") from order
            self.ended = str(order)
            self._session.leave(self.ended)
            # A reason that blames a service begins with its role and name.
            return int(self.ended.startswith(f"{self.cls.role} {self.name!r} "))
        except Terminated as order:
            self._session.leave(str(order) or "SIGTERM")
            return TERMINATED
        finally:
            # The connection last, and in any case: BYE may still be on its way.
            try:
                self._session.close()
            finally:
                self._broker.close()
                self._termination.finished()

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
            # Buffers, not copies: a frame of a channel or a LIDAR has megabytes.
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
            attend=lambda: self._broker.attend(),  # whichever connection there is by then
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
        # Before the heartbeats: a broker of another version is refused with a text, not met with nonsense.
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
        # Closed before another one is made at WELCOME: two ray tracers at once may not fit into memory.
        # A new session, and not the old one: what it knew of the run counts for nothing in the next attempt.
        old, self._session = self._session, self._new_session()
        old.close()
        while True:
            # New sockets for each attempt: what an earlier one still has in its queues is of no incarnation.
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
                # Longer each time: all services of a run come back at once after an outage.
                time.sleep(pause_s)
                pause_s = min(2 * pause_s, MAX_RETRY_S)
            else:
                away_s = time.monotonic() - began
                _log.warning("back after %.1f s as attempt %d", away_s, self._session.attempt)
                return


class SignalTermination(Termination):
    """SIGTERM and SIGINT as such an order.

    A Python signal handler does not run while the main thread is inside a compiled call, so a
    thread of its own hears of the signal through ``set_wakeup_fd``, and ends the process when the
    main thread has not done so in time. Against a call that holds the interpreter's lock not even
    that helps: then the process ends as soon as the lock is free, or its parent kills it.

    Args:
        status: Exit status of a process that ends so.
    """

    def __init__(self, status: int = TERMINATED) -> None:
        super().__init__()
        self._status = status
        # Not blocking: Python writes a byte for each signal and must not wait for the thread that reads them.
        self._read, write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        signal.set_wakeup_fd(write, warn_on_full_buffer=False)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._handle)
        threading.Thread(target=self._watch, name="termination", daemon=True).start()

    def finished(self) -> None:
        """Everything is closed; the process ends by itself, with a status of its own."""
        super().finished()
        # The interpreter puts handlers back to the default while it ends: a late SIGTERM would be the status.
        signal.signal(signal.SIGTERM, signal.SIG_IGN)

    def _handle(self, *_: object) -> None:
        self.requested = True

    def _watch(self) -> None:
        while True:
            select.select([self._read], [], [])
            if {signal.SIGTERM, signal.SIGINT} & set(os.read(self._read, 64)):
                self.requested = True
                words = "ended by SIGTERM in the middle of a call that does not return"
                self.enforce(TERMINATION_GRACE_S, self._status, words)
                return


def restart_status(status: int, ended: str) -> int:
    """Status 0 where the work is done or was called off; 1 where another run may follow.

    Args:
        status: What the runner returned.
        ended: Why the broker ended the run; "" where it did not.

    Example:
        >>> restart_status(0, RUN_COMPLETE), restart_status(0, "world was lost"), restart_status(143, "")
        (0, 1, 0)
    """
    if status == TERMINATED:
        return 0
    # 1 is a supervisor's cue to start the process again, for the next attempt at the run.
    failed = bool(ended) and ended != RUN_COMPLETE and not ended.startswith(STOPPED_BY)
    return 1 if failed else status


def serve(
    name: str,
    use: str,
    broker: str,
    connect_timeout_s: float = CONNECT_TIMEOUT_S,
    key: Path | None = None,
    broker_key: Path | None = None,
    *,
    restarted: bool = False,
    modules: Sequence[Path] = (),
    inputs: Sequence[Input] = (),
) -> int:
    """Run one service in this process.

    Args:
        name: Name of the service in the run.
        use: Role and implementation, ``role:name`` or ``role:module:Class``. The module is also looked for in
            the current folder.
        broker: ZeroMQ address of the broker.
        connect_timeout_s: Time that the broker has to answer HELLO, or a request for scenery [s].
        key: File with the secret key of the service; None: that of the environment, if any.
        broker_key: File with the public key of the broker; None: that of the environment, if any.
        restarted: Whether a supervisor starts this process again whenever its status is not 0.
        modules: Folders in which the module is looked for, too.
        inputs: What the implementation consumes by its settings (`Service.inputs_with`).

    Returns:
        The exit status of the process; what is wrong is written to standard error.
    """
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(message)s")
    # See to it that what a process says before it dies stands in its log.
    if isinstance(sys.stdout, io.TextIOWrapper):  # a test, or a notebook, may have put something else there
        sys.stdout.reconfigure(line_buffering=True)
    if sys.stderr is sys.__stderr__:
        faulthandler.enable()
    role, separator, implementation = use.partition(":")
    if not separator:
        sys.stderr.write(f"caviar service: --use {use!r} is not ROLE:NAME, for example world:sumo\n")
        return 2
    for folder in (*modules, *[Path.cwd()] * (":" in implementation)):
        find_modules_in(folder)
    steady_memory()
    try:
        found = find_credentials(key, broker_key)
        termination = SignalTermination(0 if restarted else TERMINATED)
        cls = with_inputs(load(role, implementation), inputs)
        runner = Runner(name, cls, implementation, broker, connect_timeout_s, termination, credentials=found)
        status = runner.run()
    except CaviarError as error:
        sys.stderr.write(f"caviar service {name}: {error}\n")
        return 1
    return restart_status(status, runner.ended) if restarted else status


def main() -> int:
    """Parse the command line and serve; the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m caviar_services",
        description="One service as a process: ``python -m caviar_services NAME --use role:implementation "
        "--broker URL``.",
    )
    parser.add_argument("name", help="name of the service in the run")
    parser.add_argument("--use", required=True, metavar="ROLE:NAME", help="registered implementation")
    parser.add_argument("--broker", required=True, metavar="URL", help="tcp://host:port of the broker")
    parser.add_argument(
        "--connect-timeout",
        type=float,
        default=CONNECT_TIMEOUT_S,
        metavar="S",
        help="how long to wait for the broker; it may start later than its services",
    )
    parser.add_argument("--key", type=Path, help="secret key of this service, NAME.key; else $CAVIAR_KEY")
    parser.add_argument(
        "--broker-key", type=Path, help="public key of the broker, broker.pub; else $CAVIAR_BROKER_KEY"
    )
    parser.add_argument(
        "--restarted",
        action="store_true",
        help="this process is started again whenever its status is not 0: status 1 after a run that failed, "
        "0 after SIGTERM",
    )
    parser.add_argument(
        "--inputs",
        nargs="+",
        default=[],
        metavar="TOPIC[.PART]",
        help="what the implementation consumes by its settings, as a policy that observes lidar.grid",
    )
    parser.add_argument(
        "--modules", type=Path, action="append", default=[], help="folder of the module of ROLE:module:Class"
    )
    arguments = parser.parse_args()
    inputs = [text.partition(".") for text in arguments.inputs]
    return serve(
        arguments.name,
        arguments.use,
        arguments.broker,
        arguments.connect_timeout,
        arguments.key,
        arguments.broker_key,
        restarted=arguments.restarted,
        modules=arguments.modules,
        inputs=[Input(topic=topic, parts=(part,) if part else ()) for topic, _, part in inputs],
    )
