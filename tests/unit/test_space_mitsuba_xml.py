"""Scene descriptions: what is read, and what is refused."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from caviar_protocol.errors import AssetError
from caviar_services.channel.sionna.scene_loading import file_pieces
from caviar_space.meshes import unit_box
from caviar_space.mitsuba_xml import (
    ITU_MATERIALS,
    RadioMaterial,
    SceneryShape,
    find_scenery,
    read_scenery,
    scenery_files,
)
from caviar_space.scenery import scenery_assets

SHAPE = '<shape type="ply" id="mesh-{0}"><string name="filename" value="meshes/{0}.ply"/>{1}</shape>'


def described(folder: Path, body: str, *meshes: str) -> Path:
    """A description with this content, and empty files for its meshes."""
    (folder / "meshes").mkdir()
    for mesh in meshes:
        (folder / "meshes" / f"{mesh}.ply").touch()
    file = folder / "scene.xml"
    file.write_text(f'<scene version="2.1.0">{body}</scene>')
    return file


def only_shape(folder: Path, body: str) -> SceneryShape:
    (shape,) = read_scenery(described(folder, body, "wall")).shapes
    return shape


def bundled_scenes() -> list[Path]:
    spec = importlib.util.find_spec("sionna")
    places = spec.submodule_search_locations if spec else None
    return sorted(Path(places[0]).glob("rt/scenes/*/*.xml")) if places else []


@pytest.mark.parametrize("file", bundled_scenes(), ids=lambda file: file.stem)
def test_every_scene_that_comes_with_sionna_is_read(file: Path) -> None:
    """As many shapes as the text has, each with a mesh and an ITU material."""
    shapes = read_scenery(file).shapes
    assert len(shapes) == file.read_text().count("<shape ")
    assert all(shape.file.is_file() and shape.itu_material for shape in shapes)


def test_a_scene_exported_from_blender_is_read() -> None:
    """Materials named by id alone, sensors, emitters and transforms beside the shapes."""
    file = Path(__file__).parents[2] / "../shared/data/central-park/central_park.xml"
    if not file.is_file():
        pytest.skip("the central-park scene is not on this machine")
    shapes = {shape.name: shape for shape in read_scenery(file).shapes}
    assert shapes.keys() == {"map_2_osm_buildings", "Cube", "Plane"}
    assert {name: shape.itu_material for name, shape in shapes.items()} == {
        "map_2_osm_buildings": "concrete",
        "Cube": "metal",
        "Plane": "concrete",
    }
    assert shapes["Cube"].to_world[:3, 3].tolist() == [-361.0, 198.55, -135.45146]


@pytest.mark.parametrize(
    ("material", "expected"),
    [
        ('<bsdf type="itu-radio-material" id="m"><string name="type" value="glass"/></bsdf>', "glass"),
        ('<bsdf type="diffuse" id="m"/>', ""),
    ],
)
def test_the_itu_material_is_that_of_the_definition(tmp_path: Path, material: str, expected: str) -> None:
    shape = only_shape(tmp_path, material + SHAPE.format("wall", '<ref id="m" name="bsdf"/>'))
    assert (shape.material, shape.itu_material) == ("m", expected)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("mat-itu_concrete", "concrete"),
        ("itu_wet_ground", "wet_ground"),
        ("mat-itu_brick.001", "brick"),
        ("glass", ""),
    ],
)
def test_the_itu_material_is_told_by_the_id_of_any_material(tmp_path: Path, name: str, expected: str) -> None:
    material = f'<bsdf type="twosided" id="{name}"><bsdf type="diffuse"/></bsdf>'
    shape = only_shape(tmp_path, material + SHAPE.format("wall", f'<ref id="{name}" name="bsdf"/>'))
    assert shape.itu_material == expected


@pytest.mark.parametrize(
    ("inside", "expected"),
    [
        ('<rgb name="color" value="0.1 0.2 0.3"/>', (0.1, 0.2, 0.3)),
        ('<bsdf type="diffuse"><rgb name="reflectance" value="1, 0, 0.5"/></bsdf>', (1.0, 0.0, 0.5)),
        ('<rgb name="specular" value="0.1 0.2 0.3"/>', None),
        ("", None),
    ],
)
def test_the_colour_is_that_of_the_material(
    tmp_path: Path, inside: str, expected: tuple[float, float, float] | None
) -> None:
    material = f'<bsdf type="twosided" id="m">{inside}</bsdf>'
    assert only_shape(tmp_path, material + SHAPE.format("wall", '<ref id="m"/>')).colour == expected


@pytest.mark.parametrize("value", ["red", "0.1 0.2", "1.5 0 0", ""])
def test_a_colour_that_is_none_is_refused(tmp_path: Path, value: str) -> None:
    material = f'<bsdf type="diffuse" id="m"><rgb name="reflectance" value="{value}"/></bsdf>'
    with pytest.raises(AssetError, match=r"mesh-wall.*three numbers from 0 to 1"):
        only_shape(tmp_path, material + SHAPE.format("wall", '<ref id="m"/>'))


def test_steps_of_a_transform_act_in_the_order_they_stand(tmp_path: Path) -> None:
    """Scale, then a quarter turn about z, then a shift: (1, 2, 3) by hand."""
    steps = (
        '<scale x="2"/><rotate z="1" angle="90"/><translate value="10 20 30"/>'
        '<matrix value="1 0 0 0.5  0 1 0 0  0 0 1 0  0 0 0 1"/>'
    )
    shape = only_shape(tmp_path, SHAPE.format("wall", f'<transform name="to_world">{steps}</transform>'))
    np.testing.assert_allclose(shape.to_world @ [1, 2, 3, 1], [10 - 2 + 0.5, 20 + 2, 33, 1], atol=1e-12)


def test_defaults_are_filled_in(tmp_path: Path) -> None:
    body = '<default name="h" value="4"/>' + SHAPE.format(
        "wall", '<transform name="to_world"><translate z="$h"/></transform>'
    )
    assert only_shape(tmp_path, body).to_world[2, 3] == 4.0


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('<shape type="obj" id="mesh-roof"/>', ["mesh-roof", "'obj'", "ply"]),
        ('<shape type="ply" id="mesh-roof"/>', ["mesh-roof", "filename"]),
        (SHAPE.format("gone", ""), ["mesh-gone", "meshes/gone.ply", "missing"]),
        (SHAPE.format("../../wall", ""), ["meshes/../../wall.ply", "below its folder"]),
        (SHAPE.format("wall", '<ref id="m" name="bsdf"/>'), ["mesh-wall", "'m'", "not defined"]),
        (SHAPE.format("wall", "") * 2, ["has the id 'mesh-wall'", "line 1 has, too"]),
        (
            SHAPE.format("wall", '<transform name="to_world"><lookat origin="0,0,0"/></transform>'),
            ["mesh-wall", "lookat", "rotate"],
        ),
        (
            SHAPE.format("wall", '<transform name="to_world"><translate value="1 2"/></transform>'),
            ["mesh-wall", "translate", "'1 2'"],
        ),
        (
            SHAPE.format("wall", '<transform name="to_world"><scale value="0"/></transform>'),
            ["mesh-wall", "singular"],
        ),
        (
            SHAPE.format("wall", '<transform name="to_world"><translate z="$h"/></transform>'),
            ["mesh-wall", "$h", "default"],
        ),
        ("<shape", ["broken XML", "line"]),
    ],
)
def test_what_is_wrong_is_named_with_the_file_and_the_shape(
    tmp_path: Path, body: str, words: list[str]
) -> None:
    file = described(tmp_path, body, "wall")
    with pytest.raises(AssetError) as caught:
        read_scenery(file)
    assert all(word in str(caught.value) for word in [str(file), *words])


def test_entities_are_refused_before_they_are_expanded(tmp_path: Path) -> None:
    file = tmp_path / "scene.xml"
    file.write_text('<!DOCTYPE scene [<!ENTITY a "b">]><scene><shape id="&a;"/></scene>')
    with pytest.raises(AssetError, match="DOCTYPE"):
        read_scenery(file)


def test_another_root_element_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "scene.xml"
    file.write_text("<html/>")
    with pytest.raises(AssetError, match=r"<html>.*<scene>"):
        read_scenery(file)


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match=r"nowhere\.xml"):
        read_scenery(tmp_path / "nowhere.xml")


def test_the_description_is_found_among_the_assets() -> None:
    mesh, xml = Path("/a/scenery/meshes/wall.ply"), Path("/a/scenery/canyon.xml")
    assert find_scenery({"scenery/meshes/wall.ply": mesh, "scenery/canyon.xml": xml}) == xml
    assert find_scenery({"objects/car.ply": mesh}) is None


def test_two_descriptions_in_one_run_are_refused() -> None:
    with pytest.raises(AssetError, match=r"scenery/a\.xml, scenery/b\.xml"):
        find_scenery({"scenery/b.xml": Path("b"), "scenery/a.xml": Path("a")})


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (
            '\n<bsdf type="itu-radio-material" id="m">\n<string name="type" value="concret"/></bsdf>',
            r"scene\.xml:2: material 'm': ITU-R P\.2040 has no material 'concret'; did you mean 'concrete'",
        ),
        ('\n\n<bsdf type="diffuse" id="mat-itu_bric"/>', r"scene\.xml:3: material .* did you mean 'brick'"),
        (
            '\n<shape type="cube" id="block"/>',
            r"scene\.xml:2: shape 'block' is of type 'cube'; export it as a PLY",
        ),
        (
            SHAPE.format("wall", "") + "\n" + SHAPE.format("wall", ""),
            r"scene\.xml:2: <shape> has the id 'mesh-wall', which line 1 has, too; give each an id",
        ),
        (
            '<bsdf type="diffuse" id="a"/>\n<bsdf type="diffuse" id="a"/>',
            r"scene\.xml:2: <bsdf> has the id 'a', which line 1 has, too",
        ),
        (
            SHAPE.format("wall", '<ref id="m" name="bsdf"/>'),
            r"scene\.xml:1: shape 'mesh-wall' refers to material",
        ),
        ("\n<shape", r"scene\.xml:2: broken XML"),
    ],
)
def test_a_mistake_is_told_with_file_and_line(tmp_path: Path, body: str, message: str) -> None:
    file = described(tmp_path, body, "wall")
    with pytest.raises(AssetError, match=message):
        read_scenery(file)
    with pytest.raises(AssetError, match=message.replace(r"scene\.xml", "^scenery/mine")):
        read_scenery(file, "scenery/mine")


def test_the_world_refuses_it_under_the_path_of_the_user(tmp_path: Path) -> None:
    file = described(tmp_path, '<bsdf type="diffuse" id="itu_concret"/>')
    with pytest.raises(AssetError, match=rf"^{file}:1: material 'itu_concret': .* did you mean 'concrete'"):
        scenery_assets(str(file))


def test_the_materials_are_those_of_the_ray_tracer() -> None:
    itu = pytest.importorskip("sionna.rt.radio_materials.itu", reason="needs the extra `channel`")
    assert frozenset(itu.ITU_MATERIALS_PROPERTIES) == ITU_MATERIALS


def test_the_ray_tracer_refuses_a_shape_without_radio_constants(tmp_path: Path) -> None:
    body = '<bsdf type="diffuse" id="paint"/>\n' + SHAPE.format("wall", '<ref id="paint" name="bsdf"/>')
    with pytest.raises(AssetError, match=r"^scenery/scene\.xml:2.*'mesh-wall'.*'paint'"):
        file_pieces(described(tmp_path, body, "wall"))


def test_a_colour_for_cameras_has_the_name_that_mitsuba_takes(tmp_path: Path) -> None:
    leaves = RadioMaterial(colour=(0.0, 0.25, 0.0))
    files = scenery_files("wood", {"tree": (unit_box(), "leaves")}, {"leaves": leaves})
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    assert '<rgb name="reflectance"' in (tmp_path / "scenery/wood.xml").read_text()
    assert read_scenery(tmp_path / "scenery/wood.xml").shapes[0].colour == leaves.colour
