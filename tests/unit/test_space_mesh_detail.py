"""What of a scenery is left out, and what is said about it."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from caviar_space.mesh_detail import DetailSettings, detailed, piece_numbers
from caviar_space.meshes import Mesh, box


def joined(*meshes: Mesh) -> Mesh:
    before = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + begin for mesh, begin in zip(meshes, before, strict=False)]),
    )


def apart(mesh: Mesh) -> Mesh:
    """The same triangles, none of which shares a vertex."""
    return Mesh(
        mesh.vertices[mesh.faces].reshape(-1, 3),
        np.arange(3 * len(mesh.faces), dtype=np.int32).reshape(-1, 3),
    )


HOUSE = box((10, 22), (-5, 5), (0, 12))
SHED = box((40, 42), (3, 4), (0, 2))
TOWER = box((300, 320), (100, 120), (0, 50))
GROUND = Mesh(
    np.array([[-500, -500, 0], [500, -500, 0], [500, 500, 0], [-500, 500, 0]], float),
    np.array([[0, 1, 2], [0, 2, 3]], np.int32),
)
CITY = [("ground", GROUND), ("houses", joined(HOUSE, SHED)), ("tower", TOWER)]


def made(**settings: Any) -> DetailSettings:
    return msgspec.convert(settings, DetailSettings)


def test_pieces_hang_together_by_corners() -> None:
    """Whether or not their triangles share vertices; numbered in the order of their first triangles."""
    mesh = joined(HOUSE, SHED, TOWER)
    expected = np.repeat([0, 1, 2], 12)
    assert np.array_equal(piece_numbers(mesh), expected)
    assert np.array_equal(piece_numbers(apart(mesh)), expected)
    backwards = Mesh(mesh.vertices, mesh.faces[::-1])
    assert np.array_equal(piece_numbers(backwards), expected)


def test_a_long_chain_of_triangles_is_one_piece() -> None:
    """Five hundred along a strip, in random order."""
    x = np.arange(502)
    vertices = np.column_stack([x, x % 2, np.zeros(502)]).astype(float)
    faces = np.column_stack([x[:-2], x[1:-1], x[2:]]).astype(np.int32)
    shuffled = np.random.default_rng(1).permutation(faces)
    assert not piece_numbers(Mesh(vertices, shuffled)).any()


def test_nothing_said_leaves_everything_as_it_is() -> None:
    kept, effect = detailed(CITY, made())
    assert made().is_full
    assert [(name, mesh) for name, mesh in kept] == CITY
    assert effect.triangles == (38, 38)
    assert effect.area_share == 1.0


def test_small_pieces_are_left_out_of_a_shape() -> None:
    """The shed is of 3 m; its house, under the same name, and the ground stay."""
    kept, effect = detailed(CITY, made(smallest_m=5.0))
    meshes = dict(kept)
    assert list(meshes) == ["ground", "houses", "tower"]
    assert np.array_equal(np.ptp(meshes["houses"].vertices, axis=0), [12, 10, 12])
    assert meshes["tower"] is TOWER
    assert (effect.pieces, effect.small, effect.far, effect.triangles) == (4, 1, 0, (38, 26))


def test_pieces_are_left_out_by_the_nearest_point_of_their_box() -> None:
    """From (0, 0) the tower is 316.2 m away, wherever the ground's middle or corners are."""
    assert len(detailed(CITY, made(centre_m=(0, 0), radius_m=316.3))[0]) == 3
    kept, effect = detailed(CITY, made(centre_m=(0, 0), radius_m=316.2))
    assert [name for name, _ in kept] == ["ground", "houses"]
    assert effect.far == 1
    assert [name for name, _ in detailed(CITY, made(centre_m=(310, 110), radius_m=1.0))[0]] == [
        "ground",
        "tower",
    ]


def test_the_note_says_what_is_gone() -> None:
    _, effect = detailed(CITY[1:], made(smallest_m=5.0, centre_m=(0, 0), radius_m=100))
    # Two faces of 12·10, 12·12 and 10·12 m² of the house; the shed's 16 and the tower's 4,800 m² are gone.
    share = 768 / (768 + 16 + 4800)
    assert effect.note == (
        f"mesh detail: 12 of 36 triangles, {share:.1%} of the area; "
        "of 3 pieces 1 are left out as small and 1 as far"
    )


def test_what_is_left_is_decimated() -> None:
    grid = np.arange(11.0)
    x, y = np.meshgrid(grid, grid)
    vertices = np.column_stack([x.ravel(), y.ravel(), np.zeros(121)])
    corner = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    faces = np.concatenate(
        [
            np.column_stack([corner, corner + 1, corner + 12]),
            np.column_stack([corner, corner + 12, corner + 11]),
        ]
    )
    [(_, mesh)], effect = detailed(
        [("plate", Mesh(vertices, faces.astype(np.int32)))], made(tolerance_m=1e-6)
    )
    assert effect.triangles == (200, 2)
    assert effect.area_share == pytest.approx(1.0)
    assert len(mesh.vertices) == 4


@pytest.mark.parametrize("settings", [{"centre_m": (0, 0)}, {"radius_m": 5.0}])
def test_a_radius_needs_its_centre(settings: dict[str, Any]) -> None:
    with pytest.raises(msgspec.ValidationError, match="centre_m and radius_m go together"):
        made(**settings)


def test_a_radius_is_not_negative() -> None:
    with pytest.raises(msgspec.ValidationError, match="radius_m is -2"):
        made(centre_m=(0, 0), radius_m=-2)
