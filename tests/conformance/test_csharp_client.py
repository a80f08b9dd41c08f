"""The C# client library, compiled and run by Mono: vectors, conformance, a whole run, and a killed world."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import engine_worlds as worlds
import pytest
from scenarios_support import ROOT
from vector_files import load

pytestmark = pytest.mark.slow

CSHARP = ROOT / "clients" / "csharp"
CHECK = Path(__file__).parent / "csharp" / "Check.cs"
SCENARIO = CSHARP / "world.toml"


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with World.exe and Check.exe; skips by name where Mono is missing."""
    for program in ("mcs", "mono"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed (Debian: mono-mcs, mono-runtime, libmono-posix4.0-cil)")
    folder = tmp_path_factory.mktemp("csharp")
    for source in (CSHARP / "World.cs", CHECK, CHECK.with_name("Slow.cs")):
        # Unity 2020 has C# 8; mcs ends at 7.2.
        command = ["mcs", "-langversion:7.2", "-warnaserror", f"-out:{folder / source.stem}.exe"]
        done = subprocess.run(
            [*command, source, CSHARP / "Caviar.cs"], capture_output=True, text=True, timeout=120, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
    return folder


@pytest.fixture(scope="module")
def command(build: Path) -> list[str]:
    return ["mono", str(build / "World.exe")]


@pytest.fixture
def ask(build: Path, tmp_path: Path) -> worlds.Ask:
    def asked(kind: str, lines: Sequence[str]) -> list[str]:
        cases = tmp_path / "cases.txt"
        cases.write_text("\n".join(lines) + "\n", "utf-8")
        done = subprocess.run(
            ["mono", build / "Check.exe", kind, cases],
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout.removesuffix("\n").split("\n")

    return asked


class TestTheLibraryInCSharp(worlds.LibraryTests):
    """What is tested of every library."""

    SCHEMA = CSHARP / "Caviar.cs"
    WORLD = CSHARP / "World.cs"
    COMMENT = "//"


def test_the_programs_of_its_page_compile(build: Path, tmp_path: Path) -> None:
    stub = CHECK.with_name("UnityStub.cs")
    for name, *more in (("Street.cs",), ("CaviarStreet.cs", stub)):
        source = worlds.block_of(ROOT / "docs" / "howto" / "csharp-client.md", name, tmp_path)
        command = ["mcs", "-langversion:7.2", "-target:library", f"-out:{tmp_path / name}.dll"]
        done = subprocess.run(
            [*command, source, *more, CSHARP / "Caviar.cs"], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr


def test_the_reference_world_fails_no_case_of_the_kit(command: list[str], tmp_path: Path) -> None:
    worlds.check_conformance(" ".join([*command, "{endpoint}", "{name}"]), tmp_path)


def test_a_frame_may_take_several_ticks_and_a_wrong_object_is_named(build: Path, tmp_path: Path) -> None:
    worlds.check_slow_and_wrong(tmp_path, ["mono", str(build / "Slow.exe")])


def test_an_object_as_fast_as_light_is_refused_with_its_values(ask: worlds.Ask) -> None:
    welcome = f"welcome\t{load('welcome_mounts').header.hex()}"
    _, answer = ask("mounts", [welcome, "car.1|car|0 0 1|1 0 0 0|2e8 0 2.5e8|4 2 2"])
    assert answer.startswith("object 'car.1': velocity is 200000000, 0, 250000000")


@pytest.mark.parametrize("how", ["right", "late"])
def test_the_end_of_a_run_is_told_with_its_reason_and_status(build: Path, tmp_path: Path, how: str) -> None:
    with worlds.waiting_run(worlds.ending(tmp_path, how), tmp_path, frames=3) as run:
        worlds.check_end(how, ["mono", build / "Slow.exe", run.url, "world"], run.mark, run.out)


def test_an_address_that_is_no_gateways_is_refused_at_once(command: list[str]) -> None:
    worlds.check_no_gateway(command)


@pytest.mark.exhaustive
def test_a_run_with_channel_lidar_link_and_recorder_and_the_same_digest_after_a_kill(
    command: list[str], tmp_path: Path
) -> None:
    digest, directory = worlds.whole_run(SCENARIO, tmp_path / "whole", command)
    worlds.check_recording(directory)
    worlds.check_kill(SCENARIO, tmp_path / "killed", command, digest)
