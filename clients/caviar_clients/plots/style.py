"""What all pictures share: size, colours that colour-blind readers tell apart, how they are saved."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from caviar_clients.files import writing
from caviar_protocol.errors import SetupError
from caviar_protocol.host import install_command

# Okabe and Ito, "Color Universal Design", 2008.
BLACK, GREY, LIGHT_GREY = "#222222", "#8c8c8c", "#dcdcdc"
ORANGE, SKY, BLUE, VERMILION = "#e69f00", "#56b4e9", "#0072b2", "#d55e00"

OPTIMUM, AGENT, BASELINE = BLACK, VERMILION, BLUE
"""Colours of the three curves of |y|, the same in every picture."""

Layout = Literal["constrained", "compressed"]
"""Of Matplotlib: ``compressed`` for panels of equal aspect."""

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
    "axes.formatter.limits": (-2, 4),
    "axes.formatter.use_mathtext": True,
    "savefig.dpi": 150,
}


@contextmanager
def styled() -> Iterator[None]:
    """The settings of all pictures. Raises `SetupError` where Matplotlib is missing."""
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
    """A figure [inches] that is saved as PNG, cut to what is drawn, when the block ends.

    Raises `SetupError` with the command to install Matplotlib where it is missing, `RunError`
    where the file cannot be written.
    """
    with styled():
        from matplotlib.figure import Figure

        drawn = Figure(figsize=(width, height), layout=layout)
        yield drawn
        with writing(file):
            drawn.savefig(file, format="png", bbox_inches="tight", pad_inches=0.15)


def legend_below(drawn: Any, axes: Any, columns: int = 3) -> None:
    """The legend of ``axes``, below everything else."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        drawn.legend(handles, labels, loc="outside lower center", ncols=columns)
