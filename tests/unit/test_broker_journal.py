"""The journal: readable back, also when it was cut off, and clear about a disk that is full."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import pytest
import zmq
from msgspec.structs import replace

from caviar_broker.core.events import Journal, Product
from caviar_broker.journal import JournalFile, read_journal
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.messages import GrantInput, Status


def entry(number: int, body: bytes = b"") -> Journal:
    decision = GrantInput(topic="scene", source="world", status=Status.HELD, frame=1, age=2, cause="late")
    payload = (zmq.Frame(b"\x80"), zmq.Frame(body))
    product = Product("scene", "world", number, 0, "0" * 64, "", payload)
    return Journal(number, 1, number, "world", "done", (decision,), (product,) if body else ())


@pytest.fixture
def path(tmp_path: Path) -> Path:
    journal = JournalFile(tmp_path / "journal.msgpack", epoch=3)
    for number in range(1, 51):
        journal.write([entry(number, b"x" * 1000 * (number % 3))])
    journal.close()
    return tmp_path / "journal.msgpack"


def test_entries_come_back_in_order_with_decisions_and_products(path: Path) -> None:
    entries = list(read_journal(path))
    assert [e.number for e in entries] == list(range(1, 51))
    assert {(e.epoch, e.episode, e.service, e.outcome) for e in entries} == {(3, 1, "world", "done")}
    assert entries[0].decisions == entry(1).decisions
    assert entries[1].products == (("scene", b"\x80", b"x" * 2000),)
    assert entries[2].products == ()


def test_large_bodies_are_written_from_where_they_lie_and_come_back_whole(tmp_path: Path) -> None:
    """Sizes around that from which bodies are pieces of their own, several of them in one write."""
    sizes = [0, 1, (1 << 16) - 1, 1 << 16, (1 << 16) + 1, 3_000_000, 5]
    bodies = [bytes([65 + i]) * size for i, size in enumerate(sizes)]
    entries = [entry(i, body) for i, body in enumerate(bodies, start=1)]
    both = entry(len(bodies) + 1, b"y" * 100_000)
    entries.append(replace(both, products=(*entries[5].products, *both.products)))
    journal = JournalFile(tmp_path / "journal.msgpack", epoch=1)
    journal.write(entries)
    journal.close()
    found = list(read_journal(tmp_path / "journal.msgpack"))
    assert [e.number for e in found] == list(range(1, len(bodies) + 2))
    assert [[p[2] for p in e.products] for e in found[:-1]] == [[body] if body else [] for body in bodies]
    assert [p[2] for p in found[-1].products] == [bodies[5], b"y" * 100_000]


def test_what_the_system_takes_in_parts_is_written_whole(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As Linux does from 2 GiB on."""
    whole = os.writev

    def partly(fd: int, pieces: Sequence[bytes]) -> int:
        return whole(fd, [bytes(b"".join(pieces)[:40_000])])

    monkeypatch.setattr(os, "writev", partly)
    journal = JournalFile(tmp_path / "journal.msgpack", epoch=1)
    journal.write([entry(1, b"a" * 100_000), entry(2), entry(3, b"b" * 70_000)])
    journal.close()
    found = list(read_journal(tmp_path / "journal.msgpack"))
    assert [[p[2] for p in e.products] for e in found] == [[b"a" * 100_000], [], [b"b" * 70_000]]


def test_a_later_broker_appends(path: Path) -> None:
    journal = JournalFile(path, epoch=4)
    journal.write([entry(51)])
    journal.close()
    assert [(e.number, e.epoch) for e in read_journal(path)][-2:] == [(50, 3), (51, 4)]


def test_wherever_it_is_cut_off_the_whole_entries_before_are_read(path: Path) -> None:
    data = path.read_bytes()
    ends = []
    for cut in range(len(data) - 2500, len(data), 7):
        path.write_bytes(data[:cut])
        ends.append(len(list(read_journal(path))))
    assert ends == sorted(ends)
    assert set(ends) <= {47, 48, 49}


def test_what_is_no_entry_is_named_with_its_place(path: Path) -> None:
    size = path.stat().st_size
    with path.open("ab") as file:
        file.write(b"\x93\x01\x02\x03")
    with pytest.raises(RecordingError, match=f"no entry of a journal at byte {size}"):
        list(read_journal(path))
    with pytest.raises(RecordingError, match="No such file"):
        list(read_journal(path.with_name("other")))


def test_an_entry_is_with_the_system_when_write_returns(tmp_path: Path) -> None:
    """Read while the file is open and before anything is flushed or closed."""
    journal = JournalFile(tmp_path / "journal.msgpack", epoch=1)
    for number in range(1, 4):
        journal.write([entry(number)])
        assert [e.number for e in read_journal(journal.path)] == list(range(1, number + 1))
    journal.close()


def test_a_full_disk_is_an_error_that_names_the_file() -> None:
    journal = JournalFile(Path("/dev/full"), epoch=1)
    with pytest.raises(RunError, match="cannot write the journal /dev/full: No space left"):
        journal.write([entry(1)])
    journal.close()


def test_a_journal_that_cannot_be_opened_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=f"cannot write the journal {tmp_path}"):
        JournalFile(tmp_path, epoch=1)
