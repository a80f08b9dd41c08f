"""A LIDAR scan: from above, and as the sensor sees it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.plots.style import BLACK, LIGHT_GREY, ORANGE, figure, legend_below
from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.topics import Lidar, LidarDevice, LidarScan, Scene


def draw_scan(scan: LidarScan, lidar: Lidar, scene: Scene | None, title: str, file: Path) -> None:
    """Draw one scan; hits on moving objects stand out from the scenery."""
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


def _view(scan: LidarScan) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of x and y [m]: the sensor and nearly all hits; at least 20 m."""
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
    axes.set_aspect("equal")
    axes.set_xlabel("x, east [m]")
    axes.set_ylabel("y, north [m]")
    axes.grid(color=LIGHT_GREY, linewidth=0.6)


def _draw_boxes(axes: Any, scene: Scene) -> None:
    from matplotlib.collections import PolyCollection

    outline = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, -0.5], [-0.5, 0.5]])
    boxes = [
        scene.position[i, :2]
        + (outline * scene.dimensions[i, :2]) @ rotation_matrix(scene.orientation[i].tolist())[:2, :2].T
        for i in range(len(scene.names))
    ]
    axes.add_collection(PolyCollection(boxes, facecolors="none", edgecolors=BLACK, linewidths=0.8, zorder=4))


def _draw_ranges(drawn: Any, axes: Any, scan: LidarScan, device: LidarDevice) -> None:
    """Range image: azimuth as the sensor turns, ahead in the middle, left on the left."""
    image = range_image(scan, device)
    half = 180 / device.azimuth_steps
    elevation = np.degrees([device.elevation_min, device.elevation_max])
    shown = axes.imshow(
        image, origin="lower", aspect="auto", cmap="cividis_r", interpolation="nearest",
        extent=(180 + half, -180 + half, *elevation),
    )  # fmt: skip
    drawn.colorbar(shown, ax=axes, label="Range [m]", pad=0.01)
    axes.set_xticks(range(-180, 181, 45))
    axes.set_xlabel("Azimuth from the sensor's x axis, counter-clockwise [°]")
    axes.set_ylabel("Elevation [°]")


def range_image(scan: LidarScan, device: LidarDevice) -> Float64Array:
    """Ranges [m], Shape ``[beams, azimuth_steps]``, lowest beam first, NaN where nothing was hit.

    Columns run from azimuth +180° (left of the picture) down to −180°.
    """
    ranges = np.full(device.beams * device.azimuth_steps, np.nan)
    ranges[scan.ray] = scan.range
    turn = ranges.reshape(device.beams, device.azimuth_steps)
    step = np.arange(device.azimuth_steps) * (2 * np.pi / device.azimuth_steps)
    signed = np.where(step > np.pi, step - 2 * np.pi, step)
    image: Float64Array = turn[:, np.argsort(-signed)]
    return image


def _on_objects(scan: LidarScan, lidar: Lidar, scene: Scene | None) -> BoolArray:
    """Which hits are on objects of the scene rather than on scenery."""
    names = set() if scene is None else set(scene.names)
    of_object = np.array([name in names for name in lidar.object_names] or [False])
    hits: BoolArray = of_object[scan.object]
    return hits


def _device(scan: LidarScan, scene: Scene | None) -> LidarDevice | None:
    for device in scene.devices if scene is not None else ():
        if isinstance(device, LidarDevice) and device.name == scan.sensor:
            return device
    return None
