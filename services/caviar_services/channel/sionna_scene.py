"""Scenery and moving bodies in Sionna RT: loaded once, moved in one update a frame.

Every further shape makes each trace a millisecond longer, whatever its size. So there is one
shape for each material, and a table that says which triangles belong to what; paths still name the
single building and vehicle.

The ray tracer counts in float32, whose step is 1 mm at 10 km. So it is given the scene relative to
`SionnaScene.centre`, and what its paths meet is told to callers in float64 and in world coordinates: the
scenery's corners as they stand in the files, and those of moving bodies from their poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_protocol.coordinates import SPEED_OF_LIGHT
from caviar_protocol.errors import AssetError, PayloadError, ScenarioError
from caviar_protocol.scene import object_pose
from caviar_protocol.topics import Scene
from caviar_services.channel.clearance import Surfaces
from caviar_services.channel.contributing import SurfaceMaterial, UsedSurfaces, edges_of, has_edge
from caviar_services.channel.edge_fields import Media
from caviar_services.channel.mesh_detail import DetailEffect, DetailSettings, detailed
from caviar_services.channel.sionna_materials import (
    Constants,
    MaterialPolicy,
    OutsideUse,
    any_frequency,
    freeze,
    itu_material,
    itu_materials,
    set_materials,
)
from caviar_services.channel.sionna_meshes import file_meshes, file_vertices, unit_mesh
from caviar_services.channel.sionna_planes import PlaneTable, plane_numbers, shared_planes
from caviar_services.columns import aligned_columns
from caviar_services.meshes import BodyPool, Mesh, box, placed
from caviar_services.scenery import find_scenery

_Tuning = tuple[float, list[tuple[Any, Constants]]]
"""Frequency [Hz] of a carrier, and what is to be set at materials."""

Body = tuple[str, int]
"""Asset and slot of a body in the pool."""

PARKING_DEPTH = 2000.0
"""Unused receivers stand this far [m] below the scenery, in a closed metal box of their own."""

_HALF_BOX = 4.0
"""[m]; more than the part of a shadow ray near its end that is not tested (9e-4 of its length)."""

_CENTRE_STEP = 128.0
"""[m]; the centre is a multiple of it, so that a scene about the origin stays as it is."""

_LYING = 0.5
"""Vertical part of the normal of grounds and roofs, at least."""

_PARKING = "caviar-parking"
_SKIN = "caviar-body"

_SKIN_NAME = "body_material"
_OTHER_SKIN = "choose another body_material"


@dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """What the scene is made with."""

    frequencies_hz: tuple[float, ...]
    """Of the carriers. The scene is at the first one, unless it is tuned to another."""
    body_material: str
    materials: MaterialPolicy
    weld: bool
    """Join vertices at one place, so that edges between faces are known (diffraction)."""
    detail: DetailSettings = field(default_factory=DetailSettings)
    """What of the scenery is left out."""


@dataclass(frozen=True, eq=False)
class _Shape:
    """One shape of the ray tracer: pieces of one material."""

    id: str
    material: Any
    names: list[str]
    meshes: list[Mesh]


class SionnaScene:
    """A `sionna.rt.Scene` with a pool of bodies for moving objects.

    Bodies that stand for no object are shrunk to a point: a triangle without area is never hit.
    """

    def __init__(self, assets: Mapping[str, Path], pool: Mapping[str, int], settings: SceneSettings) -> None:
        bodied = any(pool.values())
        skins = [
            itu_material(_SKIN_NAME, settings.body_material, frequency, settings.materials, _OTHER_SKIN)
            for frequency in settings.frequencies_hz
            if bodied
        ]
        description = find_scenery(assets)
        files = {} if description is None else file_vertices(description)  # says what is wrong with a file
        self._scene = _load(description)
        self._scenery = frozenset(self._scene.objects)
        loaded = _by_material(self._scene, file_meshes(self._scene, files, settings.weld))
        shapes, self.detail_effect = _with_detail(loaded, settings)
        self.low, self.high = _bounds(shapes)
        self.centre: Float64Array = np.round((self.low + self.high) / (2 * _CENTRE_STEP)) * _CENTRE_STEP
        """What the ray tracer's coordinates are relative to [m], Shape ``[3]``."""
        self._pool = dict(pool)
        self._meshes = {asset: unit_mesh(asset, assets) for asset in pool}
        self._bodies: list[Body] = [(asset, slot) for asset in sorted(pool) for slot in range(pool[asset])]
        self._standing: frozenset[Body] = frozenset()
        self.version = 0
        """Counts how often anything has moved."""
        moving = self._moving_shapes(skins[0].constants if skins else None, settings.body_material == "metal")
        moved = sum(len(mesh.vertices) for mesh in moving[-1].meshes)
        self._shapes = [*shapes, *moving]
        self._replace_shapes(self._shapes)
        self._vertices = self._corners[len(self._corners) - moved :]
        self._first_moving = len(self._faces) - sum(len(mesh.faces) for mesh in moving[-1].meshes)
        self.surfaces = Surfaces(self._corners[self._faces], self._points_outside)
        """All triangles, in world coordinates."""
        set_materials(self._scene, settings.frequencies_hz[0], settings.materials)
        self._carriers: list[_Tuning] = []
        outside: list[OutsideUse] = []
        for carrier, frequency in enumerate(settings.frequencies_hz):
            found = itu_materials(self._scene, frequency, settings.materials)
            used = [(material.name, itu, constants) for material, itu, constants in found]
            tuning = [(material, constants) for material, _, constants in found]
            if skins:
                used.append((_SKIN_NAME, skins[carrier], skins[carrier].constants))
                tuning.append((moving[-1].material, skins[carrier].constants))
            self._carriers.append((frequency, tuning))
            outside += [
                OutsideUse(name=name, carrier=carrier, itu=itu, constants=constants)
                for name, itu, constants in used
                if itu.is_outside
            ]
        self.outside = tuple(outside)
        """Materials used where they are not defined, by carrier."""

    @property
    def mi_scene(self) -> Any:
        """The Mitsuba scene, in metres relative to `centre`."""
        return self._scene.mi_scene

    @property
    def wavelengths(self) -> tuple[float, ...]:
        """Of the carriers [m]."""
        return tuple(SPEED_OF_LIGHT / frequency for frequency, _ in self._carriers)

    def tune(self, carrier: int) -> None:
        """Set frequency and materials to those of a carrier."""
        frequency, constants = self._carriers[carrier]
        for material, (permittivity, conductivity) in constants:
            material.relative_permittivity, material.conductivity = permittivity, conductivity
        self._scene.frequency = frequency

    def used_surfaces(self) -> UsedSurfaces:
        """What waves can meet, at rest and moving; unwelded scenery has no edges."""
        constants, slabs = self._surface_materials
        used = [(i, shape) for i, shape in enumerate(self._shapes) if shape.id != _PARKING]
        shapes = [shape for _, shape in used]
        still = [mesh for shape in shapes if shape.id != _SKIN for mesh in shape.meshes]
        bodies = [mesh for asset, mesh in self._meshes.items() if self._pool[asset]]
        return UsedSurfaces(
            materials=tuple(
                SurfaceMaterial(
                    name=_SKIN_NAME if shape.id == _SKIN else shape.material.name,
                    constants=tuple((float(p), float(c)) for p, c in constants[:, :, i].T),
                    thickness_m=float(slabs[0, i]),
                    scattering_coefficient=float(slabs[1, i]),
                )
                for i, shape in used
            ),
            has_edges=any(has_edge(mesh) for mesh in [*still, *bodies]),
        )

    @cached_property
    def _surface_materials(self) -> tuple[Float64Array, Float64Array]:
        """Of each shape, permittivity and conductivity [S/m] on each carrier, Shape ``[2, C, S]``, and
        thickness [m] and scattering coefficient, Shape ``[2, S]``."""
        constants = []
        for carrier in range(len(self._carriers)):
            self.tune(carrier)
            constants.append([_constants(shape.material) for shape in self._shapes])
        self.tune(0)
        slabs = [
            (float(material.thickness[0]), float(material.scattering_coefficient[0]))
            for material in (shape.material for shape in self._shapes)
        ]
        return np.moveaxis(np.array(constants), -1, 0), np.array(slabs).T

    def media(self, shapes: Int64Array) -> Media:
        """What process-local shapes are made of; anything for no shape."""
        of = self._shape_order[self._where(shapes)]
        constants, slabs = self._surface_materials
        return Media(*constants[..., of], *slabs[:, of])

    @property
    def edges(self) -> Float64Array:
        """Both ends of every edge between two faces, as it stands [m], Shape ``[E, 2, 3]``; those of bodies
        that stand for nothing have no length."""
        return self._corners[self._edge_corners]

    @cached_property
    def _edge_corners(self) -> Int64Array:
        meshes = [mesh for shape in self._shapes for mesh in shape.meshes]
        bodies = [self._meshes[asset] for asset, _ in self._bodies]
        still = len(meshes) - len(bodies)
        found, begin = [np.zeros((0, 2), np.int64)], 0
        for name, mesh in zip(self.names, [*meshes[:still], *bodies], strict=True):
            if name != _PARKING:
                found.append(begin + edges_of(mesh))
            begin += len(mesh.vertices)
        return np.concatenate(found)

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
        # A new assignment each frame: the product follows from this frame alone, also after a restart.
        taken = BodyPool(self._pool).assign((scene.names[i], scene.assets[i]) for i in solid)
        standing = {body: index[name] for name, body in taken.items()}
        names, velocity = list(self.names), np.zeros((len(self.names), 3))
        first = len(names) - len(self._bodies)
        begin = len(self._vertices) - sum(len(self._meshes[asset].vertices) for asset, _ in self._bodies)
        before = self._vertices.copy()
        for number, body in enumerate(self._bodies, start=first):
            mesh = self._meshes[body[0]]
            rows = slice(begin, begin + len(mesh.vertices))
            begin = rows.stop
            i = standing.get(body)
            if i is not None:
                self._vertices[rows] = placed(mesh, scene.dimensions[i], object_pose(scene, i))
                names[number], velocity[number] = scene.names[i], scene.velocity[i]
            elif body in self._standing:
                self._vertices[rows] = self._middle
        if not np.array_equal(before, self._vertices):
            self.version += 1
            params = self._scene.mi_scene_params
            params[f"{_SKIN}.vertex_positions"] = _floats(self._vertices - self.centre)
            params.update()
            self.plane_table.update(self._corners - self.centre, self._moving_plane)
            self.surfaces.move(self._first_moving, self._corners[self._faces[self._first_moving :]])
        self._standing = frozenset(standing)
        return tuple(names), velocity

    def planes(self, shapes: Int64Array, primitives: Int64Array) -> tuple[Float64Array, Float64Array]:
        """A corner [m] and the normal (of any length) of triangles, each of Shape ``[..., 3]``, in float64.

        Anything for no shape.
        """
        a, b, c = np.moveaxis(self.triangles(shapes, primitives), -2, 0)
        return a, np.cross(b - a, c - a)

    def triangles(self, shapes: Int64Array, primitives: Int64Array) -> Float64Array:
        """The corners [m] of triangles, Shape ``[..., 3, 3]``, in float64: those of scenery as they stand in
        its files, those of moving bodies where `place` put them last. Anything for no shape."""
        corners: Float64Array = self._corners[self._faces[self.triangle_numbers(shapes, primitives)]]
        return corners

    def triangle_numbers(self, shapes: Int64Array, primitives: Int64Array) -> Int64Array:
        """Number, through all shapes, of triangles of process-local shapes; anything for no shape."""
        number = self._offsets[self._where(shapes)] + primitives
        clipped: Int64Array = np.clip(number, 0, len(self._faces) - 1)
        return clipped

    def corners(self, triangles: Int64Array) -> Float64Array:
        """Corners of triangles by number [m], Shape ``[..., 3, 3]``; float64."""
        corners: Float64Array = self._corners[self._faces[triangles]]
        return corners

    def shapes_of(self, triangles: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Process-local shape of triangles by number, and their numbers within it."""
        order = np.argsort(self._offsets)
        where = order[np.searchsorted(self._offsets[order], triangles, side="right") - 1]
        return self._ids[where], triangles - self._offsets[where]

    def face_number(self, shapes: Int64Array, primitives: Int64Array) -> Int32Array:
        """Number of the plane of triangles within their object, the same in every frame; anything for no
        shape."""
        return self._face_of[self.triangle_numbers(shapes, primitives)]

    def moved_triangles(
        self, triangles: Int64Array, before: tuple[str, ...], now: tuple[str, ...]
    ) -> Int64Array:
        """Numbers of the same triangles of the same objects, where `place` has given bodies to others since.

        ``before`` and ``now`` are what it returned; −1 where an object has left or has another mesh.
        """
        if before == now:
            return triangles
        first = len(now) - len(self._bodies)
        place = {name: number for number, name in enumerate(now[first:], start=first)}
        piece = np.searchsorted(self._first_triangles, triangles, side="right") - 1
        moved = np.arange(len(now))
        for number, name in enumerate(before[first:], start=first):
            there = place.get(name, -1)
            is_same = there >= 0 and self._bodies[there - first][0] == self._bodies[number - first][0]
            moved[number] = there if is_same else -1
        start = self._first_triangles[moved[piece]] + triangles - self._first_triangles[piece]
        return np.where(moved[piece] >= 0, start, -1)

    def is_body(self, shapes: NDArray[np.uint32]) -> BoolArray:
        """Whether process-local shapes are of moving bodies."""
        body: BoolArray = shapes == self._body_id
        return body

    def object_index(self, shapes: Int64Array, primitives: Int64Array) -> Int32Array:
        """Index into the names of `place` of triangles of process-local shapes; −1 for no shape."""
        where = self._where(shapes)
        piece = np.searchsorted(self._first_triangles, self._offsets[where] + primitives, side="right") - 1
        return np.where(self._ids[where] == shapes, piece, -1).astype(np.int32)

    def is_parking(self, names: tuple[str, ...], objects: Int32Array) -> BoolArray:
        """Which of the objects of paths, Shape ``[P, D]``, are the box around parked receivers.

        Paths by way of it are none: it is not in the world.
        """
        parking: BoolArray = objects == names.index(_PARKING)
        return parking

    def _points_outside(self, triangle: int, normal: Float64Array) -> bool:
        """Whether a triangle's normal points away from its piece, or up from one that lies.

        Scenery has faces of either sense, so their order of corners says nothing.
        """
        piece = int(np.searchsorted(self._first_triangles, triangle, side="right")) - 1
        if triangle < self._first_moving and abs(normal[2]) > _LYING:
            return bool(normal[2] > 0)
        ends = [*self._first_triangles.tolist(), len(self._faces)]
        corners = self._corners[self._faces[ends[piece] : ends[piece + 1]]].reshape(-1, 3)
        middle = (corners.min(0) + corners.max(0)) / 2
        return bool((self._corners[self._faces[triangle, 0]] - middle) @ normal >= 0)

    def _where(self, shapes: Int64Array) -> Int64Array:
        return np.minimum(np.searchsorted(self._ids, shapes), len(self._ids) - 1)

    @property
    def _middle(self) -> Float64Array:
        return (self.low + self.high) / 2

    def _moving_shapes(self, constants: Constants | None, metal: bool) -> list[_Shape]:
        """The box around the parked receivers, and last the moving bodies; one shape where both are metal."""
        from sionna.rt import RadioMaterial

        x, y, z = self.parking
        h = _HALF_BOX
        walls = box((x - h, x + h), (y - h, y + h), (z - h, z + h))
        names = [f"{_SKIN}-{asset or 'box'}-{slot}" for asset, slot in self._bodies]
        bodies = [
            Mesh(np.tile(self._middle, (len(mesh.vertices), 1)), mesh.faces)
            for mesh in (self._meshes[asset] for asset, _ in self._bodies)
        ]
        if constants is not None and metal:
            skin = RadioMaterial(f"{_SKIN}-skin", 0.1, *constants)
            return [_Shape(_SKIN, skin, [_PARKING, *names], [walls, *bodies])]
        closed = _Shape(_PARKING, RadioMaterial(f"{_PARKING}-walls", conductivity=1e7), [_PARKING], [walls])
        if constants is None:
            return [closed]
        skin = RadioMaterial(f"{_SKIN}-skin", 0.1, *constants)
        return [closed, _Shape(_SKIN, skin, names, bodies)]

    def _replace_shapes(self, shapes: Sequence[_Shape]) -> None:
        """Put these shapes in place of what was loaded, and number their triangles."""
        from sionna.rt import SceneObject

        added = [
            SceneObject(mi_mesh=_mi_mesh(shape, self.centre), radio_material=shape.material)
            for shape in shapes
        ]
        self._scene.edit(add=added, remove=list(self._scene.objects))
        counts = [[len(mesh.faces) for mesh in shape.meshes] for shape in shapes]
        totals = np.array([sum(count) for count in counts], np.int64)
        ids = np.array([item.object_id for item in added], np.int64)
        self.offset_by_shape = np.zeros(int(ids.max(initial=0)) + 1, np.int64)
        """Number of the first triangle of each process-local shape."""
        self.offset_by_shape[ids] = np.cumsum(totals) - totals
        self._body_id = int(ids[-1]) if self._bodies else -1
        order = np.argsort(ids)
        self._ids, self._shape_order = ids[order], order
        self._offsets = (np.cumsum(totals) - totals)[order]
        faces = np.concatenate([np.array(count, np.int64) for count in counts])
        self._first_triangles = np.cumsum(faces) - faces
        meshes = [mesh for shape in shapes for mesh in shape.meshes]
        corners = np.array([len(mesh.vertices) for mesh in meshes])
        before = np.cumsum(corners) - corners
        self._corners = np.concatenate([mesh.vertices for mesh in meshes])
        self._faces = np.concatenate([mesh.faces + b for mesh, b in zip(meshes, before, strict=True)])
        self.names = tuple(name for shape in shapes for name in shape.names)
        """What the indices of `object_index` stand for while no body stands for an object."""
        self._number_planes(meshes)

    def _number_planes(self, meshes: Sequence[Mesh]) -> None:
        """Number the planes of these pieces; bodies, each of which is a point yet, by their unit meshes."""
        still = len(meshes) - len(self._bodies)
        of_asset = {asset: plane_numbers(mesh) for asset, mesh in self._meshes.items()}
        numbers = [plane_numbers(mesh) for mesh in meshes[:still]]
        numbers += [of_asset[asset] for asset, _ in self._bodies]
        self._face_of = np.concatenate(numbers)
        counts = np.array([int(number.max(initial=-1)) + 1 for number in numbers], np.int64)
        before = np.cumsum(counts) - counts
        parts = np.concatenate([number + first for number, first in zip(numbers, before, strict=True)])
        faces = self._faces.astype(np.int64)
        apart = PlaneTable(parts.astype(np.int64), faces)
        apart.update(self._corners - self.centre)
        shared = shared_planes(apart, int(counts[:still].sum()))
        self.plane_of = shared[parts]
        """Infinite plane of each triangle, numbered through all objects."""
        self._moving_plane = len(apart.normal) and int(shared.max()) + 1 - int(counts[still:].sum())
        self.plane_table = PlaneTable(self.plane_of, faces)
        self.plane_table.update(self._corners - self.centre)


def _load(description: Path | None) -> Any:
    from sionna.rt import load_scene

    try:
        with any_frequency():
            scene = load_scene(None if description is None else str(description), merge_shapes=False)
    except (ValueError, TypeError, RuntimeError) as error:
        raise AssetError(f"{description}: the ray tracer cannot load it: {error}") from error
    freeze(scene)
    return scene


def _bounds(shapes: Sequence[_Shape]) -> tuple[Float64Array, Float64Array]:
    """Lowest and highest corner [m] of all shapes; the origin where there are none."""
    if not shapes:
        return np.zeros(3), np.zeros(3)
    corners = np.concatenate([mesh.vertices for shape in shapes for mesh in shape.meshes])
    return corners.min(0), corners.max(0)


def _by_material(scene: Any, meshes: Mapping[str, Mesh]) -> list[_Shape]:
    """What was loaded, joined to one shape a material."""
    groups: dict[str, _Shape] = {}
    for name, item in scene.objects.items():
        material = item.radio_material
        group = groups.setdefault(material.name, _Shape(f"caviar-scenery-{material.name}", material, [], []))
        group.names.append(name)
        group.meshes.append(meshes[name])
    return list(groups.values())


def _with_detail(shapes: list[_Shape], settings: SceneSettings) -> tuple[list[_Shape], DetailEffect | None]:
    """Scenery with this detail, and what that did to it; None where nothing was to be left out."""
    if settings.detail.is_full:
        return shapes, None
    pieces = [piece for shape in shapes for piece in zip(shape.names, shape.meshes, strict=True)]
    kept, effect = detailed(pieces, settings.detail)
    if pieces and not kept:
        raise ScenarioError(
            f"{settings.detail} leaves out all of the scenery; leave out less",
            key=f"{settings.materials.key}.detail",
        )
    left = dict(kept)
    return [
        _Shape(shape.id, shape.material, names, [left[name] for name in names])
        for shape in shapes
        if (names := [name for name in shape.names if name in left])
    ], effect


def _constants(material: Any) -> Constants:
    return float(material.relative_permittivity[0]), float(material.conductivity[0])


def _mi_mesh(shape: _Shape, centre: Float64Array) -> Any:
    import mitsuba as mi

    counts = np.array([len(mesh.vertices) for mesh in shape.meshes])
    before = np.cumsum(counts) - counts
    faces = np.concatenate([mesh.faces + begin for mesh, begin in zip(shape.meshes, before, strict=True)])
    properties = mi.Properties()
    properties.set_id(shape.id)
    properties["face_normals"] = True
    made = mi.Mesh(shape.id, int(counts.sum()), len(faces), props=properties)
    params = mi.traverse(made)
    params["vertex_positions"] = _floats(np.concatenate([mesh.vertices for mesh in shape.meshes]) - centre)
    params["faces"] = mi.UInt(np.ascontiguousarray(faces, np.uint32).ravel())
    params.update()
    return made


def _floats(vertices: Float64Array) -> Any:
    import mitsuba as mi

    (column,) = aligned_columns(vertices.reshape(1, -1))
    return mi.Float(column)
