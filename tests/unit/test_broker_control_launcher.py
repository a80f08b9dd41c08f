"""A launcher that reads slowly, not at all, or talks nonsense, and what a broker tells it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from broker_harness import MS, plan, playing
from forked import Forked
from scenarios_support import PRELOAD

from caviar_broker.control.launcher import MAX_PENDING, Outbox, Reporter
from caviar_broker.core.events import FrameFinished, Notice
from caviar_broker.core.plan import ServicePlan
from caviar_broker.journal import JournalFile
from caviar_broker.security.limits import PERIOD_NS, NoticeThrottle
from caviar_broker.server import BrokerServer
from caviar_broker.statistics import Statistics
from caviar_protocol.assets import AssetStore

pytestmark = pytest.mark.slow

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    """A pipe of 64 KiB."""
    read, write = os.pipe()
    yield read, write
    for fd in (read, write):
        try:
            os.close(fd)
        except OSError:
            continue  # a test closed it


def read_all(fd: int) -> list[dict[str, Any]]:
    """Every line until the pipe is closed at the other end."""
    with os.fdopen(os.dup(fd), "rb") as file:
        return [json.loads(line) for line in file]


def notice(number: int) -> dict[str, Any]:
    return {"event": "notice", "number": number, "text": "x" * 200}


# --- the outbox -------------------------------------------------------------------------------------------


def test_a_reader_that_comes_late_gets_every_notice_in_order(tmp_path: Path, pipe: tuple[int, int]) -> None:
    """10,000 notices of 250 B into a pipe of 64 KiB that is not read, and none of them is lost."""
    outbox = Outbox(pipe[1], tmp_path / "log", json.dumps)
    tracemalloc.start()
    started = time.monotonic()
    for number in range(10_000):
        outbox.notice(notice(number))
        outbox.passing({"event": "frame"})
    assert time.monotonic() - started < 100.0
    assert tracemalloc.get_traced_memory()[1] < 4 * MAX_PENDING
    tracemalloc.stop()
    assert outbox.waiting
    found: list[dict[str, Any]] = []
    reader = threading.Thread(target=lambda: found.extend(read_all(pipe[0])))
    reader.start()
    outbox.finish({"event": "finished"}, within_s=20.0)
    os.close(pipe[1])
    reader.join(20.0)
    assert [line["number"] for line in found if line["event"] == "notice"] == list(range(10_000))
    assert found[-1] == {"event": "finished"}
    assert sum(line["event"] == "frame" for line in found) < 1000


def test_a_reader_that_never_reads_does_not_hold_the_end_up(tmp_path: Path, pipe: tuple[int, int]) -> None:
    outbox = Outbox(pipe[1], tmp_path / "log", json.dumps)
    for number in range(5000):
        outbox.notice(notice(number))
    started = time.monotonic()
    outbox.finish({"event": "finished"}, within_s=0.3)
    assert 0.2 < time.monotonic() - started < 20.0
    logged = [json.loads(line)["number"] for line in (tmp_path / "log").read_text().splitlines()]
    assert logged == list(range(5000))


def test_a_reader_that_is_gone_leaves_the_log(tmp_path: Path, pipe: tuple[int, int]) -> None:
    outbox = Outbox(pipe[1], tmp_path / "log", json.dumps)
    os.close(pipe[0])
    for number in range(10):
        outbox.notice(notice(number))
    assert outbox.gone
    assert not outbox.waiting
    outbox.finish({"event": "finished"}, within_s=5.0)
    assert len((tmp_path / "log").read_text().splitlines()) == 10


def test_a_log_that_cannot_be_written_still_tells_the_reader(pipe: tuple[int, int]) -> None:
    outbox = Outbox(pipe[1], Path("/dev/full"), json.dumps)
    outbox.notice(notice(1))
    while not outbox.log_error:  # of the thread that writes, which a busy machine lets wait
        time.sleep(0.01)
    assert "No space left" in outbox.log_error
    assert json.loads(os.read(pipe[0], 4096))["number"] == 1
    outbox.close()


def test_a_log_of_an_earlier_broker_is_appended_to_and_not_told_again(
    tmp_path: Path, pipe: tuple[int, int]
) -> None:
    (tmp_path / "log").write_text(json.dumps(notice(-1)) + "\n")
    outbox = Outbox(pipe[1], tmp_path / "log", json.dumps)
    outbox.notice(notice(0))
    outbox.close()
    os.close(pipe[1])
    assert [line["number"] for line in read_all(pipe[0])] == [0]
    assert len((tmp_path / "log").read_text().splitlines()) == 2


# --- the reporter -------------------------------------------------------------------------------------------


def test_a_person_reads_words_and_no_progress(tmp_path: Path, pipe: tuple[int, int]) -> None:
    reporter = Reporter(pipe[1], tmp_path / "log", control=False)
    reporter.listening("tcp://127.0.0.1:5570")
    reporter.notice(Notice("miss", "link", "too slow", 0, 7))
    reporter.notice(Notice("note", "link", "uses the CPU"))
    reporter.frame(FrameFinished(0, 0, 0, 0), Statistics({}))
    reporter.finished(digest="abc", frames=3, error="")
    assert os.read(pipe[0], 4096).decode().splitlines() == [
        "listening on tcp://127.0.0.1:5570",
        "miss: link frame 7: too slow",
        "note: link: uses the CPU",
        "3 frames, digest abc",
    ]


def test_a_launcher_reads_json_and_progress_not_more_often_than_it_can(
    tmp_path: Path, pipe: tuple[int, int]
) -> None:
    reporter = Reporter(pipe[1], tmp_path / "log", control=True)
    for frame in range(1000):
        reporter.frame(FrameFinished(0, frame, 0, 0), Statistics({}))
    reporter.finished(digest="abc")
    os.close(pipe[1])
    events = [line["event"] for line in read_all(pipe[0])]
    assert events[-1] == "finished"
    assert 1 <= events.count("frame") < 20


def test_a_launcher_that_does_not_read_slows_nothing_down(tmp_path: Path, pipe: tuple[int, int]) -> None:
    """2,000 frames, each a miss; the pipe is full after some hundred of them."""
    services = (
        ServicePlan(name="world", role="world", budget_ns=1000 * MS),
        ServicePlan(name="sensors", role="sensors", budget_ns=1, policy="drop"),
    )
    run = replace(plan("world", "sensors", frames=2000), services=services)
    reporter = Reporter(pipe[1], tmp_path / "events.jsonl", control=True)
    journal = JournalFile(tmp_path / "journal", 1)
    server = BrokerServer(run, "tcp://127.0.0.1:0", journal, reporter, AssetStore(tmp_path / "cache"))
    reporter.attach(server)
    thread = threading.Thread(target=server.run)
    thread.start()
    with playing(server.endpoint, "world", "sensors") as (world, sensors):
        for _ in range(2000):
            world.answer()
        sensors.answer()
        thread.join(60)
    assert not thread.is_alive()
    assert server.statistics.frames == 2000
    found: list[dict[str, Any]] = []
    reader = threading.Thread(target=lambda: found.extend(read_all(pipe[0])))
    reader.start()
    reporter.finished(digest="abc")
    os.close(pipe[1])
    reader.join(60)
    told = [
        line["frame"] for line in found if line["event"] == "notice" and line["kind"] in ("miss", "skipped")
    ]
    assert sorted(set(told)) == list(range(2000))
    journal.close()


# --- the process --------------------------------------------------------------------------------------------


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A broker process under control of this test."""
    command = [sys.executable, "-m", "caviar_broker", str(SMOKE), "--bind", "tcp://127.0.0.1:0"]
    command += ["--directory", str(tmp_path / "run"), "--control"]
    with Forked(command, PRELOAD, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0) as process:
        try:
            assert process.stdout is not None
            assert json.loads(process.stdout.readline())["event"] == "listening"
            yield process
        finally:
            process.kill()


def events_of(broker: subprocess.Popen[bytes]) -> list[dict[str, Any]]:
    """What it still says until it ends."""
    assert broker.stdout is not None
    lines = [json.loads(line) for line in broker.stdout]
    assert broker.wait(5) == 1
    return lines


def test_an_order_to_stop_ends_the_run_and_orders_that_are_none_are_noted(
    broker: subprocess.Popen[bytes],
) -> None:
    assert broker.stdin is not None
    for line in (b"nonsense", b"[1, 2]", b'{"lost": "nobody", "verdict": "x"}', b'{"stop": "enough"}'):
        broker.stdin.write(line + b"\n")
    events = events_of(broker)
    assert [event["text"][:30] for event in events[:-1]] == ["the launcher gave an order tha"] * 3
    assert (events[-1]["event"], events[-1]["error"], events[-1]["frames"]) == ("finished", "enough", 0)


def test_the_loss_of_a_child_is_the_end_with_its_last_words(broker: subprocess.Popen[bytes]) -> None:
    assert broker.stdin is not None
    broker.stdin.write(b'{"lost": "link", "verdict": "it exited with status 3, ')
    broker.stdin.write(b'saying: no libLLVM"}\n')
    last = events_of(broker)[-1]
    assert last["culprit"] == "link"
    assert "link 'link' died" in last["error"]
    assert "saying: no libLLVM" in last["error"]


def test_the_run_ends_with_its_launcher(broker: subprocess.Popen[bytes]) -> None:
    assert broker.stdin is not None
    broker.stdin.close()
    assert events_of(broker)[-1]["error"] == "the launcher of the run ended"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_the_run_in_order(broker: subprocess.Popen[bytes], number: signal.Signals) -> None:
    started = time.monotonic()
    broker.send_signal(number)
    assert events_of(broker)[-1]["error"] == f"stopped by {number.name}"
    assert time.monotonic() - started < 20.0


def test_a_directory_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    command = [
        sys.executable,
        "-m",
        "caviar_broker",
        str(SMOKE),
        "--directory",
        str(tmp_path / "file" / "run"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 1
    assert "cannot write the run to" in done.stderr
    assert "--directory" in done.stderr


# --- repetitions --------------------------------------------------------------------------------------------


def test_repetitions_are_counted_and_told_together() -> None:
    throttle = NoticeThrottle()
    assert throttle.tell("noise", "first", 0) == "first"
    assert [throttle.tell("noise", "more", now) for now in range(1, 1000)] == [""] * 999
    assert throttle.tell("other", "another", 5) == "another"
    assert throttle.tell("noise", "last", PERIOD_NS) == "last (and 999 more of this kind)"
    assert throttle.tell("noise", "later", 2 * PERIOD_NS) == "later"
