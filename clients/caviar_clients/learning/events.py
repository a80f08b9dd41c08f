"""Event files of TensorBoard: curves of a training, written without the package of that name.

`torch.utils.tensorboard` needs the package ``tensorboard`` with gRPC and a dozen others, for two kinds of
record. A file is a TFRecord stream: of each record its length as 8 bytes, the CRC of these, the record, and
its CRC. A record is an ``Event`` of Protocol Buffers: wall time (field 1), step (2), version of the file (3,
in the first record), or a ``Summary`` (5) of values with a tag (1) and a number (2).
"""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from types import TracebackType

from caviar_clients.files import writing

VERSION = b"brain.Event:2"
_VARINT, _64_BIT, _BYTES, _32_BIT = 0, 1, 2, 5


class EventFile:
    """Writes numbers over steps into a file of its own, which TensorBoard shows with the others of a folder.

    Args:
        folder: Where the file is made; the name begins with ``events.out.tfevents``, as TensorBoard wants it.
        purge_step: TensorBoard drops numbers of older files from this step on: a training that goes on from
            a checkpoint takes the steps after it once more. None: it keeps all.

    Raises:
        RunError: The file cannot be written.

    Example:
        >>> with EventFile(Path("curves")) as events:
        ...     events.write(100, {"rollout/mean_reward": 0.5})
        >>> [(step, value) for _, step, value in read_events(events.file)]
        [(100, 0.5)]
    """

    def __init__(self, folder: Path, purge_step: int | None = None) -> None:
        # As TensorFlow names them; two of one second and machine differ by the process.
        name = f"events.out.tfevents.{int(time.time()):010d}.{socket.gethostname()}.{os.getpid()}.0"
        self.file = folder / name
        with writing(self.file):
            self._stream = self.file.open("ab")
        self._put(_field(3, _BYTES) + _sized(VERSION))
        if purge_step is not None:
            # A SessionLog (field 7) of status START (1) at this step.
            self._put(_field(2, _VARINT) + _varint(purge_step) + _field(7, _BYTES) + _sized(b"\x08\x01"))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        """Write numbers.

        Args:
            step: Of the training.
            values: By tag; TensorBoard puts those with the same word before a ``/`` together.

        Raises:
            RunError: The file cannot be written, as on a disk that is full.
        """
        summary = b"".join(
            _field(1, _BYTES)
            + _sized(
                _field(1, _BYTES)
                + _sized(tag.encode())
                + _field(2, _32_BIT)
                + struct.pack("<f", float(value))
            )
            for tag, value in values.items()
        )
        self._put(_field(2, _VARINT) + _varint(step) + _field(5, _BYTES) + _sized(summary))

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def __enter__(self) -> EventFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _put(self, fields: bytes) -> None:
        event = _field(1, _64_BIT) + struct.pack("<d", time.time()) + fields
        length = struct.pack("<Q", len(event))
        with writing(self.file):
            self._stream.write(length + _checksum(length) + event + _checksum(event))
            self._stream.flush()  # so that curves are seen while the training goes on


def read_events(file: Path) -> Iterator[tuple[str, int, float]]:
    """Read the numbers of an event file.

    Args:
        file: The file; a record that is not whole, at its end, is left out.

    Yields:
        Tag, step and number.

    Raises:
        ValueError: A checksum is wrong.
    """
    data = file.read_bytes()
    at = 0
    while at + 12 <= len(data):
        (length,) = struct.unpack_from("<Q", data, at)
        event = data[at + 12 : at + 12 + length]
        end = at + 16 + length
        if end > len(data):
            return
        if data[at + 8 : at + 12] != _checksum(data[at : at + 8]) or data[end - 4 : end] != _checksum(event):
            raise ValueError(f"{file}: the checksum at byte {at} is wrong; the file is damaged")
        fields = list(_fields(event))
        step = next((value for number, value in fields if number == 2 and isinstance(value, int)), 0)
        for number, summary in fields:
            if number != 5 or not isinstance(summary, bytes):
                continue
            for _, value in _fields(summary):
                of = dict(_fields(value)) if isinstance(value, bytes) else {}
                tag, simple = of.get(1), of.get(2)
                if isinstance(tag, bytes) and isinstance(simple, float):
                    yield tag.decode(), step, simple
        at = end


def _fields(message: bytes) -> Iterator[tuple[int, int | float | bytes]]:
    """Number and value of each field of a message of Protocol Buffers."""
    at = 0
    while at < len(message):
        key, at = _read_varint(message, at)
        match key & 7:
            case 0:  # a number of variable length
                value, at = _read_varint(message, at)
                yield key >> 3, value
            case 1:
                yield key >> 3, struct.unpack_from("<d", message, at)[0]
                at += 8
            case 5:
                yield key >> 3, struct.unpack_from("<f", message, at)[0]
                at += 4
            case _:  # bytes
                length, at = _read_varint(message, at)
                yield key >> 3, message[at : at + length]
                at += length


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 127) << shift
        at, shift = at + 1, shift + 7
        if byte < 128:
            return value, at


def _field(number: int, kind: int) -> bytes:
    return _varint(number << 3 | kind)


def _sized(data: bytes) -> bytes:
    return _varint(len(data)) + data


def _varint(value: int) -> bytes:
    made = bytearray()
    while value > 127:
        made.append(value & 127 | 128)
        value >>= 7
    made.append(value)
    return bytes(made)


def _checksum(data: bytes) -> bytes:
    """CRC-32C (Castagnoli, RFC 3720), rotated and shifted as TFRecord has it."""
    table, crc = _table(), 0xFFFFFFFF
    for byte in data:
        crc = table[(crc ^ byte) & 0xFF] ^ crc >> 8
    crc ^= 0xFFFFFFFF
    return struct.pack("<I", ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF)


@lru_cache(maxsize=1)
def _table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
        table.append(crc)
    return table
