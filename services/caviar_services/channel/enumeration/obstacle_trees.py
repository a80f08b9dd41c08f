"""Trees of boxes around the triangles of a scene, one of scenery and one of each body: what stands first on a
segment, in float64, without the ray tracer.

The tree of a mesh is built once and fitted to where its body stands. So a frame in which no rays are launched
needs no update of the ray tracer's scene.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.enumeration.image_beams import path_kernels
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_space.planes import COPLANAR, COPLANAR_RELATIVE

OFF_SURFACE = 2e-4
"""[m]; rays from face to face start this far from the first face, whose points are rounded."""

AT_END = 1e-3
"""[m]; what a ray meets this near to its end is what it ends at: two faces meet there, or are one."""


class ObstacleTrees:
    """Obstacles of a scene: scenery, and bodies where they were placed last.

    Args:
        scene: The scene; coordinates are those of its ray tracer.
    """

    def __init__(self, scene: SionnaScene) -> None:
        self._scene = scene
        self._corners = scene.triangle_vertices.astype(np.int64)
        kinds = {b: kind for kind in scene.unit_meshes for b in scene.bodies_of(kind).tolist()}
        # Triangles of bodies come last, body after body.
        begin = [0, *(scene.begin_of(scene.first_body_piece + body)[1] for body in sorted(kinds))]
        still = scene.relative[self._corners[: begin[1] if kinds else None]]
        of_kind = {k: path_kernels.build(m.vertices[m.faces].sum(1)) for k, m in scene.unit_meshes.items()}
        made = [path_kernels.build(still.sum(1)), *(of_kind[kinds[body]] for body in sorted(kinds))]
        ends = np.cumsum([len(nodes) for nodes, _ in made])
        nodes = np.concatenate([nodes for nodes, _ in made])
        order = np.concatenate([order for _, order in made])
        self._trees = np.column_stack([np.append(0, ends[:-1]), ends])
        for (first, past), offset in zip(self._trees.tolist(), begin, strict=True):
            own = nodes[first:past]
            own[own[:, 0] >= 0, 0] += first
            own[:, 1:] += offset
            order[own[0, 1] : own[0, 2]] += offset
        self._all = nodes, order, np.zeros((len(nodes), 6)), np.zeros((len(self._corners), 9))
        self._fit(self._trees[:1])
        self._version, self._standing = -1, self._trees[:1]

    def _fit(self, trees: Int64Array) -> None:
        path_kernels.fit(self._all, trees, self._scene.relative, self._corners)

    def _fitted(self) -> tuple[Int64Array, Any]:
        """First and last node of the trees of what stands, and all trees, as the scene stands."""
        if self._version != self._scene.version:
            bodies = 1 + np.array(self._scene.standing_bodies, np.int64)
            self._version, self._standing = self._scene.version, self._trees[np.append(0, bodies)]
            self._fit(self._standing[1:])
        return self._standing, self._all

    def first_triangle(self, start: Float64Array, end: Float64Array) -> tuple[Float64Array, Int64Array]:
        """Look along segments.

        Args:
            start, end: [m], Shape ``[Q, 3]``.

        Returns:
            How much farther than a segment's end [m] the first triangle along it is, at most 0 and infinite
            where there is none, and its number, −1 where there is none; each of Shape ``[Q]``.
        """
        start, end = np.ascontiguousarray(start), np.ascontiguousarray(end)
        behind, triangle = path_kernels.first_met(start, end, *self._fitted())
        return behind, triangle

    def unhidden(self, *paths: Float64Array | Int64Array) -> BoolArray:
        """Mask of paths without an obstacle; the arguments are the first ones of `path_kernels.unhidden`."""
        scene, planes = self._scene, self._scene.plane_table
        tolerances = OFF_SURFACE, AT_END, COPLANAR, COPLANAR_RELATIVE
        free: BoolArray = path_kernels.unhidden(
            *paths, *self._fitted(), scene.surface_of, planes.normal, planes.origin, *tolerances
        )
        return free
