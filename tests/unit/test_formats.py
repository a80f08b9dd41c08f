"""Formats of other programs: conformance of each, and their numbers against those of the dataset."""

from __future__ import annotations

import csv
import json
import os
import re
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from mcap.reader import make_reader
from typer.testing import CliRunner

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeTask, play_episode
from caviar_clients.datasets.impulse_responses import placed_antennas
from caviar_clients.datasets.plan import plan_dataset
from caviar_clients.datasets.reader import Dataset
from caviar_clients.datasets.verification.verify import verify
from caviar_clients.envs.base import BeamSelectionEnv
from caviar_clients.envs.uav_path import UavPathEnv
from caviar_clients.learning.recorded import RecordedBeamsEnv
from caviar_clients.replay.plan import plan_replay, request_of, scenario_text
from caviar_clients.replay.recorded import RecordedRun
from caviar_formats.base import FORMATS, Format, export_users, find_format
from caviar_formats.cli import export_command, import_command
from caviar_formats.imports import ImportedScene, Paths, Source, import_dataset
from caviar_formats.ros2 import Ros2
from caviar_formats.runs import open_source
from caviar_formats.testing import FormatConformance
from caviar_formats.viewers import LOBE_M, ORIGIN, Moment, lobe
from caviar_protocol.digest import file_digest
from caviar_protocol.errors import CaviarError, RecordingError, RunError, ScenarioError, SetupError
from caviar_protocol.scenario import Carrier, load_scenario, parse_scenario
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.topics import AntennaArray, AntennaDevice
from caviar_view.world import World

pytestmark = pytest.mark.slow

EPISODES, SCENES = 2, 3
FREQUENCY_HZ = 28e9


def generated(out: Path, scenario: str | Path, episodes: int = EPISODES, scenes: int = SCENES) -> Dataset:
    """Generate a dataset in this process."""
    directory = DatasetDirectory(out)
    plan = plan_dataset(load_scenario(str(scenario)), episodes=episodes, scenes=scenes)
    with writing_dataset(directory):
        catalogue = Catalogue(directory.catalogue, writable=True)
        catalogue.plan(plan.settings(), episodes)
        for number in range(episodes):
            result = play_episode(EpisodeTask(plan.scenario, number, str(out)))
            assert result.rows is not None, result.error
            catalogue.add(result.rows, result.measured)
        catalogue.close()
    return Dataset(out)


SERVICES = """
[services.world]
role = "world"
use = "trajectory"
budget_ms = 20

[services.channel]
role = "channel"
use = "geometric"
budget_ms = 100

[services.channel.settings]
components = 5

[services.link]
role = "link"
use = "beams"
budget_ms = 20

[services.agent]
role = "agent"
use = "los-beam"
budget_ms = 20

[services.recorder]
role = "recorder"
use = "mcap"
budget_ms = 100
"""

SCENARIO = (
    SERVICES
    + """
[run]
name = "asymmetric"
frames = 3
sampling_period_ns = 100_000_000
record = ["scene", "channel", "channel.h", "channel.hf", "action", "link"]

[[carriers]]
name = "mm"
frequency_hz = 28e9
bandwidth_hz = 100e6
subcarriers = 8
subcarrier_spacing_hz = 1e6

[[services.world.settings.objects]]
name = "car"
kind = "car"
dimensions_m = [4.5, 1.8, 1.5]
waypoints = [[0.0, 20.0, 15.0, 0.75], [10.0, 80.0, -35.0, 2.75]]

[[devices]]
name = "bs"
kind = "antenna"
role = "tx"
position_m = [3.0, -40.0, 12.0]
yaw_deg = 70.0
pitch_deg = 10.0
roll_deg = 20.0
array = { rows = 2, columns = 4 }

[[devices]]
name = "rx"
kind = "antenna"
role = "rx"
on = "car"
position_m = [0.3, 0.2, 1.0]
yaw_deg = -35.0
array = { rows = 1, columns = 3 }
"""
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("formats")
    (place / "asymmetric.toml").write_text(SCENARIO)
    return generated(place / "data", place / "asymmetric.toml").directory.path


LIDAR = """
[services.lidar]
role = "sensors"
use = "lidar"
budget_ms = 1000

[services.camera]
role = "sensors"
use = "camera"
budget_ms = 1000

[[devices]]
name = "lidar"
kind = "lidar"
position_m = [16.0, 10.0, 3.0]
yaw_deg = 25.0
pitch_deg = 4.0
beams = 8
azimuth_steps = 180
"""

CAMERA_ON_CAR = """
[[devices]]
name = "eye"
kind = "camera"
on = "car"
position_m = [3.0, 0.0, 1.0]
yaw_deg = -20.0
size_px = [16, 12]
field_of_view_deg = 80.0
"""

CAMERA_BESIDE_THE_ROAD = """
[[devices]]
name = "camera"
kind = "camera"
position_m = [3.0, -40.0, 12.0]
yaw_deg = 45.0
pitch_deg = 15.0
size_px = [40, 32]
"""


def with_sensors(place: Path, camera: str) -> Dataset:
    text = SCENARIO.replace('record = ["scene"', 'record = ["lidar", "camera", "depth", "scene"')
    (place / "lidar.toml").write_text(text + LIDAR + camera)
    return generated(place / "data", place / "lidar.toml")


@pytest.fixture(scope="module")
def clouds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with a LIDAR, and a camera on the car."""
    return with_sensors(tmp_path_factory.mktemp("clouds"), CAMERA_ON_CAR).directory.path


@pytest.fixture(scope="module")
def roadside(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset with a LIDAR and a camera beside the road, of a world that knows its place on the Earth."""
    data = with_sensors(tmp_path_factory.mktemp("roadside"), CAMERA_BESIDE_THE_ROAD)
    (data.assets / "scenery").mkdir(parents=True)
    (data.assets / "scenery" / "town.json").write_text(
        '{"origin": {"latitude_deg": -33.4, "longitude_deg": -70.6}}'
    )
    return data.directory.path


@pytest.fixture
def data(folder: Path) -> Dataset:
    return Dataset(folder)


def exported(data: Dataset, name: str, out: Path, flavour: str = "") -> Path:
    export_users(data.users(), find_format(name, flavour), out / name)
    return out / name


SENSORS_OF = {
    "deepsense": "roadside",
    "foxglove": "clouds",
    "pcd": "clouds",
    "ros2": "clouds",
    "viwi": "roadside",
}


@pytest.mark.parametrize("name", FORMATS)
class TestConformance(FormatConformance):
    @pytest.fixture(autouse=True)
    def _name(self, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        try:
            found = find_format(name)
        except SetupError as error:
            pytest.skip(str(error))
        if found.write.__func__ is Format.write:  # type: ignore[attr-defined]
            pytest.skip("is imported alone")
        if name == "rerun":
            pytest.skip("Rerun numbers rows at random")
        monkeypatch.setattr(type(self), "name", name, raising=False)

    @pytest.fixture
    def dataset(self, name: str, data: Dataset, request: pytest.FixtureRequest) -> Dataset:
        return Dataset(request.getfixturevalue(SENSORS_OF[name])) if name in SENSORS_OF else data


def response(a: Any, tau: Any) -> Any:
    """H(f) of the eight subcarriers by its definition, Shape ``[8, Nr, Nt]``."""
    offsets = 1e6 * (np.arange(8) - 4)
    return np.einsum("mnp,kp->kmn", a, np.exp(-2j * np.pi * offsets[:, None] * tau))


def nmse_db(found: Any, right: Any) -> float:
    return float(20 * np.log10(np.linalg.norm(found - right) / np.linalg.norm(right)))


def test_npz_has_each_user_in_its_row(data: Dataset, tmp_path: Path) -> None:
    with np.load(exported(data, "npz", tmp_path) / "users-00000.npz") as rows:
        users = data.users()
        for name in (*users.recorded(), "x_m", "rx", "gain_db"):
            assert np.array_equal(rows[name], users[name], equal_nan=rows[name].dtype.kind in "fc"), name


@pytest.mark.parametrize(
    ("name", "files"),
    [
        ("npz", "users-*.npz"),
        ("sionna", "cir-*.npz"),
        ("parquet", "users/*.parquet"),
        ("huggingface", "users.parquet"),
    ],
)
def test_scenes_without_chosen_users_have_no_rows(
    name: str, files: str, data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import duckdb

    users = data.users()
    monkeypatch.setattr("caviar_formats.base.SCENES", 1)
    late = users[users["scene"] > 0]
    export_users(late, find_format(name), tmp_path / name)
    found = [
        duckdb.read_parquet(str(file)).fetchnumpy()["rx"]
        if file.suffix == ".parquet"
        else np.load(file)["rx"]
        for file in sorted((tmp_path / name).glob(files))
    ]
    assert np.concatenate(found).tolist() == late["rx"].tolist()


def test_impulse_responses_make_the_recorded_wideband_channel(data: Dataset, tmp_path: Path) -> None:
    users = data.users()
    cir = users.cir()
    assert (len(cir), cir.shape["num_tx_ant"], cir.shape["num_rx_ant"]) == (len(users), 8, 3)
    with np.load(exported(data, "sionna", tmp_path) / "cir-00000.npz") as rows:
        for at, (a, tau) in enumerate(cir()):
            right = users["channel.hf"][at, 0]
            assert nmse_db(response(a[0, :, 0, ..., 0], tau[0, 0]), right) < -100
            assert nmse_db(response(rows["a"][at, 0, :, 0, ..., 0], rows["tau"][at, 0, 0]), right) < -100


def test_sionna_phy_makes_the_recorded_wideband_channel_of_them(data: Dataset) -> None:
    channel = pytest.importorskip("sionna.phy.channel")
    torch = pytest.importorskip("torch")
    users = data.users()
    cir = users.cir()
    batch = channel.CIRDataset(cir, batch_size=len(cir), precision="double", **cir.shape)
    a, tau = batch(len(cir), 1, 1.0)
    offsets = torch.tensor(1e6 * (np.arange(8) - 4))
    found = channel.cir_to_ofdm_channel(offsets, a, tau).cpu().numpy()[:, 0, :, 0, :, 0]
    right = users["channel.hf"][:, 0].transpose(0, 2, 3, 1)
    best = [min(nmse_db(row, other) for other in right) for row in found]  # it draws users at random
    assert max(best) < -100


def test_parquet_has_each_user_in_its_row_and_units(data: Dataset, tmp_path: Path) -> None:
    import duckdb

    out, users = exported(data, "parquet", tmp_path), data.users()
    query = 'SELECT rx, x_m, "channel.tau" AS tau, "channel.h.imag" AS h, "channel.aod" AS aod FROM \'{}\''
    rows = duckdb.sql(query.format(out / "users" / "*.parquet")).fetchall()
    for at, (rx, x, tau, h, aod) in enumerate(rows):
        assert (rx, x) == (users["rx"][at], users["x_m"][at])
        assert np.array_equal(tau, users.rows(["channel.tau"])["channel.tau"][at])
        assert np.array_equal(h, users["channel.h"][at].imag.ravel())
        assert np.array_equal(np.reshape(aod, (-1, 2)), users.rows(["channel.aod"])["channel.aod"][at])
    notes = dict(
        duckdb.execute(
            "SELECT key, value FROM parquet_kv_metadata(?)", [str(out / "users/part-00000.parquet")]
        ).fetchall()
    )
    assert json.loads(notes[b"channel.tau"])["unit"] == "s"
    assert json.loads(notes[b"gain_db"])["unit"] == "dB"
    assert json.loads(notes[b"channel.h.real"])["shape"] == "[3, 8]"


def test_croissant_names_each_file_with_its_digest(data: Dataset, tmp_path: Path) -> None:
    out = exported(data, "huggingface", tmp_path)
    described = json.loads((out / "croissant.json").read_text())
    found = {file["contentUrl"]: file["sha256"] for file in described["distribution"]}
    assert found == {name: file_digest(out / name) for name in ("users.parquet", "scenes.parquet")}
    fields = {
        field["name"]: field["dataType"] for record in described["recordSet"] for field in record["field"]
    }
    assert (fields["users/rx"], fields["users/channel.tau"]) == ("sc:Text", "sc:Float")


def test_readers_of_hugging_face_and_croissant_open_the_folder(data: Dataset, tmp_path: Path) -> None:
    datasets, croissant = pytest.importorskip("datasets"), pytest.importorskip("mlcroissant")
    out, users = exported(data, "huggingface", tmp_path), data.users()
    table = datasets.load_dataset(str(out), "users", split="train", cache_dir=str(tmp_path / "cache"))
    assert table["channel.tau"][0] == users.rows(["channel.tau"])["channel.tau"][0].tolist()
    os.chdir(out)
    records = croissant.Dataset("croissant.json").records("users")
    assert [row["users/rx"].decode() for row in records] == users["rx"].tolist()


def test_a_run_is_exported_like_a_dataset(data: Dataset, tmp_path: Path) -> None:
    run = data.directory.episode(1)
    with open_source(str(run)) as found:
        assert np.array_equal(found.users()["channel.h"], data.select([1]).users()["channel.h"])
        assert found.cir().shape == data.cir().shape


def test_an_unknown_format_names_those_there_are() -> None:
    with pytest.raises(RunError, match="did you mean 'parquet'"):
        find_format("parkuet")


DEVICES = (
    AntennaDevice(
        name="bs", role="tx", position=(0.0, 0.0, 10.0), orientation=(0.8, 0.1, -0.3, 0.51),
        array=AntennaArray(rows=2, columns=4),
    ),
    AntennaDevice(name="u", role="rx", position=(30.0, 5.0, 1.5), array=AntennaArray(columns=3)),
)  # fmt: skip


def imported_scenes(gain: float = 1e-5) -> Iterator[ImportedScene]:
    """Two episodes of two scenes, of three paths each, that belong to no scene in particular."""
    for number in range(4):
        draw = np.random.default_rng(number)
        paths = Paths(
            tx="bs", rx="u", los=number % 2 == 0, a=gain * (draw.normal(size=(1, 3)) + 1j),
            tau=np.array([1.2e-7, 1.1e-7, 1.5e-7]), aod=draw.uniform(0.5, 2.0, (3, 2)),
            aoa=draw.uniform(0.5, 2.0, (3, 2)), interactions=np.array([[1, 0], [0, 0], [2, 1]], np.uint8),
        )  # fmt: skip
        yield ImportedScene(episode=number // 2, scene=number % 2, devices=DEVICES, paths=[paths])


def source_of(place: Path, scenes: Iterable[ImportedScene]) -> Source:
    carriers = (Carrier(name="mm", frequency_hz=FREQUENCY_HZ),)
    return Source(path=place, scenes=scenes, carriers=carriers, scenes_of_episode=2, lacks="no sensors")


def test_an_imported_dataset_is_one_that_everything_takes(tmp_path: Path) -> None:
    data = Dataset(import_dataset(source_of(tmp_path / "files", imported_scenes()), tmp_path / "data"))
    assert list(verify(data.directory.path)) == []
    users, right = data.users(), [scene.paths[0] for scene in imported_scenes()]
    assert users["los"].tolist() == [paths.los for paths in right]
    for at, paths in enumerate(right):
        assert np.allclose(users["channel.tau"][at], paths.tau[[1, 0, 2]])
        assert np.allclose(users["channel.a"][at], paths.a[0, [1, 0, 2]])
        a, _ = users[at : at + 1].cir().block(users[at : at + 1])
        assert nmse_db(a[0, ..., 0].sum(-1), users["channel.h"][at]) < -200
    assert (users["tx_beam"] >= 0).all()
    assert "channel" in data.episode(0).topics
    assert "camera" not in data.episode(0).topics
    assert data.episode(0).metadata.notes == ("no sensors",)
    recording = data.directory.episode(0)
    run = RecordedRun(data.episode(0))
    replay = plan_replay(run, request_of(run.scenario.services))
    assert parse_scenario(scenario_text(replay.scenario)).run.frames == 2
    training = RecordedBeamsEnv([recording], observe=("position",))
    training.reset(seed=1)
    info = training.step(training.action_space.sample())[-1]
    assert info["best_abs_y"] == pytest.approx(users["link.top_abs_y"][0, :1])


@pytest.mark.parametrize(
    ("scenes", "said"),
    [
        (lambda: iter(()), "no scene"),
        (lambda: islice(imported_scenes(), 3), r"episode 1 has scenes \[0\], and not 0 to 1"),
        (lambda: imported_scenes(float("nan")), "episode 0: .*channel"),
    ],
)
def test_an_import_that_fails_leaves_nothing(scenes: Any, said: str, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=said):
        import_dataset(source_of(tmp_path / "files", scenes()), tmp_path / "data")
    assert list(tmp_path.iterdir()) == []


# --- DeepMIMO -----------------------------------------------------------------------------------------------


def described_channels(folder: Path, shapes: Any, quaternions: Any) -> Any:
    """H by the description of DeepMIMO 4 alone (`channels_of`)."""
    end = "_t000_tx000_r001.npz"
    files = {file.name.removesuffix(end): np.load(file) for file in folder.glob(f"*{end}")}
    table = {name: file[name] for name, file in files.items() if name != "user"}
    return channels_of(table, shapes, quaternions)


def channels_of(table: dict[str, Any], shapes: Any, quaternions: Any) -> Any:
    """H of paths with phases at first elements, in our order of elements, Shape ``[N, Nr, Nt]``."""
    gain = np.nan_to_num(10 ** (table["power"] / 20) * np.exp(1j * np.radians(table["phase"])))
    out = []
    for user, amplitudes in enumerate(gain):
        responses = []
        for name, (columns, rows), q in zip(
            ("aoa", "aod"), shapes, (quaternions[0][user], quaternions[1][user]), strict=True
        ):
            theta, phi = np.nan_to_num(np.radians([table[f"{name}_el"][user], table[f"{name}_az"][user]]))
            w, x, y, z = q
            axes = np.array([
                [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
                [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
            ])  # fmt: skip
            along = axes @ [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
            places = [(c, rows - 1 - r) for c in range(columns) for r in range(rows)]
            responses.append(np.exp(1j * np.pi * np.array(places) @ along))
        out.append((responses[0] * amplitudes) @ responses[1].T)
    return np.array(out)


def test_a_reader_by_the_description_of_deepmimo_finds_h(data: Dataset, tmp_path: Path) -> None:
    users, folder = data.users(), exported(data, "deepmimo", tmp_path) / "data"
    poses = [[a.orientation for a in placed_antennas(users, end)] for end in ("rx", "tx")]
    assert nmse_db(described_channels(folder, ((3, 1), (4, 2)), poses), users["channel.h"]) < -100
    with np.load(folder / "inter_t000_tx000_r001.npz") as file:
        assert (file["inter"][:, 0] == 0).tolist() == users["los"].tolist()


@pytest.mark.parametrize("flavour", ["static", "dynamic"])
def test_deepmimo_itself_finds_h(flavour: str, data: Dataset, tmp_path: Path) -> None:
    dm = pytest.importorskip("deepmimo")
    users, out = data.users(), exported(data, "deepmimo", tmp_path, flavour)
    dm.config("scenarios_folder", str(out))
    loaded = (
        [dm.load("data")] if flavour == "static" else [s for e in range(2) for s in dm.load(f"data_e{e:06d}")]
    )
    row = 0
    for scene in loaded:
        here = users[row : row + scene.n_ue]
        row += scene.n_ue
        turns = [[euler_deg(a.orientation) for a in placed_antennas(here, end)] for end in ("tx", "rx")]
        parameters = dm.ChannelParameters(
            bs_antenna={"shape": [4, 2], "rotation": turns[0][0]},
            ue_antenna={"shape": [3, 1], "rotation": np.array(turns[1])},
            ofdm={"subcarriers": 512, "bandwidth": 512e6, "selected_subcarriers": np.arange(4)},
        )
        h = np.asarray(scene.compute_channels(parameters)) * np.sqrt(512)
        right = here["channel.hf"][:, 0, 4:].transpose(0, 2, 3, 1)
        order = [(i % 4) * 2 + 1 - i // 4 for i in range(8)]
        assert nmse_db(h, right[:, :, order]) < -60
        assert scene.los.astype(bool).tolist() == here["los"].tolist()


def euler_deg(q: Any) -> list[float]:
    """Roll, pitch and yaw of a quaternion [°]."""
    w, x, y, z = q
    roll, yaw = (
        np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )
    return [float(np.degrees(angle)) for angle in (roll, np.arcsin(2 * (w * y - z * x)), yaw)]


@pytest.mark.parametrize("flavour", ["static", "dynamic"])
def test_deepmimo_comes_back_within_single_precision(flavour: str, data: Dataset, tmp_path: Path) -> None:
    folder = exported(data, "deepmimo", tmp_path, flavour)
    scenario = folder / ("data" if flavour == "static" else "data_e000001")
    right = data.users() if flavour == "static" else data.select([1]).users()
    import_dataset(find_format("deepmimo").read(scenario), tmp_path / "back")
    found = Dataset(tmp_path / "back").users()
    assert len(found) == len(right)
    assert nmse_db(found["channel.h"], right["channel.h"]) < -100
    assert found["los"].tolist() == right["los"].tolist()
    for name in ("channel.tau", "channel.aod", "channel.aoa", "x_m", "gain_db"):
        assert np.allclose(
            np.sort(found[name], axis=None), np.sort(right[name], axis=None), rtol=1e-5, atol=1e-12
        ), name
    poses = [[a.orientation for a in placed_antennas(users, "rx")] for users in (found, right)]
    assert np.allclose(*poses)
    assert list(verify(tmp_path / "back")) == []


def test_episodes_of_one_scene_come_back_from_scenarios_of_deepmimo(folder: Path, tmp_path: Path) -> None:
    data = generated(tmp_path / "data", folder.parent / "asymmetric.toml", episodes=1, scenes=1)
    scenario = exported(data, "deepmimo", tmp_path, "dynamic") / "data_e000000"
    import_dataset(find_format("deepmimo").read(scenario), tmp_path / "back")
    assert nmse_db(Dataset(tmp_path / "back").users()["channel.h"], data.users()["channel.h"]) < -100


def broken(content: bytes, how: str) -> bytes:
    """Damage a file."""
    return {
        "empty": b"",
        "cut": content[: len(content) // 2],
        "text": b"not of this format",
        "flipped": content[::-1],
    }[how]


@pytest.mark.parametrize("how", ["empty", "cut", "text", "flipped"])
@pytest.mark.parametrize(
    "file",
    [
        "params.json",
        *(f"{name}_t000_tx000_r001.npz" for name in ("power", "aod_el", "rx_pos", "inter", "tx_pos")),
    ],
)
def test_a_damaged_scenario_of_deepmimo_is_named(file: str, how: str, folder: Path, tmp_path: Path) -> None:
    scenario = exported(Dataset(folder), "deepmimo", tmp_path) / "data"
    (scenario / file).write_bytes(broken((scenario / file).read_bytes(), how))
    with pytest.raises(RunError, match=file):
        import_dataset(find_format("deepmimo").read(scenario), tmp_path / "back")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deepmimo"]


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("power", lambda table: table[:, :2]),
        ("delay", lambda table: table[:3]),
        ("phase", lambda table: table * np.nan),
        ("rx_pos", lambda table: table[:, :2]),
        ("power", lambda table: table.astype(np.complex64)),
        ("power", lambda table: np.where(np.arange(table.shape[1]) == 0, np.nan, table)),
        ("aoa_az", lambda table: np.where(np.isfinite(table), 1e30, table)),
        ("delay", lambda table: -table),
    ],
)
def test_wrong_arrays_of_deepmimo_are_named(name: str, change: Any, folder: Path, tmp_path: Path) -> None:
    scenario = exported(Dataset(folder), "deepmimo", tmp_path) / "data"
    file = scenario / f"{name}_t000_tx000_r001.npz"
    table = np.load(file)[name]
    np.savez(file, **{name: change(table)})
    with pytest.raises(RunError, match=r"_t000_tx000_r001.npz"):
        import_dataset(find_format("deepmimo").read(scenario), tmp_path / "back")


# --- DeepSense ----------------------------------------------------------------------------------------------


def circle(azimuths_deg: Any) -> Iterator[ImportedScene]:
    """A receiver on a circle around an array that looks to the north-north-west, seen on a straight path."""
    turn = np.radians(110.0)
    tx = AntennaDevice(
        name="bs", role="tx", position=(5.0, 3.0, 1.5), array=AntennaArray(rows=2, columns=32),
        orientation=(np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)), power_dbm=10.0,
    )  # fmt: skip
    for number, azimuth in enumerate(azimuths_deg):
        phi = turn + np.radians(azimuth)
        place = (5.0 + 80 * np.cos(phi), 3.0 + 80 * np.sin(phi), 1.5)
        rx = AntennaDevice(name="u", role="rx", position=place, array=AntennaArray(columns=2))
        paths = Paths(
            tx="bs", rx="u", los=True, a=np.array([[1e-4j]]), tau=np.array([80 / 299792458]),
            aod=np.array([[np.pi / 2, phi]]), aoa=np.array([[np.pi / 2, phi + np.pi]]),
            interactions=np.zeros((1, 1), np.uint8),
        )  # fmt: skip
        yield ImportedScene(episode=number // 2, scene=number % 2, devices=(tx, rx), paths=[paths])


def test_beams_of_deepsense_turn_counter_clockwise(tmp_path: Path) -> None:
    pytest.importorskip("pyproj")
    azimuths = np.arange(-44.0, 45.0, 4.0)[:-1]
    data = Dataset(import_dataset(source_of(tmp_path / "files", circle(azimuths)), tmp_path / "data"))
    form = find_format("deepsense")
    with pytest.raises(RunError, match="--origin"):
        export_users(data.users(), form, tmp_path / "out")
    form.origin = (38.8907, -77.0787)
    export_users(data.users(), form, tmp_path / "out")
    with (tmp_path / "out" / "scenario00.csv").open() as file:
        rows = list(csv.DictReader(file))
    found = {name: [row[name] for row in rows] for name in rows[0]}
    assert list(found) == [
        "index", "unit1_pwr_60ghz", "unit1_loc", "unit2_loc", "unit1_beam", "seq_index", "time_stamp[UTC]",
    ]  # fmt: skip
    assert found["index"] == [str(1 + at) for at in range(22)]
    assert found["seq_index"] == [str(1 + at // 2) for at in range(22)]
    assert found["time_stamp[UTC]"][1].startswith("['00-00-0")
    arrays = {name: np.array([np.loadtxt(tmp_path / "out" / path) for path in found[name]])
              for name in ("unit1_pwr_60ghz", "unit1_loc", "unit2_loc")}  # fmt: skip
    beams = np.array(found["unit1_beam"], int)
    assert (arrays["unit1_pwr_60ghz"].argmax(axis=1) == beams - 1).all()
    assert np.abs((beams - 1) * 90 / 63 - 45 - azimuths).max() < 0.5 * 90 / 63 + 1e-6
    # |a|² of 10 mW by a gain of 64; a path between two beams has less.
    assert arrays["unit1_pwr_60ghz"].max() == pytest.approx(1e-8 * 10 * 64, rel=0.01)
    # On the sphere that osculates WGS84 there, within 1 cm of 80 m.
    sine2 = np.sin(np.radians(38.8907)) ** 2
    prime = 6378137.0 / np.sqrt(1 - 6.69437999014e-3 * sine2)
    meridian = prime * (1 - 6.69437999014e-3) / (1 - 6.69437999014e-3 * sine2)
    north, east = np.radians(arrays["unit2_loc"] - arrays["unit1_loc"]).T
    turn = np.radians(110.0 + azimuths)
    assert np.allclose(north * meridian, 80 * np.sin(turn), atol=0.01)
    assert np.allclose(east * prime * np.cos(np.radians(38.8907)), 80 * np.cos(turn), atol=0.01)


def test_samples_of_deepsense_have_what_sensors_beside_the_road_saw(roadside: Path, tmp_path: Path) -> None:
    from PIL import Image

    pytest.importorskip("pyproj")
    data = Dataset(roadside)
    out = exported(data, "deepsense", tmp_path)
    with (out / "scenario00.csv").open() as file:
        row = list(csv.DictReader(file))[4]
    recording = data.episode(1)
    assert np.array_equal(np.asarray(Image.open(out / row["unit1_rgb"])), recording["camera"].rgb[1, 0])
    header, _, points = (out / row["unit1_lidar"]).read_bytes().partition(b"end_header\n")
    hits = recording["lidar"].hits[1, 0]
    assert f"element vertex {hits}\n".encode() in header
    right = recording["lidar"].points[1, 0, :hits]
    assert np.array_equal(np.frombuffer(points, "<f4").reshape(-1, 3), right)
    latitude, longitude = np.loadtxt(out / row["unit1_loc"])
    assert (latitude, longitude) == pytest.approx((-33.4 - 40 / 110.9e3, -70.6 + 3 / 93.1e3), abs=1e-6)


# --- Minari -------------------------------------------------------------------------------------------------


def equal(found: Any, right: Any) -> bool:
    """Compare trees of arrays bit by bit."""
    if isinstance(right, dict):
        return set(found) == set(right) and all(equal(found[name], right[name]) for name in right)
    return np.asarray(found[()]).dtype == right.dtype and np.asarray(found[()]).tobytes() == right.tobytes()


def stacked(steps: list[Any]) -> Any:
    """Steps as a tree of arrays."""
    if isinstance(steps[0], dict):
        return {name: stacked([step[name] for step in steps]) for name in steps[0]}
    return np.array(steps)


OBSERVED = ("aoa", "aod", "departure", "position", "velocity", "last_abs_y", "last_rate", "last_beam")


def played(env: Any, episodes: int, **options: Any) -> list[dict[str, Any]]:
    """Play episodes of random actions, and keep what an environment gives."""
    found = []
    env.action_space.seed(3)
    for _ in range(episodes):
        observation, _ = env.reset(**options)
        steps = []
        while not steps or not steps[-1][-1]:
            action = env.action_space.sample()
            before = observation
            observation, reward, over, cut, _ = env.step(action)
            steps.append((before, action, reward, over, cut))
        columns = [*zip(*steps, strict=True)]
        names = ("observations", "actions", "rewards", "terminations", "truncations")
        found.append(dict(zip(names, (stacked([*column]) for column in columns), strict=True)))
        found[-1]["observations"] = stacked([*columns[0], observation])
    env.close()
    return found


def minari_file(run: Path, out: Path, flavour: str = "") -> Path:
    """Export a run; the folder of the one dataset in it."""
    with open_source(str(run)) as data:
        (folder,) = (path for path in exported(data, "minari", out, flavour).iterdir() if path.is_dir())
    return folder


def test_minari_has_what_the_environment_gave(folder: Path, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    scenario = folder.parent / "asymmetric.toml"
    env = BeamSelectionEnv(scenario, observe=OBSERVED, reward="normalised", directory=tmp_path / "run")
    right = played(env, 2)
    out = minari_file(tmp_path / "run", tmp_path, "normalised")
    with h5py.File(out / "data" / "main_data.hdf5") as file:
        assert list(file) == ["episode_0", "episode_1"]
        for number, episode in enumerate(right):
            group = file[f"episode_{number}"]
            assert all(equal(group[name], values) for name, values in episode.items())
            assert (group.attrs["id"], group.attrs["total_steps"]) == (number, SCENES)
    about = json.loads((out / "data" / "metadata.json").read_text())
    assert (about["total_episodes"], about["total_steps"], about["jpeg_encoding"]) == (2, 2 * SCENES, False)


def test_minari_itself_finds_what_the_environment_gave(
    roadside: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    minari = pytest.importorskip("minari")
    scenario = roadside.parent / "lidar.toml"
    observe = (*OBSERVED, "camera:camera", "depth:camera")
    env = BeamSelectionEnv(scenario, observe=observe, directory=tmp_path / "run")
    right = played(env, 2)
    out = minari_file(tmp_path / "run", tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(out.parent))
    data = minari.load_dataset(out.name)
    assert data.observation_space == env.observation_space
    assert data.action_space == env.action_space
    assert (data.total_episodes, data.total_steps) == (2, 2 * SCENES)
    for found, episode in zip(data, right, strict=True):
        assert all(equal(getattr(found, name), values) for name, values in episode.items())
        assert found.observations["aod"][0] in env.observation_space["aod"]


def test_minari_needs_decisions(roadside: Path, tmp_path: Path) -> None:
    data = Dataset(import_dataset(source_of(tmp_path / "files", imported_scenes()), tmp_path / "data"))
    with pytest.raises(RunError, match="no agent"):
        exported(data, "minari", tmp_path)
    with pytest.raises(ScenarioError, match="which sends none"):
        exported(Dataset(roadside), "minari", tmp_path, "delay")


def test_flights_in_minari_are_velocities(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    shipped = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "uav-path.toml"
    head, _, tail = shipped.read_text().partition("[services.channel.settings]")
    text = (head + tail[tail.index("[services.link]") :]).replace('"sionna-rt"', '"free-space"')
    text = text.replace("frames = 60", "frames = 6", 1)
    scenario = tmp_path / "flight.toml"
    scenario.write_text("\n".join(line for line in text.splitlines() if not line.startswith("scenery")))
    env = UavPathEnv(scenario, directory=tmp_path / "run")
    right = played(env, 1, seed=5)[0]
    out = minari_file(tmp_path / "run", tmp_path)
    with h5py.File(out / "data" / "main_data.hdf5") as file:
        group = file["episode_0"]
        velocity = group["actions/velocity"][:, 0]
        share = right["actions"].astype(np.float64)
        speed = env._max_speed / np.maximum(1.0, np.linalg.norm(share, axis=1, keepdims=True))
        assert np.allclose(velocity, share * speed)
        assert len(group["rewards"]) == len(right["rewards"])


# --- ViWi ---------------------------------------------------------------------------------------------------


def test_readers_of_viwi_find_channels_places_and_pictures(
    roadside: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from PIL import Image

    from caviar_formats import viwi

    h5py = pytest.importorskip("h5py")
    monkeypatch.setattr(viwi, "LENGTH", SCENES)
    data = Dataset(roadside)
    users, out = data.users(), exported(data, "viwi", tmp_path)
    with h5py.File(out / "raw_data.mat") as file:
        struct = file[list(file)[1]]
        channel, loc = (struct[name][:] for name in struct)
    found = channel.view(np.double).reshape(*channel.shape, 2) @ [1, 1j]
    assert found.shape == (1, len(users), 8, 8)  # transmitters, users, subcarriers, elements
    right = users["channel.hf"][:, 0, :, 0]
    order = [2 * y + 1 - z for z in range(2) for y in range(4)]  # of columns from +z to −z
    assert np.array_equal(found[0], right[..., order])
    assert np.array_equal(loc, np.stack([users[f"{axis}_m"] for axis in "xyz"], axis=1))
    for picture in (out / "rgb").iterdir():
        _, number, x, y = picture.stem.split("_")
        at = int(np.abs(loc[:, :2] - [float(x), float(y)]).sum(axis=1).argmin())
        rgb = data.episode(users["episode"][at])["camera"].rgb[users["scene"][at], 0]
        assert (number, np.asarray(Image.open(picture)).tolist()) == ("1", rgb.tolist())
    turns = [np.exp(-2j * np.pi * np.outer(np.arange(n), np.arange(n)) / n) for n in (2, 4)]
    best = 1 + (np.abs(found[0] @ np.kron(*turns).conj()) ** 2).sum(axis=1).argmax(axis=1)
    with (out / "beams.csv").open() as table:
        rows = list(csv.reader(table))[1:]
    assert [[int(beam) for beam in row[:SCENES]] for row in rows] == best.reshape(-1, SCENES).tolist()
    assert all((out / name).is_file() for row in rows for name in row[SCENES:] if name)


# --- Wireless InSite ----------------------------------------------------------------------------------------

P2M = """# Receiver Set: three points
     3
     1    2
 -80.0   0.1E-06   0.1E-07
    1   0   -81.0  {phase}0.1667820E-06    90.0   180.0    90.0     0.0
Tx-Rx
 0.1000000E+02   0.2000000E+02   0.5000000E+01
 0.6000000E+02   0.2000000E+02   0.5000000E+01
    2   1   -90.0  {phase}0.1886919E-06    90.0   152.0725    90.0     27.9275
Tx-d-Rx
 0.1000000E+02   0.2000000E+02   0.5000000E+01
 0.3500000E+02   0.3325000E+02   0.5000000E+01
 0.6000000E+02   0.2000000E+02   0.5000000E+01
     2    0
     3    1
 -95.0   0.1E-06   0.1E-07
    1   1   -95.0  {phase}0.1886919E-06    90.0   207.9275    90.0   -27.9275
Tx-R-Rx
 0.1000000E+02   0.2000000E+02   0.5000000E+01
 0.3500000E+02   0.0675000E+02   0.5000000E+01
 0.6000000E+02   0.2000000E+02   0.5000000E+01
"""


def insite(path: Path) -> Source:
    """Open files of paths at 60 GHz."""
    form = find_format("p2m")
    form.frequency_hz = 60e9
    return form.read(path)


def p2m(folder: Path, text: str) -> Path:
    """Write a file of paths."""
    file = folder / "street.paths.t001_05.r006.p2m"
    file.write_text(text, encoding="latin-1")
    return file


@pytest.mark.parametrize(("phase", "of_first"), [("", None), ("  -33.0  ", -33.0)])
def test_paths_of_wireless_insite_become_users_and_npz(
    phase: str, of_first: float | None, tmp_path: Path
) -> None:
    source = insite(p2m(tmp_path, P2M.format(phase=phase)))
    # λ / 4πd of 50 m at 60 GHz is −101.98 dB.
    assert "from t001_05 to r006-00001 is +20.99 dB from free space at 60 GHz" in source.assumed
    data = Dataset(import_dataset(source, tmp_path / "data"))
    assert list(verify(tmp_path / "data")) == []
    with np.load(exported(data, "npz", tmp_path) / "users-00000.npz") as users:
        assert users["rx"].tolist() == ["r006-00001", "r006-00003"], "a receiver without paths has no place"
        assert users["los"].tolist() == [True, False]
        assert np.allclose(20 * np.log10(np.abs(users["channel.a"][0])), [-81.0, -90.0])
        right = -2 * np.pi * 60e9 * 0.1667820e-6 if of_first is None else np.radians(of_first)
        assert np.allclose(users["channel.a"][0, 0] / abs(users["channel.a"][0, 0]), np.exp(1j * right))
        assert np.allclose(np.degrees(users["channel.aoa"][0]), [[90.0, 180.0], [90.0, 152.0725]])
        assert np.allclose(np.degrees(users["channel.aod"][1, 0]), [90.0, -27.9275])
        assert users["channel.interactions"][0].tolist() == [[0], [2]]
        assert users["channel.points"][1, 0].tolist() == [[35.0, 6.75, 5.0]]
        assert (users["x_m"][1], users["y_m"][1]) == (60.0, 20.0)


@pytest.mark.parametrize(
    ("before", "after", "line"),
    [
        ("     3\n", "", 2),
        ("     3\n", "     2\n", 15),
        ("     3\n", "     4\n", 22),
        ("     3\n", "  three\n", 2),
        ("     3\n", "     3.5\n", 2),
        ("     3\n", "     -3\n", 2),
        ("     1    2\n", "     1    1\n", 9),
        ("     1    2\n", "     1    3\n", 14),
        ("     1    2\n", "     1\n", 3),
        (" -80.0   0.1E-06   0.1E-07\n", "", 4),
        ("Tx-d-Rx", "Tx-X-Rx", 10),
        ("Tx-d-Rx", "Tx-d", 10),
        ("Tx-d-Rx\n", "", 10),
        ("Tx-d-Rx", "Tx-d-d-Rx", 14),
        ("   -81.0 ", "   81.0 ", 8),
        ("   -81.0 ", "   nan ", 5),
        ("   -81.0 ", "   -81.0 12.0 13.0 ", 5),
        ("0.1667820E-06    90.0   180.0", "90.0   180.0   0.1667820E-06", 8),
        ("0.1667820E-06    90.0", "0.1667820E-06    190.0", 8),
        ("0.1667820E-06", "0.1867820E-06", 8),
        ("0.3325000E+02", "0,3325000E+02", 12),
        ("0.3325000E+02", "0.3325000É+02", 0),
        (" 0.6000000E+02   0.2000000E+02   0.5000000E+01\n     2", "     2", 13),
    ],
)
def test_damaged_files_of_wireless_insite_are_named_with_the_line(
    before: str, after: str, line: int, tmp_path: Path
) -> None:
    text = P2M.format(phase="")
    assert before in text
    file = p2m(tmp_path, text.replace(before, after, 1))
    with pytest.raises(RunError, match=rf"r006.p2m, line {line}:" if line else "r006.p2m: is no file"):
        import_dataset(insite(file), tmp_path / "data")
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("content", ["", "\0" * 4096, "# only a comment\n", "1 2 3 4\n" * 9])
def test_files_that_are_none_of_wireless_insite_are_refused(content: str, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"r006.p2m, line"):
        insite(p2m(tmp_path, content))


def test_files_of_wireless_insite_need_a_frequency(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="give --frequency-hz"):
        find_format("p2m").read(p2m(tmp_path, P2M.format(phase="")))


def test_a_real_file_of_wireless_insite(shared_data: Path, tmp_path: Path) -> None:
    import_dataset(insite(shared_data / "insite-paths"), tmp_path / "data")
    users = Dataset(tmp_path / "data").users()
    assert (len(users), int(users["paths"].sum())) == (15, 375)
    assert list(verify(tmp_path / "data")) == []


# --- traces and clouds --------------------------------------------------------------------------------------


def test_a_reader_by_the_description_of_qd_traces_finds_h(data: Dataset, tmp_path: Path) -> None:
    out, users = exported(data, "ns3-qd", tmp_path) / "episode-000001", data.select([1]).users()
    settings = dict(line.split("\t") for line in (out / "Input/paraCfgCurrent.txt").read_text().splitlines())
    frequency = float(settings["carrierFrequency"])
    assert (settings["numberOfTimeDivisions"], settings["totalTimeDuration"]) == ("3", "0.3")
    lines = iter((out / "Output/Ns3/QdFiles/Tx0Rx1.txt").read_text().splitlines())
    places = np.loadtxt(out / "Output/Ns3/NodesPosition/NodesPosition.csv", delimiter=",")
    assert np.allclose(places[0], [3.0, -40.0, 12.0])
    assert (out / "nodes.txt").read_text().split() == ["bs", "car/rx"]
    for scene in range(3):
        count = int(next(lines))
        tau, gain, phase, *degrees = (np.array(next(lines).split(","), float) for _ in range(7))
        assert len(tau) == count
        assert np.allclose(tau, users.rows(["channel.tau"])["channel.tau"][scene])
        table = {
            "power": gain[None], "phase": np.degrees(phase - 2 * np.pi * frequency * tau)[None],
            **{name: degrees[at][None] for at, name in enumerate(("aod_el", "aod_az", "aoa_el", "aoa_az"))},
        }  # fmt: skip
        poses = [
            [a.orientation for a in placed_antennas(users[scene : scene + 1], end)] for end in ("rx", "tx")
        ]
        found = channels_of(table, ((3, 1), (4, 2)), poses)
        assert nmse_db(found[0], users["channel.h"][scene]) < -150
    assert next(lines, None) is None


def test_clouds_of_points_are_where_the_lidar_saw_them(clouds: Path, tmp_path: Path) -> None:
    data = Dataset(clouds)
    out = exported(data, "pcd", tmp_path) / "000001"
    assert len(list(out.iterdir())) == SCENES
    for scene in range(SCENES):
        head, _, body = (out / f"{scene:06d}-lidar.pcd").read_bytes().partition(b"DATA binary\n")
        header = dict(line.split(" ", 1) for line in head.decode().splitlines()[1:])
        cloud = np.frombuffer(body, "<f4").reshape(int(header["POINTS"]), 4)
        x, y, z, *q = map(float, header["VIEWPOINT"].split())
        right = data.episode(1)["lidar"].select(frames=[scene])
        assert len(cloud) == right.hits[0, 0] > 0
        turned = cloud[:, :3].astype(float) @ rotation_matrix(q).T + [x, y, z]
        assert np.allclose(turned, right.points_world[0, 0], atol=1e-4)
        assert np.allclose(np.linalg.norm(cloud[:, :3], axis=1), cloud[:, 3], atol=1e-4)


# --- viewers ------------------------------------------------------------------------------------------------


def foxglove_messages(file: Path) -> dict[str, list[tuple[int, Any]]]:
    """Messages by topic, each with its time [ns], of which every schema is one of Foxglove's own."""
    descriptors = pytest.importorskip("google.protobuf.descriptor_pb2")
    pools = pytest.importorskip("google.protobuf.descriptor_pool")
    factory = pytest.importorskip("google.protobuf.message_factory")
    own = pytest.importorskip("foxglove.messages")
    found: dict[str, list[tuple[int, Any]]] = {}
    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.message_encoding == "json":
                content = json.loads(message.data)
            else:
                kind = getattr(own, schema.name.removeprefix("foxglove."))
                assert schema.data == kind.get_schema().data
                pool = pools.DescriptorPool()
                for part in descriptors.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(part)
                cls = factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
                content = cls.FromString(message.data)
            found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


def xyz(place: Any) -> tuple[float, float, float]:
    return place.x, place.y, place.z


def drawn_paths(data: Dataset, scene: int) -> int:
    """Lines of paths of the model `geometric`: one of the straight path, two ticks of any other."""
    channel = data.episode(1)["channel"][data.episode(1).place(1, scene)]
    assert channel is not None
    return int(channel.los.sum() + 2 * (len(channel.tau) - channel.los.sum()))


def test_a_reader_of_foxglove_finds_what_was_recorded(clouds: Path, tmp_path: Path) -> None:
    pytest.importorskip("foxglove")
    data = Dataset(clouds)
    found = foxglove_messages(exported(data, "foxglove", tmp_path) / "episode-000001.mcap")
    recording = data.episode(1)
    assert [t for t, _ in found["/objects"]] == [0, 100_000_000, 200_000_000]
    assert len(found["/scenery"]) == 1
    for scene in range(SCENES):
        frame = recording.frame(1, scene)
        world = frame.scene()
        assert world is not None
        (car,) = found["/objects"][scene][1].entities
        assert car.id == "car"
        assert xyz(car.cubes[0].pose.position) == tuple(world.position[0])
        assert xyz(car.cubes[0].size) == (4.5, 1.8, 1.5)
        poses = {t.child_frame_id: t for t in found["/tf"][scene][1].transforms}
        assert set(poses) == {"car", "bs", "car/rx", "lidar", "car/eye", "car/eye_optical"}
        assert poses["car/rx"].parent_frame_id == "car"
        assert xyz(poses["car/rx"].translation) == (0.3, 0.2, 1.0)
        assert len(found["/rays"][scene][1].entities) == drawn_paths(data, scene)
        scan = recording["lidar"].select(frames=[scene])
        cloud = found["/lidar/lidar"][scene][1]
        rows = np.frombuffer(cloud.data, "<f4").reshape(-1, 4)
        assert np.array_equal(rows[:, :3], scan.points[0, 0])
        assert xyz(cloud.pose.position) == (16.0, 10.0, 3.0)
        camera = recording["camera"].select(frames=[scene])
        image = found["/camera/car/eye/image"][scene][1]
        assert (image.width, image.height, image.encoding) == (16, 12, "rgb8")
        assert image.data == camera.rgb[0, 0].tobytes()
        link = recording["link"].select(frames=[scene])
        user = found["/users/car/rx/bs/mm"][scene][1]
        assert user["snr_db"] == pytest.approx(10 * np.log10(link.snr[0, 0]))
        assert user["tx_beam"] == link.tx_beam[0, 0]
    # Straight ahead of the camera is z of its optical axes.
    optical = poses["car/eye_optical"]
    turned = optical.rotation
    ahead = rotation_matrix((turned.w, turned.x, turned.y, turned.z))[:, 2]
    assert np.allclose(ahead, rotation_matrix(camera.orientation[0, 0].tolist())[:, 0])
    calibration = found["/camera/car/eye/calibration"][0][1]
    assert calibration.K[0] == pytest.approx(8 / np.tan(np.radians(40)))
    assert calibration.K[2] == 7.5


def test_beams_of_viewers_point_where_the_codebook_does() -> None:
    # Row 0 and column 2 of the DFT: u_z is 0, and u_y is 2 / (16 · 0.5).
    surface = lobe(AntennaArray(rows=2, columns=16), 4)
    far = surface.vertices[np.linalg.norm(surface.vertices, axis=1).argmax()]
    assert np.linalg.norm(far) == pytest.approx(LOBE_M)
    assert far[1:] == pytest.approx([0.25 * LOBE_M, 0.0], abs=0.025 * LOBE_M)


def test_a_reader_of_ros_finds_what_was_recorded(clouds: Path, tmp_path: Path) -> None:
    highlevel = pytest.importorskip("rosbags.highlevel")
    data = Dataset(clouds)
    recording, scenes = data.episode(1), range(SCENES)
    found: dict[str, list[Any]] = {}
    with highlevel.AnyReader([exported(data, "ros2", tmp_path) / "episode-000001"]) as bag:
        for connection, time, content in bag.messages():
            message = bag.deserialize(content, connection.msgtype)
            found.setdefault(connection.topic, []).append((time, message))
    assert {topic: len(messages) for topic, messages in found.items() if "users" not in topic} == {
        "/scenery": 1, "/tf": 3, "/objects": 3, "/objects/car/pose": 3, "/rays": 3,
        "/lidar/lidar/points": 3, "/camera/car/eye/image": 3, "/camera/car/eye/depth": 3,
        "/camera/car/eye/camera_info": 3,
    }  # fmt: skip
    places = np.array([xyz(pose.pose.position) for _, pose in found["/objects/car/pose"]])
    assert np.array_equal(places, recording["scene"].position[:, 0])
    for scene in scenes:
        stamp = found["/tf"][scene][1].transforms[0].header.stamp
        assert (stamp.sec, stamp.nanosec) == (0, scene * 100_000_000)
        assert found["/tf"][scene][0] == scene * 100_000_000
        cloud = found["/lidar/lidar/points"][scene][1]
        rows = np.frombuffer(cloud.data.tobytes(), "<f4").reshape(cloud.width, 4)
        assert np.array_equal(rows[:, :3], recording["lidar"].select(frames=[scene]).points_world[0, 0])
        assert len(found["/rays"][scene][1].markers) == 1 + drawn_paths(data, scene)
        image = found["/camera/car/eye/image"][scene][1]
        right = recording["camera"].select(frames=[scene]).rgb[0, 0]
        assert np.array_equal(image.data.reshape(image.height, image.width, 3), right)
        depth = found["/camera/car/eye/depth"][scene][1]
        assert np.array_equal(
            np.frombuffer(depth.data.tobytes(), "<f4").reshape(12, 16),
            recording["depth"].select(frames=[scene]).depth[0, 0],
        )
    snr = [message.data for _, message in found["/users/car/rx/bs/mm/snr_db"]]
    assert np.allclose(snr, 10 * np.log10(recording["link"].snr[:, 0]))


def test_names_that_are_one_topic_of_ros_are_refused(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    cars = [(name, "car", ORIGIN, [4.0, 2.0, 1.5]) for name in ("car.1", "car_1")]
    now = Moment(t_ns=0, objects=cars, mounts=[], rays=[], beams=[], users={}, scans=[], images=[])
    with pytest.raises(RunError, match="two names are the topic '/objects/car_1/pose'"):
        Ros2().write_episode(tmp_path / "bag", World({}, {}), iter([now]))


@pytest.mark.parametrize("name", ["foxglove", "minari", "pcd", "rerun", "ros2"])
def test_formats_of_all_users_refuse_a_choice(name: str, clouds: Path, tmp_path: Path) -> None:
    try:
        form = find_format(name)
    except SetupError as error:
        pytest.skip(str(error))
    with pytest.raises(RunError, match="leave --carrier"):
        export_users(Dataset(clouds).users()[:2], form, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_an_export_refuses_a_folder_that_another_writes(data: Dataset, tmp_path: Path) -> None:
    out, refused = tmp_path / "npz", list[str]()

    def again(*_: int) -> None:
        for name in ("npz", "parquet"):
            with pytest.raises(RunError, match=r"another export writes .*npz now") as error:
                exported_to(out, name)
            refused.append(str(error.value))

    def exported_to(out: Path, name: str, on_part: Any = lambda *_: None) -> None:
        export_users(data.users(), find_format(name), out, on_part)

    exported_to(out, "npz", again)
    assert len(refused) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["npz"]
    assert sorted(path.name for path in out.iterdir()) == ["README.md", "users-00000.npz"]


def test_an_import_refuses_a_folder_that_another_writes(tmp_path: Path) -> None:
    file, out, refused = p2m(tmp_path, P2M.format(phase="")), tmp_path / "data", list[str]()

    def again(_: int) -> None:
        with pytest.raises(RunError, match="another process writes the dataset") as error:
            import_dataset(insite(file), out)
        refused.append(str(error.value))

    import_dataset(insite(file), out, again)
    assert (len(refused), list(verify(out))) == (1, [])
    assert not out.with_name("data.part").exists()


def test_an_export_of_a_run_names_the_run(folder: Path) -> None:
    run = str(next((folder / "episodes").iterdir()))
    text = f"^{re.escape(run)} has no users of carrier 'low'"
    with pytest.raises(RecordingError, match=text), open_source(run) as data:
        data.users(carrier="low")
    runs = folder.parent / "runs"
    runs.mkdir()
    for name in ("a", "b"):
        (runs / name).symlink_to(run)
    text = r"is no run, it holds 2: give one of them, as .*runs/a"
    with pytest.raises(RecordingError, match=text), open_source(str(runs)):
        pass


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["export", "DATA", "--to", "npz", "--origin", "1,2"], "--origin: npz has no places on the Earth"),
        (["export", "DATA", "--to", "npz", "--out", "DATA/npz"], "is in DATA, which is read"),
        (["export", "DATA", "--to", "matlab"], "known: deepmimo, deepsense,"),
        (["export", "DATA", "--to", "p2m"], "imported from p2m, not exported"),
        (["export", "DATA", "--to", "npz", "--object-class", "tram"], "known: car"),
        (["import", "nosuch", "--from", "p2m"], "nosuch: there is no such file or folder"),
        (["import", "DATA", "--from", "npz"], "exported to npz, not imported"),
        (["import", "DATA", "--from", "matlab"], "known: deepmimo, itu, p2m"),
    ],
)
def test_refusals_of_the_commands(arguments: list[str], text: str, folder: Path, tmp_path: Path) -> None:
    words = [word.replace("DATA", str(folder)) for word in arguments]
    if "--out" not in words:
        words += ["--out", str(tmp_path / "out")]
    function, name = (export_command, "export") if words[0] == "export" else (import_command, "import")
    app = typer.Typer()
    app.command(name)(function)
    error = CliRunner().invoke(app, words[1:]).exception
    assert isinstance(error, CaviarError)
    assert text.replace("DATA", str(folder)) in str(error)
    assert list(tmp_path.iterdir()) == []


def test_scenes_without_users_are_exported_where_a_format_needs_none(
    clouds: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    users = Dataset(clouds).users()[:0]
    monkeypatch.setattr(users.dataset, "users", lambda: users)
    export_users(users, find_format("pcd"), tmp_path / "pcd")
    assert len(list((tmp_path / "pcd").rglob("*.pcd"))) == EPISODES * SCENES
    with pytest.raises(RunError, match="no such users"):
        export_users(users, find_format("npz"), tmp_path / "npz")


def test_an_export_without_its_topic_says_what_to_record(data: Dataset, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r'without lidar\.points: write "lidar" into `record`'):
        exported(data, "pcd", tmp_path)
    assert list(tmp_path.iterdir()) == []


# --- the page -----------------------------------------------------------------------------------------------


def test_the_ten_lines_of_the_page_make_a_link_in_sionna_phy(
    folder: Path, tmp_path: Path, repository: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("sionna.phy")
    page = (repository / "docs" / "howto" / "formats.md").read_text(encoding="utf-8")
    code = page.partition("```py\nimport caviar\n")[2].partition("```")[0]
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "s008").symlink_to(folder)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec("import caviar\n" + code, names)  # noqa: S102 - the page's
    assert names["y"].shape == (64, 1, 3, 14, 64)
    assert names["h"].shape == (64, 1, 3, 1, 8, 14, 64)
