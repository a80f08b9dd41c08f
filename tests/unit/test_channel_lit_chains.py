"""Chains of few faces of scenery, and those that a transmitter can light."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from caviar_services.channel.enumeration import scenery_chains
from caviar_services.channel.enumeration.scenery_chains import chain_targets, lit_chains
from caviar_space.rectangles import RIM, FaceRectangles, narrowest_sides

SIGHTS = np.array([[2, 5], [2, 7], [5, 2], [7, 2]])


def walls(*corners: list[tuple[float, float, float]]) -> FaceRectangles:
    """Rectangles of four corners each; their planes are 2, 5, 7, …"""
    count = len(corners)
    at = np.array(corners, float)
    triangles = np.stack([at[:, [0, 1, 2]], at[:, [0, 2, 3]]], axis=1).reshape(-1, 3, 3)
    sizes = np.full(count, 2)
    normal = np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    planes = np.array([2, 5, 7, 9][:count])
    along = narrowest_sides(triangles, sizes)
    return FaceRectangles.of(planes, triangles, sizes, along, normal, np.ones(count, np.bool_))


SOUTH = [(-9.0, 0.0, 0.0), (9.0, 0.0, 0.0), (9.0, 0.0, 8.0), (-9.0, 0.0, 8.0)]
NORTH = [(-9.0, 6.0, 0.0), (9.0, 6.0, 0.0), (9.0, 6.0, 8.0), (-9.0, 6.0, 8.0)]
AWAY = [(-9.0, -5.0, 0.0), (9.0, -5.0, 0.0), (9.0, -5.0, 8.0), (-9.0, -5.0, 8.0)]


def chains(faces: FaceRectangles, sights: np.ndarray, depth: int, source: tuple[float, ...]) -> list[tuple]:
    targets = chain_targets(faces, sights, depth)
    assert targets is not None
    rows = lit_chains(targets, np.array(source), np.ones(len(faces), np.bool_), depth).tolist()
    return [tuple(plane for plane in row if plane >= 0) for row in rows]


def test_between_two_walls_waves_go_to_and_fro() -> None:
    found = chains(walls(SOUTH, NORTH), np.array([[2, 5], [5, 2]]), 3, (0.5, 2.0, 3.0))
    assert found == [(2,), (5,), (2, 5), (5, 2), (2, 5, 2), (5, 2, 5)]


def test_a_wall_behind_another_is_not_lit_by_way_of_it() -> None:
    """South throws the wave northwards, whatever sees what."""
    found = chains(walls(SOUTH, NORTH, AWAY), SIGHTS, 2, (0.5, 2.0, 3.0))
    assert found == [(2,), (5,), (7,), (2, 5), (5, 2), (7, 2)]


def test_a_chain_begins_at_a_face_that_the_source_sees() -> None:
    targets = chain_targets(walls(SOUTH, NORTH), np.array([[2, 5], [5, 2]]), 3)
    assert targets is not None
    found = lit_chains(targets, np.array([0.5, 2.0, 3.0]), np.array([False, True]), 3)
    assert found.tolist() == [[5, -1, -1], [5, 2, -1], [5, 2, 5]]


def test_nothing_that_is_reflected_is_left_out() -> None:
    """By the points of paths between random places, in a room of four walls that are askew."""
    rng = np.random.default_rng(3)
    askew = np.array([SOUTH, NORTH, AWAY, [(9, -5, 0), (9, 6, 0), (9, 6, 8), (9, -5, 8)]], float)
    turn = np.array([[np.cos(0.1), -np.sin(0.1), 0], [np.sin(0.1), np.cos(0.1), 0], [0, 0, 1]])
    askew[1] = askew[1] @ turn
    faces = walls(*[[tuple(corner) for corner in wall] for wall in askew])
    sights = np.array([pair for pair in itertools.product(faces.plane, repeat=2) if pair[0] != pair[1]])
    reflected = set()
    for _ in range(60):
        source, end = rng.uniform((-8, -4, 1), (8, 5, 7), (2, 3))
        found = set(chains(faces, sights, 3, tuple(source)))
        for chain in itertools.product(range(4), repeat=3):
            images = [source]
            for face in chain:
                images.append(faces.mirrored(images[-1][None], np.array([face]))[0])
            here, good = end, chain[0] != chain[1] != chain[2]
            for face, image in zip(chain[::-1], images[:0:-1], strict=True):
                near, far = (float(faces.height(p[None], np.array([face]))[0]) for p in (here, image))
                good = good and near * far < 0
                if good:
                    here = here + near / (near - far) * (image - here)
                    flat = faces.axes[face] @ (here - faces.centre[face])
                    good = bool((np.abs(flat) <= faces.half[face] + RIM).all())
            if good:
                reflected.add(chain)
                assert tuple(faces.plane[list(chain)].tolist()) in found
    assert len(reflected) > 5


def test_too_many_sequences_are_not_enumerated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scenery_chains, "MOST_CHAINS", 12)
    faces = walls(SOUTH, NORTH, AWAY)
    assert chain_targets(faces, SIGHTS, 3) is None
    assert chain_targets(faces, SIGHTS, 2) is not None


def test_faces_that_see_nothing_reflect_alone() -> None:
    assert chains(walls(SOUTH, NORTH), np.zeros((0, 2), np.int64), 2, (0.0, 1.0, 1.0)) == [(2,), (5,)]
