"""Style of all pictures: colours that colour-blind readers distinguish, shared marks, how files are saved."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np

from caviar_clients.files import writing
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.errors import SetupError
from caviar_protocol.host import install_command

# Okabe and Ito, "Color Universal Design", 2008.
BLACK, GREY, LIGHT_GREY = "#222222", "#8c8c8c", "#dcdcdc"
ORANGE, SKY, BLUE, VERMILION = "#e69f00", "#56b4e9", "#0072b2", "#d55e00"

OPTIMUM, AGENT, BASELINE = BLACK, VERMILION, BLUE
"""Colours of the three curves of |y|, the same in every picture."""

Layout = Literal["constrained", "compressed"]
"""Layout engines of Matplotlib: ``compressed`` is for panels of equal aspect."""

_SETTINGS: dict[str, Any] = {
    "font.size": 11.0,
    "axes.titlesize": 12.0,
    "axes.labelsize": 11.0,
    "legend.fontsize": 10.0,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": LIGHT_GREY,
    "grid.linewidth": 0.6,
    "axes.formatter.limits": (-2, 4),
    "axes.formatter.use_mathtext": True,
    "savefig.dpi": 150,
}


@contextmanager
def styled() -> Iterator[None]:
    """Apply the settings of all pictures within a block.

    Raises:
        SetupError: Matplotlib is missing; the error has the command that installs it.
    """
    # For a block, not for the process: in a program of its own a user has settings of Matplotlib, too.
    try:
        from matplotlib import rc_context
    except ModuleNotFoundError as error:
        raise SetupError(
            f"pictures need {error.name!r}, which is not installed; run: {install_command('plot')}"
        ) from error
    with rc_context(_SETTINGS):
        yield


@contextmanager
def figure(file: Path, width: float, height: float, layout: Layout = "constrained") -> Iterator[Any]:
    """Make a figure that is saved as PNG, cut to what is drawn, when the block ends.

    Args:
        file: Where it is saved; folders that are missing are made.
        width: Width [inches].
        height: Height [inches].
        layout: Layout engine.

    Raises:
        SetupError: Matplotlib is missing; the error has the command that installs it.
        RunError: The file cannot be written.

    Example:
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     with figure(Path(folder, "line.png"), 4.0, 3.0) as drawn:
        ...         _ = drawn.subplots().plot([0, 1], [2, 3])
        ...     Path(folder, "line.png").read_bytes()[1:4]
        b'PNG'
    """
    with styled():
        from matplotlib.figure import Figure

        # Not by pyplot, which keeps every figure until it is closed and chooses a backend by the display.
        drawn = Figure(figsize=(width, height), layout=layout)
        yield drawn
        with writing(file):
            drawn.savefig(file, format="png", bbox_inches="tight", pad_inches=0.15)


def legend_below(drawn: Any, axes: Any, columns: int = 3) -> None:
    """Draw the legend of ``axes`` below everything else; nothing where no artist has a label."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        drawn.legend(handles, labels, loc="outside lower center", ncols=columns)


def legend_square(axes: Any, label: str, color: str, edge: str = BLACK, **more: Any) -> None:
    """Add an entry to the legend: a square, which stands for areas of this colour."""
    axes.scatter(
        [], [], marker="s", s=60, facecolor=color, edgecolors=edge, linewidths=0.7, label=label, **more
    )


def shade_frames(axes: Any, time: Float64Array, mask: BoolArray, color: str, label: str = "") -> None:
    """Colour the background of frames, half a period to either side of each.

    Args:
        axes: Axes over time [s].
        time: Time of each frame [s], Shape ``[F]``.
        mask: Which frames, Shape ``[F]``.
        color: Colour of the background.
        label: Entry of the legend; empty: none.
    """
    half = np.median(np.diff(time)) / 2 if len(time) > 1 else 0.5
    # A rise and a fall of the mask for each run of frames: one area each, since edges of neighbours show.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    for n, (first, stop) in enumerate(edges.reshape(-1, 2)):
        axes.axvspan(
            time[first] - half, time[stop - 1] + half, color=color, linewidth=0, zorder=0,
            label=label if label and n == 0 else None,
        )  # fmt: skip
