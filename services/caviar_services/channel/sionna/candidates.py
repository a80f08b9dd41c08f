"""Which paths could be: specular chains and scattering points of a launch, offered to every receiver.

Every receiver is offered all of them: so its paths depend neither on which others are traced with it nor on
whether a ray happened to pass near it. Most chains cannot be a path to most receivers, which the
image method tells from the planes and the boxes around them before anything is traced.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_services.channel.sionna.chains import Chains, Met
from caviar_services.channel.sionna.diffuse_paths import Points
from caviar_services.channel.sionna.planes import PlaneTable
from caviar_services.channel.sionna.ray_launcher import Launch, LaunchOptions
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.ray_tracing import aligned_columns, aligned_indices

# [m] that a point may lie outside the box of its plane: more than float32 and the planes' tolerance do.
_SLACK = 0.1

# The same as a part of the largest coordinate.
_RELATIVE_SLACK = 1e-5

# Sine of the angle to a plane below which the point in it is too uncertain to judge by.
_GRAZING = 0.03


@dataclass(frozen=True, eq=False)
class Candidates:
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

    def take(self, which: Int64Array | BoolArray) -> Candidates:
        """These candidates."""
        return Candidates(
            self.ray[which],
            self.depth[which],
            self.receiver[which],
            self.planes[which],
            self.found[which],
            self.chosen[which],
        )


class Offer:
    """What a launch offers to every receiver.

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
        points: Points | None = None,
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
        if options.only_scattered:
            self._chains = self._chains.take(~self._chains.straight)
        self._points = points
        self._scattered = met.scattered

    def rays_of(self, planes: Int64Array, depth: Int64Array) -> Int64Array:
        """See `Chains.rays_of`."""
        return self._chains.rays_of(planes, depth)

    @property
    def size(self) -> int:
        """Candidates for each receiver, those that cannot be included."""
        return max(len(self._chains.ray), len(self._scattered.ray))

    def candidates(self, targets: Any, count: int) -> tuple[Candidates, Launch, int]:
        """Direct paths, chains and scattering points that could be paths to the first ``count`` of receivers,
        a `mitsuba.Point3f`; the launch that their rays are of; and how many more there are than ``max_paths``
        of each.
        """
        import drjit as dr

        chains, scattered = self._chains, self._scattered
        direct = self._seen(targets) if not self._options.only_scattered else np.zeros(0, np.int64)
        seen = np.ones(len(direct), np.bool_)
        if self.everywhere:
            every_target = np.arange(dr.width(targets))
            seen, direct = np.isin(every_target, direct), every_target
        chain, receiver = self.planes.possible(chains, self._source, targets)
        of_points = self._points.reached if self._points else self._reached
        point, reached, probability = of_points(targets)
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
        every = every.take(every.receiver < count)
        kept = first_of_each(every.receiver, self._options.max_paths)
        return every.take(kept), self.launch, len(kept) - int(kept.sum())

    def _seen(self, targets: Any) -> Int64Array:
        """Receivers that the transmitter sees."""
        import drjit as dr
        from sionna.rt.constants import MIN_SEGMENT_LENGTH
        from sionna.rt.utils import spawn_ray_to

        origins = dr.repeat(self._source, dr.width(targets))
        free = dr.norm(targets - origins) > MIN_SEGMENT_LENGTH
        free &= ~self._mi_scene.ray_test(spawn_ray_to(origins, targets), active=free)
        seen: Int64Array = np.flatnonzero(free.numpy())
        return seen

    def _reached(self, targets: Any) -> tuple[Int64Array, Int64Array, Float64Array]:
        """Scattering points and the receivers that each of them reaches, on the side that was lit; all with
        the probability of what was drawn."""
        import drjit as dr
        import mitsuba as mi

        ray, depth = self._scattered.ray, self._scattered.depth
        if not len(ray):
            return ray, ray, np.zeros(0)
        parts: list[tuple[Int64Array, Int64Array]] = []
        receivers = dr.width(targets)
        per_point = dr.opaque(mi.UInt, receivers)
        for d, bounce in enumerate(self.launch.bounces):
            first = int(np.searchsorted(depth, d + 1))
            rays = ray[first : int(np.searchsorted(depth, d + 1, side="right"))]
            if not len(rays):
                continue
            lane = dr.arange(mi.UInt, len(rays) * receivers)
            of_ray = dr.gather(mi.UInt, mi.UInt(aligned_indices(rays)), lane // per_point)
            target = dr.gather(mi.Point3f, targets, lane % per_point)
            hit = dr.zeros(mi.Interaction3f, len(rays) * receivers)
            hit.p = dr.gather(mi.Point3f, bounce.point, of_ray)
            hit.n = dr.gather(mi.Normal3f, bounce.normal, of_ray)
            back = hit.spawn_ray_to(target)
            lit = dr.dot(mi.Vector3f(hit.n), back.d) > 0.0
            lit &= ~self._mi_scene.ray_test(back, active=lit)
            kept: Any = dr.compress(lit)
            lanes = kept.numpy().astype(np.int64)
            parts.append((first + lanes // receivers, lanes % receivers))
        points = np.concatenate([point for point, _ in parts])
        return points, np.concatenate([rx for _, rx in parts]), np.zeros(len(points))


class Planes:
    """The planes of a frame on the ray tracer's side, to rule out chains by."""

    def __init__(self, table: PlaneTable) -> None:
        import mitsuba as mi

        rows = np.concatenate([table.origin, table.normal, table.low, table.high], axis=1).T
        reach = float(np.abs(rows).max(initial=0.0))
        columns = [mi.Float(column) for column in aligned_columns(rows)]
        self._slack = _SLACK + _RELATIVE_SLACK * reach
        self._origin, self._normal = mi.Point3f(*columns[:3]), mi.Vector3f(*columns[3:6])
        self._low, self._high = mi.Point3f(*columns[6:9]), mi.Point3f(*columns[9:12])

    def possible(self, chains: Chains, source: Any, targets: Any) -> tuple[Int64Array, Int64Array]:
        """Chain and target of each pair of them that could be a path.

        The source is mirrored at one plane after the other; from the target, the line to the last image has
        to meet the last plane between both ends and within the box around its triangles, and so on back.
        """
        import drjit as dr
        import mitsuba as mi

        count, receivers = len(chains.ray), dr.width(targets)
        if not count * receivers:
            return np.zeros(0, np.int64), np.zeros(0, np.int64)
        per_chain = dr.opaque(mi.UInt, receivers)
        lane = dr.arange(mi.UInt, count * receivers)
        chain, target = lane // per_chain, lane % per_chain
        columns = [mi.UInt(aligned_indices(column + 1)) for column in chains.planes.T.astype(np.int64)]
        judged = dr.gather(mi.UInt, mi.UInt(aligned_indices(chains.straight)), chain) != 0
        plane = [dr.gather(mi.UInt, column, chain) for column in columns]
        images = [mi.Point3f(source)]
        for number in plane:
            images.append(dr.select(number > 0, self._mirrored(images[-1], number), images[-1]))
        here, possible, unsure = dr.gather(mi.Point3f, targets, target), mi.Bool(True), ~judged
        for number, image in zip(reversed(plane), reversed(images[1:]), strict=True):
            met, grazing, meets = self._met(here, image, number)
            unsure |= grazing & (number > 0)
            possible &= meets | unsure | (number == 0)
            here = dr.select(number > 0, met, here)
        kept: Any = dr.compress(possible)
        lanes = kept.numpy().astype(np.int64)
        return lanes // receivers, lanes % receivers

    def _mirrored(self, point: Any, number: Any) -> Any:
        import drjit as dr

        origin, normal = self.plane(number)
        return point - 2 * dr.dot(point - origin, normal) * normal

    def plane(self, number: Any) -> tuple[Any, Any]:
        import drjit as dr
        import mitsuba as mi

        used = number > 0
        return dr.gather(mi.Point3f, self._origin, number - 1, used), dr.gather(
            mi.Vector3f, self._normal, number - 1, used
        )

    def _met(self, here: Any, image: Any, number: Any) -> tuple[Any, Any, Any]:
        """Where the line to an image meets a plane; whether it does so at too small an angle to tell;
        whether that may be a point of a path."""
        import drjit as dr
        import mitsuba as mi

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


def first_of_each(receiver: Int64Array, count: int) -> BoolArray:
    """Which of these receivers' candidates are among the first ``count`` of each."""
    order = np.argsort(receiver, kind="stable")
    place = np.empty(len(receiver), np.int64)
    ranked = receiver[order]
    place[order] = np.arange(len(receiver)) - np.searchsorted(ranked, ranked)
    kept: BoolArray = place < count
    return kept


def positions(points: Float64Array) -> Any:
    """Positions [m], Shape ``[N, 3]``, as a `mitsuba.Point3f`."""
    import mitsuba as mi

    return mi.Point3f(*map(mi.Float, aligned_columns(points.T)))
