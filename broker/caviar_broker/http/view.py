"""The viewer over HTTP: its page, and the answers that it asks for."""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Depends, FastAPI, HTTPException, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse

from caviar_broker.http.app import LocalOnly, may
from caviar_broker.http.auth import Tokens, http_address
from caviar_broker.http.server import http_server, listening_socket, place_of
from caviar_protocol.errors import CaviarError
from caviar_protocol.keys import VIEWER
from caviar_view.answers import BINARY, Answers, NotThereError

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
)
"""Content security policy of the page: nothing but its own files runs."""

_FILES = {
    "": ("index.html", "text/html; charset=utf-8"),
    "viewer.js": ("viewer.js", "text/javascript"),
    "viewer.css": ("viewer.css", "text/css"),
}
_COMPRESSED_FROM = 1024


async def serve_views(
    views: Mapping[str, Answers], address: str, keys: Path | None, announce: Callable[[str], None]
) -> None:
    """Serve the viewer, without a broker, until the process is interrupted.

    Args:
        views: Answers, as of `view_router`.
        address: ``HOST:PORT``; port 0: any free one.
        keys: Keys directory with tokens; None: processes of this machine are served without.
        announce: Called with the URL of the page, once it is served.

    Raises:
        SetupError: The address is none, or open to others without tokens.
        RunError: It is taken.
    """
    host, port = http_address(address, keys)
    tokens = Tokens(keys)
    app = FastAPI(title="CAVIAR viewer", docs_url=None, redoc_url=None, openapi_url=None)
    app.add_middleware(LocalOnly, tokens=tokens)
    app.include_router(view_router(views, [Depends(may(VIEWER, tokens))]))

    @app.get("/")
    async def root() -> Response:
        return RedirectResponse("view/")

    listening = listening_socket(host, port)
    server = http_server(app, lambda text: None)
    announce(f"http://{place_of(host, listening)}/view/")
    await server.serve(sockets=[listening])


def view_router(views: Mapping[str, Answers], viewer: list[Any]) -> APIRouter:
    """Make the routes below ``/view/``.

    Args:
        views: Answers by their place before ``data/``: "" and, of a second run, ``beside/``.
        viewer: Dependencies that check a request for data; the page itself has no data.
    """
    router = APIRouter(prefix="/view", include_in_schema=False)
    folder = resources.files("caviar_view") / "page"

    def page(name: str, media_type: str) -> Any:
        async def answer(request: Request) -> Response:
            content = (folder / name).read_bytes()
            return _response(request, content, media_type)

        return answer

    for path, (name, media_type) in _FILES.items():
        router.get(f"/{path}")(page(name, media_type))

    def data(answers: Answers) -> Any:
        async def answer(path: str, request: Request) -> Response:
            try:
                found = await run_in_threadpool(answers.get, path, dict(request.query_params))
            except NotThereError as error:
                raise HTTPException(404, str(error)) from None
            except CaviarError as error:
                raise HTTPException(409, str(error)) from None
            return _response(request, found.content, found.media_type)

        return answer

    for place, answers in views.items():
        router.get(f"/{place}data/{{path:path}}", dependencies=viewer)(data(answers))
    return router


def _response(request: Request, content: bytes, media_type: str) -> Response:
    headers = {
        "Content-Security-Policy": POLICY,
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cache-Control": "no-store",
    }
    if (
        media_type != BINARY
        and len(content) >= _COMPRESSED_FROM
        and "gzip" in request.headers.get("accept-encoding", "")
    ):
        headers["Content-Encoding"] = "gzip"
        content = gzip.compress(content, 1)
    return Response(content, media_type=media_type, headers=headers)
