"""Generation of a dataset: which episodes are to be played, in what they are kept, and what failed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Protocol

from caviar_clients.datasets.catalogue import Catalogue
from caviar_clients.datasets.cluster import Episodes
from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
from caviar_clients.datasets.episode import EpisodeResult, EpisodeTask
from caviar_clients.datasets.estimate import Estimate, check_disk, check_least, estimate, try_worker
from caviar_clients.datasets.ledger import Ledger, MissingEpisodes
from caviar_clients.datasets.plan import DatasetPlan
from caviar_clients.datasets.remote import RemoteDataset, is_address
from caviar_clients.datasets.settings import fingerprint
from caviar_clients.datasets.texts import counted
from caviar_protocol.assets import default_folder
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.scenario import Scenario
from caviar_protocol.scenario.conversion import convert_settings
from caviar_services.registry import load
from caviar_services.service import RunInfo
from caviar_services.world.sumo import SumoWorld
from caviar_services.world.sumo_process import TrafficStates

MOST_EPISODES = 10**18 - 1
"""That a catalogue can number."""


class Observer(Protocol):
    """Is told how a generation goes on."""

    def note(self, text: str) -> None:
        """A line for the user."""

    def traffic(self, now_s: float, end_s: float) -> None:
        """Take the progress of the pass through the traffic [s]."""

    def tried(self, done: int, of: int, phase: str) -> None:
        """Take the number of workers that have played their scenes for the estimate, and what a service says
        that it does, where that takes seconds: it launches rays, with the time that is left."""

    def estimated(self, found: Estimate, free: int | None, episodes: int, workers: int) -> None:
        """Take the estimate of what is left, and the free space of the disk [B]; None: of an address."""

    def returned(self) -> None:
        """A scheduler that was lost is there again: what is measured of time begins anew."""

    def ended(self, result: EpisodeResult) -> None:
        """An episode ended, well or not."""


@dataclass
class Outcome:
    """Outcome of a generation."""

    episodes: int = 0
    """That were played by it."""
    scenes: int = 0
    bytes: int = 0
    """Of their recordings."""
    wall_s: float = 0.0
    """From the first episode to the last."""
    before: int = 0
    """Episodes that were there before."""
    failed: dict[int, str] = field(default_factory=dict)
    """Error by episode."""


def generate(
    plan: DatasetPlan, out: str | Path, observer: Observer, *, workers: int = 0, scheduler: str = ""
) -> Outcome:
    """Play the episodes of a dataset that are not there.

    Args:
        plan: The dataset.
        out: Its folder or address; one that holds a part of the dataset is continued.
        observer: Is told of what happens.
        workers: Processes of this machine; 0: one for each core.
        scheduler: Address of a Dask scheduler; empty: processes of this machine.

    Returns:
        What was played, and what failed.

    Raises:
        RecordingError: The catalogue that is there cannot be used.
        RunError: The folder holds another dataset or damaged recordings, or cannot be written; the disk is
            too small; no scene can be played; the workers are gone.
    """
    if plan.episodes > MOST_EPISODES:
        raise RunError(f"a dataset has {MOST_EPISODES:.0e} episodes at most, and not {plan.episodes}")
    remote = RemoteDataset(str(out)) if is_address(out) else None
    directory = DatasetDirectory(Path(out)) if remote is None else remote.written()
    with writing_dataset(directory, elsewhere=bool(scheduler)):
        if remote is not None:
            _fetch_catalogue(remote, directory)
        settings = plan.settings()
        catalogue = Catalogue(directory.catalogue, writable=True)
        ledger = Ledger(plan, settings, str(out), directory, remote, catalogue)
        try:
            ledger.refuse_other_dataset()  # what is refused here changes nothing at an address
            try:
                return _generate(ledger, observer, workers, scheduler)
            finally:
                ledger.upload()
        finally:
            began = ledger.began
            # SQLite refuses to close a catalogue that was deleted; the command reports the deletion itself.
            with nullcontext() if directory.catalogue.exists() else suppress(CaviarError):
                catalogue.close()
            if not began:  # it was refused before anything was there
                _remove_catalogue(directory)


def _fetch_catalogue(remote: RemoteDataset, directory: DatasetDirectory) -> None:
    """Have the catalogue of an address, where this machine has none, or that of another dataset."""
    fetched = directory.path / "fetched.sqlite"
    if not remote.fetch_catalogue(fetched):
        _remove_catalogue(directory)
        return
    try:
        settings = _settings(fetched, f"{remote.address}/{directory.catalogue.name}")
        # Of the same dataset the one of this machine may know of more: a killed command uploads nothing.
        if not directory.catalogue.exists() or settings != _settings(directory.catalogue):
            _remove_catalogue(directory)
            fetched.replace(directory.catalogue)
    finally:
        fetched.unlink(missing_ok=True)


def _remove_catalogue(directory: DatasetDirectory) -> None:
    """Remove a catalogue, and what a killed command left beside it: it would be taken for the next one's."""
    for end in ("", "-wal", "-shm"):
        directory.catalogue.with_name(f"{directory.catalogue.name}{end}").unlink(missing_ok=True)


def _settings(file: Path, name: str = "") -> str:
    catalogue = Catalogue(file, name=name)
    try:
        return fingerprint(catalogue.settings)
    finally:
        catalogue.close()


def _generate(ledger: Ledger, observer: Observer, workers: int, scheduler: str) -> Outcome:
    plan, catalogue = ledger.plan, ledger.catalogue
    ledger.compare_with_recordings(observer.note)
    there = catalogue.episodes()
    left = MissingEpisodes(there, plan.episodes)
    outcome = Outcome(before=len(there))
    if not left:
        ledger.keep_plan()
        return outcome
    check_least(ledger.directory.path, len(left), plan.scenes, has_recordings=ledger.remote is None)
    traffic = SharedTraffic(plan.scenario)
    traffic.save(plan.episodes, observer.traffic)
    episodes = Episodes(workers, scheduler, observer.note, observer.returned)
    begun = counted(episodes.workers, "process", "processes")
    observer.note(f"connecting to the Dask scheduler {scheduler} …" if scheduler else f"starting {begun} …")
    with episodes:
        _estimate(ledger, left, traffic, episodes, observer)
        ledger.keep_plan()
        began = time.monotonic()
        for result in episodes.play(_tasks(ledger, left, traffic)):
            if not ledger.directory.catalogue.exists():  # SQLite would go on in the file without a name
                raise RunError(f"{ledger.directory.path} was deleted while it was generated, which ended it")
            _keep(result, catalogue, outcome)
            outcome.wall_s = time.monotonic() - began
            observer.ended(result)
            if result.rows is not None and outcome.before + outcome.episodes == 2:
                _warn_of_equal_episodes(catalogue, observer)
    if lost := MissingEpisodes([*catalogue.episodes(), *outcome.failed], plan.episodes):
        raise RunError(
            f"{counted(len(lost), 'episode')} ended without a result, episode {lost[0]} the first; the same "
            "command goes on"
        )
    return outcome


def _warn_of_equal_episodes(catalogue: Catalogue, observer: Observer) -> None:
    """Warn where the first two episodes hold the same products, as where nothing draws at random."""
    of_episode = "SELECT scene, topic, source, sha256 FROM products WHERE episode = ?"
    first, second = catalogue.episodes()[:2]
    if not catalogue.query(f"{of_episode} EXCEPT {of_episode}", (first, second))[1]:
        observer.note(
            f"warning: episodes {first} and {second} are equal, nothing in the scenario draws at random: "
            "generate one, or vary it (traffic of SUMO, paths that the channel draws, a random agent)"
        )


def _tasks(ledger: Ledger, left: Sequence[int], traffic: SharedTraffic) -> Iterator[EpisodeTask]:
    settings = fingerprint(ledger.settings)
    for number in left:
        cached = traffic.states_of(number)
        yield EpisodeTask(ledger.plan.scenario, number, ledger.place, cached=cached, settings=settings)


def _keep(result: EpisodeResult, catalogue: Catalogue, outcome: Outcome) -> None:
    if result.rows is None:
        outcome.failed[result.episode] = result.error
        failed = datetime.now(UTC).isoformat(timespec="seconds")
        catalogue.add_failure(result.episode, failed, result.error, str(result.measured.get("host", "")))
        return
    catalogue.add(result.rows, result.measured)
    outcome.episodes += 1
    outcome.scenes += len(result.rows.scenes)
    outcome.bytes += result.rows.episode[4]


def _estimate(
    ledger: Ledger, left: Sequence[int], traffic: SharedTraffic, episodes: Episodes, observer: Observer
) -> None:
    plan = ledger.plan
    tried = [left[len(left) * quarter // 4] for quarter in (1, 2, 3)]
    workers = counted(episodes.workers, "process", "processes")
    observer.note(f"{workers} started: each loads the scenery and tries three scenes for an estimate …")
    cached = {name: data for number in tried for name, data in traffic.states_of(number).items()}
    trials = episodes.run_on_each(
        try_worker, plan.scenario, ledger.place, tried, cached, on_look=observer.tried
    )
    good = [trial for trial in trials if trial.scenes]
    if not good:
        raise RunError(f"no scene can be played: {trials[0].error}")
    found = estimate(good, len(left), plan.scenes)
    free = check_disk(ledger.directory.path, found.bytes) if ledger.remote is None else None
    observer.estimated(found, free, len(left), episodes.workers)


# --- traffic ------------------------------------------------------------------------------------------------


class SharedTraffic:
    """The traffic that all episodes of a scenario share; none where each has its own.

    Its states are saved once, before the first episode, and travel with the episodes.

    Args:
        scenario: Of the episodes.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._states = list(_shared(scenario))

    def save(self, episodes: int, progress: Callable[[float, float], None] = lambda *_: None) -> None:
        """Save the states that episodes begin from, where one is not there.

        Args:
            episodes: Their number.
            progress: Called now and then with SUMO's time [s], and with that at which the pass ends.

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
