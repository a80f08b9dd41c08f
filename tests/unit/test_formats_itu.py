"""Format ``itu``: what its files hold, by readers written from the description of the challenge's files."""

from __future__ import annotations

import csv
import re
import shutil
import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from test_formats import SERVICES, generated

from caviar_clients.datasets.reader import Dataset
from caviar_formats.base import export_users, find_format
from caviar_formats.imports import import_dataset
from caviar_formats.testing import FormatConformance
from caviar_protocol.errors import RunError

pytestmark = pytest.mark.slow

VEHICLES, SCENES = 10, 50
SIZES = {"car": [4.5, 1.8, 1.59], "bus": [9.0, 2.5, 3.2], "truck": [12.5, 2.5, 4.3]}

SCENARIO = """
[run]
name = "s008"
frames = 1
sampling_period_ns = 100_000_000
record = ["scene", "channel", "link"{topics}]

[[carriers]]
name = "60GHz"
frequency_hz = 60e9
bandwidth_hz = 100e6

{objects}

{sensors}

[[devices]]
name = "bs"
kind = "antenna"
role = "tx"
position_m = [746.0, 560.0, 4.0]
yaw_deg = 90.0
array = {{ columns = 32 }}

[[devices]]
name = "rx"
kind = "antenna"
role = "rx"
on = "flow*"
count = {count}
mount = "roof"
position_m = [0.0, 0.0, 0.1]
yaw_deg = -90.0
array = {{ columns = 8 }}
"""

SENSORS = """
[services.lidar]
role = "sensors"
use = "lidar"
budget_ms = 1000

[services.lidar.settings]
points_every = 0
grid = { minimum_m = [744.0, 429.0, 0.0], maximum_m = [767.0, 679.0, 10.0], cells = [20, 200, 10] }

[services.camera]
role = "sensors"
use = "camera"
budget_ms = 1000

[[devices]]
name = "lidar"
kind = "lidar"
on = "flow*"
count = 3
mount = "roof"
position_m = [0.0, 0.0, 0.5]
beams = 16
azimuth_steps = 180
""" + "".join(
    f"""
[[devices]]
name = "{name}"
kind = "camera"
position_m = [746.0, 560.0, 4.5]
yaw_deg = {yaw}
size_px = [960, 540]
"""
    for name, yaw in (("north", 60.0), ("ahead", 0.0), ("south", -60.0))
)


def scenario(objects: str, sensors: str = "", topics: str = "") -> str:
    count = objects.count("name = ")
    return SERVICES + SCENARIO.format(objects=objects, sensors=sensors, topics=topics, count=count)


def vehicle(name: str, kind: str, waypoints: list[list[float]]) -> str:
    return (
        f'[[services.world.settings.objects]]\nname = "{name}"\nkind = "{kind}"\n'
        f"dimensions_m = {SIZES[kind]}\nwaypoints = {waypoints}\n"
    )


@pytest.fixture(scope="module")
def poses(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Vehicles that go in random directions from random places."""
    place, rng = tmp_path_factory.mktemp("poses"), np.random.default_rng(8)
    objects = [
        vehicle(
            f"flow{i}.0",
            list(SIZES)[i % 3],
            [[t * 0.1, *rng.uniform((700, 500), (800, 620)).tolist(), 1.5] for t in range(SCENES + 1)],
        )
        for i in range(VEHICLES)
    ]
    (place / "s008.toml").write_text(scenario("\n".join(objects)))
    return generated(place / "data", place / "s008.toml", episodes=2, scenes=SCENES)


@pytest.fixture(scope="module")
def paired(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Two vehicles with LIDARs in the area, one outside of it, and three cameras."""
    place = tmp_path_factory.mktemp("paired")
    objects = [
        vehicle("flow0.0", "bus", [[0.0, 750.0, 500.0, 1.6], [10.0, 750.0, 600.0, 1.6]]),
        vehicle("flow1.0", "car", [[0.0, 760.0, 600.0, 0.8], [10.0, 760.0, 500.0, 0.8]]),
        vehicle("flow2.0", "car", [[0.0, 780.0, 600.0, 0.8], [10.0, 780.0, 500.0, 0.8]]),
    ]
    (place / "s008.toml").write_text(scenario("\n".join(objects), SENSORS, ', "lidar.grid", "camera"'))
    return generated(place / "data", place / "s008.toml", episodes=4, scenes=1)


class TestItu(FormatConformance):
    name = "itu"

    @pytest.fixture
    def dataset(self, paired: Dataset) -> Dataset:
        return paired


def exported(dataset: Dataset, flavour: str, out: Path) -> Path:
    export_users(dataset.users(), find_format("itu", flavour), out)
    return out


def rays_of(folder: Path, row: dict[str, str]) -> Any:
    """Rays of a row of the CSV, without padding, float64 [rays, 9]."""
    (file,) = folder.rglob(f"rosslyn_mobile_60GHz_ts0.1s_V_Lidar_e{row['EpisodeID']}.hdf5")
    with h5py.File(file) as data:
        found = data["allEpisodeData"][int(row["SceneID"]), int(row["VehicleArrayID"])].astype(float)
    return found[~np.isnan(found[:, 0])]


def rows_of(folder: Path) -> list[dict[str, str]]:
    (table,) = folder.glob("CoordVehiclesRxPerScene_*.csv")
    with table.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_best_pairs_from_rays_are_those_of_the_channel(poses: Dataset, tmp_path: Path) -> None:
    """Geometry and phases of the arrays as the challenge has them, with the zenith that it leaves out."""
    folder, users = exported(poses, "full", tmp_path / "out"), poses.users()
    rows, h = rows_of(folder), users["channel.h"]
    assert [int(row["EpisodeID"]) for row in rows] == users["episode"].tolist()
    assert len(rows) == 2 * SCENES * VEHICLES
    dft = {n: np.exp(-2j * np.pi * np.outer(np.arange(n), np.arange(n)) / n) for n in (8, 32)}
    for row, exact in zip(rows, h, strict=True):
        rays = rays_of(folder, row)
        gain = 10 ** (rays[:, 0] / 20) * np.exp(1j * np.radians(rays[:, 7]))
        sent, sent_azimuth, taken, taken_azimuth = np.radians(rays[:, 2:6]).T
        along_tx = np.sin(sent) * np.cos(sent_azimuth)
        along_rx = np.sin(taken) * np.cos(taken_azimuth - np.radians(rays[:, 8] + 90))
        at = np.exp(-1j * np.pi * np.outer(np.arange(32), along_tx))
        ar = np.exp(-1j * np.pi * np.outer(np.arange(8), along_rx))
        found = (ar.conj() * gain) @ at.T
        assert np.linalg.norm(found - exact) < 1e-4 * np.linalg.norm(exact)
        y, of_exact = (np.abs(dft[8].conj().T @ m @ dft[32]) for m in (found, exact))
        assert np.argmax(y) == np.argmax(of_exact)


def test_rows_and_arrays_are_laid_out_as_readers_expect(paired: Dataset, tmp_path: Path) -> None:
    folder = exported(paired, "compat", tmp_path / "out")
    rows = rows_of(folder)
    assert [(r["VehicleName"], r["Val"], r["z"]) for r in rows[:3]] == [
        ("flow0.0", "V", "3.2"),
        ("flow1.0", "V", "1.59"),
        ("flow2.0", "I", "1.59"),  # outside of the LIDAR's area
    ]
    with h5py.File(
        folder / "ray_tracing_data_s008_carrier60GHz/rosslyn_mobile_60GHz_ts0.1s_V_Lidar_e3.hdf5"
    ) as data:
        rays = data["allEpisodeData"]
        assert (rays.shape, rays.dtype) == ((1, 3, 25, 9), np.float32)
        assert np.isnan(rays[0, 2]).all()
        own = rays[0, 0][: int(rows[9]["rays"])]
        assert (np.isnan(own).sum(axis=1) == 1).all(), "one NaN marks a ray"
        assert np.isnan(own[:, 7]).all()
        assert (np.diff(own[:, 0]) <= 0).all()
        np.testing.assert_allclose([own[0, 8], rays[0, 1, 0, 8]], [0, 180], atol=1e-3)
    with np.load(folder / "lidar_data_s008/obstacles_e_0.npz") as data:
        cells = data["obstacles_matrix_array"]
    assert (cells.shape, cells.dtype) == ((3, 20, 200, 10), np.int8)
    x, y, z = np.argwhere(cells[0] == -1)[0] * [1.15, 1.25, 1] + [744, 429, 0]
    np.testing.assert_allclose([x, y, z], [746, 560, 4], atol=1.25)
    from PIL import Image

    with Image.open(folder / "image_data_s008/camera2/0.png") as picture:
        users = paired.episode(0)["camera"]
        assert (np.asarray(picture) == users.rgb[0, users.index(["ahead"])[0]]).all()


def test_baseline_is_ready_for_training(paired: Dataset, tmp_path: Path) -> None:
    folder = exported(paired, "baseline", tmp_path / "out") / "baseline_data"
    users = paired.users()
    kept = users[np.isin(users["object"], ["flow0.0", "flow1.0"])]
    assert (folder.parent / "raw_data" / "CoordVehiclesRxPerScene_s008.csv").exists()
    files = {
        "beam_output/beams_output_{}.npz": ("output_classification", (8, 32), np.complex128),
        "lidar_input/lidar_{}.npz": ("input", (20, 200, 10), np.int8),
        "coord_input/coord_{}.npz": ("coordinates", (2,), np.float64),
        "image_input/img_input_{}_20.npz": ("inputs", (48, 81, 1), np.uint8),
    }
    for name, (key, shape, kind) in files.items():
        for part, rows in (("train", 6), ("validation", 2)):
            with np.load(folder / name.format(part)) as data:
                assert (data[key].shape, data[key].dtype) == ((rows, *shape), kind)
    with (
        np.load(folder / "beam_output/beams_output_train.npz") as y,
        np.load(folder / "beam_output/best_pairs_train.npz") as best,
    ):
        rx, tx = np.unravel_index(y["output_classification"].real.reshape(6, -1).argmax(axis=1), (8, 32))
        assert (best["rx_times_32_plus_tx"] == rx * 32 + tx).all()
        assert (best["tx_times_8_plus_rx"] == tx * 8 + rx).all()
        # The challenge's RX beams count in the other direction of rotation than `Link.rx_beam`.
        assert (tx == kept["tx_beam"][:6]).all()
        assert ((8 - rx) % 8 == kept["rx_beam"][:6]).all()


def test_readme_of_the_baseline_names_the_arrays_that_are_there(
    paired: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cameras = [device for device in paired.settings["scenario"]["devices"] if device["kind"] != "camera"]
    monkeypatch.setitem(paired.settings["scenario"], "devices", cameras)
    folder = exported(paired, "baseline", tmp_path / "out")
    named = re.findall(r"baseline_data/(\S+)/\S*SPLIT", (folder / "README.md").read_text("utf-8"))
    assert set(named) == {file.name for file in (folder / "baseline_data").iterdir()}
    assert "lidar_input" in named


def test_database_has_the_rays_of_the_arrays(paired: Dataset, tmp_path: Path) -> None:
    folder = exported(paired, "full", tmp_path / "out")
    row = rows_of(folder)[1]
    query = """SELECT path_gain, time_of_arrival, departure_elevation, interactions FROM rays
        JOIN receivers ON receivers.id = receiver_id JOIN objects ON objects.id = object_id
        WHERE name = 'flow1.0' AND scene_id = 1 ORDER BY rays.id"""
    with sqlite3.connect(folder / "episodedata.db") as database:
        found = database.execute(query).fetchall()
    np.testing.assert_array_equal(np.array([r[:3] for r in found], np.float32), rays_of(folder, row)[:, :3])
    assert [len(r[3].split("-")) == 2 for r in found] == rays_of(folder, row)[:, 6].astype(bool).tolist()


def test_scans_without_a_grid_are_left_out(
    poses: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    services = poses.settings["scenario"]["services"]
    monkeypatch.setitem(services, "lidar", {"use": "lidar", "settings": {}})
    folder = exported(poses, "compat", tmp_path / "out")
    assert not (folder / "lidar_data_s008").exists()
    assert {row["Val"] for row in rows_of(folder)} == {"V"}


def test_a_dataset_that_the_baseline_cannot_hold_is_refused(poses: Dataset, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"scenes of an episode.* 50, .* 1"):
        exported(poses, "baseline", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_full_flavour_comes_back_as_it_went(paired: Dataset, tmp_path: Path) -> None:
    folder = exported(paired, "full", tmp_path / "out")
    back = Dataset(import_dataset(find_format("itu").read(folder), tmp_path / "back"))
    theirs, ours = back.users(), paired.users()
    ours = ours[np.isin(ours["object"], ["flow0.0", "flow1.0"])]
    assert theirs["rx"].tolist() == [name.partition("/")[0] for name in ours["rx"].tolist()]
    assert (theirs["los"] == ours["los"]).all()
    for name in ("x_m", "y_m", "gain_db", "delay_s"):
        np.testing.assert_allclose(theirs[name], ours[name], rtol=1e-5)
    for exact, found in zip(ours["channel.h"], theirs["channel.h"], strict=True):
        assert np.linalg.norm(found - exact) < 1e-3 * np.linalg.norm(exact)
    assert (theirs["tx_beam"] == ours["tx_beam"]).all()
    assert (theirs["rx_beam"] == ours["rx_beam"]).all()
    again = exported(back, "full", tmp_path / "again")
    heights = [row["z"] for row in rows_of(folder) if row["Val"] == "V"]
    assert [row["z"] for row in rows_of(again)] == heights, "receivers that stand have their own below them"
    for row in rows_of(folder):
        if row["Val"] == "V":
            np.testing.assert_allclose(rays_of(again, row), rays_of(folder, row), rtol=1e-4, atol=1e-2)


def test_an_episode_without_valid_receivers_keeps_its_number(whole: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(whole, tmp_path / "in")
    table = folder / "CoordVehiclesRxPerScene_s008.csv"
    table.write_text(table.read_text().replace("V,1,", "I,1,"))
    back = Dataset(import_dataset(find_format("itu").read(folder), tmp_path / "back"))
    assert back.episodes == (0, 1, 2, 3)
    assert np.unique(back.users()["episode"]).tolist() == [0, 2, 3]


def _first(folder: Path) -> Path:
    return folder / "ray_tracing_data_s008_carrier60GHz/rosslyn_mobile_60GHz_ts0.1s_V_Lidar_e0.hdf5"


def _in_rows(folder: Path, old: str, new: str) -> None:
    table = folder / "CoordVehiclesRxPerScene_s008.csv"
    text = table.read_text()
    assert old in text
    table.write_text(text.replace(old, new, 1))


def _in_rays(folder: Path, change: Callable[[Any], Any]) -> None:
    with h5py.File(_first(folder), "r+") as data:
        rays = change(data["allEpisodeData"][()])
        del data["allEpisodeData"]
        data["allEpisodeData"] = rays


def _in_words(folder: Path) -> None:
    with h5py.File(_first(folder).with_name(f"{_first(folder).stem}_interactions.hdf5"), "r+") as data:
        data["allInteractionsDescriptions"][0, 1, 0, 0] = (ord("X"), -1)


def _with(place: tuple[int, ...], value: float) -> Callable[[Any], Any]:
    def change(rays: Any) -> Any:
        rays[place] = value
        return rays

    return change


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "no table": (lambda f: (f / "CoordVehiclesRxPerScene_s008.csv").unlink(), "CoordVehiclesRxPerScene"),
    "empty table": (lambda f: (f / "CoordVehiclesRxPerScene_s008.csv").write_text(""), "line 1"),
    "header": (lambda f: _in_rows(f, "VehicleArrayID", "Vehicle"), "line 1.*VehicleArrayID"),
    "columns": (lambda f: _in_rows(f, "V,0,0,0,", "V,0,0,"), "line 2"),
    "number": (lambda f: _in_rows(f, "V,0,0,0,", "V,0,zero,0,"), "line 2.*zero"),
    "place": (lambda f: _in_rows(f, "V,0,0,1,flow1.0,760", "V,0,0,1,flow1.0,nan"), "line 3"),
    "validity": (lambda f: _in_rows(f, "V,0,0,0,", "W,0,0,0,"), "line 2"),
    "order": (lambda f: _in_rows(f, "V,0,0,1,", "V,0,0,0,"), "line 3"),
    "name twice": (lambda f: _in_rows(f, "1,flow1.0", "1,flow0.0"), "episode 0, scene 0.*flow0.0"),
    "encoding": (
        lambda f: (f / "CoordVehiclesRxPerScene_s008.csv").write_bytes(
            b"\xff\xfe" + "Val,Ä".encode("utf-16")
        ),
        "CoordVehiclesRxPerScene_s008.csv",
    ),
    "count": (lambda f: _in_rows(f, ",LOS=", "1,LOS="), r"e0.hdf5, allEpisodeData\[0, 0\]"),
    "line of sight": (lambda f: _in_rows(f, "LOS=1", "LOS=0"), r"e0.hdf5, allEpisodeData\[0, 0\]"),
    "receiver": (lambda f: _in_rows(f, "I,0,0,2,", "V,0,0,2,"), r"allEpisodeData\[0, 2\]"),
    "no rays": (lambda f: _first(f).unlink(), "_e0.hdf5"),
    "empty rays": (lambda f: _first(f).write_bytes(b""), "e0.hdf5"),
    "cut rays": (lambda f: _first(f).write_bytes(_first(f).read_bytes()[:3000]), "e0.hdf5"),
    "no array": (
        lambda f: (_first(f).unlink(), h5py.File(_first(f), "w").close()),
        "e0.hdf5.*allEpisodeData",
    ),
    "shape": (lambda f: _in_rays(f, lambda rays: rays[0]), r"e0.hdf5.*\(3, 25, 9\)"),
    "columns of rays": (lambda f: _in_rays(f, lambda rays: rays[..., :7]), r"\(1, 3, 25, 7\)"),
    "text": (lambda f: _in_rays(f, lambda rays: rays.astype("S9")), "e0.hdf5"),
    "delay": (lambda f: _in_rays(f, _with((0, 0, 0, 1), -1e-9)), r"\[0, 0\].*delay"),
    "zenith": (lambda f: _in_rays(f, _with((0, 1, 0, 2), 181.0)), r"\[0, 1\].*zenith"),
    "infinite": (lambda f: _in_rays(f, _with((0, 1, 0, 0), np.inf)), r"\[0, 1\]"),
    "padding": (lambda f: _in_rays(f, _with((0, 1, 0, 0), np.nan)), r"\[0, 1\]"),
    "word": (lambda f: _in_words(f), r"e0_interactions.hdf5, allInteractionsDescriptions\[0, 1, 0, 0\].*88"),
    "interactions": (
        lambda f: _first(f).with_name(f"{_first(f).stem}_interactions.hdf5").write_bytes(b"HDF"),
        "e0_interactions.hdf5",
    ),
}


@pytest.fixture(scope="module")
def whole(paired: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(paired, "full", tmp_path_factory.mktemp("whole") / "out")


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_files_are_named_and_nothing_is_written(whole: Path, tmp_path: Path, damage: str) -> None:
    folder = shutil.copytree(whole, tmp_path / "in")
    change, place = DAMAGES[damage]
    change(folder)
    with pytest.raises(RunError, match=place):
        import_dataset(find_format("itu").read(folder), tmp_path / "back")
    assert not list(tmp_path.glob("back*"))
