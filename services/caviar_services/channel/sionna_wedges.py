"""Where traced paths are diffracted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array


@dataclass(frozen=True, eq=False)
class Wedges:
    """The wedge at which each of P paths is diffracted; anything for paths that are not."""

    ends: Float64Array
    """Both ends [m] of the edge, Shape ``[P, 2, 3]``."""
    outward: Float64Array
    """Unit vector between the normals of both faces, Shape ``[P, 3]``; 0 for the edge of a single face."""
    faces: Int64Array
    """Triangles on both sides, of the shape that the path meets there, Shape ``[P, 2]``."""

    @classmethod
    def none(cls, count: int) -> Wedges:
        """Of so many paths that are not diffracted."""
        return cls(np.zeros((count, 2, 3)), np.zeros((count, 3)), np.zeros((count, 2), np.int64))

    @classmethod
    def of(cls, buffer: Any) -> Wedges:
        """Of the paths in the ray tracer's buffer."""
        import drjit as dr

        wedges = buffer.diffracting_wedges
        if wedges is None:
            return cls.none(int(buffer.buffer_size))
        dr.eval(wedges)
        # A vector's own numpy() compiles a kernel for each size.
        vectors = (wedges.o, wedges.e_hat, wedges.n0, wedges.nn)
        o, e, n0, nn = (np.stack([v.x.numpy(), v.y.numpy(), v.z.numpy()], axis=-1) for v in vectors)
        o, e, n0, nn = (vector.astype(np.float64) for vector in (o, e, n0, nn))
        faces = np.stack([wedges.prim0.numpy(), wedges.primn.numpy()], axis=-1).astype(np.int64)
        single = faces[:, 0] == faces[:, 1]
        between = n0 + nn
        length = np.sqrt((between**2).sum(-1, keepdims=True))
        outward = np.where(single[:, None], 0.0, between / np.where(length > 0, length, 1.0))
        return cls(np.stack([o, o + e * wedges.length.numpy()[:, None]], axis=1), outward, faces)

    @classmethod
    def joined(cls, parts: Sequence[Wedges]) -> Wedges:
        """All of these, part by part."""
        return cls(
            np.concatenate([part.ends for part in parts]),
            np.concatenate([part.outward for part in parts]),
            np.concatenate([part.faces for part in parts]),
        )

    def moved(self, by: Float64Array) -> Wedges:
        """The same elsewhere: ``by`` [m], Shape ``[3]``, is added to all places."""
        return Wedges(self.ends + by, self.outward, self.faces)

    def take(self, which: BoolArray) -> Wedges:
        """Those of these paths."""
        return Wedges(self.ends[which], self.outward[which], self.faces[which])
