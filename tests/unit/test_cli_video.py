"""`caviar plot video`: how many pictures a video has, what they show, and what is refused."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from recording_builders import channel, frame, frame_of, lidar, link, product, record, scene

from caviar_clients.cli import main as command
from caviar_clients.cli.plot import film_run
from caviar_clients.plots import film
from caviar_clients.plots.rays import rays
from caviar_protocol.errors import RecordingError, RunError, SetupError
from caviar_protocol.recording import Recording
from caviar_protocol.space.coordinates import unit_vectors
from caviar_protocol.topics import Camera, CameraImage, Intrinsics

pytestmark = pytest.mark.slow

pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

ORANGE, WHITE = (0xE6, 0x9F, 0x00), (255, 255, 255)


def filmed(
    folder: Path, frames: int = 4, cameras: tuple[str, ...] = (), missing: tuple[int, ...] = ()
) -> Path:
    """A recording with rays and links, and cameras whose whole picture is of a frame's own red."""
    made = []
    for n in range(frames):
        payloads = {"scene": scene(n), "channel": channel(n), "link": link(n)}
        if cameras and n not in missing:
            payloads["camera"] = Camera(images=tuple(image(name, n, k) for k, name in enumerate(cameras)))
        made.append(frame_of(n, **payloads))
    return record(folder, made)


def image(name: str, number: int, which: int) -> CameraImage:
    """All of one colour: red grows with the frame, green tells the cameras apart."""
    rgb = np.zeros((30, 40, 3), np.uint8)
    rgb[...] = (100 + 40 * number, 200 * which, 30)
    return CameraImage(
        sensor=name,
        position=(0, 0, 5),
        orientation=(1, 0, 0, 0),
        intrinsics=Intrinsics(fx=20, fy=20, cx=20, cy=15),
        rgb=rgb,
    )


def pictures(file: Path) -> tuple[list[np.ndarray], list[int]]:
    """Pixels and milliseconds of each picture of a GIF."""
    found, shown = [], []
    with Image.open(file) as animation:
        for n in range(animation.n_frames):
            animation.seek(n)
            found.append(np.asarray(animation.convert("RGB")))
            shown.append(animation.info["duration"])
    return found, shown


def count(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
    return int((picture == np.array(colour, np.uint8)).all(axis=2).sum())


def near(picture: np.ndarray, colour: tuple[int, int, int]) -> int:
    """Pixels of about this colour."""
    return int((np.abs(picture.astype(int) - colour) < 12).all(axis=2).sum())


def test_a_gif_has_every_frame_at_its_speed_and_size_and_no_two_are_alike(tmp_path):
    made = film_run(filmed(tmp_path / "run", 5), tmp_path / "a.gif", width=480)
    drawn, shown = pictures(made.file)
    assert (made.frames, len(drawn)) == (5, 5)
    assert made.size == (480, drawn[0].shape[0])
    assert all(picture.shape == (made.size[1], 480, 3) for picture in drawn)
    assert shown == [100] * 5  # the sample's period
    assert made.speed == pytest.approx(1.0)
    for i, picture in enumerate(drawn):
        assert all((picture != other).any() for other in drawn[:i])


def test_the_colours_of_the_map_are_kept_exactly_beside_a_picture_of_many_colours(tmp_path):
    run = filmed(tmp_path / "run", 2, cameras=("pole",))
    for picture in pictures(film_run(run, tmp_path / "a.gif", width=640).file)[0]:
        assert count(picture, ORANGE) > 30
        assert count(picture, WHITE) > 0.4 * picture[..., 0].size


def test_what_moves_moves_and_what_stands_still_is_the_same_in_all_pictures(tmp_path):
    drawn, _ = pictures(film_run(filmed(tmp_path / "run", 5), tmp_path / "a.gif", width=640).file)
    cars = [np.flatnonzero((picture == ORANGE).all(axis=2).any(axis=0)) for picture in drawn]
    # 1 m a frame eastwards; the legend's orange mark stands still at the left.
    moved = np.diff([columns.max() for columns in cars])
    assert (moved > 0).all()
    assert np.ptp(moved) <= 2
    edge = int(0.98 * drawn[0].shape[0])  # the legend
    assert all((picture[edge:] == drawn[0][edge:]).all() for picture in drawn)


def test_a_part_of_the_frames_is_what_is_asked_for(tmp_path):
    run = filmed(tmp_path / "run", 6)
    for asked, frames in (("2:4", 2), (":1", 1), ("4:", 2), ("3:99", 3), (":", 6)):
        assert film_run(run, tmp_path / "a.gif", frames=asked, width=320).frames == frames


def test_the_chosen_camera_is_shown_and_keeps_its_last_picture(tmp_path):
    run = filmed(tmp_path / "run", 3, cameras=("car.0/front", "pole"), missing=(1,))
    drawn, _ = pictures(film_run(run, tmp_path / "a.gif", width=640).file)  # the fixed one
    sizes = [[near(picture, (100 + 40 * n, 200, 30)) for n in range(3)] for picture in drawn]
    assert np.argmax(sizes, axis=1).tolist() == [0, 0, 2]
    assert np.max(sizes, axis=1).min() > 5000
    front, _ = pictures(film_run(run, tmp_path / "b.gif", camera="car.0/front", width=640).file)
    assert near(front[0], (100, 0, 30)) > 5000
    assert near(front[0], (100, 200, 30)) == 0


def test_before_its_first_picture_a_camera_says_so(tmp_path):
    run = filmed(tmp_path / "run", 2, cameras=("pole",), missing=(0,))
    drawn, _ = pictures(film_run(run, tmp_path / "a.gif", width=640).file)
    assert near(drawn[0], (140, 0, 30)) == 0
    assert near(drawn[1], (140, 0, 30)) > 5000


def test_a_recording_without_channel_and_link_gives_the_map_alone(tmp_path):
    record(tmp_path / "run", [frame(n, product("scene", "s", scene(n), n)) for n in range(2)])
    with_link = film_run(record(tmp_path / "other", 2), tmp_path / "a.gif", width=320)
    assert film_run(tmp_path / "run", tmp_path / "b.gif", width=320).size[1] < with_link.size[1]


def test_without_ffmpeg_the_default_is_a_gif_in_the_run_directory(tmp_path, monkeypatch):
    monkeypatch.setattr(film.shutil, "which", lambda _: None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    run = record(tmp_path, 2)
    assert film_run(run, width=320).file == tmp_path / "video.gif"
    with pytest.raises(SetupError, match=r"ffmpeg.*apt-get install ffmpeg.*x\.gif"):
        film_run(run, tmp_path / "x.mp4")


def test_without_a_browser_the_command_that_installs_it_is_named(tmp_path, monkeypatch):
    pytest.importorskip("playwright")
    run = record(tmp_path / "run", 2)
    monkeypatch.setattr(film.shutil, "which", lambda _: str(tmp_path / "none"))
    with pytest.raises(SetupError, match="apt-get install chromium"):
        film_run(run, tmp_path / "x.gif", link="#n=1")
    monkeypatch.setitem(sys.modules, "playwright.sync_api", None)
    with pytest.raises(SetupError, match=r"Playwright.*caviar-sim\[film\]"):
        film_run(run, tmp_path / "x.gif", link="#n=1")


def fake_ffmpeg(folder: Path, program: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """An ``ffmpeg`` first on the path that knows one encoder and otherwise runs ``program``."""
    folder.mkdir()
    script = folder / "ffmpeg"
    listing = "if '-encoders' in sys.argv: print(' V..... mpeg4 MPEG-4'); sys.exit()"
    script.write_text(f"#!{sys.executable}\nimport pathlib, sys\n{listing}\n{program}\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=os.pathsep)


def test_an_mp4_is_what_ffmpeg_makes_of_all_pictures(tmp_path, monkeypatch):
    keep = "pathlib.Path(sys.argv[-1]).write_text(f'{len(sys.stdin.buffer.read())} {sys.argv[1:-1]}')"
    fake_ffmpeg(tmp_path / "bin", keep, monkeypatch)
    made = film_run(record(tmp_path / "run", 3), width=320, fps=12)
    assert made.file == tmp_path / "run" / "video.mp4"
    size, _, arguments = made.file.read_text().partition(" ")
    width, height = made.size
    assert height % 2 == 0
    assert int(size) == 3 * 3 * width * height
    assert f"'-video_size', '{width}x{height}', '-framerate', '12'" in arguments
    assert "'-c:v', 'mpeg4'" in arguments


@pytest.mark.parametrize("program", ["", "sys.stdin.buffer.read()"])
def test_what_ffmpeg_says_when_it_fails_is_told_and_no_file_is_left(tmp_path, monkeypatch, program):
    fail = "pathlib.Path(sys.argv[-1]).write_text('half'); print('no room', file=sys.stderr); sys.exit(3)"
    fake_ffmpeg(tmp_path / "bin", f"{program}\n{fail}", monkeypatch)
    run = record(tmp_path / "run", 3)
    before = sorted(run.iterdir())
    with pytest.raises(RunError, match=r"ffmpeg.*video\.mp4: no room"):
        film_run(run, width=320)
    assert sorted(run.iterdir()) == before


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="ffmpeg is not installed")
def test_ffmpeg_reads_every_frame_of_an_mp4(tmp_path):
    made = film_run(record(tmp_path / "run", 4), tmp_path / "a.mp4", width=480)
    decode = ["ffmpeg", "-v", "error", "-i", str(made.file), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(decode, capture_output=True, check=True).stdout
    width, height = made.size
    drawn = np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3)
    assert len(drawn) == 4
    assert near(drawn[0], ORANGE) > 30


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (
            {"frames": "7:9"},
            "--frames is '7:9', in which there is no frame; .* has frames 0 to 3 of",
        ),
        ({"frames": "3:1"}, "--frames is '3:1', in which there is no frame"),
        ({"frames": "3"}, "--frames is '3'; write A:B for frames A to B - 1; .* has frames 0 to 3"),
        ({"frames": "-2:3"}, "--frames is '-2:3'; write A:B"),
        ({"camera": "pol"}, "no images of camera 'pol'; did you mean 'pole'[?] known: car.0/front, pole"),
        ({"camera": "x"}, "no images of camera 'x'; known: car.0/front, pole"),
        ({"user": "bike"}, "no user is named 'bike'"),
        ({"out": "video.avi"}, "video.avi ends in '.avi', which is no format of a video; write .mp4 or .gif"),
        ({"out": "video"}, "video has no suffix; write .mp4 or .gif"),
        ({"fps": 0}, "--fps is 0; write more than 0 and at most 50"),
        ({"fps": 60}, "--fps is 60; write more than 0 and at most 50 for a GIF"),
        ({"width": 321}, "--width is 321; write an even number from 320 to 3840"),
    ],
)
def test_what_cannot_be_is_refused_with_the_remedy_and_leaves_no_file(tmp_path, asked, message):
    run = filmed(tmp_path / "run", 4, cameras=("car.0/front", "pole"))
    folder = tmp_path / "out"
    asked = {"out": "a.gif", "width": 320} | asked
    asked["out"] = folder / asked["out"]
    with pytest.raises((RecordingError, SetupError), match=message):
        film_run(run, **asked)
    assert not folder.exists()


def test_a_folder_is_no_video(tmp_path):
    run = record(tmp_path / "run", 2)
    with pytest.raises(
        SetupError, match=rf"{tmp_path} is a folder; write .*, as {tmp_path}/video.mp4 or .gif"
    ):
        film_run(run, tmp_path)


def test_a_camera_of_a_run_without_any_is_refused(tmp_path):
    run = record(tmp_path / "run", 2)
    with pytest.raises(RecordingError, match="no images of camera 'pole'"):
        film_run(run, tmp_path / "a.gif", camera="pole")


def test_a_run_without_a_scene_is_refused(tmp_path):
    record(tmp_path / "run", [frame(0, product("lidar", "s", lidar(0), 0))])
    with pytest.raises(RecordingError, match="holds no scene"):
        film_run(tmp_path / "run", tmp_path / "a.gif")


def test_a_fault_while_drawing_leaves_no_file_and_the_old_one_as_it_was(tmp_path, monkeypatch):
    run = record(tmp_path / "run", 3)
    old = tmp_path / "out" / "a.gif"
    film_run(run, old, width=320)
    kept = old.read_bytes()
    scene_of = Recording.products_of
    calls = []

    def breaking(self, index):
        calls.append(index)
        if index == 2 and calls.count(2) > 3:  # surveyed, in the series of |y|, sampled
            raise RecordingError("damaged")
        return scene_of(self, index)

    monkeypatch.setattr(Recording, "products_of", breaking)
    with pytest.raises(RecordingError, match="damaged"):
        film_run(run, old, width=320)
    assert old.read_bytes() == kept
    assert list(old.parent.iterdir()) == [old]


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    run = record(tmp_path / "run", 2)
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"file/a\.gif: .*/file is a file"):
        film_run(run, tmp_path / "file" / "a.gif", width=320)


@pytest.mark.parametrize("fps", [3.0, 7.0, 30.0, 50.0])
def test_the_times_of_a_gif_are_right_on_average(fps):
    shown = film.durations_ms(fps, 1000)
    assert all(time > 0 and time % 10 == 0 for time in shown)
    assert sum(shown) == pytest.approx(1e6 / fps, abs=5)
    assert max(shown) - min(shown) <= 10


def test_the_command_says_file_frames_and_speed(tmp_path, monkeypatch, capsys):
    run, file = record(tmp_path / "run", 2), tmp_path / "a.gif"
    monkeypatch.setattr(
        sys, "argv", ["caviar", "plot", "video", str(run), "--out", str(file), "--fps", "5", "--width", "320"]
    )
    with pytest.raises(SystemExit) as ended:
        command.main()
    assert ended.value.code == 0
    out, _ = capsys.readouterr()
    assert out.startswith(f"{file}: 2 frames of 320×")
    assert out.endswith("5 frames/s, 0.5 times real time\n")


def test_the_command_refuses_what_is_no_recording(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["caviar", "plot", "video", str(tmp_path / "nothing")])
    with pytest.raises(SystemExit) as ended:
        command.main()
    assert ended.value.code == 1
    assert str(tmp_path / "nothing") in capsys.readouterr().err


def test_a_path_of_unknown_route_is_two_ticks_in_its_directions_and_no_line():
    """As a statistical channel has them: no interaction points, directions off the straight line."""
    whole = channel(2)
    aod, aoa = whole.aod.copy(), whole.aoa.copy()
    aod[:, 1] += 0.2
    aoa[:, 1] -= 0.3
    unknown = msgspec.structs.replace(
        whole,
        aod=aod,
        aoa=aoa,
        interactions=np.zeros((4, 0), np.uint8),
        points=np.zeros((4, 0, 3)),
        objects=np.zeros((4, 0), np.int32),
    )
    found = rays(scene(2), unknown)
    assert not found.lines
    assert len(found.tick_gains) == 8
    power = np.abs(whole.a[0]) ** 2
    np.testing.assert_allclose(np.sort(found.tick_gains), np.sort(np.repeat(10 * np.log10(power), 2)))
    for path in range(4):
        tick = int(np.argmin(np.abs(found.tick_gains - 10 * np.log10(power[path]))))
        np.testing.assert_allclose(found.ends[tick, :2], [0.0, 20.0])
        np.testing.assert_allclose(
            found.towards[tick : tick + 2], unit_vectors(np.stack([aod[path], aoa[path]]))
        )
    np.testing.assert_allclose(found.ticks(3.0)[:, 1] - found.ticks(3.0)[:, 0], 3.0 * found.towards)


def test_a_straight_path_without_points_is_a_line_beside_the_ticks_of_the_others():
    whole = channel(2)
    mixed = msgspec.structs.replace(
        whole,
        interactions=np.zeros((4, 0), np.uint8),
        points=np.zeros((4, 0, 3)),
        objects=np.zeros((4, 0), np.int32),
    )
    found = rays(scene(2), mixed)  # the reflections leave and arrive elsewhere
    assert len(found.lines) == 2
    assert len(found.tick_gains) == 4
