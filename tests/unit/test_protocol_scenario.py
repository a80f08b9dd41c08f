"""What a scenario file may say, and what is answered to what it may not."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import (
    Scenario,
    find_scenario,
    load_scenario,
    parse_scenario,
    read_toml,
    set_keys,
)
from caviar_protocol.scenario.conversion import located
from caviar_protocol.scenario.rules import with_overrides

GOOD = """\
[run]
name = "crossing"
frames = 20
seed = 7
record = ["scene"]

[timeouts]
stall_s = 5

[[carriers]]
name = "mmwave"
frequency_hz = 28e9

[[devices]]
name = "bs"
kind = "antenna"
role = "both"
position_m = [0, 0.5, 10]
array = { rows = 8, columns = 4 }

[[devices]]
name = "scanner"
kind = "lidar"
on = "car.*"
count = 2
mount = "roof"
beams = 16

[services.traffic]
role = "world"
use = "sumo"
budget_ms = 20
settings = { prefix = "car.", nested = [{ net = "file:roads.net.xml" }] }

[services.channel]
role = "channel"
use = "sionna-rt"
budget_ms = 150
policy = "hold"
[services.channel.settings]
samples = 1e5

[services.pilot]
role = "agent"
use = "los-beam"
budget_ms = 5
users = ["bs"]

[services.recorder]
role = "recorder"
use = "mcap"
budget_ms = 50
"""


def parse(text: str, folder: Path | None = None) -> Scenario:
    return parse_scenario(text, "crossing.toml", folder)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "roads.net.xml").write_text("<net/>")
    return tmp_path


def failure(text: str, folder: Path) -> ScenarioError:
    with pytest.raises(ScenarioError) as caught:
        parse(text, folder)
    return caught.value


def line_of(text: str, fragment: str) -> int:
    return text[: text.index(fragment)].count("\n") + 1


def test_a_part_of_a_topic_can_be_recorded(folder: Path) -> None:
    text = GOOD.replace('record = ["scene"]', 'record = ["scene", "channel.h"]')
    assert parse(text, folder).run.record == ("scene", "channel.h")


def test_a_good_file_becomes_typed_values_with_defaults(folder: Path) -> None:
    scenario = parse(GOOD, folder)
    assert (scenario.run.frames, scenario.run.seed, scenario.run.episodes) == (20, 7, 1)
    assert scenario.timeouts.stall_s == 5.0
    bs, scanner = scenario.devices
    assert bs.array is not None
    assert bs.array.size == 32
    assert bs.position_m == (0.0, 0.5, 10.0)
    assert (scanner.beams, scanner.mount, scanner.count) == (16, "roof", 2)
    assert scenario.services["channel"].policy == "hold"
    assert scenario.services["channel"].settings == {"samples": 1e5}


def test_file_strings_in_settings_become_absolute_paths(folder: Path) -> None:
    (folder / "crossing.toml").write_text(GOOD)
    scenario = load_scenario(folder / "crossing.toml")
    (nested,) = scenario.services["traffic"].settings["nested"]
    assert nested == {"net": str((folder / "roads.net.xml").resolve())}


def test_a_missing_file_is_named_with_key_and_line(folder: Path) -> None:
    text = GOOD.replace("roads.net.xml", "lanes.net.xml")
    error = failure(text, folder)
    assert error.key == "services.traffic.settings.nested[0].net"
    assert error.line == line_of(text, "settings = {")
    assert str(folder.resolve() / "lanes.net.xml") in str(error)


# (what stands in the good file, what is written instead, key, a piece of the message)
UNKNOWN_KEYS = [
    ("seed = 7", "sede = 7", "run.sede", "did you mean 'seed'?"),
    ("seed = 7", "wibble = 7", "run.wibble", "known: "),
    ("[timeouts]", "[timeout]", "timeout", "did you mean 'timeouts'?"),
    ("stall_s", "stal_s", "timeouts.stal_s", "did you mean 'stall_s'?"),
    ("frequency_hz", "frequency", "carriers[0].frequency", "did you mean 'frequency_hz'?"),
    ("columns = 4", "colums = 4", "devices[0].array.colums", "did you mean 'columns'?"),
    ("beams = 16", "beems = 16", "devices[1].beems", "did you mean 'beams'?"),
    ("budget_ms = 150", "budget = 150", "services.channel.budget", "did you mean 'budget_ms'?"),
    (
        "budget_ms = 5\n",
        "budget_ms = 5\nbeams_tx = 3\n",
        "services.pilot.beams_tx",
        "in its table `settings`",
    ),
    ("[timeouts]", "[source]\nfile = 'x'\n[timeouts]", "source", "unknown key 'source'"),
]

WRONG_VALUES = [
    ("frames = 20", "frames = 0", "run.frames", "is 0, write a whole number ≥ 1 [frame]"),
    ("frames = 20", "frames = 1.5", "run.frames", "is 1.5, write a whole number ≥ 1"),
    ("frames = 20", "frames = true", "run.frames", "is true, write a whole number"),
    ("frames = 20", 'frames = "20"', "run.frames", "is '20', write a whole number"),
    (
        "seed = 7",
        "seed = 9223372036854775808",
        "run.seed",
        "write a whole number ≥ 0 and ≤ 9223372036854775807",
    ),
    ('name = "crossing"', 'name = "a b"', "run.name", "a string that matches"),
    ("stall_s = 5", "stall_s = inf", "timeouts.stall_s", "is inf, write a number > 0 and ≤ 100000000.0 [s]"),
    ("stall_s = 5", "stall_s = 2024-01-01", "timeouts.stall_s", "write a number > 0 and ≤ 100000000.0 [s]"),
    ("28e9", "-28e9", "carriers[0].frequency_hz", "write a number > 0 [Hz]"),
    ("[0, 0.5, 10]", "[0, 0.5]", "devices[0].position_m", "has 2 elements, write 3 [m]"),
    ("[0, 0.5, 10]", '[0, 0.5, "x"]', "devices[0].position_m[2]", "is 'x', write a number"),
    ("[0, 0.5, 10]", "[1e200, 0, 0]", "devices[0].position_m[0]", "≥ -1000000000.0 and ≤ 1000000000.0 [m]"),
    ("[[carriers]]", "[carriers]", "carriers", "write an array: [[carriers]]"),
    ("[0, 0.5, 10]", "10", "devices[0].position_m", "write an array"),
    ("rows = 8", "rows = 2000", "devices[0].array.rows", "≥ 1 and ≤ 1024"),
    ("{ rows = 8, columns = 4 }", '"8x4"', "devices[0].array", "write a table"),
    ('kind = "lidar"', 'kind = "lider"', "devices[1].kind", "did you mean 'lidar'? One of"),
    ('policy = "hold"', 'policy = "skip"', "services.channel.policy", "known: abort, drop, hold, wait"),
    ('role = "channel"', 'role = "chanel"', "services.channel.role", "did you mean 'channel'?"),
    ("budget_ms = 150", "budget_ms = 0", "services.channel.budget_ms", "is 0, write a number > 0 and ≤ 1"),
]

SECOND_RECORDER = """[services.tape]
role = "recorder"
use = "mcap"
budget_ms = 50
[services.pilot]"""

BROKEN_RULES = [
    ('record = ["scene"]', 'record = ["lidar", "scen"]', "run.record[1]", "did you mean 'scene'?"),
    ('record = ["scene"]', 'record = ["lidar.gird"]', "run.record[0]", "did you mean 'grid'?"),
    ('record = ["scene"]', 'record = ["scene.h"]', "run.record[0]", "has no part 'h'"),
    ('"world"', '"link"', "services", 'no service has role = "world"'),
    ("[services.pilot]", SECOND_RECORDER, "services.recorder", "at most one, which is 'tape'"),
    ('policy = "hold"', 'policy = "hold"\nmax_in_flight = 2', "services.channel.max_in_flight", "(clause 7)"),
    ('use = "sumo"', 'use = "sumo"\npolicy = "drop"', "services.traffic.policy", "a world cannot drop"),
    ('use = "mcap"', 'use = "mcap"\npolicy = "hold"', "services.recorder.policy", "a recorder cannot hold"),
    ('use = "mcap"', 'use = "mcap"\nusers = ["*"]', "services.recorder.users", "only agents own users"),
    (
        'name = "scanner"',
        'name = "bs"',
        "devices[1].name",
        "a second device is named 'bs' (the first stands in",
    ),
    ('on = "car.*"', 'on = "car.1"', "devices[1].count", 'write a pattern: on = "car.1*"'),
    ('on = "car.*"\ncount = 2\n', "", "devices[1].mount", "a parent to be mounted at"),
    (
        "{ rows = 8, columns = 4 }",
        '{ pattern_file = "sector.msi" }',
        "devices[0].array.pattern_file",
        "is 'sector.msi', write \"file:\" and a path",
    ),
    (
        "{ rows = 8, columns = 4 }",
        '{ pattern_file = "file:nowhere.msi" }',
        "devices[0].array.pattern_file",
        "nowhere.msi; 'file:nowhere.msi' is relative to the folder of the scenario",
    ),
    (
        "{ rows = 8, columns = 4 }",
        "{ panels = [{ yaw = 90 }] }",
        "devices[0].array.panels[0].yaw",
        "unknown key 'yaw'; did you mean 'yaw_deg'?",
    ),
    ("{ rows = 8, columns = 4 }", '{ polarization = "HV" }', "devices[0].array.polarization", "VH"),
    ('role = "both"\n', "", "devices[0]", 'write role = "tx", "rx" or "both"'),
    (
        'role = "both"',
        'role = "both"\nbeams = 64',
        "devices[0].beams",
        "belongs to kind 'lidar', this is 'antenna'",
    ),
    ("beams = 16", 'role = "rx"', "devices[1].role", "belongs to kind 'antenna', this is 'lidar'"),
    ("beams = 16", "range_m = [9, 3]", "devices[1].range_m", "two ascending numbers, at least 0"),
    ("beams = 16", "elevation_deg = [-95, 3]", "devices[1].elevation_deg", "at least -90.0 and at most 90.0"),
    ("beams = 16", 'world = "sky"', "devices[1].world", "known: traffic"),
    ("stall_s = 5", "heartbeat_s = 2", "timeouts", "leaves no heartbeat within liveness_s"),
    ('[[carriers]]\nname = "mmwave"\nfrequency_hz = 28e9\n', "", "services.channel", "add [[carriers]]"),
]


@pytest.mark.parametrize(("old", "new", "key", "says"), [*UNKNOWN_KEYS, *WRONG_VALUES, *BROKEN_RULES])
def test_what_is_wrong_is_named_with_file_key_and_remedy(
    folder: Path, old: str, new: str, key: str, says: str
) -> None:
    assert old in GOOD
    error = failure(GOOD.replace(old, new, 1), folder)
    assert (error.file, error.key) == ("crossing.toml", key)
    assert says in str(error)


@pytest.mark.parametrize(("old", "new", "key", "says"), [*UNKNOWN_KEYS, *WRONG_VALUES])
def test_what_is_wrong_is_named_with_its_line(folder: Path, old: str, new: str, key: str, says: str) -> None:
    text = GOOD.replace(old, new, 1)
    name = key.rpartition(".")[2].partition("[")[0]
    lines = text.splitlines()
    error = failure(text, folder)
    assert error.line is not None
    assert name in lines[error.line - 1]
    assert f"crossing.toml:{error.line}: " in str(error)
    assert error.line in range(line_of(text, new), line_of(text, new) + new.count("\n") + 1)


@pytest.mark.parametrize(
    ("line", "key", "says"),
    [
        ("frames = 20\n", "run", "lacks 'frames', write frames = … (a whole number ≥ 1)"),
        ('kind = "antenna"\n', "devices[0]", "lacks 'kind', write kind = … (one of antenna, camera, lidar)"),
        ("budget_ms = 150\n", "services.channel", "lacks 'budget_ms'"),
    ],
)
def test_a_missing_key_is_named_with_its_table(folder: Path, line: str, key: str, says: str) -> None:
    error = failure(GOOD.replace(line, "", 1), folder)
    assert error.key == key
    assert error.line is not None
    assert f"{key}: {says}" in str(error)


def test_a_device_is_found_by_its_name_too(folder: Path) -> None:
    """A world knows its own devices only, and so names them in its errors; the line is that of the key."""
    scenario = parse_scenario(GOOD, "crossing.toml", folder)
    for index, device in enumerate(scenario.devices):
        for key in ("name", "kind", "role"):
            wanted = scenario.source.line(f"devices[{index}].{key}")
            said = located(f"devices.{device.name}.{key}: is bad", "world", scenario.source)
            assert said == f"crossing.toml:{wanted}: devices.{device.name}.{key}: is bad"


def test_a_file_without_a_run_table_says_what_it_lacks() -> None:
    with pytest.raises(ScenarioError, match=r"the file lacks 'run', write \[run\]"):
        parse("[services]\n")


@pytest.mark.parametrize(
    ("text", "line"),
    [("[run]\nname 3\n", 2), ("[run]\na = 1\na = 2\n", 3), ("[run]\nx = [1,\n", 3), ("[run\n", 1)],
)
def test_broken_toml_is_named_with_its_line(text: str, line: int) -> None:
    with pytest.raises(ScenarioError, match="not TOML") as caught:
        parse(text)
    assert caught.value.line in (line, line - 1, line + 1)


@pytest.mark.parametrize(
    ("line", "remedy"),
    [
        (
            "frequency_hz = 28GHz  # mmWave",
            "; a number has no unit: the key's name says it, and 28 GHz is 28e9",
        ),
        ("budget_ms = 20 ms", "; a number has no unit: the key's name says it, and 28 GHz is 28e9"),
        ("use = los-beam", '; a text is quoted: "los-beam", and yes and no are true and false'),
        ("frames 100", ""),
        ("x = [1, 2", ""),
    ],
)
def test_a_line_that_is_no_toml_is_shown_with_what_to_write(line: str, remedy: str) -> None:
    with pytest.raises(ScenarioError, match="not TOML") as caught:
        parse(f"[run]\n{line}\n")
    assert caught.value.line in (2, 3)
    if caught.value.line == 2:
        assert f": {line}{remedy}" in str(caught.value)
        assert str(caught.value).endswith(line + remedy)
    else:
        assert not remedy


def test_a_table_that_is_misspelt_is_named_before_what_it_leaves_out(folder: Path) -> None:
    """`[services.channel]` is missing then, and `[services.channel.settings]` lacks a role: neither is it."""
    error = failure(GOOD.replace("[services.channel]", "[service.channel]"), folder)
    assert "unknown key 'service'; did you mean 'services'?" in str(error)


def test_a_file_that_is_not_text_is_named_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "latin.toml"
    path.write_bytes(b"[run]\nname = '\xe9'\n")
    with pytest.raises(ScenarioError, match=r"latin\.toml:2: is not UTF-8"):
        load_scenario(path)


def test_a_missing_scenario_names_those_beside_it(folder: Path) -> None:
    (folder / "smoke.toml").write_text(GOOD)
    with pytest.raises(ScenarioError, match=r"smok\.toml.*smoke\.toml"):
        load_scenario(folder / "smok.toml")
    with pytest.raises(ScenarioError, match=r"No such file.*/smoke\.toml\?"):
        load_scenario(folder / "smok.toml")
    with pytest.raises(ScenarioError, match=r"No such file.*/nowhere"):
        load_scenario(folder / "nowhere" / "mine.toml")


def test_a_name_of_an_own_scenario_is_found_too(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    (folder / "crossing.toml").write_text(GOOD)
    with pytest.raises(ScenarioError, match=r"did you mean 'crossing\.toml'\?"):
        load_scenario("crosing")


def test_a_folder_in_place_of_a_scenario_names_those_in_it(folder: Path) -> None:
    (folder / "smoke.toml").write_text(GOOD)
    with pytest.raises(ScenarioError, match=r"Is a directory.*smoke\.toml"):
        load_scenario(folder)


def test_the_name_of_a_folder_is_told_from_that_of_a_shipped_scenario(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a slash it was taken for a name that is misspelt."""
    monkeypatch.chdir(folder)
    for name in ("mine", "empty", "runs"):
        Path(name).mkdir()
    (folder / "mine" / "a.toml").write_text(GOOD)
    (folder / "runs" / "run.json").touch()
    with pytest.raises(ScenarioError, match=r"a\.toml.*mine/a\.toml"):
        load_scenario("mine")
    with pytest.raises(ScenarioError, match=r"Is a directory.*caviar new"):
        load_scenario("empty")
    with pytest.raises(ScenarioError, match=r"directory of a run.*caviar replay runs"):
        load_scenario("runs")


@pytest.mark.parametrize(("role", "lacking"), [("tx", "rx"), ("rx", "tx")])
def test_a_channel_with_antennas_of_one_role_alone_is_refused(folder: Path, role: str, lacking: str) -> None:
    error = failure(GOOD.replace('role = "both"', f'role = "{role}"'), folder)
    assert (error.key, error.line) == ("devices", line_of(GOOD, "[[devices]]"))
    assert f'no antenna has role = "{lacking}"' in str(error)


def test_windows_line_ends_count_as_one(folder: Path) -> None:
    text = GOOD.replace("seed = 7", "sede = 7")
    assert failure(text.replace("\n", "\r\n"), folder).line == failure(text, folder).line


def test_a_mark_in_front_of_a_file_is_passed_over(tmp_path: Path) -> None:
    text = find_scenario("smoke").read_bytes()
    (tmp_path / "marked.toml").write_bytes(b"\xef\xbb\xbf" + text)
    assert load_scenario(tmp_path / "marked.toml").services == load_scenario("smoke").services


def test_a_name_that_is_too_long_for_a_directory_is_refused_with_the_limit(tmp_path: Path) -> None:
    text = find_scenario("smoke").read_text().replace('name = "smoke"', f'name = "{"n" * 300}"')
    (tmp_path / "long.toml").write_text(text)
    with pytest.raises(ScenarioError, match=r"long\.toml:\d+.*run\.name.*\{0,199\}"):
        load_scenario(tmp_path / "long.toml")


@pytest.mark.parametrize(
    ("name", "key"),
    [("crossing", r"run\.name"), ("mmwave", r"carriers\[0\]\.name"), ("bs", r"devices\[0\]\.name")],
)
def test_a_name_with_a_control_character_is_refused_and_shown_escaped(
    name: str, key: str, folder: Path
) -> None:
    error = failure(GOOD.replace(f'"{name}"', f'"{name}\\n"'), folder)
    assert re.search(rf"{key}: .*'{name}\\n'", str(error))


def test_frames_of_the_command_line_are_within_the_longest_duration() -> None:
    with pytest.raises(ScenarioError, match=r"9000000000000 frames of \d+ ns"):
        with_overrides(load_scenario("smoke"), frames=9_000_000_000_000)


def test_pattern_files_are_found_beside_the_scenario_and_differ_in_name(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "sector.msi").write_text("x")
    (tmp_path / "roads.net.xml").write_text("x")
    one = "{ pattern_file = 'file:a/sector.msi', panels = [{ yaw_deg = 90.0 }] }"
    text = GOOD.replace("{ rows = 8, columns = 4 }", one)
    (tmp_path / "one.toml").write_text(text)
    array = load_scenario(tmp_path / "one.toml").devices[0].array
    assert array is not None
    assert (array.pattern_file, array.panels[0].yaw_deg) == (str(tmp_path / "a" / "sector.msi"), 90.0)
    (tmp_path / "linked.msi").symlink_to(tmp_path / "a" / "sector.msi")
    (tmp_path / "link.toml").write_text(text.replace("a/sector.msi", "linked.msi"))
    linked = load_scenario(tmp_path / "link.toml").devices[0].array
    assert linked is not None
    assert linked.pattern_file == str(tmp_path / "linked.msi")
    second = '\n[[devices]]\nname = "b2"\nkind = "antenna"\nrole = "rx"\n'
    (tmp_path / "two.toml").write_text(text + second + "array.pattern_file = 'file:b/sector.msi'\n")
    with pytest.raises(ScenarioError, match=r"two.toml:\d+.*devices\[2\].array.pattern_file"):
        load_scenario(tmp_path / "two.toml")


@pytest.mark.parametrize(
    ("given", "key", "value"),
    [
        ("run.frames=7", "run.frames", 7),
        ("services.world.budget_ms=1.5", "services.world.budget_ms", 1.5),
        ("link.codebook=dft", "services.link.settings.codebook", "dft"),
        ('run.record=["scene"]', "run.record", ["scene"]),
        ("carriers.mmwave.frequency_hz=60e9", "carriers.0.frequency_hz", 60e9),
        ("carriers[0].name=mm wave", "carriers.0.name", "mm wave"),
    ],
)
def test_keys_of_a_scenario_are_set_from_outside(given: str, key: str, value: object) -> None:
    table, source = read_toml(find_scenario("smoke").read_text())
    set_keys(table, source, [given])
    for part in key.split("."):
        table = table[int(part) if isinstance(table, list) else part]
    assert table == value


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("run.frames", "--set run.frames: write it as in --set services"),
        ("run.frames=0", "run.frames: is 0, write a whole number"),
        ("run.frmes=3", "run.frmes.*frames"),
        ("carriers.7.bandwidth_hz=1", "there is no '7'; there are: mmwave"),
        ("run.name.first=3", "run.name is a value, and has no keys"),
        ("chanel.samples=3", "chanel"),
    ],
)
def test_keys_that_cannot_be_set_are_refused_by_name(given: str, words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        load_scenario("smoke", [given])
