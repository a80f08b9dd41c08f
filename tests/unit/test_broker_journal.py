"""The journal: readable back, also when it was cut off, and clear about a disk that is full."""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest
import zmq
from msgspec.structs import replace

from caviar_broker.core.events import Journal, Product
from caviar_broker.journal import JournalFile
from caviar_broker.journal_format import MAGIC, JournalReader
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
    entries = list(JournalReader(path))
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
    found = list(JournalReader(tmp_path / "journal.msgpack"))
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
    found = list(JournalReader(tmp_path / "journal.msgpack"))
    assert [[p[2] for p in e.products] for e in found] == [[b"a" * 100_000], [], [b"b" * 70_000]]


def test_a_later_broker_appends(path: Path) -> None:
    journal = JournalFile(path, epoch=4)
    journal.write([entry(51)])
    journal.close()
    assert [(e.number, e.epoch) for e in JournalReader(path)][-2:] == [(50, 3), (51, 4)]


def test_wherever_it_is_cut_off_the_whole_entries_before_are_read(path: Path) -> None:
    data = path.read_bytes()
    ends = []
    for cut in range(len(data) - 2500, len(data), 7):
        path.write_bytes(data[:cut])
        ends.append(len(list(JournalReader(path))))
    assert ends == sorted(ends)
    assert set(ends) <= {47, 48, 49}


@pytest.mark.parametrize(
    "junk", [b"\0" * 3600, b"\x93\x01\x02\x03", b"\xff" * 100], ids=["zeros", "list", "ones"]
)
def test_what_is_no_entry_ends_the_log_and_is_named_with_its_place(path: Path, junk: bytes) -> None:
    size = path.stat().st_size
    with path.open("ab") as file:
        file.write(junk)
    reader = JournalReader(path)
    assert [entry.number for entry in reader] == list(range(1, 51))
    assert f"the entry at byte {size} is" in reader.problem
    assert reader.lost == len(junk)
    with pytest.raises(RecordingError, match="No such file"):
        list(JournalReader(path.with_name("other")))


def test_no_bit_that_flips_goes_unnoticed(path: Path) -> None:
    """500 of them, anywhere; what is before it is read as it was."""
    data = bytearray(path.read_bytes())
    whole = list(JournalReader(path))
    rng = random.Random(1)
    for bit in rng.sample(range(len(data) * 8), 500):
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        reader = JournalReader(path)
        found = list(reader)
        assert reader.problem, f"bit {bit} was flipped, and nothing is said"
        assert found == whole[: len(found)]
        assert reader.end <= bit // 8 < reader.size
        data[bit // 8] ^= 1 << bit % 8


@pytest.mark.parametrize("lost", [0, 1, 20, 48])
def test_an_entry_that_is_lost_or_out_of_its_place_ends_the_log(path: Path, lost: int) -> None:
    reader, ends = JournalReader(path), [len(MAGIC)]
    for _ in reader:
        ends.append(reader.end)
    data = path.read_bytes()
    path.write_bytes(data[: ends[lost]] + data[ends[lost + 1] :])
    again = JournalReader(path)
    assert len(list(again)) == lost
    assert "damaged" in again.problem


def test_a_journal_without_checksums_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "journal.msgpack"
    path.write_bytes(msgspec.msgpack.encode({"number": 1, "epoch": 1, "episode": 0, "frame": 0}))
    with pytest.raises(RecordingError, match=r"without checksums.*version"):
        JournalReader(path)


def test_what_is_cut_off_a_damaged_journal_is_kept_beside_it(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    whole = list(JournalReader(path))
    journal = JournalFile(path, epoch=4)
    journal.write([entry(51)])
    journal.close()
    assert list(JournalReader(path))[:-1] == whole
    cut = path.with_name("journal.msgpack.cut").read_bytes()
    assert data.endswith(cut)
    assert len(data) - len(cut) < len(data) // 2


def test_an_entry_is_with_the_system_when_write_returns(tmp_path: Path) -> None:
    """Read while the file is open and before anything is flushed or closed."""
    journal = JournalFile(tmp_path / "journal.msgpack", epoch=1)
    for number in range(1, 4):
        journal.write([entry(number)])
        assert [e.number for e in JournalReader(journal.path)] == list(range(1, number + 1))
    journal.close()


def test_a_full_disk_is_an_error_that_names_the_file() -> None:
    with pytest.raises(RunError, match="/dev/full: No space left"):
        JournalFile(Path("/dev/full"), epoch=1)


def test_an_entry_that_the_system_takes_in_part_is_not_in_the_journal(
    monkeypatch: pytest.MonkeyPatch, path: Path
) -> None:
    """What is written when there is room again can be read."""
    whole = os.writev

    def partly(fd: int, pieces: Sequence[bytes]) -> int:
        if len(pieces[0]) < 1000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return whole(fd, [bytes(pieces[0][:700])])

    journal = JournalFile(path, epoch=4)
    with monkeypatch.context() as patch:
        patch.setattr(os, "writev", partly)
        with pytest.raises(RunError, match="No space left"):
            journal.write([entry(51, b"x" * 1000)])
    journal.write([entry(52)])
    journal.close()
    assert [e.number for e in JournalReader(path)] == [*range(1, 51), 52]


def test_a_journal_that_cannot_be_opened_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=f"cannot write the journal {tmp_path}"):
        JournalFile(tmp_path, epoch=1)
