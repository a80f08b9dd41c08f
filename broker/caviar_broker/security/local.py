"""Which addresses are reachable from this machine alone."""

from __future__ import annotations

import ipaddress
import socket

from caviar_protocol.errors import RunError

LOOPBACK_INTERFACE = "lo"


def is_local(endpoint: str) -> bool:
    """Whether only processes of this machine can connect to what is bound to a ZeroMQ address.

    ``ipc://`` and ``inproc://`` are local, of ``tcp://`` the loopback addresses of IPv4 and IPv6, the
    loopback interface, and names of which every address is one of these. What cannot be resolved is not.
    """
    transport, _, place = endpoint.partition("://")
    if transport in ("ipc", "inproc"):
        return True
    host = place.rpartition(":")[0].removeprefix("[").removesuffix("]")
    if host == LOOPBACK_INTERFACE:
        return transport == "tcp"
    return transport == "tcp" and all(_loopback(address) for address in _addresses(host))


def check_bind(endpoint: str, keys: bool) -> None:
    """Raises `RunError` for what is no address, and where others could reach a broker without keys."""
    if "://" not in endpoint:
        raise RunError(f"{endpoint!r} is no address to listen at; write it as tcp://127.0.0.1:5570")
    if keys or is_local(endpoint):
        return
    raise RunError(
        f"{endpoint} can be reached from other machines, and without keys everybody there could take part; "
        "make keys with  caviar keys new broker --directory keys  and  caviar keys new NAME --role ROLE "
        "--directory keys,  and give --keys keys; or listen on this machine alone: --bind tcp://127.0.0.1:PORT"
    )


def _addresses(host: str) -> list[str]:
    """Numeric addresses of a host; one that is not local, where there are none."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM) if host and host != "*" else []
    except (OSError, UnicodeError):
        found = []
    return [str(entry[4][0]) for entry in found] or ["0.0.0.0"]  # noqa: S104  # stands for any, not bound


def _loopback(address: str) -> bool:
    parsed = ipaddress.ip_address(address.partition("%")[0])
    mapped = getattr(parsed, "ipv4_mapped", None)
    return (mapped or parsed).is_loopback
