"""Which services of a recorded run are served from it, and which run again."""

from __future__ import annotations

import shutil
from pathlib import Path

import msgspec
import pytest
from recording_builders import record_run

from caviar_clients.replay.plan import ReplayPlan, plan_replay, request_of, scenario_text
from caviar_clients.replay.recorded import RecordedRun
from caviar_protocol.errors import CaviarError, RecordingError, RunError
from caviar_protocol.recording import Recording, RecordingWarning
from caviar_protocol.scenario import Scenario, load_scenario, parse_scenario

pytestmark = pytest.mark.slow

SCENARIOS = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"
FRAMES = 6


def shipped(name: str = "smoke", **changes: object) -> Scenario:
    scenario = load_scenario(SCENARIOS / f"{name}.toml")
    return msgspec.structs.replace(
        scenario, run=msgspec.structs.replace(scenario.run, **{"frames": FRAMES, **changes})
    )


def recorded(scenario: Scenario, directory: Path) -> RecordedRun:
    return RecordedRun(Recording(record_run(directory, scenario)))


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    """Six frames of the smallest scenario."""
    return recorded(shipped(), tmp_path_factory.mktemp("runs") / "smoke")


def planned(run: RecordedRun, frames: int | None = None, **options: object) -> ReplayPlan:
    return plan_replay(run, request_of(run.scenario.services, **options), frames)  # type: ignore[arg-type]


def parts(plan: ReplayPlan) -> dict[str, str]:
    return {role.name: role.part for role in plan.roles}


@pytest.mark.parametrize("name", sorted(path.stem for path in SCENARIOS.glob("*.toml")))
def test_a_scenario_written_as_toml_reads_back_as_the_same(name: str) -> None:
    scenario = load_scenario(SCENARIOS / f"{name}.toml")
    again = parse_scenario(scenario_text(scenario))
    assert msgspec.structs.replace(again, source=scenario.source) == scenario


def test_texts_that_toml_would_take_for_something_else_read_back() -> None:
    scenario = shipped()
    odd = 'a"b\\c\n\x7f\x00 = # ü 𝔸'
    world = scenario.services["world"]
    settings = {odd: [odd, 1e-7, 10**15, True, {"x.y": {}}, 1.0]}
    services = {**scenario.services, "w.1 ü": msgspec.structs.replace(world, settings=settings)}
    changed = msgspec.structs.replace(scenario, services=services)
    again = parse_scenario(scenario_text(msgspec.structs.replace(changed, devices=())))
    assert again.services == changed.services


def test_without_options_everything_is_served_as_recorded(smoke: RecordedRun) -> None:
    plan = planned(smoke)
    assert parts(plan) == {
        "world": "recorded",
        "channel": "recorded",
        "link": "recorded",
        "agent": "recorded",
        "recorder": "again",
    }
    assert plan.identical
    assert plan.frames == FRAMES
    spec = plan.scenario.replay
    assert spec is not None
    assert spec.digest == smoke.recording.run_digest().digest
    assert "channel.h" in plan.scenario.run.record, "the link asked for it in the recorded run"


def test_what_follows_from_a_replaced_agent_runs_again(smoke: RecordedRun) -> None:
    plan = planned(smoke, replace=["agent=oracle"])
    assert parts(plan) == {
        "world": "recorded",
        "channel": "recorded",
        "link": "again",
        "agent": "replaced",
        "recorder": "again",
    }
    assert not plan.identical
    assert plan.scenario.services["agent"].use == "oracle"
    assert plan.scenario.replay is not None
    assert plan.scenario.replay.imposed == ("link",)


def test_a_channel_with_other_settings_keeps_the_rest_of_them(tmp_path: Path) -> None:
    run = recorded(shipped("geometric"), tmp_path / "run")
    plan = planned(run, settings=["channel.components=5", "channel.normalization=unit"])
    before = run.scenario.services["channel"].settings
    assert plan.scenario.services["channel"].settings == {**before, "components": 5}
    assert parts(plan)["channel"] == "replaced"
    assert parts(plan)["agent"] == "again", "it hears of the links of the frame before"
    assert parts(plan)["world"] == "recorded"
    assert parts(planned(run, settings=["channel.components=5"], recorded=["agent"]))["agent"] == "recorded"


def test_an_implementation_that_replaces_another_has_its_own_settings(tmp_path: Path) -> None:
    run = recorded(shipped("geometric"), tmp_path / "run")
    plan = planned(run, replace=["channel=free-space"])
    assert plan.scenario.services["channel"].settings == {}


def test_a_world_that_follows_actions_runs_again_unless_told_not_to(tmp_path: Path) -> None:
    """The user reads that a recorded one does not follow the new agent."""
    scenario = load_scenario(SCENARIOS / "uav-path.toml")
    world = scenario.services["world"]
    settings = {key: value for key, value in world.settings.items() if key != "scenery"}
    services = {
        **scenario.services,
        "world": msgspec.structs.replace(world, settings=settings),
        "channel": msgspec.structs.replace(scenario.services["channel"], use="free-space", settings={}),
    }
    scenario = msgspec.structs.replace(
        scenario, services=services, run=msgspec.structs.replace(scenario.run, frames=4)
    )
    run = recorded(scenario, tmp_path / "run")
    loop = planned(run, settings=["agent.speed_m_s=2.0"])
    assert parts(loop)["world"] == "again"
    assert parts(loop)["channel"] == "again"
    open_loop = planned(run, settings=["agent.speed_m_s=2.0"], recorded=["world", "channel"])
    assert parts(open_loop)["world"] == "recorded"
    assert any("open loop" in note for note in open_loop.notes)
    assert not any("open loop" in note for note in loop.notes)


def test_everything_runs_again_with_its_decisions(smoke: RecordedRun) -> None:
    plan = planned(smoke, again=True)
    assert set(parts(plan).values()) == {"again"}
    assert plan.identical
    assert plan.scenario.replay is not None
    assert set(plan.scenario.replay.imposed) == {"world", "channel", "link", "agent"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"replace": ["agnt=oracle"]}, "did you mean 'agent'"),
        ({"replace": ["agent"]}, "--replace channel=sionna-rt"),
        ({"settings": ["channel=3"]}, "--set channel.rung=spherical"),
        ({"settings": ["sensors.x=3"]}, "no service 'sensors'"),
        ({"keep": ["chanel"]}, "did you mean 'channel'"),
        ({"recorded": ["agent"], "replace": ["agent=oracle"]}, "'agent' is to be served as recorded"),
        ({"again": True, "replace": ["agent=oracle"]}, "--again"),
        ({"replace": ["agent=orakel"]}, "did you mean 'oracle'"),
        ({"frames": FRAMES + 1}, f"at most {FRAMES}"),
    ],
)
def test_what_cannot_be_done_is_told_with_a_remedy(
    smoke: RecordedRun, options: dict[str, object], message: str
) -> None:
    with pytest.raises(CaviarError, match=message):
        planned(smoke, **options)  # type: ignore[arg-type]


def test_a_topic_that_was_not_recorded_is_told_with_who_made_it(tmp_path: Path) -> None:
    """No service asked for the channel, so it was not run; the oracle needs it."""
    scenario = shipped(record=("scene", "action"))
    services = {name: spec for name, spec in scenario.services.items() if name != "link"}
    run = recorded(msgspec.structs.replace(scenario, services=services), tmp_path / "run")
    assert parts(planned(run))["channel"] == "left out"
    with pytest.raises(RunError, match=r"'agent'.*--keep channel.*record = \["):
        planned(run, replace=["agent=oracle"])
    assert parts(planned(run, replace=["agent=oracle"], keep=["channel"]))["channel"] == "again"


def test_a_part_that_was_not_recorded_is_told(tmp_path: Path) -> None:
    scenario = shipped(record=("scene", "action", "channel"))
    services = {name: spec for name, spec in scenario.services.items() if name != "link"}
    run = recorded(msgspec.structs.replace(scenario, services=services), tmp_path / "run")
    with pytest.raises(RunError, match=r"'agent'.*channel\.h.*--keep channel"):
        planned(run, replace=["agent=oracle"])


def test_the_scenario_of_another_version_is_told(smoke: RecordedRun) -> None:
    recording = Recording(smoke.recording.path)
    scenario = {**recording.metadata.scenario, "weather": {"rain_mm_h": 3}}
    recording.metadata = msgspec.structs.replace(recording.metadata, scenario=scenario)
    with pytest.raises(RecordingError, match=r"weather.*version"):
        RecordedRun(recording)


def test_a_recording_without_frames_is_told(smoke: RecordedRun, tmp_path: Path) -> None:
    """Killed before the first frame was written."""
    name = smoke.recording.files[0].name
    whole = (smoke.recording.directory / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: whole.index(b"caviar.frame")])
    with pytest.raises(RecordingError):
        RecordedRun(Recording(tmp_path))


def test_a_recording_that_breaks_off_is_repeated_as_far_as_it_goes(
    smoke: RecordedRun, tmp_path: Path
) -> None:
    copy = tmp_path / "run"
    shutil.copytree(smoke.recording.directory, copy)
    file = next(copy.glob("*.mcap"))
    data = file.read_bytes()
    file.write_bytes(data[: len(data) * 2 // 3])
    with pytest.warns(RecordingWarning, match="lost are all frames after frame"):
        run = RecordedRun(Recording(copy))
    plan = planned(run)
    assert 0 < plan.frames < FRAMES
    assert any("breaks off" in note for note in plan.notes)
