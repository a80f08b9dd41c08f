"""Loops over beams and what they light: cones, pyramids, mirrors and edges, in float64.

Beams have the Shape ``[B, 37]``: image of the source, axis, cosine and sine of the half angle of the
narrowest cone, unit normal of the last plane towards the lit side and the plane's offset along it, the unit
normals, inwards, of eight sides of pyramids, of which those that do not exist are 0, and the face that
reflected last, −1 for none. Targets are a tuple of

0. ``faces``, Shape ``[9, F]``: centre and radius of the sphere around each, unit normal, offset, and whether
   both sides reflect; those of scenery first,
1. ``corners`` of the faces' rectangles, in turn, Shape ``[F, 4, 3]``,
2. ``frames``, Shape ``[F, 5, 3]``: unit vectors along the sides of each rectangle, their half lengths, its
   centre and its unit normal,
3. ``bodies``, Shape ``[7, V]``: centre and radius of the sphere around each, and half the sides of its box
   along the axes,
4. ``begin``: the faces of body v are ``begin[v]`` to ``begin[v + 1]``,
5. ``sight_begin``: face f of scenery sees ``sights[sight_begin[f]:sight_begin[f + 1]]``,
6. ``sights``,
7. ``slack`` by which every target is larger [m].

Edges are a tuple of

0. ``pieces``: as ``bodies``, of the edges of each piece of the scene, Shape ``[7, P]``,
1. ``begin``: the edges of piece p are ``begin[p]`` to ``begin[p + 1]``,
2. ``boxes``: as ``bodies``, of each edge, Shape ``[7, E]``,
3. ``ends``, Shape ``[E, 2, 3]``,
4. ``normals`` of both faces, Shape ``[E, 2, 3]``,
5. ``surfaces`` of these, Shape ``[E, 2]``,
6. ``moves``: which edges are of a body, Shape ``[E]``.

Pairs are found in a fixed order, by their first index first.
"""

from __future__ import annotations

import math

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.enumeration.compiled_loops import compiled, loop, vectorized

Targets = tuple[
    Float64Array, Float64Array, Float64Array, Float64Array, Int64Array, Int64Array, Int64Array, float
]
_TARGETS = "Tuple((f8[:,::1], f8[:,:,::1], f8[:,:,::1], f8[:,::1], i8[::1], i8[::1], i8[::1], f8))"

Edges = tuple[Float64Array, Int64Array, Float64Array, Float64Array, Float64Array, Int64Array, BoolArray]
_EDGES = "Tuple((f8[:,::1], i8[::1], f8[:,::1], f8[:,:,::1], f8[:,:,::1], i8[:,::1], b1[::1]))"

AXIS, COSINE, SINE, LIT, LIT_FROM, SIDES, LAST, WIDTH = 3, 6, 7, 8, 11, 12, 36, 37
"""Columns of beams, and how many there are."""

# Other beams at an edge that are few.
_FEW = 2

# Cosine of the half angle of the widest cone that is tested; wider ones light everything.
_WIDE = 0.01


@compiled
def _added(found: Int64Array, count: int, one: int, two: int, three: int = 0) -> Int64Array:
    """Rows with one more after so many; where there is no room for it, they are copied."""
    if count == len(found):
        larger = np.empty((2 * count, found.shape[1]), np.int64)
        # Item by item: what assigns a slice takes seconds to compile, for the text of its error.
        for i in range(count):
            for k in range(found.shape[1]):
                larger[i, k] = found[i, k]
        found = larger
    found[count, 0], found[count, 1] = one, two
    if found.shape[1] > 2:
        found[count, 2] = three
    return found


@vectorized
def _near_cone(
    beams: Float64Array, b: int, spheres: Float64Array, low: int, high: int, extra: float, near: BoolArray
) -> None:
    """Test whether spheres reach into the cone of beam b, on the lit side of its last plane.

    A cheap test before those of pyramids, without a branch, so that a compiler takes several spheres at once.
    """
    ix, iy, iz = beams[b, 0], beams[b, 1], beams[b, 2]
    ax, ay, az = beams[b, AXIS], beams[b, AXIS + 1], beams[b, AXIS + 2]
    lx, ly, lz, lit_from = beams[b, LIT], beams[b, LIT + 1], beams[b, LIT + 2], beams[b, LIT_FROM]
    # A wide cone lights all.
    cosine, sine = max(beams[b, COSINE], 0.0), beams[b, SINE]
    square = cosine * cosine
    # From 0 on: an index that may be negative keeps the compiler from taking several at once.
    xs, ys, zs = spheres[0, low:high], spheres[1, low:high], spheres[2, low:high]
    radius = spheres[3, low:high]
    for j in range(len(xs)):
        x, y, z = xs[j], ys[j], zs[j]
        reach = radius[j] + extra
        tx, ty, tz = x - ix, y - iy, z - iz
        along = ax * tx + ay * ty + az * tz
        # The centre's distance from the mantle is across·cos − along·sin, which reach bounds; here squared.
        within = reach + along * sine
        across = (tx * tx + ty * ty + tz * tz - along * along) * square
        near[j] = (within >= 0) & (across <= within * within) & (x * lx + y * ly + z * lz - lit_from > -reach)


@compiled
def _in_pyramid(beams: Float64Array, b: int, x: float, y: float, z: float, reach: float) -> bool:
    """Test whether a sphere reaches into all pyramids of beam b."""
    tx, ty, tz = x - beams[b, 0], y - beams[b, 1], z - beams[b, 2]
    for k in range(SIDES, LAST, 3):
        if beams[b, k] * tx + beams[b, k + 1] * ty + beams[b, k + 2] * tz <= -reach:
            return False
    return True


@compiled
def _box_in_pyramid(beams: Float64Array, b: int, boxes: Float64Array, j: int, slack: float) -> bool:
    """Test whether box j reaches into all pyramids of beam b."""
    x, y, z = boxes[0, j] - beams[b, 0], boxes[1, j] - beams[b, 1], boxes[2, j] - beams[b, 2]
    for k in range(SIDES, LAST, 3):
        nx, ny, nz = beams[b, k], beams[b, k + 1], beams[b, k + 2]
        reach = abs(nx) * boxes[4, j] + abs(ny) * boxes[5, j] + abs(nz) * boxes[6, j] + slack
        if nx * x + ny * y + nz * z <= -reach:
            return False
    return True


@vectorized
def _facing(
    beams: Float64Array, b: int, faces: Float64Array, low: int, high: int, slack: float, near: BoolArray
) -> None:
    """Keep near faces that reflect on the side of the image of beam b: of closed bodies, those towards it."""
    x, y, z = beams[b, 0], beams[b, 1], beams[b, 2]
    nx, ny, nz = faces[4, low:high], faces[5, low:high], faces[6, low:high]
    offset, both = faces[7, low:high], faces[8, low:high]
    for j in range(len(nx)):
        near[j] &= (nx[j] * x + ny[j] * y + nz[j] * z - offset[j] > -slack) | (both[j] != 0)


@compiled
def _lit_boxes(
    beams: Float64Array, b: int, boxes: Float64Array, slack: float, near: BoolArray, lit: Int64Array
) -> int:
    """Write the numbers of the boxes that beam b lights, and return how many they are."""
    many = boxes.shape[1]
    _near_cone(beams, b, boxes, 0, many, 2 * slack, near)
    count = 0
    for j in range(many):
        if near[j] and _box_in_pyramid(beams, b, boxes, j, slack):
            lit[count] = j
            count += 1
    return count


@compiled
def _on_lit_side(beams: Float64Array, b: int, x: float, y: float, z: float, slack: float) -> bool:
    height = beams[b, LIT] * x + beams[b, LIT + 1] * y + beams[b, LIT + 2] * z
    lit: bool = height > beams[b, LIT_FROM] - slack
    return lit


@compiled
def _lights_corner(beams: Float64Array, b: int, corners: Float64Array, f: int, slack: float) -> bool:
    """Test whether face f may be lit: no side of beam b has all four corners beyond it.

    These are separating planes of a convex pyramid and a convex rectangle: conservative, as only those of the
    pyramid are tried.
    """
    most = -np.inf
    for i in range(4):
        x, y, z = corners[f, i, 0], corners[f, i, 1], corners[f, i, 2]
        most = max(most, beams[b, LIT] * x + beams[b, LIT + 1] * y + beams[b, LIT + 2] * z)
    if most <= beams[b, LIT_FROM] + slack:
        return False
    for k in range(SIDES, LAST, 3):
        nx, ny, nz = beams[b, k], beams[b, k + 1], beams[b, k + 2]
        if nx == 0 and ny == 0 and nz == 0:  # after one reflection there are four sides
            break
        least = nx * beams[b, 0] + ny * beams[b, 1] + nz * beams[b, 2] - slack
        most = -np.inf
        for i in range(4):
            most = max(most, nx * corners[f, i, 0] + ny * corners[f, i, 1] + nz * corners[f, i, 2])
        if most <= least:
            return False
    return True


@compiled
def _fill_sides(beams: Float64Array, b: int, column: int, edge: Float64Array) -> None:
    """Unit normals, inwards, of the sides of a pyramid with these edges, Shape ``[4, 3]``."""
    mx, my, mz = edge[0, 0] + edge[2, 0], edge[0, 1] + edge[2, 1], edge[0, 2] + edge[2, 2]
    for i in range(4):
        j = (i + 1) % 4
        x = edge[i, 1] * edge[j, 2] - edge[i, 2] * edge[j, 1]
        y = edge[i, 2] * edge[j, 0] - edge[i, 0] * edge[j, 2]
        z = edge[i, 0] * edge[j, 1] - edge[i, 1] * edge[j, 0]
        # Of an image in the plane of its rectangle the pyramid is flat, and a side has no direction.
        scale = 1.0 / math.sqrt(max(x * x + y * y + z * z, 1e-20))
        if x * mx + y * my + z * mz < 0:
            scale = -scale
        k = column + 3 * i
        beams[b, k], beams[b, k + 1], beams[b, k + 2] = x * scale, y * scale, z * scale


@loop(f"f8[:,::1]({_TARGETS}, f8[:,::1], i8[::1], i8[::1])")
def reflected(targets: Targets, before: Float64Array, parent: Int64Array, last: Int64Array) -> Float64Array:
    """Beams after a reflection of beams ``before``, by their number in ``parent``, at the faces ``last``; the
    faces that reflected them before bound the beams, too."""
    faces, corners = targets[:2]
    beams = np.zeros((len(last), WIDTH))
    edge, axis = np.empty((4, 3)), np.empty(3)
    for b in range(len(last)):
        f, source, g = last[b], before[parent[b]], int(before[parent[b], LAST])
        n0, n1, n2, offset = faces[4, f], faces[5, f], faces[6, f], faces[7, f]
        height = source[0] * n0 + source[1] * n1 + source[2] * n2 - offset
        image = beams[b]
        image[LAST] = f
        for c in range(3):
            image[c] = source[c] - 2 * height * faces[4 + c, f]
        # The image is behind the mirror, so the lit side is the other one.
        away = -1.0 if image[0] * n0 + image[1] * n1 + image[2] * n2 > offset else 1.0
        beams[b, LIT], beams[b, LIT + 1], beams[b, LIT + 2] = n0 * away, n1 * away, n2 * away
        beams[b, LIT_FROM] = offset * away
        narrowest = -2.0
        for which in range(2 if g >= 0 else 1):
            h = g if which else f
            axis[:] = 0.0
            for i in range(4):
                x, y, z = corners[h, i, 0], corners[h, i, 1], corners[h, i, 2]
                # The rectangle before this one bounds the beam, too, by its mirror image.
                height = (x * n0 + y * n1 + z * n2 - offset) if which else 0.0
                edge[i, 0] = x - 2 * height * n0 - image[0]
                edge[i, 1] = y - 2 * height * n1 - image[1]
                edge[i, 2] = z - 2 * height * n2 - image[2]
                length = math.sqrt(edge[i, 0] ** 2 + edge[i, 1] ** 2 + edge[i, 2] ** 2)
                if length > 0:
                    for c in range(3):
                        axis[c] += edge[i, c] / length
            length = math.sqrt(axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2)
            cosine = 2.0 if length > 0 else -1.0
            for i in range(4):
                norm = math.sqrt(edge[i, 0] ** 2 + edge[i, 1] ** 2 + edge[i, 2] ** 2) * length
                dot = edge[i, 0] * axis[0] + edge[i, 1] * axis[1] + edge[i, 2] * axis[2]
                cosine = min(cosine, dot / norm if norm > 0 else -1.0)
            # A cone that is wider than a half-space does not hold all that its directions span.
            cosine = cosine if cosine > _WIDE else -1.0
            if cosine > narrowest:
                narrowest = cosine
                for c in range(3):
                    beams[b, AXIS + c] = axis[c] / length if length > 0 else 0.0
            _fill_sides(beams, b, SIDES + 12 * which, edge)
        beams[b, COSINE] = narrowest
        beams[b, SINE] = math.sqrt(max(1 - min(narrowest, 1.0) ** 2, 0.0))
    return beams


@loop("i8[:,::1](f8[:,::1], f8[:,::1], f8)")
def lit_points(beams: Float64Array, points: Float64Array, slack: float) -> Int64Array:
    """Pairs of a beam and a point that it lights; points as boxes without sides, Shape ``[7, R]``."""
    found, count = np.empty((64, 2), np.int64), 0
    many = points.shape[1]
    near, lit = np.empty(many, np.bool_), np.empty(many, np.int64)
    for b in range(len(beams)):
        for i in range(_lit_boxes(beams, b, points, slack, near, lit)):
            found, count = _added(found, count, b, lit[i]), count + 1
    return found[:count].copy()


@compiled
def _lit_faces(
    beams: Float64Array, b: int, targets: Targets, low: int, high: int, near: BoolArray, lit: Int64Array
) -> int:
    """Write the numbers of the faces whose spheres reach into the cone of beam b and which reflect on its
    image's side, and return how many they are."""
    faces, slack = targets[0], targets[7]
    _near_cone(beams, b, faces, low, high, 2 * slack, near)
    _facing(beams, b, faces, low, high, slack, near)
    count = 0
    for j in range(low, high):
        if near[j - low]:
            lit[count] = j
            count += 1
    return count


@loop(f"i8[:,::1](f8[:,::1], i8, {_TARGETS})")
def lit_faces(beams: Float64Array, first: int, targets: Targets) -> Int64Array:
    """Pairs of a beam and a face that it lights: faces of bodies, and for beams from ``first`` on, faces of
    scenery."""
    faces, corners, _, bodies, begin, _, _, slack = targets
    found, count = np.empty((1024, 2), np.int64), 0
    near, lit_body = np.empty(faces.shape[1], np.bool_), np.empty(bodies.shape[1], np.int64)
    lit = np.empty(faces.shape[1], np.int64)
    for b in range(len(beams)):
        some = _lit_faces(beams, b, targets, 0, begin[0], near, lit) if b >= first else 0
        for i in range(_lit_boxes(beams, b, bodies, slack, near, lit_body)):
            v = lit_body[i]
            some += _lit_faces(beams, b, targets, begin[v], begin[v + 1], near, lit[some:])
        for i in range(some):
            f = lit[i]
            # A plane does not reflect twice in a row.
            if f != beams[b, LAST] and _lights_corner(beams, b, corners, f, slack):
                found, count = _added(found, count, b, f), count + 1
    return found[:count].copy()


@compiled
def _shown_sights(views: Float64Array, w: int, targets: Targets, shown: Int64Array) -> int:
    """Write the faces of scenery that view w shows, of those that its face sees; return how many they are."""
    faces, corners, _, _, _, sight_begin, sights, slack = targets
    face, count = int(views[w, LAST]), 0
    near = np.empty(1, np.bool_)
    for k in range(sight_begin[face], sight_begin[face + 1]):
        f = sights[k]
        _near_cone(views, w, faces, f, f + 1, 2 * slack, near)
        if near[0] and _lights_corner(views, w, corners, f, slack):
            shown[count] = f
            count += 1
    return count


@loop(f"i8[:,::1](f8[:,::1], {_TARGETS})")
def shown_scenery(views: Float64Array, targets: Targets) -> Int64Array:
    """Pairs of a view in a face of scenery, and a face of scenery that it shows."""
    found, count = np.empty((256, 2), np.int64), 0
    shown = np.empty(targets[0].shape[1], np.int64)
    for w in range(len(views)):
        for i in range(_shown_sights(views, w, targets, shown)):
            found, count = _added(found, count, w, shown[i]), count + 1
    return found[:count].copy()


@vectorized
def _crossing(
    beams: Float64Array,
    b: int,
    frames: Float64Array,
    f: int,
    slack: float,
    seen: Float64Array,
    own: int,
    crosses: BoolArray,
) -> bool:
    """Test which receivers see the image of beam b in face f, within its rectangle.

    ``seen[own]`` has the receivers in the face's frame (`_fill_seen`).
    """
    dx, dy, dz = beams[b, 0] - frames[f, 3, 0], beams[b, 1] - frames[f, 3, 1], beams[b, 2] - frames[f, 3, 2]
    x = dx * frames[f, 0, 0] + dy * frames[f, 0, 1] + dz * frames[f, 0, 2]
    y = dx * frames[f, 1, 0] + dy * frames[f, 1, 1] + dz * frames[f, 1, 2]
    height = dx * frames[f, 4, 0] + dy * frames[f, 4, 1] + dz * frames[f, 4, 2]
    wide, tall = frames[f, 2, 0] + slack, frames[f, 2, 1] + slack
    some = 0
    ps, qs, gs = seen[own, 0], seen[own, 1], seen[own, 2]
    for r in range(len(ps)):
        p, q, g = ps[r], qs[r], gs[r]
        # The line from the receiver to the image meets the plane at (p, q)·height + (x, y)·g over the sum of
        # both heights, of which none is divided by: most receivers see no image.
        total = abs(g + height)
        crosses[r] = (
            (g * height > 0)
            & (abs(p * height + x * g) <= wide * total)
            & (abs(q * height + y * g) <= tall * total)
        )
        some += crosses[r]
    return some > 0


@compiled
def _fill_seen(targets: Targets, f: int, points: Float64Array, seen: Float64Array) -> None:
    """Points, Shape ``[R, 3]``, in the frame of face f: along both sides from the centre, and the height, 0
    where the face shows its back; Shape ``[3, R]``."""
    faces, frame = targets[0], targets[2][f]
    for r in range(len(points)):
        dx, dy, dz = points[r, 0] - faces[0, f], points[r, 1] - faces[1, f], points[r, 2] - faces[2, f]
        seen[0, r] = dx * frame[0, 0] + dy * frame[0, 1] + dz * frame[0, 2]
        seen[1, r] = dx * frame[1, 0] + dy * frame[1, 1] + dz * frame[1, 2]
        height = dx * faces[4, f] + dy * faces[5, f] + dz * faces[6, f]
        seen[2, r] = height if height > 0 or faces[8, f] != 0 else 0.0


@loop(f"i8[:,::1](f8[:,::1], {_TARGETS}, f8[:,::1])")
def ends_by_bodies(beams: Float64Array, targets: Targets, points: Float64Array) -> Int64Array:
    """Beam, face of a body and receiver wherever the beam may light the receiver by a reflection at the face.

    Instead of a beam through the last face, the receiver's image in it is held against the beam before.

    Args:
        beams: Before the last reflection.
        targets: All targets.
        points: Receivers, Shape ``[R, 3]``.
    """
    faces, _, frames, bodies, begin, _, _, slack = targets
    found, count = np.empty((256, 3), np.int64), 0
    near, lit_body = np.empty(faces.shape[1], np.bool_), np.empty(bodies.shape[1], np.int64)
    lit, crosses = np.empty(faces.shape[1], np.int64), np.empty(len(points), np.bool_)
    seen = np.empty((faces.shape[1] - begin[0], 3, len(points)))
    for own in range(len(seen)):
        _fill_seen(targets, begin[0] + own, points, seen[own])
    for b in range(len(beams)):
        for i in range(_lit_boxes(beams, b, bodies, slack, near, lit_body)):
            v = lit_body[i]
            for k in range(_lit_faces(beams, b, targets, begin[v], begin[v + 1], near, lit)):
                f = lit[k]
                own = f - begin[0]
                if f == beams[b, LAST] or not _crossing(beams, b, frames, f, slack, seen, own, crosses):
                    continue
                for r in range(len(points)):
                    twice = 2 * seen[own, 2, r]
                    x, y = points[r, 0] - twice * faces[4, f], points[r, 1] - twice * faces[5, f]
                    if crosses[r] and _in_pyramid(beams, b, x, y, points[r, 2] - twice * faces[6, f], slack):
                        found, count = _added(found, count, b, f, r), count + 1
    return found[:count].copy()


@vectorized
def _cones_near(
    columns: Float64Array, low: int, high: int, x: float, y: float, z: float, reach: float, lit: BoolArray
) -> None:
    """Test whether a sphere reaches into the cones of several beams, whose columns are rows here."""
    xs, ys, zs = columns[0, low:high], columns[1, low:high], columns[2, low:high]
    ax, ay, az = columns[AXIS, low:high], columns[AXIS + 1, low:high], columns[AXIS + 2, low:high]
    cosine, sine = columns[COSINE, low:high], columns[SINE, low:high]
    for b in range(len(xs)):
        tx, ty, tz = x - xs[b], y - ys[b], z - zs[b]
        along = ax[b] * tx + ay[b] * ty + az[b] * tz
        within = reach + along * sine[b]
        across = (tx * tx + ty * ty + tz * tz - along * along) * (cosine[b] * cosine[b])
        lit[b] = (within >= 0) & (across <= within * within)


@loop(f"i8[:,::1](f8[:,::1], i8, f8[:,::1], {_TARGETS}, f8[:,::1])")
def ends_by_scenery(
    beams: Float64Array, first: int, views: Float64Array, targets: Targets, points: Float64Array
) -> Int64Array:
    """Beam and view of each pair where the beam may light the view's receiver by a reflection at its face.

    What a receiver sees in a face is a beam, too: only bodies and faces that this one lights can reflect
    before. So beams of the transmitter are grouped by their last body or face, and each view is tested
    against the groups that it shows instead of against all beams.

    Args:
        beams: Before the last reflection; from ``first`` on they are by way of a body, and count.
        first: See ``beams``.
        views: What receivers see in faces of scenery, as beams.
        targets: All targets.
        points: Receiver of each view, Shape ``[W, 3]``.
    """
    faces, _, frames, bodies, begin, _, _, slack = targets
    found, count = np.empty((256, 2), np.int64), 0
    # A group for each body, then one for each face of scenery.
    many = bodies.shape[1]
    group_of = many + np.arange(faces.shape[1])
    for v in range(many):
        group_of[begin[v] : begin[v + 1]] = v
    group_begin = np.zeros(many + begin[0] + 1, np.int64)
    for b in range(first, len(beams)):
        group_begin[group_of[int(beams[b, LAST])] + 1] += 1
    group_begin = np.cumsum(group_begin)
    order, filled = np.empty(len(beams) - first, np.int64), group_begin.copy()
    # Beams as columns: a view's image is held against several at once.
    columns, near = np.empty((LIT, len(order))), np.empty(len(order) + many, np.bool_)
    for b in range(first, len(beams)):
        group = group_of[int(beams[b, LAST])]
        order[filled[group]] = b
        for c in range(LIT):
            columns[c, filled[group]] = beams[b, c]
        columns[COSINE, filled[group]] = max(beams[b, COSINE], 0.0)
        filled[group] += 1
    shows = np.zeros((len(group_begin) - 1, len(views)), np.bool_)
    lit_body, shown = np.empty(many, np.int64), np.empty(begin[0], np.int64)
    seen, crosses = np.empty((len(views), 3, 1)), np.empty(1, np.bool_)
    for w in range(len(views)):
        _fill_seen(targets, int(views[w, LAST]), points[w : w + 1], seen[w])
        if seen[w, 2, 0] == 0:
            continue
        for i in range(_lit_boxes(views, w, bodies, slack, near, lit_body)):
            shows[lit_body[i], w] = True
        for i in range(_shown_sights(views, w, targets, shown)):
            shows[many + shown[i], w] = True
    # Group by group, whose beams stay in the processor's cache while all views are tested.
    for group in range(len(shows)):
        low, high = group_begin[group], group_begin[group + 1]
        for w in range(len(views)):
            if low == high or not shows[group, w]:
                continue
            f = int(views[w, LAST])
            ix, iy, iz = views[w, 0], views[w, 1], views[w, 2]
            _cones_near(columns, low, high, ix, iy, iz, 2 * slack, near)
            for k in range(low, high):
                b = order[k]
                if not near[k - low] or not _on_lit_side(beams, b, ix, iy, iz, slack):
                    continue
                if beams[b, LAST] == f or not _in_pyramid(beams, b, ix, iy, iz, slack):
                    continue
                if _crossing(beams, b, frames, f, slack, seen, w, crosses):
                    found, count = _added(found, count, b, w), count + 1
    return found[:count].copy()


@compiled
def _near_edges(
    beams: Float64Array,
    b: int,
    own: int,
    edges: Edges,
    slack: float,
    near: BoolArray,
    piece: Int64Array,
    lit: Int64Array,
) -> int:
    """Write the edges whose spheres reach into the cone of beam b, whose image is in front of a face of them,
    and return how many they are; but for edges of the surface ``own``, which reflected the beam last: they
    lie in the mirror's plane, and no wave goes from there to them."""
    pieces, begin, boxes, ends, normals, surfaces, _ = edges
    x, y, z = beams[b, 0], beams[b, 1], beams[b, 2]
    count = 0
    for i in range(_lit_boxes(beams, b, pieces, slack, near, piece)):
        low, high = begin[piece[i]], begin[piece[i] + 1]
        _near_cone(beams, b, boxes, low, high, 2 * slack, near)
        for e in range(low, high):
            if not near[e - low] or surfaces[e, 0] == own or surfaces[e, 1] == own:
                continue
            dx, dy, dz = x - ends[e, 0, 0], y - ends[e, 0, 1], z - ends[e, 0, 2]
            first = dx * normals[e, 0, 0] + dy * normals[e, 0, 1] + dz * normals[e, 0, 2]
            second = dx * normals[e, 1, 0] + dy * normals[e, 1, 1] + dz * normals[e, 1, 2]
            if first > -slack or second > -slack:
                lit[count] = e
                count += 1
    return count


@loop(f"i8[:,::1](f8[:,::1], i8[::1], {_EDGES}, f8)", edges=True)
def lit_edges(beams: Float64Array, own: Int64Array, edges: Edges, slack: float) -> Int64Array:
    """Pairs of a beam and an edge that it may light; ``own`` are the surfaces that reflected the beams last,
    −2 for none."""
    found, count = np.empty((1024, 2), np.int64), 0
    near, piece = np.empty(len(edges[3]), np.bool_), np.empty(len(edges[3]), np.int64)
    lit = np.empty(len(edges[3]), np.int64)
    for b in range(len(beams)):
        for i in range(_near_edges(beams, b, own[b], edges, slack, near, piece, lit)):
            if _box_in_pyramid(beams, b, edges[2], lit[i], slack):
                found, count = _added(found, count, b, lit[i]), count + 1
    return found[:count].copy()


@compiled
def _unfolded(
    beams: Float64Array, b: int, ends: Float64Array, ux: float, uy: float, uz: float
) -> tuple[float, float]:
    """Coordinate of the image of beam b along the line of an edge, and its distance from that line."""
    x, y, z = beams[b, 0] - ends[0, 0], beams[b, 1] - ends[0, 1], beams[b, 2] - ends[0, 2]
    s = x * ux + y * uy + z * uz
    x, y, z = x - s * ux, y - s * uy, z - s * uz
    return s, math.sqrt(x * x + y * y + z * z)


@loop(f"i8[:,::1](f8[:,::1], i8[::1], b1[::1], f8[:,::1], i8[:,::1], b1[::1], {_EDGES}, f8)", edges=True)
def meetings(
    beams: Float64Array,
    own: Int64Array,
    moves: BoolArray,
    others: Float64Array,
    lit: Int64Array,
    others_move: BoolArray,
    edges: Edges,
    slack: float,
) -> Int64Array:
    """Beam, edge and other beam wherever beams from both sides meet at an edge, at the point of Keller's law.

    Args:
        beams: Beams from one side.
        own: Surface that reflected each of them last, −2 for none.
        moves: Which of them are by way of a body; likewise ``others_move``. One of both beams and of the edge
            has to be of a body.
        others: Beams from the other side.
        lit: Pairs of an edge and one of these that may light it, in the order of edges.
        others_move: See ``moves``.
        edges: All edges.
        slack: By which all targets are larger [m].
    """
    ends, edge_moves = edges[3], edges[6]
    found, count = np.empty((256, 3), np.int64), 0
    near, piece = np.empty(len(ends), np.bool_), np.empty(len(ends), np.int64)
    reached = np.empty(len(ends), np.int64)
    begin = np.searchsorted(lit[:, 0], np.arange(len(ends) + 1))
    # Unit vectors along edges and their lengths; where the others are along them, and how far from them.
    units, along, aways = np.empty((len(ends), 4)), np.empty(len(lit)), np.empty(len(lit))
    for e in range(len(ends)):
        ux, uy = ends[e, 1, 0] - ends[e, 0, 0], ends[e, 1, 1] - ends[e, 0, 1]
        uz = ends[e, 1, 2] - ends[e, 0, 2]
        length = math.sqrt(ux * ux + uy * uy + uz * uz)
        ux, uy, uz = ux / length, uy / length, uz / length
        units[e, 0], units[e, 1], units[e, 2], units[e, 3] = ux, uy, uz, length
        for k in range(begin[e], begin[e + 1]):
            along[k], aways[k] = _unfolded(others, lit[k, 1], ends[e], ux, uy, uz)
    for b in range(len(beams)):
        for i in range(_near_edges(beams, b, own[b], edges, slack, near, piece, reached)):
            e = reached[i]
            # Where few others meet the beam, the test of each costs less than that of the edge.
            if begin[e + 1] - begin[e] > _FEW and not _box_in_pyramid(beams, b, edges[2], e, slack):
                continue
            ux, uy, uz, length = units[e, 0], units[e, 1], units[e, 2], units[e, 3]
            s, away = _unfolded(beams, b, ends[e], ux, uy, uz)
            for k in range(begin[e], begin[e + 1]):
                # Keller's law: s − place over the one distance is place − t over the other. Most places are
                # beyond the ends, and not divided.
                place, total = s * aways[k] + along[k] * away, away + aways[k]
                if not -slack * total < place < (length + slack) * total:
                    continue
                o, place = lit[k, 1], place / total
                if not (moves[b] or edge_moves[e] or others_move[o]):
                    continue
                x, y, z = ends[e, 0, 0] + place * ux, ends[e, 0, 1] + place * uy, ends[e, 0, 2] + place * uz
                if not (_on_lit_side(beams, b, x, y, z, slack) and _on_lit_side(others, o, x, y, z, slack)):
                    continue
                if _in_pyramid(beams, b, x, y, z, slack) and _in_pyramid(others, o, x, y, z, slack):
                    found, count = _added(found, count, b, e, o), count + 1
    return found[:count].copy()
