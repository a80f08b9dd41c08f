"""What a run directory says about its run, so that another broker can go on with it."""

from __future__ import annotations

from pathlib import Path

import msgspec

from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.scenario import Scenario
from caviar_protocol.tables import Source

NAME = "run.json"


class RunRecord(msgspec.Struct, frozen=True, kw_only=True):
    """``run.json``: who runs what, where."""

    run: str
    epoch: int
    """Of the broker that wrote this."""
    endpoint: str
    """Where that broker listened."""
    scenario: Scenario
    """As resolved, with the command line's values and absolute paths."""

    def save(self, directory: Path) -> None:
        """Write it, in one step. `RunError` naming the file where that fails."""
        path = directory / NAME
        plain = msgspec.structs.replace(
            self, scenario=msgspec.structs.replace(self.scenario, source=Source())
        )
        partial = path.with_suffix(".partial")
        try:
            partial.write_bytes(msgspec.json.format(msgspec.json.encode(plain), indent=1) + b"\n")
            partial.replace(path)
        except OSError as error:
            raise RunError(f"cannot write {path}: {error.strerror}") from error


def read_record(directory: Path) -> RunRecord:
    """The record of a run. `RecordingError` naming the file where it is none."""
    path = directory / NAME
    try:
        return msgspec.json.decode(path.read_bytes(), type=RunRecord)
    except OSError as error:
        if (directory / "journal.msgpack").exists():
            raise RecordingError(
                f"cannot go on with {directory}: it has no {NAME}, and an embedded run cannot be "
                "gone on with; run its scenario again"
            ) from error
        raise RecordingError(
            f"cannot go on with {directory}: {path}: {error.strerror}; give the directory of a run"
        ) from error
    except msgspec.MsgspecError as error:
        raise RecordingError(f"cannot go on with {directory}: {path} is damaged: {error}") from error
