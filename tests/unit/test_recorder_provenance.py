"""What a run follows from: versions of the packages that its services compute with, and code of the user."""

from __future__ import annotations

import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import msgspec
import pytest

from caviar_clients.datasets.episode import MEASURED, EpisodeTask, play_episode
from caviar_clients.datasets.plan import plan_dataset
from caviar_clients.datasets.settings import differences
from caviar_protocol.recording import Recording
from caviar_protocol.scenario import load_scenario, parse_scenario
from caviar_services.recorder import provenance
from caviar_services.recorder.provenance import code_digests, installed_versions, used_versions
from caviar_services.registry import load, registered

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"
BASE = {"caviar-sim", "lz4", "mcap", "msgspec", "numpy", "python", "zstandard"}


def scenario(**settings: dict[str, Any]) -> dict[str, Any]:
    """A recorder and services by ``role__implementation``."""
    uses = {"recorder__mcap": {}, **settings}
    services = {}
    for name, values in uses.items():
        role, _, use = name.partition("__")
        use = use if ":" in use else use.replace("_", "-")
        services[name] = {"role": role, "use": use, "settings": values}
    return {"services": services}


@pytest.fixture
def every_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """All packages are installed, of version 7."""
    monkeypatch.setattr(provenance, "_version", lambda name: "7")


@pytest.mark.parametrize(
    ("services", "more"),
    [
        ({"channel__free_space": {}, "agent__random": {}}, set()),
        ({"agent__policy": {}}, {"onnxruntime"}),
        ({"world__sumo": {}}, {"eclipse-sumo", "libsumo"}),
        ({"world__sumo": {"scenery": "sionna:munich"}}, {"eclipse-sumo", "libsumo", "sionna-rt"}),
        ({"sensors__lidar": {}}, {"mitsuba", "drjit"}),
        ({"channel__adaptive": {"ladder": [{"use": "free-space"}]}}, set()),
        (
            {"channel__adaptive": {"ladder": [{"label": "2e3"}], "reference": {"use": "geometric"}}},
            {"sionna-rt", "mitsuba", "drjit", "scipy"},
        ),
        ({"link__cell": {"rate_model": "nr"}}, {"sionna", "torch"}),
        ({"world__flight": {"objects": [{"engine": "mujoco"}]}}, {"mujoco"}),
        ({"world__remote": {}}, set()),
    ],
)
def test_the_packages_of_the_services_count_and_no_others(
    services: dict[str, Any], more: set[str], every_package: None
) -> None:
    assert set(used_versions(scenario(**services))) == BASE | more


def test_every_package_that_a_service_names_is_required_by_an_extra_or_the_base() -> None:
    required = {line.partition(" ")[0] for line in metadata.requires("caviar-sim") or ()}
    names = {provenance.re.split(r"[^A-Za-z0-9._-]", line, maxsplit=1)[0] for line in required}
    for key in registered():
        packages = set(load(*key.split(":")).packages)
        assert packages - {"zstandard"} <= names, key  # which mcap brings


def test_what_else_is_installed_changes_no_byte_and_stands_beside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A recording and the settings of the dataset are the same; `measured.json` has the whole list."""
    plan = plan_dataset(load_scenario(SMOKE), episodes=1, scenes=2)
    before, found = plan.settings(), []
    version, more = provenance._version, {"panda3d": "99.1", "duckdb": "99.2", "scipy": "99.3"}
    everything = {**installed_versions(), **more}
    for name in ("one", "two"):
        if name == "two":
            monkeypatch.setattr("caviar_clients.datasets.episode.installed_versions", lambda: everything)
            monkeypatch.setattr("caviar_services.recorder.mcap.installed_versions", lambda: everything)
            monkeypatch.setattr(provenance, "_version", lambda name: more.get(name) or version(name))
        (tmp_path / name / "episodes").mkdir(parents=True)
        assert play_episode(EpisodeTask(plan.scenario, 0, str(tmp_path / name))).error == ""
        episode = tmp_path / name / "episodes" / "episode-000000"
        found.append((episode / "recording-0000.mcap").read_bytes())
    assert list(differences(before, plan.settings())) == []
    assert found[0] == found[1]
    beside = msgspec.json.decode((episode / MEASURED).read_bytes())["versions"]
    assert (beside["panda3d"], beside["numpy"]) == ("99.1", before["versions"]["numpy"])


AGENT = """
import helper_of_mine
from caviar_services.agent.baselines import RandomAgent
class Mine(RandomAgent):
    def step(self, frame):
        import msgspec_lookalike
        return super().step(frame)
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scenario with an agent of its own, which imports modules beside it."""
    (tmp_path / "agent_of_mine.py").write_text(AGENT)
    (tmp_path / "helper_of_mine.py").write_text("BEAM = 1\n")
    (tmp_path / "msgspec_lookalike.py").write_text("import numpy\n")
    (tmp_path / "not_imported.py").write_text("")
    (tmp_path / "pack_of_mine" / "inner").mkdir(parents=True)  # which has no __init__.py
    (tmp_path / "pack_of_mine" / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("agent_of_mine", "helper_of_mine", "msgspec_lookalike"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return tmp_path


def test_code_of_the_user_is_a_part_of_what_a_dataset_is(own: Path) -> None:
    text = SMOKE.read_text().replace('use = "los-beam"', 'use = "agent_of_mine:Mine"', 1)
    plan = plan_dataset(parse_scenario(text), episodes=1, scenes=2)
    before = plan.settings()
    assert list(before["code"]) == ["agent_of_mine"]
    (own / "not_imported.py").write_text("x = 1\n")
    assert plan.settings() == before
    for file in ("agent_of_mine.py", "helper_of_mine.py", "msgspec_lookalike.py"):
        was = plan.settings()
        with (own / file).open("a") as stream:
            stream.write("# edited\n")
        (found,) = differences(was, plan.settings())
        assert found == "agent_of_mine.py, or a module that it imports, has changed"


def test_the_code_stands_in_recordings(own: Path) -> None:
    text = SMOKE.read_text().replace('use = "los-beam"', 'use = "agent_of_mine:Mine"', 1)
    plan = plan_dataset(parse_scenario(text), episodes=1, scenes=2)
    (own / "d" / "episodes").mkdir(parents=True)
    assert play_episode(EpisodeTask(plan.scenario, 0, str(own / "d"))).error == ""
    versions = Recording(own / "d" / "episodes" / "episode-000000").metadata.versions
    assert versions["code of agent_of_mine"] == plan.settings()["code"]["agent_of_mine"][:16]


def test_what_a_module_of_a_package_imports_counts(own: Path) -> None:
    services = {"services": {"a": {"role": "agent", "use": "pack_of_mine.inner.agents:Theirs"}}}
    package = own / "pack_of_mine"
    (package / "inner" / "agents.py").write_text("from . import beams\nfrom ..shared import powers as p\n")
    for name in ("inner/beams.py", "shared/__init__.py", "shared/powers.py", "inner/not_imported.py"):
        (package / name).parent.mkdir(exist_ok=True)
        (package / name).write_text("import numpy.linalg, json\n")
    before = code_digests(services)
    assert list(before) == ["pack_of_mine.inner.agents"]
    counted = []
    for file in sorted(package.rglob("*.py")):
        with file.open("a") as stream:
            stream.write("# edited\n")
        counted += [file.relative_to(package).as_posix()] if code_digests(services) != before else []
        before = code_digests(services)
    assert counted == [
        "__init__.py", "inner/agents.py", "inner/beams.py", "shared/__init__.py", "shared/powers.py",
    ]  # fmt: skip


def test_modules_that_are_installed_count_by_the_version_of_what_brings_them(own: Path) -> None:
    folder = own / "lib" / "site-packages"
    folder.mkdir(parents=True)
    before = code_digests(scenario(**{"agent__agent_of_mine:Mine": {}}))
    (own / "helper_of_mine.py").rename(folder / "helper_of_mine.py")
    sys.path.append(str(folder))
    try:
        moved = code_digests(scenario(**{"agent__agent_of_mine:Mine": {}}))
        (folder / "helper_of_mine.py").write_text("BEAM = 2\n")
        assert code_digests(scenario(**{"agent__agent_of_mine:Mine": {}})) == moved != before
    finally:
        sys.path.remove(str(folder))


def test_a_rung_of_the_user_counts(own: Path) -> None:
    ladder = [{"use": "agent_of_mine:Mine"}]
    assert list(code_digests(scenario(channel__adaptive={"ladder": ladder}))) == ["agent_of_mine"]


def test_packages_that_code_of_the_user_imports_count_by_version(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (own / "helper_of_mine.py").write_text("def f():\n    from yaml.nodes import Node\n    import json\n")
    monkeypatch.setattr(provenance, "_distributions", lambda: {"yaml": ["PyYAML"], "numpy": ["numpy"]})
    version = provenance._version
    monkeypatch.setattr(provenance, "_version", lambda name: "6.0" if name == "PyYAML" else version(name))
    services = {"services": {"a": {"role": "agent", "use": "agent_of_mine:Mine", "settings": {}}}}
    assert used_versions(services)["PyYAML"] == "6.0"


def test_files_of_one_name_and_meshes_of_scenery_are_told_apart(tmp_path: Path) -> None:
    from caviar_clients.datasets.plan import _digests, _files

    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "net.xml").write_text(folder)
    (tmp_path / "wall.ply").write_bytes(WALL)
    (tmp_path / "street.xml").write_text(STREET)
    settings = {
        "net": str(tmp_path / "a" / "net.xml"),
        "routes": [str(tmp_path / "b" / "net.xml")],
        "scenery": str(tmp_path / "street.xml"),
    }
    found = _digests(_files({"settings": settings}))
    assert list(found) == [
        "scenery/wall.ply",
        "settings.net: net.xml",
        "settings.routes[0]: net.xml",
        "street.xml",
    ]
    (tmp_path / "wall.ply").write_bytes(WALL.replace(b"9", b"8"))
    changed = differences({"files": found}, {"files": _digests(_files({"settings": settings}))})
    assert list(changed) == ["scenery/wall.ply has changed"]


WALL = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
9 0 0
0 0 9
3 0 1 2
"""
STREET = """<scene version="2.1.0">
<bsdf type="itu-radio-material" id="mat-concrete">
<string name="type" value="concrete"/><float name="thickness" value="0.1"/></bsdf>
<shape type="ply" id="wall"><string name="filename" value="wall.ply"/>
<ref id="mat-concrete" name="bsdf"/></shape>
</scene>"""
