"""Pictures of the page of a dataset, light and dark, as data within the page."""

from __future__ import annotations

import base64
import io
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_clients.plots.style import BLUE, ORANGE, SKY, styled
from caviar_protocol.arrays import UInt8Array

WIDTH_IN = 9.0
"""Width of a figure [inches]."""
DPI = 144
"""Of the pictures; a page shows them at 96, so that screens with small pixels have more to show."""
DOTS = 3000
"""Places up to this number are dots in a map of gains; more are cells."""
CELLS = 80
"""Cells of a map, along its longer side."""
PANELS = 4
"""Carriers and transmitters with a panel of their own at most."""


@dataclass(frozen=True)
class Theme:
    """Colours of a figure."""

    ink: str
    muted: str
    paper: str
    grid: str
    area: str
    """Of buildings."""
    outline: str
    first: str
    """Of what stands first: a free line of sight."""
    second: str
    """Of what stands second: no line of sight."""
    third: str
    """Of what is missing: no path."""
    ramp: tuple[float, float]
    """Part of viridis that stands out from the paper."""

    @property
    def colours(self) -> Any:
        """Colour map of numbers."""
        from matplotlib import colormaps
        from matplotlib.colors import ListedColormap

        return ListedColormap(colormaps["viridis"](np.linspace(*self.ramp, 256)))

    def settings(self) -> dict[str, Any]:
        """Settings of Matplotlib."""
        ink = ("text.color", "axes.labelcolor", "axes.titlecolor", "xtick.color", "ytick.color")
        paper = ("figure.facecolor", "axes.facecolor", "savefig.facecolor", "legend.facecolor")
        return {
            **dict.fromkeys(ink, self.ink),
            **dict.fromkeys(paper, self.paper),
            "axes.edgecolor": self.muted,
            "legend.edgecolor": self.grid,
            "grid.color": self.grid,
            "hatch.color": self.muted,
        }


LIGHT = Theme(
    "#222222", "#767676", "#ffffff", "#dcdcdc", "#e6e6e6", "#a6a6a6", BLUE, ORANGE, "#b8b8b8", (0.0, 0.95)
)
DARK = Theme(
    "#e4e6e8", "#8d949b", "#17191c", "#33383d", "#2a2f34", "#646c74", SKY, ORANGE, "#6a7178", (0.22, 1.0)
)


@dataclass(frozen=True)
class Picture:
    """A picture within a page."""

    light: str
    """URI with the data of the picture."""
    dark: str
    """The same for dark pages; empty: it is the same."""
    width: int
    """As the page shows it [pixels]."""
    height: int
    alt: str
    """What it shows, for those who do not see it."""


Draw = Callable[[Any, Theme], None]
"""``draw(figure, theme)``"""


def picture(
    draw: Draw, alt: str, height: float, width: float = WIDTH_IN, *, map_like: bool = False
) -> Picture:
    """Draw a figure in both themes.

    Args:
        draw: Draws it.
        alt: What it shows, for those who do not see it.
        height: Its height [inches].
        width: Its width [inches].
        map_like: Whether its axes have an aspect of their own.

    Raises:
        SetupError: Matplotlib is not installed.
    """
    files = [_png(draw, theme, width, height, map_like) for theme in (LIGHT, DARK)]
    pixels = struct.unpack(">II", files[0][16:24])  # of the PNG's header
    size = [round(side * 96 / DPI) for side in pixels]
    return Picture(_uri(files[0], "png"), _uri(files[1], "png"), size[0], size[1], alt)


def pixels(image: UInt8Array, alt: str) -> Picture:
    """Take pixels as they are.

    Args:
        image: Shape ``[height, width, 3]``.
        alt: What it shows, for those who do not see it.
    """
    from matplotlib.image import imsave

    data = io.BytesIO()
    imsave(data, np.ascontiguousarray(image), format="jpg", pil_kwargs={"quality": 88})
    return Picture(_uri(data.getvalue(), "jpeg"), "", image.shape[1], image.shape[0], alt)


def _png(draw: Draw, theme: Theme, width: float, height: float, map_like: bool) -> bytes:
    with styled():
        from matplotlib import rc_context
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        with rc_context(theme.settings()):
            layout: Any = ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.06, compress=map_like)
            drawn = Figure(figsize=(width, height), layout=layout)
            draw(drawn, theme)
            data = io.BytesIO()
            # Axes with an aspect of their own leave margins; to cut them off takes time.
            cut: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.08} if map_like else {}
            drawn.savefig(data, format="png", dpi=DPI, **cut)
    return data.getvalue()


def _uri(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"


# --- maps ------------------------------------------------------------------------------------------------


def plain(name: str) -> str:
    """A name of the user's, in which a dollar sign begins no formula.

    Example:
        >>> print(plain("$a"))
        \\$a
    """
    return name.replace("$", r"\$")


def panel_axes(drawn: Any, count: int) -> list[Any]:
    """Axes of so many panels, two a row."""
    columns = min(count, 2)
    cells = drawn.subplots(-(-count // columns), columns, squeeze=False).ravel()
    for axes in cells[count:]:
        axes.set_axis_off()
    return list(cells[:count])


def share_axis(axes: Any, of: str = "users") -> None:
    from matplotlib.ticker import MaxNLocator

    axes.yaxis.set_major_locator(MaxNLocator(5))
    axes.set_ylabel("Share [%]" if of == "users" else f"Share of {of} [%]")
    axes.grid(axis="y")


def all_handles(drawn: Any) -> tuple[list[Any], list[str]]:
    """Entries of the legends of all panels, each once."""
    found: dict[str, Any] = {}
    for axes in drawn.axes:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    return list(found.values()), list(found)
