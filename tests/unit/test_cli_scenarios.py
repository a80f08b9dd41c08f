"""`caviar scenarios` and `caviar new`, and what else a user meets first: names, help, version, completion."""

from __future__ import annotations

import io
import re
import shlex
import sys
from importlib import metadata
from pathlib import Path

import pytest
from rich.console import Console
from typer.testing import CliRunner

from caviar_clients.cli import scenarios, shared
from caviar_clients.cli.main import app
from caviar_clients.session.embedded import EmbeddedRun
from caviar_clients.session.prepared import prepare
from caviar_protocol import host
from caviar_protocol.errors import RunError, SetupError
from caviar_protocol.scenario import load_scenario, parse_scenario, shipped_scenarios
from caviar_protocol.topics import AntennaArray

runner = CliRunner()
SCENARIOS = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"
ENVIRONMENT = {"COLUMNS": "150", "TERM": "dumb"}


def listed(monkeypatch: pytest.MonkeyPatch, installed: bool) -> str:
    monkeypatch.setattr(scenarios, "has_extra", lambda extra: installed)
    console = Console(file=io.StringIO(), width=120)
    scenarios.list_scenarios(console)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_every_shipped_scenario_is_listed_with_a_line_and_what_it_needs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    text = listed(monkeypatch, installed=True)
    for name, path in shipped_scenarios().items():
        assert re.search(rf"^{name} +\w", text, re.MULTILINE), name
        assert 20 < len(scenarios.description(path.read_text())) < 160, name
    assert re.search(r"^smoke .* base install *$", text, re.MULTILINE)
    assert re.search(r"^street-canyon .* channel, sensors, world *$", text, re.MULTILINE)
    assert "pip install" not in text


def test_the_keys_that_the_file_of_a_new_scenario_advertises_are_keys() -> None:
    (line,) = re.findall(
        r"^array = .*also: (.*)", (SCENARIOS / "new" / "scenario.toml").read_text(), re.MULTILINE
    )
    assert set(line.split(", ")) <= set(AntennaArray.__struct_fields__)


def test_the_list_marks_what_is_not_installed_and_names_one_command(monkeypatch: pytest.MonkeyPatch) -> None:
    text = listed(monkeypatch, installed=False)
    assert "channel*, sensors*, world*" in text
    assert f"{sys.executable} -m pip install 'caviar-sim[channel,panda3d,sensors,world]'" in text


@pytest.mark.parametrize(
    ("name", "needed"),
    [
        ("smoke", ()),
        ("geometric", ()),
        ("remote", ()),
        ("uav-munich", ("channel", "world")),
        ("adaptive", ("channel", "world")),
        ("cameras", ("channel", "sensors", "world")),
    ],
)
def test_what_a_scenario_needs_follows_from_its_services(name: str, needed: tuple[str, ...]) -> None:
    assert scenarios.extras_of(load_scenario(name)) == needed


def test_scenes_of_sionna_come_with_either_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    pair = load_scenario("uav-pair")
    for module in (scenarios, shared):
        monkeypatch.setattr(module, "has_extra", lambda extra: extra == "channel")
    assert scenarios.extras_of(pair) == ("channel",)
    scenarios.require_extras(pair)
    monkeypatch.setattr(scenarios, "has_extra", lambda extra: False)
    assert scenarios.extras_of(pair) == ("world",)


def test_the_rate_model_of_a_link_may_need_an_extra() -> None:
    text = shipped_scenarios()["cell"].read_text().replace('rate_model = "capped"', 'rate_model = "nr"')
    assert scenarios.extras_of(parse_scenario(text)) == ("system",)
    # `sionna` alone is the ray tracer; it is looked for without being imported.
    assert host.has_extra("system") == bool(metadata_of("sionna"))


def metadata_of(distribution: str) -> str:
    try:
        return metadata.version(distribution)
    except metadata.PackageNotFoundError:
        return ""


def test_a_run_without_its_extras_is_refused_with_one_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared, "has_extra", lambda extra: extra == "world")
    with pytest.raises(SetupError, match=re.escape("'caviar-sim[channel,sensors]'")):
        scenarios.require_extras(load_scenario("street-canyon"))
    scenarios.require_extras(load_scenario("smoke"))


def test_a_quadrotor_in_mujoco_without_it_is_refused_before_there_is_a_directory(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    text = shipped_scenarios()["uav-wind"].read_text()
    (tmp_path / "uav.toml").write_text(text.replace("on_collision =", 'engine = "mujoco"\non_collision ='))
    monkeypatch.setattr(shared, "has_extra", lambda extra: extra != "mujoco")
    out = tmp_path / "runs"
    result = runner.invoke(app, ["run", str(tmp_path / "uav.toml"), "--out", str(out)], env=ENVIRONMENT)
    assert isinstance(result.exception, SetupError)
    assert "pip install 'caviar-sim[mujoco]'" in str(result.exception)
    assert not out.exists()


def test_the_install_command_names_this_interpreter_and_an_extra_that_exists(repository: Path) -> None:
    python, *_, wanted = shlex.split(host.install_command("plot"))
    assert (python, wanted) == (sys.executable, "caviar-sim[plot]")
    provided = metadata.metadata("caviar-sim").get_all("Provides-Extra") or []
    assert {*host._MODULES} <= {*provided}


def test_a_new_scenario_runs_as_it_is_and_has_the_name_that_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = runner.invoke(app, ["new", "first"])
    assert done.exit_code == 0
    assert "caviar run first.toml" in done.output
    scenario = prepare(Path("first.toml"), frames=3).scenario
    assert (scenario.run.name, scenarios.extras_of(scenario)) == ("first", ())
    outcome = EmbeddedRun(scenario, None).run()
    assert not outcome.error


def test_a_new_scenario_overwrites_nothing_and_makes_its_folder(tmp_path: Path) -> None:
    path = scenarios.new_scenario(str(tmp_path / "deep" / "mine"))
    assert path == tmp_path / "deep" / "mine.toml"
    path.write_text("edited")
    with pytest.raises(RunError, match=r"mine\.toml is there already"):
        scenarios.new_scenario(str(path))
    assert path.read_text() == "edited"
    with pytest.raises(RunError, match=r"not \.txt.*mine\.toml"):
        scenarios.new_scenario(str(tmp_path / "mine.txt"))
    assert scenarios.new_scenario(str(tmp_path / "v1.2")).name == "v1.2.toml"
    with pytest.raises(RunError, match="'a b' is no name"):
        scenarios.new_scenario(str(tmp_path / "a b"))
    with pytest.raises(RunError, match="cannot write"):
        scenarios.new_scenario(str(path / "below-a-file"))


def test_every_alternative_that_a_new_scenario_comments_out_is_accepted(tmp_path: Path) -> None:
    text = scenarios.new_scenario(str(tmp_path / "mine")).read_text()
    commented = re.compile(r"^# (\[|\w+ = )", re.MULTILINE)
    assert len(commented.findall(text)) >= 15
    (tmp_path / "my-city.xml").write_text("<scene/>")
    scenario = parse_scenario(commented.sub(r"\1", text), folder=tmp_path)
    prepare(scenario)
    assert scenario.run.pace == "realtime"
    assert "lidar" in scenario.services


@pytest.mark.parametrize("command", [[], ["run"], ["plot", "map"], ["measure", "bench", "broker"]])
def test_h_is_help_everywhere(command: list[str]) -> None:
    short = runner.invoke(app, [*command, "-h"], env=ENVIRONMENT)
    assert short.exit_code == 0
    assert short.output == runner.invoke(app, [*command, "--help"], env=ENVIRONMENT).output
    assert "Usage: " in short.output


def test_the_version_is_that_of_the_distribution() -> None:
    done = runner.invoke(app, ["--version"])
    assert (done.exit_code, done.output) == (0, f"caviar {metadata.version('caviar-sim')}\n")


def test_a_shell_completes_names_of_scenarios() -> None:
    environment = {"_CAVIAR_COMPLETE": "complete_bash", "COMP_WORDS": "caviar run street", "COMP_CWORD": "2"}
    done = runner.invoke(app, [], prog_name="caviar", env=environment)
    assert done.output.split() == ["street-canyon"]
    assert "--install-completion" in runner.invoke(app, ["-h"], env=ENVIRONMENT).output


FORMER = {
    **{name: f"dataset {name}" for name in ("generate", "look", "verify", "tables")},
    **{name: f"policy {name}" for name in ("train", "evaluate", "swap")},
    **{name: f"measure {name}" for name in ("budget", "bench", "tradeoff", "stability")},
    "map": "plot map",
    "video": "plot video",
    "why": "status",
    "export-policy": "policy export",
    "plot runs/x": "plot run runs/x",
}


@pytest.mark.parametrize(("former", "name"), FORMER.items())
def test_a_former_name_of_a_command_goes_on_and_is_not_shown(former: str, name: str) -> None:
    old, new = (
        runner.invoke(app, [*words.split(), "-h"], env=ENVIRONMENT).output.splitlines()[2:]
        for words in (former, name)
    )
    assert old == new
    assert any("--help" in line for line in old)
    shown = re.findall(r"(?m)^\W ([a-z-]+) ", runner.invoke(app, ["-h"], env=ENVIRONMENT).output)
    assert former not in shown
    assert name.split()[0] in shown
