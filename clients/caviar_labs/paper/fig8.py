"""The paper's Fig. 8: a DQN that chooses beams for a UAV, beside the beam along the straight line.

Three channels: the geometric model with components drawn anew in each frame, as in the paper; with components
that last an episode; and flights over Munich, ray-traced. On each a DQN with the library's defaults observes
the angle alone, as in the paper; on the last two a tuned one observes position and last feedback, and a third
one, with the same hyper-parameters, the angle alone. All are experiments of ``caviar policy train``, which
ship as files; a folder gets copies of these, the recorded flights, and the trainings.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Literal, TypeAlias

from caviar_clients.files import write_file, writing
from caviar_clients.learning.campaign import train_experiments
from caviar_clients.learning.experiment import Experiment, load_experiment
from caviar_clients.learning.training import POLICY, Progress, read_result, seed_folder
from caviar_labs.paper.held_out import Episodes, batch_episodes, recorded_episodes
from caviar_protocol.errors import RunError
from caviar_protocol.host import has_extra, install_command

ChannelName: TypeAlias = Literal["geometric", "quasi-static", "munich"]
AgentName: TypeAlias = Literal["DQN, defaults", "DQN, tuned, angle alone", "DQN, tuned"]

CHANNELS: Mapping[ChannelName, str] = {
    "geometric": "Geometric channel, components drawn in each frame (the paper)",
    "quasi-static": "Geometric channel, components drawn once an episode",
    "munich": "Munich, ray-traced",
}
"""Titles of the channels."""
_AGENTS: Mapping[AgentName, str] = {
    "DQN, tuned": "tuned",
    "DQN, tuned, angle alone": "angle",
    "DQN, defaults": "defaults",
}
_SCENARIOS: Mapping[ChannelName, str] = {
    "geometric": "geometric",
    "quasi-static": "geometric-quasi-static.toml",
    "munich": "munich-flights.toml",
}
FLIGHTS = "munich-flights"
"""Folder of the recorded flights."""
HELD_OUT = ("uav10/rx10", "uav0/rx0", "uav5/rx5", "uav15/rx15")
"""Receivers on flights that no policy is trained on; the first is drawn: no other UAV ever shadows it."""
FIRST_EPISODE = 1000
"""Seed of the first episode of the geometric channel that policies are judged on."""
QUICK = 1 / 15
"""Of the steps, in the quick form."""

_COST_S = {"tuned": 37.0 / 300_000, "angle": 37.0 / 300_000, "defaults": 51.0 / 50_000}
"""Of a step of training [s], for the time left: about, on one core."""
_START_S, _TRACING_S, _JUDGING_S = 4.0, 45.0, 1.5


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Trainings and evaluations of the experiment."""

    folder: Path
    """Of experiments, recording and trainings; what is there already is not done again."""
    seeds: int = 5
    """Of training: 1, 2, …"""
    share: float = 1.0
    """Of the steps of each experiment."""
    episodes: int = 20
    """Of the geometric channel, which policies are judged on."""
    channels: Sequence[ChannelName] = tuple(CHANNELS)
    jobs: int = 1
    """Trainings at a time."""

    def quick(self) -> Settings:
        """The same in a form of some minutes, of which little can be concluded."""
        return replace(self, seeds=min(self.seeds, 2), share=QUICK, episodes=4)


@dataclass(frozen=True)
class Report:
    """Results of the experiment, by channel."""

    played: Mapping[ChannelName, Episodes]
    steps: Mapping[str, int]
    """Of each experiment, for each seed."""
    seeds: tuple[int, ...]
    notes: Sequence[str] = ()
    """What was left out, and how to have it."""


def experiment(
    settings: Settings, progress: Callable[[str, float], None] = lambda what, share: None
) -> Report:
    """Record, train and play what is not there yet, and read the rest.

    Args:
        settings: What.
        progress: Called with what is done, and the share of the expected time that has passed.

    Returns:
        |y| of all agents in episodes that none was trained on.

    Raises:
        RunError: The folder was begun by another version, or with other steps.
        SetupError: The extra ``learning`` is not installed.
    """
    channels, notes = list(settings.channels), []
    if "munich" in channels and not has_extra("channel"):
        channels.remove("munich")
        notes.append(f"Munich is left out: it needs the ray tracer; run: {install_command('channel')}.")
    write_files(settings)
    meter = _Meter(progress)
    tracing = "munich" in channels and not (settings.folder / FLIGHTS).exists()
    names = {channel: _experiments_of(channel) for channel in channels}
    if tracing:
        meter.expect(FLIGHTS, _TRACING_S)
    for channel in channels:
        for agent, name in names[channel].items():
            seconds = _steps(settings.folder / f"{name}.toml") * _COST_S[_AGENTS[agent]]
            for seed in range(1, settings.seeds + 1):
                done = read_result(_trainings(settings) / name, seed) is not None
                meter.expect(f"{name}, seed {seed}", seconds + _START_S, float(done))
                meter.expect(f"{name}, seed {seed} is judged", _JUDGING_S)
    if tracing:
        meter.report(FLIGHTS, 0.0, "sixteen flights over Munich are traced")
        _record_flights(settings.folder)
        meter.report(FLIGHTS, 1.0)
    loaded = [load_experiment(settings.folder / f"{n}.toml") for c in channels for n in names[c].values()]
    _train(loaded, settings, meter)
    played = {}
    for channel in channels:
        episodes = _open(channel, settings)
        for agent, name in names[channel].items():
            for seed in range(1, settings.seeds + 1):
                file = seed_folder(_trainings(settings) / name, seed) / POLICY
                what = f"{name}, seed {seed} is judged"
                meter.report(what, 0.0, what)
                episodes.play(agent, file)
                meter.report(what, 1.0)
        played[channel] = episodes
        episodes.close()
    steps = {one.experiment.name: one.experiment.steps for one in loaded}
    return Report(played, steps, tuple(range(1, settings.seeds + 1)), notes)


def _experiments_of(channel: ChannelName) -> dict[AgentName, str]:
    """Names of the experiments on a channel, by agent."""
    if channel == "geometric":
        return {"DQN, defaults": f"{channel}-defaults"}
    return {agent: f"{channel}-{kind}" for agent, kind in _AGENTS.items()}


def _trainings(settings: Settings) -> Path:
    return settings.folder / "training"


# --- files ------------------------------------------------------------------------------------------------


def write_files(settings: Settings) -> None:
    """Copy experiments and scenarios into the folder, with the steps and seeds of these settings.

    Args:
        settings: Which.

    Raises:
        RunError: The folder has a scenario of another version, on which its trainings stand.
    """
    for name, text in shipped_files().items():
        copy = settings.folder / name
        if name in _SCENARIOS.values():
            if copy.exists() and copy.read_text(encoding="utf-8") != text:
                raise RunError(
                    f"{copy} is not that of this version; remove {settings.folder}, or name another --out"
                )
        else:
            text = _with_seeds_and_steps(text, settings)
        write_file(copy, text)


def shipped_files() -> dict[str, str]:
    """Texts of the experiments and scenarios that ship, by the names of their files.

    Example:
        >>> [name for name in shipped_files() if name.startswith("geometric")]
        ['geometric-defaults.toml', 'geometric-quasi-static.toml']
    """
    folder = Path(str(resources.files("caviar_scenarios"))) / "fig8"
    return {file.name: file.read_text(encoding="utf-8") for file in sorted(folder.glob("*.toml"))}


_STEPS = re.compile(r"(?m)^((?:checkpoint_)?steps) = ([\d_]+)")


def _with_seeds_and_steps(text: str, settings: Settings) -> str:
    def fewer(found: re.Match[str]) -> str:
        return f"{found[1]} = {max(1, round(int(found[2]) * settings.share)):_}"

    seeds = list(range(1, settings.seeds + 1))
    return _STEPS.sub(fewer, re.sub(r"(?m)^seeds = .*$", f"seeds = {seeds}", text))


def _steps(file: Path) -> int:
    (steps,) = re.findall(r"(?m)^steps = ([\d_]+)", file.read_text(encoding="utf-8"))
    return int(steps)


def _record_flights(folder: Path) -> None:
    """Trace the flights over Munich; the recording gets its name when it is whole."""
    import caviar

    partial = folder / f"{FLIGHTS}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    run = caviar.run(folder / _SCENARIOS["munich"], out=partial, embedded=True)
    with writing(folder / FLIGHTS):
        run.rename(folder / FLIGHTS)
        shutil.rmtree(partial)


# --- training and playing -----------------------------------------------------------------------------------


def _train(experiments: Sequence[Experiment], settings: Settings, meter: _Meter) -> None:
    def report(name: str, progress: Progress) -> None:
        share = min(1.0, progress.steps / progress.total)
        meter.report(f"{name}, seed {progress.seed}", share, f"{name}, seed {progress.seed}")

    # The longest first: at the end no core waits for another one.
    ordered = sorted(experiments, key=lambda one: one.environment.members == 1)
    train_experiments(ordered, _trainings(settings), settings.jobs, report, keep_checkpoints=False)


def _open(channel: ChannelName, settings: Settings) -> Episodes:
    if channel == "munich":
        return recorded_episodes(settings.folder / FLIGHTS, HELD_OUT)
    name = _SCENARIOS[channel]
    scenario = settings.folder / name if name.endswith(".toml") else name
    return batch_episodes(scenario, settings.episodes, FIRST_EPISODE)


def done_seeds(settings: Settings) -> int:
    """Count trainings of these settings that an earlier call has ended.

    Args:
        settings: Which.
    """
    return sum(
        read_result(_trainings(settings) / name, seed) is not None
        for channel in settings.channels
        for name in _experiments_of(channel).values()
        for seed in range(1, settings.seeds + 1)
    )


class _Meter:
    """The share of the expected time that has passed, of all parts together."""

    def __init__(self, progress: Callable[[str, float], None]) -> None:
        self._progress, self._parts = progress, dict[str, tuple[float, float]]()
        self._text = ""

    def expect(self, part: str, seconds: float, share: float = 0.0) -> None:
        self._parts[part] = seconds, share

    def report(self, part: str, share: float, text: str = "") -> None:
        self._parts[part] = self._parts[part][0], share
        self._text = text or self._text
        total = sum(seconds for seconds, _ in self._parts.values())
        self._progress(self._text, sum(seconds * done for seconds, done in self._parts.values()) / total)
