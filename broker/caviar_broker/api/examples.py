"""Answers of the HTTP interface, as its OpenAPI description shows them."""

from __future__ import annotations

from typing import Any

_WAIT: dict[str, Any] = {
    "service": "channel",
    "role": "channel",
    "frame": 41,
    "phase": "tracing",
    "progress": 3107,
    "heartbeat_age_s": 0.121,
    "elapsed_s": 0.734,
    "limit_s": 0.5,
    "late": True,
    "missing": "link waits for channel of frame 41",
    "text": "channel 'channel' is late in frame 41: 734 ms since its grant, budget 500 ms; last heartbeat "
    "121 ms ago: phase 'tracing', progress 3107; link waits for channel of frame 41",
}
_BLAME: dict[str, Any] = {
    "kind": "miss",
    "service": "channel",
    "text": "channel 'channel' overran its budget in frame 41: 500 ms since its grant, budget 500 ms; "
    "last heartbeat 86.4 ms ago: phase 'tracing', progress 3101; the frame waits",
    "episode": 0,
    "frame": 41,
    "at": 1767225600.25,
}
_FIGURES: dict[str, Any] = {
    "p50_ms": 212.4,
    "p99_ms": 480.2,
    "total_ms": 9012.7,
    "grants_answered": 41,
    "misses": 1,
    "budget_ms": 500.0,
}

WHY: dict[str, Any] = {
    "run": "street-canyon-20260101-120000",
    "state": "running",
    "paused": False,
    "episode": 0,
    "frame": 42,
    "late": True,
    "waits": [_WAIT],
    "last_blame": _BLAME,
    "error": "",
}
LATENCIES: dict[str, Any] = {"channel": _FIGURES}
ORDERED: dict[str, Any] = {"state": "running", "paused": True, "frame": 42}
STATUS: dict[str, Any] = {
    "run": "street-canyon-20260101-120000",
    "epoch": 1,
    "state": "running",
    "since_s": 12.81,
    "paused": False,
    "steps": 0,
    "episode": 0,
    "episodes": 1,
    "frame": 42,
    "frames": 120,
    "pace": "free",
    "services": [
        {
            "name": "channel",
            "role": "channel",
            "use": "sionna-rt",
            "policy": "wait",
            "state": "active",
            "since_s": 12.81,
            "attempt": 1,
            "phase": "tracing",
            "progress": 3107,
            "heartbeat_age_s": 0.121,
            "grants": [{"frame": 41, "state": "granted", "elapsed_s": 0.734, "budget_s": 0.5}],
            **_FIGURES,
        }
    ],
    "waits": [_WAIT],
    "error": "",
    "culprit": "",
    "frames_finished": 40,
    "misses": 1,
    "frames_per_second": 3.2,
    "endpoint": "tcp://127.0.0.1:5570",
    "http": "http://127.0.0.1:8080",
    "last_blame": _BLAME,
}
