"""Folders for temporary files: they go with their process, also where it is killed, and with no other."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from caviar_protocol.files import FOLDER_MARK, PrivateFolder, remove_leftovers

HOLDS = """
import sys
from caviar_protocol.files import PrivateFolder
folder = PrivateFolder("test")
(folder.path / "secret.key").write_text("secret")
print(folder.path, flush=True)
sys.stdin.readline()
"""
KEEPS = "import sys; print(flush=True); sys.stdin.readline()"


@pytest.fixture(autouse=True)
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A temporary folder for the test alone."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


@contextmanager
def holder(code: str = HOLDS, **options: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A process, and the line that it prints once it is ready."""
    command = [sys.executable, "-c", code]
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        **options,  # type: ignore[call-overload]
    )
    try:
        yield process, process.stdout.readline().strip()
    finally:
        process.kill()
        process.communicate()


def test_a_folder_is_this_users_alone_and_goes_with_its_block() -> None:
    with PrivateFolder("key") as folder:
        assert folder.path.name.startswith("caviar-key-")
        assert folder.path.stat().st_mode & 0o777 == 0o700
    assert not folder.path.exists()
    folder.cleanup()  # a second time


def test_a_folder_goes_with_its_process(place: Path) -> None:
    with holder() as (process, line):
        assert Path(line, "secret.key").exists()
        process.communicate("go\n")
        assert process.returncode == 0
    assert not list(place.iterdir())


def test_what_a_killed_process_leaves_is_removed_by_the_next_and_that_of_a_live_one_is_not() -> None:
    with holder() as (killed, left), holder() as (_, live):
        killed.kill()
        killed.wait()
        assert Path(left, "secret.key").exists()
        with PrivateFolder() as mine:
            assert not Path(left).exists()
            assert Path(live, "secret.key").exists()
            assert remove_leftovers() == []
            assert mine.path.exists()


def test_a_child_that_inherits_the_folder_holds_it_after_its_parent() -> None:
    """The broker of a launcher that is killed ends a moment later."""
    folder = PrivateFolder()
    with holder(KEEPS, pass_fds=(folder.fileno(),)):
        folder._end.detach()
        os.close(folder.fileno())  # as the kernel does when this process is killed
        assert remove_leftovers() == []
    assert remove_leftovers() == [folder.path]


@pytest.mark.parametrize("kind", ["no mark", "open to others", "link", "file"])
def test_what_is_not_surely_a_leftover_stays(place: Path, kind: str) -> None:
    there = place / "caviar-something"
    if kind == "file":
        there.write_text("mine")
    elif kind == "link":
        (place / "elsewhere").mkdir(mode=0o700)
        (place / "elsewhere" / FOLDER_MARK).touch()
        there.symlink_to(place / "elsewhere")
    else:
        there.mkdir(mode=0o700)
        if kind == "open to others":
            (there / FOLDER_MARK).touch()
            there.chmod(0o755)
    assert remove_leftovers() == []
    assert there.exists()


def test_a_file_system_without_locks_keeps_its_leftovers(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise OSError("no locks available")

    monkeypatch.setattr("fcntl.flock", refused)
    with PrivateFolder() as folder:
        assert remove_leftovers() == []
        assert folder.path.exists()
    assert not folder.path.exists()
