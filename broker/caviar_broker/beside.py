"""HTTP beside a broker: a process of its own, started with it, and never waited for."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

from caviar_broker.api.tokens import http_address
from caviar_broker.processes import describe_exit
from caviar_broker.server import BrokerServer
from caviar_protocol.errors import SetupError

END_S = 3.0
"""[s] that it gets to end behind the broker's last frame, which it sees by itself."""
LOG = Path("logs", "http.log")


class HttpBeside:
    """The process that serves HTTP for a broker; without an address, nothing.

    Parameters
    ----------
    directory
        Of the run.
    address
        ``HOST:PORT``; "" for none.
    keys
        Keys directory with the tokens.
    again
        Whether the run goes on: then the process of the broker before may hold the address a moment longer.

    Raises `SetupError` where the address is none, taken, or open to others without tokens.
    """

    def __init__(self, directory: Path, address: str, keys: Path | None, again: bool = False) -> None:
        self._directory, self._address, self._keys = directory, address, keys
        self._process: subprocess.Popen[bytes] | None = None
        self._fd = -1
        if address:
            place = http_address(address, keys)
            if not again:
                _refuse_taken(*place)

    def start(self, server: BrokerServer) -> None:
        """Start it; the server's loop notes when it ends."""
        if not self._address:
            return
        command = [sys.executable, "-m", "caviar_broker.api", str(self._directory), "--http", self._address]
        command += ["--keys", str(self._keys)] if self._keys is not None else []
        log = self._directory / LOG
        log.parent.mkdir(exist_ok=True)
        with log.open("wb") as file:
            self._process = subprocess.Popen(  # noqa: S603  # our own module with checked arguments
                command, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True
            )
        self._fd = os.pidfd_open(self._process.pid)
        server.loop.watch(self._fd, lambda: self._ended(server))

    def _ended(self, server: BrokerServer) -> None:
        server.loop.unwatch(self._fd)
        if self._process is not None:
            lines = (self._directory / LOG).read_text(errors="replace").strip().splitlines()
            said = f": {lines[-1]}" if lines else ""
            server.note("", f"HTTP is not served any more, {describe_exit(self._process.wait())}{said}")

    def close(self) -> None:
        """See it end."""
        if self._process is None:
            return
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._fd)


def _refuse_taken(host: str, port: int) -> None:
    """`SetupError` where nothing can listen: the process itself would end beside a run that goes on."""
    try:
        family, kind, number, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, number) as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind(place)
            trial.listen()
    except OSError as error:
        raise SetupError(
            f"HTTP cannot be served at {host}:{port}: {error.strerror}; "
            "choose another address, or port 0 for any"
        ) from None
