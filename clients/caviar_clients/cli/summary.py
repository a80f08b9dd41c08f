"""Figures of a run, from its recording: as a structure, and as JSON (``caviar run --json``).

`summary_table` puts them into words.
"""

from __future__ import annotations

import math
import shlex
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import msgspec
import numpy as np

from caviar_clients.cli.shared import counted
from caviar_protocol.arrays import BoolArray, Float64Array, quantity
from caviar_protocol.errors import RecordingError
from caviar_protocol.messages import Report, Status
from caviar_protocol.policies import REFUSED
from caviar_protocol.recording import Recording
from caviar_protocol.run_directory import RunDirectory
from caviar_protocol.space.codebooks import DFT
from caviar_protocol.topics import Channel, Link
from caviar_protocol.topics.channel import INSIDE_PREFIX, UNMATCHED_PREFIX, Cause
from caviar_protocol.topics.scene import (
    BESIDE_ROAD_PREFIX,
    LEFT_GEOFENCE_PREFIX,
    MESH_REFUSED_PREFIX,
    OUTSIDE_GEOFENCE_PREFIX,
    SIMULATOR_SAYS_PREFIX,
    WITHOUT_OBJECT_PREFIX,
)

STATE = "state:"
"""Begins the name of a decision that is no choice, but what a service knew when the episode began."""

_CAUSES = {cause.count_name: cause for cause in Cause}
# What a count means that every frame of a run has, by the count's name or what that begins with.
_NEVER: Mapping[str, str] = {
    "frames-without-users": "{source} had no user to serve in any frame; see its `users`, and `on` of the "
    "receivers",
    WITHOUT_OBJECT_PREFIX: "device {rest!r} stood on no object of {source} in any frame; see its `on`",
}
SHOWN_ALIKE = 8
"""Warnings of one source that differ in a name alone."""
# What a count means in whatever frames have it, likewise.
_EVER: Mapping[str, str] = {
    "dropped": "{source} dropped {paths} with values that are not finite, in {frames}: what its model "
    "computes is wrong there",
    "persons-put-elsewhere": "{source} shows people elsewhere at once {times}: SUMO put them farther away "
    "than they walk; see its option --pedestrian.model",
    "snr-above-60-db": "{source}: SNR above 60 dB in {frames}, first in {first}, where beams hardly matter; "
    "see power_dbm of the transmitters, bandwidth_hz of the carriers, "
    "services.{source}.settings.noise_figure_db and the channel's normalization",
    LEFT_GEOFENCE_PREFIX: "{rest!r} of {source} left its geofence {times}, first in {first}",
    OUTSIDE_GEOFENCE_PREFIX: "{rest!r} of {source} was commanded to places outside of its geofence in "
    "{frames}, first in {first}, and kept within",
    SIMULATOR_SAYS_PREFIX: "the simulator of {source} warned {times}, first in {first}: {rest}",
    BESIDE_ROAD_PREFIX: "{rest!r} of {source} is one rigid box, and too long for its bend in {frames}, first "
    "in {first}: its rear is beside the road or track",
    MESH_REFUSED_PREFIX: "mesh {rest!r} of {source} was refused in {first}; its objects were boxes",
}


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


class OutageSummary(msgspec.Struct, kw_only=True):
    """Users without a path, summed over frames."""

    users: int
    causes: dict[str, int]
    """Of these, how many for which `Cause`, the most frequent first."""
    unexplained: int
    """Of these, those for which the channel reported no cause: it was held, or is of another make."""
    inside: dict[str, int]
    """Frames in which an antenna without a path stood inside an object, by ``ANTENNA in OBJECT``."""


class SourceSummary(msgspec.Struct, kw_only=True):
    """Fate of one source's products of one topic."""

    topic: str
    source: str
    fresh: int = 0
    held: int = 0
    absent: int = 0
    late: int = 0
    bytes: Annotated[int, quantity("B", "stored")] = 0


class PacketSummary(msgspec.Struct, kw_only=True):
    """Fate of packets, over all frames and users."""

    arrived: Annotated[int, quantity("bit", "came for users")]
    sent: Annotated[int, quantity("bit", "came through")]
    dropped: Annotated[int, quantity("bit", "too old, or the buffer was full")]
    delivered: int
    """Packets of which the last bit came through."""
    mean_delay: Annotated[float | None, quantity("s", "of these")]
    """None where there was none."""
    mean_throughput: Annotated[float, quantity("bit/s", "of a user")]
    blocks: int
    """Transport blocks that were sent."""
    block_errors: int
    """Of these, how many were not decoded."""


class LinkFigures(msgspec.Struct, kw_only=True):
    """Means over frames and users that have a path; |y| of beams of unit norm."""

    mean_abs_y: float | None
    """None where no user ever had a path."""
    mean_abs_y_best: float | None
    mean_abs_y_baseline: float | None
    loss_to_best_db: Annotated[
        float | None, quantity("dB", "mean |y|² of the best pairs over that of the chosen")
    ]
    """None where no user had a path, or none was served."""
    gain_over_random_db: Annotated[float | None, quantity("dB", "mean |y|² over that of a random pair")]
    """None likewise, and where H was not recorded."""
    mean_snr_db: Annotated[float | None, quantity("dB", "mean of the linear SNR of the chosen pairs")]
    """None where no user had a path, or none was served."""
    mean_snr_best_db: Annotated[float | None, quantity("dB", "the same of the best pairs")]
    mean_bit_rate: Annotated[float | None, quantity("bit/s", "of a user with the chosen pair")]
    no_path_share: float | None
    """Share of users without a path; None where there was no user."""
    users: int
    """Users summed over frames."""


class StationSummary(LinkFigures, kw_only=True):
    """The users of one transmitter on one carrier."""

    tx: str
    carrier: str


class LinkSummary(LinkFigures, kw_only=True):
    """All users of a run, and those of each transmitter and carrier."""

    stations: list[StationSummary] = []
    """Empty where there is one alone."""
    packets: PacketSummary | None = None
    """None where the link has no packets."""


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
    simulated_s: Annotated[float, quantity("s", "up to a sampling period after the last frames")]
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


class ReportTally:
    """Counts what services reported of the frames of a run."""

    def __init__(self) -> None:
        self._frames = 0
        self._reported: Counter[str] = Counter()
        # By source and name of a count: its sum, and the frames in which it was not 0.
        self._sums: Counter[tuple[str, str]] = Counter()
        self._frames_with: Counter[tuple[str, str]] = Counter()
        # Episode and frame of the first of these.
        self._first: dict[tuple[str, str], tuple[int, int]] = {}
        # By source and name of a decision: its values, the last one with its episode, and its changes.
        self._values: dict[tuple[str, str], Counter[str]] = {}
        self._last: dict[tuple[str, str], tuple[int, str]] = {}
        self._changes: Counter[tuple[str, str]] = Counter()
        # Agents and what they could not serve, in the order in which they said so.
        self._refused: dict[tuple[str, str], None] = {}

    def add(self, episode: int, reports: Iterable[Report], number: int = 0) -> None:
        """Count the reports of a frame. Frames come in their order.

        Args:
            episode: Of the frame.
            reports: What each service reported of it.
            number: Of the frame.
        """
        self._frames += 1
        for report in reports:
            self._reported[report.source] += 1
            for name, count in report.counts.items():
                self._sums[report.source, name] += count
                if count:
                    self._frames_with[report.source, name] += 1
                    self._first.setdefault((report.source, name), (episode, number))
            for name, value in report.decisions.items():
                if name.startswith(STATE):
                    continue
                if name == REFUSED:  # it is said once, of a policy: no choice that every frame has
                    self._refused[report.source, value] = None
                    continue
                key = report.source, name
                self._values.setdefault(key, Counter())[value] += 1
                before, last = self._last.get(key, (episode, value))
                # The first frame of an episode starts from what the service is set to: that is no change.
                self._changes[key] += before == episode and last != value
                self._last[key] = episode, value

    def decisions(self) -> list[Decided]:
        """Sum up the decisions, sorted by service and name."""
        return [
            Decided(
                service=service,
                decision=name,
                frames=dict(values.most_common()),
                changes=self._changes[service, name],
                error_checks=self._sums[service, "error-checks"],
                error_covered=self._sums[service, "error-covered"],
            )
            for (service, name), values in sorted(self._values.items())
        ]

    def outage(self, users: int) -> OutageSummary | None:
        """Sum up why users had no path.

        Args:
            users: Users without a path, summed over frames.

        Returns:
            The causes; None where every user had a path.
        """
        if not users:
            return None
        causes, inside = Counter[str](), Counter[str]()
        for (source, name), count in self._sums.items():
            if name in _CAUSES:
                causes[_CAUSES[name].value] += count
            elif name.startswith(INSIDE_PREFIX):
                inside[name.removeprefix(INSIDE_PREFIX)] += self._frames_with[source, name]
        return OutageSummary(
            users=users,
            causes=dict(causes.most_common()),
            unexplained=max(0, users - causes.total()),
            inside=dict(inside.most_common()),
        )

    def warnings(self) -> list[str]:
        """Warn of what the user probably did not mean: a policy that an agent refused, an agent without users
        in any frame, a device without an object, paths that were dropped for values that are not finite, an
        object outside of its geofence, a mesh that was refused, a key without effect, an SNR that no receiver
        has."""
        never, unmatched = [], []
        for (source, name), frames in sorted(self._frames_with.items()):
            never_prefix = next(filter(name.startswith, _NEVER), "")
            if never_prefix and frames == self._frames:
                never.append(_NEVER[never_prefix].format(source=source, rest=name.removeprefix(never_prefix)))
            # A channel that joined late has reported of fewer frames than there are.
            elif name.startswith(UNMATCHED_PREFIX) and frames == self._reported[source]:
                unmatched.append(
                    f"{source}: {name.removeprefix(UNMATCHED_PREFIX)} had no effect: no object, class or "
                    "piece of scenery was called so in any frame"
                )
        refused = [
            f"{source} refused policy {value.partition(' ')[0][:12]}…, and stayed with the one that it had: "
            f"{value.partition(' ')[2]}"
            for source, value in self._refused
        ]
        return [*refused, *never, *self._ever(), *unmatched]

    def _ever(self) -> Iterator[str]:
        """Say what was counted that a run had better be without; of one kind and source a few."""
        alike = Counter[tuple[str, str]]()
        for (source, name), frames in sorted(self._frames_with.items()):
            kind = next((p for p in _EVER if name == p or (p[-1] == "/" and name.startswith(p))), "")
            alike[source, kind] += 1
            if kind and alike[source, kind] <= SHOWN_ALIKE:
                episode, number = self._first[source, name]
                yield _EVER[kind].format(
                    source=source,
                    rest=name.removeprefix(kind),
                    paths=counted(self._sums[source, name], "path"),
                    times=counted(self._sums[source, name], "time"),
                    frames=counted(frames, "frame"),
                    first=f"frame {number} of episode {episode}",
                )
        for (source, kind), count in alike.items():
            if kind and count > SHOWN_ALIKE:
                yield f"{source}: {count - SHOWN_ALIKE} more counts of {kind.rstrip('/')!r}"


class PacketTotals:
    """Sums over links, of which those without packets count as nothing."""

    def __init__(self) -> None:
        self._counts = np.zeros(6, np.int64)
        self._delay, self._throughput, self._receivers, self._any = 0.0, 0.0, 0, False

    def add(self, link: Link) -> None:
        """Add a frame's link."""
        if link.arrived is None or link.delay is None or link.delivered is None or link.throughput is None:
            return
        self._any = True
        counts = (link.arrived, link.sent, link.dropped, link.delivered, link.blocks, link.block_errors)
        self._counts += [0 if values is None else int(values.sum()) for values in counts]
        self._delay += float(link.delay @ link.delivered)
        self._throughput += float(link.throughput.sum())
        # A receiver on a carrier is one user here, however many transmitters reach it.
        self._receivers += len(set(zip(link.rx, link.carrier, strict=True)))

    def summary(self) -> PacketSummary | None:
        """Figures of all links; None where none had packets."""
        if not self._any:
            return None
        arrived, sent, dropped, delivered, blocks, errors = self._counts.tolist()
        return PacketSummary(
            arrived=arrived,
            sent=sent,
            dropped=dropped,
            delivered=delivered,
            mean_delay=self._delay / delivered if delivered else None,
            mean_throughput=self._throughput / max(self._receivers, 1),
            blocks=blocks,
            block_errors=errors,
        )


class _UserTotals:
    """Sums over users that have a path, and how many users had none."""

    def __init__(self) -> None:
        self.users = self.served = 0
        # Of |y|, best and baseline |y|, SNR, best SNR, bit rate, |y|² chosen, best, random; sums, so that a
        # run of any length fits.
        self._sums = np.zeros(9)

    def add(self, link: Link, random: Float64Array, which: BoolArray | slice = slice(None)) -> None:
        """Add a frame's users, or some of them; ``random`` is the mean |y|² of all pairs of each."""
        with_path = link.has_path[which]
        self.users += len(with_path)
        self.served += int(with_path.sum())
        best = link.top_abs_y[:, :1].sum(axis=1)  # the column lacks where there is no user
        amplitudes = (link.abs_y, best, link.baseline_abs_y)
        powers = (link.abs_y**2, best**2, random)
        figures = (*amplitudes, link.snr, link.snr_best, link.bit_rate, *powers)
        self._sums += [values[which][with_path].sum() for values in figures]

    def means(self) -> dict[str, Any]:
        """Fields of `LinkFigures`."""
        means: list[float | None] = [None] * len(self._sums)
        if self.served:
            means = (self._sums / self.served).tolist()
        abs_y, best, baseline, snr, snr_best, bit_rate, power, power_best, power_random = means
        return {
            "mean_abs_y": abs_y,
            "mean_abs_y_best": best,
            "mean_abs_y_baseline": baseline,
            "loss_to_best_db": _db(power_best / power) if power and power_best else None,
            "gain_over_random_db": _db(power / power_random) if power and power_random else None,
            "mean_snr_db": _db(snr),
            "mean_snr_best_db": _db(snr_best),
            "mean_bit_rate": bit_rate,
            "no_path_share": 1 - self.served / self.users,
            "users": self.users,
        }


class _LinkTotals:
    """Totals of all users, and of those of each transmitter and carrier."""

    def __init__(self) -> None:
        self.all, self._packets = _UserTotals(), PacketTotals()
        self._stations: dict[tuple[str, str], _UserTotals] = defaultdict(_UserTotals)

    def add(self, link: Link, channels: Sequence[Channel]) -> None:
        self._packets.add(link)
        random = _random_power(link, channels)
        self.all.add(link, random)
        of_user = list(zip(link.tx, link.carrier, strict=True))
        for station in dict.fromkeys(of_user):
            self._stations[station].add(link, random, np.array([user == station for user in of_user]))

    def summary(self) -> LinkSummary | None:
        if not self.all.users:
            return None
        stations = [
            StationSummary(tx=tx, carrier=carrier, **totals.means())
            for (tx, carrier), totals in sorted(self._stations.items())
        ]
        return LinkSummary(
            **self.all.means(),
            stations=stations if len(stations) > 1 else [],
            packets=self._packets.summary(),
        )


def _random_power(link: Link, channels: Sequence[Channel]) -> Float64Array:
    """Mean |y|² over all beam pairs of each user; NaN where its H is not recorded.

    DFT codebooks are orthonormal bases, so the sum over all pairs is the squared Frobenius norm of H.
    """
    mean = {
        (channel.tx[matrix.tx], channel.rx[matrix.rx], channel.carriers[matrix.carrier].name): np.vdot(
            matrix.h, matrix.h
        ).real
        / matrix.h.size
        for channel in channels
        for matrix in channel.h
    }
    users = zip(link.tx, link.rx, link.carrier, strict=True)
    return np.array([mean.get(user, math.nan) for user in users], np.float64)


def _db(ratio: float | None) -> float | None:
    # 0 is no path at all, and no number of decibels; what is not a number is not known.
    return 10 * math.log10(ratio) if ratio and not math.isnan(ratio) else None


def _has_dft_alone(scenario: dict[str, Any]) -> bool:
    devices = scenario.get("devices")
    arrays = [device.get("array") for device in devices or () if isinstance(device, dict)]
    return all(array.get("codebook", DFT) == DFT for array in arrays if isinstance(array, dict))


def _episodes_planned(scenario: dict[str, Any]) -> int:
    # As it was recorded, perhaps by another version: nothing about its form is certain.
    run = scenario.get("run")
    episodes = run.get("episodes", 1) if isinstance(run, dict) else 1
    return episodes if isinstance(episodes, int) else 1


def summarise(recording: Recording) -> RunSummary:
    """Sum up a recording.

    Damaged frames are listed, and count as if they had no products.

    Example:
        >>> summary = summarise(Recording("runs/smoke-20261122-101500"))
        >>> summary.frames == summary.frames_planned
        True
    """
    metadata, damage = recording.metadata, list(recording.damage)
    sources: dict[tuple[str, str], SourceSummary] = {}
    totals, reports = _LinkTotals(), ReportTally()
    orthonormal = _has_dft_alone(metadata.scenario)
    episodes: dict[int, int] = {}  # to the last instant [ns]
    for frame in recording.frames():
        episodes[frame.episode] = max(frame.t_ns, episodes.get(frame.episode, 0))
        reports.add(frame.episode, frame.reports, frame.number)
        for entry in frame.inputs:
            key = (entry.topic, entry.source)
            source = sources.setdefault(key, SourceSummary(topic=entry.topic, source=entry.source))
            setattr(source, entry.status.value, getattr(source, entry.status.value) + 1)
        # A frame whose payloads are damaged still has its entries, and counts with them.
        links: list[Link] = []
        channels: list[Channel] = []
        try:
            for product in frame.products:
                entry = product.provenance
                if entry.status in (Status.FRESH, Status.LATE):
                    sources[entry.topic, entry.source].bytes += product.size
                if entry.status is Status.FRESH and entry.topic == "link":
                    links.append(cast(Link, product.payload))
                elif entry.status is Status.FRESH and entry.topic == "channel" and orthonormal:
                    channels.append(cast(Channel, product.payload))
        except RecordingError as error:
            damage.append(str(error))
            continue
        for link in links:
            totals.add(link, channels)
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
        outage=reports.outage(totals.all.users - totals.all.served),
        decided=reports.decisions(),
        warnings=reports.warnings(),
        versions=metadata.versions,
        machine=metadata.machine,
        notes=metadata.notes,
        damage=damage,
    )


def resume_hint(recording: Recording) -> str:
    """Write the command that resumes a run which was killed; empty for one that ended or has no journal."""
    directory, metadata = recording.directory, recording.metadata
    planned = metadata.frames * _episodes_planned(metadata.scenario)
    files = RunDirectory(directory)
    # Where `caviar run` alone was killed, the recorder still closes its recording: no summary tells that.
    ended = files.summary.is_file() or len(recording) >= planned
    if not files.record.is_file() or (recording.complete and ended):
        return ""
    return (
        f"unless the run still goes on, continue it with: caviar run --resume {shlex.quote(str(directory))}"
    )


def recorded_figures(directory: Path) -> RunSummary | None:
    """Sum up the recording of a run; None where it has none that can be read."""
    try:
        return summarise(Recording(directory))
    except RecordingError:
        return None


_OF_OUTCOME = ("frames_per_second", "warm_up_frames", "services", "deadlines", "pace", "digest")


def summary_of(
    outcome: Mapping[str, Any],
    recorded: RunSummary | None,
    scenario: str,
    directory: Path,
    seed: int,
    warnings: Sequence[str] = (),
) -> dict[str, Any]:
    """Collect what ``caviar run --json`` writes.

    Of a run that ended early ``frames_recorded`` may be one more than ``frames``: a frame that the recorder
    had answered and other services had not. The digest is that of ``frames``.

    Args:
        outcome: The broker's report of the end, the event ``finished``.
        recorded: Figures of the recording; None where there is none.
        scenario: The scenario's name.
        directory: The run's directory.
        seed: The run's.
        warnings: Of the scenario and its services, which stand before those of the recording.
    """
    figures = recorded.link if recorded else None
    return {
        "run": directory.name,
        "scenario": scenario,
        "seed": seed,
        "complete": not outcome["error"],
        "error": outcome["error"],
        "frames": outcome["frames"],
        "frames_recorded": recorded.frames if recorded else None,
        **{key: outcome[key] for key in _OF_OUTCOME},
        **{
            name: msgspec.to_builtins(getattr(figures, name, None))
            for name in LinkSummary.__struct_fields__
            if name != "users"
        },
        "outage": msgspec.to_builtins(recorded.outage) if recorded else None,
        "decided": msgspec.to_builtins(recorded.decided) if recorded else [],
        "warnings": [*warnings, *(recorded.warnings if recorded else ())],
    }
