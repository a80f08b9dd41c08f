"""What one camera saw at one instant: picture, depth, objects, surface normals, materials."""

from __future__ import annotations

import colorsys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_clients.plots.style import LIGHT_GREY, figure
from caviar_protocol.arrays import Float32Array, Float64Array, Int32Array, UInt8Array

NAMED = 16
"""Entries of a legend at most."""
SKY_GREY = "#eef1f4"
"""Where nothing was hit."""
_GOLDEN = 0.618033988749895


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraView:
    """Images of one camera in one frame; None for what was not recorded."""

    sensor: str
    rgb: UInt8Array | None = None
    depth: Float32Array | None = None
    objects: Int32Array | None = None
    object_names: tuple[str, ...] = ()
    normals: Float32Array | None = None
    materials: Int32Array | None = None
    material_names: tuple[str, ...] = ()
    moving: frozenset[str] = frozenset()
    """Names of the objects of the scene, which stand out from scenery."""


def draw_view(view: CameraView, title: str, folder: Path, stem: str = "camera") -> list[Path]:
    """Draw every image that there is as ``STEM-KIND.png``, and all in one as ``STEM.png``.

    ``STEM-rgb.png`` has the pixels of the picture and nothing else. The files, all in one first.
    """
    panels = list(_panels(view))
    files = [folder / f"{stem}.png"]
    _draw_all(panels, title, files[0])
    for kind, name, draw, aspect in panels:
        files.append(folder / f"{stem}-{kind}.png")
        if kind == "rgb" and view.rgb is not None:
            _save_pixels(view.rgb, files[-1])
            continue
        with figure(files[-1], 9.5, 7.0 * aspect + 0.6) as drawn:
            axes = drawn.subplots()
            draw(drawn, axes)
            axes.set_title(f"{name}: {title}")
    return files


_Draw = Callable[[Any, Any], None]


def _panels(view: CameraView) -> Iterator[tuple[str, str, _Draw, float]]:
    """Kind, title, how to draw it, and height over width of each image that there is."""
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
    """sRGB by index, Shape ``[names, 3]``: strong colours for what moves, pale ones for scenery.

    Hues follow each other by the golden ratio, which keeps any number of them apart.
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
    """Two images a row; a legend stands beside its image, so materials have a picture of their own."""
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
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    axes.set_facecolor(SKY_GREY)
    return axes.imshow(image, interpolation="nearest", **how)


def _draw_depth(drawn: Any, axes: Any, depth: Float32Array) -> None:
    """Depth on a logarithmic scale, on which near and far have the same share of colours."""
    from matplotlib.colors import LogNorm
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    hit = depth > 0
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
    """Indices of the names with most pixels, at most `NAMED`; three of four places are for ``first``."""
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


def _save_pixels(rgb: UInt8Array, file: Path) -> None:
    from matplotlib.image import imsave

    imsave(file, np.ascontiguousarray(rgb))
