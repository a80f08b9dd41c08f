"""CAVIAR from a program or a notebook: run a scenario, open its recording, make an environment.

>>> import caviar
>>> run = caviar.run("smoke", frames=10, out="results")
>>> recording = caviar.open(run)
>>> recording["channel"].h.shape  # frames × users × Nr × Nt
(10, 2, 4, 32)

Importing this package registers the environments, so that ``gymnasium.make("caviar:caviar/BeamSelection-v0",
scenario="geometric")`` needs no other import. Ray tracer, SUMO and broker are loaded when a run needs them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import caviar_clients.envs as _registered  # noqa: F401
from caviar_protocol.space.beams import beam_gains, best_pairs

if TYPE_CHECKING:
    from caviar.recorded_run import RecordedRun
    from caviar_clients.datasets.reader import Dataset
    from caviar_protocol.scenario import Scenario

__all__ = ["beam_gains", "best_pairs", "dataset", "load_scenario", "open", "run"]


def load_scenario(scenario: str | Path) -> Scenario:
    """Read and check a scenario.

    Args:
        scenario: Name of a scenario that ships (``caviar scenarios``), or a TOML file.

    Returns:
        The scenario, a frozen struct: ``run``, ``services``, ``devices``, ``carriers`` and what else its file
        may have, with defaults filled in.

    Raises:
        ScenarioError: A key or value is wrong; the text has file, line and remedy.

    Example:
        >>> import caviar
        >>> caviar.load_scenario("smoke").run.sampling_period_ns
        100000000
    """
    from caviar_protocol.scenario import find_scenario
    from caviar_protocol.scenario import load_scenario as load

    return load(find_scenario(Path(scenario)))


def run(
    scenario: str | Path,
    *,
    frames: int | None = None,
    seed: int | None = None,
    episodes: int | None = None,
    settings: Sequence[str] = (),
    record: str | Sequence[str] | None = None,
    out: str | Path = "runs",
    embedded: bool = False,
    progress: bool = False,
) -> Path:
    """Run a scenario to its end, as ``caviar run`` does.

    In the main thread it handles Ctrl-C for the time of the run, which ends in order. In another one, as of
    ``asyncio.to_thread``, Ctrl-C is the program's, and the run goes on.

    Args:
        scenario: Name of a scenario that ships, or a TOML file.
        frames: Frames of each episode; None for those of the scenario.
        seed: Of all random numbers, from 0 to 2⁶³ − 1; None for that of the scenario.
        episodes: Of the run; None for those of the scenario.
        settings: ``KEY=VALUE`` each, in place of the scenario's, as ``--set`` of the command:
            ``["services.channel.settings.samples=1000"]``.
        record: Topics to record, ``["scene", "channel.h"]`` or ``"scene,channel.h"``; None for those of the
            scenario.
        out: Directory in which the run's own is made.
        embedded: Whether all services run in this process, without sockets; the digest is the same.
        progress: Whether to print what ``caviar run`` prints.

    Returns:
        The directory of the run: recording, summary, logs.

    Raises:
        ScenarioError: A key or value of the scenario is wrong.
        SetupError: An extra that the scenario needs is not installed; the text has the command.
        RunError: The run did not come to its end; the text has the cause and the directory.
        TypeError: ``settings`` is no list of texts.

    Example:
        >>> import caviar
        >>> directory = caviar.run("smoke", frames=3, embedded=True)
        >>> sorted(file.name for file in directory.glob("summary.*"))
        ['summary.json', 'summary.txt']
    """
    from rich.console import Console

    from caviar_clients.cli.run import run_scenario
    from caviar_clients.cli.shared import keys_set
    from caviar_protocol.errors import RunError

    if not (isinstance(settings, list | tuple) and all(isinstance(key, str) for key in settings)):
        raise TypeError(f"settings is {settings!r:.80}: write a list of KEY=VALUE texts, as ['run.seed=3']")
    # A notebook shows the widgets of a console that is quiet, too.
    console = Console(quiet=not progress, force_jupyter=None if progress else False)
    topics = record if record is None or isinstance(record, str) else ",".join(record)
    keys = keys_set(settings, topics, episodes)
    outcome = run_scenario(Path(scenario), Path(out), console, frames, seed, embedded=embedded, settings=keys)
    if outcome.status:
        raise RunError(f"the run in {outcome.directory} ended early: {outcome.error}")
    return outcome.directory


def open(run: str | Path | None = None) -> RecordedRun:  # noqa: A001 - read as caviar.open
    """Open the recording of a run.

    Args:
        run: Directory of the run; None for the newest one below ``runs``.

    Returns:
        The recording: arrays by topic over all frames (``recording["link"].abs_y``), or frame by frame. A
        notebook shows its summary and a map, with ``.view()`` its world in 3D.

    Raises:
        RecordingError: There is no recording, or it is damaged; the text has the place and the remedy.

    Example:
        >>> import caviar
        >>> run = caviar.run("smoke", frames=3, embedded=True)
        >>> caviar.open(run)["link"].abs_y.shape  # frames × users
        (3, 2)
    """
    from caviar.recorded_run import RecordedRun
    from caviar_protocol.recording import newest_run

    return RecordedRun(newest_run() if run is None else run)


def dataset(path: str | Path) -> Dataset:
    """Open a dataset that ``caviar dataset generate`` wrote.

    Args:
        path: Folder of the dataset, or its address (``s3://bucket/s008``).

    Returns:
        The dataset: tables as columns (``data.users(los=True)["gain_db"]``), recorded arrays a row for each
        user (``data.users()["channel.h"]``), splits by episode, and the recording of each episode.

    Raises:
        RecordingError: There is no dataset; the text has the place and the remedy.
    """
    from caviar_clients.datasets.reader import Dataset

    return Dataset(path)
