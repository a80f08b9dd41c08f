"""Axes and units of game engines and flight simulators: poses to and from the one convention of CAVIAR.

In every convention the front of a body lies along the axis that its users call forward. Where world and body
axes follow one rule, as in Unreal, Unity and Godot, a mount on a body converts like a pose in the world.
`clients/axes.json` has poses in all of them, as vectors for clients in other languages.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from caviar_protocol.arrays import Float64Array, Int32Array
from caviar_protocol.space.coordinates import Pose, UnitQuaternion, Vector, multiply

_HALF = 0.5**0.5
_Rows: TypeAlias = tuple[Vector, Vector, Vector]


class Motion(NamedTuple):
    """Motion of a body.

    Args:
        velocity: In world axes, a length a second.
        angular_velocity: In world axes, rad/s; its direction is the axis about which a right hand turns (in
            left-handed axes a left hand).
    """

    velocity: Vector
    angular_velocity: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class EngineAxes:
    """Axes and unit of length of an engine.

    Args:
        name: Of the engine.
        world: 3 × 3, takes a direction in ENU to the engine's world axes; its determinant is −1 where these
            are left-handed.
        body: The same from a body's axes (forward, left, up) to the engine's.
        unit: Length in the engine of 1 m.
        clockwise: Whether its triangles are clockwise as seen from outside, as Unity and Godot have them;
            those of Unreal are counter-clockwise: what the eye sees counts, not the hand of the axes.

    Example:
        >>> UNREAL.from_enu(Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))).position
        (100.0, -200.0, 300.0)
    """

    name: str
    world: _Rows
    body: _Rows
    unit: float = 1.0
    clockwise: bool = False

    def from_enu(self, pose: Pose) -> Pose:
        """Convert a pose from ENU metres.

        Args:
            pose: Position [m] and unit quaternion (w, x, y, z), body to world.

        Returns:
            Position in the engine's unit, and its unit quaternion (w, x, y, z), w ≥ 0.
        """
        return Pose(
            _scaled(self.unit, self._to_world(pose.position)),
            _conjugated(pose.orientation, self.world, self.body),
        )

    def to_enu(self, pose: Pose) -> Pose:
        """Convert a pose of the engine to ENU metres.

        Args:
            pose: Position in the engine's unit, and unit quaternion (w, x, y, z).

        Example:
            >>> UNITY.to_enu(Pose((-2.0, 3.0, 1.0), (1.0, 0.0, 0.0, 0.0))).position
            (1.0, 2.0, 3.0)
        """
        position = _scaled(1.0 / self.unit, _vector(np.array(self.world).T @ pose.position))
        return Pose(position, _conjugated(pose.orientation, _transposed(self.world), _transposed(self.body)))

    def motion_from_enu(self, motion: Motion) -> Motion:
        """Convert velocities from ENU, m/s and rad/s.

        Args:
            motion: In world axes.
        """
        return Motion(
            _scaled(self.unit, self._to_world(motion.velocity)),
            _scaled(self._hand, self._to_world(motion.angular_velocity)),
        )

    def motion_to_enu(self, motion: Motion) -> Motion:
        """Convert velocities of the engine to ENU, m/s and rad/s.

        Args:
            motion: In the engine's world axes and unit.
        """
        world = np.array(self.world).T
        return Motion(
            _scaled(1.0 / self.unit, _vector(world @ motion.velocity)),
            _scaled(self._hand, _vector(world @ motion.angular_velocity)),
        )

    def mesh_to_enu(self, vertices: ArrayLike, triangles: ArrayLike) -> tuple[Float64Array, Int32Array]:
        """Convert a mesh of the engine, as it gives it, to one for `Engine.offer_mesh`.

        Args:
            vertices: In the engine's body axes and unit, Shape ``[V, 3]``.
            triangles: Vertices of each, wound as the engine does, Shape ``[F, 3]``.

        Returns:
            Vertices forward, left, up [m], and triangles counter-clockwise as seen from outside; the second
            and third corner change places where the engine has them clockwise.

        Example:
            >>> vertices, triangles = UNITY.mesh_to_enu([(0, 0, 1), (1, 0, 0), (0, 2, 0)], [(0, 1, 2)])
            >>> vertices.tolist(), triangles.tolist()
            ([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 2.0]], [[0, 2, 1]])
        """
        points = np.asarray(vertices, np.float64).reshape(-1, 3) @ np.array(self.body) / self.unit + 0.0
        corners = np.asarray(triangles, np.int32).reshape(-1, 3)
        return points, corners[:, [0, 2, 1]] if self.clockwise else corners

    def _to_world(self, vector: Vector) -> Vector:
        return _vector(np.array(self.world) @ vector)

    @property
    def _hand(self) -> float:
        # An angular velocity is a pseudovector: a reflection turns it round.
        return float(round(np.linalg.det(np.array(self.world))))


UNREAL = EngineAxes(
    "unreal",
    world=((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    body=((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    unit=100.0,
)
"""Left-handed centimetres: x east and forward, y south and right, z up."""
UNITY = EngineAxes(
    "unity",
    world=((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
    body=((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
    clockwise=True,
)
"""Left-handed metres: x south and right, y up, z east and forward."""
GODOT = EngineAxes(
    "godot",
    world=((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)),
    body=((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)),
    clockwise=True,
)
"""Right-handed metres: x south and right, y up, z west and back."""
NED = EngineAxes(
    "ned",
    world=((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    body=((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)),
)
"""North, east, down, as AirSim and MAVLink have it; bodies forward, right, down."""

ENGINES = {axes.name: axes for axes in (UNREAL, UNITY, GODOT, NED)}
"""By name."""


def _conjugated(q: Sequence[float], world: _Rows, body: _Rows) -> UnitQuaternion:
    """Orientation in other axes: W·R·Bᵀ as a quaternion, w ≥ 0.

    With W = s·P and B = s·Q, where P and Q are rotations and s = ±1 is their determinant, it is P·R·Qᵀ: the
    sign cancels.
    """
    w, x, y, z = multiply(multiply(_turn(world), q), _inverse(_turn(body)))
    sign = -1.0 if w < 0.0 else 1.0
    return (sign * w, sign * x, sign * y, sign * z)


@lru_cache
def _turn(rows: _Rows) -> UnitQuaternion:
    """The rotation that is left of axes without their reflection; it takes 0.1 ms to find."""
    matrix = np.array(rows)
    return _quaternion(round(float(np.linalg.det(matrix))) * matrix)


def _transposed(rows: _Rows) -> _Rows:
    (a, b, c), (d, e, f), (g, h, i) = rows
    return ((a, d, g), (b, e, h), (c, f, i))


def _quaternion(matrix: Float64Array) -> UnitQuaternion:
    """Unit quaternion of a rotation matrix of quarter and half turns, exact but for the rounding of √½."""
    # (w, x, y, z) is the eigenvector of the greatest eigenvalue of this matrix (Bar-Itzhack 2000, eq. 1).
    (a, b, c), (d, e, f), (g, h, i) = matrix.tolist()
    symmetric = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    vector = np.linalg.eigh(symmetric)[1][:, -1]
    # Eigenvectors are good to 1e-16, parts of such turns are 0, ½, √½ or 1.
    parts = [min((0.0, 0.5, _HALF, 1.0), key=lambda exact: abs(exact - abs(part))) for part in vector]
    w, x, y, z = (float(np.copysign(exact, part)) for exact, part in zip(parts, vector, strict=True))
    return (w, x, y, z)


def _inverse(q: UnitQuaternion) -> UnitQuaternion:
    return (q[0], -q[1], -q[2], -q[3])


def _vector(values: Float64Array) -> Vector:
    x, y, z = values.tolist()
    return (x, y, z)


def _scaled(factor: float, vector: Vector) -> Vector:
    # Adding 0 makes −0 to 0.
    return (factor * vector[0] + 0.0, factor * vector[1] + 0.0, factor * vector[2] + 0.0)
