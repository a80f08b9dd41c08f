"""What containers need: a broker that goes on where it was killed, statuses, signs of life, packages."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest
from forked import Forked
from scenarios_support import PRELOAD

from caviar_clients.cli.remote import RunInProgress
from caviar_protocol.host import VARIABLE, SignOfLife
from caviar_services.runner import TERMINATED, restart_status

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
SMOKE = ROOT / "deploy" / "caviar_scenarios" / "smoke.toml"
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}


@pytest.mark.parametrize(
    ("status", "ended", "expected"),
    [
        (0, "the run is complete", 0),
        (0, "stopped by SIGTERM", 0),
        (0, "world 'traffic' failed in prepare: no such file", 1),
        (TERMINATED, "", 0),
        (1, "", 1),
    ],
)
def test_only_a_run_that_failed_makes_a_service_come_again(status: int, ended: str, expected: int) -> None:
    assert restart_status(status, ended) == expected


def test_a_run_is_in_progress_while_it_is_served_and_after_its_broker_died(tmp_path: Path) -> None:
    directory = tmp_path / "smoke-1"
    directory.mkdir()
    (directory / "run.json").write_text("{}")
    run = RunInProgress(tmp_path, "smoke")
    assert run.directory() is None
    seen = []

    def serve() -> int:
        seen.append(RunInProgress(tmp_path, "smoke").directory())
        seen.append(RunInProgress(tmp_path, "other").directory())
        return 7

    assert run.serve(directory, serve) == 7
    assert seen == [directory, None]
    assert run.directory() is None


def test_a_run_that_has_written_nothing_yet_is_not_resumed(tmp_path: Path) -> None:
    (tmp_path / "smoke-1").mkdir()
    (tmp_path / "smoke.current").write_text("smoke-1\n")
    assert RunInProgress(tmp_path, "smoke").directory() is None


def started(out: Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "caviar_clients", "broker", str(SMOKE), "--restarted"]
    return Forked(
        [*command, "--out", str(out), "--bind", "tcp://127.0.0.1:0"],
        PRELOAD,
        stdout=subprocess.PIPE,
        text=True,
        env=ENVIRONMENT,
    )


def lines_until(process: subprocess.Popen[str], word: str) -> str:
    assert process.stdout is not None
    found = ""
    for line in process.stdout:
        found += line
        if word in line:
            return found
    raise AssertionError(f"no {word!r} in {found!r}")


def test_a_killed_broker_resumes_its_run_and_a_stopped_one_does_not(tmp_path: Path) -> None:
    with started(tmp_path) as first:
        lines_until(first, "listening")
        first.kill()
    directory = (tmp_path / "smoke.current").read_text().strip()
    with started(tmp_path) as second:
        assert f"{directory}: its broker died" in lines_until(second, "listening")
        second.send_signal(signal.SIGTERM)
        assert second.wait(10) == 0
    with started(tmp_path) as third:
        assert "its broker died" not in lines_until(third, "listening")
        third.send_signal(signal.SIGTERM)
        assert third.wait(10) == 0


def test_a_service_that_waits_for_its_broker_ends_with_status_0_when_told_to(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "caviar_services", "agent", "--use", "agent:los-beam"]
    command += ["--broker", "tcp://127.0.0.1:9", "--connect-timeout", "60"]
    for options, status in ((["--restarted"], 0), ([], TERMINATED)):
        with Forked([*command, *options], PRELOAD, env=ENVIRONMENT) as process:
            handled = Path(f"/proc/{process.pid}/status")
            until = time.monotonic() + 20
            while not int(handled.read_text().split("SigCgt:")[1].split()[0], 16) >> (signal.SIGTERM - 1) & 1:
                assert time.monotonic() < until, "it never listens to SIGTERM"
            process.send_signal(signal.SIGTERM)
            assert process.wait(10) == status


def test_a_sign_of_life_touches_the_file_and_not_in_every_turn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "alive"
    monkeypatch.setenv(VARIABLE, str(file))
    sign = SignOfLife()
    sign.touch()
    assert file.exists()
    file.unlink()
    sign.touch()
    assert not file.exists()


def test_a_sign_of_life_that_cannot_be_given_ends_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "/proc/none/alive")
    SignOfLife().touch()


def requirements(*arguments: str) -> list[str]:
    script = ROOT / "deploy" / "requirements.py"
    done = subprocess.run([sys.executable, script, *arguments], capture_output=True, text=True, check=True)
    return done.stdout.split("\n")[:-1]


def test_images_take_their_packages_from_pyproject() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert requirements() == project["dependencies"]
    extras = project["optional-dependencies"]
    assert requirements("channel") == extras["channel"]
    named = requirements("world", "--only", "sionna-rt")
    others = requirements("world", "--without", "sionna-rt", "--without", "eclipse-sumo")
    assert len(named) == 1
    assert set(named) | set(others) < set(extras["world"])
    assert [line.split(">")[0] for line in others] == ["libsumo"]
