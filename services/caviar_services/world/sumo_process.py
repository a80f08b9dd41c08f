"""The SUMO simulation in this process: starting, stepping, and saying what is wrong.

libsumo is one simulation per process, prints its errors instead of raising them, and ends the
process on some broken files; so files are looked at first, and its output is caught.
"""

from __future__ import annotations

import io
import math
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.parsers import expat

from caviar_protocol.errors import RunError, ScenarioError, SetupError
from caviar_protocol.host import install_command

_ROOTS = {
    "net": ("net",),
    "config": ("configuration", "sumoConfiguration"),
    "routes": ("routes",),
    "additional": ("additional", "add", "routes"),
}


# Elements of traffic, and which attribute says when it begins.
_DEPARTS = {
    "flow": "begin",
    "personFlow": "begin",
    "vehicle": "depart",
    "trip": "depart",
    "person": "depart",
}


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


def check_file(key: str, file: str) -> None:
    """Check that a file can be what a setting names.

    Args:
        key: The setting: ``net``, ``config``, ``routes`` or ``additional``.
        file: Path of the file.

    Raises:
        ScenarioError: The file is missing, is no XML of this kind, or has traffic out of order; names file,
            key and line.
    """
    path = Path(file)
    if not path.is_file():
        raise ScenarioError(
            f'there is no file {file}; write "file:PATH", relative to the scenario', key=f"settings.{key}"
        )
    if path.suffix == ".gz":  # SUMO reads them; what is wrong in one it says itself, where it does not crash
        return
    roots: list[str] = []
    order = _Departures(file, f"settings.{key}")
    parser = expat.ParserCreate()

    def start(tag: str, attributes: dict[str, str]) -> None:
        if not roots:
            roots.append(tag)
        elif key == "routes":
            order.see(tag, attributes, parser.CurrentLineNumber)

    parser.StartElementHandler = start
    try:
        with path.open("rb") as stream:
            parser.ParseFile(stream)
    except expat.ExpatError as error:
        raise ScenarioError(f"not well-formed XML: {error}", file, f"settings.{key}", error.lineno) from error
    if roots[0] not in _ROOTS[key]:
        raise ScenarioError(
            f"holds <{roots[0]}>, {key} takes a file with <{_ROOTS[key][0]}>", file, f"settings.{key}"
        )


class _Departures:
    """Whether a file of routes has its traffic in the order of departure: SUMO leaves out whatever stands
    after something later, with a warning among many."""

    def __init__(self, file: str, key: str) -> None:
        self._file, self._key = file, key
        self._latest, self._of = -math.inf, ""

    def see(self, tag: str, attributes: dict[str, str], line: int) -> None:
        """Look at one more element. `ScenarioError` where it departs before the one before."""
        time = attributes.get(_DEPARTS.get(tag, ""))
        try:
            departs = float(time or "nan")
        except ValueError:
            return  # "triggered", or hours and minutes, which SUMO knows how to read
        name = f"{tag} {attributes.get('id', '')!r}"
        if departs < self._latest:
            text = (
                f"{name} departs at {departs:g} s, after {self._of} at {self._latest:g} s: SUMO would leave "
                "it out; sort flows, vehicles and trips by departure"
            )
            raise ScenarioError(text, self._file, self._key, line)
        if departs > self._latest:
            self._latest, self._of = departs, name


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
        try:
            with _caught_stderr() as output:
                self.api.start(["sumo", *arguments])
        except self.api.TraCIException as error:
            said = output.getvalue().strip() or str(error)
            raise SetupError(
                f"SUMO does not start: {_one_line(said)}; mend the file or setting it names"
            ) from error
        finally:
            # A start that failed may leave a simulation behind, which would refuse the next start.
            self._running = bool(self.api.isLoaded())
        sys.stderr.write(output.getvalue())

    def step(self) -> None:
        """Simulate one step.

        Raises:
            RunError: SUMO stops; has its own words.
        """
        try:
            self.api.simulationStep()
        except self.api.TraCIException as error:
            raise RunError(
                f"SUMO stopped at {self.api.simulation.getTime()} s of its time: {_one_line(str(error))}"
            ) from error

    def close(self) -> None:
        """End the simulation, if one runs."""
        if self._running:
            self._running = False
            self.api.close()


@contextmanager
def _caught_stderr() -> Iterator[io.StringIO]:
    """Catch what C++ code writes to standard error meanwhile."""
    # By its descriptor: code that is not Python does not know `sys.stderr`. A file, not a pipe, which would
    # block SUMO once it is full.
    output = io.StringIO()
    sys.stderr.flush()
    with tempfile.TemporaryFile() as file:
        kept = os.dup(2)
        os.dup2(file.fileno(), 2)
        try:
            yield output
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            output.write(file.read().decode(errors="replace"))


def _one_line(text: str) -> str:
    return " ".join(text.split())
