"""Beam tracing: chains of reflections by way of moving bodies, enumerated, and the receivers that they light,
culled in the ray tracer's arrays.

Mirrored in a face, a transmitter is an image, and what it lights by way of that face is the pyramid from the
image through the face's rectangle. The next face mirrors the image and the last rectangle with it: a beam is
an image, the pyramids through its last two rectangles, and the side of the last plane that it lights (M. F.
Catedra et al., "Efficient ray-tracing techniques for three-dimensional analyses of propagation in mobile
communications", IEEE Antennas Propag. Mag. 40(2), 1998, cull by such beams). The test is conservative: it
leaves out nothing that a beam lights and keeps some that it does not light. Which chains are paths is decided
in float64 by the image method (`image_paths`).

All of this is computed in float32, with a slack that is larger than its rounding. Every test is one kernel:
its lanes are all pairs of two lists, for example of beams and faces.

Where bodies are small, rays rarely meet them, so a launch misses most chains by way of them. `chain_pairs`
takes every sequence of faces with a face of a body in it for a candidate, and leaves out sequences that beams
cannot reach. With B for a face of a body and S for one of scenery, these are to a depth of three: B, SB, BS,
BB, SSB, SBS, SBB, BSS, BSB, BBS and BBB. The last reflection needs no beam of its own: it exists where the
receiver's image in the last face lies in the beam before it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_services.channel.sionna import dr, mi
from caviar_services.drjit_setup import aligned_columns, aligned_indices, positions, several
from caviar_space.rectangles import FaceRectangles
from caviar_space.vectors import ranges

# Pairs that one kernel tests at most, so that its memory is bounded.
_LANES = 1 << 23


def pairs(first: int, second: int, test: Callable[[Any, Any], Any]) -> tuple[Any, Any]:
    """Pairs of indices that pass a test.

    Args:
        first: The first index of a pair is below it; the second one is below ``second``.
        second: See ``first``.
        test: From both indices, as `mitsuba.UInt`, whether the pair passes.

    Returns:
        First and second index of each pair, as `mitsuba.UInt`.
    """
    parts = []
    at_once = max(1, _LANES // max(second, 1))
    # Opaque: as a literal, each size would be another kernel to compile, and sizes change in every frame.
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
    """Pairs of indices that pass a test, evaluated."""
    if not dr.width(numbers[0]):
        return numbers
    kept = dr.compress(test(*numbers))
    found = gathered(numbers[0], kept), gathered(numbers[1], kept)
    dr.eval(found)
    return found


def gathered(column: Any, index: Any) -> Any:
    """Elements of a column of the ray tracer, by index."""
    return dr.gather(type(column), column, index)


def indices(values: Int64Array | BoolArray) -> Any:
    """Indices, Shape ``[N]``, as `mitsuba.UInt`, a single one twice (`several`)."""
    return mi.UInt(aligned_indices(values[several(len(values))]))


def columns(rows: Float64Array) -> list[Any]:
    """Rows, Shape ``[R, N]``, as one `mitsuba.Float` each, of a single number twice (`several`)."""
    return [mi.Float(column) for column in aligned_columns(rows[:, several(rows.shape[1])])]


def places(points: Float64Array) -> Any:
    """Positions, Shape ``[N, 3]``, as `mitsuba.Point3f`, a single one twice (`several`)."""
    return positions(points[several(len(points))])


def opaque(number: int) -> Any:
    """A number that a kernel reads from memory: as a literal, each number would be another kernel."""
    return dr.opaque(mi.UInt, number)


def numbers(indices: Any) -> Int64Array:
    """Indices in the ray tracer's arrays as a NumPy array, Shape ``[N]``."""
    found: Int64Array = indices.numpy().astype(np.int64)
    return found


# [m] by which every target is larger in tests; float32 rounds a coordinate of 1 km to 6e-5 m.
_SLACK = 5e-3

# The same as a part of the largest coordinate, some 30 times the rounding of float32.
_RELATIVE_SLACK = 2e-6

# Cosine of the half angle of the widest cone that is tested; wider ones light everything.
_WIDE = 0.01


class Targets:
    """Targets of a frame's beams: faces, and bodies by the spheres around them.

    Args:
        faces: Those of scenery first, then those of bodies, body after body.
        sizes: Number of faces of each body, Shape ``[V]``.
    """

    def __init__(self, faces: FaceRectangles, sizes: Int64Array) -> None:
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
        column = columns(rows)
        self.normal, self.centre, self.u, self.v = (mi.Vector3f(*column[i : i + 3]) for i in (0, 3, 6, 9))
        self.offset, self.radius = column[12:]
        self.two_sided = mi.Bool(indices(faces.two_sided))
        self.body_centre = places(centre)
        self.body_radius = columns(reach[None])[0]
        # Faces of a body are consecutive, so that a lane finds the n-th face of a body by an addition.
        begin = self.first_body + np.cumsum(sizes) - sizes
        self.body_begin, self.body_size = indices(begin), indices(sizes)
        slack = _SLACK + _RELATIVE_SLACK * float(np.abs(faces.centre).max(initial=0.0))
        self.slack = dr.opaque(mi.Float, slack)
        """By which every target is larger in tests [m], as an opaque `mitsuba.Float`."""

    def body_of(self, faces: Int64Array) -> Int64Array:
        """Number of the body of these faces of bodies."""
        begin = self.body_begin.numpy()[: self.bodies].astype(np.int64)
        return np.searchsorted(begin, faces, side="right") - 1

    def corners(self, face: Any) -> list[Any]:
        """The four corners of rectangles, in turn."""
        centre, u, v = (gathered(column, face) for column in (self.centre, self.u, self.v))
        return [centre - u - v, centre + u - v, centre + u + v, centre - u + v]

    def height(self, point: Any, face: Any) -> Any:
        """Heights of points above the planes of faces [m]; negative behind."""
        return dr.dot(point, gathered(self.normal, face)) - gathered(self.offset, face)


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
class ImageBeams:
    """B beams after n reflections each; attributes of type `Any` are arrays of the ray tracer."""

    chain: Int64Array
    """Faces that reflected them, Shape ``[B, n]``."""
    by_body: BoolArray
    """Whether one of these is of a body, Shape ``[B]``."""
    image: Any
    """Of the source [m]."""
    sides: Sequence[Any]
    """Unit normals, inwards, of the pyramids' sides: four for each rectangle."""
    axis: Any
    """Of the narrowest cone around the pyramids."""
    cosine: Any
    """Of the half angle of that cone."""
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
        """Index of the first beam by way of a body: beams of scenery alone stand before it."""
        return int(np.argmax(self.by_body)) if self.by_body.any() else len(self)

    def light_cone(self, beam: Any, centre: Any, radius: Any, slack: Any) -> Any:
        """Test whether spheres reach into the cones of beams, on the lit side of their last planes.

        A cheap test before `light`: a cone is one dot product, a pyramid up to eight.
        """
        axis, cosine = gathered(self.axis, beam), gathered(self.cosine, beam)
        towards = centre - gathered(self.image, beam)
        along = dr.dot(axis, towards)
        # Distance of the sphere's centre from the cone's mantle, positive outside: across·cos − along·sin.
        across = dr.sqrt(dr.maximum(dr.squared_norm(towards) - along * along, 0.0))
        sine = dr.sqrt(dr.maximum(1.0 - cosine * cosine, 0.0))
        before = dr.dot(gathered(self.lit, beam), centre) - gathered(self.lit_from, beam)
        reach = radius + 2.0 * slack
        return (across * cosine - along * sine <= reach) & (before > -reach)

    def light(self, beam: Any, centre: Any, reach: Any) -> Any:
        """Test whether spheres reach into all pyramids of beams."""
        towards = centre - gathered(self.image, beam)
        lit = mi.Bool(True)
        for side in self.sides:
            lit &= dr.dot(gathered(side, beam), towards) > -reach
        return lit


def first_beams(targets: Targets, source: Float64Array, scenery: Int64Array) -> ImageBeams:
    """Beams of a transmitter [m], Shape ``[3]``, after one reflection: at given faces of scenery, then at all
    faces of bodies whose reflecting side the transmitter sees."""
    faces = targets.faces
    bodies = np.arange(targets.first_body, len(faces))
    shown = faces.height(np.broadcast_to(source, (len(bodies), 3)), bodies) > 0
    first = np.concatenate([scenery, bodies[shown | faces.two_sided[bodies]]])
    return reflected_beams(targets, first[:, None], places(np.tile(source, (len(first), 1))), None)


def next_beams(targets: Targets, beams: ImageBeams, scenery: Int64Array, known: Int64Array) -> ImageBeams:
    """Beams after one more reflection.

    Args:
        targets: Faces that may reflect.
        beams: Beams after n reflections.
        scenery: Faces of scenery that may reflect a beam by way of a body.
        known: Chains of scenery alone, Shape ``[K, n + 1]``. Each begins with the chain of one of ``beams``.
            Beams by way of scenery alone continue along these and no others.

    Returns:
        Beams of ``known`` first, then those by way of a body.
    """

    beam, face = by_scenery(targets, beams, scenery)
    of_body = filtered(partial(lights_corner, targets, beams), lit_bodies(targets, beams))
    # Beams of scenery alone come first, as everywhere: `ImageBeams.first_by_body` divides the list.
    chain = np.concatenate(
        [
            known,
            np.concatenate([beams.chain[numbers(beam)], numbers(face)[:, None]], axis=1),
            np.concatenate([beams.chain[numbers(of_body[0])], numbers(of_body[1])[:, None]], axis=1),
        ]
    )
    before = _rows_of(beams.chain[: beams.first_by_body], known[:, :-1])
    parent = np.concatenate([before, numbers(beam), numbers(of_body[0])])
    return longer_beams(targets, beams, parent, chain)


def scenery_beams(targets: Targets, beams: ImageBeams, known: Int64Array) -> ImageBeams:
    """Beams of `next_beams` whose chains are of scenery alone."""
    return longer_beams(targets, beams, _rows_of(beams.chain[: beams.first_by_body], known[:, :-1]), known)


def longer_beams(targets: Targets, beams: ImageBeams, parent: Int64Array, chain: Int64Array) -> ImageBeams:
    """Beams of chains, Shape ``[B, n + 1]``, each one face longer than the chain of its parent beam."""
    index = indices(parent)
    return reflected_beams(targets, chain, gathered(beams.image, index), gathered(beams.last, index))


def by_scenery(targets: Targets, beams: ImageBeams, scenery: Int64Array) -> tuple[Any, Any]:
    """Pairs of a beam by way of a body and a face of scenery that it lights, as `mitsuba.UInt`."""
    faces = indices(scenery)
    # Only beams by way of a body: which chains of scenery alone exist is known (`scenery_chains`).
    begin = beams.first_by_body
    first = opaque(begin)

    def near(beam: Any, place: Any) -> Any:
        beam, face = beam + first, gathered(faces, place)
        centre, radius = gathered(targets.centre, face), gathered(targets.radius, face)
        lit = beams.light_cone(beam, centre, radius, targets.slack)
        return lit & (face != gathered(beams.last, beam))

    def lights(beam: Any, place: Any) -> Any:
        return lights_corner(targets, beams, beam + first, gathered(faces, place))

    beam, place = filtered(lights, pairs(len(beams) - begin, len(scenery), near))
    if not dr.width(beam):
        return beam, place
    beam, face = beam + first, gathered(faces, place)
    dr.eval(beam, face)
    return beam, face


def lit_bodies(targets: Targets, beams: ImageBeams) -> tuple[Any, Any]:
    """Pairs of a beam and a face of a body whose sphere it lights, as `mitsuba.UInt`."""
    slack = targets.slack
    beam, body = near_bodies(targets, beams)

    def face_of(pair: Any, number: Any) -> Any:
        return gathered(targets.body_begin, gathered(body, pair)) + number

    def shows(pair: Any, number: Any) -> Any:
        there = number < gathered(targets.body_size, gathered(body, pair))
        of, face = gathered(beam, pair), dr.select(there, face_of(pair, number), 0)
        # A face of a closed body reflects on its outside only, which the image has to be in front of.
        height = targets.height(gathered(beams.image, of), face)
        there &= (height > -slack) | gathered(targets.two_sided, face)
        there &= face != gathered(beams.last, of)  # a plane does not reflect twice in a row
        centre, radius = gathered(targets.centre, face), gathered(targets.radius, face)
        return there & beams.light_cone(of, centre, radius, slack)

    def shows_within(pair: Any, number: Any) -> Any:
        face = face_of(pair, number)
        reach = gathered(targets.radius, face) + slack
        return beams.light(gathered(beam, pair), gathered(targets.centre, face), reach)

    pair, number = filtered(shows_within, pairs(dr.width(beam), targets.most, shows))
    beam, face = gathered(beam, pair), face_of(pair, number)
    dr.eval(beam, face)
    return beam, face


def reflected_beams(targets: Targets, chain: Int64Array, image: Any, before: Any | None) -> ImageBeams:
    """Beams after a reflection at the last face of each chain.

    Args:
        targets: Faces.
        chain: All faces of each beam, Shape ``[B, n]``.
        image: Image of the source before that reflection.
        before: Face of the reflection before that one, which bounds the beam, too; None: there is none.
    """
    if not len(chain):  # kernels of no lanes do not exist
        return ImageBeams(chain, np.zeros(0, np.bool_), None, (), None, None, None, None, None)
    last = indices(chain[:, -1])
    normal, offset = gathered(targets.normal, last), gathered(targets.offset, last)

    def mirrored(point: Any) -> Any:
        return point - 2.0 * (dr.dot(point, normal) - offset) * normal

    image = mirrored(image)
    corners = targets.corners(last)
    axis, cosine = _cone(image, corners)
    sides = _sides(image, corners)
    if before is not None:
        # The beam has passed the rectangle before this one, too, whose mirror image bounds it from the new
        # image.
        mirrored_corners = [mirrored(corner) for corner in targets.corners(before)]
        other_axis, other_cosine = _cone(image, mirrored_corners)
        narrower = other_cosine > cosine
        axis, cosine = dr.select(narrower, other_axis, axis), dr.maximum(cosine, other_cosine)
        sides += _sides(image, mirrored_corners)
    # The image is behind the mirror, so the lit side is the other one.
    away = dr.select(dr.dot(image, normal) > offset, -1.0, 1.0)
    lit, lit_from = normal * away, offset * away
    dr.eval(image, axis, cosine, sides, lit, lit_from, last)
    by_body = chain >= targets.first_body
    return ImageBeams(
        chain, np.logical_or.reduce(by_body, axis=1), image, sides, axis, cosine, last, lit, lit_from
    )


def near_bodies(targets: Targets, beams: ImageBeams) -> tuple[Any, Any]:
    """Pairs of a beam and a body whose sphere it lights, as `mitsuba.UInt`."""

    def near(beam: Any, body: Any) -> Any:
        centre, radius = gathered(targets.body_centre, body), gathered(targets.body_radius, body)
        return beams.light_cone(beam, centre, radius, targets.slack)

    def lit(beam: Any, body: Any) -> Any:
        centre, radius = gathered(targets.body_centre, body), gathered(targets.body_radius, body)
        return beams.light(beam, centre, radius + targets.slack)

    return filtered(lit, pairs(len(beams), targets.bodies, near))


def lights_corner(targets: Targets, beams: ImageBeams, beam: Any, face: Any) -> Any:
    """Test whether rectangles may be lit: no side of the beam has all four corners beyond it."""
    corners, image = targets.corners(face), gathered(beams.image, beam)
    # Separating planes of a convex pyramid and a convex rectangle: conservative, as only the pyramid's are
    # tried.
    lit = _some(corners, gathered(beams.lit, beam), gathered(beams.lit_from, beam) + targets.slack)
    for side in beams.sides:
        normal = gathered(side, beam)
        lit &= _some(corners, normal, dr.dot(normal, image) - targets.slack)
    return lit


def _some(corners: list[Any], normal: Any, offset: Any) -> Any:
    """Test whether one of the corners at least is beyond a plane."""
    a, b, c, d = (dr.dot(normal, corner) for corner in corners)
    return dr.maximum(dr.maximum(a, b), dr.maximum(c, d)) > offset


def _sides(image: Any, corners: list[Any]) -> list[Any]:
    """Unit normals, inwards, of the sides of the pyramid from a point around corners in turn."""
    edges = [corner - image for corner in corners]
    middle = edges[0] + edges[2]
    sides = []
    for one, other in zip(edges, [*edges[1:], edges[0]], strict=True):
        normal = dr.cross(one, other)
        # Of an image in the plane of its rectangle the pyramid is flat, and a side has no direction of its
        # own.
        normal *= dr.rsqrt(dr.maximum(dr.squared_norm(normal), 1e-20))
        sides.append(dr.select(dr.dot(normal, middle) < 0.0, -normal, normal))
    return sides


def _cone(image: Any, corners: list[Any]) -> tuple[Any, Any]:
    """Axis of a cone from a point around corners, and the cosine of its half angle."""
    edges = [dr.normalize(corner - image) for corner in corners]
    axis = dr.normalize(edges[0] + edges[1] + edges[2] + edges[3])
    a, b, c, d = (dr.dot(edge, axis) for edge in edges)
    cosine = dr.minimum(dr.minimum(a, b), dr.minimum(c, d))
    # A cone that is wider than a half-space does not hold all that its directions span.
    return axis, dr.select(cosine > _WIDE, cosine, -1.0)


def _rows_of(rows: Int64Array, wanted: Int64Array) -> Int64Array:
    """Index of the row that equals each wanted row."""
    known = {tuple(row): number for number, row in enumerate(rows.tolist())}
    return np.array([known[tuple(row)] for row in wanted.tolist()], np.int64)


# Beams of one group that lanes test together: groups are filled up to a multiple of it, so that a lane finds
# its beam by a division and not by a search.
_BLOCK = 16


@dataclass(frozen=True, eq=False)
class SceneryViews:
    """Faces of scenery that may reflect last before receivers."""

    faces: Int64Array
    """In ascending order, Shape ``[U]``."""
    sights: Int64Array
    """Pairs of these that see one another, by index into ``faces``, in both orders, sorted, ``[M, 2]``."""
    receiver: Int64Array
    """Receiver of each of W pairs of a receiver and a face that it may see, Shape ``[W]``."""
    place: Int64Array
    """Face of each, by index into ``faces``, Shape ``[W]``."""


def receiver_beams(targets: Targets, receivers: Float64Array, faces: Int64Array) -> ImageBeams:
    """The beam of what a receiver [m] sees in a face of scenery, of Shapes ``[W, 3]`` and ``[W]``."""
    return reflected_beams(targets, faces[:, None], places(receivers), None)


def ends_at(targets: Targets, beams: ImageBeams, receivers: Float64Array) -> tuple[Int64Array, Int64Array]:
    """Beam and receiver of each pair where the beam lights the receiver; receivers [m] have the Shape
    ``[R, 3]``."""
    place = places(receivers)

    def near(beam: Any, receiver: Any) -> Any:
        return beams.light_cone(beam, gathered(place, receiver), 0.0, targets.slack)

    def lit(beam: Any, receiver: Any) -> Any:
        return beams.light(beam, gathered(place, receiver), targets.slack)

    beam, receiver = filtered(lit, pairs(len(beams), len(receivers), near))
    return numbers(beam), numbers(receiver)


def ends_by_bodies(
    targets: Targets, beams: ImageBeams, receivers: Float64Array
) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Beam, face of a body and receiver wherever the beam may light the receiver by a reflection at the face.

    Args:
        targets: Faces.
        beams: Beams before the last reflection.
        receivers: Positions [m], Shape ``[R, 3]``.
    """
    beam, face = lit_bodies(targets, beams)
    place = places(receivers)

    def crosses(way: Any, receiver: Any) -> Any:
        image = gathered(beams.image, gathered(beam, way))
        return _crosses(targets, image, gathered(face, way), gathered(place, receiver))

    def lit(way: Any, receiver: Any) -> Any:
        last, point = gathered(face, way), gathered(place, receiver)
        # Instead of a beam through the last face, the receiver's image in it is held against the beam before.
        image = point - 2.0 * targets.height(point, last) * gathered(targets.normal, last)
        return beams.light(gathered(beam, way), image, targets.slack)

    way, receiver = filtered(lit, pairs(dr.width(beam), len(receivers), crosses))
    return numbers(gathered(beam, way)), numbers(gathered(face, way)), numbers(receiver)


def ends_by_scenery(
    targets: Targets, beams: ImageBeams, receivers: Float64Array, scenery: SceneryViews
) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Beam by way of a body, face of scenery and receiver wherever the beam may light the receiver by a
    reflection at the face.

    What a receiver sees in a face is a beam, too: only bodies and faces that this one lights can reflect
    before. So beams of the transmitter are grouped by their last body or face, and each view is tested
    against the groups that it shows instead of against all beams.

    Args:
        targets: Faces.
        beams: Beams before the last reflection.
        receivers: Positions [m], Shape ``[R, 3]``.
        scenery: Which faces the receivers see.
    """

    none = np.zeros(0, np.int64)
    first = beams.first_by_body
    if first == len(beams) or not len(scenery.receiver):
        return none, none, none
    views = receiver_beams(targets, receivers[scenery.receiver], scenery.faces[scenery.place])
    view, body = (numbers(part) for part in near_bodies(targets, views))
    seen, other = shown_scenery(targets, views, scenery)
    view = np.concatenate([view, seen])
    group = np.concatenate([body, targets.bodies + other])
    last = beams.chain[first:, -1]
    of_body = last >= targets.first_body
    place_of = np.searchsorted(scenery.faces, last)
    group_of = np.where(of_body, targets.body_of(last), targets.bodies + place_of)
    # Beams group by group of what reflected them last: a body, or a face of scenery, after the bodies.
    order = np.argsort(group_of, kind="stable")
    sizes = np.bincount(group_of, minlength=targets.bodies + len(scenery.faces))
    begin = np.cumsum(sizes) - sizes
    own, block = ranges(np.zeros(len(group), np.int64), -(-sizes[group] // _BLOCK))
    start = begin[group[own]] + block * _BLOCK
    columns = [indices(column) for column in (view[own], start, (begin + sizes)[group[own]])]
    by_group, place = indices(first + order), places(receivers[scenery.receiver])

    def beam_of(block: Any, number: Any) -> tuple[Any, Any]:
        there = gathered(columns[1], block) + number
        within = there < gathered(columns[2], block)
        # Index 0 can be gathered without reading beyond an array.
        return gathered(by_group, dr.select(within, there, 0)), within

    def near(block: Any, number: Any) -> Any:
        beam, within = beam_of(block, number)
        seen = gathered(columns[0], block)
        within &= gathered(views.last, seen) != gathered(beams.last, beam)
        return within & beams.light_cone(beam, gathered(views.image, seen), 0.0, targets.slack)

    def lit(block: Any, number: Any) -> Any:
        beam, _ = beam_of(block, number)
        seen = gathered(columns[0], block)
        image, point = gathered(beams.image, beam), gathered(place, seen)
        crosses = _crosses(targets, image, gathered(views.last, seen), point)
        return crosses & beams.light(beam, gathered(views.image, seen), targets.slack)

    # Lanes beyond the end of a group look at the first beam of all, and `within` drops them.
    found = filtered(lit, pairs(len(own), _BLOCK, near))
    block, number = (numbers(part) for part in found)
    seen = view[own[block]]
    beam = first + order[start[block] + number]
    return beam, scenery.faces[scenery.place[seen]], scenery.receiver[seen]


def shown_scenery(
    targets: Targets, views: ImageBeams, scenery: SceneryViews
) -> tuple[Int64Array, Int64Array]:
    """Faces of scenery that receivers see by a reflection in another one.

    Args:
        targets: Faces.
        views: Beams of the receivers, one for each pair of ``scenery``.
        scenery: Which faces the receivers see, and which faces see one another.

    Returns:
        View and face of each pair, by index into ``views`` and into ``scenery.faces``.
    """
    sizes = np.bincount(scenery.sights[:, 0], minlength=len(scenery.faces))
    own, rows = ranges((np.cumsum(sizes) - sizes)[scenery.place], sizes[scenery.place])
    other = scenery.sights[rows, 1]
    if not len(own):
        return own, other
    view, face = indices(own), indices(scenery.faces[other])

    def near(pair: Any) -> Any:
        shown = gathered(face, pair)
        centre, radius = gathered(targets.centre, shown), gathered(targets.radius, shown)
        return views.light_cone(gathered(view, pair), centre, radius, targets.slack)

    def lights(pair: Any) -> Any:
        return lights_corner(targets, views, gathered(view, pair), gathered(face, pair))

    kept = dr.compress(near(dr.arange(mi.UInt, dr.width(view))))
    if dr.width(kept):
        kept = gathered(kept, dr.compress(lights(kept)))
    pair = numbers(kept)
    pair = pair[pair < len(own)]
    return own[pair], other[pair]


def _crosses(targets: Targets, image: Any, face: Any, point: Any) -> Any:
    """Test whether points see images in faces: from the side that reflects, and within the rectangle."""
    there, here = targets.height(image, face), targets.height(point, face)
    crosses = (there * here > 0.0) & ((here > 0.0) | gathered(targets.two_sided, face))
    # The line from the point to the image meets the plane at the share here / (there + here) of its length.
    beside = dr.fma(image - point, here / (there + here), point) - gathered(targets.centre, face)
    for side in (gathered(targets.u, face), gathered(targets.v, face)):
        square = dr.squared_norm(side)
        crosses &= dr.abs(dr.dot(beside, side)) <= square + targets.slack * dr.sqrt(square)
    return crosses


@dataclass(frozen=True, eq=False)
class ChainPairs:
    """N pairs of a chain and a receiver."""

    chain: Int64Array
    """Faces, −1 past the last, Shape ``[N, D]``."""
    receiver: Int64Array
    """Shape ``[N]``."""

    @classmethod
    def joined(cls, parts: list[tuple[Int64Array, Int64Array]], depth: int) -> ChainPairs:
        """All pairs of parts, whose chains may have any length up to ``depth``."""
        chains = [np.full((0, depth), -1, np.int64)]
        chains += [
            np.pad(chain, ((0, 0), (0, depth - chain.shape[1])), constant_values=-1) for chain, _ in parts
        ]
        receivers = [np.zeros(0, np.int64), *(receiver for _, receiver in parts)]
        return cls(np.concatenate(chains), np.concatenate(receivers))


def chain_pairs(
    targets: Targets,
    scenery: Int64Array,
    views: SceneryViews,
    transmitter: Float64Array,
    receivers: Float64Array,
) -> ChainPairs:
    """All pairs of a chain and a receiver that may be a path: without a reflection, by way of scenery alone,
    and by way of bodies.

    Args:
        targets: Faces of scenery, then those of bodies, body after body.
        scenery: Chains of scenery alone that waves from the transmitter go along, as faces, −1 past the
            last, Shape ``[K, D]``; the beginnings of each chain are among them.
        views: Faces of these chains that may reflect last, and who sees them.
        transmitter: Position [m], Shape ``[3]``.
        receivers: Positions [m], Shape ``[R, 3]``.
    """
    depth = scenery.shape[1]
    # The chain without a reflection is a candidate for every receiver: the line of sight.
    every = np.arange(len(receivers))
    found = [(np.zeros((len(receivers), 0), np.int64), every)]
    if not (depth and len(targets.faces) and len(receivers)):
        return ChainPairs.joined(found, depth)
    length = (scenery >= 0).sum(1)

    def add(beams: ImageBeams) -> None:
        if len(beams):
            beam, receiver = ends_at(targets, beams, receivers)
            found.append((beams.chain[beam], receiver))

    beams = first_beams(targets, transmitter, scenery[length == 1, 0])
    add(beams)
    for n in range(2, depth):
        if len(beams):
            beams = next_beams(targets, beams, views.faces, scenery[length == n, :n])
            add(beams)
    if depth > 1 and len(beams):
        # The last reflection needs no beams of its own: its faces are tested with the receivers at once.
        add(scenery_beams(targets, beams, scenery[length == depth]))
        for beam, face, receiver in (
            ends_by_scenery(targets, beams, receivers, views),
            ends_by_bodies(targets, beams, receivers),
        ):
            found.append((np.concatenate([beams.chain[beam], face[:, None]], axis=1), receiver))
    return ChainPairs.joined(found, depth)
