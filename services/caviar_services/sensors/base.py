"""Base of all sensor services, and the scene as their ray tracer holds it.

A sensor implements `Sensors.observe`; meshes are loaded and moved here, the same way for every sensor.

Scenery and the bodies of moving objects are two ray-tracing scenes of one merged mesh each. Tracing both
costs less than building one again: when a vertex moves, Embree rebuilds everything that shares its scene.
"""

from __future__ import annotations

import importlib.util
import time
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float32Array, Float64Array, Int32Array, Payload, quantity
from caviar_protocol.assets import is_mesh_name
from caviar_protocol.errors import PayloadError, ScenarioError, SetupError
from caviar_protocol.host import install_command
from caviar_protocol.messages import Input, Role
from caviar_protocol.space.coordinates import Pose, Vector
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import Scene
from caviar_protocol.topics.scene import Device
from caviar_services.drjit_setup import (
    activate_llvm,
    aligned_columns,
    aligned_indices,
    choose_variant,
    cuda_devices,
    limit_threads,
)
from caviar_services.service import Frame, Preparation, Prepared, Service, StepResult
from caviar_space.meshes import (
    Mesh,
    assign_bodies,
    coarse_centre,
    contains,
    joined,
    object_meshes,
    placed_objects,
    shown_asset,
)
from caviar_space.mitsuba_xml import SceneryShape, find_scenery, read_scenery, world_mesh

NO_HIT = -1
"""Owner of a ray that hits nothing."""

# [m]; where float32 has a step of 0.1 mm. A scene that is nearer to the origin is traced where it is.
_NEAR = 2048.0


class SensorSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of every sensor service."""

    bodies_per_asset: Annotated[
        int, quantity("1", "objects of one mesh that may be in the scene at once", ge=0, le=4096)
    ] = 4096
    bodies: dict[str, Annotated[int, quantity("1", "the same, for one mesh", ge=0, le=4096)]] = {}
    """By asset name, ``objects/car.ply``; the empty name is the box."""


S = TypeVar("S", bound=SensorSettings)
D = TypeVar("D", bound=Device)


class Sensors(Service[S]):
    """Base of sensor services.

    An implementation sets ``outputs`` and implements `observe` and `example_devices`. Loading and moving of
    meshes is done here, the same way for every sensor; rays are traced by Mitsuba.

    Args:
        settings: The scenario's settings of the sensors.
        run: What the sensors know about the run.

    Example:
        >>> from caviar_protocol.topics import Depth
        >>> class Range(Sensors[SensorSettings]):
        ...     outputs = ("depth",)
        ...     uses_scenery = True
        ...
        ...     def example_devices(self):
        ...         return ()
        ...
        ...     def observe(self, mi, traced, scene):
        ...         ray = mi.Ray3f(mi.Point3f(0, 0, 1), mi.Vector3f(1, 0, 0))
        ...         distance, face = traced.intersect(mi, ray)
        ...         return {"depth": Depth(images=())}
    """

    role: ClassVar[Role] = "sensors"
    Settings: ClassVar[type[msgspec.Struct]] = SensorSettings
    extra: ClassVar[str] = "sensors"
    packages: ClassVar[tuple[str, ...]] = ("mitsuba", "drjit")
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"),)
    changes_geometry: ClassVar[bool] = True

    traced: TracedScene | None = None
    """The scene for rays; None where nothing is asked for."""
    frame = Frame(episode=0, number=0, t_ns=0)
    """That which is observed, for its number and its generators; before the first an empty one."""
    shapes: tuple[SceneryShape, ...] = ()
    """Shapes of the scenery, in the order of their owners in `traced`."""
    # Objects that may be in the scene at once, by asset name.
    _capacity: Mapping[str, int]

    def prepare(self, preparation: Preparation) -> Prepared:
        """Load the scenery and the objects' meshes, and compile what `observe` needs.

        Nothing is loaded where no output is in demand (contract, clause 5).

        Raises:
            AssetError: The scene description or a mesh is broken or missing.
            SetupError: Mitsuba is not installed, or there is no library to compile kernels with.
        """
        # Before Mitsuba is looked for: an agent's run without sensors needs no ray tracer.
        if not preparation.demand.keys() & set(self.outputs):
            return Prepared(notes=("no service asks for what these sensors see: not run",))
        if importlib.util.find_spec("mitsuba") is None:
            raise SetupError(
                f"Mitsuba, which traces the rays, is not installed; run: {install_command('sensors')}"
            )
        device = "a CUDA device" if cuda_devices() else activate_llvm()
        # The channel's variant: rays and triangles are the same in all, and an embedded run with both
        # would change it twice a frame, which costs Sionna RT half of the frame.
        self.variant = choose_variant()
        limit_threads()
        # Large scenery and kernels may take longer than the scenario's `stall_s`, so a grace is asked for.
        self.run.progress("loading scenery", 60.0)
        with active_variant(self.variant) as mi:
            self.traced = self._load(mi, preparation.assets)
            self.run.progress("compiling kernels", 60.0)
            self._warm_up(mi)
        return Prepared(notes=(f"rays are traced by {device}",))

    def use_meshes(self, meshes: Mapping[str, Path]) -> None:
        """Take the meshes that objects may have from the next frame on, beside those of `prepare`.

        Args:
            meshes: Files by asset name.

        Raises:
            AssetError: A file is no mesh.
        """
        if self.traced is not None:
            self.traced.use_meshes(object_meshes(meshes))

    def step(self, frame: Frame) -> StepResult:
        """Move the bodies to the objects of the frame, and observe."""
        if self.traced is None:
            return StepResult()
        self.frame = frame
        scene = frame.scene()
        started = time.perf_counter_ns()
        with active_variant(self.variant) as mi:
            self.traced.update(mi, scene)
            updated = time.perf_counter_ns()
            products = self.observe(mi, self.traced, scene)
        done = time.perf_counter_ns()
        return StepResult(
            products=products,
            fidelity="ray-traced",
            measured={"scene update": updated - started, "observation": done - updated},
        )

    def release_memory(self) -> None:
        """Give back the buffers that Dr.Jit keeps, some of each size: sizes vary with what rays hit."""
        if self.traced is not None:
            import drjit as dr

            dr.flush_malloc_cache()

    def close(self) -> None:
        """Release the scene."""
        self.traced = None

    @abstractmethod
    def observe(self, mi: Any, traced: TracedScene, scene: Scene) -> dict[str, Payload]:
        """Observe a scene with all its sensors.

        Args:
            mi: Mitsuba, with the variant that is active.
            traced: The triangles of scenery and objects, moved to where ``scene`` has them.
            scene: The scenes of all worlds as one.

        Returns:
            Product by topic, of the topics in demand alone (contract, clause 5).

        Raises:
            PayloadError: A sensor sits inside its carrier (`sensor_poses`).
        """

    @abstractmethod
    def example_devices(self) -> tuple[Device, ...]:
        """Devices without a parent that make `observe` compile all it ever needs."""

    def _load(self, mi: Any, assets: Mapping[str, Path]) -> TracedScene:
        file = find_scenery(assets)
        self.shapes = read_scenery(file).shapes if file is not None else ()
        bodies = object_meshes(assets)
        unknown = sorted(self.settings.bodies.keys() - bodies.keys())
        if unknown:
            raise ScenarioError(
                f"the run has no mesh {unknown[0]!r}; meshes of its objects: {', '.join(sorted(bodies)[1:])}",
                key=f"services.{self.run.name}.settings.bodies",
            )
        self._capacity = dict.fromkeys(bodies, self.settings.bodies_per_asset) | self.settings.bodies
        meshes = [world_mesh(shape) for shape in self.shapes]
        return TracedScene(mi, tuple(shape.name for shape in self.shapes), meshes, bodies, self._capacity)

    def _warm_up(self, mi: Any) -> None:
        """Compile the kernels of an update and an observation: of a box around example devices, so that
        their rays come back."""
        # Without a hit, what works on hits would compile in frame 0, which is late then.
        if self.traced is None:
            return
        count = min(1, self._capacity[""])  # a run may allow no boxes
        x, y, z = self.traced.centre.tolist()
        scene = Scene(
            names=("warm-up box",) * count,
            classes=("box",) * count,
            assets=("",) * count,
            position=np.tile(self.traced.centre, (count, 1)),
            orientation=np.array([[1.0, 0.0, 0.0, 0.0]] * count).reshape(count, 4),
            velocity=np.zeros((count, 3)),
            dimensions=np.full((count, 3), 10.0),
            devices=tuple(
                msgspec.structs.replace(device, position=(x, y, z)) for device in self.example_devices()
            ),
        )
        self.traced.update(mi, scene)
        self.observe(mi, self.traced, scene)


def sensor_poses(traced: TracedScene, scene: Scene, kind: type[D]) -> list[tuple[D, Pose]]:
    """Find the devices of a kind and their world poses.

    Args:
        traced: The scene for rays, moved to where ``scene`` has the objects.
        scene: The scenes of all worlds as one.
        kind: Class of the devices, such as `caviar_protocol.topics.LidarDevice`.

    Returns:
        Device and pose, sorted by the name of the device.

    Raises:
        PayloadError: A sensor sits inside the mesh that carries it; the text names both and the remedy.
    """
    found = []
    for device in scene.devices:
        if not isinstance(device, kind):
            continue
        # A mounted device whose object is not in the scene has no pose, which `device_pose` says.
        if device.parent and device.parent in scene.names:
            parent = scene.names.index(device.parent)
            if traced.is_inside(scene.assets[parent], scene.dimensions[parent], device.position):
                tag = type(device).__struct_config__.tag
                raise PayloadError(
                    f"{tag} {device.name!r} sits inside its carrier {device.parent!r} and would see only "
                    'that; mount it outside the mesh, for example with mount = "roof" and a position_m above'
                    " it"
                )
        found.append((device, device_pose(scene, device)))
    return sorted(found, key=lambda sensor: sensor[0].name)


@contextmanager
def active_variant(variant: str) -> Iterator[Any]:
    """Mitsuba with a variant set, and the one before set again after it.

    The variant is one for the whole process, and an embedded run has a channel service in it too.

    Args:
        variant: Name of the variant, for example ``llvm_ad_mono_polarized``.
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


class _Part:
    """One merged mesh in a ray-tracing scene of its own."""

    def __init__(self, mi: Any, name: str, mesh: Mesh) -> None:
        traced = mi.Mesh(name, len(mesh.vertices), len(mesh.faces))
        parameters = mi.traverse(traced)
        parameters["vertex_positions"] = mi.Float(mesh.vertices.ravel().astype(np.float32))
        parameters["faces"] = mi.UInt32(mesh.faces.ravel().astype(np.uint32))
        parameters.update()
        self.scene = mi.load_dict({"type": "scene", name: traced})
        self._keys = f"{name}.vertex_positions", f"{name}.faces"
        self._parameters = mi.traverse(self.scene)
        self._parameters.keep(list(self._keys))
        self._faces = mesh.faces

    def replace(self, mi: Any, mesh: Mesh, centre: Float64Array) -> None:
        """Put another mesh in place of this one, of any size, counted from a centre."""
        (column,) = aligned_columns((mesh.vertices - centre).reshape(1, -1))
        self._parameters[self._keys[0]] = mi.Float(column)
        # In most frames the same objects are there: then only vertices move.
        if not np.array_equal(mesh.faces, self._faces):
            self._parameters[self._keys[1]] = mi.UInt32(aligned_indices(mesh.faces.ravel()))
            self._faces = mesh.faces
        self._parameters.update()


def _end_gpu_kernel(*results: Any) -> None:
    """Evaluate what rays met, where a GPU traces them.

    With OptiX a kernel has the shader binding table of one scene: of rays in two scenes Dr.Jit leaves out
    those in one of them, which then hit nothing (mitsuba3, issue 1349).
    """
    import drjit as dr

    if dr.backend_v(results[0]) == dr.JitBackend.CUDA:
        dr.eval(*results)


class TracedScene:
    """Scenery and the bodies of moving objects, for rays. Build and use it under `active_variant`.

    Rays are traced in float32, so positions count from `centre`, near the scene wherever that is: the middle
    of the scenery, or of the objects where there is none.

    What a ray hits has an *owner*: the number of a scenery shape, or of an object, counted after all shapes.

    Args:
        mi: Mitsuba, with the variant that is active.
        names: Names of the scenery's shapes.
        meshes: Their meshes, in world coordinates [m].
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
        self._first_bodies = self._bodies = dict(bodies)
        self._capacity = dict(capacity)
        self._scenery: _Part | None = None
        scenery, self._scenery_owner = joined(meshes), _owners(meshes)
        self.scenery_faces = len(scenery.faces)
        self.centre: Float64Array = np.zeros(3)
        """Where positions of rays count from [m], Shape ``[3]``; 0 for a scene near the origin."""
        if self.scenery_faces:
            self.centre = _far_centre((scenery.vertices.min(0) + scenery.vertices.max(0)) / 2)
            self._scenery = _Part(mi, "scenery", Mesh(scenery.vertices - self.centre, scenery.faces))
        self._scenery_normals = _normals(scenery)
        # A triangle without area, within the scene, which no ray can hit: a mesh has one at least.
        place = scenery.vertices.mean(axis=0) if len(scenery.vertices) else np.zeros(3)
        self._nothing = Mesh(np.tile(place, (3, 1)), np.array([[0, 1, 2]], dtype=np.int32))
        self._moving = _Part(mi, "bodies", Mesh(self._nothing.vertices - self.centre, self._nothing.faces))
        self._set_bodies([], [])

    def use_meshes(self, bodies: Mapping[str, Mesh]) -> None:
        """Take unit meshes that objects may have beside those of the beginning.

        Any number of objects may have them: no body is kept for one that is not there.

        Args:
            bodies: By asset name; those of an earlier call that are not here are gone.
        """
        self._bodies = {**self._first_bodies, **bodies}

    def _body(self, asset: str) -> Mesh:
        """The unit mesh that stands for an asset (`shown_asset`)."""
        return self._bodies[shown_asset(asset, self._bodies)]

    def update(self, mi: Any, scene: Scene) -> None:
        """Bring the bodies to where the scene's objects are.

        Args:
            mi: Mitsuba, with the variant that is active.
            scene: The scenes of all worlds as one.

        Raises:
            PayloadError: There are more objects of an asset than there may be, or an object has the name of
                a scenery shape.
        """
        clash = set(self._scenery_names) & set(scene.names)
        if clash:
            raise PayloadError(
                f"object {min(clash)!r} has the name of a shape of the scenery; give the world's objects "
                "another prefix"
            )
        known = [pair for pair in zip(scene.names, scene.assets, strict=True) if not is_mesh_name(pair[1])]
        assign_bodies(known, self._capacity)
        # Embree rebuilds all that is in the mesh, whether a ray can hit it or not: no body is parked there.
        # A pool of 4 × 64 bodies had 13,800 triangles rebuilt in each frame of `street-canyon`.
        units = [self._body(asset) for asset in scene.assets]
        vertices = placed_objects(units, scene, range(len(units)))
        meshes = [Mesh(corners, unit.faces) for corners, unit in zip(vertices, units, strict=True)]
        self._set_bodies(scene.names, meshes)
        if self._scenery is None:
            self.centre = _far_centre(np.median(scene.position, axis=0)) if meshes else np.zeros(3)
        self._moving.replace(mi, self._joined_bodies, self.centre)

    def _set_bodies(self, names: Sequence[str], meshes: list[Mesh]) -> None:
        meshes = meshes or [self._nothing]
        self._joined_bodies, owner = joined(meshes), _owners(meshes)
        first = len(self._scenery_names)
        self.face_owner: Int32Array = np.concatenate([self._scenery_owner, owner + np.int32(first)])
        """Owner of each face in the last update, Shape ``[F]``: the scenery's faces, then the bodies'."""
        self.owner_names: list[str] = [*self._scenery_names, *(names or [""])]
        """By owner; empty for that of the triangle that stands for no object."""
        self.object_owner: dict[str, int] = {name: first + body for body, name in enumerate(names)}
        """Owner of each object of the last update, by its name."""

    def intersect(self, mi: Any, ray: Any) -> tuple[Any, Any]:
        """Find the first hit of each ray.

        Args:
            mi: Mitsuba, with the variant that is active.
            ray: Rays whose origins count from `centre`, as `mitsuba.Ray3f`.

        Returns:
            Distance [m] and face of each hit, as Dr.Jit arrays that may wait for evaluation; where nothing is
            hit, the distance is infinite and the face any number.
        """
        import drjit as dr

        hit = self._moving.scene.ray_intersect_preliminary(ray, coherent=True)
        if self._scenery is None:
            return hit.t, hit.prim_index
        _end_gpu_kernel(hit.t, hit.prim_index)
        fixed = self._scenery.scene.ray_intersect_preliminary(ray, coherent=True)
        _end_gpu_kernel(fixed.t, fixed.prim_index)
        # Faces of scenery come first in the tables (`face_owner`), so those of bodies are counted on.
        moving = hit.t < fixed.t
        face = dr.select(moving, hit.prim_index + mi.UInt32(self.scenery_faces), fixed.prim_index)
        return dr.select(moving, hit.t, fixed.t), face

    def occluded(self, ray: Any, active: Any, coherent: bool) -> Any:
        """Test whether each ray hits anything, as a Dr.Jit array that may wait for evaluation.

        Args:
            ray: Rays whose origins count from `centre`, as `mitsuba.Ray3f`.
            active: Which rays are traced, as `mitsuba.Bool`.
            coherent: Whether neighbouring rays take similar ways, which Embree makes use of.
        """
        hit = self._moving.scene.ray_test(ray, coherent=coherent, active=active)
        if self._scenery is not None:
            _end_gpu_kernel(hit)
            hit |= self._scenery.scene.ray_test(ray, coherent=coherent, active=active)
            _end_gpu_kernel(hit)
        return hit

    def face_normals(self) -> Float32Array:
        """Unit normal of each face in the last update, world axes, by the right-hand rule; 0 where a
        face has no area. Shape ``[F, 3]``, in the order of `face_owner`."""
        return np.concatenate([self._scenery_normals, _normals(self._joined_bodies)])

    def is_inside(self, asset: str, dimensions: Float64Array, point: Vector) -> bool:
        """Test whether a point in an object's body axes [m] lies in its mesh, deeper than a millimetre."""
        # `contains` is undecided on the surface, where sensors are mounted: so points around it are asked.
        if not (dimensions > 0).all():
            return False
        around = np.array(point) + 1e-3 * np.concatenate([np.eye(3), -np.eye(3)])
        return all(contains(self._body(asset), place) for place in around / dimensions)


def _far_centre(middle: Float64Array) -> Float64Array:
    """Centre to count from [m], for a scene about a place; 0 along axes on which that is near the origin."""
    return np.where(np.abs(middle) > _NEAR, coarse_centre(middle), 0.0)


def _owners(meshes: list[Mesh]) -> Int32Array:
    """The index of the mesh that each face of the joined meshes is of."""
    counts = np.array([len(mesh.faces) for mesh in meshes], np.int64)
    return np.repeat(np.arange(len(meshes), dtype=np.int32), counts)


def _normals(mesh: Mesh) -> Float32Array:
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: Float64Array = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return unit.astype(np.float32)


def visible_names(
    of_owner: Sequence[str], owners: Iterable[Int32Array]
) -> tuple[tuple[str, ...], Int32Array]:
    """List the names of all that rays hit.

    Args:
        of_owner: Name of each owner.
        owners: Owners that rays hit, `NO_HIT` among them, any number of arrays.

    Returns:
        Names, sorted, and the index into them of each owner. The index has one entry more, the last, which is
        −1, so that it can be taken at `NO_HIT` too.

    Example:
        >>> visible_names(["wall", "car", "bus"], [np.array([2, 0, NO_HIT], np.int32)])
        (('bus', 'wall'), array([ 1, -1,  0, -1], dtype=int32))
    """
    seen = np.zeros(len(of_owner) + 1, dtype=bool)
    for of_rays in owners:
        seen[of_rays] = True
    seen[NO_HIT] = False
    name_of = {owner: of_owner[owner] for owner in np.flatnonzero(seen).tolist()}
    names = tuple(sorted(set(name_of.values())))
    place = {name: position for position, name in enumerate(names)}
    # Names, not owners, are listed: several shapes of a scenery may have one material.
    index = np.full(len(seen), NO_HIT, dtype=np.int32)
    for owner, name in name_of.items():
        index[owner] = place[name]
    return names, index
