"""What SPEC.md tells the author of a world: its examples are read by the readers of this repository."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from caviar_protocol.fields import CHANGES_OTHERS, PARTS_SINCE, VALUES_SINCE
from caviar_protocol.host import host_identity
from caviar_protocol.keys import Pair, read_pair
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.space.coordinates import rotated, rotation_matrix
from caviar_protocol.space.ply import read_ply
from caviar_protocol.topics import Interaction
from caviar_space.mitsuba_xml import find_scenery, read_scenery

SPEC = (Path(__file__).parents[2] / "protocol" / "SPEC.md").read_text("utf-8")


def block(beginning: str) -> str:
    """The code block that begins so."""
    (found,) = re.findall(rf"```\w*\n({re.escape(beginning)}.*?)```", SPEC, re.DOTALL)
    return str(found)


def test_the_example_of_scenery_and_its_mesh_are_read(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "ground.ply").write_text(block("ply\n"))
    (tmp_path / "street.xml").write_text(block("<scene "))
    file = find_scenery({"scenery/street.xml": tmp_path / "street.xml"})
    assert file is not None
    (shape,) = read_scenery(file).shapes
    assert (shape.name, shape.itu_material) == ("ground", "concrete")
    vertices, faces = read_ply(shape.file)
    assert vertices.shape == (4, 3)
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3]]


def of_engine(row: str, name: str, values: dict[str, float]) -> list[float]:
    """Numbers of a cell of the table of engines, by the axes and components that it names."""
    cells = dict(
        zip(("engine", "position", "quaternion", "turning", "dimensions"), row.split(" | "), strict=True)
    )
    terms = re.findall(r"(−?)([wxyz])(?:/(100))?", cells[name])
    return [(-1 if sign else 1) * values[key] / float(scale or 1) for sign, key, scale in terms]


@pytest.mark.parametrize("engine", ["ROS", "Unreal", "Unity", "Godot"])
def test_the_table_of_engines_turns_and_then_maps_as_it_maps_and_then_turns(engine: str) -> None:
    (row,) = re.findall(rf"^\| (.*\({engine}\) \|.*) \|$", SPEC, re.MULTILINE)
    parts = {"w": 0.3, "x": 0.5, "y": -0.2, "z": math.sqrt(0.62)}
    turn = rotation_matrix([parts[key] for key in "wxyz"])
    body = [1.0, 2.0, 3.0]

    def mapped(vector: Iterable[float]) -> list[float]:
        return of_engine(row, "position", dict(zip("xyz", vector, strict=True)))

    expected = mapped(turn @ body)
    assert rotated(of_engine(row, "quaternion", parts), mapped(body)) == pytest.approx(expected)
    velocity = {"x": 0.3, "y": -0.7, "z": 1.1}
    turning = of_engine(row, "turning", velocity)
    assert np.cross(turning, mapped(body)) == pytest.approx(mapped(np.cross([*velocity.values()], body)))
    sides = of_engine(row, "dimensions", {"x": 1.0, "y": 2.0, "z": 3.0})
    assert sides == pytest.approx([abs(side) for side in mapped(body)])


def test_every_key_of_a_device_is_in_the_table() -> None:
    section = SPEC[SPEC.index("### Which devices") : SPEC.index("### Geometry of several worlds")]
    rows = "".join(re.findall(r"^\| (`.*?) \|", section, re.MULTILINE))
    assert set(re.findall(r"`(\w+)`", rows)) == set(DeviceSpec.__struct_fields__)


def test_the_section_on_versions_names_what_a_reader_has_to_know() -> None:
    section = SPEC[SPEC.index("## Versions") : SPEC.index("## Transport")]
    words = set(re.findall(r"`([^`]+)`", section))
    assert words >= {value for values in VALUES_SINCE.values() for value in values}
    assert words >= {field.partition(".")[2] for field in CHANGES_OTHERS}
    for part, since in PARTS_SINCE.items():
        topic, _, name = part.partition(".")
        assert f"| {topic} | `{name}` | {since} |" in SPEC


def test_what_interactions_are_stands_in_the_table_of_a_channel() -> None:
    (row,) = re.findall(r"^\| interactions \|.*", SPEC, re.MULTILINE)
    codes = dict(re.findall(r"(\d) (\w+)", row))
    assert codes.pop("0") == "nothing"
    assert {name.upper(): int(code) for code, name in codes.items()} == {
        kind.name: kind.value for kind in Interaction if kind
    }


def test_the_key_file_is_one(tmp_path: Path) -> None:
    file = tmp_path / "agent.key"
    file.write_text(block("# Secret key"))
    file.chmod(0o600)
    assert msgspec.structs.asdict(read_pair(file)).keys() == set(Pair.__struct_fields__)


def test_the_host_has_the_form_that_is_told() -> None:
    (example,) = re.findall(r"`([0-9a-f-]{36}:pid:\[\d+\])`", SPEC)
    assert re.fullmatch(r"[0-9a-f-]{36}:pid:\[\d+\]", host_identity()), example


def test_materials_are_those_that_the_ray_tracer_knows() -> None:
    import pytest

    itu = pytest.importorskip("sionna.rt.radio_materials.itu")
    text = SPEC[SPEC.index("Recommendation ITU-R P.2040:") :].partition(";")[0]
    assert set(re.findall(r"`(\w+)`", text)) == set(itu.ITU_MATERIALS_PROPERTIES)
