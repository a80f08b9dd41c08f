"""Maps: the world from above with rays and the chosen beam, and radio maps with a colour for each cell.

`draw_map` and `draw_values` write files. The layers of a map (`draw_scenery`, `draw_rays`, `draw_objects`,
`draw_antennas`, `draw_beam`) draw into given axes, for videos and environments too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.plots.rays import OUTLINE, Footprints, Rays, View, from_above, rays, scale, view_around
from caviar_clients.plots.style import (
    BLACK,
    GREY,
    LIGHT_GREY,
    ORANGE,
    SKY,
    VERMILION,
    Labels,
    figure,
    legend_below,
    legend_square,
    name_objects,
)
from caviar_protocol.arrays import Float64Array, Int32Array, Int64Array
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import AntennaArray, AntennaDevice, Channel, Link, Scene
from caviar_protocol.topics.channel import Interaction

BeamGain = Callable[[AntennaArray, int, Float64Array], Float64Array]
"""``gain(array, beam, directions)``: amplitude of a codebook beam towards unit vectors in device
axes, Shape ``[N, 3]`` to ``[N]``, 1 at its greatest."""

BEAM_ALPHA = 0.22
"""Opacity of the beam's area: rays and objects below it show."""

TICK = 0.05
"""Length of the ticks of paths whose route is unknown, of the width of the map."""
TICK_COLOR = "#21918c"  # the middle of viridis
TICK_LABEL = "path of unknown route: departure, arrival"


@dataclass(frozen=True, eq=False)
class MapData:
    """Contents of a map; what is None is left out.

    Args:
        scene: Objects and devices.
        channel: Paths that are drawn as rays.
        link: Beams that were chosen, and which receivers have a path.
        footprints: Scenery.
        beam_gain: Pattern of a codebook beam.
        user: (tx, rx, carrier) whose chosen beam is shown.
        title: Title of the map.
    """

    scene: Scene
    channel: Channel | None
    link: Link | None
    footprints: Footprints | None
    beam_gain: BeamGain | None
    user: tuple[str, str, str] | None
    title: str


@contextmanager
def _map_figure(file: Path, view: View, title: str, columns: int = 3) -> Iterator[tuple[Any, Any]]:
    """Make figure and axes of a map of this view, with title, labels and legend when the block ends."""
    (left, right), (bottom, top) = view
    # As high as the view needs, beside 1.5 inches for the colour bar, above 1.6 for title and legend.
    height = float(np.clip((top - bottom) / (right - left) * 8.0 + 1.6, 4.5, 11.0))
    with figure(file, 9.5, height, layout="compressed") as drawn:
        axes = drawn.subplots()
        # Before anything is drawn: sizes of ticks and places of names are shares of the view.
        axes.set(xlim=view[0], ylim=view[1], aspect="equal")
        yield drawn, axes
        axes.set(xlabel="x, east [m]", ylabel="y, north [m]", title=title)
        legend_below(drawn, axes, columns)


def draw_map(data: MapData, file: Path) -> None:
    """Draw the map of one frame.

    Args:
        data: Contents of the map.
        file: PNG that is written.
    """
    beam = chosen_beam(data)
    with _map_figure(file, view_of(data, beam), data.title) as (drawn, axes):
        draw_scenery(axes, data.footprints)
        _add_rays(drawn, axes, data)
        if beam is not None:
            draw_beam(axes, beam)
        draw_objects(axes, data, Labels(marked=served_object(data)))
        draw_antennas(axes, data)


def draw_site(
    data: MapData, materials: Mapping[str, Footprints], lanes: Sequence[Float64Array], file: Path
) -> None:
    """Draw scenery with its materials, the lanes of a road network, and objects.

    Args:
        data: Scene and title.
        materials: Footprints of the scenery by material, as the legend calls it.
        lanes: Centre lines in the world [m], Shape ``[P, 2]`` each.
        file: PNG that is written.
    """
    from matplotlib.collections import LineCollection

    points = np.concatenate([*(drawn.faces.reshape(-1, 2) for drawn in materials.values()), *lanes])
    view = view_around(points.min(axis=0), points.max(axis=0), 5.0, 20.0, (0.9, 0.4), scale=1.08)
    with _map_figure(file, view, data.title, columns=1) as (_, axes):
        for (label, drawn), color in zip(materials.items(), cycle(_SITE_COLORS), strict=False):
            draw_scenery(axes, drawn, area=color)
            legend_square(axes, label, color)
        lines: Any = lanes
        axes.add_collection(LineCollection(lines, colors=SKY, linewidths=1.0, zorder=2, label="lanes"))
        draw_objects(axes, data)
        draw_antennas(axes, data)


# Areas below lanes and objects: pale.
_SITE_COLORS = ("#d9d2c5", "#bfdcae", "#c9c3dc", "#e6c9c3", "#c3dde6")


def view_of(data: MapData, beam: Beam | None) -> View:
    """Choose the limits of a map: objects, devices, beam, ray points unless far off; at least 40 m.

    Args:
        data: Contents of the map.
        beam: Outline of the chosen beam; None: there is none.

    Returns:
        Limits of x and of y [m].
    """
    devices = [device_pose(data.scene, device).position[:2] for device in data.scene.devices]
    core = np.concatenate([data.scene.position[:, :2], np.array(devices).reshape(-1, 2)])
    if beam is not None:
        core = np.concatenate([core, beam.outline])
    if not len(core):
        core = np.zeros((1, 2))
    low, high = core.min(axis=0), core.max(axis=0)
    if data.channel is not None:
        used = data.channel.interactions != Interaction.NONE
        # A reflection off a distant tower must not shrink everything else to a dot.
        reach = 0.25 * float((high - low).max())
        points = np.clip(data.channel.points[used][:, :2], low - reach, high + reach)
        low, high = np.min([low, *points], axis=0), np.max([high, *points], axis=0)
    return view_around(low, high, 5.0, 20.0, (0.9, 0.4), scale=1.08)


def draw_scenery(
    axes: Any,
    footprints: Footprints | None,
    width: float = 0.6,
    outline_zorder: float = 1.1,
    *,
    area: str = LIGHT_GREY,
    outline: str = GREY,
) -> None:
    """Draw areas and outlines of buildings.

    Args:
        axes: Axes of the map.
        footprints: Scenery; None: nothing is drawn.
        width: Width of outlines [points].
        outline_zorder: Place of the outlines among the layers.
        area: Colour of the areas.
        outline: Colour of the outlines.
    """
    from matplotlib.collections import LineCollection, PolyCollection

    if footprints is None:
        return
    faces: Any = footprints.faces
    edges: Any = footprints.edges
    axes.add_collection(PolyCollection(faces, facecolors=area, edgecolors=area, linewidths=0.4, zorder=1))
    axes.add_collection(LineCollection(edges, colors=outline, linewidths=width, zorder=outline_zorder))


def draw_rays(axes: Any, drawn: Rays, limits: tuple[float, float]) -> list[Any]:
    """Draw every path as a line over its interaction points, or as ticks; the strongest on top.

    Args:
        axes: Axes of the map, with their limits.
        drawn: The paths.
        limits: Gains [dB] of the ends of the colour scale.

    Returns:
        The collections, for a colour bar.
    """
    from matplotlib.collections import LineCollection

    (left, right), collections = axes.get_xlim(), []
    ticks = drawn.ticks(TICK * (right - left))
    style: dict[str, Any] = {"cmap": "viridis", "clim": limits, "alpha": 0.85, "zorder": 2}
    for lines, gains, width in ((drawn.lines, drawn.gains, 1.1), (ticks, drawn.tick_gains, 2.0)):
        order = np.argsort(gains, kind="stable")
        if len(order):
            ordered: list[Any] = [lines[i][:, :2] for i in order]
            collections.append(LineCollection(ordered, array=gains[order], linewidths=width, **style))
            axes.add_collection(collections[-1])
    return collections


def _add_rays(drawn: Any, axes: Any, data: MapData) -> None:
    found = rays(data.scene, data.channel)
    if not len(found.all_gains):
        return
    collections = draw_rays(axes, found, scale(found.all_gains))
    drawn.colorbar(collections[0], ax=axes, label="Path gain [dB]", shrink=0.75, pad=0.01)
    if len(found.tick_gains):
        axes.plot([], [], color=TICK_COLOR, linewidth=2.0, label=TICK_LABEL)


@dataclass(frozen=True, eq=False)
class Beam:
    """The chosen beam's pattern around its array, cut at the elevation of the user."""

    outline: Float64Array
    """x and y [m], Shape ``[N, 2]``."""
    label: str


def chosen_beam(data: MapData) -> Beam | None:
    """Compute the outline of the beam that was chosen for the user of the map.

    Args:
        data: Contents of the map; its link has the choice, its ``beam_gain`` the pattern.

    Returns:
        The outline, cut at the elevation of the user; None where no beam was chosen.
    """
    found = _chosen(data)
    if found is None or data.beam_gain is None:
        return None
    device, beam, rx = found
    pose = device_pose(data.scene, device)
    receiver = next((d for d in data.scene.devices if d.name == rx), None)
    line = np.array([1.0, 0.0, 0.0])
    if receiver is not None:
        line = np.array(device_pose(data.scene, receiver).position) - np.array(pose.position)
    distance = float(np.linalg.norm(line))
    sine = 0.0 if distance == 0 else float(line[2]) / distance
    cosine = np.sqrt(max(0.0, 1 - sine**2))
    azimuth = np.linspace(-np.pi, np.pi, 2881)
    around = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    world = np.column_stack([cosine * around, np.full_like(azimuth, sine)])
    # Cut at the elevation of the user: in the plane of the horizon a beam that points down has no lobe.
    gain = data.beam_gain(device.array, beam, world @ rotation_matrix(pose.orientation))
    radius = max(0.6 * distance, 5.0) * gain / max(float(gain.max()), 1e-9)
    outline: Float64Array = np.array(pose.position[:2]) + (radius[:, None] * around)[_main_lobe(gain)]
    carrier = data.user[2] if data.user else ""
    return Beam(outline, f"beam {beam} of {device.name} on {carrier}, chosen for {rx}")


def _main_lobe(gain: Float64Array) -> Int64Array:
    """Places of the strongest lobe of a pattern over a whole turn, from its null before to its null after."""
    turned = np.arange(len(gain)) + int(gain.argmax())
    around = gain[turned % len(gain)]
    rises = np.flatnonzero(np.diff(around) > 0)
    falls = np.flatnonzero(np.diff(around) < 0)
    after = int(rises[0]) if len(rises) else 0
    before = int(falls[-1]) + 1 if len(falls) else 0
    lobe: Int64Array = turned[0] + np.arange(before - len(gain), after + 1)
    return lobe % len(gain)


def draw_beam(axes: Any, beam: Beam) -> None:
    """Draw the pattern as an area with an outline."""
    from matplotlib.collections import PolyCollection

    # Not `axes.fill`, which takes a tenth of a second to find the limits of so many corners.
    area = PolyCollection([beam.outline], facecolors=VERMILION, alpha=BEAM_ALPHA, linewidths=0, zorder=3)
    axes.add_collection(area, autolim=False)
    axes.plot(*beam.outline.T, color=VERMILION, linewidth=1.6, zorder=3.1, label=beam.label)


def _chosen(data: MapData) -> tuple[AntennaDevice, int, str] | None:
    """Transmitter, its chosen beam, and the receiver it was chosen for."""
    if data.link is None or data.user is None:
        return None
    users = list(zip(data.link.tx, data.link.rx, data.link.carrier, strict=True))
    if data.user not in users:
        return None
    beam = int(data.link.tx_beam[users.index(data.user)])
    device = next((d for d in antennas(data.scene, "tx") if d.name == data.user[0]), None)
    return None if device is None or beam < 0 else (device, beam, data.user[1])


def draw_objects(axes: Any, data: MapData, labels: Labels | None = None) -> None:
    """Draw bounding boxes from above, a mark at the front, names where there is room.

    Args:
        axes: Axes of the map, with their limits.
        data: Contents of the map.
        labels: How names stand; None: as in a single picture.
    """
    from matplotlib.collections import PolyCollection

    scene = data.scene
    if not scene.names:
        return
    carriers = {device.parent for device in scene.devices}
    boxes: Any = from_above(scene, OUTLINE)
    fronts: Any = from_above(scene, [[0.25, 0.5], [0.25, -0.5], [0.5, 0.0]])
    colors = [ORANGE if name in carriers else SKY for name in scene.names]
    axes.add_collection(PolyCollection(boxes, facecolors=colors, edgecolors=BLACK, linewidths=0.7, zorder=4))
    axes.add_collection(PolyCollection(fronts, facecolors=BLACK, linewidths=0, zorder=4.1))
    # A car on a map of a kilometre is a pixel: what is smaller than 1.2 % of the view gets a square.
    (left, right), smallest = axes.get_xlim(), scene.dimensions[:, :2].max(axis=1)
    tiny = np.flatnonzero(smallest < 0.012 * (right - left))
    axes.scatter(
        *scene.position[tiny, :2].T, marker="s", s=42, c=[colors[i] for i in tiny], edgecolors=BLACK,
        linewidths=0.7, zorder=3.9,
    )  # fmt: skip
    for color, label in ((ORANGE, "object with a device"), (SKY, "other object")):
        if color in colors:
            legend_square(axes, label, color)
    name_objects(axes, scene, boxes, carriers, labels or Labels())


def served_object(data: MapData) -> str:
    """Name the object that carries the receiver whose beam is shown; empty where none does."""
    receiver = data.user[1] if data.user else ""
    return next((device.parent for device in data.scene.devices if device.name == receiver), "")


@dataclass(frozen=True)
class Mark:
    """Mark of a device in a map.

    Args:
        label: Entry of the legend.
        marker: Marker of Matplotlib.
        size: Area [points²].
        color: Colour of the area.
        edge: Colour of the edge.
        width: Width of the edge [points].
    """

    label: str
    marker: str
    size: float
    color: str = BLACK
    edge: str = "white"
    width: float = 0.8


TRANSMITTER = Mark("transmitter", "^", 110)
RECEIVER = Mark("receiver", "o", 18)
WITHOUT_LOS = Mark("receiver, NLOS", "o", 30, color="white", edge=BLACK, width=1.6)
WITHOUT_PATH = Mark("receiver, no path", "X", 70)
RECEIVERS = (RECEIVER, WITHOUT_LOS, WITHOUT_PATH)


def receiver_mark(link: Link | None, receiver: str) -> Mark:
    """Choose a receiver's mark: a transmitter in sight, only reflections, no path; plain where unknown."""
    users = [i for i, rx in enumerate(link.rx) if rx == receiver] if link is not None else []
    if link is None or not users or link.los[users].any():
        return RECEIVER
    return WITHOUT_LOS if link.has_path[users].any() else WITHOUT_PATH


def draw_antennas(axes: Any, data: MapData) -> None:
    """Draw transmitters as triangles with their names, receivers as dots."""
    by_mark: dict[Mark, list[AntennaDevice]] = {TRANSMITTER: list(antennas(data.scene, "tx"))}
    for device in antennas(data.scene, "rx"):
        by_mark.setdefault(receiver_mark(data.link, device.name), []).append(device)
    for mark in (TRANSMITTER, *RECEIVERS):
        if devices := by_mark.get(mark, []):
            places = np.array([device_pose(data.scene, device).position[:2] for device in devices])
            # A device on an object has that object's name beside it.
            names = ["" if device.parent else device.name for device in devices]
            _draw_marks(axes, mark, places, names)


def _draw_marks(axes: Any, mark: Mark, places: Float64Array, names: Sequence[str]) -> None:
    """Draw a mark at each place, with its name above where that is not empty."""
    from matplotlib.patheffects import withStroke

    axes.scatter(
        *places.T, marker=mark.marker, s=mark.size, color=mark.color, edgecolors=mark.edge,
        linewidths=mark.width, zorder=5, label=mark.label,
    )  # fmt: skip
    for name, place in zip(names, places, strict=True):
        if name:
            axes.annotate(
                name, place, xytext=(0, 10), textcoords="offset points", ha="center", fontsize=10,
                fontweight="bold", path_effects=[withStroke(linewidth=2.5, foreground="white")], zorder=6,
                annotation_clip=True,
            )  # fmt: skip


# --- radio maps -------------------------------------------------------------------------------------

SERVERS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#7570b3")
"""Colours of best servers, again from the first where there are more (Okabe and Ito, 2008)."""

# [dB] of the colour bar at the most, below the strongest cells: a few cells deep in the shadow would take the
# colours of those that matter.
_SPAN_DB = 100.0

# Cells without a signal are hatched, which no colour of the bar looks like.
_HATCH, _HATCH_COLOR = "////", "#c4c4c4"


@dataclass(frozen=True, kw_only=True, eq=False)
class RadioMapView:
    """Surroundings of the cells of a radio map.

    Args:
        area: Lowest x and y, highest x and y of the cells [m].
        transmitters: Names of the transmitters.
        positions: x and y of the transmitters [m], Shape ``[T, 2]``.
        scene: Scene whose objects are drawn.
        footprints: Scenery; None: none is drawn.
        title: Title of the map.
    """

    area: tuple[float, float, float, float]
    transmitters: Sequence[str]
    positions: Float64Array
    scene: Scene
    footprints: Footprints | None
    title: str


def draw_values(view: RadioMapView, values: Float64Array, label: str, file: Path) -> None:
    """Draw one number for each cell.

    Args:
        view: What is drawn around the cells.
        values: The numbers, Shape ``[ny, nx]`` from south to north; NaN: no signal.
        label: Name of the quantity with its unit.
        file: PNG that is written.
    """
    with _radio_map(view, file) as (drawn, axes):
        shown = values[np.isfinite(values)]
        low, high, extend = colour_limits(shown)
        image = _draw_cells(axes, view, np.ma.masked_invalid(values), cmap="viridis", vmin=low, vmax=high)
        if len(shown):
            bar = drawn.colorbar(image, ax=axes, label=label, shrink=0.75, pad=0.01, extend=extend)
            # Of nearly equal values the bar would have «1e−3 − 94.8», which is no number to read.
            bar.formatter.set_useOffset(False)
            bar.formatter.set_scientific(False)
            bar.update_ticks()


def draw_servers(view: RadioMapView, server: Int32Array, file: Path) -> None:
    """Draw which transmitter serves each cell.

    Args:
        view: What is drawn around the cells.
        server: Index of the transmitter, Shape ``[ny, nx]`` from south to north; −1: no signal.
        file: PNG that is written.
    """
    from matplotlib.colors import ListedColormap

    count = len(view.transmitters)
    colors = [SERVERS[t % len(SERVERS)] for t in range(count)]
    with _radio_map(view, file) as (_, axes):
        cells = np.ma.masked_less(server, 0)
        _draw_cells(axes, view, cells, cmap=ListedColormap(colors), vmin=-0.5, vmax=count - 0.5)
        served = max(int(np.count_nonzero(server >= 0)), 1)
        for t, (name, color) in enumerate(zip(view.transmitters, colors, strict=True)):
            label = f"served by {name}, {np.count_nonzero(server == t) / served:.0%}"
            legend_square(axes, label, color)


def colour_limits(values: Float64Array) -> tuple[float, float, str]:
    """Choose the ends of a colour bar.

    From the strongest thousandth down to the weakest hundredth of the cells, over 100 dB at the most.

    Args:
        values: Values of all cells with a signal [dB].

    Returns:
        Both ends [dB], and ``both``, ``min``, ``max`` or ``neither`` for the ends with values beyond them.

    Example:
        >>> colour_limits(np.array([-90.0, -90.0]))
        (-90.5, -89.5, 'neither')
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
    """Make the picture around the cells, which the block draws."""
    from matplotlib.collections import PolyCollection

    x0, y0, x1, y1 = view.area
    with _map_figure(file, ((x0, x1), (y0, y1)), view.title, columns=4) as (drawn, axes):
        axes.patch.set(facecolor="white", hatch=_HATCH, edgecolor=_HATCH_COLOR)
        yield drawn, axes
        # Areas of buildings lie below the cells, so that those with a signal hide them; outlines above.
        draw_scenery(axes, view.footprints, width=0.5, outline_zorder=3)
        if view.footprints is not None:
            legend_square(axes, "building", LIGHT_GREY, GREY)
        if view.scene.names:
            boxes: Any = from_above(view.scene, OUTLINE)
            style: dict[str, Any] = {"facecolors": "white", "edgecolors": BLACK, "linewidths": 0.7}
            axes.add_collection(PolyCollection(boxes, zorder=4, **style))
            legend_square(axes, "object", "white")
        _draw_marks(axes, TRANSMITTER, view.positions, view.transmitters)
        legend_square(axes, "no signal", "white", _HATCH_COLOR, hatch=_HATCH)


def _draw_cells(axes: Any, view: RadioMapView, cells: Any, **colours: Any) -> Any:
    x0, y0, x1, y1 = view.area
    return axes.imshow(
        cells, origin="lower", extent=(x0, x1, y0, y1), interpolation="none", zorder=2, **colours
    )
