"""Times of the services of a recorded run, by frame: from the latencies beside its recording."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from caviar_clients.replay.recorded import RecordedRun
from caviar_protocol.errors import RecordingError
from caviar_protocol.files import open_regular
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.recording import FrameEntry
from caviar_protocol.run_directory import RunDirectory

At: TypeAlias = tuple[int, int]
"""(episode, frame); an agent's final grant stands after the last frame."""
Outcome: TypeAlias = Literal["answered", "late", "busy", "skipped"]
"""End of a service's part of a frame. ``busy``: it never got the grant, for it still had an
earlier one; ``skipped``: something that it needs was absent (clause 10)."""


@dataclass(frozen=True)
class Timing:
    """Latencies of one service [ns]: from its GRANT, or the answer before, to its answer."""

    times: Mapping[At, int]
    typical: int
    """Median, for frames that it had no part in."""
    p99: int
    exact: bool
    """Whether each latency could be assigned to its frame."""

    def at(self, episode: int, frame: int) -> int:
        """Look up what a frame took.

        Args:
            episode: From 0 on.
            frame: From 0 on; of an agent's final grant, the number behind the last frame.

        Returns:
            Time [ns]; the median where the service had no part in the frame.
        """
        return self.times.get((episode, frame), self.typical)


def timings_of(run: RecordedRun) -> dict[str, Timing]:
    """Assign the latencies beside a recording to frames.

    Returns:
        Timing of each service that was run, by name.

    Raises:
        RecordingError: There are no latencies beside the recording, or they cannot be read.
    """
    return {name: _timing(run, name, values) for name, values in _latencies(run).items() if len(values)}


def measured_rate(run: RecordedRun) -> float:
    """Work out the frame rate of a recorded run after its warm-up frames [1/s]; 0 where it is unknown."""
    # Without the first tenth, at most ten frames, in which services compile kernels and fill caches.
    finished = _archive(run)["finished_ns"]
    first = min(10, len(finished) // 10)
    if len(finished) - first < 2 or finished[-1] == finished[first]:
        return 0.0
    return float((len(finished) - 1 - first) / (finished[-1] - finished[first]) * 1e9)


def outcomes_of(run: RecordedRun, name: str) -> Iterator[tuple[At, Outcome]]:
    """Find out what became of a service's part of each frame, and of an agent's final grants.

    Yields:
        Episode and frame, and the outcome, in the order of frames.
    """
    agent = run.hellos[name].role == "agent"
    for index in range(len(run.recording)):
        entry = run.recording.entry(index)
        yield (entry.episode, entry.frame), _outcome(entry, name)
        if agent and entry.frame + 1 == run.lengths[entry.episode]:
            yield (entry.episode, entry.frame + 1), "answered"


def _outcome(entry: FrameEntry, name: str) -> Outcome:
    missed = f"{name} missed frame {entry.frame} ("
    for item in _not_fresh(entry.inputs, name):
        if item.cause.startswith(missed):
            return "busy" if ", still busy with frame" in item.cause else "late"
        # A product that lacks for another reason than the service's lacks since its input did.
        if not item.cause.startswith((f"{name} failed", f"{name} produced")):
            return "skipped"
    return "answered"


def _not_fresh(inputs: Iterable[GrantInput], name: str) -> Iterator[GrantInput]:
    return (i for i in inputs if i.source == name and i.status in (Status.HELD, Status.ABSENT))


def _timing(run: RecordedRun, name: str, values: npt.NDArray[np.int64]) -> Timing:
    outcomes = [(at, outcome) for at, outcome in outcomes_of(run, name) if outcome != "skipped"]
    # Latencies carry no frame: they are assigned in order, if there are as many as answers.
    exact = len(outcomes) == len(values)
    if exact:
        times = dict(zip(_in_order_of_latencies(outcomes), values.tolist(), strict=True))
        busy = {at for at, outcome in outcomes if outcome == "busy"}
        times = {at: time for at, time in times.items() if at not in busy}
    else:  # a run that broke off, or whose service came back: in order, as far as they reach
        answered = [at for at, outcome in outcomes if outcome != "busy"]
        times = dict(zip(answered, values.tolist(), strict=False))
    found = np.array(list(times.values()) or values, dtype=np.int64)
    return Timing(times, round(float(np.median(found))), round(float(np.percentile(found, 99))), exact)


def _in_order_of_latencies(outcomes: Iterable[tuple[At, Outcome]]) -> list[At]:
    """Bring frames into the order in which their latencies were noted: that of a late frame is known when it
    is answered, after the frames missed meanwhile."""
    found: list[At] = []
    late: At | None = None
    for at, outcome in outcomes:
        if outcome != "busy" and late is not None:
            found.append(late)
            late = None
        if outcome == "late":
            late = at
        else:
            found.append(at)
    return [*found, late] if late is not None else found


def _latencies(run: RecordedRun) -> dict[str, npt.NDArray[np.int64]]:
    archive = _archive(run)
    prefix = "latency_ns/"
    return {
        key.removeprefix(prefix): values
        for key, values in archive.items()
        if key.startswith(prefix) and key.removeprefix(prefix) in run.hellos
    }


def _archive(run: RecordedRun) -> dict[str, npt.NDArray[np.int64]]:
    path = RunDirectory(run.recording.directory).latencies
    try:
        with open_regular(path) as file, np.load(file) as archive:
            return {key: archive[key] for key in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise RecordingError(
            f"{path} cannot be read: it has the latencies of a run that came to its end, and is made by "
            "caviar run; run the scenario again"
        ) from error
