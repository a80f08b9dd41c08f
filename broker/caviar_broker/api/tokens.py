"""Who may do what over HTTP: ``tokens.toml`` in the keys directory."""

from __future__ import annotations

import hashlib
import ipaddress
from pathlib import Path
from typing import Annotated, get_args

import msgspec

from caviar_protocol.errors import SetupError
from caviar_protocol.messages import Role

FILE = "tokens.toml"
VIEWER, OPERATOR = "viewer", "operator"
SERVICE_ROLES: tuple[str, ...] = get_args(Role)
ROLES = (VIEWER, OPERATOR, *SERVICE_ROLES)


class Token(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One token, of which only the digest is known."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=200)]
    """Of who has it; of the service, where it is for one."""
    role: str
    """``viewer`` may read, ``operator`` may also pause, step and stop; a role of a service, such as
    ``agent``, may take part through the gateway under that name and in that role, and nothing else."""
    sha256: Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]

    def may(self, role: str) -> bool:
        """Whether it is good for what a viewer or an operator does."""
        return self.role == OPERATOR or self.role == role

    @property
    def of_service(self) -> bool:
        """Whether a service takes part with it."""
        return self.role in SERVICE_ROLES


class _File(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    token: tuple[Token, ...] = ()


class Tokens:
    """The tokens of a keys directory, as they are now: the file is read again when it changes.

    Parameters
    ----------
    directory
        Keys directory; None: there are no tokens, and everybody on this machine may do everything.
    """

    def __init__(self, directory: Path | None) -> None:
        self._path = directory / FILE if directory is not None else None
        self._stamp: tuple[int, int] | None = None
        self._by_digest: dict[str, Token] = {}
        self._read()

    @property
    def exist(self) -> bool:
        """Whether a token is asked for; from the first one on always, also when all are revoked."""
        self._read()
        return self._stamp is not None

    def find(self, text: str) -> Token | None:
        """The token that reads so."""
        self._read()
        return self._by_digest.get(hashlib.sha256(text.encode()).hexdigest())

    def holds(self, token: Token) -> bool:
        """Whether a token was not revoked."""
        self._read()
        return self._by_digest.get(token.sha256) == token

    def _read(self) -> None:
        """Take in the file, if it changed; one that cannot be used changes nothing."""
        if self._path is None:
            return
        try:
            self._take_in(self._path)
        except SetupError:
            if self._stamp is None:
                raise

    def _take_in(self, path: Path) -> None:
        try:
            found = path.stat()
            stamp = (found.st_mtime_ns, found.st_size)
            if stamp == self._stamp:
                return
            tokens = msgspec.toml.decode(path.read_bytes(), type=_File).token
        except FileNotFoundError:
            self._by_digest = {}
            return
        except OSError as error:
            raise SetupError(f"cannot read {path}: {error.strerror}") from error
        except msgspec.DecodeError as error:
            raise SetupError(f"{path} is not what it should be: {error}; mend that line") from None
        for token in tokens:
            if token.role not in ROLES:
                known = ", ".join(ROLES)
                raise SetupError(f"{path}: {token.name!r} has the role {token.role!r}; write one of {known}")
        self._stamp, self._by_digest = stamp, {token.sha256: token for token in tokens}


def http_address(text: str, keys: Path | None) -> tuple[str, int]:
    """Host and port of ``HOST:PORT``.

    Raises `SetupError` where it is none, or where other machines could reach it without a token.
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isascii() or not port.isdigit() or int(port) > 65535:
        raise SetupError(f"{text!r} is no address for HTTP; write HOST:PORT, such as 127.0.0.1:8080")
    if not is_loopback(host) and not Tokens(keys).exist:
        raise SetupError(
            f"HTTP at {text} could be reached by others, and there are no tokens; make one with  "
            "caviar keys token NAME --role operator  and give --keys, or choose 127.0.0.1"
        )
    return host, int(port)


def is_loopback(host: str) -> bool:
    """Whether a host name or address always means this machine."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
