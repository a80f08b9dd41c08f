"""The scene as a ray tracer holds it: scenery, and bodies that follow the moving objects.

Scenery and bodies are two ray-tracing scenes of one merged mesh each. Tracing both costs less
than building one again: when a vertex moves, Embree rebuilds everything that shares its scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float32Array, Float64Array, Int32Array, Int64Array
from caviar_protocol.errors import AssetError, PayloadError
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.space.scene import object_pose
from caviar_protocol.topics import Scene
from caviar_services.mesh.scenery import Scenery
from caviar_services.mesh.shapes import Mesh, assign_bodies, placed
from caviar_services.ray_tracing import aligned_columns, aligned_indices

NO_HIT = -1
"""Owner of a ray that hits nothing."""


@contextmanager
def active_variant(variant: str) -> Iterator[Any]:
    """Mitsuba with ``variant`` set, and the one before set again behind it.

    The variant is one for the whole process, and an embedded run has a channel service in it too.
    """
    import mitsuba as mi

    before = mi.variant()
    if before != variant:
        mi.set_variant(variant)
    try:
        yield mi
    finally:
        if before not in (None, variant):
            mi.set_variant(before)


def load_mesh(mi: Any, file: Path) -> Mesh:
    """Triangles of a PLY file, under the variant that is set.

    Raises `AssetError` naming the file where it is not a mesh.
    """
    try:
        mesh = mi.load_dict({"type": "ply", "filename": str(file), "face_normals": True})
        vertices = mesh.vertex_positions_buffer().numpy().reshape(-1, 3).astype(np.float64)
        faces = mesh.faces_buffer().numpy().reshape(-1, 3).astype(np.int32)
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise AssetError(f"{file}: no PLY mesh ({reason}); export it again, with triangles only") from error
    if not np.isfinite(vertices).all() or (faces.size and faces.max() >= len(vertices)):
        raise AssetError(f"{file}: a vertex is not finite or a face names none; export it again")
    return Mesh(vertices, faces)


def load_scenery(mi: Any, scenery: Scenery) -> list[Mesh]:
    """The scenery's meshes in world coordinates, in its order."""
    meshes = []
    for shape in scenery.shapes:
        mesh = load_mesh(mi, shape.file)
        rotation, offset = shape.to_world[:3, :3], shape.to_world[:3, 3]
        meshes.append(Mesh(mesh.vertices @ rotation.T + offset, mesh.faces))
    return meshes


def load_unit_mesh(mi: Any, file: Path) -> Mesh:
    """The mesh of a moving object.

    Raises `AssetError` where its bounding box is not −½…½ on every axis.
    """
    mesh = load_mesh(mi, file)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    if not (np.allclose(low, -0.5, atol=1e-4) and np.allclose(high, 0.5, atol=1e-4)):
        raise AssetError(
            f"{file}: spans {low.round(4).tolist()} to {high.round(4).tolist()}; "
            "scale and centre it to −0.5…0.5 on every axis"
        )
    return mesh


def contains(mesh: Mesh, point: Float64Array) -> bool:
    """Whether ``point`` [3] lies inside a closed mesh; undecided on its surface.

    Sums the solid angles of all triangles (Van Oosterom and Strackee, "The solid angle of a plane
    triangle", 1983): ±4π inside, 0 outside.
    """
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - point, 1, 0)
    la, lb, lc = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    numerator = np.einsum("ij,ij->i", a, np.cross(b, c))
    denominator = (
        la * lb * lc
        + np.einsum("ij,ij->i", a, b) * lc
        + np.einsum("ij,ij->i", b, c) * la
        + np.einsum("ij,ij->i", c, a) * lb
    )
    angle = 2 * float(np.arctan2(numerator, denominator).sum())
    return abs(angle) > 2 * np.pi


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays end."""

    distance: Float32Array
    """[m] along each ray, Shape ``[N]``; infinite where nothing is hit."""
    owner: Int32Array
    """What is hit, for `TracedScene.name_of`; `NO_HIT` for nothing. Shape ``[N]``."""
    face: Int64Array
    """Which triangle is hit, for `TracedScene.face_normals`; 0 where nothing is. Shape ``[N]``."""


class _Part:
    """One merged mesh in a ray-tracing scene of its own."""

    def __init__(self, mi: Any, name: str, vertices: Float64Array, faces: Int32Array) -> None:
        mesh = mi.Mesh(name, len(vertices), len(faces))
        parameters = mi.traverse(mesh)
        parameters["vertex_positions"] = mi.Float(vertices.ravel().astype(np.float32))
        parameters["faces"] = mi.UInt32(faces.ravel().astype(np.uint32))
        parameters.update()
        self.scene = mi.load_dict({"type": "scene", name: mesh})
        self._keys = f"{name}.vertex_positions", f"{name}.faces"
        self._parameters = mi.traverse(self.scene)
        self._parameters.keep(list(self._keys))
        self._faces = faces

    def replace(self, mi: Any, vertices: Float64Array, faces: Int32Array) -> None:
        """Put another mesh in place of this one, of any size."""
        (column,) = aligned_columns(vertices.reshape(1, -1))
        self._parameters[self._keys[0]] = mi.Float(column)
        if not np.array_equal(faces, self._faces):
            self._parameters[self._keys[1]] = mi.UInt32(aligned_indices(faces.ravel()))
            self._faces = faces
        self._parameters.update()


class TracedScene:
    """Scenery and the bodies of moving objects, for rays. Build and use it under `active_variant`.

    Args:
        names, meshes: The scenery's shapes, in world coordinates.
        bodies: Unit mesh of each asset that moving objects may have, by asset name.
        capacity: How many objects of each asset may be in the scene at once.
    """

    def __init__(
        self,
        mi: Any,
        names: tuple[str, ...],
        meshes: list[Mesh],
        bodies: Mapping[str, Mesh],
        capacity: Mapping[str, int],
    ) -> None:
        self._scenery_names = names
        self._bodies = dict(bodies)
        self._capacity = dict(capacity)
        self._scenery: _Part | None = None
        vertices, faces, self._scenery_owner = merged(meshes)
        self.scenery_faces = len(faces)
        if faces.size:
            self._scenery = _Part(mi, "scenery", vertices, faces)
        self._scenery_normals = _normals(vertices, faces)
        # A triangle without area, within the scene, which no ray can hit: a mesh has one at least.
        place = vertices.mean(axis=0) if len(vertices) else np.zeros(3)
        self._nothing = Mesh(np.tile(place, (3, 1)), np.array([[0, 1, 2]], dtype=np.int32))
        self._moving = _Part(mi, "bodies", self._nothing.vertices, self._nothing.faces)
        self._set_bodies([], [])

    def update(self, mi: Any, scene: Scene) -> None:
        """Bring the bodies to where the scene's objects are.

        Raises `PayloadError` where there are more objects of an asset than there may be, and where an
        object has the name of a scenery shape.
        """
        clash = set(self._scenery_names) & set(scene.names)
        if clash:
            raise PayloadError(
                f"object {min(clash)!r} has the name of a shape of the scenery; give the world's objects "
                "another prefix"
            )
        assign_bodies(zip(scene.names, scene.assets, strict=True), self._capacity)
        # Embree rebuilds all that is in the mesh, whether a ray can hit it or not: no body is parked there.
        meshes = [
            Mesh(placed(unit, scene.dimensions[index], object_pose(scene, index)), unit.faces)
            for index, unit in enumerate(self._bodies[asset] for asset in scene.assets)
        ]
        self._set_bodies(scene.names, meshes)
        self._moving.replace(mi, self._vertices, self._body_faces)

    def _set_bodies(self, names: Sequence[str], meshes: list[Mesh]) -> None:
        self._vertices, self._body_faces, owner = merged(meshes or [self._nothing])
        first = len(self._scenery_names)
        self.face_owner: Int32Array = np.concatenate([self._scenery_owner, owner + np.int32(first)])
        """Owner of each face in the last update, Shape ``[F]``: the scenery's faces, then the bodies'."""
        self.owner_names: list[str] = [*self._scenery_names, *(names or [""])]
        """By owner; empty for that of the triangle that stands for no object."""
        self.object_owner: dict[str, int] = {name: first + body for body, name in enumerate(names)}
        """Owner of each object of the last update, by its name."""

    def trace(self, mi: Any, origin: Float64Array, direction: Float64Array, reach: Float64Array) -> Hits:
        """First hit of each ray.

        Args:
            origin, direction: World coordinates [m] and unit vectors, Shape ``[3, N]``.
            reach: [m], Shape ``[N]``; what is farther is not looked for.
        """
        import drjit as dr

        # Every value is an array, never a Python number: a number becomes part of the kernel, and
        # each new one makes a kernel to compile.
        x, y, z, dx, dy, dz, limit = map(mi.Float, aligned_columns(np.vstack([origin, direction, reach])))
        ray = mi.Ray3f(mi.Point3f(x, y, z), mi.Vector3f(dx, dy, dz))
        ray.maxt = limit
        distance, face = self.intersect(mi, ray)
        dr.eval(distance, face)
        return self._hits(distance.numpy(), face.numpy())

    def intersect(self, mi: Any, ray: Any) -> tuple[Any, Any]:
        """Distance [m] and face of each ray's first hit, as Dr.Jit arrays that wait for evaluation.

        Distance is infinite, and the face any number, where nothing is hit.
        """
        import drjit as dr

        hit = self._moving.scene.ray_intersect_preliminary(ray, coherent=True)
        if self._scenery is None:
            return hit.t, hit.prim_index
        fixed = self._scenery.scene.ray_intersect_preliminary(ray, coherent=True)
        moving = hit.t < fixed.t
        face = dr.select(moving, hit.prim_index + mi.UInt32(self.scenery_faces), fixed.prim_index)
        return dr.select(moving, hit.t, fixed.t), face

    def occluded(self, ray: Any, active: Any, coherent: bool) -> Any:
        """Whether each ray hits anything, as a Dr.Jit array that waits for evaluation."""
        hit = self._moving.scene.ray_test(ray, coherent=coherent, active=active)
        if self._scenery is not None:
            hit |= self._scenery.scene.ray_test(ray, coherent=coherent, active=active)
        return hit

    def _hits(self, distance: Float32Array, face: Any) -> Hits:
        found = np.isfinite(distance)
        # A ray that hits nothing has no face; 0 stands in, so that the tables can be read.
        face = np.where(found, face, 0).astype(np.int64)
        if not len(self.face_owner):
            return Hits(distance, np.full(len(distance), NO_HIT, dtype=np.int32), face)
        owner = np.where(found, self.face_owner[face], np.int32(NO_HIT))
        return Hits(distance, owner, face)

    def face_normals(self) -> Float32Array:
        """Unit normal of each face in the last update, world axes, by the right-hand rule; 0 where a
        face has no area. Shape ``[F, 3]``, in the order of `face_owner`."""
        return np.concatenate([self._scenery_normals, _normals(self._vertices, self._body_faces)])

    def is_inside(self, asset: str, dimensions: Float64Array, point: Vector) -> bool:
        """Whether a point in an object's body axes [m] lies in its mesh, deeper than a millimetre."""
        if not (dimensions > 0).all():
            return False
        around = np.array(point) + 1e-3 * np.concatenate([np.eye(3), -np.eye(3)])
        return all(contains(self._bodies[asset], place) for place in around / dimensions)

    def name_of(self, owner: int) -> str:
        """Name of the object or scenery shape behind an owner of `Hits`, in the last update."""
        return self.owner_names[owner]


def merged(meshes: list[Mesh]) -> tuple[Float64Array, Int32Array, Int32Array]:
    """One mesh of several: vertices, faces, and the index of the mesh that each face is of."""
    if not meshes:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32), np.zeros(0, dtype=np.int32)
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + np.int32(start) for mesh, start in zip(meshes, starts, strict=False)]
    counts = [len(mesh.faces) for mesh in meshes]
    owner = np.repeat(np.arange(len(meshes), dtype=np.int32), counts)
    return np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces, dtype=np.int32), owner


def _normals(vertices: Float64Array, faces: Int32Array) -> Float32Array:
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: Float64Array = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return unit.astype(np.float32)


def visible_names(
    of_owner: Sequence[str], owners: Iterable[Int32Array]
) -> tuple[tuple[str, ...], Int32Array]:
    """Names of all that rays hit, sorted, and the index into them of each owner.

    ``of_owner`` has the name of each owner, ``owners`` those of the rays. The index has one entry more,
    the last, which is −1, so that it can be taken at `NO_HIT` too.
    """
    seen = np.zeros(len(of_owner) + 1, dtype=bool)
    for of_rays in owners:
        seen[of_rays] = True
    seen[NO_HIT] = False
    name_of = {owner: of_owner[owner] for owner in np.flatnonzero(seen).tolist()}
    names = tuple(sorted(set(name_of.values())))
    place = {name: position for position, name in enumerate(names)}
    index = np.full(len(seen), NO_HIT, dtype=np.int32)
    for owner, name in name_of.items():
        index[owner] = place[name]
    return names, index
