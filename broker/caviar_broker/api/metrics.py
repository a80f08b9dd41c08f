"""The status of a run in Prometheus's text format, version 0.0.4."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
STATES = ("joining", "preparing", "resetting", "running", "stopping", "finished")


def metrics(status: Mapping[str, Any], peers: int) -> str:
    """The text, from a desk's status and the number of open WebSockets."""
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
    told = ",".join(f'{key}="{_escaped(str(text))}"' for key, text in labels.items())
    return f"{name}{{{told}}} {value}" if told else f"{name} {value}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
