"""`caviar doctor` says what is there, and names the command for what is not."""

from __future__ import annotations

import io
import re
import socket
import sys
import tomllib
from pathlib import Path

import pytest
from rich.console import Console

from caviar_clients.cli import doctor
from caviar_clients.cli.doctor import Check
from caviar_clients.cli.scenarios import extras_of
from caviar_protocol.errors import SetupError
from caviar_protocol.host import install_command
from caviar_protocol.scenario import load_scenario, shipped_scenarios
from caviar_services import drjit_setup

pytestmark = pytest.mark.slow


def shown(checks: list[Check], width: int = 80) -> str:
    console = Console(file=io.StringIO(), width=width)
    doctor.render(checks, console)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_every_check_is_ok_or_names_a_command() -> None:
    checks = doctor.doctor()
    assert len({check.name for check in checks}) == len(checks) >= 12
    for check in checks:
        assert check.found
        assert bool(check.remedy) != check.ok, check


def test_looking_imports_nothing_heavy() -> None:
    before = set(sys.modules)
    doctor.doctor()
    assert not {name.partition(".")[0] for name in set(sys.modules) - before} & {
        "drjit",
        "mitsuba",
        "sionna",
        "libsumo",
        "matplotlib",
    }


def test_two_frames_of_the_base_install_are_computed_and_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    check = doctor.check_frames()
    assert check.ok, check
    monkeypatch.setattr(doctor, "FRAME_DIGESTS", {})
    assert doctor.check_frames().ok, "right numbers that are rounded otherwise are said, and no error"
    monkeypatch.setattr(doctor, "FRAME_ABS_Y", doctor.FRAME_ABS_Y * (1 + 1e-9))
    check = doctor.check_frames()
    assert not check.ok
    assert "expected" in check.found


def test_a_dependency_with_which_no_frame_is_computed_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> object:
        raise KeyError("NDArray[numpy.float64]")

    monkeypatch.setattr("caviar_protocol.codec.payloads.plain", refused)
    check = doctor.check_frames()
    assert not check.ok
    assert "NDArray[numpy.float64]" in check.found
    assert "pip install" in check.remedy


def test_the_exit_status_is_1_as_soon_as_one_thing_is_missing() -> None:
    good, bad = Check("a", True, "1"), Check("b", False, "none", "make b")
    assert doctor.exit_status([good, good]) == 0
    assert doctor.exit_status([good, bad]) == 1


def test_warming_up_needs_numba_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("caviar_services.channel.enumeration.compiled_loops.numba", None)
    with pytest.raises(SetupError, match=re.escape(install_command("channel"))):
        doctor.warm(Console())


def test_a_remedy_is_shown_whole_so_that_it_can_be_copied() -> None:
    remedy = "sudo apt-get install -y " + " ".join(f"package-[{index}]" for index in range(20))
    text = shown([Check("thing", False, "missing", remedy)], width=60)
    assert remedy in text.splitlines()[-1]
    assert "Ready" not in text
    assert "Ready: all " in shown([Check("thing", True, "1")])


def test_what_is_ready_is_told_by_the_scenarios_that_run_with_what_there_is() -> None:
    """Not «everything is here» beside what is missing: no shipped scenario needs an agent's library."""
    count = len(shipped_scenarios())
    lacks = {
        extra: shown([Check(extra, False, "missing", f"pip install {extra}", extra)], width=200)
        for extra in ("policy", "sensors")
    }
    assert f"Ready: all {count} shipped scenarios run here." in lacks["policy"]
    cameras = sum("sensors" in extras_of(load_scenario(path)) for path in shipped_scenarios().values())
    some = f"Ready: {count - cameras} of the {count} shipped scenarios run here; the others need sensors"
    assert some in lacks["sensors"]
    for extra, text in lacks.items():
        assert f"Not installed, and optional: {extra}. To add all of it:" in text


def test_a_missing_llvm_comes_with_its_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> drjit_setup.LlvmLibrary:
        raise SetupError("no libLLVM of version 16 or newer")

    monkeypatch.setattr(drjit_setup, "choose_llvm", none)
    check = doctor.check_llvm()
    assert (check.ok, check.remedy) == (False, drjit_setup.INSTALL)
    assert "no libLLVM" in check.found


@pytest.mark.channel
def test_an_llvm_that_cannot_compile_is_found_by_compiling(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pytest.importorskip("drjit")
    fake = tmp_path / "libLLVM.so.19.1"
    fake.write_bytes(b"not a library")
    monkeypatch.setattr(drjit_setup, "choose_llvm", lambda: drjit_setup.LlvmLibrary((19, 1), fake))
    check = doctor.check_llvm()
    assert not check.ok
    assert "cannot compile" in check.found
    assert check.remedy == drjit_setup.INSTALL


def test_a_process_that_aborts_is_named_by_its_signal() -> None:
    ok, text = doctor._run([sys.executable, "-c", "import os; os.abort()"], {})
    assert not ok
    assert "killed by SIGABRT" in text


def test_what_an_extra_lacks_becomes_one_pip_command(monkeypatch: pytest.MonkeyPatch) -> None:
    versions = {"sionna-rt": "2.2.0", "mitsuba": "3.5.0", "drjit": None, "numba": "0.68.1", "scipy": "1.18.0"}
    monkeypatch.setattr(doctor, "_version", versions.get)
    check = doctor.check_extra("channel")
    assert not check.ok
    assert "drjit missing" in check.found
    command, _, packages = check.remedy.partition(" install ")
    assert command == f"{sys.executable} -m pip"
    assert {package.partition("<")[0].partition(">")[0] for package in packages.split()} == {
        "'drjit",
        "'mitsuba",
    }


def test_a_full_disk_and_a_locked_home_are_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert doctor.check_kernel_cache(tmp_path).ok
    monkeypatch.setattr(doctor.os, "access", lambda path, mode: False)
    assert "chown" in doctor.check_kernel_cache(tmp_path).remedy
    monkeypatch.setattr(doctor, "MINIMUM_FREE_GB", 1e9)
    assert "--out" in doctor.check_disk(tmp_path).remedy


def test_a_machine_without_loopback_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object, **__: object) -> socket.socket:
        raise OSError("Cannot assign requested address")

    assert doctor.check_loopback().ok
    monkeypatch.setattr(doctor.socket, "create_server", refused)
    check = doctor.check_loopback()
    assert (check.ok, check.remedy) == (False, "sudo ip link set lo up")


def test_a_base_install_is_whole_and_one_command_adds_every_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    base = {requirement.name for requirement in doctor._requirements("")}
    versions = {name: doctor._version(name) for name in base}
    monkeypatch.setattr(doctor, "_version", versions.get)
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)

    def none() -> drjit_setup.LlvmLibrary:
        raise SetupError("no libLLVM of version 16 or newer")

    monkeypatch.setattr(drjit_setup, "choose_llvm", none)
    checks = [doctor.check_base(), *map(doctor.check_extra, doctor.EXTRAS), doctor.check_sumo()]
    checks.append(doctor.check_llvm())
    assert [check.extra for check in checks if not check.ok] == [*doctor.EXTRAS, "world", "channel"]
    assert doctor.exit_status(checks) == 0
    text = shown(checks, width=200)
    assert text.count("pip install") == 1
    assert f"install 'caviar-sim[{','.join(doctor.EXTRAS)}]'" in text
    assert f"  {drjit_setup.INSTALL}\n" in text, "pip brings no LLVM"
    ready, count = re.search(r"Ready: (\d+) of the (\d+) shipped scenarios run here", text).groups()
    assert 0 < int(ready) < int(count)
    assert "the others need channel, sensors, world, panda3d (`caviar scenarios`" in text


def test_every_extra_stands_on_the_page_about_installing(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    page = (repository / "docs" / "howto" / "install.md").read_text()
    extras = {*project["optional-dependencies"]} - {"bench", "dev", "docs"}  # of those who work on CAVIAR
    assert {extra for extra in extras if f"| `{extra}` | " not in page} == set()
    assert {*doctor.EXTRAS} <= extras
    assert "datasets" in doctor.EXTRAS
