"""Answers to a viewer: frames show their products, thinned ones say so, nothing else is answered."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import caviar
from caviar_protocol.arrays import Payload
from caviar_protocol.codec import decode_payload, split_frame
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import GrantInput, Observe, Status
from caviar_protocol.observer import Observation, ObservedProduct
from caviar_protocol.recording import FrameEntry, Recording
from caviar_protocol.space.beams import beam_gains
from caviar_protocol.topics import (
    Camera,
    CameraImage,
    Channel,
    Intrinsics,
    Lidar,
    LidarScan,
    Link,
    Scene,
)
from caviar_space.meshes import Mesh, ply
from caviar_view import live
from caviar_view.answers import Answers, NotThereError
from caviar_view.frames import Frames, RecordedFrames
from caviar_view.world import World


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return caviar.run("geometric", frames=6, out=tmp_path_factory.mktemp("view"), embedded=True)


@pytest.fixture
def answers(run: Path) -> Answers:
    return Answers(RecordedFrames(Recording(run)))


def asked(answers: Answers, path: str, **query: object) -> Any:
    return json.loads(answers.get(path, {key: str(value) for key, value in query.items()}).content)


def product(answers: Answers, path: str, **query: object) -> tuple[dict[str, Any], Payload]:
    content = answers.get(path, {key: str(value) for key, value in query.items()}).content
    said, header, body = split_frame(content)
    about = msgspec.msgpack.decode(said)
    return about, decode_payload(about["topic"], header, body)


def test_about_names_the_run_its_frames_and_its_scenery(answers: Answers) -> None:
    about = asked(answers, "about")
    assert (about["kind"], about["name"], about["live"]) == ("recording", "geometric", False)
    assert about["frames"] == [{"episode": 0, "first_frame": 0, "first": 0, "count": 6}]
    assert about["meshes"] == []
    assert [service["name"] for service in about["services"]] == list(answers.frames.scenario["services"])
    vertices, triangles = np.frombuffer(answers.get(f"meshes/{about['assets']['']}").content[:8], "<u4")
    assert (vertices, triangles) == (8, 12)


def test_products_are_those_of_the_recording(run: Path, answers: Answers) -> None:
    frame = Recording(run).frame(0, 4)
    scene, recorded = product(answers, "frames/4/scene")[1], frame.scene()
    assert isinstance(scene, Scene)
    assert recorded is not None
    assert scene.names == recorded.names
    assert np.array_equal(scene.position, recorded.position)
    link = product(answers, "frames/4/link")[1]
    assert isinstance(link, Link)
    assert np.array_equal(link.snr, frame.payloads("link", Link)["link"].snr)
    about, channel = product(answers, "frames/4/channel")
    (whole,) = frame.payloads("channel", Channel).values()
    assert isinstance(channel, Channel)
    assert about["kept"]["paths"] == [len(whole.tau), len(whole.tau)]
    assert np.array_equal(channel.a, whole.a)
    assert not channel.h


def test_the_strongest_paths_of_each_pair_are_kept_in_their_order(run: Path, answers: Answers) -> None:
    about, channel = product(answers, "frames/4/channel", paths=2)
    (whole,) = Recording(run).frame(0, 4).payloads("channel", Channel).values()
    assert isinstance(channel, Channel)
    assert about["kept"]["paths"] == [len(channel.tau), len(whole.tau)]
    for tx in whole.tx:
        for rx in whole.rx:
            power = np.abs(whole.a[0, whole.pair(tx, rx)]) ** 2
            kept = channel.id[channel.pair(tx, rx)]
            best = np.sort(np.argsort(-power, kind="stable")[:2])
            assert kept.tolist() == whole.id[whole.pair(tx, rx)][best].tolist()


def test_lobes_are_the_array_factor(run: Path, answers: Answers) -> None:
    scene = Recording(run).frame(0, 0).scene()
    assert scene is not None
    device = next(d for d in scene.devices if d.name == "bs")
    lobe = asked(answers, "frames/0/lobes", device="bs", beam=3)
    gain = np.array(lobe["gain"])
    assert gain.shape == (len(lobe["elevations"]), len(lobe["azimuths"]))
    assert gain.max() > 0.98
    # Towards a single plane wave |y| of the beam is the lobe times the square root of the elements.
    row, column = 30, 50
    elevation, azimuth = lobe["elevations"][row], lobe["azimuths"][column]
    from caviar_protocol.space.antenna_arrays import steering_vector
    from caviar_protocol.topics import AntennaArray

    unit = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    if lobe["axis"] == "y":
        unit = unit[[1, 2, 0]]
    h = steering_vector(device.array, unit)[None, :]
    y = beam_gains(h, device.array, AntennaArray(rows=1, columns=1))[3, 0]
    assert gain[row, column] == pytest.approx(y / np.sqrt(device.array.size), abs=1e-3)
    with pytest.raises(NotThereError, match="'bs'"):
        answers.get("frames/0/lobes", {"device": "bs", "beam": "9999"})


def test_curves_and_clock_are_those_of_the_run(run: Path, answers: Answers) -> None:
    recorded = Recording(run)["link"]
    curves = asked(answers, "curves", user=0)
    user = curves["user"]
    place = [tuple(each) for each in recorded.users].index((user["tx"], user["rx"], user["carrier"]))
    assert curves["n"] == list(range(6))
    assert np.allclose(curves["series"]["abs_y"]["values"], recorded.abs_y[:, place], rtol=1e-12)
    assert np.allclose(curves["series"]["snr_db"]["values"], 10 * np.log10(recorded.snr[:, place]))
    clock = asked(answers, "clock", first=2, count=3)
    assert [frame["n"] for frame in clock["frames"]] == [2, 3, 4]
    worked = [lane for lane in clock["frames"][0]["lanes"] if lane["work_ms"] is not None]
    assert worked
    assert all(0 <= lane["start_ms"] <= lane["end_ms"] for lane in worked)
    assert min(lane["start_ms"] for lane in worked) == 0


@pytest.mark.parametrize(
    "path",
    [
        "",
        "frames/6",
        "frames/-1",
        "frames/x",
        "frames/²",
        f"frames/{'9' * 5000}",
        "frames/1/lidar",
        "frames/1/secret",
        "meshes/99",
        "meshes/../x",
    ],
)
def test_nothing_else_is_answered(answers: Answers, path: str) -> None:
    with pytest.raises(NotThereError):
        answers.get(path)


def test_a_damaged_product_is_an_error_and_no_picture(run: Path, tmp_path: Path) -> None:
    import shutil

    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    segment = copy / "recording-0000.mcap"
    scene = Recording(copy).frame(0, 3).products[-1].body
    content = segment.read_bytes()
    segment.write_bytes(content.replace(bytes(scene), bytes(len(scene))))
    damaged = Answers(RecordedFrames(Recording(copy)))
    with pytest.raises(RecordingError, match="frame 3, scene"):
        damaged.get("frames/3/scene")
    damaged.get("frames/2/scene")


class Given(Frames):
    """Products of one frame, as given."""

    kind, run, seed, complete, first, end = "recording", "r", 1, True, 0, 1

    def __init__(self, products: Mapping[str, Payload]) -> None:
        self.products = products
        self.scenario: Mapping[str, Any] = {}
        self.assets: Mapping[str, Path] = {}
        self.topics: Mapping[str, Sequence[str]] = dict.fromkeys(products, ("s",))
        self.damage = ()

    def entry(self, place: int) -> FrameEntry:
        items = tuple(GrantInput(topic=topic, source="s", status=Status.HELD) for topic in self.products)
        return FrameEntry(episode=0, frame=0, t_ns=0, inputs=items)

    def payload(self, place: int, item: GrantInput) -> Payload:
        return self.products[item.topic]


def test_scans_and_pictures_are_thinned_and_say_so() -> None:
    n = 1000
    points = np.arange(3 * n, dtype=np.float32).reshape(n, 3)
    scan = LidarScan(
        sensor="l",
        position=(1.0, 2.0, 3.0),
        orientation=(1.0, 0.0, 0.0, 0.0),
        ray=np.arange(n, dtype=np.int32),
        points=points,
        points_world=points,
        range=np.ones(n, np.float32),
        object=np.zeros(n, np.int32),
    )
    rgb = np.arange(60 * 90 * 3, dtype=np.uint32).astype(np.uint8).reshape(60, 90, 3)
    optics = Intrinsics(fx=45.0, fy=45.0, cx=45.0, cy=30.0)
    image = CameraImage(
        sensor="c", intrinsics=optics, position=(0, 0, 0), orientation=(1.0, 0, 0, 0), rgb=rgb
    )
    answers = Answers(
        Given({"lidar": Lidar(object_names=("wall",), scans=(scan,)), "camera": Camera(images=(image,))})
    )
    about, lidar = product(answers, "frames/0/lidar", points=300)
    assert isinstance(lidar, Lidar)
    assert about["status"] == "held"
    assert about["kept"]["points"] == [250, 1000]
    assert lidar.scans[0].ray.tolist() == list(range(0, 1000, 4))
    assert np.array_equal(lidar.scans[0].points, points[::4])
    assert lidar.scans[0].points_world is None
    about, camera = product(answers, "frames/0/camera", pixels=30)
    assert isinstance(camera, Camera)
    small = camera.images[0]
    assert about["kept"]["pixels"] == [30, 90]
    assert np.array_equal(small.rgb, rgb[::3, ::3])
    # Pixel 3 of the small picture is pixel 9 of the other: the same direction.
    assert (3.5 - small.intrinsics.cx) / small.intrinsics.fx == pytest.approx((9.5 - 45.0) / 45.0)


def test_large_scenery_is_thinned_and_keeps_its_place(tmp_path: Path) -> None:
    side = 200
    x, y = np.meshgrid(np.linspace(0, 100, side), np.linspace(0, 50, side), indexing="ij")
    vertices = np.stack([x.ravel(), y.ravel(), np.sin(x / 9).ravel()], 1)
    i = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + side], 1), np.stack([i + 1, i + side + 1, i + side], 1)])
    (tmp_path / "ground.ply").write_bytes(ply(Mesh(vertices, faces.astype(np.int32))))
    description = tmp_path / "scene.xml"
    description.write_text(
        '<scene version="2.1.0"><bsdf type="itu-radio-material" id="mat-g">'
        '<string name="type" value="concrete"/></bsdf><shape type="ply" id="mesh-ground">'
        '<string name="filename" value="ground.ply"/>'
        '<ref id="mat-g" name="bsdf"/></shape></scene>'
    )
    assets = {"scenery/scene.xml": description, "scenery/ground.ply": tmp_path / "ground.ply"}
    boxes = [{"minimum_m": [0, 0, 0], "maximum_m": [2, 1, 5]}]
    channel = {"role": "channel", "settings": {"obstacles": boxes}}
    world = World(assets, {"services": {"channel": channel}}, most=5000)
    group, obstacles = world.groups
    assert obstacles.mesh.vertices.max(0).tolist() == [2, 1, 5]
    assert group.kind == "terrain"
    assert group.material == "concrete"
    assert len(group.mesh.faces) <= 5000 < group.of == 2 * (side - 1) ** 2
    assert np.allclose(group.mesh.vertices.min(0), vertices.min(0), atol=2.0)
    assert np.allclose(group.mesh.vertices.max(0), vertices.max(0), atol=2.0)


def seen(frame: int, topic: str = "lidar", size: int = 0) -> Observation:
    item = GrantInput(topic=topic, source="s", status=Status.FRESH, frame=frame)
    product = ObservedProduct(item, memoryview(b""), memoryview(bytes(size)))
    message = Observe(sequence=frame, state="running", frame=frame, t_ns=frame, inputs=(item,))
    return Observation(message, {(topic, "s"): product})


def test_a_run_that_goes_on_holds_its_newest_frames(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "MOST_BYTES", 1000)
    monkeypatch.setattr(live, "MOST_FRAMES", 8)
    monkeypatch.setattr(live, "_MARGIN", 2)
    frames = live.LiveFrames(tmp_path, {}, "run", 1, {})
    for frame in range(20):
        frames.add(seen(frame, size=300))
        frames.add(seen(frame, size=300))  # another state of the run, with the frame as before
    assert (frames.first, frames.end) == (12, 20)
    assert [frames.entry(place).frame for place in (12, 19)] == [12, 19]
    with pytest.raises(RecordingError, match="frame 3 is not held"):
        frames.entry(3)
    item = frames.entry(15).inputs[0]
    with pytest.raises(RecordingError, match="lidar of frame 15 is not held"):
        frames.payload(15, item)
    # Two pages ask at once, and get the same rows: none is counted twice, none is lost.
    for first, rows in (
        (0, [[0, 0, 5, 0, 2], [0, 1, 9, 1, 4]]),
        (0, [[0, 0, 5, 0, 2]]),
        (2, [[0, 2, 12, 0, 1]]),
    ):
        frames.add_answers({"link": {"first": first, "rows": rows}})
    assert frames.known_answers() == {"link": 3}
    assert frames.answers() == {"link": {(0, 0): (5, 0, 2), (0, 1): (9, 1, 4), (0, 2): (12, 0, 1)}}


def test_a_radio_map_beside_the_recording_is_shown(run: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mapped"
    shutil.copytree(run, folder)

    def answers_of() -> Answers:
        return Answers(RecordedFrames(Recording(folder)))

    assert asked(answers_of(), "about")["radio_map"] is False
    with pytest.raises(NotThereError):
        asked(answers_of(), "radio-map")
    gain = np.array([[[-90.0, np.nan], [-np.inf, -70.0]], [[-80.0, np.nan], [-100.0, -75.0]]])
    np.savez(folder / "radio-map.npz", x=[1.0, 3.0], y=[5.0, 7.0], z=[[0.5, 0.5], [np.nan, 1.5]], gain=gain)
    found = answers_of()
    assert asked(found, "about")["radio_map"] is True
    shown = asked(found, "radio-map")
    assert (shown["x"], shown["y"], shown["every"]) == ([1.0, 3.0], [5.0, 7.0], 1)
    assert shown["gain_db"] == [[-80.0, None], [None, -70.0]]  # the strongest; no signal, no height: none
    assert (shown["z"][0][0], shown["z"][1][1]) == (0.5, 1.5)
    (folder / "radio-map.npz").write_bytes(b"PK\x03\x04 damaged")
    with pytest.raises(RecordingError, match="radio-map"):
        asked(answers_of(), "radio-map")
