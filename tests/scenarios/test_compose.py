"""The containers of deploy/: accepted by docker-compose, and started, killed and stopped for real."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

DEPLOY = Path(__file__).parents[2] / "deploy"
IMAGES = ("broker", "world", "channel", "sensors", "link", "agent", "recorder")
COMPOSE = ["docker-compose"] if shutil.which("docker-compose") else ["docker", "compose"]
OVERRIDES = ("docker-compose.gpu.yml", "docker-compose.remote-agent.yml")


def says(*command: str) -> str | None:
    """Output of a command; None where it fails or is not there."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=DEPLOY, check=False)
    except FileNotFoundError:
        return None
    return done.stdout if done.returncode == 0 else None


@pytest.mark.parametrize("override", [None, *OVERRIDES])
def test_docker_compose_accepts_the_file_alone_and_with_each_override(override: str | None) -> None:
    if says(*COMPOSE, "version") is None:
        pytest.skip("docker-compose is not installed")
    files = ["-f", "docker-compose.yml", *(["-f", override] if override else [])]
    done = subprocess.run(
        [*COMPOSE, *files, "config", "--services"], capture_output=True, text=True, cwd=DEPLOY, check=False
    )
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.split()) == {
        *("keys", "broker", "traffic", "channel", "lidar", "link", "agent", "recorder")
    }


@pytest.mark.exhaustive
@pytest.mark.timeout(900)
def test_containers_complete_their_run_in_any_order_and_over_kills_and_stop_in_order() -> None:
    """One cold start, the broker and a service killed, one stop; deploy/compose-test does the rest."""
    if says("docker", "info") is None:
        pytest.skip("no Docker engine runs here")
    missing = [name for name in IMAGES if says("docker", "image", "inspect", f"caviar/{name}") is None]
    if missing:
        pytest.skip(f"images are not built ({', '.join(missing)}): docker-compose build in deploy/")
    command = [sys.executable, str(DEPLOY / "compose-test"), "--starts", "1"]
    done = subprocess.run(
        [*command, "--kill", "broker", "--kill", "link"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ},
    )
    assert done.returncode == 0, done.stdout + done.stderr
