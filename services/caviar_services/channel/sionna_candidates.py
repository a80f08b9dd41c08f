"""Deterministic path candidates for one transmitter, with the bookkeeping done on what was found.

Sionna RT's deterministic generator shoots twice: a first pass notes which (depth, ray, receiver) found
something, a second stores it, in an order decided in between. That decision runs over every lane of
depth · rays · receivers, of which one in some thousands holds anything. Here the lanes that do are
picked out first: the same candidates in the same order for less than a tenth of the work.

Imported by the tracer only, after a Mitsuba variant has been set.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
from sionna.rt.path_solvers.sb_deterministic import (
    NO_PATH_RECORDED_MARKER,
    NON_SPECULAR_PATH_MARKER,
    UINT32_MAX,
    SBDeterministicCandidateGenerator,
    extract_hashes_from_u64,
)


class CandidateGenerator(SBDeterministicCandidateGenerator):  # type: ignore[misc]  # untyped base
    """`SBDeterministicCandidateGenerator` for a single source."""

    def _shoot_and_bounce(
        self,
        mi_scene: Any,
        src_positions: Any,
        tgt_positions: Any,
        paths: Any,
        samples_per_src: int,
        max_num_paths_per_src: int,
        max_depth: int,
        paths_counter_per_source: Any,
        specular_reflection: bool,
        diffuse_reflection: bool,
        refraction: bool,
        diffraction: bool,
        edge_diffraction: bool,
        seed: int,
        src_boxes: Any = None,
    ) -> None:
        arguments = (
            mi_scene,
            src_positions,
            tgt_positions,
            samples_per_src,
            max_num_paths_per_src,
            max_depth,
            paths,
            paths_counter_per_source,
            specular_reflection,
            diffuse_reflection,
            refraction,
            diffraction,
            edge_diffraction,
            self._sampler,
        )
        targets = dr.width(tgt_positions)
        with dr.scoped_set_flag(dr.JitFlag.OptimizeLoops, False):
            self._sampler.seed(seed, samples_per_src)
            notes, first_ray = self._shoot_and_bounce_loop(*arguments, counting_mode=True)
            noted: Any = dr.compress(notes != NO_PATH_RECORDED_MARKER)
            if dr.width(noted) == 0:
                return
            lanes, finished = _winners(noted, notes, first_ray, samples_per_src, targets)
            count = min(dr.width(lanes), paths.buffer_size - int(paths.paths_counter[0]))
            if count <= 0:
                return
            place, shooting = _places(
                lanes, finished, count, paths.paths_counter, dr.width(notes), samples_per_src, targets
            )
            self._sampler.seed(seed, samples_per_src)
            self._shoot_and_bounce_loop(*arguments, output_offset=place, thread_has_output=shooting)
        paths.advance_paths_counter(dr.opaque(mi.UInt32, count))


def _winners(lanes: Any, notes: Any, first_ray: Any, samples: int, targets: int) -> tuple[Any, Any]:
    """Those of the lanes whose find is kept, and whether each ends in a diffuse reflection, so is finished.

    Of the rays that found one chain of surfaces, the first keeps it: the one that both hash tables name.
    """
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
    number = dr.arange(mi.UInt32, dr.width(lanes))
    fits = number < dr.opaque(mi.UInt32, count)
    place = dr.full(mi.UInt32, UINT32_MAX, width)
    dr.scatter(place, (number + stored) | dr.select(finished, mi.UInt32(1 << 31), 0), lanes, fits)
    shooting = dr.zeros(mi.Bool, samples)
    dr.scatter(shooting, True, (lanes // targets) % samples, fits)
    dr.eval(place, shooting)
    return place, shooting
