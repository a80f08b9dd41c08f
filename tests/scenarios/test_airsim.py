"""The unmodified client of AirSim 1.8.1 flies a vehicle of a run, sees through its sensors, and steps it.

The client has an environment of its own in ``.venvs``, made once: it pins tornado 4.5.3, which no Python
after 3.11 runs.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from scenarios_support import HERE, ROOT, blocks, eventually, marked, pid_of, running, scenario_file

pytestmark = pytest.mark.slow

CLIENT = ROOT / ".venvs" / "airsim-1.8.1"
VERSIONS = ("3.11", "3.10", "3.9", "3.8")
CHANGES = [
    ('pace = "realtime"', 'pace = "free"'),
    ("sionna:munich", "sionna:simple_street_canyon"),
    ("start_m = [35.0, 75.0, 1.5]", "start_m = [-88.0, -10.0, 1.5]"),
    ("[services.pilot.settings]", '[services.pilot.settings]\nlisten = "127.0.0.1:0"\nstart = "client"'),
    ("size_px = [256, 144]", "size_px = [64, 36]"),
    ("azimuth_steps = 360", "azimuth_steps = 120"),
]
"""To the scenario that ships, for a run of a small street as fast as it goes."""


def interpreter() -> Path | None:
    """A Python that runs the client: the one of these tests, of the PATH, or of pyenv."""
    home = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    for version in VERSIONS:
        found = shutil.which(f"python{version}")
        for path in [
            Path(sys.executable),
            *([Path(found)] if found else []),
            *home.glob(f"versions/{version}*/bin/python"),
        ]:
            show = "import sys, venv; print(*sys.version_info[:2], sep='.')"
            done = subprocess.run(
                [path, "-c", show], capture_output=True, text=True, timeout=120, check=False
            )
            if done.stdout.strip() == version:
                return path
    return None


@pytest.fixture(scope="module")
def client() -> Path:
    """The Python of the client."""
    python = CLIENT / "bin" / "python"
    if (CLIENT / "ready").exists():
        return python
    base = interpreter()
    if base is None:
        pytest.skip(f"the client of AirSim needs one of Python {', '.join(VERSIONS)}")
    shutil.rmtree(CLIENT, ignore_errors=True)
    subprocess.run([base, "-m", "venv", "--without-pip", CLIENT], check=True, timeout=120)
    pip = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        python,
        "install",
        "--quiet",
        "--no-input",
        "--no-compile",
    ]
    # Its setup imports what it needs, so that this comes first; OpenCV is for a picture's file alone.
    for wanted in (
        ["numpy<2", "msgpack-rpc-python==0.4.1", "setuptools<81", "wheel"],
        ["--no-build-isolation", "--no-deps", "airsim==1.8.1"],
    ):
        done = subprocess.run([*pip, *wanted], capture_output=True, text=True, timeout=280, check=False)
        if done.returncode:
            pytest.skip(f"the client of AirSim cannot be installed: {done.stderr.strip()[-300:]}")
    (CLIENT / "ready").touch()
    return python


@dataclass
class Session:
    """A run, and the client that flies in it."""

    python: Path
    port: int
    mark: str

    def script(self, name: str) -> dict[str, Any]:
        """What a script of `airsim_session` found."""
        command = [self.python, HERE / "airsim_session.py", str(self.port), name]
        done = subprocess.run(command, capture_output=True, text=True, timeout=250, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
        return found

    def memory_mib(self) -> float:
        """Resident memory of the agent's process."""
        status = Path(f"/proc/{pid_of(self.mark, 'caviar_services pilot')}/status").read_text()
        return next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS")) / 1024


def served_port(out: Path) -> int:
    """Where the run says that it serves AirSim's RPC; 0 before it does."""
    for log in out.glob("*/events.jsonl"):
        for line in log.read_text().splitlines():
            words, _, port = str(json.loads(line).get("text")).rpartition(":")
            if words.startswith("AirSim's RPC is served at"):
                return int(port)
    return 0


@pytest.fixture(scope="module")
def session(client: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    """A run that goes on until its tests are over, and then ends by Ctrl-C while a client holds it."""
    pytest.importorskip("mitsuba", reason="cameras and LIDARs need mitsuba")
    pytest.importorskip("sionna.rt", reason="the street comes with sionna-rt")
    out = tmp_path_factory.mktemp("airsim")
    scenario = scenario_file(out, CHANGES, base="airsim")
    with running(scenario, out / "runs") as (process, mark):
        eventually(lambda: served_port(out / "runs") or process.poll() is not None, 90, "the RPC is served")
        assert process.poll() is None, process.stdout.read() if process.stdout else ""
        made = Session(client, served_port(out / "runs"), mark)
        yield made
        made.script("hold")
        process.send_signal(signal.SIGINT)
        said, _ = process.communicate(timeout=120)
        assert process.returncode == 130, said
        assert "lost" not in said
        assert marked(mark) == []


def test_it_flies_a_square_and_all_else_that_it_is_asked_for(session: Session) -> None:
    found = session.script("square")
    assert found["flown"] == [True] * len(found["flown"])
    for corner, (x, y) in zip(found["corners"], ((20, 0), (20, 20), (0, 20), (0, 0)), strict=True):
        assert corner == pytest.approx([x, y, -6], abs=1.0)
    assert found["yaw"] == pytest.approx(1.5708, abs=0.09)
    assert found["before"] == pytest.approx([5.0, 2.5, -4.0], abs=1.0)  # where the velocity ended
    assert found["home"] == pytest.approx([0.0, 0.0, 0.0], abs=0.6)
    assert found["landed"]


@pytest.mark.exhaustive
def test_the_script_of_the_page_runs_as_it_is_printed(session: Session, tmp_path: Path) -> None:
    """But for the port, of which the tests have one of their own."""
    ((_, script),) = [block for block in blocks(ROOT / "docs/howto/airsim.md") if block[0] == "python"]
    assert script.count("MultirotorClient()") == 1
    program = tmp_path / "script.py"
    program.write_text(script.replace("MultirotorClient()", f"MultirotorClient(port={session.port})"))
    done = subprocess.run([session.python, program], capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, done.stderr
    x, y, z = (float(value) for value in re.findall(r"_val': (\S+?)[,}]", done.stdout))
    assert (x, y, z) == pytest.approx((0.0, 0.0, -6.0), abs=1.0)


def test_it_takes_pictures_and_scans_of_one_frame(session: Session) -> None:
    found = session.script("sensors")
    assert found["size"] == [36, 64, 36 * 64 * 3]
    assert found["colours"] > 20
    assert 0.3 < found["planar"][0] < found["planar"][1] < 500.0
    assert found["rays"] >= 0.0
    assert found["shown"] < 1e-5
    assert found["png"] == [True, True]
    assert set(found["stamps"]) == {found["now"]}
    assert found["points"] == found["segments"] > 300
    assert found["lowest"] == pytest.approx(1.5, abs=0.05)  # the ground, below where the vehicle started


def test_it_pauses_and_steps_the_world(session: Session) -> None:
    found = session.script("steps")
    paused, begun, frames, time = found["times"]
    assert paused is True
    assert (frames - begun, time - frames) == (500_000_000, 500_000_000)
    assert (found["done"], found["paused"]) == (True, False)


def test_a_call_that_is_not_offered_or_not_possible_says_so(session: Session) -> None:
    found = session.script("errors")
    unknown, unarmed, camera = found["errors"]
    assert unknown.startswith("'simSetTimeOfDay' is not offered here; offered: armDisarm, cancelLastTask, ")
    assert "enableApiControl(True) first" in unarmed  # the reset before took it away
    assert "there is no camera '9' on vehicle 'SimpleFlight'; there are: 0 (uav/front)" in camera
    assert (found["nowhere"], found["objects"], found["wall"]) == ("nan", ["uav"], False)


@pytest.mark.exhaustive
def test_two_clients_at_once_make_thousands_of_calls_without_a_leak(session: Session) -> None:
    expected = {"sorted": True, "done": False, "control": [True, True]}
    assert session.script("warm") == {**expected, "frames": 3}  # caches fill, and the allocator's pools
    before = session.memory_mib()
    assert session.script("calls") == {**expected, "frames": 11}
    assert session.memory_mib() - before < 2.0
