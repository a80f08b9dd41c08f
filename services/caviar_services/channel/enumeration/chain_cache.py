"""Chains of scenery kept in files, so that the next run with the same scenery does not launch them again.

A file's name is a digest of all that its chains follow from, so a file is never out of date: the scenery's
triangles, the transmitter's position, how rays are launched, and the versions of this format and of the ray
tracer. Files are put in place in one step, and one that is damaged is launched again.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from caviar_protocol.arrays import Int32Array
from caviar_protocol.files import read_regular, replace_file
from caviar_protocol.messages import WARNING
from caviar_services.checkpoint import Packed

_FORMAT: Literal["caviar-chains-1"] = "caviar-chains-1"


class _ChainFile(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The content of a file."""

    format: Literal["caviar-chains-1"]
    key: str
    tables: tuple[Packed, ...]
    """Of planes by number."""
    digest: bytes
    """Of the tables' bytes."""


class ChainCache:
    """Files of chains below a folder, which is made when the first one is written.

    Parameters
    ----------
    folder
        Any; several processes may use it at once.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.notes: list[str] = []
        """What could not be read or written, and why."""

    def load(self, key: str, widths: tuple[int, ...]) -> tuple[Int32Array, ...] | None:
        """The tables of a key, which have rows of these widths; None where there is no file, or a damaged
        one."""
        path = self._folder / key
        try:
            data = read_regular(path, "it is replaced")
        except FileNotFoundError:
            return None
        except OSError as error:
            self.notes.append(
                f"{WARNING}{path} cannot be read ({error.strerror}); its chains are launched again"
            )
            return None
        try:
            file = msgspec.msgpack.decode(data, type=_ChainFile)
            tables: tuple[Int32Array, ...] = tuple([table.array(np.int32) for table in file.tables])
            intact = file.key == key and file.digest == _digest(file.tables)
        except (msgspec.MsgspecError, UnicodeDecodeError, ValueError):
            intact = False
        if intact and [table.shape[1:] for table in tables] == [(width,) for width in widths]:
            return tables
        self.notes.append(f"{WARNING}{path} is damaged; its chains are launched again")
        return None

    def save(self, key: str, tables: tuple[Int32Array, ...]) -> None:
        """Keep the tables of a key; where that cannot be done, a note says so."""
        packed = tuple([Packed.of(table, "<i4") for table in tables])
        file = _ChainFile(format=_FORMAT, key=key, tables=packed, digest=_digest(packed))
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            replace_file(self._folder / key, msgspec.msgpack.encode(file), durable=False)
        except OSError as error:
            self.notes.append(
                f"{WARNING}chains cannot be kept in {self._folder} ({error.strerror}); the next run "
                "launches them again, unless XDG_CACHE_HOME names a folder that can be written"
            )


def cache_key(*parts: bytes) -> str:
    """Digest of all that chains follow from."""
    digest = hashlib.blake2b(digest_size=20)
    for part in (_FORMAT.encode(), *parts):
        digest.update(len(part).to_bytes(8, "little"))
        digest.update(part)
    return digest.hexdigest()


def _digest(tables: tuple[Packed, ...]) -> bytes:
    return hashlib.blake2b(b"".join([table.data for table in tables]), digest_size=16).digest()
