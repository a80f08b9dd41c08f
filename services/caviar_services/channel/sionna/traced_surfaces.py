"""What traced paths meet, in the float64 coordinates of the scene's own meshes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array, UInt8Array
from caviar_services.channel.arrays.element_paths import Surfaces
from caviar_services.channel.sionna.path_buffer import Traced
from caviar_services.channel.sionna.scene import SionnaScene


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
    edge = np.concatenate([*(launch.edge for launch in launches), [-1]])[traced]
    settled = np.concatenate([*(launch.settled for launch in launches), np.zeros(1, np.bool_)])[traced]
    triangles = scene.triangle_numbers(shapes, primitives)
    edges = scene.edges
    count = len(traced)
    origin, normal = scene.planes(shapes, primitives)
    return Surfaces(
        types=types,
        points=points,
        origin=origin,
        plane=scene.surface_of[triangles],
        normal=normal,
        edge=np.zeros((count, 2, 3)) if edges is None else edges.ends(edge),
        outward=np.zeros((count, 3)) if edges is None else edges.outward(edge),
        settled=settled,
    )
