"""A package of others, installed by pip beside this one, adds to it without a change of the core."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from scenarios_support import caviar

pytestmark = pytest.mark.slow

PROJECT = """
[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "harbour"
version = "1.0"

[project.entry-points."caviar.services"]
"world:harbour" = "harbour:Harbour"

[project.entry-points."caviar.traffic"]
burst = "harbour:BURST"

[project.entry-points."caviar.observations"]
height = "harbour:Height"

[project.entry-points."caviar.codebooks"]
switched = "harbour:Switched"

[project.entry-points."caviar.formats"]
positions = "harbour:Positions"

[project.entry-points."caviar.commands"]
ships = "harbour:ships"
"""

MODULE = '''
"""Ships that pass a quay, what they send, and what a policy sees of them."""

import numpy as np

from caviar_protocol.cell.traffic import Offered, TrafficModel
from caviar_protocol.observations import Bounds, Part
from caviar_protocol.space.codebooks import Codebook
from caviar_protocol.space.scene import device_pose
from caviar_formats.base import Format
from caviar_services.world.base import ObjectState, World


class Harbour(World):
    """One ship, eastwards at 5 m/s."""

    def prefixes(self):
        return ("ship.",)

    def mesh_classes(self):
        return ()

    def begin(self, episode, seed):
        pass

    def objects_at(self, elapsed_ns):
        x = 5e-9 * elapsed_ns
        level = (1.0, 0.0, 0.0, 0.0)
        yield ObjectState("ship.1", "ship", (x, 0.0, 4.0), level, (5.0, 0.0, 0.0), (30.0, 8.0, 8.0))


def burst(traffic, place):
    """All of a period within its first tenth."""
    rate = 10 * traffic.rate_bit_s / traffic.packet_bits
    return Offered(np.array([0.0, 0.1 * traffic.period_s]), np.array([rate, 0.0]), traffic.period_s)


class Switched(Codebook):
    """One element at a time."""

    def block(self):
        return np.eye(self.uniform.size)


class Positions(Format):
    """A line for each user of each scene."""

    def write(self, part, folder):
        columns = [part.users[name] for name in ("episode", "scene", "x_m")]
        lines = [",".join(map(str, row)) for row in zip(*columns)]
        (folder / f"positions-{part.number}.csv").write_text("\\n".join(lines))


BURST = TrafficModel(burst, needs=("rate_bit_s", "period_s"))


class Height(Part):
    """z of the first receiver [m]."""

    @property
    def bounds(self):
        return Bounds(-1e6, 1e6, (1,), np.float32)

    def read(self, moment):
        pair = moment.users[0][1]
        return np.array([device_pose(moment.scene, pair.rx).position[2]], np.float32)


def ships(count: int = 1) -> None:
    """Count ships."""
    print(f"ships: {count}")
'''

SCENARIO = """
[run]
name = "harbour"
frames = 10
sampling_period_ns = 100_000_000
record = ["scene", "channel", "link"]

[[carriers]]
name = "mm"
frequency_hz = 28e9
bandwidth_hz = 100e6

[services.world]
role = "world"
use = "harbour"
budget_ms = 20

[services.channel]
role = "channel"
use = "free-space"
budget_ms = 20

[services.link]
role = "link"
use = "cell"
budget_ms = 20

[services.link.settings]
slots = 10

[[services.link.settings.traffic]]
model = "burst"
rate_bit_s = 1.2e6
period_s = 0.5

[services.agent]
role = "agent"
use = "los-beam"
budget_ms = 20

[services.recorder]
role = "recorder"
use = "mcap"
budget_ms = 100

[[devices]]
name = "quay"
kind = "antenna"
role = "tx"
position_m = [0.0, -40.0, 12.0]
yaw_deg = 90.0
array = { columns = 4, codebook = "switched" }

[[devices]]
name = "rx"
kind = "antenna"
role = "rx"
on = "ship.1"
position_m = [0.0, 0.0, 5.0]
"""

READ = """
import json, sys
import caviar
run = caviar.open(sys.argv[1])
x = run["scene"].select(names="ship.1").position[:, 0, 0]
link, one_element = run["link"], abs(run["channel"].a).max()
figures = {"arrived": float(link.arrived.sum()), "gain": float(link.abs_y.max() / one_element)}
print(json.dumps({"x": x.tolist(), **figures}))
"""

OBSERVE = """
import json, sys
from caviar_clients.envs.base import BeamSelectionEnv
with BeamSelectionEnv(sys.argv[1], observe=("height",)) as env:
    print(json.dumps(env.reset(seed=1)[0]["height"].tolist()))
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder into which pip has installed the package."""
    project = tmp_path_factory.mktemp("harbour")
    (project / "pyproject.toml").write_text(PROJECT)
    (project / "harbour.py").write_text(MODULE)
    (project / "harbour.toml").write_text(SCENARIO)
    site = project / "site"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    command = [*pip, "--no-deps", "--no-build-isolation", "--target", str(site), str(project)]
    subprocess.run(command, check=True, timeout=120)
    return site


def python(site: Path, program: str, *arguments: str | Path) -> object:
    """What a program prints as JSON, with the package installed."""
    command = [sys.executable, "-c", program, *map(str, arguments)]
    done = subprocess.run(
        command, env={"PYTHONPATH": str(site), "PATH": ""}, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_its_world_traffic_model_and_codebook_run(site: Path, tmp_path: Path) -> None:
    done = caviar("run", site.parent / "harbour.toml", "--out", tmp_path, PYTHONPATH=str(site))
    assert (done.status, done.leftovers) == (0, []), done.output
    found = python(site, READ, next(tmp_path.iterdir()))
    assert isinstance(found, dict)
    assert found["x"] == pytest.approx([0.5 * frame for frame in range(10)])
    assert found["arrived"] == pytest.approx(1.2e6)
    assert found["gain"] == pytest.approx(1.0), "no beam has more than one element"


def test_its_part_of_the_observation_is_observed(site: Path) -> None:
    assert python(site, OBSERVE, site.parent / "harbour.toml") == pytest.approx([9.0])


def test_its_format_is_one_of_export(site: Path, tmp_path: Path) -> None:
    data, out = tmp_path / "data", tmp_path / "out"
    here = {"PYTHONPATH": str(site)}
    scenario = site.parent / "harbour.toml"
    done = caviar("dataset", "generate", scenario, "--episodes", "1", "--workers", "1", "--out", data, **here)
    assert done.status == 0, done.output
    export = ("export", data, "--to", "positions", "--out", out)
    assert caviar(*export, **here).output.endswith(f"{out}\n")
    rows = [line.split(",") for line in (out / "positions-0.csv").read_text().splitlines()]
    assert [float(x) for _, _, x in rows] == pytest.approx([0.5 * frame for frame in range(10)])
    assert "not empty" in caviar(*export, **here).output
    again = caviar("export", data, "--to", "position", "--out", tmp_path / "other", **here)
    assert (again.status, "did you mean 'positions'" in again.output) == (1, True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data", "out"]


def test_its_command_is_one_of_caviar(site: Path) -> None:
    assert caviar("ships", "--count", "3", PYTHONPATH=str(site)).output == "ships: 3\n"
    assert "Count ships" in caviar("-h", PYTHONPATH=str(site)).output
    assert caviar("ships").status == 2


def test_it_is_named_where_it_is_not_installed(site: Path, tmp_path: Path) -> None:
    done = caviar("run", site.parent / "harbour.toml", "--out", tmp_path)
    assert done.status == 1
    assert "devices[0].array.codebook: 'switched' is no codebook" in done.output


@pytest.mark.parametrize("lines", [PROJECT, MODULE])
def test_each_addition_takes_at_most_forty_lines(lines: str) -> None:
    additions = lines.count("[project.entry-points") or 3
    assert len([line for line in lines.splitlines() if line.strip()]) <= 40 * additions
