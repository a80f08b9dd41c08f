"""Rotations and poses in the one convention of CAVIAR.

Right-handed ENU metres, yaw counter-clockwise from +x, quaternions (w, x, y, z) that rotate body
axes into world axes. Adapters of other conventions convert at their edge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import numpy as np

from caviar_protocol.arrays import Float64Array

Vector = tuple[float, float, float]
UnitQuaternion = tuple[float, float, float, float]

SPEED_OF_LIGHT = 299_792_458.0
"""[m/s] in vacuum, exact (SI)."""


N = TypeVar("N", float, Float64Array)
"""A number, or an array of them."""


class Pose(NamedTuple):
    """Position and orientation of a body in the world.

    Args:
        position: (x, y, z) [m].
        orientation: Unit quaternion (w, x, y, z) that rotates body axes into world axes.

    Example:
        >>> Pose((10.0, 0.0, 1.5), quaternion_from_euler(0.0)).orientation
        (1.0, 0.0, 0.0, 0.0)
    """

    position: Vector
    orientation: UnitQuaternion


def dot(a: Vector, b: Vector) -> float:
    """Inner product; of single vectors a fifth of the time of NumPy's.

    Example:
        >>> dot((1.0, 2.0, 3.0), (1.0, 0.0, 1.0))
        4.0
    """
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def quaternion_from_euler(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> UnitQuaternion:
    """Unit quaternion of intrinsic z–y′–x″ rotations, equal to Sionna RT's (α, β, γ) orientation.

    Args:
        yaw: Counter-clockwise seen from above [rad].
        pitch: Right-handed about +y, so that positive pitch lowers the nose [rad].
        roll: About +x [rad].

    Example:
        >>> [round(part, 3) for part in quaternion_from_euler(math.pi / 2)]  # from east to north
        [0.707, 0.0, 0.0, 0.707]
    """
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    return (
        cy * cp * cr + sy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
    )


def euler_from_quaternion(q: Sequence[float]) -> Vector:
    """Yaw, pitch and roll [rad] of a unit quaternion; the inverse of `quaternion_from_euler`.

    Args:
        q: Unit quaternion (w, x, y, z).

    Example:
        >>> [round(angle, 6) for angle in euler_from_quaternion(quaternion_from_euler(0.3, 0.2, 0.1))]
        [0.3, 0.2, 0.1]
    """
    w, x, y, z = q
    # Rounding takes the sine of a vertical nose out of asin's range.
    sin_pitch = max(-1.0, min(1.0, 2 * (w * y - z * x)))
    return (
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
        math.asin(sin_pitch),
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
    )


def rotation_matrix(q: Sequence[float] | Float64Array) -> Float64Array:
    """Rotation matrix R of a unit quaternion, Shape ``[3, 3]``: world = R · body.

    Args:
        q: Unit quaternion (w, x, y, z); of N an array of Shape ``[4, N]``, for matrices of Shape
            ``[3, 3, N]``.

    Example:
        >>> north = rotation_matrix(quaternion_from_euler(math.pi / 2)) @ (1.0, 0.0, 0.0)
        >>> north.round(6).tolist()
        [0.0, 1.0, 0.0]
    """
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotated(q: Sequence[float], v: Sequence[float]) -> Vector:
    """World components of one vector given in body axes, without an array.

    Args:
        q: Unit quaternion (w, x, y, z) of the body.
        v: Components in body axes.

    Returns:
        R·v with the `rotation_matrix` R.

    Example:
        >>> [round(x, 6) for x in rotated(quaternion_from_euler(math.pi / 2), (1.0, 0.0, 0.0))]
        [0.0, 1.0, 0.0]
    """
    # Written out: for one vector a NumPy call costs more than all of these products.
    w, x, y, z = q
    a, b, c = v
    return (
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y - w * z) * b + 2 * (x * z + w * y) * c,
        2 * (x * y + w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z - w * x) * c,
        2 * (x * z - w * y) * a + 2 * (y * z + w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    )


def unrotated(q: Sequence[N], v: Sequence[N]) -> tuple[N, N, N]:
    """Body components of one vector given in world axes: the inverse of `rotated`, by the transposed matrix.

    Args:
        q: Unit quaternion (w, x, y, z) of the body.
        v: Components in world axes; of many vectors an array each.

    Example:
        >>> [round(x, 6) for x in unrotated(quaternion_from_euler(math.pi / 2), (0.0, 1.0, 0.0))]
        [1.0, 0.0, 0.0]
    """
    w, x, y, z = q
    a, b, c = v
    return (
        (1 - 2 * (y * y + z * z)) * a + 2 * (x * y + w * z) * b + 2 * (x * z - w * y) * c,
        2 * (x * y - w * z) * a + (1 - 2 * (x * x + z * z)) * b + 2 * (y * z + w * x) * c,
        2 * (x * z + w * y) * a + 2 * (y * z - w * x) * b + (1 - 2 * (x * x + y * y)) * c,
    )


def multiply(p: Sequence[float], q: Sequence[float]) -> UnitQuaternion:
    """Hamilton product p·q of two quaternions: the rotation q, followed by p.

    Args:
        p: Unit quaternion (w, x, y, z).
        q: Unit quaternion (w, x, y, z).

    Example:
        >>> eighth = quaternion_from_euler(math.pi / 4)
        >>> [round(part, 6) for part in multiply(eighth, eighth)]  # a quarter turn
        [0.707107, 0.0, 0.0, 0.707107]
    """
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return (
        pw * qw - px * qx - py * qy - pz * qz,
        pw * qx + px * qw + py * qz - pz * qy,
        pw * qy - px * qz + py * qw + pz * qx,
        pw * qz + px * qy - py * qx + pz * qw,
    )


def compose(parent: Pose, mount: Pose) -> Pose:
    """World pose of something that is mounted on a parent.

    Args:
        parent: World pose of the parent.
        mount: Pose relative to the parent, in its axes.

    Example:
        >>> bus = Pose((10.0, 0.0, 1.5), quaternion_from_euler(math.pi / 2))
        >>> [round(x, 6) for x in compose(bus, Pose((2.0, 0.0, 1.5), (1.0, 0.0, 0.0, 0.0))).position]
        [10.0, 2.0, 3.0]
    """
    x, y, z = rotated(parent.orientation, mount.position)
    px, py, pz = parent.position
    return Pose((px + x, py + y, pz + z), multiply(parent.orientation, mount.orientation))


def direction(zenith: float, azimuth: float) -> Float64Array:
    """Unit vector of a direction, Shape ``[3]``.

    Args:
        zenith: Angle from +z [rad].
        azimuth: Counter-clockwise from +x [rad].

    Example:
        >>> direction(math.pi / 2, math.pi).round(6).tolist()  # west
        [-1.0, 0.0, 0.0]
    """
    return np.array(
        [
            math.sin(zenith) * math.cos(azimuth),
            math.sin(zenith) * math.sin(azimuth),
            math.cos(zenith),
        ]
    )


def angles(vectors: Float64Array) -> Float64Array:
    """Zenith and azimuth [rad] of vectors.

    Args:
        vectors: Of any length but 0, Shape ``[..., 3]``.

    Returns:
        (zenith from +z, azimuth from +x), Shape ``[..., 2]``. Zenith is the atan2 of the horizontal part, so
        that directions near the poles keep their precision.

    Example:
        >>> angles(np.array([0.0, 2.0, 0.0])).round(6).tolist()  # north
        [1.570796, 1.570796]
    """
    found = np.empty((*vectors.shape[:-1], 2))
    found[..., 0] = np.arctan2(np.hypot(vectors[..., 0], vectors[..., 1]), vectors[..., 2])
    found[..., 1] = np.arctan2(vectors[..., 1], vectors[..., 0])
    return found


def unit_vectors(angles: Float64Array) -> Float64Array:
    """Unit vectors of directions, the inverse of `angles`.

    Args:
        angles: (zenith from +z, azimuth from +x) [rad], Shape ``[..., 2]``.

    Returns:
        Shape ``[..., 3]``.

    Example:
        >>> unit_vectors(np.array([np.pi / 2, np.pi / 2])).round(9).tolist()  # north
        [0.0, 1.0, 0.0]
    """
    zenith, azimuth = angles[..., 0], angles[..., 1]
    sine = np.sin(zenith)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=-1)
