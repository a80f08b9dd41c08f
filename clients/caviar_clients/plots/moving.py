"""Maps that move: the pictures of a video, with |y| over time and a camera, and those of environments."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_clients.plots.map import (
    BEAM_ALPHA,
    RECEIVERS,
    TICK_COLOR,
    TICK_LABEL,
    TRANSMITTER,
    Beam,
    MapData,
    Mark,
    View,
    chosen_beam,
    draw_antennas,
    draw_beam,
    draw_objects,
    draw_rays,
    draw_scenery,
)
from caviar_clients.plots.rays import Footprints, rays
from caviar_clients.plots.sensors import SKY_GREY
from caviar_clients.plots.style import BLACK, BLUE, GREY, LIGHT_GREY, ORANGE, SKY, VERMILION, Labels, styled
from caviar_clients.plots.user_curves import UserSeries, curves, shade
from caviar_protocol.arrays import UInt8Array
from caviar_protocol.errors import SetupError
from caviar_protocol.host import install_command
from caviar_protocol.space.codebooks import codebook_of
from caviar_protocol.space.scene import Pair, device_pose
from caviar_protocol.topics import Link, Scene

# Width of a picture [inches]; all sizes below are inches too, so that texts grow with the pixels. A layout
# engine of Matplotlib would place the panels by the texts that happen to be in the first picture.
_WIDTH = 11.0
_LEFT, _RIGHT = 0.75, 0.2
# Above the map a line of text and one more for the beam, below it the labels of its axis and the legend.
_ABOVE, _LINE, _BELOW = 0.45, 0.28, 0.95
# The colour bar with its labels.
_BAR = 0.95
# Height of the curves, and the gap between them and the map, or the picture.
_CURVES = 1.35
_BETWEEN = 0.95


@dataclass(frozen=True, kw_only=True, eq=False)
class Plan:
    """Parts that are the same in all pictures of a video.

    Args:
        view: Limits of the map [m].
        gains_db: Gains of the ends of the colour scale of paths [dB]; None: there are no paths.
        has_ticks: Whether paths of unknown route occur.
        has_beam: Whether a chosen beam occurs.
        kinds: Whether objects with a device (True) and others (False) occur.
        receivers: Marks of receivers that occur.
        prefix: What names of objects leave out.
        user: Object of the user whose beam is shown; empty: none.
        footprints: Scenery; None: none is drawn.
        series: |y| in all frames of the video; None: it is not drawn.
        agent: Name of the agent, for the legend.
        camera: Camera whose pictures are shown; None: none is.
        aspect: Height over width of these pictures.
    """

    view: View
    gains_db: tuple[float, float] | None
    has_ticks: bool
    has_beam: bool
    kinds: frozenset[bool]
    receivers: frozenset[Mark]
    prefix: str
    user: str
    footprints: Footprints | None
    series: UserSeries | None
    agent: str
    camera: str | None
    aspect: float = 0.75


class MovingMap:
    """Draws one picture after another; what stands still is drawn once.

    Args:
        plan: What all pictures share.
        width: Width [pixels], even; the height follows from the content and is even too.
    """

    def __init__(self, plan: Plan, width: int) -> None:
        with styled():
            self._plan = plan
            self._build(width)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [pixels]."""
        width, height = self._canvas.get_width_height()
        return int(width), int(height)

    def draw(self, data: MapData, step: int, picture: UInt8Array | None) -> UInt8Array:
        """Draw the picture of one frame.

        Args:
            data: Scene, channel and link of the frame.
            step: Its place in the plan's series.
            picture: What the camera saw; None where it has not seen anything yet.

        Returns:
            Pixels in sRGB, Shape ``[height, width, 3]``.
        """
        with styled():
            # Axes, scenery, colour bar and legend are pixels that are copied: only what moves is drawn anew.
            self._canvas.restore_region(self._still)
            beam = chosen_beam(data)
            self._over(self._map, lambda: self._draw_map(data, beam))
            self._write(self._when, data.title)
            self._write(self._what, "" if beam is None else beam.label)
            if self._camera is not None:
                self._over(self._camera, lambda: self._show(picture))
            if self._curves is not None:
                self._over(self._curves, lambda: self._point(step))
            drawn: UInt8Array = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
        return drawn

    def _build(self, width: int) -> None:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        plan, places = self._plan, _places(self._plan)
        dpi = width / _WIDTH
        pixels = 2 * round(places.height * dpi / 2)
        # A hundredth of a pixel more, since Matplotlib rounds the product down.
        self._figure = Figure(figsize=((width + 0.01) / dpi, (pixels + 0.01) / dpi), dpi=dpi)
        self._canvas = FigureCanvasAgg(self._figure)
        self._camera: Any = None if places.camera is None else self._axes(places, places.camera)
        self._curves = None if places.curves is None else self._axes(places, places.curves)
        self._map = self._axes(places, places.map)
        self._labels = Labels(width=places.map[2] * 72, prefix=plan.prefix, marked=plan.user)
        self._prepare_map(places)
        if self._camera is not None:
            self._camera.set_title(f"camera {plan.camera}", fontsize=10, loc="left")
            self._camera.set(xticks=[], yticks=[], facecolor=SKY_GREY)
            self._camera.spines[:].set_visible(False)
        if self._curves is not None and plan.series is not None:
            self._prepare_curves(self._curves, plan.series)
        x, y = places.map[0] / _WIDTH, 1 - 0.12 / places.height
        style: dict[str, Any] = {"va": "top", "animated": True}
        self._when = self._figure.text(x, y, "", fontsize=12, fontweight="bold", **style)
        self._what = self._figure.text(x, 1 - 0.42 / places.height, "", fontsize=10, color=VERMILION, **style)
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(self._figure.bbox)

    def _axes(self, places: _Places, place: Rectangle) -> Any:
        left, bottom, width, height = place
        scale = (_WIDTH, places.height, _WIDTH, places.height)
        share: Any = [a / b for a, b in zip((left, bottom, width, height), scale, strict=True)]
        axes = self._figure.add_axes(share)
        axes.tick_params(labelsize=9.5)
        return axes

    def _prepare_map(self, places: _Places) -> None:
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize

        axes, plan = self._map, self._plan
        (x0, x1), (y0, y1) = _filling(plan.view, places.map[3] / places.map[2])
        axes.set(xlim=(x0, x1), ylim=(y0, y1), xlabel="x, east [m]", ylabel="y, north [m]")
        axes.set_autoscale_on(False)
        draw_scenery(axes, plan.footprints)
        if plan.gains_db is not None:
            left, bottom, width, height = places.map
            bar = self._axes(places, (left + width + 0.1, bottom + 0.1 * height, 0.14, 0.8 * height))
            colors = ScalarMappable(Normalize(*plan.gains_db), "viridis")
            self._figure.colorbar(colors, cax=bar, label="Path gain [dB]")
        handles = _legend(plan)
        # Below the axis label there is room for two rows, in each for six of these texts.
        columns = math.ceil(len(handles) / math.ceil(len(handles) / 6))
        self._figure.legend(
            handles=handles, loc="lower left", ncols=columns, frameon=False, fontsize=9,
            bbox_to_anchor=((places.map[0] - 0.1) / _WIDTH, 0.02 / places.height), borderaxespad=0,
            columnspacing=1.4, handletextpad=0.5,
        )  # fmt: skip

    def _prepare_curves(self, axes: Any, data: UserSeries) -> None:
        for (_, values, style), label in zip(
            curves(data, self._plan.agent), ("best", f"chosen ({self._plan.agent})", "LOS beam"), strict=True
        ):
            axes.plot(data.time, np.where(data.has_path, values, np.nan), label=label, **style)
        shade(axes, data)
        axes.set_ylim(bottom=0)
        axes.margins(x=0)
        axes.set_xlim(*axes.get_xlim())
        axes.grid()
        axes.set_xlabel("Time [s]")
        # Powers of ten stand in the label: above the axis, where Matplotlib writes them, is the legend.
        highest = float(np.max(data.best, where=data.has_path, initial=0.0))
        power = math.floor(math.log10(highest)) if highest > 0 else 0
        if -2 <= power < 4:
            axes.set_ylabel("|y|")
        else:
            axes.set_ylabel(f"|y| [$10^{{{power}}}$]")
            axes.yaxis.set_major_formatter(lambda value, _: f"{value / 10.0**power:g}")
        axes.legend(
            loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=5, frameon=False, fontsize=8.5,
            borderaxespad=0.2, columnspacing=1.0, handletextpad=0.4, handlelength=1.6,
        )  # fmt: skip

    def _over(self, axes: Any, draw: Callable[[], None]) -> None:
        """Draw over what stands still, and remove what was drawn."""
        # Functions of a map add artists to axes and return nothing: the new ones were not there before.
        before = set(axes.get_children())
        draw()
        added = [artist for artist in axes.get_children() if artist not in before]
        for artist in sorted(added, key=lambda artist: artist.get_zorder()):
            axes.draw_artist(artist)
        for artist in added:
            artist.remove()

    def _write(self, place: Any, text: str) -> None:
        place.set_text(text)
        self._figure.draw_artist(place)

    def _draw_map(self, data: MapData, beam: Beam | None) -> None:
        if self._plan.gains_db is not None:
            draw_rays(self._map, rays(data.scene, data.channel), self._plan.gains_db)
        if beam is not None:
            draw_beam(self._map, beam)
        draw_objects(self._map, data, self._labels)
        draw_antennas(self._map, data)

    def _show(self, picture: UInt8Array | None) -> None:
        if picture is not None:
            height, width, _ = picture.shape
            self._camera.imshow(picture, extent=(0, width, height, 0), aspect="auto", zorder=1)
        else:
            self._camera.text(0.5, 0.5, "no picture yet", transform=self._camera.transAxes, ha="center")

    def _point(self, step: int) -> None:
        data = self._plan.series
        if data is None or self._curves is None:
            return
        time = data.time[step]
        self._curves.axvline(time, color=GREY, linewidth=1.2, zorder=3)
        for (_, values, style), size in zip(curves(data, self._plan.agent), (80, 34, 9), strict=True):
            if data.has_path[step]:
                self._curves.scatter(
                    time, values[step], s=size, color=style["color"], linewidths=0, zorder=4, clip_on=False
                )


Rectangle = tuple[float, float, float, float]
"""Left, bottom, width, height [inches]."""


@dataclass(frozen=True)
class _Places:
    height: float
    map: Rectangle
    camera: Rectangle | None
    curves: Rectangle | None


def _places(plan: Plan) -> _Places:
    """Lay out the panels: the camera right of the map, |y| below it; without a camera |y| below the map."""
    beside = _BAR if plan.gains_db is not None else 0.0
    (x0, x1), (y0, y1) = plan.view
    shape = (y1 - y0) / (x1 - x0)
    above = _ABOVE + _LINE * plan.has_beam
    if plan.camera is None:
        width = _WIDTH - _LEFT - beside - _RIGHT
        height = float(np.clip(shape * width, 3.4, 5.2))
        below = 0.0 if plan.series is None else _CURVES + _BETWEEN
        bottom = _BELOW + below
        curves_at = None if plan.series is None else (_LEFT, _BELOW, width, _CURVES)
        return _Places(bottom + height + above, (_LEFT, bottom, width, height), None, curves_at)
    width = 0.47 * _WIDTH
    left = _LEFT + width + beside + 0.15
    seen = _WIDTH - left - _RIGHT
    tall = seen * plan.aspect
    if plan.series is not None:
        left_curves = left + 0.4
        total = tall + _BETWEEN + _CURVES
    else:
        left_curves, total = left, tall
    height = max(float(np.clip(shape * width, 3.4, 5.2)), total)
    top = _BELOW + height
    camera = (left, top - tall if plan.series is not None else _BELOW + (height - tall) / 2, seen, tall)
    curves_at = None if plan.series is None else (left_curves, _BELOW, seen - 0.4, _CURVES)
    return _Places(top + above, (_LEFT, _BELOW, width, height), camera, curves_at)


def key_colours() -> UInt8Array:
    """Collect the colours that mean something, and steps from black to white, for the palette of a GIF.

    Returns:
        sRGB, Shape ``[K, 3]``.
    """
    from matplotlib import colormaps
    from matplotlib.colors import to_rgb

    named = np.array([to_rgb(color) for color in (BLACK, GREY, LIGHT_GREY, ORANGE, SKY, BLUE, VERMILION)])
    # The beam's colour over white, as its area shows it.
    lobe = 1 + BEAM_ALPHA * (named[-1:] - 1)
    gains = colormaps["viridis"](np.linspace(0, 1, 40))[:, :3]
    steps = np.linspace(0, 1, 12)[:, None].repeat(3, axis=1)
    result: UInt8Array = np.round(255 * np.concatenate([named, lobe, gains, steps])).astype(np.uint8)
    return result


def _filling(view: View, shape: float) -> View:
    """Make the view larger so that it fills a panel of this height over width."""
    (x0, x1), (y0, y1) = view
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    half = max((x1 - x0) / 2, (y1 - y0) / 2 / shape)
    return (x - half, x + half), (y - half * shape, y + half * shape)


def _legend(plan: Plan) -> list[Any]:
    from matplotlib.lines import Line2D

    def mark(marker: str, size: float, color: str, edge: str, label: str) -> Any:
        return Line2D(
            [], [], linestyle="none", marker=marker, markersize=size, color=color, markeredgecolor=edge,
            markeredgewidth=0.7, label=label,
        )  # fmt: skip

    handles = []
    if True in plan.kinds:
        handles.append(mark("s", 8, ORANGE, BLACK, "object with a device"))
    if False in plan.kinds:
        handles.append(mark("s", 8, SKY, BLACK, "other object"))
    for shown in (TRANSMITTER, *(known for known in RECEIVERS if known in plan.receivers)):
        handles.append(mark(shown.marker, math.sqrt(shown.size), shown.color, shown.edge, shown.label))
    if plan.has_beam:
        handles.append(Line2D([], [], color=VERMILION, linewidth=1.3, label="chosen beam"))
    if plan.has_ticks:
        handles.append(Line2D([], [], color=TICK_COLOR, linewidth=2.0, label=TICK_LABEL))
    return handles


# --- pictures of environments -------------------------------------------------------------------------------

SIZE_IN, DPI = (6.4, 4.8), 100
"""640×480 pixels."""
MARGIN_M = 15.0
"""Around what was seen so far."""


class MapRenderer:
    """Draws scenes as maps. The view only grows: what stands still in the world stands still in the pictures.

    Raises:
        SetupError: Matplotlib is not installed; the text has the command.
    """

    def __init__(self) -> None:
        try:
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure
        except ImportError as error:
            raise SetupError(f"pictures need Matplotlib; run: {install_command('plot')}") from error
        self._figure = Figure(SIZE_IN, dpi=DPI, layout="compressed")
        self._canvas = FigureCanvasAgg(self._figure)
        self._axes: Any = self._figure.subplots()
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)

    def draw(self, scene: Scene, link: Link | None, pair: Pair | None, title: str) -> UInt8Array:
        """Draw a scene.

        Args:
            scene: What is drawn.
            link: Has the beams; None: none is drawn.
            pair: The one whose beam is drawn; None: none.
            title: Stands above the map.

        Returns:
            Picture, Shape ``[480, 640, 3]``, red, green and blue, 0 to 255.
        """
        user = None
        if pair is not None and link is not None:
            users = zip(link.tx, link.rx, link.carrier, strict=True)
            user = next((u for u in users if u[:2] == (pair.tx.name, pair.rx.name)), None)
        data = MapData(scene, None, link, None, lambda array, *of: codebook_of(array).gain(*of), user, title)
        axes = self._axes
        axes.clear()
        self._widen(scene)
        axes.set_xlim(self._low[0], self._high[0])
        axes.set_ylim(self._low[1], self._high[1])
        axes.set_aspect("equal")
        axes.grid(color=GREY, alpha=0.2)
        beam = chosen_beam(data)
        if beam is not None:
            draw_beam(axes, beam)
        draw_objects(axes, data)
        draw_antennas(axes, data)
        axes.set(xlabel="x, east [m]", ylabel="y, north [m]", title=title)
        self._canvas.draw()
        return np.array(self._canvas.buffer_rgba())[..., :3].copy()  # the canvas uses its buffer again

    def _widen(self, scene: Scene) -> None:
        devices = [device_pose(scene, device).position[:2] for device in scene.devices]
        seen = np.concatenate([scene.position[:, :2], np.array(devices).reshape(-1, 2)])
        if len(seen):
            self._low = np.minimum(self._low, seen.min(0) - MARGIN_M)
            self._high = np.maximum(self._high, seen.max(0) + MARGIN_M)
