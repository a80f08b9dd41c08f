"""What a user types to start a service that `caviar run` does not start."""

from __future__ import annotations

import shlex
import socket
from pathlib import Path

import caviar_clients
from caviar_protocol.keys import BROKER, BROKER_KEY_VARIABLE, KEY_VARIABLE
from caviar_protocol.scenario import ServiceSpec

MINIMAL = Path(caviar_clients.__file__).parents[1] / "minimal" / "agent.py"
"""The example agent; it comes with the sources and not with an installed package."""
_EVERYWHERE = ("0.0.0.0", "[::]", "*")  # noqa: S104  # recognised, not bound


def reachable(endpoint: str) -> str:
    """An address to connect to, where a broker may listen on all of this machine's."""
    transport, _, place = endpoint.partition("://")
    host, _, port = place.rpartition(":")
    return f"{transport}://{socket.gethostname()}:{port}" if host in _EVERYWHERE else endpoint


def start_command(name: str, spec: ServiceSpec, endpoint: str) -> str:
    """A command that fills the place of a remote service, as far as it can be known."""
    if spec.role == "agent" and MINIMAL.exists():
        return f"python {_shown(MINIMAL)} {endpoint} {shlex.quote(name)}"
    use = f"{spec.role}:IMPLEMENTATION"
    return f"caviar service {shlex.quote(name)} --use {use} --broker {endpoint}"


def waiting_text(name: str, spec: ServiceSpec, endpoint: str, seconds: float) -> str:
    """What the user is told while a remote service is waited for."""
    there = reachable(endpoint)
    return (
        f"waiting for {name!r} ({spec.role}) at {there}, for {seconds:g} s (timeouts.connect_s): "
        f"start it with  {start_command(name, spec, there)}"
    )


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
