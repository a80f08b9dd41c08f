"""The journal: every decision of a run, handed to the operating system before it is relied on.

`JournalFile` writes entries, puts them on the disk and compacts itself, in the thread that calls it.

Writer of the journal: when entries count as handed over, and when they go to the disk.

Clause 18 says that nothing relies on an entry before it is handed over: `JournalWriter.confirmed` counts
entries for which ``write`` has returned, so that they outlive the broker's process, and that under
``durability = "frame"`` are on the disk. Under ``periodic`` a thread puts the recording, then the journal on
the disk twice in `SYNC_PERIOD_S`; where that takes longer, no more entries are confirmed, so that no more
than `SYNC_PERIOD_S` of the run is in danger.
"""

from __future__ import annotations

import errno
import hashlib
import os
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Any

import msgspec

from caviar_broker.core.events import Journal
from caviar_broker.core.run import Snapshot
from caviar_broker.event_loop import call_with_timeout
from caviar_broker.journal_format import (
    HEAD,
    MAGIC,
    MAGIC_CRC,
    EntryIndex,
    EntryLocation,
    JournalEntry,
    JournalReader,
    entries_to_keep,
    entry_head,
)
from caviar_protocol.errors import RunError
from caviar_protocol.files import SYNC_PERIOD_S, Durability, read_regular, replace_file, sync_file
from caviar_protocol.run_directory import RunDirectory


class CheckpointFiles:
    """``checkpoints/NAME-EPISODE-FRAME.bin`` in the directory of a run.

    A file is there as a whole or not at all. Kept of each service are the newest one of a frame that
    is finished, since a broker that resumes continues after the last finished frame, and all later ones.

    Args:
        directory: Of the run.
        durable: Whether a state has to be on the disk before an older one may go.
    """

    def __init__(self, directory: Path, *, durable: bool = False) -> None:
        self._folder, self._durable = RunDirectory(directory).checkpoints, durable
        self.finished = (0, -1)
        """(episode, frame) that was finished last, and will be so for a broker that resumes."""
        # Files of each service by (episode, frame), in that order.
        self._kept: dict[str, dict[tuple[int, int], Path]] = {}
        # Files that are not named by an entry of the journal yet.
        self._saved: list[Path] = []
        # Files that are, and may not be on the disk.
        self._unsynced: list[Path] = []
        self._synced: set[Path] = set()

    def save(self, service: str, episode: int, frame: int, state: Any) -> tuple[str, str]:
        """Write a state; its file's name and SHA-256. `RunError` naming the file where that fails.

        Args:
            service: Whose state it is.
            episode: Of the checkpoint.
            frame: After which the state was taken.
            state: Its bytes.
        """
        path, data = self._folder / f"{service}-{episode}-{frame}.bin", memoryview(state)
        try:
            self._folder.mkdir(exist_ok=True)
            replace_file(path, data, durable=False)
        except OSError as error:
            raise RunError(f"cannot write the state of {service!r} to {path}: {error.strerror}") from error
        self._kept.setdefault(service, {})[episode, frame] = path
        self._synced.discard(path)
        self._saved.append(path)
        return path.name, hashlib.sha256(data).hexdigest()

    def note_entered(self) -> None:
        """The journal names what was saved: remove what nothing needs any more."""
        self._unsynced += self._saved
        self._saved = []
        for kept in self._kept.values():
            safe = [i for i in kept if i <= self.finished and (not self._durable or kept[i] in self._synced)]
            for instant in safe[:-1]:
                path = kept.pop(instant)
                self._synced.discard(path)
                path.unlink(missing_ok=True)

    def sync(self) -> list[Path]:
        """Put on the disk what the journal names; these files. `RunError` where that fails."""
        paths, self._unsynced = self._unsynced, []
        try:
            for path in paths:
                with suppress(FileNotFoundError):  # it was removed meanwhile
                    sync_file(path)
            if paths:
                sync_file(self._folder)
                sync_file(self._folder.parent)
        except OSError as error:
            raise RunError(f"cannot write states to {self._folder}: {error.strerror}") from error
        return paths

    def note_synced(self, paths: Iterable[Path]) -> None:
        """These files and the entries that name them are on the disk."""
        self._synced.update(paths)

    def load(self, service: str, file: str, digest: str) -> bytes | None:
        """A state that was saved before a restart of the broker; None where it is gone, or is another.

        Args:
            service: Whose state it is.
            file: Its name in ``checkpoints/``.
            digest: SHA-256 that the journal has of it.
        """
        path = self._folder / file
        try:
            state = read_regular(path)
        except OSError:
            return None
        if hashlib.sha256(state).hexdigest() != digest:
            return None
        *_, episode, frame = path.stem.rsplit("-", 2)
        self._kept.setdefault(service, {})[int(episode), int(frame)] = path
        self._synced.add(path)
        return state


COMPACT_BYTES = 8 << 20
"""[B] that a journal grows by before it is compacted."""
CUT_SUFFIX = ".cut"
"""Of the file that keeps what was cut off a damaged journal."""
# That one call of ``writev`` takes.
_MOST_PIECES = 1024
# An empty body, as msgpack writes it.
_NO_BYTES = b"\xc4\x00"
# Errors of `os.fsync` for what no disk is behind: a pipe, a device, a file system in memory.
_UNSYNCABLE = frozenset({errno.EINVAL, errno.EROFS, errno.ENOTSUP})
# [B] from which a body is written without a copy; below, one more piece costs more.
_UNCOPIED = 1 << 16


class JournalFile:
    """Append-only file of `JournalEntry`, in the format of `caviar_broker.journal_format`.

    When `write` returns the kernel has the bytes, so they outlive this process. `sync` puts them on the
    disk. Both and `compact` may be called from different threads, `write` and `compact` from one.

    Args:
        path: The file; one that exists is continued after its last whole entry.
        epoch: Of the broker that writes.
        checkpoints: Where the states of services go; by default beside the journal.
        end: Where to go on [B]; what is past it is kept in a file of its own. By default the end of the
            log.
        run: Id of the run, by which a journal in the directory of another run is noticed.
        durable: Whether what is compacted has to be on the disk before it takes the place of what was there.

    Raises:
        RunError: The file cannot be opened.
        RecordingError: The file is no journal.
    """

    def __init__(
        self,
        path: Path,
        epoch: int,
        checkpoints: CheckpointFiles | None = None,
        end: int | None = None,
        *,
        run: str = "",
        durable: bool = False,
    ) -> None:
        self._run = run
        self.path, self._epoch, self._durable = path, epoch, durable
        self.checkpoints = checkpoints or CheckpointFiles(path.parent, durable=durable)
        self._encoder = msgspec.msgpack.Encoder()
        # Held while the file is replaced, or its descriptor taken.
        self._lock = Lock()
        self._entries = EntryIndex()
        self._number, self._crc, self.size = 0, MAGIC_CRC, 0
        self._compacted_size = 0
        if path.is_file() and path.stat().st_size:
            self._continue_log(end)
        try:
            self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise self._failed(error) from error
        if not self.size:
            self._put([MAGIC])
            self.size = len(MAGIC)

    # --- writing -------------------------------------------------------------------------------------

    def write(self, entries: Iterable[Journal]) -> None:
        """Append entries. `RunError` naming the file where the system refuses them; then none is in it."""
        pieces: list[bytes | memoryview] = []
        crc, size, located, saved = self._crc, self.size, list[EntryLocation](), False
        for entry in entries:
            record = self._record(entry)
            saved |= bool(record.file)
            payload = self._encoded(record)
            head, crc = entry_head(crc, *payload)
            pieces += (head, *payload)
            length = sum(map(len, payload))
            located.append(EntryLocation.locate(record, size + HEAD.size, length))
            size += HEAD.size + length
        self._put(pieces)
        self._crc, self.size = crc, size
        self._entries.extend(located)
        if saved:
            self.checkpoints.note_entered()

    def _encoded(self, record: JournalEntry) -> tuple[bytes | memoryview, ...]:
        """A record in one piece, or two where its last product is large."""
        body = record.products[-1][2] if record.products else b""
        if len(body) < _UNCOPIED:
            return (self._encoder.encode(record),)
        topic, header, _ = record.products[-1]
        short = msgspec.structs.replace(record, products=(*record.products[:-1], (topic, header, b"")))
        data = self._encoder.encode(short).removesuffix(_NO_BYTES)
        return data + b"\xc6" + len(body).to_bytes(4, "big"), body

    def _record(self, entry: Journal) -> JournalEntry:
        products: tuple[tuple[str, Any, Any], ...] = tuple(
            (p.topic, memoryview(p.payload[0]), memoryview(p.payload[1])) for p in entry.products
        )
        file = digest = ""
        if entry.state is not None:
            file, digest = self.checkpoints.save(entry.service, entry.episode, entry.frame, entry.state)
        self._number = entry.number
        return JournalEntry(
            chosen=dict(entry.chosen or {}),
            facts=dict(entry.facts or {}),
            members=entry.members,
            file=file,
            digest=digest,
            number=entry.number,
            epoch=self._epoch,
            episode=entry.episode,
            frame=entry.frame,
            service=entry.service,
            outcome=entry.outcome,
            decisions=entry.decisions,
            geometry=entry.geometry,
            run=self._run if entry.outcome == "episode" else "",
            products=products,
        )

    def _put(self, pieces: Sequence[bytes | memoryview]) -> None:
        """Hand over all of it, or nothing; Linux takes 2 GiB at once at most."""
        try:
            while pieces:
                pieces = _behind(pieces, os.writev(self._fd, pieces[:_MOST_PIECES]))
        except OSError as error:
            with suppress(OSError):
                os.ftruncate(self._fd, self.size)  # half an entry would end the log for what may follow
            raise self._failed(error) from error

    # --- on the disk ---------------------------------------------------------------------------------

    def sync(self) -> None:
        """Put on the disk what was written when this was called: states first, which entries name.

        `RunError` naming the file where the system cannot.
        """
        states = self.checkpoints.sync()
        with self._lock:
            fd = os.dup(self._fd)
        try:
            os.fsync(fd)
        except OSError as error:
            if error.errno not in _UNSYNCABLE:
                raise self._failed(error) from error
        finally:
            os.close(fd)
        self.checkpoints.note_synced(states)

    @property
    def is_long(self) -> bool:
        """Whether it is time to compact."""
        return self.size >= max(COMPACT_BYTES + self._compacted_size, 2 * self._compacted_size)

    def compact(self, snapshot: Snapshot) -> None:
        """Drop what nothing needs any more, now that the frames of a snapshot are safe in the recording.

        The new file takes the place of the old one in one step. `RunError` naming it where that fails.
        """
        base, kept = entries_to_keep(self._entries, snapshot)
        # Not `replace_file`: the journal goes on in the descriptor of the new file.
        partial = self.path.with_name(self.path.name + ".partial")
        try:
            fd = os.open(partial, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND | os.O_CLOEXEC, 0o644)
            try:
                crc, size, moved = self._copy(fd, self._opening(snapshot, base), kept)
                if self._durable:
                    os.fsync(fd)
                with self._lock:
                    partial.replace(self.path)
                    self._fd, fd = fd, self._fd
            finally:
                os.close(fd)
            if self._durable:
                sync_file(self.path.parent)
        except OSError as error:
            raise self._failed(error) from error
        self._crc, self.size, self._entries = crc, size, EntryIndex()
        self._entries.extend(moved)
        self._compacted_size = size

    def _opening(self, snapshot: Snapshot, base: int) -> JournalEntry:
        return JournalEntry(
            number=self._number,
            epoch=self._epoch,
            episode=snapshot.episode,
            frame=snapshot.finished,
            service="",
            outcome="snapshot",
            facts={
                "seed": snapshot.seed,
                "seed_episode": snapshot.seed_episode,
                "frames": snapshot.frames,
                "finished_before": snapshot.finished_before,
                "base": base,
            },
            members=snapshot.members,
            digest=snapshot.digest,
            run=self._run,
        )

    def _copy(
        self, fd: int, opening: JournalEntry, kept: Sequence[EntryLocation]
    ) -> tuple[int, int, list[EntryLocation]]:
        """Write a new journal; its CRC, its size and where its entries are."""
        payload = self._encoder.encode(opening)
        head, crc = entry_head(MAGIC_CRC, payload)
        os.writev(fd, [MAGIC, head, payload])
        size, moved = len(MAGIC) + len(head) + len(payload), list[EntryLocation]()
        for entry in kept:
            payload = os.pread(self._fd, entry.length, entry.offset)
            head, crc = entry_head(crc, payload)
            pieces: Sequence[bytes | memoryview] = [head, payload]
            while pieces:
                pieces = _behind(pieces, os.writev(fd, pieces))
            moved.append(entry._replace(offset=size + HEAD.size))
            size += HEAD.size + entry.length
        return crc, size, moved

    # --- opening and closing ---------------------------------------------------------------------------

    def _continue_log(self, end: int | None) -> None:
        """Continue what another broker wrote; what is cut off is kept beside it."""
        reader = JournalReader(self.path)
        self.size = reader.end
        for entry in reader:
            if end is not None and reader.end > end:
                break
            offset = self.size + HEAD.size
            self._entries.extend([EntryLocation.locate(entry, offset, reader.end - offset)])
            self._crc, self._number, self.size = reader.crc, max(self._number, entry.number), reader.end
        if reader.size > self.size:
            cut = self.path.with_name(self.path.name + CUT_SUFFIX)
            try:
                with self.path.open("rb") as file:
                    file.seek(self.size)
                    rest = file.read()
                if any(rest):
                    cut.write_bytes(rest)
                os.truncate(self.path, self.size)
            except OSError as error:
                raise self._failed(error) from error

    def _failed(self, error: OSError) -> RunError:
        return RunError(f"cannot write the journal {self.path}: {error.strerror}")

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)


def _behind(pieces: Sequence[bytes | memoryview], written: int) -> list[bytes | memoryview]:
    """Rest of the buffers that is left to be written."""
    left: list[bytes | memoryview] = []
    for piece in pieces:
        if written < len(piece):
            left.append(memoryview(piece)[written:])
        written = max(0, written - len(piece))
    return left


END_S = 10.0
"""[s] that closing waits for the disk: a busy one takes seconds for the last entries."""


class JournalWriter:
    """Writes a journal, and puts it on the disk as ``durability`` says. `write` may wait for the disk.

    Args:
        file: The journal; its owner closes it after `close`.
        durability: When entries have to be on the disk.
        sync_recording: Puts the recording on the disk, as far as it is handed over; under ``frame`` the
            recorder did so before it answered.
    """

    def __init__(
        self,
        file: JournalFile,
        durability: Durability = "none",
        sync_recording: Callable[[], None] = lambda: None,
    ) -> None:
        self._file, self._durability, self._sync_recording = file, durability, sync_recording
        self.confirmed = 0
        """All entries up to this number are handed over."""
        self.error: RunError | None = None
        """Why no more entries are confirmed."""
        self.doing = ""
        """What `write` last began to wait for."""
        # (episode, frame) that was finished last by the entries in the file.
        self._finished = (0, -1)
        self._clean = threading.Condition()
        # When the first entry was written that the next sync will cover [s].
        self._dirty_since: float | None = None
        # The same of the sync that is under way.
        self._syncing_since: float | None = None
        self._over = False
        self._syncing = threading.Thread(target=self._sync_all, name="journal sync", daemon=True)
        if durability == "periodic":
            self._syncing.start()

    @property
    def path(self) -> Path:
        """Path of the file."""
        return self._file.path

    @property
    def wants_snapshot(self) -> bool:
        """Whether the journal is to be compacted."""
        return self._file.is_long

    def write(
        self, entries: Sequence[Journal], finished: tuple[int, int], snapshot: Snapshot | None = None
    ) -> None:
        """Write entries, until they are confirmed or `error` says why not.

        Args:
            entries: In order.
            finished: (episode, frame) that is finished with these entries.
            snapshot: Of the same instant, where one is wanted.
        """
        if self.error is not None:
            return
        try:
            self.doing = "write"
            self._file.write(entries)
            self._finished = finished
            if self._durability == "none":
                self._file.checkpoints.finished = finished
            elif self._durability == "frame":
                self.doing = "fsync"
                self._sync()
            else:
                self._wait_for_sync()
            if snapshot is not None:
                self.doing = "compaction"
                if self._durability != "none":
                    self._sync()
                self._file.compact(snapshot)
        except RunError as error:
            self.error = error
        if self.error is None:
            self.confirmed = entries[-1].number

    def close(self) -> bool:
        """Put everything on the disk; False where it takes nothing for `END_S`."""
        return call_with_timeout(self._end, END_S)

    def _end(self) -> None:
        with self._clean:
            self._over = True
            self._clean.notify_all()
        if self._durability == "periodic":
            self._syncing.join()
        if self._durability != "none" and self.error is None:
            try:
                self._sync()
            except RunError as error:
                self.error = error

    def _wait_for_sync(self) -> None:
        """Under ``periodic``: not more than a period of the run may depend on what is not on the disk."""
        now = time.monotonic()
        dirty, syncing = self._dirty_since, self._syncing_since
        if dirty is None or syncing is not None or now - dirty > SYNC_PERIOD_S:
            with self._clean:
                if self._dirty_since is None:
                    self._dirty_since = now
                self.doing = "fsync"
                # After an error of the thread that synchronises, no sync will come.
                self._clean.wait_for(lambda: self._over or self.error is not None or not self._is_overdue())

    def _is_overdue(self) -> bool:
        oldest = self._dirty_since if self._syncing_since is None else self._syncing_since
        return oldest is not None and time.monotonic() - oldest > SYNC_PERIOD_S

    def _sync_all(self) -> None:
        while not self._over and self.error is None:
            with self._clean:
                self._clean.wait_for(lambda: self._over, SYNC_PERIOD_S / 2)
                if self._over or self._dirty_since is None:
                    continue
                self._syncing_since, self._dirty_since = self._dirty_since, None
            try:
                self._sync()
            except RunError as error:
                self.error = error
            with self._clean:
                self._syncing_since = None
                self._clean.notify_all()

    def _sync(self) -> None:
        """The recording first, so that a journal on the disk is not ahead of it."""
        finished = self._finished
        if self._durability == "periodic":
            self._sync_recording()
        self._file.sync()
        self._file.checkpoints.finished = finished
