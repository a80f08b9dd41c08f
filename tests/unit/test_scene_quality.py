"""``caviar scene check`` and ``look``: planted faults are found and named, and a clean town has none."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from caviar_protocol.errors import AssetError, ScenarioError
from caviar_scenes.checks import KINDS, check
from caviar_scenes.cli import app
from caviar_scenes.look import look
from caviar_scenes.opened import open_scene, write_changed
from caviar_scenes.repairs import repair
from caviar_scenes.simplification import simplify
from caviar_space.imported_scenes import Georeference, ImportedScene, Piece, write_scene
from caviar_space.meshes import Mesh, box, joined
from caviar_space.mitsuba_xml import RadioMaterial, scenery_files

HOUSE = box((0.0, 8.0), (0.0, 9.0), (0.0, 6.0))
WALL = box((20.0, 29.0), (5.0, 5.2), (0.0, 3.0))


def sheet(x: tuple[float, float], y: tuple[float, float], z: float = 0.0) -> Mesh:
    corners = np.array([[x[0], y[0], z], [x[1], y[0], z], [x[1], y[1], z], [x[0], y[1], z]])
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32))


def moved(x: float, faces: NDArray[np.int32] = HOUSE.faces, up: float = 0) -> Mesh:
    return Mesh(HOUSE.vertices + np.array([x, 0, up]), faces)


def town(folder: Path, more: dict[str, tuple[Mesh, str]], without: str = "") -> Path:
    """A scene of two houses on the ground, and more."""
    shapes = {
        "ground": (sheet((-50, 50), (-50, 50)), "wet_ground"),
        "house": (HOUSE, "concrete"),
        "neighbour": (box((8.0, 20.0), (0.0, 9.0), (0.0, 7.0)), "brick"),
        "chimney": (box((2.0, 3.0), (2.0, 3.0), (5.5, 8.0)), "brick"),
        **more,
    }
    shapes.pop(without, None)
    scene = ImportedScene(
        name="town",
        origin=Georeference(latitude_deg=60.17, longitude_deg=24.94),
        pieces={
            name: Piece(mesh, material, name.partition("-")[0], "test", 1)
            for name, (mesh, material) in shapes.items()
        },
        materials={name: RadioMaterial(name) for name in ("wet_ground", "concrete", "brick", "wood")},
    )
    write_scene(scene, folder / "town")
    return folder / "town"


PLANTED = {
    "thin closed wall": {"wall": (WALL, "concrete")},
    "duplicate face": {"double": (joined([HOUSE, Mesh(HOUSE.vertices, HOUSE.faces[:2])]), "concrete")},
    "overlapping materials": {"lawn": (sheet((30, 40), (30, 40)), "concrete")},
    "hole": {"shed": (moved(30, HOUSE.faces[:-1]), "concrete")},
    "mixed normals": {
        "shed": (
            moved(30, np.vstack([HOUSE.faces[:1, ::-1], HOUSE.faces[1:]])),
            "wood",
        )
    },
    "inside out": {"shed": (moved(30, HOUSE.faces[:, ::-1]), "concrete")},
    "floating": {"cloud": (moved(30, up=20), "wood")},
    "sunken": {"cellar": (moved(30, up=-8), "concrete")},
    "sliver": {"thread": (sheet((30, 40), (30, 30.0005), 0.2), "wood")},
}


@pytest.mark.parametrize("kind", PLANTED)
def test_a_planted_fault_is_found_and_named(kind: str, tmp_path: Path) -> None:
    without = "house" if kind == "duplicate face" else ""
    folder = town(tmp_path, PLANTED[kind], without)
    found = CliRunner().invoke(app, ["check", str(folder), "--json"])
    faults = json.loads(found.stdout)["faults"]
    assert {fault["kind"] for fault in faults} == {kind}
    (name,) = PLANTED[kind]
    # Of two pieces in one plane the first is met: here the ground's material is the fault's.
    assert name in {fault["piece"] for fault in faults} | {faults[0]["note"].removeprefix("with ")}
    low, high = np.ptp(PLANTED[kind][name][0].vertices, axis=0), np.array(faults[0]["place"])
    assert (np.abs(high - PLANTED[kind][name][0].vertices.mean(0)) <= low / 2 + 0.01).all()
    assert found.exit_code == KINDS[kind].wrong


@pytest.mark.parametrize(
    "kind", ["thin closed wall", "duplicate face", "mixed normals", "inside out", "sliver"]
)
def test_a_fault_is_repaired_and_nothing_else_changes(kind: str, tmp_path: Path) -> None:
    without = "house" if kind == "duplicate face" else ""
    folder = town(tmp_path, PLANTED[kind], without)
    done = CliRunner().invoke(app, ["repair", str(folder), "--out", str(tmp_path / "better")])
    assert done.exit_code == 0, done.output
    before, after = open_scene(str(folder)), open_scene(str(tmp_path / "better"))
    assert not check(after)
    (name,) = PLANTED[kind]
    for other in before.meshes.keys() - {name}:
        one, same = before.meshes[other], after.meshes[other]
        assert np.array_equal(one.vertices[one.faces], same.vertices[same.faces])
    if kind == "thin closed wall":
        shape = after.shapes[name]
        assert shape.radio is not None
        assert 'name="thickness" value="0.2"' in shape.radio.xml
        assert np.unique(after.meshes[name].vertices[:, 1]) == pytest.approx([5.1])


def test_posts_stay_and_parts_and_odd_names_get_files_of_their_own(tmp_path: Path) -> None:
    post = box((30.0, 30.4), (30.0, 30.4), (0.0, 9.0))
    more = {
        "post": (post, "concrete"),
        "a": (joined([moved(40), WALL]), "wood"),
        "a-part1": (moved(60), "wood"),
    }
    folder = town(tmp_path, more)
    xml = folder / "scene.xml"
    xml.write_text(xml.read_text().replace('id="mesh-house"', 'id="mesh-../../house"'))
    opened = open_scene(str(folder))
    done, _ = repair(opened)
    write_changed(opened, done, tmp_path / "out", {}, "")
    assert not (tmp_path / "house.ply").exists()
    made = open_scene(str(tmp_path / "out")).meshes
    faces = {name: len(made[name].faces) for name in ("post", "a", "a-part1-", "a-part1", "../../house")}
    assert faces == {"post": 12, "a": 12, "a-part1-": 2, "a-part1": 12, "../../house": 12}


def test_a_folder_that_comes_to_be_meanwhile_is_not_written_into(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = town(tmp_path, {})
    monkeypatch.setattr(Path, "exists", lambda self: False)
    with pytest.raises(AssetError, match="cannot write"):
        town(tmp_path, {})
    assert not (first / "scene").is_dir()


@pytest.mark.parametrize("wrong", [
    RadioMaterial(constants=(math.nan, 0.0)), RadioMaterial(constants=(3.0, -1.0)),
    RadioMaterial("brick", math.inf), RadioMaterial("brick", scattering_coefficient=7.0),
])  # fmt: skip
def test_materials_that_cannot_be_are_refused(wrong: RadioMaterial) -> None:
    with pytest.raises(AssetError, match="material 'm': "):
        scenery_files("s", {"house": (HOUSE, "m")}, {"m": wrong})


def test_a_sheet_of_a_material_for_cameras_keeps_what_it_is_made_of(tmp_path: Path) -> None:
    xml = town(tmp_path, PLANTED["thin closed wall"]) / "scene.xml"
    cameras = '<bsdf type="twosided" id="itu_brick"><bsdf type="diffuse"><rgb name="color" value="1 0 0"/>'
    text = xml.read_text().replace("</scene>", cameras + "</bsdf></bsdf></scene>")
    wall = text.index("mesh-wall")
    xml.write_text(text[:wall] + text[wall:].replace('"concrete"', '"itu_brick"', 1))
    done, _ = repair(open_scene(str(xml)))
    write_changed(open_scene(str(xml)), done, tmp_path / "better", {}, "repaired")
    shape = open_scene(str(tmp_path / "better")).shapes["wall"]
    assert (shape.itu_material, shape.colour) == ("brick", (1.0, 0.0, 0.0))
    assert shape.radio is not None
    assert '"thickness" value="0.2"' in shape.radio.xml


def test_overlapping_bodies_of_one_material_are_united(tmp_path: Path) -> None:
    wing = box((0.0, 8.0), (5.0, 30.0), (0.0, 6.0))
    scene = open_scene(str(town(tmp_path, {"wing": (wing, "concrete")})))
    done, changes = repair(scene, union=True)
    assert not done["wing"]
    (change,) = (change for change in changes if change.piece == "house")
    assert change.after.volume_m3 == pytest.approx(8 * 30 * 6, rel=1e-5)
    assert len(done["neighbour"]) == len(done["chimney"]) == 1


def test_a_clean_town_has_no_fault(tmp_path: Path) -> None:
    folder = town(tmp_path, {})
    found = CliRunner().invoke(app, ["check", str(folder)])
    assert (found.exit_code, "0 faults" in found.stdout) == (0, True)


def test_a_look_tells_extent_place_and_materials(tmp_path: Path) -> None:
    folder = town(tmp_path, {})
    seen = CliRunner().invoke(app, ["look", str(folder), "--out", str(tmp_path / "town.png")])
    assert seen.exit_code == 0, seen.output
    assert (tmp_path / "town.png").read_bytes()[1:4] == b"PNG"
    text = "\n".join(look(open_scene(str(folder))).lines)
    assert "100.0 × 100.0 × 8.0 m" in text
    assert "60.170000° N, 24.940000° E" in text
    assert "4, 3 closed, 1 open" in text
    (brick,) = (row for row in look(open_scene(str(folder))).materials if row[0] == "brick")
    # Twelve by nine by seven, and one by one by two and a half, metres.
    assert brick[1:4] == ("2", "24", f"{2 * (12 * 9 + 12 * 7 + 9 * 7) + 2 + 4 * 2.5:.0f}")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        ("scene.json", "scene.json"),
        ("scene.xml", "broken XML"),
        ("meshes/house.ply", "house.ply"),
        ("", "scene.xml"),
    ],
)
def test_a_damaged_scene_is_refused_by_name(damage: str, said: str, tmp_path: Path) -> None:
    folder = town(tmp_path, {})
    if damage:
        (folder / damage).write_bytes((folder / damage).read_bytes()[:60])
    else:
        folder = tmp_path
    with pytest.raises(AssetError, match=said):
        check(open_scene(str(folder)))


SCENARIO = """
[run]
name = "drive"
frames = 8
sampling_period_ns = 1_000_000_000

[[carriers]]
name = "c"
frequency_hz = 3.5e9
bandwidth_hz = 100e6

[services.world]
role = "world"
use = "trajectory"
budget_ms = 500

[services.world.settings]
scenery = "file:town/scene.xml"

[[services.world.settings.objects]]
name = "car"
kind = "car"
dimensions_m = [4.5, 1.8, 1.5]
waypoints = [[0.0, -20.0, -5.0, 0.75], [8.0, 30.0, -5.0, 0.75]]

[services.channel]
role = "channel"
use = "USE"
budget_ms = 5000
SETTINGS

[services.agent]
role = "agent"
use = "los-beam"
budget_ms = 500

[services.link]
role = "link"
use = "beams"
budget_ms = 500

[[devices]]
name = "bs"
kind = "antenna"
role = "tx"
position_m = [10.0, -20.0, 10.0]

[[devices]]
name = "rx"
kind = "antenna"
role = "rx"
on = "car"
position_m = [0.0, 0.0, 1.0]
"""


def scenario_in(folder: Path, use: str, settings: str) -> str:
    far = {f"far-{n}": (moved(500, HOUSE.faces, n), "wood") for n in range(5)}
    bricks = {f"brick-{n}": (box((n, n + 0.2), (20, 20.2), (0, 0.2)), "brick") for n in range(5)}
    town(folder, {**far, **bricks})
    file = folder / "drive.toml"
    file.write_text(SCENARIO.replace("USE", use).replace("SETTINGS", settings))
    return str(file)


@pytest.mark.channel
def test_a_scene_is_simplified_within_an_error_that_is_measured(tmp_path: Path) -> None:
    settings = '[services.channel.settings]\nmax_depth = 2\nsamples = 20_000\ncandidates = "launched"'
    scenario = scenario_in(tmp_path, "sionna-rt", settings)
    said: list[float] = []
    found = simplify(scenario, 0.02, tmp_path / "simple", 8, lambda _, share: said.append(share))
    # The far houses and the bricks go; the ground and the houses, between which waves are reflected, stay.
    assert found.triangles == (14 * 12 - 12 + 2, found.triangles[1])
    assert found.triangles[1] <= 3 * 12 + 2
    assert (found.positions, found.held_out.users) == ((4, 4), 4)
    assert found.held_out.p90_db <= 1.2 * 0.02
    assert said == sorted(said)
    left = open_scene(str(tmp_path / "simple"))
    assert sum(len(mesh.faces) for mesh in left.meshes.values()) == found.triangles[1]
    assert {"ground", "house"} <= left.meshes.keys()
    report = json.loads((tmp_path / "simple" / "simplified.json").read_bytes())
    assert report["held_out"]["p90_db"] == pytest.approx(found.held_out.p90_db)


def test_a_scenario_whose_channel_meets_no_scenery_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="uses scenery"):
        simplify(scenario_in(tmp_path, "free-space", ""), 0.5, tmp_path / "simple")


@pytest.mark.channel
def test_munich_has_holes_in_its_monuments_alone_and_nothing_that_makes_powers_wrong() -> None:
    faults = check(open_scene("sionna:munich"))
    monuments = ("Frauenkirche", "Heilig_Geist", "St__Peter", "Neues_Rathaus")
    assert 1 <= len(faults) <= 30
    assert not [fault for fault in faults if KINDS[fault.kind].wrong]
    assert all(fault.piece.startswith(monuments) for fault in faults)
