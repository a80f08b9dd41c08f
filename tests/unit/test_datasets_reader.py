"""The reader and the catalogue of a dataset."""

from __future__ import annotations

import csv
import pickle
import re
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from recording_builders import channel, frame_of, grid_only, link, record, scene

import caviar
from caviar_clients.datasets.catalogue import MEASURED_TABLES, TABLES, Catalogue, columns_of
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeTask, play_episode
from caviar_clients.datasets.formats import export_tables
from caviar_clients.datasets.generate import _warn_of_equal_episodes
from caviar_clients.datasets.plan import plan_dataset
from caviar_clients.datasets.reader import Dataset, check_level
from caviar_clients.datasets.remote import is_address
from caviar_clients.datasets.rows import USER_COLUMNS
from caviar_clients.datasets.user_rows import Columns, Users
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.recording import Recording
from caviar_protocol.scenario import load_scenario
from caviar_protocol.topics import Camera, CameraImage, Intrinsics

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


def recorded_users(run: Path, frames: int = 2, cars: int = 3) -> Users:
    """Users of a recording with a fixed camera, and a LIDAR of which the grid alone was recorded."""
    optics = {"intrinsics": Intrinsics(fx=4.0, fy=4.0, cx=4.0, cy=3.0), "orientation": (1.0, 0.0, 0.0, 0.0)}
    images = [
        CameraImage(sensor="pole", position=(0, 0, 3), rgb=np.full((6, 8, 3), n, "|u1"), **optics)
        for n in range(frames)
    ]
    record(
        run,
        [
            frame_of(
                n, scene=scene(n), channel=channel(n), link=link(n), lidar=grid_only(),
                camera=Camera(images=(images[n],)),
            )
            for n in range(frames)
        ],
    )  # fmt: skip
    recording = Recording(run)
    dataset = SimpleNamespace(episodes=(0,), episode=lambda _: recording, location="here")
    names = [f"car.{u}" for _ in range(frames) for u in range(cars)]
    table = {
        "episode": np.zeros(len(names), int),
        "scene": np.repeat(np.arange(frames), cars),
        "object": np.array(names),
        "rx": np.array([f"{name}/rx" for name in names]),
        "tx": np.full(len(names), "bs"),
        "carrier": np.full(len(names), "c0"),
    }
    return Users(dataset, Columns(table))  # type: ignore[arg-type]


def test_users_share_the_row_of_one_sensor(tmp_path: Path) -> None:
    users = recorded_users(tmp_path / "run")
    one = users[users["scene"] == 1]["camera.rgb"]
    assert (one.shape, one.strides[0], one.flags.writeable) == ((3, 6, 8, 3), 0, False)
    rows, index = users.distinct("camera.rgb")
    assert (len(rows), index.tolist()) == (2, [0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(rows[index], users["camera.rgb"])
    with pytest.raises(ValueError, match="a column of the catalogue"):
        users.distinct("scene")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("lidar.points", "was recorded without points: its scans have the grid alone"),
        ("lidar.hits", "was recorded without hits: its scans have the grid alone"),
        ("link.sinr", "has no sinr: the run had no packets"),
    ],
)
def test_arrays_that_were_not_recorded_are_refused_and_not_listed(
    tmp_path: Path, name: str, words: str
) -> None:
    users = recorded_users(tmp_path / "run")
    assert name not in users.recorded()
    assert {"lidar.grid", "link.snr", "camera.rgb"} <= set(users.recorded())
    with pytest.raises(RecordingError, match=words):
        users[name]


def test_a_recording_of_another_dataset_is_refused(folder: Path, tmp_path: Path) -> None:
    copied = tmp_path / "d"
    shutil.copytree(folder, copied)
    (file,) = DatasetDirectory(copied).episode(1).glob("*.mcap")
    file.write_bytes(file.read_bytes() + b"\0")
    data = Dataset(copied)
    assert data.episode(0)["channel"].h.size
    with pytest.raises(RecordingError, match="episode-000001"):
        data.users()["channel.h"]


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
        (lambda data: data.users()["channel.H"], "channel has no array 'H'; did you mean 'h'"),
        (lambda data: data.users()["H"], "no column 'H'; a recorded array has .* in front: 'channel.h'"),
        (lambda data: data.users()["channel"], "no column 'channel'; a recorded array has .*'channel.h'"),
        (lambda data: data.users()["lidar.grid"], "holds no product of 'lidar'"),
        (lambda data: data.users(carrier="mmwav"), "no users of carrier 'mmwav'; did you mean 'mmwave'"),
        (lambda data: data.table("user"), "no table 'user'; did you mean 'users'"),
        (lambda data: data.select([9]), "has no episode 9; it has 6: 0 to 5"),
        (lambda data: data.query("SELECT none FROM users"), "no such column: none"),
        (lambda data: data.query("ATTACH 'other.sqlite' AS o"), "query\\(.*write one SELECT"),
        (lambda data: data.query("-- c\n PRAGMA query_only = 0"), "write one SELECT"),
        (lambda data: data.query("WITH x AS (SELECT 1) DELETE FROM users"), "readonly database"),
        (lambda data: data.query("SELECT 1; ATTACH 'o' AS o"), "one statement at a time"),
        (lambda data: data.episode(9), "has no episode 9 here; it has 6: 0 to 5"),
        (lambda data: data.users().batches(4, ["x_n"]), "no column 'x_n'; did you mean 'x_m'"),
        (
            lambda data: data.users().torch(["chanel.h"]),
            "'chanel' has no row for each user; did you mean 'chan",
        ),
        (
            lambda data: data.users()["channel.hf"],
            "no carrier of the run has subcarriers; write subcarriers = ",
        ),
        (lambda data: data.users()["channel.taps"], "no carrier of the run has taps; write taps = "),
    ],
)
def test_what_is_not_there_is_named(folder: Path, ask: object, words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        ask(caviar.dataset(folder))  # type: ignore[operator]


@pytest.mark.parametrize(
    ("ask", "error", "words"),
    [
        (lambda data: data.users()[3], TypeError, "users[3] is one user: write users[3:4]"),
        (lambda data: data.users()[0], TypeError, "users['rx'][0] for a value; users are 0 to 35"),
        (lambda data: data.users()[[0, 36]], IndexError, "users[[0, 36]]: index 36 is out of bounds"),
        (lambda data: data.users()[np.ones(3, bool)], IndexError, "users are 0 to 35, as a slice, list"),
        (lambda data: data.select([1, 1]), ValueError, "episodes has 1 2 times: name each once"),
        (lambda data: data.select(1), TypeError, "episodes is 1: write a list of numbers, as [1]"),
        (lambda data: data.select([1.5]), TypeError, "episodes has 1.5, a float: the number of an episode"),
        (
            lambda data: data.episode("1"),
            TypeError,
            "number is '1', a str: the number of an episode is an int, ",
        ),
        (lambda data: data.episode("1"), TypeError, "is an int, write 1"),
        (
            lambda data: data.episode(1.0),
            TypeError,
            "number is 1.0, a float: the number of an episode is an int, write 1",
        ),
        (lambda data: data.episode(None), TypeError, "number is None, a NoneType"),
        (lambda data: data.users().H, AttributeError, "write users['channel.h']"),
        (lambda data: data.users().los_, AttributeError, "users have no attribute 'los_'; print(users)"),
        (lambda data: data.users().gain_db, AttributeError, "write users['gain_db']"),
        (lambda data: data.users().link, AttributeError, "users['link.tx_beam']"),
        (lambda data: data.episode(1)["channel"].H, AttributeError, "channel has no 'H'; did you mean 'h'?"),
        (
            lambda data: data.split((0.99, 0.01)),
            ValueError,
            "of 6 episodes part 2 gets none; divide more episodes, or give it 0.17 at least",
        ),
        (
            lambda data: data.select([1]).split((0.5, 0.5)),
            ValueError,
            "of 1 episode part 1 gets none; divide",
        ),
        (
            lambda data: data.split(0.8),
            TypeError,
            "shares is 0.8: write a share for each part, as (0.8, 0.2)",
        ),
        (lambda data: data.split(()), ValueError, "shares are (): write positive numbers"),
        (
            lambda data: data.users().batches(64, "x_m"),
            TypeError,
            "names is 'x_m': write a list of names, as ['x",
        ),
        (
            lambda data: data.users().batches(64, []),
            ValueError,
            "name a column at least; known: episode, scene",
        ),
        (lambda data: data.users().batches(0, ["x_m"]), ValueError, "size is 0: a batch has at least 1 user"),
        (
            lambda data: data.users().torch_batches(0, ["x_m"]),
            ValueError,
            "size is 0: a batch has at least 1",
        ),
        (lambda data: data.users().torch_batches(2.5, ["x_m"]), ValueError, "size is 2.5: a batch has at"),
        (lambda data: data.users().torch("x_m"), TypeError, "names is 'x_m'"),
        (
            lambda data: data.users().batches(4, ["x_m"], shuffle=True),
            ValueError,
            "shuffle is True: it is the seed of the order, write a whole number, as shuffle=1",
        ),
    ],
)
def test_what_is_wrong_with_an_argument_is_said_at_once(
    folder: Path, ask: object, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=re.escape(words)):
        ask(caviar.dataset(folder))  # type: ignore[operator]


def test_a_query_makes_no_file(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    data = caviar.dataset(folder)
    with pytest.raises(RecordingError):
        data.query("/* c */ attach database 'made.sqlite' as made")
    assert list(tmp_path.iterdir()) == []
    text = "/* of */ -- all\n with x as (select count(*) as n from users) select n from x"
    assert data.query(text)["n"].tolist() == [EPISODES * SCENES * USERS]


def test_users_are_shown_with_what_each_column_is(folder: Path) -> None:
    text = repr(caviar.dataset(folder).users()[:1])
    assert text.startswith(f"1 user of {folder}\n")
    assert "  delay_s: of the first path [s]\n" in text
    assert "  tx_beam: of the best pair; of the pair that the agent chose it is link.tx_beam\n" in text
    assert "  channel.tau: " in text
    assert list(USER_COLUMNS) == list(columns_of("users"))


def test_the_folder_of_another_level_names_that_of_the_dataset(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(folder.parent)
    name = folder.name
    episode = f"{name}/episodes/episode-000002"
    with pytest.raises(
        RecordingError, match=f"{episode} is the recording of an episode: its dataset is {name};"
    ):
        Dataset(episode)
    for part in (f"{name}/episodes", f"{name}/catalogue.sqlite"):
        with pytest.raises(RecordingError, match=f"{part} is a part of a dataset: give {name}$"):
            check_level(part)
    with pytest.raises(RecordingError, match=r"no dataset, it holds \d+"):
        check_level(folder.parent)
    check_level(folder)
    check_level(tmp_path / "nothing")  # of which the catalogue says that it is not there
    for place in (name, f"{name}/episodes"):
        words = f"{name} is a dataset: give an episode of it, as {name}/episodes/episode-000000"
        with pytest.raises(RecordingError, match=words):
            caviar.open(place)


def test_a_folder_without_a_catalogue_is_no_dataset(tmp_path: Path) -> None:
    with pytest.raises(
        RecordingError,
        match=r"catalogue\.sqlite.*dataset generate",
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


def test_tables_tell_an_empty_text_from_no_value_and_leave_other_files(folder: Path, tmp_path: Path) -> None:
    import duckdb

    catalogue = Catalogue(tmp_path / "catalogue.sqlite", writable=True)
    for number, error in enumerate(("", 'a "b", c\r\nd', "NULL", "\\N")):
        catalogue.add_failure(number, "2026-11-24", error, "")
    notes = tmp_path / "t" / "notes.csv"
    notes.parent.mkdir()
    notes.write_text("mine")
    for form in ("csv", "parquet", "csv", "parquet"):
        export_tables(catalogue, tmp_path / "t", form)  # type: ignore[arg-type]
    assert (
        duckdb.read_parquet(str(tmp_path / "t" / "failures.parquet")).fetchall()
        == catalogue.table("failures")[1]
    )
    assert (
        (tmp_path / "t" / "failures.csv")
        .read_text()
        .startswith('episode,failed,error,host\n0,2026-11-24,"",""\n')
    )
    names = {f"{name}.{form}" for name in (*TABLES, *MEASURED_TABLES) for form in ("csv", "parquet")}
    assert {file.name for file in notes.parent.iterdir()} == {*names, "notes.csv"}


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_a_file_of_the_user_is_not_replaced_by_a_table(folder: Path, tmp_path: Path, form: str) -> None:
    catalogue = Catalogue(DatasetDirectory(folder).catalogue)
    mine = tmp_path / f"users.{form}"
    mine.write_text("name,age\nAda,36\n")
    with pytest.raises(RunError, match=f"users.{form} is there, and is not the table users of a dataset"):
        export_tables(catalogue, tmp_path, form)  # type: ignore[arg-type]
    assert [file.name for file in tmp_path.iterdir()] == [mine.name]
    assert mine.read_text() == "name,age\nAda,36\n"


def test_tables_are_written_to_a_folder(folder: Path) -> None:
    catalogue = Catalogue(DatasetDirectory(folder).catalogue)
    with pytest.raises(RunError, match="s3://bucket/x"):
        export_tables(catalogue, "s3://bucket/x", "csv")
    with pytest.raises(RunError, match="write 's3://bucket/x', as text"):
        export_tables(catalogue, Path("s3://bucket/x"), "csv")


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("s3:/bucket/x", "write 's3://bucket/x'"),
        ("s3:bucket/x", "write 's3://bucket/x'"),
        ("s3//bucket/x", "write 's3://bucket/x'"),
        ("file:/data/x", "write 'file:///data/x'"),
        ("", "give a folder, or an address as s3://bucket/name"),
        ("  ", "give a folder, or an address as s3://bucket/name"),
    ],
)
def test_an_address_that_lacks_something_is_no_folder(place: str, words: str, tmp_path: Path) -> None:
    for ask in (is_address, caviar.dataset):
        with pytest.raises(RunError, match=words):
            ask(place)
    assert not is_address("run:3/s3")
    assert not is_address("./s3:/bucket")
    assert is_address("file:///data/x")


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


def test_seeds_that_follow_each_other_share_no_epochs(folder: Path) -> None:
    pytest.importorskip("torch")
    users, orders = caviar.dataset(folder).users(), []
    for seed in (7, 8, 9):
        batches = users.torch_batches(len(users), ["episode", "scene", "rx"], shuffle=seed)
        for batches.epoch in range(3):
            (batch,) = batches
            orders.append(
                tuple(zip(batch["episode"].tolist(), batch["scene"].tolist(), batch["rx"], strict=True))
            )
    assert len(set(orders)) == len(orders)


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
            # Rows of a batch have the size of its largest array: 4 elements of the car, 1 of the UAV.
            assert batch["channel.h"].shape[1:] in ((4, 32), (1, 32))
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
    words = (
        r"channel\.h has the shape \(4, 32\) for 'car/rx' and \(1, 32\) for 'uav/rx-uav': take torch_batches"
    )
    with pytest.raises(ValueError, match=words):
        users.torch(["channel.h"])
    assert users[users["rx"] == "car/rx"].torch(["channel.h"])[2]["channel.h"].shape == (4, 32)
    assert len(users[:0].torch(["channel.h"])) == 0


def test_a_scenario_that_draws_nothing_at_random_is_named(folder: Path, tmp_path: Path) -> None:
    notes = list[str]()
    other = shutil.copy(DatasetDirectory(folder).catalogue, tmp_path)
    with closing(sqlite3.connect(other)) as changed:
        changed.execute("UPDATE products SET sha256 = '' WHERE episode = 1 AND scene = 2 AND topic = 'link'")
        changed.commit()
    for file in (DatasetDirectory(folder).catalogue, Path(other)):
        catalogue = Catalogue(file)
        _warn_of_equal_episodes(catalogue, SimpleNamespace(note=notes.append))  # type: ignore[arg-type]
        catalogue.close()
    (note,) = notes
    assert "episodes 0 and 1 are equal, nothing in the scenario draws at random" in note


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
