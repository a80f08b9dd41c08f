"""Scenery in Sionna RT: loaded, joined to one shape a material, with as much detail as asked for.

Faces are as the ray tracer has them, vertices as they stand in the files: it keeps them in float32 only.
"""

from __future__ import annotations

import gc
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError, ScenarioError
from caviar_protocol.space.ply import read_ply
from caviar_services.channel.mesh_detail import DetailEffect, DetailSettings, detailed
from caviar_services.channel.sionna.materials import any_frequency, freeze
from caviar_services.mesh.scenery import SceneryShape, asset_name, read_scenery
from caviar_services.mesh.shapes import Mesh, unit_box
from caviar_services.ray_tracing import aligned_columns

# By how much of its size a mesh in float32 may differ from its file.
_SAME_VERTEX = 1e-5


@dataclass(frozen=True, eq=False)
class Shape:
    """One shape of the ray tracer: pieces of one material."""

    id: str
    material: Any
    names: list[str]
    meshes: list[Mesh]


def file_vertices(description: Path) -> dict[str, Float64Array]:
    """World vertices [m] of a scenery's shapes as they stand in its files, by name.

    Raises `AssetError` naming what is wrong with the description, a material or a mesh.
    """
    vertices = {}
    for shape in read_scenery(description, asset_name(description)).shapes:
        _check_material(shape)
        turned, moved = shape.to_world[:3, :3], shape.to_world[:3, 3]
        # Faces are read to be checked: of one that names a vertex that is not there the ray tracer dies.
        found, _ = read_ply(shape.file, f"{shape.place}: mesh {shape.file.name}")
        vertices[shape.name] = found @ turned.T + moved
    return vertices


def _check_material(shape: SceneryShape) -> None:
    """Refuse a shape that has nothing to reflect radio waves with."""
    if not shape.itu_material and not shape.material_type.endswith("radio-material"):
        named = f"material {shape.material!r} of type {shape.material_type!r}"
        raise AssetError(
            f"{shape.place} has {named if shape.material else 'no material'}, of which the ray tracer has no "
            "radio constants; give it one of ITU-R P.2040, such as <bsdf type='itu-radio-material' "
            "id='itu_concrete'><string name='type' value='concrete'/></bsdf>"
        )


def file_meshes(scene: Any, vertices: Mapping[str, Float64Array]) -> dict[str, Mesh]:
    """The meshes of what was loaded, by name, in world coordinates."""
    meshes = {}
    for name, item in scene.objects.items():
        mesh = _mesh_of(item.mi_mesh)
        meshes[name] = _as_in_file(mesh, vertices[name]) if name in vertices else mesh
    return meshes


def _as_in_file(mesh: Mesh, vertices: Float64Array) -> Mesh:
    """A mesh with its vertices in float64, unless the ray tracer took others than the file's."""
    same = vertices.shape == mesh.vertices.shape
    if same and len(vertices):
        same = bool(np.abs(vertices - mesh.vertices).max() <= _SAME_VERTEX * max(np.abs(vertices).max(), 1.0))
    return Mesh(vertices, mesh.faces) if same else mesh


def unit_mesh(asset: str, assets: Mapping[str, Path]) -> Mesh:
    import mitsuba as mi

    if not asset:
        return unit_box()
    path = assets.get(asset)
    if path is None:
        known = ", ".join(sorted(name for name in assets if name.startswith("objects/"))) or "none"
        raise AssetError(f"there is no mesh {asset!r} among the assets; object meshes: {known}")
    vertices, _ = read_ply(path, f"mesh {asset!r}")
    try:
        loaded = _mesh_of(mi.load_dict({"type": "ply", "filename": str(path), "face_normals": True}))
    except RuntimeError as error:
        raise AssetError(f"mesh {asset!r} ({path}) cannot be read: {error}") from error
    return _as_in_file(loaded, vertices)


def _mesh_of(shape: Any) -> Mesh:
    import mitsuba as mi

    params = mi.traverse(shape)
    return Mesh(
        np.array(params["vertex_positions"], np.float64).reshape(-1, 3),
        np.array(params["faces"], np.int32).reshape(-1, 3),
    )


def mi_mesh(shape: Shape, centre: Float64Array) -> Any:
    """A shape as the ray tracer has it, relative to ``centre`` [m]."""
    import mitsuba as mi

    counts = np.array([len(mesh.vertices) for mesh in shape.meshes])
    before = np.cumsum(counts) - counts
    faces = np.concatenate([mesh.faces + begin for mesh, begin in zip(shape.meshes, before, strict=True)])
    properties = mi.Properties()
    properties.set_id(shape.id)
    properties["face_normals"] = True
    made = mi.Mesh(shape.id, int(counts.sum()), len(faces), props=properties)
    params = mi.traverse(made)
    params["vertex_positions"] = floats(np.concatenate([mesh.vertices for mesh in shape.meshes]) - centre)
    params["faces"] = mi.UInt(np.ascontiguousarray(faces, np.uint32).ravel())
    params.update()
    return made


def floats(vertices: Float64Array) -> Any:
    """Coordinates, Shape ``[V, 3]``, as the ray tracer has them."""
    import mitsuba as mi

    (column,) = aligned_columns(vertices.reshape(1, -1))
    return mi.Float(column)


def loaded(description: Path | None) -> Any:
    """The `sionna.rt.Scene` of a description, or an empty one.

    Raises `AssetError` where the ray tracer cannot take it.
    """
    from sionna.rt import load_scene

    # A scene refers to itself. Until one without other references is collected, kernels branch over what is
    # in it too, and are compiled anew.
    gc.collect()
    try:
        with any_frequency():
            scene = load_scene(None if description is None else str(description), merge_shapes=False)
    except (ValueError, TypeError, RuntimeError) as error:
        raise AssetError(f"{asset_name(description)}: the ray tracer cannot load it: {error}") from error
    freeze(scene)
    return scene


def by_material(scene: Any, meshes: Mapping[str, Mesh], changed: Mapping[str, Any]) -> list[Shape]:
    """Meshes of what was loaded, by name, joined to one shape a material; ``changed`` has the materials of
    pieces that are given another one than the scenery's."""
    groups: dict[str, Shape] = {}
    for name, mesh in meshes.items():
        material = changed.get(name, scene.objects[name].radio_material)
        group = groups.setdefault(material.name, Shape(f"caviar-scenery-{material.name}", material, [], []))
        group.names.append(name)
        group.meshes.append(mesh)
    return list(groups.values())


def with_detail(
    shapes: list[Shape], detail: DetailSettings, key: str
) -> tuple[list[Shape], DetailEffect | None]:
    """Scenery with this detail, and what that did to it; None where nothing was to be left out.

    ``key`` is where the detail stands in the scenario.

    Raises `ScenarioError` where nothing would be left.
    """
    if detail.is_full:
        return shapes, None
    pieces = [piece for shape in shapes for piece in zip(shape.names, shape.meshes, strict=True)]
    kept, effect = detailed(pieces, detail)
    if pieces and not kept:
        raise ScenarioError(
            f"{detail} leaves out all of the scenery; leave out less",
            key=key,
        )
    left = dict(kept)
    return [
        Shape(shape.id, shape.material, names, [left[name] for name in names])
        for shape in shapes
        if (names := [name for name in shape.names if name in left])
    ], effect
