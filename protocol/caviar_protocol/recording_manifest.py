"""``recording.json``: which segments a recording has, and what each finished one is.

A segment that is removed, exchanged or cut leaves no trace in the other segments; the manifest tells.
It is replaced as a whole: when a segment has its first frame (and then is listed as open), when a segment
is finished (once it is on disk, where the run's ``durability`` wants that), and when the recording is closed.
So what it says of a finished segment holds after a loss of power too. A segment that is not listed was begun
later. A recording without a manifest was made by an earlier version, and is read without one.
"""

from __future__ import annotations

import zlib
from pathlib import Path

import msgspec

from caviar_protocol.durability import replace_file
from caviar_protocol.errors import RecordingError
from caviar_protocol.regular_file import read_regular

MANIFEST_NAME = "recording.json"


class SegmentRecord(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One segment in the manifest."""

    name: str
    first: tuple[int, int] | None = None
    """(episode, frame) of its first frame; None where it was closed without one."""
    finished: bool = False
    """Whether it was closed; an open one has only a name and a first frame here."""
    last: tuple[int, int] | None = None
    """(episode, frame) of its last frame."""
    frames: int = 0
    size: int = 0
    """[B]"""
    crc: int = 0
    """CRC-32 of the whole file."""

    @property
    def extent(self) -> str:
        """Its frames for people."""
        if self.first is None:
            return "no frame"
        if self.last is None:
            return f"{frame_name(self.first)} and later"
        return f"{frame_name(self.first)} to {frame_name(self.last)}"


class Manifest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The segments of a recording, in order."""

    run: str = ""
    seed: int = 0
    segments: tuple[SegmentRecord, ...] = ()
    closed: bool = False
    """Whether the recorder came to its end and closed the recording."""

    def save(self, folder: Path, *, sync: bool) -> None:
        """Write it to a run directory, in one step. Raises `OSError` where that fails."""
        content = msgspec.json.encode(self)
        replace_file(folder / MANIFEST_NAME, _sealed(content), durable=sync)


class _Envelope(msgspec.Struct):
    crc: int
    """CRC-32 of the bytes of ``manifest``."""
    manifest: msgspec.Raw


def read_manifest(folder: Path) -> Manifest | None:
    """The manifest in a run directory; None where there is none.

    Raises `RecordingError` naming the file where a byte of it differs from what was written.
    """
    path = folder / MANIFEST_NAME
    try:
        data = read_regular(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise RecordingError(f"{path} cannot be read: {error.strerror} (errno {error.errno})") from error
    try:
        content = bytes(msgspec.json.decode(data, type=_Envelope).manifest)
        if data != _sealed(content):
            raise RecordingError(f"{path} is damaged: its content does not have its CRC-32")
        return msgspec.json.decode(content, type=Manifest)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path} is damaged: {error}") from error


def frame_name(instant: tuple[int, int]) -> str:
    """(episode, frame) for people."""
    return f"frame {instant[1]} of episode {instant[0]}"


def _sealed(content: bytes) -> bytes:
    return b'{"crc":%d,"manifest":%s}\n' % (zlib.crc32(content), content)
