"""The viewer over HTTP: its page, and the answers that it asks for."""

from __future__ import annotations

import asyncio
import gzip
import json
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any

import msgspec
from fastapi import APIRouter, Depends, FastAPI, HTTPException, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import RedirectResponse, StreamingResponse

from caviar_broker.control.socket import Ask
from caviar_broker.http.app import LocalOnly, may
from caviar_broker.http.auth import Tokens, http_address
from caviar_broker.http.server import http_server, listening_socket, place_of
from caviar_broker.security.access import PAGE
from caviar_protocol.assets import AssetStore
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.fields import Asset
from caviar_protocol.keys import VIEWER, Credentials
from caviar_protocol.observer import EVERYTHING, Observer
from caviar_protocol.run_directory import RunDirectory
from caviar_view.answers import BINARY, Answers, NotThereError
from caviar_view.live import LiveFrames

PERIOD_S = 0.04
"""[s] from one frame that is shown to the next at least: more than a screen needs."""
AGAIN_S = 1.0
"""[s] after which a broker that has disconnected the observer is asked again."""
NEWS_S = 0.1
"""[s] between news of a run at least, where a page asks for no other time."""
QUIET_S = 0.5
"""[s] between news of a run that makes no frames, and between questions to the broker."""

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


async def serve_views(views: Views, address: str, keys: Path | None, announce: Callable[[str], None]) -> None:
    """Serve the viewer, without a broker, until the process is interrupted.

    Args:
        views: What is shown.
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


class LiveView:
    """Answers about a run as it goes on: observed from the first request on, until the run ends.

    Args:
        ask: Asks the broker.
        directory: Of the run.
        endpoint: ZeroMQ address of the broker.
        credentials: For a broker with keys.
    """

    def __init__(self, ask: Ask, directory: Path, endpoint: str, credentials: Credentials | None) -> None:
        self._ask, self._record = ask, RunDirectory(directory).record
        self._observed = endpoint, PAGE, EVERYTHING, credentials
        self._starting = asyncio.Lock()
        self._asking = asyncio.Lock()
        # What the run waits for, as the broker last said, and when.
        self._why: Mapping[str, Any] = {"state": "", "paused": False, "waits": []}
        self._why_at = 0.0
        self._answers: Answers | None = None
        self._frames: LiveFrames | None = None
        # Why there is no observer now, and why the run is over; empty while there is none.
        self._failure = self._ended = ""

    async def answers(self, path: str) -> Answers:
        """Answers; the observer begins with the first call.

        Raises:
            RunError: The run has not begun, or the broker refuses the observer.
        """
        async with self._starting:
            if self._answers is None:
                await self._start()
        failure = self._failure or self._ended
        if self._answers is None or self._frames is None or (failure and not self._frames.end):
            raise RunError(failure)
        if path == "clock":
            known = self._frames.known_answers()
            self._frames.add_answers((await self._ask(do="answers", known=known))["answers"])
        return self._answers

    async def _start(self) -> None:
        status = (await self._ask(do="status"))["status"]
        if status["state"] in ("joining", "preparing"):
            waits = ", ".join(wait["service"] for wait in status["waits"])
            raise RunError(f"the run has not begun: it waits for {waits or 'its services'}")
        scenery = await self._ask(do="scenery")
        wanted = msgspec.convert(scenery["assets"], list[Asset])
        assets = await asyncio.to_thread(AssetStore(Path(scenery["store"])).folder_of, wanted)
        try:
            record = json.loads(await asyncio.to_thread(self._record.read_text, "utf-8"))
        except OSError as error:
            raise RunError(f"cannot read {self._record}: {error.strerror}") from None
        scenario = record["scenario"]
        seed = (scenario.get("run") or {}).get("seed", 0)
        self._frames = LiveFrames(self._record.parent, scenario, status["run"], seed, assets)
        self._answers = Answers(self._frames, controls=True)
        threading.Thread(target=self._observe, args=(self._frames,), name="observer", daemon=True).start()
        for _ in range(100):  # the first frame, where there is one: a page can show it at once
            if self._frames.end or self._failure or self._ended:
                break
            await asyncio.sleep(0.02)

    def _observe(self, frames: LiveFrames) -> None:
        while not self._ended:
            try:
                with Observer(*self._observed, period_s=PERIOD_S) as observer:
                    self._failure = ""
                    for seen in observer:
                        frames.add(seen)
                self._ended = observer.ended or "the run is over"
            except CaviarError as error:
                # A process that was stopped is disconnected, as slow: this one ends with the broker.
                self._failure = str(error)
                time.sleep(AGAIN_S)

    async def news(self, every_s: float) -> AsyncIterator[bytes]:
        """Server-sent events about new frames, and what the run does; without any, one in `QUIET_S`."""
        frames, told, said_at = (await self.answers("news")).frames, -1, 0.0
        while not self._ended:
            if frames.end != told or time.monotonic() - said_at > QUIET_S:
                why = await self._waits()
                added = self._answers.blocks(told) if self._answers else []
                told, said_at = frames.end, time.monotonic()
                event = {key: why.get(key) for key in ("state", "paused", "waits")}
                event |= {"first": frames.first, "frames": told, "added": added}
                yield f"data: {json.dumps(event)}\n\n".encode()
            await asyncio.sleep(every_s)
        yield f"data: {json.dumps({'ended': self._ended})}\n\n".encode()

    async def _waits(self) -> Mapping[str, Any]:
        """What the run waits for, as the broker said at most `QUIET_S` ago, for all pages."""
        async with self._asking:
            if time.monotonic() - self._why_at > QUIET_S:
                try:
                    self._why = (await self._ask(do="why"))["why"]
                except RunError:  # a broker that is busy, or that has ended, as the observer finds out
                    await asyncio.sleep(QUIET_S)
                self._why_at = time.monotonic()
            return self._why


Views = Mapping[str, Callable[[str], Awaitable[Answers]]]
"""By the place before ``data/``, "" and, of a second run, ``beside/``: answers for a path."""


def standing(answers: Answers) -> Callable[[str], Awaitable[Answers]]:
    """Answers that are there from the beginning, as an entry of `Views`."""

    async def found(_: str) -> Answers:
        return answers

    return found


def view_router(views: Views, viewer: list[Any], live: LiveView | None = None) -> APIRouter:
    """Make the routes below ``/view/``.

    Args:
        views: What is shown.
        viewer: Dependencies that check a request for data; the page itself has no data.
        live: Has the news of a run as it goes on; None: there are none.
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

    if live is not None:
        news = live.news

        @router.get("/data/news", dependencies=viewer)
        async def tell(every: Annotated[float, Query(ge=NEWS_S, le=60)] = NEWS_S) -> Response:
            return StreamingResponse(news(every), media_type="text/event-stream")

    def data(view: Callable[[str], Awaitable[Answers]]) -> Any:
        async def answer(path: str, request: Request) -> Response:
            try:
                answers = await view(path)
                found = await run_in_threadpool(answers.get, path, dict(request.query_params))
            except RunError as error:
                raise HTTPException(503, str(error)) from None
            except NotThereError as error:
                raise HTTPException(404, str(error)) from None
            except CaviarError as error:
                raise HTTPException(409, str(error)) from None
            return _response(request, found.content, found.media_type)

        return answer

    for place, view in views.items():
        router.get(f"/{place}data/{{path:path}}", dependencies=viewer)(data(view))
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
