"""The image method: interaction points in float64, at planes by images, at edges by Keller's law.

A ray tracer's points are float32: some 1e-5 m at 100 m, which is 0.01 rad of phase at 60 GHz and grows with
the coordinates. Which triangles a path meets is known exactly, so its points can be computed again:

- Reflection: TX, or the last point before that is not specular, is mirrored at one plane after the other.
  From the next such point or RX, the line to the last image meets the last plane at the last point, and so
  on back.
- Transmission: where that line meets the plane; it does not bend a path.
- Diffraction: the point of the edge at which the unfolded path is shortest (J. B. Keller, "Geometrical Theory
  of Diffraction", 1962: both rays make the same angle with the edge).
- Scattering: any point of the surface is one, so the traced one stays, brought onto the plane.

So the length of a path without scattering is that of closed form; with scattering it is that of
the path over the point that was drawn. Amplitudes stay as traced, in float32.

Enumerated chains are mirrored together with their tests of faces, in `enumeration.image_paths`; launched
candidates are tested by Sionna RT's image method in float32 first, and come here afterwards.
"""

from __future__ import annotations

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt8Array
from caviar_protocol.topics import Interaction
from caviar_space.vectors import cross, equal_rows

# [m]; a point that moves less is the same.
_NEAR = 0.05

# Part of a path's length by which a point may move where the length stays: at grazing incidence a rounding
# moves the point far and the length not at all.
_FAR = 1e-2

# [m]; what rounding changes of a path's length at most, in scenes of some kilometres.
_SAME_LENGTH = 2e-3

# [m]; a segment needs a length to have a direction, and this is 1e-4 rad at 300 GHz.
_BIT = 1e-8

# [m]; points of one type and pair that are nearer than this are one.
_SAME_PLACE = 1e-4


def refined_points(
    start: Float64Array,
    points: Float64Array,
    end: Float64Array,
    types: UInt8Array,
    triangles: Float64Array,
    edges: Float64Array | None = None,
    traced_ends: tuple[Float64Array, Float64Array] | None = None,
) -> Float64Array:
    """Points of the paths start → points → end, computed anew.

    A path whose points cannot be (a line within the plane, a triangle without area, another edge than the
    traced one) stays as traced.

    Args:
        start: Position of TX [m], Shape ``[P, 3]``; ``end`` that of RX.
        points: Traced points [m], Shape ``[P, D, 3]``.
        end: See ``start``.
        types: `Interaction` at each, Shape ``[P, D]``; diffraction at most once in a path.
        triangles: Corners [m] of the triangle at each interaction, Shape ``[P, D, 3, 3]``.
        edges: Both ends [m] of the edge of each path that is diffracted, Shape ``[P, 2, 3]``; None: none is.
        traced_ends: From where and to where the points were traced, where that was not from start to end.

    Example:
        >>> start, end = np.array([[0.0, 0.0, 3.0]]), np.array([[8.0, 0.0, 1.0]])
        >>> ground = np.array([[[[0.0, -9.0, 0.0], [9.0, -9.0, 0.0], [0.0, 9.0, 0.0]]]])
        >>> types = np.array([[Interaction.REFLECTION]], np.uint8)
        >>> refined_points(start, np.array([[[5.9999, 1e-4, 0.0]]]), end, types, ground).round(9).tolist()
        [[[6.0, 0.0, 0.0]]]
    """
    some = np.flatnonzero((types != 0).any(1))
    if not len(some):
        return points
    kind, traced = types[some], points[some]
    edges = np.zeros((len(types), 2, 3)) if edges is None else edges
    with np.errstate(invalid="ignore", divide="ignore"):  # such paths stay as traced
        one, other = (start, end) if traced_ends is None else traced_ends
        found = _found(one[some], traced, other[some], kind, triangles[some], edges[some])
        good = _same(one[some], traced, found, other[some], kind)
        # Antennas at surfaces are traced from beside their place: the points found there are known to be the
        # path's, and serve as a start for those of the true positions.
        moved = good & ((one != start) | (other != end)).any(1)[some]
        if moved.any():
            there = some[moved]
            found[moved] = _found(
                start[there], found[moved], end[there], kind[moved], triangles[there], edges[there]
            )
        good &= np.isfinite(found).all((1, 2))
    refined = points.copy()
    refined[some[good]] = found[good]
    return refined


def image_points(
    start: Float64Array, end: Float64Array, types: UInt8Array, origin: Float64Array, normal: Float64Array
) -> Float64Array:
    """Points where paths of reflections and transmissions meet their planes, by images.

    Args:
        start: Position of TX [m], Shape ``[P, 3]``; ``end`` that of RX.
        end: See ``start``.
        types: `Interaction` at each point, 0 past the last, Shape ``[P, D]``.
        origin: A point of each plane [m], Shape ``[P, D, 3]``.
        normal: Of each plane, of any length, Shape ``[P, D, 3]``.

    Returns:
        Points [m], Shape ``[P, D, 3]``: 0 past the last one, not finite at a plane seen edge-on.

    Example:
        >>> ends = np.array([[0.0, 0.0, 1.0]]), np.array([[4.0, 0.0, 3.0]])
        >>> ground = np.zeros((1, 1, 3)), np.array([[[0.0, 0.0, 1.0]]])
        >>> image_points(*ends, np.array([[Interaction.REFLECTION]], np.uint8), *ground).tolist()
        [[[1.0, 0.0, 0.0]]]
    """
    nowhere = np.zeros((*types.shape, 3))
    with np.errstate(invalid="ignore", divide="ignore"):
        images = _images(start, nowhere, types, origin, normal)
        return _traced_back(images, nowhere, end, types, origin, normal)


def path_lengths(
    start: Float64Array, points: Float64Array, end: Float64Array, types: UInt8Array
) -> Float64Array:
    """Lengths [m] of the paths start → points → end, Shape ``[P]``; the arguments are those of
    `refined_points`.

    Example:
        >>> start, end = np.array([[0.0, 0.0, 3.0]]), np.array([[8.0, 0.0, 3.0]])
        >>> types = np.array([[Interaction.REFLECTION]], np.uint8)
        >>> path_lengths(start, np.array([[[4.0, 0.0, 0.0]]]), end, types).tolist()
        [10.0]
    """
    unused = (types == 0)[..., None]
    corners = np.concatenate([start[:, None], np.where(unused, end[:, None], points), end[:, None]], axis=1)
    length: Float64Array = np.sqrt((np.diff(corners, axis=1) ** 2).sum(-1)).sum(-1)
    return length


def _found(
    start: Float64Array,
    traced: Float64Array,
    end: Float64Array,
    types: UInt8Array,
    triangles: Float64Array,
    edges: Float64Array,
) -> Float64Array:
    depth = types.shape[1]
    a, b, c = np.moveaxis(triangles, -2, 0)
    origin, normal = a, cross(b - a, c - a)
    fixed = traced.copy()
    scattered = types == Interaction.SCATTERING
    if scattered.any():
        fixed[scattered] = _onto(traced[scattered], origin[scattered], normal[scattered])
    diffracted = types == Interaction.DIFFRACTION
    if diffracted.any():
        paths, at = np.nonzero(diffracted)
        # Both sides of the edge are straightened by images, then Keller's point joins them.
        before = _images(start, fixed, types, origin, normal)
        behind = _images(end, fixed[:, ::-1], types[:, ::-1], origin[:, ::-1], normal[:, ::-1])
        fixed[paths, at] = keller_point(before[at, paths], behind[depth - 1 - at, paths], edges[paths])
    return _traced_back(_images(start, fixed, types, origin, normal), fixed, end, types, origin, normal)


def _images(
    start: Float64Array, fixed: Float64Array, types: UInt8Array, origin: Float64Array, normal: Float64Array
) -> Float64Array:
    """Image of the source before each interaction and past the last, Shape ``[D + 1, P, 3]``."""
    images = [start]
    for d in range(types.shape[1]):
        last, kind = images[-1], types[:, d, None]
        mirrored = 2 * _onto(last, origin[:, d], normal[:, d]) - last
        image = np.where(kind == Interaction.REFLECTION, mirrored, last)
        images.append(np.where(_is_fixed(kind), fixed[:, d], image))
    return np.array(images)


def _traced_back(
    images: Float64Array,
    fixed: Float64Array,
    end: Float64Array,
    types: UInt8Array,
    origin: Float64Array,
    normal: Float64Array,
) -> Float64Array:
    found = np.zeros(fixed.shape)
    here, start = end, images[0]
    for d in reversed(range(types.shape[1])):
        kind = types[:, d, None]
        line = images[d + 1] - here
        along = ((origin[:, d] - here) * normal[:, d]).sum(-1) / (line * normal[:, d]).sum(-1)
        met = here + _not_nothing(along[:, None] * line, line)
        met = np.where(_is_fixed(kind), fixed[:, d], met)
        if d == 0:
            # The first segment of a reflected path runs from the start itself, which may be on the surface.
            out = here - met
            in_ = out - 2 * (out * normal[:, 0]).sum(-1, keepdims=True) / _square(normal[:, 0]) * normal[:, 0]
            met = np.where(kind == Interaction.REFLECTION, start + _not_nothing(met - start, in_), met)
        found[:, d] = np.where(kind != 0, met, 0.0)
        here = np.where(kind != 0, met, here)
    return found


def _same(
    start: Float64Array, traced: Float64Array, found: Float64Array, end: Float64Array, types: UInt8Array
) -> BoolArray:
    """Test whether the points found are those of the traced path, except for rounding."""
    shift = np.where(types != 0, np.abs(found - traced).max(-1), 0.0).max(-1)
    length = path_lengths(start, traced, end, types)
    longer = np.abs(path_lengths(start, found, end, types) - length)
    same: BoolArray = (shift < _NEAR) | ((shift < _FAR * length) & (longer < _SAME_LENGTH))
    return same


def _is_fixed(kind: UInt8Array) -> BoolArray:
    fixed: BoolArray = (kind == Interaction.SCATTERING) | (kind == Interaction.DIFFRACTION)
    return fixed


def _onto(point: Float64Array, origin: Float64Array, normal: Float64Array) -> Float64Array:
    """Foot of the perpendicular on a plane."""
    offset = ((point - origin) * normal).sum(-1, keepdims=True) / _square(normal)
    foot: Float64Array = point - offset * normal
    return foot


def _not_nothing(segment: Float64Array, direction: Float64Array) -> Float64Array:
    """A segment; where an antenna is on the surface, so that it has no length, a bit of its direction."""
    length = np.sqrt(_square(segment))
    bit = _BIT * direction / np.sqrt(_square(direction))
    kept: Float64Array = np.where(length < _BIT, bit, segment)
    return kept


def _square(vectors: Float64Array) -> Float64Array:
    square: Float64Array = (vectors**2).sum(-1, keepdims=True)
    return square


def keller_point(source: Float64Array, target: Float64Array, edges: Float64Array) -> Float64Array:
    """Points where the shortest paths over the lines of edges meet them: both rays make the same angle with
    the edge.

    Args:
        source: Start of each path, or its image [m], Shape ``[P, 3]``; ``target`` the end.
        target: See ``source``.
        edges: Both ends of each edge [m], Shape ``[P, 2, 3]``.

    Returns:
        Points [m], Shape ``[P, 3]``, beyond an end of the edge or not; not finite where source and target are
        both on the line.

    Example:
        >>> edge = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 9.0]]])
        >>> keller_point(np.array([[3.0, 0.0, 1.0]]), np.array([[0.0, 6.0, 4.0]]), edge).tolist()
        [[0.0, 0.0, 2.0]]
    """
    origin, along = edges[:, 0], edges[:, 1] - edges[:, 0]
    along = along / np.sqrt(_square(along))
    s = ((source - origin) * along).sum(-1, keepdims=True)
    t = ((target - origin) * along).sum(-1, keepdims=True)
    from_source = np.sqrt(((source - origin - s * along) ** 2).sum(-1, keepdims=True))
    from_target = np.sqrt(((target - origin - t * along) ** 2).sum(-1, keepdims=True))
    place: Float64Array = origin + (s * from_target + t * from_source) / (from_source + from_target) * along
    return place


def distinct(pair: Int64Array, types: UInt8Array, points: Float64Array) -> BoolArray:
    """Paths that do not repeat an earlier one.

    A ray tracer that takes two triangles of one wall for two planes finds one reflection twice. Paths with
    scattering are samples, and each counts.

    Args:
        pair: TX and RX of each path as one number, Shape ``[P]``.
        types: `Interaction` at each point, Shape ``[P, D]``.
        points: Refined points [m], Shape ``[P, D, 3]``.

    Returns:
        Which paths are kept, Shape ``[P]``.

    Example:
        >>> types, points = np.full((2, 1), Interaction.REFLECTION, np.uint8), np.full((2, 1, 3), 4.0)
        >>> distinct(np.array([0, 0]), types, points).tolist()
        [True, False]
    """
    kept: BoolArray = (types == Interaction.SCATTERING).any(1)
    some = np.flatnonzero(~kept)
    used = (types[some] != 0)[..., None]
    # The grid is off the origin by an odd part of a cell: coordinates are often round numbers, and would lie
    # on the border of two cells.
    cells = np.where(used, np.floor(points[some] / _SAME_PLACE + 0.271828), 0.0) + 0.0  # no negative zeros
    keys = np.concatenate(
        [pair[some, None], types[some], cells.reshape(len(some), 3 * types.shape[1])], axis=1
    )
    kept[some[equal_rows(keys)[0]]] = True
    return kept
