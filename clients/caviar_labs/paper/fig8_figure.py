"""The figures of ``caviar paper fig8``: both panels of the paper's Fig. 8, of each channel."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.plots.style import (
    AGENT,
    BASELINE,
    GREY,
    LIGHT_GREY,
    OPTIMUM,
    ORANGE,
    figure,
    legend_below,
    shade_frames,
)
from caviar_labs.paper.fig8 import CHANNELS, ChannelName, Report
from caviar_labs.paper.held_out import Episodes
from caviar_protocol.arrays import BoolArray, Float64Array

_STYLES: dict[str, dict[str, Any]] = {
    "optimum": {"color": OPTIMUM, "linewidth": 2.6},
    "DQN, defaults": {"color": ORANGE, "linewidth": 0.9, "alpha": 0.9},
    "DQN, tuned": {"color": AGENT, "linewidth": 1.5},
    "los-beam": {"color": BASELINE, "linewidth": 1.1, "linestyle": "--"},
}
"""Of the curves, from the one at the back to the one in front."""


def draw(report: Report, folder: Path, name: str, label: str = "") -> list[Path]:
    """Draw |y| over time above and the angle below, of each channel.

    Args:
        report: What was played.
        folder: Of the pictures.
        name: Which their names begin with.
        label: Stands in their titles.

    Returns:
        The files, PNG.
    """
    return [
        _draw(channel, episodes, folder / f"{name}-{channel}.png", label)
        for channel, episodes in report.played.items()
    ]


def _draw(channel: ChannelName, played: Episodes, file: Path, label: str) -> Path:
    # The first episode, and the policies of the first seed.
    time: Float64Array = np.arange(played.angle_deg.shape[1], dtype=np.float64) * played.period_s
    has_path, los = played.has_path[0], played.los[0]
    curves = {"optimum": played.optimum[0], "los-beam": played.los_beam[0]}
    curves |= {agent: found[0][0] for agent, found in played.chosen.items()}
    with figure(file, 9.0, 6.0) as drawn:
        top, bottom = drawn.subplots(2, 1, sharex=True, height_ratios=(3, 2))
        for method, style in _STYLES.items():
            if method in curves:
                values = np.where(has_path, curves[method], np.nan)
                top.plot(time, values, label=_label(method, values, los), **style)
        for axes in (top, bottom):
            shade_frames(axes, time, has_path & ~los, LIGHT_GREY, "NLOS")
            axes.grid()
        top.set_ylabel("|y|")
        top.set_ylim(bottom=0)
        top.set_title(CHANNELS[channel] + (f"; {label}" if label else ""))
        bottom.plot(time, played.angle_deg[0], color=GREY, linewidth=1.6)
        bottom.set_ylabel("angle θ [°]")
        bottom.set_xlabel("Time [s]")
        bottom.margins(x=0)
        legend_below(drawn, top, columns=2)
    return file


def _label(method: str, values: Float64Array, los: BoolArray) -> str:
    """Label of a curve, with its means with and without a line of sight."""
    known = ~np.isnan(values)
    kinds = (("LOS", known & los), ("NLOS", known & ~los))
    means = [f"{values[mine].mean():.2f} {kind}" for kind, mine in kinds if mine.any()]
    return f"{method}: mean {', '.join(means)}"
