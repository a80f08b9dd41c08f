"""Maps of OpenStreetMap: heights, roofs, parts, materials, roads beside buildings, and damaged files."""

from __future__ import annotations

import json
import struct
import zlib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from caviar_clients.cli.main import app
from caviar_protocol.errors import AssetError
from caviar_space.imported_scenes import Georeference, ImportedScene, Piece, cut_to_box
from caviar_space.meshes import Mesh, box, joined
from caviar_space.sources import Request, read_source
from caviar_space.sources.map_files import metres
from caviar_space.volumes import outward

pytest.importorskip("osmium")
shapely = pytest.importorskip("shapely")

HERE = Georeference(latitude_deg=60.17, longitude_deg=24.94, projection="tmerc")
Tags = dict[str, str]


class MapFile:
    """Map that is written by hand, in metres about `HERE`."""

    def __init__(self) -> None:
        self.root = ElementTree.Element("osm", version="0.6")
        self.nodes: dict[tuple[float, float], int] = {}
        self.count = 1000

    def node(self, x: float, y: float, **tags: str) -> int:
        if (x, y) not in self.nodes:
            latitude, longitude, _ = HERE.to_wgs84(x, y)
            self.nodes[x, y] = len(self.nodes) + 1
            node = ElementTree.Element(
                "node", id=str(self.nodes[x, y]), lat=f"{latitude:.9f}", lon=f"{longitude:.9f}"
            )
            self._tag(node, tags)
            self.root.insert(len(self.nodes) - 1, node)
        return self.nodes[x, y]

    def _tag(self, element: ElementTree.Element, tags: Tags) -> None:
        for key, value in tags.items():
            ElementTree.SubElement(element, "tag", k=key.replace("__", ":"), v=value)

    def way(self, *points: tuple[float, float], **tags: str) -> int:
        self.count += 1
        refs = [self.node(x, y) for x, y in points]
        way = ElementTree.SubElement(self.root, "way", id=str(self.count))
        for ref in refs:
            ElementTree.SubElement(way, "nd", ref=str(ref))
        self._tag(way, tags)
        return self.count

    def block(self, x: float, y: float, wide: float, deep: float, **tags: str) -> int:
        corners = [(x, y), (x + wide, y), (x + wide, y + deep), (x, y + deep), (x, y)]
        return self.way(*corners, **tags)

    def relation(self, outer: int, inner: int, **tags: str) -> None:
        relation = ElementTree.SubElement(self.root, "relation", id="1")
        for way, role in ((outer, "outer"), (inner, "inner")):
            ElementTree.SubElement(relation, "member", type="way", ref=str(way), role=role)
        self._tag(relation, {"type": "multipolygon", **tags})

    def write(self, file: Path) -> Path:
        ElementTree.ElementTree(self.root).write(file, encoding="utf-8", xml_declaration=True)
        return file


def town() -> MapFile:
    made = MapFile()
    made.relation(
        made.block(-60, 20, 40, 30), made.block(-50, 30, 20, 10), building="yes", building__levels="4"
    )
    made.block(20, 20, 20, 10, building="yes", height="9")  # w1003, of which a part is higher
    made.block(20, 20, 10, 10, building__part="yes", height="20 m")
    made.block(60, 20, 16, 8, building="house", height="10,5", roof__shape="gabled", roof__height="3",
               building__material="brick", roof__material="copper")  # fmt: skip
    made.block(60, 40, 10, 10, building="yes")
    made.block(60, -60, 8, 20, building="yes", building__levels="2", roof__shape="hipped")  # w1007
    made.block(60, 60, 8, 8, building="roof", roof__material="glass")
    made.block(-20, -60, 40, 30, natural="water")
    made.node(-5, 12, natural="tree", height="12")
    made.way((-80, 12), (-60, 12), natural="tree_row")
    made.way((-100, 0), (0, 0), (100, 0), highway="residential", name="Main Street")
    made.way((0, -100), (0, 0), (0, 100), highway="residential")
    made.way((25, -90), (25, 90), highway="residential")  # through the building with a part
    made.way((-100, 35), (100, 35), highway="residential", tunnel="yes")
    return made


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> ImportedScene:
    file = town().write(tmp_path_factory.mktemp("map") / "town.osm")
    return read_source(file, Request(origin=HERE, box_m=(-90.0, -95.0, 95.0, 95.0)))


def volume(*meshes: Mesh) -> float:
    """Volume within meshes that are closed together [m³]."""
    corners = outward(Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([m.faces + sum(len(n.vertices) for n in meshes[:i]) for i, m in enumerate(meshes)]),
    ))  # fmt: skip
    a, b, c = np.moveaxis(corners, 1, 0)
    return float((np.cross(a, b) * c).sum() / 6)


@pytest.mark.parametrize(
    ("name", "solid_m3", "low", "high"),
    [
        ("building-r1", (40 * 30 - 20 * 10) * 12, 0.0, 12.0),  # four storeys about a courtyard
        ("building-w1003", 10 * 10 * 9, 0.0, 9.0),  # what its part leaves
        ("building-w1004", 10 * 10 * 20, 0.0, 20.0),
        ("building-w1006", 10 * 10 * 9.75, 0.0, 9.75),  # the median of 9, 9, 10.5 and 12
        ("building-w1007", 8 * 20 * 6 + 8 * 3 * (12 / 2 + 8 / 3), 0.0, 9.0),  # two storeys and a hipped roof
    ],
)
def test_bodies_have_the_heights_and_footprints_of_the_map(
    scene: ImportedScene, name: str, solid_m3: float, low: float, high: float
) -> None:
    mesh = scene.pieces[name].mesh
    assert (mesh.vertices[:, 2].min(), mesh.vertices[:, 2].max()) == pytest.approx((low, high))
    assert volume(mesh) == pytest.approx(solid_m3, rel=2e-3)  # OSM: 1e-7°


@pytest.mark.parametrize(
    ("levels", "outline_m3"),
    [
        ("2", 20 * 10 * 6),  # of the storeys below the part
        ("5", 10 * 10 * 15),  # of the whole: below the part is a passage
    ],
)
def test_a_part_stands_on_an_outline_that_is_lower(levels: str, outline_m3: float, tmp_path: Path) -> None:
    made = MapFile()
    made.block(20, 20, 20, 10, building="yes", building__levels=levels)
    made.block(20, 20, 10, 10, building__part="yes", building__levels="5", building__min_level="2")
    pieces = read_source(made.write(tmp_path / "town.osm"), Request(origin=HERE)).pieces
    assert volume(pieces["building-w1001"].mesh) == pytest.approx(outline_m3, rel=2e-3)
    assert volume(pieces["building-w1002"].mesh) == pytest.approx(10 * 10 * 9, rel=2e-3)


def test_a_roof_without_walls_is_one_face(scene: ImportedScene) -> None:
    mesh = scene.pieces["building-w1008"].mesh
    assert scene.pieces["building-w1008"].material == "glass"
    assert set(mesh.vertices[:, 2]) == {4.5}
    assert len(mesh.faces) == 2


def test_a_gable_stands_over_the_shorter_sides_and_has_its_own_material(scene: ImportedScene) -> None:
    walls, roof = scene.pieces["building-w1005"], scene.pieces["building-w1005-roof"]
    assert (walls.material, roof.material) == ("brick", "metal")
    assert volume(walls.mesh, roof.mesh) == pytest.approx(16 * 8 * 7.5 + 16 * 8 * 3 / 2, rel=2e-3)
    ridge = roof.mesh.vertices[roof.mesh.vertices[:, 2] > 10.4]
    assert np.ptp(ridge[:, 0]) == pytest.approx(16.0, abs=0.01)
    assert np.ptp(ridge[:, 1]) == pytest.approx(0.0, abs=0.01)


def test_trees_are_closed_volumes_and_water_lies_in_the_ground(scene: ImportedScene) -> None:
    crowns = scene.pieces["foliage-trees"]
    assert crowns.kind == "foliage"
    assert volume(crowns.mesh) == pytest.approx(np.pi / 6 * 25 * (8.4 + 3 * 7.0), rel=1e-3)  # one, and a row
    flat = {name: scene.pieces[name] for name in ("ground", "water")}
    areas = {name: shapely.polygons(p.mesh.vertices[p.mesh.faces][..., :2]) for name, p in flat.items()}
    assert shapely.area(areas["water"]).sum() == pytest.approx(1200.0, rel=2e-3)
    assert not shapely.intersection(
        shapely.union_all(areas["water"]), shapely.union_all(areas["ground"])
    ).area
    assert [flat[name].material for name in flat] == ["concrete", "wet_ground"]


def test_roads_are_in_the_axes_of_the_scene_and_none_is_in_a_building(scene: ImportedScene) -> None:
    root = ElementTree.fromstring(scene.files["sumo/net.net.xml"])  # noqa: S314 - SUMO wrote it
    assert root.find("location").get("netOffset") == "0.000,0.000"  # type: ignore[union-attr]
    lanes = [
        (lane.get("allow") == "pedestrian", [point.split(",")[:2] for point in lane.get("shape", "").split()])
        for edge in root.iter("edge") if edge.get("function") is None for lane in edge.iter("lane")
    ]  # fmt: skip
    lanes = [(foot, shapely.LineString(np.array(points, float))) for foot, points in lanes]
    main = [line for foot, line in lanes if not foot and abs(np.array(line.coords)[:, 1]).max() < 3]
    assert max(line.bounds[2] for line in main) == pytest.approx(95.0, abs=0.01)  # the border of the box
    assert {abs(round(line.coords[0][1], 2)) for line in main} == {1.6}  # a lane of 3.2 m on either side
    assert any(foot for foot, _ in lanes)
    solid = shapely.union_all([shapely.box(20, 20, 40, 30), shapely.box(-60, 20, -20, 50)])
    assert not any(line.buffer(1.0).intersects(solid) for _, line in lanes)
    assert any("1 × road in a tunnel" in note for note in scene.notes)
    assert any("segment of a road through a building" in note for note in scene.notes)


def test_the_sea_is_to_the_right_of_a_coast(tmp_path: Path) -> None:
    made = MapFile()
    made.block(-60, 20, 10, 10, building="yes")
    made.way(
        (-80, -50), (0, -40), (80, -50), natural="coastline"
    )  # its ends are lost with an extract's border
    file = made.write(tmp_path / "coast.osm")
    scene = read_source(file, Request(origin=HERE, box_m=(-100.0, -100.0, 100.0, 100.0)))
    sea = scene.pieces["water"].mesh.vertices
    assert sea[:, 1].max() == pytest.approx(-40.0, abs=0.02)
    assert sea[:, 1].min() == pytest.approx(-100.0, abs=0.02)


def test_geojson_has_the_same_tags(tmp_path: Path) -> None:
    def at(*points: tuple[float, float]) -> list[list[float]]:
        return [[lon, lat] for lat, lon, _ in (HERE.to_wgs84(x, y) for x, y in points)]

    features = [
        ({"building": "yes", "height": 7}, "Polygon",
         [at((10, 10), (20, 10), (20, 30), (10, 30), (10, 10))]),
        ({"highway": "residential"}, "LineString", at((-100, 0), (0, 0), (100, 0))),
        ({"highway": "residential"}, "LineString", at((0, 0), (0, 100))),
        ({"natural": "tree"}, "Point", at((5, 5))[0]),
    ]  # fmt: skip
    file = tmp_path / "town.geojson"
    collection = {"type": "FeatureCollection", "features": [
        {"type": "Feature", "properties": tags, "geometry": {"type": kind, "coordinates": places}}
        for tags, kind, places in features
    ]}  # fmt: skip
    file.write_text(json.dumps(collection))
    scene = read_source(file, Request(origin=HERE))
    assert volume(scene.pieces["building-f0"].mesh) == pytest.approx(10 * 20 * 7, rel=2e-3)
    net = ElementTree.fromstring(scene.files["sumo/net.net.xml"])  # noqa: S314 - SUMO wrote it
    assert any(junction.get("type") == "priority" for junction in net.iter("junction"))  # they meet


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("12", 12.0), ("10,5", 10.5), ("12.13 m", 12.13), ("100 ft", 30.48), ("-2", -2.0),
        ("33'6\"", 10.2108), ("NaN", None), ("inf", None), ("12 storeys", None), ("", None),
        ("1e400", None), ("9" * 400, None),
    ],
)  # fmt: skip
def test_lengths_of_tags(text: str, found: float | None) -> None:
    assert metres(text) == (found if found is None else pytest.approx(found))


XML = '<?xml version="1.0"?>\n<osm version="0.6">{}</osm>'
SQUARE = "".join(
    f'<node id="{i}" lat="{60.17 + y}" lon="{24.94 + x}"/>'
    for i, (x, y) in enumerate([(0, 0), (0.0004, 0), (0.0004, 0.0002), (0, 0.0002)], 1)
)


def house(tags: Tags, refs: str = "1 2 3 4 1") -> str:
    inner = "".join(f'<nd ref="{ref}"/>' for ref in refs.split())
    inner += "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())
    return f'<way id="7">{inner}</way>'


def blob(kind: bytes, size: int | None = None, data: bytes = b"") -> bytes:
    """Blob of a PBF file, whose header may claim another size than the data has."""
    raw = b"\x1a" + varint(len(z := zlib.compress(data))) + z + b"\x10" + varint(len(data))
    header = b"\x0a" + varint(len(kind)) + kind + b"\x18" + varint(len(raw) if size is None else size)
    return struct.pack(">I", len(header)) + header + raw


def varint(value: int) -> bytes:
    found = b""
    while value > 127:
        found, value = found + bytes([value & 127 | 128]), value >> 7
    return found + bytes([value])


def feature(geometry: object, **properties: object) -> bytes:
    given = {"type": "Feature", "properties": {"building": "yes", **properties}, "geometry": geometry}
    return json.dumps({"type": "FeatureCollection", "features": [given]}).encode()


ENTITIES = (
    '<?xml version="1.0"?><!DOCTYPE osm [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;&a;">'
    '<!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;&b;&b;">]><osm version="0.6"><node id="1" lat="60" lon="24">'
    '<tag k="building" v="&c;"/></node></osm>'
)
HEADER = blob(b"OSMHeader", data=b"\x22\x0eOsmSchema-V0.6")
DAMAGED: dict[str, bytes] = {
    "empty.osm": b"",
    "text.osm": b"no map at all",
    "cut.osm": XML.format(SQUARE + house({"building": "yes"})).encode()[:300],
    "other.osm": b"<gpx><trk/></gpx>",
    "nothing.osm": XML.format("").encode(),
    "entities.osm": ENTITIES.encode(),
    "latitude.osm": XML.format('<node id="1" lat="north" lon="24"/>').encode(),
    "huge.osm": XML.format('<node id="1" lat="1e300" lon="24"/>' + house({"building": "yes"}, "1")).encode(),
    "id.osm": XML.format('<node id="x" lat="60" lon="24"/>').encode(),
    "lost.osm": XML.format(house({"building": "yes"})).encode(),
    "bytes.osm": XML.format(SQUARE).encode().replace(b"<node", b"<n\xff\xfeode", 1),
    "empty.osm.pbf": b"",
    "text.osm.pbf": b"no map at all",
    "cut.osm.pbf": HEADER[:-5],
    "claim.osm.pbf": struct.pack(">I", 0x7FFFFFFF) + b"\x0a\x09OSMHeader",
    "blob.osm.pbf": blob(b"OSMHeader", size=0x7FFFFFF0),
    "kind.osm.pbf": blob(b"OSMNonsense"),
    "zlib.osm.pbf": HEADER + blob(b"OSMData", data=b"\xff" * 40),
    "flipped.osm.pbf": HEADER[:20] + bytes([HEADER[20] ^ 255]) + HEADER[21:],
    "schema.osm.pbf": blob(b"OSMHeader", data=b"\x22\x07Unknown"),
    "nothing.osm.pbf": HEADER,
    "empty.geojson": b"",
    "cut.geojson": feature({"type": "Point", "coordinates": [24, 60]})[:-20],
    "nested.geojson": b'{"type": "FeatureCollection", "features": ' + b"[" * 100_000,
    "array.geojson": b"[1, 2]",
    "nan.geojson": feature({"type": "Point", "coordinates": [24, float("nan")]}),
    "huge.geojson": feature({"type": "Polygon", "coordinates": [[[1e30, 0], [1, 0], [1, 1], [1e30, 0]]]}),
    "metres.geojson": feature({"type": "Point", "coordinates": [385e3, 667e4]}, natural="tree"),
    "kind.geojson": feature({"type": "Circle", "coordinates": [24, 60]}),
    "words.geojson": feature({"type": "Point", "coordinates": ["east", "north"]}),
    "short.geojson": feature({"type": "Polygon", "coordinates": [[[24, 60], [24.1, 60]]]}),
    "none.geojson": feature(None),
    "features.geojson": b'{"type": "FeatureCollection", "features": {"a": 1}}',
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_maps_are_refused_by_name(name: str, tmp_path: Path) -> None:
    file = tmp_path / name
    file.write_bytes(DAMAGED[name])
    with pytest.raises(AssetError, match=name.replace(".", r"\.")) as refused:
        read_source(file)
    assert len(str(refused.value)) < 600


CROSSED = "1 3 2 4 1"
ROAD = '<way id="9"><nd ref="1"/><nd ref="2"/><nd ref="99"/><tag k="highway" v="residential"/></way>'
# A line of a few metres in the middle of two trees that are far apart.
COAST = (
    '<node id="10" lat="60.16" lon="24.92"><tag k="natural" v="tree"/></node>'
    '<node id="11" lat="60.18" lon="24.96"><tag k="natural" v="tree"/></node>'
    '<node id="5" lat="60.17006" lon="24.9401"/><node id="6" lat="60.17008" lon="24.9402"/>'
    '<way id="8"><nd ref="5"/><nd ref="6"/><tag k="natural" v="coastline"/></way>'
)


@pytest.mark.parametrize(
    ("content", "note"),
    [
        (house({"building": "yes", "height": "NaN"}), "1 × height that cannot be read"),
        (house({"building": "yes", "height": "-3"}), "1 × height that cannot be read"),
        (house({"building": "yes", "height": "1e9"}), "1 × height that cannot be read"),
        (house({"building": "yes", "height": "6", "min_height": "8"}), "1 × min_height that is not below"),
        (house({"building": "yes", "roof:shape": "onion"}), "1 × roof that is flat here"),
        (
            house({"building": "yes", "building:material": "cheese"}),
            "1 × material 'cheese' that no table has",
        ),
        (house({"building": "yes"}, CROSSED) + ROAD, "1 × building without a closed outline"),
        (house({"building": "yes"}, "1 2 3 99 1") + ROAD, "1 × building without a closed outline"),
        (house({"building": "yes"}) + ROAD, "1 × node of a road that is not in the file"),
        (house({"building": "yes"}) + COAST, "1 × coast that ends within the box"),
        (house({"building": "yes", "height": "5"}), "no network of roads: the map has none"),
    ],
)
def test_oddities_of_real_maps_are_counted(content: str, note: str, tmp_path: Path) -> None:
    file = tmp_path / "odd.osm"
    file.write_text(XML.format(SQUARE + content))
    found = read_source(file)
    assert any(text.startswith(note) for text in found.notes), found.notes
    assert all(np.isfinite(piece.mesh.vertices).all() for piece in found.pieces.values())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--box", "24.9,60.1"], "write W,S,E,N"),
        (["--box", "25,60.1,24,60.2"], "lower corner comes first"),
        (["--box", "1,2,3,4", "--box-m", "1,2,3,4"], "write one of them"),
        (["--box", "10,10,11,11"], "town.osm has neither buildings nor roads within the box"),
        (["--origin", "60"], "--origin 60: write LAT,LON"),
        (["--origin", "91,0"], "--origin 91,0: beyond 90° and 180°"),
        (["--box", "24,89,25,95"], "--box 24,89,25,95: beyond 180° and 90°"),
        (["--origin", "-60,24"], "km from the origin, of at most 200"),
        (["--material", "butter"], "ITU-R P.2040 has no material 'butter'"),
        (["--materials", "copper=cheese"], "--materials copper=cheese"),
        (["--format", "shapefile"], "no format of scenes 'shapefile'"),
    ],
)
def test_wrong_options_are_refused(arguments: list[str], words: str, tmp_path: Path) -> None:
    file = town().write(tmp_path / "town.osm")
    out = ["--out", str(tmp_path / "scene")]
    with pytest.raises(AssetError, match=words.replace("(", r"\(")):
        CliRunner().invoke(app, ["scene", "import", str(file), *out, *arguments], catch_exceptions=False)
    assert not (tmp_path / "scene").exists()


def tiff(file: Path, heights: np.ndarray, west: float, north: float, step: float) -> Path:
    """GeoTIFF of WGS84 whose values are those of points."""
    image = pytest.importorskip("PIL.Image")
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    tags = ImageFileDirectory_v2()
    for tag, kind, value in (
        (33550, 12, (step, step, 0.0)), (33922, 12, (0.0, 0.0, 0.0, west, north, 0.0)),
        (34735, 3, (1, 1, 0, 3, 1024, 0, 1, 2, 1025, 0, 1, 2, 2048, 0, 1, 4326)),
    ):  # fmt: skip
        tags.tagtype[tag] = kind
        tags[tag] = value
    image.fromarray(heights.astype(np.float32)).save(file, tiffinfo=tags)
    return file


def dted(file: Path, heights: np.ndarray) -> Path:
    """DTED of 60 to 61° north and 24 to 25° east, whose step is 1/(n − 1)°."""
    rows, columns = heights.shape
    step = f"{36000 // (columns - 1):04d}"
    header = f"UHL10240000E0600000N{step}{step}".ljust(47) + f"{columns:04d}{rows:04d}"
    encoded = np.where(heights < 0, 0x8000 | -heights.astype(int), heights.astype(int))
    records = b"".join(
        b"\xaa" + bytes(7) + encoded[::-1, column].astype(">u2").tobytes() + bytes(4)
        for column in range(columns)
    )
    file.write_bytes(header.ljust(80).encode() + bytes(648 + 2700) + records)
    return file


def test_grids_of_heights_have_the_places_of_their_values(tmp_path: Path) -> None:
    from caviar_space.sources.height_grids import read_heights

    rows, columns = np.mgrid[:11, :11]
    heights = 10.0 * (10 - rows) + columns - 3  # 100 m a degree northwards, 10 m eastwards
    for grid in (read_heights(tiff(tmp_path / "a.tif", heights, 24.0, 61.0, 0.1)),
                 read_heights(dted(tmp_path / "a.dt0", heights))):  # fmt: skip
        found = grid.at(np.array([24.0, 24.25, 25.0, 23.9]), np.array([60.0, 60.31, 61.0, 60.5]))
        np.testing.assert_allclose(found, [-3.0, 30.5, 107.0, np.nan], atol=1e-6)


def test_buildings_and_roads_stand_on_the_ground(tmp_path: Path) -> None:
    _, columns = np.mgrid[:60, :60]
    west, north, step = 24.935, 60.1725, 0.0002
    heights = 50.0 + 0.5 * columns  # a slope to the west of 0.5 m on 11 m
    grid = tiff(tmp_path / "slope.tif", heights, west, north, step)
    file = town().write(tmp_path / "town.osm")
    with pytest.raises(AssetError, match="squares of ground of 20 m within the box"):
        read_source(file, Request(origin=HERE, box_m=(-9e4, -9e4, 9e4, 9e4), heights=grid))
    made = read_source(file, Request(origin=HERE, box_m=(-90.0, -95.0, 95.0, 95.0), heights=grid))
    assert made.origin is not None
    slope = 0.5 / (made.origin.to_scene(60.17, west + step)[0] - made.origin.to_scene(60.17, west)[0])
    ground = made.pieces["ground"].mesh.vertices
    np.testing.assert_allclose(ground[:, 2], slope * (ground[:, 0] + 90.0), atol=0.02)
    house = made.pieces["building-w1004"].mesh.vertices
    assert np.ptp(house[:, 2]) == pytest.approx(20.0)
    assert house[:, 2].min() == pytest.approx(slope * (20 + 90), abs=0.02)
    _, _, altitude = made.origin.to_wgs84(20.0, 20.0, float(house[:, 2].min()))
    assert altitude == pytest.approx(50 + 0.5 * (made.origin.to_wgs84(20, 20)[1] - west) / step, abs=0.05)
    net = ElementTree.fromstring(made.files["sumo/net.net.xml"])  # noqa: S314 - SUMO wrote it
    points = [p.split(",") for lane in net.iter("lane") for p in lane.get("shape", "").split()]
    at = np.array([[*point, "0"][:3] for point in points], float)
    assert np.abs(at[:, 2] - slope * (at[:, 0] + 90.0)).max() < 0.6  # junctions are level


@pytest.mark.parametrize("name", ["text.tif", "grey.tif", "cut.dt1", "none.dt2", "grid.asc"])
def test_damaged_heights_are_refused(name: str, tmp_path: Path) -> None:
    from caviar_space.sources.height_grids import read_heights

    file = tmp_path / name
    if name == "cut.dt1":
        file.write_bytes(dted(file, np.zeros((5, 5))).read_bytes()[:-9])
    elif name == "grey.tif":
        pytest.importorskip("PIL.Image").new("L", (4, 4)).save(file)
    elif name != "none.dt2":
        file.write_text("no heights")
    with pytest.raises(AssetError, match=name):
        read_heights(file)


@pytest.mark.parametrize("source", ["overpass", "josm"])
def test_nodes_may_come_last_and_numbers_be_negative(
    source: str, tmp_path: Path, scene: ImportedScene
) -> None:
    root = town().root
    if source == "overpass":
        root[:] = sorted(root, key=lambda element: ("way", "relation", "node").index(element.tag))
    else:
        for element in root.iter():
            for key in ("id", "ref"):
                if key in element.attrib:
                    element.set(key, f"-{element.get(key)}")
    file = tmp_path / "town.osm"
    ElementTree.ElementTree(root).write(file)
    found = read_source(file, Request(origin=HERE, box_m=(-90.0, -95.0, 95.0, 95.0)))
    assert found.pieces.keys() == scene.pieces.keys()
    assert found.files == scene.files


@pytest.mark.parametrize("form", ["osm", "osm.pbf", "geojson"])
def test_maps_with_flipped_bytes_are_read_or_refused(form: str, tmp_path: Path) -> None:
    """Twenty-five files, each with four bytes that are others, or cut: a scene, or an error by name."""
    import osmium

    made = MapFile()
    made.block(0, 0, 20, 10, building="yes", height="9")
    made.block(0, 30, 20, 10, building="yes", building__levels="3")
    file = made.write(tmp_path / "whole.osm")
    if form == "geojson":
        square = [[24.94, 60.17], [24.941, 60.17], [24.941, 60.171], [24.94, 60.17]]
        (tmp_path / "whole.geojson").write_bytes(feature({"type": "Polygon", "coordinates": [square]}))
    elif form == "osm.pbf":
        with osmium.SimpleWriter(str(tmp_path / "whole.osm.pbf")) as writer:
            for thing in osmium.FileProcessor(str(file)):
                writer.add(thing)
    whole = (tmp_path / f"whole.{form}").read_bytes()
    assert read_source(tmp_path / f"whole.{form}").pieces
    rng = np.random.default_rng(3)
    refused = 0
    for number in range(25):
        data = bytearray(whole)
        for at in rng.integers(len(data), size=4):
            data[at] ^= int(rng.integers(1, 256))
        damaged = tmp_path / f"damaged.{form}"
        damaged.write_bytes(data[: int(rng.integers(len(data)))] if number % 5 == 0 else data)
        try:
            found = read_source(damaged)
        except AssetError as error:
            refused += damaged.name in str(error)
        else:
            assert all(np.isfinite(piece.mesh.vertices).all() for piece in found.pieces.values())
    assert refused > 5


def test_any_scene_is_cut_to_a_box() -> None:
    def piece(mesh: Mesh, kind: str) -> Piece:
        return Piece(mesh, "concrete", kind, "town.obj", 1)

    corners = [(-50.0, -50.0, 0.0), (90.0, -50.0, 0.0), (90.0, 90.0, 0.0)]
    two = joined([box((0, 10), (0, 10), (0, 9)), box((40, 50), (0, 10), (0, 9))])  # one mesh, two buildings
    scene = ImportedScene(name="town", pieces={
        "ground": piece(Mesh(np.array(corners), np.array([[0, 1, 2]], np.int32)), "ground"),
        "houses": piece(two, "building"),
        "beyond": piece(box((60, 70), (0, 10), (0, 9)), "building"),
        "edge": piece(box((24, 34), (0, 10), (0, 9)), "building"),  # its middle is within, its end is not
        "wood": piece(box((-40, 60), (-40, 60), (0, 9)), "foliage"),
    }, transmitters_m=[(0.0, 0.0, 5.0), (99.0, 0.0, 5.0)])  # fmt: skip
    cut_to_box(scene, (-20.0, -20.0, 30.0, 30.0))
    assert list(scene.pieces) == ["ground", "houses", "edge", "wood"]
    assert volume(scene.pieces["houses"].mesh) == pytest.approx(900.0)
    assert volume(scene.pieces["edge"].mesh) == pytest.approx(900.0)
    assert volume(scene.pieces["wood"].mesh) == pytest.approx(90_000.0)  # a volume stays closed
    ground = scene.pieces["ground"].mesh
    inside = shapely.polygons(np.array(corners)[:, :2]) & shapely.box(-20, -20, 30, 30)
    parts = shapely.polygons(ground.vertices[ground.faces][..., :2])
    assert shapely.area(parts).sum() == pytest.approx(inside.area)
    assert shapely.union_all(parts).symmetric_difference(inside).area < 1e-6
    assert scene.transmitters_m == [(0.0, 0.0, 5.0)]
    assert "1 of 5 pieces outside of the box: left out" in scene.notes
    with pytest.raises(AssetError, match="nothing of the 4 pieces of town"):
        cut_to_box(scene, (500.0, 500.0, 510.0, 510.0))


def test_netconvert_that_fails_is_named_with_its_last_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sumo = pytest.importorskip("sumo")
    program = tmp_path / "bin" / "netconvert"
    program.parent.mkdir()
    program.write_text("#!/bin/sh\necho 'Error: no edges left' >&2\nexit 1\n")
    program.chmod(0o755)
    (tmp_path / "data").symlink_to(Path(sumo.SUMO_HOME) / "data")
    monkeypatch.setattr(sumo, "SUMO_HOME", str(tmp_path))
    with pytest.raises(AssetError, match="netconvert makes no network of the roads: Error: no edges left"):
        read_source(town().write(tmp_path / "town.osm"), Request(origin=HERE))
