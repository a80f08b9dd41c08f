"""HTTP beside a running broker: what it tells, what it orders, and which peers it lets in."""

from __future__ import annotations

import hashlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from broker_harness import PAIR, PATIENCE_S, eventually, playing
from http_harness import Site, site

from caviar_broker.http.auth import Tokens, http_address
from caviar_protocol import messages as m
from caviar_protocol.errors import SetupError

pytestmark = pytest.mark.slow


def token_file(**tokens: tuple[str, str]) -> str:
    """tokens.toml, from text to name and role."""
    entries = []
    for text, (name, role) in tokens.items():
        digest = hashlib.sha256(text.encode()).hexdigest()
        entries.append(f'[[token]]\nname = "{name}"\nrole = "{role}"\nsha256 = "{digest}"\n')
    return "\n".join(entries)


TOKENS = token_file(
    look=("grafana", "viewer"), act=("ana", "operator"), part=("world", "world"), train=("gym", "trainer")
)


def test_questions_and_orders(tmp_path: Path) -> None:
    with site(tmp_path, frames=4) as http, playing(http.broker.endpoint, *PAIR) as (world, sensors):
        assert http.get("/healthz").json == {"ok": True}
        assert http.get("/readyz").json == {"ready": True}
        assert http.post("/step").status == 409
        assert "not paused" in http.post("/step").json["detail"]
        world.answer()  # frame 0 may be late: services warm up in it
        sensors.answer()
        world.expect(m.Grant)
        eventually(lambda: http.get("/why").json["late"], "the world is late")
        why = http.get("/why").json
        assert why["waits"][0]["service"] == "world"
        assert why["last_blame"]["kind"] == "miss"
        assert http.post("/pause").json == {"state": "running", "paused": True, "frame": 1}
        world.send(m.Done(**world.ids, episode=0, frame=1))
        assert world.quiet(200)
        assert http.post("/step?frames=1").status == 200
        assert world.answer().frame == 2
        sensors.answer()
        assert world.quiet(200)
        status = http.get("/status").json
        assert (status["paused"], status["frames_finished"]) == (True, 3)
        figures = http.get("/latencies").json
        assert figures["world"]["grants_answered"] == 3
        told = [n for n in http.broker.witness.notices if (n.kind, n.service) == ("miss", "world")]
        assert figures["world"]["misses"] == len(told) >= 1  # a busy machine may have missed the second too
        assert http.post("/resume").json["paused"] is False
        world.expect(m.Grant)
        assert http.post("/stop?reason=lunch").json["state"] == "stopping"
        for client in (world, sensors):
            while not isinstance(message := client.receive(), m.Shutdown):
                pass
            assert message.reason == "lunch"
        assert http.broker.outcome().error == "lunch"
        assert http.process.wait(PATIENCE_S) == 0, "it ends with the broker"


def test_an_order_that_makes_no_sense_is_refused(tmp_path: Path) -> None:
    with site(tmp_path) as http:
        for path in ("/step?frames=0", "/step?frames=x", "/step?frames=1e9", "/stop?reason="):
            assert http.post(path).status == 422, path
        assert http.get("/status").json["state"] == "joining"


def test_readiness_is_that_of_the_services(tmp_path: Path) -> None:
    with site(tmp_path) as http:
        answer = http.get("/readyz")
        assert (answer.status, answer.json) == (503, {"ready": False})
        assert http.get("/healthz").status == 200


def test_metrics_are_in_the_text_format_of_prometheus(tmp_path: Path) -> None:
    with site(tmp_path, frames=9) as http, playing(http.broker.endpoint, *PAIR) as (world, sensors):
        for _ in range(3):
            world.answer()
            sensors.answer()
        # The world's next grant does not wait for the third answer of the sensors.
        finished = "caviar_frames_finished_total 3"
        eventually(lambda: finished in http.get("/metrics").text, "three frames are finished")
        page = http.get("/metrics")
        assert page.headers["content-type"].startswith("text/plain; version=0.0.4")
        line = re.compile(r'[a-z_]+(\{[a-z]+="[^"\n]*"(,[a-z]+="[^"\n]*")*\})? -?[0-9.e+-]+')
        samples = [text for text in page.text.splitlines() if not text.startswith("#")]
        assert all(line.fullmatch(text) for text in samples)
        assert 'caviar_latency_seconds_count{service="sensors"} 3' in samples
        assert 'caviar_run_state{state="running"} 1' in samples
        assert finished in samples
        families = re.findall(r"^# TYPE (\S+)", page.text, re.MULTILINE)
        assert len(families) == len(set(families))


def test_the_interface_describes_itself_with_examples(tmp_path: Path) -> None:
    with site(tmp_path) as http:
        described = http.get("/openapi.json").json["paths"]
        assert set(described) >= {"/status", "/why", "/latencies", "/pause", "/step", "/metrics", "/readyz"}
        for path, method, real in (("/status", "get", "/status"), ("/why", "get", "/why")):
            example = described[path][method]["responses"]["200"]["content"]["application/json"]["example"]
            assert set(example) - {"http"} == set(http.get(real).json) - {"http"}
            assert described[path][method]["security"]


# --- who comes in -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "method", "token", "status"),
    [
        ("/status", "GET", "", 401),
        ("/status", "GET", "guess", 401),
        ("/status", "GET", "look", 200),
        ("/status", "GET", "act", 200),
        ("/status", "GET", "part", 403),
        ("/metrics", "GET", "", 401),
        ("/pause", "POST", "", 401),
        ("/pause", "POST", "look", 403),
        ("/pause", "POST", "part", 403),
        ("/pause", "POST", "act", 200),
        ("/pause", "POST", "train", 403),
        ("/status", "GET", "train", 200),
        ("/policies/agent", "POST", "", 401),
        ("/policies/agent", "POST", "look", 403),
        ("/policies/agent", "POST", "part", 403),
        ("/policies/agent", "POST", "train", 409),  # let in: no agent of this run serves policies
        ("/policies/agent", "POST", "act", 409),
        ("/healthz", "GET", "", 200),
    ],
)
def test_a_token_is_good_for_what_its_role_may(
    token_site: Site, path: str, method: str, token: str, status: int
) -> None:
    assert token_site.ask(method, path, token).status == status


@pytest.fixture(scope="module")
def token_site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with site(tmp_path_factory.mktemp("tokens"), tokens=TOKENS) as http:
        yield http


def test_a_token_that_is_revoked_is_good_for_nothing(tmp_path: Path) -> None:
    with site(tmp_path, tokens=TOKENS) as http:
        assert http.get("/status", "look").status == 200
        (tmp_path / "tokens.toml").write_text(token_file(act=("ana", "operator")))
        assert http.get("/status", "look").status == 401
        (tmp_path / "tokens.toml").write_text("[[token]]\nname = 3\n")
        assert http.get("/status", "act").status == 200, "a file that cannot be used changes nothing"
        (tmp_path / "tokens.toml").unlink()
        assert http.get("/status", "act").status == 401
        assert http.get("/status").status == 401, "a file that is gone opens nothing"


@pytest.mark.parametrize(
    "headers",
    [
        {"Host": "evil.example"},
        {"Host": "127.0.0.1.evil.example"},
        {"Host": ""},
        {"Origin": "https://evil.example"},
        {"Origin": "null"},
    ],
)
def test_without_tokens_no_page_of_another_machine_gets_in(open_site: Site, headers: dict[str, str]) -> None:
    assert open_site.post("/stop", **headers).status == 403


@pytest.fixture(scope="module")
def open_site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    with site(tmp_path_factory.mktemp("open")) as http:
        yield http


def test_a_page_of_this_machine_does_get_in(open_site: Site) -> None:
    for headers in ({"Origin": "http://localhost:3000"}, {"Host": "[::1]:80"}):
        assert open_site.get("/why", **headers).status == 200


@pytest.mark.parametrize("address", ["0.0.0.0:80", "[::]:80", "192.0.2.1:80", "example.org:80"])
def test_an_address_that_others_reach_is_refused_without_tokens(tmp_path: Path, address: str) -> None:
    for keys in (None, tmp_path):
        with pytest.raises(SetupError, match=r"no tokens; make one with"):
            http_address(address, keys)
    (tmp_path / "tokens.toml").write_text(TOKENS)
    assert http_address(address, tmp_path)[1] == 80


@pytest.mark.parametrize("address", ["", "80", ":80", "localhost:", "localhost:x", "localhost:65536"])
def test_what_is_no_address_is_refused(address: str) -> None:
    with pytest.raises(SetupError, match="write HOST:PORT"):
        http_address(address, None)


def test_a_token_with_an_unknown_role_is_refused_by_naming_the_known_ones(tmp_path: Path) -> None:
    (tmp_path / "tokens.toml").write_text(token_file(x=("x", "king")))
    with pytest.raises(
        SetupError,
        match=r"tokens.toml.*\d+.*'x'.*'king'",
    ):
        Tokens(tmp_path)


# --- which process it lives with --------------------------------------------------------------------------


def test_it_says_where_no_broker_runs(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "caviar_broker.http", str(tmp_path), "--http", "127.0.0.1:0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 1
    assert f"no broker runs in {tmp_path}" in done.stderr


def test_a_broker_whose_http_process_is_stopped_or_killed_goes_on(tmp_path: Path) -> None:
    with site(tmp_path, frames=200) as http, playing(http.broker.endpoint, *PAIR) as (world, sensors):
        for number in (signal.SIGSTOP, signal.SIGKILL):
            os.kill(http.process.pid, number)
            for _ in range(50):
                world.answer()
                sensors.answer()
        assert http.broker.server.outcome is None
