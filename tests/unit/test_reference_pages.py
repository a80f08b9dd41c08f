"""The generated reference has every command with its options, every key of a scenario, and every module."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import pytest
import typer

from caviar_clients.cli.main import app
from caviar_protocol.scenario.schema import DeviceSpec, Limits, Run, ServiceSpec, Timeouts
from caviar_services.registry import settings_classes

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def reference() -> ModuleType:
    pytest.importorskip("sphinx", reason="needs the extra `docs`")
    sys.path.insert(0, str(ROOT / "docs"))
    try:
        import reference_pages
    finally:
        sys.path.remove(str(ROOT / "docs"))
    return reference_pages


def test_every_command_has_a_page_with_its_options(reference: ModuleType) -> None:
    pages = dict(reference.commands.pages())
    root: Any = typer.main.get_command(app)
    context = root.context_class(root)
    commands = {name: root.get_command(context, name) for name in root.list_commands(context)}
    assert {"run", "dataset", "export", "import", "scene", "view", "measure", "paper", "conform"} <= set(
        commands
    )
    assert set(pages) == {"index.md", *(f"{name}.md" for name in commands)}
    for name, command in commands.items():
        for parameter in command.params:
            for option in parameter.opts if parameter.param_type_name == "option" else ():
                assert f"`{option}`" in pages[f"{name}.md"]
    assert "| `--frames` INTEGER ≥ 1 ≤ 10000 | `12` |" in pages["measure.md"]


def test_every_key_of_a_scenario_stands_on_a_page(reference: ModuleType) -> None:
    pages = dict(reference.scenario_keys.pages())
    for cls in (Run, Timeouts, Limits, ServiceSpec, DeviceSpec):
        assert all(f"\n| `{field.name}` | " in pages["index.md"] for field in msgspec.structs.fields(cls))
    for (role, name), cls in settings_classes().items():
        page = pages[f"settings-{role}.md"]
        assert f"\n## {name}\n" in page
        assert all(f"\n| `{field.name}` | " in page for field in msgspec.structs.fields(cls))
    assert (
        "| `sampling_period_ns` | T_sam, from one frame to the next. | int, > 0 | ns | `100000000` |"
        in pages["index.md"]
    )


def test_every_key_has_a_meaning(reference: ModuleType) -> None:
    rows = [
        line for _, page in reference.scenario_keys.pages() for line in page.splitlines() if line[:3] == "| `"
    ]
    assert len(rows) > 150
    assert not [row for row in rows if row.split(" | ")[1] in ("", ".")]


def test_every_module_stands_on_the_page_of_its_package(reference: ModuleType) -> None:
    text = "".join(page for name, page in reference.api.pages() if name.endswith(".rst"))
    for folder in ("protocol", "broker", "services", "clients"):
        for file in sorted((ROOT / folder / f"caviar_{folder}").rglob("*.py")):
            module = ".".join(file.relative_to(ROOT / folder).with_suffix("").parts).removesuffix(".__init__")
            if "__main__" not in module:
                assert f".. automodule:: {module}\n" in text


def test_the_path_of_a_frame_goes_through_every_role(reference: ModuleType) -> None:
    calls = reference.frame_path.traced_calls(2)
    modules = [module for module, _ in calls]
    assert len(calls) == len(set(calls)) > 50
    stations = ["world", "channel", "link", "recorder"]
    first = [
        next(at for at, module in enumerate(modules) if f"services.{role}." in module) for role in stations
    ]
    assert first == sorted(first)
    assert "caviar_broker.core.clock" in modules


def test_stars_and_bars_in_docstrings_are_characters(reference: ModuleType) -> None:
    lines = ["|y| of ``a | b``", "* a bullet with w* H f", "*emphasis*, **bold** and 2*3"]
    code = [">>> f(*a)", "as in::", "", "    2*3", ""]
    text = [*lines, *code, "2*3"]
    reference.api.finish_docstring(None, "data", "x", 0, None, text)
    expected = [r"\|y\| of ``a | b``", r"* a bullet with w\* H f", r"*emphasis*, **bold** and 2\*3"]
    assert text == [*expected, *code, r"2\*3"]
