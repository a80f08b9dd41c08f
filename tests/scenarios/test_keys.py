"""Keys from the command line: making them, a run that asks for them, and what is written where."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from forked import Forked
from scenarios_support import PRELOAD, ROOT, SCENARIOS, Finished, caviar, environment, eventually

from caviar_protocol import keys as k

AGENT = ROOT / "clients" / "minimal" / "agent.py"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys of a broker, an agent that is authorized, and a stranger."""
    directory = tmp_path_factory.mktemp("made") / "keys"
    for arguments in (["new", "broker"], ["new", "agent", "--role", "agent"], ["new", "stranger"]):
        assert caviar("keys", *arguments, "--directory", directory).status == 0
    return directory


@pytest.fixture
def keys(made: Path, tmp_path: Path) -> Path:
    """A copy of them for one test."""
    return Path(shutil.copytree(made, tmp_path / "keys"))


def texts_below(*folders: Path) -> bytes:
    """All bytes of all files."""
    return b"\0".join(path.read_bytes() for folder in folders for path in folder.rglob("*") if path.is_file())


def test_a_run_with_keys_lets_the_authorized_agent_in_and_writes_no_secret(
    tmp_path: Path, keys: Path
) -> None:
    """No file and no output holds the secrets of agent, broker, launcher or token."""
    token = caviar("keys", "token", "visitor", "--role", "viewer", "--directory", keys).output.strip()
    out, temporary = tmp_path / "runs", tmp_path / "tmp"
    temporary.mkdir()
    command = [sys.executable, "-m", "caviar_clients", "run", str(SCENARIOS / "remote.toml"), "--frames", "5"]
    command += ["--bind", "tcp://0.0.0.0:0", "--keys", str(keys), "--out", str(out)]
    output: list[str] = []
    with Forked(
        command, PRELOAD, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=ROOT,
        env=environment("keys", TMPDIR=str(temporary)),
    ) as process:  # fmt: skip
        assert process.stdout is not None
        stream = process.stdout
        reader = threading.Thread(target=lambda: output.extend(stream), daemon=True)
        reader.start()
        eventually(lambda: "waiting for 'agent'" in "".join(output), 30.0, "the run waits for its agent")
        port = re.findall(r"tcp://[^ ]*:(\d+)", "".join(output))[0]
        borrowed = k.read_pair(next(temporary.glob("caviar-*/run.key")))
        outcomes = {}
        for name in ("stranger", "agent"):
            shown = {
                k.KEY_VARIABLE: str(keys / f"{name}.key"),
                k.BROKER_KEY_VARIABLE: str(keys / "broker.pub"),
            }
            use = ["service", "agent", "--use", "agent:random", "--broker", f"tcp://127.0.0.1:{port}"]
            outcomes[name] = caviar(*use, **shown) if name == "stranger" else minimal(port, shown)
        process.wait(60.0)
        reader.join(10.0)
    assert outcomes["stranger"].status == 1
    assert "refused the key: it is not authorized" in outcomes["stranger"].output
    assert outcomes["agent"].status == 0, outcomes["agent"].output
    assert process.returncode == 0, "".join(output)
    assert f"CAVIAR_KEY={keys}/agent.key and CAVIAR_BROKER_KEY={keys}/broker.pub" in "".join(output)
    assert "a connection from 127.0.0.1 was refused: the key" in next(out.rglob("events.jsonl")).read_text()
    secrets = [k.read_pair(keys / f"{name}.key").secret for name in ("broker", "agent", "stranger")]
    said = "".join([*output, outcomes["stranger"].output, outcomes["agent"].output]).encode()
    written = texts_below(out, temporary) + said
    assert borrowed.public.encode() not in said
    assert len(written) > 10_000
    for secret in (*secrets, borrowed.secret, token):
        assert secret.encode() not in written
    assert token.encode() not in texts_below(keys)
    assert not list(temporary.iterdir()), "the borrowed key is left behind"


def minimal(port: str, shown: dict[str, str]) -> Finished:
    """The minimal agent, in a process of its own."""
    done = subprocess.run(
        [sys.executable, str(AGENT), f"tcp://127.0.0.1:{port}", "agent"],
        env=os.environ | shown, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    return Finished(done.returncode, done.stdout + done.stderr, Path())


@pytest.mark.parametrize("command", ["run", "broker"])
@pytest.mark.parametrize("address", ["tcp://0.0.0.0:0", "tcp://*:0"])
def test_an_open_address_without_keys_is_refused_before_anything_is_made(
    tmp_path: Path, command: str, address: str
) -> None:
    out = tmp_path / "runs"
    refused = caviar(command, SCENARIOS / "remote.toml", "--bind", address, "--out", out)
    assert refused.status == 1
    assert "can be reached from other machines" in refused.output
    assert "--keys" in refused.output
    assert not out.exists()


def test_keys_are_listed_revoked_and_not_made_twice(keys: Path) -> None:
    where = ("--directory", keys)
    listed = caviar("keys", "authorize", keys / "stranger.pub", "--name", "s", "--role", "link", *where)
    assert listed.status == 0
    shown = caviar("keys", "list", *where).output
    assert re.search(r"^agent +agent +topics: all of its role", shown, re.MULTILINE)
    assert re.search(r"^s +link +", shown, re.MULTILINE)
    for wrong, words in [
        (["new", "agent"], "is not overwritten"),
        (["new", "agent", "--role", "agent"], "is authorized already"),
        (["new", "../x"], "cannot be called"),
        (["new", "x", "--role", "king"], "there is no role 'king'"),
        (["authorize", keys / "agent.key", "--name", "b", "--role", "link"], r"give the .pub file"),
        (
            ["authorize", keys / "agent.pub", "--name", "b", "--role", "link"],
            "authorized already, as 'agent'",
        ),
        (["revoke", "nobody"], "is not authorized in"),
    ]:
        refused = caviar("keys", *wrong, *where)
        assert refused.status == 1
        assert words in refused.output
    assert caviar("keys", "revoke", "agent", *where).status == 0
    assert [entry.name for entry in k.read_authorized(keys)] == ["s"]


def test_of_a_token_only_its_digest_is_kept(keys: Path) -> None:
    token = caviar("keys", "token", "visitor", "--role", "viewer", "--directory", keys).output.strip()
    kept = k.read_tokens(keys)
    assert [(entry.name, entry.role) for entry in kept] == [("visitor", "viewer")]
    assert token not in (keys / k.TOKENS).read_text()
    again = caviar("keys", "token", "visitor", "--role", "viewer", "--directory", keys)
    assert again.status == 1
    assert "revoke it first" in again.output
