"""The bytes of a journal: entries with a checksum each, chained, so that the log ends at the first bad one.

A journal begins with `MAGIC`. An entry is its length [B] (8 bytes, little-endian), a CRC-32 (4 bytes) and a
msgpack map, `JournalEntry`. The CRC covers length and map, and starts from the CRC of the entry before (the
first one's from that of `MAGIC`). So an entry that is changed, cut off, missing or out of its place ends the
log, and so do zeros, which a file system may leave at the end of a file after a loss of power.
"""

from __future__ import annotations

import struct
import zlib
from array import array
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import msgspec

from caviar_broker.core.run import Snapshot
from caviar_protocol.errors import RecordingError
from caviar_protocol.files import map_regular
from caviar_protocol.messages import GeometryChange, GrantInput

MAGIC = b"CAVIAR journal 2\n"
HEAD = struct.Struct("<QI")
"""Length and CRC-32 of an entry."""
MAGIC_CRC = zlib.crc32(MAGIC)
NO_BROKER = 0
"""Epoch in the journal of a run in one process, which has no broker and no record; brokers count from 1."""


class JournalEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One entry of the journal: what became of one service's part of one frame, or a turn of the run;
    see `caviar_broker.core.events.Journal`.

    ``snapshot`` opens a compacted journal: the run up to ``frame``. Entries of earlier frames after it are
    those that a grant may still need.
    """

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
    digest: str = ""
    """SHA-256 of that state; of a snapshot, the digest of the run."""
    geometry: GeometryChange | None = None
    """Meshes that a world has from a frame on."""
    run: str = ""
    """Id of the run, in the first entry of an episode and in a snapshot: a journal opens with either."""
    products: tuple[tuple[str, bytes, bytes], ...] = ()
    """(topic, payload header, body) of products that a later frame may consume, or a service that
    comes back (clause 18). Last, so that the body of the last one ends the entry: it is written from where
    it lies."""


class JournalReader:
    """The whole entries of a journal, in the order in which they were written.

    ``problem`` says why the log ends before the file does; it is empty where it does not.

    Raises:
        RecordingError: The file cannot be read or is a journal of another format.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problem = ""
        try:
            self._data = map_regular(path)
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise RecordingError(f"cannot read the journal {path}: {reason}") from error
        self.size = len(self._data)
        """Of the file [B]."""
        self.end, self.crc = 0, MAGIC_CRC
        """End of the last whole entry [B], and its CRC."""
        if self._data[: len(MAGIC)] == MAGIC:
            self.end = len(MAGIC)
        elif self.size and (self._data[0] & 0xF0 == 0x80 or self._data[0] == 0xDE):
            raise RecordingError(
                f"{path} is a journal without checksums, of a version before this one: "
                "resume that run with the version that began it"
            )
        elif self.size:
            self.problem = f"{path}: it does not begin as a journal"

    @property
    def lost(self) -> int:
        """Bytes past the end of the log."""
        return self.size - self.end

    def __iter__(self) -> Iterator[JournalEntry]:
        decoder = msgspec.msgpack.Decoder(JournalEntry)
        for payload in self.payloads():
            try:
                entry = decoder.decode(payload)
            except msgspec.MsgspecError as error:
                # Its CRC is right: not damage, but another program.
                place = f"before byte {self.end}"
                raise RecordingError(f"{self.path}: the entry {place} is none: {error}") from error
            yield entry

    def payloads(self) -> Iterator[memoryview]:
        """The bytes of the entries, each with `end` after it."""
        while self.end >= len(MAGIC) and self.end < self.size:
            start = self.end + HEAD.size
            if start > self.size:
                self.problem = f"{self.path}: the entry at byte {self.end} is cut off"
                return
            # Compared with what is there before anything is sliced: a damaged length may be any number.
            length, crc = HEAD.unpack_from(self._data, self.end)
            if length > self.size - start:
                self.problem = f"{self.path}: the entry at byte {self.end} is cut off or damaged"
                return
            payload = self._data[start : start + length]
            # Chained: an entry of another journal, or one that was moved, has the wrong CRC though it is
            # whole.
            if entry_head(self.crc, payload)[1] != crc:
                self.problem = f"{self.path}: the entry at byte {self.end} is damaged, its CRC-32 differs"
                return
            self.end, self.crc = start + length, crc
            yield payload


def run_of_journal(path: Path) -> str:
    """Id of the run that a journal is of; empty where it does not say, as those of earlier versions.

    Raises:
        RecordingError: The file cannot be read or is a journal of another format.
    """
    return next((entry.run for entry in JournalReader(path)), "")


def entry_head(before: int, *pieces: bytes | memoryview) -> tuple[bytes, int]:
    """The head of an entry after the one with the CRC ``before``, and its CRC; its bytes are ``pieces``."""
    length = sum(map(len, pieces))
    # The length is covered too: a damaged one must not be taken for that of a longer entry.
    crc = zlib.crc32(length.to_bytes(8, "little"), before)
    for piece in pieces:
        crc = zlib.crc32(piece, crc)
    return HEAD.pack(length, crc), crc


class EntryLocation(NamedTuple):
    """An entry by what decides whether it is needed, and its place in the file."""

    episode: int
    frame: int
    service: str
    outcome: str
    topics: tuple[str, ...]
    """Of the products in it."""
    offset: int
    """Of its payload [B]."""
    length: int

    @classmethod
    def locate(cls, entry: JournalEntry, offset: int, length: int) -> EntryLocation:
        """The place of an entry."""
        topics = tuple([product[0] for product in entry.products])
        return cls(entry.episode, entry.frame, entry.service, entry.outcome, topics, offset, length)


class EntryIndex:
    """The places of the entries of a journal, in 40 B each: they are kept until the next compaction."""

    def __init__(self) -> None:
        # Episode, frame, offset and length of each.
        self._numbers = array("q")
        # Service, outcome and topics of each.
        self._kinds: list[tuple[str, str, tuple[str, ...]]] = []
        self._known: dict[tuple[str, str, tuple[str, ...]], tuple[str, str, tuple[str, ...]]] = {}

    def extend(self, entries: Iterable[EntryLocation]) -> None:
        """Note entries after those that are known."""
        for entry in entries:
            kind = entry.service, entry.outcome, entry.topics
            # One tuple for all entries of a kind; a run has a few kinds and millions of entries.
            self._kinds.append(self._known.setdefault(kind, kind))
            self._numbers.extend((entry.episode, entry.frame, entry.offset, entry.length))

    def __iter__(self) -> Iterator[EntryLocation]:
        numbers = iter(self._numbers)
        columns = zip(numbers, numbers, numbers, numbers, strict=True)
        for (episode, frame, offset, length), kind in zip(columns, self._kinds, strict=True):
            yield EntryLocation(episode, frame, *kind, offset, length)


def entries_to_keep(entries: Iterable[EntryLocation], snapshot: Snapshot) -> tuple[int, list[EntryLocation]]:
    """Entries that are needed beside a snapshot, in order, and the frame from which all are there.

    That frame is the last finished one, or that of the oldest among the services' newest states of a
    finished frame: what came since is granted again to a service that comes back. Of earlier frames the
    newest products remain, which may be held, and how agents end the episode.

    Args:
        entries: Of the journal, in order.
        snapshot: The run up to its last finished frame.
    """
    live = [
        entry
        for entry in _in_force(entries)
        if entry.episode > snapshot.episode
        or (entry.episode == snapshot.episode and entry.outcome != "episode")
    ]
    saved: dict[str, int] = {}
    for entry in live:
        is_finished = entry.episode == snapshot.episode and entry.frame < snapshot.finished
        if entry.outcome == "checkpoint" and is_finished:
            saved[entry.service] = max(entry.frame, saved.get(entry.service, -1))
    base = min([snapshot.finished - 1, *saved.values()])
    newest: dict[tuple[str, str], EntryLocation] = {}
    for entry in live:
        if entry.episode == snapshot.episode and entry.frame < base:
            for topic in entry.topics:
                before = newest.get((entry.service, topic))
                if before is None or entry.frame >= before.frame:
                    newest[entry.service, topic] = entry
    held = {entry.offset for entry in newest.values()}
    return base, [
        entry
        for entry in live
        if entry.episode > snapshot.episode
        or entry.frame >= base
        or entry.offset in held
        or entry.outcome in ("end", "seed", "geometry")
    ]


def _in_force(entries: Iterable[EntryLocation]) -> list[EntryLocation]:
    """Entries without those that a broker decided anew, and without what a snapshot replaces."""
    found: list[EntryLocation] = []
    for entry in entries:
        if entry.outcome == "resumed":
            found = [e for e in found if (e.episode, e.frame) < (entry.episode, entry.frame)]
        elif entry.outcome == "episode":
            found = [e for e in found if e.episode < entry.episode]
            found.append(entry)
        elif entry.outcome != "snapshot":
            found.append(entry)
    return found
