"""Damaged files of scenes: each is refused by its name, or read with finite geometry."""

from __future__ import annotations

import io
import json
import random
import re
import shutil
import struct
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scene_builders import SQUARE, b3dm, boxes, content, glb, surface, tile, tileset

from caviar_protocol.errors import AssetError, SetupError
from caviar_space.sources import READERS, read_source

trimesh = pytest.importorskip("trimesh")
ezdxf = pytest.importorskip("ezdxf")
pytest.importorskip("pyproj")
pytest.importorskip("DracoPy")

FORMS = (
    "glb", "gltf", "draco", "obj", "ply", "stl", "text", "dxf", "cityjson", "3d-tiles", "implicit", "mitsuba",
)  # fmt: skip


def samples(folder: Path) -> dict[str, Path]:
    """A small valid file of each format, in a folder of its own."""
    made = {}
    for name in FORMS:
        (folder / name).mkdir()
        made[name] = folder / name / f"a.{name}"
    scene = boxes()
    made["glb"].write_bytes(trimesh.exchange.gltf.export_glb(scene))
    made["draco"] = made["draco"].with_suffix(".glb")
    made["draco"].write_bytes(trimesh.exchange.gltf.export_glb(scene, extension_draco=True))
    made["gltf"].write_bytes(
        trimesh.exchange.gltf.export_gltf(scene, merge_buffers=True, embed_buffers=True)["model.gltf"]
    )
    made["text"] = made["text"].with_suffix(".stl")
    mesh = trimesh.creation.box((1, 2, 3))
    for name, form in (("obj", "obj"), ("ply", "ply"), ("stl", "stl"), ("text", "stl_ascii")):
        mesh.export(made[name], file_type=form)
    drawing = ezdxf.new("R12")
    drawing.modelspace().add_3dface([(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0)])
    drawing.saveas(made["dxf"])
    city = SQUARE | {
        "CityObjects": {
            "a": {
                "type": "Building",
                "geometry": [surface("MultiSurface", 1, [[[0, 1, 2, 3], [4, 5, 6, 7]]])],
            }
        }
    }
    made["cityjson"] = made["cityjson"].with_name("a.city.json")
    made["cityjson"].write_text(json.dumps(city))
    made["3d-tiles"] = made["3d-tiles"].with_name("tileset.json")
    made["3d-tiles"].write_text(tileset(tile(1, "a.b3dm")))
    made["3d-tiles"].with_name("a.b3dm").write_bytes(b3dm(content((0, 0, 0)), {"BATCH_LENGTH": 0}))
    implicit = {
        "subdivisionScheme": "OCTREE",
        "subtreeLevels": 1,
        "availableLevels": 1,
        "subtrees": {"uri": "a.subtree"},
    }
    made["implicit"] = made["implicit"].with_name("tileset.json")
    made["implicit"].write_text(tileset(tile(1, "a.glb", implicitTiling=implicit)))
    head = json.dumps(
        {f"{what}Availability": {"constant": 1} for what in ("tile", "childSubtree")}
        | {
            "contentAvailability": [{"bitstream": 0}],
            "buffers": [{"byteLength": 8}],
            "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": 1}],
        }
    ).encode()
    made["implicit"].with_name("a.subtree").write_bytes(
        struct.pack("<4sIQQ", b"subt", 1, len(head), 8) + head + struct.pack("<Q", 1)
    )
    made["implicit"].with_name("a.glb").write_bytes(content((0, 0, 0)))
    made["mitsuba"] = made["mitsuba"].with_name("s.xml")
    made["mitsuba"].write_text(
        '<scene version="3.5.0"><bsdf type="diffuse" id="itu_brick"/>'
        '<shape type="ply" id="mesh-a"><string name="filename" value="a.ply"/>'
        '<ref id="itu_brick" name="bsdf"/></shape></scene>'
    )
    mesh.export(made["mitsuba"].with_name("a.ply"))
    return made


def damaged(data: bytes, draw: random.Random) -> bytes:
    """Content with one of six damages."""
    at, length = draw.randrange(len(data)), draw.randrange(1, 60)
    numbers = list(re.finditer(rb"-?\d+(\.\d+)?", data))
    match draw.randrange(6 if numbers else 5):
        case 0:
            return data[:at]
        case 1:
            return data[:at] + bytes([draw.randrange(256)]) + data[at + 1 :]
        case 2:
            return data[:at] + b"\xff\xff\xff\x7f" + data[at + 4 :]
        case 3:
            return data[:at] + data[at + length :]
        case 4:
            return data[:at] + data[at : at + length] * 2 + data[at + length :]
    number = draw.choice(numbers)
    wrong = draw.choice(
        [b"-1", b"2147483647", b"99999999999999999999", b"1e400", b"NaN", b"null", b'"x"', b"[]"]
    )
    return data[: number.start()] + wrong + data[number.end() :]


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return samples(tmp_path_factory.mktemp("originals"))


@pytest.fixture
def sample(request: pytest.FixtureRequest, originals: dict[str, Path], tmp_path: Path) -> Path:
    """A copy of a format's file, with what lies beside it."""
    file = originals[request.param]
    shutil.copytree(file.parent, tmp_path / "copy")
    return tmp_path / "copy" / file.name


@pytest.mark.parametrize("sample", FORMS, indirect=True)
def test_damaged_files_are_read_or_refused_by_name(sample: Path) -> None:
    file = sample
    assert read_source(file).pieces
    files = sorted(file.parent.iterdir())
    whole = {each: each.read_bytes() for each in files}
    refused = 0
    for number in range(60):
        draw = random.Random(number)
        wrong = draw.choice(files)
        wrong.write_bytes(damaged(whole[wrong], draw))
        said = ""
        try:
            read = read_source(file)
        except AssetError as error:
            said = str(error)
            refused += 1
        else:
            assert all(np.isfinite(piece.mesh.vertices).all() for piece in read.pieces.values())
        assert not said or (str(file.parent) in said and len(said) < 600)
        wrong.write_bytes(whole[wrong])
    assert refused >= 20


def replaced(old: str, new: str) -> Callable[[bytes], bytes]:
    def change(data: bytes) -> bytes:
        assert re.search(old.encode(), data)
        return re.sub(old.encode(), new.encode(), data, count=1)

    return change


def in_glb(old: str, new: str) -> Callable[[bytes], bytes]:
    """Change the JSON of a GLB, and its length."""

    def change(data: bytes) -> bytes:
        size = struct.unpack_from("<I", data, 12)[0]
        return glb(json.loads(replaced(old, new)(data[20 : 20 + size])), data[28 + size :])

    return change


def claimed(at: int, kind: str = "<I", value: int = 1 << 31) -> Callable[[bytes], bytes]:
    """Write a count of 2 Gi into a header."""
    return lambda data: data[:at] + struct.pack(kind, value) + data[at + struct.calcsize(kind) :]


def nested_blocks(entities: int) -> bytes:
    """DXF whose blocks hold ten of the next, eight deep, or one that holds itself."""
    drawing = ezdxf.new()
    for level in range(8 if entities else 1):
        block = drawing.blocks.new(f"b{level}")
        if level or not entities:
            for _ in range(entities or 1):
                block.add_blockref(f"b{max(level - 1, 0)}", (0, 0))
        else:
            block.add_line((0, 0), (1, 1))
    drawing.modelspace().add_blockref(f"b{7 if entities else 0}", (0, 0))
    text = io.StringIO()
    drawing.write(text)
    return text.getvalue().encode()


DAMAGES: list[tuple[str, str, Callable[[bytes], bytes], str]] = [
    ("glb", "", claimed(8), "2147483648 bytes announced"),
    ("glb", "", claimed(12), "JSON of 2147483648"),
    ("glb", "", claimed(4, value=1), "binary glTF of version 1"),
    (
        "glb",
        "",
        in_glb('"count": ?36', '"count":2147483648'),
        "accessor . of 2147483648 rows ends after its buffer view",
    ),
    ("glb", "", in_glb('"byteLength": ?', '"byteLength":2147483648'), "bytes, not 2147483648|ends at byte"),
    ("glb", "", in_glb('"version": ?"2.0"', '"version":"1.0"'), "version 1.0"),
    (
        "glb",
        "",
        in_glb('"nodes": ?\\[\\{', '"nodes":[{"children":[0],'),
        "node 0 is below two nodes, or below itself",
    ),
    (
        "glb",
        "",
        in_glb('"asset":', '"extensionsRequired":["EXT_meshopt_compression"],"asset":'),
        "EXT_meshopt_compression",
    ),
    ("glb", "", in_glb('"mesh": ?0', '"mesh":7'), "there is no mesh 7: of 2"),
    (
        "gltf",
        "",
        replaced("data:application/octet-stream", "http://example.org/a.bin?"),
        "names 'http://example.org",
    ),
    ("gltf", "", replaced("data:[^,]*,", "../../secret.bin?"), "names '../../secret.bin"),
    ("gltf", "", replaced("data:[^,]*,", "/etc/passwd?"), "names '/etc/passwd"),
    ("gltf", "", lambda data: b'{"asset":{"version":"2.0"},"nodes":' + b"[" * 100_000, "recursion|Expected"),
    ("obj", "", replaced("f 1", "f 99"), r"a.obj:\d+: .*no vertex 99: 8 stand above"),
    ("obj", "", replaced("v ", "v nan "), r"a vertex is at \[nan"),
    ("obj", "", lambda data: b"mtllib ../../etc/passwd\n" + data, "names '../../etc/passwd'"),
    ("obj", "", lambda data: b"# nothing", "holds no surface"),
    ("ply", "", replaced("element vertex 8", "element vertex 2147483648"), "a.ply"),
    ("ply", "", replaced("element face 12", "element face 2147483648"), "a.ply"),
    ("ply", "", replaced("element face 12", "element face -3"), "a.ply"),
    ("stl", "", claimed(80), "an STL of 2147483648 triangles has 107374182484 bytes, this one 684"),
    ("text", "", replaced("endsolid", "solid"), "cut off"),
    ("dxf", "", lambda data: nested_blocks(10), "more than 2000000 entities|expand"),
    ("dxf", "", lambda data: nested_blocks(0), "recursion|block"),
    ("dxf", "", replaced("3DFACE", "3DFAC"), "holds no surface"),
    ("cityjson", "", replaced("4, 0, 0", "4e400, 0, 0"), "out of range|vertices"),
    ("cityjson", "", replaced("0, 1, 2, 3", "0, 1, 2, 99"), "object 'a': .*index 99 is out of bounds"),
    ("cityjson", "", replaced("0, 1, 2, 3", "0, 1, 2, -1"), r"object 'a': .*>= 0 - at `\$"),
    ("cityjson", "", replaced('"1.0"', '"3.0"'), "version 3.0"),
    (
        "cityjson",
        "",
        replaced('"CityObjects"', '"metadata":{"referenceSystem":"EPSG:999999"},"CityObjects"'),
        "999999",
    ),
    (
        "cityjson",
        "",
        replaced('"CityObjects"', '"metadata":{"referenceSystem":"moon"},"CityObjects"'),
        "'moon' names no EPSG code",
    ),
    ("cityjson", "", lambda data: b'{"CityObjects":' + b'{"a":' * 100_000, "recursion|a.city.json"),
    ("cityjson", "", lambda data: b"\xff\xfe" + data, "a.city.json"),
    (
        "3d-tiles",
        "",
        replaced("a.b3dm", "../a.b3dm"),
        r"names '../a.b3dm'; what it names lies in its folder or below",
    ),
    ("3d-tiles", "", replaced("a.b3dm", "%2e%2e/a.b3dm"), "names '%2e%2e/a.b3dm'"),
    ("3d-tiles", "", replaced("a.b3dm", "https://example.org/a.b3dm"), "names 'https://example.org/a.b3dm'"),
    ("3d-tiles", "", replaced("a.b3dm", "/a.b3dm"), "names '/a.b3dm'"),
    ("3d-tiles", "", replaced("a.b3dm", "tileset.json"), "names itself"),
    ("3d-tiles", "", replaced("a.b3dm", "missing.b3dm"), "holds no surface"),
    (
        "3d-tiles",
        "",
        lambda data: b'{"root":' + b'{"geometricError":1,"children":[' * 50_000,
        "recursion|tileset",
    ),
    ("3d-tiles", "", lambda data: tileset(tile(1, children=[tile(1)] * 301)).encode(), "more than 300 tiles"),
    (
        "3d-tiles",
        "",
        replaced('"geometricError": 1,', '"geometricError": 1, "transform": [1, 2],'),
        "reshape",
    ),
    ("3d-tiles", "a.b3dm", claimed(8), "2147483648 bytes announced"),
    ("3d-tiles", "a.b3dm", claimed(12), "tables of 2147483648 bytes announced"),
    ("3d-tiles", "a.b3dm", replaced("b3dm", "vctr"), "begins with b'vctr'"),
    ("3d-tiles", "a.b3dm", replaced('"BATCH_LENGTH": 0', '"RTC_CENTER": [0]'), "length 3"),
    ("implicit", "a.subtree", claimed(8, "<Q"), "JSON of 2147483648"),
    ("implicit", "a.subtree", claimed(16, "<Q"), "binary of 2147483648"),
    (
        "implicit",
        "a.subtree",
        replaced('"byteLength": 1', '"byteLength": 0'),
        "there is no byte of bits 0: of 0",
    ),
    ("implicit", "", replaced("OCTREE", "BINARY"), "BINARY"),
    ("implicit", "", replaced('"subtreeLevels": 1', '"subtreeLevels": 99'), "subtreeLevels"),
    ("implicit", "", replaced('"availableLevels": 1', '"availableLevels": 20'), "a.subtree|more than"),
    ("implicit", "", replaced("a.subtree", "../{level}"), "names '../0'"),
    (
        "mitsuba",
        "",
        lambda data: b'<!DOCTYPE s [<!ENTITY a "x"><!ENTITY b "&a;&a;">]>' + data,
        "document type 's' is refused",
    ),
    ("mitsuba", "", replaced("a.ply", "../a.ply"), "names '../a.ply'"),
    ("mitsuba", "", replaced('"ply"', '"serialized"'), "type 'serialized'"),
    ("mitsuba", "", replaced("</scene>", ""), "broken XML"),
    ("mitsuba", "", lambda data: b"<scene>" * 100_000, "broken XML"),
    ("mitsuba", "a.ply", replaced("element face 12", "element face 2147483648"), "a.ply"),
]
"""Format, file in its folder (the main one), damage, and what the refusal says."""


@pytest.mark.parametrize(("sample", "name", "damage", "said"), DAMAGES, indirect=["sample"])
def test_file_that_would_do_harm_is_refused(
    sample: Path,
    name: str,
    damage: Callable[[bytes], bytes],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("caviar_space.sources.tiles3d._MOST_TILES", 300)
    file = sample
    wrong = file.with_name(name) if name else file
    wrong.write_bytes(damage(wrong.read_bytes()))

    with pytest.raises(AssetError, match=said) as refused:
        read_source(file)

    assert str(wrong.parent) in str(refused.value)
    assert len(str(refused.value)) < 600


def test_every_format_has_a_reader_for_its_files() -> None:
    ends = [end for ends, _ in READERS.values() for end in ends]
    assert len(ends) == len(set(ends))


@pytest.mark.parametrize(
    ("sample", "library"),
    [("draco", "DracoPy"), ("dxf", "ezdxf"), ("cityjson", "shapely")],
    indirect=["sample"],
)
def test_library_that_is_not_installed_is_named(
    sample: Path, library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)

    with pytest.raises(SetupError, match=rf"needs {library}, of the extra `scenes`; run: .*scenes"):
        read_source(sample)


def test_json_is_of_the_format_that_it_holds(originals: dict[str, Path], tmp_path: Path) -> None:
    shutil.copytree(originals["3d-tiles"].parent, tmp_path / "tiles")
    (tmp_path / "tiles" / "tileset.json").rename(tmp_path / "tiles" / "root.json")

    assert read_source(tmp_path / "tiles" / "root.json").pieces
    assert read_source(originals["3d-tiles"].parent).pieces  # the folder
    for name in ("a", "b"):
        shutil.copy(originals["glb"], tmp_path / f"{name}.glb")
    with pytest.raises(AssetError, match=r"has 2 files of gltf \(a\.glb, b\.glb\); name one"):
        read_source(tmp_path)
