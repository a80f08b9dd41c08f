"""What `caviar dataset generate` shows while it plays, and what it needs."""

from __future__ import annotations

import io
import logging
from pathlib import Path

import pytest
from rich.console import Console

from caviar_clients.cli import datasets, shared
from caviar_clients.cli.datasets import _Screen
from caviar_clients.cli.main import app
from caviar_clients.datasets.episode import EpisodeResult
from caviar_clients.datasets.estimate import Estimate
from caviar_clients.datasets.local_cluster import set_up_dask
from caviar_protocol.errors import SetupError


def test_after_a_scheduler_was_lost_the_time_left_follows_from_what_came_since(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [1000.0]
    monkeypatch.setattr(datasets.time, "monotonic", lambda: now[0])
    screen = _Screen(Console(file=io.StringIO()))
    screen.estimated(Estimate(10.0, 10), 100, 10, 1)
    shown = screen._bar.tasks[0]

    def play(episodes: int, each_s: float) -> str:
        for number in range(episodes):
            now[0] += each_s
            screen.ended(EpisodeResult(number))
        return str(shown.fields["left"])

    assert play(1, 10.0) == ""
    assert play(1, 10.0) == "0:01:20 left"
    now[0] += 600.0
    screen.returned()
    assert play(1, 0.0) == ""
    assert play(1, 20.0) == "0:01:00 left"
    assert shown.completed == 4


def test_dask_writes_no_tracebacks_of_lost_connections() -> None:
    set_up_dask()
    for name in ("distributed.client", "distributed.utils", "distributed.comm.tcp", "tornado.application"):
        assert not logging.getLogger(name).isEnabledFor(logging.ERROR), name


def test_all_extras_of_a_preset_are_named_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(shared, "has_extra", lambda extra: False)
    with pytest.raises(SetupError, match=r"'caviar-sim\[datasets,channel,sensors,world\]'"):
        app(["generate", "s008", "--out", str(tmp_path / "d")], standalone_mode=False)
    assert not (tmp_path / "d").exists()
