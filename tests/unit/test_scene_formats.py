"""Readers of scenes: geometry, place and materials against independent readings; damaged files."""

from __future__ import annotations

import io
import json
import math
import re
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scene_builders import SQUARE, b3dm, boxes, content, glb, surface, tile, tileset

from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import AssetError
from caviar_space.imported_scenes import Georeference, ImportedScene
from caviar_space.meshes import Mesh, ply
from caviar_space.sources import Request, read_source
from caviar_space.sources.pieces import itu_name, surface_triangles

trimesh = pytest.importorskip("trimesh")
ezdxf = pytest.importorskip("ezdxf")
pyproj = pytest.importorskip("pyproj")
pytest.importorskip("DracoPy")

A, F = 6378137.0, 1 / 298.257223563
E2 = F * (2 - F)


def measured(scene: ImportedScene) -> dict[str, tuple[float, float]]:
    """Volume and area of each piece."""
    made = {}
    for name, piece in scene.pieces.items():
        a, b, c = np.moveaxis(piece.mesh.vertices[piece.mesh.faces], 1, 0)
        across = np.cross(b - a, c - a)
        made[name] = float((across * a).sum() / 6), float(np.linalg.norm(across, axis=1).sum() / 2)
    return made


def bounds(scene: ImportedScene) -> Float64Array:
    points = np.concatenate([piece.mesh.vertices for piece in scene.pieces.values()])
    return np.stack([points.min(0), points.max(0)])


def turned(points: Any) -> Float64Array:
    """y up, z south to z up, y north."""
    x, y, z = np.asarray(points).T
    return np.stack([x, -z, y], axis=-1)


def ecef(latitude: float, longitude: float, height: float) -> Float64Array:
    """Textbook formula (B. Hofmann-Wellenhof et al., "GNSS", 2008, section 8.2)."""
    lat, lon = math.radians(latitude), math.radians(longitude)
    n = A / math.sqrt(1 - E2 * math.sin(lat) ** 2)
    return np.array(
        [
            (n + height) * math.cos(lat) * math.cos(lon),
            (n + height) * math.cos(lat) * math.sin(lon),
            (n * (1 - E2) + height) * math.sin(lat),
        ]
    )


def east_north_up(latitude: float, longitude: float) -> Float64Array:
    """Rows: east, north and up in the Earth's axes."""
    lat, lon = math.radians(latitude), math.radians(longitude)
    return np.array(
        [
            [-math.sin(lon), math.cos(lon), 0],
            [-math.sin(lat) * math.cos(lon), -math.sin(lat) * math.sin(lon), math.cos(lat)],
            [math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)],
        ]
    )


# --- formats of meshes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["glb", "gltf", "draco"])
def test_gltf_is_where_trimesh_reads_it_with_z_up(how: str, tmp_path: Path) -> None:
    scene = boxes()
    file = tmp_path / ("town.gltf" if how == "gltf" else "town.glb")
    if how == "gltf":
        for name, content in scene.export(file_type="gltf").items():
            (tmp_path / (file.name if name == "model.gltf" else name)).write_bytes(content)
    else:
        file.write_bytes(trimesh.exchange.gltf.export_glb(scene, extension_draco=how == "draco"))

    read = read_source(file)

    near = 2e-3 if how == "draco" else 1e-6
    expected = turned(trimesh.load_scene(file).to_mesh().vertices)
    np.testing.assert_allclose(bounds(read), [expected.min(0), expected.max(0)], atol=near)
    assert measured(read)["house"] == pytest.approx((24, 52), abs=near)
    assert measured(read)["tower"] == pytest.approx((2, 10), abs=near)
    material = read.materials[read.pieces["house"].material]
    assert (material.itu_material, material.colour) == ("brick", (1.0, 0.0, 0.0))
    assert read.pieces["house"].material == "red-brick"


def test_gltf_instances_and_mirrors_keep_the_outside_in_front(tmp_path: Path) -> None:
    data = bytearray(trimesh.exchange.gltf.export_glb(trimesh.Scene(trimesh.creation.box((1, 2, 3)))))
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    places = np.array([[0, 0, 0], [10, 0, 0], [0, 0, 20]], "<f4").tobytes()
    binary = bytes(data[28 + size :]) + places
    document["bufferViews"].append({"buffer": 0, "byteOffset": len(data) - 28 - size, "byteLength": 36})
    document["buffers"][0]["byteLength"] = len(binary)
    accessor = {
        "bufferView": len(document["bufferViews"]) - 1,
        "componentType": 5126,
        "count": 3,
        "type": "VEC3",
    }
    document["accessors"].append(accessor)
    node = next(node for node in document["nodes"] if "mesh" in node)
    node["scale"] = [-1, 1, 1]
    node.pop("matrix", None)
    instances = {"attributes": {"TRANSLATION": len(document["accessors"]) - 1}}
    node["extensions"] = {"EXT_mesh_gpu_instancing": instances}
    (tmp_path / "a.glb").write_bytes(glb(document, binary))

    read = read_source(tmp_path / "a.glb")

    assert [round(volume, 6) for volume, _ in measured(read).values()] == [6, 6, 6]
    np.testing.assert_allclose(bounds(read), [[-10.5, -21.5, -1], [0.5, 1.5, 1]], atol=1e-6)


@pytest.mark.parametrize("name", ["b.obj", "b.ply", "b.stl", "text.stl"])
@pytest.mark.parametrize("up", ["z", "y"])
def test_mesh_is_where_trimesh_reads_it(name: str, up: str, tmp_path: Path) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=5)
    mesh.apply_translation((1, 2, 3))
    file = tmp_path / name
    mesh.export(file, file_type="stl_ascii" if name == "text.stl" else None)

    read = read_source(file, Request(up="y" if up == "y" else "z"))

    again = trimesh.load_mesh(file)
    ((volume, area),) = measured(read).values()
    assert (volume, area) == pytest.approx((again.volume, again.area), rel=1e-9)
    expected = turned(again.vertices) if up == "y" else again.vertices
    np.testing.assert_allclose(bounds(read), [expected.min(0), expected.max(0)], atol=1e-9)
    assert f"the format has no axes: {up} is taken as up" in read.notes


L_FLOOR = [(0, 0), (10, 0), (10, 4), (4, 4), (4, 10), (0, 10)]


def l_prism() -> tuple[list[tuple[float, float, float]], list[list[int]]]:
    """Corners and polygons of a prism of 64 m² over a floor that is not convex, 5 m high."""
    corners = [(float(x), float(y), z) for z in (0.0, 5.0) for x, y in L_FLOOR]
    walls = [[i, (i + 1) % 6, (i + 1) % 6 + 6, i + 6] for i in range(6)]
    return corners, [list(range(5, -1, -1)), list(range(6, 12)), *walls]


def test_obj_with_polygons_groups_and_materials(tmp_path: Path) -> None:
    corners, polygons = l_prism()
    lines = ["mtllib town materials.mtl", "o Town hall"]
    lines += [f"v {x} {y} {z}" for x, y, z in corners]
    for number, polygon in enumerate(polygons):
        lines.append("usemtl itu_glass" if number == 2 else "usemtl plaster")
        # Corners with texture and normal; negative numbers count from the end.
        lines.append("f " + " ".join(f"{i + 1}/1/1" if number % 2 else f"{i - 12}//1" for i in polygon))
    lines += ["l 1 2", "f 1 2 \\", "2"]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    (tmp_path / "town materials.mtl").write_text("newmtl plaster\nKd 0.5 0.25 0\n")

    read = read_source(tmp_path / "a.obj", Request(materials={"plaster": "marble"}))

    volumes, areas = zip(*measured(read).values(), strict=True)
    assert (sum(volumes), sum(areas)) == pytest.approx((320, 128 + 200))
    assert [
        (piece.material, read.materials[piece.material].itu_material) for piece in read.pieces.values()
    ] == [
        ("plaster", "marble"),
        ("itu-glass", "glass"),
    ]
    assert read.materials["plaster"].colour == (0.5, 0.25, 0.0)
    assert {"1 lines: left out", "1 triangles have no area: left out"} <= set(read.notes)
    assert [source["file"] for source in read.sources] == ["a.obj", "town materials.mtl"]


def test_ply_with_polygons_far_away(tmp_path: Path) -> None:
    corners, polygons = l_prism()
    lines = ["ply", "format ascii 1.0", "comment material brick", f"element vertex {len(corners)}"]
    lines += [f"property double {axis}" for axis in "xyz"] + [f"element face {len(polygons)}"]
    lines += ["property list uchar int vertex_indices", "end_header"]
    lines += [f"{x + 385000.25} {y + 6672000.5} {z}" for x, y, z in corners]
    lines += [f"{len(polygon)} {' '.join(map(str, polygon))}" for polygon in polygons]
    (tmp_path / "a.ply").write_text("\n".join(lines))

    read = read_source(tmp_path / "a.ply")

    assert measured(read)["a"] == pytest.approx((320, 328))
    np.testing.assert_allclose(bounds(read), [[0.25, 0.5, 0], [10.25, 10.5, 5]])
    assert read.materials[read.pieces["a"].material].itu_material == "brick"
    assert "the origin of the scene is at 385000, 6672000, 0 m of the source" in read.notes


def test_dxf_with_every_kind_of_faces(tmp_path: Path) -> None:
    drawing = ezdxf.new()
    drawing.units = 2  # feet
    space = drawing.modelspace()
    space.add_lwpolyline(
        L_FLOOR, close=True, dxfattribs={"thickness": 5, "elevation": 1, "layer": "Brick houses"}
    )
    space.add_lwpolyline([(0, 0), (10, 0)], dxfattribs={"thickness": 3, "layer": "fence"})
    space.add_lwpolyline([(0, 0), (10, 0)], dxfattribs={"layer": "streets"})
    space.add_3dface([(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0)], dxfattribs={"layer": "glass"})
    cube = ezdxf.render.forms.cube(center=False).scale(3, 4, 5)
    cube.render_polyface(space, dxfattribs={"layer": "polyface"})
    cube.translate(20, 0, 0).render_mesh(space, dxfattribs={"layer": "mesh"})
    block = drawing.blocks.new("tower")
    block.add_solid([(0, 0), (1, 0), (0, 1), (1, 1)], dxfattribs={"thickness": 9, "layer": "tower"})
    space.add_blockref("tower", (50, 60), dxfattribs={"rotation": 90})
    drawing.saveas(tmp_path / "a.dxf")

    read = read_source(tmp_path / "a.dxf")

    foot = 0.3048
    got = measured(read)
    expected = {
        "brick-houses": (320, 328),
        "fence": (0, 30),
        "glass": (0, 2),
        "polyface": (60, 94),
        "mesh": (60, 94),
        "tower": (9, 38),
    }
    for layer, (volume, area) in expected.items():
        assert got.pop(layer) == pytest.approx((volume * foot**3, area * foot**2), abs=1e-9), layer
    assert not got
    low = read.pieces["tower"].mesh.vertices.min(0) / foot
    np.testing.assert_allclose(low, [49, 60, 0], atol=1e-9)
    assert read.materials[read.pieces["brick-houses"].material].itu_material == "brick"
    assert "1 entities without faces (LWPOLYLINE): left out" in read.notes


@pytest.mark.parametrize(
    ("name", "itu"),
    [
        ("mat-itu_wet_ground.001", "wet_ground"),
        ("Asphalt concrete", "asphalt_concrete"),
        ("itu-metal", "metal"),
        ("RoofSteel", "metal"),
        ("Windows", "glass"),
        ("Glasgow", ""),
        ("", ""),
    ],
)
def test_material_of_a_name(name: str, itu: str) -> None:
    assert itu_name(name) == itu


def test_surface_with_a_hole_keeps_corners_on_its_sides() -> None:
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.6, 0.8]))[:3, :3]
    outline = np.array([(0, 0, 0), (5, 0, 0), (10, 0, 0), (10, 10, 0), (0, 10, 0)], float) @ turn.T
    hole = np.array([(2, 2, 0), (2, 4, 0), (4, 4, 0), (4, 2, 0)], float) @ turn.T

    points, faces = surface_triangles([outline, hole])

    a, b, c = np.moveaxis(points[faces], 1, 0)
    across = np.cross(b - a, c - a)
    np.testing.assert_allclose(across.sum(0) / 2, turn @ [0, 0, 96], atol=1e-9)
    assert np.linalg.norm(across, axis=1).sum() / 2 == pytest.approx(96)
    assert set(faces.reshape(-1).tolist()) == set(range(9))


# --- CityJSON -----------------------------------------------------------------------------------------------


def independent(
    file: Path, to_scene: Callable[[Float64Array], Float64Array]
) -> dict[str, tuple[float, float]]:
    """Volume and area of each object of CityJSON by vectors of polygons (M. E. Newell), without triangles."""
    city = json.loads(file.read_text())
    transform = city.get("transform", {"scale": [1, 1, 1], "translate": [0, 0, 0]})
    points = to_scene(np.array(city["vertices"]) * transform["scale"] + transform["translate"])
    made = {}
    for name, thing in city["CityObjects"].items():
        for geometry in thing.get("geometry", []):
            shells = geometry["boundaries"] if geometry["type"] == "Solid" else [geometry["boundaries"]]
            volume = area = 0.0
            for rings in (rings for shell in shells for rings in shell):
                whole = np.zeros(3)
                for ring in rings:
                    here = points[ring] - points[rings[0][0]]
                    whole += np.cross(here, np.roll(here, -1, axis=0)).sum(0) / 2
                area += float(np.linalg.norm(whole))
                volume += float(points[rings[0][0]] @ whole) / 3
            made[name] = volume, area
    return made


@pytest.mark.parametrize(
    ("name", "epsg"),
    [
        ("delft.json", 28992),
        ("zurich_subset_lod2.json", 2056),
        ("rotterdam_subset.json", 0),
        ("DH_01_subs.city.json", 0),
    ],
)
def test_cityjson_has_the_areas_and_volumes_of_its_polygons(shared_data: Path, name: str, epsg: int) -> None:
    file = shared_data / "cityjson" / name

    read = read_source(file)

    city = json.loads(file.read_text())
    source = np.array(city["vertices"]) * city["transform"]["scale"] + city["transform"]["translate"]

    def to_scene(points: Float64Array) -> Float64Array:
        if read.origin is None:
            return points - np.floor(source.min(0))
        middle = f"+lat_0={read.origin.latitude_deg} +lon_0={read.origin.longitude_deg}"
        frame = pyproj.CRS(f"+proj=tmerc {middle} +k=1 +datum=WGS84")
        crs = pyproj.Transformer.from_crs(epsg, frame, always_xy=True)
        return np.stack([*crs.transform(*points.T[:2]), points[:, 2]], axis=-1)

    assert (read.origin is None) == (epsg == 0)
    expected = independent(file, to_scene)
    here = to_scene(source)
    np.testing.assert_allclose(bounds(read), [here.min(0), here.max(0)], atol=1e-3)
    got = {key.split("-", 1)[1]: value for key, value in measured(read).items()}
    assert len(got) == len(read.pieces) == len(expected)
    keys = [
        re.sub("[^a-z0-9]+", "-", re.sub("(?<=[a-z])(?=[A-Z])", "-", key).lower()).strip("-")
        for key in expected
    ]
    by_end = {key: next(value for end, value in got.items() if end.endswith(key)) for key in keys}
    for key, (volume, area) in zip(keys, expected.values(), strict=True):
        assert by_end[key] == pytest.approx((volume, area), rel=2e-3, abs=0.05), key
    total = np.array(list(expected.values())).sum(0)
    np.testing.assert_allclose(np.array(list(got.values())).sum(0), total, rtol=1e-4)


def test_cityjson_levels_holes_semantics_and_templates(tmp_path: Path) -> None:
    crown = [[[0, 2, 1]], [[0, 1, 8]], [[1, 2, 8]], [[2, 0, 8]]]
    whole, holed = [[0, 1, 2, 3]], [[0, 1, 2, 3], [4, 5, 6, 7]]
    kinds = {
        "surfaces": [{"type": "Window"}, {"type": "WallSurface"}, {"type": "ClosureSurface"}],
        "values": [0, 1, 2],
    }
    matrix = [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]
    city = SQUARE | {
        "CityObjects": {
            "house": {
                "type": "Building",
                "geometry": [
                    surface("MultiSurface", 1, [whole]),
                    surface("MultiSurface", 2.2, [whole, holed, whole], semantics=kinds),
                ],
            },
            "block": {
                "type": "Building",
                "geometry": [surface("MultiSurface", "1", [whole])],
                "children": ["part"],
            },
            "part": {
                "type": "BuildingPart",
                "geometry": [surface("Solid", "1.2", [[holed]])],
                "parents": ["block"],
            },
            "bench": {
                "type": "CityFurniture",
                "geometry": [
                    {
                        "type": "GeometryInstance",
                        "template": 0,
                        "boundaries": [8],
                        "transformationMatrix": matrix,
                    }
                ],
            },
            "tree": {"type": "SolitaryVegetationObject", "geometry": [surface("Solid", "1", [crown])]},
            "bush": {"type": "SolitaryVegetationObject", "geometry": [surface("Solid", "1", [crown[1:]])]},
            "way": {
                "type": "Road",
                "geometry": [surface("MultiSurface", "1", [whole]), surface("MultiLineString", "1", [])],
            },
        },
        "geometry-templates": {
            "templates": [surface("MultiSurface", "1", [[[0, 1, 2]]])],
            "vertices-templates": [[0, 0, 0], [1, 0, 0], [0, 1, 0]],
        },
    }
    (tmp_path / "a.city.json").write_text(json.dumps(city))

    read = read_source(tmp_path / "a.city.json", Request(materials={"WallSurface": "brick"}))

    tree = read.pieces.pop("foliage-tree")
    assert (tree.kind, read.materials[tree.material].itu_material, len(tree.mesh.faces)) == ("foliage", "", 4)
    assert {key: area for key, (_, area) in measured(read).items()} == pytest.approx(
        {
            "building-house-glass": 16,
            "building-house-brick": 15,
            "building-part-part": 15,
            "city-furniture-bench": 2,
            "road-way": 16,
        }
    )
    np.testing.assert_allclose(read.pieces["city-furniture-bench"].mesh.vertices.max(0), [102, 52, 3])
    materials = {name: read.materials[piece.material].itu_material for name, piece in read.pieces.items()}
    assert (materials["road-way"], materials["building-part-part"]) == ("asphalt_concrete", "concrete")
    assert {"1 ClosureSurface: left out", "1 MultiLineString: left out", "1 open trees: left out"} <= set(
        read.notes
    )
    coarse = read_source(tmp_path / "a.city.json", Request(lod="1"))
    assert set(coarse.pieces) == {"building-house", "building-block", "road-way", "foliage-tree"}
    # The same as lines of features, of which each has vertices of its own.
    first = json.dumps(city | {"CityObjects": {}, "vertices": []})
    features = [
        json.dumps({"type": "CityJSONFeature", "CityObjects": {name: thing}, "vertices": SQUARE["vertices"]})
        for name, thing in city["CityObjects"].items()
        if name in ("house", "bench")
    ]
    (tmp_path / "a.city.jsonl").write_text("\n".join([first, *features]))
    lines = read_source(tmp_path / "a.city.jsonl", Request(materials={"WallSurface": "brick"}))
    assert {name: value for name, value in measured(read).items() if "house" in name or "bench" in name} == (
        measured(lines)
    )
    with pytest.raises(AssetError, match=r"has no level of detail '3'; it has: .*1, 1\.2, 2\.2"):
        read_source(tmp_path / "a.city.json", Request(lod="3"))


# --- 3D Tiles -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("place", [(40.0425, -75.612, 12.5), (-33.9, 151.2, 800.0), (60.17, 24.94, -3.0)])
def test_known_places_on_the_earth_are_within_a_millimetre(
    place: tuple[float, float, float], tmp_path: Path
) -> None:
    latitude, longitude, height = place
    centre, axes = ecef(*place), east_north_up(latitude, longitude)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = axes.T, centre
    (tmp_path / "a.glb").write_bytes(content((30, 20, 5)))
    # Another one by the centre of a b3dm, in the axes of the Earth.
    (tmp_path / "b.b3dm").write_bytes(
        b3dm(content((0, 0, 0)), {"RTC_CENTER": ecef(latitude + 1e-3, longitude, height).tolist()})
    )
    turned_box = tile(1, "a.glb", refine="ADD", transform=transform.T.reshape(-1).tolist())
    undone = np.linalg.inv(transform).T.reshape(-1).tolist()
    (tmp_path / "tileset.json").write_text(
        tileset(turned_box | {"children": [tile(0, "b.b3dm", transform=undone)]})
    )
    origin = Georeference(latitude_deg=latitude, longitude_deg=longitude, altitude_m=height)

    read = read_source(tmp_path / "tileset.json", Request(origin=origin))
    own = read_source(tmp_path / "tileset.json")

    boxes = [piece.mesh.vertices for piece in read.pieces.values()]
    a = min(boxes, key=lambda points: abs(points[:, 0].max() - 31))
    np.testing.assert_allclose([a.min(0), a.max(0)], [[30, 20, 5], [31, 21, 6]], atol=1e-3)
    b = max(boxes, key=lambda points: points[:, 1].max())
    corner = axes @ (ecef(latitude + 1e-3, longitude, height) - centre)
    assert np.linalg.norm(b - corner, axis=1).min() < 1e-3
    assert own.origin is not None
    assert (own.origin.latitude_deg, own.origin.longitude_deg) == pytest.approx(
        (latitude, longitude), abs=1e-7
    )
    assert own.origin.altitude_m == pytest.approx(height - 10, abs=1e-2)
    # Of tiles beyond a box, no content is opened.
    near = read_source(tmp_path / "tileset.json", Request(origin=origin, box_m=(0, 0, 40, 40)))
    assert [each["file"] for each in near.sources] == ["tileset.json", "a.glb"]


def test_tiles_by_level_of_detail_external_and_missing_ones(tmp_path: Path) -> None:
    for number in range(6):
        (tmp_path / f"{number}.glb").write_bytes(content((10 * number, 0, 0)))
    (tmp_path / "inner").mkdir()
    inner = tile(2, "../3.glb", refine="REPLACE", children=[tile(0, "../4.glb"), tile(0, "../missing.glb")])
    (tmp_path / "inner" / "tileset.json").write_text(tileset(inner))
    root = tile(
        8,
        "0.glb",
        children=[
            tile(4, "1.glb", refine="ADD", children=[tile(0, "2.glb")]),
            tile(4, "inner/tileset.json"),
        ],
    )
    (tmp_path / "tileset.json").write_text(tileset(root))

    def taken(error_m: float) -> list[int]:
        read = read_source(tmp_path / "tileset.json", Request(error_m=error_m))
        return sorted(round(piece.mesh.vertices[:, 0].min() / 10) for piece in read.pieces.values())

    assert (taken(0), taken(4), taken(8)) == ([1, 2, 3], [1, 3], [0])
    notes = read_source(tmp_path / "tileset.json").notes
    assert {
        "tileset.json names missing.glb, which is not there",
        "3.glb stands for finer tiles that are not there",
        "the tileset is not on the Earth: its axes are taken as east, north and up",
    } <= set(notes)


def tiles_of(folder: Path) -> list[Float64Array]:
    """Vertices of all glTF contents of a folder, by trimesh and z up."""
    found = []
    for file in sorted(folder.rglob("*.glb")) + sorted(folder.rglob("*.b3dm")):
        data = file.read_bytes()
        begin = 28 + sum(struct.unpack_from("<4I", data, 12)) if file.suffix == ".b3dm" else 0
        loaded = trimesh.load_scene(io.BytesIO(data[begin:]), file_type="glb")
        for mesh in loaded.dump():
            if hasattr(mesh, "faces"):
                found.append(turned(mesh.triangles.reshape(-1, 3)))
    return found


@pytest.mark.parametrize(
    "name", ["SparseImplicitOctree", "SparseImplicitQuadtree", "MetadataGranularities", "MultipleContents"]
)
def test_samples_of_3d_tiles_have_all_triangles_of_their_contents(shared_data: Path, name: str) -> None:
    folder = shared_data / "3d-tiles" / "1.1" / name

    read = read_source(folder / "tileset.json")

    corners = np.concatenate(tiles_of(folder))
    area = float(
        np.linalg.norm(np.cross(corners[1::3] - corners[::3], corners[2::3] - corners[::3]), axis=1).sum() / 2
    )
    assert read.origin is None
    if name != "MetadataGranularities":  # its tiles are turned and moved
        np.testing.assert_allclose(bounds(read), [corners.min(0), corners.max(0)], atol=1e-6)
    assert sum(each for _, each in measured(read).values()) == pytest.approx(area, rel=1e-6)


def test_samples_on_the_earth_are_where_own_arithmetic_has_them(shared_data: Path) -> None:
    lod = shared_data / "3d-tiles" / "1.0" / "TilesetWithDiscreteLOD"
    city = shared_data / "3d-tiles" / "1.0" / "TilesetWithRequestVolume" / "city"
    for folder, file, error in (
        (lod, "dragon_low.b3dm", 1.0),
        (lod, "dragon_medium.b3dm", 0.1),
        (city, "ll.b3dm", 0),
    ):
        read = read_source(folder / "tileset.json", Request(error_m=error))
        data = (folder / file).read_bytes()
        sizes = struct.unpack_from("<4I", data, 12)
        table = json.loads(data[28 : 28 + sizes[0]])
        loaded = trimesh.load_scene(io.BytesIO(data[28 + sum(sizes) :]), file_type="glb")
        corners = np.concatenate([turned(mesh.triangles.reshape(-1, 3)) for mesh in loaded.dump()])
        root = json.loads((folder / "tileset.json").read_text())["root"]
        matrix = np.reshape(root.get("transform", np.eye(4).reshape(-1)), (4, 4)).T
        earth = (corners + table.get("RTC_CENTER", [0, 0, 0])) @ matrix[:3, :3].T + matrix[:3, 3]
        assert read.origin is not None
        there = read.origin.latitude_deg, read.origin.longitude_deg
        expected = (earth - ecef(*there, read.origin.altitude_m)) @ east_north_up(*there).T
        pieces = [p.mesh.vertices for p in read.pieces.values() if p.file == file]
        got = np.concatenate(pieces)
        np.testing.assert_allclose([got.min(0), got.max(0)], [expected.min(0), expected.max(0)], atol=1e-3)


@pytest.mark.parametrize("binary", [False, True])
def test_implicit_tiles_of_two_subtrees(binary: bool, tmp_path: Path) -> None:
    implicit = {
        "subdivisionScheme": "QUADTREE",
        "subtreeLevels": 2,
        "availableLevels": 3,
        "subtrees": {"uri": "s/{level}.{x}.{y}"},
    }
    root = tile(4, "t/{level}-{x}-{y}.glb", refine="ADD", implicitTiling=implicit)
    (tmp_path / "tileset.json").write_text(tileset(root))
    (tmp_path / "s").mkdir()
    (tmp_path / "t").mkdir()
    places = {"1-1-0": (1, -8, 0), "2-3-1": (6, -4, 0)}
    for name, place in places.items():
        (tmp_path / "t" / f"{name}.glb").write_bytes(content(place))
    # Bits in the order of Morton: the root, then (0, 0), (1, 0), (0, 1), (1, 1).
    heads: dict[str, tuple[dict[str, Any], bytes]] = {
        "0.0.0": (
            {
                "tileAvailability": {"bitstream": 0},
                "contentAvailability": [{"bitstream": 1}],
                "childSubtreeAvailability": {"bitstream": 2},
                "bufferViews": [
                    {"buffer": 0, "byteOffset": i * 8, "byteLength": 2 if i == 2 else 1} for i in range(3)
                ],
            },
            struct.pack("<QQQ", 0b00101, 0b00100, 1 << 0b0111),
        ),
        "2.3.1": (
            {
                "tileAvailability": {"constant": 1},
                "contentAvailability": [{"bitstream": 0}],
                "childSubtreeAvailability": {"constant": 0},
                "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": 1}],
            },
            struct.pack("<Q", 1),
        ),
    }
    for name, (head, bits) in heads.items():
        uri = {} if binary else {"uri": f"{name}.bin"}
        text = json.dumps(head | {"buffers": [{"byteLength": len(bits), **uri}]}).encode()
        if binary:
            (tmp_path / "s" / name).write_bytes(
                struct.pack("<4sIQQ", b"subt", 1, len(text), len(bits)) + text + bits
            )
        else:
            (tmp_path / "s" / name).write_bytes(text)
            (tmp_path / "s" / f"{name}.bin").write_bytes(bits)

    read = read_source(tmp_path / "tileset.json")

    assert {tuple(piece.mesh.vertices.min(0).round(6)) for piece in read.pieces.values()} == set(
        places.values()
    )
    boxed = read_source(tmp_path / "tileset.json", Request(box_m=(0, -9, 4, -6)))
    assert [each["file"] for each in boxed.sources] == ["tileset.json", "1-1-0.glb"]
    coarse = read_source(tmp_path / "tileset.json", Request(error_m=2))
    assert {tuple(piece.mesh.vertices.min(0).round(6)) for piece in coarse.pieces.values()} == {(1, -8, 0)}


# --- Mitsuba ------------------------------------------------------------------------------------------------


def test_mitsuba_with_what_blender_and_people_write(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    corners, polygons = l_prism()
    obj = "\n".join(
        [
            *(f"v {x} {y} {z}" for x, y, z in corners),
            *("f " + " ".join(str(i + 1) for i in p) for p in polygons),
        ]
    )
    (tmp_path / "meshes" / "L.obj").write_text(obj)
    (tmp_path / "meshes" / "box.ply").write_bytes(trimesh.creation.box((1, 2, 3)).export(file_type="ply"))
    (tmp_path / "meshes" / "empty.ply").write_bytes(ply(Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))))

    def shape(kind: str, name: str, material: str, file: str = "", more: str = "") -> str:
        named = f'<string name="filename" value="$folder/{file}"/>' if file else ""
        return (
            f'<shape type="{kind}" id="mesh-{name}">{named}{more}<ref id="{material}" name="bsdf"/></shape>'
        )

    mirror = '<transform name="to_world"><scale x="-1" y="2"/></transform>'
    (tmp_path / "s.xml").write_text(
        f"""<scene version="3.5.0"><default name="folder" value="meshes"/><integrator type="path"/>
        <bsdf type="twosided" id="mat-itu_brick.002"><bsdf type="principled">
          <rgb name="base_color" value="0.5 0.25 0"/></bsdf></bsdf>
        <bsdf type="diffuse" id="itu_brick"/><bsdf type="diffuse" id="mat-itu_brick"/>
        <bsdf type="principled" id="mat-Window pane"/>
        <bsdf type="radio-material" id="own"><float name="relative_permittivity" value="3"/>
          <float name="conductivity" value="0.1"/><float name="thickness" value="0.3"/>
          <float name="scattering_coefficient" value="0.4"/>
          <string name="scattering_pattern" value="lambertian"/></bsdf>
        {shape("obj", "L", "itu_brick", "L.obj")}
        {shape("ply", "box", "own", "box.ply", '<transform name="to_world"><scale value="2"/></transform>')}
        {shape("ply", "nothing", "own", "empty.ply")}
        {shape("rectangle", "pane", "mat-Window pane")}
        {shape("cube", "cube", "mat-itu_brick.002", more=mirror)}
        </scene>"""
    )

    read = read_source(tmp_path / "s.xml")

    got = measured(read)
    assert got["l"] == pytest.approx((320, 328))
    assert got["box"] == pytest.approx((48, 88))
    assert got["pane"] == pytest.approx((0, 4))
    assert got["cube"] == pytest.approx((16, 40))
    materials = {name: read.materials[piece.material] for name, piece in read.pieces.items()}
    assert materials["box"].constants == (3, 0.1)
    assert (materials["box"].thickness_m, materials["box"].scattering_coefficient) == (0.3, 0.4)
    assert [materials[name].itu_material for name in ("l", "pane", "cube")] == ["brick", "glass", "brick"]
    assert materials["cube"].colour == (0.5, 0.25, 0)
    assert "without faces: 'nothing' of s.xml: left out" in read.notes
