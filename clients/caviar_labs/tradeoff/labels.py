"""Labels of points in a plot: every text is written where it covers least, tied to its point by a line where
that is far.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

from caviar_clients.plots.style import GREY

# From the middle of the text, cut where its box begins; it ends before the mark of the point.
_LEADER = {
    "arrowstyle": "-",
    "color": GREY,
    "linewidth": 0.7,
    "relpos": (0.5, 0.5),
    "shrinkA": 0,
    "shrinkB": 4,
}
DISTANCES_PT = (9.0, 16.0, 26.0, 38.0, 52.0, 68.0)
DIRECTIONS = 16
GAP_PX = 3.0
LEADER_PT = 12.0
"""A label farther away than this is tied to its point by a line."""
CROSSING = 100.0
"""Area [pixels²] of overlap that is as bad as a step of such a line within something else."""
STEPS = 12
HIDING = 10.0
"""Weight of covering a point, against covering a label or a line."""


class Box(NamedTuple):
    """A rectangle [pixels]."""

    left: float
    bottom: float
    right: float
    top: float

    def overlap(self, other: Box) -> float:
        """Area that both cover [pixels²]."""
        width = min(self.right, other.right) - max(self.left, other.left)
        height = min(self.top, other.top) - max(self.bottom, other.bottom)
        return max(0.0, width) * max(0.0, height)

    def outside(self, other: Box) -> float:
        """Area of this one that the other does not cover [pixels²]."""
        return (self.right - self.left) * (self.top - self.bottom) - self.overlap(other)


class Spot(NamedTuple):
    """Place of a label: its centre relative to its point [points], and the rectangle."""

    dx: float
    dy: float
    distance: float
    box: Box


def spots(x: float, y: float, width: float, height: float, pixels_per_point: float) -> Iterator[Spot]:
    """Yield places around a point for a label, the nearest first.

    Args:
        x: Place of the point [pixels].
        y: Place of the point [pixels].
        width: Size of the label [pixels].
        height: Size of the label [pixels].
        pixels_per_point: Resolution.
    """
    for distance in DISTANCES_PT:
        for step in range(DIRECTIONS):
            angle = 2 * math.pi * step / DIRECTIONS
            along, up = math.cos(angle), math.sin(angle)
            # The distance is that of the label's edge from the point.
            dx = along * (distance * pixels_per_point + width / 2)
            dy = up * (distance * pixels_per_point + height / 2)
            centre_x, centre_y = x + dx, y + dy
            box = Box(
                centre_x - width / 2 - GAP_PX,
                centre_y - height / 2 - GAP_PX,
                centre_x + width / 2 + GAP_PX,
                centre_y + height / 2 + GAP_PX,
            )
            yield Spot(dx / pixels_per_point, dy / pixels_per_point, distance, box)


def place_labels(
    axes: Any,
    points: Sequence[tuple[float, float]],
    texts: Sequence[str],
    line: Sequence[tuple[float, float]] = (),
    size: float = 9.0,
) -> None:
    """Write a text beside each point, off the other points, texts and lines.

    Args:
        axes: Axes with final limits: a text keeps its place when they change, and its point does not.
        points: The points, in data coordinates.
        texts: A text for each.
        line: Corners of a staircase to keep off, in data coordinates.
        size: Size of the font [points].
    """
    # Places around each point are tried, and the least bad one is taken. adjustText 1.4 moves texts until
    # they rest instead: it needs SciPy, and put texts onto points where settings of the ladder are alike.
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    drawn = axes.figure
    canvas = FigureCanvasAgg(drawn)
    canvas.draw()  # the layout is known only then
    pixels_per_point = drawn.dpi / 72
    frame = Box(*axes.get_window_extent().extents)
    pixels = [tuple(axes.transData.transform(point)) for point in points]
    radius = 5 * pixels_per_point
    taken = [Box(x - radius, y - radius, x + radius, y + radius) for x, y in pixels]
    corners = [tuple(axes.transData.transform(point)) for point in line]
    lines = [
        Box(min(x0, x1) - 1, min(y0, y1) - 1, max(x0, x1) + 1, max(y0, y1) + 1)
        for (x0, y0), (x1, y1) in pairwise(corners)
    ]
    for text, (x, y), point in sorted(zip(texts, pixels, points, strict=True), key=lambda e: -e[1][1]):
        style: dict[str, Any] = {
            "textcoords": "offset points",
            "ha": "center",
            "va": "center",
            "fontsize": size,
            "zorder": 5,
            "bbox": {"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8},
        }
        # Written once for its extent, and again where it belongs, with a line where that is far.
        trial = axes.annotate(text, point, xytext=(0, 0), **style)
        extent = trial.get_window_extent(canvas.get_renderer())
        trial.remove()
        found = min(
            spots(x, y, extent.width, extent.height, pixels_per_point),
            key=lambda spot: (
                sum(spot.box.overlap(other) for other in (*taken, *lines))
                + HIDING * sum(spot.box.overlap(other) for other in taken[: len(pixels)])
                + 10 * spot.box.outside(frame)
                + CROSSING * _crossed(x, y, spot, taken),
                spot.distance,
            ),
        )
        taken.append(found.box)
        if found.distance >= LEADER_PT:
            style["arrowprops"] = _LEADER
        axes.annotate(text, point, xytext=(found.dx, found.dy), **style)


def _crossed(x: float, y: float, spot: Spot, taken: Sequence[Box]) -> int:
    """Count steps of the line between a point and its label at which it would cross labels or points."""
    if spot.distance < LEADER_PT:
        return 0
    centre_x, centre_y = (spot.box.left + spot.box.right) / 2, (spot.box.bottom + spot.box.top) / 2
    beside = [box for box in taken if not (box.left <= x <= box.right and box.bottom <= y <= box.top)]
    found = 0
    for step in range(1, STEPS):
        along = step / STEPS
        here_x, here_y = x + along * (centre_x - x), y + along * (centre_y - y)
        here = Box(here_x - 1, here_y - 1, here_x + 1, here_y + 1)
        found += any(box.overlap(here) > 0 for box in beside)
    return found
