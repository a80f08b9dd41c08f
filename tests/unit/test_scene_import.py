"""`caviar scene import`: a Wireless InSite project, what a scene cannot hold, and damaged files."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from link_builders import scene_of
from msgspec.structs import replace
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_clients.datasets.plan import PRESETS, apply_preset
from caviar_clients.plots.rays import covered_objects, footprints, lanes_of
from caviar_protocol.errors import AssetError
from caviar_protocol.scenario import load_scenario
from caviar_space.imported_scenes import Georeference
from caviar_space.meshes import box, ply
from caviar_space.mitsuba_xml import read_scenery, world_mesh
from caviar_space.scenery import scenery_assets
from caviar_space.sources import read_source

REFERENCE = """begin_<reference>
cartesian
longitude -77.0787
latitude 38.8907
end_<reference>
"""


def material(number: int, title: str, kind: str, *more: str) -> str:
    lines = (f"begin_<Material> {title}", f"Material {number}", kind, *more, "end_<Material>", "")
    return "\n".join(lines)


def layer(permittivity: float, thickness: float) -> str:
    values = f"conductivity 0.9\npermittivity {permittivity}\nroughness 0\nthickness {thickness}"
    return f"begin_<DielectricLayer>\n{values}\nend_<DielectricLayer>"


CONCRETE = material(
    8,
    "ITU Concrete 60 GHz",
    "LayeredDielectric",
    "diffuse_scattering_model lambertian\nfields_diffusively_scattered 0.4\ncross_polarized_power 0.3",
    f"nLayers 1\n{layer(5.31, 0.3)}",
)
LEAVES = material(0, "Forest", "Biophysical", "density 0.6")
# An L of 10 m by 10 m, which is not convex, and 6 m high.
OUTLINE = [(0, 0), (10, 0), (10, 4), (4, 4), (4, 10), (0, 10)]


def face(number: int, *points: tuple[float, ...]) -> str:
    rows = "\n".join(" ".join(f"{value:.10f}" for value in point) for point in points)
    return f"begin_<face>\nMaterial {number}\nnVertices {len(points)}\n{rows}\nend_<face>\n"


def block(number: int, x: float = 700.0, low: float = 0.0) -> str:
    at = [(x + east, 500.0 + north) for east, north in OUTLINE]
    sides = [
        face(number, (*a, low), (*b, low), (*b, 6.0), (*a, 6.0))
        for a, b in zip(at, [*at[1:], at[0]], strict=True)
    ]
    return "".join(
        [face(number, *((*p, 6.0) for p in at)), face(number, *((*p, low) for p in reversed(at))), *sides]
    )


def geometry(kind: str, materials: str, faces: str, title: str = "") -> str:
    inner = (
        f"begin_<structure> {title}\nbegin_<sub_structure> 1\n{faces}end_<sub_structure>\nend_<structure>\n"
    )
    return (
        f"Format type:keyword version: 1.1.0\nbegin_<{kind}> Town\n{REFERENCE}{materials}"
        f"begin_<structure_group>\n{inner}end_<structure_group>\nend_<{kind}>\n"
    )


GROUND = face(8, (600.0, 400.0, 0.0), (900.0, 400.0, 0.0), (900.0, 700.0, 0.0), (600.0, 700.0, 0.0))
POINTS = "".join(
    f"begin_<points> {name}\nbegin_<location>\n{REFERENCE}nVertices {len(rows)}\n" + "\n".join(rows) + "\n"
    f"end_<location>\nis_transmitter {tx}\nis_receiver {rx}\nend_<points>\n"
    for name, rows, tx, rx in (
        ("Tx", ["746 560 4"], "yes", "no"),
        ("Rx", [f"777 {455 + 10 * number} 3" for number in range(10)], "no", "yes"),
    )
)
FILE = (
    "<Geometry><remcom__rxapi__FileDescription><Filename><remcom__rxapi__String Value='./{}'/></Filename>"
    "</remcom__rxapi__FileDescription></Geometry>"
)
STUDY = (
    "<!DOCTYPE InSite>\n<InSite><CarrierFrequency>"
    "<remcom__rxapi__Double Value='60000000000'/></CarrierFrequency>\n"
    "<FoliageModel><remcom__rxapi__FoliageModelEnum Value='None'/></FoliageModel>\n"
    + "\n".join(FILE.format(name) for name in ("town.city", "flat.ter", "trees.veg", "gone.object"))
    + "\n</InSite>\n"
)
NET = '<net><location netOffset="-650.50,-350.25" projParameter="!"/></net>'
ROUTES = '<routes><vType id="Car"/><vType id="Truck"/></routes>'
CONFIG = '<configuration><net-file value="a.net.xml"/><route-files value="a.rou.xml"/></configuration>'
PROJECT = {
    "town.city": geometry("city", CONCRETE, block(8), "Corner House"),
    "flat.ter": geometry("terrain", CONCRETE, GROUND),
    "trees.veg": geometry("foliage", LEAVES, block(0, x=760.0, low=4.0)),
    "town.txrx": POINTS,
    "town.study.xml": STUDY,
    "sumo/a.sumocfg": CONFIG,
    "sumo/a.net.xml": NET,
    "sumo/a.rou.xml": ROUTES,
}


@pytest.fixture
def project(tmp_path: Path) -> Path:
    folder = tmp_path / "project"
    (folder / "sumo").mkdir(parents=True)
    for name, text in PROJECT.items():
        (folder / name).write_bytes(text.replace("\n", "\r\n").encode())
    return folder


def run(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["scene", "import", *arguments], env={"COLUMNS": "400"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.stdout


def test_a_project_becomes_scenery_with_its_materials_and_scenarios(project: Path, tmp_path: Path) -> None:
    out = tmp_path / "scenes" / "town"
    printed = run(str(project), "--out", str(out), "--lidar", "744,429,767,679")
    assert "names gone.object, which is not there: left out" in printed
    shapes = {shape.name: shape for shape in read_scenery(out / "scene.xml").shapes}
    assert list(shapes) == ["city-corner-house", "terrain-1", "foliage-1"]
    mesh = world_mesh(shapes["city-corner-house"])
    corners = mesh.vertices[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert areas.sum() == pytest.approx(2 * 64 + 40 * 6, rel=1e-5)  # of an L, not of its hull
    radio = shapes["city-corner-house"].radio
    assert radio is not None
    assert radio == shapes["terrain-1"].radio  # one material of two files
    given = dict(re.findall(r'name="(\w+)" value="([\d.]+)"', radio.xml))
    assert {name: float(value) for name, value in given.items()} == {
        "thickness": 0.3,
        "relative_permittivity": 5.31,
        "conductivity": 0.9,
        "scattering_coefficient": 0.4,
        "xpd_coefficient": 0.3,
    }
    assert shapes["foliage-1"].radio is None  # a volume: never taken for a wall
    described = json.loads((out / "scene.json").read_text())
    assert described["origin"] == {
        "latitude_deg": 38.8907,
        "longitude_deg": -77.0787,
        "altitude_m": 0.0,
        "projection": "enu",
    }
    assert len(described["sources"]) == 5
    assert "scenery/scene.json" in scenery_assets(str(out / "scene.xml"))  # its place travels with it
    assert all(re.fullmatch(r"[0-9a-f]{64}", source["sha256"]) for source in described["sources"])
    mobile, fixed = load_scenario(out / "mobile.toml"), load_scenario(out / "fixed.toml")
    traffic = mobile.services["traffic"].settings
    assert traffic["offset_m"] == [650.5, 350.25, 0.0]
    assert traffic["classes"] == {"Car": "car", "Truck": "truck"}
    assert mobile.carriers[0].frequency_hz == 60e9
    assert [(d.name, d.position_m) for d in mobile.devices if d.role == "tx"] == [("tx", (746.0, 560.0, 4.0))]
    assert next(d for d in mobile.devices if d.role == "rx").yaw_deg == -90.0
    standing = [d.position_m for d in fixed.devices if d.role == "rx"]
    assert standing == [(777.0, 455.0 + 10 * number, 3.0) for number in range(10)]
    for preset in PRESETS.values():  # each takes one of the two
        made = apply_preset(preset, {"mobile": mobile, "fixed": fixed}[preset.receivers])
        receivers = [d for d in made.devices if d.role == "rx"]
        assert sum(d.count for d in receivers) == 10
        # Along a vehicle that turns, and north–south where the heading is kept.
        assert {d.yaw_deg for d in receivers if d.on} <= {-90.0 if preset.arrays_turn else 0.0}
    with pytest.raises(AssetError, match="is there already"):
        run(str(project), "--out", str(out))


def test_what_a_scene_cannot_hold_is_said(tmp_path: Path) -> None:
    layers = f"nLayers 2\n{layer(5.0, 0.1)}\n{layer(2.0, 0.2)}"
    wall = material(8, "Wall", "LayeredDielectric", layers, "diffuse_scattering_model directive",
                    "fields_diffusively_scattered 0.2")  # fmt: skip
    metal = material(9, "Metal", "PEC", "roughness 0.01")
    (tmp_path / "a.city").write_text(geometry("city", wall + metal, block(8) + block(9, x=800.0)))
    scene = read_source(tmp_path / "a.city")
    assert scene.materials["insite-wall"].constants == (5.0, 0.9)
    assert scene.materials["insite-wall"].thickness_m == pytest.approx(0.3)
    assert list(scene.pieces) == ["city-1-8", "city-1-9"]
    said = "\n".join(scene.notes)
    for part in ("of its 2 layers the first", "'directive'", "1e+12 S/m", "roughness of 0.01 m"):
        assert part in said


def test_points_that_are_inactive_or_send_with_power_are_told(project: Path) -> None:
    (project / "town.city").rename(project / "Town.CITY")  # Windows takes both names for one
    points = project / "town.txrx"
    sender = (
        "begin_<transmitter>\nbegin_<pattern>\nrotation_z 90\nend_<pattern>\npower 33\nend_<transmitter>\n"
    )
    points.write_text(POINTS.replace("is_transmitter yes", f"{sender}is_transmitter yes"))
    scene = read_source(project)
    assert "city" in {piece.kind for piece in scene.pieces.values()}
    said = "\n".join(scene.notes)
    assert "power 33 is not taken" in said
    assert "rotation 90 is not taken" in said
    points.write_text(POINTS.replace("is_receiver no", "is_receiver yes"))
    assert "'Tx' sends and receives" in "\n".join(read_source(project).notes)
    points.write_text(POINTS.replace("<points> Tx\n", "<points> Tx\ninactive\n"))
    scene = read_source(project)
    assert scene.transmitters_m == []
    assert len(scene.receivers_m) == 10
    assert "'Tx' is inactive" in "\n".join(scene.notes)


def test_places_on_the_earth_and_back() -> None:
    pytest.importorskip("pyproj")
    origin = Georeference(latitude_deg=38.8907, longitude_deg=-77.0787)
    # Radii of curvature of WGS84 at the origin; 1e-4° are some metres, over which ENU is level within 1e-5 m.
    a, e2, sine = 6378137.0, 6.69437999014e-3, np.sin(np.radians(38.8907))
    prime = a / np.sqrt(1 - e2 * sine**2)
    meridian = a * (1 - e2) / (1 - e2 * sine**2) ** 1.5
    step = np.radians(1e-4)
    east, north, _ = origin.to_scene(38.8907 + 1e-4, -77.0787 + 1e-4)
    assert east == pytest.approx(prime * np.cos(np.radians(38.8908)) * step, abs=1e-3)
    assert north == pytest.approx(meridian * step, abs=1e-3)
    assert origin.to_wgs84(*origin.to_scene(38.9, -77.05, 12.0)) == pytest.approx(
        (38.9, -77.05, 12.0), abs=1e-9
    )


def nested(text: str) -> str:
    return text.replace("begin_<structure_group>", "begin_<a>\n" * 40 + "begin_<structure_group>", 1)


def replaced(old: str, new: str) -> Callable[[str], str]:
    """A change of the first place of a text that is there."""
    return lambda text: text[: text.index(old)] + new + text[text.index(old) + len(old) :]


# File, change, and what the message has behind the file; None: the file is gone.
MUTATIONS: dict[str, tuple[str, Callable[[str], str | bytes] | None, str]] = {
    "empty": ("town.city", lambda t: "", r":1: holds no block"),
    "cut": ("town.city", lambda t: t[: len(t) // 2], r":\d+: (the file is cut off|nVertices)"),
    "cut before the last line": ("flat.ter", replaced("end_<terrain>", ""), r":\d+: the file is cut"),
    "oversized vertex": ("town.city", replaced("700.0000000000", "7e300"), r":\d+: a vertex lies"),
    "oversized count": (
        "town.city",
        replaced("nVertices 6", "nVertices 999999999"),
        r"nVertices is 999999999, and 6",
    ),
    "a vertex too few": (
        "flat.ter",
        replaced("nVertices 4", "nVertices 5"),
        r":\d+: nVertices is 5, and 4 follow",
    ),
    "too few for a face": ("flat.ter", replaced("nVertices 4", "nVertices 2"), r":\d+: '2': write 1 finite"),
    "no number": ("town.city", replaced("700.0000000000", "7oo.0"), r":\d+: '7oo.0 .*write 3 finite"),
    "not finite": ("town.city", replaced("6.0000000000", "nan"), r":\d+: .*write 3 finite"),
    "two coordinates": (
        "flat.ter",
        lambda t: t.replace(" 400.0000000000 0.0", " 400.0", 1).replace(
            "600.0000000000 400.00000000000", "600.0 400.0"
        ),
        r":\d+: .*write 3",
    ),
    "deep": ("town.city", nested, r":\d+: more than 32 blocks"),
    "mislabelled kind": ("trees.veg", lambda t: PROJECT["town.city"], r":1: holds begin_<city>"),
    "mislabelled end": ("town.city", replaced("end_<face>", "end_<fase>"), r":\d+: end_<fase> closes"),
    "wrong order": ("town.city", lambda t: "end_<city>\n" + t, r":1: end_<city> closes"),
    "wrong order of vertices": (
        "flat.ter",
        lambda t: (
            t.replace("900.0000000000 700", "X", 1)
            .replace("900.0000000000 400", "900.0000000000 700", 1)
            .replace("X", "900.0000000000 400")
        ),
        r":\d+: the outline of the face crosses",
    ),
    "unknown material": (
        "town.city",
        replaced("Material 8\nnV", "Material 7\nnV"),
        r":\d+: material 7 is not defined",
    ),
    "material twice": (
        "town.city",
        lambda t: t.replace(CONCRETE, CONCRETE * 2),
        r":\d+: material 8 is there already",
    ),
    "unknown kind of material": (
        "town.city",
        replaced("LayeredDielectric", "Magic"),
        r":\d+: .*of type 'Magic'",
    ),
    "leaves as walls": (
        "town.city",
        replaced("LayeredDielectric", "Biophysical"),
        r":\d+: .*foliage is Biophysical",
    ),
    "permittivity below 1": (
        "flat.ter",
        replaced("5.31", "0.5"),
        r":\d+: '0.5': write 1 finite number\(s\) from 1",
    ),
    "no conductivity": (
        "flat.ter",
        replaced("conductivity 0.9\n", ""),
        r":\d+: begin_<DielectricLayer> lacks conductivity",
    ),
    "no thickness": (
        "flat.ter",
        replaced("thickness 0.3", "thickness 0"),
        r":\d+: its layers have no thickness",
    ),
    "layers": ("flat.ter", replaced("nLayers 1", "nLayers 2"), r":\d+: nLayers is 2, and 1 follow"),
    "share above 1": ("flat.ter", replaced("scattered 0.4", "scattered 4"), r":\d+: .*are shares"),
    "geographic coordinates": (
        "town.city",
        replaced("cartesian", "longlat"),
        r":\d+: coordinates are not cartesian",
    ),
    "another origin": ("trees.veg", replaced("38.8907", "38.9"), r":\d+: origin at 38.9"),
    "no place": ("town.city", replaced("38.8907", "388.9"), r":\d+: latitude 388.9"),
    "open foliage": (
        "trees.veg",
        lambda t: t[: t.index("begin_<face>")] + t[t.index("end_<face>") + 11 :],
        r":\d+: foliage 'foliage-1' encloses no volume",
    ),
    "UTF-16": ("town.city", lambda t: t.encode("utf-16"), r":1: a zero byte"),
    "Latin-1": (
        "town.city",
        lambda t: t.replace("Corner House", "Straße").encode("latin-1"),
        r":\d+: byte 0xdf is not UTF-8",
    ),
    "points without role": ("town.txrx", replaced("yes", "no"), r":\d+: points neither"),
    "offset that is none": ("sumo/a.net.xml", lambda t: t.replace("-650.50", "nan"), "netOffset 'nan"),
    "no points": ("town.txrx", lambda t: "", r":1: holds no points"),
    "study cut": ("town.study.xml", lambda t: t[:-12], r":\d+: .*export the study again"),
    "study mislabelled": ("town.study.xml", lambda t: "<html/>", r":1: <html> is no study"),
    "study with entities": (
        "town.study.xml",
        lambda t: t.replace("<!DOCTYPE InSite>", '<!DOCTYPE a [<!ENTITY b "c">]>'),
        r"an entity is declared",
    ),
    "frequency": (
        "town.study.xml",
        replaced("60000000000", "sixty"),
        r"CarrierFrequency sixty: write numbers",
    ),
    "network cut": ("sumo/a.net.xml", lambda t: t[:-4], r":1: .*mend the XML"),
    "network without offset": ("sumo/a.net.xml", lambda t: "<net/>", r"netOffset ''; write x,y"),
    "routes gone": ("sumo/a.rou.xml", None, r": No such file"),
}


@pytest.mark.parametrize("name", MUTATIONS)
def test_a_damaged_project_is_refused_with_its_place_and_nothing_is_written(
    name: str, project: Path, tmp_path: Path
) -> None:
    file, change, expected = MUTATIONS[name]
    if change is None:
        (project / file).unlink()
    else:
        made = change(PROJECT[file])
        (project / file).write_bytes(made if isinstance(made, bytes) else made.encode())
    before = sorted(tmp_path.iterdir())
    with pytest.raises(
        AssetError, match=re.escape(Path(file).name.removeprefix("sumo/")) + ".*" + expected
    ) as refused:
        run(str(project), "--out", str(tmp_path / "out"))
    assert "\n" not in str(refused.value)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.sumo
def test_rosslyn(shared_data: Path, tmp_path: Path) -> None:
    pytest.importorskip("libsumo")
    pytest.importorskip("matplotlib")
    scene = read_source(shared_data / "rosslyn")
    kinds = [piece.kind for piece in scene.pieces.values()]
    assert [kinds.count(kind) for kind in ("city", "terrain", "foliage")] == [29, 1, 3]
    assert scene.transmitters_m == [(746.0, 560.0, 4.0)]
    assert len(scene.receivers_m) == 10
    assert scene.frequencies_hz == [60e9]
    assert scene.materials["insite-itu-concrete-60-ghz"].constants == (5.31, 0.8967)
    run(str(shared_data / "rosslyn"), "--out", str(tmp_path / "rosslyn"))
    picture = tmp_path / "rosslyn.png"
    arguments = ["scene", "picture", str(tmp_path / "rosslyn" / "mobile.toml"), "--out", str(picture)]
    result = CliRunner().invoke(app, [*arguments, "--frames", "20"], env={"COLUMNS": "200"})
    assert result.exit_code == 0, result.output
    assert picture.read_bytes()[1:4] == b"PNG"
    objects, positions, below = map(
        int, re.findall(r"(\d+) (?:objects in|positions|below)", result.stdout)[-3:]
    )
    assert objects > 20
    assert positions > 400
    assert below == 0


def test_objects_below_roofs_and_lanes_are_found_in_the_world(tmp_path: Path) -> None:
    (tmp_path / "house.ply").write_bytes(ply(box((0.0, 10.0), (0.0, 4.0), (0.0, 6.0))))
    house = footprints([(tmp_path / "house.ply", np.eye(4))])
    places = {"in": (5.0, 0.0), "half": (-1.5, 0.0), "across": (-1.5, np.pi / 2), "out": (-9.0, 0.0)}
    objects = {name: ((x, 2.0, 0.5), yaw) for name, (x, yaw) in places.items()}
    scene = replace(scene_of(objects=objects), dimensions=np.tile([4.0, 1.0, 1.0], (4, 1)))
    # Of four metres along x, the front is in the house; turned by 90° nothing is.
    assert dict(covered_objects(scene, [house])) == {"in": 5, "half": 2, "across": 0, "out": 0}
    net = tmp_path / "a.net.xml"
    net.write_text('<net><edge><lane shape="1.0,2.0 3.0,2.0"/></edge></net>')
    assert lanes_of(net, (10.0, 20.0, 0.0), 0.0)[0].tolist() == [[11.0, 22.0], [13.0, 22.0]]
    assert lanes_of(net, (10.0, 20.0, 0.0), 90.0)[0] == pytest.approx(np.array([[8.0, 21.0], [8.0, 23.0]]))
