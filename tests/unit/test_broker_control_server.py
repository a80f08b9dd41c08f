"""The desk of a running broker, over its socket, and ``caviar status``."""

from __future__ import annotations

import json
import os
import re
import select
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from broker_harness import (
    PAIR,
    PATIENCE_S,
    Client,
    Serving,
    eventually,
    plan,
    play_to_the_end,
    playing,
    serving,
)
from rich.console import Console

from caviar_broker.control.server import MAX_CONNECTIONS, MAX_REQUEST, MAX_WAITING
from caviar_broker.control.socket import ask, connect, locked
from caviar_clients.cli.remote import newest_run, why_command
from caviar_protocol import messages as m
from caviar_protocol.errors import RunError

pytestmark = pytest.mark.slow

SOCKET, NOTE = "control.sock", "control.json"


@contextmanager
def desk_of(tmp_path: Path, directory: Path | None = None, **run: Any) -> Iterator[Serving]:
    """A world and sensors, whose broker has a desk in ``directory``."""
    with serving(plan(*PAIR, **run), tmp_path, desk=directory or tmp_path) as broker:
        yield broker


def why(directory: Path) -> str:
    written = StringIO()
    why_command(directory, Console(file=written, width=1000))
    return written.getvalue()


def status(directory: Path) -> dict[str, Any]:
    found: dict[str, Any] = ask(directory, do="status")["status"]
    return found


# --- questions ---------------------------------------------------------------------------------------------


def test_status_tells_run_frames_services_and_how_they_keep_their_budgets(tmp_path: Path) -> None:
    with desk_of(tmp_path, frames=5) as broker, playing(broker.endpoint, *PAIR) as (world, sensors):
        for _ in range(2):
            world.answer()
            sensors.answer()
        world.answer()
        grant = sensors.expect(m.Grant)
        assert grant.frame == 2
        found = status(tmp_path)
        assert (found["run"], found["epoch"], found["state"], found["episode"]) == ("test", 1, "running", 0)
        assert (found["frames"], found["frames_finished"], found["pace"]) == (5, 2, "free")
        assert found["endpoint"] == broker.endpoint
        by_name = {service["name"]: service for service in found["services"]}
        (owed,) = by_name["sensors"]["grants"]
        assert (owed["frame"], owed["state"], owed["budget_s"]) == (2, "granted", 0.05)
        assert by_name["sensors"]["grants"][0]["elapsed_s"] > 0
        assert (by_name["sensors"]["grants_answered"], by_name["world"]["grants_answered"]) == (2, 3)
        assert 0 < by_name["world"]["p50_ms"] <= by_name["world"]["p99_ms"]


def test_why_names_who_is_late_in_which_frame_and_who_lacks_what(tmp_path: Path) -> None:
    with desk_of(tmp_path) as broker, playing(broker.endpoint, *PAIR) as (world, sensors):
        world.answer()  # frame 0 may be late: services warm up in it
        sensors.answer()
        world.expect(m.Grant)
        eventually(lambda: "late: world 'world' is late in frame 1" in why(tmp_path), "the world is late")
        told = why(tmp_path)
        assert re.search(r"\d+ ms since its grant, budget 50 ms; no heartbeat ever came", told)
        assert "sensors waits for scene of frame 1" in told
        assert "last blame: miss: world in frame 1: world 'world' overran its budget" in told
        assert "no service is late" not in told


def test_why_tells_phase_and_progress_of_the_last_heartbeat(tmp_path: Path) -> None:
    with desk_of(tmp_path) as broker, playing(broker.endpoint, *PAIR) as (world, _):
        world.attach().send(m_heartbeat())
        world.expect(m.Grant)
        eventually(lambda: "phase 'rays', progress 7" in why(tmp_path), "the heartbeat is reported")


def m_heartbeat() -> bytes:
    from caviar_protocol.codec import encode_message

    return encode_message(m.Heartbeat(sequence=1, progress=7, phase="rays"))


def test_why_names_whoever_has_not_connected(tmp_path: Path) -> None:
    with desk_of(tmp_path) as broker, Client(broker.endpoint, "world") as world:
        world.join()
        told = why(tmp_path)
        assert "no service is late" in told
        assert "waited for: sensors 'sensors' has not connected" in told
        assert "world 'world'" not in told


def test_an_unknown_request_is_refused_by_naming_the_known_ones(tmp_path: Path) -> None:
    with desk_of(tmp_path):
        with pytest.raises(RunError, match=r"'dance'.*status, why.*subscribe"):
            ask(tmp_path, do="dance")
        with connect(tmp_path) as connection, connection.makefile("rwb") as lines:
            for line in (b"[1]", b"\xff", b"{", b"null", b'{"do": ["status"]}'):
                lines.write(line + b"\n")
                lines.flush()
                assert json.loads(lines.readline())["ok"] is False
            lines.write(b'{"do": "status", "id": 9}\n')
            lines.flush()
            assert json.loads(lines.readline())["id"] == 9


# --- orders ------------------------------------------------------------------------------------------------


def test_a_paused_run_grants_nothing_until_it_may_step_or_go_on(tmp_path: Path) -> None:
    with desk_of(tmp_path) as broker, playing(broker.endpoint, *PAIR) as (world, sensors):
        world.expect(m.Grant)
        begun = ask(tmp_path, do="pause")
        assert (begun["paused"], begun["frame"]) == (True, 0)
        world.send(m.Done(**world.ids, episode=0, frame=0))
        sensors.quiet(50)  # its only input is absent, so that it is not granted
        assert world.quiet(200)
        assert "no service is late: the run is paused" in why(tmp_path)
        ask(tmp_path, do="step")
        assert world.answer().frame == 1
        assert sensors.answer().frame == 1
        assert world.quiet(200)
        assert ask(tmp_path, do="resume")["paused"] is False
        assert world.answer().frame == 2
        assert sensors.answer().frame == 2
        eventually(lambda: status(tmp_path)["state"] == "stopping", "the last frame is finished")
        with pytest.raises(RunError, match="the run is over"):
            ask(tmp_path, do="pause")


def test_a_stop_ends_the_run_with_its_reason(tmp_path: Path) -> None:
    with desk_of(tmp_path) as broker, playing(broker.endpoint, *PAIR) as clients:
        assert ask(tmp_path, do="stop", reason="lunch")["state"] == "stopping"
        for client in clients:
            while not isinstance(message := client.receive(), m.Shutdown):
                assert isinstance(message, m.Grant)
            assert message.reason == "lunch"
        assert broker.outcome().error == "lunch"


@pytest.mark.parametrize(
    ("request_", "told"),
    [
        ({"do": "step"}, "not paused; pause it first"),
        ({"do": "step", "frames": 0}, "from 1 to"),
        ({"do": "step", "frames": True}, "from 1 to"),
        ({"do": "step", "frames": 1e99}, "from 1 to"),
        ({"do": "stop", "reason": "x" * 501}, "at most 500"),
        ({"do": "stop", "reason": 7}, "at most 500"),
        ({"do": "note", "text": ""}, "1 to 1000"),
        ({"do": "note", "text": "x", "service": "nobody"}, "a service of the run"),
        ({"do": "serving"}, "address"),
    ],
)
def test_a_wrong_order_is_refused_and_changes_nothing(
    tmp_path: Path, request_: dict[str, Any], told: str
) -> None:
    with desk_of(tmp_path) as broker, playing(broker.endpoint, *PAIR) as clients:
        with pytest.raises(RunError, match=told):
            ask(tmp_path, **request_)
        play_to_the_end(clients, 3)
        assert broker.outcome().error == ""


@pytest.mark.parametrize("line", [b"[" * 2000, b'{"a":' * 700, b"{", b"7", b"\xff"])
def test_a_line_that_is_no_request_is_refused_and_the_broker_goes_on(tmp_path: Path, line: bytes) -> None:
    with desk_of(tmp_path) as broker, playing(broker.endpoint, *PAIR) as clients:
        with connect(tmp_path) as connection, connection.makefile("rwb") as lines:
            lines.write(line + b"\n")
            lines.flush()
            assert "one JSON object a line" in json.loads(lines.readline())["error"]
        play_to_the_end(clients, 3)
        assert broker.outcome().error == ""


def test_a_subscriber_hears_notices_frames_and_the_end(tmp_path: Path) -> None:
    with desk_of(tmp_path) as broker, playing(broker.endpoint, *PAIR) as clients:
        with connect(tmp_path) as connection, connection.makefile("rwb") as lines:
            lines.write(b'{"do": "subscribe"}\n')
            lines.flush()
            assert json.loads(lines.readline()) == {"ok": True}
            ask(tmp_path, do="note", text="hear, hear")
            play_to_the_end(clients, 3)
            events = [json.loads(line) for line in lines]
        assert next(event["text"] for event in events if event["event"] == "notice") == "hear, hear"
        assert next(event["frame"] for event in events if event["event"] == "frame") == 0
        last = events[-1]
        assert (last["event"], last["error"]) == ("finished", "")
        assert last["digest"] == broker.outcome().digest


# --- who may, and how much ----------------------------------------------------------------------------------


def test_only_the_user_of_the_broker_may_connect(tmp_path: Path) -> None:
    with desk_of(tmp_path):
        assert stat.S_IMODE((tmp_path / SOCKET).stat().st_mode) == 0o600


def test_a_directory_may_have_any_length(tmp_path: Path) -> None:
    directory = tmp_path / ("d" * 150)
    directory.mkdir()
    with desk_of(tmp_path, directory):
        assert len(os.fsencode(directory / SOCKET)) > 107
        assert (directory / SOCKET).is_socket()
        assert status(directory)["run"] == "test"


def test_nothing_is_left_behind(tmp_path: Path) -> None:
    directory = tmp_path / "run"
    directory.mkdir()
    with desk_of(tmp_path, directory) as broker:
        ask(directory, do="stop")
        broker.outcome()
    assert list(directory.iterdir()) == []


def test_a_second_broker_may_not_serve_the_same_directory_but_the_next_may(tmp_path: Path) -> None:
    with desk_of(tmp_path):
        with pytest.raises(RunError, match="another broker runs in"), desk_of(tmp_path):
            pass
        assert status(tmp_path)["run"] == "test"
    for name in (SOCKET, NOTE):
        (tmp_path / name).write_text("{}")  # as a broker leaves them that was killed
    with desk_of(tmp_path):
        assert status(tmp_path)["run"] == "test"


def test_one_who_asks_without_reading_is_held_back_and_holds_nobody_up(tmp_path: Path) -> None:
    with (
        desk_of(tmp_path, frames=50) as broker,
        playing(broker.endpoint, *PAIR) as clients,
        connect(tmp_path) as greedy,
    ):
        greedy.setblocking(False)
        assert not sent_without_end(greedy, b'{"do": "status"}\n' * 200)
        play_to_the_end(clients, 50)
        assert broker.outcome().error == ""


def sent_without_end(connection: socket.socket, data: bytes) -> bool:
    """Whether a socket takes whatever is sent, for a long time."""
    for _ in range(1000):
        if not select.select([], [connection], [], 0.5)[1]:
            return False
        connection.send(data)
    return True


def test_a_subscriber_that_does_not_read_is_cut_off(tmp_path: Path) -> None:
    with desk_of(tmp_path), connect(tmp_path) as mute:
        mute.sendall(b'{"do": "subscribe"}\n')
        assert mute.recv(100) == b'{"ok": true}\n'
        for _ in range(2 * MAX_WAITING // 1000):
            ask(tmp_path, do="note", text="x" * 1000)
        received = b""
        while data := mute.recv(1 << 20):
            received += data
        assert received.count(b"\n") < 2 * MAX_WAITING // 1000


def test_a_line_that_never_ends_is_cut_off(tmp_path: Path) -> None:
    with desk_of(tmp_path), connect(tmp_path) as connection:
        connection.sendall(b"x" * (MAX_REQUEST + 1))
        connection.settimeout(PATIENCE_S)
        came = b""
        with suppress(ConnectionResetError):
            came = connection.recv(10)
        assert came == b""
        assert status(tmp_path)["run"] == "test"


def test_one_connection_too_many_is_closed_and_there_is_room_when_others_leave(tmp_path: Path) -> None:
    with desk_of(tmp_path):
        others = [connect(tmp_path) for _ in range(MAX_CONNECTIONS)]
        with pytest.raises(RunError, match="hung up"):
            ask(tmp_path, do="why")
        for other in others:
            other.close()
        eventually(lambda: answered(tmp_path), "there is room again")


def answered(directory: Path) -> bool:
    try:
        return bool(ask(directory, do="why"))
    except RunError:
        return False


# --- where there is no broker ---------------------------------------------------------------------------


def test_why_says_where_no_broker_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RunError, match=f"no broker runs in {tmp_path}"):
        why(tmp_path)
    with pytest.raises(RunError, match=r"there is no directory .*missing; give"):
        why(tmp_path / "missing")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RunError, match=r"no broker.*runs"):
        newest_run(Path("runs"))


def test_why_asks_the_broker_that_was_started_last(tmp_path: Path) -> None:
    for name in ("a", "c", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / NOTE).write_text("{}")
        stamp = time.time_ns() + {"a": 0, "c": 1, "b": 2}[name] * 10**9
        os.utime(tmp_path / name / NOTE, ns=(stamp, stamp))
    assert newest_run(tmp_path) == tmp_path / "b"


def test_a_broker_that_is_stopped_is_told_from_one_that_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("caviar_broker.control.socket.REACH_S", 0.2)
    with socket.socket(socket.AF_UNIX) as mute:
        mute.bind(str(tmp_path / SOCKET))
        mute.listen(1)
        with pytest.raises(RunError, match=r"did not answer within 0\.2 s"):
            ask(tmp_path, do="why")
        assert select.select([mute], [], [], 0)[0]


def test_a_directory_is_held_by_one_broker_at_a_time(tmp_path: Path) -> None:
    with locked(tmp_path), pytest.raises(RunError, match="another broker runs in"), locked(tmp_path):
        pass
    with locked(tmp_path):
        pass
