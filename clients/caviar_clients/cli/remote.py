"""Runs with services or brokers of other machines: commands to type, restarts, and ``caviar why``.

The file ``NAME.current`` in the folder of runs names the run in progress. It exists exactly while a broker
serves that run, or after a broker died while it did: a broker that starts again resumes the run.
"""

from __future__ import annotations

import shlex
import socket
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

import caviar_clients
from caviar_broker.control.socket import ask
from caviar_protocol.errors import RunError
from caviar_protocol.files import RunDirectory, replace_file
from caviar_protocol.keys import BROKER, BROKER_KEY_VARIABLE, KEY_VARIABLE, read_authorized
from caviar_protocol.scenario import ServiceSpec
from caviar_services.registry import registered


class RunInProgress:
    """The run of a scenario's name that goes on in the folder ``root``."""

    def __init__(self, root: Path, name: str) -> None:
        self._root, self._file = root, root / f"{name}.current"

    def directory(self) -> Path | None:
        """Of the run whose broker died; None where there is none to go on with."""
        try:
            left = self._root / self._file.read_text().strip()
        except OSError:
            return None
        return left if RunDirectory(left).record.is_file() else None

    def serve(self, directory: Path, serve: Callable[[], int]) -> int:
        """Serve a run to its end, whatever that is; the exit status of ``serve``."""
        try:
            replace_file(self._file, f"{directory.name}\n".encode())
        except OSError as error:
            raise RunError(f"cannot write {self._file}: {error.strerror}; choose another --out") from error
        try:
            return serve()
        finally:
            self._file.unlink(missing_ok=True)


RUNS = Path("runs")


def why_command(run: Path | None, console: Console) -> None:
    """Print what the broker of a run says; of the newest one that runs below ``./runs`` where none is named.

    Raises `RunError` where no broker runs there.
    """
    directory = run if run is not None else newest_run(RUNS)
    for line in why_lines(ask(directory, do="why")["why"]):
        console.print(line, highlight=False, soft_wrap=True, markup=False)


def newest_run(root: Path) -> Path:
    """The directory of the run below ``root`` whose broker was started last and is still noted there."""
    notes = [note for run in root.glob("*") if (note := RunDirectory(run).control_note).is_file()]
    if not notes:
        raise RunError(f"no broker runs below {root.resolve()}; name the directory of a run: caviar why RUN")
    return max(notes, key=lambda note: note.stat().st_mtime_ns).parent


def why_lines(why: Mapping[str, Any]) -> Iterator[str]:
    """The answer of a desk, in words."""
    waits, last = why["waits"], why["last_blame"]
    late = [wait for wait in waits if wait["late"]]
    where = f", episode {why['episode']}, frame {why['frame']}" if why["frame"] >= 0 else ""
    paused = ", paused" if why["paused"] else ""
    yield f"run {why['run']}: {why['state']}{where}{paused}"
    if why["error"]:
        yield f"it ends early: {why['error']}"
    if not late:
        yield _nobody_late(why)
    for wait in waits:
        yield f"{'late' if wait['late'] else 'waited for'}: {wait['text']}"
    if last is not None:
        frame = f" in frame {last['frame']}" if last["frame"] >= 0 else ""
        yield f"last blame: {last['kind']}: {last['service']}{frame}: {last['text']}"


def _nobody_late(why: Mapping[str, Any]) -> str:
    if why["paused"] and not why["waits"]:
        return "nobody is late: the run is paused, and every frame that has begun is finished"
    return "nobody is late"


MINIMAL = Path(caviar_clients.__file__).parents[1] / "minimal"
"""The example clients; they come with the sources and not with an installed package."""
EXAMPLES = {"agent": ("python", "agent.py"), "world": ("node", "node/world.mjs")}
"""Role to the program and the script of its example."""
_EVERYWHERE = ("0.0.0.0", "[::]", "*")  # noqa: S104  # recognised, not bound


def reachable(endpoint: str) -> str:
    """An address to connect to, where a broker may listen on all of this machine's."""
    transport, _, place = endpoint.partition("://")
    host, _, port = place.rpartition(":")
    return f"{transport}://{socket.gethostname()}:{port}" if host in _EVERYWHERE else endpoint


def start_command(name: str, spec: ServiceSpec, endpoint: str) -> str:
    """A command that fills the place of a remote service, as far as it can be known."""
    program, script = EXAMPLES.get(spec.role, ("", ""))
    if script and (MINIMAL / script).exists():
        return f"{program} {_shown(MINIMAL / script)} {endpoint} {shlex.quote(name)}"
    use = f"{spec.role}:IMPLEMENTATION"
    return f"caviar service {shlex.quote(name)} --use {use} --broker {endpoint}"


def waiting_text(name: str, spec: ServiceSpec, endpoint: str, seconds: float) -> str:
    """What the user is told while a remote service is waited for."""
    there = reachable(endpoint)
    command = start_command(name, spec, there)
    known = sorted(key.partition(":")[2] for key in registered() if key.startswith(f"{spec.role}:"))
    where = f" (IMPLEMENTATION: {', '.join(known)})" if "IMPLEMENTATION" in command else ""
    return (
        f"waiting for {name!r} ({spec.role}) at {there}, for {seconds:g} s (timeouts.connect_s): "
        f"start your own client with this address and name (protocol/SPEC.md), or  {command}{where}"
    )


def service_commands(services: Mapping[str, ServiceSpec], bind: str, keys: Path | None) -> list[str]:
    """Commands that start the services of a run whose broker stands alone.

    They name the broker's address where it is known before it listens, and where it has keys those of
    each service. Before them stand the commands that let services in which nothing lets in yet.
    """
    place = reachable(bind) if bind.rpartition(":")[2].strip("0*!") else ""
    address = ["--broker", place] if place else []
    authorized = {entry.name for entry in read_authorized(keys)} if keys is not None else set()
    before, commands = [], []
    for name, spec in services.items():
        use = "IMPLEMENTATION" if spec.remote else spec.use
        command = ["caviar", "service", name, "--use", f"{spec.role}:{use}", *address]
        if keys is not None:
            before += [] if name in authorized else [_authorization(name, spec, keys)]
            secret = keys / f"{name}.key"
            elsewhere = name in authorized and not secret.exists()
            secret = Path(secret.name) if elsewhere else secret  # made on the machine of the service
            command += ["--key", str(secret), "--broker-key", str(keys / f"{BROKER}.pub")]
        commands.append(command)
    return [shlex.join(command) for command in before + commands]


def _authorization(name: str, spec: ServiceSpec, keys: Path) -> list[str]:
    """The command that lets a service in: with the key that it has, or with one that it makes."""
    public, into = keys / f"{name}.pub", ["--role", spec.role, "--directory", str(keys)]
    if public.exists():
        return ["caviar", "keys", "authorize", str(public), "--name", name, *into]
    return ["caviar", "keys", "new", name, *into]


def key_text(name: str, keys: Path | None) -> str:
    """What the user is told of the key that a service needs; nothing where the broker has none."""
    if keys is None:
        return ""
    broker, secret = keys / f"{BROKER}.pub", keys / f"{name}.key"
    secret = secret if secret.exists() else Path(secret.name)  # made on the machine of the service
    return f"  with {KEY_VARIABLE}={secret} and {BROKER_KEY_VARIABLE}={broker} in its environment"


def _shown(path: Path) -> str:
    """Relative to where the user is, if it stands below."""
    here = Path.cwd()
    return shlex.quote(str(path.relative_to(here) if path.is_relative_to(here) else path))
