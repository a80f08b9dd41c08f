"""Chains of reflections with faces of moving bodies, enumerated, and the receivers where their beams end.

Where bodies are small, rays rarely meet them, so a launch misses most chains by way of them. Here every
sequence of faces is a candidate that has a face of a body in it; what beams cannot reach is left out
(`image_beams`). Of B, a face of a body, and S, one of scenery, that is to a depth of three: B, SB, BS, BB,
SSB, SBS, SBB, BSS, BSB, BBS and BBB. The last reflection needs no beams of its own: the receiver's image in
its face lies in the beam before it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_services.channel.enumeration.face_rectangles import ranges
from caviar_services.channel.enumeration.image_beams import (
    Beams,
    Targets,
    filtered,
    first_beams,
    gathered,
    lights_corner,
    lit_bodies,
    near_bodies,
    next_beams,
    numbers,
    pairs,
    reflected_beams,
    scenery_beams,
)
from caviar_services.ray_tracing import aligned_indices, positions, several

_BLOCK = 16
"""Beams of one group that are looked at together: groups are filled up to a multiple of it."""


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


def receiver_beams(targets: Targets, receivers: Float64Array, faces: Int64Array) -> Beams:
    """What each of some receivers [m], Shape ``[W, 3]``, sees in a face of scenery, Shape ``[W]``."""
    return reflected_beams(targets, faces[:, None], positions(receivers[several(len(faces))]), None)


def ends_at(targets: Targets, beams: Beams, receivers: Float64Array) -> tuple[Int64Array, Int64Array]:
    """Beam and receiver of each pair where the one lights the other; receivers [m] are of Shape
    ``[R, 3]``."""
    place = positions(receivers[several(len(receivers))])

    def near(beam: Any, receiver: Any) -> Any:
        return beams.light_cone(beam, gathered(place, receiver), 0.0, targets.slack)

    def lit(beam: Any, receiver: Any) -> Any:
        return beams.light(beam, gathered(place, receiver), targets.slack)

    beam, receiver = filtered(lit, pairs(len(beams), len(receivers), near))
    return numbers(beam), numbers(receiver)


def ends_by_bodies(
    targets: Targets, beams: Beams, receivers: Float64Array
) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Beam, face of a body and receiver, where the beam may light the receiver by way of the face; receivers
    [m] are of Shape ``[R, 3]``."""
    import drjit as dr

    beam, face = lit_bodies(targets, beams)
    place = positions(receivers[several(len(receivers))])

    def crosses(way: Any, receiver: Any) -> Any:
        image = gathered(beams.image, gathered(beam, way))
        return _crosses(targets, image, gathered(face, way), gathered(place, receiver))

    def lit(way: Any, receiver: Any) -> Any:
        last, point = gathered(face, way), gathered(place, receiver)
        image = point - 2.0 * targets.height(point, last) * gathered(targets.normal, last)
        return beams.light(gathered(beam, way), image, targets.slack)

    way, receiver = filtered(lit, pairs(dr.width(beam), len(receivers), crosses))
    return numbers(gathered(beam, way)), numbers(gathered(face, way)), numbers(receiver)


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
    view, body = (numbers(part) for part in near_bodies(targets, views))
    seen, other = shown_scenery(targets, views, scenery)
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

    found = filtered(lit, pairs(len(own), _BLOCK, near))
    block, number = (numbers(part) for part in found)
    seen = view[own[block]]
    beam = first + order[start[block] + number]
    return beam, scenery.faces[scenery.place[seen]], scenery.receiver[seen]


def shown_scenery(targets: Targets, views: Beams, scenery: SceneryViews) -> tuple[Int64Array, Int64Array]:
    """What receivers see by way of faces of scenery: numbers of views, one for each pair of a receiver and a
    face, and places of the other faces that they show."""
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
        shown = gathered(face, pair)
        centre, radius = gathered(targets.centre, shown), gathered(targets.radius, shown)
        return views.light_cone(gathered(view, pair), centre, radius, targets.slack)

    def lights(pair: Any) -> Any:
        return lights_corner(targets, views, gathered(view, pair), gathered(face, pair))

    kept = dr.compress(near(dr.arange(mi.UInt, len(lanes))))
    if dr.width(kept):
        kept = gathered(kept, dr.compress(lights(kept)))
    pair = numbers(kept)
    pair = pair[pair < len(own)]
    return own[pair], other[pair]


def _crosses(targets: Targets, image: Any, face: Any, point: Any) -> Any:
    """Whether points see images in faces: on the side that reflects, and within the rectangle."""
    import drjit as dr

    there, here = targets.height(image, face), targets.height(point, face)
    crosses = (there * here > 0.0) & ((here > 0.0) | gathered(targets.two_sided, face))
    beside = dr.fma(image - point, here / (there + here), point) - gathered(targets.centre, face)
    for side in (gathered(targets.u, face), gathered(targets.v, face)):
        square = dr.squared_norm(side)
        crosses &= dr.abs(dr.dot(beside, side)) <= square + targets.slack * dr.sqrt(square)
    return crosses


def _either(used: Any, index: Any) -> Any:
    """An index where it is used, else 0."""
    import drjit as dr

    return dr.select(used, index, 0)


@dataclass(frozen=True, eq=False)
class ChainPairs:
    """N pairs of a chain and a receiver."""

    chain: Int64Array
    """Faces, −1 behind the last, Shape ``[N, D]``."""
    receiver: Int64Array
    """Shape ``[N]``."""

    @classmethod
    def joined(cls, parts: list[tuple[Int64Array, Int64Array]], depth: int) -> ChainPairs:
        """Of chains of any length up to ``depth``."""
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
    """All pairs of a chain and a receiver that it may be a path to: no reflection, chains of scenery alone,
    and chains with a face of a body.

    Parameters
    ----------
    targets
        Faces of scenery, and behind them of bodies, body after body.
    scenery
        Chains of scenery alone that waves from the transmitter go along, with the beginnings of each, as
        faces, −1 behind the last, Shape ``[K, D]``.
    views
        Of all faces of these chains.
    transmitter
        [m], Shape ``[3]``.
    receivers
        [m], Shape ``[R, 3]``.
    """
    depth = scenery.shape[1]
    every = np.arange(len(receivers))
    found = [(np.zeros((len(receivers), 0), np.int64), every)]
    if not (depth and len(targets.faces) and len(receivers)):
        return ChainPairs.joined(found, depth)
    length = (scenery >= 0).sum(1)

    def add(beams: Beams) -> None:
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
        # The last reflection needs no beams of its own: its faces are held against the receivers at once.
        add(scenery_beams(targets, beams, scenery[length == depth]))
        for beam, face, receiver in (
            ends_by_scenery(targets, beams, receivers, views),
            ends_by_bodies(targets, beams, receivers),
        ):
            found.append((np.concatenate([beams.chain[beam], face[:, None]], axis=1), receiver))
    return ChainPairs.joined(found, depth)
