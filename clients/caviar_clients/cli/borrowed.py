"""A key for the services that a launcher starts itself, for as long as the run lasts."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path

from caviar_protocol.keys import BROKER, BROKER_KEY_VARIABLE, KEY_VARIABLE, Pair, write_pair


class BorrowedKey:
    """A key pair in a folder that only this user can read, removed by `close`.

    Parameters
    ----------
    keys
        Keys directory of the broker; None: a run without keys, which needs none.
    """

    def __init__(self, keys: Path | None) -> None:
        self._keys = keys
        self._folder: Path | None = None
        self.public = ""
        """What the broker is told; "" without keys."""

    def environment(self) -> Mapping[str, str]:
        """Environment of a service that is started here."""
        if self._keys is None:
            return os.environ
        if self._folder is None:
            self._make()
        broker = (self._keys / f"{BROKER}.pub").resolve()
        return {**os.environ, KEY_VARIABLE: str(self._key), BROKER_KEY_VARIABLE: str(broker)}

    def options(self) -> list[str]:
        """What the broker is started with."""
        if self._keys is None:
            return []
        if self._folder is None:
            self._make()
        return ["--keys", str(self._keys), f"--local-key={self.public}"]

    def close(self) -> None:
        """Remove the key."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def _make(self) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="caviar-"))
        pair = Pair.new()
        self.public = pair.public
        self._key, _ = write_pair(self._folder, "run", pair)
