"""Chains of reflections by way of moving bodies, enumerated, and the receivers that their beams light.

Where bodies are small, rays rarely meet them, so a launch misses most chains by way of them. Here every
sequence of faces with a face of a body in it is a candidate; sequences that beams cannot reach are left out
(`image_beams`). With B for a face of a body and S for one of scenery, these are to a depth of three: B, SB,
BS, BB, SSB, SBS, SBB, BSS, BSB, BBS and BBB. The last reflection needs no beam of its own: it exists where
the receiver's image in the last face lies in the beam before it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_services.channel.enumeration.image_beams import (
    ImageBeams,
    Targets,
    filtered,
    first_beams,
    gathered,
    indices,
    lights_corner,
    lit_bodies,
    near_bodies,
    next_beams,
    numbers,
    pairs,
    places,
    reflected_beams,
    scenery_beams,
)
from caviar_space.vectors import ranges

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
    import drjit as dr

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
        return gathered(by_group, _either(within, there)), within

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
    """Which faces of scenery receivers see by a reflection in another one.

    Args:
        targets: Faces.
        views: Beams of the receivers, one for each pair of ``scenery``.
        scenery: Which faces the receivers see, and which faces see one another.

    Returns:
        View and face of each pair, by index into ``views`` and into ``scenery.faces``.
    """
    import drjit as dr
    import mitsuba as mi

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
    """Whether points see images in faces: from the side that reflects, and within the rectangle."""
    import drjit as dr

    there, here = targets.height(image, face), targets.height(point, face)
    crosses = (there * here > 0.0) & ((here > 0.0) | gathered(targets.two_sided, face))
    # The line from the point to the image meets the plane at the share here / (there + here) of its length.
    beside = dr.fma(image - point, here / (there + here), point) - gathered(targets.centre, face)
    for side in (gathered(targets.u, face), gathered(targets.v, face)):
        square = dr.squared_norm(side)
        crosses &= dr.abs(dr.dot(beside, side)) <= square + targets.slack * dr.sqrt(square)
    return crosses


def _either(used: Any, index: Any) -> Any:
    """An index where it is used, else 0, which can be gathered without reading beyond an array."""
    import drjit as dr

    return dr.select(used, index, 0)


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
