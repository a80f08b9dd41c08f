"""States of SUMO at the beginnings of episodes that share one traffic, saved by one pass through it.

Episode e of such a run begins e·(time between episodes) after the first. To get there anew SUMO would pass
through all that comes before: 62,580 s for the last of 2,086 episodes that are 30 s apart. One pass saves its
state at the beginning of each episode, and every episode starts from its saved state, wherever and in
whatever order it is played; whether the state was there or had to be made changes nothing.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from caviar_protocol.assets import default_folder
from caviar_protocol.digest import file_digest
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.host import PYTHON
from caviar_services.world.sumo_process import Simulation, load_libsumo

_REPORT_EVERY = 1000
"""Steps between two reports of progress."""

SAVING = ("--save-state.rng", "--save-state.precision", "20")
"""Options of SUMO with which a saved state has the random numbers and every digit."""


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
        key = json.dumps([content, list(options), version, begin_s, spacing_s])
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
        """Whether the state of one of the first episodes has to be made.

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
