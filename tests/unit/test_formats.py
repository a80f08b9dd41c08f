"""Formats of other programs: conformance of each, and their numbers against those of the dataset."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeTask, play_episode
from caviar_clients.datasets.plan import plan_dataset
from caviar_clients.datasets.reader import Dataset
from caviar_formats.base import FORMATS, Format, export_users, find_format
from caviar_formats.runs import open_source
from caviar_formats.testing import FormatConformance
from caviar_protocol.digest import file_digest
from caviar_protocol.errors import RunError
from caviar_protocol.scenario import load_scenario

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


SCENARIO = """
[run]
name = "asymmetric"
frames = 3
sampling_period_ns = 100_000_000
record = ["scene", "channel", "channel.h", "channel.hf", "link"]

[[carriers]]
name = "mm"
frequency_hz = 28e9
bandwidth_hz = 100e6
subcarriers = 8
subcarrier_spacing_hz = 1e6

[services.world]
role = "world"
use = "trajectory"
budget_ms = 20

[[services.world.settings.objects]]
name = "car"
kind = "car"
dimensions_m = [4.5, 1.8, 1.5]
waypoints = [[0.0, 20.0, 15.0, 0.75], [10.0, 80.0, -35.0, 2.75]]

[services.channel]
role = "channel"
use = "geometric"
budget_ms = 100

[services.channel.settings]
components = 4

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

[[devices]]
name = "bs"
kind = "antenna"
role = "tx"
position_m = [3.0, -40.0, 12.0]
yaw_deg = 70.0
pitch_deg = 10.0
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


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("formats")
    (place / "asymmetric.toml").write_text(SCENARIO)
    return generated(place / "data", place / "asymmetric.toml").directory.path


@pytest.fixture
def data(folder: Path) -> Dataset:
    return Dataset(folder)


def exported(data: Dataset, name: str, out: Path, flavour: str = "") -> Path:
    export_users(data.users(), find_format(name, flavour), out / name)
    return out / name


@pytest.mark.parametrize("name", FORMATS)
class TestConformance(FormatConformance):
    @pytest.fixture(autouse=True)
    def _name(self, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
        if find_format(name).write.__func__ is Format.write:  # type: ignore[attr-defined]
            pytest.skip("is imported alone")
        monkeypatch.setattr(type(self), "name", name, raising=False)

    @pytest.fixture
    def dataset(self, data: Dataset) -> Dataset:
        return data


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
