"""What a run directory says about its run, so that another broker can go on with it."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

import msgspec

from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.files import read_regular, replace_file
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.conversion import Source

NAME = "run.json"
_UNSET = "0" * 64
_CHECK = re.compile(rb'\n "check": "([0-9a-f]{64})"\n}\n$')
"""The last line of the file."""


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """``run.json``: who runs what, where, and with which code."""

    run: str
    epoch: int
    """Of the broker that wrote this."""
    endpoint: str
    """Where that broker listened."""
    scenario: Scenario
    """As resolved, with the command line's values and absolute paths."""
    versions: dict[str, str] = {}
    """Of all that the results depend on, as `caviar_broker.versions.versions_of` finds them."""
    check: str = _UNSET
    """SHA-256 of the file with zeros in this place."""

    def save(self, directory: Path) -> None:
        """Write it, in one step and to the disk. `RunError` naming the file where that fails."""
        path = directory / NAME
        file = self.scenario.source.file  # whose folder may have modules of services
        source = Source(file=str(Path(file).resolve()) if file else "")
        without_lines = msgspec.structs.replace(self.scenario, source=source)
        plain = msgspec.structs.replace(self, scenario=without_lines, check=_UNSET)
        data = msgspec.json.format(msgspec.json.encode(plain), indent=1) + b"\n"
        check = hashlib.sha256(data).hexdigest()
        try:
            replace_file(path, data.replace(_UNSET.encode(), check.encode()))
        except OSError as error:
            raise RunError(f"cannot write {path}: {error.strerror}") from error


def read_record(directory: Path) -> RunRecord:
    """The record of a run. `RecordingError` naming the file where it is none, or not as it was written."""
    path = directory / NAME
    try:
        data = read_regular(path)
    except OSError as error:
        if isinstance(error, FileNotFoundError) and (directory / "journal.msgpack").exists():
            raise RecordingError(
                f"cannot go on with {directory}: it has no {NAME}, and an embedded run cannot be "
                "gone on with; run its scenario again"
            ) from error
        remedy = "; give the directory of a run" if isinstance(error, FileNotFoundError) else ""
        raise RecordingError(f"cannot go on with {directory}: {path}: {error.strerror}{remedy}") from error
    found = _CHECK.search(data)
    if found is None or hashlib.sha256(_blanked(data, found)).hexdigest() != found[1].decode():
        why = "it is empty" if not data.strip(b"\0") else "its content is not that of its SHA-256"
        if found is None and b'"scenario"' in data and b'"check"' not in data:
            why = "it has no check value; a run that another version began is gone on with by that version"
        raise RecordingError(f"cannot go on with {directory}: {path} is damaged: {why}")
    try:
        return msgspec.json.decode(data, type=RunRecord)
    except msgspec.MsgspecError as error:
        raise RecordingError(f"cannot go on with {directory}: {path} is damaged: {error}") from error


def _blanked(data: bytes, found: re.Match[bytes]) -> bytes:
    return data[: found.start(1)] + _UNSET.encode() + data[found.end(1) :]
