"""The world from above: scenery, objects, rays and the beam that was chosen.

A radio map from above: cells in colour, buildings, transmitters.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.plots.rays import Footprints, Rays, rays, scale
from caviar_clients.plots.style import BLACK, GREY, LIGHT_GREY, ORANGE, SKY, VERMILION, figure, legend_below
from caviar_protocol.arrays import Float64Array, Int32Array
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.space.scene import antennas, device_pose
from caviar_protocol.topics import AntennaArray, AntennaDevice, Channel, Link, Scene
from caviar_protocol.topics.channel import Interaction

View = tuple[tuple[float, float], tuple[float, float]]
"""Limits of x and of y [m]."""

BeamGain = Callable[[AntennaArray, int, Float64Array], Float64Array]
"""``gain(array, beam, directions)``: amplitude of a codebook beam towards unit vectors in device
axes, Shape ``[N, 3]`` to ``[N]``, 1 at its greatest."""

OUTLINE = ((0.5, 0.5), (0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5))
"""Corners of an object's box from above, of its length and width."""

BEAM_ALPHA = 0.22
"""Opacity of the beam's area."""

TICK = 0.05
"""Length of the ticks of paths whose route is unknown, of the width of the map."""
TICK_COLOR = "#21918c"  # the middle of viridis
TICK_LABEL = "path of unknown route: departure, arrival"


@dataclass(frozen=True, eq=False)
class MapData:
    """What stands in a map; whatever is None is left out."""

    scene: Scene
    channel: Channel | None
    link: Link | None
    footprints: Footprints | None
    beam_gain: BeamGain | None
    user: tuple[str, str, str] | None
    """(tx, rx, carrier) whose chosen beam is shown."""
    title: str


def draw_map(data: MapData, file: Path) -> None:
    """Draw the map of one frame."""
    beam = chosen_beam(data)
    view = view_of(data, beam)
    (left, right), (bottom, top) = view
    # As high as the view needs, beside 1.5 inches for the colour bar, above 1.6 for title and legend.
    height = float(np.clip((top - bottom) / (right - left) * 8.0 + 1.6, 4.5, 11.0))
    with figure(file, 9.5, height, layout="compressed") as drawn:
        axes = drawn.subplots()
        axes.set_xlim(view[0])
        axes.set_ylim(view[1])
        draw_scenery(axes, data.footprints)
        _add_rays(drawn, axes, data)
        if beam is not None:
            draw_beam(axes, beam)
        draw_objects(axes, data, Labels(marked=served_object(data)))
        draw_antennas(axes, data)
        axes.set_aspect("equal")
        axes.set_xlabel("x, east [m]")
        axes.set_ylabel("y, north [m]")
        axes.set_title(data.title)
        legend_below(drawn, axes)


def view_of(data: MapData, beam: Beam | None) -> View:
    """Limits of x and y [m]: objects, devices and the beam, ray points unless far off; at least 40 m."""
    devices = [device_pose(data.scene, device).position[:2] for device in data.scene.devices]
    core = np.concatenate([data.scene.position[:, :2], np.array(devices).reshape(-1, 2)])
    if beam is not None:
        core = np.concatenate([core, beam.outline])
    if not len(core):
        core = np.zeros((1, 2))
    low, high = core.min(axis=0), core.max(axis=0)
    if data.channel is not None:
        used = data.channel.interactions != Interaction.NONE
        reach = 0.25 * float((high - low).max())
        points = np.clip(data.channel.points[used][:, :2], low - reach, high + reach)
        low, high = np.min([low, *points], axis=0), np.max([high, *points], axis=0)
    centre, half = (low + high) / 2, np.maximum((high - low) / 2 * 1.08 + 5.0, 20.0)
    half = np.maximum(half, half.max() * np.array([0.9, 0.4]))  # neither a tower nor a strip
    left, bottom = (centre - half).tolist()
    right, top = (centre + half).tolist()
    return (left, right), (bottom, top)


def draw_scenery(axes: Any, footprints: Footprints | None) -> None:
    """Areas and outlines of buildings."""
    from matplotlib.collections import LineCollection, PolyCollection

    if footprints is None:
        return
    faces: Any = footprints.faces
    edges: Any = footprints.edges
    axes.add_collection(
        PolyCollection(faces, facecolors=LIGHT_GREY, edgecolors=LIGHT_GREY, linewidths=0.4, zorder=1)
    )
    axes.add_collection(LineCollection(edges, colors=GREY, linewidths=0.6, zorder=1.1))


def draw_rays(axes: Any, drawn: Rays, limits: tuple[float, float]) -> list[Any]:
    """Every path as a line over its interaction points, or as ticks; the strongest on top.

    Returns the collections, whose colours are those of ``limits`` [dB].
    """
    from matplotlib.collections import LineCollection

    (left, right), collections = axes.get_xlim(), []
    ticks = drawn.ticks(TICK * (right - left))
    style: dict[str, Any] = {"cmap": "viridis", "clim": limits, "alpha": 0.85, "zorder": 2}
    for lines, gains, width in ((drawn.lines, drawn.gains, 1.1), (ticks, drawn.tick_gains, 2.0)):
        order = np.argsort(gains, kind="stable")
        if len(order):
            ordered: list[Any] = [lines[i] for i in order]
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
    """The beam chosen for the user of the map; None where there is none."""
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
    gain = data.beam_gain(device.array, beam, world @ rotation_matrix(pose.orientation))
    radius = max(0.6 * distance, 5.0) * gain / max(float(gain.max()), 1e-9)
    outline: Float64Array = np.array(pose.position[:2]) + radius[:, None] * around
    return Beam(outline, f"beam {beam} of {device.name}, chosen for {rx}")


def draw_beam(axes: Any, beam: Beam) -> None:
    """The pattern as an area with an outline."""
    from matplotlib.collections import PolyCollection

    # Not `axes.fill`, which takes a tenth of a second to find the limits of so many corners.
    area = PolyCollection([beam.outline], facecolors=VERMILION, alpha=BEAM_ALPHA, linewidths=0, zorder=3)
    axes.add_collection(area, autolim=False)
    axes.plot(*beam.outline.T, color=VERMILION, linewidth=1.3, zorder=3.1, label=beam.label)


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


@dataclass
class Labels:
    """How names stand in a map; kept from frame to frame, names stay on the side where they were."""

    width: float = 570.0
    """Of the axes, about [points]."""
    prefix: str | None = None
    """What names leave out at their beginning; by default what all of the scene have in common."""
    marked: str = ""
    """Object whose name stands out."""
    sides: dict[str, int] = field(default_factory=dict)


def draw_objects(axes: Any, data: MapData, labels: Labels | None = None) -> None:
    """Bounding boxes from above, a mark at the front, names where there is room."""
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
    (left, right), smallest = axes.get_xlim(), scene.dimensions[:, :2].max(axis=1)
    tiny = np.flatnonzero(smallest < 0.012 * (right - left))
    axes.scatter(
        *scene.position[tiny, :2].T, marker="s", s=42, c=[colors[i] for i in tiny], edgecolors=BLACK,
        linewidths=0.7, zorder=3.9,
    )  # fmt: skip
    for color, label in ((ORANGE, "object with a device"), (SKY, "other object")):
        if color in colors:
            axes.scatter([], [], marker="s", s=60, color=color, edgecolors=BLACK, linewidths=0.7, label=label)
    _name_objects(axes, scene, boxes, carriers, labels or Labels())


def from_above(scene: Scene, points: Sequence[Sequence[float]]) -> Float64Array:
    """Where points x and y of a box −½…½ are on each object of a scene [m], Shape ``[N, len(points), 2]``."""
    found = np.zeros((len(scene.names), len(points), 2))
    for i in range(len(scene.names)):
        rotation = rotation_matrix(scene.orientation[i].tolist())[:2, :2]
        found[i] = scene.position[i, :2] + (np.array(points) * scene.dimensions[i, :2]) @ rotation.T
    return found


def served_object(data: MapData) -> str:
    """The object that carries the receiver whose beam is shown; empty where none does."""
    receiver = data.user[1] if data.user else ""
    return next((device.parent for device in data.scene.devices if device.name == receiver), "")


def _name_objects(axes: Any, scene: Scene, boxes: Float64Array, carriers: set[str], labels: Labels) -> None:
    """Names without what all have in common, where there is room.

    The marked one comes first, then those with a device.
    """
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
    """Above, below, right and left of a box."""
    x0, y0, x1, y1 = box
    corners = (
        ((x0 + x1 - width) / 2, y1 + gap),
        ((x0 + x1 - width) / 2, y0 - gap - height),
        (x1 + gap, (y0 + y1 - height) / 2),
        (x0 - gap - width, (y0 + y1 - height) / 2),
    )
    return [(x, y, x + width, y + height) for x, y in corners]


def common_prefix(names: Sequence[str]) -> str:
    """The dotted parts that all names begin with; empty for a single name."""
    parts = [name.split(".")[:-1] for name in names] if len(names) > 1 else []
    same = itertools.takewhile(lambda level: len(set(level)) == 1, zip(*parts, strict=False))
    return "".join(f"{level[0]}." for level in same)


def _within(a: Rectangle, x: tuple[float, float], y: tuple[float, float]) -> bool:
    return x[0] <= a[0] and a[2] <= x[1] and y[0] <= a[1] and a[3] <= y[1]


def _overlap(a: Rectangle, b: Rectangle) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


@dataclass(frozen=True)
class Mark:
    """How a device stands in a map."""

    label: str
    marker: str
    size: float
    """[points²]"""
    color: str = BLACK
    edge: str = "white"
    width: float = 0.8


TRANSMITTER = Mark("transmitter", "^", 110)
RECEIVER = Mark("receiver", "o", 18)
WITHOUT_LOS = Mark("receiver, NLOS", "o", 30, color="white", edge=BLACK, width=1.6)
WITHOUT_PATH = Mark("receiver, no path", "X", 70)
RECEIVERS = (RECEIVER, WITHOUT_LOS, WITHOUT_PATH)


def receiver_mark(link: Link | None, receiver: str) -> Mark:
    """Whether any transmitter reaches a receiver along the line of sight, or at all; plain where unknown."""
    users = [i for i, rx in enumerate(link.rx) if rx == receiver] if link is not None else []
    if link is None or not users or link.los[users].any():
        return RECEIVER
    return WITHOUT_LOS if link.has_path[users].any() else WITHOUT_PATH


def draw_antennas(axes: Any, data: MapData) -> None:
    """Transmitters as triangles with their names, receivers as dots."""
    from matplotlib.patheffects import withStroke

    halo = [withStroke(linewidth=2.5, foreground="white")]
    by_mark: dict[Mark, list[AntennaDevice]] = {TRANSMITTER: list(antennas(data.scene, "tx"))}
    for device in antennas(data.scene, "rx"):
        by_mark.setdefault(receiver_mark(data.link, device.name), []).append(device)
    for mark in (TRANSMITTER, *RECEIVERS):
        devices = by_mark.get(mark, [])
        if not devices:
            continue
        places = np.array([device_pose(data.scene, device).position[:2] for device in devices])
        axes.scatter(
            *places.T, marker=mark.marker, s=mark.size, color=mark.color, edgecolors=mark.edge,
            linewidths=mark.width, zorder=5, label=mark.label,
        )  # fmt: skip
        for device, place in zip(devices, places, strict=True):
            if not device.parent:
                axes.annotate(
                    device.name, place, xytext=(0, 10), textcoords="offset points", ha="center",
                    fontsize=10, fontweight="bold", path_effects=halo, zorder=6, annotation_clip=True,
                )  # fmt: skip


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
