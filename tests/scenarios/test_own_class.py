"""A class of the user's own in a scenario: `use = "module:Class"`."""

from __future__ import annotations

from pathlib import Path

from scenarios_support import ROOT, run

from caviar_clients.cli.scenarios import new_scenario


def test_the_agent_of_the_contributing_page_runs_from_beside_its_scenario(tmp_path: Path) -> None:
    page = (ROOT / "CONTRIBUTING.md").read_text()
    (code,) = (block for block in page.split("```python\n") if "class Mine(Agent)" in block)
    (tmp_path / "my_agent.py").write_text(code.partition("```")[0])
    path = new_scenario(str(tmp_path / "own"))
    path.write_text(path.read_text().replace('use = "los-beam"', 'use = "my_agent:Mine"'))
    finished = run(path, tmp_path / "runs", "--frames", "3")
    assert finished.status == 0, finished.output
    assert "3/3" in finished.output
