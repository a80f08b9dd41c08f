"""How many rays went along each chain of a launch, from which follows what half of the rays would miss."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from caviar_services.channel.sionna.candidates import MANY_RAYS, Chains, chains_of
from caviar_services.channel.sionna.ray_launcher import REFLECTED, Bounce, Launch
from caviar_services.drjit_setup import activate_llvm, choose_variant
from caviar_services.sensors.base import active_variant

pytestmark = pytest.mark.channel


@pytest.fixture(autouse=True)
def ray_tracer() -> Iterator[None]:
    """The ray tracer's arrays are of the channel's variant."""
    variant = choose_variant()
    if variant.startswith("llvm"):
        activate_llvm()
    with active_variant(variant):
        yield


def launched(*planes: list[int]) -> Chains:
    """Chains of a launch whose rays met these planes, bounce by bounce; −1: the ray has ended."""
    import mitsuba as mi

    bounces = tuple(
        Bounce(
            kind=mi.UInt([REFLECTED if plane >= 0 else 0 for plane in met]),
            shape=mi.UInt([0] * len(met)),
            primitive=mi.UInt([max(plane, 0) for plane in met]),
            point=None,
            normal=None,
            probability=None,
        )
        for met in planes
    )
    scene: Any = SimpleNamespace(
        surface_of=np.arange(8, dtype=np.int32),
        plane_table=SimpleNamespace(triangle=np.arange(8)),
        triangle_numbers=lambda shapes, primitives: primitives,
    )
    return chains_of(Launch(bounces, None), scene, len(planes))


FIRST = [4, 4, 2, 4, -1, 2, 2]
SECOND = [1, 1, 1, 3, -1, -1, 1]


def test_rays_of_each_chain_are_counted() -> None:
    found = launched(FIRST, SECOND)
    counted = {tuple(planes): rays for planes, rays in zip(found.planes.tolist(), found.rays, strict=True)}
    assert counted == {(2, -1): 3, (4, -1): 3, (2, 1): 2, (4, 1): 2, (4, 3): 1}


def test_those_of_a_path_are_found_by_its_planes() -> None:
    paths = np.array([[4, 3], [2, -1], [2, 1], [3, 4], [2, -1]])
    depth = np.array([2, 1, 2, 2, 2])
    rays = launched(FIRST, SECOND).rays_of(paths, depth)
    assert rays.tolist() == [1, 3, 2, MANY_RAYS, MANY_RAYS]


def test_a_launch_that_met_nothing_has_none() -> None:
    assert launched([-1, -1]).rays_of(np.array([[3]]), np.array([1])).tolist() == [MANY_RAYS]


def test_what_half_misses_is_the_mean_over_all_ways_to_halve_the_launch() -> None:
    """A chain that n of N rays went along is missing from a half drawn ray by ray with probability 2⁻ⁿ."""
    rng = np.random.default_rng(1)
    halves = rng.random((20_000, len(FIRST))) < 0.5
    of_chain = {chain: [i for i, met in enumerate(FIRST) if met == chain] for chain in (2, 4)}
    for chain, rays in of_chain.items():
        missed = float(np.mean(~halves[:, rays].any(1)))
        assert abs(missed - 0.5 ** launched(FIRST).rays_of(np.array([[chain]]), np.array([1]))[0]) < 0.01


def test_a_ray_between_that_ended_leaves_the_chain_of_its_neighbours_one() -> None:
    found = launched([4, -1, 4, 4, 2], [1, -1, 1, -1, -1])
    assert found.planes.tolist() == [[2, -1], [4, -1], [4, 1]]
    assert found.rays.tolist() == [1, 3, 2]
    assert found.ray.tolist() == [4, 0, 0]


@pytest.mark.parametrize("rays", [1, 2, 500])
@pytest.mark.parametrize("ended", [0.0, 0.3, 1.0])
def test_chains_are_those_of_a_walk_along_each_ray(rays: int, ended: float) -> None:
    rng = np.random.default_rng(rays)
    met = np.repeat(rng.integers(0, 3, (3, rays)), 1 + rays // 100, axis=1)[:, :rays]
    # What has ended stays so.
    met[np.logical_or.accumulate(rng.random((3, rays)) < ended)] = -1
    walked: dict[tuple[int, ...], list[int]] = {}
    for ray, planes in enumerate(met.T.tolist()):
        for depth in range(1, 1 + sum(plane >= 0 for plane in planes)):
            walked.setdefault((*planes[:depth], *[-1] * (3 - depth)), []).append(ray)
    found = launched(*met.tolist())
    counted = zip(found.planes.tolist(), found.ray.tolist(), found.rays.tolist(), strict=True)
    assert {tuple(planes): (first, count) for planes, first, count in counted} == {
        planes: (along[0], len(along)) for planes, along in walked.items()
    }
