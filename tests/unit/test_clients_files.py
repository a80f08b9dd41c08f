"""Files that commands write: tried before the work, and left alone until there is something to write."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest

from caviar_clients.files import write_file, writing
from caviar_protocol.errors import RunError


def test_trying_a_file_makes_its_folders_and_leaves_what_is_in_it(tmp_path: Path) -> None:
    file = tmp_path / "results" / "figures.json"
    write_file(file)
    assert file.read_bytes() == b""
    write_file(file, "first")
    write_file(file)  # what comes may fail
    assert file.read_text() == "first"
    write_file(file, "2nd")
    assert file.read_text() == "2nd"


def test_a_file_that_cannot_be_written_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=f"cannot write {tmp_path}: Is a directory; choose another file"):
        write_file(tmp_path)


def test_a_file_in_the_way_of_a_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(
        RunError, match=f"cannot write .*: {tmp_path / 'file'} is a file, not a folder; choose"
    ):
        write_file(tmp_path / "file" / "figures" / "figures.json")


def test_a_full_disk_leaves_the_file_as_it_was(tmp_path: Path, small_disk: Path) -> None:
    file = small_disk / "figures.json"
    write_file(file, "first")
    with pytest.raises(RunError, match=f"cannot write {file}: No space left on device; free space there, or"):
        write_file(file, "x" * 1_000_000)
    assert [(entry.name, entry.read_text()) for entry in small_disk.iterdir()] == [("figures.json", "first")]
    (tmp_path / "full.json").symlink_to("/dev/full")
    with pytest.raises(RunError, match=r"full\.json: No space left"):
        write_file(tmp_path / "full.json", "text")


def test_errors_of_libraries_on_a_full_disk_name_it(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"out: No space left"), writing(tmp_path / "out"):
        raise ValueError(f"IO Error: {os.strerror(errno.ENOSPC)}, errno 28")
    with pytest.raises(ValueError, match="another"), writing(tmp_path / "out"):
        raise ValueError("another")
