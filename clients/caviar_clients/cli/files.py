"""Files that a command writes because it was asked to."""

from __future__ import annotations

from pathlib import Path

from caviar_protocol.errors import RunError


def write_file(path: Path, text: str = "") -> None:
    """Write a file, and the folders to it.

    Called without text before the work, which leaves what is there: afterwards, a file that cannot be written
    would cost the results.
    Raises `RunError` naming the file and why it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if text:
            path.write_text(text, encoding="utf-8")
        else:
            path.open("ab").close()
    except OSError as error:
        raise RunError(f"cannot write {path}: {error.strerror}; choose another file") from error
