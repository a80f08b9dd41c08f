"""The journal: every decision of a run, handed to the operating system before it is relied on."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec

from caviar_broker.core.events import Journal
from caviar_protocol.errors import RunError
from caviar_protocol.messages import GrantInput


class JournalEntry(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One line of the journal: what became of one service's part of one frame."""

    number: int
    epoch: int
    episode: int
    frame: int
    service: str
    outcome: str
    decisions: tuple[GrantInput, ...] = ()
    products: tuple[tuple[str, bytes, bytes], ...] = ()
    """(topic, payload header, body) of products that a later frame may consume (clause 18)."""


class JournalFile:
    """Append-only msgpack stream of `JournalEntry`.

    ``os.write`` returns once the kernel has the bytes, so they outlive this process; that, and not
    a flush to the disk for each frame, is what clause 18 asks for.
    """

    def __init__(self, path: Path, epoch: int) -> None:
        self.path, self._epoch = path, epoch
        self._encoder = msgspec.msgpack.Encoder()
        try:
            self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise RunError(f"cannot write the journal {path}: {error.strerror}") from error

    def write(self, entry: Journal) -> None:
        """Append one entry. `RunError` naming the file where the system refuses it."""
        data = self._encoder.encode(
            JournalEntry(
                number=entry.number,
                epoch=self._epoch,
                episode=entry.episode,
                frame=entry.frame,
                service=entry.service,
                outcome=entry.outcome,
                decisions=entry.decisions,
                products=tuple((p.topic, _bytes(p.payload[0]), _bytes(p.payload[1])) for p in entry.products),
            )
        )
        try:
            written = os.write(self._fd, data)
        except OSError as error:
            raise RunError(f"cannot write the journal {self.path}: {error.strerror}") from error
        if written != len(data):
            raise RunError(f"cannot write the journal {self.path}: no space left")

    def close(self) -> None:
        """Close the file."""
        os.close(self._fd)


def _bytes(part: Any) -> bytes:
    return bytes(part.buffer)
