"""Materials from pictures: cameras, segmentation by ONNX, labels of faces, and the table one can correct."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_protocol.arrays import Float32Array, UInt8Array
from caviar_protocol.errors import AssetError
from caviar_scenes.materials import (
    chosen_materials,
    label_faces,
    read_materials,
    read_scene,
    table_of,
    wall_neighbours,
    with_materials,
)
from caviar_scenes.segmentation import OnnxSegmenter, class_materials, material_matrix
from caviar_scenes.views import Eye, Picture, camera, pictures_table, read_pictures, viewpoints
from caviar_space.imported_scenes import ImportedScene, Piece, write_scene
from caviar_space.meshes import Mesh, box, joined
from caviar_space.mitsuba_xml import RadioMaterial

pytestmark = pytest.mark.slow

COLOURS = {"brick": (200, 60, 40), "glass": (40, 80, 220), "sky": (250, 250, 250)}


def wall(x: float, y: tuple[float, float], z: tuple[float, float]) -> Mesh:
    """Two triangles across x."""
    corners = [(x, y[0], z[0]), (x, y[1], z[0]), (x, y[1], z[1]), (x, y[0], z[1])]
    return Mesh(np.array(corners, np.float64), np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def model_scene() -> ImportedScene:
    """A front of 10 m by 9 m, whose ground floor is to be of glass, and a wall behind the camera."""
    front = joined([wall(10.0, (-5.0, 5.0), (0.0, 3.0)), wall(10.0, (-5.0, 5.0), (3.0, 9.0))])
    scene = ImportedScene(name="two walls", materials={"grey": RadioMaterial("concrete", 0.3)})
    for name, mesh in (("front", front), ("back", wall(-10.0, (-5.0, 5.0), (0.0, 9.0)))):
        scene.pieces[name] = Piece(mesh, "grey", "building", "test", 1)
    return scene


def eye_of(scene: ImportedScene) -> Eye:
    return Eye({name: piece.mesh for name, piece in scene.pieces.items()})


class Colours:
    """A segmenter that knows colours."""

    classes = tuple(COLOURS)

    def segment(self, rgb: UInt8Array) -> Float32Array:
        near = -np.stack([np.abs(rgb.astype(float) - colour).sum(-1) for colour in COLOURS.values()], -1) / 20
        share = np.exp(near - near.max(-1, keepdims=True))
        return (share / share.sum(-1, keepdims=True)).astype(np.float32)


def photograph(folder: Path) -> Picture:
    """What the middle camera sees: glass below 3 m, brick above, sky around."""
    from PIL import Image

    device = camera("p.png", (0.0, 0.0, 2.0), (0.0, -10.0, 0.0), 90.0, (96, 72))
    seen = eye_of(model_scene()).look(device)
    rgb = np.full((72, 96, 3), COLOURS["sky"], np.uint8)
    with np.errstate(invalid="ignore"):
        rgb[(seen.face >= 0) & (seen.points[..., 2] >= 3.0)] = COLOURS["brick"]
        rgb[(seen.face >= 0) & (seen.points[..., 2] < 3.0)] = COLOURS["glass"]
    Image.fromarray(rgb).save(folder / "p.png")
    (folder / "pictures.csv").write_text(pictures_table({"p.png": device}))
    return Picture(folder / "p.png", device)


def onnx_model(
    folder: Path, classes: int = 3, card: Mapping[str, Any] | None = None, bias: float = 0.0
) -> Path:
    """A model whose logits are those of the nearest of three colours."""
    import onnx
    from onnx import TensorProto, helper

    colours = np.array(list(COLOURS.values())[:classes], np.float32) / 255
    weights = 60 * colours[:, :, None, None]
    biases = bias - 30 * (colours**2).sum(1)
    graph = helper.make_graph(
        [helper.make_node("Conv", ["picture", "w", "b"], ["logits"])],
        "colours",
        [helper.make_tensor_value_info("picture", TensorProto.FLOAT, [1, 3, "h", "w"])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, [1, classes, "h", "w"])],
        [
            helper.make_tensor("w", TensorProto.FLOAT, weights.shape, weights.ravel()),
            helper.make_tensor("b", TensorProto.FLOAT, biases.shape, biases),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, str(folder / "net.onnx"))
    known = {
        "classes": list(COLOURS), "materials": {"brick": "brick", "glass": "glass"}, "mean": [0, 0, 0],
        "std": [1, 1, 1], "width": 64, "multiple": 4,
    }  # fmt: skip
    (folder / "net.json").write_text(json.dumps({**known, **(card or {})}))
    return folder / "net.onnx"


TABLE = {"brick": {"brick": 1.0}, "glass": {"glass": 1.0}, "sky": {}}


def test_faces_get_what_pixels_say_and_walls_stay_of_two_materials(tmp_path: Path) -> None:
    scene = model_scene()
    labels = label_faces(eye_of(scene), [photograph(tmp_path)], Colours(), TABLE)
    assert labels.best[:4] == ["glass", "glass", "brick", "brick"]
    assert labels.share.max(1)[:4].min() > 0.9
    assert labels.views.tolist() == [1, 1, 1, 1, 0, 0]
    assert labels.reached.tolist() == [True] * 4 + [False] * 2
    of_faces, sure = chosen_materials(scene, labels, 0.5)
    assert of_faces == {"front": ["glass", "glass", "brick", "brick"], "back": ["", ""]}
    made, parts = with_materials(scene, of_faces)
    assert {name: piece.material for name, piece in made.pieces.items()} == {
        "front-glass": "glass", "front-brick": "brick", "back": "grey",
    }  # fmt: skip
    assert made.pieces["front-brick"].mesh.vertices[:, 2].min() == 3.0
    assert parts["front-brick"].tolist() == [2, 3]
    rows = table_of(made, parts, labels, sure).splitlines()
    assert rows[0] == "piece,faces,material,confidence,views,source"
    assert rows[1] == "front-glass,*,glass,1.000,1,pictures"
    assert rows[3] == "back,*,grey,,0,prior"


def test_a_prior_decides_where_nothing_is_seen(tmp_path: Path) -> None:
    scene, prior = model_scene(), {"wood": 0.7, "brick": 0.3}
    labels = label_faces(eye_of(scene), [photograph(tmp_path)], Colours(), TABLE, prior=prior)
    assert chosen_materials(scene, labels, 0.5, prior)[0]["back"] == ["wood", "wood"]


def test_an_unseen_triangle_follows_its_wall() -> None:
    """Its neighbour of the same plane is seen; the one around the corner is not asked."""
    corners = np.array([(5, -2, 0), (5, 2, 0), (5, 2, 4), (5, -2, 4), (9, 2, 0)], np.float64)
    scene = ImportedScene(name="corner", materials={"grey": RadioMaterial("concrete")})
    mesh = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3], [1, 4, 2]], np.int32))
    scene.pieces["wall"] = Piece(mesh, "grey", "building", "test", 1)
    one, other, weight = wall_neighbours(eye_of(scene))
    assert sorted(zip(one.tolist(), other.tolist(), strict=True)) == [(0, 1), (1, 0)]
    assert weight.tolist() == [1.0, 1.0]


def test_the_ends_of_the_commands_meet(tmp_path: Path) -> None:
    """Label by ONNX, correct a line by hand, apply it, and read what became of it."""
    write_scene(model_scene(), tmp_path / "city")
    photograph(tmp_path)
    run = CliRunner().invoke
    given = ["scene", "materials", "label", str(tmp_path / "city"), str(tmp_path / "pictures.csv")]
    found = run(app, [*given, "--model", str(onnx_model(tmp_path)), "--out", str(tmp_path / "made")])
    assert found.exit_code == 0, found.output
    assert "4 of 6 faces have their material from 1 pictures; 4 are seen" in found.output
    table = tmp_path / "made" / "materials.csv"
    assert "front-brick,*,brick," in table.read_text()
    table.write_text("piece,faces,material\nfront-brick,0,marble\nback,*,wood\n")
    again = [
        "scene",
        "materials",
        "apply",
        str(tmp_path / "made"),
        str(table),
        "--out",
        str(tmp_path / "corrected"),
    ]
    assert run(app, again).exit_code == 0
    read = read_scene(str(tmp_path / "corrected"))
    assert {name: read.materials[piece.material].itu_material for name, piece in read.pieces.items()} == {
        "front-glass": "glass", "front-brick-marble": "marble", "front-brick-brick": "brick", "back": "wood",
    }  # fmt: skip
    described = json.loads((tmp_path / "made" / "scene.json").read_text())
    assert {source["file"] for source in described["sources"]} == {"net.onnx", "pictures.csv", "p.png"}


def test_views_are_written_with_faces_and_poses(tmp_path: Path) -> None:
    write_scene(model_scene(), tmp_path / "city")
    given = ["scene", "materials", "views", str(tmp_path / "city"), "--out", str(tmp_path / "views")]
    options = ["--at", "0,0,2,0", "--at", "0,0,2,180,-5", "--size", "40x30"]
    assert CliRunner().invoke(app, [*given, *options]).exit_code == 0
    first, second = read_pictures(tmp_path / "views" / "pictures.csv")
    assert first.rgb().shape == (30, 40, 3)
    with np.load(tmp_path / "views" / "view-00.npz") as seen:
        assert seen["depth"][15, 20] == pytest.approx(10.0, abs=1e-4)
        assert seen["pieces"][seen["piece"][15, 20]] == "front"
        assert seen["face"][15, 20] in (0, 1)
    assert np.allclose(second.camera.position, (0, 0, 2))
    turned = np.array(second.camera.orientation)
    expected = camera("", (0, 0, 2), (180.0, -5.0, 0.0), 90.0, (1, 1)).orientation
    assert min(abs(turned - expected).max(), abs(turned + expected).max()) < 1e-8


def test_viewpoints_see_both_sides_of_a_street() -> None:
    eye = Eye({
        "ground": box((-40, 40), (-40, 40), (-0.2, 0)),
        "left": box((-30, 30), (10, 20), (0, 12)),
        "right": box((-30, 30), (-20, -10), (0, 12)),
    })  # fmt: skip
    chosen = viewpoints(eye, 6, (64, 48))
    seen = [set(np.unique(eye.look(device).owner[eye.look(device).owner >= 0]).tolist()) for device in chosen]
    assert set.union(*seen) == {0, 1, 2}
    assert min(device.position[2] for device in chosen) == pytest.approx(1.7, abs=1e-4)
    assert max(device.position[2] for device in chosen) > 12


@pytest.mark.parametrize(("name", "count", "road"), [("ade20k", 150, 6), ("cityscapes", 19, 0)])
def test_tables_of_known_classes(name: str, count: int, road: int) -> None:
    table = class_materials(name)
    assert len(table) == count
    assert list(table)[road] == "road"
    names, shares = material_matrix(list(table), table, name)
    assert shares[road].tolist() == [1.0 if material == "asphalt_concrete" else 0.0 for material in names]
    assert (shares.sum(1) < 1 + 1e-12).all()
    assert not shares[list(table).index("sky")].any()


DAMAGED_PICTURES = [
    ("file,x_m\np.png,1\n", "pictures.csv:1: there is no column y_m"),
    ("", "pictures.csv:1: there is no column file"),
    ("HEAD", "names no picture"),
    ("HEADp.png,0,0,2,0,0,0\n", "pictures.csv:2: 7 values, the head has 8 columns"),
    ("HEADp.png,0,0,up,0,0,0,90\n", "pictures.csv:2: z_m is 'up'; write a number"),
    ("HEADp.png,0,0,nan,0,0,0,90\n", "pictures.csv:2: z_m is 'nan'"),
    ("HEADp.png,0,0,2,0,0,0,180\n", "pictures.csv:2: hfov_deg is 180"),
    ("HEAD# a note\nnone.png,0,0,2,0,0,0,90\n", "pictures.csv:3: picture"),
    ("HEADpictures.csv,0,0,2,0,0,0,90\n", "cannot be read"),
    ('[{"file": "p.png", "x_m": 1}]', "y_m is None"),
    ('{"file": "p.png"}', "write a list of objects"),
]


@pytest.mark.parametrize(("text", "expected"), DAMAGED_PICTURES)
def test_damaged_tables_of_pictures(tmp_path: Path, text: str, expected: str) -> None:
    photograph(tmp_path)
    file = tmp_path / ("pictures.json" if text[:1] in "[{" and text else "pictures.csv")
    file.write_text(text.replace("HEAD", "file,x_m,y_m,z_m,yaw_deg,pitch_deg,roll_deg,hfov_deg\n"))
    with pytest.raises(AssetError) as caught:
        read_pictures(file)
    assert expected in str(caught.value)


DAMAGED_MATERIALS = [
    ("piece,faces\nfront,*\n", "m.csv:1: there is no column material"),
    ("piece,faces,material\nfrnt,*,brick\n", "m.csv:2: the scene has no piece 'frnt'"),
    ("piece,faces,material\nfront,*,brik\n", "m.csv:2: no material 'brik'"),
    ("piece,faces,material\nfront,0-4,brick\n", "m.csv:2: faces '0-4' of 'front'"),
    ("piece,faces,material\nfront,3-1,brick\n", "faces '3-1'"),
    ("piece,faces,material\nfront,,brick\n", "faces ''"),
    (
        "piece,faces,material\nfront,0 1,brick\nfront,1,glass\n",
        "m.csv:3: face 1 of 'front' is in a line before",
    ),
    (
        "piece,faces,material\nfront,*,brick\nfront,*,glass\n",
        "m.csv:3: line 2 has the other faces of 'front'",
    ),
]


@pytest.mark.parametrize(("text", "expected"), DAMAGED_MATERIALS)
def test_damaged_tables_of_materials(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "m.csv").write_text(text)
    with pytest.raises(AssetError) as caught:
        read_materials(model_scene(), tmp_path / "m.csv")
    assert expected in str(caught.value)


def _bad_output(folder: Path) -> Path:
    return onnx_model(folder, classes=2)


def _no_number(folder: Path) -> Path:
    return onnx_model(folder, bias=math.nan)


def _no_model(folder: Path) -> Path:
    onnx_model(folder).write_bytes(b"no model")
    return folder / "net.onnx"


def _no_card(folder: Path) -> Path:
    onnx_model(folder).with_suffix(".json").unlink()
    return folder / "net.onnx"


def _wrong_layout(folder: Path) -> Path:
    return onnx_model(folder, card={"layout": "NHWC"})


def _unknown_class(folder: Path) -> Path:
    return onnx_model(folder, card={"materials": {"brik": "brick"}})


def _unknown_material(folder: Path) -> Path:
    return onnx_model(folder, card={"materials": {"brick": "brik"}})


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (
            _bad_output,
            "shape [1, 2, 48, 64], and the card has 3 classes; expected is [1, 3, height, width]",
        ),
        (_no_number, "values that are no number"),
        (_no_model, "is no ONNX model"),
        (_no_card, "net.json cannot be read"),
        (_wrong_layout, "does not take a picture of 64 × 48"),
        (_unknown_class, "materials.brik"),
        (_unknown_material, "ITU-R P.2040 has no material 'brik'"),
    ],
)
def test_damaged_models(tmp_path: Path, make: Callable[[Path], Path], expected: str) -> None:
    picture = photograph(tmp_path)
    with pytest.raises(AssetError) as caught:
        OnnxSegmenter(make(tmp_path)).segment(picture.rgb())
    assert expected in str(caught.value)


def test_an_empty_picture_and_an_empty_scene_are_refused(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match="without pixels"):
        OnnxSegmenter(onnx_model(tmp_path)).segment(np.zeros((0, 4, 3), np.uint8))
    with pytest.raises(AssetError, match="has no faces"):
        viewpoints(Eye({}), 2)


def test_a_broken_picture_and_a_broken_segmenter_are_named(tmp_path: Path) -> None:
    picture = photograph(tmp_path)

    class Broken(Colours):
        def segment(self, rgb: UInt8Array) -> Float32Array:
            return super().segment(rgb) * np.float32(math.nan)

    with pytest.raises(AssetError, match=r"p\.png: the segmenter gives .* values that are no number"):
        label_faces(eye_of(model_scene()), [picture], Broken(), TABLE)
    picture.file.write_bytes(picture.file.read_bytes()[:-40])
    with pytest.raises(AssetError, match=r"p\.png' cannot be read"):
        label_faces(eye_of(model_scene()), [picture], Colours(), TABLE)


def test_trees_keep_what_they_are(tmp_path: Path) -> None:
    scene = model_scene()
    scene.pieces["front"] = replace(scene.pieces["front"], kind="foliage")
    labels = label_faces(eye_of(scene), [photograph(tmp_path)], Colours(), TABLE)
    of_faces, sure = chosen_materials(scene, labels, 0.5, {"wood": 1.0})
    assert of_faces == {"front": [""] * 4, "back": ["wood"] * 2}
    assert not sure.any()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("class,materials\nroad,tar\n", "c.csv:2: ITU-R P.2040 has no material 'tar'"),
        ("class,materials\nroad,brick x glass 1\n", "c.csv:2: share 'x' of brick"),
        ("class,materials\nroad,brick 0.5 glass\n", "c.csv:2: share '' of glass"),
        ("class,materials\nroad,brick\nroad,glass\n", "c.csv:3: class 'road' is there twice"),
        ("class,materials\n", "has no classes"),
    ],
)
def test_damaged_tables_of_classes(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "c.csv").write_text(text)
    with pytest.raises(AssetError) as caught:
        class_materials(tmp_path / "c.csv")
    assert expected in str(caught.value)


def test_a_class_that_the_table_lacks_is_named() -> None:
    with pytest.raises(AssetError, match="my table has no class 'sky'"):
        material_matrix(Colours.classes, {"brick": {"brick": 1.0}, "glass": {}}, "my table")
