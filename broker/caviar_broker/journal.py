"""The journal: every decision of a run, handed to the operating system before it is relied on."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
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
    products: tuple[tuple[str, bytes, bytes], ...] = ()
    """(topic, payload header, body) of products that a later frame may consume, or a service that
    comes back (clause 18)."""
    facts: dict[str, int] = {}
    members: tuple[str, ...] = ()
    file: str = ""
    """Of the service's state, in ``checkpoints/``."""


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
        for entry in entries:
            self._encoder.encode_into(self._record(entry), data, -1)
        try:
            written = os.write(self._fd, data)
        except OSError as error:
            raise RunError(f"cannot write the journal {self.path}: {error.strerror}") from error
        if written != len(data):
            raise RunError(f"cannot write the journal {self.path}: no space left")

    def _record(self, entry: Journal) -> JournalEntry:
        products: tuple[tuple[str, Any, Any], ...] = tuple(
            (p.topic, memoryview(p.payload[0]), memoryview(p.payload[1])) for p in entry.products
        )
        file = ""
        if entry.state is not None:
            file = self.checkpoints.save(entry.service, entry.episode, entry.frame, entry.state)
        return JournalEntry(
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
