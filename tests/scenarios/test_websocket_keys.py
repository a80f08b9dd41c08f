"""An agent over a WebSocket at a broker with keys: its token lets it in, and nothing else does."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from http_harness import Peer
from scenarios_support import SCENARIOS, caviar, running, scenario_file
from test_websocket_agent import FRAMES, WITHIN_S, WebRun, over_zeromq, python_agent
from websockets.exceptions import ConnectionClosed

from caviar_protocol import messages as m

__all__ = ["over_zeromq"]


@contextmanager
def locked_run(folder: Path, keys: Path, frames: int = FRAMES) -> Iterator[WebRun]:
    scenario, out = scenario_file(folder, (), base="remote"), folder / "out"
    more = ("--frames", str(frames), "--http", "127.0.0.1:0", "--keys", str(keys))
    with running(scenario, out, *more) as (process, mark):
        yield WebRun(process, mark, out)


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """A keys directory with the broker's pair, and no other's."""
    directory = tmp_path / "keys"
    assert caviar("keys", "new", "broker", "--directory", directory).status == 0
    return directory


def token_of(keys: Path, name: str, *role: str) -> str:
    made = caviar("keys", "token", name, *role, "--directory", keys)
    assert made.status == 0, made.output
    return made.output.strip()


def refused(url: str, token: str = "") -> str:
    """Why a WebSocket is closed at once."""
    with Peer(url, "agent", token=token) as peer:
        told = peer.expect(m.Refuse)
        with pytest.raises(ConnectionClosed) as ended:
            peer.receive()
        assert ended.value.rcvd is not None
        assert ended.value.rcvd.code == 1008
        return told.message


def test_an_agent_with_its_token_plays_the_run_of_the_one_without_keys(
    tmp_path: Path, keys: Path, over_zeromq: str
) -> None:
    token = token_of(keys, "agent", "--role", "agent")
    with locked_run(tmp_path, keys) as run, run.agent(*python_agent(run.url), token) as agent:
        assert run.digest() == over_zeromq
        assert agent.wait(WITHIN_S) == 0


def test_other_tokens_are_refused_and_named_and_a_revoked_one_ends_the_part_that_it_plays(
    tmp_path: Path, keys: Path
) -> None:
    token, viewer = token_of(keys, "agent", "--role", "agent"), token_of(keys, "visitor")
    stranger = token_of(keys, "stranger", "--role", "agent")
    with locked_run(tmp_path, keys) as run:
        assert "there is no token in the request" in refused(run.url)
        assert "not, or no longer, known" in refused(run.url, token[1:])
        assert "the token of 'visitor' is for viewer" in refused(run.url, viewer)
        with Peer(run.url, "agent", token=stranger) as other:
            other.send(other.hello)
            told = other.expect(m.Refuse)
            assert told.code == "unauthorized"
            assert "of agent 'stranger', not of agent 'agent'" in told.message
        with Peer(run.url, "agent", token=token, outputs=("action",)) as agent:
            agent.join()
            assert caviar("keys", "revoke", "agent", "--directory", keys).status == 0
            with pytest.raises(ConnectionClosed, match="its token was revoked"):  # noqa: PT012  # it may come after any message
                while True:
                    agent.socket.recv(timeout=WITHIN_S)
        assert "not, or no longer, known" in refused(run.url, token)
        events = next(run.out.glob("*/events.jsonl")).read_text()
        assert "a WebSocket from 127.0.0.1 was refused: there is no token in the request" in events
        assert "the token is of agent 'stranger', not of agent 'agent'" in events
        # Broker and gateway both look: where the gateway closes the socket first, the agent is away.
        ends = ("not authorized any more: there is no token of a service 'agent'", "'agent' is away")
        assert any(words in events for words in ends)
        assert token not in events


@pytest.mark.parametrize("command", ["run", "broker"])
def test_http_with_keys_and_without_tokens_is_refused_before_the_run(
    tmp_path: Path, keys: Path, command: str
) -> None:
    out = tmp_path / "runs"
    asked = ("--http", "127.0.0.1:0", "--keys", keys, "--out", out)
    refused = caviar(command, SCENARIOS / "remote.toml", *asked)
    assert refused.status == 1
    assert f"{keys} holds no tokens" in refused.output.replace("\n", "")
    assert f"caviar keys token NAME --role operator --directory {keys}" in refused.output.replace("\n", "")
    assert "Traceback" not in refused.output
