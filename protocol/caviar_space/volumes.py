"""Volumes within closed meshes: lengths of straight lines in them, in float64.

A point is inside where the surfaces around it wind about it: a line that enters as often as it leaves is
outside (winding number, here of the crossings before a point). So surfaces may overlap and enclose cavities.
A line through an edge or a corner crosses what a line infinitesimally beside it crosses (H. Edelsbrunner and
E. P. Mücke, "Simulation of simplicity", ACM Trans. Graph. 9(1), 1990).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_space.meshes import Mesh
from caviar_space.vectors import ranges

# Boxes in a box of the next level, and triangles in one of the first.
_BRANCHES = 8


# By which boxes are wider, relative to the largest coordinate and 1 m.
_SLACK = 1e-9


# Pairs of a line and a box or triangle that are looked at together: what stays in a processor's cache.
_AT_ONCE = 1 << 16


def outward(mesh: Mesh) -> Float64Array:
    """Triangles of a closed mesh, all with their outside in front.

    Args:
        mesh: Corners at exactly one place count as one.

    Returns:
        Corners [m], counter-clockwise as seen from outside, Shape ``[F, 3, 3]``.

    Raises:
        ValueError: Edges are open, or have both triangles on one side; says how many.

    Example:
        >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> crown = Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32))
        >>> outward(crown).shape
        (4, 3, 3)
    """
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    corners = place.reshape(-1)[mesh.faces]
    sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2)
    sides = sides[sides[:, 0] != sides[:, 1]]
    edges, edge, count = np.unique(np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True)
    # Two triangles with the same outside run along their common edge in opposite directions.
    ways = np.bincount(edge.reshape(-1), np.where(sides[:, 0] < sides[:, 1], 1, -1), minlength=len(edges))
    is_open = np.count_nonzero(count % 2)
    if is_open or not len(edges):
        raise ValueError(f"{is_open} of its {len(edges)} edges are open")
    if ways.any():
        turned = np.count_nonzero(ways)
        raise ValueError(f"at {turned} of its {len(edges)} edges one triangle faces out and the other in")
    triangles: Float64Array = mesh.vertices[mesh.faces]
    # Six times the volume, relative to a corner: at UTM coordinates the digits would be lost.
    a, b, c = np.moveaxis(triangles - triangles[0, 0], 1, 0)
    volume = float((np.cross(a, b) * c).sum())
    return triangles[:, ::-1] if volume < 0 else triangles


@dataclass(frozen=True, eq=False)
class MeshVolumes:
    """Volumes within closed surfaces of F triangles, each of one of some kinds."""

    triangles: Float64Array
    """Corners [m], Shape ``[F, 3, 3]``, neighbours near to each other."""
    kind: Int64Array
    """What the volume is of that each is around, Shape ``[F]``."""

    @classmethod
    def of(cls, surfaces: Sequence[tuple[Float64Array, int]]) -> MeshVolumes:
        """Volumes within surfaces.

        Args:
            surfaces: Triangles of each (`outward`), and the kind of its volume.
        """
        triangles = np.concatenate([np.zeros((0, 3, 3)), *(corners for corners, _ in surfaces)])
        kind = np.repeat(
            np.array([kind for _, kind in surfaces], np.int64), [len(corners) for corners, _ in surfaces]
        )
        order = _near_each_other(triangles.mean(1))
        return cls(triangles[order], kind[order])

    @cached_property
    def _boxes(self) -> list[tuple[Float64Array, Float64Array]]:
        """Lowest and highest corners of boxes, Shape ``[3, N]`` each, level by level: around triangles,
        around `_BRANCHES` of these, and so on up to one box, each a little wider than what it holds."""
        slack = _SLACK * (1 + np.abs(self.triangles).max())
        low, high = self.triangles.min(1).T - slack, self.triangles.max(1).T + slack
        levels = [(np.ascontiguousarray(low), np.ascontiguousarray(high))]
        while low.shape[1] > 1:
            first = np.arange(0, low.shape[1], _BRANCHES)
            low, high = np.minimum.reduceat(low, first, axis=1), np.maximum.reduceat(high, first, axis=1)
            levels.append((low, high))
        return levels

    def crossings(
        self, start: Float64Array, direction: Float64Array
    ) -> Iterator[tuple[Int64Array, Int64Array, Float64Array, Int64Array]]:
        """Crossings of lines into and out of volumes.

        Args:
            start: A point of each of Q lines [m], Shape ``[Q, 3]``.
            direction: Along each line [m], Shape ``[Q, 3]``.

        Yields:
            For some lines at a time: line, kind, multiple of the direction, and 1 for entering or −1 for
            leaving, Shape ``[N]`` each. Left out are lines that miss all volumes from 0 to 1 or are not
            finite, and some crossings beyond 1.
        """
        if not len(self.kind):
            return
        lines = np.flatnonzero((direction != 0).any(1) & np.isfinite(start + direction).all(1))
        with np.errstate(divide="ignore"):
            slabs = np.ascontiguousarray(start.T), 1 / np.ascontiguousarray(direction.T)
        root = np.zeros(len(lines), np.int64)
        met = _meets(slabs, lines, self._boxes[-1], root, (0.0, 1.0))
        # Depth first, and large levels in halves, so that few pairs of lines and boxes exist at a time.
        pending = [(len(self._boxes) - 1, lines[met], root[met])]
        while pending:
            level, lines, boxes = pending.pop()
            if len(lines) > _AT_ONCE:
                half = len(lines) // 2
                pending += [(level, lines[:half], boxes[:half]), (level, lines[half:], boxes[half:])]
            elif level:
                below = self._boxes[level - 1]
                sizes = np.minimum(_BRANCHES, below[0].shape[1] - boxes * _BRANCHES)
                parent, boxes = ranges(boxes * _BRANCHES, sizes)
                lines = lines[parent]
                met = _meets(slabs, lines, below, boxes, (-np.inf, 1.0))
                pending.append((level - 1, lines[met], boxes[met]))
            elif len(lines):
                crossed, along, step = _crossed(start[lines], direction[lines], self.triangles[boxes])
                yield lines[crossed], self.kind[boxes[crossed]], along, step


def lengths_inside(
    volumes: Sequence[MeshVolumes], start: Float64Array, end: Float64Array, kinds: int
) -> Float64Array:
    """Lengths of segments within the union of all volumes of each kind.

    Args:
        volumes: Of all kinds, numbered from 0.
        start: Start of each of Q segments [m], Shape ``[Q, 3]``; ``end`` likewise.
        end: See ``start``.
        kinds: Number of kinds, K.

    Returns:
        Lengths [m], Shape ``[Q, K]``.

    Example:
        >>> from caviar_space.meshes import box
        >>> crown = MeshVolumes.of([(outward(box((0, 2), (0, 2), (0, 2))), 0)])
        >>> start, end = np.array([[-1.0, 1.0, 1.5]]), np.array([[1.5, 1.0, 1.5]])
        >>> lengths_inside([crown], start, end, kinds=1).tolist()
        [[1.5]]
    """
    direction = end - start
    found = [crossed for of in volumes for crossed in of.crossings(start, direction)]
    if not found:
        return np.zeros((len(start), kinds))
    line, kind, along, step = (np.concatenate(parts) for parts in zip(*found, strict=True))
    # Along each line and kind, the running sum of +1 and −1 is the winding number after each crossing.
    pair, along = line * kinds + kind, np.clip(along, 0.0, 1.0)
    order = np.lexsort((step, along, pair))
    pair, along, around = pair[order], along[order], np.cumsum(step[order])
    first = np.diff(pair, prepend=-1) != 0
    around -= np.repeat((around - step[order])[first], np.diff(np.flatnonzero(first), append=len(pair)))
    # Up to the next crossing, or to the end: crossings beyond are not all known.
    until = np.where(np.append(first[1:], True), 1.0, np.append(along[1:], 1.0))
    gaps = np.where(around != 0, until - along, 0.0)
    share = np.bincount(pair, gaps, minlength=len(start) * kinds).reshape(len(start), kinds)
    inside: Float64Array = share * np.sqrt((direction**2).sum(1, keepdims=True))
    return inside


def _near_each_other(points: Float64Array) -> Int64Array:
    """An order of points, Shape ``[N, 3]``, in which neighbours are near: Morton's, of 10 bits an axis."""
    if not len(points):
        return np.zeros(0, np.int64)
    low, size = points.min(0), np.ptp(points, axis=0).max()
    cells = ((points - low) / (size or 1.0) * 1023).astype(np.int64)
    bits = (cells[..., None] >> np.arange(10)) & 1
    code = (bits << (3 * np.arange(10) + np.arange(3)[:, None])).sum((1, 2))
    return np.argsort(code, kind="stable")


def _meets(
    slabs: tuple[Float64Array, Float64Array],
    lines: Int64Array,
    corners: tuple[Float64Array, Float64Array],
    boxes: Int64Array,
    between: tuple[float, float],
) -> BoolArray:
    """Test whether lines touch boxes between two multiples of their directions, pair by pair, Shape ``[N]``.

    By slabs (T. L. Kay and J. T. Kajiya, "Ray tracing complex scenes", SIGGRAPH 1986).

    Args:
        slabs: Start and inverse of the direction of all lines, Shape ``[3, Q]`` each.
        lines, boxes: Number of the line and of the box, Shape ``[N]``.
        corners: Lowest and highest of all boxes, Shape ``[3, M]`` each.
    """
    near, far = np.full(len(lines), between[0]), np.full(len(lines), between[1])
    with np.errstate(invalid="ignore"):
        for start, inverse, low, high in zip(*slabs, *corners, strict=True):
            at, along = start[lines], inverse[lines]
            one, other = (low[boxes] - at) * along, (high[boxes] - at) * along
            np.fmax(near, np.fmin(one, other), out=near)
            np.fmin(far, np.fmax(one, other), out=far)
    met: BoolArray = near <= far
    return met


def _crossed(
    origin: Float64Array, direction: Float64Array, triangles: Float64Array
) -> tuple[Int64Array, Float64Array, Int64Array]:
    """Triangles of N, Shape ``[N, 3, 3]``, that lines meet, at what multiple of the direction, and whether
    they enter there, 1, or leave, −1.

    In axes in which the line is the third one (S. Woop, C. Benthin and I. Wald, "Watertight ray/triangle
    intersection", JCGT 2(1), 2013): the sign of the product of two corners is opposite for the two triangles
    at an edge, and right or zero.
    """
    # The longest component of the direction becomes the third axis, so that the shear is well conditioned.
    axis = np.argmax(np.abs(direction), axis=1)
    axes = (axis[:, None] + np.array([1, 2, 0])) % 3
    towards = np.take_along_axis(direction, axes, axis=1)
    corners = np.take_along_axis(triangles - origin[:, None], axes[:, None], axis=2)
    x = corners[..., 0] - towards[:, :1] / towards[:, 2:] * corners[..., 2]
    y = corners[..., 1] - towards[:, 1:2] / towards[:, 2:] * corners[..., 2]
    x_next, y_next = np.roll(x, -1, axis=1), np.roll(y, -1, axis=1)
    product = x * y_next - y * x_next
    # On an edge, the line counts as a little beside it, by ε along x and by ε² along y.
    beside = np.where(y != y_next, y - y_next, x_next - x)
    side = np.sign(np.where(product == 0, beside, product))
    met = np.flatnonzero((side[:, 0] != 0) & (side == side[:, :1]).all(1))
    weight = np.roll(product[met], -1, axis=1)
    depth = (weight * corners[met, :, 2]).sum(1) / weight.sum(1)
    step = -side[met, 0] * np.sign(towards[met, 2])
    return met, depth / towards[met, 2], step.astype(np.int64)
