"""The journal: every decision of a run, handed to the operating system before it is relied on."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
import msgspec

from caviar_broker.checkpoints import CheckpointFiles
from caviar_broker.core.events import Journal
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.messages import GrantInput


class JournalEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One entry of the journal: what became of one service's part of one frame, or a turn of the run;
    see `caviar_broker.core.events.Journal`."""

    number: int
    epoch: int
    episode: int
    frame: int
    service: str
    outcome: str
    decisions: tuple[GrantInput, ...] = ()
    chosen: dict[str, str] = {}
    """Decisions that the service took."""
    facts: dict[str, int] = {}
    members: tuple[str, ...] = ()
    file: str = ""
    """Of the service's state, in ``checkpoints/``."""
    products: tuple[tuple[str, bytes, bytes], ...] = ()
    """(topic, payload header, body) of products that a later frame may consume, or a service that
    comes back (clause 18). Last, so that the body of the last one ends the entry: it is written from where
    it lies."""


_NO_BYTES = b"\xc4\x00"
"""An empty body, as msgpack writes it."""
_UNCOPIED = 1 << 16
"""[B] from which a body is written without a copy; below, one more piece costs more."""


class JournalFile:
    """Append-only msgpack stream of `JournalEntry`.

    ``os.write`` returns once the kernel has the bytes, so they outlive this process; that, and not
    a flush to the disk for each frame, is what clause 18 asks for.
    """

    def __init__(self, path: Path, epoch: int, checkpoints: CheckpointFiles | None = None) -> None:
        self.path, self._epoch = path, epoch
        self.checkpoints = checkpoints or CheckpointFiles(path.parent)
        self._encoder = msgspec.msgpack.Encoder()
        self._buffer = bytearray()
        try:
            self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise RunError(f"cannot write the journal {path}: {error.strerror}") from error

    def write(self, entries: Iterable[Journal]) -> None:
        """Append entries. `RunError` naming the file where the system refuses them."""
        data = self._buffer
        data.clear()
        pieces: list[bytes | memoryview] = []
        saved = False
        for entry in entries:
            record = self._record(entry)
            saved |= bool(record.file)
            body = record.products[-1][2] if record.products else b""
            if len(body) < _UNCOPIED:
                self._encoder.encode_into(record, data, -1)
                continue
            topic, header, _ = record.products[-1]
            products = (*record.products[:-1], (topic, header, b""))
            self._encoder.encode_into(msgspec.structs.replace(record, products=products), data, -1)
            del data[-len(_NO_BYTES) :]
            data += b"\xc6" + len(body).to_bytes(4, "big")
            pieces += [bytes(data), body]
            data.clear()
        pieces.append(bytes(data))
        self._put(pieces)
        if saved:
            self.checkpoints.prune()

    def _put(self, pieces: Sequence[bytes | memoryview]) -> None:
        """Hand over all of it; Linux takes 2 GiB at once at most."""
        while pieces:
            try:
                written = os.writev(self._fd, pieces)
            except OSError as error:
                raise RunError(f"cannot write the journal {self.path}: {error.strerror}") from error
            pieces = _behind(pieces, written)

    def _record(self, entry: Journal) -> JournalEntry:
        products: tuple[tuple[str, Any, Any], ...] = tuple(
            (p.topic, memoryview(p.payload[0]), memoryview(p.payload[1])) for p in entry.products
        )
        file = ""
        if entry.state is not None:
            file = self.checkpoints.save(entry.service, entry.episode, entry.frame, entry.state)
        return JournalEntry(
            chosen=dict(entry.chosen or {}),
            facts=dict(entry.facts or {}),
            members=entry.members,
            file=file,
            number=entry.number,
            epoch=self._epoch,
            episode=entry.episode,
            frame=entry.frame,
            service=entry.service,
            outcome=entry.outcome,
            decisions=entry.decisions,
            products=products,
        )

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)


def _behind(pieces: Sequence[bytes | memoryview], written: int) -> list[bytes | memoryview]:
    """What of these is left to be written."""
    left: list[bytes | memoryview] = []
    for piece in pieces:
        if written < len(piece):
            left.append(memoryview(piece)[written:])
        written = max(0, written - len(piece))
    return left


def mend_journal(path: Path) -> None:
    """Cut off an entry that was not written whole, so that others can follow.

    Raises `RecordingError` naming the place of what is no entry.
    """
    if not path.exists():
        return
    whole = 0
    with path.open("rb") as file:
        unpacker = msgpack.Unpacker(file, max_buffer_size=0)
        while True:
            try:
                unpacker.skip()
            except msgpack.OutOfData:
                break
            except (ValueError, msgpack.UnpackException) as error:
                raise RecordingError(f"{path}: no entry of a journal at byte {whole}: {error}") from error
            whole = unpacker.tell()
    os.truncate(path, whole)


def read_journal(path: Path) -> Iterator[JournalEntry]:
    """The entries of a journal, in the order in which they were written.

    An entry that is cut off at the end, as a crash in the middle of writing leaves it, ends the
    sequence. Raises `RecordingError` naming the place of what is no entry.
    """
    try:
        file = path.open("rb")
    except OSError as error:
        raise RecordingError(f"cannot read the journal {path}: {error.strerror}") from error
    with file:
        unpacker = msgpack.Unpacker(file, max_buffer_size=0)
        while True:
            place = unpacker.tell()
            try:
                yield msgspec.convert(unpacker.unpack(), JournalEntry)
            except msgpack.OutOfData:
                return
            except (ValueError, msgpack.UnpackException) as error:
                raise RecordingError(f"{path}: no entry of a journal at byte {place}: {error}") from error
