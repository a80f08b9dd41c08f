"""Which planes of scenery see one another: what one reflects, another reflects only where it sees that.

Of a thousand planes in a town each sees some thirty. Rays in all directions from points of each plane tell
which; planes that are hidden but for less than one ray meets count as hidden.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.enumeration.face_rectangles import FaceRectangles
from caviar_services.channel.sionna.candidate_visibility import Faces

_OFF_PLANE = 1e-3
"""[m] from its plane that a ray starts."""

_PART = 1_000_000
"""Rays that are traced together."""


def visible_pairs(look: Faces, faces: FaceRectangles, rays: int, seed: int) -> Int64Array:
    """Both planes of each pair that see one another, each pair in both orders, sorted, Shape ``[M, 2]``.

    Parameters
    ----------
    look
        Asks the scene, in which nothing that moves should stand.
    faces
        Of the planes.
    rays
        From each of them.
    seed
        Of the points and directions that are drawn.
    """
    rng = np.random.default_rng(seed)
    at_once = max(1, _PART // rays)
    found = [np.zeros((0, 2), np.int64)]
    for begin in range(0, len(faces), at_once):
        some = np.arange(begin, min(begin + at_once, len(faces)))
        face = np.repeat(some, rays)
        start = _points(faces.take(some), rays, rng)
        direction = rng.standard_normal((len(face), 3))
        direction /= np.sqrt((direction**2).sum(1))[:, None]
        off = np.sign((direction * faces.normal[face]).sum(1))[:, None] * faces.normal[face] * _OFF_PLANE
        behind, plane = look.nearest(start + off, start + off + direction)
        hit = np.isfinite(behind)
        found.append(np.unique(np.column_stack([faces.plane[face], plane])[hit], axis=0))
    pairs = np.concatenate(found)
    pairs = pairs[np.isin(pairs[:, 1], faces.plane) & (pairs[:, 0] != pairs[:, 1])]
    return np.unique(np.concatenate([pairs, pairs[:, ::-1]]), axis=0)


def seen_planes(look: Faces, points: Float64Array, planes: Int64Array, rays: int) -> BoolArray:
    """Which of some planes, in ascending order, each of some points [m], Shape ``[R, 3]``, sees, Shape
    ``[R, U]``: those that rays in all directions meet first."""
    seen = np.zeros((len(points), len(planes) + 1), np.bool_)
    start = np.repeat(points, rays, axis=0)
    behind, plane = look.nearest(start, start + np.tile(_directions(rays), (len(points), 1)))
    place = np.searchsorted(planes, plane)
    known = np.isfinite(behind) & (np.append(planes, -1)[place] == plane)
    seen[np.repeat(np.arange(len(points)), rays), np.where(known, place, len(planes))] = True
    return seen[:, :-1]


@lru_cache(maxsize=4)
def _directions(rays: int) -> Float64Array:
    """Unit vectors that are spread evenly, Shape ``[N, 3]``."""
    number = np.arange(rays) + 0.5
    z, turn = 1 - 2 * number / rays, np.pi * (1 + math.sqrt(5.0)) * number
    flat = np.sqrt(1 - z**2)
    return np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])


def _points(faces: FaceRectangles, count: int, rng: np.random.Generator) -> Float64Array:
    """So many points of each face [m], evenly spread over its triangles, face after face."""
    corners = faces.triangles
    one, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0])
    ends = np.cumsum(area)
    last = np.cumsum(faces.sizes) - 1
    begin, whole = ends[last] - np.add.reduceat(area, last + 1 - faces.sizes), ends[last]
    drawn = begin[:, None] + rng.random((len(faces), count)) * (whole - begin)[:, None]
    triangle = np.clip(np.searchsorted(ends, drawn), (last + 1 - faces.sizes)[:, None], last[:, None])
    triangle = triangle.ravel()
    weights = rng.random((len(triangle), 2))
    weights = np.where((weights.sum(1) > 1)[:, None], 1 - weights, weights)
    flat = corners[triangle, 0] + weights[:, :1] * one[triangle] + weights[:, 1:] * other[triangle]
    face = np.repeat(np.arange(len(faces)), count)
    points: Float64Array = faces.centre[face] + np.einsum("na,nac->nc", flat, faces.axes[face])
    return points
