"""Rays from one transmitter into the scene: every ray's interactions, the same for all receivers.

Neighbouring lanes of a kernel walk the ray tracer's tree together. Sionna RT launches its rays in the order
of the Fibonacci lattice, where neighbours point into quite different directions; here the same rays
are launched along a space-filling curve, which halved the time of the kernel in the street canyon.

Where a ray may go on in several ways, Sionna RT draws one, so that fewer rays are left to be reflected:
in Munich, refraction cost 10 of 57 reflected paths. So rays that draw are launched beside rays that are
reflected alone, and an option that is switched on loses no reflection.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array
from caviar_services.drjit_setup import aligned_indices

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
        import drjit as dr

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
        import drjit as dr

        return int(dr.width(self.bounces[0].kind)) if self.bounces else 0

    def take(self, rays: Int64Array) -> Launch:
        """Some rays alone.

        Args:
            rays: Their numbers.
        """
        import drjit as dr
        import mitsuba as mi

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
    import drjit as dr
    import mitsuba as mi

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
        mi_scene: Where they go, a `mitsuba.Scene`.
        options: What is traced.
        generator: See `Launcher`.
    """

    def __init__(self, mi_scene: Any, options: LaunchOptions, generator: Any = None) -> None:
        # All passes of a ray are lanes of one launch.
        at_once = max(1, options.rays_at_once // max(len(options.passes), 1))
        begins = range(0, options.samples, at_once)
        bounds = [(begin, min(begin + at_once, options.samples)) for begin in begins]
        self._parts = [
            (begin, end, Launcher(mi_scene, options, (begin, end), generator)) for begin, end in bounds
        ]

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
        mi_scene: Where they go, a `mitsuba.Scene`.
        options: What is traced.
        part: Numbers of the first ray and of the one past the last; absent: all rays.
        generator: What says how rays go on, a `SBCandidateGenerator` of Sionna RT; absent: that itself.
    """

    def __init__(
        self,
        mi_scene: Any,
        options: LaunchOptions,
        part: tuple[int, int] | None = None,
        generator: Any = None,
    ) -> None:
        from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator
        from sionna.rt.utils import fibonacci_lattice

        self._mi_scene = mi_scene
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
        import drjit as dr
        import mitsuba as mi

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
        wedges = self._no_wedges(lanes)
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

    def _no_wedges(self, samples: int) -> Any:
        from sionna.rt.utils import WedgeGeometry

        return WedgeGeometry.build_with_size(samples) if self._options.diffraction else None

    def _bounce(self, origin: Any, direction: Any, active: Any, enabled: Any, wedges: Any) -> tuple[Any, ...]:
        """Next interaction of all rays, and how they go on. Rules of what may follow what are Sionna RT's."""
        import drjit as dr
        import mitsuba as mi

        ray = mi.Ray3f(origin, direction)
        # Coherent: lanes are in the order of the curve, so neighbours walk the tree together.
        hit = self._mi_scene.ray_intersect(ray, ray_flags=mi.RayFlags.Minimal, coherent=True, active=active)
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
    import drjit as dr
    import mitsuba as mi

    points = -(-(end - first) // step)
    # In float64: float32 cannot count to the 1e8 rays that a launch may have.
    number = dr.opaque(mi.Float64, first) + dr.opaque(mi.Float64, step) * dr.arange(mi.Float64, points)
    x = number / ((1.0 + math.sqrt(5.0)) / 2.0)
    return mi.Point2f(x - dr.floor(x), number / dr.opaque(mi.Float64, count - 1))


def _along_curve(lattice: Any) -> Any:
    """Directions of a lattice on the unit square, ordered along a space-filling curve."""
    import drjit as dr
    import mitsuba as mi

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
