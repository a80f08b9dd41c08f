"""States of SUMO at the beginnings of episodes that share one traffic, saved by one pass through it.

Episode e of such a run begins e·(time between episodes) after the first. To get there anew SUMO would pass
through all that comes before: 62,580 s for the last of 2,086 episodes that are 30 s apart. One pass saves its
state at the beginning of each episode, and every episode starts from its saved state, wherever and in
whatever order it is played; whether the state was there or had to be made changes nothing.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from caviar_protocol.assets import default_folder
from caviar_protocol.digest import file_digest
from caviar_protocol.errors import RunError
from caviar_services.world.sumo_process import Simulation

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
        return self._folder / f"{episode:06d}.xml.gz"

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

    def make(
        self, simulation: Simulation, episode: int, progress: Callable[[float, float], None] = lambda *_: None
    ) -> None:
        """Save the states of all episodes up to one.

        Args:
            simulation: In which the pass runs; it is closed after it.
            episode: The last one.
            progress: Called now and then with SUMO's time [s], and with that at which the pass ends.

        Raises:
            RunError: The states cannot be written.
        """
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            folder = Path(tempfile.mkdtemp(prefix="part-", dir=self._folder))
        except OSError as error:
            raise self._failed(error) from error
        try:
            simulation.start([*self._command(), *SAVING])
            end = self.begin_s(episode)
            for number in range(episode + 1):
                steps = 0
                while simulation.api.simulation.getTime() < self.begin_s(number) - 5e-4:
                    simulation.step()
                    steps += 1
                    if steps % 1000 == 0:
                        progress(simulation.api.simulation.getTime(), end)
                if not self.file(number).exists():
                    part = folder / self.file(number).name
                    simulation.api.simulation.saveState(str(part))
                    os.replace(part, self.file(number))  # noqa: PTH105 - as elsewhere, in one step
                progress(self.begin_s(number), end)
        except OSError as error:
            raise self._failed(error) from error
        finally:
            simulation.close()
            shutil.rmtree(folder, ignore_errors=True)

    def _command(self) -> list[str]:
        return [
            *(word for option, names in self._files.items() for word in (option, ",".join(names))),
            *self._options,
        ]

    def _failed(self, error: OSError) -> RunError:
        return RunError(
            f"the states of the traffic cannot be saved in {self._folder}: {error.strerror or error}; free "
            "space there, or name another cache: export XDG_CACHE_HOME=/path"
        )
