"""Writer of the journal: when entries count as handed over, and when they go to the disk.

Clause 18 says that nothing relies on an entry before it is handed over: `JournalWriter.confirmed` counts
entries for which ``write`` has returned, so that they outlive the broker's process, and that under
``durability = "frame"`` are on the disk. Under ``periodic`` a thread puts the recording, then the journal on
the disk twice in `SYNC_PERIOD_S`; where that takes longer, no more entries are confirmed, so that no more
than `SYNC_PERIOD_S` of the run is in danger.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from caviar_broker.core.events import Journal
from caviar_broker.core.run import Snapshot
from caviar_broker.event_loop import call_with_timeout
from caviar_broker.journal import JournalFile
from caviar_protocol.errors import RunError
from caviar_protocol.files import SYNC_PERIOD_S, Durability

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
