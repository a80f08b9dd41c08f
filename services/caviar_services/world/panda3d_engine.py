"""Panda3D behind the world ``panda3d``: level, bodies in Bullet, and pictures by its software renderer.

Panda3D is imported by the functions that need it. Nothing of it is global here but its configuration: no
window, no task manager, no clock; a step is as long as the caller says.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError, SetupError, suggestion
from caviar_protocol.host import install_command
from caviar_protocol.space.coordinates import Pose, UnitQuaternion, Vector
from caviar_protocol.space.engine_axes import EngineAxes
from caviar_protocol.space.scene import device_pose, object_pose
from caviar_protocol.topics import Camera, CameraDevice, CameraImage, Scene
from caviar_services.mesh.scenery import ITU_MATERIALS, read_scenery, world_mesh
from caviar_services.mesh.shapes import SHAPES, Mesh, ply, unit_box
from caviar_services.sensors.camera import intrinsics
from caviar_services.sensors.shading import object_colour, shape_colour

PANDA3D = EngineAxes(
    "panda3d",
    world=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    body=((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
)
"""Right-handed metres, z up: the world's axes are ENU; a body looks along +y, with +x to its right."""

TICK_NS = 10_000_000
"""Length of a step of the physics [ns]."""

# [s] in which a body turns by 63 % of the way to its course.
_TURN_LAG = 0.2
# [rad/s] at most.
_TURN = 1.5
# [m/s]; slower, a body has no course and keeps its heading.
_STANDS = 0.5
# [rad/s]; slower is the rounding of single precision.
_STILL = 1e-3

# Bits of what may touch: scenery, vehicles, UAVs. Vehicles do not touch scenery: they stand on it.
_SCENERY, _VEHICLES, _UAVS = 0, 1, 2

_CONFIGURATION = """\
load-display p3tinydisplay
audio-library-name null
notify-level error
model-cache-dir
"""
# The software renderer needs no libraries of the system; a cache of models would write into the home folder.

_SKY = (0.72, 0.82, 0.93, 1.0)


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
    """What stands still in the engine."""

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
        node = level.node.attachNewNode(_geom_node(core, shape.name, world_mesh(shape)))
        node.setColor(*_srgb(shape_colour(shape, {})), 1.0)
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
            name = next(n for n in (base, *(f"{base}-{k}" for k in range(1, 1 << 20))) if n not in taken)
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
        corners = [tuple(colour)[:3] for colour in _column(core, node.getGeom(index).getVertexData(), "color")]
        shown = np.mean(corners, axis=0) if corners else np.ones(3)
    red, green, blue = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4).tolist()
    return (red, green, blue)


def _described(name: str, shapes: Mapping[str, tuple[Mesh, str, Vector]]) -> dict[str, bytes]:
    """A Mitsuba XML of shapes, with their meshes, by asset name."""
    looks = sorted({(radio, colour) for _, radio, colour in shapes.values()})
    lines = ['<scene version="2.1.0">']
    for index, (radio, colour) in enumerate(looks):
        lines += [
            f'  <bsdf type="itu-radio-material" id="{radio}-{index}">',
            f'    <string name="type" value="{radio}"/>',
            '    <float name="thickness" value="0.2"/>',
            f'    <rgb name="color" value="{colour[0]:.6f} {colour[1]:.6f} {colour[2]:.6f}"/>',
            "  </bsdf>",
        ]
    for shape, (_, radio, colour) in shapes.items():
        lines += [
            f'  <shape type="ply" id="mesh-{shape}">',
            f'    <string name="filename" value="meshes/{shape}.ply"/>',
            '    <boolean name="face_normals" value="true"/>',
            f'    <ref id="{radio}-{looks.index((radio, colour))}" name="bsdf"/>',
            "  </shape>",
        ]
    meshes = {f"scenery/meshes/{shape}.ply": ply(mesh) for shape, (mesh, _, _) in shapes.items()}
    return {f"scenery/{name}.xml": "\n".join([*lines, "</scene>", ""]).encode(), **meshes}


def _geom_node(core: ModuleType, name: str, mesh: Mesh) -> Any:
    """A mesh as the engine draws it: flat faces, each with corners of its own."""
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


def _srgb(linear: Float64Array | Vector) -> Vector:
    """A linear colour as Panda3D has colours, which its software renderer shows as they are."""
    values = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    red, green, blue = np.where(
        values <= 0.0031308, 12.92 * values, 1.055 * values ** (1 / 2.4) - 0.055
    ).tolist()
    return (red, green, blue)


class BodyState(NamedTuple):
    """Where a body is and how it moves, in the axes of the run."""

    pose: Pose
    velocity: Vector
    """[m/s]"""
    yaw_rate: float
    """[rad/s], counter-clockwise."""


class Body:
    """A rigid body in Bullet that stays upright.

    Args:
        node: Its ``BulletRigidBodyNode``.
        path: ``NodePath`` of the node.
    """

    def __init__(self, node: Any, path: Any) -> None:
        self._node, self._path = node, path
        self._vector = panda3d_core().Vec3

    def place(self, position: Vector, yaw: float, velocity: Vector = (0.0, 0.0, 0.0)) -> None:
        """Put the body somewhere.

        Args:
            position: Of its centre [m].
            yaw: [rad], counter-clockwise from +x.
            velocity: [m/s]
        """
        self._path.setPosHpr(*position, math.degrees(yaw) - 90.0, 0.0, 0.0)
        self._node.setLinearVelocity(self._vector(*velocity))
        self._node.setAngularVelocity(self._vector(0.0, 0.0, 0.0))

    def push(self, wanted: Vector, acceleration: float) -> None:
        """Apply the force and the turn of one tick.

        Args:
            wanted: Velocity that the body is to have [m/s].
            acceleration: At most [m/s²].
        """
        seconds = TICK_NS / 1e9
        velocity = self.velocity
        change = [a - b for a, b in zip(wanted, velocity, strict=True)]
        size = math.hypot(*change)
        # Bullet adds force · time / mass to the velocity before it moves the body (semi-implicit Euler).
        scale = self._node.getMass() / seconds * min(1.0, acceleration * seconds / size if size else 1.0)
        self._node.applyCentralForce(self._vector(*(scale * part for part in change)))
        rate = 0.0
        if math.hypot(*velocity[:2]) > _STANDS:
            error = math.remainder(math.atan2(velocity[1], velocity[0]) - self.yaw, 2 * math.pi)
            rate = max(-_TURN, min(_TURN, error / _TURN_LAG))
        self._node.setAngularVelocity(self._vector(0.0, 0.0, rate if abs(rate) > _STILL else 0.0))

    @property
    def position(self) -> Vector:
        """Of its centre [m]."""
        x, y, z = self._path.getPos()
        return (x, y, z)

    @property
    def velocity(self) -> Vector:
        """[m/s]"""
        x, y, z = self._node.getLinearVelocity()
        return (x, y, z)

    @property
    def yaw(self) -> float:
        """[rad], counter-clockwise from +x."""
        return math.radians(self._path.getH() + 90.0)

    def state(self) -> BodyState:
        """Read the body, converted from the engine's axes."""
        pose = PANDA3D.to_enu(Pose(self.position, _unit(self._path.getQuat())))
        return BodyState(pose, self.velocity, self._node.getAngularVelocity()[2] + 0.0)


def _unit(quaternion: Any) -> UnitQuaternion:
    # Panda3D has single precision: its unit quaternions are good to 1e-7, those of a scene to 1e-9.
    w, x, y, z = quaternion
    size = math.sqrt(w * w + x * x + y * y + z * z)
    return (w / size, x / size, y / size, z / size)


class Physics:
    """Bodies that move in a level, stepped in ticks.

    Args:
        level: ``NodePath`` of what stands still.
    """

    def __init__(self, level: Any) -> None:
        from panda3d import bullet

        self._core, self._bullet = panda3d_core(), bullet
        self._world = bullet.BulletWorld()
        self._world.setGravity(self._core.Vec3(0.0, 0.0, 0.0))  # wheels and thrust hold what moves
        scenery = bullet.BulletRigidBodyNode("level")
        for path in level.findAllMatches("**/+GeomNode"):
            mesh = bullet.BulletTriangleMesh()
            for geom in path.node().getGeoms():
                mesh.addGeom(geom)
            if mesh.getNumTriangles():
                shape = bullet.BulletTriangleMeshShape(mesh, dynamic=False)
                scenery.addShape(shape, path.getTransform(level))
        scenery.setIntoCollideMask(self._core.BitMask32.bit(_SCENERY))
        if scenery.getNumShapes():
            self._attach(scenery)

    def add_vehicle(self, name: str, dimensions: Vector) -> Body:
        """Add a box that drives, and touches vehicles and UAVs.

        Args:
            name: Of the object.
            dimensions: Length, width and height [m].
        """
        length, width, height = dimensions
        shape = self._bullet.BulletBoxShape(self._core.Vec3(width / 2, length / 2, height / 2))
        return self._body(name, shape, 1500.0, self._core.BitMask32.bit(_VEHICLES))

    def add_uav(self, name: str, dimensions: Vector) -> Body:
        """Add a ball that flies, and touches everything.

        Args:
            name: Of the object.
            dimensions: Length, width and height [m]; the ball holds a box of this size.
        """
        shape = self._bullet.BulletSphereShape(math.hypot(*dimensions) / 2)
        bits = self._core.BitMask32
        return self._body(name, shape, 1.5, bits.bit(_SCENERY) | bits.bit(_VEHICLES) | bits.bit(_UAVS))

    def tick(self) -> None:
        """Step all bodies by `TICK_NS`."""
        # Without substeps, in which Bullet would keep a rest of the time for the next call.
        self._world.doPhysics(TICK_NS / 1e9, 0)

    def contacts(self) -> int:
        """Count the pairs of bodies that touch."""
        return sum(manifold.getNumManifoldPoints() > 0 for manifold in self._world.getManifolds())

    def _body(self, name: str, shape: Any, mass_kg: float, mask: Any) -> Body:
        node = self._bullet.BulletRigidBodyNode(name)
        node.addShape(shape)
        node.setMass(mass_kg)
        node.setAngularFactor(self._core.Vec3(0.0, 0.0, 1.0))
        node.setFriction(0.0)
        node.setLinearDamping(0.0)
        node.setAngularDamping(0.0)
        node.setDeactivationEnabled(False)
        node.setIntoCollideMask(mask)
        return Body(node, self._attach(node))

    def _attach(self, node: Any) -> Any:
        self._world.attach(node)
        return self._core.NodePath(node)


class Pictures:
    """Pictures of a scene by the engine's software renderer.

    Args:
        level: ``NodePath`` of what stands still.

    Raises:
        SetupError: The renderer cannot be loaded.
    """

    def __init__(self, level: Any) -> None:
        core = self._core = panda3d_core()
        self._engine = core.GraphicsEngine()
        pipes = core.GraphicsPipeSelection.getGlobalPtr()
        self._pipe = pipes.makePipe("TinyOffscreenGraphicsPipe", "p3tinydisplay")
        if self._pipe is None:
            raise SetupError("Panda3D has no p3tinydisplay, its software renderer; reinstall panda3d of PyPI")
        self._root = core.NodePath("scene")
        level.reparentTo(self._root)
        self._light()
        self._objects: dict[str, tuple[tuple[str, str], Any]] = {}
        self._meshes: dict[str, Any] = {}
        self._cameras: dict[CameraDevice, tuple[Any, Any, Any]] = {}

    def take(self, scene: Scene) -> Camera:
        """Move the objects to where a scene has them, and take a picture with each of its cameras.

        Args:
            scene: Of the world whose level this is.
        """
        self._show(scene)
        devices = [device for device in scene.devices if isinstance(device, CameraDevice)]
        optics = [_optics(device) for device in devices]
        for gone in self._cameras.keys() - set(optics):
            self._engine.removeWindow(self._cameras.pop(gone)[0])
        poses = [device_pose(scene, device) for device in devices]
        for optic, pose in zip(optics, poses, strict=True):
            if optic not in self._cameras:
                self._cameras[optic] = self._camera(optic)
            self._put(self._cameras[optic][2], pose)
        if devices:
            self._engine.renderFrame()
        return Camera(
            images=tuple(
                CameraImage(
                    sensor=device.name,
                    intrinsics=intrinsics(device),
                    position=pose.position,
                    orientation=pose.orientation,
                    rgb=self._pixels(self._cameras[optic][1]),
                )
                for device, optic, pose in zip(devices, optics, poses, strict=True)
            )
        )

    def warm_up(self) -> None:
        """Take a picture of the level alone, so that the first frame does not wait for the renderer to load."""
        nothing = np.zeros((0, 3))
        self.take(
            Scene(
                names=(),
                classes=(),
                assets=(),
                position=nothing,
                orientation=np.zeros((0, 4)),
                velocity=nothing,
                dimensions=nothing,
                devices=(CameraDevice(name="warm-up", width=8, height=6, position=(0.0, 0.0, 2.0)),),
            )
        )

    def close(self) -> None:
        """Release the buffers."""
        self._cameras.clear()
        self._engine.removeAllWindows()

    def _light(self) -> None:
        core = self._core
        sky, sun = core.AmbientLight("sky"), core.DirectionalLight("sun")
        sky.setColor((0.5, 0.52, 0.56, 1.0))
        sun.setColor((0.6, 0.57, 0.5, 1.0))
        # Where the sun of the ray-traced pictures stands: azimuth −55°, elevation 45°.
        azimuth, elevation = math.radians(-55.0), math.radians(45.0)
        level = -math.cos(elevation)
        ray = (level * math.cos(azimuth), level * math.sin(azimuth), -math.sin(elevation))
        sun.setDirection(core.Vec3(*ray))
        for light in (sky, sun):
            self._root.setLight(self._root.attachNewNode(light))
        # Without a material the renderer lights the colour of a node and multiplies by that colour again.
        white = core.Material()
        white.setAmbient((1.0, 1.0, 1.0, 1.0))
        white.setDiffuse((1.0, 1.0, 1.0, 1.0))
        self._root.setMaterial(white)

    def _show(self, scene: Scene) -> None:
        for gone in self._objects.keys() - set(scene.names):
            self._objects.pop(gone)[1].removeNode()
        for index, name in enumerate(scene.names):
            look = scene.assets[index], scene.classes[index]
            kept = self._objects.get(name)
            if kept is None or kept[0] != look:
                if kept is not None:
                    kept[1].removeNode()
                node = self._root.attachNewNode(name)
                self._mesh(scene.assets[index]).copyTo(node)
                node.setColor(*_srgb(object_colour(scene.classes[index], name, {})), 1.0)
                self._objects[name] = look, node
            node = self._objects[name][1]
            self._put(node, object_pose(scene, index))
            length, width, height = scene.dimensions[index].tolist()
            node.setScale(width, length, height)

    def _mesh(self, asset: str) -> Any:
        """The unit mesh of an asset, turned to the engine's body axes."""
        if asset not in self._meshes:
            make = SHAPES.get(PurePosixPath(asset).stem, unit_box)
            mesh = make()
            turned = Mesh(mesh.vertices @ np.array(PANDA3D.body).T, mesh.faces)
            self._meshes[asset] = self._core.NodePath(_geom_node(self._core, asset or "box", turned))
        return self._meshes[asset]

    def _put(self, node: Any, pose: Pose) -> None:
        there = PANDA3D.from_enu(pose)
        node.setPosQuat(self._core.Point3(*there.position), self._core.Quat(*there.orientation))

    def _camera(self, device: CameraDevice) -> tuple[Any, Any, Any]:
        """Buffer, texture and ``NodePath`` of a camera."""
        core = self._core
        wanted = core.FrameBufferProperties()
        wanted.setRgbColor(True)
        wanted.setDepthBits(24)
        size = core.WindowProperties.size(device.width, device.height)
        refuse = core.GraphicsPipe.BF_refuse_window
        buffer = self._engine.makeOutput(self._pipe, device.name, 0, wanted, size, refuse)
        if buffer is None:
            raise SetupError(
                f"Panda3D makes no buffer of {device.width} × {device.height} pixels for camera "
                f"{device.name!r}; make its size_px smaller"
            )
        buffer.setClearColor(core.Vec4(*_SKY))
        texture = core.Texture()
        buffer.addRenderTexture(texture, core.GraphicsOutput.RTM_copy_ram)
        eye = core.Camera(device.name)
        lens = eye.getLens()
        lens.setAspectRatio(device.width / device.height)
        lens.setFov(math.degrees(device.field_of_view))
        lens.setNearFar(0.1, 3000.0)
        path = self._root.attachNewNode(eye)
        buffer.makeDisplayRegion().setCamera(path)
        return buffer, texture, path

    def _pixels(self, texture: Any) -> Any:
        rows = np.frombuffer(texture.getRamImageAs("RGB"), np.uint8)
        # The engine begins at the bottom.
        return rows.reshape(texture.getYSize(), texture.getXSize(), 3)[::-1].copy()


def _optics(device: CameraDevice) -> CameraDevice:
    """What of a camera its buffer depends on."""
    return CameraDevice(
        name=device.name, width=device.width, height=device.height, field_of_view=device.field_of_view
    )
