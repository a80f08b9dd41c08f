"""Runs with services or brokers of other machines: ``caviar broker``, commands to type, ``caviar status``.

The file ``NAME.current`` in the folder of runs names the run in progress. It exists exactly while a broker
serves that run, or after a broker died while it did: a broker that starts again resumes the run.
"""

from __future__ import annotations

import shlex
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import typer
from rich.console import Console

import caviar_clients
from caviar_clients.cli.shared import new_run_directory, print_line
from caviar_protocol.errors import RunError
from caviar_protocol.files import replace_file
from caviar_protocol.keys import BROKER, BROKER_KEY_VARIABLE, KEY_VARIABLE, read_authorized
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import ServiceSpec
from caviar_services.registry import registered


def serve_broker(
    path: Path,
    out: Path,
    frames: int | None,
    seed: int | None,
    pace: str | None,
    bind: str,
    keys: Path | None,
    options: Sequence[str],
) -> int:
    """Serve a run whose services are started by hand, here or on other machines.

    With ``--restarted`` a run that an earlier broker left is resumed.

    Args:
        path: The scenario.
        out: Folder in which the run's own is made.
        frames, seed, pace: What replaces the scenario's; None: nothing.
        bind: Address to listen on; empty for the default.
        keys: Keys directory; None: a run without keys.
        options: The options of the broker's own command line that a new and a resumed run share.

    Returns:
        The exit status.

    Raises:
        ScenarioError: A key or value of the scenario is wrong.
        RunError: The run's directory cannot be made.
    """
    # `caviar run` and `caviar status` load this module, and no broker: a server takes a third of a second.
    from caviar_broker.launch import DEFAULT_BIND, parser, serve
    from caviar_broker.security.access import check_bind
    from caviar_clients.session.prepared import prepare

    prepared = prepare(path, frames, seed, pace)
    scenario = prepared.scenario
    check_bind(bind or DEFAULT_BIND, keys=keys is not None)
    current = RunInProgress(out, scenario.run.name) if "--restarted" in options else None
    left = current.directory() if current else None
    if current is not None and left is not None:
        typer.echo(f"run {left}: its broker died, another one resumes it")
        return current.serve(left, lambda: resume_broker(left, options))
    directory = new_run_directory(out, scenario.run.name)
    for warning in prepared.warnings:
        typer.echo(f"warning: {warning}", err=True)
    typer.echo(f"run {directory}; start its services; from elsewhere, with --broker and its address:")
    for command in service_commands(scenario.services, bind, keys):
        typer.echo(f"  {command}")
    arguments = [*options, str(path), "--directory", str(directory)]
    for name, value in (("--frames", frames), ("--seed", seed), ("--pace", pace)):
        arguments += [] if value is None else [name, str(value)]
    parsed = parser().parse_args(arguments)
    return current.serve(directory, lambda: serve(parsed)) if current else serve(parsed)


def resume_broker(directory: Path, options: Sequence[str]) -> int:
    """Serve a run whose broker died, from where its journal ends; the exit status."""
    from caviar_broker.launch import parser, serve

    return serve(parser().parse_args(["--resume", str(directory), *options]))


class RunInProgress:
    """The run of a scenario that a broker serves, or served when it died: the file ``NAME.current``.

    Args:
        root: The folder of runs.
        name: The scenario's name.
    """

    def __init__(self, root: Path, name: str) -> None:
        self._root, self._file = root, root / f"{name}.current"

    def directory(self) -> Path | None:
        """Find the directory of a run whose broker died; None where there is none to resume."""
        try:
            left = self._root / self._file.read_text().strip()
        except OSError:
            return None
        # A broker that died before it wrote the record had begun nothing that could be resumed.
        return left if RunDirectory(left).record.is_file() else None

    def serve(self, directory: Path, serve: Callable[[], int]) -> int:
        """Serve a run, with the file in place until it ends.

        Args:
            directory: The run's directory, in the folder of runs.
            serve: Serves the run to its end, whatever that is, and returns the exit status.

        Returns:
            The exit status of ``serve``.

        Raises:
            RunError: The file cannot be written.
        """
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
    """Print what the broker of a run waits for, and why.

    Args:
        run: The run's directory; None: that of the newest one that runs below ``./runs``.
        console: Where it is printed.

    Raises:
        RunError: No broker runs there.
    """
    from caviar_broker.control.socket import ask  # with asyncio, which `caviar run` does without

    directory = run if run is not None else newest_run(RUNS)
    for line in why_lines(ask(directory, do="why")["why"]):
        print_line(console, line)


def newest_run(root: Path, command: str = "caviar status RUN") -> Path:
    """Find the run below a folder whose broker was started last and is still noted there.

    Args:
        root: The folder.
        command: How a user names another run, for the error.

    Raises:
        RunError: No broker is noted below ``root``.
    """
    notes = [note for run in root.glob("*") if (note := RunDirectory(run).control_note).is_file()]
    if not notes:
        raise RunError(f"no broker runs below {root.resolve()}; name the directory of a run: {command}")
    return max(notes, key=lambda note: note.stat().st_mtime_ns).parent


def why_lines(why: Mapping[str, Any]) -> Iterator[str]:
    """Put the answer of a broker's control socket to ``why`` into words."""
    waits, last = why["waits"], why["last_blame"]
    late = [wait for wait in waits if wait["late"]]
    where = f", episode {why['episode']}, frame {why['frame']}" if why["frame"] >= 0 else ""
    paused = ", paused" if why["paused"] else ""
    yield f"run {why['run']}: {why['state']}{where}{paused}"
    if why["error"]:
        yield f"it ends early: {why['error']}"
    if not late:
        idle = why["paused"] and not waits
        rest = ": the run is paused, and every frame that has begun is finished" if idle else ""
        yield f"no service is late{rest}"
    for wait in waits:
        yield f"{'late' if wait['late'] else 'waited for'}: {wait['text']}"
    if last is not None:
        frame = f" in frame {last['frame']}" if last["frame"] >= 0 else ""
        yield f"last blame: {last['kind']}: {last['service']}{frame}: {last['text']}"


SOURCES = Path(caviar_clients.__file__).parents[1]
"""Of the example clients; they come with the sources and not with an installed package."""
EXAMPLES = {"agent": "minimal/agent.py", "world": "python/world.py"}
"""Role to the script of its example, in Python."""
_EVERYWHERE = ("0.0.0.0", "[::]", "*")  # noqa: S104  # recognised, not bound


def reachable(endpoint: str) -> str:
    """Turn an address that a broker listens on into one to connect to, from another machine too.

    Example:
        >>> reachable("tcp://10.0.0.7:5570")
        'tcp://10.0.0.7:5570'
    """
    transport, _, place = endpoint.partition("://")
    host, _, port = place.rpartition(":")
    return f"{transport}://{socket.gethostname()}:{port}" if host in _EVERYWHERE else endpoint


def start_command(name: str, spec: ServiceSpec, endpoint: str) -> str:
    """Write the command that starts a remote service, as far as it can be known.

    Args:
        name: Of the service.
        spec: Of the service, from the scenario.
        endpoint: Address of the broker, to connect to.
    """
    # A checkout has clients to copy from; an installed package does not.
    script = EXAMPLES.get(spec.role, "")
    if script and (SOURCES / script).exists():
        return f"python {_shown(SOURCES / script)} {endpoint} {shlex.quote(name)}"
    use = f"{spec.role}:IMPLEMENTATION"
    return f"caviar service {shlex.quote(name)} --use {use} --broker {endpoint}"


def waiting_text(name: str, spec: ServiceSpec, endpoint: str, seconds: float) -> str:
    """Write what to do about a remote service for which the run waits.

    Args:
        name, spec: Of the service, from the scenario.
        endpoint: Address that the broker listens on.
        seconds: How long it waits [s].
    """
    there = reachable(endpoint)
    command = start_command(name, spec, there)
    # No program is known that fits: the user chooses among the implementations that are here.
    known = sorted(key.partition(":")[2] for key in registered() if key.startswith(f"{spec.role}:"))
    where = f" (IMPLEMENTATION: {', '.join(known)})" if "IMPLEMENTATION" in command else ""
    return (
        f"waiting for {name!r} ({spec.role}) at {there}, for {seconds:g} s (timeouts.connect_s): "
        f"start your own client with this address and name (protocol/SPEC.md), or  {command}{where}"
    )


def service_commands(services: Mapping[str, ServiceSpec], bind: str, keys: Path | None) -> list[str]:
    """Write the commands that start the services of a run whose broker stands alone.

    Args:
        services: Of the scenario, by name.
        bind: Address on which the broker will listen; the commands name it where it has a port.
        keys: Keys directory; None: a run without keys.

    Returns:
        A command for each service. With keys, those come first that authorize services which are not yet.
    """
    # Port 0 or *: which one it is, the broker prints once it listens.
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
    """The command that authorizes a service, with the key that it has or with one that it makes."""
    public, into = keys / f"{name}.pub", ["--role", spec.role, "--directory", str(keys)]
    if public.exists():
        return ["caviar", "keys", "authorize", str(public), "--name", name, *into]
    return ["caviar", "keys", "new", name, *into]


def key_text(name: str, keys: Path | None) -> str:
    """Name the environment that a service with keys needs; empty for a run without keys."""
    if keys is None:
        return ""
    broker, secret = keys / f"{BROKER}.pub", keys / f"{name}.key"
    secret = secret if secret.exists() else Path(secret.name)  # made on the machine of the service
    return f"  with {KEY_VARIABLE}={secret} and {BROKER_KEY_VARIABLE}={broker} in its environment"


def _shown(path: Path) -> str:
    """A path for a command: relative to the current folder where it is below that."""
    here = Path.cwd()
    return shlex.quote(str(path.relative_to(here) if path.is_relative_to(here) else path))
