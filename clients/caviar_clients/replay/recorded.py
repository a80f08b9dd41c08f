"""A recorded run as replays need it: scenario, producers of each input, length, and times of each service."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from caviar_clients.session.prepared import declared_hello, demanded
from caviar_protocol.digest import RunDigest
from caviar_protocol.errors import DeclarationError, RecordingError
from caviar_protocol.files import open_regular
from caviar_protocol.messages import PROTOCOL_VERSION, GrantInput, Hello, Status
from caviar_protocol.recording import FrameEntry, Recording
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.scenario import Scenario, ServiceSpec


class RecordedRun:
    """The run that a recording holds.

    Args:
        recording: Open.

    Raises:
        RecordingError: It holds no frame, or a scenario that this version does not read.

    Example:
        >>> run = RecordedRun(Recording("runs/smoke-20261122-101500"))
        >>> run.topics["link"]
        ('link',)
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        if not len(recording):
            raise RecordingError(f"{recording.path} holds no frame, so there is nothing to repeat")
        try:
            self.scenario = msgspec.convert(recording.metadata.scenario, Scenario)
        except msgspec.ValidationError as error:
            made = recording.metadata.versions.get("caviar", "another version")
            raise RecordingError(
                f"{recording.path} was recorded by {made}, its scenario is not one of this version: {error}; "
                "replay it with the version that recorded it"
            ) from error

    @cached_property
    def topics(self) -> Mapping[str, tuple[str, ...]]:
        """Recorded topics of each service; one that was not run has none."""
        # The first and the last frame: a service may join late, or be given up.
        entries = (self.recording.entry(index) for index in (0, len(self.recording) - 1))
        pairs = {(item.source, item.topic) for entry in entries for item in entry.inputs}
        return {
            name: tuple(sorted(topic for source, topic in pairs if source == name))
            for name in self.scenario.services
        }

    @cached_property
    def hellos(self) -> Mapping[str, Hello]:
        """HELLO of each service; without its implementation, with the topics that were recorded."""
        return {name: self._hello(name, spec) for name, spec in self.scenario.services.items()}

    def _hello(self, name: str, spec: ServiceSpec) -> Hello:
        try:
            return declared_hello(name, spec)
        except DeclarationError:
            return Hello(version=PROTOCOL_VERSION, name=name, role=spec.role, outputs=self.topics[name])

    @cached_property
    def demand(self) -> tuple[str, ...]:
        """Topics that the run produced, and the parts demanded of them, as entries of ``run.record``."""
        found = demanded(self.hellos, self.scenario.run.record)
        recorded = {topic for topics in self.topics.values() for topic in topics}
        return tuple(sorted(entry for entry in found | recorded if entry.partition(".")[0] in recorded))

    @cached_property
    def parts_are_known(self) -> bool:
        """True where every consumer's declaration is here, so that a part not demanded is not recorded."""
        return not any(spec.remote for spec in self.scenario.services.values())

    @cached_property
    def lengths(self) -> Mapping[int, int]:
        """Frames of each recorded episode."""
        found: dict[int, int] = {}
        for index in range(len(self.recording)):
            entry = self.recording.entry(index)
            found[entry.episode] = entry.frame + 1
        return found

    def after(self, names: Iterable[str]) -> set[str]:
        """Find the services downstream: those that take a product of these, at any lag, or of such a service.

        Args:
            names: Services to start from.

        Returns:
            Names of services, without recorders and services of which nothing was recorded.
        """
        found: set[str] = set()
        # Inputs of a frame before count, too: the graph has circles, as from the link back to the agent.
        todo = list(names)
        while todo:
            name = todo.pop()
            outputs = set(self.hellos[name].outputs)
            for other, hello in self.hellos.items():
                takes = any(item.topic in outputs for item in hello.inputs)
                if takes and hello.role != "recorder" and other not in found and self.topics[other]:
                    found.add(other)
                    todo.append(other)
        return found

    def misses(self, name: str) -> int:
        """Count the frames in which a service's products were held or absent."""
        statuses = (Status.HELD, Status.ABSENT)
        entries = (self.recording.entry(index) for index in range(len(self.recording)))
        return sum(any(i.source == name and i.status in statuses for i in entry.inputs) for entry in entries)

    def digest(self, frames: int) -> str:
        """Work out the digest of the run, had it been shorter.

        Args:
            frames: Of each episode, at most.
        """
        # As the broker does: of each frame the digests of its fresh products.
        chain = RunDigest()
        for index in range(len(self.recording)):
            entry = self.recording.entry(index)
            if entry.frame < frames:
                fresh = ((i.topic, i.source, i.digest) for i in entry.inputs if i.status is Status.FRESH)
                chain.add_frame(entry.episode, entry.frame, fresh)
        return chain.hexdigest()


At: TypeAlias = tuple[int, int]
"""(episode, frame); an agent's final grant stands after the last frame."""
Outcome: TypeAlias = Literal["answered", "late", "busy", "skipped"]
"""What became of a service's part of a frame. ``busy``: it never got the grant, for it still had an
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
