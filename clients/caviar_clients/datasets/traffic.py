"""One traffic for all episodes: its states are saved once, before the first episode, and travel with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from caviar_protocol.assets import default_folder
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.conversion import convert_settings
from caviar_services.registry import load
from caviar_services.service import RunInfo
from caviar_services.world.sumo import SumoWorld
from caviar_services.world.sumo_process import TrafficStates

Progress = Callable[[float, float], None]
"""Called with SUMO's time [s], and with that at which the pass ends."""


class SharedTraffic:
    """The traffic that all episodes of a scenario share; none where each has its own.

    Args:
        scenario: Of the episodes.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._states = list(_shared(scenario))

    def save(self, episodes: int, progress: Progress = lambda *_: None) -> None:
        """Save the states that episodes begin from, where one is not there.

        Args:
            episodes: Their number.
            progress: Called now and then.

        Raises:
            RunError: They cannot be saved.
        """
        for states in self._states:
            if states.missing(episodes):
                states.make(episodes, progress)

    def states_of(self, episode: int) -> dict[str, bytes]:
        """Read the saved states from which an episode begins.

        Args:
            episode: Its number.

        Returns:
            Their content, by the name of the file in the cache; empty where each episode has its own traffic.
        """
        files = (states.file(episode) for states in self._states)
        return {file.relative_to(default_folder()).as_posix(): file.read_bytes() for file in files}


def _shared(scenario: Scenario) -> Iterator[TrafficStates]:
    for name, spec in scenario.services.items():
        if spec.role != "world" or spec.remote or not issubclass(cls := load(spec.role, spec.use), SumoWorld):
            continue
        settings = convert_settings(cls.Settings, spec.settings)
        run = RunInfo(name=name, sampling_period_ns=scenario.run.sampling_period_ns)
        if (states := cls(settings, run).traffic_states(scenario.run.seed)) is not None:
            yield states
