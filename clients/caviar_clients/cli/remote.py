"""What a user types to start a service that `caviar run` does not start."""

from __future__ import annotations

import shlex
import socket
from collections.abc import Mapping
from pathlib import Path

import caviar_clients
from caviar_protocol.keys import BROKER, BROKER_KEY_VARIABLE, KEY_VARIABLE, read_authorized
from caviar_protocol.scenario import ServiceSpec
from caviar_services.registry import registered

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
