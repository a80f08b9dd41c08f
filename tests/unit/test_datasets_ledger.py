"""What is there of a dataset when generation goes on: hostile catalogues, damaged and foreign recordings."""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

import caviar
from caviar_clients.datasets import catalogue as catalogue_module
from caviar_clients.datasets.catalogue import TABLES, Catalogue
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeResult, EpisodeTask, play_episode
from caviar_clients.datasets.estimate import Estimate
from caviar_clients.datasets.generate import generate
from caviar_clients.datasets.ledger import Ledger, MissingEpisodes
from caviar_clients.datasets.plan import DatasetPlan, plan_dataset
from caviar_clients.datasets.settings import fingerprint
from caviar_clients.datasets.verification.verify import verify
from caviar_protocol.errors import CaviarError, RecordingError, RunError
from caviar_protocol.scenario import load_scenario

EPISODES, SCENES = 3, 2


class Notes:
    """Keeps what a generation tells."""

    def __init__(self) -> None:
        self.texts = list[str]()

    def note(self, text: str) -> None:
        self.texts.append(text)

    def traffic(self, now_s: float, end_s: float) -> None:
        raise AssertionError("smoke has no traffic")

    def estimated(self, found: Estimate, free: int | None, episodes: int, workers: int) -> None:
        raise AssertionError("no test here plays an episode")

    def ended(self, result: EpisodeResult) -> None:
        raise AssertionError("no test here plays an episode")


def planned(episodes: int = EPISODES, seed: int | None = None) -> DatasetPlan:
    return plan_dataset(load_scenario("smoke"), episodes=episodes, scenes=SCENES, seed=seed)


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("clean") / "d"
    directory, plan = DatasetDirectory(out), planned()
    settings = plan.settings()
    with writing_dataset(directory):
        catalogue = Catalogue(directory.catalogue, writable=True)
        catalogue.plan(settings, EPISODES)
        for number in range(EPISODES):
            task = EpisodeTask(plan.scenario, number, str(out), settings=fingerprint(settings))
            result = play_episode(task)
            assert result.rows is not None, result.error
            catalogue.add(result.rows, result.measured)
        catalogue.close()
    return out


@pytest.fixture
def data(clean: Path, tmp_path: Path) -> Path:
    """A copy to do harm to."""
    shutil.copytree(clean, tmp_path / "d")
    return tmp_path / "d"


def execute(data: Path, *statements: str) -> None:
    with closing(sqlite3.connect(data / "catalogue.sqlite", isolation_level=None)) as connection:
        for statement in statements:
            connection.execute(statement)


def tables(data: Path) -> dict[str, object]:
    catalogue = Catalogue(data / "catalogue.sqlite")
    found: dict[str, object] = {name: catalogue.table(name) for name in (*TABLES, "timings")}
    found |= {"settings": catalogue.settings, "planned": catalogue.planned}
    catalogue.close()
    return found


def refused(data: Path, plan: DatasetPlan | None = None) -> str:
    with pytest.raises(CaviarError) as caught:
        generate(plan or planned(), data, Notes(), workers=1)
    return str(caught.value)


SETTINGS = "UPDATE dataset SET value = {} WHERE key = 'settings'"
HOSTILE = {
    "DROP TABLE users": "table users is missing",
    "DROP TABLE dataset": "table dataset is missing",
    "ALTER TABLE scenes ADD COLUMN more INTEGER": "table scenes has a column more too many",
    "ALTER TABLE scenes RENAME COLUMN t_s TO t": "table scenes has no column t_s",
    SETTINGS.format("'{'"): "settings in table dataset are damaged: Input data was truncated",
    SETTINGS.format("'[1, 2]'"): "damaged: Expected `object`, got `array`",
    SETTINGS.format("'{}'"): "damaged: Object missing required field `format`",
    SETTINGS.format(
        "json_set(value, '$.format', 99)"
    ): "it has format 99, and this version reads 1; install a",
    SETTINGS.format(
        "json_set(value, '$.format', 0)"
    ): "it has format 0, and this version reads 1; read it with",
    SETTINGS.format("json_set(value, '$.scenario.run', 7)"): r"got `int` - at `\$.scenario.run`",
    SETTINGS.format("json_set(value, '$.scenario.run.frames', -1)"): "Expected `int` >= 1",
    "UPDATE dataset SET value = '-3' WHERE key = 'episodes'": "the number of episodes .* is '-3'",
    "UPDATE dataset SET value = '1e9' WHERE key = 'episodes'": "the number of episodes .* is '1e9'",
    "UPDATE episodes SET episode = -1 WHERE episode = 0": "table episodes has an episode -1",
    "UPDATE users SET episode = -7 WHERE episode = 1": "table users has an episode -7",
}


@pytest.mark.parametrize("harm", HOSTILE)
def test_a_hostile_catalogue_is_refused_by_all_that_open_it_and_stays_as_it_is(data: Path, harm: str) -> None:
    execute(data, *harm.split("; "))
    before = (data / "catalogue.sqlite").read_bytes()
    opened: list[Callable[[], object]] = [
        lambda: Catalogue(data / "catalogue.sqlite"),
        lambda: caviar.dataset(data),
        lambda: list(verify(data)),
        lambda: generate(planned(), data, Notes()),
    ]
    for opens in opened:
        with pytest.raises(RecordingError, match=HOSTILE[harm]) as caught:
            opens()
        assert "catalogue.sqlite is no catalogue that can be used" in str(caught.value)
        assert any(word in str(caught.value) for word in ("move it away", "install", "read it with"))
    assert (data / "catalogue.sqlite").read_bytes() == before


def test_a_catalogue_whose_types_bind_nothing_is_not_written(data: Path) -> None:
    execute(data, "CREATE TABLE loose AS SELECT * FROM users", "DROP TABLE users")
    execute(data, "ALTER TABLE loose RENAME TO users")
    assert "table users has columns of other types, or another key; move it away" in refused(data)
    assert len(caviar.dataset(data)) == EPISODES


def test_what_is_no_database_has_a_way_out(data: Path) -> None:
    (data / "catalogue.sqlite").write_bytes(b"not a database, but long enough to be looked at as one" * 20)
    said = refused(data)
    assert (
        "file is not a database; move it away, and the same caviar dataset generate command makes it anew"
        in said
    )
    (data / "catalogue.sqlite").write_bytes(b"")
    with pytest.raises(RecordingError, match=r"table dataset is missing; move it away"):
        caviar.dataset(data)


def test_who_locks_a_catalogue_is_named(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(catalogue_module, "LOCKED_S", 0.0)
    program = (
        "import sqlite3, sys; c = sqlite3.connect(sys.argv[1]); c.execute('BEGIN EXCLUSIVE'); "
        "print('locked', flush=True); sys.stdin.read()"
    )
    file = str(data / "catalogue.sqlite")
    with subprocess.Popen(
        [sys.executable, "-c", program, file], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "locked\n"
        said = refused(data)
        holder.communicate("")
    assert f"database is locked; process {holder.pid} (" in said
    assert "writes it: wait until that ends, then run the same command again" in said


def test_a_catalogue_of_a_file_system_that_cannot_be_written_says_so(data: Path) -> None:
    catalogue = Catalogue(data / "catalogue.sqlite")
    with pytest.raises(RecordingError, match="readonly database"):
        catalogue.forget([0])
    with pytest.raises(RecordingError, match="asks for no columns; write a SELECT"):
        catalogue.query("PRAGMA query_only = 1")


def test_missing_episodes_are_counted_without_a_list() -> None:
    there = [0, 1, 4, 5, 9, 12]
    left = MissingEpisodes(there, 11)
    assert list(left) == [number for number in range(11) if number not in there]
    assert [left[-1], left[1:3], len(left)] == [10, [3, 6], 6]
    many = MissingEpisodes(there, 10**12)
    assert (len(many), many[len(many) // 2]) == (10**12 - 6, (10**12 - 6) // 2 + 6)
    assert not MissingEpisodes(range(4), 3)
    with pytest.raises(IndexError, match="6 of 6"):
        left[6]


def test_a_listed_recording_that_is_cut_is_refused_by_name(data: Path) -> None:
    file = DatasetDirectory(data).episode(1) / "recording-0000.mcap"
    size = file.stat().st_size
    os.truncate(file, 1000)
    (DatasetDirectory(data).episode(2) / "recording.json").unlink()
    said = refused(data)
    assert "2 recordings damaged" in said
    assert f"{file.parent} has 1000 B of {size} B" in said
    assert f"remove {file.parent}, {DatasetDirectory(data).episode(2)} and run the same command" in said
    assert tables(data)["planned"] == EPISODES


@pytest.mark.parametrize("size", [0, 100, 9000])
def test_an_unlisted_recording_that_is_cut_is_refused_and_others_are_listed(
    data: Path, clean: Path, size: int
) -> None:
    catalogue = Catalogue(data / "catalogue.sqlite", writable=True)
    catalogue.forget([0, 1])
    catalogue.close()
    folder = DatasetDirectory(data).episode(0)
    os.truncate(folder / "recording-0000.mcap", size)
    said = refused(data)
    assert "1 recording damaged: " in said
    assert f"remove {folder} and run the same command" in said
    shutil.rmtree(folder)
    shutil.copytree(DatasetDirectory(clean).episode(0), folder)
    assert generate(planned(), data, Notes()).before == EPISODES
    assert tables(data) == tables(clean)


def test_a_lost_catalogue_is_made_anew_from_the_recordings(data: Path, clean: Path) -> None:
    (data / "catalogue.sqlite").unlink()
    notes = Notes()
    assert generate(planned(), data, notes).before == EPISODES
    assert notes.texts == ["3 recordings not in the catalogue, episode 0 the first: now listed"]
    assert tables(data) == tables(clean)
    assert not (data / ".work").exists()


@pytest.mark.parametrize("has_digest", [True, False])
def test_recordings_of_another_dataset_make_no_catalogue(data: Path, has_digest: bool) -> None:
    (data / "catalogue.sqlite").unlink()
    if not has_digest:
        for file in data.glob("episodes/*/measured.json"):
            file.unlink()
    said = refused(data, planned(seed=5))
    assert "episode-000000 is of another dataset: run.seed was 1, is 5; give another --out" in said
    assert len(said) < 500
    assert not (data / "catalogue.sqlite").exists()
    if not has_digest:  # of the same dataset they do
        assert generate(planned(), data, Notes()).before == EPISODES


def test_recordings_of_another_device_make_no_catalogue(data: Path) -> None:
    (data / "catalogue.sqlite").unlink()
    for file in data.glob("episodes/*/measured.json"):
        file.write_text('{"settings": "another"}')
    said = refused(data)
    assert "is of another dataset: the device, or the content of a file, is another one" in said


def test_a_dataset_of_other_settings_is_refused_in_a_few_words(data: Path) -> None:
    other = planned(seed=5)
    execute(data, SETTINGS.format("json_set(value, '$.versions.numpy', hex(zeroblob(2000)))"))
    said = refused(data, other)
    assert "holds another dataset:\n  run.seed was 1, is 5\n  versions.numpy was '0000" in said
    assert len(said) < 700


def test_more_episodes_than_the_disk_can_hold_are_refused_at_once(data: Path, tmp_path: Path) -> None:
    said = refused(data, planned(episodes=10**13))
    assert "is too small" in said
    assert tables(data)["planned"] == EPISODES
    assert "1e+18 episodes at most" in refused(data, planned(episodes=10**30))
    refused(tmp_path / "new", planned(episodes=10**13))
    assert not (tmp_path / "new" / "catalogue.sqlite").exists()


def test_a_plan_of_another_dataset_of_which_nothing_is_there_is_replaced(data: Path) -> None:
    catalogue = Catalogue(data / "catalogue.sqlite", writable=True)
    catalogue.forget(range(EPISODES))
    shutil.rmtree(data / "episodes")
    plan = planned(episodes=2, seed=5)
    ledger = Ledger(plan, plan.settings(), str(data), DatasetDirectory(data), None, catalogue)
    ledger.refuse_other_dataset()
    ledger.compare_with_recordings(pytest.fail)
    ledger.keep_plan()
    assert catalogue.planned == 2
    catalogue.close()


def test_an_episode_in_the_folder_of_another_is_refused(data: Path) -> None:
    DatasetDirectory(data).episode(0).rename(DatasetDirectory(data).episode(7))
    with pytest.raises(RunError, match=r"episode-000007.*episode 0, not of 7"):
        generate(planned(), data, Notes())
