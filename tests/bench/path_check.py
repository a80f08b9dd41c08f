"""Whether a path is one, by geometry alone: in float64, against every triangle of a scene.

Nothing of the channel's search is used here: no planes, images, beams, tree or float32. A path is *real*
where each point lies in a triangle, both legs make equal angles with it on one side, and no triangle crosses
a leg; at a *border* where it is none, but would be if it ran less than `NEAR` beside; and *wrong* elsewhere.
Where a path is transmitted, its legs are one line instead; where it is diffracted, the point lies on a side
of a triangle, and both legs make the same angle with it (J. B. Keller, "Geometrical Theory of Diffraction",
1962).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.topics import Interaction
from caviar_services.channel.propagation.image_method import image_points
from caviar_services.channel.sionna.scene import SionnaScene

NEAR = 1e-3
"""[m] from an edge: what is decided there, files and float32 decide."""

_EXACT = 1e-6
"""[m]; points lie in their planes to this, and legs end at them."""

_ON_EDGE = 1e-7
"""[m]; two triangles share the points of an edge to this."""

_LAW = 1e-6
"""Unit vectors of both legs obey the law of reflection to this."""

_AROUND = np.array([[np.cos(turn), np.sin(turn)] for turn in np.arange(8) * np.pi / 4])


@dataclass(frozen=True)
class Verdict:
    """What geometry says of a path."""

    word: str
    """``real``, ``border`` or ``wrong``."""
    why: str = ""


class PathCheck:
    """Judges paths in the scene as it stands.

    Args:
        scene: Gives the corners of its triangles, in world coordinates; nothing else is read from it.
    """

    def __init__(self, scene: SionnaScene) -> None:
        numbers = np.arange(len(scene.plane_of))
        corners = scene.corners(numbers)
        a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
        normal = np.cross(b - a, c - a)
        area = np.linalg.norm(normal, axis=1)
        kept = area > 1e-12
        self._numbers, self._every = numbers[kept], corners
        self._corners, self._normal = corners[kept], normal[kept] / area[kept, None]
        self._edges = np.roll(self._corners, -1, axis=1) - self._corners
        self._inward = np.cross(self._normal[:, None], self._edges)
        self._inward /= np.linalg.norm(self._inward, axis=2, keepdims=True)

    def __call__(
        self,
        start: Float64Array,
        points: Float64Array,
        end: Float64Array,
        types: Sequence[int] | None = None,
    ) -> Verdict:
        """Of a path start → points ``[D, 3]`` → end, in metres in the world; ``types`` are its interactions,
        absent: all reflections."""
        places = np.array([start, *points, end])
        planes: list[Sequence[tuple[Float64Array, Float64Array]]] = []
        notes, real = [], True
        for number in range(1, len(places) - 1):
            before, here, behind = places[number - 1 : number + 2]
            come, go = _unit(here - before), _unit(behind - here)
            kind = Interaction.REFLECTION if types is None else types[number - 1]
            if kind == Interaction.DIFFRACTION:
                sides = self._sides_at(here)
                if not any(abs(float((go - come) @ side)) < _LAW for side, _ in sides):
                    return Verdict("wrong", f"no edge at point {number}, or not Keller's law")
                planes.append([(here, normal) for _, normal in sides])
                continue
            normal, inside = self._surface(here)
            if normal is None or inside < -NEAR:
                return Verdict("wrong", f"point {number} is on no surface")
            if inside < NEAR:
                notes.append(f"point {number} is {1e3 * inside:.2g} mm inside of its surface")
            real &= inside >= -_ON_EDGE
            bent = 0.0 if kind == Interaction.TRANSMISSION else 2 * (come @ normal)
            if np.abs(go - come + bent * normal).max() > _LAW:
                return Verdict("wrong", f"point {number} is no {Interaction(kind).name.lower()}")
            planes.append([(here, normal)])
        for number in range(len(places) - 1):
            one, other = places[number : number + 2]
            ends = [plane for near in planes[max(number - 1, 0) : number + 1] for plane in near]
            free = not self._crossed(one, other, ())
            beside = [not self._crossed(one + off, other + off, ends) for off in _around(one, other)]
            if not free and not any(beside):
                return Verdict("wrong", f"leg {number} is blocked")
            real &= free
            if not (free and all(beside)):
                notes.append(f"leg {number} passes less than 1 mm from an edge")
        return Verdict("real" if real else "border", "; ".join(notes))

    def triangles(self, points: Float64Array) -> Int64Array:
        """Number of the triangle that each point [m] lies in, or is nearest to, Shape ``[D]``."""
        found = []
        for point in points:
            height = np.einsum("tc,tc->t", point - self._corners[:, 0], self._normal)
            near = np.flatnonzero(np.abs(height) < _EXACT)
            found.append(int(self._numbers[near[self._depth(point, near).argmax()]]) if len(near) else -1)
        return np.array(found, np.int64)

    def mirrored_at(self, triangles: Int64Array, start: Float64Array, end: Float64Array) -> Float64Array:
        """Points at which the planes of triangles reflect start → end in turn [m], Shape ``[D, 3]``."""
        corners = self._every[triangles]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        types = np.full((1, len(triangles)), Interaction.REFLECTION, np.uint8)
        points: Float64Array = image_points(start[None], end[None], types, corners[None, :, 0], normal[None])[
            0
        ]
        return points

    def _sides_at(self, point: Float64Array) -> list[tuple[Float64Array, Float64Array]]:
        """Direction of each side of a triangle that a point is on, and the triangle's normal."""
        towards = point - self._corners
        length = np.linalg.norm(self._edges, axis=2)
        along = np.einsum("tec,tec->te", towards, self._edges) / length
        off = np.linalg.norm(towards - (along / length)[..., None] * self._edges, axis=2)
        on = (off < _EXACT) & (along > -_EXACT) & (along < length + _EXACT)
        return [
            (self._edges[triangle, side] / length[triangle, side], self._normal[triangle])
            for triangle, side in zip(*np.nonzero(on), strict=True)
        ]

    def _surface(self, point: Float64Array) -> tuple[Float64Array | None, float]:
        """Normal of the surface that a point is on, and how far inside of its outline [m], up to 2 mm."""
        height = np.einsum("tc,tc->t", point - self._corners[:, 0], self._normal)
        near = np.flatnonzero(np.abs(height) < _EXACT)
        depth = self._depth(point, near)
        if not len(near) or depth.max() < -2 * NEAR:
            return None, -np.inf
        normal = self._normal[near[depth.argmax()]]
        if depth.max() < 0:
            return normal, float(depth.max())
        near = near[np.abs(self._normal[near] @ normal) > 1 - 1e-6]
        axes = _across(normal)
        for radius in (1e-5, 1e-4, NEAR, 2 * NEAR):
            if any(self._depth(point + radius * flat @ axes, near).max() < 0 for flat in _AROUND):
                return normal, radius / 2
        return normal, 2 * NEAR

    def _depth(self, point: Float64Array, triangles: Int64Array) -> Float64Array:
        """How far inside of triangles a point of their planes is [m]; negative: outside."""
        towards = point - self._corners[triangles]
        depth: Float64Array = np.einsum("tec,tec->te", towards, self._inward[triangles]).min(1)
        return depth

    def _crossed(
        self,
        start: Float64Array,
        end: Float64Array,
        without: Sequence[tuple[Float64Array, Float64Array]],
    ) -> bool:
        """Whether any triangle that lies in none of some planes crosses a leg between its ends."""
        height, other = (
            np.einsum("tc,tc->t", place - self._corners[:, 0], self._normal) for place in (start, end)
        )
        some: BoolArray = height * other < 0
        for origin, normal in without:
            off = np.abs((self._corners - origin) @ normal).max(1)
            some &= off > NEAR
        rows = np.flatnonzero(some)
        part = height[rows] / (height[rows] - other[rows])
        met = start + part[:, None] * (end - start)
        length = float(np.linalg.norm(end - start))
        between = (part * length > _EXACT) & ((1 - part) * length > _EXACT)
        towards = met[:, None] - self._corners[rows]
        depth = np.einsum("tec,tec->te", towards, self._inward[rows]).min(1)
        return bool((between & (depth > -1e-9)).any())


def _unit(vector: Float64Array) -> Float64Array:
    unit: Float64Array = vector / np.linalg.norm(vector)
    return unit


def _across(direction: Float64Array) -> Float64Array:
    """Two unit vectors across a direction, Shape ``[2, 3]``."""
    least = np.eye(3)[np.abs(direction).argmin()]
    one = _unit(np.cross(direction, least))
    return np.array([one, np.cross(direction, one)])


def _around(start: Float64Array, end: Float64Array) -> Float64Array:
    """Offsets of `NEAR` across a leg, Shape ``[8, 3]``."""
    offsets: Float64Array = NEAR * _AROUND @ _across(_unit(end - start))
    return offsets
