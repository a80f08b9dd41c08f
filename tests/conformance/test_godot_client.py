"""The add-on for Godot, run by Godot 3 without a screen: vectors, conformance, whole runs, a killed world."""

from __future__ import annotations

import math
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import engine_worlds as worlds
import pytest
from scenarios_support import ROOT
from vector_files import load

from caviar_protocol.recording import Recording

pytestmark = pytest.mark.slow

GODOT = ROOT / "clients" / "godot"
ADDON = GODOT / "addons" / "caviar"
CHECK = Path(__file__).parent / "godot" / "check.gd"
SCENARIO = GODOT / "world.toml"


@pytest.fixture(scope="module")
def godot() -> str:
    """Program that runs scripts without a screen; skips by name where it is missing."""
    found = shutil.which("godot3-server")
    if found is None:
        pytest.skip("godot3-server is not installed (Debian: godot3-server)")
    return found


@pytest.fixture
def ask(godot: str, tmp_path: Path) -> worlds.Ask:
    def asked(kind: str, lines: Sequence[str]) -> list[str]:
        cases, answers = tmp_path / "cases.txt", tmp_path / "answers.txt"
        cases.write_text("\n".join(lines) + "\n", "utf-8")
        done = subprocess.run(
            [godot, "--path", GODOT, "-s", CHECK, kind, cases, answers],
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert "SCRIPT ERROR" not in done.stderr, done.stderr
        return answers.read_text("utf-8").removesuffix("\n").split("\n")

    return asked


@pytest.fixture(scope="module")
def command(godot: str) -> list[str]:
    return [godot, "--path", str(GODOT), "-s", "world.gd"]


class TestTheAddOn(worlds.LibraryTests):
    """What is tested of every library."""

    SCHEMA = ADDON / "caviar_schema.gd"
    WORLD = GODOT / "world.gd"
    COMMENT = "#"


def test_the_transform_of_a_node_is_a_pose(ask: worlds.Ask) -> None:
    """A node turned by 30° about Godot's y, up, is turned by 30° about z; its scale is none of the pose."""
    half = math.radians(30) / 2
    (answer,) = ask("transform", [f"1 2 3 0 {math.sin(half)} 0 {math.cos(half)}"])
    position, orientation = ([worlds.number(word) for word in field.split()] for field in answer.split("\t"))
    assert position == pytest.approx([-3, -1, 2])
    assert orientation == pytest.approx([math.cos(half), 0, 0, math.sin(half)], abs=1e-6)


def test_a_field_that_objects_do_not_have_is_named(ask: worlds.Ask) -> None:
    welcome = f"welcome\t{load('welcome_mounts').header.hex()}"
    fields = "car.1|car|0 0 1|1 0 0 0|0 0 0|4 2 2|angularVelocity"
    _, answer = ask("mounts", [welcome, fields])
    assert answer.startswith("object 'car.1': has a field 'angularVelocity'; its fields are name, class, ")


def test_the_reference_world_fails_no_case_of_the_kit(godot: str, tmp_path: Path) -> None:
    # The script around Godot turns SIGTERM into a file that the add-on looks for.
    command = f"env GODOT='{godot} --path {GODOT}' {ADDON / 'run_headless.sh'} world.gd {{endpoint}} {{name}}"
    worlds.check_conformance(command, tmp_path)


def test_a_frame_may_take_several_ticks_and_a_wrong_object_is_named(godot: str, tmp_path: Path) -> None:
    script = str(CHECK.with_name("slow.gd"))
    worlds.check_slow_and_wrong(tmp_path, [godot, "--path", str(GODOT), "-s", script])


def test_an_address_that_is_no_gateways_is_refused_at_once(godot: str) -> None:
    worlds.check_no_gateway([godot, "--path", str(GODOT), "-s", "world.gd"])


TREE = """extends SceneTree

func _init():
	var node = load("res://caviar_node.gd").new()
	var car = RigidBody.new()
	car.name = "Car"
	car.translation = Vector3(3, 100, -20)
	car.linear_velocity = Vector3(0, 0, -10)
	node.add_child(car)
	node.tracked = [NodePath("Car")]
	root.add_child(node)

func _idle(_delta):
	return root.get_child(0).world.end_reason != ""
"""


def test_the_node_of_its_page_tells_where_physics_move_a_body(godot: str, tmp_path: Path) -> None:
    """Godot's -z is east, its x south: a body thrown along -z goes east while it falls."""
    project, run_folder = tmp_path / "project", tmp_path / "run"
    shutil.copytree(GODOT / "addons", project / "addons")
    (project / "project.godot").write_text("config_version=4\n", "utf-8")
    (project / "tree.gd").write_text(TREE, "utf-8")
    run_folder.mkdir()
    scenario = run_folder / "bare.toml"
    scenario.write_text(worlds.BARE, "utf-8")
    with worlds.waiting_run(scenario, run_folder, frames=20) as run:
        source = worlds.block_of(ROOT / "docs" / "howto" / "godot-client.md", "caviar_node.gd", project)
        source.write_text(source.read_text("utf-8").replace("ws://127.0.0.1:8080/ws", run.url), "utf-8")
        with run.agent(godot, "--path", str(project), "-s", "tree.gd"):
            run.digest()
    scenes = [frame.scene() for frame in Recording(next(run.out.glob("*/")))]
    x, y, z = zip(*(scene.position[0].tolist() for scene in scenes if scene is not None), strict=True)
    assert len(x) == 20
    assert 20 <= x[0] < x[-1]
    assert y == pytest.approx([-3] * 20)
    assert 100 >= z[0] > z[-1]
    first, last = scenes[0], scenes[-1]
    assert first is not None
    assert last is not None
    # The air of Godot slows the body down.
    assert 0 < last.velocity[0, 0] < first.velocity[0, 0] <= 10
    assert last.velocity[0, 2] < first.velocity[0, 2] <= 0


def test_killed_and_started_again_it_goes_on_with_the_same_digest(command: list[str], tmp_path: Path) -> None:
    """At a pace at which the frames are not over before the kill."""
    scenario = worlds.light(SCENARIO, tmp_path)
    digest, _ = worlds.whole_run(scenario, tmp_path / "whole", command, "--pace", "10")
    worlds.check_kill(scenario, tmp_path / "killed", command, digest, "--pace", "10")


@pytest.mark.exhaustive
def test_a_run_with_channel_lidar_link_and_recorder_and_the_same_digest_after_a_kill(
    command: list[str], tmp_path: Path
) -> None:
    digest, directory = worlds.whole_run(SCENARIO, tmp_path / "whole", command)
    worlds.check_recording(directory)
    worlds.check_kill(SCENARIO, tmp_path / "killed", command, digest)
