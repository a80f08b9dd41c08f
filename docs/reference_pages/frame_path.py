"""The functions that a frame passes, from a traced run."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from msgspec.structs import replace

from caviar_clients.session.embedded import EmbeddedRun
from caviar_protocol.scenario import load_scenario

from . import markdown
from .api import PACKAGES

TRACED_FRAME = 5

_HEAD = """\
Frame {frame} of `smoke`, run in one process with a recorder, passed {functions} functions in {modules}
modules of CAVIAR. They stand here in the order of first calls; the list is made anew with every rendering.
[Life of a frame](../../topics/life-of-a-frame.md) explains the steps. In a run of processes, the sockets of
broker and services stand between them.
"""


def pages() -> Iterator[tuple[str, str]]:
    """File name and text of the page."""
    modules: dict[str, list[str]] = {}
    calls = traced_calls(TRACED_FRAME)
    for module, function in calls:
        modules.setdefault(module, []).append(f"`{function}`")
    head = _HEAD.format(frame=TRACED_FRAME, functions=len(calls), modules=len(modules))
    rows = [(f"`{module}`", ", ".join(functions)) for module, functions in modules.items()]
    lines = ["# Functions of a frame", "", head, *markdown.table(("module", "functions"), rows)]
    yield "index.md", "\n".join(lines)


def traced_calls(frame: int) -> list[tuple[str, str]]:
    """Module and name of every function of the packages that is called in one frame of `smoke`, in order."""
    found: dict[tuple[str, str], None] = {}

    def note(stack: Any, event: str, _: Any) -> None:
        module = stack.f_globals.get("__name__", "")
        name = stack.f_code.co_qualname
        # Comprehensions and methods that dataclasses generate are no functions of a file.
        ours = event == "call" and module.partition(".")[0] in PACKAGES
        if ours and not re.search("<|__create_fn__", name):
            found.setdefault((module, name))

    def switch(finished: Any) -> None:
        sys.setprofile(note if finished.frame == frame - 1 else None)

    # Not frame 0, in which inputs of lag 1 are always absent.
    scenario = load_scenario("smoke")
    short = replace(scenario, run=replace(scenario.run, frames=frame + 2))
    with TemporaryDirectory() as folder:
        try:
            EmbeddedRun(short, Path(folder), on_frame=switch).run()
        finally:
            sys.setprofile(None)
    return list(found)
