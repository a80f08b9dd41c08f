"""The programs of ``examples/``, as a user starts them, in a short form."""

from __future__ import annotations

import ast
import importlib.util
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from forked import Forked
from scenarios_support import SCENARIOS, running

EXAMPLES = Path(__file__).parents[2] / "examples"
PRELOAD = ("caviar", "caviar_clients.envs")
"""What the programs import."""
ENDPOINT = re.compile(r"waiting for .* at (tcp://[\w.:-]+\d)")


def started(folder: Path, program: str, *arguments: str) -> str:
    """What a program prints that ends with status 0."""
    command = [sys.executable, str(EXAMPLES / program), *arguments]
    pipe = subprocess.PIPE
    with Forked(command, PRELOAD, cwd=folder, stdout=pipe, stderr=pipe, text=True) as process:
        try:
            output, errors = process.communicate(timeout=120)
        finally:
            process.kill()
    assert process.returncode == 0, errors
    return str(output)


@pytest.mark.parametrize("program", sorted(path.name for path in EXAMPLES.glob("*.[pi]*")))
def test_each_example_is_tried_here_and_on_the_page(program: str) -> None:
    assert program in Path(__file__).read_text(encoding="utf-8")
    assert f"({program})" in (EXAMPLES / "README.md").read_text(encoding="utf-8")


def test_first_run(tmp_path: Path) -> None:
    """The cells of ``first_run.ipynb`` run from top to bottom, and show recording, curves and page."""
    pytest.importorskip("ipykernel", reason="the kernel of Jupyter is not installed")
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    book = nbformat.read(EXAMPLES / "first_run.ipynb", as_version=4)
    assert len(book.cells) == 10
    nbclient.NotebookClient(book, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [output for cell in book.cells for output in cell.get("outputs", ())]
    shown = [output["data"] for output in outputs if "data" in output]
    assert ["text/html" in data for data in shown] == [True, False, False, False, True]
    assert "image/png" in shown[3]
    assert "<iframe" in shown[4]["text/html"]
    assert "as the link says: True" in "".join(output.get("text", "") for output in outputs)
    # Jupyter asks libraries for colours, which no file has.
    (summary,) = tmp_path.glob("runs/*/summary.txt")
    assert summary.read_text().startswith("geometric: ")
    assert "\x1b" not in summary.read_text()


@pytest.mark.exhaustive
def test_train_and_evaluate(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")
    printed = started(tmp_path, "train_and_evaluate.py", "--steps", "300")
    assert (tmp_path / "beams.onnx").is_file()
    assert re.findall(r"^(\S+) +all \d", printed, re.MULTILINE) == ["policy", "los-beam", "random", "optimum"]


@pytest.mark.exhaustive
def test_learned_beams(tmp_path: Path) -> None:
    """A few frames, all in sight, and too few steps to win by."""
    pytest.importorskip("stable_baselines3", reason="Stable-Baselines3 is not installed")
    pytest.importorskip("sionna.rt", reason="the ray tracer is not installed")
    printed = started(tmp_path, "learned_beams.py", "--frames", "6", "--steps", "600")
    shares = dict(re.findall(r"^(\S+) +all (\d\.\d+)", printed, re.MULTILINE))
    assert 0.0 < float(shares["policy"]) <= 1.0
    assert 0.9 < float(shares["los-beam"]) <= 1.0


def test_own_policy_learns(tmp_path: Path) -> None:
    """A few frames of 64 members suffice to be far above random beams."""
    pytest.importorskip("torch", reason="PyTorch is not installed")
    printed = started(tmp_path, "own_policy.py", "--frames", "150")
    means = {name: float(mean) for name, mean in re.findall(r"^(\S+) +all ([\d.]+)", printed, re.MULTILINE)}
    assert means["policy"] > 3 * means["random"]


def test_vector_of_environments(tmp_path: Path) -> None:
    printed = started(tmp_path, "vector_of_environments.py", "--frames", "30")
    assert re.search(r"of 64 together: \d+ times as many\nmean \|y\| by azimuth alone: \d", printed)


def test_tilted_beams(tmp_path: Path) -> None:
    """The UAV leans by more than the width of a beam as soon as it flies off."""
    printed = started(tmp_path, "tilted_beams.py", "--frames", "30")
    assert re.search(r"^pitch -?\d\S*° to [23]\d\.\d°: [4-9] of 16 beams", printed, re.MULTILINE)
    lost = re.search(r"without knowing the tilt: ([\d.]+) dB lost in the mean", printed)
    assert lost is not None
    assert float(lost[1]) > 5
    if importlib.util.find_spec("matplotlib") is not None:
        assert [file.name for file in tmp_path.iterdir()] == ["runs"]
        picture = re.search(r"^picture: (runs/uav-wind-\S+/tilted-beams\.png)$", printed, re.MULTILINE)
        assert picture is not None
        assert (tmp_path / picture[1]).is_file()
        assert "\npicture: tilt.png\n" in started(
            tmp_path, "tilted_beams.py", "--frames", "3", "--out", "tilt.png"
        )
        assert (tmp_path / "tilt.png").is_file()


def test_two_agents_deliver(tmp_path: Path) -> None:
    pytest.importorskip("pettingzoo", reason="PettingZoo is not installed")
    printed = started(tmp_path, "two_agents.py", "--seeds", "1")
    assert [line.split(":")[1].split()[0] for line in printed.splitlines()] == ["2", "2"]


def test_the_remote_trainer_plays_all_episodes(tmp_path: Path) -> None:
    scenario = tmp_path / "remote.toml"
    text = (SCENARIOS / "remote.toml").read_text()
    scenario.write_text(text.replace("frames = 100", "frames = 30\nepisodes = 2"))
    with running(scenario, tmp_path / "out", "--bind", "tcp://127.0.0.1:0") as (process, _):
        assert process.stdout is not None
        output, until = "", time.monotonic() + 30
        while not (found := ENDPOINT.search(output)):
            assert time.monotonic() < until, f"no endpoint came: {output}"
            output += os.read(process.stdout.fileno(), 65536).decode()
        printed = started(tmp_path, "remote_trainer.py", str(scenario), found[1])
        process.communicate(timeout=120)
    assert process.returncode == 0
    assert "episode 2: mean |y| 0." in printed
    assert "the run is over" in printed


def test_the_guide_makes_keys_as_the_remote_trainer_does() -> None:
    """By the commands that the test below runs."""
    page = (EXAMPLES.parent / "docs" / "howto" / "train-an-agent.md").read_text(encoding="utf-8")
    described = (EXAMPLES / "remote_trainer.py").read_text(encoding="utf-8")
    commands = re.findall(r"^(caviar (?:keys|run crossing).*?)(?: +#.*)?$", page, re.MULTILINE)
    assert len(commands) == 4
    assert not [command for command in commands if f"    {command}\n" not in described]


@pytest.mark.exhaustive
def test_the_commands_of_the_remote_trainer_are_right(tmp_path: Path) -> None:
    """As they stand in its file, one after the other; but for the port, and the length of the run."""
    here, there = tmp_path / "here", tmp_path / "there"
    here.mkdir()
    there.mkdir()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    description = ast.get_docstring(ast.parse((EXAMPLES / "remote_trainer.py").read_text()))
    assert description is not None
    text = description.replace("\\\n", " ").replace("5570", port).replace("HOST", "127.0.0.1")
    text = text.replace("examples/", f"{EXAMPLES}/")
    new_key, *prepare, begin, train = (line for line in text.splitlines() if line.startswith("    "))
    bin_folder = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"

    def ended(command: str, folder: Path) -> str:
        done = subprocess.run(
            shlex.split(command), cwd=folder, capture_output=True, text=True, timeout=120, check=False,
            env={**os.environ, "PATH": bin_folder},
        )  # fmt: skip
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        return done.stdout

    ended(new_key, here)
    shutil.copy(here / "keys" / "agent.pub", there)
    for command in prepare:
        ended(command, there)
    scenario = there / "crossing.toml"
    scenario.write_text(re.sub(r"(?m)^frames = \d+", "frames = 30", scenario.read_text()))
    shutil.copy(scenario, here)
    shutil.copy(there / "keys" / "broker.pub", here)
    run = subprocess.Popen(
        begin.split(), cwd=there, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, "PATH": bin_folder},
    )  # fmt: skip
    try:
        assert "the run is over" in ended(train, here)
        assert run.wait(timeout=120) == 0
    finally:
        run.kill()
        run.communicate()


def test_the_remote_trainer_says_that_there_is_no_broker(tmp_path: Path) -> None:
    program = str(EXAMPLES / "remote_trainer.py")
    command = [sys.executable, program, "remote", "tcp://127.0.0.1:9", "--wait", "0.5"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert "tcp://127.0.0.1:9 within 0.5 s" in done.stdout + done.stderr


def test_materials_of_streets(tmp_path: Path) -> None:
    """``street_materials.py`` judges a model that ``train_segmentation.py`` trains for a second."""
    image = pytest.importorskip("PIL.Image")
    random = np.random.default_rng(1)
    for part in ("train", "test"):
        for folder, most, shape in ((part, 256, (96, 128, 3)), (f"{part}annot", 12, (96, 128))):
            (tmp_path / folder).mkdir()
            image.fromarray(random.integers(0, most, shape, dtype=np.uint8)).save(tmp_path / folder / "0.png")
    short = ("--streets", "1", "--minutes", "0.02", "--out", "m.onnx")
    assert "mean IoU" in started(tmp_path, "train_segmentation.py", ".", *short)
    short = ("--streets", "1", "--views", "2", "--samples", "20000", "--out", "made")
    assert re.search(
        r"error \[dB\], from pictures \d", started(tmp_path, "street_materials.py", "m.onnx", *short)
    )
    assert len(list((tmp_path / "made").glob("fig*.png"))) == 4


@pytest.mark.parametrize(("name", "seed"), [("district", 1), ("district-b", 2)])
def test_district_writes_what_ships(tmp_path: Path, name: str, seed: int) -> None:
    pytest.importorskip("sumo", reason="eclipse-sumo is not installed")
    started(tmp_path, "district.py", "--out", ".", "--seed", str(seed), "--name", name)
    shipped = [SCENARIOS / f"{name}.toml", *filter(Path.is_file, (SCENARIOS / name).rglob("*"))]
    assert len(shipped) > 20
    for file in shipped:
        assert (tmp_path / file.relative_to(SCENARIOS)).read_bytes() == file.read_bytes(), file
    made = {file.name for file in (tmp_path / name).rglob("*") if file.is_file()}
    assert made == {file.name for file in shipped[1:]}
