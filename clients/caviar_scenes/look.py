"""Looks at a scene: what it holds, in numbers and in a picture from above and aslant."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_scenes.checks import Parts
from caviar_scenes.opened import OpenedScene
from caviar_space.ground import are_ground
from caviar_space.mitsuba_xml import SceneryShape
from caviar_space.vectors import cross

_COLOURS = np.array(
    [
        [0.80, 0.77, 0.71], [0.66, 0.40, 0.34], [0.55, 0.62, 0.70], [0.56, 0.70, 0.45],
        [0.78, 0.68, 0.45], [0.60, 0.55, 0.72], [0.45, 0.68, 0.70],
    ]
)  # fmt: skip
# Towards the light, and what a face that lies in shadow has of it.
_LIGHT = np.array([0.36, -0.48, 0.8])
_SHADOW = 0.55
_ABOVE, _ASLANT = np.radians(90.0), np.radians(35.0)


@dataclass(frozen=True)
class Look:
    """Numbers of a scene, as text."""

    lines: list[str]
    materials: list[tuple[str, ...]]
    """Name, pieces, triangles, area [m²], thickness [m], and where it is defined."""


def look(scene: OpenedScene) -> Look:
    """Describe a scene.

    Args:
        scene: The scene.
    """
    parts = Parts(list(scene.meshes.values()))
    low, high = parts.triangles.min((0, 1)), parts.triangles.max((0, 1))
    (x, y, z), (x0, y0, z0) = (high - low).tolist(), low.tolist()
    closed = int(np.count_nonzero(parts.closed()))
    lines = [
        f"{scene.name}: {len(scene.meshes)} pieces, {len(parts.triangles)} triangles",
        f"extent: {x:.1f} × {y:.1f} × {z:.1f} m, the lowest corner at ({x0:.1f}, {y0:.1f}, {z0:.1f}) m",
        f"parts that hang together: {parts.count}, {closed} closed, {parts.count - closed} open",
    ]
    if origin := scene.origin:
        lines.append(
            f"origin: {origin.latitude_deg:.6f}° N, {origin.longitude_deg:.6f}° E, "
            f"{origin.altitude_m:.1f} m ({origin.projection})"
        )
    else:
        lines.append("origin: none; the scene has no place on the Earth")
    area = np.bincount(parts.piece, np.linalg.norm(parts.normals(), axis=1), len(scene.meshes))
    by_material: dict[str, list[int]] = {}
    first: dict[str, SceneryShape] = {}
    for number, (name, shape) in enumerate(scene.shapes.items()):
        key = "foliage" if name in scene.foliage else shape.radio.name if shape.radio else shape.material
        by_material.setdefault(key, []).append(number)
        first.setdefault(key, shape)
    counts = [len(mesh.faces) for mesh in scene.meshes.values()]
    materials: list[tuple[str, ...]] = [
        (
            name,
            str(len(pieces)),
            str(sum(counts[piece] for piece in pieces)),
            f"{area[pieces].sum():.0f}",
            _thickness(first[name]),
            _ranges(first[name]),
        )
        for name, pieces in by_material.items()
    ]
    return Look(lines, materials)


def _thickness(shape: SceneryShape) -> str:
    found = re.search(r'name="thickness" value="([^"]+)"', shape.radio.xml) if shape.radio else None
    return found.group(1) if found else "0.1" if shape.radio else "–"


def _ranges(shape: SceneryShape) -> str:
    """Frequencies at which a material is defined; those of its own constants are all."""
    if not shape.itu_material:
        return "all carriers: constants of its own" if shape.radio else "–"
    try:
        from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES
    except ImportError:
        return "unknown without the extra `channel`"
    ranges = ITU_MATERIALS_PROPERTIES.get(shape.itu_material, {})
    return ", ".join(f"{low:g}–{high:g} GHz" for low, high in ranges)


def draw(scene: OpenedScene, file: Path) -> None:
    """Draw a scene from above and aslant, coloured by material.

    Args:
        scene: The scene.
        file: PNG that is written.

    Raises:
        SetupError: Matplotlib is missing.
        RunError: The file cannot be written.
    """
    from caviar_clients.plots.style import figure, legend_below, legend_square

    meshes = list(scene.meshes.values())
    triangles = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    labels = [
        "foliage" if name in scene.foliage else shape.radio.name if shape.radio else shape.material
        for name, shape in scene.shapes.items()
    ]
    known = list(dict.fromkeys(labels))
    material = np.repeat([known.index(label) for label in labels], [len(mesh.faces) for mesh in meshes])
    ground = np.repeat(are_ground(meshes), [len(mesh.faces) for mesh in meshes])
    colours = _COLOURS[np.arange(len(known)) % len(_COLOURS)]
    with figure(file, 14.0, 7.5) as drawn:
        above, aslant = drawn.subplots(1, 2)
        for axes, angle in ((above, _ABOVE), (aslant, _ASLANT)):
            _draw_from(axes, triangles, colours[material], ground, angle)
        above.set(xlabel="x, east [m]", ylabel="y, north [m]", title=f"{scene.name} from above")
        aslant.set(title="from the south, 35° above the horizon")
        aslant.set_axis_off()
        for label, colour in zip(known, colours, strict=True):
            legend_square(above, label, colour)
        legend_below(drawn, above, 4)


def _draw_from(
    axes: Any, triangles: Float64Array, colours: Float64Array, ground: BoolArray, angle: float
) -> None:
    """Draw triangles as seen from the south at an angle [rad] above the horizon, the farthest first, after
    all ground, whose triangles may be larger than houses."""
    from matplotlib.collections import PolyCollection

    towards = np.array([0.0, -np.cos(angle), np.sin(angle)])
    up = np.array([0.0, np.sin(angle), np.cos(angle)])
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    seen = np.abs(normal @ towards) > 1e-3
    facing = normal * np.sign(normal @ towards)[:, None]
    light = _SHADOW + (1 - _SHADOW) * np.clip(facing @ _LIGHT, 0.0, 1.0)
    order = np.lexsort((triangles.mean(1) @ towards, ~ground))
    order = order[seen[order]]
    flat: Any = np.stack([triangles[..., 0], triangles @ up], axis=-1)[order]
    shaded = colours[order] * light[order, None]
    axes.add_collection(PolyCollection(flat, facecolors=shaded, edgecolors=shaded, linewidths=0.2))
    axes.set(
        xlim=(flat[..., 0].min(), flat[..., 0].max()),
        ylim=(flat[..., 1].min(), flat[..., 1].max()),
        aspect="equal",
    )
