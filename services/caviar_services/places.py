"""The line of a service's own code, for texts that say where it waits or failed."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Iterable
from pathlib import Path
from types import CodeType, TracebackType


def place_in(cls: type | None, lines: Iterable[tuple[CodeType, int]]) -> str:
    """The first of some lines that is in a module of a class or of its bases.

    Args:
        cls: Implementation of a service.
        lines: Code and number of each line, the innermost call first.

    Returns:
        ``my_agent.py:7 in step``, relative to the present folder where it lies there; empty where no line is.
    """
    modules = (sys.modules.get(base.__module__) for base in (cls.__mro__ if cls else ()))
    files = {getattr(module, "__file__", None) for module in modules} - {None}
    found = next(((code, line) for code, line in lines if code.co_filename in files), None)
    if found is None:
        return ""
    code, line = found
    file = Path(code.co_filename)
    if file.is_relative_to(Path.cwd()):
        file = file.relative_to(Path.cwd())
    return f"{file}:{line} in {code.co_name}"


def place_of_error(cls: type | None, trace: TracebackType | None) -> str:
    """The line of a class's modules at which an exception left them.

    Args:
        cls: Implementation of a service.
        trace: Of the exception.
    """
    lines = [(frame.f_code, line) for frame, line in traceback.walk_tb(trace)]
    return place_in(cls, reversed(lines))
