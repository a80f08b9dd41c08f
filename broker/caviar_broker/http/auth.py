"""Access over HTTP: the tokens of a keys directory, or, without any, clients of this machine alone."""

from __future__ import annotations

import hashlib
import ipaddress
from collections.abc import Iterable, Mapping
from pathlib import Path
from urllib.parse import urlsplit

from caviar_protocol.codec import SUBPROTOCOL
from caviar_protocol.errors import SetupError
from caviar_protocol.keys import TOKENS, Token, read_tokens


class Tokens:
    """The tokens of a keys directory, as they are now: the file is read again when it changes.

    Args:
        directory: Keys directory; None: there are no tokens, and a process of this machine may do everything.
    """

    def __init__(self, directory: Path | None) -> None:
        self._directory = directory
        self._stamp: tuple[int, int, int] | None = None
        self._by_digest: dict[str, Token] = {}
        self._read()

    @property
    def exist(self) -> bool:
        """True if a token is asked for; from the first one on always, also when all are revoked."""
        self._read()
        return self._stamp is not None

    def find(self, text: str) -> Token | None:
        """Find the token with this text; None where it is not known."""
        # The file holds digests: a copy of it lets no one in.
        self._read()
        return self._by_digest.get(hashlib.sha256(text.encode()).hexdigest())

    def holds(self, token: Token) -> bool:
        """Return whether a token was not revoked."""
        self._read()
        return self._by_digest.get(token.sha256) == token

    def _read(self) -> None:
        """Take in the file, if it changed; one that cannot be used changes nothing."""
        if self._directory is None:
            return
        try:
            self._take_in(self._directory)
        except SetupError:
            if self._stamp is None:
                raise  # at the start; later a file that is being edited must not lock its users out

    def _take_in(self, directory: Path) -> None:
        path = directory / TOKENS
        try:
            found = path.stat()
        except FileNotFoundError:
            self._by_digest = {}
            return
        except OSError as error:
            raise SetupError(f"cannot read {path}: {error.strerror}") from error
        # The inode too: editors replace a file, and two versions may have the same size and instant.
        stamp = (found.st_mtime_ns, found.st_ino, found.st_size)
        if stamp != self._stamp:
            tokens = read_tokens(directory)
            self._stamp, self._by_digest = stamp, {token.sha256: token for token in tokens}


def http_address(text: str, keys: Path | None) -> tuple[str, int]:
    """Check the address that HTTP is to be served at, and split it.

    Args:
        text: ``HOST:PORT``; an IPv6 address in brackets.
        keys: Keys directory; None: there is none.

    Raises:
        SetupError: It is no address, other machines could reach it without a token, or a broker
            with keys has no tokens: a process of this machine without a key could then stop the run.

    Example:
        >>> http_address("127.0.0.1:8080", None)
        ('127.0.0.1', 8080)
        >>> http_address("0.0.0.0:8080", None)  # doctest: +IGNORE_EXCEPTION_DETAIL
        Traceback (most recent call last):
        SetupError: HTTP at 0.0.0.0:8080 could be reached by others, and there are no tokens
    """
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not port.isascii() or not port.isdigit() or int(port) > 65535:
        raise SetupError(f"{text!r} is no address for HTTP; write HOST:PORT, such as 127.0.0.1:8080")
    if keys is not None and not Tokens(keys).exist:
        raise SetupError(
            f"HTTP at {text} would let every process of this machine in, though the broker asks for keys: "
            f"{keys} holds no tokens; make one with  caviar keys token NAME --role operator --directory "
            f"{keys},  or leave out --http"
        )
    if not is_loopback(host) and keys is None:
        raise SetupError(
            f"HTTP at {text} could be reached by others, and there are no tokens; make one with  "
            "caviar keys token NAME --role operator  and give --keys, or choose 127.0.0.1"
        )
    return host, int(port)


def is_loopback(host: str) -> bool:
    """Return whether a host name or address always means this machine.

    Names are deliberately not resolved, other than ``localhost``: what a name stands for may change
    between this check and the bind, or be decided by who runs the name server, and then HTTP without
    tokens would be open to others. A name that happens to mean this machine is refused instead, and
    its user writes the address.

    Example:
        >>> is_loopback("127.0.0.1"), is_loopback("localhost"), is_loopback("broker.lan")
        (True, True, False)
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


BEARER = "bearer."
"""Before a token among the subprotocols, where a browser has no header for it."""


def foreign(headers: Mapping[str, str], tokens: Tokens) -> str:
    """Say why a request, as one of a page of another machine, is refused; empty where it is not.

    Such a page gives itself away by its ``Origin``, or, where it has had its own name point to this
    machine, by ``Host``.
    """
    if tokens.exist:
        return ""  # a page cannot know a token, wherever it is from
    # DNS rebinding: the browser takes the page and this machine for one origin, but states the page's name.
    if not is_loopback(_host(f"//{headers.get('host', '')}")):
        return "without tokens only this machine's own names and addresses are served"
    origin = headers.get("origin")
    if origin is not None and not is_loopback(_host(origin)):
        return "without tokens no page of another machine is served"
    return ""


def _host(url: str) -> str:
    try:
        return urlsplit(url).hostname or ""
    except ValueError:
        return ""


def token_of(headers: Mapping[str, str], tokens: Tokens, subprotocols: Iterable[str] = ()) -> Token | None:
    """Read the token of ``Authorization: Bearer TOKEN``, or of the subprotocol ``bearer.TOKEN``.

    Args:
        headers: Of the request.
        tokens: Those that hold.
        subprotocols: That a WebSocket offers.
    """
    text = _text(headers, subprotocols)
    return tokens.find(text) if text else None


def token_shown(headers: Mapping[str, str], subprotocols: Iterable[str]) -> bool:
    """Return whether a request shows a token, valid or not.

    Example:
        >>> token_shown({"authorization": "Bearer abc"}, []), token_shown({}, ["caviar"])
        (True, False)
    """
    return bool(_text(headers, subprotocols))


def _text(headers: Mapping[str, str], subprotocols: Iterable[str]) -> str:
    scheme, _, text = headers.get("authorization", "").partition(" ")
    if scheme.lower() != "bearer":
        text = next((p.removeprefix(BEARER) for p in subprotocols if p.startswith(BEARER)), "")
    return text.strip()


def subprotocol(offered: Iterable[str]) -> str | None:
    """Choose the subprotocol of the answer: ours, if it is offered; never the one with the token.

    Example:
        >>> subprotocol([f"{BEARER}abc", SUBPROTOCOL]) == SUBPROTOCOL, subprotocol(["chat"])
        (True, None)
    """
    return SUBPROTOCOL if SUBPROTOCOL in offered else None
