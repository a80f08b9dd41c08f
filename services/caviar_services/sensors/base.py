"""What all sensor services share: the scene for rays, and how many bodies may be in it.

A sensor implements `observe`; loading and moving of meshes is done here, the same way
for every sensor.
"""

from __future__ import annotations

import importlib.util
import time
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, ClassVar, TypeVar

import msgspec
import numpy as np

from caviar_protocol.arrays import Float64Array, Payload, quantity
from caviar_protocol.errors import PayloadError, ScenarioError, SetupError
from caviar_protocol.host import install_command
from caviar_protocol.messages import Input, Role
from caviar_protocol.space.coordinates import Pose, rotation_matrix
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import Scene
from caviar_protocol.topics.scene import Device
from caviar_services.mesh.scenery import SceneryShape, find_scenery, read_scenery
from caviar_services.mesh.shapes import Mesh, unit_box
from caviar_services.ray_tracing import activate_llvm, choose_variant, cuda_devices, limit_threads
from caviar_services.sensors.traced_scene import TracedScene, active_variant, load_scenery, load_unit_mesh
from caviar_services.service import Frame, Preparation, Prepared, Service, StepResult


class SensorSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of every sensor service."""

    bodies_per_asset: Annotated[
        int, quantity("1", "objects of one mesh that may be in the scene at once", ge=0, le=4096)
    ] = 64
    bodies: dict[str, Annotated[int, quantity("1", "the same, for one mesh", ge=0, le=4096)]] = {}
    """By asset name, ``objects/car.ply``; the empty name is the box."""


S = TypeVar("S", bound=SensorSettings)


class Sensors(Service[S]):
    """Base of sensor services.

    An implementation sets ``outputs`` and implements `observe` and `example_devices`. Loading and moving of
    meshes is done here, the same way for every sensor; rays are traced by Mitsuba.

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
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"),)

    traced: TracedScene | None = None
    """The scene for rays; None where nothing is asked for."""
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
        if not preparation.demand.keys() & set(self.outputs):
            return Prepared(notes=("nobody asks for what these sensors see: not run",))
        if importlib.util.find_spec("mitsuba") is None:
            raise SetupError(
                f"Mitsuba, which traces the rays, is not installed; run: {install_command('sensors')}"
            )
        device = "a CUDA device" if cuda_devices() else activate_llvm()
        # The channel's variant: rays and triangles are the same in all, and an embedded run with both
        # would change it twice a frame, which costs Sionna RT half of the frame.
        self.variant = choose_variant()
        limit_threads()
        self.run.progress("loading scenery", 60.0)
        with active_variant(self.variant) as mi:
            self.traced = self._load(mi, preparation.assets)
            self.run.progress("compiling kernels", 60.0)
            self._warm_up(mi)
        return Prepared(notes=(f"rays are traced by {device}",))

    def step(self, frame: Frame) -> StepResult:
        """Move the bodies to the objects of the frame, and observe."""
        if self.traced is None:
            return StepResult()
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
        """Dr.Jit keeps freed buffers, some of each size that it has seen; sizes vary with what rays hit."""
        if self.traced is not None:
            import drjit as dr

            dr.flush_malloc_cache()

    def close(self) -> None:
        """Release the scene."""
        self.traced = None

    @abstractmethod
    def observe(self, mi: Any, traced: TracedScene, scene: Scene) -> dict[str, Payload]:
        """What the sensors of a scene see.

        Args:
            mi: Mitsuba, with the variant that is active.
            traced: The triangles of scenery and objects, moved to where ``scene`` has them.
            scene: The scenes of all worlds as one.

        Returns:
            Product by topic, of the topics in demand alone (contract, clause 5).

        Raises:
            PayloadError: A sensor sits inside its carrier (`pose_outside`).
        """

    @abstractmethod
    def example_devices(self) -> tuple[Device, ...]:
        """Devices without a parent that make `observe` compile all it ever needs."""

    def _load(self, mi: Any, assets: Mapping[str, Path]) -> TracedScene:
        file = find_scenery(assets)
        meshes: list[Mesh] = []
        if file is not None:
            scenery = read_scenery(file)
            self.shapes, meshes = scenery.shapes, load_scenery(mi, scenery)
        bodies = {"": unit_box()}
        bodies |= {
            name: load_unit_mesh(mi, path)
            for name, path in assets.items()
            if PurePosixPath(name).match("objects/*.ply")
        }
        unknown = sorted(self.settings.bodies.keys() - bodies.keys())
        if unknown:
            raise ScenarioError(
                f"the run has no mesh {unknown[0]!r}; meshes of its objects: {', '.join(sorted(bodies)[1:])}",
                key=f"services.{self.run.name}.settings.bodies",
            )
        self._capacity = dict.fromkeys(bodies, self.settings.bodies_per_asset) | self.settings.bodies
        return TracedScene(mi, tuple(shape.name for shape in self.shapes), meshes, bodies, self._capacity)

    def _warm_up(self, mi: Any) -> None:
        """Compile the kernels of an update and an observation: of a box around example devices, so that
        their rays come back."""
        if self.traced is None:
            return
        count = min(1, self._capacity[""])
        scene = Scene(
            names=("warm-up box",) * count,
            classes=("box",) * count,
            assets=("",) * count,
            position=np.zeros((count, 3)),
            orientation=np.array([[1.0, 0.0, 0.0, 0.0]] * count).reshape(count, 4),
            velocity=np.zeros((count, 3)),
            dimensions=np.full((count, 3), 10.0),
            devices=self.example_devices(),
        )
        self.traced.update(mi, scene)
        self.observe(mi, self.traced, scene)


def pose_outside(traced: TracedScene, scene: Scene, device: Device) -> Pose:
    """World pose of a sensor, which must not sit inside the mesh that carries it.

    Args:
        traced: The scene for rays.
        scene: Where the carrier is.
        device: The sensor.

    Raises:
        PayloadError: The sensor is inside its carrier; the text names both and the remedy.
    """
    if device.parent and device.parent in scene.names:
        parent = scene.names.index(device.parent)
        if traced.is_inside(scene.assets[parent], scene.dimensions[parent], device.position):
            kind = type(device).__struct_config__.tag
            raise PayloadError(
                f"{kind} {device.name!r} sits inside its carrier {device.parent!r} and would see only that; "
                'mount it outside the mesh, for example with mount = "roof" and a position_m above it'
            )
    return device_pose(scene, device)


def turned(pose: Pose, local: Float64Array) -> Float64Array:
    """Vectors in a sensor's axes in world axes.

    Args:
        pose: World pose of the sensor.
        local: Vectors in its axes, Shape ``[3, N]``.

    Returns:
        The same vectors in world axes, Shape ``[3, N]``.
    """
    # Written out instead of a matrix product, whose rounding may depend on the BLAS and its threads.
    return np.stack(
        [
            row[0] * local[0] + row[1] * local[1] + row[2] * local[2]
            for row in rotation_matrix(pose.orientation)
        ]
    )
