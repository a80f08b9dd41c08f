"""Style of all pictures: colours that colour-blind readers distinguish, shared marks, labels, saved files.

Labels cover nothing. `name_objects` is greedy and leaves names out where there is no room: a map of a city
has hundreds.
"""

from __future__ import annotations

import csv
import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from caviar_clients.files import writing
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.errors import SetupError
from caviar_protocol.host import install_command
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import Scene

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


_PAPER: dict[str, Any] = {
    **dict.fromkeys(("font.size", "axes.titlesize", "axes.labelsize"), 8.0),
    **dict.fromkeys(("legend.fontsize", "xtick.labelsize", "ytick.labelsize"), 7.0),
    "lines.linewidth": 1.0,
    "axes.linewidth": 0.6,
    "grid.linewidth": 0.4,
    "pdf.fonttype": 42,  # TrueType: publishers refuse type 3
    "svg.fonttype": "path",  # outlines, since SVG embeds no fonts
    "svg.hashsalt": "caviar",
    "savefig.dpi": 600,
}
COLUMNS_IN = {"1col": 3.5, "2col": 7.16}
"""Widths of one and of two columns of IEEE's journals [inches], by what ends the names of their files."""
DENSE = 2000
"""Points above which a cloud is pixels in a figure for a paper: viewers draw vectors one by one."""
_for_paper: ContextVar[bool] = ContextVar("for_paper", default=False)


@contextmanager
def paper_style() -> Iterator[None]:
    """Save the figures of a block as `saved_files` names them: for papers, with what they draw as numbers."""
    token = _for_paper.set(True)
    try:
        yield
    finally:
        _for_paper.reset(token)


def saved_files(file: Path) -> list[Path]:
    """List the files that `figure` makes.

    Args:
        file: PNG that it is asked for.

    Returns:
        This one; in `paper_style` PDF and SVG in the widths of `COLUMNS_IN`, without titles, and CSV.

    Example:
        >>> with paper_style():
        ...     [file.name for file in saved_files(Path("map.png"))]
        ['map-1col.pdf', 'map-1col.svg', 'map-2col.pdf', 'map-2col.svg', 'map.csv']
    """
    if not _for_paper.get():
        return [file]
    made = [file.with_name(f"{file.stem}-{name}.{kind}") for name in COLUMNS_IN for kind in ("pdf", "svg")]
    return [*made, file.with_suffix(".csv")]


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
    with rc_context(_SETTINGS | (_PAPER if _for_paper.get() else {})):
        yield


@contextmanager
def figure(file: Path, width: float, height: float, layout: Layout = "constrained") -> Iterator[Any]:
    """Make a figure that is saved when the block ends: as PNG, cut to what is drawn, or as `saved_files`.

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
            if _for_paper.get():
                _save_for_paper(drawn, file)
            else:
                drawn.savefig(file, format="png", bbox_inches="tight", pad_inches=0.15)


def _save_for_paper(drawn: Any, file: Path) -> None:
    from matplotlib.collections import Collection
    from matplotlib.transforms import Bbox

    with saved_files(file)[-1].open("w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        rows.writerow(("panel", "kind", "label", "number", "x", "y", "value"))
        rows.writerows(_drawn_points(drawn))
    # Captions have what titles say.
    drawn.suptitle("")
    for axes in drawn.axes:
        axes.set_title("")
    for cloud in drawn.findobj(Collection):
        cloud.set_rasterized(len(cloud.get_offsets()) > DENSE)
    (width, height), columns = drawn.get_size_inches(), [legend._ncols for legend in drawn.legends]
    engine = drawn.get_layout_engine()
    for name, wide in COLUMNS_IN.items():
        # Texts are as large in both widths: a narrow figure is higher for them.
        drawn.set_size_inches(wide, height * wide / width * (1.0 if wide > 5 else 1.4))
        for legend, most in zip(drawn.legends[:], columns, strict=True):
            handles, labels = legend.legend_handles, [text.get_text() for text in legend.get_texts()]
            # A character of 7 points is about 3.6 points wide; handle and margins take those of 8.
            fitting = max(1, int(72 * wide / 3.6 / (max(map(len, labels)) + 8)))
            legend.remove()
            drawn.legend(handles, labels, loc="outside lower center", ncols=min(most, fitting))
        drawn.set_layout_engine(engine)
        drawn.draw_without_rendering()
        drawn.set_layout_engine("none")  # the layout stays: it takes longer than all else
        low, high = drawn.get_tightbbox().intervaly
        cut = Bbox.from_extents(0, low - 0.03, wide, high + 0.03)
        for kind, date in (("pdf", "CreationDate"), ("svg", "Date")):
            picture = file.with_name(f"{file.stem}-{name}.{kind}")
            drawn.savefig(picture, metadata={date: None}, bbox_inches=cut)


def _drawn_points(drawn: Any) -> Iterator[tuple[str | int | float, ...]]:
    """Rows of what a figure draws, in the units of its axes: lines, points, areas, cells; no pictures."""
    from matplotlib.collections import LineCollection, QuadMesh

    for axes in drawn.axes:
        panel = (axes.get_title() or axes.get_ylabel()).replace("\n", " ")
        shown: list[tuple[str, Any, Any, Any]] = [
            ("line", line, line.get_xydata(), None)
            for line in axes.lines
            if line.get_transform() == axes.transData
        ]
        for made in axes.collections:
            values = None if made.get_array() is None else np.ravel(made.get_array())
            if isinstance(made, QuadMesh):
                corners: Any = made.get_coordinates()
                centres = (corners[:-1, :-1] + corners[1:, 1:]) / 2
                shown.append(("cells", made, centres.reshape(-1, 2), values))
            elif made.get_offset_transform() == axes.transData:
                shown.append(("points", made, made.get_offsets(), values))
            else:
                kind = "line" if isinstance(made, LineCollection) else "area"
                parts = [path.vertices for path in made.get_paths()]
                shown += [
                    (kind, made, part, None if values is None else np.full(len(part), values[n]))
                    for n, part in enumerate(parts)
                ]
        for number, (kind, made, points, values) in enumerate(shown):
            label = "" if str(made.get_label()).startswith("_") else made.get_label()
            table = np.ma.filled(np.ma.asarray(points, dtype=float), np.nan).tolist()
            for at, (x, y) in enumerate(table):
                value = "" if values is None else float(np.ma.filled(values, np.nan)[at])
                yield panel, kind, label, number, x, y, value


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


# --- names in a map ---------------------------------------------------------------------------------


@dataclass
class Labels:
    """Places of names in a map; kept from frame to frame, names stay on the side where they were.

    Args:
        width: Width of the axes, about [points].
        prefix: What names leave out at their beginning; None: what all of the scene have in common.
        marked: Object whose name stands out.
        sides: Side of each name in the frame before: above, below, right, left.
    """

    width: float = field(default_factory=lambda: 210.0 if _for_paper.get() else 570.0)
    prefix: str | None = None
    marked: str = ""
    sides: dict[str, int] = field(default_factory=dict)


def name_objects(axes: Any, scene: Scene, boxes: Float64Array, carriers: set[str], labels: Labels) -> None:
    """Write names without what all have in common, where there is room.

    The marked one comes first, then those with a device.
    """
    # Greedy: a name that finds no place beside its box is left out, since one that covers another is worse.
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2.0, foreground="white")]
    prefix = common_prefix(scene.names) if labels.prefix is None else labels.prefix
    (left, right) = axes.get_xlim()
    unit = (right - left) / labels.width
    # As large as the mark that stands for a tiny object; a character of 8 points is about 5 points wide.
    centre, least = scene.position[:, :2], 5.0 * unit
    low = np.minimum(boxes.min(axis=1), centre - least)
    high = np.maximum(boxes.max(axis=1), centre + least)
    taken: list[Rectangle] = [(*a, *b) for a, b in zip(low.tolist(), high.tolist(), strict=True)]
    for device in antennas(scene, "tx"):
        if not device.parent:
            x, y, _ = device_pose(scene, device).position
            wide = 3.5 * len(device.name) * unit
            taken.append((x - max(wide, 6 * unit), y - 6 * unit, x + max(wide, 6 * unit), y + 22 * unit))

    def rank(i: int) -> tuple[bool, bool, str]:
        name = scene.names[i]
        return name != labels.marked, name not in carriers, name

    for i in sorted(range(len(boxes)), key=rank):
        name = scene.names[i]
        text = name.removeprefix(prefix)
        places = _places(taken[i], 5.0 * len(text) * unit, 9.0 * unit, 2.0 * unit)
        before = labels.sides.get(name, 0)
        for side in sorted(range(len(places)), key=lambda side: (side != before, side)):
            inside = _within(places[side], axes.get_xlim(), axes.get_ylim())
            if inside and not any(_overlap(places[side], other) for other in taken):
                taken.append(places[side])
                labels.sides[name] = side
                standing = {"color": VERMILION, "fontweight": "bold"} if name == labels.marked else {}
                # Not clipped: the width is an estimate, and a name that is cut is another name.
                axes.text(*places[side][:2], text, fontsize=8, path_effects=halo, zorder=6, **standing)
                break


Rectangle = tuple[float, float, float, float]
"""Left, bottom, right, top [m]."""


def _places(box: Rectangle, width: float, height: float, gap: float) -> list[Rectangle]:
    """Rectangles above, below, right and left of a box."""
    x0, y0, x1, y1 = box
    corners = (
        ((x0 + x1 - width) / 2, y1 + gap),
        ((x0 + x1 - width) / 2, y0 - gap - height),
        (x1 + gap, (y0 + y1 - height) / 2),
        (x0 - gap - width, (y0 + y1 - height) / 2),
    )
    return [(x, y, x + width, y + height) for x, y in corners]


def common_prefix(names: Sequence[str]) -> str:
    """Find the dotted parts that all names begin with; empty for a single name.

    Example:
        >>> common_prefix(["vehicle.east.1", "vehicle.west.1"])
        'vehicle.'
    """
    parts = [name.split(".")[:-1] for name in names] if len(names) > 1 else []
    same = itertools.takewhile(lambda level: len(set(level)) == 1, zip(*parts, strict=False))
    return "".join(f"{level[0]}." for level in same)


def _within(a: Rectangle, x: tuple[float, float], y: tuple[float, float]) -> bool:
    return x[0] <= a[0] and a[2] <= x[1] and y[0] <= a[1] and a[3] <= y[1]


def _overlap(a: Rectangle, b: Rectangle) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]
