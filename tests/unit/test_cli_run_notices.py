"""What the console of `caviar run` shows of the broker's notices."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console
from rich.progress import Progress

from caviar_clients.cli.run import _Watcher
from caviar_protocol.scenario import load_scenario

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"


def shown(*notices: tuple[str, str, str]) -> str:
    """The console's text after notices of (kind, service, text)."""
    console = Console(file=io.StringIO(), width=200)
    watcher = _Watcher(Progress(console=console), console, load_scenario(SMOKE), None)
    for kind, service, text in notices:
        watcher.show({"event": "notice", "kind": kind, "service": service, "frame": -1, "text": text})
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def test_every_refused_peer_is_shown_with_the_reason() -> None:
    first = "a connection from 10.0.0.7 was refused: the key X is not authorized"
    second = "a WebSocket from 10.0.0.8 was refused: there is no token in the request"
    text = shown(("refused", "", first), ("refused", "", second))
    assert f"refused: {first}\n" in text
    assert f"refused: {second}\n" in text


@pytest.mark.parametrize("kind", ["note", "stale"])
def test_what_is_of_no_use_to_a_user_is_only_logged(kind: str) -> None:
    assert shown((kind, "world", "something")) == ""


def test_every_warning_of_a_service_is_shown_and_kept_for_the_summary() -> None:
    console = Console(file=io.StringIO(), width=200)
    watcher = _Watcher(Progress(console=console), console, load_scenario(SMOKE), None)
    for text in ("scattering is switched off: why", "a file is damaged"):
        watcher.show({"event": "notice", "kind": "warning", "service": "channel", "frame": -1, "text": text})
    assert watcher.warnings == ["channel: scattering is switched off: why", "channel: a file is damaged"]
    for text in watcher.warnings:
        assert f"warning: {text}\n" in console.file.getvalue()  # type: ignore[attr-defined]
