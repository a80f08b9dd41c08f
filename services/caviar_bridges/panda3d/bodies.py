"""Bodies of the world ``panda3d`` in Bullet, which a run steps in ticks of equal length."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from caviar_bridges.panda3d.level import PANDA3D, panda3d_core
from caviar_protocol.space.coordinates import Pose, UnitQuaternion, Vector

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


class BodyState(NamedTuple):
    """Position and motion of a body, in the axes of the run."""

    pose: Pose
    velocity: Vector
    """Velocity [m/s]."""
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
        """Position of its centre [m]."""
        x, y, z = self._path.getPos()
        return (x, y, z)

    @property
    def velocity(self) -> Vector:
        """Velocity [m/s]."""
        x, y, z = self._node.getLinearVelocity()
        return (x, y, z)

    @property
    def yaw(self) -> float:
        """Yaw [rad], counter-clockwise from +x."""
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
