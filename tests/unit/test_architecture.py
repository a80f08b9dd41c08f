"""The packages stand on a light base install, and ship what they promise."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

pytestmark = pytest.mark.slow

PACKAGES = (
    "caviar_protocol",
    "caviar_space",
    "caviar_view",
    "caviar_broker",
    "caviar_services",
    "caviar_bridges",
    "caviar_clients",
    "caviar_formats",
    "caviar_labs",
    "caviar_scenes",
    "caviar",
)
HEAVY = (
    "mitsuba", "drjit", "sionna", "torch", "libsumo", "sumolib", "traci", "sumo", "matplotlib",
    "scipy", "numba", "pytest", "hypothesis", "dask", "distributed", "duckdb", "h5py", "nanoarrow", "PIL",
    "pyproj",
)  # fmt: skip

IMPORT_EVERYTHING = f"""
import importlib, pkgutil, sys

class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {HEAVY!r}:
            raise ImportError(f"{{name}} is not part of the base install")

sys.meta_path.insert(0, Hidden())
count = 0
for package in {PACKAGES!r}:
    root = importlib.import_module(package)
    for module in pkgutil.walk_packages(root.__path__, package + "."):
        if module.name.endswith("__main__") or module.name.split(".")[1:2] == ["testing"]:
            continue  # the conformance tests are for pytest; __main__ runs
        importlib.import_module(module.name)
        count += 1
print(count)
"""


def test_every_module_imports_on_the_base_install() -> None:
    """Heavy libraries are imported by the functions that need them, so hiding them changes nothing."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", IMPORT_EVERYTHING], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout) > 30


@pytest.fixture(scope="module")
def built(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel and the source distribution of this checkout."""
    folder = tmp_path_factory.mktemp("dist")
    done = subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-d", str(folder)],
        cwd=repository, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    return folder


def test_the_wheel_has_the_four_packages_typed_and_licensed_and_the_scenarios(built: Path) -> None:
    (wheel,) = built.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.partition("/")[0] for name in names}
    assert tops - {f"{wheel.name.split('-py3')[0]}.dist-info"} == {*PACKAGES, "caviar_scenarios"}
    assert "caviar_scenarios/smoke.toml" in names
    assert "caviar_scenarios/street-canyon/canyon.net.xml" in names
    assert "caviar_scenarios/new/scenario.toml" in names
    for package in PACKAGES:
        assert f"{package}/py.typed" in names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert any(name.endswith("entry_points.txt") for name in names)


def test_the_source_distribution_builds_and_carries_no_recordings(built: Path) -> None:
    (archive,) = built.glob("*.tar.gz")
    with tarfile.open(archive) as content:
        names = [name.partition("/")[2] for name in content.getnames()]
    assert {"pyproject.toml", "LICENSE", "README.md", "Makefile"} <= set(names)
    folders = {name.partition("/")[0] for name in names if "/" in name}
    assert folders <= {"protocol", "broker", "services", "clients", "deploy", "docs", "tests", "tools"}
    assert not [name for name in names if name.endswith((".mcap", ".pyc", ".png"))]


def _names(requirements: list[str]) -> set[str]:
    return {Requirement(requirement).name for requirement in requirements}


def test_users_are_asked_for_nothing_heavy_and_for_no_copyleft(repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text())["project"]
    heavy = {"sionna-rt", "mitsuba", "drjit", "eclipse-sumo", "libsumo", "torch", "matplotlib", "scipy"}
    heavy.add("numba")
    assert not _names(project["dependencies"]) & heavy
    for extra, requirements in project["optional-dependencies"].items():
        if extra != "dev":  # GPL packages may at most be compared with in tests
            assert "deepmimo" not in _names(requirements), extra


def test_images_are_built_from_all_that_the_wheel_holds(repository: Path) -> None:
    """Else the broker of a container would not know the scenarios by their names."""
    project = tomllib.loads((repository / "pyproject.toml").read_text())
    let_in = (repository / ".dockerignore").read_text().splitlines()
    for package in project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        assert {f"!{package}", f"!{package.partition('/')[0]}"} & {*let_in}, package


def test_the_demo_installs_neither_learning_nor_tools_of_the_tests(repository: Path) -> None:
    extras = tomllib.loads((repository / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert "extras=all " in (repository / "deploy" / "setup.sh").read_text()
    (parts,) = [Requirement(line).extras for line in extras["all"]]
    installed = set().union(*(_names(extras[part]) for part in parts))
    assert "sionna-rt" in installed
    assert not installed & {"torch", *_names(extras["learning"]), *_names(extras["dev"])}
