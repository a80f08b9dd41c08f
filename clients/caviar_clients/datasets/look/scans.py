"""LIDAR scans and pictures of the page of a dataset."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from typing import Any

import numpy as np

from caviar_clients.datasets.look.data import (
    SAMPLE_SCENES,
    Content,
    Scan,
)
from caviar_clients.datasets.look.html import absent, figure
from caviar_clients.datasets.look.pictures import (
    Draw,
    Theme,
    all_handles,
    picture,
    pixels,
    plain,
)
from caviar_clients.datasets.texts import counted
from caviar_clients.plots.map import View
from caviar_clients.plots.style import VERMILION, legend_square
from caviar_protocol.arrays import Float64Array


def draw_scans(scans: Sequence[Scan]) -> Draw:
    """A panel for each LIDAR scan, from above."""

    def draw(drawn: Any, theme: Theme) -> None:
        rows, columns = (len(scans), 1) if _is_wide(scans) else (1, len(scans))
        panels = drawn.subplots(rows, columns, squeeze=False)
        for axes, scan in zip(panels.ravel(), scans, strict=True):
            if scan.grid is not None:
                _draw_grid(axes, scan.grid, theme)
            else:
                _draw_points(drawn, axes, scan, theme)
            axes.scatter(
                *scan.position, marker="*", s=130, color=VERMILION, edgecolors=theme.paper, linewidths=0.8,
                zorder=5, label="the sensor",
            )  # fmt: skip
            (left, right), (bottom, top) = _scan_view(scan)
            axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
            title = plain(scan.title)
            axes.set_title(title.replace("\n", ", ") if columns == 1 else title, fontsize=9.5)
        for axes in panels[-1]:
            axes.set_xlabel("x, east [m]")
        for axes in panels[:, 0]:
            axes.set_ylabel("y, north [m]")
        if rows > 1 and len({_scan_view(scan) for scan in scans}) == 1:
            for axes in panels[:-1, 0]:
                axes.tick_params(labelbottom=False)  # as those below
        handles, labels = all_handles(drawn)
        drawn.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)

    return draw


def scans_height(scans: Sequence[Scan]) -> float:
    """Height of the figure of these scans [inches]."""
    if not _is_wide(scans):
        return 4.7 if len(scans) > 1 else 6.2
    heights = [(top - bottom) / (right - left) for (left, right), (bottom, top) in map(_scan_view, scans)]
    return 0.9 + sum(max(7.8 * height, 0.7) + 0.45 for height in heights)


def _is_wide(scans: Sequence[Scan]) -> bool:
    """Whether scans stand one below the other: those along a street."""
    views = [_scan_view(scan) for scan in scans]
    return all((right - left) > 2.0 * (top - bottom) for (left, right), (bottom, top) in views)


def _draw_grid(axes: Any, grid: tuple[Float64Array, tuple[float, float, float, float]], theme: Theme) -> None:
    from matplotlib.colors import ListedColormap

    cells, extent = grid
    colours = [theme.second, VERMILION, theme.area, theme.first]
    axes.imshow(
        cells, origin="lower", extent=extent, interpolation="none", vmin=-2.5, vmax=1.5,
        cmap=ListedColormap(colours),
    )  # fmt: skip
    for value, label in ((1, "obstacle"), (-1, "transmitter"), (-2, "receiver")):
        if (cells == value).any():
            legend_square(axes, label, colours[value + 2], theme.muted)


def _draw_points(drawn: Any, axes: Any, scan: Scan, theme: Theme) -> None:
    from matplotlib.collections import PolyCollection

    height = scan.points[:, 2]
    low, high = np.percentile(height, [1, 99]) if len(height) else (0.0, 1.0)
    shown = axes.scatter(
        *scan.points[:, :2].T, c=height, s=1.2, linewidths=0, cmap=theme.colours, vmin=low,
        vmax=max(high, low + 0.1),
    )  # fmt: skip
    drawn.colorbar(shown, ax=axes, label="Height z [m]", orientation="horizontal", shrink=0.8, pad=0.02)
    boxes: Any = scan.boxes
    style: dict[str, Any] = {"facecolors": "none", "edgecolors": theme.ink, "linewidths": 0.7}
    axes.add_collection(PolyCollection(boxes, **style))


def _scan_view(scan: Scan) -> View:
    """Limits of what is shown [m]: a square around nearly all points, or the grid."""
    if scan.grid is not None:
        left, right, bottom, top = scan.grid[1]
        return (left, right), (bottom, top)
    around = np.array([scan.position])
    if len(scan.points):
        # Nearly: one hit on a distant tower would make the rest a dot.
        around = np.vstack([around, np.percentile(scan.points[:, :2], [0.5, 99.5], axis=0)])
    low, high = around.min(axis=0), around.max(axis=0)
    half = max(float((high - low).max()) / 2 * 1.05, 10.0)
    (x, y) = ((low + high) / 2).tolist()
    return (x - half, x + half), (y - half, y + half)


# --- generation ------------------------------------------------------------------------------------------


def sampled(content: Content) -> str:
    """The sample in words."""
    sample, read = content.sample, content.sample.read
    episodes = counted(read, "recorded episode")
    if read < sample.there:
        episodes = f"{read:,} of the {counted(sample.there, 'recorded episode')}, drawn with seed 0"
    first = f", of each the first {SAMPLE_SCENES} scenes" if sample.cut else ""
    return f"{episodes} ({counted(sample.scenes, 'scene')}{first})"


def lidar_section(content: Content) -> Iterator[str]:
    scans = content.sample.scans
    if "lidar" not in content.topics:
        yield absent("No LIDAR is recorded.")
    elif not scans:
        yield absent(f"No scan in {sampled(content)} has points or a grid.")
    else:
        grid = any(scan.grid is not None for scan in scans)
        what = (
            "what stands in the cells of the occupancy grid, at any height"
            if grid
            else "hits, coloured by their height, with the outlines of moving objects"
        )
        titles = "; ".join(scan.title.replace("\n", ", ") for scan in scans)
        yield figure(
            picture(
                draw_scans(scans),
                f"LIDAR scans from above ({what}): {titles}.",
                scans_height(scans),
                map_like=True,
            ),
            f"{'Scan' if len(scans) == 1 else 'Scans'} from above: {what}.",
        )


_KINDS = {"picture": "picture", "depth": "depth, near is bright", "objects": "objects, strong colours move"}


def camera_section(content: Content) -> Iterator[str]:
    shots = content.sample.shots
    if not content.topics & {"camera", "depth", "segmentation"}:
        yield absent("No camera is recorded.")
        return
    if not shots:
        yield absent(f"No camera has a picture in {sampled(content)}.")
    for moment in dict.fromkeys(shot.moment for shot in shots):
        yield f"<h3>{escape(moment[:1].upper() + moment[1:])}</h3>"
        seen = [shot for shot in shots if shot.moment == moment]
        rows = [seen] if all(len(shot.images) == 1 for shot in seen) else [[shot] for shot in seen]
        for row in rows:
            yield '<div class="row">'
            for shot in row:
                for kind, image in shot.images.items():
                    alt = f"Camera {shot.sensor}, {_KINDS[kind]}: {moment}."
                    yield figure(pixels(image, alt), f"{shot.sensor}: {_KINDS[kind]}")
            yield "</div>"
