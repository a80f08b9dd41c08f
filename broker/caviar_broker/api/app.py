"""The HTTP interface: what a broker's desk says and does, as JSON, and the gateway at ``/ws``."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Annotated, Any

from fastapi import Depends, FastAPI, HTTPException, Query, Request, WebSocket
from fastapi.responses import JSONResponse, PlainTextResponse
from fastapi.security import HTTPBearer

from caviar_broker.api import examples
from caviar_broker.api.door import LocalOnly, token_of
from caviar_broker.api.gateway import Gateway
from caviar_broker.api.link import DeskLink, DeskRefusal
from caviar_broker.api.metrics import CONTENT_TYPE, metrics
from caviar_broker.api.tokens import Tokens
from caviar_broker.desk import MAX_STEPS
from caviar_protocol.errors import RunError
from caviar_protocol.keys import OPERATOR, VIEWER
from caviar_protocol.messages import PROTOCOL_VERSION

ABOUT = """Look at a running CAVIAR broker, and have it pause, step or stop.

Where there are tokens, `Authorization: Bearer TOKEN` is asked for: a *viewer* may read, an *operator* may
give orders too. `/ws` is the WebSocket gateway (protocol/SPEC.md, section WebSocket)."""
READY = ("resetting", "running", "stopping")
_bearer = HTTPBearer(auto_error=False, description="token of caviar keys token")


def make_app(desk: DeskLink, tokens: Tokens, gateway: Gateway) -> FastAPI:
    """The application."""
    version = ".".join(map(str, PROTOCOL_VERSION))
    app = FastAPI(title="CAVIAR broker", version=version, description=ABOUT, docs_url=None, redoc_url=None)
    app.add_middleware(LocalOnly, tokens=tokens)
    app.add_exception_handler(DeskRefusal, _refused)
    app.add_exception_handler(RunError, _no_broker)
    viewer = [Depends(_bearer), Depends(_may(VIEWER, tokens))]
    operator = [Depends(_bearer), Depends(_may(OPERATOR, tokens))]
    _questions(app, desk, gateway, viewer)
    _orders(app, desk, operator)
    _probes(app, desk)

    @app.websocket("/ws")
    async def ws(socket: WebSocket) -> None:
        await gateway.serve(socket)

    return app


def _questions(app: FastAPI, desk: DeskLink, gateway: Gateway, viewer: list[Any]) -> None:
    @app.get("/status", dependencies=viewer, responses=_example(examples.STATUS))
    async def status() -> Any:
        """The run, its services, and what each of them does now."""
        return (await desk.ask("status"))["status"]

    @app.get("/why", dependencies=viewer, responses=_example(examples.WHY))
    async def why() -> Any:
        """Whom the run waits for now, and why; the last blame."""
        return (await desk.ask("why"))["why"]

    @app.get("/latencies", dependencies=viewer, responses=_example(examples.LATENCIES))
    async def latencies() -> Any:
        """How each service keeps its budget; quantiles of its newest 512 answers."""
        return (await desk.ask("latencies"))["latencies"]

    @app.get("/metrics", dependencies=viewer, response_class=PlainTextResponse)
    async def prometheus() -> Any:
        """The same as figures for Prometheus."""
        found = (await desk.ask("status"))["status"]
        return PlainTextResponse(metrics(found, gateway.connections), media_type=CONTENT_TYPE)


def _orders(app: FastAPI, desk: DeskLink, operator: list[Any]) -> None:
    done = _example(examples.ORDERED) | {409: {"description": "not possible in this state of the run"}}

    @app.post("/pause", dependencies=operator, responses=done)
    async def pause() -> Any:
        """Let no new frame begin; those that have begun are finished."""
        return _state(await desk.ask("pause"))

    @app.post("/resume", dependencies=operator, responses=done)
    async def resume() -> Any:
        """Let frames begin again."""
        return _state(await desk.ask("resume"))

    @app.post("/step", dependencies=operator, responses=done)
    async def step(
        frames: Annotated[int, Query(ge=1, le=MAX_STEPS, description="how many frames")] = 1,
    ) -> Any:
        """Let so many frames more of a paused run begin."""
        return _state(await desk.ask("step", frames=frames))

    @app.post("/stop", dependencies=operator, responses=done)
    async def stop(
        reason: Annotated[str, Query(min_length=1, max_length=500)] = "stopped over HTTP",
    ) -> Any:
        """End the run in order: every service is told to leave."""
        return _state(await desk.ask("stop", reason=reason))


def _probes(app: FastAPI, desk: DeskLink) -> None:
    @app.get("/healthz", responses=_example({"ok": True}) | _unready("the broker does not answer"))
    async def healthz() -> Any:
        """Whether the broker answers. Needs no token."""
        await desk.ask("why")
        return {"ok": True}

    @app.get("/readyz", responses=_example({"ready": True}) | _unready("services are missing or prepare"))
    async def readyz() -> Any:
        """Whether all services are there and ready. Needs no token."""
        state = (await desk.ask("why"))["why"]["state"]
        return JSONResponse({"ready": state in READY}, 200 if state in READY else 503)


def _may(role: str, tokens: Tokens) -> Callable[[Request], Awaitable[None]]:
    """What checks that a request's token has a role."""

    async def check(request: Request) -> None:
        if not tokens.exist:
            return
        token = token_of(request.headers, tokens)
        if token is None:
            raise HTTPException(401, "this asks for a token", {"WWW-Authenticate": "Bearer"})
        if not token.may(role):
            raise HTTPException(403, f"this asks for a token with the role {role}")

    return check


def _state(answer: dict[str, Any]) -> dict[str, Any]:
    return {key: answer[key] for key in ("state", "paused", "frame")}


async def _refused(_: Request, error: Exception) -> JSONResponse:
    return JSONResponse({"detail": str(error)}, 409)


async def _no_broker(_: Request, error: Exception) -> JSONResponse:
    return JSONResponse({"detail": str(error)}, 503)


def _example(value: Any) -> dict[int | str, dict[str, Any]]:
    return {200: {"content": {"application/json": {"example": value}}}}


def _unready(text: str) -> dict[int | str, dict[str, Any]]:
    return {503: {"description": text}}
