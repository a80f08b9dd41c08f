"""Scenery of which a piece is far away: float32 must stay fine where the rest is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from caviar_protocol.errors import AssetError
from caviar_services.channel.sionna.scene_loading import Shape, counting_centre, file_vertices
from caviar_services.mesh.scenery import RadioMaterial, scenery_files
from caviar_services.mesh.shapes import Mesh, box


def shape(**pieces: Mesh) -> Shape:
    return Shape("s", None, list(pieces), list(pieces.values()))


HOUSE, YARD = box((300.0, 320.0), (0.0, 10.0), (0.0, 8.0)), box((250.0, 400.0), (-50.0, 50.0), (-1.0, 0.0))


@pytest.mark.parametrize("distance", [-1e8, 1e8])
def test_of_two_places_that_at_the_origin_counts(distance: float) -> None:
    rock = box((distance, distance + 10.0), (0.0, 1.0), (0.0, 1.0))
    centre, warning = counting_centre([shape(rock=rock, house=HOUSE)])
    assert (centre == counting_centre([shape(house=HOUSE)])[0]).all()
    assert "'rock'" in warning


@pytest.mark.parametrize("distance", [1e6, 1e8, 1e12])
def test_a_far_piece_is_named_and_does_not_move_the_centre(distance: float) -> None:
    rock = box((distance, distance + 10.0), (0.0, 1.0), (0.0, 1.0))
    alone, quiet = counting_centre([shape(house=HOUSE, yard=YARD)])
    centre, warning = counting_centre([shape(house=HOUSE, rock=rock), shape(yard=YARD)])
    assert (centre == alone).all()
    assert not quiet
    assert "'rock'" in warning
    assert f"{distance:g}" in warning
    assert f"steps of {np.spacing(np.float32(distance)):.2g} m" in warning


def test_a_wide_piece_is_named_where_nothing_is_beside_it() -> None:
    centre, warning = counting_centre([shape(plain=box((-1e6, 1e6), (-1e6, 1e6), (0.0, 1.0)))])
    assert (centre == 0).all()
    assert "'plain'" in warning


def test_a_city_is_counted_from_its_middle_without_a_word() -> None:
    centre, warning = counting_centre([shape(west=HOUSE, east=box((9e4, 9.1e4), (0.0, 1.0), (0.0, 1.0)))])
    assert not warning
    assert abs(centre[0] - (300.0 + 9.1e4) / 2) <= 64.0
    assert counting_centre([])[1] == ""


def test_a_shape_named_like_a_material_is_refused_with_a_remedy(tmp_path: Path) -> None:
    files = scenery_files("scene", {"ground": (YARD, "ground")}, {"ground": RadioMaterial("concrete")})
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    with pytest.raises(AssetError, match=r"the name of a material.*such as 'ground-shape'"):
        file_vertices(tmp_path / "scenery/scene.xml")
