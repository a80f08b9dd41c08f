"""A run in progress, and the broker that is started again whenever its status is not 0, as containers are.

The file ``NAME.current`` in the folder of the runs holds the name of the run that is going on. It is there
exactly while a broker serves it, or died while it did.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from caviar_protocol.errors import RunError
from caviar_protocol.files import replace_file
from caviar_protocol.run_directory import RunDirectory


class RunInProgress:
    """The run of a scenario's name that goes on in the folder ``root``."""

    def __init__(self, root: Path, name: str) -> None:
        self._root, self._file = root, root / f"{name}.current"

    def directory(self) -> Path | None:
        """Of the run whose broker died; None where there is none to go on with."""
        try:
            left = self._root / self._file.read_text().strip()
        except OSError:
            return None
        return left if RunDirectory(left).record.is_file() else None

    def serve(self, directory: Path, serve: Callable[[], int]) -> int:
        """Serve a run to its end, whatever that is; the exit status of ``serve``."""
        try:
            replace_file(self._file, f"{directory.name}\n".encode())
        except OSError as error:
            raise RunError(f"cannot write {self._file}: {error.strerror}; choose another --out") from error
        try:
            return serve()
        finally:
            self._file.unlink(missing_ok=True)
