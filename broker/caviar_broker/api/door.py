"""Who comes in: tokens, and, where there are none, only pages and programs of this machine."""

from __future__ import annotations

from collections.abc import Iterable
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from caviar_broker.api.tokens import Tokens, is_loopback
from caviar_protocol.codec import SUBPROTOCOL
from caviar_protocol.keys import Token

BEARER = "bearer."
"""Before a token among the subprotocols, where a browser has no header for it."""


class LocalOnly:
    """Refuses what a page from elsewhere has a browser send here, where no token protects from that.

    WebSockets pass: the gateway refuses those itself, in a way that a page can read.
    """

    def __init__(self, app: ASGIApp, tokens: Tokens) -> None:
        self._app, self._tokens = app, tokens

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or answer it."""
        reason = foreign(Headers(scope=scope), self._tokens) if scope["type"] == "http" else ""
        if reason:
            await JSONResponse({"detail": reason}, 403)(scope, receive, send)
        else:
            await self._app(scope, receive, send)


def foreign(headers: Headers, tokens: Tokens) -> str:
    """Why a request is that of a page of elsewhere, and refused; empty where there are tokens, or it is not.

    Such a page gives itself away by its ``Origin``, or, where it has had its own name point to this
    machine, by ``Host``.
    """
    if tokens.exist:
        return ""
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


def token_of(headers: Headers, tokens: Tokens, subprotocols: Iterable[str] = ()) -> Token | None:
    """The token of ``Authorization: Bearer TOKEN``, or of the subprotocol ``bearer.TOKEN``."""
    text = _text(headers, subprotocols)
    return tokens.find(text) if text else None


def token_shown(headers: Headers, subprotocols: Iterable[str]) -> bool:
    """Whether a request shows a token, of whatever worth."""
    return bool(_text(headers, subprotocols))


def _text(headers: Headers, subprotocols: Iterable[str]) -> str:
    scheme, _, text = headers.get("authorization", "").partition(" ")
    if scheme.lower() != "bearer":
        text = next((p.removeprefix(BEARER) for p in subprotocols if p.startswith(BEARER)), "")
    return text.strip()


def subprotocol(offered: Iterable[str]) -> str | None:
    """That of the answer: ours, if it is wanted; never the one with the token."""
    return SUBPROTOCOL if SUBPROTOCOL in offered else None
