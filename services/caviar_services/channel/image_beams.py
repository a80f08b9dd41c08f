"""Beams of images: where waves can go that were reflected at given faces, culled in the ray tracer's arrays.

Mirrored in a face, a transmitter is an image, and what it lights by way of that face is the pyramid from the
image through the face's rectangle. The next face mirrors the image and the last rectangle with it: a beam is
an image, the pyramids through its last two rectangles, and the side of the last plane that it lights (M. F.
Catedra et al., "Efficient ray-tracing techniques for three-dimensional analyses of propagation in mobile
communications", IEEE Antennas Propag. Mag. 40(2), 1998, cull by such beams). Nothing that a beam lights is
left out, and some that it does not light is kept: the image method decides, in float64, which is a path.

Everything here counts in float32, with a slack that is more than its rounding.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.face_rectangles import FaceRectangles, ranges
from caviar_services.channel.sionna_candidates import positions
from caviar_services.columns import aligned_columns, aligned_indices, several

_SLACK = 5e-3
"""[m] around everything that is looked for."""

_RELATIVE_SLACK = 2e-6
"""The same as a part of the largest coordinate."""

_WIDE = 0.01
"""Cosine of the half angle of the widest cone that is held against anything."""

_BLOCK = 16
"""Beams of one group that are looked at together: groups are filled up to a multiple of it."""

_LANES = 1 << 23
"""Pairs that are looked at together at most."""


class Targets:
    """What beams are held against in a frame: faces, the spheres around bodies, and points.

    Parameters
    ----------
    faces
        Of scenery, and behind them of bodies, body after body.
    sizes
        How many of the last ones each body has, Shape ``[V]``.
    """

    def __init__(self, faces: FaceRectangles, sizes: Int64Array) -> None:
        import drjit as dr
        import mitsuba as mi

        self.faces = faces
        self.first_body = len(faces) - int(sizes.sum())
        """Number of the first face of a body."""
        self.most = int(sizes.max(initial=0))
        """Faces of a body, at most."""
        self.bodies = len(sizes)
        centre, reach = _spheres(faces, self.first_body, sizes)
        rows = np.concatenate(
            [
                faces.normal,
                faces.centre,
                faces.axes[:, 0] * faces.half[:, :1],
                faces.axes[:, 1] * faces.half[:, 1:],
                faces.offset[:, None],
                faces.radius[:, None],
            ],
            axis=1,
        ).T
        columns = [mi.Float(column) for column in aligned_columns(rows[:, several(len(faces))])]
        self.normal, self.centre, self.u, self.v = (mi.Vector3f(*columns[i : i + 3]) for i in (0, 3, 6, 9))
        self.offset, self.radius = columns[12:]
        self.two_sided = mi.UInt(aligned_indices(faces.two_sided[several(len(faces))])) != 0
        some = several(self.bodies)
        self.body_centre = positions(centre[some])
        self.body_radius = mi.Float(aligned_columns(reach[None, some])[0])
        begin = self.first_body + np.cumsum(sizes) - sizes
        self.body_begin, self.body_size = (mi.UInt(aligned_indices(part[some])) for part in (begin, sizes))
        slack = _SLACK + _RELATIVE_SLACK * float(np.abs(faces.centre).max(initial=0.0))
        self.slack = dr.opaque(mi.Float, slack)
        """Around everything that is looked for [m]; a number in a kernel would be another kernel."""

    def body_of(self, faces: Int64Array) -> Int64Array:
        """Number of the body of these faces of bodies."""
        begin = self.body_begin.numpy()[: self.bodies].astype(np.int64)
        return np.searchsorted(begin, faces, side="right") - 1

    def corners(self, face: Any) -> list[Any]:
        """Those of rectangles, in turn."""
        centre, u, v = (_gathered(column, face) for column in (self.centre, self.u, self.v))
        return [centre - u - v, centre + u - v, centre + u + v, centre - u + v]

    def height(self, point: Any, face: Any) -> Any:
        """How far points are in front of planes."""
        import drjit as dr

        return dr.dot(point, _gathered(self.normal, face)) - _gathered(self.offset, face)


def _spheres(faces: FaceRectangles, first: int, sizes: Int64Array) -> tuple[Float64Array, Float64Array]:
    """Centre [m], Shape ``[V, 3]``, and radius [m] of a sphere around all rectangles of each body."""
    if not len(sizes):
        return np.zeros((0, 3)), np.zeros(0)
    u, v = (faces.axes[first:, i] * faces.half[first:, i, None] for i in (0, 1))
    corners = faces.centre[first:, None] + np.stack([u + v, u - v, v - u, -u - v], axis=1)
    begin = np.cumsum(sizes) - sizes
    low = np.minimum.reduceat(corners.min(1), begin)
    high = np.maximum.reduceat(corners.max(1), begin)
    centre = (low + high) / 2
    away = np.sqrt(((corners - np.repeat(centre, sizes, axis=0)[:, None]) ** 2).sum(-1)).max(1)
    return centre, np.maximum.reduceat(away, begin)


@dataclass(frozen=True, eq=False)
class SceneryViews:
    """Faces of scenery that may be the last ones before receivers."""

    faces: Int64Array
    """In ascending order, Shape ``[U]``."""
    sights: Int64Array
    """Which of these see one another, as places among them, in both orders and sorted, Shape ``[M, 2]``."""
    receiver: Int64Array
    """Of W pairs of a receiver and a face that it may see, Shape ``[W]``."""
    place: Int64Array
    """Places of these faces, Shape ``[W]``."""


@dataclass(frozen=True, eq=False)
class Beams:
    """B beams behind the same number of reflections, in the ray tracer's arrays and in NumPy's."""

    chain: Int64Array
    """Faces that they were reflected at, Shape ``[B, n]``."""
    by_body: BoolArray
    """Whether one of these is of a body, Shape ``[B]``."""
    image: Any
    sides: Sequence[Any]
    """Unit normals, inwards, of the pyramids' sides: four for each rectangle."""
    axis: Any
    cosine: Any
    """Of the half angle of the narrowest cone around a pyramid."""
    last: Any
    """The last face."""
    lit: Any
    """Unit normal of its plane towards the side that is lit."""
    lit_from: Any
    """Offset of that plane along it."""

    def __len__(self) -> int:
        return len(self.chain)

    @property
    def first_by_body(self) -> int:
        """Number of the first beam by way of a body: those of scenery alone stand before."""
        return int(np.argmax(self.by_body)) if self.by_body.any() else len(self)

    def light_cone(self, beam: Any, centre: Any, radius: Any, slack: Any) -> Any:
        """Whether spheres reach into the cones of beams, and before their last planes."""
        import drjit as dr

        axis, cosine = _gathered(self.axis, beam), _gathered(self.cosine, beam)
        towards = centre - _gathered(self.image, beam)
        along = dr.dot(axis, towards)
        across = dr.sqrt(dr.maximum(dr.squared_norm(towards) - along * along, 0.0))
        sine = dr.sqrt(dr.maximum(1.0 - cosine * cosine, 0.0))
        before = dr.dot(_gathered(self.lit, beam), centre) - _gathered(self.lit_from, beam)
        reach = radius + 2.0 * slack
        return (across * cosine - along * sine <= reach) & (before > -reach)

    def light(self, beam: Any, centre: Any, reach: Any) -> Any:
        """Whether spheres reach into the pyramids of beams."""
        import drjit as dr
        import mitsuba as mi

        towards = centre - _gathered(self.image, beam)
        lit = mi.Bool(True)
        for side in self.sides:
            lit &= dr.dot(_gathered(side, beam), towards) > -reach
        return lit


def first_beams(targets: Targets, source: Float64Array, scenery: Int64Array) -> Beams:
    """Beams of a transmitter [m], Shape ``[3]``, by faces of scenery, then by all that bodies show it."""
    faces = targets.faces
    bodies = np.arange(targets.first_body, len(faces))
    shown = faces.height(np.broadcast_to(source, (len(bodies), 3)), bodies) > 0
    first = np.concatenate([scenery, bodies[shown | faces.two_sided[bodies]]])
    image = positions(np.broadcast_to(source, (len(several(len(first))), 3)))
    return _reflected(targets, first[:, None], image, None)


def receiver_beams(targets: Targets, receivers: Float64Array, faces: Int64Array) -> Beams:
    """What each of some receivers [m], Shape ``[W, 3]``, sees in a face of scenery, Shape ``[W]``."""
    return _reflected(targets, faces[:, None], positions(receivers[several(len(faces))]), None)


def next_beams(targets: Targets, beams: Beams, scenery: Int64Array, known: Int64Array) -> Beams:
    """Beams behind one more reflection.

    Parameters
    ----------
    scenery
        Faces of scenery that reflect what bodies reflected.
    known
        Chains of scenery alone that are one longer than those of ``beams``, Shape ``[K, n + 1]``, each
        beginning with one of these: of scenery alone these are gone on with.
    """

    beam, face = by_scenery(targets, beams, scenery)
    of_body = filtered(partial(_lights_corner, targets, beams), lit_bodies(targets, beams))
    chain = np.concatenate(
        [
            known,
            np.concatenate([beams.chain[_numbers(beam)], _numbers(face)[:, None]], axis=1),
            np.concatenate([beams.chain[_numbers(of_body[0])], _numbers(of_body[1])[:, None]], axis=1),
        ]
    )
    before = _rows_of(beams.chain[: beams.first_by_body], known[:, :-1])
    parent = np.concatenate([before, _numbers(beam), _numbers(of_body[0])])
    return _longer(targets, beams, parent, chain)


def scenery_beams(targets: Targets, beams: Beams, known: Int64Array) -> Beams:
    """Of `next_beams`, those of chains of scenery alone."""
    return _longer(targets, beams, _rows_of(beams.chain[: beams.first_by_body], known[:, :-1]), known)


def _longer(targets: Targets, beams: Beams, parent: Int64Array, chain: Int64Array) -> Beams:
    """Beams of chains, each of which is longer by one than that of its parent."""
    import mitsuba as mi

    index = mi.UInt(aligned_indices(parent[several(len(parent))]))
    return _reflected(targets, chain, _gathered(beams.image, index), _gathered(beams.last, index))


def by_scenery(targets: Targets, beams: Beams, scenery: Int64Array) -> tuple[Any, Any]:
    """Beams by way of bodies and faces of scenery that they light, as `mitsuba.UInt`."""
    import drjit as dr
    import mitsuba as mi

    faces = mi.UInt(aligned_indices(scenery[several(len(scenery))]))
    begin = beams.first_by_body
    first = _opaque(begin)

    def near(beam: Any, place: Any) -> Any:
        beam, face = beam + first, _gathered(faces, place)
        centre, radius = _gathered(targets.centre, face), _gathered(targets.radius, face)
        lit = beams.light_cone(beam, centre, radius, targets.slack)
        return lit & (face != _gathered(beams.last, beam))

    def lights(beam: Any, place: Any) -> Any:
        return _lights_corner(targets, beams, beam + first, _gathered(faces, place))

    beam, place = filtered(lights, pairs(len(beams) - begin, len(scenery), near))
    if not dr.width(beam):
        return beam, place
    beam, face = beam + first, _gathered(faces, place)
    dr.eval(beam, face)
    return beam, face


def lit_bodies(targets: Targets, beams: Beams) -> tuple[Any, Any]:
    """Beams and faces of bodies whose spheres they light, as `mitsuba.UInt`."""
    import drjit as dr

    slack = targets.slack
    beam, body = near_bodies(targets, beams)

    def face_of(pair: Any, number: Any) -> Any:
        return _gathered(targets.body_begin, _gathered(body, pair)) + number

    def shows(pair: Any, number: Any) -> Any:
        there = number < _gathered(targets.body_size, _gathered(body, pair))
        of, face = _gathered(beam, pair), dr.select(there, face_of(pair, number), 0)
        height = targets.height(_gathered(beams.image, of), face)
        there &= (height > -slack) | _gathered(targets.two_sided, face)
        there &= face != _gathered(beams.last, of)
        centre, radius = _gathered(targets.centre, face), _gathered(targets.radius, face)
        return there & beams.light_cone(of, centre, radius, slack)

    def shows_within(pair: Any, number: Any) -> Any:
        face = face_of(pair, number)
        reach = _gathered(targets.radius, face) + slack
        return beams.light(_gathered(beam, pair), _gathered(targets.centre, face), reach)

    pair, number = filtered(shows_within, pairs(dr.width(beam), targets.most, shows))
    beam, face = _gathered(beam, pair), face_of(pair, number)
    dr.eval(beam, face)
    return beam, face


def _reflected(targets: Targets, chain: Int64Array, image: Any, before: Any | None) -> Beams:
    """Beams by way of the last faces of chains, from images before these and by way of faces ``before``."""
    import drjit as dr
    import mitsuba as mi

    last = mi.UInt(aligned_indices(chain[several(len(chain)), -1]))
    normal, offset = _gathered(targets.normal, last), _gathered(targets.offset, last)

    def mirrored(point: Any) -> Any:
        return point - 2.0 * (dr.dot(point, normal) - offset) * normal

    image = mirrored(image)
    corners = targets.corners(last)
    axis, cosine = _cone(image, corners)
    sides = _sides(image, corners)
    if before is not None:
        mirrored_corners = [mirrored(corner) for corner in targets.corners(before)]
        other_axis, other_cosine = _cone(image, mirrored_corners)
        narrower = other_cosine > cosine
        axis, cosine = dr.select(narrower, other_axis, axis), dr.maximum(cosine, other_cosine)
        sides += _sides(image, mirrored_corners)
    away = dr.select(dr.dot(image, normal) > offset, -1.0, 1.0)
    lit, lit_from = normal * away, offset * away
    dr.eval(image, axis, cosine, sides, lit, lit_from, last)
    by_body = chain >= targets.first_body
    return Beams(
        chain, np.logical_or.reduce(by_body, axis=1), image, sides, axis, cosine, last, lit, lit_from
    )


def near_bodies(targets: Targets, beams: Beams) -> tuple[Any, Any]:
    """Beams and bodies whose spheres they light, as `mitsuba.UInt`."""

    def near(beam: Any, body: Any) -> Any:
        centre, radius = _gathered(targets.body_centre, body), _gathered(targets.body_radius, body)
        return beams.light_cone(beam, centre, radius, targets.slack)

    def lit(beam: Any, body: Any) -> Any:
        centre, radius = _gathered(targets.body_centre, body), _gathered(targets.body_radius, body)
        return beams.light(beam, centre, radius + targets.slack)

    return filtered(lit, pairs(len(beams), targets.bodies, near))


def ends_at(targets: Targets, beams: Beams, receivers: Float64Array) -> tuple[Int64Array, Int64Array]:
    """Beam and receiver of each pair where the one lights the other; receivers [m] are of Shape
    ``[R, 3]``."""
    place = positions(receivers[several(len(receivers))])

    def near(beam: Any, receiver: Any) -> Any:
        return beams.light_cone(beam, _gathered(place, receiver), 0.0, targets.slack)

    def lit(beam: Any, receiver: Any) -> Any:
        return beams.light(beam, _gathered(place, receiver), targets.slack)

    beam, receiver = filtered(lit, pairs(len(beams), len(receivers), near))
    return _numbers(beam), _numbers(receiver)


def ends_by_bodies(
    targets: Targets, beams: Beams, receivers: Float64Array
) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Beam, face of a body and receiver, where the beam may light the receiver by way of the face; receivers
    [m] are of Shape ``[R, 3]``."""
    import drjit as dr

    beam, face = lit_bodies(targets, beams)
    place = positions(receivers[several(len(receivers))])

    def crosses(way: Any, receiver: Any) -> Any:
        image = _gathered(beams.image, _gathered(beam, way))
        return _crosses(targets, image, _gathered(face, way), _gathered(place, receiver))

    def lit(way: Any, receiver: Any) -> Any:
        last, point = _gathered(face, way), _gathered(place, receiver)
        image = point - 2.0 * targets.height(point, last) * _gathered(targets.normal, last)
        return beams.light(_gathered(beam, way), image, targets.slack)

    way, receiver = filtered(lit, pairs(dr.width(beam), len(receivers), crosses))
    return _numbers(_gathered(beam, way)), _numbers(_gathered(face, way)), _numbers(receiver)


def ends_by_scenery(
    targets: Targets, beams: Beams, receivers: Float64Array, scenery: SceneryViews
) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Beam by way of a body, face of scenery and receiver, where the beam may light the receiver by way of
    the face; receivers [m] are of Shape ``[R, 3]``.

    What a receiver sees in a face is a beam too: only bodies and faces that it meets can come before.
    """
    import mitsuba as mi

    none = np.zeros(0, np.int64)
    first = beams.first_by_body
    if first == len(beams) or not len(scenery.receiver):
        return none, none, none
    views = receiver_beams(targets, receivers[scenery.receiver], scenery.faces[scenery.place])
    view, body = (_numbers(part) for part in near_bodies(targets, views))
    seen, other = _shown(targets, views, scenery)
    view = np.concatenate([view, seen])
    group = np.concatenate([body, targets.bodies + other])
    last = beams.chain[first:, -1]
    of_body = last >= targets.first_body
    place_of = np.searchsorted(scenery.faces, last)
    group_of = np.where(of_body, targets.body_of(last), targets.bodies + place_of)
    order = np.argsort(group_of, kind="stable")
    sizes = np.bincount(group_of, minlength=targets.bodies + len(scenery.faces))
    begin = np.cumsum(sizes) - sizes
    own, block = ranges(np.zeros(len(group), np.int64), -(-sizes[group] // _BLOCK))
    start = begin[group[own]] + block * _BLOCK
    columns = [
        mi.UInt(aligned_indices(column[several(len(own))]))
        for column in (view[own], start, (begin + sizes)[group[own]])
    ]
    by_group = mi.UInt(aligned_indices(first + order[several(len(order))]))
    place = positions(receivers[scenery.receiver[several(len(views))]])

    def beam_of(block: Any, number: Any) -> tuple[Any, Any]:
        there = _gathered(columns[1], block) + number
        within = there < _gathered(columns[2], block)
        return _gathered(by_group, _either(within, there)), within

    def near(block: Any, number: Any) -> Any:
        beam, within = beam_of(block, number)
        seen = _gathered(columns[0], block)
        within &= _gathered(views.last, seen) != _gathered(beams.last, beam)
        return within & beams.light_cone(beam, _gathered(views.image, seen), 0.0, targets.slack)

    def lit(block: Any, number: Any) -> Any:
        beam, _ = beam_of(block, number)
        seen = _gathered(columns[0], block)
        image, point = _gathered(beams.image, beam), _gathered(place, seen)
        crosses = _crosses(targets, image, _gathered(views.last, seen), point)
        return crosses & beams.light(beam, _gathered(views.image, seen), targets.slack)

    found = filtered(lit, pairs(len(own), _BLOCK, near))
    block, number = (_numbers(part) for part in found)
    seen = view[own[block]]
    beam = first + order[start[block] + number]
    return beam, scenery.faces[scenery.place[seen]], scenery.receiver[seen]


def _shown(targets: Targets, views: Beams, scenery: SceneryViews) -> tuple[Int64Array, Int64Array]:
    """Views, and places of the other faces of scenery that they show."""
    import drjit as dr
    import mitsuba as mi

    sizes = np.bincount(scenery.sights[:, 0], minlength=len(scenery.faces))
    own, rows = ranges((np.cumsum(sizes) - sizes)[scenery.place], sizes[scenery.place])
    other = scenery.sights[rows, 1]
    lanes = several(len(own))
    if not len(lanes):
        return own, other
    view, face = (mi.UInt(aligned_indices(column[lanes])) for column in (own, scenery.faces[other]))

    def near(pair: Any) -> Any:
        shown = _gathered(face, pair)
        centre, radius = _gathered(targets.centre, shown), _gathered(targets.radius, shown)
        return views.light_cone(_gathered(view, pair), centre, radius, targets.slack)

    def lights(pair: Any) -> Any:
        return _lights_corner(targets, views, _gathered(view, pair), _gathered(face, pair))

    kept = dr.compress(near(dr.arange(mi.UInt, len(lanes))))
    if dr.width(kept):
        kept = _gathered(kept, dr.compress(lights(kept)))
    pair = _numbers(kept)
    pair = pair[pair < len(own)]
    return own[pair], other[pair]


def _crosses(targets: Targets, image: Any, face: Any, point: Any) -> Any:
    """Whether points see images in faces: on the side that reflects, and within the rectangle."""
    import drjit as dr

    there, here = targets.height(image, face), targets.height(point, face)
    crosses = (there * here > 0.0) & ((here > 0.0) | _gathered(targets.two_sided, face))
    beside = dr.fma(image - point, here / (there + here), point) - _gathered(targets.centre, face)
    for side in (_gathered(targets.u, face), _gathered(targets.v, face)):
        square = dr.squared_norm(side)
        crosses &= dr.abs(dr.dot(beside, side)) <= square + targets.slack * dr.sqrt(square)
    return crosses


def pairs(first: int, second: int, test: Callable[[Any, Any], Any]) -> tuple[Any, Any]:
    """Which pairs of numbers below ``first`` and below ``second`` pass a test, as `mitsuba.UInt`."""
    import drjit as dr
    import mitsuba as mi

    parts = []
    at_once = max(1, _LANES // max(second, 1))
    many = dr.opaque(mi.UInt, second)
    for begin in range(0, first if second else 0, at_once):
        count = min(at_once, first - begin)
        lane = dr.arange(mi.UInt, count * second)
        start = dr.opaque(mi.UInt, begin)
        kept: Any = dr.compress(test(start + lane // many, lane % many))
        if dr.width(kept):
            parts.append((start + kept // many, kept % many))
    if not parts:
        return mi.UInt(), mi.UInt()
    if len(parts) == 1:
        return parts[0]
    return dr.concat([one for one, _ in parts]), dr.concat([other for _, other in parts])


def filtered(test: Callable[[Any, Any], Any], numbers: tuple[Any, Any]) -> tuple[Any, Any]:
    """Those of pairs of numbers that pass a test."""
    import drjit as dr

    if not dr.width(numbers[0]):
        return numbers
    kept = dr.compress(test(*numbers))
    found = _gathered(numbers[0], kept), _gathered(numbers[1], kept)
    dr.eval(found)
    return found


def _lights_corner(targets: Targets, beams: Beams, beam: Any, face: Any) -> Any:
    """Whether no side of beams has all corners of rectangles beyond it."""
    import drjit as dr

    corners, image = targets.corners(face), _gathered(beams.image, beam)
    lit = _some(corners, _gathered(beams.lit, beam), _gathered(beams.lit_from, beam) + targets.slack)
    for side in beams.sides:
        normal = _gathered(side, beam)
        lit &= _some(corners, normal, dr.dot(normal, image) - targets.slack)
    return lit


def _some(corners: list[Any], normal: Any, offset: Any) -> Any:
    """Whether one of the corners at least is beyond a plane."""
    import drjit as dr

    a, b, c, d = (dr.dot(normal, corner) for corner in corners)
    return dr.maximum(dr.maximum(a, b), dr.maximum(c, d)) > offset


def _sides(image: Any, corners: list[Any]) -> list[Any]:
    """Unit normals, inwards, of the sides of the pyramid from a point around corners in turn."""
    import drjit as dr

    edges = [corner - image for corner in corners]
    middle = edges[0] + edges[2]
    sides = []
    for one, other in zip(edges, [*edges[1:], edges[0]], strict=True):
        normal = dr.cross(one, other)
        normal *= dr.rsqrt(dr.maximum(dr.squared_norm(normal), 1e-20))
        sides.append(dr.select(dr.dot(normal, middle) < 0.0, -normal, normal))
    return sides


def _cone(image: Any, corners: list[Any]) -> tuple[Any, Any]:
    """Axis of a cone from a point around corners, and the cosine of its half angle."""
    import drjit as dr

    edges = [dr.normalize(corner - image) for corner in corners]
    axis = dr.normalize(edges[0] + edges[1] + edges[2] + edges[3])
    a, b, c, d = (dr.dot(edge, axis) for edge in edges)
    cosine = dr.minimum(dr.minimum(a, b), dr.minimum(c, d))
    # A cone that is wider than a half-space does not hold all that its directions span.
    return axis, dr.select(cosine > _WIDE, cosine, -1.0)


def _gathered(column: Any, index: Any) -> Any:
    import drjit as dr

    return dr.gather(type(column), column, index)


def _opaque(number: int) -> Any:
    """A number that a kernel reads: as a constant of the kernel, each would be another kernel."""
    import drjit as dr
    import mitsuba as mi

    return dr.opaque(mi.UInt, number)


def _either(used: Any, index: Any) -> Any:
    """An index where it is used, else 0."""
    import drjit as dr

    return dr.select(used, index, 0)


def _numbers(indices: Any) -> Int64Array:
    found: Int64Array = indices.numpy().astype(np.int64)
    return found


def _rows_of(rows: Int64Array, wanted: Int64Array) -> Int64Array:
    """Number of the row that each of the wanted ones is."""
    known = {tuple(row): number for number, row in enumerate(rows.tolist())}
    return np.array([known[tuple(row)] for row in wanted.tolist()], np.int64)
