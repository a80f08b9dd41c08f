"""Event files of TensorBoard: the curves of a training, written so that a full disk is noticed."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from caviar_clients.files import writing


class EventFile:
    """Writes numbers over steps into a file of its own, which TensorBoard shows with the others of a folder.

    Args:
        folder: Where the file is made; the name begins with ``events.out.tfevents``, as TensorBoard wants it.
        purge_step: TensorBoard drops numbers of older files from this step on: a training that goes on from
            a checkpoint takes the steps after it once more. None: it keeps all.

    Raises:
        RunError: The file cannot be written.
    """

    def __init__(self, folder: Path, purge_step: int | None = None) -> None:
        from tensorboardX.proto.event_pb2 import SessionLog
        from tensorboardX.record_writer import RecordWriter

        # As TensorFlow names them; two of one second and machine differ by the process.
        name = f"events.out.tfevents.{int(time.time()):010d}.{socket.gethostname()}.{os.getpid()}.0"
        self.file = folder / name
        with writing(self.file):
            self._writer = RecordWriter(str(self.file))
        self._put(file_version="brain.Event:2")
        if purge_step is not None:
            self._put(step=purge_step, session_log=SessionLog(status=SessionLog.START))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Write numbers.

        Args:
            step: Of the training.
            values: By tag; TensorBoard puts those with the same word before a ``/`` together.

        Raises:
            RunError: The file cannot be written, as on a disk that is full.
        """
        from tensorboardX.proto.summary_pb2 import Summary

        numbers = [Summary.Value(tag=tag, simple_value=float(value)) for tag, value in values.items()]
        self._put(step=step, summary=Summary(value=numbers))

    def close(self) -> None:
        """Close the file."""
        self._writer.close()

    def __enter__(self) -> EventFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _put(self, **fields: Any) -> None:
        from tensorboardX.proto.event_pb2 import Event

        # `SummaryWriter` would write in a thread of its own, and lose what that thread fails with.
        with writing(self.file):
            self._writer.write(Event(wall_time=time.time(), **fields).SerializeToString())
            self._writer.flush()  # so that curves are seen while the training goes on
