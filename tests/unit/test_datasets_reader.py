"""The reader and the catalogue of a dataset."""

from __future__ import annotations

import csv
import pickle
from pathlib import Path

import numpy as np
import pytest

import caviar
from caviar_clients.datasets.catalogue import MEASURED_TABLES, TABLES, Catalogue, columns_of
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeTask, play_episode
from caviar_clients.datasets.export import export_tables
from caviar_clients.datasets.plan import plan_dataset
from caviar_clients.datasets.reader import Dataset
from caviar_protocol.errors import RecordingError
from caviar_protocol.scenario import load_scenario

EPISODES, SCENES, USERS = 6, 3, 2


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("dataset")
    directory = DatasetDirectory(out)
    plan = plan_dataset(load_scenario("smoke"), episodes=EPISODES, scenes=SCENES)
    with writing_dataset(directory):
        catalogue = Catalogue(directory.catalogue, writable=True)
        catalogue.plan(plan.settings(), EPISODES)
        for number in range(EPISODES):
            result = play_episode(EpisodeTask(plan.scenario, number, str(out)))
            assert result.rows is not None, result.error
            catalogue.add(result.rows, result.measured)
        catalogue.close()
    return out


def test_tables_are_columns_of_numpy_arrays(folder: Path) -> None:
    data = caviar.dataset(folder)
    assert repr(data) == f"Dataset of {folder}: 6 episodes, 18 scenes"
    scenes = data.table("scenes")
    assert scenes["scene"].tolist() == [0, 1, 2] * EPISODES
    np.testing.assert_allclose(scenes["t_s"][:3], [0.0, 0.1, 0.2])
    users = data.users()
    assert len(users) == EPISODES * SCENES * USERS
    assert users["los"].dtype == np.bool_
    assert set(users["rx"]) == {"car/rx", "uav/rx-uav"}


def test_columns_of_the_catalogue_are_what_was_recorded(folder: Path) -> None:
    data = caviar.dataset(folder)
    users = data.users(object_class="car")
    link, channel = data.episode(2)["link"], data.episode(2)["channel"]
    at = users["episode"] == 2
    np.testing.assert_array_equal(users["tx_beam"][at], link.top_tx_beam[:, 0, 0])
    np.testing.assert_array_equal(users["abs_y"][at], link.top_abs_y[:, 0, 0])
    gain = 20.0 * np.log10(np.abs(channel.a[:, 0, 0]))
    np.testing.assert_allclose(users["gain_db"][at], gain, atol=1e-9)
    np.testing.assert_array_equal(users["delay_s"][at], channel.tau[:, 0, 0])
    position = data.episode(2)["scene"].devices.select(frames=range(3))
    rows = position.position[:, position.index(["car/rx"])[0]]
    np.testing.assert_array_equal(np.stack([users["x_m"], users["y_m"], users["z_m"]], axis=1)[at], rows)


def test_recorded_arrays_have_a_row_for_each_user_in_their_order(folder: Path) -> None:
    data = caviar.dataset(folder)
    users = data.users()
    shuffled = users[np.random.default_rng(1).permutation(len(users))]
    h = shuffled["channel.h"]
    assert h.shape == (len(users), 4, 32)
    for row in range(0, len(users), 7):
        channel = data.episode(shuffled["episode"][row])["channel"]
        user = channel.rx.index(shuffled["rx"][row])
        np.testing.assert_array_equal(h[row], channel.h[shuffled["scene"][row], user][: h.shape[1]])


def test_batches_are_all_users_once_in_an_order_that_the_seed_gives(folder: Path) -> None:
    users = caviar.dataset(folder).users()
    names = ["episode", "scene", "rx", "channel.h"]

    def keys(seed: int | None) -> list[tuple[int, int, str]]:
        found = []
        for batch in users.batches(5, names, shuffle=seed):
            assert len(batch["channel.h"]) == len(batch)
            found += list(zip(batch["episode"], batch["scene"], batch["rx"], strict=True))
        return found

    assert keys(1) == keys(1) != keys(2)
    assert sorted(keys(1)) == sorted(keys(None)) == keys(None)


def test_splits_are_by_episode_and_follow_from_the_seed(folder: Path) -> None:
    data = caviar.dataset(folder)
    train, test = data.split((0.5, 0.5), seed=3)
    assert sorted(train.episodes + test.episodes) == list(range(EPISODES))
    assert data.split((0.5, 0.5), seed=3)[0].episodes == train.episodes
    assert {data.split((0.5, 0.5), seed=seed)[0].episodes for seed in range(9)} != {train.episodes}
    assert set(train.users()["episode"]) == set(train.episodes)
    with pytest.raises(ValueError, match="add up to 1 at most"):
        data.split((0.8, 0.3))


def test_a_dataset_goes_to_another_process(folder: Path) -> None:
    part = caviar.dataset(folder).select([4, 1])
    again = pickle.loads(pickle.dumps(part))  # noqa: S301 - our own
    assert again.episodes == (4, 1)
    assert len(again.users()) == 2 * SCENES * USERS


@pytest.mark.parametrize(
    ("ask", "words"),
    [
        (lambda data: data.users()["gain"], "no column 'gain'; did you mean 'gain_db'"),
        (lambda data: data.users()["channel.hh"], "channel has no array 'hh'"),
        (lambda data: data.users()["lidar.grid"], "holds no product of 'lidar'"),
        (lambda data: data.users(carrier="mmwav"), "no users of carrier 'mmwav'; did you mean 'mmwave'"),
        (lambda data: data.table("user"), "no table 'user'; did you mean 'users'"),
        (lambda data: data.select([9]), "has no episode 9; it has 6: 0 to 5"),
        (lambda data: data.query("SELECT none FROM users"), "no such column: none"),
    ],
)
def test_what_is_not_there_is_named(folder: Path, ask: object, words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        ask(caviar.dataset(folder))  # type: ignore[operator]


def test_a_folder_without_a_catalogue_is_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(
        RecordingError, match=r"is no dataset, it has no catalogue.sqlite; make one with: caviar generate"
    ):
        Dataset(tmp_path)
    (tmp_path / "catalogue.sqlite").write_text("not a database, but long enough to be taken for one" * 20)
    with pytest.raises(RecordingError, match="file is not a database"):
        Dataset(tmp_path)


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_tables_are_exported_without_loss(folder: Path, tmp_path: Path, form: str) -> None:
    catalogue = Catalogue(DatasetDirectory(folder).catalogue)
    files = export_tables(catalogue, tmp_path, form)  # type: ignore[arg-type]
    assert [file.name for file in files][:2] == [f"episodes.{form}", f"scenes.{form}"]
    for name in TABLES:
        columns, rows = catalogue.table(name)
        if form == "csv":
            with (tmp_path / f"{name}.csv").open(newline="") as stream:
                read = list(csv.reader(stream))
            assert tuple(read[0]) == columns
            assert read[1:] == [["" if value is None else str(value) for value in row] for row in rows]
        else:
            import duckdb

            found = duckdb.read_parquet(str(tmp_path / f"{name}.parquet"))
            assert tuple(found.columns) == columns
            assert found.fetchall() == rows


def test_an_episode_that_is_added_again_replaces_itself(folder: Path, tmp_path: Path) -> None:
    from caviar_clients.datasets.rows import rows_of

    catalogue = Catalogue(tmp_path / "catalogue.sqlite", writable=True)
    rows = rows_of(caviar.dataset(folder).episode(3))
    catalogue.add_failure(3, "2026-11-24", "died", "here")
    assert catalogue.failures() == [(3, "died")]
    for _ in range(2):
        catalogue.add(rows, {})
    assert (catalogue.episodes(), len(catalogue.table("users")[1])) == ([3], SCENES * USERS)
    assert catalogue.failures() == []
    catalogue.forget([3])
    assert (catalogue.episodes(), catalogue.table("products")[1]) == ([], [])


def test_a_data_loader_delivers_one_order_with_any_number_of_processes(folder: Path) -> None:
    from torch.utils.data import DataLoader

    users = caviar.dataset(folder).users()
    names = ["episode", "scene", "rx", "channel.h"]

    def delivered(processes: int, epoch: int = 0) -> list[tuple[int, int, str, complex]]:
        batches = users.torch_batches(5, names, shuffle=7)
        batches.epoch = epoch
        found = []
        loader = DataLoader(
            batches, batch_size=None, num_workers=processes, multiprocessing_context=_CONTEXT[processes]
        )
        for batch in loader:
            assert batch["channel.h"].shape[1:] == (4, 32)
            first = batch["channel.h"][:, 0, 0].tolist()
            found += list(
                zip(batch["episode"].tolist(), batch["scene"].tolist(), batch["rx"], first, strict=True)
            )
        return found

    alone = delivered(0)
    assert len(alone) == len(users)
    assert delivered(2) == alone
    assert delivered(0, epoch=1) != alone


_CONTEXT = {0: None, 2: "spawn"}


def test_samples_are_read_by_position(folder: Path) -> None:
    users = caviar.dataset(folder).users()
    samples = users.torch(["gain_db", "channel.tau", "rx"])
    assert len(samples) == len(users)
    assert samples[3]["gain_db"].item() == users["gain_db"][3]
    assert samples[-1]["rx"] == users["rx"][-1]
    with pytest.raises(IndexError, match="user 36 of 36"):
        samples[36]


def test_the_reference_names_every_table_and_column(repository: Path) -> None:
    page = (repository / "docs" / "reference" / "datasets.md").read_text()
    for table in (*TABLES, *MEASURED_TABLES):
        assert f"## {table}" in page or f" {table}\n" in page
        heading = (
            page.split("## timings and failures")[1]
            if table in MEASURED_TABLES
            else page.split(f"## {table}\n")[1]
        )
        for column in columns_of(table):
            assert f"`{column}`" in heading.split("\n## ")[0], (table, column)
