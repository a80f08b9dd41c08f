"""Rays from one transmitter into the scene: every ray's interactions, the same for all receivers, and the few
diffuse paths of each receiver that are chosen among every point that rays met.

Neighbouring lanes of a kernel walk the ray tracer's tree together. Sionna RT launches its rays in the order
of the Fibonacci lattice, where neighbours point into quite different directions; here the same rays
are launched along a space-filling curve, which halved the time of the kernel in the street canyon.

Where a ray may go on in several ways, Sionna RT draws one, so that fewer rays are left to be reflected:
in Munich, refraction cost 10 of 57 reflected paths. So rays that draw are launched beside rays that are
reflected alone, and an option that is switched on loses no reflection.

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

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import BoolArray, Float64Array, Int64Array
from caviar_protocol.seeding import derive_seed
from caviar_services.channel.paths import Antenna
from caviar_services.channel.propagation.patterns import FormulaPattern
from caviar_services.channel.sionna import dr, mi
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.drjit_setup import aligned_columns, aligned_indices, several
from caviar_space.materials import EPSILON_0

T = TypeVar("T")

REFLECTED, SCATTERED, REFRACTED, DIFFRACTED = 1, 2, 4, 8
"""Flags of `sionna.rt.constants.InteractionType`; 0 is none."""

RAYS_AT_ONCE = 1_000_000
"""More at once are no faster."""

# Memory for each interaction of each ray while a part is launched and its chains are looked for.
_INTERACTION_BYTES = 250


def rays_within(memory_gib: float, max_depth: int) -> int:
    """Number of rays that may be traced together: at least 10,000, and at most `RAYS_AT_ONCE`.

    Args:
        memory_gib: Memory for them [GiB].
        max_depth: Interactions of a ray at most.

    Example:
        >>> rays_within(0.05, 3)
        71582
    """
    fit = memory_gib * 2**30 / (_INTERACTION_BYTES * max(max_depth, 1))
    return int(min(max(fit, 10_000), RAYS_AT_ONCE))


@dataclass(frozen=True, kw_only=True)
class LaunchOptions:
    """Options of a launch: what is traced, and with how many rays."""

    max_depth: int
    samples: int
    max_paths: int
    seed: int
    reflection: bool
    refraction: bool
    diffraction: bool
    scattering: bool
    only_scattered: bool = False
    """Whether paths without a diffuse reflection are left to another launch."""
    diffuse_paths: int | None = None
    """How many diffuse paths of a receiver are chosen, about; None: those that were drawn."""
    rays_at_once: int = RAYS_AT_ONCE
    """Rays that are traced together at most, of all passes: memory grows with them, and not with
    ``samples``."""

    @property
    def passes(self) -> tuple[int, ...]:
        """Interactions that rays may draw from, as flags, for each time that all rays are launched: those
        that draw come first, so that what they draw does not depend on the others."""
        enabled = (
            REFLECTED * self.reflection
            | SCATTERED * self.scattering
            | REFRACTED * self.refraction
            | DIFFRACTED * self.diffraction
        )
        if not enabled:
            return ()
        if self.reflection and enabled != REFLECTED and not self.only_scattered:
            return enabled, REFLECTED
        return (enabled,)

    @property
    def lanes(self) -> int:
        """Rays of all passes."""
        return self.samples * len(self.passes)


@dataclass(frozen=True, eq=False)
class Bounce:
    """One interaction of each of N rays, in the ray tracer's arrays; rays are in the order of the passes."""

    kind: Any
    """`mitsuba.UInt`: flag of the interaction; 0 where the ray has ended."""
    shape: Any
    """`mitsuba.UInt`: process-local id of the shape that was hit."""
    primitive: Any
    """`mitsuba.UInt`: triangle of that shape."""
    point: Any
    """`mitsuba.Point3f` [m]."""
    normal: Any
    """`mitsuba.Normal3f` towards the side that the ray came from."""
    probability: Any
    """`mitsuba.Float`: that this kind of interaction was drawn."""

    def take(self, rays: Any) -> Bounce:
        """Interactions of some rays.

        Args:
            rays: Their numbers, a `mitsuba.UInt`.
        """
        columns = [getattr(self, field.name) for field in fields(self)]
        return Bounce(*(dr.gather(type(column), column, rays) for column in columns))


@dataclass(frozen=True, eq=False)
class Launch:
    """Interactions of the rays from one transmitter."""

    bounces: tuple[Bounce, ...]
    """First, second, … interaction."""
    wedges: Any
    """The ray tracer's `WedgeGeometry` of the edge that diffracted each ray, the number of the edge in
    ``local_edge``; None without diffraction."""

    @property
    def rays(self) -> int:
        """Number of rays."""
        return int(dr.width(self.bounces[0].kind)) if self.bounces else 0

    def take(self, rays: Int64Array) -> Launch:
        """Some rays alone.

        Args:
            rays: Their numbers.
        """
        index = mi.UInt(aligned_indices(rays))
        bounces = tuple(bounce.take(index) for bounce in self.bounces)
        wedges = None if self.wedges is None else dr.gather(type(self.wedges), self.wedges, index)
        # Now, so that the memory of the other rays is free.
        dr.eval([getattr(bounce, field.name) for bounce in bounces for field in fields(bounce)], wedges)
        return Launch(bounces, wedges)

    @classmethod
    def joined(cls, parts: Sequence[Launch]) -> Launch:
        """The rays of several launches of one depth, part by part.

        Args:
            parts: One at least.
        """
        bounces = tuple(
            Bounce(
                *(_concatenated([getattr(bounce, field.name) for bounce in met]) for field in fields(Bounce))
            )
            for met in zip(*(part.bounces for part in parts), strict=True)
        )
        wedges = [part.wedges for part in parts]
        return cls(bounces, None if wedges[0] is None else _concatenated(wedges))


def _concatenated(parts: Sequence[Any]) -> Any:
    """Arrays of Dr.Jit, or structures of them, one after the other."""
    whole = dr.zeros(type(parts[0]), sum(dr.width(part) for part in parts))
    begin = 0
    for part in parts:
        # Opaque, or each offset would be part of a kernel.
        dr.scatter(whole, part, dr.opaque(mi.UInt, begin) + dr.arange(mi.UInt, dr.width(part)))
        begin += dr.width(part)
    dr.eval(whole)
    return whole


class PartedLauncher:
    """Launches the rays in parts, so that memory is bounded whatever their number.

    Args:
        scene: Where they go.
        options: What is traced.
        generator: See `Launcher`.
    """

    def __init__(self, scene: SionnaScene, options: LaunchOptions, generator: Any = None) -> None:
        self._made_of = scene, options, generator

    @cached_property
    def _parts(self) -> list[tuple[int, int, Launcher]]:
        """First ray of each part, the one past its last, and what launches it; made at the first launch,
        which where all is enumerated never comes."""
        scene, options, generator = self._made_of
        # All passes of a ray are lanes of one launch.
        at_once = max(1, options.rays_at_once // max(len(options.passes), 1))
        begins = range(0, options.samples, at_once)
        bounds = [(begin, min(begin + at_once, options.samples)) for begin in begins]
        return [(begin, end, Launcher(scene, options, (begin, end), generator)) for begin, end in bounds]

    @property
    def in_parts(self) -> bool:
        """True if a launch has more than one part."""
        return len(self._parts) > 1

    def each(
        self,
        look: Callable[[Int64Array, Launch], T],
        source: Any,
        rays: Int64Array | None = None,
        number: int = 0,
    ) -> list[T]:
        """Look at each part of a launch.

        A part's memory is free before the next one is launched, unless ``look`` holds it.

        Args:
            look: Gets the numbers of a part's rays, and what they met.
            source: See `Launcher`.
            rays: Numbers of the rays, in ascending order; None: all.
            number: See `Launcher`.

        Returns:
            What ``look`` found in each part.
        """
        if rays is None:
            return [
                look(np.arange(begin, end), part(source, None, number)) for begin, end, part in self._parts
            ]
        ends = np.searchsorted(rays, [end for _, end, _ in self._parts])
        split = zip(self._parts, np.split(rays, ends[:-1]), strict=True)
        return [
            look(some, part(source, some - begin, number))
            for (begin, _, part), some in split
            if len(some) or not self.in_parts
        ]


class Launcher:
    """Launches the rays; one kernel serves every depth.

    Args:
        scene: Where they go.
        options: What is traced.
        part: Numbers of the first ray and of the one past the last; absent: all rays.
        generator: What says how rays go on, a `SBCandidateGenerator` of Sionna RT; absent: that itself.
    """

    def __init__(
        self,
        scene: SionnaScene,
        options: LaunchOptions,
        part: tuple[int, int] | None = None,
        generator: Any = None,
    ) -> None:
        from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator
        from sionna.rt.utils import fibonacci_lattice

        self._scene = scene
        self._options = options
        self._generator = SBCandidateGenerator() if generator is None else generator
        self._sampler = self._generator._sampler
        first, end = part or (0, options.samples)
        self._count = end - first
        whole = self._count == options.samples
        self._first = first
        lattice = fibonacci_lattice(options.samples) if whole else _lattice(options.samples, first, end)
        self._directions = _along_curve(lattice)

    def __call__(self, source: Any, rays: Int64Array | None = None, number: int = 0) -> Launch:
        """Launch from one position, a `mitsuba.Point3f` of width 1: all rays, or those of these numbers, in
        each pass.

        From launch to launch, by its ``number``, other things are drawn where a ray may go on in several
        ways, and all rays are turned by less than what lies between two of them; at 0 by nothing.
        """
        from sionna.rt.utils import WedgeGeometry

        passes = self._options.passes
        if not passes:
            return Launch((), None)
        samples = self._count if rays is None else len(rays)
        lanes = samples * len(passes)
        # Each launch, and each part of one, draws numbers of its own.
        self._sampler.seed(self._options.seed + number + self._first, lanes)
        origin = dr.repeat(source, lanes)
        direction = mi.Vector3f(self._directions)
        if rays is not None:
            direction = dr.gather(mi.Vector3f, self._directions, mi.UInt(aligned_indices(rays)))
        if len(passes) > 1:
            direction = dr.tile(direction, len(passes))
        # A turn by a small angle adds the cross product with it.
        turn = mi.Vector3f(*(dr.opaque(mi.Float, angle) for angle in self._turn(number)))
        direction = dr.normalize(direction + dr.cross(turn, direction))
        active, enabled = dr.full(mi.Bool, True, lanes), dr.full(mi.UInt, passes[0], lanes)
        if len(passes) > 1:
            enabled = dr.select(dr.arange(mi.UInt, lanes) < dr.opaque(mi.UInt, samples), enabled, passes[1])
        wedges = WedgeGeometry.build_with_size(lanes) if self._options.diffraction else None
        # Evaluated arrays, so that the first interaction runs the kernel of all others.
        dr.make_opaque(origin, direction, active, enabled, wedges)
        bounces = []
        for _ in range(self._options.max_depth):
            bounce, origin, direction, active, enabled, wedges = self._bounce(
                origin, direction, active, enabled, wedges
            )
            bounces.append(bounce)
        return Launch(tuple(bounces), wedges)

    def _turn(self, number: int) -> list[float]:
        """Small angles [rad] about the three axes: a sequence of low discrepancy (M. Roberts, "The
        unreasonable effectiveness of quasirandom sequences", 2018, R_3) as wide as the rays are apart."""
        apart = math.sqrt(4 * math.pi / self._options.samples)
        root = 1.2207440846057596  # of x⁴ = x + 1
        return [apart * math.remainder(number / root**axis, 1.0) for axis in (1, 2, 3)]

    def _bounce(self, origin: Any, direction: Any, active: Any, enabled: Any, wedges: Any) -> tuple[Any, ...]:
        """Next interaction of all rays, and how they go on. Rules of what may follow what are Sionna RT's."""
        ray = mi.Ray3f(origin, direction)
        # Coherent: lanes are in the order of the curve, so neighbours walk the tree together.
        mi_scene = self._scene.mi_scene
        hit = mi_scene.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=True, active=active)
        active &= hit.is_valid()
        sampler = self._sampler
        drawn = sampler.next_1d(), sampler.next_2d(), sampler.next_2d()
        diffraction = self._options.diffraction
        sample, normal, wedge = self._generator._sample_radio_material(
            hit, origin, direction, *drawn, enabled, diffraction, False, active
        )
        kind = dr.select(active, sample.sampled_component, 0)
        active &= kind != 0
        diffracted, scattered = kind == DIFFRACTED, kind == SCATTERED
        enabled = dr.select(diffracted, enabled & ~mi.UInt(SCATTERED | DIFFRACTED), enabled)
        enabled = dr.select(scattered, enabled & ~mi.UInt(DIFFRACTED), enabled)
        if wedges is not None:
            wedges = dr.select(diffracted, wedge, wedges)
        onward = hit.spawn_ray(d=sample.wo)
        shape = dr.reinterpret_array(mi.UInt, hit.shape)
        found = (kind, shape, hit.prim_index, hit.p, normal, sample.pdf)
        sampler.schedule_state()
        # Evaluated after each interaction: unrolled, every depth would be a kernel of its own.
        dr.eval(found, onward.o, onward.d, active, enabled, wedges)
        bounce = Bounce(kind, shape, hit.prim_index, hit.p, normal, sample.pdf)
        return bounce, onward.o, onward.d, active, enabled, wedges


def spread_directions(count: int, part: int, parts: int) -> Any:
    """Directions that share the sphere, a `mitsuba.Vector3f`; each part is spread over all of it.

    Args:
        count: Of all parts together.
        part: Which part, from 0.
        parts: How many.
    """
    return _along_curve(_lattice(count, part, count, parts))


def _lattice(count: int, first: int, end: int, step: int = 1) -> Any:
    """Points ``first`` to ``end`` of `sionna.rt.utils.fibonacci_lattice`, each ``step``-th."""
    points = -(-(end - first) // step)
    # In float64: float32 cannot count to the 1e8 rays that a launch may have.
    number = dr.opaque(mi.Float64, first) + dr.opaque(mi.Float64, step) * dr.arange(mi.Float64, points)
    x = number / ((1.0 + math.sqrt(5.0)) / 2.0)
    return mi.Point2f(x - dr.floor(x), number / dr.opaque(mi.Float64, count - 1))


def _along_curve(lattice: Any) -> Any:
    """Directions of a lattice on the unit square, ordered along a space-filling curve."""
    order = morton_order(np.array(lattice.x, np.float64), np.array(lattice.y, np.float64))
    # Gathered, not made from NumPy: where NumPy's memory happens to lie would be part of the kernel.
    directions = mi.warp.square_to_uniform_sphere(
        dr.gather(mi.Point2f, lattice, mi.UInt32(order.astype(np.uint32)))
    )
    dr.eval(directions)
    return directions


def morton_order(x: Float64Array, y: Float64Array) -> Int64Array:
    """Indices that sort points along the Morton curve, Shape ``[N]``; the bits of both coordinates alternate
    in the key (G. M. Morton, "A Computer Oriented Geodetic Data Base", IBM, 1966).

    Args:
        x, y: From 0 to 1, Shape ``[N]``.

    Example:
        >>> morton_order(np.array([0.9, 0.1, 0.9, 0.1]), np.array([0.9, 0.9, 0.1, 0.1])).tolist()
        [3, 2, 1, 0]
    """
    bits = 16
    cells = [np.clip(axis * (1 << bits), 0, (1 << bits) - 1).astype(np.uint64) for axis in (x, y)]
    key = np.zeros(len(x), np.uint64)
    for bit in range(bits):
        for shift, cell in enumerate(cells):
            key |= ((cell >> np.uint64(bit)) & np.uint64(1)) << np.uint64(2 * bit + shift)
    return np.argsort(key, kind="stable")


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
    # Looked for where the rays are: on a GPU few of them come back.
    found: list[Any] = [dr.compress(bounce.kind == SCATTERED) for bounce in launch.bounces]
    rays = [numbers.numpy().astype(np.int64) for numbers in found]
    depth = np.repeat(np.arange(1, len(rays) + 1), np.array([len(ray) for ray in rays], np.int64))
    return Scattered(np.concatenate([np.zeros(0, np.int64), *rays]), depth, np.zeros((0, len(depth))))


@dataclass(frozen=True, eq=False)
class DrawnPoints:
    """The points of a launch at which a ray was drawn to be scattered."""

    mi_scene: Any
    """The Mitsuba scene."""
    launch: Launch
    """What the rays met."""
    found: Scattered
    """Its scattering points."""

    def reached(self, targets: Any) -> tuple[Int64Array, Int64Array, Float64Array]:
        """Find the receivers that points reach, on the side that was lit.

        Args:
            targets: The receivers, a `mitsuba.Point3f`.

        Returns:
            Points and receivers of the pairs, and 0 as probability: that of what was drawn.
        """
        ray, depth = self.found.ray, self.found.depth
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
            lit &= ~self.mi_scene.ray_test(back, active=lit)
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
        # At each depth the sequence begins anywhere else.
        begin = depth.astype(np.uint64) * np.uint64(0x85EBCA6B)
        place = (ray.astype(np.uint64) * _GOLDEN + self._offset + begin) & _WORD
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


class ChosenPoints:
    """The points that `Thinning.points` found, of which each receiver is offered a choice.

    Args:
        thinning: Chooses.
        found: The points.
    """

    def __init__(self, thinning: Thinning, found: Scattered) -> None:
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
