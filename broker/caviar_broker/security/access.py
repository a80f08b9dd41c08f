"""Authentication: which key or token may take part as what, asked at each handshake and HELLO.

An unauthenticated peer gets no further than the handshake (ZAP status 400); one whose key is authorized for
another name, role or topic is refused at HELLO.
"""

from __future__ import annotations

import ipaddress
import socket
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from zmq.utils import z85

from caviar_protocol.errors import RunError, SetupError
from caviar_protocol.keys import (
    AUTHORIZED,
    BROKER,
    TOKENS,
    Authorization,
    Pair,
    Token,
    read_authorized,
    read_pair,
    read_tokens,
)

LOOPBACK_INTERFACE = "lo"


def is_local(endpoint: str) -> bool:
    """Return whether only processes of this machine can connect to what is bound to a ZeroMQ address.

    ``ipc://`` and ``inproc://`` are local, of ``tcp://`` the loopback addresses of IPv4 and IPv6, the
    loopback interface, and names of which every address is one of these. What cannot be resolved is not.

    Args:
        endpoint: The address.

    Example:
        >>> is_local("tcp://127.0.0.1:5570"), is_local("tcp://0.0.0.0:5570"), is_local("ipc:///tmp/caviar")
        (True, False, True)
    """
    transport, _, place = endpoint.partition("://")
    if transport in ("ipc", "inproc"):
        return True
    host = place.rpartition(":")[0].removeprefix("[").removesuffix("]")
    if host == LOOPBACK_INTERFACE:
        return transport == "tcp"
    return transport == "tcp" and all(_loopback(address) for address in _addresses(host))


def check_bind(endpoint: str, keys: bool) -> None:
    """Refuse what is no address, and one where other machines could reach a broker without keys.

    Args:
        endpoint: Address to listen at.
        keys: Whether the broker has keys.

    Raises:
        RunError: It is refused; the error says how keys are made.

    Example:
        >>> check_bind("tcp://0.0.0.0:5570", keys=True)
        >>> check_bind("tcp://0.0.0.0:5570", keys=False)  # doctest: +IGNORE_EXCEPTION_DETAIL
        Traceback (most recent call last):
        RunError: tcp://0.0.0.0:5570 can be reached from other machines
    """
    transport, separator, place = endpoint.partition("://")
    if not separator:
        raise RunError(f"{endpoint!r} is no address to listen at; write it as tcp://127.0.0.1:5570")
    host, _, port = place.rpartition(":")
    # Of a larger number libzmq takes the lower 16 bits, which is another port.
    if transport == "tcp" and not (port == "*" or (port.isdecimal() and int(port) < 1 << 16)):
        wrong = f"has the port {port!r}" if host and not place.endswith("]") else "has no port"
        raise RunError(
            f"{endpoint!r} {wrong}; write it as tcp://127.0.0.1:PORT, with a port from 0 (any free one) "
            "to 65535"
        )
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
    # An address of IPv4 may be written as one of IPv6: ::ffff:127.0.0.1.
    parsed = ipaddress.ip_address(address.partition("%")[0])
    mapped = getattr(parsed, "ipv4_mapped", None)
    return (mapped or parsed).is_loopback


BAR_NS = 10_000_000_000
"""[ns] for which a key that was cut off for its behaviour is not let in again."""
LOCAL = "services of this run"
"""What the key is called that a launcher gives to the services that it starts itself."""
GATEWAY = "WebSocket gateway"
"""What the key is called with which the gateway connects those who have a token."""
PAGE = "HTTP page"
"""Observer that the process with the gateway is itself; no token can have this name."""

_Stamp = tuple[int, int, int]


class Access:
    """The keys of a broker.

    Args:
        directory: Keys directory, with ``broker.key``, and ``authorized.toml`` and ``tokens.toml``, which may
            change at any time.
        local_key: Public key of the services that a launcher starts itself; "" for none.
        local: Name to role of these.

    Raises:
        SetupError: The directory lacks something.
    """

    def __init__(self, directory: Path, local_key: str = "", local: Mapping[str, str] | None = None) -> None:
        self.directory = directory
        path = directory / f"{BROKER}.key"
        if not path.exists():
            raise SetupError(
                f"there is no {path}; make it with  caviar keys new {BROKER} --directory {directory}"
            )
        self.pair = read_pair(path)
        self._local_key, self._local = local_key, dict(local or {})
        self.gateway = Pair.new()
        """Pair of the gateway of this broker, which is written nowhere and ends with it."""
        self._stamp = self._look()
        self._entries: dict[str, Authorization] = {}
        self._tokens: tuple[Token, ...] = ()
        self._read()
        # Public key to the instant until which it is barred [ns].
        self._barred: dict[str, int] = {}

    def name(self, key: str) -> str:
        """Name a key; "" for one that is not authorized."""
        if key == self._local_key:
            return LOCAL
        if key == self.gateway.public:
            return GATEWAY
        entry = self._entries.get(key)
        return entry.name if entry else ""

    def admits(self, key: str) -> str:
        """Say why a key may not connect at all; empty where it may."""
        if not self.name(key):
            return f"the key {key} is not authorized (caviar keys authorize)"
        if self._barred.get(key, 0) > time.monotonic_ns():
            return f"the key of {self.name(key)!r} was cut off and is barred for {BAR_NS // 10**9} s"
        return ""

    def refusal(self, key: str, name: str, role: str = "", outputs: Sequence[str] = ()) -> str:
        """Say why a key may not appear as that service; empty where it may.

        Args:
            key: Public key of the connection, in Z85.
            name: Of the service.
            role: Role of the service; empty: only the name counts.
            outputs: Topics that it declares.
        """
        # An empty key, of a connection that is not known, equals the local key of a broker without one.
        if key and key == self._local_key:
            known = self._local.get(name)
            if known is None:
                return f"the key given to services that this run starts is not for {name!r}"
            return _role_refusal(name, known, role)
        if key == self.gateway.public and name == PAGE:
            return _role_refusal(name, "observer", role)
        if key == self.gateway.public:
            # Reason why no peer of the gateway may appear as that service; the gateway checks its token.
            roles = [token.role for token in self._tokens if token.name == name and token.of_service]
            if not roles:
                return f"there is no token of a service {name!r} ({self._remedy(name, role or 'ROLE')})"
            if self._barred.get(f"{GATEWAY} {name}", 0) > time.monotonic_ns():
                return f"the WebSocket of {name!r} was cut off, and it is barred for {BAR_NS // 10**9} s"
            if role and role not in roles:
                return f"the token of {name!r} is for {roles[0]}, not for {role}"
            return ""
        entry = self._entries.get(key)
        if entry is None:
            return "its key is not authorized (caviar keys authorize)"
        if entry.name != name:
            return f"its key is authorized for the name {entry.name!r}, not for {name!r}"
        return _role_refusal(name, entry.role, role) or _topic_refusal(entry, outputs)

    def bar(self, key: str, service: str = "") -> None:
        """Do not let a key in for `BAR_NS`; of the gateway's, which all its peers share, only the service."""
        if key == self.gateway.public:
            self._barred[f"{GATEWAY} {service}"] = time.monotonic_ns() + BAR_NS
        elif key and key != self._local_key:
            self._barred[key] = time.monotonic_ns() + BAR_NS

    def reload(self) -> str | None:
        """Read the two files again if they changed.

        Returns:
            None where they did not change; else why they cannot be used, in which case what stood there
            before holds, or an empty text.
        """
        # Noted also for a file that cannot be used: the complaint comes once, not at every look.
        stamp = self._look()
        if stamp == self._stamp:
            return None
        self._stamp = stamp
        try:
            self._read()
        except SetupError as error:
            return f"{error}; what stood there before goes on holding"
        return ""

    def _read(self) -> None:
        """Read both files: each holds by itself, also where the other one cannot be used."""
        try:
            self._entries = {entry.public: entry for entry in read_authorized(self.directory)}
        finally:
            self._tokens = read_tokens(self.directory)

    def _look(self) -> tuple[_Stamp, _Stamp]:
        """Compute a value that changes whenever one of the files does."""
        return _stamp(self.directory / AUTHORIZED), _stamp(self.directory / TOKENS)

    def _remedy(self, name: str, role: str) -> str:
        return f"caviar keys token {name} --role {role} --directory {self.directory}"


def _stamp(path: Path) -> _Stamp:
    try:
        found = path.stat()
    except OSError:
        return (0, 0, 0)
    # The inode too: editors replace a file, and two versions may have the same size and instant.
    return (found.st_mtime_ns, found.st_ino, found.st_size)


def answer(access: Access | None, request: Sequence[bytes]) -> tuple[list[bytes], str]:
    """Answer a request of the ZeroMQ Authentication Protocol (RFC 27).

    The user id that it gives to each message of the connection is the public key, in Z85. Without
    ``access`` every peer is let in that asks for no mechanism.

    Args:
        access: The keys; None: none are asked for.
        request: Parts of the request.

    Returns:
        Parts of the reply, and why it refuses; empty where it does not.
    """
    version, sequence = [*request, b"", b""][:2]
    reason = f"a request of {len(request)} parts"
    key = ""
    if access is None and len(request) > 5 and request[5] == b"NULL":
        reason = ""
    elif access is not None and len(request) == 7 and request[5] == b"CURVE" and len(request[6]) == 32:
        key = z85.encode(request[6]).decode()
        reason = access.admits(key)
    elif len(request) > 5:
        reason = f"the mechanism {request[5].decode(errors='replace')!r} has no keys"
    status, text = (b"400", b"not authorized") if reason else (b"200", b"OK")
    return [version or b"1.0", sequence, status, text, b"" if reason else key.encode(), b""], reason


def _role_refusal(name: str, known: str, role: str) -> str:
    if role and role != known:
        return f"its key is authorized for {name!r} as {known}, not as {role}"
    return ""


def _topic_refusal(entry: Authorization, outputs: Sequence[str]) -> str:
    beyond = [] if entry.topics is None else [topic for topic in outputs if topic not in entry.topics]
    if not beyond:
        return ""
    allowed = ", ".join(entry.topics or ()) or "none"
    return f"its key is authorized for the topics {allowed}, not for {', '.join(beyond)}"
