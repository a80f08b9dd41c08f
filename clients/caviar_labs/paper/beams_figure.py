"""The picture of ``caviar paper beams``: accuracy over tried pairs, LOS and NLOS, and learning curves."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from caviar_clients.learning.dataset_evaluation import DatasetEvaluation
from caviar_clients.plots.style import AGENT, BASELINE, BLACK, GREY, ORANGE, SKY, figure, legend_below
from caviar_labs.paper.beams import Report, experiment_name
from caviar_protocol.arrays import Float64Array

MOST = 30
"""Pairs along the axis."""
_COLOURS = {
    "position": BASELINE,
    "lidar": ORANGE,
    "fusion": AGENT,
    "nearest users": BLACK,
    "fingerprint": SKY,
    "los-beam": GREY,
}


def draw(report: Report, file: Path, label: str = "") -> Path:
    """Draw top-k accuracy over k with and without a line of sight, and below it over the scenes of training.

    Args:
        report: What was judged.
        file: Of the picture, PNG.
        label: Stands in its title.

    Returns:
        The file.
    """
    kinds = [kind for kind in ("LOS", "NLOS") if report.held_out.users[kind]]
    with figure(file, 9.0, 7.0) as drawn:
        panels = drawn.subplots(2, len(kinds), sharey="row", squeeze=False)
        for column, kind in enumerate(kinds):
            top, bottom = panels[0][column], panels[1][column]
            for method, colour in _COLOURS.items():
                if method in report.held_out.methods:
                    curve = _accuracy(report.held_out, method, kind)
                    top.plot(np.arange(1, MOST + 1), 100 * curve, color=colour, label=method)
            top.set_title(f"{kind}, {report.held_out.users[kind]:,} users")
            top.set_xlabel("pairs that are tried")
            for model in report.models:
                scenes, means, halves = [], [], []
                for share, count in sorted(report.scenes.items(), reverse=True):
                    found = report.held_out.figure(experiment_name(model, share), kind, "top_10")
                    scenes.append(count)
                    means.append(100 * found.mean)
                    halves.append(100 * found.half_width)
                bottom.errorbar(scenes, means, halves, color=_COLOURS[model], marker="o", capsize=3)
            bottom.set_xscale("log")
            counts = sorted(report.scenes.values())
            bottom.set_xticks(counts, [f"{count:,}" for count in counts])
            bottom.minorticks_off()
            bottom.set_xlabel("scenes of training")
            for axes in (top, bottom):
                axes.grid()
        panels[0][0].set_ylabel("best pair among them [%]")
        panels[1][0].set_ylabel("top-10 [%]")
        if label:
            drawn.suptitle(label)
        legend_below(drawn, panels[0][0], columns=3)
    return file


def _accuracy(made: DatasetEvaluation, method: str, kind: str) -> Float64Array:
    """Top-k accuracy of k = 1 … `MOST`, the mean over seeds."""
    ranks = np.concatenate([run.rank for run in made.terms[method][kind]])
    counts = np.bincount(np.minimum(ranks, MOST), minlength=MOST + 1)[:MOST]
    found: Float64Array = np.cumsum(counts) / len(ranks)
    return found
