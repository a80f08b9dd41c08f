"""What follows from a scenario: owners of devices, overrides, the resolved form, settings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import pytest

from caviar_broker.core.plan import plan_run
from caviar_protocol.arrays import quantity
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import (
    DeviceSpec,
    Limits,
    Run,
    Scenario,
    ServiceSpec,
    load_scenario,
    parse_scenario,
)
from caviar_protocol.scenario.conversion import Source, convert_settings
from caviar_protocol.scenario.rules import (
    check_scenario,
    resolved,
    scenario_error,
    settings_place,
    with_overrides,
    world_of,
)
from caviar_protocol.scenario.schema import owned_by


def devices_of(scenario: Scenario, world: str) -> tuple[DeviceSpec, ...]:
    """The devices that a world publishes."""
    return tuple(
        device for index, device in enumerate(scenario.devices) if world_of(scenario, index) == world
    )


def world(prefix: str = "") -> ServiceSpec:
    settings = {"prefix": prefix} if prefix else {}
    return ServiceSpec(role="world", use="trajectory", budget_ms=1.0, settings=settings)


def antenna(name: str, on: str = "", world: str = "") -> DeviceSpec:
    return DeviceSpec(name=name, kind="antenna", role="rx", on=on, world=world)


def scenario(*devices: DeviceSpec, **worlds: ServiceSpec) -> Scenario:
    return Scenario(run=Run(name="x", frames=3), services=worlds, devices=devices)


def test_the_only_world_publishes_every_device() -> None:
    one = scenario(antenna("bs"), antenna("user", on="car.*"), streets=world())
    assert [device.name for device in devices_of(one, "streets")] == ["bs", "user"]


def test_a_world_without_a_prefix_owns_what_begins_with_its_name_and_a_dot() -> None:
    two = scenario(antenna("user", on="streets.*"), streets=world(), sky=world("uav"))
    assert [device.name for device in devices_of(two, "streets")] == ["user"]
    assert devices_of(two, "sky") == ()


def test_with_two_worlds_a_device_goes_by_prefix_or_by_name() -> None:
    two = scenario(
        antenna("user", on="car.*"),
        antenna("eye", on="uav"),
        antenna("bs", world="sky"),
        streets=world("car."),
        sky=world("uav"),
    )
    assert [device.name for device in devices_of(two, "streets")] == ["user"]
    assert [device.name for device in devices_of(two, "sky")] == ["eye", "bs"]


@pytest.mark.parametrize("device", [antenna("bs"), antenna("user", on="truck.*"), antenna("user", on="*")])
def test_a_device_of_no_certain_world_is_refused(device: DeviceSpec) -> None:
    with pytest.raises(ScenarioError, match='write world = "streets"'):
        check_scenario(scenario(device, streets=world("car."), sky=world("uav")))


def test_overrides_replace_and_are_checked() -> None:
    base = scenario(streets=world())
    assert with_overrides(base) is base
    changed = with_overrides(base, frames=9, seed=0)
    assert (changed.run.frames, changed.run.seed, changed.run.name) == (9, 0, "x")
    assert base.run.frames == 3
    with pytest.raises(ScenarioError, match=r"run\.frames: is 0.*≥ 1"):
        with_overrides(base, frames=0)
    with pytest.raises(ScenarioError, match=r"run\.seed: is -1"):
        with_overrides(base, seed=-1)


@pytest.mark.parametrize(
    ("text", "pace"), [("free", "free"), ("realtime", "realtime"), ("2", 2.0), ("0.5", 0.5), ("1e3", 1000.0)]
)
def test_a_pace_on_the_command_line_is_a_word_or_a_factor(text: str, pace: str | float) -> None:
    assert with_overrides(scenario(streets=world()), pace=text).run.pace == pace


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "1e9", "quick", ""])
def test_a_pace_that_is_none_is_refused_on_the_command_line(text: str) -> None:
    with pytest.raises(ScenarioError, match=r'run\.pace.*"fast".*"free"'):
        with_overrides(scenario(streets=world()), pace=text)


@pytest.mark.parametrize("value", ["0", "-1.0", "0.0", "nan", "inf", "-inf", '"quick"', '"2"', "true", "[1]"])
def test_a_pace_that_is_none_is_refused_with_its_line(value: str) -> None:
    text = f"""
[run]
name = "x"
frames = 3
pace = {value}
[services.w]
role = "world"
use = "trajectory"
budget_ms = 1
"""
    with pytest.raises(ScenarioError, match=r':5.*run\.pace.*"fast".*"free"'):
        parse_scenario(text, "paced.toml")


@pytest.mark.parametrize(
    ("value", "realtime", "speed"),
    [('"free"', False, 1.0), ('"realtime"', True, 1.0), ("2", True, 2.0), ("0.25", True, 0.25)],
)
def test_the_pace_of_the_file_is_that_of_the_run(value: str, realtime: bool, speed: float) -> None:
    text = (
        f'[run]\nname = "x"\nframes = 3\npace = {value}\n'
        '[services.w]\nrole = "world"\nuse = "trajectory"\nbudget_ms = 1\n'
    )
    plan = plan_run(parse_scenario(text, "paced.toml"), "run", {})
    assert (plan.realtime, plan.speed) == (realtime, speed)


TEXT = """\
[run]
name = "x"
frames = 3
[[carriers]]
name = "c"
frequency_hz = 1e9
[services.streets]
role = "world"
use = "sumo"
budget_ms = 5
[services.streets.settings]
lanes = 2
grid = [1, 2]
table.samples = 3
"""


def test_the_resolved_form_shows_defaults_and_reads_back() -> None:
    loaded = parse_scenario(TEXT, "x.toml")
    plain = resolved(loaded)
    assert plain["carriers"] == [
        {
            "name": "c",
            "frequency_hz": 1e9,
            "bandwidth_hz": 100e6,
            "subcarriers": 0,
            "subcarrier_spacing_hz": 0.0,
            "taps": 0,
            "slots": 1,
            "slot_duration_s": 0.0,
        }
    ]
    assert plain["timeouts"]["stall_s"] == 30.0
    assert plain["services"]["streets"]["settings"] == {"lanes": 2, "grid": [1, 2], "table": {"samples": 3}}
    assert "source" not in plain
    assert msgspec.json.decode(msgspec.json.encode(plain)) == plain
    assert msgspec.convert(plain, Scenario) == msgspec.structs.replace(loaded, source=Source())


@pytest.mark.parametrize(
    ("limits", "told"),
    [
        ("conections = 9", r"x\.toml:\d+: limits\.conections: .*connections"),
        ("connections = 1", r"x\.toml:16: limits\.connections: is 1, .* write at least 2"),
        ("messages_per_s = 3", r"limits\.messages_per_s: is 3, and a heartbeat each 0\.25 s .* at least 8"),
        (
            "waiting_mib = 64",
            r"limits\.waiting_mib: is 64, .* 1024 .* least 1025, or part_mib = 63",
        ),
        ("part_mib = 1025", r"limits\.part_mib"),
        ("part_mib = 3", r"limits\.part_mib"),  # assets travel in parts of 4 MiB
        ("messages_at_once = 99", r"limits\.messages_at_once"),  # grants in flight are answered at once
        ("connections_before_hello = 1", r"limits\.connections_before_hello: is 1, .* at least \d+"),
    ],
)
def test_limits_that_no_service_could_keep_are_refused_with_the_remedy(limits: str, told: str) -> None:
    with pytest.raises(ScenarioError, match=told):
        parse_scenario(f"{TEXT}[limits]\n{limits}\n", "x.toml")


def test_limits_are_read_and_the_others_keep_their_defaults() -> None:
    found = parse_scenario(
        f"{TEXT}[limits]\npart_mib = 8\nwaiting_mib = 9\nmessages_per_s = 4\n", "x.toml"
    ).limits
    assert found == Limits(part_mib=8, waiting_mib=9, messages_per_s=4.0)


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        (
            "subcarrier_spacing_hz = 1.0",
            "subcarrier_spacing_hz: is 1 Hz, .* more than 65536; write at least 1525.88",
        ),
        ("subcarrier_spacing_hz = 1e-300", "subcarrier_spacing_hz: is 1e-300 Hz"),
        ("subcarrier_spacing_hz = 1e-310", "subcarrier_spacing_hz: is 1e-310 Hz"),
        ("subcarrier_spacing_hz = 2e8", "subcarrier_spacing_hz: is 2e[+]08 Hz, wider than bandwidth_hz"),
        ("bandwidth_hz = 1e300", r"bandwidth_hz: is 1e\+300 Hz, write 1 to 1e\+12"),
        ("bandwidth_hz = 1e-300", r"bandwidth_hz: is 1e-300 Hz, write 1 to 1e\+12"),
    ],
)
def test_a_numerology_that_cannot_be_is_refused_by_key_and_line(keys: str, told: str) -> None:
    text = TEXT.replace("frequency_hz = 1e9", f"frequency_hz = 1e9\n{keys}")
    with pytest.raises(ScenarioError, match=rf"x\.toml:\d+: carriers\[0\]\.{told}"):
        parse_scenario(text, "x.toml")


def test_the_finest_numerology_is_as_many_subcarriers_as_there_may_be() -> None:
    spacing = 100e6 / 65536
    text = TEXT.replace("frequency_hz = 1e9", f"frequency_hz = 1e9\nsubcarrier_spacing_hz = {spacing!r}")
    assert parse_scenario(text, "x.toml").carriers[0].subcarriers == 65536


class Inner(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    samples: Annotated[int, quantity("1", "rays", ge=1)] = 10


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    lanes: Annotated[int, quantity("1", "lanes", ge=1)] = 1
    grid: tuple[float, float] = (0.0, 0.0)
    table: Inner | None = None
    even: int = 0

    def __post_init__(self) -> None:
        if self.even % 2:
            raise ValueError(f"even = {self.even} is odd, write an even number")


def test_settings_convert_with_and_without_a_place() -> None:
    loaded = parse_scenario(TEXT, "x.toml")
    given = loaded.services["streets"].settings
    expected = Settings(lanes=2, grid=(1.0, 2.0), table=Inner(samples=3))
    assert convert_settings(Settings, given, settings_place(loaded, "streets")) == expected
    assert convert_settings(Settings, given) == expected
    shown = resolved(loaded, {"streets": expected})["services"]["streets"]["settings"]
    assert shown == {"lanes": 2, "grid": [1.0, 2.0], "table": {"samples": 3}, "even": 0}


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "lanes = 2",
            "lane = 2",
            "x.toml:12: services.streets.settings.lane: unknown key 'lane'; did you mean",
        ),
        (
            "lanes = 2",
            "lanes = 0",
            "x.toml:12: services.streets.settings.lanes: is 0, write a whole number ≥ 1",
        ),
        ("[1, 2]", '[1, "b"]', "x.toml:13: services.streets.settings.grid[1]: is 'b', write a number"),
        ("samples = 3", "samples = 0.5", "x.toml:14: services.streets.settings.table.samples: is 0.5"),
        (
            "lanes = 2",
            "even = 3",
            "x.toml:11: services.streets.settings: even = 3 is odd, write an even number",
        ),
    ],
)
def test_wrong_settings_are_named_with_their_line(old: str, new: str, says: str) -> None:
    loaded = parse_scenario(TEXT.replace(old, new), "x.toml")
    given = loaded.services["streets"].settings
    with pytest.raises(ScenarioError) as caught:
        convert_settings(Settings, given, settings_place(loaded, "streets"))
    assert str(caught.value).startswith(says)
    with pytest.raises(ScenarioError, match=r"^settings") as without_place:
        convert_settings(Settings, given)
    assert without_place.value.line is None


def test_a_later_check_can_name_the_line() -> None:
    loaded = parse_scenario(TEXT, "x.toml")
    error = scenario_error(loaded, "services.streets.use", "no world is named 'sumo'")
    assert str(error) == "x.toml:9: services.streets.use: no world is named 'sumo'"
    absent = scenario_error(loaded, "services.streets.policy[3].x", "…")
    assert absent.line == 7
    assert scenario_error(scenario(), "run.frames", "…").line is None


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("power_dbm = 30.0", "power_dbm = 400.0", "devices[0].power_dbm: is 400.0, write a number ≥ -200"),
        (
            "array = { rows = 4, columns = 8 }",
            'array = { pattern = "tr38901", pattern_file = "file:a.csv" }',
            "devices[0].array.pattern: and pattern_file both say how elements radiate; remove one",
        ),
    ],
)
def test_what_an_antenna_cannot_be_is_refused_where_it_is_read(
    tmp_path: Path, old: str, new: str, says: str
) -> None:
    text = SMOKE.read_text()
    assert old in text
    (tmp_path / "a.csv").write_text("")
    (tmp_path / "a.toml").write_text(text.replace(old, new, 1))
    with pytest.raises(ScenarioError) as refused:
        load_scenario(tmp_path / "a.toml")
    assert says in str(refused.value)


def test_users_are_matched_by_pattern() -> None:
    assert owned_by(["truck", "car.*"], "car.7/antenna")
    assert not owned_by(["car.?"], "car.17")
    assert not owned_by([], "car.1")


SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"


def smoke_with(users: str, *changes: tuple[str, str]) -> str:
    """The smoke scenario, whose receivers are car/rx and uav/rx-uav, with these users of its agent."""
    text = SMOKE.read_text()
    for old, new in (('use = "los-beam"', f'use = "los-beam"\nusers = {users}'), *changes):
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.mark.parametrize("wrong", ["cra/rx", "car", "beam:uav/rx", "uav/rx?", "UAV/*"])
def test_users_that_no_receiver_can_be_are_named_with_their_line(wrong: str) -> None:
    text = smoke_with(f'["car/*", "{wrong}"]')
    with pytest.raises(ScenarioError) as error:
        parse_scenario(text, "smoke.toml")
    line = 1 + text[: text.index("users = ")].count("\n")
    assert str(error.value) == (
        f"smoke.toml:{line}: services.agent.users[1]: no receiver is named {wrong.removeprefix('beam:')!r}; "
        "there are: car/rx, uav/rx-uav"
    )


@pytest.mark.parametrize(
    ("users", "changes"),
    [
        ('["car/rx", "beam:uav/*"]', ()),
        ('["*", "motion:uav", "schedule:bs"]', ()),
        ('["car-1?/rx"]', (('on = "car"', 'on = "car*"'),)),
        ('["elsewhere/rx"]', (('use = "trajectory"', 'use = "remote"'),)),
    ],
)
def test_users_that_may_come_are_waited_for(users: str, changes: tuple[tuple[str, str], ...]) -> None:
    """Also those of a remote world, which may publish devices of its own."""
    assert parse_scenario(smoke_with(users, *changes)).services["agent"].users


def test_an_agent_without_any_receiver_is_told_so() -> None:
    antenna = '[[devices]]\nname = "only"\nkind = "antenna"\nrole = "tx"\n'
    text = smoke_with('["car/rx"]', ('use = "free-space"\nbudget_ms = 20', 'use = "lidar"\nbudget_ms = 20'))
    text = text[: text.index("[[devices]]")].replace('role = "channel"', 'role = "sensors"') + antenna
    with pytest.raises(ScenarioError, match=r"'car/rx'.*role = .rx."):
        parse_scenario(text)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("sampling_period_ns = 100_000_000", "sampling_period_ns = 9223372036854775807", "longer than"),
        ("[run]\n", "[timeouts]\nrejoin_s = 1e300\n\n[run]\n", "timeouts.rejoin_s"),
        ("[run]\n", "[timeouts]\nheartbeat_s = 1e9\n\n[run]\n", "timeouts.heartbeat_s"),
        ("budget_ms = 20", "budget_ms = 1e15", "budget_ms"),
    ],
)
def test_times_that_no_64_bit_number_of_nanoseconds_holds_are_refused(old: str, new: str, said: str) -> None:
    text = SMOKE.read_text()
    assert old in text
    with pytest.raises(ScenarioError, match=said) as refused:
        parse_scenario(text.replace(old, new, 1), "town.toml", SMOKE.parent)
    assert "town.toml:" in str(refused.value)
