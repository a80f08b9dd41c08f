"""Deterministic path candidates for one transmitter, with the bookkeeping done on what was found.

Sionna RT's deterministic generator shoots twice: a first pass notes which (depth, ray, receiver) found
something, a second stores it, in an order decided in between. That decision runs over every lane of
depth · rays · receivers, of which few hold anything. Here the lanes that do are picked out first:
the same candidates in the same order for a fraction of the work.

Neighbouring lanes of a kernel walk the ray tracer's tree together. Sionna RT launches its rays in the order
of the Fibonacci lattice, where neighbours point into quite different directions; here the same rays
are launched along a space-filling curve, which halved the time of the kernel in the street canyon.
"""

from __future__ import annotations

from types import FunctionType, MethodType
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array, Int64Array


def candidate_generator() -> Any:
    """A `SBDeterministicCandidateGenerator` for a single source, with that stage replaced."""
    from sionna.rt.path_solvers.sb_deterministic import SBDeterministicCandidateGenerator

    generator = SBDeterministicCandidateGenerator()
    generator._shoot_and_bounce = _Shooting(generator)
    return generator


class _Shooting:
    """The shooting stage of a candidate generator; called as its ``_shoot_and_bounce``."""

    def __init__(self, generator: Any) -> None:
        loop = generator._shoot_and_bounce_loop.__func__
        names = {**loop.__globals__, "fibonacci_lattice": _Lattice(loop.__globals__["fibonacci_lattice"])}
        along_curve = FunctionType(loop.__code__, names, loop.__name__, loop.__defaults__, loop.__closure__)
        along_curve.__kwdefaults__ = loop.__kwdefaults__
        self._loop = MethodType(along_curve, generator)
        self._sampler = generator._sampler

    def __call__(
        self,
        mi_scene: Any,
        src_positions: Any,
        tgt_positions: Any,
        paths: Any,
        samples: int,
        max_paths: int,
        max_depth: int,
        paths_counter: Any,
        *flags_seed_and_boxes: Any,
    ) -> None:
        import drjit as dr
        import mitsuba as mi
        from sionna.rt.path_solvers.sb_deterministic import NO_PATH_RECORDED_MARKER

        *flags, seed, _boxes = flags_seed_and_boxes
        arguments = (mi_scene, src_positions, tgt_positions, samples, max_paths, max_depth, paths)
        arguments = (*arguments, paths_counter, *flags, self._sampler)
        targets = dr.width(tgt_positions)
        with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
            self._sampler.seed(seed, samples)
            notes, first_ray = self._loop(*arguments, counting_mode=True)
            noted: Any = dr.compress(notes != NO_PATH_RECORDED_MARKER)
            if dr.width(noted) == 0:
                return
            lanes, finished = _winners(noted, notes, first_ray, samples, targets)
            count = min(dr.width(lanes), paths.buffer_size - int(paths.paths_counter[0]))
            if count <= 0:
                return
            place, shooting = _places(
                lanes, finished, count, paths.paths_counter, dr.width(notes), samples, targets
            )
            self._sampler.seed(seed, samples)  # the second pass repeats the first
            self._loop(*arguments, output_offset=place, thread_has_output=shooting)
        paths.advance_paths_counter(dr.opaque(mi.UInt32, count))


def _winners(lanes: Any, notes: Any, first_ray: Any, samples: int, targets: int) -> tuple[Any, Any]:
    """Those of the lanes whose find is kept, and whether each ends in a diffuse reflection, so is finished.

    Of the rays that found one chain of surfaces, the first keeps it: the one that both hash tables name.
    """
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.path_solvers.sb_deterministic import NON_SPECULAR_PATH_MARKER, extract_hashes_from_u64

    note = dr.gather(mi.UInt64, notes, lanes)
    finished = note == NON_SPECULAR_PATH_MARKER
    ray = (lanes // targets) % samples
    won = dr.copy(finished)
    slots = extract_hashes_from_u64(note)
    first = [
        dr.gather(mi.UInt32, table, slot, ~finished) for table, slot in zip(first_ray, slots, strict=True)
    ]
    won |= (first[0] == ray) & (first[1] == ray)
    kept: Any = dr.compress(won)
    return dr.gather(mi.UInt32, lanes, kept), dr.gather(mi.Bool, finished, kept)


def _places(
    lanes: Any, finished: Any, count: int, stored: Any, width: int, samples: int, targets: int
) -> tuple[Any, Any]:
    """For the second pass: where each lane stores its find, and which rays have any.

    The topmost bit of a place says that the find is finished, as the loop expects.
    """
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.path_solvers.sb_deterministic import UINT32_MAX

    number = dr.arange(mi.UInt32, dr.width(lanes))
    fits = number < dr.opaque(mi.UInt32, count)
    place = dr.full(mi.UInt32, UINT32_MAX, width)
    dr.scatter(place, (number + stored) | dr.select(finished, mi.UInt32(1 << 31), 0), lanes, fits)
    shooting = dr.zeros(mi.Bool, samples)
    dr.scatter(shooting, True, (lanes // targets) % samples, fits)
    dr.eval(place, shooting)
    return place, shooting


class _Lattice:
    """A lattice on the unit square whose points are ordered along a space-filling curve."""

    def __init__(self, lattice: Any) -> None:
        self._lattice = lattice
        self._ordered: dict[int, Any] = {}

    def __call__(self, count: int) -> Any:
        import drjit as dr
        import mitsuba as mi

        if count not in self._ordered:
            points = self._lattice(count)
            order = morton_order(np.array(points.x, np.float64), np.array(points.y, np.float64))
            # Gathered, not made from NumPy: where NumPy's memory happens to lie would be part of the kernel.
            ordered = dr.gather(mi.Point2f, points, mi.UInt32(order.astype(np.uint32)))
            dr.eval(ordered)
            self._ordered[count] = ordered
        return self._ordered[count]


def morton_order(x: Float64Array, y: Float64Array) -> Int64Array:
    """Indices that sort points of the unit square along the Morton curve (G. M. Morton, "A Computer Oriented
    Geodetic Data Base", IBM, 1966), Shape ``[N]``; the bits of both coordinates alternate in the key."""
    bits = 16
    cells = [np.clip(axis * (1 << bits), 0, (1 << bits) - 1).astype(np.uint64) for axis in (x, y)]
    key = np.zeros(len(x), np.uint64)
    for bit in range(bits):
        for shift, cell in enumerate(cells):
            key |= ((cell >> np.uint64(bit)) & np.uint64(1)) << np.uint64(2 * bit + shift)
    return np.argsort(key, kind="stable")
