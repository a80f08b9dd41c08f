"""The C++ header against the vectors: encoding, refusals, digests, devices, axes, typed reading."""

from __future__ import annotations

import fnmatch
import hashlib
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from cpp_programs import PROBE, Probe, compiled, program_folder
from scenarios_support import ROOT
from vector_files import Vector, all_vectors, array_of, is_array, load, named

from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.topics import Action, Channel, Link, Scene

pytestmark = pytest.mark.slow

VECTORS = all_vectors()


@pytest.fixture(scope="module")
def folder(pytestconfig: pytest.Config, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return program_folder(pytestconfig, tmp_path_factory)


@pytest.fixture(scope="module")
def probe(folder: Path) -> Iterator[Probe]:
    found = Probe(compiled("g++", PROBE, folder, "-std=c++17", "-Wall", "-Wextra", "-Werror"))
    yield found
    found.close()


# --- encoding -------------------------------------------------------------------------------------------


def asked(probe: Probe, vector: Vector) -> Any:
    """What the header makes of a vector."""
    kind = vector.stated["kind"]
    if kind == "message":
        lengths = vector.stated.get("lengths", [])
        parts: Sequence[bytes | str] = vector.parts[: len(vector.parts) - len(lengths)]
        return probe("message", *parts, *[f"zeros:{length}" for length in lengths])
    if kind == "payload":
        return probe("payload", vector.stated["topic"], vector.header, vector.body)
    return probe("arrays", vector.header, vector.body)


@pytest.mark.parametrize("vector", [v for v in VECTORS if v.refused is not None], ids=named)
def test_a_wrong_vector_is_refused_with_its_code(probe: Probe, vector: Vector) -> None:
    assert asked(probe, vector).get("code") == vector.refused


@pytest.mark.parametrize("vector", [v for v in VECTORS if v.refused is None], ids=named)
def test_a_vector_is_read_and_written_again_in_canonical_form(probe: Probe, vector: Vector) -> None:
    got = asked(probe, vector)
    assert "header" in got, got
    assert (got["header"], got.get("body", "")) == tuple(part.hex() for part in canonical(vector))
    if vector.canonical and "value" in vector.stated:
        assert_means(got["value"], vector.means, vector.name)


def canonical(vector: Vector) -> tuple[bytes, bytes]:
    """Header and body as a writer writes them."""
    if vector.canonical:
        return vector.header, vector.body
    if vector.stated["kind"] == "message":
        return msgpack.packb(vector.means), b""
    return encode_payload(decode_payload(vector.stated["topic"], vector.header, vector.body))


def assert_means(got: Any, stated: Any, path: str) -> None:
    """Compare what was decoded with the JSON of a vector, which has no field that is not there."""
    if is_array(stated):
        expected = array_of(stated)
        assert (got["dtype"], got["shape"]) == (stated["dtype"], list(expected.shape)), path
        assert bytes.fromhex(got["data"]) == expected.tobytes(), path
    elif isinstance(stated, dict):
        assert set(got) == set(stated), path
        for key, value in stated.items():
            assert_means(got[key], value, f"{path}.{key}")
    elif isinstance(stated, list):
        assert len(got) == len(stated), path
        for index, (item, value) in enumerate(zip(got, stated, strict=True)):
            assert_means(item, value, f"{path}[{index}]")
    else:
        assert (got, type(got)) == (stated, type(stated)), path


SIMPLE = {"≥ ": ">=", "≤ ": "<=", "> ": ">", ", ": "", "plain value": "plain"}


def written_type(cell: str) -> str:
    """A type of a table of SPEC.md as the header writes it."""
    cell = re.sub(r" \(.*since .*\)$", "", cell).replace("\\|", "|")
    if found := re.fullmatch(r"array `(.*?)` \[(.*)\]", cell):
        return f"{found[1]}[{found[2].replace(' ', '')}]"
    if found := re.fullmatch(r"list of (.*), 0 to (\d+) of them", cell):
        return f"[{written_type(found[1])}]<={found[2]}"
    if found := re.fullmatch(r"list of (\d) (\w+)", cell):
        return f"{found[2]}*{found[1]}"
    if found := re.fullmatch(r"list of (.*)", cell):
        return f"[{written_type(found[1])}]"
    if found := re.fullmatch(r"map, str to (.*)", cell):
        return f"{{{written_type(found[1])}}}"
    if links := re.findall(r"\[(\w+)\]\(#[\w-]+\)", cell):
        return "/".join(links)
    if "`" in cell:
        return "|".join(re.findall("`(.*?)`", cell))
    for words, sign in SIMPLE.items():
        cell = cell.replace(words, sign)
    return cell


def tables_of_the_specification() -> str:
    """All tables of fields, as the header writes them."""
    text, found = (ROOT / "protocol" / "SPEC.md").read_text("utf-8"), []
    for name, table in re.findall(r"<!-- fields: (\w+) -->(.*?)<!-- end -->", text, re.DOTALL):
        words = [name]
        for line in table.splitlines():
            if not line.startswith("| ") or line.startswith(("| field |", "| ---")):
                continue
            field, kind, _, default = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:5]]
            if field == "type":
                words[0] += "#" + kind.strip('`"')
                continue
            shown = {"required": "!", "left out": "?", "all defaults": "=@"}
            words.append(
                f"{field}:{written_type(kind)}{shown.get(default, '=' + default.replace(', ', ','))}"
            )
        found.append(" ".join(words))
    return " ".join(found)


def test_the_types_of_the_header_are_those_of_the_specification(probe: Probe) -> None:
    assert probe("schema").split() == tables_of_the_specification().split()


def test_digests_are_those_of_the_specification(probe: Probe) -> None:
    scene = load("scene_one_object")
    text = (ROOT / "protocol" / "SPEC.md").read_text("utf-8")
    assert f"`{probe('digest', scene.header, scene.body)}`" in text
    assert f"`{probe('geometry', 'objects/car.ply', b'abc')}`" in text
    # A length at which the padding of SHA-256 takes a block of its own.
    long = bytes(range(256)) * 3
    for size in (47, 55, 56, 63, 64, 700):
        right = hashlib.sha256((size).to_bytes(8, "little") + long[:size]).hexdigest()
        assert probe("digest", long[:size], b"") == right


# --- what a world publishes, and what it gets -----------------------------------------------------------

ARRIVALS = (("car.2", "uav"), ("car.1",), ("car.0",), (), ("car.2",))
"""Objects that come in each frame of the vectors `mounts_0` to `mounts_4`."""


def test_devices_are_mounted_as_in_the_vectors(probe: Probe) -> None:
    assert probe("mounts", load("welcome_mounts").header)["code"] == ""
    order: list[str] = []
    for frame, new in enumerate(ARRIVALS):
        vector = load(f"mounts_{frame}")
        there = vector.stated["value"]["names"]
        order = [name for name in (*order, *new) if name in there]
        # Those that are there already may stand anywhere in the list: only who came counts.
        shuffled = [*new, *[name for name in order if name not in new]]
        got = probe("scene", vector.header, vector.body, ",".join(shuffled))
        assert (got["header"], got["body"]) == (vector.header.hex(), vector.body.hex()), f"frame {frame}"


def test_a_device_that_keeps_its_heading_turns_against_its_object(probe: Probe) -> None:
    welcome = msgpack.unpackb(load("welcome_mounts").header)
    spec = next(device for device in welcome["scenario"]["devices"] if device["name"] == "top")
    scenario = {"devices": [spec | {"keeps_heading": True, "yaw_deg": 90.0}]}
    assert probe("mounts", msgpack.packb(welcome | {"scenario": scenario}))["code"] == ""
    vector = load("scene_one_object")
    scene = decode_payload("scene", vector.header, vector.body)
    assert isinstance(scene, Scene)
    got = probe("scene", vector.header, vector.body, scene.names[0])
    mounted = decode_payload("scene", bytes.fromhex(got["header"]), bytes.fromhex(got["body"]))
    assert isinstance(mounted, Scene)
    # The object of the vector is turned by 90° about z, so that the device is not turned against it.
    np.testing.assert_allclose(scene.orientation[0], [0.5**0.5, 0.0, 0.0, 0.5**0.5], atol=1e-9)
    np.testing.assert_allclose(mounted.devices[0].orientation, [1.0, 0.0, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    "pattern",
    [
        "car.*",
        "*",
        "c?r.[0-9]",
        "car.[!2-4]",
        "[[]x]",
        "*.*.*",
        "a[]b]c",
        "[",
        "a[b",
        "µ?",
        "ca[r-].*",
        "",
        "**b",
    ],
)
def test_patterns_match_as_in_other_services(probe: Probe, pattern: str) -> None:
    for text in (
        "car.1",
        "car.3",
        "uav",
        "[x]",
        "a.b.c",
        "a]c",
        "abc",
        "[",
        "a[b",
        "µ",
        "µé",
        "ca-.x",
        "",
        "aab",
    ):
        right = pattern == text or fnmatch.fnmatchcase(text, pattern)
        assert probe("match", pattern.encode(), text.encode()) is right, f"{pattern!r} on {text!r}"


AXES = json.loads((ROOT / "clients" / "axes.json").read_text("utf-8"))
PARTS = ("position", "orientation", "velocity", "angular_velocity")


@pytest.mark.parametrize("engine", AXES["engines"])
def test_poses_convert_to_and_from_an_engine(probe: Probe, engine: str) -> None:
    for pose in AXES["poses"]:
        for direction, source, target in (("from", "enu", engine), ("to", engine, "enu")):
            got = probe(
                "axes", engine, direction, *[number for part in PARTS for number in pose[source][part]]
            )
            for part in PARTS:
                right = np.array(pose[target][part])
                found = np.array(got[part])
                if part == "orientation" and found @ right < 0:
                    found = -found  # q and −q are one rotation
                np.testing.assert_allclose(found, right, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("engine", AXES["engines"])
def test_a_mesh_converts_from_the_axes_and_winding_of_an_engine(probe: Probe, engine: str) -> None:
    vertices, triangles = (np.ravel(AXES["meshes"][engine][part]) for part in ("vertices", "triangles"))
    got = probe("engine_mesh", engine, len(vertices), *vertices, *triangles)
    assert got == AXES["meshes"]["enu"]


@pytest.mark.parametrize(
    ("engine", "right"),
    [("unreal", [0.01, 0.02, 0.03]), ("unity", [3, 1, 2]), ("godot", [3, 1, 2]), ("ned", [1, 2, 3])],
)
def test_sides_of_a_box_have_no_sign(probe: Probe, engine: str, right: list[float]) -> None:
    assert probe("axes", engine, "to", 1.0, 2.0, 3.0, 1.0, *[0.0] * 9)["sides"] == pytest.approx(right)


def test_commands_of_an_action_are_read(probe: Probe) -> None:
    vector = load("action_every_command")
    action = decode_payload("action", vector.header, vector.body)
    assert isinstance(action, Action)
    got = asked(probe, vector)["typed"]
    kinds = [("beam", "waypoint", "velocity", "schedule")[command["kind"]] for command in got]
    assert kinds == [command.__struct_config__.tag for command in action.commands]
    for mine, theirs in zip(got, action.commands, strict=True):
        for field in theirs.__struct_fields__:
            value = getattr(theirs, field)
            assert mine[field] == (list(value) if isinstance(value, tuple) else value), field


def test_users_of_a_link_are_read(probe: Probe) -> None:
    vector = load("link_full")
    link = decode_payload("link", vector.header, vector.body)
    assert isinstance(link, Link)
    got = asked(probe, vector)["typed"]
    assert len(got) == len(link.tx) > 1
    for i, user in enumerate(got):
        for field in set(user) - {"best_tx_beam", "best_rx_beam"}:
            assert user[field] == getattr(link, field)[i], field
        assert [user["best_tx_beam"], user["best_rx_beam"]] == [
            link.top_tx_beam[i, 0],
            link.top_rx_beam[i, 0],
        ]


def test_paths_of_a_channel_are_read_as_rays(probe: Probe) -> None:
    vector = load("channel_paths")
    channel = decode_payload("channel", vector.header, vector.body)
    assert isinstance(channel, Channel)
    got = asked(probe, vector)["typed"]
    assert len(got) == len(channel.tau) > 1
    pair_of = np.repeat(np.arange(len(channel.offsets) - 1), np.diff(channel.offsets))
    for p, ray in enumerate(got):
        depth = int(np.count_nonzero(channel.interactions[p]))
        assert ray["tx"] == channel.tx[pair_of[p] // len(channel.rx)]
        assert ray["rx"] == channel.rx[pair_of[p] % len(channel.rx)]
        assert [complex(*gain) for gain in ray["a"]] == channel.a[:, p].tolist()
        assert (ray["tau"], ray["aod"], ray["aoa"]) == (
            channel.tau[p],
            channel.aod[p].tolist(),
            channel.aoa[p].tolist(),
        )
        assert ray["interactions"] == channel.interactions[p, :depth].tolist()
        assert ray["points"] == channel.points[p, :depth].tolist()
        names = [channel.object_names[i] if i >= 0 else "" for i in channel.objects[p, :depth]]
        assert ray["objects"] == names
