"""A journal beside the frames: a slow, frozen or missing disk stops nothing but what relies on it.

Clause 18 says that nothing relies on an entry before it is handed over: `JournalThread.confirmed` counts
entries for which ``write`` has returned, so that they outlive the broker's process, and that under
``durability = "frame"`` are on the disk. Under ``periodic`` another thread puts the recording, then the
journal on the disk twice in `SYNC_PERIOD_S`; where that takes longer, no more entries are confirmed, so that
no more than `SYNC_PERIOD_S` of the run is in danger.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from caviar_broker.core.events import Journal
from caviar_broker.core.resumption import Snapshot
from caviar_broker.journal import JournalFile
from caviar_protocol.durability import SYNC_PERIOD_S, Durability
from caviar_protocol.errors import RunError

BRIEFLY_S = 0.002
"""[s] for which `JournalThread.submit` waits: an entry is written in some 0.03 ms."""
END_S = 2.0
"""[s] that closing waits for the disk."""


class _Batch:
    """Entries that are handed over together."""

    __slots__ = ("awaited", "done", "entries", "finished", "snapshot")

    def __init__(
        self, entries: Sequence[Journal], finished: tuple[int, int], snapshot: Snapshot | None
    ) -> None:
        self.entries, self.finished, self.snapshot = entries, finished, snapshot
        self.done = threading.Lock()
        self.done.acquire()
        self.awaited = True
        """Whether `submit` still waits; else the descriptor tells."""


class JournalThread:
    """Writes a journal in a thread, and puts it on the disk as ``durability`` says.

    One batch is under way at a time: what comes meanwhile waits with the caller, who grants nothing that
    relies on it, so it is bounded by the frames in flight.

    Parameters
    ----------
    file
        The journal; its owner closes it behind `close`.
    durability
        When entries have to be on the disk.
    sync_recording
        Puts the recording on the disk, as far as it is handed over; under ``frame`` the recorder did so
        before it answered.
    """

    def __init__(
        self,
        file: JournalFile,
        durability: Durability = "none",
        sync_recording: Callable[[], None] = lambda: None,
    ) -> None:
        self._file, self._durability, self._sync_recording = file, durability, sync_recording
        self.fd = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        """Readable once a batch that `submit` did not wait for is confirmed, or failed."""
        self.confirmed = 0
        """All entries up to this number are handed over."""
        self.error: RunError | None = None
        """Why no more entries are confirmed."""
        self._batches: queue.SimpleQueue[_Batch | None] = queue.SimpleQueue()
        self._batch: _Batch | None = None
        """The one that was submitted last."""
        self._last = 0
        """Number of the last entry that was submitted."""
        self._compacting = False
        self._since: float | None = None
        """When the batch that is under way was handed to the thread [s]."""
        self._doing = ""
        self._finished = (0, -1)
        """(episode, frame) that was finished last by the entries in the file."""
        self._clean = threading.Condition()
        self._dirty_since: float | None = None
        """When the first entry was written that the next sync will cover [s]."""
        self._syncing_since: float | None = None
        """The same of the sync that is under way."""
        self._over = False
        self._threads = [threading.Thread(target=self._write_all, name="journal", daemon=True)]
        if durability == "periodic":
            self._threads.append(threading.Thread(target=self._sync_all, name="journal sync", daemon=True))
        for thread in self._threads:
            thread.start()

    # --- the caller's side ---------------------------------------------------------------------------

    @property
    def path(self) -> Path:
        """Of the file."""
        return self._file.path

    @property
    def busy(self) -> bool:
        """Whether a batch is under way."""
        return self._since is not None

    @property
    def wants_snapshot(self) -> bool:
        """Whether the journal is to be compacted."""
        return not self._compacting and self._file.is_long

    def submit(
        self,
        entries: Sequence[Journal],
        finished: tuple[int, int],
        snapshot: Snapshot | None = None,
        *,
        wait: bool = True,
    ) -> None:
        """Hand entries to the thread. Only while none are under way.

        Parameters
        ----------
        entries
            In order.
        finished
            (episode, frame) that is finished with these entries.
        snapshot
            Of the same instant, where one is wanted.
        wait
            Whether a grant waits for them: then this waits, too, for `BRIEFLY_S`. To hand over to a thread
            and back costs 0.1 ms and more, which is better spent on messages where nothing waits.
        """
        batch = self._batch = _Batch(entries, finished, snapshot)
        self._last = batch.entries[-1].number
        self._compacting |= snapshot is not None
        self._since = time.monotonic()
        batch.awaited = wait and self._durability != "frame"
        self._batches.put(batch)
        if wait and not self.wait():
            batch.awaited = False
            self._look_whether_through()

    def wait(self) -> bool:
        """Wait `BRIEFLY_S` for the batch that is under way; whether it is through."""
        batch = self._batch
        if batch is None or self._since is None:
            return True
        if self._durability != "frame" and batch.done.acquire(timeout=BRIEFLY_S):
            self._since = None
            return True
        return False

    def take_note(self) -> None:
        """The descriptor is readable: the batch that was under way is confirmed, or failed."""
        os.eventfd_read(self.fd)
        self._look_whether_through()

    def _look_whether_through(self) -> None:
        if self.error is not None or self.confirmed >= self._last:
            self._since = None

    def waiting_s(self) -> tuple[float, str]:
        """For how long the batch that is under way has waited [s], and for what."""
        since, doing = self._since, self._doing
        return (0.0, "") if since is None else (time.monotonic() - since, doing)

    def close(self) -> bool:
        """Put everything on the disk and end; False where the disk takes nothing for `END_S`."""
        self._batches.put(None)
        with self._clean:
            self._over = True
            self._clean.notify_all()
        until = time.monotonic() + END_S
        for thread in self._threads:
            thread.join(max(0.0, until - time.monotonic()))
        if any(thread.is_alive() for thread in self._threads):
            return False
        os.close(self.fd)
        return True

    # --- the thread that writes ------------------------------------------------------------------------

    def _write_all(self) -> None:
        while (batch := self._batches.get()) is not None:
            if self.error is None:
                try:
                    self._write(batch)
                except RunError as error:
                    self.error = error
            if self.error is None:
                self.confirmed = batch.entries[-1].number
            batch.done.release()
            if not batch.awaited:
                os.eventfd_write(self.fd, 1)
            if self.error is None and batch.snapshot is not None:
                self._compact(batch.snapshot)
        if self._durability != "none" and self.error is None:
            self._sync()

    def _write(self, batch: _Batch) -> None:
        self._doing = "write"
        self._file.write(batch.entries)
        self._finished = batch.finished
        if self._durability == "none":
            self._file.checkpoints.finished = batch.finished
        elif self._durability == "frame":
            self._sync()
        else:
            self._wait_for_sync()

    def _compact(self, snapshot: Snapshot) -> None:
        try:
            self._doing = "compaction"
            if self._durability != "none":
                self._sync()
            self._file.compact(snapshot)
        except RunError as error:
            self.error = error
        self._compacting = False

    def _wait_for_sync(self) -> None:
        """Under ``periodic``: not more than a period of the run may depend on what is not on the disk."""
        now = time.monotonic()
        with self._clean:
            if self._dirty_since is None:
                self._dirty_since = now
            self._doing = "fsync"
            self._clean.wait_for(lambda: self._over or not self._is_overdue())

    def _is_overdue(self) -> bool:
        oldest = self._dirty_since if self._syncing_since is None else self._syncing_since
        return oldest is not None and time.monotonic() - oldest > SYNC_PERIOD_S

    # --- the thread that synchronises --------------------------------------------------------------------

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
        self._doing, finished = "fsync", self._finished
        if self._durability == "periodic":
            self._sync_recording()
        self._file.sync()
        self._file.checkpoints.finished = finished
