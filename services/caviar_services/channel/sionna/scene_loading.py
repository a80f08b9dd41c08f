"""Scenery in Sionna RT: loaded, joined to one shape a material, with as much detail as asked for.

Faces are as the ray tracer has them, vertices as they stand in the files: it keeps them in float32 only.
"""

from __future__ import annotations

import gc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError, ScenarioError
from caviar_protocol.messages import WARNING
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


# [m]; the centre is a multiple of it, so that a scene about the origin stays as it is.
_CENTRE_STEP = 128.0

# [m]; float32 has a step of 8 mm at this distance: what is farther from the centre is traced too coarsely.
_FARTHEST = 1e5


def near_middle(low: Float64Array, high: Float64Array) -> Float64Array:
    """Multiples of `_CENTRE_STEP` next to the middle of a box [m], Shape ``[3]``; no negative zeros."""
    middle: Float64Array = np.round((low + high) / (2 * _CENTRE_STEP)) * _CENTRE_STEP + 0.0
    return middle


def bounds(shapes: Sequence[Shape]) -> tuple[Float64Array, Float64Array]:
    """Lowest and highest corner [m] of all shapes, Shape ``[3]`` each; the origin where there are none."""
    low, high = _boxes(shapes)
    return (low.min(0), high.max(0)) if len(low) else (np.zeros(3), np.zeros(3))


def _boxes(shapes: Sequence[Shape]) -> tuple[Float64Array, Float64Array]:
    """Lowest and highest corner [m] of each piece, Shape ``[N, 3]`` each."""
    vertices = [mesh.vertices for shape in shapes for mesh in shape.meshes if len(mesh.vertices)]
    low = np.array([corners.min(0) for corners in vertices]).reshape(-1, 3)
    return low, np.array([corners.max(0) for corners in vertices]).reshape(-1, 3)


def counting_centre(shapes: Sequence[Shape]) -> tuple[Float64Array, str]:
    """Choose where the ray tracer, which has float32 only, counts from.

    It is the middle of the scenery, or of most of it where some pieces are so far away that all others would
    be coarse: with one triangle at 1e8 m, a step of float32 is 4 m, and rays pass through vehicles.

    Args:
        shapes: The scenery.

    Returns:
        The centre [m], Shape ``[3]``, and a warning that names the farthest piece, empty where none is far.
    """
    low, high = _boxes(shapes)
    if not len(low) or (high.max(0) - low.min(0)).max() <= 2 * _FARTHEST:
        return near_middle(*bounds(shapes)), ""
    most = np.median((low + high) / 2, axis=0)
    reach = np.maximum(np.abs(low - most), np.abs(high - most)).max(1)
    near = reach <= max(_FARTHEST, reach.min())
    centre = near_middle(low[near].min(0), high[near].max(0))
    names = [
        name
        for shape in shapes
        for name, mesh in zip(shape.names, shape.meshes, strict=True)
        if len(mesh.vertices)
    ]
    far = int(np.maximum(np.abs(low - centre), np.abs(high - centre)).max(1).argmax())
    step = np.spacing(np.float32(reach[far]))
    return centre, (
        f"{WARNING}the piece {names[far]!r} of the scenery reaches from {_place(low[far])} to "
        f"{_place(high[far])}, where the ray tracer counts in steps of {step:.2g} m: paths by way of it are "
        "wrong by as much; move it nearer, or leave it out"
    )


def _place(corner: Float64Array) -> str:
    return f"({', '.join(f'{c:g}' for c in corner)}) m"
