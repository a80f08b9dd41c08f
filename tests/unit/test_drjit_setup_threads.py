"""How many threads each ray tracer of a run computes with."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from caviar_clients.cli.launch import Launcher
from caviar_clients.session.prepared import implemented
from caviar_protocol.errors import SetupError
from caviar_protocol.scenario import load_scenario
from caviar_services.drjit_setup import THREADS_VARIABLE, limited_threads, share_of_each

SCENARIOS = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"


@pytest.mark.parametrize(
    ("cores", "tracers", "threads"), [(2, 2, 1), (2, 1, 2), (16, 3, 5), (1, 2, 1), (4, 0, 4)]
)
def test_cores_are_shared_out(
    monkeypatch: pytest.MonkeyPatch, cores: int, tracers: int, threads: int
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(cores)))
    assert share_of_each(tracers) == threads


@pytest.mark.parametrize(("scenario", "threads"), [("street-canyon", "3"), ("uav-munich", "6")])
def test_the_launcher_counts_the_services_that_trace_rays(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, scenario: str, threads: str
) -> None:
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(6)))
    path = SCENARIOS / f"{scenario}.toml"
    with Launcher(implemented(load_scenario(path)), path, tmp_path) as launcher:
        assert launcher._threads == {THREADS_VARIABLE: threads}


@pytest.mark.parametrize("text", ["0", "-1", "two", "1.5", "²"])
def test_what_is_no_number_of_threads_is_refused(text: str) -> None:
    with pytest.raises(SetupError, match=rf"{THREADS_VARIABLE} is '{text}'; write a number"):
        limited_threads({THREADS_VARIABLE: text})


def test_without_a_word_the_ray_tracer_keeps_its_own_number() -> None:
    assert limited_threads({}) == 0


@pytest.mark.channel
def test_a_limit_holds_but_for_what_is_done_once() -> None:
    """In a process of its own: threads are the process's."""
    code = (
        "import drjit as dr\n"
        "from caviar_services.drjit_setup import all_threads, cores, limit_threads\n"
        "limit_threads()\n"
        "assert dr.thread_count() == 1, dr.thread_count()\n"
        "with all_threads():\n"
        "    assert dr.thread_count() == cores(), dr.thread_count()\n"
        "assert dr.thread_count() == 1, dr.thread_count()\n"
    )
    environment = {"PATH": "/usr/bin:/bin", THREADS_VARIABLE: "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False, timeout=60
    )
    assert done.returncode == 0, done.stderr
