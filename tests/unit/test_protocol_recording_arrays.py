"""Topics of a recording as arrays: shapes, names, what is missing, and mistakes of the reader."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from recording_builders import (
    absent,
    channel,
    frame,
    lidar,
    link,
    product,
    record,
    recorder,
    scene,
    with_packets,
)

from caviar_protocol.errors import ProductError, RecordingError, SetupError
from caviar_protocol.messages import Status
from caviar_protocol.recording import Recording
from caviar_protocol.recording.arrays import TopicArrays
from caviar_protocol.recording.scene import DeviceArrays, MotionArrays
from caviar_protocol.recording.topics import TOPIC_ARRAYS, User
from caviar_protocol.topics import (
    Action,
    BeamChoice,
    Carrier,
    Channel,
    ChannelMatrix,
    ChannelResponse,
    ChannelTaps,
    Depth,
    DepthImage,
    Intrinsics,
    Link,
    Scene,
    Segmentation,
    SegmentationImage,
    WaypointCommand,
)
from caviar_protocol.validation import ContentRules, ProductCheck
from caviar_services.service import FrameInput

pytestmark = pytest.mark.slow


@pytest.fixture
def street(tmp_path: Path) -> Path:
    """Two episodes of three frames, a segment each two; a third car joins in frame 2 of both."""
    frames = []
    for episode in range(2):
        for number in range(3):
            cars = 3 if number == 2 else 2
            frames.append(
                frame(
                    number,
                    product("channel", "rt", with_h(channel(number, cars)), number),
                    product("link", "link", link(number, cars, without_path=(1,)), number),
                    product("scene", "world", scene(number, cars), number),
                    episode=episode,
                )
            )
    return record(tmp_path / "run", frames, segment_frames=2)


def with_h(paths: Channel, two_carriers: bool = False) -> Channel:
    """With H[m, n] = (carrier + 1)·(receiver + 1)·(m + 2n) + j; the second receiver has two elements."""
    carriers = (Carrier(name="wide", frequency_hz=28e9), Carrier(name="low", frequency_hz=3e9))
    carriers = carriers if two_carriers else carriers[:1]
    matrices = []
    for c in range(len(carriers)):
        for r in range(len(paths.rx)):
            m, n = np.meshgrid(np.arange(2 if r == 1 else 1), np.arange(4), indexing="ij")
            matrices.append(ChannelMatrix(carrier=c, tx=0, rx=r, h=(c + 1) * (r + 1) * (m + 2 * n) + 1j))
    per_carrier = {name: np.repeat(getattr(paths, name), len(carriers), axis=0) for name in ("a", "doppler")}
    return msgspec.structs.replace(paths, carriers=carriers, h=tuple(matrices), **per_carrier)


def test_h_has_a_row_for_each_user_and_nan_where_one_is_not_there(street: Path) -> None:
    rays = Recording(street)["channel"]
    assert rays.users == tuple(User("bs", f"car.{k}/rx", "wide") for k in range(3))
    assert (rays.episode.tolist(), rays.frame.tolist()) == ([0, 0, 0, 1, 1, 1], [0, 1, 2, 0, 1, 2])
    np.testing.assert_allclose(rays.t, [0, 0.1, 0.2, 0, 0.1, 0.2])
    h = rays.h
    assert (h.shape, h.dtype) == ((6, 3, 2, 4), np.complex128)
    np.testing.assert_array_equal(h[2, 2, 0], 3 * 2 * np.arange(4) + 1j)
    np.testing.assert_array_equal(h[4, 1], 2 * (np.arange(2)[:, None] + 2 * np.arange(4)) + 1j)
    assert np.isnan(h[0, 2]).all()
    assert np.isnan(h[2, 0, 1]).all(), "the first receiver has one element"
    assert rays.present.tolist() == 2 * [[True, True, False], [True, True, False], [True, True, True]]


def test_paths_are_cut_by_user_and_padded_to_the_most(street: Path) -> None:
    rays, plain = Recording(street)["channel"], channel(2, 3)
    assert rays.paths.tolist() == 2 * [[2, 0, -1], [2, 0, -1], [2, 2, 0]]
    assert (rays.tau.shape, rays.aod.shape, rays.points.shape) == ((6, 3, 2), (6, 3, 2, 2), (6, 3, 2, 1, 3))
    np.testing.assert_array_equal(rays.tau[2, :2].ravel(), plain.tau)
    np.testing.assert_array_equal(rays.a[2, :2].ravel(), plain.a[0])
    np.testing.assert_array_equal(rays.points[2, 1], plain.points[2:4])
    assert np.isnan(rays.tau[0, 1:]).all()
    assert rays.los[0].tolist() == [True, False, False]
    assert rays.rung == ("siso-rt",) * 6
    assert np.isnan(rays.expected_error_db).all()


def test_wideband_parts_are_there_for_carriers_that_have_them(tmp_path: Path) -> None:
    """hf and taps of the first carrier; the second has no subcarriers and no taps."""
    rays = with_h(channel(0, 2), two_carriers=True)
    wide = msgspec.structs.replace(
        rays.carriers[0], subcarriers=3, subcarrier_spacing_hz=1e6, taps=2, slots=2, slot_duration_s=1e-3
    )
    h = np.arange(2 * 3 * 4).reshape(2, 3, 1, 4).astype(np.complex64)
    rays = msgspec.structs.replace(
        rays,
        carriers=(wide, rays.carriers[1]),
        hf=tuple(ChannelResponse(carrier=0, tx=0, rx=r, h=(r + 1) * h) for r in range(2)),
        taps=tuple(ChannelTaps(carrier=0, tx=0, rx=r, first=7 - r, h=(r + 1j) * h[:, :2]) for r in range(2)),
    )
    record(tmp_path, [frame(0, product("channel", "rt", rays, 0))])
    read = Recording(tmp_path)["channel"]
    assert (read.hf.shape, read.hf.dtype) == ((1, 4, 2, 3, 1, 4), np.complex64)
    np.testing.assert_array_equal(read.select(carrier="wide").hf[0, 1], 2 * h)
    assert np.isnan(read.select(carrier=("wide", "low")).hf[0, 2:]).all()
    np.testing.assert_array_equal(read.taps[0, 1], (1 + 1j) * h[:, :2])
    assert read.first_tap.tolist() == [[7, 6, 0, 0]]


def test_a_wideband_part_that_was_not_recorded_is_asked_for_by_name(street: Path, tmp_path: Path) -> None:
    """Where no carrier could have it, `record` alone would not bring it."""
    rays = Recording(street)["channel"]
    with pytest.raises(RecordingError, match="write subcarriers = "):
        rays.hf  # noqa: B018
    with pytest.raises(RecordingError, match=r"write taps = .*\[\[carr"):
        rays.first_tap  # noqa: B018
    assert "h: narrowband gain" in repr(rays)
    assert f"Here {rays.h.shape}" in repr(rays)
    made, change = channel(0, 2), msgspec.structs.replace
    wide = change(made, carriers=tuple(change(one, subcarriers=4, taps=2) for one in made.carriers))
    record(tmp_path / "wide", [frame(0, product("channel", "rt", wide, 0))])
    for name in ("hf", "taps"):
        with pytest.raises(RecordingError, match=rf"without channel\.{name}: write it into `record`"):
            getattr(Recording(tmp_path / "wide")["channel"], name)


def test_several_carriers_are_users_of_their_own(tmp_path: Path) -> None:
    record(tmp_path, [frame(0, product("channel", "rt", with_h(channel(0, 2), two_carriers=True), 0))])
    rays = Recording(tmp_path)["channel"]
    assert rays.carrier == ("wide", "wide", "low", "low")
    assert rays.rx == ("car.0/rx", "car.1/rx") * 2
    assert rays.carriers["low"].frequency_hz == 3e9
    low = rays.select(carrier="low")
    np.testing.assert_array_equal(low.h[0, 1], 4 * (np.arange(2)[:, None] + 2 * np.arange(4)) + 1j)
    assert low.tx == ("bs", "bs")


def test_link_has_the_users_of_the_channel_and_all_its_fields(street: Path) -> None:
    recording = Recording(street)
    links = recording["link"]
    assert links.users == tuple(User("bs", f"car.{k}/rx", "c0") for k in range(3))
    assert links.tx_beam.tolist()[1] == [3, 3, -1]
    assert links.abs_y[2].tolist() == [2.1, 0.0, 2.1]
    assert np.isnan(links.abs_y[0, 2])
    assert links.top_abs_y.shape == (6, 3, 1)
    assert np.isnan(links.buffered).all()
    fields = {name for name in Link.__struct_fields__ if name not in ("tx", "rx", "carrier", "no_path")}
    assert set(links.columns) == fields


def test_a_link_with_packets_has_them_and_nan_where_a_user_is_not_there(tmp_path: Path) -> None:
    """Beside a frame of a link without, as of a run from before protocol 1.5."""
    links = [with_packets(link(0, 2)), with_packets(link(1, 3)), link(2, 3)]
    record(tmp_path, [frame(n, product("link", "link", found, n)) for n, found in enumerate(links)])
    read = Recording(tmp_path)["link"]
    np.testing.assert_array_equal(read.sent[:2], [[0, 1000, np.nan], [0, 1000, 2000]])
    assert np.isnan(read.sent[2]).all()
    assert read.block_errors[1].tolist() == [0, 0, 1]
    balance = read.arrived - read.sent - read.dropped - read.buffered
    assert balance[1].tolist() == [0, 0, 0]


def test_objects_and_devices_are_rows_by_name(street: Path) -> None:
    objects = Recording(street)["scene"]
    assert objects.names == ("car.0", "car.1", "car.2")
    assert objects.classes == ("car",) * 3
    np.testing.assert_array_equal(objects.position[2], scene(2, 3).position)
    assert np.isnan(objects.velocity[0, 2]).all()
    devices = objects.devices
    assert devices.names == ("bs", "car.0/rx", "car.0/top", "car.1/rx", "car.2/rx")
    assert devices.antennas("tx") == ("bs",)
    receivers = devices.position[:, devices.index(["car.1/rx", "bs"])]
    np.testing.assert_allclose(receivers[1, 0], scene(1).position[1] + [0, 0, 1])
    np.testing.assert_allclose(receivers[1, 1], [0, 20, 15])
    np.testing.assert_allclose(
        devices.velocity[0, devices.index(["car.0/rx", "bs"])], [[10, 1, 0], [0, 0, 0]]
    )


def test_the_scenes_of_several_worlds_are_one(tmp_path: Path) -> None:
    uav = msgspec.structs.replace(scene(0, 1), names=("uav",), devices=())
    record(
        tmp_path,
        [
            frame(0, product("scene", "air", uav, 0), product("scene", "road", scene(0, 1), 0)),
            frame(1, absent("scene", "air", "air died"), product("scene", "road", scene(1, 1), 1)),
        ],
    )
    both = Recording(tmp_path)["scene"]
    assert both.names == ("car.0", "uav")
    assert both.present.tolist() == [[True, True], [True, False]]
    assert both.status.tolist() == ["fresh", "absent"]
    assert both.cause == ("", "air died")
    assert Recording(tmp_path)["scene", "air"].names == ("uav",)


def test_held_and_absent_products_have_a_status_and_an_age(tmp_path: Path) -> None:
    late = product("link", "link", link(0), 0, Status.LATE, used_in=2)
    record(
        tmp_path,
        [
            frame(0, absent("link", "link", "the first is late")),
            frame(1, product("link", "link", link(1), 1)),
            frame(2, late, product("link", "link", link(1), 1, Status.HELD, used_in=2)),
        ],
    )
    links = Recording(tmp_path)["link"]
    assert links.status.tolist() == ["absent", "fresh", "held"]
    assert links.age.tolist() == [-1, 0, 1]
    assert np.isnan(links.abs_y[0]).all()
    np.testing.assert_array_equal(links.abs_y[2], link(1).abs_y)
    assert links[links.fresh].frame.tolist() == [1]
    assert links[0] is None
    assert links[2] == link(1)


def test_views_cover_what_is_asked_for(street: Path) -> None:
    rays = Recording(street)["channel"]
    assert rays[:2].users == rays.users[:2], "a view has the users of its own frames"
    assert rays[:2].like(rays).h.shape == (2, 3, 2, 4)
    assert rays[[2, 5]].episode.tolist() == [0, 1]
    assert rays[rays.frame == 1].frame.tolist() == [1, 1]
    assert rays[[]].h.shape == (0, 0, 0, 0)
    assert isinstance(rays[-1], Channel)
    chosen = rays.select(episode=1, frames=[0, 2], rx="car.1/rx")
    assert (chosen.frame.tolist(), chosen.rx, chosen.h.shape) == ([0, 2], ("car.1/rx",), (2, 1, 2, 4))
    assert chosen[1:].rx == ("car.1/rx",)
    parts = list(rays.blocks(4))
    assert [len(part) for part in parts] == [4, 2]
    np.testing.assert_array_equal(np.concatenate([part.h for part in parts]), rays.h)
    assert [part[1:].users for part in parts] == [rays.users] * 2
    with pytest.raises(ValueError, match="at least 1 frame, got 0"):
        next(rays.blocks(0))


def test_a_slice_reads_its_own_frames_alone(street: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = Recording(street)
    read: list[int] = []
    original = Recording.recorded_product
    monkeypatch.setattr(
        Recording, "recorded_product", lambda self, at, item: (read.append(at), original(self, at, item))[1]
    )
    rays = recording["channel"]
    assert len(rays[2:4].status) == 2
    assert not read
    assert rays[2:4].h.shape == (2, 3, 2, 4)
    assert set(read) == {2, 3}


def test_a_segment_is_read_alone(street: Path) -> None:
    rays = Recording(street / "recording-0001.mcap")["channel"]
    assert list(zip(rays.episode.tolist(), rays.frame.tolist(), strict=True)) == [(0, 2), (1, 0)]
    assert rays.h.shape == (2, 3, 2, 4)


def test_a_held_product_of_another_segment_says_what_to_open(tmp_path: Path) -> None:
    fresh = [product("link", "link", link(number), number) for number in range(4)]
    held = product("link", "link", link(1), 1, Status.HELD, used_in=2)
    inputs = [*fresh[:2], held, fresh[3]]
    record(tmp_path, [frame(number, item) for number, item in enumerate(inputs)], segment_frames=2)
    links = Recording(tmp_path / "recording-0001.mcap")["link"]
    assert links.status.tolist() == ["held", "fresh"]
    np.testing.assert_array_equal(links[1:].abs_y, [link(3).abs_y])
    with pytest.raises(RecordingError, match=rf"of frame 1, are not in .*0001\.mcap; open {tmp_path}"):
        links.abs_y  # noqa: B018  # it is read here


def test_a_damaged_product_is_named_and_those_beside_it_are_read(street: Path) -> None:
    file = street / "recording-0000.mcap"
    stored = next(p for p in Recording(street).frame(0, 1).products if p.provenance.topic == "link")
    data = bytearray(file.read_bytes())
    data[data.index(bytes(stored.body)) + 5] ^= 1
    file.write_bytes(data)
    recording = Recording(street)
    assert recording["channel"].h.shape == (6, 3, 2, 4)
    assert recording["link"][2:].abs_y.shape == (4, 3)
    with pytest.raises(RecordingError, match="episode 0, frame 1, link of 'link'"):
        recording["link"].abs_y  # noqa: B018


def test_lidar_scans_are_padded_and_objects_renumbered(tmp_path: Path) -> None:
    other = lidar(1)
    fewer = {
        name: getattr(other.scans[0], name)[:5]
        for name in ("ray", "points", "points_world", "range", "object")
    }
    scan = msgspec.structs.replace(other.scans[0], **fewer)
    second = msgspec.structs.replace(other, object_names=("wall", "tree"), scans=(scan,))
    record(
        tmp_path,
        [
            frame(0, product("lidar", "front", lidar(0), 0), product("lidar", "rear", lidar(0), 0)),
            frame(1, product("lidar", "front", second, 1), product("lidar", "rear", lidar(1), 1)),
        ],
    )
    scans = Recording(tmp_path)["lidar", "front"]
    assert (scans.names, scans.object_names) == (("car.0/top",), ("car.1", "tree", "wall"))
    assert scans.hits.tolist() == [[480], [5]]
    assert scans.points.shape == (2, 1, 480, 3)
    assert (scans.object[0] == np.where(lidar(0).scans[0].object == 0, 0, 2)).all()
    assert scans.object[1, 0, :6].tolist() == [*np.array([2, 1])[scan.object], -1]
    assert np.isnan(scans.range[1, 0, 5:]).all()
    with pytest.raises(RecordingError, match=r"lidar\.grid.*`record`"):
        scans.grid  # noqa: B018
    with pytest.raises(RecordingError, match=r"'front'.*'rear'.*\['lidar'.*'front'\]"):
        Recording(tmp_path)["lidar"]


def test_points_in_world_axes_are_computed_where_they_were_left_out(tmp_path: Path) -> None:
    whole = lidar(1)
    scan = msgspec.structs.replace(whole.scans[0], points_world=None)
    record(tmp_path, [frame(1, product("lidar", "lidar", msgspec.structs.replace(whole, scans=(scan,)), 1))])
    world = Recording(tmp_path)["lidar"].points_world[0, 0]
    np.testing.assert_allclose(world, whole.scans[0].points_world, atol=1e-5)
    assert np.abs(world - scan.points).max() > 1


def test_images_are_stacked(tmp_path: Path) -> None:
    optics = {"sensor": "cam", "position": (1.0, 2.0, 3.0), "orientation": (1.0, 0.0, 0.0, 0.0)}
    optics["intrinsics"] = Intrinsics(fx=1.0, fy=1.0, cx=2.0, cy=1.0)
    depth = DepthImage(**optics, depth=np.arange(6, dtype=np.float32).reshape(2, 3))
    parts = SegmentationImage(
        **optics, object=np.array([[0, -1]], np.int32), material=np.array([[1, 0]], np.int32)
    )
    names = {"object_names": ("tree",), "material_names": ("wood", "leaf")}
    record(
        tmp_path,
        [
            frame(
                0,
                product("depth", "eye", Depth(images=(depth,)), 0),
                product("segmentation", "eye", Segmentation(**names, images=(parts,)), 0),
            ),
            frame(1, absent("depth", "eye", "late"), absent("segmentation", "eye", "late")),
        ],
    )
    recording = Recording(tmp_path)
    assert recording["depth"].depth.shape == (2, 1, 2, 3)
    assert recording["depth"].position[0, 0].tolist() == [1, 2, 3]
    assert np.isnan(recording["depth"].depth[1]).all()
    with pytest.raises(RecordingError, match=r"without depth\.normals"):
        recording["depth"].normals  # noqa: B018
    segmented = recording["segmentation"]
    assert segmented.object[0, 0].tolist() == [[0, -1]]
    assert [segmented.material_names[k] for k in segmented.material[0, 0, 0]] == ["leaf", "wood"]


def test_actions_are_beams_by_user_and_motion_by_object(tmp_path: Path) -> None:
    beam = BeamChoice(tx="bs", rx="uav/rx", tx_beam=5, rx_beam=1)
    flight = WaypointCommand(object="uav", position=(1.0, 2.0, 3.0), speed=4.0)
    record(
        tmp_path,
        [
            frame(0, product("action", "pilot", Action(commands=(beam, flight)), 0)),
            frame(1, product("action", "pilot", Action(commands=(beam,)), 1)),
        ],
    )
    actions = Recording(tmp_path)["action"]
    assert (actions.users, actions.tx_beam.tolist()) == ((User("bs", "uav/rx", ""),), [[5], [5]])
    assert actions.motion.names == ("uav",)
    assert actions.motion.waypoint[0, 0].tolist() == [1, 2, 3]
    assert actions.motion.speed[0, 0] == 4
    assert np.isnan(actions.motion.waypoint[1]).all()
    assert np.isnan(actions.motion.velocity).all()


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (lambda run: run["chanel"], "there is no topic 'chanel'; did you mean 'channel'?"),
        (lambda run: run.products("lnk"), "there is no topic 'lnk'; did you mean 'link'?"),
        (lambda run: run.product(0, 0, "scen", "world"), "there is no topic 'scen'; did you mean 'scene'?"),
        (
            lambda run: run.frame(0, 0).payloads("scen", Scene),
            "there is no topic 'scen'; did you mean 'scene'?",
        ),
        (lambda run: run.frame(0, 0).payloads("scene", Link), "payloads of 'scene' are Scene, not Link"),
        (lambda run: run["camera"], "holds no product of 'camera'; it holds channel, link, scene"),
        (lambda run: run["link", "lonk"], "has no link of 'lonk'; did you mean 'link'?"),
        (lambda run: run["link"].select(episode=2), "link has no episode 2 here; it has 0 to 1"),
        (lambda run: run["link"].select(frames=range(5)), "link has no frame 3 here; it has 0 to 2"),
        (lambda run: run["link"].select(rx="car.0"), "has no receiver 'car.0' in these frames; did you mean"),
        (lambda run: run["link"].select(carrier="c"), "link has no carrier 'c' in these frames; "),
        (lambda run: run["scene"].select(names="car.7"), "has no row named 'car.7' in these frames; did you"),
        (
            lambda run: run["scene"].devices.index(["b"]),
            "scene has no 'b' in these frames; did you mean 'bs'?",
        ),
    ],
)
def test_a_mistake_is_told_with_what_is_there(street: Path, mistake: Any, message: str) -> None:
    with pytest.raises(RecordingError) as told:
        mistake(Recording(street))
    assert message in str(told.value)


def test_paths_without_h_say_how_to_record_it(tmp_path: Path) -> None:
    record(tmp_path, [frame(0, product("channel", "rt", channel(0), 0))])
    rays = Recording(tmp_path)["channel"]
    assert rays.tau.shape == (1, 3, 2)
    with pytest.raises(RecordingError, match=r"channel\.h.*`record`"):
        rays.h  # noqa: B018


def test_a_recorder_that_asks_for_a_part_refuses_a_channel_without_it(tmp_path: Path) -> None:
    made = recorder(tmp_path, run={"record": ("channel.h",)})
    check = ProductCheck(ContentRules(parts=made.parts))
    bare = product("channel", "rt", channel(0), 0)
    with pytest.raises(ProductError, match="'rt', frame 0: part 'h'"):
        made.step(frame(0, FrameInput(bare.provenance, bare.header, bare.body, check=check)))
    made.close()


def test_a_part_that_was_asked_for_and_not_delivered_is_laid_on_its_source(tmp_path: Path) -> None:
    record(tmp_path, [frame(0, product("channel", "rt", channel(0), 0))], run={"record": ("channel.h",)})
    with pytest.raises(RecordingError, match=r"channel\.h.*`record`.*'rt'"):
        Recording(tmp_path)["channel"].h  # noqa: B018


def test_an_empty_recording_has_no_product(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no product of 'scene'"):
        Recording(record(tmp_path, frames=0))["scene"]


SECTIONS: dict[str, type[TopicArrays[Any, Any]]] = {
    **{f'recording["{topic}"]': cls for topic, cls in TOPIC_ARRAYS.items()},
    'recording["scene"].devices': DeviceArrays,
    'recording["action"].motion': MotionArrays,
}


@pytest.mark.parametrize("section", SECTIONS)
def test_the_page_lists_every_array(repository: Path, section: str) -> None:
    cls = SECTIONS[section]
    lines = [f"### `{section}`", "", "| array | shape | type | |", "| --- | --- | --- | --- |"]
    for name, column in cls.columns.items():
        axes = " × ".join(["F", cls.axis, *map(str, column.shape)])
        doc = column.doc.replace("|", "\\|")
        lines.append(f"| `{name}` | {axes} | {column.dtype.name} | {doc} [{column.unit}] |")
    wanted = "\n".join(lines) + "\n"
    page = (repository / "docs" / "reference" / "recordings.md").read_text()
    assert wanted in page, f"docs/reference/recordings.md lacks\n{wanted}"


def test_a_table_has_a_row_for_each_that_is_present_and_what_was_recorded(
    street: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = Recording(street)
    links, objects = recording["link"], recording["scene"]
    table = links.table()
    assert len(table["t"]) == links.present.sum() < links.present.size
    assert table["rx"].tolist()[:3] == ["car.0/rx", "car.1/rx", "car.0/rx"]
    assert np.array_equal(table["abs_y"], links.abs_y[links.present])
    assert np.array_equal(table["frame"], links.frame[np.nonzero(links.present)[0]])
    assert "top_abs_y" not in table, "has several values"
    assert "buffered" not in table, "was not recorded"
    assert np.array_equal(objects.table()["position_y"], objects.position[objects.present][:, 1])
    assert np.array_equal(objects.table()["orientation_w"], objects.orientation[objects.present][:, 0])
    assert "first_tap" not in recording["channel"].table()
    assert len(links[:0].table()["t"]) == 0
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(SetupError, match="pip install pandas"):
        links.dataframe()
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=lambda columns: ["frame", *columns]))
    assert links.dataframe() == ["frame", *table]


def test_a_recording_and_its_topics_say_what_they_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sizes of arrays are there as long as the recording is not large."""
    recording = Recording(record(tmp_path, frames=4))
    lines = repr(recording).splitlines()
    assert lines[0] == f"Recording of {tmp_path}: 4 frames in 1 episode"
    assert "  link of 'link'" in lines
    links = recording["link"]
    assert f"  abs_y: {type(links).columns['abs_y'].__doc__} Here {links.abs_y.shape}." in repr(links)
    monkeypatch.setattr("caviar_protocol.recording.arrays.MEASURED_B", 0)
    assert "Here" not in repr(links)
