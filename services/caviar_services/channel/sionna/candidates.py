"""Candidates for paths: specular chains and scattering points of a launch, offered to every receiver, and
which of them the outermost elements of arrays have.

Every receiver is offered all of them: so its paths depend neither on which others are traced with it nor on
whether a ray happened to pass near it. Most chains cannot be a path to most receivers, which the
image method tells from the planes and the boxes around them before anything is traced.

A chain is a sequence of planes that some ray of the transmitter's launch went along. Chains, and the points
at which rays were scattered, are the candidates. Those by way of moving objects may be enumerated instead:
`channel.enumeration`.

A path that the arrays' centres have may be hidden from some elements, and one that they do not have may
exist for others. Both are seen at the corners of the arrays, with the chains of planes that are known from
the launch, in one kernel (`at_corners`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array, UInt64Array
from caviar_services.channel.sionna import dr, mi
from caviar_services.channel.sionna.ray_launcher import (
    DIFFRACTED,
    REFLECTED,
    REFRACTED,
    SCATTERED,
    Bounce,
    ChosenPoints,
    DrawnPoints,
    Launch,
    LaunchOptions,
    Scattered,
    scattered_of,
)
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.drjit_setup import aligned_columns, aligned_indices, positions, several
from caviar_space.planes import PlaneTable
from caviar_space.vectors import Rows

MANY_RAYS = 1000
"""Of a chain that no half of a launch would miss."""


@dataclass(frozen=True, eq=False)
class Chains(Rows):
    """C specular chains, or specular ends after a scattering point."""

    ray: Int64Array
    """The first ray that went along each, Shape ``[C]``."""
    depth: Int64Array
    """Interactions of each, Shape ``[C]``."""
    planes: Int32Array
    """Plane at each interaction that is a reflection, −1 elsewhere, Shape ``[C, D]``."""
    straight: BoolArray
    """Whether a chain has but reflections and transmissions, Shape ``[C]``."""
    rays: Int64Array
    """How many rays went along each, Shape ``[C]``."""

    def rays_of(self, planes: Int64Array, depth: Int64Array) -> Int64Array:
        """Count the rays that went along the chains of paths.

        Chains that differ in other things than planes count together.

        Args:
            planes: At each interaction that is a reflection, −1 elsewhere, Shape ``[P, D]``.
            depth: Interactions of each path, Shape ``[P]``.

        Returns:
            Shape ``[P]``; ``MANY_RAYS`` for a path of none of these chains.
        """
        known, which = np.unique(_chain_keys(self.planes, self.depth), return_inverse=True)
        if not len(known):
            return np.full(len(depth), MANY_RAYS)
        rays = np.bincount(which.reshape(-1), weights=self.rays).astype(np.int64)
        keys = _chain_keys(planes, depth)
        place = np.minimum(np.searchsorted(known, keys), len(known) - 1)
        return np.where(known[place] == keys, rays[place], MANY_RAYS)


def _chain_keys(planes: Int32Array | Int64Array, depth: Int64Array) -> UInt64Array:
    """A hash of each chain: planes are too many for a key that counts all sequences of them."""
    # A polynomial with a prime base, modulo 2⁶⁴: planes are too many for exact numbers of sequences.
    key = depth.astype(np.uint64)
    for column in planes.T:
        key = key * np.uint64(1_000_003) + (column + 2).astype(np.uint64)
    return key


@dataclass(frozen=True, eq=False)
class Met:
    """Chains and scattering points that rays met, of which paths may come."""

    launch: Launch
    """The rays that went along a chain first, or were scattered; of a launch in one part all of them."""
    chains: Chains
    """By rays of ``launch``."""
    scattered: Scattered


def met_by(
    launch: Launch, scene: SionnaScene, max_depth: int, scattered: Scattered | None = None, part: bool = False
) -> Met:
    """Find the chains and the scattering points of a launch.

    Args:
        launch: All rays, or a part of them.
        scene: Where they went.
        max_depth: Interactions at most.
        scattered: Points of diffuse paths; None: those that were drawn.
        part: Whether the launch is a part of a larger one, of which only the rays that matter are kept.
    """
    chains = chains_of(launch, scene, max_depth)
    scattered = scattered or scattered_of(launch)
    if not part:
        return Met(launch, chains, scattered)
    # One at least: Dr.Jit gathers nothing from arrays without elements, not even with no lane active.
    rays = np.union1d(np.append(chains.ray, 0), scattered.ray)
    return Met(
        launch.take(rays),
        replace(chains, ray=np.searchsorted(rays, chains.ray)),
        replace(scattered, ray=np.searchsorted(rays, scattered.ray)),
    )


def united(parts: Sequence[Met], scene: SionnaScene) -> Met:
    """Unite what the parts of a launch met; each chain once, as `chains_of` sorts.

    Args:
        parts: One at least.
        scene: Where the rays went.
    """
    if len(parts) == 1:
        return parts[0]
    launch = Launch.joined([part.launch for part in parts])
    widths = np.array([part.launch.rays for part in parts])
    # Each part numbers its rays from 0.
    first = np.cumsum(widths) - widths
    chains = Chains.joined(
        [replace(part.chains, ray=part.chains.ray + begin) for part, begin in zip(parts, first, strict=True)]
    )
    # Depth first, which is the order that chains of one launch have.
    signature = np.column_stack([chains.depth, _signature(launch, chains, scene)])
    _, kept, which = np.unique(signature, axis=0, return_index=True, return_inverse=True)
    rays = np.bincount(which.reshape(-1), weights=chains.rays).astype(np.int64)
    ray = np.concatenate([part.scattered.ray + begin for part, begin in zip(parts, first, strict=True)])
    depth = np.concatenate([part.scattered.depth for part in parts])
    order = np.argsort(depth, kind="stable")
    rows = np.concatenate([part.scattered.rows for part in parts], axis=1)
    return Met(
        launch, replace(chains.take(kept), rays=rays), Scattered(ray[order], depth[order], rows[:, order])
    )


def chains_of(launch: Launch, scene: SionnaScene, max_depth: int) -> Chains:
    """Find all chains that rays of a launch went along, shortest first, then in a stable order.

    Args:
        launch: The rays.
        scene: Where they went.
        max_depth: Interactions at most.
    """
    planes, straight = np.full((1, max_depth), -1, np.int32), np.ones(1, np.bool_)
    none = np.zeros(0, np.int64)
    found = [Chains(none, none, planes[:0], straight[:0], none)]
    # All rays begin in the one chain of no interaction.
    before, chain = np.zeros(1, np.int64), np.zeros(1, np.int64)
    for d, begins in enumerate(_runs(launch)):
        lengths = np.diff(np.append(begins, launch.rays))
        met = _columns(launch.bounces[d], begins)
        on = met[0] != 0
        heads = begins[on]
        if not len(heads):
            break
        kind, plane, token, tokens = _tokens(launch, heads, met[:, on], scene)
        # One integer for the chain before and the interaction that follows it.
        key = chain[np.searchsorted(before, heads, side="right") - 1] * tokens + token
        _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
        kind, plane, last = kind[first], plane[first], key[first] // tokens
        planes, straight = planes[last], straight[last] & ((kind == REFLECTED) | (kind == REFRACTED))
        planes[:, d] = np.where(kind == REFLECTED, plane, -1)
        rays = np.bincount(inverse.reshape(-1), weights=lengths[on]).astype(np.int64)
        before, chain = begins, np.full(len(begins), -1, np.int64)
        chain[on] = inverse.reshape(-1)
        specular = kind != SCATTERED
        found.append(
            Chains(
                heads[first][specular],
                np.full(int(specular.sum()), d + 1, np.int64),
                planes[specular],
                straight[specular],
                rays[specular],
            )
        )
    return Chains.joined(found)


def _runs(launch: Launch) -> Iterator[Int64Array]:
    """For each interaction, the first ray of each run of neighbours that met the same up to it; rays that
    have ended are in runs too.

    Neighbouring rays mostly meet the same, so that only the first of each run is looked at. Runs are found
    where the rays are: on a GPU, or on all cores. A ray that has ended stays so: its kind is 0 from there on.
    """
    if not launch.rays:
        return
    lane = dr.arange(mi.UInt, launch.rays)
    previous = dr.maximum(lane, 1) - 1
    begins = lane == 0
    if launch.wedges is not None:
        begins |= _differs(launch.wedges.local_edge, previous)
    for bounce in launch.bounces:
        # Evaluated, so that the first interaction runs the same kernel as the others.
        dr.make_opaque(begins)
        going = bounce.kind != 0
        begins |= _differs(bounce.kind, previous)
        begins |= going & (_differs(bounce.shape, previous) | _differs(bounce.primitive, previous))
        first: Any = dr.compress(begins)
        yield first.numpy().astype(np.int64)


def _differs(column: Any, previous: Any) -> Any:
    return column != dr.gather(type(column), column, previous)


def _columns(bounce: Bounce, rays: Int64Array) -> Int64Array:
    """Kind, shape and primitive that some rays met at an interaction, Shape ``[3, N]``."""
    return _gathered((bounce.kind, bounce.shape, bounce.primitive), rays)


def _gathered(columns: Sequence[Any], rays: Int64Array) -> Int64Array:
    """Values of C columns of the ray tracer for N rays, Shape ``[C, N]``."""
    # Two more, since to Dr.Jit an array of one element is another kernel.
    index = mi.UInt(aligned_indices(np.append(rays, (0, 0))))
    found = [dr.gather(type(column), column, index) for column in columns]
    dr.eval(found)  # all in one kernel
    return np.array([values.numpy()[: len(rays)] for values in found], np.int64)


def _tokens(
    launch: Launch, ray: Int64Array, met: Int64Array, scene: SionnaScene
) -> tuple[Int64Array, Int64Array, Int64Array, int]:
    """Kind, plane, and what tells interactions of these rays apart: the plane of a reflection, the edge of a
    diffraction, else the kind alone; and how many of these there can be."""
    kind, plane, token = _identified(launch, ray, met, scene)
    first_edge = _first_edge(scene)
    bent = np.flatnonzero(token >= first_edge)
    edges = 0
    if len(bent):
        _, edge = np.unique(token[bent], return_inverse=True)
        edges = int(edge.max()) + 1
        token[bent] = first_edge + edge.reshape(-1)
    return kind, plane, token, first_edge + edges


def _signature(launch: Launch, chains: Chains, scene: SionnaScene) -> Int64Array:
    """Numbers that tell interactions of chains apart, −1 past the last, Shape ``[C, D]``."""
    signature = np.full(chains.planes.shape, -1, np.int64)
    for d in range(len(launch.bounces)):
        used = chains.depth > d
        ray = chains.ray[used]
        signature[used, d] = _identified(launch, ray, _columns(launch.bounces[d], ray), scene)[2]
    return signature


def _identified(
    launch: Launch, ray: Int64Array, met: Int64Array, scene: SionnaScene
) -> tuple[Int64Array, Int64Array, Int64Array]:
    """Kind and plane of what rays met (`_columns`), and a number that tells it apart in all launches: the
    plane, or one for each kind, or one for each edge."""
    kind, shape, primitive = met
    plane = scene.surface_of[scene.triangle_numbers(shape, primitive)]
    token = np.where(kind == REFLECTED, plane, _first_edge(scene) - 16 + kind)
    bent = kind == DIFFRACTED
    if bent.any():
        token[bent] = _first_edge(scene) + _gathered([launch.wedges.local_edge], ray[bent])[0]
    return kind, plane, token


def _first_edge(scene: SionnaScene) -> int:
    """The first number of an edge: after those of planes and kinds."""
    # The flags of kinds are at most 8.
    return len(scene.plane_table.triangle) + 16


@dataclass(frozen=True, eq=False)
class Candidates(Rows):
    """P candidates for paths from one transmitter."""

    ray: Int64Array
    """Ray of the launch whose first interactions they take, Shape ``[P]``."""
    depth: Int64Array
    """How many, Shape ``[P]``."""
    receiver: Int64Array
    """Index of the receiver, Shape ``[P]``."""
    planes: Int32Array
    """Plane that has to reflect at each interaction, −1 where any may, Shape ``[P, D]``."""
    found: BoolArray
    """Known to be a path; of the others the image method finds out, Shape ``[P]``."""
    chosen: Float64Array
    """Probability with which a path was chosen that is diffuse at its last interaction, whatever its ray did
    there; 0 where its ray did what it does; Shape ``[P]``."""


class Offer:
    """Candidates of a launch, offered to every receiver.

    Args:
        scene: Where the rays went.
        met: What its rays met.
        source: Where they came from, a `mitsuba.Point3f` of width 1.
        options: What is traced.
        points: Of the launch, to choose diffuse paths from; None: all that were drawn are wanted.
    """

    def __init__(
        self,
        scene: SionnaScene,
        met: Met,
        source: Any,
        options: LaunchOptions,
        points: ChosenPoints | None = None,
    ) -> None:
        self.launch = met.launch
        self._mi_scene = scene.mi_scene
        self._source = source
        self._options = options
        self.everywhere = False
        """Whether straight lines to receivers that are not seen are candidates too."""
        self.planes = Planes(scene.plane_table)
        """What chains go by."""
        self._chains = met.chains
        # Specular chains are found by the other launch; here they only lead to scattering points.
        if options.only_scattered:
            self._chains = self._chains.take(~self._chains.straight)
        self._points = points or DrawnPoints(scene.mi_scene, met.launch, met.scattered)
        self._scattered = met.scattered

    def rays_of(self, planes: Int64Array, depth: Int64Array) -> Int64Array:
        """See `Chains.rays_of`.

        Args:
            planes, depth: Of paths.
        """
        return self._chains.rays_of(planes, depth)

    @property
    def size(self) -> int:
        """Candidates for each receiver, those that cannot be included."""
        return max(len(self._chains.ray), len(self._scattered.ray))

    def candidates(self, targets: Any, count: int) -> tuple[Candidates, Launch, int]:
        """List what could be paths: straight lines, chains and scattering points.

        Args:
            targets: The receivers, a `mitsuba.Point3f`.
            count: How many of them count: the first ones.

        Returns:
            The candidates, the launch that their rays are of, and how many more there are than ``max_paths``
            of each receiver.
        """
        chains, scattered = self._chains, self._scattered
        direct = self._seen(targets) if not self._options.only_scattered else np.zeros(0, np.int64)
        seen = np.ones(len(direct), np.bool_)
        if self.everywhere:
            every_target = np.arange(dr.width(targets))
            seen, direct = np.isin(every_target, direct), every_target
        chain, receiver = self.planes.possible(chains.planes, chains.straight, self._source, targets)
        point, reached, probability = self._points.reached(targets)
        none = np.zeros(len(direct), np.int64)
        any_plane = np.full((len(direct) + len(point), self._options.max_depth), -1, np.int32)
        every = Candidates(
            np.concatenate([none, chains.ray[chain], scattered.ray[point]]),
            np.concatenate([none, chains.depth[chain], scattered.depth[point]]),
            np.concatenate([direct, receiver, reached]),
            np.concatenate([any_plane[: len(direct)], chains.planes[chain], any_plane[len(direct) :]]),
            np.concatenate([seen, np.repeat([False, True], [len(chain), len(point)])]),
            np.concatenate([np.zeros(len(direct) + len(chain)), probability]),
        )
        # Receivers from there on fill up the kernel.
        every = every.take(every.receiver < count)
        kept = first_of_each(every.receiver, self._options.max_paths)
        return every.take(kept), self.launch, len(kept) - int(kept.sum())

    def _seen(self, targets: Any) -> Int64Array:
        """Receivers that the transmitter sees."""
        from sionna.rt.constants import MIN_SEGMENT_LENGTH
        from sionna.rt.utils import spawn_ray_to

        origins = dr.repeat(self._source, dr.width(targets))
        free = dr.norm(targets - origins) > MIN_SEGMENT_LENGTH
        free &= ~self._mi_scene.ray_test(spawn_ray_to(origins, targets), active=free)
        seen: Int64Array = np.flatnonzero(free.numpy())
        return seen


def first_of_each(receiver: Int64Array, count: int) -> BoolArray:
    """Mask of candidates that are among the first of their receiver, Shape ``[P]``.

    Args:
        receiver: Of each candidate, Shape ``[P]``.
        count: How many of each receiver.

    Example:
        >>> first_of_each(np.array([4, 7, 4, 4]), 2).tolist()
        [True, True, True, False]
    """
    order = np.argsort(receiver, kind="stable")
    place = np.empty(len(receiver), np.int64)
    ranked = receiver[order]
    place[order] = np.arange(len(receiver)) - np.searchsorted(ranked, ranked)
    kept: BoolArray = place < count
    return kept


# [m] that a point may lie outside the box of its plane: more than float32 and the planes' tolerance do.
_SLACK = 0.1

# The same as a part of the largest coordinate.
_RELATIVE_SLACK = 1e-5

# Sine of the angle to a plane below which the point in it is too uncertain to judge by.
_GRAZING = 0.03

# [m]; rays from face to face start this far from the first, whose points are known to some 1e-5 m. From and
# to antennas rays start at the antenna, so that nothing is off.
_OFF_SURFACE = 2e-4

# [m]; a surface this near a segment's end is what stands there.
_AT_END = 1e-2


class Planes:
    """The planes of a frame on the ray tracer's side, to mirror in and to rule out chains by.

    Args:
        table: As the planes stand.
    """

    def __init__(self, table: PlaneTable) -> None:
        rows = np.concatenate([table.origin, table.normal, table.low, table.high], axis=1).T
        reach = float(np.abs(rows).max(initial=0.0))
        columns = [mi.Float(column) for column in aligned_columns(rows)]
        # In float32 what is far from the centre is known less exactly.
        self._slack = _SLACK + _RELATIVE_SLACK * reach
        self._origin, self._normal = mi.Point3f(*columns[:3]), mi.Vector3f(*columns[3:6])
        self._low, self._high = mi.Point3f(*columns[6:9]), mi.Point3f(*columns[9:12])

    def possible(
        self, chains: Int32Array, straight: BoolArray, source: Any, targets: Any
    ) -> tuple[Int64Array, Int64Array]:
        """Chain and target of each pair of them that could be a path.

        The source is mirrored at one plane after the other; from the target, the line to the last image has
        to meet the last plane between both ends and within the box around its triangles, and so on back.

        Args:
            chains: Plane at each interaction, −1 where any may be, Shape ``[C, D]``.
            straight: Which chains have reflections and transmissions alone; of others nothing is known, so
                that all could be, Shape ``[C]``.
            source: A `mitsuba.Point3f` of width 1.
            targets: A `mitsuba.Point3f`.

        Returns:
            Indices of chains and of targets.
        """
        count, receivers = len(chains), dr.width(targets)
        if not count * receivers:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        # Opaque: a literal would be part of the kernel, which would be compiled for each number of receivers.
        per_chain = dr.opaque(mi.UInt, receivers)
        lane = dr.arange(mi.UInt, count * receivers)
        chain, target = lane // per_chain, lane % per_chain
        columns = [mi.UInt(aligned_indices(column + 1)) for column in chains.T.astype(np.int64)]
        judged = dr.gather(mi.UInt, mi.UInt(aligned_indices(straight)), chain) != 0
        plane = [dr.gather(mi.UInt, column, chain) for column in columns]
        images = self.images(mi.Point3f(source), plane)
        here, possible, unsure = dr.gather(mi.Point3f, targets, target), mi.Bool(True), ~judged
        for number, image in zip(reversed(plane), reversed(images[1:]), strict=True):
            met, grazing, meets = self._met(here, image, number)
            # The point in a plane that is met at a small angle is too uncertain: such chains go on to the
            # exact test.
            unsure |= grazing & (number > 0)
            possible &= meets | unsure | (number == 0)
            here = dr.select(number > 0, met, here)
        kept: Any = dr.compress(possible)
        lanes = kept.numpy().astype(np.int64)
        return lanes // receivers, lanes % receivers

    def images(self, source: Any, numbers: Sequence[Any]) -> list[Any]:
        """A source and its image in one plane after the other.

        Args:
            source: A `mitsuba.Point3f`.
            numbers: Of the planes, from 1; 0 is none. Each a `mitsuba.UInt`.
        """
        images = [source]
        for number in numbers:
            origin, normal = self.plane(number)
            mirrored = images[-1] - 2 * dr.dot(images[-1] - origin, normal) * normal
            images.append(dr.select(number > 0, mirrored, images[-1]))
        return images

    def plane(self, number: Any) -> tuple[Any, Any]:
        """A point [m] and the unit normal of planes.

        Args:
            number: Counted from 1, 0 is none, a `mitsuba.UInt`.
        """
        used = number > 0
        origin = dr.gather(mi.Point3f, self._origin, number - 1, used)
        return origin, dr.gather(mi.Vector3f, self._normal, number - 1, used)

    def _met(self, here: Any, image: Any, number: Any) -> tuple[Any, Any, Any]:
        """Point where the line to an image meets a plane; whether it does so at too small an angle to tell;
        whether that may be a point of a path."""
        used = number > 0
        origin, normal = self.plane(number)
        line = image - here
        length, across = dr.norm(line), dr.dot(line, normal)
        grazing = dr.abs(across) < _GRAZING * length
        along = dr.dot(origin - here, normal) / dr.select(grazing, 1.0, across)
        met = here + along * line
        low = dr.gather(mi.Point3f, self._low, number - 1, used) - self._slack
        high = dr.gather(mi.Point3f, self._high, number - 1, used) + self._slack
        margin = self._slack / dr.maximum(dr.abs(across), 1e-9)
        between = (along > -margin) & (along < 1.0 + margin)
        return met, grazing, between & dr.all((met > low) & (met < high))


class Faces:
    """First hits of rays in a scene: how far away, and on which of the surfaces of its objects' faces.

    Args:
        scene: Its bodies are where they were placed last.
        still: Whether rays meet the scenery alone.
    """

    def __init__(self, scene: SionnaScene, still: bool = False) -> None:
        self._scene, self._still = scene, still
        self._offset = mi.UInt(aligned_indices(scene.offset_by_shape))
        self._surface_of = scene.surface_of
        self._surface = mi.UInt(aligned_indices(scene.surface_of))

    def along(self, start: Any, end: Any, active: Any) -> tuple[Any, Any]:
        """Look along segments, in a kernel.

        Args:
            start, end: `mitsuba.Point3f`.
            active: `mitsuba.Bool`.

        Returns:
            How much farther than a segment's end [m] the first surface along it is, and its number.
        """
        # The table is replaced where faces were joined or parted: mostly nothing is to be uploaded.
        if self._surface_of is not self._scene.surface_of:
            self._surface_of = self._scene.surface_of
            self._surface = mi.UInt(aligned_indices(self._surface_of))
        line = end - start
        length = dr.norm(line)
        active &= length > 0.0
        ray = mi.Ray3f(start, line / dr.select(length > 0.0, length, 1.0))
        mi_scene = self._scene.mi_scenery if self._still else self._scene.mi_scene
        met = mi_scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        hit = active & met.is_valid()
        offset = dr.gather(mi.UInt, self._offset, mi.UInt(dr.reinterpret_array(mi.UInt, met.shape)), hit)
        return met.t - length, dr.gather(mi.UInt, self._surface, offset + met.prim_index, hit)

    def nearest(self, start: Float64Array, end: Float64Array) -> tuple[Float64Array, Int64Array]:
        """Look along segments.

        Args:
            start, end: [m], Shape ``[Q, 3]``.

        Returns:
            How much farther than a segment's end [m] the first surface along it is, infinite where there is
            none, and its number, anything where there is none; each of Shape ``[Q]``.
        """
        # One lane alone would be another kernel to Dr.Jit.
        lanes = several(len(start))
        behind, number = self.along(
            positions(start[lanes]), positions(end[lanes]), dr.full(mi.Bool, True, len(lanes))
        )
        dr.eval(behind, number)
        behind, number = behind.numpy()[: len(start)], number.numpy()[: len(start)]
        return behind.astype(np.float64), number.astype(np.int64)


@dataclass(frozen=True, eq=False)
class Corners:
    """Outermost elements of arrays around a transmitter and its receivers [m]."""

    transmitter: Float64Array
    """Shape ``[K, 3]``."""
    receivers: Float64Array
    """Shape ``[R, L, 3]``."""

    def relative_to(self, centre: Float64Array) -> Corners:
        """The same, counted from a centre.

        Args:
            centre: [m], Shape ``[3]``.
        """
        return Corners(self.transmitter - centre, self.receivers - centre)

    def take(self, which: slice) -> Corners:
        """Corners of some receivers.

        Args:
            which: Of the receivers.
        """
        return Corners(self.transmitter, self.receivers[which])


def at_corners(
    faces: Faces,
    planes: Planes,
    chains: Int32Array,
    depth: Int64Array,
    receiver: Int64Array,
    at_centres: BoolArray,
    corners: Corners | None,
) -> tuple[BoolArray, BoolArray]:
    """Look at candidates from the corners of the arrays.

    Args:
        faces: Of the scene.
        planes: Of the scene.
        chains: Plane at each interaction of P candidates, −1 where any may be, Shape ``[P, D]``.
        depth: Interactions of each, Shape ``[P]``.
        receiver: Of each, Shape ``[P]``.
        at_centres: Which of them the arrays' centres have, Shape ``[P]``.
        corners: Of the arrays; None: only the centres count.

    Returns:
        Which only other elements than the centres have, and which all corners have, each of Shape ``[P]``.
    """
    hidden, settled = np.zeros((2, len(at_centres)), np.bool_)
    if corners is not None:
        mirrors = (chains >= 0) == (np.arange(chains.shape[1]) < depth[:, None])
        # Of chains with other interactions than reflections the corners say nothing.
        some = np.flatnonzero(mirrors.all(1))
        exist = reached(faces, planes, chains[some], receiver[some], corners.transmitter, corners.receivers)
        hidden[some] = exist.any((1, 2))
        settled[some] = exist.all((1, 2))
    return hidden & ~at_centres, settled & at_centres


def reached(
    faces: Faces,
    planes: Planes,
    chains: Int32Array,
    receiver: Int64Array,
    sources: Float64Array,
    targets: Float64Array,
) -> BoolArray:
    """Test whether chains of reflections are paths, Shape ``[P, L, K]``.

    Args:
        chains: Plane at each interaction, −1 past the last, Shape ``[P, D]``.
        receiver: Of each chain, Shape ``[P]``.
        sources: Corners of the transmitter's array [m], Shape ``[K, 3]``.
        targets: Corners of the receivers' arrays [m], Shape ``[R, L, 3]``.
    """
    lanes = several(len(chains))
    shape = (len(chains), targets.shape[1], len(sources))
    chains, receiver = chains[lanes], receiver[lanes]
    count, corners = len(chains), targets.shape[1]
    lane = dr.arange(mi.UInt, count * corners * len(sources))
    per_chain, per_corner = (dr.opaque(mi.UInt, n) for n in (corners * len(sources), len(sources)))
    chain, rest = lane // per_chain, lane % per_chain
    corner, source = rest // per_corner, rest % per_corner
    number = [
        dr.gather(mi.UInt, mi.UInt(aligned_indices(column + 1)), chain)
        for column in chains.T.astype(np.int64)
    ]
    first = dr.gather(mi.UInt, mi.UInt(aligned_indices(receiver * corners)), chain)
    start, here = (
        dr.gather(mi.Point3f, positions(places[several(len(places))]), index)
        for places, index in ((sources, source), (targets.reshape(-1, 3), first + corner))
    )
    found: BoolArray = _exists(faces, planes, number, start, here).numpy()
    return found.reshape(-1, *shape[1:])[: shape[0]]


def reflected(
    faces: Faces, planes: Planes, chains: Int64Array, start: Float64Array, end: Float64Array
) -> BoolArray:
    """Test whether chains of reflections are paths between positions, Shape ``[Q]``.

    Args:
        faces, planes: Of the scene.
        chains: Plane at each interaction, −1 past the last, Shape ``[Q, D]``.
        start, end: [m], Shape ``[Q, 3]``.
    """
    lanes = several(len(chains))
    number = [mi.UInt(aligned_indices(column + 1)) for column in chains[lanes].T]
    found: BoolArray = _exists(faces, planes, number, positions(start[lanes]), positions(end[lanes])).numpy()
    return found[: len(chains)]


def _exists(faces: Faces, planes: Planes, number: list[Any], start: Any, end: Any) -> Any:
    """The same on the ray tracer's side; planes are numbered from 1, 0 is none."""
    here = end
    images = planes.images(start, number)
    # From the receiver back to the transmitter: each image is seen through the plane that made it.
    exists, lifted = mi.Bool(True), here
    for plane, image in zip(number[::-1], images[:0:-1], strict=True):
        origin, normal = planes.plane(plane)
        used = exists & (plane > 0)
        line = image - here
        along = dr.dot(origin - here, normal) / dr.dot(line, normal)
        met = here + along * line
        exists &= ~used | ((along > 0) & (along < 1))
        used &= exists
        exists &= ~used | (faces.along(lifted, met, used)[1] == plane - 1)
        here = dr.select(used, met, here)
        lifted = dr.select(
            used, met - _OFF_SURFACE * dr.select(dr.dot(line, normal) > 0, normal, -normal), lifted
        )
    # The first segment ends at the first plane, or at the receiver where nothing reflects.
    behind, met_plane = faces.along(start, here, exists)
    exists &= (
        dr.select(number[0] > 0, met_plane == number[0] - 1, behind > -_AT_END)
        if number
        else behind > -_AT_END
    )
    return exists
