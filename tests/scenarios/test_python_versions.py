"""The wheel, installed by pip on its own, on every Python that this machine has.

Each environment lies in ``.venvs`` and is made anew only when its requirements change. One has the oldest
versions of them that pyproject.toml allows, the others the newest.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from scenarios_support import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
REQUIREMENTS = [Requirement(line) for line in PROJECT["dependencies"]]
PREFIX = "Programming Language :: Python :: "
VERSIONS = tuple(line.removeprefix(PREFIX) for line in PROJECT["classifiers"] if line.startswith(PREFIX))
OLDEST = "oldest"
THIS = f"{sys.version_info.major}.{sys.version_info.minor}"
ENVIRONMENTS = (OLDEST, *(version for version in VERSIONS if version != THIS))
NEWEST_ALONE = [
    pytest.param(label, marks=() if label == ENVIRONMENTS[-1] else pytest.mark.exhaustive)
    for label in ENVIRONMENTS
]
"""The others are left to the long form."""
"""The newest requirements on this Python are those of the tests at large."""
CACHE = ROOT / ".venvs"
GENERATED = ("codec", "keys", "messages", "multipath", "recording_reader")
"""Modules of the protocol whose tests generate inputs for most of a minute."""
WIRE = (
    "arrays",
    "codec_nesting",
    "digest",
    "scenario_conversion",
    "scenario",
    "space_scene",
    "validation",
)
"""Modules of the protocol that lean most on the Python and the libraries at hand."""
TEST_TOOLS = ("hypothesis", "psutil", "pytest", "pytest-timeout")


@dataclass(frozen=True)
class Environment:
    """A virtual environment with the base install and the wheel of this checkout."""

    folder: Path

    @property
    def python(self) -> Path:
        """Its interpreter."""
        return self.folder / "bin" / "python"


def interpreter(version: str) -> Path | None:
    """A Python of this version: of the PATH, or one that pyenv has."""
    found = shutil.which(f"python{version}")
    if found and _answers(Path(found), version):
        return Path(found)
    home = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    candidates = sorted(home.glob(f"versions/{version}*/bin/python"))
    return next((path for path in candidates if _answers(path, version)), None)


def _answers(python: Path, version: str) -> bool:
    """Whether it runs and is that version: a shim of pyenv may name one that is not selected."""
    show = "import sys, venv; print(*sys.version_info[:2], sep='.')"
    done = subprocess.run([python, "-c", show], capture_output=True, text=True, timeout=120)
    return done.returncode == 0 and done.stdout.strip() == version


def constraints(label: str) -> list[str]:
    """What pip is given beyond the requirements: for the oldest environment, their floors."""
    if label != OLDEST:
        return []
    return [f"{need.name}=={floor.version}" for need in REQUIREMENTS for floor in need.specifier]


def prepare(label: str, python: Path, wheel: Path) -> Environment:
    """The environment of a label with this wheel; what pip says where it cannot be made."""
    needs = [*map(str, REQUIREMENTS), *constraints(label), *TEST_TOOLS]
    key = hashlib.sha256(json.dumps([str(python), *needs]).encode()).hexdigest()[:12]
    environment = Environment(CACHE / f"{label}-{key}")
    ready = environment.folder / "ready"
    if not ready.exists():
        for outdated in CACHE.glob(f"{label}-*"):
            shutil.rmtree(outdated)
        _run([python, "-m", "venv", "--without-pip", environment.folder])
        _pip(environment, *needs)
        ready.touch()
    _pip(environment, "--no-deps", "--force-reinstall", str(wheel))
    return environment


def _pip(environment: Environment, *arguments: str) -> None:
    """Install with the pip of this Python. Bytecode is left to the imports."""
    pip = [sys.executable, "-m", "pip", "--python", environment.python, "--quiet", "--no-input"]
    options = ("--disable-pip-version-check", "--prefer-binary", "--no-compile")
    _run([*pip, "install", *options, *arguments])


def _run(command: list[str | Path], folder: Path = ROOT, **extra: str) -> str:
    done = subprocess.run(
        command, cwd=folder, env=os.environ | extra, capture_output=True, text=True, timeout=400
    )
    assert done.returncode == 0, f"{command}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def environments(
    tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config
) -> dict[str, Environment]:
    """The environments of the tests that are run, as far as their Python is here, made at the same time."""
    labels = ENVIRONMENTS if pytestconfig.getoption("--all") else ENVIRONMENTS[-1:]
    dist = tmp_path_factory.mktemp("dist")
    _run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(dist)])
    (wheel,) = dist.glob("*.whl")
    pythons = {label: interpreter(THIS if label == OLDEST else label) for label in labels}
    with ThreadPoolExecutor(2) as pool:
        made = {
            label: pool.submit(prepare, label, python, wheel)
            for label, python in pythons.items()
            if python is not None
        }
        return {label: future.result() for label, future in made.items()}


@pytest.fixture(scope="module")
def smoke_digest(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Digest of `smoke` on the Python of this test."""
    return digest_of_smoke([sys.executable, "-m", "caviar_clients"], tmp_path_factory.mktemp("here"))


def digest_of_smoke(caviar: list[str | Path], folder: Path) -> str:
    """Run `smoke` by its name, every service as a process, in a folder that is empty."""
    _run([*caviar, "run", "smoke", "--json", "figures.json"], folder)
    figures = json.loads((folder / "figures.json").read_text())
    assert figures["complete"]
    return str(figures["digest"])


@pytest.mark.timeout(600)
@pytest.mark.parametrize("label", NEWEST_ALONE)
def test_the_wheel_runs_smoke_by_name_with_the_same_digest(
    label: str, environments: dict[str, Environment], smoke_digest: str, tmp_path: Path
) -> None:
    environment = _present(label, environments)
    assert digest_of_smoke([environment.folder / "bin" / "caviar"], tmp_path) == smoke_digest


@pytest.mark.exhaustive
@pytest.mark.timeout(600)
@pytest.mark.parametrize("label", ENVIRONMENTS)
def test_the_protocol_passes_its_vectors_and_unit_tests(
    label: str, environments: dict[str, Environment]
) -> None:
    """Of the unit tests those of the wire: the others run on every Python in the long form."""
    wire = [ROOT / "tests" / "unit" / f"test_protocol_{name}.py" for name in WIRE]
    vectors = ROOT / "tests" / "vectors" / "test_protocol_vectors.py"
    run_tests(_present(label, environments), [vectors, *wire])


@pytest.mark.exhaustive
@pytest.mark.timeout(600)
@pytest.mark.parametrize("label", ENVIRONMENTS)
def test_the_protocol_passes_its_other_unit_tests(label: str, environments: dict[str, Environment]) -> None:
    units = set((ROOT / "tests" / "unit").glob("test_protocol_*.py")) - set(_generated())
    run_tests(_present(label, environments), sorted(units))


@pytest.mark.exhaustive
@pytest.mark.timeout(600)
@pytest.mark.parametrize("label", ENVIRONMENTS)
def test_the_protocol_passes_its_generated_tests(label: str, environments: dict[str, Environment]) -> None:
    run_tests(_present(label, environments), _generated())


def _generated() -> list[Path]:
    return [ROOT / "tests" / "unit" / f"test_protocol_{name}.py" for name in GENERATED]


def run_tests(environment: Environment, files: list[Path]) -> None:
    """Run test modules in an environment; AssertionError with what pytest says where one fails."""
    _run(
        [environment.python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files],
        PYTHONDONTWRITEBYTECODE="1",
    )


def _present(label: str, environments: dict[str, Environment]) -> Environment:
    if label not in environments:
        pytest.skip(f"Python {label} is not on this machine")
    return environments[label]
