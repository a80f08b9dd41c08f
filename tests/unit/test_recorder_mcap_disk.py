"""The recorder and the disk: what is on it when, and what is said where it is full or gone."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from recording_builders import frame, recorder

from caviar_protocol.errors import RunError
from caviar_protocol.recording import Recording
from caviar_services.recorder import segment_writer
from caviar_services.recorder.base import failure
from caviar_services.recorder.mcap import McapRecorder


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 400 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=400k", "tmpfs", str(folder)]
    if shutil.which("mount") is None or subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("this user may not mount a tmpfs")
    yield folder
    subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(made: McapRecorder, first: int = 0) -> tuple[int, str]:
    """Record until it fails: the frame that does, and what is said."""
    for number in range(first, 10_000):
        try:
            made.step(frame(number))
        except RunError as error:
            return number, str(error)
    raise AssertionError("it never failed")


@pytest.mark.parametrize("settings", [{}, {"segment_frames": 10}], ids=str)
def test_a_full_disk_is_named_with_its_remedy_and_what_was_written_is_read(small_disk, capfd, settings):
    made = recorder(small_disk / "run", **settings)
    (small_disk / "run" / "run.json").touch()  # of a run that can be resumed
    number, text = fill(made)
    assert "the recorder cannot write" in text
    assert str(small_disk / "run") in text
    assert "No space left on device (errno 28); free space on its file system, then resume with" in text
    assert f"caviar run --resume {small_disk / 'run'}" in text
    with pytest.raises(RunError, match="No space left"):
        made.step(frame(number))
    made.close()
    recording = Recording(small_disk / "run")
    assert len(recording) in (number, number + 1)
    assert number > 10
    assert not recording.complete
    assert recording.run_digest().damage == ()
    assert capfd.readouterr().err == ""


def test_a_recording_goes_on_once_there_is_space(small_disk):
    ballast = small_disk / "ballast"
    ballast.write_bytes(bytes(200_000))
    made = recorder(small_disk / "run")
    number, text = fill(made)
    assert "No space left" in text
    made.close()
    ballast.unlink()
    subprocess.run(["mount", "-o", "remount,size=4m", str(small_disk)], check=True)
    later = recorder(small_disk / "run", again=True)
    for one in range(number, number + 5):
        later.step(frame(one))
    later.close()
    recording = Recording(small_disk / "run")
    assert recording.complete
    assert [f.number for f in recording.frames()] == list(range(number + 5))


def test_a_directory_that_is_removed_during_the_run_is_named(tmp_path):
    made = recorder(tmp_path / "run")
    made.step(frame(0))
    shutil.rmtree(tmp_path / "run")
    with pytest.raises(RunError, match="directory was removed or renamed"):
        made.step(frame(1))
    made.close()


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.EMFILE, "ulimit -n"),
        (errno.EFBIG, "ulimit -f"),
        (errno.EDQUOT, "quota"),
        (errno.EROFS, "--out"),
        (errno.EIO, "--out"),
    ],
)
def test_the_remedy_fits_the_error(number, remedy):
    text = str(failure(Path("run/recording-0000.mcap"), OSError(number, os.strerror(number))))
    assert "recording-0000.mcap" in text
    assert remedy in text


class Syncs:
    """Calls that bring a file to disk, with the size it then has."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sizes: list[int] = []
        self.came = threading.Event()
        really = os.fdatasync

        def fdatasync(fd: int) -> None:
            self.sizes.append(os.fstat(fd).st_size)
            really(fd)
            self.came.set()

        monkeypatch.setattr(os, "fdatasync", fdatasync)


def test_with_frame_each_frame_is_on_disk_before_it_is_acknowledged(tmp_path, monkeypatch):
    syncs = Syncs(monkeypatch)
    made = recorder(tmp_path, run={"durability": "frame"}, segment_frames=2)
    for number in range(4):
        segment = tmp_path / f"recording-{number // 2:04d}.mcap"
        before = len(syncs.sizes)
        made.step(frame(number))
        assert len(syncs.sizes) > before
        assert syncs.sizes[-1] == segment.stat().st_size
    made.close()
    assert Recording(tmp_path).complete


def test_with_periodic_a_thread_brings_frames_to_disk(tmp_path, monkeypatch):
    monkeypatch.setattr(segment_writer, "_PAUSE_S", 0.01)
    syncs = Syncs(monkeypatch)
    made = recorder(tmp_path, run={"durability": "periodic"}, segment_frames=2)
    for number in range(4):
        syncs.came.clear()
        made.step(frame(number))
        assert syncs.came.wait(20)
    made.close()
    assert Recording(tmp_path).complete


def test_with_periodic_an_error_of_the_disk_ends_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(segment_writer, "_PAUSE_S", 0.01)
    tried = threading.Event()

    def fdatasync(fd: int) -> None:
        tried.set()
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    made = recorder(tmp_path, run={"durability": "periodic"})
    made.step(frame(0))
    assert tried.wait(20)
    _, text = fill(made, 1)
    assert "Input/output error (errno 5)" in text
    made.close()


def test_with_none_nothing_is_synced(tmp_path, monkeypatch):
    syncs = Syncs(monkeypatch)
    made = recorder(tmp_path, run={"durability": "none"}, segment_frames=2)
    for number in range(4):
        made.step(frame(number))
    made.close()
    assert syncs.sizes == []
    assert Recording(tmp_path).complete


def test_what_cannot_be_resumed_is_not_said_to_be(tmp_path):
    """An embedded run has no run.json."""
    text = str(failure(tmp_path / "recording-0000.mcap", OSError(errno.ENOSPC, "No space left on device")))
    assert "free space on its file system, or choose another directory with --out" in text
