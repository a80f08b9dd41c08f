"""Meshes of moving objects, and the pool of bodies that stand for them in a channel's ray tracer.

An object's mesh is a *unit* mesh: its bounding box is −½…½ on every axis, x forward, z up. It is
scaled by the object's dimensions, turned and moved. Ray tracers rebuild little when vertices
change and much when bodies come or go, so the channel keeps a pool of bodies and parks the unused ones.
Sensors need nothing of a body but its triangles, and hold those of the frame alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import Float64Array, Int32Array
from caviar_protocol.errors import PayloadError
from caviar_protocol.space.coordinates import Pose, rotation_matrix


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: vertices [m], Shape ``[V, 3]``; faces, Shape ``[F, 3]``, outward normals by the
    right-hand rule."""

    vertices: Float64Array
    faces: Int32Array


def placed(mesh: Mesh, dimensions: Float64Array, pose: Pose) -> Float64Array:
    """World vertices [m], Shape ``[V, 3]``, of a unit mesh scaled by ``dimensions`` [3] at a pose."""
    world: Float64Array = (mesh.vertices * dimensions) @ rotation_matrix(pose.orientation).T + np.array(
        pose.position
    )
    return world


_BOX_FACES = np.array(
    [
        [0, 2, 1], [0, 3, 2],  # −z
        [4, 5, 6], [4, 6, 7],  # +z
        [0, 1, 5], [0, 5, 4],  # −y
        [2, 3, 7], [2, 7, 6],  # +y
        [0, 4, 7], [0, 7, 3],  # −x
        [1, 2, 6], [1, 6, 5],  # +x
    ],
    dtype=np.int32,
)  # fmt: skip


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Mesh:
    """Axis-aligned box between the given bounds [m]: 8 vertices, 12 faces."""
    (x0, x1), (y0, y1), (z0, z1) = x, y, z
    corners = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    return Mesh(
        np.array([(*corner, z0) for corner in corners] + [(*corner, z1) for corner in corners]),
        _BOX_FACES.copy(),
    )


def unit_box() -> Mesh:
    """The unit mesh of an object without one of its own."""
    return box((-0.5, 0.5), (-0.5, 0.5), (-0.5, 0.5))


class BodyPool:
    """Which body of a ray tracer stands for which object of the scene.

    Every asset has ``capacity[asset]`` bodies. An object keeps its body as long as it is in the
    scene; one that leaves frees it for the next. Names are assigned in sorted order, so that the
    assignment depends only on the sequence of scenes.
    """

    def __init__(self, capacity: Mapping[str, int]) -> None:
        self._free = {asset: list(range(count))[::-1] for asset, count in capacity.items()}
        self._capacity = dict(capacity)
        self._taken: dict[str, tuple[str, int]] = {}

    def assign(self, objects: Iterable[tuple[str, str]]) -> dict[str, tuple[str, int]]:
        """Body (asset, slot) of each (name, asset) in the scene.

        Raises `PayloadError` naming the asset where there are more objects than bodies.
        """
        wanted = dict(objects)
        for name in [n for n, (asset, _) in self._taken.items() if wanted.get(n) != asset]:
            asset, slot = self._taken.pop(name)
            self._free[asset].append(slot)
            self._free[asset].sort(reverse=True)
        for name in sorted(wanted.keys() - self._taken.keys()):
            asset = wanted[name]
            if not self._free.get(asset):
                raise PayloadError(
                    f"object {name!r} needs another body of {asset or 'the box'!r}, the pool has "
                    f"{self._capacity.get(asset, 0)}; raise the pool size in the service's settings"
                )
            self._taken[name] = (asset, self._free[asset].pop())
        return dict(self._taken)
