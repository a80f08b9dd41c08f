"""Scenery of which a piece is far away: float32 must stay fine where the rest is."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from caviar_protocol.errors import AssetError
from caviar_services.channel.sionna.scene_loading import Shape, counting_centre, file_pieces
from caviar_services.drjit_setup import choose_variant
from caviar_space.materials import ObjectMaterials
from caviar_space.meshes import Mesh, box, ply


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


def described(folder: Path, body: str) -> Path:
    """A description of a wall of concrete and a yard of it, whose mesh is a quad."""
    (folder / "meshes").mkdir()
    (folder / "meshes/wall.ply").write_bytes(ply(HOUSE))
    head = "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    faces = "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
    quad = "0 0 0\n9 0 0\n9 9 0\n0 9 0\n4 0 1 2 3\n"
    (folder / "meshes/yard.ply").write_text(head.format(4) + faces.format(1) + quad)
    (folder / "meshes/empty.ply").write_text(head.format(0) + faces.format(0))
    file = folder / "scene.xml"
    file.write_text(f'<scene version="2.1.0">\n{body}\n</scene>')
    return file


def shape_of(name: str, material: str, file: str = "meshes/{}.ply") -> str:
    named = f'<string name="filename" value="{file.format(name)}"/><ref id="{material}" name="bsdf"/>'
    return f'<shape type="ply" id="mesh-{name}">{named}</shape>\n'


CONCRETE = '<bsdf type="itu-radio-material" id="{}"><string name="type" value="concrete"/>{}</bsdf>\n'
THICK = '<float name="thickness" value="0.4"/>'
COLOUR = '<rgb name="color" value="0.1 0.2 0.3"/>'
DIFFUSE = '<bsdf type="diffuse" id="{}"/>\n'


@pytest.mark.parametrize(
    ("materials", "used", "names"),
    [
        (CONCRETE.format("c", ""), "cc", "cc"),
        (DIFFUSE.format("mat-itu_concrete.001"), ["mat-itu_concrete.001"] * 2, ["itu_concrete"] * 2),
        (
            DIFFUSE.format("mat-itu_concrete") + DIFFUSE.format("itu_concrete"),
            ["mat-itu_concrete", "itu_concrete"],
            ["itu_concrete"] * 2,
        ),
        (CONCRETE.format("c.002", COLOUR) + CONCRETE.format("c", ""), ["c", "c.002"], "cc"),
        (CONCRETE.format("c.002", THICK) + CONCRETE.format("c", ""), ["c", "c.002"], ["c", "c.002"]),
        (
            '<default name="m" value="concrete"/>' + DIFFUSE.format("itu_$m"),
            ["itu_$m"] * 2,
            ["itu_concrete"] * 2,
        ),
        (CONCRETE.format("wall", ""), ["wall"] * 2, ["wall"] * 2),
        (
            '<bsdf type="twosided" id="mat-itu_concrete"><bsdf type="principled" id="inner"/></bsdf>\n',
            ["mat-itu_concrete"] * 2,
            ["itu_concrete"] * 2,
        ),
    ],
    ids=[
        "plain",
        "numbered",
        "two names",
        "copy",
        "another thickness",
        "parameter",
        "a shape's name",
        "two sides",
    ],
)
def test_materials_of_exported_scenes_have_the_constants_that_they_say(
    tmp_path: Path, materials: str, used: Sequence[str], names: Sequence[str]
) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant(choose_variant())
    body = f'<default name="dir" value="meshes"/>{materials}{shape_of("wall", used[0], "$dir/{}.ply")}'
    body += shape_of("yard", used[1]) + shape_of("empty", used[1])
    pieces, notes = file_pieces(described(tmp_path, body))
    assert [piece.material.name for piece in pieces.values()] == list(names)
    assert {piece.material.itu_type for piece in pieces.values()} == {"concrete"}
    assert (len({*map(id, (p.material for p in pieces.values()))}) == 1) is (names[0] == names[1])
    thick = 0.4 if names[0] != names[1] else 0.1
    assert float(pieces["yard"].material.thickness[0]) == pytest.approx(thick)
    assert pieces["yard"].mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert pieces["wall"].mesh.vertices.tolist() == HOUSE.vertices.tolist()
    assert len(notes) == 1
    assert re.search(
        r"^warning: scenery/scene\.xml:\d: shape 'mesh-empty', mesh empty\.ply, has no tri", notes[0]
    )


@pytest.mark.parametrize(
    ("materials", "message"),
    [
        (
            CONCRETE.format("mat-c", THICK) + CONCRETE.format("c", ""),
            r"scene\.xml:3: material 'c' and that of line 2: material 'mat-c' are both 'c'",
        ),
        (
            '<bsdf type="radio-material" id="c"><float name="relative_permittivity" value="0.5"/></bsdf>',
            r"scene\.xml:2: material 'c': .*relative permittivity must be greater",
        ),
        (CONCRETE.format("c", THICK.replace("0.4", "abc")), r"scene\.xml:2: material 'c': .*\"abc\""),
        (CONCRETE.format("c", THICK.replace("0.4", "$d")), r"scene\.xml:2: bsdf 'c' uses \$d"),
    ],
    ids=["two of one name", "constants", "number", "parameter"],
)
def test_a_material_that_cannot_be_made_is_named_with_its_line_and_cause(
    tmp_path: Path, materials: str, message: str
) -> None:
    mi = pytest.importorskip("mitsuba")
    mi.set_variant(choose_variant())
    with pytest.raises(AssetError, match=message) as caught:
        file_pieces(described(tmp_path, materials + shape_of("wall", "c")))
    assert "Traceback" not in str(caught.value)
    assert "At string" not in str(caught.value)


@pytest.mark.parametrize("name", ["wall-material", "itu_concrete"])
def test_a_radio_material_keeps_its_properties_whatever_its_id(tmp_path: Path, name: str) -> None:
    pytest.importorskip("mitsuba").set_variant(choose_variant())
    rough = '<float name="scattering_coefficient" value="0.3"/>'
    pieces, _ = file_pieces(described(tmp_path, CONCRETE.format(name, rough) + shape_of("wall", name)))
    assert float(pieces["wall"].material.scattering_coefficient[0]) == pytest.approx(0.3)


def test_foliage_alone_may_have_a_material_without_radio_constants(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba").set_variant(choose_variant())
    leaves = '<bsdf type="diffuse" id="leaves"><rgb name="color" value="0 0.3 0"/></bsdf>'
    scene = described(tmp_path, leaves + shape_of("wall", "leaves"))
    with pytest.raises(AssetError, match=r"'leaves' of type 'diffuse', of which .* no radio constants"):
        file_pieces(scene)
    pieces, _ = file_pieces(scene, ObjectMaterials({"wa*": "wa*"}))
    assert pieces["wall"].material is None
