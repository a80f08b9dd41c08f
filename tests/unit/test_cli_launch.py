"""The launcher: what it starts it ends, whatever happens in between."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import pytest
from forked import Forked, forking
from scenarios_support import PRELOAD

from caviar_clients.cli import launch
from caviar_clients.cli.launch import TAIL, Child, Launcher
from caviar_clients.session.prepared import implemented
from caviar_protocol.errors import RunError
from caviar_protocol.files import remove_leftovers
from caviar_protocol.scenario import load_scenario

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
SMOKE = ROOT / "deploy" / "caviar_scenarios" / "smoke.toml"


@pytest.fixture(autouse=True)
def _forks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Broker and services are forks of a process that has imported them."""
    monkeypatch.setattr(launch, "subprocess", forking(PRELOAD))


def launcher(tmp_path: Path, frames: int = 10, extra: str = "", **values: Any) -> Launcher:
    """Of the smoke scenario with something added."""
    path = tmp_path / "scenario.toml"
    text = SMOKE.read_text()
    assert 'record = ["scene",' in text
    if "sensors" in extra:
        text = text.replace('record = ["scene",', 'record = ["lidar", "scene",')
    path.write_text(text + extra)
    return Launcher(implemented(load_scenario(path)), path, tmp_path / "run", frames=frames, **values)


def alive(started: Launcher) -> list[str]:
    """Names of the processes that it started and that still run."""
    found = [name for name, child in started._children.items() if child.process.poll() is None]
    broker = started._broker
    return [*found, "broker"] if broker is not None and broker.poll() is None else found


def wait_for(started: Launcher, kind: str) -> list[Mapping[str, Any]]:
    """Events up to the first of a kind."""
    seen = []
    for event in started.events():
        seen.append(event)
        if event["event"] == kind:
            return seen
    raise AssertionError(f"no {kind} among {seen}")


def test_a_run_that_is_stopped_before_its_broker_is_started_ends(tmp_path: Path) -> None:
    """Ctrl-C while the broker's process is made."""
    with launcher(tmp_path, frames=1_000_000) as started:
        started.stop("stopped by Ctrl-C")
        finished = wait_for(started, "finished")[-1]
    assert finished["error"] == "stopped by Ctrl-C"


def test_a_run_tells_where_it_listens_and_how_it_ended(tmp_path: Path) -> None:
    with launcher(tmp_path) as started:
        events = list(started.events())
        started.stop("too late")  # and harmless
    assert [event["event"] for event in events if event["event"] not in ("frame", "notice")] == [
        "listening",
        "finished",
        "ended",
    ]
    assert events[-2]["frames"] == 10
    assert events[-2]["error"] == ""
    assert events[-1]["status"] == 0
    assert alive(started) == []
    assert sorted(path.stem for path in (tmp_path / "run" / "logs").iterdir()) == sorted(
        ["agent", "broker", "channel", "link", "recorder", "world"]
    )


def test_a_local_run_talks_over_a_socket_file_of_its_user_alone(tmp_path: Path) -> None:
    """A broker that dies is followed by another at the same file; the directory goes with the run."""
    extra = "[timeouts]\nrejoin_s = 5.0\n"
    with launcher(tmp_path, frames=100, extra=extra, bind="") as started:
        [*_, listening] = wait_for(started, "listening")
        folder = Path(listening["endpoint"].removeprefix("ipc://")).parent
        assert (listening["endpoint"], folder.stat().st_mode & 0o777) == (f"ipc://{folder}/broker", 0o700)
        wait_for(started, "frame")
        assert started._broker is not None
        started._broker.kill()
        finished = wait_for(started, "finished")[-1]
        assert started.endpoint == listening["endpoint"]
    assert (finished["error"], finished["frames"]) == ("", 100)
    assert not folder.exists()


def test_the_folder_of_a_run_that_was_killed_goes_with_the_next_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    command = [sys.executable, "-m", "caviar_clients", "run", str(SMOKE), "--frames", "1000000"]
    killed = Forked([*command, "--out", str(tmp_path / "runs")], PRELOAD, stdout=subprocess.DEVNULL)
    until = time.monotonic() + 20.0
    while not [*tmp_path.glob("runs/*/recording-*.mcap")]:
        assert time.monotonic() < until
        os.sched_yield()
    (left,) = tmp_path.glob("caviar-*")
    with launcher(tmp_path) as beside:
        assert left.exists(), "it is a live run's"
        killed.kill()
        killed.wait()
        while left.exists():  # its broker holds the folder until it has ended
            assert time.monotonic() < until
            remove_leftovers()
        assert alive(beside) == []
        assert wait_for(beside, "finished")[-1]["frames"] == 10


@pytest.mark.parametrize("case", ["remote", "keys", "long path"])
def test_a_run_that_cannot_use_a_socket_file_listens_on_a_port(
    tmp_path: Path, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if case == "long path":
        long = tmp_path / ("x" * 100)
        long.mkdir()
        monkeypatch.setattr("tempfile.tempdir", str(long))
    plain = launcher(tmp_path, keys=tmp_path / "keys" if case == "keys" else None)
    services = dict(plain.scenario.services)
    if case == "remote":
        services["agent"] = msgspec.structs.replace(services["agent"], use="remote", settings={})
    scenario = msgspec.structs.replace(plain.scenario, services=services)
    with Launcher(implemented(scenario), plain.path, plain.directory, bind="", keys=plain.keys) as started:
        assert started.bind == "tcp://127.0.0.1:0"


def test_a_block_that_is_left_in_the_middle_leaves_no_process(tmp_path: Path) -> None:
    def interrupted() -> None:
        with launcher(tmp_path, frames=1_000_000) as started:
            kept.append(started)
            wait_for(started, "frame")
            raise KeyboardInterrupt

    kept: list[Launcher] = []
    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert alive(kept[0]) == []
    assert time.monotonic() - began < 60.0


def test_an_order_to_stop_ends_the_run_with_that_reason(tmp_path: Path) -> None:
    with launcher(tmp_path, frames=1_000_000) as started:
        wait_for(started, "frame")
        started.stop("enough of it")
        finished = next(event for event in started.events() if event["event"] == "finished")
    assert finished["error"] == "enough of it"
    assert alive(started) == []


def test_a_broker_that_cannot_start_says_why(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        bind = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        with (
            launcher(tmp_path, bind=bind) as started,
            pytest.raises(RunError, match="Address already in use"),
        ):
            list(started.events())
    assert alive(started) == []


def test_a_broker_that_is_stopped_is_named_at_once(tmp_path: Path) -> None:
    with launcher(tmp_path, frames=1_000_000) as started:
        wait_for(started, "frame")
        assert started._broker is not None
        os.kill(started._broker.pid, signal.SIGSTOP)
        began = time.monotonic()
        with pytest.raises(RunError, match=f"the broker died: its process {started._broker.pid} is stopped"):
            list(started.events())
        assert time.monotonic() - began < 10.0
    assert alive(started) == []


def test_a_broker_that_hangs_is_given_up_once_its_services_have_left_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(launch, "BROKER_S", 0.3)
    # It hangs, and why cannot be seen.
    monkeypatch.setattr("caviar_clients.cli.launch.is_stopped", lambda _: False)
    with launcher(tmp_path, frames=1_000_000, extra="[timeouts]\nshutdown_s = 0.5\n") as started:
        wait_for(started, "frame")
        assert started._broker is not None
        os.kill(started._broker.pid, signal.SIGSTOP)
        with pytest.raises(RunError, match="the broker does not answer"):
            list(started.events())
    assert alive(started) == []


def test_a_broker_that_never_listens_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(launch, "LISTEN_S", 0.0)
    with (
        launcher(tmp_path) as started,
        pytest.raises(RunError, match=rf"has not begun to listen within 0 s.* {tmp_path}.*broker\.log"),
    ):
        list(started.events())
    assert alive(started) == []


@pytest.mark.parametrize("name", ["logs", "logs/broker.log"])
def test_a_log_that_cannot_be_written_is_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / "run" / name
    if name == "logs":
        path.parent.mkdir()
        path.write_text("in the way")
    else:
        path.parent.mkdir(parents=True)
        os.mkfifo(path)
    words = "logs is a file, not a folder" if name == "logs" else "it is a named pipe, not a file; move it"
    with launcher(tmp_path) as started, pytest.raises(RunError, match=f"cannot write .*{words}"):
        list(started.events())


def test_services_that_die_with_their_broker_are_each_started_again_once(tmp_path: Path) -> None:
    """Their deaths are seen together with the broker's, when others have taken their places already."""
    extra = "[timeouts]\nrejoin_s = 5.0\n"
    with launcher(tmp_path, frames=100, extra=extra) as started:
        wait_for(started, "frame")
        assert started._broker is not None
        children = [started._broker, *(child.process for child in started._children.values())]
        for process in children:
            process.kill()
            os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        events = list(started.events())
    kinds = [(event["kind"], event["service"]) for event in events if event["event"] == "notice"]
    assert [kind for kind in kinds if kind[0] in ("lost", "restarted")] == [("restarted", "")]
    finished = next(event for event in events if event["event"] == "finished")
    assert (finished["error"], finished["frames"]) == ("", 100)
    assert alive(started) == []


STUBBORN = """
[services.sick]
role = "sensors"
use = "runner_services:HoldsForever"
budget_ms = 50

[timeouts]
shutdown_s = 0.5
"""


def test_a_service_that_nothing_else_ends_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It holds the interpreter's lock, so that no signal handler and no thread of it runs."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent))
    with launcher(tmp_path, extra=STUBBORN) as started:
        stuck = tmp_path / "run" / "logs" / "sick.log"
        wait_for(started, "listening")
        until = time.monotonic() + 20.0
        while "stuck" not in stuck.read_text():
            assert time.monotonic() < until
            os.sched_yield()
        began = time.monotonic()
    assert time.monotonic() - began < 0.5 + launch.KILL_AFTER_S + 20.0
    assert alive(started) == []
    assert started._children["sick"].process.returncode == -signal.SIGKILL


def test_the_last_line_of_a_long_log_is_found_at_its_end(tmp_path: Path) -> None:
    log = tmp_path / "log"
    child = Child("world", None, log, -1)  # type: ignore[arg-type]
    log.write_bytes(b"")
    assert child.last_line() == ""
    log.write_bytes(b"x" * (3 * TAIL) + b"\nsegmentation \xff fault\n\n")
    assert child.last_line() == "segmentation � fault"


CRASH = b"""reading the map
Fatal Python error: Segmentation fault

Thread 0x00007f01 (most recent call first):
  File "/lib/threading.py", line 982 in run

Current thread 0x00007f02 (most recent call first):
  File "/home/ana/tracer.py", line 12 in trace
  File "/lib/runner.py", line 3 in serve

Extension modules: numpy.linalg._umath_linalg (total: 1)
"""


def test_of_a_crash_the_line_that_crashed_is_found(tmp_path: Path) -> None:
    log = tmp_path / "log"
    child = Child("world", None, log, -1)  # type: ignore[arg-type]
    log.write_bytes(CRASH)
    crash = 'Fatal Python error: Segmentation fault, File "/home/ana/tracer.py", line 12 in trace'
    assert child.last_line() == crash
    log.write_bytes(
        CRASH + b"caviar service world: no map\n"
    )  # another process, after the crash of the first
    assert child.last_line() == "caviar service world: no map"


def test_what_the_broker_says_in_pieces_is_put_together(tmp_path: Path) -> None:
    """Lines are split wherever a read ends."""
    with launcher(tmp_path) as started:
        read, write = os.pipe()

        class Broker:
            stdout = os.fdopen(read, "rb", buffering=0)

        started._broker = Broker()  # type: ignore[assignment]
        line = json.dumps({"event": "notice", "text": "é" * 100}, ensure_ascii=False).encode() + b"\n"
        events = []
        for piece in (line[:3], line[3:40], line[40:] + line):
            os.write(write, piece)
            events += list(started._broker_said())
        assert [event["text"] for event in events] == ["é" * 100] * 2
        Broker.stdout.close()
        os.close(write)
        started._broker = None
