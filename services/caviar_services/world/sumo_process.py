"""The SUMO simulation in this process, and saved states of a traffic that episodes share.

libsumo is one simulation per process and prints what it warns of, so that its output is caught.

`TrafficStates` are those at the beginnings of episodes that share one traffic.
Episode e of such a run begins e·(time between episodes) after the first. To get there anew SUMO would pass
through all that comes before: 62,580 s for the last of 2,086 episodes that are 30 s apart. One pass saves its
state at the beginning of each episode, and every episode starts from its saved state, wherever and in
whatever order it is played; whether the state was there or had to be made changes nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from types import ModuleType
from typing import Any

from caviar_protocol.assets import default_folder
from caviar_protocol.digest import file_digest
from caviar_protocol.errors import CaviarError, RunError, SetupError
from caviar_protocol.host import PYTHON, install_command
from caviar_services.world.sumo_inputs import one_line

# What differs in warnings of one kind: names, numbers, and reasons with either.
_PARTICULAR = re.compile(r"'[^']*'|-?\d+(\.\d+)?")


def load_libsumo() -> ModuleType:
    """Import libsumo.

    Raises:
        SetupError: It is not installed; says the command that installs it.
    """
    try:
        with redirect_stdout(None):  # a remark about pyarrow, which only its outputs would need
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


_REPORT_EVERY = 1000
"""Steps between two reports of progress."""

SAVING = ("--save-state.rng", "--save-state.transportables", "--save-state.precision", "20")
"""Options of SUMO with which a saved state has the random numbers, the people, and every digit."""


class TrafficStates:
    """The saved states of one traffic, in the cache of this user, below ``caviar/traffic``.

    Their folder is named after what they follow from: the content of SUMO's files, its options, its version
    and the seed. Several processes may make the same states at once; each appears when it is complete.

    Args:
        files: SUMO's input by option: ``{"--net-file": ["town.net.xml"]}``.
        options: The rest of its command line, with step and seed.
        version: Of SUMO.
        begin_s: SUMO's time at the beginning of episode 0 [s].
        spacing_s: From the beginning of an episode to that of the next [s].
        cache: Folder of the cache; by default that of this user.

    Example:
        >>> states = TrafficStates({}, ["--seed", "1"], "SUMO 1.25", 60.0, 30.0, Path("cache"))
        >>> states.begin_s(2), states.file(2).name
        (120.0, '000002.xml.gz')
    """

    def __init__(
        self,
        files: Mapping[str, Sequence[str]],
        options: Sequence[str],
        version: str,
        begin_s: float,
        spacing_s: float,
        cache: Path | None = None,
    ) -> None:
        self._files, self._options = files, options
        self._begin_s, self._spacing_s = begin_s, spacing_s
        content = {option: [file_digest(Path(file)) for file in names] for option, names in files.items()}
        key = json.dumps([content, [*options, *SAVING], version, begin_s, spacing_s])
        self.digest = hashlib.sha256(key.encode()).hexdigest()
        """Of what the states follow from."""
        self._folder = (cache or default_folder()) / "traffic" / self.digest

    def begin_s(self, episode: int) -> float:
        """SUMO's time at the beginning of an episode [s].

        Args:
            episode: Its number.
        """
        return round(self._begin_s + episode * self._spacing_s, 3)

    def file(self, episode: int) -> Path:
        """The saved state at the beginning of an episode, whether or not it is there.

        Args:
            episode: Its number.
        """
        return self._folder / _name(episode)

    def missing(self, episodes: int) -> bool:
        """Return whether the state of one of the first episodes has to be made.

        Args:
            episodes: Their number.
        """
        return not all(self.file(number).exists() for number in range(episodes))

    def arguments(self, episode: int) -> list[str]:
        """SUMO's command line that goes on from a saved state.

        Args:
            episode: Which begins there.
        """
        begin = ["--begin", f"{self.begin_s(episode):.3f}"]
        return [*self._command(), *begin, "--load-state", str(self.file(episode))]

    def make(self, episodes: int, progress: Callable[[float, float], None] = lambda *_: None) -> None:
        """Save the states of the first episodes by one pass, in a process of its own.

        SUMO writes into a state how many numbers its generators have drawn, and counts those of simulations
        that the process ran before (SUMO 1.28): only the first one in a process is saved as it was.

        Args:
            episodes: Their number.
            progress: Called now and then with SUMO's time [s], and with that at which the pass ends.

        Raises:
            RunError: SUMO stops, or the states cannot be written.
        """
        command = [*PYTHON, "-m", __name__]
        with subprocess.Popen(  # noqa: S603 - our own module
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            start_new_session=True,  # Ctrl-C is this process's, which ends that one
        ) as process:  # fmt: skip
            try:
                self._watch(process, episodes, progress)
            except BaseException:
                process.kill()
                raise

    def _watch(
        self, process: subprocess.Popen[str], episodes: int, progress: Callable[[float, float], None]
    ) -> None:
        if process.stdin is None or process.stdout is None or process.stderr is None:
            raise RunError("the process of SUMO has no pipes")
        order = {
            "command": self._command(),
            "folder": str(self._folder),
            "begins_s": [self.begin_s(number) for number in range(episodes)],
        }
        process.stdin.write(json.dumps(order))
        process.stdin.close()
        for line in process.stdout:
            now, end = map(float, line.split())
            progress(now, end)
        said = process.stderr.read().strip()
        if process.wait():
            last = said.splitlines()[-1] if said else f"it ended with status {process.returncode}"
            raise RunError(f"the traffic of the episodes cannot be saved: {last}")

    def _command(self) -> list[str]:
        return [
            *(word for option, names in self._files.items() for word in (option, ",".join(names))),
            *self._options,
        ]


def _save(command: list[str], folder: Path, begins_s: list[float]) -> None:
    """Pass through the traffic, and save its state at these times [s]; report on standard output."""
    simulation = Simulation(load_libsumo())
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="part-", dir=folder) as part:
        simulation.start([*command, *SAVING])
        for number, begin_s in enumerate(begins_s):
            steps = 0
            while simulation.api.simulation.getTime() < begin_s - 5e-4:
                simulation.step()
                steps += 1
                if steps % _REPORT_EVERY == 0:
                    _report(simulation.api.simulation.getTime(), begins_s[-1])
            file = Path(part, _name(number))
            simulation.api.simulation.saveState(str(file))
            file.replace(folder / file.name)  # in one step: others may make the same states
            _report(begin_s, begins_s[-1])
        simulation.close()


def _report(now_s: float, end_s: float) -> None:
    sys.stdout.write(f"{now_s} {end_s}\n")
    sys.stdout.flush()


def _name(episode: int) -> str:
    return f"{episode:06d}.xml.gz"


def main() -> int:
    """Make the states that standard input asks for, as JSON."""
    order = json.load(sys.stdin)
    try:
        _save(order["command"], Path(order["folder"]), order["begins_s"])
    except OSError as error:
        remedy = "free space there, or name another cache: export XDG_CACHE_HOME=/path"
        sys.stderr.write(f"{order['folder']}: {error.strerror or error}; {remedy}\n")
        return 1
    except CaviarError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
