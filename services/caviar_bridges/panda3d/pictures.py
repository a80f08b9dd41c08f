"""Pictures of the world ``panda3d`` by the software renderer of Panda3D, without a display."""

from __future__ import annotations

import math
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from caviar_bridges.panda3d.level import PANDA3D, geom_node, panda3d_core, srgb_of
from caviar_protocol.arrays import UInt8Array
from caviar_protocol.errors import SetupError
from caviar_protocol.space.coordinates import Pose
from caviar_protocol.space.scene import device_pose, object_pose
from caviar_protocol.topics import Camera, CameraDevice, CameraImage, Scene
from caviar_services.sensors.camera import intrinsics
from caviar_services.sensors.shading import object_colour
from caviar_space.meshes import SHAPES, Mesh, unit_box

_SKY = (0.72, 0.82, 0.93, 1.0)


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
        """Take a picture of the level alone: the first one loads the renderer."""
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
                node.setColor(*srgb_of(object_colour(scene.classes[index], name, {})), 1.0)
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
            self._meshes[asset] = self._core.NodePath(geom_node(self._core, asset or "box", turned))
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

    def _pixels(self, texture: Any) -> UInt8Array:
        rows = np.frombuffer(texture.getRamImageAs("RGB"), np.uint8)
        # The engine begins at the bottom.
        return rows.reshape(texture.getYSize(), texture.getXSize(), 3)[::-1].copy()


def _optics(device: CameraDevice) -> CameraDevice:
    """Properties of a camera on which its buffer depends."""
    return CameraDevice(
        name=device.name, width=device.width, height=device.height, field_of_view=device.field_of_view
    )
