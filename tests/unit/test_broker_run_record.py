"""run.json: nothing that changes it goes unnoticed, and what a run was begun with is compared."""

from __future__ import annotations

import random
from pathlib import Path

import msgspec
import pytest

from caviar_broker.run_record import RunRecord, changes, read_record, versions_of
from caviar_protocol.errors import RecordingError
from caviar_protocol.scenario import find_scenario, load_scenario

SMOKE = load_scenario(find_scenario("smoke"))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    record = RunRecord(run="smoke-1", epoch=2, endpoint="tcp://127.0.0.1:5570", scenario=SMOKE)
    msgspec.structs.replace(record, versions={"code": "abc"}).save(tmp_path)
    return tmp_path / "run.json"


def test_a_record_comes_back_as_it_was_written(path: Path) -> None:
    found = read_record(path.parent)
    assert (found.run, found.epoch, found.versions) == ("smoke-1", 2, {"code": "abc"})
    assert found.scenario.services == SMOKE.services
    assert [file.name for file in path.parent.iterdir()] == ["run.json"]


def test_no_bit_that_flips_in_run_json_goes_unnoticed(path: Path) -> None:
    data, rng = bytearray(path.read_bytes()), random.Random(2)
    for bit in rng.sample(range(len(data) * 8), 500):
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        with pytest.raises(RecordingError, match=r"run\.json is damaged"):
            read_record(path.parent)
        data[bit // 8] ^= 1 << bit % 8


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"", "is empty"),
        (b"\0" * 4096, "is empty"),
        (b"{}", "SHA-256"),
        (b'{"scenario": {}}\n', "another version"),
    ],
    ids=["empty", "zeros", "other", "older"],
)
def test_what_a_loss_of_power_leaves_of_run_json_is_named(path: Path, content: bytes, why: str) -> None:
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=why):
        read_record(path.parent)


def test_versions_cover_code_protocol_libraries_and_files_of_a_scenario(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    table.write_text("1\n")
    service = msgspec.structs.replace(SMOKE.services["world"], settings={"file": f"file:{table}"})
    scenario = msgspec.structs.replace(SMOKE, services={**SMOKE.services, "world": service})
    before = versions_of(scenario)
    assert {"python", "protocol", "code", "numpy", "msgspec", f"file {table}"} <= before.keys()
    assert "mitsuba" not in before
    assert changes(before, versions_of(scenario)) == ""
    table.write_text("2\n")
    assert changes(before, versions_of(scenario)).startswith(f"file {table} ")
    assert changes({"numpy": "2.1"}, {"numpy": "2.2"}) == "numpy 2.2 (was 2.1)"
    traced = msgspec.structs.replace(SMOKE.services["channel"], use="sionna-rt")
    scenario = msgspec.structs.replace(SMOKE, services={**SMOKE.services, "channel": traced})
    assert "mitsuba" in versions_of(scenario)
