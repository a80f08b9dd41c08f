"""Examples in docstrings and pages run, and print what they say.

In a docstring an example is a doctest; in a page it is a fenced block of ``python``, and the blocks of a page
are run one after the other. There ``value  # → text`` says what ``print(value)`` prints. They run in a folder
with a recorded run, `RUN`; names that the text around an example takes for granted are those of `GIVEN`.
"""

from __future__ import annotations

import ast
import doctest
import importlib
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from recording_builders import record_run

from caviar_protocol.scenario import find_scenario, parse_scenario

pytestmark = pytest.mark.slow

PACKAGES = (
    "caviar_protocol",
    "caviar_space",
    "caviar_broker",
    "caviar_services",
    "caviar_bridges",
    "caviar_clients",
    "caviar_formats",
    "caviar_labs",
    "caviar",
)
ROOT = Path(__file__).parents[2]
RUN = "runs/smoke-20261122-101500"
ELSEWHERE = {
    **dict.fromkeys(
        (str(page.relative_to(ROOT)) for page in ROOT.glob("docs/tutorials/*.md")),
        "tests/scenarios/test_tutorials.py",
    ),
    "README.md": "tests/scenarios/test_readme.py",
    "docs/howto/airsim.md": "tests/scenarios/test_airsim.py",
    "docs/howto/beam-agents.md": "tests/scenarios/test_learning_agents.py",
    "protocol/SPEC.md": "tests/unit/test_protocol_spec.py",
}
"""Pages whose examples need processes of their own, and the test that runs them."""


def _clock() -> dict[str, Any]:
    from core_harness import Simulation, agent

    from caviar_broker.core.events import Joined
    from caviar_protocol.messages import PROTOCOL_VERSION, Hello

    hello = Hello(version=PROTOCOL_VERSION, name="agent", role="agent")
    return {"plan": Simulation([agent()]).plan, "now": 0, "event": Joined(hello)}


def _keyframes() -> dict[str, Any]:
    """Free space between a base station and a car, at 0 s, 0.2 s and 0.5 s."""
    from recording_builders import channel, scene

    return {
        "channel_0": channel(0, 2),
        "channel_1": channel(5, 2),
        "scene_0": scene(0, 2),
        "scene_1": scene(5, 2),
        "scene_at_200_ms": scene(2, 2),
    }


def _channel_model() -> dict[str, Any]:
    from caviar_services.channel.statistical.free_space import FreeSpaceChannel

    return {"MyModel": FreeSpaceChannel, "MyChannel": FreeSpaceChannel}


def _wideband() -> dict[str, Any]:
    """Two frames of `smoke` with both wideband parts."""
    text = find_scenario("smoke").read_text()
    keys = "subcarriers = 264\nsubcarrier_spacing_hz = 120e3\ntaps = 64\nslots = 4\nslot_duration_s = 125e-6"
    text = text.replace("[[carriers]]", f"[[carriers]]\n{keys}")
    text = re.sub(r"(?m)^frames = .*", "frames = 2", text)
    text = re.sub(
        r"(?m)^record = .*", 'record = ["scene", "channel", "channel.hf", "channel.taps", "link"]', text
    )
    run = Path("runs/smoke-wideband")
    record_run(run, parse_scenario(text, folder=find_scenario("smoke").parent))
    return {}


def _packets() -> dict[str, Any]:
    """240 frames of `cell`: up to the first handovers."""
    text = re.sub(r"(?m)^frames = .*", "frames = 240", find_scenario("cell").read_text())
    record_run(Path("runs/cell"), parse_scenario(text, folder=find_scenario("cell").parent))
    return {}


def _dataset() -> dict[str, Any]:
    """A dataset of `smoke`."""
    import caviar
    from caviar_clients.datasets.catalogue import Catalogue
    from caviar_clients.datasets.directory import DatasetDirectory, writing_dataset
    from caviar_clients.datasets.episode import EpisodeTask, play_episode
    from caviar_clients.datasets.plan import plan_dataset
    from caviar_protocol.scenario import load_scenario

    directory = DatasetDirectory(Path("data/s008"))
    plan = plan_dataset(load_scenario("smoke"), episodes=2, scenes=2)
    with writing_dataset(directory):
        catalogue = Catalogue(directory.catalogue, writable=True)
        for number in range(plan.episodes):
            rows = play_episode(EpisodeTask(plan.scenario, number, str(directory.path))).rows
            assert rows is not None
            catalogue.add(rows, {})
        catalogue.close()
    return {"caviar": caviar}


GIVEN: dict[str, Callable[[], dict[str, Any]]] = {
    "CONTRIBUTING.md": _channel_model,
    "docs/howto/datasets.md": _dataset,
    "docs/howto/packets.md": _packets,
    "docs/howto/wideband.md": _wideband,
    "docs/topics/channel.md": _keyframes,
    "caviar_broker.core.clock": _clock,
    "caviar_services.testing": _channel_model,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a recorded run of `smoke` and, as in a checkout, the example clients."""
    place = tmp_path_factory.mktemp("examples")
    (place / "clients").symlink_to(ROOT / "clients")
    record_run(place / RUN)
    return place


def pages() -> list[str]:
    """Pages with examples, below the checkout."""
    found = [
        file
        for folder in ("", "docs", "protocol", "broker", "services", "clients", "deploy", "examples")
        for file in ((ROOT / folder).rglob("*.md") if folder else ROOT.glob("*.md"))
    ]
    return [str(file.relative_to(ROOT)) for file in sorted(found) if "```python\n" in file.read_text()]


@pytest.mark.parametrize("page", [page for page in pages() if page not in ELSEWHERE])
def test_the_examples_of_a_page_run(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    names = GIVEN.get(page, dict)()
    for line, code in blocks((ROOT / page).read_text()):
        for expression, printed, number in run_block(code, page, line, names):
            expected = re.search(r"# → (.*)", code.splitlines()[number - line])
            if expected:
                assert str(printed) == expected[1], f"{page}:{number}: {expression}"


def blocks(text: str) -> Iterator[tuple[int, str]]:
    """Each fenced block of Python with the number of its first line."""
    for found in re.finditer(r"^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        yield text.count("\n", 0, found.start(1)) + 1, found[1]


def run_block(code: str, page: str, line: int, names: dict[str, Any]) -> Iterator[tuple[str, Any, int]]:
    """Execute it statement by statement; of each expression its source, value and line."""
    tree = ast.parse(code)
    ast.increment_lineno(tree, line - 1)
    for statement in tree.body:
        if isinstance(statement, ast.Expr):
            value = eval(compile(ast.Expression(statement.value), page, "eval"), names)  # noqa: S307
            yield ast.unparse(statement), value, statement.lineno
        else:
            exec(compile(ast.Module([statement], []), page, "exec"), names)  # noqa: S102


def sources() -> Iterator[tuple[str, str]]:
    """Name and text of every module of the packages."""
    for package in PACKAGES:
        component = package.removeprefix("caviar_") if package != "caviar" else "clients"
        folder = ROOT / component / package
        for file in sorted(folder.rglob("*.py")):
            parts = file.relative_to(folder.parent).with_suffix("").parts
            yield ".".join(parts).removesuffix(".__init__"), file.read_text()


def test_the_examples_of_docstrings_run(
    folder: Path, monkeypatch: pytest.MonkeyPatch, pytestconfig: pytest.Config
) -> None:
    monkeypatch.chdir(folder)
    heap = pytestconfig.pluginmanager.get_plugin("frozen-heap")
    assert heap is not None
    finder, runner = doctest.DocTestFinder(exclude_empty=True), doctest.DocTestRunner(verbose=False)
    ran = set()
    for name in [name for name, text in sources() if ">>> " in text]:
        for test in finder.find(importlib.import_module(name)):
            if test.examples:
                test.globs = {**test.globs, **GIVEN.get(test.name, dict)()}
                assert not runner.run(test, out=sys.stdout.write).failed, f"the example of {test.name}"
                ran.add(test.name)
        heap.freeze()
    assert "caviar_protocol.recording" in ran


def test_no_docstring_has_code_that_is_not_run() -> None:
    """A literal block of Python that is no doctest would grow wrong in silence."""
    unrun = []
    for name, text in sources():
        for node in ast.walk(ast.parse(text)) if "::\n" in text else ():
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
                docstring = ast.get_docstring(node) or ""
                unrun += [f"{name}: {code}" for code in literal_blocks(docstring) if is_python(code)]
    assert not unrun, "\n".join(unrun)


def literal_blocks(text: str) -> list[str]:
    """What stands indented after ``::``."""
    return [found[1] for found in re.finditer(r"::\n\n((?:    .*\n|\n)+)", text + "\n")]


def is_python(code: str) -> bool:
    """Whether it is Python; a doctest is not."""
    try:
        ast.parse("\n".join(line[4:] for line in code.splitlines()))
    except SyntaxError:
        return False
    return True
