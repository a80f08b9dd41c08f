"""The SUMO simulation in this process: starting, stepping, and saying what is wrong.

libsumo is one simulation per process and prints what it warns of, so that its output is caught.
"""

from __future__ import annotations

import os
import re
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType
from typing import Any

from caviar_protocol.errors import RunError, SetupError
from caviar_protocol.host import install_command
from caviar_services.world.sumo_inputs import one_line

# What differs in warnings of one kind: names, numbers, and reasons with either.
_PARTICULAR = re.compile(r"'[^']*'|-?\d+(\.\d+)?")


def load_libsumo() -> ModuleType:
    """Import libsumo.

    Raises:
        SetupError: It is not installed; says the command that installs it.
    """
    try:
        import libsumo
    except ImportError as error:
        raise SetupError(
            f"the world `sumo` needs libsumo ({error}); run: {install_command('world')}"
        ) from error
    return libsumo  # type: ignore[no-any-return]  # an untyped module


class Simulation:
    """One SUMO simulation at a time.

    Args:
        libsumo: What `load_libsumo` gives.

    Example:
        >>> simulation = Simulation(load_libsumo())
        >>> simulation.close()  # nothing runs: does nothing
    """

    def __init__(self, libsumo: ModuleType) -> None:
        self.api: Any = libsumo
        self.said = Counter[str]()
        """What SUMO warned of since it was read last, by kind: names and numbers are left out."""
        self._running = False

    def start(self, arguments: Sequence[str]) -> None:
        """Start, from the beginning.

        Args:
            arguments: SUMO's command line.

        Raises:
            SetupError: SUMO refuses, or runs in this process already; has SUMO's own words.
        """
        # `close` ends only what was started here: a simulation of another world in this process stays.
        self.close()
        if self.api.isLoaded():
            raise SetupError(
                "libsumo already runs a simulation in this process and has room for one; run this world as a "
                "process of its own (caviar service NAME), and workers of Dask with --nthreads 1"
            )
        printed: list[str] = []
        try:
            with _caught_stderr(printed):
                self.api.start(["sumo", *arguments])
        except (self.api.TraCIException, self.api.FatalTraCIError) as error:
            said = " ".join(printed).strip() or str(error)
            raise SetupError(
                f"SUMO does not start: {one_line(said)}; mend the file or setting it names"
            ) from error
        finally:
            # A start that failed may leave a simulation behind, which would refuse the next start.
            self._running = bool(self.api.isLoaded())
        self._note(printed)

    def step(self) -> None:
        """Simulate one step.

        Raises:
            RunError: SUMO stops; has its own words.
        """
        printed: list[str] = []
        try:
            with _caught_stderr(printed):
                self.api.simulationStep()
        except (self.api.TraCIException, self.api.FatalTraCIError) as error:
            # SUMO has closed its simulation where the error is fatal.
            self._running = bool(self.api.isLoaded())
            raise RunError(f"SUMO stopped: {one_line(str(error))}") from error
        if printed:
            self._note(printed)

    def _note(self, printed: list[str]) -> None:
        """Count warnings and errors by kind; whatever else was printed meanwhile goes on."""
        for line in printed:
            level, colon, text = line.partition(": ")
            if colon and level in ("Warning", "Error"):
                self.said[_PARTICULAR.sub("…", text).rstrip(". ")] += 1
            else:
                sys.stderr.write(line + "\n")

    def close(self) -> None:
        """End the simulation, if one runs."""
        if self._running:
            self._running = False
            self.api.close()


@contextmanager
def _caught_stderr(lines: list[str]) -> Iterator[None]:
    """Catch what C++ code writes to standard error meanwhile, as lines."""
    # By its descriptor: code that is not Python does not know `sys.stderr`. A file, not a pipe, which would
    # block SUMO once it is full; in memory, since every step has one.
    sys.stderr.flush()
    with open(os.memfd_create("sumo"), "rb") as file:  # noqa: PTH123 - it has no path
        kept = os.dup(2)
        os.dup2(file.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            if file.seek(0, os.SEEK_CUR):  # the descriptors share one position
                file.seek(0)
                lines += file.read().decode(errors="replace").splitlines()
