"""A comparison from beginning to end, and all that it found."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Literal, get_args

import msgspec

from caviar_clients.tradeoff import ladder
from caviar_clients.tradeoff.campaign import Campaign, Measured, Skipped, Told
from caviar_clients.tradeoff.convergence import Point, points
from caviar_clients.tradeoff.ladder import Block, Setting
from caviar_clients.tradeoff.measure import seen
from caviar_clients.tradeoff.rows import Row, error_fields
from caviar_clients.tradeoff.scenes import Scenes
from caviar_protocol.arrays import quantity
from caviar_protocol.scene import antennas

Part = Literal["ladder", "spacing", "arrays", "convergence"]
PARTS: tuple[Part, ...] = get_args(Part)


class Report(msgspec.Struct, frozen=True, kw_only=True):
    """What a comparison found."""

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
    rows: tuple[Row, ...]
    convergence: tuple[Point, ...]
    skipped: tuple[Skipped, ...]


class Options(msgspec.Struct, frozen=True, kw_only=True):
    """What can be chosen."""

    reference: str | None = None
    baseline: str | None = None
    receivers: int | None = None
    seeds: int = 3
    seconds: float = 600.0
    parts: tuple[Part, ...] = PARTS


_WEIGHTS: Mapping[Block, float] = {
    "ladder": 45,
    "ray spacing": 22,
    "arrays": 8,
    "convergence": 12,
    "diffuse convergence": 13,
}
"""Shares of the time."""


def compare(
    scenes: Scenes, options: Options, machine: Mapping[str, str], told: Callable[[Told], None]
) -> Report:
    """Measure every setting of the chosen parts.

    Raises `RunError` for an unknown label, and where reference or baseline cannot be measured.
    """
    begun = time.monotonic()
    known = (*ladder.LADDER, *ladder.spacing_settings())
    reference, baseline = (
        None if label is None else ladder.find(label, known, option)
        for label, option in ((options.reference, "--reference"), (options.baseline, "--baseline"))
    )
    campaign = Campaign(
        scenes,
        reference=reference,
        baseline=baseline,
        seconds=options.seconds,
        receivers=options.receivers,
        told=told,
    )
    measured = list[Measured]()
    plan = _plan(options, [setting for setting in (reference, baseline) if setting is not None])
    for number, (block, settings) in enumerate(plan):
        share = _WEIGHTS[block] / sum(_WEIGHTS[name] for name, _ in plan[number:])
        measured += campaign.block(block, settings, share) if number else campaign.first(settings, share)
    receivers = [len(antennas(seen(i.scene, options.receivers, None), "rx")) for i in scenes.instants]
    return Report(
        scenario=scenes.name,
        origin=scenes.origin,
        carriers_hz=tuple(carrier.frequency_hz for carrier in scenes.carriers),
        scenes=len(scenes.instants),
        receivers=sum(receivers) / len(receivers),
        reference=campaign.reference,
        baseline=campaign.baseline,
        elapsed_s=time.monotonic() - begun,
        machine=dict(machine),
        rows=tuple(_row(entry, campaign.reference) for entry in measured if not _is_of_a_curve(entry)),
        convergence=tuple(points([e for e in measured if _is_of_a_curve(e)], campaign.channels)),
        skipped=tuple(campaign.skipped),
    )


def _plan(options: Options, chosen: Sequence[Setting]) -> list[tuple[Block, list[Setting]]]:
    """Blocks in order; the first one has what may become reference and baseline."""
    needed = {*ladder.REFERENCES, *ladder.BASELINES} if not chosen else {s.label for s in chosen}
    first = [s for s in ladder.LADDER if "ladder" in options.parts or s.label in needed]
    plan: list[tuple[Block, list[Setting]]] = [("ladder", first + [s for s in chosen if s not in first])]
    if "spacing" in options.parts:
        others = [s for s in ladder.spacing_settings() if s not in chosen]
        plan.append(("ray spacing", others))
    if "arrays" in options.parts:
        plan.append(("arrays", list(ladder.array_settings())))
    if "convergence" in options.parts:
        curves = ladder.convergence_settings(options.seeds)
        for block in ("convergence", "diffuse convergence"):
            plan.append((block, [s for s in curves if s.block == block]))
    return plan


def _is_of_a_curve(entry: Measured) -> bool:
    return entry.setting.block in ("convergence", "diffuse convergence")


def _row(entry: Measured, reference: str) -> Row:
    timing, setting = entry.timing, entry.setting
    notes = (["the reference"] if setting.label == reference else []) + entry.notes
    return Row(
        setting=setting.label,
        block=setting.block,
        column=setting.column,
        row=setting.row,
        rung=entry.rung,
        time_ms_median=timing.median_ms,
        time_ms_p99=timing.p99_ms,
        factor=timing.median_ms / entry.baseline_ms,
        memory_mib=max(timing.memory_mib, default=None),
        loaded_mib=entry.loaded_mib,
        prepare_s=entry.prepare_s,
        measurements=len(timing.times_ms),
        scenes=len(timing.frames),
        receivers=sum(timing.receivers) / len(timing.receivers),
        paths=sum(timing.paths) / len(timing.paths),
        note="; ".join(notes),
        **error_fields(entry.differences),  # type: ignore[arg-type]  # fields of a row, by name
    )
