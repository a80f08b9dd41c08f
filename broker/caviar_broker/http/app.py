"""The HTTP interface: requests of the control channel as JSON, figures for Prometheus, and the gateway."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

from fastapi import Depends, FastAPI, HTTPException, Query, Request, WebSocket
from fastapi.responses import JSONResponse, PlainTextResponse
from fastapi.security import HTTPBearer
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from caviar_broker.control.server import MAX_STEPS
from caviar_broker.control.socket import Ask, RequestRefusedError
from caviar_broker.http.auth import Tokens, foreign, token_of
from caviar_broker.http.gateway import Gateway
from caviar_broker.policies import awaited_outcome, offer_policy
from caviar_protocol.errors import RunError
from caviar_protocol.keys import OPERATOR, TRAINER, VIEWER
from caviar_protocol.messages import PROTOCOL_VERSION
from caviar_protocol.policies import MAX_POLICY

# Version of the text format that every Prometheus reads; it makes no use of OpenMetrics.
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
STATES = ("joining", "preparing", "resetting", "running", "stopping", "finished")


def metrics(status: Mapping[str, Any], peers: int) -> str:
    """Write the status of a run in Prometheus's text format.

    Args:
        status: Answer of the control channel to ``status``.
        peers: Number of open WebSockets.

    Returns:
        Families of samples with ``# HELP`` and ``# TYPE``, ending in a line feed.
    """
    # Made of an answer at each request, where prometheus-client would keep counters of its own: these are the
    # broker's, in another process, and the library's collector for them has as many lines.
    return "\n".join(_lines(status, peers)) + "\n"


def _lines(status: Mapping[str, Any], peers: int) -> Iterator[str]:
    services, waits = status["services"], {wait["service"]: wait for wait in status["waits"]}
    yield from _family("caviar_run_info", "gauge", "Run and incarnation of the broker; always 1.")
    yield _sample("caviar_run_info", 1, run=status["run"], epoch=status["epoch"])
    yield from _family("caviar_run_state", "gauge", "1 for the state that the run is in.")
    for state in STATES:
        yield _sample("caviar_run_state", int(state == status["state"]), state=state)
    single = (
        ("caviar_paused", "gauge", "Whether the run is paused.", int(status["paused"])),
        ("caviar_episode", "gauge", "Present episode, from 0.", status["episode"]),
        (
            "caviar_frames_finished_total",
            "counter",
            "Frames finished.",
            status["frames_finished"],
        ),
        ("caviar_frames_per_second", "gauge", "Newest frames a second.", status["frames_per_second"]),
        ("caviar_websocket_connections", "gauge", "Open connections of the gateway.", peers),
    )
    for name, kind, about, value in single:
        yield from _family(name, kind, about)
        yield _sample(name, value)
    yield from _family("caviar_service_present", "gauge", "Whether a service is connected.")
    for service in services:
        present = service["state"] not in ("expected", "lost", "left")
        yield _sample("caviar_service_present", int(present), service=service["name"], role=service["role"])
    yield from _family("caviar_service_waited_seconds", "gauge", "How long the run has waited for it now.")
    for service in services:
        waited = waits[service["name"]]["elapsed_s"] if service["name"] in waits else 0
        yield _sample("caviar_service_waited_seconds", waited, service=service["name"])
    yield from _family("caviar_heartbeat_age_seconds", "gauge", "Since its last heartbeat.")
    for service in services:
        if service["heartbeat_age_s"] is not None:
            yield _sample("caviar_heartbeat_age_seconds", service["heartbeat_age_s"], service=service["name"])
    yield from _family("caviar_budget_seconds", "gauge", "Its budget of a frame.")
    for service in services:
        yield _sample("caviar_budget_seconds", service["budget_ms"] / 1e3, service=service["name"])
    yield from _family("caviar_misses_total", "counter", "Frames in which it overran its budget.")
    for service in services:
        yield _sample("caviar_misses_total", service["misses"], service=service["name"])
    yield from _family("caviar_latency_seconds", "summary", "From grant to answer; quantiles: newest 512.")
    for service in services:
        name = service["name"]
        for quantile, key in (("0.5", "p50_ms"), ("0.99", "p99_ms")):
            if service[key] is not None:
                yield _sample("caviar_latency_seconds", service[key] / 1e3, service=name, quantile=quantile)
        yield _sample("caviar_latency_seconds_sum", service["total_ms"] / 1e3, service=name)
        yield _sample("caviar_latency_seconds_count", service["grants_answered"], service=name)


def _family(name: str, kind: str, about: str) -> Iterator[str]:
    yield f"# HELP {name} {about}"
    yield f"# TYPE {name} {kind}"


def _sample(name: str, value: float, **labels: str | int) -> str:
    listed = ",".join(f'{key}="{_escaped(str(text))}"' for key, text in labels.items())
    return f"{name}{{{listed}}} {value}" if listed else f"{name} {value}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


EXAMPLES: dict[str, Any] = json.loads(Path(__file__).with_name("examples.json").read_text())
"""An answer to each request, which the OpenAPI description shows."""
QUESTIONS = {
    "status": "The run, its services, and what each of them does now.",
    "why": "Which services the run waits for now, and why; the last blame.",
    "latencies": "How each service keeps its budget; quantiles of its newest 512 answers.",
}
"""Requests of the control channel that are read under their own names."""
ORDERS = {
    "pause": "Let no new frame begin; those that have begun are finished.",
    "resume": "Let frames begin again.",
}
"""Requests that change the run, and need no parameters."""
ABOUT = """Look at a running CAVIAR broker, and have it pause, step or stop.

Where there are tokens, `Authorization: Bearer TOKEN` is asked for: a *viewer* may read, a *trainer* may
also give agents other policies, an *operator* may give every order. `/ws` is the WebSocket gateway
(protocol/SPEC.md, section WebSocket)."""
READY = ("resetting", "running", "stopping")
_bearer = HTTPBearer(auto_error=False, description="token of caviar keys token")


class LocalOnly:
    """Refuses what a page from elsewhere has a browser send here, where no token protects from that.

    WebSockets pass: the gateway refuses those itself, in a way that a page can read.

    Args:
        app: The application behind it.
        tokens: Where there are any, they protect instead.
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


def make_app(ask: Ask, directory: Path, tokens: Tokens, gateway: Gateway) -> FastAPI:
    """Build the application.

    Args:
        ask: Asks the broker.
        directory: Of the run, where policies are put.
        tokens: Which requests are allowed; without any, all from this machine.
        gateway: Serves ``/ws``.
    """
    version = ".".join(map(str, PROTOCOL_VERSION))
    app = FastAPI(title="CAVIAR broker", version=version, description=ABOUT, docs_url=None, redoc_url=None)
    app.add_middleware(LocalOnly, tokens=tokens)
    app.add_exception_handler(RequestRefusedError, _refused)
    app.add_exception_handler(RunError, _no_broker)
    viewer = [Depends(_bearer), Depends(may(VIEWER, tokens))]
    operator = [Depends(_bearer), Depends(may(OPERATOR, tokens))]

    # A function that makes each handler: one made in the loop would answer with the loop's last name.
    def answers(name: str) -> Callable[[], Awaitable[Any]]:
        async def answer() -> Any:
            return (await ask(do=name))[name]

        return answer

    for name, about in QUESTIONS.items():
        app.get(f"/{name}", name=name, description=about, dependencies=viewer, responses=_example(name))(
            answers(name)
        )

    @app.get("/metrics", dependencies=viewer, response_class=PlainTextResponse)
    async def prometheus() -> Any:
        """The same as figures for Prometheus."""
        found = (await ask(do="status"))["status"]
        return PlainTextResponse(metrics(found, gateway.connections), media_type=CONTENT_TYPE)

    _orders(app, ask, operator)
    _policies(app, directory, [Depends(_bearer), Depends(may(TRAINER, tokens))])

    @app.get("/healthz", responses=_example("healthz") | _unready("the broker does not answer"))
    async def healthz() -> Any:
        """Return whether the broker answers. Needs no token."""
        # Of `why` and not of `status`, which computes quantiles for every service.
        await ask(do="why")
        return {"ok": True}

    @app.get("/readyz", responses=_example("readyz") | _unready("services are missing or prepare"))
    async def readyz() -> Any:
        """Return whether all services are there and ready. Needs no token."""
        state = (await ask(do="why"))["why"]["state"]
        return JSONResponse({"ready": state in READY}, 200 if state in READY else 503)

    @app.websocket("/ws")
    async def ws(socket: WebSocket) -> None:
        await gateway.serve(socket)

    return app


def _orders(app: FastAPI, ask: Ask, operator: list[Any]) -> None:
    done = _example("ordered") | {409: {"description": "not possible in this state of the run"}}

    def obeys(name: str) -> Callable[[], Awaitable[Any]]:
        async def obey() -> Any:
            return _state(await ask(do=name))

        return obey

    for name, about in ORDERS.items():
        app.post(f"/{name}", name=name, description=about, dependencies=operator, responses=done)(obeys(name))

    @app.post("/step", dependencies=operator, responses=done)
    async def step(
        frames: Annotated[int, Query(ge=1, le=MAX_STEPS, description="how many frames")] = 1,
    ) -> Any:
        """Let so many frames more of a paused run begin."""
        return _state(await ask(do="step", frames=frames))

    @app.post("/stop", dependencies=operator, responses=done)
    async def stop(
        reason: Annotated[str, Query(min_length=1, max_length=500)] = "stopped over HTTP",
    ) -> Any:
        """End the run in order: every service gets SHUTDOWN."""
        return _state(await ask(do="stop", reason=reason))


def _policies(app: FastAPI, directory: Path, trainer: list[Any]) -> None:
    done = _example("swap") | {409: {"description": "the agent, or the broker, refuses it"}}

    @app.post("/policies/{agent}", dependencies=trainer, responses=done)
    async def swap(
        agent: str,
        request: Request,
        wait: Annotated[float, Query(ge=0, le=60, description="[s] for the agent to take it")] = 10.0,
    ) -> Any:
        """Give an agent of the kind `policy` another policy: the body is its ONNX file. Answers once a frame
        was decided by it, or after `wait`; the run goes on meanwhile."""
        content = bytearray()
        async for chunk in request.stream():
            content += chunk
            if len(content) > MAX_POLICY:
                raise HTTPException(413, f"a policy may have {MAX_POLICY} B")
        name, digest = await asyncio.to_thread(offer_policy, directory, agent, bytes(content))
        found = await asyncio.to_thread(awaited_outcome, directory, name, digest, wait)
        if found["state"] == "refused":
            raise HTTPException(409, found["reason"])
        return {"agent": name, "sha256": digest, "state": found["state"], "frame": found["frame"]}


def may(role: str, tokens: Tokens) -> Callable[[Request], Awaitable[None]]:
    """Make a dependency that checks a request's token for a role.

    Args:
        role: The least role.
        tokens: Those that hold; without any, all of this machine may.
    """

    async def check(request: Request) -> None:
        # Without tokens `LocalOnly` has refused what a page of elsewhere sends.
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
    reason = error.reason if isinstance(error, RequestRefusedError) else str(error)
    return JSONResponse({"detail": reason}, 409)


async def _no_broker(_: Request, error: Exception) -> JSONResponse:
    return JSONResponse({"detail": str(error)}, 503)


def _example(name: str) -> dict[int | str, dict[str, Any]]:
    return {200: {"content": {"application/json": {"example": EXAMPLES[name]}}}}


def _unready(text: str) -> dict[int | str, dict[str, Any]]:
    return {503: {"description": text}}
