"""Whatever goes wrong: one clear message that names the culprit, a status, no process left."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from subprocess import DEVNULL, PIPE

import pytest
from forked import Forked
from scenarios_support import (
    MARK,
    PRELOAD,
    Finished,
    caviar,
    environment,
    eventually,
    frames_recorded,
    marked,
    pid_of,
    recorded_below,
    run,
    running,
    scenario_file,
)

RECORD = (
    'record = ["scene", "channel", "action", "link"]',
    'record = ["scene", "channel", "action", "link", "lidar"]',
)


def faulty(folder: Path, name: str, settings: str = "frame = 5", extra: str = "") -> Path:
    """The smoke scenario with one more service that goes wrong, and short time-outs."""
    return scenario_file(
        folder,
        [RECORD, ("frames = 100\n", "frames = 100\nframes_in_flight = 1\n")],
        f"""
[services.sick]
role = "sensors"
use = "faulty:{name}"
budget_ms = 50
settings = {{ {settings} }}

[timeouts]
stall_s = 1.0
{extra}
""",
        radio=False,
    )


def assert_blamed(finished: Finished, *words: str) -> None:
    """One line names the culprit; the status says it failed; nothing is left."""
    blame = [line for line in finished.output.splitlines() if all(word in line for word in words)]
    assert blame, f"no line of the output has {words}:\n{finished.output}"
    assert finished.status not in (0, None)
    assert "Traceback" not in finished.output
    assert finished.leftovers == []


def assert_readable(finished: Finished, frames: int) -> None:
    """What was recorded until then can be read, and has the digest that the broker chained."""
    assert frames_recorded(finished.directory) >= frames
    digest = caviar("inspect", "--digest", finished.directory)
    assert digest.status == 0
    summary = json.loads((finished.directory / "summary.json").read_text())
    assert digest.output.split() == [summary["digest"]]


def test_a_service_that_raises_is_named_with_its_exception_and_frame(tmp_path: Path) -> None:
    finished = run(faulty(tmp_path, "Raises"), tmp_path / "out")
    assert_blamed(finished, "sensors 'sick'", "frame 5", "ZeroDivisionError: the sensor's focal length is 0")
    assert_readable(finished, 5)


def test_a_service_that_exits_is_named_with_its_status_and_last_line(tmp_path: Path) -> None:
    started = time.monotonic()
    finished = run(faulty(tmp_path, "Exits"), tmp_path / "out")
    assert time.monotonic() - started < 120.0
    assert_blamed(finished, "sensors 'sick'", "frame 5", "status 3", "segmentation of the world failed")
    assert_readable(finished, 5)


def test_a_service_that_crashes_is_named_with_the_line_and_keeps_what_it_printed(tmp_path: Path) -> None:
    """What Python had not written to the file yet would be lost, and a crash leaves no word by itself."""
    finished = run(faulty(tmp_path, "Crashes"), tmp_path / "out")
    assert_blamed(
        finished, "sensors 'sick'", "SIGABRT", "Fatal Python error: Aborted", "faulty.py", "go_wrong"
    )
    assert f"its log: {finished.directory / 'logs' / 'sick.log'}" in finished.output
    assert "the focal length is 0\n" in (finished.directory / "logs" / "sick.log").read_text()


def test_a_log_without_a_word_is_not_pointed_at(tmp_path: Path) -> None:
    finished = run(faulty(tmp_path, "DiesInSilence"), tmp_path / "out")
    assert_blamed(finished, "sensors 'sick'", "frame 5", "status 3")
    assert "its log" not in finished.output


def test_a_service_that_never_answers_is_blamed_after_the_stall_time(tmp_path: Path) -> None:
    finished = run(faulty(tmp_path, "NeverAnswers"), tmp_path / "out")
    assert_blamed(finished, "sensors 'sick'", "makes no progress", "frame 5", "budget", "last heartbeat")
    assert_readable(finished, 5)


@pytest.mark.parametrize(
    ("number", "words"), [(signal.SIGKILL, "SIGKILL"), (signal.SIGSTOP, "is stopped (SIGSTOP")]
)
def test_a_service_killed_or_stopped_from_outside_is_named_with_the_signal(
    tmp_path: Path, number: signal.Signals, words: str
) -> None:
    scenario = faulty(tmp_path, "Raises", "frame = 1000000")
    with running(scenario, tmp_path, "--frames", "100000") as (process, mark):
        eventually(lambda: recorded_below(tmp_path) > 3, 20, "a few frames are recorded")
        os.kill(pid_of(mark, "caviar_services sick"), number)
        output, _ = process.communicate(timeout=120)
        assert process.returncode == 1
        assert "sensors 'sick' died" in output
        assert words in output
        assert marked(mark) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_ctrl_c_ends_everything_cleanly(tmp_path: Path, number: signal.Signals) -> None:
    with running(scenario_file(tmp_path, radio=False), tmp_path, "--frames", "100000") as (process, mark):
        eventually(lambda: recorded_below(tmp_path) > 3, 20, "a few frames are recorded")
        process.send_signal(number)
        output, _ = process.communicate(timeout=120)
        assert process.returncode == 130
        assert "stopped by" in output
        assert marked(mark) == []
    assert frames_recorded(next(tmp_path.glob("smoke-*"))) > 0


def test_a_run_that_ctrl_c_ends_before_its_first_frame_leaves_no_directory(tmp_path: Path) -> None:
    file = scenario_file(tmp_path, base="remote")
    with running(file, tmp_path / "out") as (process, mark):
        log = "out/*/logs/broker.log"
        eventually(lambda: list(tmp_path.glob(log)), 20, "the broker starts")
        process.send_signal(signal.SIGINT)
        output, _ = process.communicate(timeout=120)
        assert process.returncode == 130
        assert "no frame was simulated" in output
        assert marked(mark) == []
    assert list((tmp_path / "out").iterdir()) == []


def test_a_launcher_that_is_killed_leaves_no_process_behind(tmp_path: Path) -> None:
    with running(scenario_file(tmp_path, radio=False), tmp_path, "--frames", "100000") as (process, mark):
        eventually(lambda: recorded_below(tmp_path) > 3, 20, "a few frames are recorded")
        process.kill()
        process.wait()
        eventually(lambda: not marked(mark), 10, "all processes of the run end")


def test_a_broker_that_is_killed_is_named_and_leaves_no_process_behind(tmp_path: Path) -> None:
    with running(scenario_file(tmp_path, radio=False), tmp_path, "--frames", "100000") as (process, mark):
        eventually(lambda: recorded_below(tmp_path) > 3, 20, "a few frames are recorded")
        os.kill(pid_of(mark, "caviar_broker"), signal.SIGKILL)
        output, _ = process.communicate(timeout=120)
        assert process.returncode == 1
        assert "the broker died: it was killed by SIGKILL" in output
        assert marked(mark) == []


SMOKE_SERVICES = {
    "world": "world:trajectory",
    "recorder": "recorder:mcap",
}

GARBAGE_CLIENT = """
import sys, msgpack, zmq
socket = zmq.Context().socket(zmq.DEALER)
socket.connect(sys.argv[1])
def send(**fields): socket.send(msgpack.packb(fields))
def receive():
    assert socket.poll(20000)
    return msgpack.unpackb(socket.recv_multipart()[0])
send(type="HELLO", version=[1, 0], name="sick", role="sensors",
     inputs=[{"topic": "scene"}], outputs=["lidar"])
welcome = receive()
who = {key: welcome[key] for key in ("epoch", "attempt")}
while True:
    message = receive()
    if message["type"] == "PREPARE":
        send(type="READY", **who)
    elif message["type"] == "RESET":
        send(type="RESET_DONE", episode=0, **who)
    elif message["type"] == "GRANT":
        socket.send(bytes.fromhex(sys.argv[2]))
    elif message["type"] == "SHUTDOWN":
        break
"""


@pytest.mark.parametrize(
    "garbage",
    ["ff00ff00", "81a474797065a6424c45545448", "c1"],
    ids=["noise", "unknown-type", "reserved-byte"],
)
def test_a_service_that_answers_garbage_is_named(tmp_path: Path, garbage: str) -> None:
    """A stranger's process beside the real services, started by hand as in a distributed run."""
    env = environment("garbage-" + os.urandom(8).hex())
    command = [sys.executable, "-m", "caviar_broker", str(faulty(tmp_path, "Raises"))]
    command += ["--bind", "tcp://127.0.0.1:0", "--directory", str(tmp_path / "run")]
    with Forked(command, PRELOAD, env=env, stdout=PIPE, stderr=PIPE, text=True) as broker:
        assert broker.stdout is not None
        endpoint = broker.stdout.readline().split()[-1]
        services: list[subprocess.Popen[bytes]] = [
            subprocess.Popen([sys.executable, "-c", GARBAGE_CLIENT, endpoint, garbage], env=env)
        ]
        for name, use in SMOKE_SERVICES.items():
            command = [sys.executable, "-m", "caviar_services", name, "--use", use, "--broker", endpoint]
            services.append(Forked(command, PRELOAD, env=env, stdout=DEVNULL, stderr=DEVNULL))
        output, errors = broker.communicate(timeout=120)
    for service in services:
        service.wait(10)
    leftovers = marked(env[MARK])
    finished = Finished(broker.returncode, output + errors, tmp_path / "run", leftovers)
    assert_blamed(finished, "sensors 'sick'", "not in the protocol")
    assert frames_recorded(tmp_path / "run") == 0


def test_a_port_in_use_is_named_with_the_remedy(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        finished = run(
            scenario_file(tmp_path, radio=False), tmp_path / "out", "--bind", f"tcp://127.0.0.1:{port}"
        )
    assert_blamed(finished, f"127.0.0.1:{port}", "Address already in use", "--bind")


TOWN = """
<scene version="3.0.0">
  <bsdf type="itu-radio-material" id="wall"><string name="type" value="concrete"/></bsdf>
  <shape type="ply" id="mesh-tower">
    <string name="filename" value="meshes/tower.ply"/><ref id="wall" name="bsdf"/>
  </shape>
</scene>
"""


def test_a_missing_mesh_is_named_with_its_scene(tmp_path: Path) -> None:
    (tmp_path / "town.xml").write_text(TOWN)
    objects = "[[services.world.settings.objects]]"
    scenery = '[services.world.settings]\nscenery = "file:town.xml"\n\n'
    scenario = scenario_file(tmp_path, [(objects, scenery + objects)], radio=False)
    assert_blamed(run(scenario, tmp_path / "out"), "world 'world'", "tower.ply", "town.xml")


@pytest.mark.channel
def test_a_missing_llvm_is_named_with_the_setting(tmp_path: Path) -> None:
    scenario = scenario_file(tmp_path, [('use = "free-space"', 'use = "sionna-rt"')])
    finished = run(scenario, tmp_path / "out", DRJIT_LIBLLVM_PATH="/nowhere/libLLVM.so")
    assert_blamed(finished, "channel 'channel'", "DRJIT_LIBLLVM_PATH", "/nowhere/libLLVM.so")


def test_an_unknown_key_is_named_with_file_line_and_suggestion(tmp_path: Path) -> None:
    scenario = scenario_file(tmp_path, [("budget_ms = 20", "budgte_ms = 20")])
    line = 1 + scenario.read_text()[: scenario.read_text().index("budgte_ms")].count("\n")
    assert_blamed(run(scenario, tmp_path / "out"), f"{scenario}:{line}", "budgte_ms", "budget_ms")


def test_an_unknown_setting_of_a_service_is_named_with_file_line_and_suggestion(tmp_path: Path) -> None:
    scenario = scenario_file(tmp_path, [('use = "beams"\n', 'use = "beams"\nsettings = { topk = 3 }\n')])
    line = 1 + scenario.read_text()[: scenario.read_text().index("topk")].count("\n")
    assert_blamed(run(scenario, tmp_path / "out"), f"{scenario}:{line}", "topk", "top_k")


@pytest.mark.parametrize("how", ["", "--embedded"])
def test_what_only_a_service_finds_wrong_is_named_with_file_and_line(tmp_path: Path, how: str) -> None:
    scenario = scenario_file(tmp_path, [('name = "uav"', 'name = "car"')], radio=False)
    line = 1 + scenario.read_text()[: scenario.read_text().rindex("[[services.world")].count("\n")
    key = "services.world.settings.objects[1]: a second object is named 'car'"
    finished = run(scenario, tmp_path / "out", *filter(None, [how]))
    assert_blamed(finished, "world 'world'", f"{scenario}:{line}: {key}")


def test_an_unknown_implementation_is_named_with_file_line_and_suggestion(tmp_path: Path) -> None:
    scenario = scenario_file(tmp_path, [('use = "free-space"', 'use = "freespace"')])
    line = 1 + scenario.read_text()[: scenario.read_text().index("freespace")].count("\n")
    assert_blamed(run(scenario, tmp_path / "out"), f"{scenario}:{line}", "freespace", "'free-space'")


def test_an_agent_that_served_nobody_is_warned_of_when_the_run_is_over(tmp_path: Path) -> None:
    """Before that, a user might still have come."""
    users = ('use = "los-beam"', 'use = "los-beam"\nusers = ["car-9/rx"]')
    scenario = scenario_file(tmp_path, [users, ('on = "car"', 'on = "car*"')])
    finished = run(scenario, tmp_path / "out", "--embedded", "--frames", "3")
    assert finished.status == 0, finished.output
    (warning,) = json.loads((finished.directory / "summary.json").read_text())["warnings"]
    assert warning.startswith("agent had no user to serve in any frame")
    assert "warning: agent had no user" in finished.output


def test_two_worlds_with_the_same_names_are_refused(tmp_path: Path) -> None:
    scenario = scenario_file(
        tmp_path,
        extra="""
[services.other]
role = "world"
use = "trajectory"
budget_ms = 20
[[services.other.settings.objects]]
name = "car"
kind = "car"
dimensions_m = [4.0, 1.8, 1.5]
waypoints = [[0.0, 0.0, 0.0, 0.75], [1.0, 1.0, 0.0, 0.75]]
""",
        radio=False,
    )
    text = scenario.read_text().replace("[[devices]]\n", '[[devices]]\nworld = "world"\n')
    scenario.write_text(text)
    assert_blamed(run(scenario, tmp_path / "out"), "'world'", "'other'", "'car")


def test_a_cycle_is_refused_by_naming_it(tmp_path: Path) -> None:
    scenario = faulty(
        tmp_path,
        "Circular",
        extra='[services.sicker]\nrole = "sensors"\nuse = "faulty:CircularToo"\nbudget_ms = 50',
    )
    assert_blamed(run(scenario, tmp_path / "out"), "cycle", "sick", "sicker")
