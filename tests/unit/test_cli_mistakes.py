"""What users mistype: each mistake is answered by its name and its remedy, and nothing else happens."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest

from caviar_broker.http.process import HttpProcess
from caviar_clients.cli import main as command
from caviar_labs.conform import conform
from caviar_labs.conform.client import Rules
from caviar_protocol.errors import SetupError

pytestmark = pytest.mark.slow

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"


def caviar(monkeypatch: pytest.MonkeyPatch, *arguments: str | Path) -> int:
    monkeypatch.setattr(sys, "argv", ["caviar", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        command.main()
    return int(ended.value.code or 0)


@pytest.fixture
def keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A keys directory with a key that is not authorized yet."""
    monkeypatch.chdir(tmp_path)
    assert caviar(monkeypatch, "keys", "new", "agent") == 0
    return Path("keys")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("token", "ana", "--role", "operater"),
            "no token has the role 'operater'; did you mean 'operator'?",
        ),
        (("token", "ana", "--role", "reader"), "no token has the role 'reader'"),
        (
            ("authorize", "agent.pub", "--name", "a", "--role", "agent"),
            "caviar keys authorize keys/agent.pub",
        ),
        (
            ("authorize", "keys/agent.pub", "--name", "a", "--role", "agent", "--topics", "acton"),
            "no topic is named 'acton'; did you mean 'action'?",
        ),
    ],
)
def test_a_mistake_about_keys_is_named_and_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], keys: Path, arguments, words
) -> None:
    before = sorted(keys.iterdir())
    assert caviar(monkeypatch, "keys", *arguments) == 1
    assert words in capsys.readouterr().err
    assert sorted(keys.iterdir()) == before


def test_a_token_without_a_role_is_one_that_may_look_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], keys: Path
) -> None:
    assert caviar(monkeypatch, "keys", "token", "ana") == 0
    HttpProcess(keys, "127.0.0.1:0", keys)  # refuses tokens with roles that HTTP does not know
    assert caviar(monkeypatch, "keys", "list") == 0
    assert "ana  viewer  HTTP token" in capsys.readouterr().out


def test_a_keys_directory_that_is_missing_is_called_so(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert caviar(monkeypatch, "keys", "list", "--directory", tmp_path / "kyes") == 0
    assert "kyes, which does not exist" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("status", "runs/nosuch"), "there is no directory runs/nosuch; give that of a run"),
        (("run", SMOKE, "--bind", "127.0.0.1:5570"), "'127.0.0.1:5570' is no address to listen at"),
        (("run", "--resume", "nosuch"), "give the directory of a run"),
        (("conform", "--role", "agnt"), "no client has the role 'agnt'; did you mean 'agent'?"),
    ],
)
def test_a_mistake_is_answered_at_once(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments, words
) -> None:
    monkeypatch.chdir(tmp_path)
    assert caviar(monkeypatch, *arguments) == 1
    assert words in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_an_http_address_that_is_taken_is_refused_before_the_run(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(
            SetupError, match=f"cannot be served at {address}: Address already in use; choose"
        ):
            HttpProcess(tmp_path, address, None)
        HttpProcess(tmp_path, address, None, again=True)  # the process of the broker before may still end


def test_a_port_that_is_taken_leaves_no_run(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        bind = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        assert caviar(monkeypatch, "run", SMOKE, "--frames", "2", "--out", tmp_path, "--bind", bind) == 1
        assert caviar(monkeypatch, "conform", "--listen", bind) == 1
    out, err = capsys.readouterr()
    assert "no frame was simulated" in out
    assert list(tmp_path.iterdir()) == []
    for option in ("--bind tcp://127.0.0.1:PORT", "--listen"):
        remedy = f"end what uses that port, or choose another with {option} (0: any free"
        assert f"Address already in use; {remedy}" in err


def test_an_embedded_run_is_not_resumed_and_says_why(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert caviar(monkeypatch, "run", SMOKE, "--frames", "2", "--embedded", "--out", tmp_path) == 0
    (run,) = tmp_path.iterdir()
    assert caviar(monkeypatch, "run", "--resume", run) == 1
    assert "an embedded run cannot be resumed" in capsys.readouterr().err


def test_a_finished_run_is_not_resumed_and_stays_as_it_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert caviar(monkeypatch, "run", SMOKE, "--frames", "3", "--out", tmp_path) == 0
    (run,) = tmp_path.iterdir()
    files = ("summary.json", "latency.npz", "journal.msgpack", "run.json", "recording-0000.mcap")
    before = [(run / name).read_bytes() for name in files]
    assert caviar(monkeypatch, "run", "--resume", run) == 1
    assert "all its frames are finished, and so is it" in capsys.readouterr().err
    assert [(run / name).read_bytes() for name in files] == before


def test_what_nobody_sent_is_not_called_canonical() -> None:
    verdicts = conform("tcp://127.0.0.1:0", command="true", names=["canonical"], rules=Rules(timeout_s=1.0))
    assert [verdict.outcome for verdict in verdicts] == ["not applicable"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("generate", "smoke", "--out", "s3:/bucket/x"),
            "'s3:/bucket/x' is no address: write 's3://bucket/x'",
        ),
        (("dataset", "generate", "smoke", "--out", "file:/data/x", "--overwrite"), "write 'file:///data/x'"),
        (("dataset", "generate", "smoke", "--out", ""), "give a folder, or an address as s3://bucket/name"),
        (("dataset", "generate", "S008", "--out", "d"), "there is no preset 'S008'; did you mean 's008'?"),
        (("dataset", "generate", "s08", "--out", "d"), "there is no preset 's08'; did you mean 's008'?"),
        (
            ("tables", "d", "--format", "csv", "--out", "s3://bucket/x"),
            "s3://bucket/x is an address: give a",
        ),
        (
            ("dataset", "verify", "d/episodes/episode-000000"),
            "is the recording of an episode: its dataset is d;",
        ),
        (("dataset", "look", "d/episodes"), "d/episodes is a part of a dataset: give d"),
        (("dataset", "tables", ".", "--format", "csv"), "is no dataset, it holds 1: give one of them, as d"),
        (
            ("inspect", "d"),
            "d is a dataset: give an episode of it, as d/episodes/episode-000000;",
        ),
        (
            ("policy", "swap", "policy.onnx"),
            "name the directory of a run: caviar policy swap policy.onnx --run RUN",
        ),
    ],
)
def test_a_mistake_about_datasets_or_policies_is_named_and_changes_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path, arguments, words
) -> None:
    monkeypatch.chdir(tmp_path)
    episode = Path("d/episodes/episode-000000")
    episode.mkdir(parents=True)
    (episode / "recording-0000.mcap").write_bytes(b"")
    Path("d/catalogue.sqlite").write_bytes(b"")
    before = sorted(tmp_path.rglob("*"))
    assert caviar(monkeypatch, *arguments) == 1
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error
    assert sorted(tmp_path.rglob("*")) == before
