"""Diffraction over near edges only: who sets a range pays for no edges out of it."""

from __future__ import annotations

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.paths import PathTable
from caviar_services.channel.sionna.scene import SionnaScene


class EdgeRange:
    """Which edges of a scene, as it stands, are within a distance of one end of a path at least.

    Args:
        scene: Where the edges are.
        within_m: How far they may be.
    """

    def __init__(self, scene: SionnaScene, within_m: float) -> None:
        self._scene = scene
        self._within = within_m

    def reaches(self, places: Float64Array) -> bool:
        """Whether any edge is in range of any of these places [m], Shape ``[N, 3]``."""
        if self._scene.edges is None:
            return False
        edges = self._scene.edges.all_ends
        begin, along = edges[:, 0], edges[:, 1] - edges[:, 0]
        square = (along**2).sum(-1)
        begin, along, square = begin[square > 0], along[square > 0], square[square > 0]
        for place in places:
            share = np.clip(((place - begin) * along).sum(-1) / square, 0.0, 1.0)
            nearest = begin + share[:, None] * along - place
            if ((nearest**2).sum(-1) <= self._within**2).any():
                return True
        return False

    def within(self, table: PathTable, start: Float64Array, end: Float64Array) -> BoolArray:
        """Which paths have no edge out of range of both ends, Shape ``[P]``; ``start`` and ``end`` ``[P, 3]``
        [m] are these."""
        bent = table.types == Interaction.DIFFRACTION
        near = np.zeros(bent.shape, np.bool_)
        for place in (start, end):
            near |= ((table.points - place[:, None]) ** 2).sum(-1) <= self._within**2
        kept: BoolArray = (near | ~bent).all(1)
        return kept
