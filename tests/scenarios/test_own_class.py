"""A class of the user's own in a scenario: `use = "module:Class"`."""

from __future__ import annotations

from pathlib import Path

import pytest
from scenarios_support import ROOT, run, run_as_printed

from caviar_clients.cli.radio_map import channel_of
from caviar_clients.cli.scenarios import new_scenario
from caviar_clients.session.scenes import scene_at
from caviar_protocol.errors import RunError


def test_the_agent_of_the_contributing_page_runs_from_beside_its_scenario(tmp_path: Path) -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text()
    (code,) = (block for block in page.split("```python\n") if "class Mine(Agent)" in block)
    (tmp_path / "my_agent.py").write_text(code.partition("```")[0])
    path = new_scenario(str(tmp_path / "own"))
    path.write_text(path.read_text().replace('use = "los-beam"', 'use = "my_agent:Mine"'))
    finished = run(path, tmp_path / "runs", "--frames", "3")
    assert finished.status == 0, finished.output
    assert "3/3" in finished.output


def hostile(folder: Path, *modules: str) -> None:
    """Write modules that say so when they are imported."""
    for module in modules:
        (folder / f"{module}.py").write_text(f"open({str(folder / 'imported')!r}, 'a').write({module!r})\n")


def test_no_file_of_the_current_folder_is_imported_in_place_of_a_library_nor_to_look(tmp_path: Path) -> None:
    (tmp_path / "evil.py").write_text(
        "from caviar_services.agent.baselines import LosBeamAgent\n"
        "from caviar_services.channel.statistical.free_space import FreeSpaceChannel\n"
        "class Mine(LosBeamAgent): pass\n"
        "class Air(FreeSpaceChannel): pass\n"
    )
    text = (ROOT / "deploy" / "caviar_scenarios" / "smoke.toml").read_text()
    text = text.replace('use = "los-beam"', 'use = "evil:Mine"')
    (tmp_path / "mine.toml").write_text(text.replace('use = "free-space"', 'use = "evil:Air"'))
    hostile(tmp_path, "random", "signal", "types", "queue", "threading")
    size = ["--episodes", "1", "--scenes", "1", "--workers", "1"]
    run_as_printed(["caviar", "run", "mine.toml", "--frames", "2", "--out", "r"], tmp_path)
    run_as_printed(["caviar", "generate", "mine.toml", "--out", "d", *size], tmp_path)
    assert not (tmp_path / "imported").exists()
    hostile(tmp_path, "evil")
    (directory,) = (tmp_path / "r").iterdir()
    for command, path in (("inspect", directory), ("plot", directory), ("verify", "d")):
        run_as_printed(["caviar", command, path], tmp_path)
    scenes = scene_at(directory)
    with pytest.raises(RunError, match="module:Class, which are not loaded"):
        channel_of(scenes, scenes.instants[0].scene)
    assert not (tmp_path / "imported").exists()
