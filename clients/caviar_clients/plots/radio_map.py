"""A radio map from above: cells in colour, buildings, transmitters."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.plots.map import OUTLINE, TRANSMITTER, from_above
from caviar_clients.plots.rays import Footprints
from caviar_clients.plots.style import BLACK, GREY, LIGHT_GREY, figure, legend_below
from caviar_protocol.arrays import Float64Array, Int32Array
from caviar_protocol.topics import Scene

SERVERS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#7570b3")
"""Colours of best servers, again from the first where there are more (Okabe and Ito, 2008)."""

_SPAN_DB = 100.0
"""Of the colour bar at the most, below the strongest cells."""

_HATCH, _HATCH_COLOR = "////", "#c4c4c4"
"""Of what no signal reaches, which no colour of the bar looks like."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RadioMapView:
    """What is drawn around the cells of a radio map."""

    area: tuple[float, float, float, float]
    """Lowest x and y, highest x and y of the cells [m]."""
    transmitters: Sequence[str]
    positions: Float64Array
    """Of the transmitters, x and y [m], Shape ``[T, 2]``."""
    scene: Scene
    """Its objects are drawn."""
    footprints: Footprints | None
    title: str


def draw_values(view: RadioMapView, values: Float64Array, label: str, file: Path) -> None:
    """Draw one number for each cell, Shape ``[ny, nx]``; NaN: no signal. ``label`` names it with its unit."""
    with _radio_map(view, file) as (drawn, axes):
        shown = values[np.isfinite(values)]
        low, high, extend = colour_limits(shown)
        image = _draw_cells(axes, view, np.ma.masked_invalid(values), cmap="viridis", vmin=low, vmax=high)
        if len(shown):
            drawn.colorbar(image, ax=axes, label=label, shrink=0.75, pad=0.01, extend=extend)


def draw_servers(view: RadioMapView, server: Int32Array, file: Path) -> None:
    """Draw which transmitter serves each cell, Shape ``[ny, nx]``; −1: no signal."""
    from matplotlib.colors import ListedColormap

    count = len(view.transmitters)
    colors = [SERVERS[t % len(SERVERS)] for t in range(count)]
    with _radio_map(view, file) as (_, axes):
        cells = np.ma.masked_less(server, 0)
        _draw_cells(axes, view, cells, cmap=ListedColormap(colors), vmin=-0.5, vmax=count - 0.5)
        served = max(int(np.count_nonzero(server >= 0)), 1)
        for t, (name, color) in enumerate(zip(view.transmitters, colors, strict=True)):
            label = f"served by {name}, {np.count_nonzero(server == t) / served:.0%}"
            axes.scatter([], [], marker="s", s=60, color=color, edgecolors=BLACK, linewidths=0.7, label=label)


def colour_limits(values: Float64Array) -> tuple[float, float, str]:
    """Ends of the colour bar [dB], and at which of them there are values beyond.

    From the strongest thousandth down to the weakest hundredth, over `_SPAN_DB` at the most.
    """
    if not len(values):
        return 0.0, 1.0, "neither"
    low, high = np.percentile(values, [1.0, 99.9]).tolist()
    low = max(low, high - _SPAN_DB)
    if high - low < 1.0:
        low, high = low - 0.5, high + 0.5
    below, above = values.min() < low, values.max() > high
    ends = {(True, True): "both", (True, False): "min", (False, True): "max", (False, False): "neither"}
    return low, high, ends[bool(below), bool(above)]


@contextmanager
def _radio_map(view: RadioMapView, file: Path) -> Iterator[tuple[Any, Any]]:
    """The picture around the cells, which the block draws."""
    x0, y0, x1, y1 = view.area
    # As high as the cells need, beside 1.5 inches for the colour bar, above 1.6 for title and legend.
    height = float(np.clip((y1 - y0) / (x1 - x0) * 8.0 + 1.6, 4.5, 11.0))
    with figure(file, 9.5, height, layout="compressed") as drawn:
        axes = drawn.subplots()
        axes.patch.set(facecolor="white", hatch=_HATCH, edgecolor=_HATCH_COLOR)
        yield drawn, axes
        _draw_buildings(axes, view.footprints)
        _draw_objects(axes, view.scene)
        _draw_transmitters(axes, view)
        axes.scatter(
            [], [], marker="s", s=60, facecolor="white", edgecolors=_HATCH_COLOR, hatch=_HATCH,
            label="no signal",
        )  # fmt: skip
        axes.set_xlim(x0, x1)
        axes.set_ylim(y0, y1)
        axes.set_aspect("equal")
        axes.set_xlabel("x, east [m]")
        axes.set_ylabel("y, north [m]")
        axes.set_title(view.title)
        legend_below(drawn, axes, columns=4)


def _draw_cells(axes: Any, view: RadioMapView, cells: Any, **colours: Any) -> Any:
    x0, y0, x1, y1 = view.area
    return axes.imshow(
        cells, origin="lower", extent=(x0, x1, y0, y1), interpolation="none", zorder=2, **colours
    )


def _draw_buildings(axes: Any, footprints: Footprints | None) -> None:
    """Areas below the cells, so that those with a signal hide them; outlines above."""
    from matplotlib.collections import LineCollection, PolyCollection

    if footprints is None:
        return
    faces: Any = footprints.faces
    edges: Any = footprints.edges
    axes.add_collection(
        PolyCollection(faces, facecolors=LIGHT_GREY, edgecolors=LIGHT_GREY, linewidths=0.4, zorder=1)
    )
    axes.add_collection(LineCollection(edges, colors=GREY, linewidths=0.5, zorder=3))
    axes.scatter(
        [], [], marker="s", s=60, color=LIGHT_GREY, edgecolors=GREY, linewidths=0.7, label="building"
    )


def _draw_objects(axes: Any, scene: Scene) -> None:
    from matplotlib.collections import PolyCollection

    if scene.names:
        boxes: Any = from_above(scene, OUTLINE)
        axes.add_collection(
            PolyCollection(boxes, facecolors="white", edgecolors=BLACK, linewidths=0.7, zorder=4)
        )
        axes.scatter(
            [], [], marker="s", s=60, color="white", edgecolors=BLACK, linewidths=0.7, label="object"
        )


def _draw_transmitters(axes: Any, view: RadioMapView) -> None:
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2.5, foreground="white")]
    mark = TRANSMITTER
    axes.scatter(
        *view.positions.T, marker=mark.marker, s=mark.size, color=mark.color, edgecolors=mark.edge,
        linewidths=mark.width, zorder=5, label=mark.label,
    )  # fmt: skip
    for name, place in zip(view.transmitters, view.positions, strict=True):
        axes.annotate(
            name, place, xytext=(0, 10), textcoords="offset points", ha="center", fontsize=10,
            fontweight="bold", path_effects=halo, zorder=6, annotation_clip=True,
        )  # fmt: skip
