"""One setting in this process: which scene it sees, what is lost of it, and what it costs."""

from __future__ import annotations

import dataclasses
import mmap
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from link_builders import CARRIER, antenna, scene_of
from msgspec.structs import replace

from caviar_clients.session.scenes import Instant, Scenes
from caviar_labs.tradeoff.errors import FLOOR_DB, UserChannel, difference, differences, error_fields
from caviar_labs.tradeoff.ladder import REFERENCES, SCATTERING, Setting
from caviar_labs.tradeoff.report import _reference, comparable
from caviar_labs.tradeoff.worker import Rung, peak_mib, reset_peak, scattering_materials, seen
from caviar_protocol.errors import ScenarioError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import AntennaArray
from caviar_space.meshes import unit_box
from caviar_space.mitsuba_xml import RadioMaterial, scenery_files


def scenes() -> Scenes:
    scene = scene_of(
        antenna("bs", "tx", (1, 8), (0.0, 0.0, 10.0), power_dbm=30.0),
        antenna("near", "rx", (2, 2), (30.0, 4.0, 1.0), yaw=3.0),
        antenna("far", "rx", (2, 2), (300.0, -40.0, 1.0), yaw=3.0),
    )
    return Scenes(
        name="two",
        origin="made by hand",
        instants=(Instant(5, 500, scene),),
        carriers=(CARRIER,),
        devices=(),
        assets={},
        services={},
        seed=1,
        sampling_period_ns=100,
    )


def test_a_setting_may_see_few_receivers() -> None:
    scene = scenes().instants[0].scene
    assert seen(scene, None, None) is scene
    assert [device.name for device in antennas(seen(scene, 1, None), "rx")] == ["far"]
    assert [device.name for device in antennas(seen(scene, 1, None), "tx")] == ["bs"]


def test_a_setting_may_have_arrays_of_its_own() -> None:
    changed = seen(scenes().instants[0].scene, None, (64, 2))
    sizes = {device.name: (device.array.rows, device.array.columns) for device in antennas(changed, "rx")}
    assert sizes == {"near": (1, 2), "far": (1, 2)}
    assert antennas(changed, "tx")[0].array.columns == 64


def test_every_material_scatters_unless_the_scenario_says_which(tmp_path: Path) -> None:
    materials = {
        "mat-brick": RadioMaterial("brick"),
        "glass": RadioMaterial(constants=(6.0, 0.1)),
        "leaves": RadioMaterial(colour=(0.0, 0.3, 0.0)),  # for cameras: waves do not meet it
    }
    shapes = {f"piece-{name}": (unit_box(), name) for name in materials}
    assets = {name: tmp_path / name for name in scenery_files("street", shapes, materials)}
    for name, content in scenery_files("street", shapes, materials).items():
        assets[name].parent.mkdir(parents=True, exist_ok=True)
        assets[name].write_bytes(content)
    given = {"glass": {"thickness_m": 0.1}}
    assert scattering_materials(given, assets) == {
        "brick": {"scattering_coefficient": SCATTERING},
        "glass": {"thickness_m": 0.1, "scattering_coefficient": SCATTERING},
    }
    own = {"glass": {"scattering_coefficient": 0.2}}
    assert scattering_materials(own, assets) == own


def test_a_sample_has_the_users_of_the_scene() -> None:
    rung = Rung(Setting(label="f", use="free-space"), scenes(), None)
    sample = rung.sample(scenes().instants[0])
    rung.close()
    assert (sample.rung, sample.receivers, sample.paths, sample.lost_paths) == ("free-space", 2, 2, False)
    assert set(sample.users) == {(5, "bs", "near", "mmwave"), (5, "bs", "far", "mmwave")}
    near, far = (sample.users[5, "bs", name, "mmwave"] for name in ("near", "far"))
    distance = [np.linalg.norm([30, 4, 9]), np.linalg.norm([300, 40, 9])]
    # Friis: the difference of gains is that of the squared distances.
    assert near.path_gain_db - far.path_gain_db == pytest.approx(20 * np.log10(distance[1] / distance[0]))
    assert near.capacity_bps_hz > far.capacity_bps_hz > 0


def test_patterns_of_files_reach_channels_that_know_no_scenery(tmp_path: Path) -> None:
    """Elements that radiate 10 dB less everywhere bring 10 dB less."""
    name, file = "patterns/weak.csv", tmp_path / "weak.csv"
    rows = [f"{theta},{phi},-10" for theta in (0, 90, 180) for phi in (0, 180)]
    file.write_text("\n".join(["theta_deg,phi_deg,gain_dbi", *rows]))
    plain = scenes()
    devices = tuple(
        replace(device, array=replace(device.array, pattern_file=name)) if device.name == "bs" else device
        for device in antennas(plain.instants[0].scene, "tx") + antennas(plain.instants[0].scene, "rx")
    )
    weak = Instant(5, 500, replace(plain.instants[0].scene, devices=devices))
    spec = DeviceSpec(name="bs", kind="antenna", role="tx", array=AntennaArray(pattern_file="weak.csv"))
    given = dataclasses.replace(plain, instants=(weak,), devices=(spec,), assets={name: file})
    gains = []
    for at in (plain, given):
        rung = Rung(Setting(label="f", use="free-space"), at, None)
        gains.append(rung.sample(at.instants[0]).users[5, "bs", "near", "mmwave"].path_gain_db)
        rung.close()
    assert gains[1] - gains[0] == pytest.approx(-10)


def test_free_space_is_no_reference_where_there_is_scenery(tmp_path: Path) -> None:
    traced, free = Setting(label="t", use="sionna-rt"), Setting(label="f", use="free-space")
    with_scenery = dataclasses.replace(scenes(), assets={"scenery/a.xml": tmp_path / "a.xml"})
    assert comparable([traced, free], with_scenery) == [traced]
    assert comparable([traced, free], scenes()) == [traced, free]
    assert comparable([free], with_scenery) == [free]


def test_a_setting_that_the_channel_does_not_know_is_refused() -> None:
    with pytest.raises(ScenarioError, match="unknown key 'rays'"):
        Rung(Setting(label="f", use="free-space", settings={"rays": 3}), scenes(), None)


def test_the_peak_of_memory_is_seen_and_forgotten() -> None:
    if reset_peak() is None:
        pytest.skip("this system does not tell the peak of resident memory")
    before = reset_peak()
    # Pages of its own: an array might be given what an earlier test had and the allocator kept.
    with mmap.mmap(-1, 40 * 2**20) as block:
        for _ in range(40):
            block.write(bytes([1]) * 2**20)
    peak = peak_mib()
    assert before is not None
    assert peak is not None
    assert 35 < peak - before < 60
    assert reset_peak() is not None
    assert (peak_mib() or 0.0) - before < 20


def channel(scale: float, ranked: list[int], los: bool = True) -> UserChannel:
    h = scale * np.array([[1.0, 1j], [2.0, 0.5]])
    return UserChannel(
        los=los,
        path_gain_db=20 * float(np.log10(scale)),
        delay_spread_s=scale * 1e-9,
        angular_spread_rad=np.array([0.0, scale, 0.0, 0.0]),
        h=h,
        capacity_bps_hz=scale,
        abs_y=scale * np.array([[0.5, 1.0], [0.25, 0.125]]),
        ranked=ranked,
    )


NOTHING = UserChannel(los=False)


def test_a_users_channel_is_compared_with_the_references() -> None:
    found = difference(channel(1.5, [0, 1, 2, 3]), channel(1.0, [1, 0, 2, 3]))
    assert found.nmse == pytest.approx(0.25)
    assert found.path_gain_db == pytest.approx(20 * np.log10(1.5))
    assert found.delay_spread_s == pytest.approx(0.5e-9)
    assert found.capacity_bps_hz == pytest.approx(0.5)
    assert (found.top1, found.top5, found.los_agrees) == (False, True, True)
    assert found.pair_loss_db == pytest.approx(20 * np.log10(2))


def test_a_path_on_one_side_alone_is_counted_and_no_gain_is_made_up() -> None:
    missed = difference(NOTHING, channel(1.0, [1, 0, 2, 3]))
    assert (missed.missed, missed.invented, missed.nmse, missed.path_gain_db) == (True, False, 1.0, None)
    assert (missed.top1, missed.top5, missed.capacity_bps_hz) == (False, False, -1.0)
    invented = difference(channel(1.0, [1, 0, 2, 3]), NOTHING)
    assert (invented.missed, invented.invented, invented.nmse, invented.top1) == (False, True, None, None)
    assert not invented.los_agrees


def test_rows_are_means_over_the_users_that_both_know() -> None:
    key, other, third = ((0, "bs", name, "c") for name in ("a", "b", "c"))
    reference = {key: channel(1.0, [1, 0]), other: channel(1.0, [1, 0])}
    found = {key: channel(1.1, [1, 0]), other: channel(0.7, [0, 1]), third: channel(1.0, [1, 0])}
    fields = error_fields(differences(found, reference))
    assert fields["users"] == 2
    assert fields["nmse_db"] == pytest.approx(10 * np.log10((0.01 + 0.09) / 2))
    assert fields["capacity_error_bps_hz"] == pytest.approx(0.2)
    assert fields["capacity_bias_bps_hz"] == pytest.approx(-0.1)
    assert fields["delay_spread_error_ns"] == pytest.approx(0.2)
    assert fields["aod_azimuth_spread_error_deg"] == pytest.approx(np.degrees(0.2))
    assert (fields["beam_top1"], fields["beam_top5"]) == (0.5, 1.0)
    same = error_fields(differences(reference, reference))
    assert (same["nmse_db"], same["path_gain_error_db"]) == (FLOOR_DB, 0.0)
    assert error_fields([])["nmse_db"] is None


def test_what_was_measured_is_compared_with_the_finest_of_it() -> None:
    measured = [
        SimpleNamespace(setting=SimpleNamespace(label=name)) for name in ("geometric", "siso-rt 1e5 d3")
    ]
    assert _reference([*REFERENCES, "geometric"], measured) is measured[1]  # type: ignore[arg-type]
    assert _reference([*REFERENCES, "geometric"], measured[:1]) is measured[0]  # type: ignore[arg-type]
