"""Chains of scenery in files."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from queue import SimpleQueue

import numpy as np
import pytest

from caviar_services.channel.enumeration.scenery_chains import ChainCache, cache_key

TABLES = (np.array([[1, -1, -1], [1, 5, 2]], np.int32), np.array([[1, 2], [2, 1], [2, 5]], np.int32))
KEY = cache_key(b"geometry", b"place")


def test_what_was_saved_is_loaded(tmp_path: Path) -> None:
    cache = ChainCache(tmp_path / "chains")
    assert cache.load(KEY, (3, 2)) is None
    cache.save(KEY, TABLES)
    loaded = ChainCache(tmp_path / "chains").load(KEY, (3, 2))
    assert loaded is not None
    assert all(np.array_equal(one, other) for one, other in zip(loaded, TABLES, strict=True))
    assert [path.name for path in (tmp_path / "chains").iterdir()] == [KEY]
    assert cache.notes == []


def test_what_two_launch_at_once_is_launched_by_one(tmp_path: Path) -> None:
    told, found = SimpleQueue[str](), list[object]()

    def wait_for_the_other() -> None:
        cache = ChainCache(tmp_path)
        with cache.launching(KEY, told.put):
            found.append(cache.load(KEY, (3, 2)))

    other = threading.Thread(target=wait_for_the_other)
    cache = ChainCache(tmp_path)
    with cache.launching(KEY, lambda _: None) as tell, cache.launching(cache_key(b"another"), print):
        tell("launching part 3")
        other.start()
        assert "launching part 3" in told.get(timeout=30)
        assert found == []
        cache.save(KEY, TABLES)
    other.join(30)
    assert found[0] is not None
    assert [path.name for path in tmp_path.iterdir()] == [KEY]


def test_where_no_lock_can_be_had_each_launches(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_bytes(b"")
    os.mkfifo(tmp_path / f"{KEY}.lock")
    for folder in (tmp_path, tmp_path / "file" / "chains"):
        with ChainCache(folder).launching(KEY, print) as tell:
            tell("part 3")
    assert capsys.readouterr().out == "part 3\npart 3\n"


def test_empty_tables_too(tmp_path: Path) -> None:
    cache = ChainCache(tmp_path)
    cache.save(KEY, (np.zeros((0, 3), np.int32), np.zeros((0, 2), np.int32)))
    loaded = cache.load(KEY, (3, 2))
    assert loaded is not None
    assert [table.shape for table in loaded] == [(0, 3), (0, 2)]


def test_damage_of_any_kind_is_noted_and_nothing_is_loaded(tmp_path: Path) -> None:
    cache = ChainCache(tmp_path)
    cache.save(KEY, TABLES)
    path = tmp_path / KEY
    whole = path.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    for data in (b"", whole[:-1], bytes(flipped), b"\xc1" * 50):
        path.write_bytes(data)
        assert cache.load(KEY, (3, 2)) is None
        assert "is damaged" in cache.notes.pop()
    path.write_bytes(whole)
    assert cache.load(KEY, (4, 2)) is None
    assert "is damaged" in cache.notes.pop()
    assert cache.load(KEY, (3, 2)) is not None


def test_a_pipe_in_place_of_a_file_or_of_its_draft_is_not_waited_for(tmp_path: Path) -> None:
    cache = ChainCache(tmp_path)
    os.mkfifo(tmp_path / KEY)
    assert cache.load(KEY, (3, 2)) is None
    assert "it is a named pipe, not a file" in cache.notes.pop()
    cache.save(KEY, TABLES)
    assert cache.load(KEY, (3, 2)) is not None
    (tmp_path / KEY).unlink()
    os.mkfifo(tmp_path / f"{KEY}.partial")
    cache.save(KEY, TABLES)
    assert "chains cannot be kept" in cache.notes.pop()
    cache.save(KEY, TABLES)
    assert cache.load(KEY, (3, 2)) is not None


def test_a_file_under_another_name_is_not_believed(tmp_path: Path) -> None:
    cache = ChainCache(tmp_path)
    cache.save(KEY, TABLES)
    other = cache_key(b"geometry", b"another place")
    (tmp_path / KEY).rename(tmp_path / other)
    assert cache.load(other, (3, 2)) is None
    assert "is damaged" in cache.notes.pop()


def test_a_folder_that_cannot_be_written_is_noted_with_the_remedy(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    cache = ChainCache(tmp_path / "file" / "chains")
    cache.save(KEY, TABLES)
    assert "XDG_CACHE_HOME" in cache.notes.pop()
    assert cache.load(KEY, (3, 2)) is None


def test_keys_tell_parts_apart() -> None:
    keys = {cache_key(*parts) for parts in ((b"ab", b"c"), (b"a", b"bc"), (b"abc",), (b"ab", b"c", b""))}
    assert len(keys) == 4
