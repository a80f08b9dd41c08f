"""The `caviar` command, and ``python -m caviar_clients``."""

import sys

# Before any other import: `python -m` finds the current folder before the standard library.
if __name__ == "__main__" and not sys.flags.safe_path:
    del sys.path[0]

import gc
import os
import signal
from types import FrameType


def _leave(number: int, _: FrameType | None) -> None:
    os._exit(128 + number)


def main() -> None:
    """Load the command and run it.

    Loading its libraries takes up to a second. Ctrl-C within it ends the process with status 130 and
    without a traceback: nothing runs yet that would have to be ended first.
    """
    signal.signal(signal.SIGINT, _leave)
    gc.disable()
    from caviar_clients.cli.main import main as command

    gc.freeze()  # what is loaded stays: no collection looks at it
    gc.enable()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    command()


if __name__ == "__main__":
    main()
