"""What a recording holds, summed up: sources, link quality, decisions, outages, damage."""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any, cast

import msgspec
import numpy as np

from caviar_protocol.arrays import quantity
from caviar_protocol.errors import RecordingError
from caviar_protocol.files import RunDirectory
from caviar_protocol.messages import Report, Status
from caviar_protocol.recording import RecordedFrame, Recording
from caviar_protocol.topics import Link
from caviar_protocol.topics.channel import INSIDE_PREFIX, UNMATCHED_PREFIX, Cause
from caviar_protocol.topics.scene import WITHOUT_OBJECT_PREFIX

STATE = "state:"
"""Begins the name of a decision that is no choice, but what a service knew when the episode began."""


def counted(number: int, what: str) -> str:
    """``1 frame``, ``2 frames``."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


class Decided(msgspec.Struct, kw_only=True):
    """One decision of one service over all frames: the rung of an adaptive channel, say."""

    service: str
    decision: str
    frames: dict[str, int]
    """How many had each value, the most frequent first."""
    changes: int
    """Frames whose value is not that of the frame before, in the same episode."""
    error_checks: Annotated[int, quantity("1", "stated errors that were measured, of all pairs and frames")]
    error_covered: Annotated[int, quantity("1", "of these, those that held")]


class Decisions:
    """Counts decisions, frame by frame."""

    def __init__(self) -> None:
        self._values: dict[tuple[str, str], Counter[str]] = {}
        self._last: dict[tuple[str, str], tuple[int, str]] = {}
        self._changes: Counter[tuple[str, str]] = Counter()
        self._counts: dict[str, Counter[str]] = {}

    def add(self, episode: int, reports: Iterable[Report]) -> None:
        """What services reported of a frame; frames come in their order."""
        for report in reports:
            if not report.decisions:
                continue
            self._counts.setdefault(report.source, Counter()).update(report.counts)
            for name, value in report.decisions.items():
                if name.startswith(STATE):
                    continue
                key = report.source, name
                self._values.setdefault(key, Counter())[value] += 1
                before, last = self._last.get(key, (episode, value))
                self._changes[key] += before == episode and last != value
                self._last[key] = episode, value

    def summary(self) -> list[Decided]:
        """By service and decision."""
        return [
            Decided(
                service=service,
                decision=name,
                frames=dict(values.most_common()),
                changes=self._changes[service, name],
                error_checks=self._counts[service]["error-checks"],
                error_covered=self._counts[service]["error-covered"],
            )
            for (service, name), values in sorted(self._values.items())
        ]


def decided_lines(found: Sequence[Decided]) -> list[str]:
    """For a user: one line a decision."""
    lines = []
    for entry in found:
        total = sum(entry.frames.values())
        shares = ", ".join(f"{value} {count / total:.0%}" for value, count in entry.frames.items())
        line = f"{entry.service}: {entry.decision} {shares}; {counted(entry.changes, 'change')}"
        if entry.error_checks:
            line += f"; stated error held in {entry.error_covered} of {counted(entry.error_checks, 'check')}"
        lines.append(line)
    return lines


_CAUSES = {cause.count_name: cause for cause in Cause}

SHOWN_INSIDE = 8
"""Antennas inside an object that are named; how many there are more is said."""


class OutageSummary(msgspec.Struct, kw_only=True):
    """Users without a path, summed over frames."""

    users: int
    causes: dict[str, int]
    """Of these, how many for which `Cause`, the most frequent first."""
    unexplained: int
    """Of these, those for which the channel reported no cause: it was held, or is of another make."""
    inside: dict[str, int]
    """Frames in which an antenna without a path stood inside an object, by ``ANTENNA in OBJECT``."""


class Outages:
    """Counts causes, frame by frame."""

    def __init__(self) -> None:
        self._causes: Counter[str] = Counter()
        self._inside: Counter[str] = Counter()

    def add(self, reports: Iterable[Report]) -> None:
        """What services reported of a frame."""
        for report in reports:
            for name, count in report.counts.items():
                if name in _CAUSES:
                    self._causes[_CAUSES[name].value] += count
                elif name.startswith(INSIDE_PREFIX):
                    self._inside[name.removeprefix(INSIDE_PREFIX)] += 1

    def summary(self, users: int) -> OutageSummary | None:
        """The causes of ``users`` users without a path; None where there were none."""
        if not users:
            return None
        return OutageSummary(
            users=users,
            causes=dict(self._causes.most_common()),
            unexplained=max(0, users - self._causes.total()),
            inside=dict(self._inside.most_common()),
        )


def outage_lines(outage: OutageSummary) -> list[str]:
    """For a user: the causes in one line, and what stands inside of what."""
    parts = [f"{count} {cause}" for cause, count in outage.causes.items()]
    if outage.unexplained:
        parts.append(f"{outage.unexplained} for a cause that the channel did not report")
    lines = [", ".join(parts)]
    shown = list(outage.inside.items())[:SHOWN_INSIDE]
    lines += [f"inside an object: {name}, in {_frames(frames)}" for name, frames in shown]
    if len(outage.inside) > len(shown):
        lines.append(f"inside an object: {len(outage.inside) - len(shown)} more antennas")
    return lines


def _frames(count: int) -> str:
    return f"{count} frame" if count == 1 else f"{count} frames"


# What a count means that every frame of a run has, by the count's name or what that begins with.
_NEVER: Mapping[str, str] = {
    "frames-without-users": "{source} had nobody to serve in any frame; see its `users`, and `on` of the "
    "receivers",
    WITHOUT_OBJECT_PREFIX: "device {rest!r} stood on no object of {source} in any frame; see its `on`",
}


class Unserved:
    """Counts frames, and those in which something that the scenario asks for was of no use: an agent without
    users, a device without an object."""

    def __init__(self) -> None:
        self._frames = 0
        self._without: Counter[tuple[str, str]] = Counter()

    def add(self, reports: Iterable[Report]) -> None:
        """What services reported of a frame."""
        self._frames += 1
        for report in reports:
            for name, count in report.counts.items():
                if count and name.startswith(tuple(_NEVER)):
                    self._without[report.source, name] += 1

    def warnings(self) -> list[str]:
        """For a user: a line for each of these that was so from the first frame to the last."""
        return [
            text.format(source=source, rest=name.removeprefix(prefix))
            for (source, name), frames in sorted(self._without.items())
            for prefix, text in _NEVER.items()
            if frames == self._frames and name.startswith(prefix)
        ]


class Unmatched:
    """Keys of a channel's settings that were for nothing, in each of the frames that it reported of."""

    def __init__(self) -> None:
        self._frames: Counter[str] = Counter()
        self._unmatched: Counter[tuple[str, str]] = Counter()

    def add(self, reports: Iterable[Report]) -> None:
        """What services reported of a frame."""
        for report in reports:
            self._frames[report.source] += 1
            for name in report.counts:
                if name.startswith(UNMATCHED_PREFIX):
                    self._unmatched[report.source, name.removeprefix(UNMATCHED_PREFIX)] += 1

    def warnings(self) -> list[str]:
        """For a user: a line for each key that had no effect from the first frame to the last."""
        return [
            f"{source}: {key} had no effect: no object, class or piece of scenery was called so in any frame"
            for (source, key), frames in sorted(self._unmatched.items())
            if frames == self._frames[source]
        ]


_DROPPED = "dropped"


class Dropped:
    """Sums paths that channels dropped because their values are not finite."""

    def __init__(self) -> None:
        self._paths: Counter[str] = Counter()
        self._frames: Counter[str] = Counter()

    def add(self, reports: Iterable[Report]) -> None:
        """What services reported of a frame."""
        for report in reports:
            if paths := report.counts.get(_DROPPED):
                self._paths[report.source] += paths
                self._frames[report.source] += 1

    def warnings(self) -> list[str]:
        """For a user: a line for each channel that dropped paths."""
        return [
            f"{source} dropped {counted(paths, 'path')} with values that are not finite, in "
            f"{_frames(self._frames[source])}: what its model computes is wrong there"
            for source, paths in sorted(self._paths.items())
        ]


SHOWN_DAMAGE = 20
"""Lines about damage that are printed; how many there are more is said."""


class SourceSummary(msgspec.Struct, kw_only=True):
    """What became of one source's products of one topic."""

    topic: str
    source: str
    fresh: int = 0
    held: int = 0
    absent: int = 0
    late: int = 0
    bytes: Annotated[int, quantity("B", "stored")] = 0


class LinkSummary(msgspec.Struct, kw_only=True):
    """Means over frames and users that have a path; |y| of beams of unit norm."""

    mean_abs_y: float | None
    """None where no user ever had a path."""
    mean_abs_y_best: float | None
    mean_abs_y_baseline: float | None
    mean_snr_db: Annotated[float | None, quantity("dB", "mean of the linear SNR of the chosen pairs")]
    """None where no user had a path, or none was served."""
    mean_snr_best_db: Annotated[float | None, quantity("dB", "the same of the best pairs")]
    mean_bit_rate: Annotated[float | None, quantity("bit/s", "of a user with the chosen pair")]
    no_path_share: float | None
    """Share of users without a path; None where there was no user."""
    users: int
    """Users summed over frames."""


class RunSummary(msgspec.Struct, kw_only=True):
    """A recording at a glance."""

    run: str
    scenario: str
    seed: int
    started: str
    complete: bool
    """Whether the recorder closed the recording."""
    segments: int
    episodes: int
    frames: int
    frames_planned: int
    simulated_s: Annotated[float, quantity("s", "up to a sampling period behind the last frames")]
    bytes: Annotated[int, quantity("B", "size of the segments")]
    sources: list[SourceSummary]
    link: LinkSummary | None
    outage: OutageSummary | None
    """Why users had no path; None where all had one."""
    decided: list[Decided]
    warnings: list[str]
    """What the user probably did not mean."""
    versions: dict[str, str]
    machine: dict[str, str]
    notes: tuple[str, ...]
    damage: list[str]


def resume_hint(recording: Recording) -> str:
    """How to go on with a run that was killed; empty for one that ended, or is embedded and cannot go on.

    A recorder closes its recording where `caviar run` alone was killed: such a run has no summary.
    """
    directory, metadata = recording.directory, recording.metadata
    planned = metadata.frames * _episodes_planned(metadata.scenario)
    files = RunDirectory(directory)
    ended = files.summary.is_file() or len(recording) >= planned
    if not files.record.is_file() or (recording.complete and ended):
        return ""
    return (
        f"unless the run still goes on, continue it with: caviar run --resume {shlex.quote(str(directory))}"
    )


def summarise(recording: Recording) -> RunSummary:
    """The summary of a recording. Damaged frames are listed and count as if they had no products."""
    metadata, damage = recording.metadata, list(recording.damage)
    sources: dict[tuple[str, str], SourceSummary] = {}
    totals, decisions, unserved, outages = _LinkTotals(), Decisions(), Unserved(), Outages()
    dropped, unmatched = Dropped(), Unmatched()
    episodes: dict[int, int] = {}  # to the last instant [ns]
    for frame in recording.frames():
        episodes[frame.episode] = max(frame.t_ns, episodes.get(frame.episode, 0))
        decisions.add(frame.episode, frame.reports)
        unserved.add(frame.reports)
        outages.add(frame.reports)
        dropped.add(frame.reports)
        unmatched.add(frame.reports)
        for entry in frame.inputs:
            key = (entry.topic, entry.source)
            source = sources.setdefault(key, SourceSummary(topic=entry.topic, source=entry.source))
            setattr(source, entry.status.value, getattr(source, entry.status.value) + 1)
        try:
            _measure(frame, sources, totals)
        except RecordingError as error:
            damage.append(str(error))
    return RunSummary(
        run=metadata.run,
        scenario=metadata.name,
        seed=metadata.seed,
        started=metadata.started,
        complete=recording.complete,
        segments=len(recording.files),
        episodes=len(episodes),
        frames=len(recording),
        frames_planned=metadata.frames * _episodes_planned(metadata.scenario),
        simulated_s=sum(last + metadata.sampling_period_ns for last in episodes.values()) / 1e9,
        bytes=sum(file.stat().st_size for file in recording.files),
        sources=[sources[key] for key in sorted(sources)],
        link=totals.summary(),
        outage=outages.summary(totals.users - totals.served),
        decided=decisions.summary(),
        warnings=[*unserved.warnings(), *dropped.warnings(), *unmatched.warnings()],
        versions=metadata.versions,
        machine=metadata.machine,
        notes=metadata.notes,
        damage=damage,
    )


class _LinkTotals:
    """Sums over users that have a path, and how many users had none."""

    def __init__(self) -> None:
        self.users = self.served = 0
        # Of |y|, best and baseline |y|, SNR, best SNR, bit rate.
        self._sums = np.zeros(6)

    def add(self, link: Link) -> None:
        with_path = link.has_path
        self.users += len(link.rx)
        self.served += int(with_path.sum())
        best = link.top_abs_y[:, :1].sum(axis=1)  # no column where there is no user
        figures = (link.abs_y, best, link.baseline_abs_y, link.snr, link.snr_best, link.bit_rate)
        self._sums += [values[with_path].sum() for values in figures]

    def summary(self) -> LinkSummary | None:
        if not self.users:
            return None
        means: list[float | None] = [None] * len(self._sums)
        if self.served:
            means = (self._sums / self.served).tolist()
        abs_y, best, baseline, snr, snr_best, bit_rate = means
        return LinkSummary(
            mean_abs_y=abs_y,
            mean_abs_y_best=best,
            mean_abs_y_baseline=baseline,
            mean_snr_db=_db(snr),
            mean_snr_best_db=_db(snr_best),
            mean_bit_rate=bit_rate,
            no_path_share=1 - self.served / self.users,
            users=self.users,
        )


def _db(ratio: float | None) -> float | None:
    return 10 * math.log10(ratio) if ratio else None


def _measure(
    frame: RecordedFrame, sources: dict[tuple[str, str], SourceSummary], totals: _LinkTotals
) -> None:
    for product in frame.products:
        entry = product.provenance
        if entry.status in (Status.FRESH, Status.LATE):
            sources[entry.topic, entry.source].bytes += product.size
        if entry.topic == "link" and entry.status is Status.FRESH:
            totals.add(cast(Link, product.payload))


def _episodes_planned(scenario: dict[str, Any]) -> int:
    run = scenario.get("run")
    episodes = run.get("episodes", 1) if isinstance(run, dict) else 1
    return episodes if isinstance(episodes, int) else 1


def link_quality(snr_db: float | None, snr_best_db: float | None, bit_rate: float) -> str:
    """SNR [dB] against the best beams', and the rate [bit/s] of a user, in words."""
    snr, best = ("none" if value is None else f"{value:.1f} dB" for value in (snr_db, snr_best_db))
    return f"{snr} of {best} at best, mean rate {_rate(bit_rate)} a user"


def _rate(bit_rate: float) -> str:
    for unit in ("bit/s", "kbit/s", "Mbit/s"):
        if bit_rate < 1000:
            return f"{bit_rate:.3g} {unit}"
        bit_rate /= 1000
    return f"{bit_rate:.3g} Gbit/s"
