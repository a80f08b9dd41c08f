"""Lengths of segments within closed meshes, against slabs of boxes."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from caviar_protocol.arrays import Float64Array
from caviar_space.meshes import Mesh, box
from caviar_space.volumes import MeshVolumes, lengths_inside, outward

ONE, OTHER = ((0.0, 2.0), (0.0, 3.0), (0.0, 4.0)), ((1.0, 5.0), (1.0, 6.0), (-1.0, 2.0))
BOTH = ((1.0, 2.0), (1.0, 3.0), (0.0, 2.0))
"""Where the two overlap."""

Bounds = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


def merged(*meshes: Mesh) -> Mesh:
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + begin for mesh, begin in zip(meshes, first, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(faces).astype(np.int32))


def inside_out(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]))


def ball(radius: float, rings: int = 12, sides: int = 24) -> Mesh:
    """Its corners are on a sphere about the origin."""
    tilt, turn = np.meshgrid(
        np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, sides + 1), indexing="ij"
    )
    turn[:, -1] = 0.0  # the same corners to the bit
    at = radius * np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], axis=-1)
    at[0], at[-1] = (0, 0, radius), (0, 0, -radius)
    number = np.arange(at.size // 3).reshape(at.shape[:2])
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate(
        [np.stack([a, b, c], -1)[:-1].reshape(-1, 3), np.stack([a, c, d], -1)[1:].reshape(-1, 3)]
    )
    return Mesh(at.reshape(-1, 3), faces.astype(np.int32))


def segments(count: int = 5000) -> tuple[Float64Array, Float64Array]:
    """At random, about a tenth of them with an end inside."""
    ends = np.random.default_rng(1).uniform(-3, 7, (2, count, 3))
    return ends[0], ends[1]


def by_slabs(bounds: Bounds, start: Float64Array, end: Float64Array) -> Float64Array:
    low, high = np.array(bounds).T
    along = end - start
    one, other = (low - start) / along, (high - start) / along
    near, far = np.minimum(one, other).max(1), np.maximum(one, other).min(1)
    share = np.minimum(far, 1) - np.maximum(near, 0)
    return np.maximum(share, 0) * np.linalg.norm(along, axis=1)


def inside(*meshes: Mesh, start: Float64Array, end: Float64Array) -> Float64Array:
    volumes = MeshVolumes.of([(outward(mesh), 0) for mesh in meshes])
    return lengths_inside([volumes], start, end, 1)[:, 0]


def test_within_a_box_a_line_runs_as_far_as_between_its_slabs() -> None:
    start, end = segments()
    assert np.abs(inside(box(*ONE), start=start, end=end) - by_slabs(ONE, start, end)).max() < 1e-13


@pytest.mark.parametrize("how", ["two meshes", "one mesh", "one of them inside out", "two sets"])
def test_where_volumes_of_one_kind_overlap_counts_once(how: str) -> None:
    start, end = segments()
    expected = by_slabs(ONE, start, end) + by_slabs(OTHER, start, end) - by_slabs(BOTH, start, end)
    one, other = box(*ONE), box(*OTHER)
    if how == "two sets":
        sets = [MeshVolumes.of([(outward(mesh), 0)]) for mesh in (one, other)]
        found = lengths_inside(sets, start, end, 1)[:, 0]
    elif how == "one mesh":
        found = inside(merged(one, other), start=start, end=end)
    else:
        found = inside(inside_out(one) if "out" in how else one, other, start=start, end=end)
    assert np.abs(found - expected).max() < 1e-13


def test_volumes_of_two_kinds_count_for_each() -> None:
    start, end = segments()
    volumes = MeshVolumes.of([(outward(box(*ONE)), 1), (outward(box(*OTHER)), 0)])
    found = lengths_inside([volumes], start, end, 2)
    expected = np.stack([by_slabs(OTHER, start, end), by_slabs(ONE, start, end)], axis=1)
    assert np.abs(found - expected).max() < 1e-13


def test_a_box_twice_counts_once_and_a_cavity_not_at_all() -> None:
    start, end = segments()
    cavity = ((0.5, 1.5), (1.0, 2.0), (1.0, 3.0))
    hollow = merged(box(*ONE), inside_out(box(*cavity)))
    whole, gap = by_slabs(ONE, start, end), by_slabs(cavity, start, end)
    assert np.abs(inside(box(*ONE), box(*ONE), start=start, end=end) - whole).max() < 1e-13
    assert np.abs(inside(hollow, start=start, end=end) - (whole - gap)).max() < 1e-13


def test_lines_through_corners_and_edges_are_inside_as_far_as_others() -> None:
    """Through the middle of a ball and each of its corners; between points of a lattice with a box's corners
    and the middles of its edges and faces, but for lines in the plane of a face."""
    mesh = ball(3.0)
    found = inside(mesh, start=-2 * mesh.vertices, end=2 * mesh.vertices)
    assert np.abs(found - 6.0).max() < 1e-12
    lattice = np.array(list(product((-1.0, 0.0, 1.0, 2.0, 3.0), repeat=3)))
    start, end = (lattice[i.ravel()] for i in np.indices((len(lattice),) * 2))
    cube = ((0.0, 2.0),) * 3
    in_face = ((start == end) & ((start == 0) | (start == 2))).any(1)
    nudge = 1e-9 * np.array([0.31, -0.53, 0.77])
    with np.errstate(divide="ignore", invalid="ignore"):
        expected = by_slabs(cube, start + nudge, end + nudge)
    compared = ~in_face & (start != end).any(1) & np.isfinite(expected)
    assert np.count_nonzero(compared) > 10_000
    assert np.abs(inside(box(*cube), start=start, end=end) - expected)[compared].max() < 1e-8


def test_at_utm_coordinates_lengths_are_those_at_the_origin() -> None:
    start, end = segments(500)
    far = np.array([4.6e5, 5.33e6, 520.0])
    bounds = tuple((low + shift, high + shift) for (low, high), shift in zip(ONE, far.tolist(), strict=True))
    found = inside(box(*bounds), start=start + far, end=end + far)
    assert np.abs(found - by_slabs(ONE, start, end)).max() < 1e-6


def test_what_has_no_inside_is_refused() -> None:
    whole = box(*ONE)
    with pytest.raises(ValueError, match="3 of its 18 edges are open"):
        outward(Mesh(whole.vertices, whole.faces[1:]))
    turned = whole.faces.copy()
    turned[0] = turned[0, ::-1]
    with pytest.raises(ValueError, match="3 of its 18 edges"):
        outward(Mesh(whole.vertices, turned))


def test_no_volumes_and_segments_without_length() -> None:
    start, end = segments(10)
    assert not lengths_inside([MeshVolumes.of([])], start, end, 2).any()
    assert not inside(box(*ONE), start=start, end=start).any()
    with np.errstate(invalid="ignore"):
        assert not np.nan_to_num(inside(box(*ONE), start=np.full((3, 3), np.nan), end=end[:3])).any()
