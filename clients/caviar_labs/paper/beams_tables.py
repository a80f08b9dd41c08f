"""The tables of ``caviar paper beams``, and what differs from what was published."""

from __future__ import annotations

from typing import Any

from caviar_clients.learning.dataset_evaluation import DatasetEvaluation
from caviar_clients.learning.evaluate import Interval
from caviar_clients.learning.rankings import FIGURES
from caviar_labs.paper.beams import Report, experiment_name
from caviar_labs.paper.comparison import NOTHING, Comparison, number

PUBLISHED: tuple[tuple[str, dict[str, str]], ...] = (
    ("challenge, baseline", {"top_10": "83.52", "throughput_10": "0.8415"}),
    ("challenge, winner", {"top_10": "91.17", "throughput_10": "0.9478"}),
    ("Zecchin et al.", {"throughput_1": "0.799"}),
    ("DeepSense 6G", {"top_1": "> 75"}),
    ("Multimodal-Wireless", {"top_1": "80.8"}),
)
"""Published figures by the columns of the table; notes below it say what they are."""
COLUMNS = {
    "top_1": "top-1 %",
    "top_10": "top-10 %",
    "throughput_1": "ratio, 1",
    "throughput_10": "ratio, 10",
}
"""Figures with their columns."""
_KINDS = {"top_1": "top-1 %", "top_10": "top-10 %", "outage_1": "outage %"}

_WHAT = (
    "{users} users with a path in {episodes} held-out episodes; {used} of {pairs} pairs are the best of "
    "one, the entropy of the best pair is {entropy:.2f} bit. ± is the 95 % interval over episodes and "
    "{seeds} seeds."
)
_RATIO = (
    "Throughput ratio: that of the challenge, Σ log₂(1 + max y of the tried pairs) / Σ log₂(1 + max y), y "
    "of DFT matrices that are not normalised. Path gains are small, so that it weighs users by their "
    "amplitude."
)
_WINNER = (
    "The ITU challenge ML5G-PHY (2020) trained on s008 and tested on s009, another traffic in the same "
    "streets of Rosslyn by Wireless InSite, 256 pairs; here episodes of one traffic are held out, and "
    "another city is the harder test. Its labels had random phases of the rays and left out their zenith."
)
_ZECCHIN = (
    "Zecchin, Boloursaz Mashhadi, Jankowski, Gündüz, Kountouris and Gesbert (2021), s008 to s009, LIDAR and "
    "position: 79.9 % of the throughput of an exhaustive sweep without a search, 95 % with six beams. It is "
    "a ratio of throughputs, no accuracy."
)
_OTHERS = (
    "DeepSense 6G: «more than ≈ 75 %» by camera and position (Charan et al., 2022), measured with one car "
    "and 64 beams of the station alone. Multimodal-Wireless: the mean over simulated towns by a language "
    "model that sees pictures and LIDAR (Mao et al., 2026). Both have other codebooks: for orientation."
)
_SIZES = "Parameters of the networks: {}; the challenge's winner had 7,462."
_TIMES = "Time to train a seed on all episodes of training: {}."


def comparisons(report: Report) -> list[Comparison]:
    """Make the tables of a report.

    Args:
        report: What was trained and judged.
    """
    held_out = report.held_out
    judged = {"held-out episodes": held_out}
    if report.other is not None:
        judged[f"another city ({report.other.dataset})"] = report.other
    found = []
    for where, made in judged.items():
        found.append(_benchmark(f"Beam selection, {where}", report, made, published=made is held_out))
        found.append(_kinds(f"With and without a line of sight, {where}", report, made))
        found.append(_worth(f"What the sensors are worth, {where}", report, made))
    found += [_curve(report, kind) for kind in ("LOS", "NLOS") if held_out.users[kind]]
    sizes = _SIZES.format(", ".join(f"{model} {count:,}" for model, count in report.parameters.items()))
    times = _TIMES.format(", ".join(f"{model} {each:.0f} s" for model, each in report.seconds.items()))
    notes = [_RATIO, _WINNER, _ZECCHIN, _OTHERS, sizes, times]
    return [*found, Comparison("What differs", (), (), notes)]


def _shown(found: Interval, figure: str) -> str:
    factor, digits = (1, 3) if figure.startswith("throughput") else (100, 1)
    mean, half = factor * found.mean, factor * found.half_width
    return (
        number(mean, digits) if half != half or half == 0 else f"{number(mean, digits)} ± {half:.{digits}f}"
    )


def _benchmark(title: str, report: Report, made: DatasetEvaluation, *, published: bool) -> Comparison:
    rows: list[tuple[str, ...]] = []
    for method in _whole(report, made):
        cells = [_shown(made.figure(method, "all", name), name) for name in COLUMNS]
        needed = made.beams_needed(method, "all")
        rows.append((method, *cells, NOTHING if needed is None else str(needed)))
    for name, figures in PUBLISHED if published else ():
        rows.append((name, *(figures.get(column, NOTHING) for column in COLUMNS), NOTHING))
    what = _WHAT.format(
        users=f"{made.users['all']:,}", episodes=f"{len(made.episodes):,}", used=made.pairs_used,
        pairs=made.pairs, entropy=made.entropy_bit, seeds=report.seeds,
    )  # fmt: skip
    return Comparison(title, ("", *COLUMNS.values(), "for 90 %"), rows, [what, *made.notes])


def _whole(report: Report, made: DatasetEvaluation) -> list[str]:
    """Methods without the networks that were trained on a share of the episodes."""
    parts = {experiment_name(model, share) for model in report.models for share in report.scenes if share > 1}
    return [method for method in made.methods if method not in parts]


def _kinds(title: str, report: Report, made: DatasetEvaluation) -> Comparison:
    kinds = [kind for kind in ("LOS", "NLOS") if made.users[kind]]
    rows = [
        (method, *(_shown(made.figure(method, kind, name), name) for kind in kinds for name in _KINDS))
        for method in _whole(report, made)
    ]
    columns = ("", *(f"{kind} {column}" for kind in kinds for column in _KINDS.values()))
    users = " and ".join(f"{made.users[kind]:,} {kind}" for kind in kinds)
    return Comparison(title, columns, rows, [f"Users: {users}. Outage: SNR of the first pair below 0 dB."])


def _worth(title: str, report: Report, made: DatasetEvaluation) -> Comparison:
    """Differences to the first network, on the same users."""
    first = report.models[0]
    kinds = [kind for kind in ("all", "LOS", "NLOS") if made.users[kind]]
    rows = [
        (f"{method}, {name.replace('_', '-')}", *(_signed(made, method, first, k, name) for k in kinds))
        for method in (*report.models[1:], "nearest users")
        for name in ("top_1", "top_10")
        if method in made.methods
    ]
    columns = (f"less {first}", *(f"{kind} ({made.users[kind]:,})" for kind in kinds))
    note = "Points, paired by episode and seed; a difference is there where its interval leaves out 0."
    return Comparison(title, columns, rows, [note])


def _signed(made: DatasetEvaluation, method: str, first: str, kind: str, name: str) -> str:
    found = made.difference(method, first, kind, name)
    mean = number(100 * found.mean, 1)
    return f"{mean if mean.startswith('−') else f'+{mean}'} ± {100 * found.half_width:.1f}"


def _curve(report: Report, kind: str) -> Comparison:
    rows = []
    for share in sorted(report.scenes, reverse=True):
        names = [experiment_name(model, share) for model in report.models]
        cells = (_shown(report.held_out.figure(name, kind, "top_10"), "top_10") for name in names)
        rows.append((f"{report.scenes[share]:,}", *cells))
    return Comparison(f"Learning curve, {kind}: top-10 %", ("scenes of training", *report.models), rows)


def figures_of(report: Report) -> dict[str, Any]:
    """All figures of a report, for its JSON file.

    Args:
        report: What was trained and judged.
    """
    first = report.models[0]
    return {
        "held_out": report.held_out.as_json(),
        "other": None if report.other is None else report.other.as_json(),
        "scenes": {str(share): scenes for share, scenes in report.scenes.items()},
        "parameters": dict(report.parameters),
        "seconds": dict(report.seconds),
        "seeds": report.seeds,
        "minus_first": {
            method: {
                kind: {n: vars(report.held_out.difference(method, first, kind, n)) for n in FIGURES}
                for kind in report.held_out.users
                if report.held_out.users[kind]
            }
            for method in report.models
        },
    }
