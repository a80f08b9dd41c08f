"""Pictures of one sensor at one instant: a camera's picture, depth, objects, normals, materials; LIDAR scans.

A LIDAR scan: from above, and as the sensor sees it.
"""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.plots.rays import OUTLINE, from_above
from caviar_clients.plots.style import BLACK, LIGHT_GREY, ORANGE, figure, legend_below
from caviar_protocol.arrays import BoolArray, Float32Array, Float64Array, Int32Array, UInt8Array
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.topics import Lidar, LidarDevice, LidarScan, OccupancyGrid, Scene


def draw_scan(scan: LidarScan, lidar: Lidar, scene: Scene | None, title: str, file: Path) -> None:
    """Draw a scan from above and as the sensor sees it; hits on moving objects stand out from the scenery.

    Args:
        scan: The scan.
        lidar: The product that it is of, for the names of objects.
        scene: Objects and the sensor of the frame; None: neither boxes nor the range image are drawn.
        title: Title of the picture.
        file: PNG that is written.
    """
    moving = _on_objects(scan, lidar, scene)
    device = _device(scan, scene)
    view = _view(scan)
    (left, right), (bottom, top) = view
    # As high as the view needs at its width, then 2 inches for the range image.
    height = float(np.clip((top - bottom) / (right - left) * 8.0, 2.0, 8.0))
    with figure(file, 9.5, height + (3.6 if device else 1.2)) as drawn:
        ratios = (height, 2.0) if device else (height,)
        panels = drawn.subplots(len(ratios), 1, height_ratios=ratios, squeeze=False)
        above = panels[0, 0]
        above.set_xlim(left, right)
        above.set_ylim(bottom, top)
        above.set_title(title)
        _draw_above(drawn, above, scan, moving, scene)
        if device is not None:
            _draw_ranges(drawn, panels[1, 0], scan, device)
        legend_below(drawn, above)


def draw_grid(grid: OccupancyGrid, title: str, file: Path) -> None:
    """Draw the quantised grid of a scan from above: the highest occupied layer of each column.

    Args:
        grid: Of the scan.
        title: Title of the picture.
        file: PNG that is written.
    """
    cells, (x, y, z), (dx, dy, dz) = grid.occupancy, grid.origin, grid.cell
    height = np.where(cells == 1, z + dz * np.arange(cells.shape[2]), -np.inf).max(axis=2)
    # The first and the last cell reach half a cell beyond their coordinates.
    extent = (x - dx / 2, x + dx * (len(cells) - 0.5), y - dy / 2, y + dy * (cells.shape[1] - 0.5))
    ratio = (extent[3] - extent[2]) / (extent[1] - extent[0])
    with figure(file, 9.5, float(np.clip(8.0 * ratio, 2.0, 8.0)) + 1.2) as drawn:
        axes = drawn.subplots()
        shown = axes.imshow(
            np.ma.masked_invalid(height).T,
            origin="lower",
            extent=extent,
            cmap="viridis",
            interpolation="none",
        )
        drawn.colorbar(shown, ax=axes, label="Highest occupied cell z [m]", pad=0.01)
        antennas = np.argwhere((cells < 0).any(axis=2)) * (dx, dy) + (x, y)
        axes.scatter(*antennas.T, marker="^", s=60, color=ORANGE, edgecolors=BLACK, label="antenna")
        axes.set(xlabel="x, east [m]", ylabel="y, north [m]", title=title)
        legend_below(drawn, axes)


def _view(scan: LidarScan) -> tuple[tuple[float, float], tuple[float, float]]:
    """Choose limits of x and y [m]: the sensor and nearly all hits; at least 20 m."""
    # Nearly: one hit on a distant tower would make the rest a dot.
    around = np.array([scan.position[:2]])
    if len(scan.range):
        around = np.vstack([around, np.percentile(scan.in_world()[:, :2], [0.2, 99.8], axis=0)])
    low, high = around.min(axis=0), around.max(axis=0)
    half = np.maximum((high - low) / 2 + 3.0, 10.0)
    half = np.maximum(half, half.max() * 0.25)
    (left, bottom), (right, top) = ((low + high) / 2 - half).tolist(), ((low + high) / 2 + half).tolist()
    return (left, right), (bottom, top)


def _draw_above(drawn: Any, axes: Any, scan: LidarScan, moving: BoolArray, scene: Scene | None) -> None:
    points = scan.in_world()
    height = points[:, 2]
    limits = np.percentile(height, [1, 99]) if len(height) else (0.0, 1.0)
    cloud = axes.scatter(
        points[~moving, 0], points[~moving, 1], c=height[~moving], s=1.5, linewidths=0, cmap="viridis",
        vmin=limits[0], vmax=max(limits[1], limits[0] + 0.1),
    )  # fmt: skip
    drawn.colorbar(cloud, ax=axes, label="Scenery height z [m]", pad=0.01)
    if moving.any():
        axes.scatter(points[moving, 0], points[moving, 1], s=3.5, linewidths=0, color=ORANGE)
        axes.scatter([], [], s=40, color=ORANGE, label="moving objects")
    if scene is not None:
        _draw_boxes(axes, scene)
    x, y, _ = scan.position
    heading = rotation_matrix(scan.orientation)[:2, 0]
    axes.scatter([x], [y], marker="*", s=200, color="white", edgecolors=BLACK, zorder=5, label=scan.sensor)
    extent = float(np.percentile(scan.range, 99.5)) if len(scan.range) else 20.0
    axes.annotate(
        "", xy=(x + 0.12 * extent * heading[0], y + 0.12 * extent * heading[1]), xytext=(x, y),
        arrowprops={"arrowstyle": "->", "color": BLACK, "linewidth": 1.6}, zorder=6,
    )  # fmt: skip
    axes.set(aspect="equal", xlabel="x, east [m]", ylabel="y, north [m]")
    axes.grid()


def _draw_boxes(axes: Any, scene: Scene) -> None:
    from matplotlib.collections import PolyCollection

    boxes: Any = from_above(scene, OUTLINE)
    axes.add_collection(PolyCollection(boxes, facecolors="none", edgecolors=BLACK, linewidths=0.8, zorder=4))


def _draw_ranges(drawn: Any, axes: Any, scan: LidarScan, device: LidarDevice) -> None:
    """Draw the range image: azimuth as the sensor turns, ahead in the middle, left on the left."""
    image = range_image(scan, device)
    half = 180 / device.azimuth_steps
    elevation = np.degrees([device.elevation_min, device.elevation_max])
    shown = axes.imshow(
        image, origin="lower", aspect="auto", cmap="cividis_r", interpolation="nearest",
        extent=(180 + half, -180 + half, *elevation),
    )  # fmt: skip
    drawn.colorbar(shown, ax=axes, label="Range [m]", pad=0.01)
    axes.set(xticks=range(-180, 181, 45), xlabel="Azimuth from the sensor's x axis, counter-clockwise [°]")
    axes.set_ylabel("Elevation [°]")


def range_image(scan: LidarScan, device: LidarDevice) -> Float64Array:
    """Arrange the ranges of a scan as an image.

    Args:
        scan: The scan.
        device: Its sensor, for the numbers of beams and azimuths.

    Returns:
        Ranges [m], Shape ``[beams, azimuth_steps]``, lowest beam first, NaN where nothing was hit. Columns
        run from azimuth +180° (left of the picture) down to −180°.
    """
    ranges = np.full(device.beams * device.azimuth_steps, np.nan)
    ranges[scan.ray] = scan.range
    turn = ranges.reshape(device.beams, device.azimuth_steps)
    step = np.arange(device.azimuth_steps) * (2 * np.pi / device.azimuth_steps)
    signed = np.where(step > np.pi, step - 2 * np.pi, step)
    image: Float64Array = turn[:, np.argsort(-signed)]
    return image


def _on_objects(scan: LidarScan, lidar: Lidar, scene: Scene | None) -> BoolArray:
    """Find the hits on objects of the scene rather than on scenery."""
    names = set() if scene is None else set(scene.names)
    of_object = np.array([name in names for name in lidar.object_names] or [False])
    hits: BoolArray = of_object[scan.object]
    return hits


def _device(scan: LidarScan, scene: Scene | None) -> LidarDevice | None:
    for device in scene.devices if scene is not None else ():
        if isinstance(device, LidarDevice) and device.name == scan.sensor:
            return device
    return None


NAMED = 16
"""Entries of a legend at most."""
SKY_GREY = "#eef1f4"
"""Colour where nothing was hit."""
# (√5 − 1)/2: multiples of it modulo 1 never come close to each other.
_GOLDEN = 0.618033988749895


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraView:
    """Images of one camera in one frame; None for what was not recorded.

    Args:
        sensor: Name of the camera.
        rgb: Picture in sRGB, Shape ``[height, width, 3]``.
        depth: Depth along the optical axis [m], 0 where nothing was hit, Shape ``[height, width]``.
        objects: Index of the object at each pixel, −1 where nothing was hit, Shape ``[height, width]``.
        object_names: Names by that index.
        normals: Unit normals in world axes, 0 where nothing was hit, Shape ``[height, width, 3]``.
        materials: Index of the material at each pixel, likewise.
        material_names: Names by that index.
        moving: Names of the objects of the scene, which stand out from scenery.
    """

    sensor: str
    rgb: UInt8Array | None = None
    depth: Float32Array | None = None
    objects: Int32Array | None = None
    object_names: tuple[str, ...] = ()
    normals: Float32Array | None = None
    materials: Int32Array | None = None
    material_names: tuple[str, ...] = ()
    moving: frozenset[str] = frozenset()


def draw_view(view: CameraView, title: str, folder: Path, stem: str = "camera") -> list[Path]:
    """Draw every image that there is as ``STEM-KIND.png``, and all in one as ``STEM.png``.

    ``STEM-rgb.png`` has the pixels of the picture and nothing else.

    Args:
        view: The images.
        title: Title of the pictures.
        folder: Where the files go.
        stem: Beginning of their names.

    Returns:
        The files, all in one first.
    """
    panels = list(_panels(view))
    files = [folder / f"{stem}.png"]
    _draw_all(panels, title, files[0])
    from matplotlib.image import imsave  # where that drew, it is installed

    for kind, name, draw, aspect in panels:
        files.append(folder / f"{stem}-{kind}.png")
        if kind == "rgb" and view.rgb is not None:
            imsave(files[-1], np.ascontiguousarray(view.rgb))
            continue
        with figure(files[-1], 9.5, 7.0 * aspect + 0.6) as drawn:
            axes = drawn.subplots()
            draw(drawn, axes)
            axes.set_title(f"{name}: {title}")
    return files


_Draw = Callable[[Any, Any], None]


def _panels(view: CameraView) -> Iterator[tuple[str, str, _Draw, float]]:
    """Yield kind, title, how to draw it, and height over width of each image that there is."""
    if (rgb := view.rgb) is not None:
        yield "rgb", "Picture", lambda _, axes: _show(axes, rgb), _aspect(rgb)
    if (depth := view.depth) is not None:
        yield "depth", "Depth", lambda drawn, axes: _draw_depth(drawn, axes, depth), _aspect(depth)
    if (normals := view.normals) is not None:
        yield "normals", "Normals", lambda _, axes: _draw_normals(axes, normals), _aspect(normals)
    if (objects := view.objects) is not None:
        colours = object_colours(view.object_names, view.moving)
        yield (
            "segmentation",
            "Objects",
            lambda _, axes: _draw_ids(axes, objects, view.object_names, colours, view.moving),
            _aspect(objects),
        )
    if (materials := view.materials) is not None:
        spread = object_colours(view.material_names, frozenset(view.material_names))
        yield (
            "materials",
            "Materials",
            lambda _, axes: _draw_ids(axes, materials, view.material_names, spread, frozenset()),
            _aspect(materials),
        )


def object_colours(names: tuple[str, ...], moving: frozenset[str]) -> Float64Array:
    """Choose a colour for each name: strong ones for what moves, pale ones for scenery.

    Args:
        names: The names.
        moving: Those that move.

    Returns:
        sRGB, Shape ``[names, 3]``. Hues follow each other by the golden ratio, which keeps any number of them
        apart.
    """
    colours, counts = np.zeros((len(names), 3)), [0, 0]
    for index, name in enumerate(names):
        strong = name in moving
        count = counts[strong]
        level = (
            (0.80, 0.85 - 0.15 * (count % 2))
            if strong
            else (0.10 + 0.12 * (count % 3), 0.93 - 0.08 * (count % 4))
        )
        colours[index] = colorsys.hsv_to_rgb((0.02 + count * _GOLDEN) % 1, *level)
        counts[strong] += 1
    return colours


def _draw_all(panels: list[tuple[str, str, _Draw, float]], title: str, file: Path) -> None:
    """Draw two images a row; a legend stands beside its image, so materials have a picture of their own."""
    chosen = [panel for panel in panels if panel[0] != "materials"] or panels
    columns = min(2, len(chosen))
    rows = -(-len(chosen) // columns)
    height = max(panel[3] for panel in chosen)
    with figure(file, 8.0 * columns, (5.6 * height + 0.5) * rows + 0.5, layout="compressed") as drawn:
        drawn.suptitle(title[:1].upper() + title[1:])
        cells = drawn.subplots(rows, columns, squeeze=False).ravel()
        for axes in cells[len(chosen) :]:
            axes.set_axis_off()
        for axes, (_, name, draw, _) in zip(cells, chosen, strict=False):
            draw(drawn, axes)
            axes.set_title(name)


def _aspect(image: Any) -> float:
    return float(image.shape[0] / image.shape[1])


def _show(axes: Any, image: Any, **how: Any) -> Any:
    axes.set(xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_facecolor(SKY_GREY)
    return axes.imshow(image, interpolation="nearest", **how)


def _draw_depth(drawn: Any, axes: Any, depth: Float32Array) -> None:
    """Draw depth on a logarithmic scale, on which near and far have the same share of colours."""
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    hit = depth > 0
    # Without the nearest and farthest thousandth: a ray along the ground would stretch the scale.
    near, far = np.percentile(depth[hit], [0.1, 99.9]) if hit.any() else (1.0, 10.0)
    shown = _show(
        axes,
        np.where(hit, depth, np.nan),
        cmap="viridis_r",
        norm=LogNorm(float(near), float(max(far, 1.01 * near))),
    )
    beside = axes.inset_axes((1.02, 0.0, 0.035, 1.0))
    bar = drawn.colorbar(shown, cax=beside, label="Depth along the optical axis [m]")
    bar.ax.yaxis.set_major_locator(LogLocator(base=10, subs=(1, 2, 5)))
    bar.ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    bar.ax.yaxis.set_minor_formatter(NullFormatter())


def _draw_normals(axes: Any, normals: Float32Array) -> None:
    hit = (normals != 0).any(axis=2)
    image = np.ones((*hit.shape, 4))
    image[..., :3] = np.clip((normals + 1) / 2, 0, 1)
    image[..., 3] = hit
    _show(axes, image)
    _legend(
        axes,
        [
            ("east, +x", (1.0, 0.5, 0.5)),
            ("west, −x", (0.0, 0.5, 0.5)),
            ("north, +y", (0.5, 1.0, 0.5)),
            ("south, −y", (0.5, 0.0, 0.5)),
            ("up, +z", (0.5, 0.5, 1.0)),
        ],
    )


def _draw_ids(
    axes: Any, ids: Int32Array, names: tuple[str, ...], colours: Float64Array, first: frozenset[str]
) -> None:
    table = np.vstack([np.column_stack([colours, np.ones(len(names))]), np.zeros((1, 4))])
    _show(axes, table[ids])
    entries = [(names[i], tuple(colours[i])) for i in largest(ids, names, first)]
    if len(np.unique(ids[ids >= 0])) > len(entries):
        entries.append(("… and smaller ones", tuple(np.full(3, 1.0))))
    _legend(axes, entries)


def largest(ids: Int32Array, names: tuple[str, ...], first: frozenset[str]) -> list[int]:
    """Choose the names of a legend: those with most pixels, at most `NAMED`.

    Args:
        ids: Index of the name at each pixel, −1: none.
        names: The names.
        first: Names that three of four places are for.

    Returns:
        Indices of the names, those of ``first`` at the beginning.
    """
    pixels = np.bincount(ids[ids >= 0].ravel(), minlength=len(names))
    order = [int(i) for i in np.argsort(-pixels, kind="stable") if pixels[i]]
    front = [i for i in order if names[i] in first]
    rest = [i for i in order if names[i] not in first]
    few = min(len(rest), max(NAMED // 4, NAMED - len(front)))
    return front[: NAMED - few] + rest[:few]


def _legend(axes: Any, entries: list[tuple[str, tuple[float, ...]]]) -> None:
    from matplotlib.patches import Patch

    handles = [Patch(facecolor=colour, edgecolor=LIGHT_GREY, label=name) for name, colour in entries]
    axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(1.01, 1.0), borderaxespad=0, frameon=False)
