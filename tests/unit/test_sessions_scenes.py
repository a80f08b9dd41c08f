"""Which scenes a recording gives, and which services of a scenario are run for them."""

from __future__ import annotations

from pathlib import Path

import pytest
from recording_builders import frame, link, product, record, scene

from caviar_clients.session.prepared import implemented
from caviar_clients.session.scenes import KEEPER, worlds_only
from caviar_labs.tradeoff.scenes import scenes_of
from caviar_protocol.errors import RecordingError
from caviar_protocol.scenario import load_scenario

SCENARIOS = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"


def test_a_recording_without_scenes_says_what_to_record(tmp_path: Path) -> None:
    record(tmp_path, [frame(0, product("link", "s", link(0), 0))])
    with pytest.raises(RecordingError, match='record = \\["scene"'):
        scenes_of(tmp_path, 2)


def test_a_recording_whose_scenario_cannot_be_read_is_refused(tmp_path: Path) -> None:
    record(tmp_path, [frame(0, product("scene", "s", scene(0), 0))])
    with pytest.raises(RecordingError, match="scenario in its metadata"):
        scenes_of(tmp_path, 2)


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("smoke", {"world", "agent"}),
        ("street-canyon", {"traffic", "agent"}),
    ],
)
def test_worlds_and_agents_that_need_no_channel_are_run(name: str, kept: set[str]) -> None:
    reduced = worlds_only(implemented(load_scenario(SCENARIOS / f"{name}.toml"))).scenario
    assert set(reduced.services) == kept | {KEEPER}
    assert reduced.run.episodes == 1
    assert reduced.run.record == ()
