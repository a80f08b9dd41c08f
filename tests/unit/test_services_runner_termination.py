"""SIGTERM ends a service within 2 s, whatever it is at."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from runner_harness import Broker, ends, hears, played_broker, service

from caviar_protocol import messages as m
from caviar_protocol.host import start_process

pytestmark = pytest.mark.slow

__all__ = ["played_broker"]


def terminated(process: subprocess.Popen[str], number: int = signal.SIGTERM) -> str:
    """What it says until it has ended, within 2 s."""
    started = time.monotonic()
    process.send_signal(number)
    said = ends(process, 143, within_s=5.0)
    elapsed = time.monotonic() - started
    sys.stdout.write(f"ended {elapsed:.2f} s after the signal\n")
    assert elapsed < 2.0
    return said


def test_ctrl_c_does_not_end_a_process_that_still_imports() -> None:
    process = multiprocessing.get_context("spawn").Process(target=time.sleep, args=(0.0,))
    start_process(process)
    os.kill(process.pid or 0, signal.SIGINT)
    process.join(30)
    assert process.exitcode == 0
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_between_frames_ends_it_with_bye(broker: Broker, number: signal.Signals) -> None:
    with service(broker.endpoint) as process:
        broker.start()
        process.send_signal(number)
        assert broker.expect(m.Bye).reason == "SIGTERM"
        assert "closed" in ends(process, 143, within_s=2.0)


def test_sigterm_while_it_waits_for_a_broker_ends_it(broker: Broker) -> None:
    with service(broker.endpoint) as process:
        broker.expect(m.Hello)  # and no WELCOME
        terminated(process)


@pytest.mark.parametrize("name", ["WaitsForever", "SleepsInC", "ComputesInC", "HoldsTheInterpreter"])
def test_sigterm_ends_a_service_that_is_stuck_in_a_frame(broker: Broker, name: str) -> None:
    with service(broker.endpoint, f"sensors:{name}") as process:
        broker.start()
        broker.grant(0)
        hears(process, "stuck")
        terminated(process)


def test_a_service_that_looks_for_orders_leaves_a_frame_that_waits(broker: Broker) -> None:
    """SHUTDOWN and SIGTERM, as elsewhere between frames: BYE, and everything closed."""
    for order in ("SHUTDOWN", "SIGTERM"):
        with service(broker.endpoint, "sensors:Attends") as process:
            broker.start()
            broker.grant(0)
            hears(process, "stuck")
            if order == "SHUTDOWN":
                broker.shutdown()
                assert "closed" in ends(process, 0, within_s=2.0)
            else:
                process.send_signal(signal.SIGTERM)
                assert broker.expect(m.Bye).reason == "SIGTERM"
                assert "closed" in ends(process, 143, within_s=2.0)


def test_what_comes_while_a_frame_waits_is_handled_after_it(broker: Broker, tmp_path: Path) -> None:
    """A repeated GRANT, and one too early; progress goes on, so that the wait is no stall."""
    with service(broker.endpoint, "sensors:Attends") as process:
        broker.start(scenario={"directory": str(tmp_path)})
        broker.grant(0)
        hears(process, "stuck")
        broker.grant(0)
        broker.grant(1)
        first = len(broker.beats)
        broker.until(lambda: len(broker.beats) >= first + 4)
        assert broker.beats[-1].phase == "waiting"
        assert broker.beats[-1].progress > broker.beats[first].progress
        (tmp_path / "go").touch()
        assert [broker.expect(m.Done).frame for _ in range(3)] == [0, 0, 1]
        broker.shutdown()
        ends(process, 0)


def test_sigterm_ends_a_service_that_is_stuck_in_prepare(broker: Broker) -> None:
    with service(broker.endpoint, "sensors:SleepsInC") as process:
        broker.welcome(settings={"wrong": "prepare"})
        broker.prepare()
        hears(process, "stuck")
        assert "in the middle of a call that does not return" in terminated(process)


def test_sigterm_ends_a_service_that_hangs_when_it_closes(broker: Broker) -> None:
    with service(broker.endpoint, "sensors:IgnoresClosing") as process:
        broker.start()
        terminated(process)


LATE = """
import os
from caviar_services.runner import SignalTermination

class Late:
    def __del__(self, kill=os.kill, pid=os.getpid()):
        kill(pid, 15)

late = Late()  # gone when the interpreter clears this module
SignalTermination(0).finished()
"""


def test_sigterm_while_the_interpreter_shuts_down_is_not_the_status() -> None:
    assert subprocess.run([sys.executable, "-c", LATE], check=False).returncode == 0
