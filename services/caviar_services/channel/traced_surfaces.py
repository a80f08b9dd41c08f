"""What traced paths meet, in the float64 coordinates of the scene's own meshes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array, UInt8Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.element_paths import Surfaces
from caviar_services.channel.sionna_scene import SionnaScene
from caviar_services.channel.sionna_traced import Traced

_SAME_CORNER = 0.01
"""[m]; a corner of a mesh this near the end of an edge is that end."""


def traced_surfaces(
    launches: Sequence[Traced],
    traced: Int64Array,
    types: UInt8Array,
    points: Float64Array,
    scene: SionnaScene,
) -> Surfaces:
    """Surfaces of some paths of all launches: ``traced`` are their numbers, −1 for paths that meet nothing.

    ``types`` and ``points`` are those of the table.
    """
    depth = types.shape[1]
    # Nothing stands at the end, where −1 finds it.
    none = np.zeros((1, depth), np.int64)
    shapes = np.concatenate([*(launch.shapes for launch in launches), none])[traced]
    primitives = np.concatenate([*(launch.primitives for launch in launches), none])[traced]
    edge = np.concatenate([*(launch.wedge.ends for launch in launches), np.zeros((1, 2, 3))])[traced]
    outward = np.concatenate([*(launch.wedge.outward for launch in launches), np.zeros((1, 3))])[traced]
    settled = np.concatenate([*(launch.settled for launch in launches), np.zeros(1, np.bool_)])[traced]
    triangles = scene.triangle_numbers(shapes, primitives)
    bent = types == Interaction.DIFFRACTION
    some = np.flatnonzero(bent.any(1))
    if len(some):
        at = np.argmax(bent[some], axis=1)
        edge[some] = _snapped(edge[some], scene.corners(triangles[some, at]))
    origin, normal = scene.planes(shapes, primitives)
    return Surfaces(
        types=types,
        points=points,
        origin=origin,
        plane=scene.surface_of[triangles],
        normal=normal,
        edge=edge,
        outward=outward,
        settled=settled,
    )


def _snapped(ends: Float64Array, corners: Float64Array) -> Float64Array:
    """Ends ``[P, 2, 3]`` at the nearest of the corners ``[P, 3, 3]``, where one is there."""
    apart = np.sqrt(((ends[:, :, None] - corners[:, None]) ** 2).sum(-1))
    nearest: Int64Array = np.argmin(apart, axis=-1)
    rows = np.arange(len(ends))[:, None]
    there = np.take_along_axis(apart, nearest[..., None], axis=-1) < _SAME_CORNER
    return np.where(there, corners[rows, nearest], ends)
