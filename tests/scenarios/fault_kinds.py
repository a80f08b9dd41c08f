"""What goes wrong in a process of a run, in a given frame and only once; see `fault_nursery`."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from caviar_protocol import messages as m

if TYPE_CHECKING:
    from fault_nursery import Case

FLOOD = 50_000
"""Messages of a flood."""
FLOOD_S = 1.0
"""[s] that a flood lasts at most."""
GARBAGE = (b"\xff\x00\xff\x00", b"\xc1", bytes(range(256)), b"\x81\xa4type\xa6GETOUT")


def arm_service(case: Case, name: str) -> None:
    """In the process of a service: go wrong in the frame of the case, unless another process did before."""
    if name != case.victim:
        return
    from caviar_services import runner
    from caviar_services.session import ServiceSession

    if case.remote:
        runner.host_identity = lambda: "another machine"  # type: ignore[attr-defined]

    granted = ServiceSession._grant

    def grant(self: ServiceSession, message: m.Grant, parts: Sequence[Any], now: float) -> None:
        if message.frame >= case.frame and claims(case):
            SERVICE[case.fault](self._send.__self__)  # type: ignore[attr-defined]  # the runner
        granted(self, message, parts, now)

    ServiceSession._grant = grant  # type: ignore[method-assign]


def arm_broker(case: Case) -> None:
    """In the process of the broker: go wrong, or be wronged, after the frame of the case."""
    if case.victim != "broker":
        return
    from caviar_broker.server import BrokerServer

    finished = BrokerServer._frame_finished

    def frame_finished(self: BrokerServer, action: Any) -> None:
        finished(self, action)
        if action.frame >= case.frame and claims(case):
            BROKER[case.fault](self)

    BrokerServer._frame_finished = frame_finished  # type: ignore[method-assign]


def claims(case: Case) -> bool:
    """Whether this process is the first one to go wrong in the run; says when."""
    try:
        with (Path(case.directory) / "fault").open("x") as file:
            file.write(str(time.monotonic()))
    except FileExistsError:
        return False
    return True


def kill(_: Any) -> None:
    """End by SIGKILL."""
    os.kill(os.getpid(), signal.SIGKILL)


def stop(_: Any) -> None:
    """Be stopped, as by a debugger or a shell."""
    os.kill(os.getpid(), signal.SIGSTOP)


def disconnect(_: Any) -> None:
    """Lose every TCP connection, as when a router between restarts."""
    for entry in tuple(Path("/proc/self/fd").iterdir()):
        with suppress(OSError), socket.socket(fileno=os.dup(int(entry.name))) as connection:
            if connection.family in (socket.AF_INET, socket.AF_INET6):
                connection.getpeername()  # raises where it listens
                connection.shutdown(socket.SHUT_RDWR)


def garbage(runner: Any) -> None:
    """Send what is no message of the protocol."""
    for noise in GARBAGE:
        runner._broker._socket.send(noise)


def flood(runner: Any) -> None:
    """Send messages as fast as possible."""
    from caviar_protocol.codec import encode_message
    from caviar_protocol.errors import RunError

    message = encode_message(m.Error(code="unexpected", message="x" * 64))
    until = time.monotonic() + FLOOD_S
    with suppress(RunError):
        for _ in range(FLOOD):
            if time.monotonic() > until:
                break
            runner._broker.send_parts([message])


def stranger(body: Callable[[Any], None]) -> Callable[[Any], None]:
    """Another user of the machine who wrongs the broker, as a process of its own."""

    def fault(server: Any) -> None:
        endpoint = server.endpoint
        if os.fork() == 0:
            try:
                os.closerange(3, 1 << 12)
                if os.fork() == 0:  # an orphan, so that no process has to wait for it
                    import zmq

                    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
                    with context, context.socket(zmq.DEALER) as dealer, suppress(zmq.Again):
                        dealer.setsockopt(zmq.LINGER, 200)
                        dealer.setsockopt(zmq.SNDTIMEO, 50)
                        dealer.connect(endpoint)
                        body(dealer)
            finally:
                os._exit(0)

    return fault


def _garbage(dealer: Any) -> None:
    for noise in GARBAGE * 4:
        dealer.send(noise)


def _flood(dealer: Any) -> None:
    until = time.monotonic() + FLOOD_S / 2
    while time.monotonic() < until:
        dealer.send(b"\xc1" * 1000)


SERVICE: dict[str, Callable[[Any], None]] = {
    "kill": kill,
    "stop": stop,
    "garbage": garbage,
    "flood": flood,
    "disconnect": disconnect,
}
"""What a service does, given its runner."""
BROKER: dict[str, Callable[[Any], None]] = {
    "kill": kill,
    "stop": stop,
    "garbage": stranger(_garbage),
    "flood": stranger(_flood),
    "disconnect": disconnect,
}
"""What befalls a broker, given its server."""
