"""The `caviar` command: what is wrong with its arguments is one line on standard error."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import get_args, get_type_hints

import pytest
from recording_builders import record_run

from caviar_clients.cli import main as command
from caviar_protocol.scenario.schema import Run

pytestmark = pytest.mark.slow

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"


def complaint(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str | Path
) -> str:
    """The one line that ``caviar`` answers to these arguments; its status is 1."""
    monkeypatch.setattr(sys, "argv", ["caviar", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        command.main()
    assert ended.value.code == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    return err


def scenario(folder: Path, old: str, new: str) -> Path:
    path = folder / "scenario.toml"
    text = SMOKE.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize("text", ["[/red]", "[bold]", "[[carriers]]"])
def test_brackets_of_a_message_are_shown_as_they_are(monkeypatch, capsys, tmp_path, text):
    """Rich would take them for markup: swallow them, or fail."""
    path = scenario(tmp_path, 'use = "beams"', f'use = "{text}"')
    assert f"no link is named '{text}'" in complaint(monkeypatch, capsys, "run", path)


def test_a_remedy_that_is_a_table_is_shown(monkeypatch, capsys, tmp_path):
    path = tmp_path / "scenario.toml"
    path.write_text(re.sub(r"\[\[carriers\]\][^\[]*", "", SMOKE.read_text()))
    assert "add [[carriers]] with" in complaint(monkeypatch, capsys, "run", path)


def test_a_topic_to_record_that_nothing_produces_is_named_with_its_line(monkeypatch, capsys, tmp_path):
    path = scenario(tmp_path, '"scene", "channel"', '"scene", "lidar"')
    line = 1 + SMOKE.read_text().partition("record = ")[0].count("\n")
    err = complaint(monkeypatch, capsys, "run", path)
    assert f"{path}:{line}: run.record[1]: no service of the run produces 'lidar'; remove it" in err


@pytest.mark.parametrize("digest", [["--digest"], []])
def test_what_is_no_recording_is_named(monkeypatch, capsys, tmp_path, digest):
    err = complaint(monkeypatch, capsys, "inspect", tmp_path / "nothing", *digest)
    assert f"caviar: {tmp_path / 'nothing'} does not exist" in err


def test_a_directory_that_cannot_be_made_is_named_with_the_option(monkeypatch, capsys, tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    err = complaint(monkeypatch, capsys, "run", SMOKE, "--out", file)
    assert f"{file}/smoke-" in err
    assert "is a file, not a folder; choose another folder" in err


def test_a_summary_that_cannot_be_written_ends_the_command_before_the_run(monkeypatch, capsys, tmp_path):
    err = complaint(monkeypatch, capsys, "run", SMOKE, "--out", tmp_path / "runs", "--json", tmp_path)
    assert f"cannot write {tmp_path}: Is a directory" in err
    assert not (tmp_path / "runs").exists()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recorded run of `smoke`."""
    return record_run(tmp_path_factory.mktemp("run"))


@pytest.mark.parametrize(
    "arguments",
    [
        ("run", SMOKE, "--embedded", "--out", "FILE/out"),
        ("run", SMOKE, "--embedded", "--json", "FILE/x.json"),
        ("broker", SMOKE, "--out", "FILE/out"),
        ("plot", "RUN", "--out", "FILE/pictures"),
        ("plot", "video", "RUN", "--out", "FILE/x.gif"),
        ("measure", "budget", "RUN", "--json", "FILE/x.json"),
        ("replay", "RUN", "--embedded", "--json", "FILE/x.json"),
        ("measure", "tradeoff", SMOKE, "--json", "FILE/x.json"),
        ("measure", "tradeoff", SMOKE, "--out", "FILE/out"),
        ("measure", "stability", "--no-traced", "--json", "FILE/x.json"),
        ("measure", "stability", "--no-traced", "--markdown", "FILE/x.md"),
        ("measure", "bench", "broker", "--json", "FILE/x.json"),
        ("conform", "--json", "FILE/x.json"),
    ],
    ids=lambda arguments: f"{arguments[0]} {arguments[-2]}",
)
def test_every_command_answers_alike_where_a_file_is_in_the_way_of_a_folder(
    monkeypatch, capsys, tmp_path, recorded, arguments
):
    """And before its work: nothing but the message is printed."""
    file = tmp_path / "file"
    file.touch()
    words = [str(word).replace("FILE", str(file)).replace("RUN", str(recorded)) for word in arguments]
    monkeypatch.setattr(sys, "argv", ["caviar", *words])
    with pytest.raises(SystemExit) as ended:
        command.main()
    assert ended.value.code == 1
    err = capsys.readouterr().err
    assert f"{file} is a file, not a folder; choose another folder" in err
    assert "Traceback" not in err


@pytest.mark.parametrize(
    "arguments",
    [("run", SMOKE, "--embedded"), ("measure", "budget", "RUN"), ("measure", "tradeoff", SMOKE)],
    ids=lambda arguments: arguments[1],
)
def test_a_folder_that_lacks_is_named_where_a_file_of_figures_shall_be(
    monkeypatch, capsys, tmp_path, recorded, arguments
):
    words = [recorded if word == "RUN" else word for word in arguments]
    err = complaint(monkeypatch, capsys, *words, "--json", tmp_path / "nope" / "x.json")
    assert f"there is no folder {tmp_path}/nope; make it" in err
    assert not (tmp_path / "nope").exists()


@pytest.mark.parametrize("name", ["run", "broker"])
def test_each_pace_that_a_scenario_may_have_is_told_of_by_the_help_and_the_page(monkeypatch, capsys, name):
    monkeypatch.setattr(sys, "argv", ["caviar", name, "--help"])
    monkeypatch.setenv("COLUMNS", "400")
    with pytest.raises(SystemExit):
        command.main()
    (help_text,) = (line for line in capsys.readouterr().out.splitlines() if "--pace" in line)
    page = (Path(__file__).parents[2] / "docs" / "topics" / "clock-and-deadlines.md").read_text()
    words = get_args(get_args(get_type_hints(Run)["pace"])[0])
    assert "realtime" in words
    for word in words:
        assert re.search(rf"\b{word}\b", help_text), word
        assert f"`{word}`" in page


def test_ctrl_c_that_comes_while_an_object_is_finalised_is_not_lost() -> None:
    script = """
import signal, time
from caviar_clients.cli import main

class Finalised:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

def app():
    Finalised()
    for _ in range(600):
        time.sleep(0.05)

main.app = app
signal.signal(signal.SIGINT, signal.default_int_handler)  # which a job in the background ignores
main.main()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "")
