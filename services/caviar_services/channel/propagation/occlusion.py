"""Which straight lines boxes block: the line of sight where there is no ray tracer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.space.coordinates import rotation_matrix
from caviar_protocol.topics import Scene


@dataclass(frozen=True, eq=False)
class Boxes:
    """N boxes of any orientation."""

    names: tuple[str, ...]
    centre: Float64Array
    """[m], Shape ``[N, 3]``."""
    rotation: Float64Array
    """Turns a box's axes into world axes, Shape ``[N, 3, 3]``."""
    half: Float64Array
    """Half of each edge [m], Shape ``[N, 3]``."""

    @classmethod
    def aligned(cls, corners: Sequence[tuple[Sequence[float], Sequence[float]]]) -> Boxes:
        """Boxes along the world's axes from their lowest and highest corners [m]."""
        low = np.array([low for low, _ in corners], np.float64).reshape(-1, 3)
        high = np.array([high for _, high in corners], np.float64).reshape(-1, 3)
        turned = np.broadcast_to(np.eye(3), (len(low), 3, 3))
        return cls(("",) * len(low), (low + high) / 2, turned, (high - low) / 2)

    @classmethod
    def of(cls, scene: Scene) -> Boxes:
        """The bounding boxes of a scene's objects."""
        turned = [rotation_matrix(q) for q in scene.orientation.tolist()]
        rotation = np.array(turned, np.float64).reshape(-1, 3, 3)
        return cls(scene.names, scene.position, rotation, scene.dimensions / 2)

    def block(self, start: Float64Array, end: Float64Array) -> BoolArray:
        """Whether each segment passes through each box; Shapes ``[Q, 3]``, ``[Q, 3]`` to ``[Q, N]``.

        A segment that only touches a face or an edge is not blocked. By slabs (Kay and Kajiya 1986).
        """
        # Shape [Q, N, 3], in the axes of each box
        origin = np.einsum("qni,nij->qnj", start[:, None] - self.centre, self.rotation)
        along = np.einsum("qi,nij->qnj", end - start, self.rotation)
        outside = (along == 0) & (np.abs(origin) >= self.half)
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (-self.half - origin) / along, (self.half - origin) / along
        near = np.where(along == 0, -np.inf, np.minimum(one, other)).max(-1)
        far = np.where(along == 0, np.inf, np.maximum(one, other)).min(-1)
        blocked: BoolArray = (np.maximum(near, 0) < np.minimum(far, 1)) & ~outside.any(-1)
        return blocked
