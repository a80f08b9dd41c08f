"""Scenery that a world brings, and the meshes of moving objects."""

from __future__ import annotations

import importlib.util
import struct
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from world_builders import ScriptedWorld

from caviar_protocol.errors import AssetError, ScenarioError, SetupError
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.schema import fixed_device
from caviar_protocol.topics import AntennaArray, AntennaDevice
from caviar_services.world.assets import object_assets, pattern_assets
from caviar_services.world.base import WorldSettings
from caviar_space.meshes import SHAPES, Mesh, placed, ply
from caviar_space.scenery import scenery_assets

with_sionna = pytest.mark.skipif(importlib.util.find_spec("sionna") is None, reason="needs sionna-rt")


def read_ply(data: bytes) -> Mesh:
    """A reader that knows only what the PLY format says."""
    head, _, body = data.partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    vertex_count = int(next(line for line in lines if line.startswith("element vertex")).split()[-1])
    face_count = int(next(line for line in lines if line.startswith("element face")).split()[-1])
    vertices = [struct.unpack_from("<fff", body, 12 * i) for i in range(vertex_count)]
    faces = [struct.unpack_from("<Biii", body, 12 * vertex_count + 13 * i) for i in range(face_count)]
    assert len(body) == 12 * vertex_count + 13 * face_count
    assert {count for count, *_ in faces} == {3}
    return Mesh(np.array(vertices), np.array([corners for _, *corners in faces], dtype=np.int32))


def write_scene(folder: Path, content: str) -> Path:
    (folder / "meshes").mkdir()
    (folder / "meshes" / "wall.ply").write_bytes(ply(SHAPES["car"]()))
    xml = folder / "city.xml"
    xml.write_text(f'<scene version="2.1.0">\n{content}\n</scene>')
    return xml


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_unit_meshes_fill_the_unit_box_exactly(name: str) -> None:
    """What scales by an object's dimensions must be −½…½ on every axis, in float32 too."""
    mesh = read_ply(ply(SHAPES[name]()))
    assert mesh.vertices.min(axis=0).tolist() == [-0.5, -0.5, -0.5]
    assert mesh.vertices.max(axis=0).tolist() == [0.5, 0.5, 0.5]


@pytest.mark.parametrize("name", sorted(SHAPES))
def test_unit_meshes_are_closed_with_normals_outwards(name: str) -> None:
    """Every edge belongs to two faces that run through it in opposite directions, no face is
    degenerate, and the volume by the divergence theorem is positive for every closed part."""
    mesh = SHAPES[name]()
    edges = Counter((int(face[k]), int(face[(k + 1) % 3])) for face in mesh.faces for k in range(3))
    assert set(edges.values()) == {1}
    assert {(b, a) for a, b in edges} == set(edges)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-6
    for part in parts_of(mesh):
        volume = np.einsum("ij,ij->i", a[part], np.cross(b[part], c[part])).sum() / 6
        assert 1e-6 < volume < 1.0


def parts_of(mesh: Mesh) -> list[list[int]]:
    """Faces of each connected part."""
    owner = list(range(len(mesh.vertices)))

    def root(v: int) -> int:
        while owner[v] != v:
            v = owner[v]
        return v

    for x, y, z in mesh.faces.tolist():
        owner[root(y)] = owner[root(z)] = root(x)
    parts: dict[int, list[int]] = {}
    for index, face in enumerate(mesh.faces.tolist()):
        parts.setdefault(root(face[0]), []).append(index)
    return list(parts.values())


@pytest.mark.parametrize("name", ["car", "truck", "bus"])
def test_vehicles_are_symmetric_left_to_right_and_lower_in_front(name: str) -> None:
    """x is forward: the windscreen is there, so the front top edge is lower than the middle."""
    vertices = SHAPES[name]().vertices
    mirrored = vertices * [1, -1, 1]
    assert {tuple(v) for v in vertices.round(12).tolist()} == {
        tuple(v) for v in (mirrored.round(12) + 0.0).tolist()
    }
    assert vertices[vertices[:, 0] == 0.5][:, 2].max() < 0.45


def test_a_placed_mesh_fills_the_objects_box() -> None:
    from caviar_protocol.space.coordinates import Pose

    corners = placed(SHAPES["bus"](), np.array([12.0, 2.5, 3.2]), Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0)))
    assert corners.min(axis=0) == pytest.approx([-5.0, 0.75, 1.4])
    assert corners.max(axis=0) == pytest.approx([7.0, 3.25, 4.6])


def test_no_scenery_is_no_asset() -> None:
    """With two worlds only one brings scenery; the other brings the meshes of its objects."""
    assert scenery_assets("") == {}
    assert set(ScriptedWorld([[]]).scenery()) == {"objects/car.ply"}


def test_equal_classes_of_two_worlds_bring_equal_bytes() -> None:
    assert object_assets(("car", "bus"))["objects/car.ply"] == object_assets(("car",))["objects/car.ply"]


def test_scenery_brings_the_xml_and_what_it_names(tmp_path: Path) -> None:
    xml = write_scene(
        tmp_path,
        '<default name="mesh" value="meshes/wall.ply"/>\n'
        '<shape type="ply" id="a"><string name="filename" value="meshes/wall.ply"/></shape>\n'
        '<shape type="ply" id="b"><string name="filename" value="$mesh"/></shape>',
    )
    world = ScriptedWorld([[]], settings=WorldSettings(scenery=str(xml)))
    assets = world.scenery()
    assert set(assets) == {"scenery/city.xml", "scenery/meshes/wall.ply", "objects/car.ply"}
    assert assets["scenery/meshes/wall.ply"] == tmp_path / "meshes" / "wall.ply"


def test_a_missing_mesh_is_named_with_file_line_and_shape(tmp_path: Path) -> None:
    xml = write_scene(
        tmp_path,
        '<shape type="ply" id="mesh-a"><string name="filename" value="meshes/wall.ply"/></shape>\n'
        '<shape type="ply" id="mesh-b">\n<string name="filename" value="meshes/roof.ply"/></shape>',
    )
    with pytest.raises(AssetError, match=r"city\.xml:3.*'mesh-b'.*meshes/roof\.ply"):
        scenery_assets(str(xml))


@pytest.mark.parametrize("name", ["../wall.ply", "/etc/wall.ply", ""])
def test_a_mesh_outside_the_folder_cannot_travel(tmp_path: Path, name: str) -> None:
    xml = write_scene(tmp_path, f'<shape type="ply" id="a"><string name="filename" value="{name}"/></shape>')
    with pytest.raises(AssetError, match=r"city\.xml:2: <shape> a "):
        scenery_assets(str(xml))


def test_an_include_is_refused_with_what_to_do(tmp_path: Path) -> None:
    xml = write_scene(tmp_path, '<include filename="other.xml"/>')
    with pytest.raises(AssetError, match="write its content into this file"):
        scenery_assets(str(xml))


def test_broken_xml_is_named_with_its_line(tmp_path: Path) -> None:
    xml = tmp_path / "city.xml"
    xml.write_text("<scene>\n<shape>\n</scene>")
    with pytest.raises(AssetError, match=r"city\.xml:3: broken XML"):
        scenery_assets(str(xml))


def test_missing_scenery_and_nonsense_are_refused(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match="is not there"):
        scenery_assets(str(tmp_path / "none.xml"))
    with pytest.raises(AssetError, match='write "sionna:NAME"'):
        scenery_assets("munich")


def test_without_sionna_the_extras_that_bring_its_scenes_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SetupError, match=r"`world`.*`channel`.*'caviar-sim\[world\]'"):
        scenery_assets("sionna:simple_street_canyon")


@with_sionna
def test_scenes_of_sionna_are_found_without_importing_it() -> None:
    assets = scenery_assets("sionna:simple_street_canyon")
    assert len(assets) == 8
    assert all(isinstance(path, Path) and path.is_file() for path in assets.values())


@with_sionna
@pytest.mark.parametrize("name", ["simple_street_canyons", "../scenes/munich", ""])
def test_an_unknown_scene_of_sionna_is_answered_with_the_known_ones(name: str) -> None:
    with pytest.raises(AssetError, match=r"has no scene .*munich"):
        scenery_assets(f"sionna:{name}")


def test_sionna_not_installed_is_answered_with_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SetupError, match=r"pip install 'caviar-sim\[world\]'"):
        scenery_assets("sionna:munich")


def test_pattern_files_of_devices_travel_and_what_is_wrong_with_one_names_its_key(tmp_path: Path) -> None:
    file = tmp_path / "sector.msi"
    file.write_text(
        "GAIN 10 dBi\nHORIZONTAL 4\n0 0\n90 15\n180 20\n270 15\nVERTICAL 4\n0 0\n90 12\n180 20\n270 12\n"
    )
    array = AntennaArray(pattern_file=str(file))
    device = DeviceSpec(name="bs", kind="antenna", role="tx", array=array)
    plain = DeviceSpec(name="ue", kind="antenna", role="rx")
    assert pattern_assets((plain, device)) == {"patterns/sector.msi": file}
    published = fixed_device(device)
    assert isinstance(published, AntennaDevice)
    assert published.array.pattern_file == "patterns/sector.msi"
    file.write_text("GAIN ten dBi\n")
    with pytest.raises(ScenarioError, match=r"devices.bs.array.pattern_file.*sector.msi:1.*'ten'"):
        pattern_assets((device,))
