"""All chains of reflections at few faces of scenery, and those that a transmitter can light.

In a scenery of few faces, every sequence of faces that see one another may be a chain, from wherever a
transmitter is: no rays are needed. From a place, the beams of its images leave most of them dark
(`image_beams` has the same beams for the faces of a frame, on the ray tracer's side).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_services.channel.enumeration.face_rectangles import FaceRectangles, ranges

MOST_CHAINS = 20_000
"""Sequences of which all are taken, at most."""

_SLACK = 1e-3
"""[m] around pyramids; more than the rim of triangles."""

_IN_FRONT = 1e-6
"""[m]; walls of a building that meet at a corner do not show one another."""


@dataclass(frozen=True, eq=False)
class _Level:
    """Sequences of one length."""

    parent: Int64Array
    """Number of the sequence of one face less that each goes on from, Shape ``[K]``."""
    face: Int64Array
    """Its last face, Shape ``[K]``."""
    planes: Int32Array
    """Its planes, −1 behind the last, Shape ``[K, D]``."""


class ChainTree:
    """Sequences of faces, each of which sees the next one.

    Parameters
    ----------
    faces
        Of scenery, in ascending order of their planes.
    levels
        Sequences of one face, of two faces, and so on.
    """

    def __init__(self, faces: FaceRectangles, levels: list[_Level]) -> None:
        self._faces, self._levels = faces, levels
        u, v = (faces.axes[:, i] * faces.half[:, i, None] for i in (0, 1))
        around = np.stack([-u - v, u - v, u + v, v - u], axis=1)
        self._corners: Float64Array = faces.centre[:, None] + around

    @property
    def planes(self) -> Int64Array:
        """Of the faces, in ascending order, Shape ``[U]``."""
        return self._faces.plane

    @classmethod
    def of(cls, faces: FaceRectangles, sights: Int64Array, depth: int) -> ChainTree | None:
        """Up to so many faces; None where there are more than `MOST_CHAINS`.

        ``sights`` are planes that see one another, in both orders and sorted, Shape ``[M, 2]``.
        """
        seen = np.searchsorted(faces.plane, sights)
        parent, face = np.zeros(len(faces), np.int64), np.arange(len(faces))
        planes = np.full((len(faces), depth), -1, np.int32)
        levels: list[_Level] = []
        for length in range(depth):
            planes[:, length] = faces.plane[face]
            levels.append(_Level(parent, face, planes))
            if sum(len(level.face) for level in levels) > MOST_CHAINS:
                return None
            begin, end = (np.searchsorted(seen[:, 0], face, side) for side in ("left", "right"))
            parent, behind = ranges(begin, end - begin)
            face, planes = seen[behind, 1], planes[parent]
        return cls(faces, levels)

    def chains(self, source: Float64Array, seen: BoolArray) -> Int32Array:
        """Planes of the sequences that a source can light, those of fewer planes first, with the beginnings
        of each, −1 behind the last, Shape ``[K, D]``.

        Parameters
        ----------
        source
            [m], Shape ``[3]``.
        seen
            Faces that the source may see, Shape ``[U]``.
        """
        faces, level = self._faces, self._levels[0]
        rows = last = np.flatnonzero(seen)
        image = faces.mirrored(np.broadcast_to(source, (len(rows), 3)), last)
        through: Float64Array | None = None
        found = [level.planes[rows]]
        for shorter, level in pairwise(self._levels):
            place = np.full(len(shorter.face), -1)
            place[rows] = np.arange(len(rows))
            rows = np.flatnonzero(place[level.parent] >= 0)
            parent, face = place[level.parent[rows]], level.face[rows]
            target = self._corners[face]
            lit = self._in_front(image[parent], last[parent], target)
            lit &= ~_beyond(image[parent], self._corners[last[parent]], target)
            if through is not None:
                lit &= ~_beyond(image[parent], through[parent], target)
            rows, parent, face = rows[lit], parent[lit], face[lit]
            through = self._mirrored(last[parent], face)
            image, last = faces.mirrored(image[parent], face), face
            found.append(level.planes[rows])
        return np.concatenate(found)

    def _in_front(self, image: Float64Array, last: Int64Array, target: Float64Array) -> BoolArray:
        """Whether rectangles reach to the side of the planes of last faces that images are behind."""
        away = np.where(self._faces.height(image, last) > 0, -1.0, 1.0)[:, None]
        height = np.einsum("nkc,nc->nk", target, self._faces.normal[last]) - self._faces.offset[last, None]
        in_front: BoolArray = (away * height > _IN_FRONT).any(1)
        return in_front

    def _mirrored(self, faces: Int64Array, mirrors: Int64Array) -> Float64Array:
        """Corners of faces, mirrored in others, Shape ``[N, 4, 3]``."""
        flat = self._corners[faces].reshape(-1, 3)
        return self._faces.mirrored(flat, np.repeat(mirrors, 4)).reshape(-1, 4, 3)


def _beyond(apex: Float64Array, corners: Float64Array, target: Float64Array) -> BoolArray:
    """Whether N rectangles lie beyond a side of the pyramids from apexes around other rectangles."""
    edges = corners - apex[:, None]
    normal = np.cross(edges, np.roll(edges, -1, axis=1))
    length = np.sqrt(np.einsum("nsc,nsc->ns", normal, normal))
    inwards = np.sign(np.einsum("nsc,nc->ns", normal, edges.sum(1)))
    normal *= (inwards / np.where(length > 0, length, 1.0))[..., None]
    height = np.einsum("nsc,nkc->nsk", normal, target - apex[:, None])
    beyond: BoolArray = (height < -_SLACK).all(2).any(1)
    return beyond
