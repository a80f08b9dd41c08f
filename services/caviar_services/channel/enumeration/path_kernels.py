"""Loops over paths: reflections of chains of faces by the image method, and the first obstacle on segments,
by trees of boxes, in float64.

A tree is a run of nodes, its root first and every child after its parent. Nodes have a box, in ``boxes`` of
Shape ``[N, 6]``, lowest corner first, and in ``nodes`` of Shape ``[N, 3]`` the first of two children, −1 at a
leaf, and the run of ``order`` that has the triangles below the node. Triangles are a corner and the sides
that lead from it, in ``triangles`` of Shape ``[T, 9]``.
"""

from __future__ import annotations

import math

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.enumeration.compiled_loops import compiled, loop

Ray = tuple[float, float, float, float, float, float]
Trees = tuple[Int64Array, Int64Array, Float64Array, Float64Array]
_TREES = "Tuple((i8[:,::1], i8[::1], f8[:,::1], f8[:,::1]))"

# Nodes of a tree that wait, at most: one for each level.
_DEEPEST = 64

# Cosine between the normals of planes that count as parallel.
_PARALLEL = 1 - 1e-6

# [m] by which rectangles are larger; more than the rim of their triangles.
_SLACK = 2e-3


@compiled
def _in_triangle(u: float, v: float, triangles: Float64Array, first: int, past: int, rim: float) -> bool:
    """Test whether a point of a plane lies in one of some triangles, or no farther outside than a rim [m]."""
    for t in range(first, past):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        area = (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])
        side, inside = np.sign(area), area != 0
        for i in range(3):
            one, other = triangles[t, i], triangles[t, (i + 1) % 3]
            x, y = other[0] - one[0], other[1] - one[1]
            # Twice the area of the triangle of point and side over the side's length is the distance from the
            # side.
            across = x * (v - one[1]) - y * (u - one[0])
            inside &= across * side >= -rim * math.sqrt(x * x + y * y)
        if inside:
            return True
    return False


@loop(
    "Tuple((f8[:,:,::1], b1[::1]))"
    "(f8[:,::1], f8[:,:,::1], f8[:,:,::1], i8[::1], f8, i8[:,::1], f8[:,::1], f8[:,::1])"
)
def reflections(
    faces: Float64Array,
    frames: Float64Array,
    triangles: Float64Array,
    begin: Int64Array,
    rim: float,
    chain: Int64Array,
    start: Float64Array,
    end: Float64Array,
) -> tuple[Float64Array, BoolArray]:
    """Points where chains of faces reflect a wave on its way from a start to an end, by the image method.

    Args:
        faces: Of `beam_kernels`; likewise ``frames``.
        frames: See ``faces``.
        triangles: Of the faces, in their frames [m], Shape ``[T, 3, 2]``.
        begin: Those of face f are ``begin[f]`` to ``begin[f + 1]``.
        rim: Around triangles [m].
        chain: Faces in turn, −1 past the last, Shape ``[N, D]``.
        start: Position [m], Shape ``[N, 3]``; ``end`` likewise.
        end: See ``start``.

    Returns:
        Points, the end past the last [m], Shape ``[N, D, 3]``, and which rows have every point in a
        triangle of its face, on the side that reflects, Shape ``[N]``. Points of other rows are undefined.
    """
    depth = chain.shape[1]
    points, good = np.empty((len(chain), depth, 3)), np.ones(len(chain), np.bool_)
    images, flat = np.empty((depth + 1, 3)), np.empty((depth, 2))
    for n in range(len(chain)):
        count = 0
        for c in range(3):
            images[0, c] = start[n, c]
            for d in range(depth):
                points[n, d, c] = end[n, c]  # past the last reflection it stays
        while count < depth and chain[n, count] >= 0:
            f = chain[n, count]
            image = images[count]
            twice = 2 * (
                image[0] * faces[4, f] + image[1] * faces[5, f] + image[2] * faces[6, f] - faces[7, f]
            )
            for c in range(3):
                images[count + 1, c] = image[c] - twice * faces[4 + c, f]
            count += 1
        # Back from the end: the line to the last image meets the last face at the last point, and so on.
        x, y, z = end[n, 0], end[n, 1], end[n, 2]
        for d in range(count - 1, -1, -1):
            f = chain[n, d]
            tx, ty, tz = images[d + 1, 0], images[d + 1, 1], images[d + 1, 2]
            near = x * faces[4, f] + y * faces[5, f] + z * faces[6, f] - faces[7, f]
            far = tx * faces[4, f] + ty * faces[5, f] + tz * faces[6, f] - faces[7, f]
            # The line has to cross the plane between the end and the image, from the side that reflects.
            good[n] = near * far < 0 and (near > 0 or faces[8, f] != 0)
            if not good[n]:
                break
            share = near / (near - far)
            x, y, z = x + share * (tx - x), y + share * (ty - y), z + share * (tz - z)
            points[n, d, 0], points[n, d, 1], points[n, d, 2] = x, y, z
            for a in range(2):
                flat[d, a] = 0.0
                for c in range(3):
                    flat[d, a] += (points[n, d, c] - faces[c, f]) * frames[f, a, c]
                good[n] &= abs(flat[d, a]) <= frames[f, 2, a] + _SLACK
            if not good[n]:
                break
        # Triangles cost most: they are tested where all rectangles are met.
        for d in range(count):
            f = chain[n, d]
            good[n] = good[n] and _in_triangle(flat[d, 0], flat[d, 1], triangles, begin[f], begin[f + 1], rim)
    return points, good


# Triangles of a leaf at most.
_LEAF = 4


@loop("Tuple((i8[:,::1], i8[::1]))(f8[:,::1])")
def build(middle: Float64Array) -> tuple[Int64Array, Int64Array]:
    """Nodes and order of a tree of triangles: each node is split at the median of its triangles' middles,
    Shape ``[T, 3]`` of any scale, along the axis on which these are farthest apart."""
    count = len(middle)
    order, nodes = np.arange(count), np.full((max(2 * count, 1), 3), -1, np.int64)
    nodes[0, 1], nodes[0, 2] = 0, count
    made, i = 1, 0
    while i < made:
        begin, end = nodes[i, 1], nodes[i, 2]
        if end - begin > _LEAF:
            some = order[begin:end].copy()
            axis, widest = 0, -1.0
            for c in range(3):
                low, high = np.inf, -np.inf
                for t in some:
                    low, high = min(low, middle[t, c]), max(high, middle[t, c])
                if high - low > widest:
                    axis, widest = c, high - low
            for k, t in enumerate(some[np.argsort(middle[some, axis], kind="mergesort")]):
                order[begin + k] = t
            half = (begin + end) // 2
            nodes[i, 0] = made
            nodes[made, 1], nodes[made, 2] = begin, half
            nodes[made + 1, 1], nodes[made + 1, 2] = half, end
            made += 2
        i += 1
    return nodes[:made].copy(), order


@loop(f"void({_TREES}, i8[:,::1], f8[:,::1], i8[:,::1])")
def fit(trees: Trees, standing: Int64Array, vertices: Float64Array, corners: Int64Array) -> None:
    """Fit trees, by their first node and the one past their last, Shape ``[M, 2]``, and their triangles to
    vertices [m], Shape ``[V, 3]``; ``corners`` are the vertices of each triangle, Shape ``[T, 3]``."""
    nodes, order, boxes, triangles = trees
    for tree in range(len(standing)):
        first, past = standing[tree, 0], standing[tree, 1]
        for k in range(nodes[first, 1], nodes[first, 2]):
            t = order[k]
            for c in range(3):
                triangles[t, c] = vertices[corners[t, 0], c]
                triangles[t, 3 + c] = vertices[corners[t, 1], c] - triangles[t, c]
                triangles[t, 6 + c] = vertices[corners[t, 2], c] - triangles[t, c]
        for i in range(past - 1, first - 1, -1):
            child = nodes[i, 0]
            for c in range(3):
                low, high = np.inf, -np.inf
                if child >= 0:
                    low = min(boxes[child, c], boxes[child + 1, c])
                    high = max(boxes[child, 3 + c], boxes[child + 1, 3 + c])
                else:
                    for k in range(nodes[i, 1], nodes[i, 2]):
                        for corner in range(3):
                            along = vertices[corners[order[k], corner], c]
                            low, high = min(low, along), max(high, along)
                boxes[i, c], boxes[i, 3 + c] = low, high


@compiled
def _entry(boxes: Float64Array, i: int, ray: Ray, most: float) -> float:
    """Distance at which a ray, its start and the inverse of its direction, enters a box; infinite beyond
    ``most``, or where it misses the box."""
    near, far = 0.0, most
    for c in range(3):
        one, other = (boxes[i, c] - ray[c]) * ray[3 + c], (boxes[i, 3 + c] - ray[c]) * ray[3 + c]
        # Comparisons that are false for 0 · ∞, of a ray within a side of the box, keep it.
        near = max(near, min(one, other)) if one == one and other == other else near
        far = min(far, max(one, other)) if one == one and other == other else far
    # A flat box, of a wall along an axis, is entered and left at once.
    return near if near <= far * (1 + 1e-12) + 1e-12 else np.inf


@compiled
def _first_met(
    start: Float64Array, end: Float64Array, standing: Int64Array, trees: Trees, stack: Int64Array
) -> tuple[float, int]:
    """First triangle of trees on a segment between two points: its distance from the start less the segment's
    length [m], and its number; infinite and −1 where there is none before the end (T. Möller and B. Trumbore,
    "Fast, minimum storage ray/triangle intersection", 1997)."""
    nodes, order, boxes, triangles = trees
    ox, oy, oz = start[0], start[1], start[2]
    dx, dy, dz = end[0] - ox, end[1] - oy, end[2] - oz
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if not length > 0:
        return np.inf, -1
    dx, dy, dz = dx / length, dy / length, dz / length
    ray = (ox, oy, oz, 1 / dx, 1 / dy, 1 / dz)
    least, met = length, -1
    for tree in range(len(standing)):
        stack[0], depth = standing[tree, 0], 1
        while depth:
            depth -= 1
            i = stack[depth]
            if _entry(boxes, i, ray, least) == np.inf:
                continue
            child = nodes[i, 0]
            if child >= 0:
                # The nearer one is looked at first.
                nearer = _entry(boxes, child, ray, least) <= _entry(boxes, child + 1, ray, least)
                stack[depth], stack[depth + 1] = (child + 1, child) if nearer else (child, child + 1)
                depth += 2
                continue
            for k in range(nodes[i, 1], nodes[i, 2]):
                t = order[k]
                ax, ay, az = triangles[t, 3], triangles[t, 4], triangles[t, 5]
                bx, by, bz = triangles[t, 6], triangles[t, 7], triangles[t, 8]
                px, py, pz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
                volume = ax * px + ay * py + az * pz
                if volume == 0:
                    continue
                sx, sy, sz = ox - triangles[t, 0], oy - triangles[t, 1], oz - triangles[t, 2]
                u = (sx * px + sy * py + sz * pz) / volume
                if u < 0 or u > 1:
                    continue
                qx, qy, qz = sy * az - sz * ay, sz * ax - sx * az, sx * ay - sy * ax
                v = (dx * qx + dy * qy + dz * qz) / volume
                if v < 0 or u + v > 1:
                    continue
                along = (bx * qx + by * qy + bz * qz) / volume
                # Of triangles that coincide the one of the lowest number.
                if 0 < along < least or (along == least and t < met):
                    least, met = along, t
    return (least - length if met >= 0 else np.inf), met


@loop(f"Tuple((f8[::1], i8[::1]))(f8[:,::1], f8[:,::1], i8[:,::1], {_TREES})")
def first_met(
    start: Float64Array, end: Float64Array, standing: Int64Array, trees: Trees
) -> tuple[Float64Array, Int64Array]:
    """`_first_met` of each segment, Shape ``[Q, 3]``."""
    behind, met, stack = np.empty(len(start)), np.empty(len(start), np.int64), np.empty(_DEEPEST, np.int64)
    for q in range(len(start)):
        behind[q], met[q] = _first_met(start[q], end[q], standing, trees, stack)
    return behind, met


@loop(
    "b1[::1](f8[:,:,::1], i8[::1], i8[::1], f8[:,:,::1], i8[:,:,::1], i8[:,::1], "
    f"i8[:,::1], {_TREES}, i8[::1], f8[:,::1], f8[:,::1], f8, f8, f8, f8)"
)
def unhidden(
    corners: Float64Array,
    count: Int64Array,
    bend: Int64Array,
    normals: Float64Array,
    surfaces: Int64Array,
    planes: Int64Array,
    standing: Int64Array,
    trees: Trees,
    surface_of: Int64Array,
    plane_normals: Float64Array,
    plane_origins: Float64Array,
    off_surface: float,
    at_end: float,
    coplanar: float,
    coplanar_relative: float,
) -> BoolArray:
    """Mask of paths without an obstacle on their segments.

    A segment is free if a ray along it first meets the surface at its end, or something within ``at_end`` of
    it that does not stand in front of it: rays that end before would lose what grazes. Both faces of an edge
    are no obstacle to a segment that ends there: what a ray meets of them is rounding.

    Args:
        corners: Transmitter, interactions, and the receiver in all places past the last [m], Shape ``[P, D +
            2, 3]``.
        count: Interactions of each path, Shape ``[P]``.
        bend: Which of them is at an edge, −1 for none, Shape ``[P]``.
        normals: At corners: unit normals of faces, of edges between those of both faces, else 0.
        surfaces: At corners: surfaces that a ray may meet there, −1 for none, Shape ``[P, D + 2, 2]``.
        planes: At corners: plane of a face, −1 elsewhere, Shape ``[P, D + 2]``.
        standing: First and last node of the trees of what stands.
        trees: All trees.
        surface_of: Surface of each triangle.
        plane_normals: Unit normals of planes; ``plane_origins`` has a point of each.
        plane_origins: See ``plane_normals``.
        off_surface: How far from a face the ray that leaves it starts [m].
        at_end: See above [m].
        coplanar: Distance between parallel planes that rounding may make [m], and ``coplanar_relative``, what
            the largest coordinate adds to it.
        coplanar_relative: See ``coplanar``.
    """
    free, start, end = np.ones(len(corners), np.bool_), np.empty(3), np.empty(3)
    stack = np.empty(_DEEPEST, np.int64)
    for p in range(len(corners)):
        for d in range(count[p] + 1):
            # The last ray goes from the receiver, which is off every surface and needs no lift.
            a, b = (d + 1, d) if d == count[p] and d else (d, d + 1)
            along = 0.0
            for c in range(3):
                along += (corners[p, b, c] - corners[p, a, c]) * normals[p, a, c]
            # Off a face on the ray's side. A ray ends on a face, but beside an edge: rounding would put its
            # end into one of both faces.
            lift = off_surface * (1.0 if a == bend[p] + 1 else np.sign(along))
            beside = off_surface if b == bend[p] + 1 else 0.0
            for c in range(3):
                start[c] = corners[p, a, c] + lift * normals[p, a, c]
                end[c] = corners[p, b, c] + beside * normals[p, b, c]
            behind, triangle = _first_met(start, end, standing, trees, stack)
            if triangle < 0:
                continue
            met, wanted = surface_of[triangle], planes[p, b]
            if met == surfaces[p, b, 0] or met == surfaces[p, b, 1]:
                continue
            free[p] = behind >= -at_end
            if free[p] and wanted >= 0:
                # Of parallel faces that are farther apart than rounding, the one in front hides the other.
                dot, height, most = 0.0, 0.0, 0.0
                for c in range(3):
                    dot += plane_normals[met, c] * plane_normals[wanted, c]
                    height += (end[c] - plane_origins[met, c]) * plane_normals[met, c]
                    most = max(most, abs(end[c]))
                free[p] = abs(dot) <= _PARALLEL or abs(height) <= coplanar + coplanar_relative * most
            if not free[p]:
                break
    return free
