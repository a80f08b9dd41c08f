"""A whole run with an adaptive channel, repeated from the decisions that it recorded."""

from __future__ import annotations

from pathlib import Path

import pytest
from adaptive_rungs import LADDER, Time
from msgspec.structs import replace

from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.recording import Recording
from caviar_protocol.recording.reader import Imposed, recorded_decisions
from caviar_protocol.scenario import load_scenario
from caviar_services.channel.adaptive.channel import AdaptiveChannel

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"


def digest(directory: Path, load: float, imposed: Imposed | None = None) -> str:
    """Of the smoke run with an adaptive channel, on a machine that is so busy from its first frame on."""
    smoke = load_scenario(SMOKE)
    settings = {"ladder": LADDER, "calibrate_every": 3, "patience": 4}
    channel = replace(smoke.services["channel"], use="adaptive", budget_ms=200.0, settings=settings)
    scenario = replace(
        smoke, run=replace(smoke.run, frames=30), services={**smoke.services, "channel": channel}
    )
    directory.mkdir()
    Time.load = 1.0

    def grow_busy(_: object) -> None:
        Time.load = load

    outcome = EmbeddedRun(scenario, directory, on_frame=grow_busy, imposed=imposed).run()
    assert not outcome.error
    return outcome.digest


def test_decisions_imposed_repeat_a_run_and_without_them_it_is_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(AdaptiveChannel, "clock", staticmethod(Time.read))
    busy = digest(tmp_path / "busy", 4.0)
    decisions = recorded_decisions(Recording(tmp_path / "busy"))
    assert decisions["channel", 0, 0] == {"rung": "high"}
    assert decisions["channel", 0, 29] == {"rung": "middle"}
    assert digest(tmp_path / "idle", 1.0) != busy
    assert digest(tmp_path / "imposed", 1.0, decisions) == busy
    assert recorded_decisions(Recording(tmp_path / "imposed")) == decisions
