"""Few diffuse paths for each receiver, chosen among every point that rays met.

Most points at which rays meet something rough bring a receiver next to nothing: they are far away, or were
met after other reflections. So each point is kept with a probability that goes by what it is expected to
bring, and its power is divided by that probability: the mean over all choices is the power of all points
(Russian roulette; J. Arvo and D. Kirk, "Particle transport and image synthesis", SIGGRAPH 1990). What was
not chosen is not tested for occlusion, and has no field.

Points are not drawn: each point at which a ray meets a rough surface is one, whether the ray goes on
diffusely, as reflection or through it (splitting, ibid.), so that none of the rays is lost to the others.
What a point brings is expected from the element's gain, from the reflected power at each interaction, by
C. Schlick's approximation ("An inexpensive BRDF model for physically-based rendering", 1994), and from
Lambert's law and the distance at the end: what these leave out makes the choice worse, and not wrong.
Between neighbouring rays the choice goes by a sequence of low discrepancy, and so it falls evenly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array, UInt64Array
from caviar_protocol.seeding import derive_seed
from caviar_services.channel.paths import Antenna
from caviar_services.channel.propagation.patterns import FormulaPattern
from caviar_services.channel.propagation.utd import EPSILON_0
from caviar_services.channel.sionna.ray_launcher import REFLECTED, REFRACTED, SCATTERED, Bounce, Launch
from caviar_services.drjit_setup import aligned_columns, aligned_indices, several

# What a factor of a weight is at least: factors leave out polarisation and the thickness of walls, and a
# point that was chosen against all odds brings far too much.
_LEAST = 0.01

# Added to the cosine of Lambert's law: a point that is seen at a small angle is chosen now and then.
_GRAZING = 0.1

# [m²]; added to the squared distance, for the same reason and so that weights have a limit.
_NEAR = 1.0

# Weights are added up as multiples of its inverse: sums of integers do not depend on their order.
_UNIT = 2.0**40

# 2³² divided by the golden ratio: multiples of it, modulo 2³², are a sequence of low discrepancy.
_GOLDEN = np.uint64(2654435769)

_WORD = np.uint64(0xFFFFFFFF)


@dataclass(frozen=True, eq=False)
class Scattered:
    """P points of a launch from which waves go on diffusely, in the order of depth and ray."""

    ray: Int64Array
    """Shape ``[P]``."""
    depth: Int64Array
    """Which interaction of the ray, from 1, Shape ``[P]``."""
    rows: Float64Array
    """What a choice among them goes by (`Thinning.points`), Shape ``[K, P]``; K = 0 where all are taken."""


def scattered_of(launch: Launch) -> Scattered:
    """List every interaction of a launch that is a diffuse reflection.

    Args:
        launch: The rays.
    """
    import drjit as dr

    # Looked for where the rays are: on a GPU few of them come back.
    found: list[Any] = [dr.compress(bounce.kind == SCATTERED) for bounce in launch.bounces]
    rays = [numbers.numpy().astype(np.int64) for numbers in found]
    depth = np.repeat(np.arange(1, len(rays) + 1), np.array([len(ray) for ray in rays], np.int64))
    return Scattered(np.concatenate([np.zeros(0, np.int64), *rays]), depth, np.zeros((0, len(depth))))


class DrawnPoints:
    """The points of a launch at which a ray was drawn to be scattered.

    Args:
        mi_scene: The Mitsuba scene.
        launch: What the rays met.
        found: Its scattering points.
    """

    def __init__(self, mi_scene: Any, launch: Launch, found: Scattered) -> None:
        self._mi_scene, self._launch, self._found = mi_scene, launch, found

    def reached(self, targets: Any) -> tuple[Int64Array, Int64Array, Float64Array]:
        """Find the receivers that points reach, on the side that was lit.

        Args:
            targets: The receivers, a `mitsuba.Point3f`.

        Returns:
            Points and receivers of the pairs, and 0 as probability: that of what was drawn.
        """
        import drjit as dr
        import mitsuba as mi

        ray, depth = self._found.ray, self._found.depth
        if not len(ray):
            return ray, ray, np.zeros(0)
        parts: list[tuple[Int64Array, Int64Array]] = []
        receivers = dr.width(targets)
        per_point = dr.opaque(mi.UInt, receivers)
        for d, bounce in enumerate(self._launch.bounces):
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


@dataclass(frozen=True, eq=False)
class Element:
    """Gain of an antenna's elements."""

    antenna: Antenna

    @property
    def key(self) -> bytes:
        """The same for equal ones in a run."""
        return repr(self.antenna.array).encode() + self.antenna.rotation.tobytes()

    def gain(self, directions: Float64Array) -> Float64Array:
        """Power gain towards directions, the mean over subarrays, Shape ``[N]``.

        Args:
            directions: Unit vectors in world axes, Shape ``[N, 3]``.
        """
        gains = [
            (part.pattern or FormulaPattern(part.array.pattern)).amplitude(directions @ part.rotation) ** 2
            for part in self.antenna.subarrays
        ]
        gain: Float64Array = sum(gains[1:], gains[0]) / len(gains)
        return gain


class Thinning:
    """Chooses the diffuse paths of launches.

    Args:
        mi_scene: The Mitsuba scene, with its radio materials.
        wanted: About how many of each receiver are chosen at most.
        seed: Where the choice begins.
    """

    def __init__(self, mi_scene: Any, wanted: int, seed: int) -> None:
        import drjit as dr
        import mitsuba as mi

        self.mi_scene = mi_scene
        self._wanted = wanted
        self._offset = np.uint64(2 * derive_seed(seed, 0, "diffuse paths"))  # of 31 bits
        shapes: list[Any] = list(mi_scene.shapes())
        pointers: list[Any] = [dr.reinterpret_array(mi.UInt, mi.ShapePtr(shape)) for shape in shapes]
        numbers = [int(pointer[0]) for pointer in pointers]
        # Squared scattering coefficient S² of each process-local shape.
        self._roughness = np.zeros(max(numbers, default=0) + 1)
        # Power that each reflects of a wave along its normal.
        self._mirror = np.zeros(len(self._roughness))
        for number, shape in zip(numbers, shapes, strict=True):
            material = shape.bsdf()
            self._roughness[number] = float(material.scattering_coefficient[0]) ** 2
            self._mirror[number] = _at_normal(material)

    def points(self, launch: Launch, source: Float64Array, element: Element | None) -> Scattered:
        """List all points at which rays of a launch met something rough.

        Args:
            launch: The rays.
            source: Where they came from [m], Shape ``[3]``.
            element: Of the transmitter; None: its gain is the same in all directions.

        Returns:
            The points, with position [m], normal and what each is expected to bring as rows, Shape ``[7,
            P]``.
        """
        parts = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((7, 0)))]
        here, power = source[None], np.ones(1)
        for d, bounce in enumerate(launch.bounces):
            met = _Met.of(bounce, here)
            shape = bounce.shape.numpy() * (met.kind != 0)
            if d == 0 and element is not None:
                power = np.maximum(element.gain(met.direction), _LEAST)
            rough, mirror = self._roughness[shape], self._mirror[shape]
            reflected = mirror + (1 - mirror) * (1 - met.cosine) ** 5
            ray = np.flatnonzero((rough > 0) & (met.kind != 0))
            brings = np.broadcast_to(power, len(shape)) * np.maximum(rough * reflected, _LEAST * rough)
            rows = np.concatenate([met.point[ray].T, met.normal[ray].T, brings[None, ray]])
            parts.append((ray, np.full(len(ray), d + 1, np.int64), rows))
            # Divided by the probability of what was drawn: on average, all power goes on.
            if d + 1 < len(launch.bounces):
                kinds = [met.kind == REFLECTED, met.kind == SCATTERED, met.kind == REFRACTED]
                parts_on = [(1 - rough) * reflected, rough * reflected, 1 - reflected]
                onward = np.select(kinds, parts_on) / np.maximum(met.probability, _LEAST)
                power = power * np.maximum(onward, _LEAST)
                here = met.point
        ray, depth, rows = (np.concatenate(column, axis=-1) for column in zip(*parts, strict=True))
        return Scattered(ray, depth, rows)

    def chosen(
        self, ray: Int64Array, depth: Int64Array, weight: Float64Array
    ) -> tuple[BoolArray, Float64Array]:
        """Choose the points that are kept for each receiver.

        A point's place in the sequence is that of its ray and depth, the same for all receivers: so the
        choice for a receiver changes as little as its weights do.

        Args:
            ray, depth: Of each point, Shape ``[P]``.
            weight: What each is expected to bring each receiver, Shape ``[P, R]``.

        Returns:
            Which are kept, and with what probability, each of Shape ``[P, R]``.
        """
        # Of integers, so that the sum does not depend on the order of the points.
        total = np.rint(weight * _UNIT).astype(np.int64).sum(0) / _UNIT
        probability = weight * (self._wanted / np.maximum(total, 1 / _UNIT))
        np.minimum(probability, 1.0, out=probability)
        place = (ray.astype(np.uint64) * _GOLDEN + self._offset + _turned(depth)) & _WORD
        kept: BoolArray = place[:, None] * 2.0**-32 < probability
        return kept, probability


@dataclass(frozen=True, eq=False)
class _Met:
    """An interaction of each of N rays, in NumPy's arrays."""

    kind: NDArray[np.uint32]
    probability: Float64Array
    point: Float64Array
    """Shape ``[N, 3]``."""
    normal: Float64Array
    """Shape ``[N, 3]``."""
    direction: Float64Array
    """Unit vectors of the rays, Shape ``[N, 3]``."""
    cosine: Float64Array
    """Of the angle to the normal at which they met it."""

    @classmethod
    def of(cls, bounce: Bounce, source: Float64Array) -> _Met:
        """Hits of rays from ``source``, Shape ``[N, 3]`` or ``[1, 3]``."""
        point, normal = (
            np.stack([axis.numpy() for axis in vector], axis=-1).astype(np.float64)
            for vector in (bounce.point, bounce.normal)
        )
        way = point - source
        direction = way / np.maximum(np.sqrt((way * way).sum(-1, keepdims=True)), 1e-9)
        cosine = np.minimum(np.abs((direction * normal).sum(-1)), 1.0)
        return cls(bounce.kind.numpy(), bounce.probability.numpy(), point, normal, direction, cosine)


def _at_normal(material: Any) -> float:
    """``|Γ|²`` of a half-space of a radio material at normal incidence (Fresnel)."""
    loss = float(material.conductivity[0]) / (float(material.scene.angular_frequency[0]) * EPSILON_0)
    root = complex(float(material.relative_permittivity[0]), -loss) ** 0.5
    return abs((1 - root) / (1 + root)) ** 2


def _turned(depth: Int64Array) -> UInt64Array:
    """Offset of the sequence at each depth: anywhere else."""
    return depth.astype(np.uint64) * np.uint64(0x85EBCA6B)


class ChosenPoints:
    """The points that `Thinning.points` found, of which each receiver is offered a choice.

    Args:
        thinning: Chooses.
        found: The points.
    """

    def __init__(self, thinning: Thinning, found: Scattered) -> None:
        import mitsuba as mi

        self._ray, self._depth, rows = found.ray, found.depth, found.rows
        self._thinning = thinning
        self._brings = rows[6]
        self._all = several(len(self._ray))
        columns = [mi.Float(column) for column in aligned_columns(rows[:6, self._all])]
        self._point, self._normal = mi.Point3f(*columns[:3]), mi.Normal3f(*columns[3:])

    def reached(self, targets: Any) -> tuple[Int64Array, Int64Array, Float64Array]:
        """Choose points for receivers, and keep those that they reach.

        Args:
            targets: The receivers, a `mitsuba.Point3f`.

        Returns:
            Points and receivers of the pairs, and the probability with which each was chosen.
        """
        none = np.zeros(0, np.int64)
        if not len(self._ray):
            return none, none, np.zeros(0)
        kept, probability = self._thinning.chosen(self._ray, self._depth, self._weights(targets))
        point, receiver = np.nonzero(kept)
        if not len(point):
            return none, none, np.zeros(0)
        free = self._free(point, receiver, targets)
        point, receiver = point[free], receiver[free]
        return point, receiver, probability[point, receiver]

    def _weights(self, targets: Any) -> Float64Array:
        """Power that each point is expected to bring each receiver, in any unit; 0 on the side that is not
        lit; Shape ``[P, R]``."""
        import drjit as dr
        import mitsuba as mi

        receivers = dr.width(targets)
        per_point = dr.opaque(mi.UInt, receivers)
        lane = dr.arange(mi.UInt, len(self._all) * receivers)
        point, target = lane // per_point, lane % per_point
        towards = dr.gather(mi.Point3f, targets, target) - dr.gather(mi.Point3f, self._point, point)
        apart = dr.squared_norm(towards)
        normal = mi.Vector3f(dr.gather(mi.Normal3f, self._normal, point))
        cosine = dr.dot(normal, mi.Vector3f(towards)) * dr.rsqrt(apart)
        weight: Any = dr.select(cosine > 0.0, (cosine + _GRAZING) / (apart + _NEAR), 0.0)
        found: Float64Array = weight.numpy().reshape(-1, receivers)[: len(self._ray)].astype(np.float64)
        found *= self._brings[:, None]
        return found

    def _free(self, point: Int64Array, receiver: Int64Array, targets: Any) -> BoolArray:
        """Test whether nothing stands between these points and receivers."""
        import drjit as dr
        import mitsuba as mi

        some = several(len(point))
        of_point, of_receiver = (
            mi.UInt(aligned_indices(point[some])),
            mi.UInt(aligned_indices(receiver[some])),
        )
        hit = dr.zeros(mi.Interaction3f, len(some))
        hit.p = dr.gather(mi.Point3f, self._point, of_point)
        hit.n = dr.gather(mi.Normal3f, self._normal, of_point)
        back = hit.spawn_ray_to(dr.gather(mi.Point3f, targets, of_receiver))
        lit = dr.dot(mi.Vector3f(hit.n), back.d) > 0.0
        free: BoolArray = (lit & ~self._thinning.mi_scene.ray_test(back, active=lit)).numpy()[: len(point)]
        return free
