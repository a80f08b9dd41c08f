"""When a recording is on disk: the run's ``durability``, and the manifest of its segments.

Under ``none`` the operating system decides; under ``periodic`` everything is synced by a thread, twice in
`SYNC_PERIOD_S`; under ``frame`` a frame is on disk before it is acknowledged. A process that is killed loses
nothing under any of them, for every frame is in the hands of the operating system.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

from caviar_protocol.files import SYNC_PERIOD_S, Durability, sync_file
from caviar_protocol.recording.layout import Manifest, SegmentRecord
from caviar_services.recorder.segment_writer import SegmentWriter

_PAUSE_S = SYNC_PERIOD_S / 2
"""[s] between two syncs under ``periodic``, so that one that takes a while is done within the period."""


class Persistence:
    """Keeps the manifest, and brings segments and manifest to disk.

    All methods raise `OSError` where the system refuses, under ``periodic`` with the frame that follows.

    Parameters
    ----------
    folder
        Directory of the run.
    durability
        When what is written has to be on disk.
    run, seed
        Of the run, for the manifest.
    earlier
        Segments that are there already, all of them finished.
    """

    def __init__(
        self, folder: Path, durability: Durability, run: str, seed: int, earlier: list[SegmentRecord]
    ) -> None:
        self._folder, self._run, self._seed = folder, run, seed
        self._durability = durability
        self._lock = threading.Lock()
        """Of the manifest."""
        self._records = {record.name: record for record in earlier}
        self._periodic = _PeriodicSync(folder, self._list) if durability == "periodic" else None

    def written(self, segment: SegmentWriter) -> None:
        """A frame was written to a segment. Under ``frame`` it is on disk when this returns."""
        if self._durability == "frame":
            segment.sync()
        if segment.frames == 1:
            self._list(SegmentRecord(name=segment.path.name, first=segment.first))
        if self._periodic is not None:
            self._periodic.note(segment)

    def finished(self, segment: SegmentWriter) -> None:
        """Finish and close a segment, and say so in the manifest once it is on disk."""
        record = segment.finish()
        if self._periodic is not None:
            self._periodic.note(segment, record)
            return
        if self._durability == "frame":
            segment.sync()
        segment.close()
        self._list(record)

    def close(self) -> None:
        """Stop, with the recording on disk unless ``durability`` is none; the manifest says it is whole."""
        if self._periodic is not None:
            self._periodic.stop()
            self._periodic.sync()
        with self._lock:
            self._save(closed=True, durable=self._durability != "none")

    def abandon(self) -> None:
        """Stop, after a failure; what is not on disk yet is left to the operating system."""
        if self._periodic is not None:
            self._periodic.abandon()

    def _list(self, record: SegmentRecord) -> None:
        with self._lock:
            self._records[record.name] = record
            self._save(closed=False, durable=self._durability == "frame")

    def _save(self, *, closed: bool, durable: bool) -> None:
        listed = tuple(self._records.values())
        manifest = Manifest(run=self._run, seed=self._seed, segments=listed, closed=closed)
        manifest.save(self._folder, sync=durable)


class _PeriodicSync:
    """A thread that brings to disk what was written since it last did."""

    def __init__(self, folder: Path, synced: Callable[[SegmentRecord], None]) -> None:
        self._folder, self._synced = folder, synced
        self._lock = threading.Lock()
        self._dirty: dict[SegmentWriter, SegmentRecord | None] = {}
        """Segments with what is not on disk yet; those with a record are finished."""
        self._failure: OSError | None = None
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name="recording-sync", daemon=True)
        self._thread.start()

    def note(self, segment: SegmentWriter, record: SegmentRecord | None = None) -> None:
        """A segment was written to, and with a ``record`` finished. Raises what failed since."""
        with self._lock:
            self._dirty[segment] = record
            failure = self._failure
        if failure is not None:
            raise failure

    def sync(self) -> None:
        """Bring everything to disk, and close what is finished."""
        with self._lock:
            dirty, self._dirty = self._dirty, {}
        if dirty:
            sync_file(self._folder)
        for segment, record in dirty.items():
            segment.sync()
            if record is not None:
                segment.close()
                self._synced(record)

    def stop(self) -> None:
        """End the thread."""
        self._end.set()
        self._thread.join()

    def abandon(self) -> None:
        """End the thread, and close what is finished as it is."""
        self.stop()
        for segment, record in self._dirty.items():
            if record is not None:
                segment.close()

    def _run(self) -> None:
        pause = _PAUSE_S
        while not self._end.wait(pause):
            began = time.monotonic()
            try:
                self.sync()
            except OSError as error:
                with self._lock:
                    self._failure = error
                return
            pause = max(0.0, _PAUSE_S - (time.monotonic() - began))
