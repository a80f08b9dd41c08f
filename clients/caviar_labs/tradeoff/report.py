"""A comparison from beginning to end: its rows, and the convergence over samples.

`compare` measures a plan of blocks with a `Campaign` and makes a `Report`, which `tables` and `plot` show.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from itertools import combinations
from statistics import fmean
from typing import Annotated, Literal, get_args

import msgspec
import numpy as np

from caviar_clients.session.scenes import Scenes
from caviar_labs.tradeoff import ladder
from caviar_labs.tradeoff.campaign import Campaign, Measured, Progress, Skipped, candidates
from caviar_labs.tradeoff.errors import Key, Row, UserChannel, differences, error_fields
from caviar_labs.tradeoff.ladder import TRUTH, Block, Setting
from caviar_labs.tradeoff.worker import is_known, seen
from caviar_protocol.arrays import quantity
from caviar_protocol.space.scene import antennas
from caviar_services.registry import load
from caviar_space.mitsuba_xml import find_scenery


class Point(msgspec.Struct, frozen=True, kw_only=True):
    """Measurements of all seeds with one number of samples. A pair is two of the seeds, over all users."""

    paths: str
    """``specular`` or ``diffuse``."""
    samples: Annotated[int, quantity("1", "rays launched per transmitter")]
    seeds: int
    time_ms_median: Annotated[float, quantity("ms", "wall time of a scene")]
    nmse_db: tuple[float, ...]
    """Of each seed against the most samples [dB], as `Row.nmse_db`; none for diffuse paths."""
    pair_nmse_db: Annotated[float | None, quantity("dB", "NMSE of H between the seeds of a pair")]
    pair_gain_db_p95: Annotated[float | None, quantity("dB", "95 % of pairs differ by less in path gain")]
    pair_beam_top1: Annotated[float | None, quantity("1", "share of pairs with the same best beam pair")]
    users: Annotated[int, quantity("1", "user pairs compared")]


def points(measured: Sequence[Measured]) -> list[Point]:
    """Make a point for each kind of path and number of samples."""
    groups: dict[tuple[str, str], list[Measured]] = {}
    truth: dict[Key, UserChannel] = {}
    for entry in measured:
        if entry.setting.label == TRUTH:
            truth = entry.users
        else:
            groups.setdefault((entry.setting.column, entry.setting.row), []).append(entry)
    return [_point(kind, int(row), group, truth) for (kind, row), group in groups.items()]


def _point(kind: str, samples: int, group: Sequence[Measured], truth: Mapping[Key, UserChannel]) -> Point:
    pairs = [d for one, other in combinations(group, 2) for d in differences(one.users, other.users)]
    # Each pair of seeds as if one were the reference: how far apart two runs of a user's may be.
    between = error_fields(pairs)
    against = [error_fields(differences(entry.users, truth))["nmse_db"] for entry in group]
    return Point(
        paths=kind,
        samples=samples,
        seeds=len(group),
        time_ms_median=float(np.median([ms for entry in group for ms in entry.times_ms])),
        # Specular paths become more and more the same; diffuse ones are drawn anew with each seed.
        nmse_db=tuple(v for v in against if v is not None) if kind == "specular" else (),
        pair_nmse_db=between["nmse_db"],
        pair_gain_db_p95=between["path_gain_error_db_p95"],
        pair_beam_top1=between["beam_top1"],
        users=len(pairs),
    )


Part = Literal["ladder", "keyframes", "spacing", "arrays", "convergence"]
PARTS: tuple[Part, ...] = get_args(Part)


class Answer(msgspec.Struct, frozen=True, kw_only=True):
    """The setting to take for an error or a time."""

    error_db: Annotated[float | None, quantity("dB", "greatest NMSE of H that was asked for")] = None
    time_ms: Annotated[float | None, quantity("ms", "longest median time of a scene that was asked for")] = (
        None
    )
    setting: str | None
    """None: no setting that was measured is as good, or as fast."""


def pareto_rows(rows: Sequence[Row], reference: str) -> list[Row]:
    """Select the rows of the ladder that no other one beats in both time and NMSE, from the fastest on.

    Args:
        rows: Of a report. Those that saw fewer receivers than the reference did are left out, as their times
            are of less work.
        reference: Its setting, which has no error and is left out.
    """
    whole = max((row.receivers for row in rows), default=0.0)
    found = list[Row]()
    for row in sorted(
        (
            row
            for row in rows
            if row.block == "ladder"
            and row.setting != reference
            and row.nmse_db is not None
            and row.receivers == whole
        ),
        key=lambda row: (row.time_ms_median, row.nmse_db),
    ):
        if not found or (row.nmse_db or 0.0) < (found[-1].nmse_db or 0.0):
            found.append(row)
    return found


def answers(
    rows: Sequence[Row], reference: str, errors_db: Sequence[float], times_ms: Sequence[float]
) -> tuple[Answer, ...]:
    """Choose the fastest setting for each error, and the most accurate one for each time.

    Args:
        rows: Of a report.
        reference: Setting that errors are against. It is the answer only where no other one is.
        errors_db: NMSE of H at most [dB].
        times_ms: Median times of a scene at most [ms].
    """
    front = pareto_rows(rows, reference)
    own = [row for row in rows if row.setting == reference and row.block == "ladder"]
    found = []
    for error in errors_db:
        good = [row for row in front if (row.nmse_db or 0.0) <= error] + own
        found.append(Answer(error_db=error, setting=good[0].setting if good else None))
    for time_ms in times_ms:
        fast = [row for row in front + own if row.time_ms_median <= time_ms]
        # The front becomes more accurate as it becomes slower, and the reference has no error.
        found.append(Answer(time_ms=time_ms, setting=fast[-1].setting if fast else None))
    return tuple(found)


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """Findings of a comparison, as ``caviar measure tradeoff --json`` writes them."""

    scenario: str
    origin: str
    """Where the scenes are from."""
    carriers_hz: tuple[float, ...]
    scenes: int
    receivers: Annotated[float, quantity("1", "of a scene, mean")]
    reference: str
    """Setting that errors are against."""
    baseline: str
    """Setting that factors are against."""
    elapsed_s: Annotated[float, quantity("s", "wall time of the whole")]
    machine: dict[str, str]
    answers: tuple[Answer, ...] = ()
    """The setting to take for each error, and for each time, that was asked for."""
    rows: tuple[Row, ...]
    convergence: tuple[Point, ...]
    skipped: tuple[Skipped, ...]


class Options(msgspec.Struct, frozen=True, kw_only=True):
    """Options of a comparison.

    Args:
        reference: Label of the setting that errors are against; None: the finest that can be measured.
        baseline: Label of the setting that factors of time are against; None: the default.
        receivers: Receivers of a scene at most; None: all.
        seeds: Seeds of each point of the convergence.
        seconds: Time for everything [s].
        parts: Parts that are measured.
        errors_db: NMSE of H [dB] that the fastest setting is named for.
        times_ms: Times of a scene [ms] that the most accurate setting is named for.

    Example:
        >>> Options(parts=("ladder",), seconds=60.0).receivers is None
        True
    """

    reference: str | None = None
    baseline: str | None = None
    receivers: int | None = None
    seeds: int = 2
    seconds: float = 720.0
    parts: tuple[Part, ...] = PARTS
    errors_db: tuple[float, ...] = (-10.0, -20.0)
    times_ms: tuple[float, ...] = (10.0, 50.0, 200.0)


_WEIGHTS: Mapping[Block, float] = {
    "ladder": 36,
    "keyframes": 4,
    "ray spacing": 28,
    "arrays": 12,
    "convergence": 10,
    "diffuse convergence": 14,
}
# Shares of the time; a block that needs less leaves the rest to those after it.


def compare(
    scenes: Scenes, options: Options, machine: Mapping[str, str], report: Callable[[Progress], None]
) -> Report:
    """Measure every setting of the chosen parts.

    Args:
        scenes: Scenes that are measured on.
        options: Parts, time, reference and baseline.
        machine: Facts about the machine, for the report.
        report: Called with the progress.

    Raises:
        RunError: A label is unknown, or no baseline can be measured.
    """
    begun = time.monotonic()
    # Measured before anything else and on every scene: all errors of the report are against it.
    known = (*ladder.LADDER, *ladder.spacing_settings())
    references = candidates(options.reference, ladder.REFERENCES, known, "--reference")
    references = comparable([s for s in references if is_known(s, scenes)], scenes) or references
    baselines = candidates(options.baseline, ladder.BASELINES, known, "--baseline")
    campaign = Campaign(
        scenes,
        baseline=baselines,
        whole=[references[0].label],
        seconds=options.seconds,
        receivers=options.receivers,
        report=report,
    )
    with closing(campaign):
        # All candidates in the ladder, where each is a line anyway; without it only the best one is measured.
        needed = references if "ladder" in options.parts else references[:1]
        plan = _plan(options, list(dict.fromkeys([*needed, campaign.baseline])))
        measured, interpolated = list[Measured](), list[Row]()
        for number, (block, settings) in enumerate(plan):
            # Of the time that is left: what one block does not need, those after it share.
            share = _WEIGHTS[block] / sum(_WEIGHTS[name] for name, _ in plan[number:])
            if block == "keyframes":
                interpolated += campaign.keyframes(share)
            else:
                measured += campaign.block(block, settings, share)
    # Chosen at the end, among what was measured: the finest may have run out of memory, or of time.
    labels = [*(setting.label for setting in references), *ladder.REFERENCES[:-1], campaign.baseline.label]
    reference = _reference(labels, measured)
    rows = (*(_row(entry, reference) for entry in measured if not _is_of_a_curve(entry)), *interpolated)
    receivers = [len(antennas(seen(i.scene, options.receivers, None), "rx")) for i in scenes.instants]
    return Report(
        scenario=scenes.name,
        origin=scenes.origin,
        carriers_hz=tuple(carrier.frequency_hz for carrier in scenes.carriers),
        scenes=len(scenes.instants),
        receivers=fmean(receivers),
        reference=reference.setting.label,
        baseline=campaign.baseline.label,
        elapsed_s=time.monotonic() - begun,
        machine=dict(machine),
        answers=answers(rows, reference.setting.label, options.errors_db, options.times_ms),
        rows=rows,
        convergence=tuple(points([entry for entry in measured if _is_of_a_curve(entry)])),
        skipped=tuple(campaign.skipped),
    )


def comparable(references: Sequence[Setting], scenes: Scenes) -> list[Setting]:
    """Leave out references that know no scenery, where there is some and others know it.

    Against those, the reflections of the scenery would count as errors.
    """
    if find_scenery(scenes.assets) is None:
        return list(references)
    traced = [setting for setting in references if load("channel", setting.use).uses_scenery]
    return traced or list(references)


def _plan(options: Options, needed: Sequence[Setting]) -> list[tuple[Block, list[Setting]]]:
    """Order the blocks; the first one has reference and baseline, which the others need."""
    first = [s for s in ladder.LADDER if "ladder" in options.parts or s in needed]
    plan: list[tuple[Block, list[Setting]]] = [("ladder", [*first, *(s for s in needed if s not in first)])]
    if "keyframes" in options.parts:
        plan.append(("keyframes", []))
    if "spacing" in options.parts:
        plan.append(("ray spacing", [s for s in ladder.spacing_settings() if s not in needed]))
    if "arrays" in options.parts:
        plan.append(("arrays", list(ladder.array_settings())))
    if "convergence" in options.parts:
        curves = ladder.convergence_settings(options.seeds)
        for block in ("convergence", "diffuse convergence"):
            plan.append((block, [s for s in curves if s.block == block]))
    return plan


def _reference(labels: Sequence[str], measured: Sequence[Measured]) -> Measured:
    """The first of these that was measured; the baseline, the last of them, always is."""
    by_label = {entry.setting.label: entry for entry in measured}
    return next(by_label[label] for label in labels if label in by_label)


def _is_of_a_curve(entry: Measured) -> bool:
    return entry.setting.block in ("convergence", "diffuse convergence")


def _row(entry: Measured, reference: Measured) -> Row:
    setting, scenes = entry.setting, entry.scenes.values()
    # Users of other arrays have other channels.
    found = differences(entry.users, reference.users) if setting.elements is None else []
    notes = (["the reference"] if entry is reference else []) + entry.notes
    return Row(
        setting=setting.label,
        block=setting.block,
        column=setting.column,
        row=setting.row,
        rung=entry.loaded.first.rung,
        time_ms_median=entry.median_ms,
        time_ms_p99=float(np.percentile(entry.times_ms, 99)),
        factor=entry.median_ms / entry.baseline_ms,
        memory_mib=max((s.memory_mib for s in entry.samples if s.memory_mib is not None), default=None),
        loaded_mib=entry.loaded.memory_mib,
        prepare_s=entry.loaded.seconds,
        measurements=len(entry.samples),
        scenes=len(scenes),
        receivers=fmean(sample.receivers for sample in scenes),
        paths=fmean(sample.paths for sample in scenes),
        note="; ".join(notes),
        **error_fields(found),  # type: ignore[arg-type]  # fields of a row, by name
    )
