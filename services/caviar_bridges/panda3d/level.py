"""Panda3D behind the world ``panda3d``: its axes, its configuration, and the level as scenery.

Panda3D is imported by the functions that need it. Nothing of it is global here but its configuration: no
window, no task manager, no clock.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from functools import cache
from itertools import chain, count
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError, SetupError, suggestion
from caviar_protocol.host import install_command
from caviar_protocol.space.coordinates import Vector
from caviar_services.sensors.shading import shape_colour
from caviar_space.engine_axes import EngineAxes
from caviar_space.meshes import Mesh
from caviar_space.mitsuba_xml import ITU_MATERIALS, RadioMaterial, read_scenery, scenery_files, world_mesh

PANDA3D = EngineAxes(
    "panda3d",
    world=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    body=((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
)
"""Right-handed metres, z up: the world's axes are ENU; a body looks along +y, with +x to its right."""

_CONFIGURATION = """\
load-display p3tinydisplay
audio-library-name null
notify-level error
model-cache-dir
"""
# The software renderer needs no libraries of the system; a cache of models would write into the home folder.


@cache
def panda3d_core() -> ModuleType:
    """Import ``panda3d.core``, configured to render without a display.

    Raises:
        SetupError: Panda3D is not installed.
    """
    try:
        from panda3d import core
    except ImportError as error:
        raise SetupError(
            f"Panda3D, the engine of this world, is not installed; run: {install_command('panda3d')}"
        ) from error
    core.loadPrcFileData("caviar", _CONFIGURATION)
    return core  # type: ignore[no-any-return]


class Level(NamedTuple):
    """Geometry that stands still in the engine."""

    node: Any
    """``NodePath`` of the geometry."""
    assets: Mapping[str, bytes]
    """The same for the other services: a Mitsuba XML and its meshes by asset name; empty where the geometry
    came from such files."""


def empty_level() -> Level:
    """A level without anything in it."""
    return Level(panda3d_core().NodePath("level"), {})


def level_of_scenery(xml: Path) -> Level:
    """Load scenery that other worlds bring, too, into the engine.

    Args:
        xml: A Mitsuba XML.

    Raises:
        AssetError: The description or a mesh is wrong.
    """
    core = panda3d_core()
    level = empty_level()
    for shape in read_scenery(xml).shapes:
        node = level.node.attachNewNode(geom_node(core, shape.name, world_mesh(shape)))
        node.setColor(*srgb_of(shape_colour(shape, {})), 1.0)
    level.node.setTwoSided(True)  # meshes of scenery are often open sheets
    return level


def level_of_model(file: Path, material: str) -> Level:
    """Load a model, and export its geometry for the other services.

    Each geometry becomes a shape with the name of its node. The tag ``material`` of the node, or of one
    above it, is the radio material.

    Args:
        file: In a format that Panda3D loads: ``.egg``, ``.bam``, …
        material: Of nodes without such a tag.

    Raises:
        AssetError: The file cannot be loaded, holds no triangles, or names a material that ITU-R P.2040 does
            not have.
    """
    core = panda3d_core()
    loaded = core.Loader.getGlobalPtr().loadSync(core.Filename.fromOsSpecific(str(file)))
    if loaded is None:
        raise AssetError(f"Panda3D cannot load the model {file}; export it as .egg or .bam")
    node = core.NodePath(loaded)
    shapes: dict[str, tuple[Mesh, str, Vector]] = {}
    for name, mesh, tag, colour in _geometries(core, node):
        radio = tag or material
        if radio not in ITU_MATERIALS:
            raise AssetError(
                f"{file}: node {name!r} has the material {radio!r}, which ITU-R P.2040 does not have; "
                f"{suggestion(radio, ITU_MATERIALS)}"
            )
        shapes[name] = mesh, radio, colour
    if not shapes:
        raise AssetError(f"{file}: the model has no triangles; export its meshes")
    return Level(node, _described(file.stem, shapes))


def _geometries(core: ModuleType, level: Any) -> Iterator[tuple[str, Mesh, str, Vector]]:
    """Name, mesh in world axes [m], material tag and linear colour of each geometry of a model."""
    taken: set[str] = set()
    for node in level.findAllMatches("**/+GeomNode"):
        matrix = node.getMat(level)
        for index in range(node.node().getNumGeoms()):
            base = _shape_name(node)
            numbered = (f"{base}-{number}" for number in count(1))
            name = next(name for name in chain([base], numbered) if name not in taken)
            taken.add(name)
            geom = node.node().getGeom(index).decompose()
            # Panda3D multiplies row vectors from the left; its world axes are those of the run.
            vertices = [
                tuple(matrix.xformPoint(point)) for point in _column(core, geom.getVertexData(), "vertex")
            ]
            faces = [
                [primitive.getVertex(corner + k) for k in range(3)]
                for primitive in geom.getPrimitives()
                for corner in range(0, primitive.getNumVertices(), 3)
            ]
            if faces:
                mesh = Mesh(np.array(vertices), np.array(faces, dtype=np.int32))
                yield name, mesh, node.getNetTag("material"), _colour(core, node.node(), index)


def _shape_name(node: Any) -> str:
    """Name of the nearest node above that has one, of characters that file names may have."""
    while not node.getName() and node.hasParent():
        node = node.getParent()
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", node.getName()).strip(".-") or "level"


def _column(core: ModuleType, data: Any, name: str) -> Iterator[Any]:
    reader = core.GeomVertexReader(data, name)
    while reader.hasColumn() and not reader.isAtEnd():
        yield reader.getData4() if name == "color" else reader.getData3()


def _colour(core: ModuleType, node: Any, index: int) -> Vector:
    """Mean colour of a geometry, linear sRGB."""
    attribute = node.getGeomState(index).getAttrib(core.ColorAttrib)
    if attribute is not None and attribute.getColorType() == core.ColorAttrib.T_flat:
        shown = np.array(attribute.getColor())[:3]
    else:
        corners = [
            tuple(colour)[:3] for colour in _column(core, node.getGeom(index).getVertexData(), "color")
        ]
        shown = np.mean(corners, axis=0) if corners else np.ones(3)
    red, green, blue = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4).tolist()
    return (red, green, blue)


def _described(name: str, shapes: Mapping[str, tuple[Mesh, str, Vector]]) -> dict[str, bytes]:
    """A Mitsuba XML of shapes, with their meshes, by asset name."""
    looks = sorted({(radio, colour) for _, radio, colour in shapes.values()})
    keys = {look: f"{look[0]}-{index}" for index, look in enumerate(looks)}
    materials = {key: RadioMaterial(radio, colour=colour) for (radio, colour), key in keys.items()}
    placed = {shape: (mesh, keys[radio, colour]) for shape, (mesh, radio, colour) in shapes.items()}
    return scenery_files(name, placed, materials)


def geom_node(core: ModuleType, name: str, mesh: Mesh) -> Any:
    """Make a mesh as the engine draws it: flat faces, each with corners of its own.

    Args:
        core: ``panda3d.core``.
        name: Of the node.
        mesh: In axes of the engine.

    Returns:
        A ``GeomNode``.
    """
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    rows = np.concatenate([corners, np.repeat(normals[:, None], 3, axis=1)], axis=2).reshape(-1, 6)
    data = core.GeomVertexData(name, core.GeomVertexFormat.getV3n3(), core.Geom.UHStatic)
    data.uncleanSetNumRows(len(rows))
    data.modifyArrayHandle(0).copyDataFrom(rows.astype("<f4").tobytes())
    triangles = core.GeomTriangles(core.Geom.UHStatic)
    triangles.addNextVertices(len(rows))
    triangles.closePrimitive()
    geom = core.Geom(data)
    geom.addPrimitive(triangles)
    node = core.GeomNode(name)
    node.addGeom(geom)
    return node


def srgb_of(linear: Float64Array | Vector) -> Vector:
    """Encode a linear colour as Panda3D has colours, which its software renderer shows as they are.

    Args:
        linear: Linear sRGB, 0…1.
    """
    values = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    red, green, blue = np.where(
        values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055
    ).tolist()
    return (red, green, blue)
