"""Scenery and moving bodies in Sionna RT: loaded once, moved in one update a frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array, Int32Array, Int64Array
from caviar_protocol.errors import AssetError, PayloadError
from caviar_protocol.scene import object_pose
from caviar_protocol.topics import Scene
from caviar_services.channel.sionna_materials import MaterialSettings, OutsideRange, set_materials
from caviar_services.meshes import BodyPool, Mesh, box, placed, unit_box
from caviar_services.scenery import find_scenery, read_scenery

Body = tuple[str, int]
"""Asset and slot of a body in the pool."""

PARKING_DEPTH = 2000.0
"""Unused receivers stand this far [m] below the scenery, in a closed metal box of their own."""

_PARKING = "caviar-parking"
_HALF_BOX = 4.0
"""[m]; more than the part of a shadow ray near its end that is not tested (9e-4 of its length)."""


@dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """What the scene is made with."""

    frequency_hz: float
    body_material: str
    materials: Mapping[str, MaterialSettings]
    outside_itu_range: OutsideRange
    weld: bool
    """Join vertices at one place, so that edges between faces are known (diffraction)."""


class SionnaScene:
    """A `sionna.rt.Scene` with a pool of bodies for moving objects.

    Bodies that stand for no object are shrunk to a point: a triangle without area is never hit.
    """

    def __init__(self, assets: Mapping[str, Path], pool: Mapping[str, int], settings: SceneSettings) -> None:
        self._scene = _load(find_scenery(assets), settings.weld)
        scenery = list(self._scene.objects)
        self.low, self.high = _bounds(self._scene) if scenery else (np.zeros(3), np.zeros(3))
        self._pool = BodyPool(pool)
        self._meshes = {asset: _unit_mesh(asset, assets) for asset in pool}
        self._bodies: list[Body] = [(asset, slot) for asset in sorted(pool) for slot in range(pool[asset])]
        self._add_bodies(settings.body_material)
        set_materials(self._scene, settings.frequency_hz, settings.materials, settings.outside_itu_range)
        self._names = (*scenery, _PARKING, *(_body_name(body) for body in self._bodies))
        self._scenery = frozenset(scenery)
        objects = self._scene.objects
        ids = np.array([objects[name].object_id for name in self._names], np.int64)
        self._by_id = np.argsort(ids)
        self._ids = ids[self._by_id]
        self._standing: frozenset[Body] = frozenset()

    @property
    def mi_scene(self) -> Any:
        """The Mitsuba scene."""
        return self._scene.mi_scene

    @property
    def parking(self) -> Float64Array:
        """Where unused receivers stand [m], Shape ``[3]``."""
        middle = (self.low + self.high) / 2
        return np.array([middle[0], middle[1], self.low[2] - PARKING_DEPTH])

    def place(self, scene: Scene, without_body: frozenset[str]) -> tuple[tuple[str, ...], Float64Array]:
        """Move the bodies to the objects of a scene, in one update.

        Returns the names that the indices of `object_index` stand for, and their velocities [m/s],
        Shape ``[len(names), 3]``.

        Raises `PayloadError` where the pool is too small, or an object has the name of a piece of scenery.
        """
        solid = [i for i, cls in enumerate(scene.classes) if cls not in without_body]
        index = {scene.names[i]: i for i in solid}
        clash = self._scenery & index.keys()
        if clash:
            raise PayloadError(f"object {min(clash)!r} has the name of a piece of scenery; rename one")
        taken = self._pool.assign((scene.names[i], scene.assets[i]) for i in solid)
        standing = {body: index[name] for name, body in taken.items()}
        params = self._scene.mi_scene_params
        names, velocity = list(self._names), np.zeros((len(self._names), 3))
        first = len(names) - len(self._bodies)
        for offset, body in enumerate(self._bodies):
            i = standing.get(body)
            if i is not None:
                vertices = placed(self._meshes[body[0]], scene.dimensions[i], object_pose(scene, i))
                params[f"{_body_name(body)}.vertex_positions"] = _floats(vertices)
                names[first + offset] = scene.names[i]
                velocity[first + offset] = scene.velocity[i]
            elif body in self._standing:
                params[f"{_body_name(body)}.vertex_positions"] = _floats(self._shrunk(body))
        if standing or self._standing:
            params.update()
        self._standing = frozenset(standing)
        return tuple(names), velocity

    def object_index(self, shapes: Int64Array) -> Int32Array:
        """Index into the names of `place` of each process-local shape id; −1 for no shape."""
        where = np.minimum(np.searchsorted(self._ids, shapes), len(self._ids) - 1)
        found = self._ids[where] == shapes
        return np.where(found, self._by_id[where], -1).astype(np.int32)

    def _shrunk(self, body: Body) -> Float64Array:
        centre = (self.low + self.high) / 2
        return np.broadcast_to(centre, self._meshes[body[0]].vertices.shape)

    def _add_bodies(self, material: str) -> None:
        from sionna.rt import ITURadioMaterial, RadioMaterial, SceneObject

        metal = RadioMaterial("caviar-parking-wall", conductivity=1e7)
        x, y, z = self.parking
        h = _HALF_BOX
        parking = box((x - h, x + h), (y - h, y + h), (z - h, z + h))
        added = [SceneObject(mi_mesh=_mi_mesh(_PARKING, parking, parking.vertices), radio_material=metal)]
        if self._bodies:
            skin = ITURadioMaterial("caviar-body", material, 0.1)
            for body in self._bodies:
                mesh = _mi_mesh(_body_name(body), self._meshes[body[0]], self._shrunk(body))
                added.append(SceneObject(mi_mesh=mesh, radio_material=skin))
        self._scene.edit(add=added)


def _load(description: Path | None, weld: bool) -> Any:
    from sionna.rt import load_scene

    if description is not None:
        read_scenery(description)  # says what is wrong with a file before the renderer does
    try:
        # Merged shapes would lose the names that paths refer to.
        return load_scene(
            None if description is None else str(description),
            merge_shapes=False,
            remove_duplicate_vertices=weld,
        )
    except (ValueError, TypeError, RuntimeError) as error:
        raise AssetError(f"{description}: the ray tracer cannot load it: {error}") from error


def _bounds(scene: Any) -> tuple[Float64Array, Float64Array]:
    box = scene.mi_scene.bbox()
    return np.array(box.min, np.float64).reshape(3), np.array(box.max, np.float64).reshape(3)


def _body_name(body: Body) -> str:
    return f"caviar-body-{body[0] or 'box'}-{body[1]}".replace(".", "_")


def _unit_mesh(asset: str, assets: Mapping[str, Path]) -> Mesh:
    import mitsuba as mi

    if not asset:
        return unit_box()
    path = assets.get(asset)
    if path is None:
        known = ", ".join(sorted(name for name in assets if name.startswith("objects/"))) or "none"
        raise AssetError(f"there is no mesh {asset!r} among the assets; object meshes: {known}")
    try:
        shape = mi.load_dict({"type": "ply", "filename": str(path), "face_normals": True})
    except RuntimeError as error:
        raise AssetError(f"mesh {asset!r} ({path}) cannot be read: {error}") from error
    params = mi.traverse(shape)
    return Mesh(
        np.array(params["vertex_positions"], np.float64).reshape(-1, 3),
        np.array(params["faces"], np.int32).reshape(-1, 3),
    )


def _mi_mesh(name: str, mesh: Mesh, vertices: Float64Array) -> Any:
    import mitsuba as mi

    properties = mi.Properties()
    properties.set_id(name)
    properties["face_normals"] = True
    made = mi.Mesh(name, len(mesh.vertices), len(mesh.faces), props=properties)
    params = mi.traverse(made)
    params["vertex_positions"] = _floats(vertices)
    params["faces"] = mi.UInt(np.ascontiguousarray(mesh.faces, np.uint32).ravel())
    params.update()
    return made


def _floats(vertices: Float64Array) -> Any:
    import mitsuba as mi

    return mi.Float(np.ascontiguousarray(vertices, np.float32).ravel())
