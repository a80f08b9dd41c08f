"""Scenes of Mitsuba and of Sionna RT, as Blender's exporter writes them, with shapes that no run reads."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from caviar_space.imported_scenes import ImportedScene
from caviar_space.meshes import Mesh, box
from caviar_space.mitsuba_xml import RadioBsdf, RadioMaterial, SceneryShape, read_scenery, world_mesh
from caviar_space.sources import Request
from caviar_space.sources.mesh_files import wavefront
from caviar_space.sources.pieces import Colour, SceneBuilder, moved, reading

# [m]; Sionna RT's, where a description gives a material none.
_THICKNESS_M = 0.1


def read_mitsuba(path: Path, request: Request) -> ImportedScene:
    """Read a scene of Mitsuba as a scene; see `caviar_space.sources.Reader`.

    Materials keep their constants; those for cameras alone get some by their names.
    """
    builder = SceneBuilder(path, request)
    builder.read(path)
    scenery = read_scenery(path, kinds=("ply", "obj", "rectangle", "cube"))
    for number, shape in enumerate(scenery.shapes, 1):
        request.progress(shape.name, number / len(scenery.shapes))
        if shape.kind in ("ply", "obj"):
            builder.read(shape.file)
        with reading(shape.place, "a shape of Mitsuba"):
            mesh = _mesh(shape)
        if shape.radio is not None:
            material = builder.keep(shape.radio.name, _constants(shape.radio, shape.colour))
        else:
            material = builder.material(shape.material.removeprefix("mat-"), shape.colour)
        vertices = builder.upright(mesh.vertices)
        builder.add(shape.name, vertices, mesh.faces, material, "object", path, number)
    return builder.finish()


def _mesh(shape: SceneryShape) -> Mesh:
    match shape.kind:
        case "ply":
            return world_mesh(shape)
        case "obj":
            found = wavefront(shape.file)
            vertices, faces = found.vertices, np.concatenate(list(found.faces.values()))
        case "cube":
            cube = box((-1, 1), (-1, 1), (-1, 1))
            vertices, faces = cube.vertices.astype(np.float64), cube.faces.astype(np.int64)
        case _:
            vertices = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
            faces = np.array([[0, 1, 2], [0, 2, 3]])
    vertices, faces = moved(shape.to_world, vertices, faces)
    return Mesh(vertices, faces.astype(np.int32))


def _constants(radio: RadioBsdf, colour: Colour | None) -> RadioMaterial:
    element = ElementTree.fromstring(radio.xml)  # noqa: S314 - made of elements that were read
    given = {part.get("name", ""): part.get("value", "") for part in element}
    with reading(radio.place, "a material"):

        def number(name: str, default: float) -> float:
            return float(given.get(name, default))

        constants = number("relative_permittivity", 1.0), number("conductivity", 0.0)
        return RadioMaterial(
            given.get("type", ""),
            number("thickness", _THICKNESS_M),
            colour,
            None if "type" in given else constants,
            number("scattering_coefficient", 0.0),
            number("xpd_coefficient", 0.0),
        )
