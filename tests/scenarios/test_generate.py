"""``caviar dataset generate`` with real processes: kills, numbers of workers, a scheduler that comes back."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sqlite3
import ssl
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
from distributed import Security
from forked import Forked

import caviar
from caviar_clients.datasets import cluster_watch
from caviar_clients.datasets.cluster import Episodes
from caviar_clients.datasets.generate import Outcome
from caviar_clients.datasets.generate import generate as generate_dataset
from caviar_clients.datasets.plan import plan_dataset
from caviar_clients.datasets.verification.verify import verify
from caviar_protocol.errors import RunError
from caviar_protocol.scenario import load_scenario

SMOKE = Path(__file__).parents[2] / "deploy" / "caviar_scenarios" / "smoke.toml"
PRELOAD = (
    "caviar_clients.cli.main",
    "caviar_clients.cli.datasets",
    "caviar_clients.datasets.cluster",
    "caviar_clients.datasets.episode",
    "caviar_clients.datasets.generate",
    "caviar_clients.datasets.local_cluster",
    "caviar_clients.session.embedded",
    "caviar_services.link.beams",
    "distributed",
    "lz4.frame",
    "mcap.writer",
)
COMMAND = (sys.executable, "-m", "caviar_clients", "dataset", "generate")
EPISODES = 16


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Episodes of a quarter of a second, so that a kill finds some begun."""
    folder = tmp_path_factory.mktemp("scenario")
    (folder / "slow_agent.py").write_text(
        "import time\n"
        "from caviar_services.agent.baselines import RandomAgent\n"
        "class SlowAgent(RandomAgent):\n"
        "    def step(self, frame):\n"
        "        time.sleep(0.03)\n"
        "        return super().step(frame)\n"
    )
    file = folder / "slow.toml"
    file.write_text(SMOKE.read_text().replace('use = "los-beam"', 'use = "slow_agent:SlowAgent"', 1))
    return file


def start(command: list[str], **more: Any) -> Forked:
    return Forked(command, PRELOAD, **more)


def ended(command: list[str], seconds: float = 120.0) -> subprocess.CompletedProcess[str]:
    with start(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            output, errors = process.communicate(timeout=seconds)
        finally:
            process.kill()
    return subprocess.CompletedProcess(command, process.returncode, output, errors)


def generate(
    scenario: Path, out: Path | str, *options: str, seconds: float = 120.0
) -> subprocess.CompletedProcess[str]:
    command = [
        *COMMAND,
        str(scenario),
        "--out",
        str(out),
        "--episodes",
        str(EPISODES),
        "--scenes",
        "5",
        *options,
    ]
    return ended(command, seconds)


@pytest.fixture(scope="module")
def reference(scenario: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("reference") / "d"
    done = generate(scenario, out, "--workers", "1")
    assert done.returncode == 0, done.stderr
    assert f"slow: {EPISODES} episodes of 5 scenes" in done.stdout.replace("smoke:", "slow:")
    assert "estimate: " in done.stdout
    return out


def content(out: Path) -> dict[str, object]:
    """Bytes of the recordings, and the tables that depend on the dataset alone."""
    found: dict[str, object] = {
        file.relative_to(out).as_posix(): file.read_bytes()
        for file in sorted(out.glob("episodes/*/recording*"))
    }
    with sqlite3.connect(f"file:{out / 'catalogue.sqlite'}?mode=ro", uri=True) as connection:
        for table in ("episodes", "scenes", "users", "products", "dataset"):
            found[table] = connection.execute(f"SELECT * FROM {table}").fetchall()  # noqa: S608
    return found


def children(process: psutil.Process) -> list[psutil.Process]:
    """The processes that play episodes."""
    found = []
    for child in process.children(recursive=True):
        try:
            if child.name() == "forked" or "spawn_main" in " ".join(child.cmdline()):
                found.append(child)
        except psutil.Error:
            continue
    return found


@pytest.mark.slow
@pytest.mark.exhaustive
def test_two_workers_write_the_bytes_of_one(scenario: Path, reference: Path, tmp_path: Path) -> None:
    done = generate(scenario, tmp_path / "d", "--workers", "2")
    assert done.returncode == 0, done.stderr
    assert len(content(reference)) == 2 * EPISODES + 5
    assert content(tmp_path / "d") == content(reference)


@pytest.mark.slow
def test_killed_workers_and_commands_change_no_byte(scenario: Path, reference: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    kills, rounds = 0, 0
    while len(list(out.glob("episodes/episode-*"))) < EPISODES and rounds < 12:
        rounds += 1
        command = [*COMMAND, str(scenario), "--out", str(out), "--workers", "2"]
        process = start(
            [*command, "--episodes", str(EPISODES), "--scenes", "5"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        before = len(list(out.glob("episodes/episode-*")))
        watched = psutil.Process(process.pid)
        deadline = time.monotonic() + 240.0
        while process.poll() is None and time.monotonic() < deadline:
            there = len(list(out.glob("episodes/episode-*")))
            if there >= before + 2 and kills % 3 != 2:
                for worker in children(watched)[:1]:
                    worker.kill()
                    kills += 1
                before = there
            elif there >= before + 2:
                process.kill()
                kills += 1
                break
            time.sleep(0.05)
        process.wait(120.0)
    assert kills >= 2
    done = generate(scenario, out)
    assert done.returncode == 0, done.stdout + done.stderr
    assert content(out) == content(reference)
    assert not (out / ".work").exists()


@contextmanager
def dask(*arguments: str) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(
        [sys.executable, "-m", "distributed.cli.dask_" + arguments[0], *arguments[1:]],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_processes_of_this_machine_answer_no_other_user() -> None:
    stranger = Security.temporary().get_connection_args("client")["ssl_context"]
    stranger.verify_mode = ssl.CERT_NONE  # it takes any scheduler for its own
    with Episodes(1) as episodes:
        about = episodes._connected.scheduler_info()
        (worker,) = about["workers"].values()
        for address in (about["address"], worker["nanny"], *about["workers"]):
            with socket.create_connection(address_of("tls", address), timeout=120) as tcp:
                tcp.sendall(b"GET / HTTP/1.0\r\n\r\n")
                with pytest.raises(ConnectionResetError):
                    tcp.recv(1)
            with (
                socket.create_connection(address_of("tls", address), timeout=120) as tcp,
                pytest.raises(ssl.SSLError, match="UNKNOWN_CA"),
                stranger.wrap_socket(tcp) as tls,
            ):
                tls.recv(1)
        for host, services in ((about["address"], about["services"]), (worker["nanny"], worker["services"])):
            page = f"http://{address_of('tls', host)[0]}:{services['dashboard']}/info/main/workers.html"
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(page, timeout=120)


def test_a_scheduler_with_tls_needs_a_certificate_of_the_command(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"tls://127\.0\.0\.1:1.*/tls\.yaml"):
        generated(SMOKE, tmp_path, Notes(), "tls://127.0.0.1:1")


def address_of(scheme: str, text: str) -> tuple[str, int]:
    """Host and port of an address of Dask, which has to be of a scheme."""
    found = urlsplit(text)
    assert (found.scheme, found.hostname) == (scheme, "127.0.0.1")
    return found.hostname, found.port


@pytest.mark.exhaustive
@pytest.mark.slow
def test_a_cluster_survives_a_worker_and_its_scheduler(
    scenario: Path, reference: Path, tmp_path: Path
) -> None:
    out, port = tmp_path / "d", str(free_port())
    address = f"tcp://127.0.0.1:{port}"
    start = ("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
    worker = ("worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny", "--host", "127.0.0.1")
    with dask(*worker) as doomed, dask(*worker), dask(*worker):
        with dask(*start):
            command = [*COMMAND, str(scenario), "--out", str(out), "--scheduler", address]
            process = start(
                [*command, "--episodes", str(EPISODES), "--scenes", "5"],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            wait_for(out, 4, process)
            doomed.kill()
            wait_for(out, 10, process)
        with dask(*start), dask(*worker), dask(*worker):
            said, _ = process.communicate(timeout=120.0)
    assert process.returncode == 0, said
    assert content(out) == content(reference)


def wait_for(out: Path, episodes: int, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 90.0
    while len(list(out.glob("episodes/episode-*"))) < episodes:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "too few episodes in 90 s"
        time.sleep(0.05)


def test_what_goes_wrong_is_named_and_leaves_nothing_half_written(scenario: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = generate(scenario, tmp_path / "file" / "d")
    assert done.returncode == 1
    assert "the dataset cannot be written" in done.stderr
    done = generate(scenario, tmp_path / "d", "--scheduler", "tcp://127.0.0.1:9", seconds=90.0)
    assert done.returncode == 1
    assert "no Dask scheduler answers at tcp://127.0.0.1:9" in done.stderr
    assert "Traceback" not in done.stderr
    assert list((tmp_path / "d" / "episodes").iterdir()) == []


def test_another_dataset_is_not_continued(scenario: Path, reference: Path) -> None:
    before = content(reference)
    done = generate(scenario, reference, "--seed", "5")
    assert done.returncode == 1
    assert "holds another dataset: run.seed was 1, is 5" in done.stderr
    assert content(reference) == before
    again = generate(scenario, reference)
    assert again.returncode == 0
    assert f"{EPISODES} episodes were there" in again.stdout


def test_an_episode_that_fails_is_listed_and_the_others_are_there(tmp_path: Path) -> None:
    (tmp_path / "picky.py").write_text(
        "from caviar_services.agent.baselines import RandomAgent\n"
        "class Picky(RandomAgent):\n"
        "    def step(self, frame):\n"
        "        if frame.episode in (5, 7):\n"
        "            raise ValueError('I will not')\n"
        "        return super().step(frame)\n"
    )
    file = tmp_path / "picky.toml"
    file.write_text(SMOKE.read_text().replace('use = "los-beam"', 'use = "picky:Picky"', 1))
    done = generate(file, tmp_path / "d", "--workers", "1")
    assert done.returncode == 1
    assert "episode 5 failed: agent 'agent' failed" in done.stdout
    assert "2 episodes of 16 failed" in done.stderr
    there = {int(path.name[-6:]) for path in (tmp_path / "d" / "episodes").iterdir()}
    assert there == set(range(EPISODES)) - {5, 7}


@pytest.mark.parametrize(
    ("first", "ends", "said"),
    [
        (0, "os._exit(3)", "it exited with status 3 (no signal)"),
        (0, "os.kill(os.getpid(), 11)", "signal SIGSEGV ended it"),
        (4, "os._exit(3)", "it exited with status 3 (no signal)"),
    ],
)
def test_an_agent_that_ends_its_process_is_named_with_the_exit_and_costs_its_episode_alone(
    tmp_path: Path, first: int, ends: str, said: str
) -> None:
    """In scenes that are tried (the first), and in a later one, behind which another episode waits."""
    (tmp_path / "ends.py").write_text(
        "import os\n"
        "from caviar_services.agent.baselines import RandomAgent\n"
        "class Ends(RandomAgent):\n"
        "    def step(self, frame):\n"
        f"        if frame.episode == 0 and frame.number == {first}:\n"
        f"            {ends}\n"
        "        return super().step(frame)\n"
    )
    file, out = tmp_path / "ends.toml", tmp_path / "d"
    file.write_text(SMOKE.read_text().replace('use = "los-beam"', 'use = "ends:Ends"', 1))
    command = [*COMMAND, str(file), "--out", str(out), "--episodes", "3", "--scenes", "5", "--workers", "1"]
    done = ended(command)
    assert done.returncode == 1
    assert said in (done.stdout if first else done.stderr)
    assert not (out / ".work").exists(), "scenes of an episode that failed are not kept"
    assert "Traceback" not in done.stderr
    if first:
        assert "1 episode of 3 failed" in done.stderr
        assert sorted(path.name[-1] for path in (out / "episodes").iterdir()) == ["1", "2"]


@pytest.mark.parametrize(
    "send",
    [
        lambda pid: os.killpg(pid, signal.SIGINT),  # as a terminal does, to the command and its processes
        lambda pid: os.kill(pid, signal.SIGTERM),
    ],
    ids=["ctrl-c", "sigterm"],
)
def test_a_signal_ends_all_processes_and_says_how_to_go_on(
    send: Callable[[int], None], scenario: Path, tmp_path: Path
) -> None:
    """Temporary folders go, too."""
    out = tmp_path / "d"
    command = [
        *COMMAND,
        str(scenario),
        "--out",
        str(out),
        "--episodes",
        "400",
        "--scenes",
        "5",
        "--workers",
        "2",
    ]
    (temporary := tmp_path / "tmp").mkdir()
    process = start(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"TMPDIR": str(temporary)},
    )
    wait_for(out, 3, process)
    workers = children(psutil.Process(process.pid))
    send(process.pid)
    said, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert "starting 2 processes …" in said
    assert "the same command goes on" in said
    assert "Traceback" not in errors
    gone, alive = psutil.wait_procs(workers, timeout=120)
    assert (len(gone) >= 2, alive) == (True, [])
    assert not (out / ".work").exists()
    assert list(temporary.iterdir()) == []


def test_a_dataset_that_is_deleted_ends_the_command(scenario: Path, tmp_path: Path) -> None:
    out, scenes = tmp_path / "d", ("--episodes", "400", "--scenes", "5", "--workers", "2")
    command = [*COMMAND, str(scenario), "--out", str(out), *scenes]
    process = start(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    wait_for(out, 3, process)
    out.rename(tmp_path / "gone")
    _, errors = process.communicate(timeout=120)
    assert (process.returncode, errors.count("\n")) == (1, 1), errors
    assert f"{out} was deleted while it was generated, which ended it" in errors


@pytest.mark.parametrize("small_disk", ["4m"], indirect=True)
def test_a_disk_that_fills_up_ends_the_command_and_loses_nothing(scenario: Path, small_disk: Path) -> None:
    """The estimate finds it large enough, and then something else is written there."""
    out = small_disk / "d"
    command = [
        *COMMAND,
        str(scenario),
        "--out",
        str(out),
        "--episodes",
        "3",
        "--scenes",
        "2",
        "--workers",
        "1",
    ]
    process = start(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    wait_for(out, 1, process)
    filler = small_disk / "filler"
    with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
        while True:
            file.write(bytes(4096))
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 1, said
    assert "free space" in said
    assert "Traceback" not in said
    filler.unlink()
    done = ended(command)
    assert done.returncode == 0, done.stdout + done.stderr
    assert sorted(path.name[-1] for path in (out / "episodes").iterdir()) == ["0", "1", "2"]


@pytest.mark.slow
def test_a_dataset_at_an_address_has_the_bytes_of_a_folder(
    scenario: Path, reference: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``file://`` stands for any store of fsspec: no rename, markers, the catalogue uploaded at the end."""
    store = tmp_path / "store"
    address = f"file://{store}"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "first-machine"))
    process = start(
        [*COMMAND, str(scenario), "--out", address, "--episodes", str(EPISODES), "--scenes", "5"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    wait_for(store, 4, process)
    process.kill()
    process.wait(60.0)
    marked = len(list(store.glob("episodes/*/complete.json")))
    assert 3 <= marked < EPISODES
    # Another machine goes on: what it knows it has from the address.
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "second-machine"))
    done = generate(scenario, address)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "episodes were there" in done.stdout
    assert content(store) == content(reference)

    data = caviar.dataset(address)
    assert len(data) == EPISODES
    users, same = data.users(valid=True), caviar.dataset(reference).users(valid=True)
    np.testing.assert_array_equal(users["channel.h"], same["channel.h"])
    assert list(verify(address)) == []
    (store / "episodes" / "episode-000003" / "complete.json").unlink()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "third-machine"))
    assert [(one.episode, one.what) for one in verify(address)] == [(3, "recording")]
    again = generate(scenario, address)
    assert "1 recording removed, episode 3 the first" in again.stdout
    assert list(verify(address)) == []
    other = generate(scenario, address, "--seed", "5")
    assert other.returncode == 1
    assert "holds another dataset: run.seed was 1, is 5" in other.stderr


def test_addresses_that_cannot_be_used_are_refused(scenario: Path, tmp_path: Path) -> None:
    done = generate(scenario, "nosuch://bucket/d")
    assert done.returncode == 1
    assert "nosuch://bucket/d cannot be opened: Protocol not known: nosuch" in done.stderr.replace("\n", " ")
    (tmp_path / "file").write_text("")
    done = generate(scenario, f"file://{tmp_path}/file/d")
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert "cannot be written" in done.stderr


class Notes:
    """Keeps what a generation tells."""

    def __init__(self) -> None:
        self.texts = list[str]()
        self.is_estimated = False

    def note(self, text: str) -> None:
        self.texts.append(text)

    def traffic(self, now_s: float, end_s: float) -> None: ...

    def tried(self, done: int, of: int, phase: str) -> None: ...

    def estimated(self, *_: object) -> None:
        self.is_estimated = True

    def returned(self) -> None: ...

    def ended(self, _: object) -> None: ...


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seconds in place of minutes."""
    limits = {"LOOK_S": 0.5, "NOTE_S": 2.0, "SILENT_S": 4.0, "NO_WORKER_S": 6.0, "STALLED_S": 8.0}
    for name, seconds in limits.items():
        monkeypatch.setattr(cluster_watch, name, seconds)


@pytest.fixture
def sleeper(tmp_path: Path) -> Path:
    """A scenario whose agent never answers in a late scene of episode 1, which no trial has."""
    (tmp_path / "sleeping_agent.py").write_text(
        "import time\n"
        "from caviar_services.agent.baselines import RandomAgent\n"
        "class Sleeper(RandomAgent):\n"
        "    def step(self, frame):\n"
        "        while frame.episode == 1 and frame.number == 4:\n"
        "            time.sleep(0.1)\n"
        "        return super().step(frame)\n"
    )
    file = tmp_path / "sleeper.toml"
    file.write_text(SMOKE.read_text().replace('use = "los-beam"', 'use = "sleeping_agent:Sleeper"', 1))
    return file


def generated(scenario: Path, out: Path, notes: Notes, scheduler: str = "", scenes: int = 5) -> Outcome:
    plan = plan_dataset(load_scenario(scenario), episodes=3, scenes=scenes)
    return generate_dataset(plan, out, notes, workers=1, scheduler=scheduler)


@pytest.mark.exhaustive
@pytest.mark.usefixtures("impatient")
def test_an_agent_that_never_answers_costs_its_episode_alone(sleeper: Path, tmp_path: Path) -> None:
    notes = Notes()
    outcome = generated(sleeper, tmp_path / "d", notes)
    assert (outcome.episodes, list(outcome.failed)) == (2, [1])
    assert "in one step, 8 s are the limit: waiting for agent 'agent' in frame 4" in outcome.failed[1]
    assert "sleeping_agent.py:6 in step" in outcome.failed[1]
    assert any("no episode has ended for" in text and "waiting for agent" in text for text in notes.texts)


@pytest.mark.exhaustive
@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("when", ["before", "trials", "play"])
def test_a_cluster_whose_workers_are_gone_ends_the_command(
    scenario: Path, tmp_path: Path, when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = str(free_port())
    address = f"tcp://127.0.0.1:{port}"
    start = ("scheduler", "--host", "127.0.0.1", "--port", port, "--no-dashboard")
    arguments = ("worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny", "--host", "127.0.0.1")
    notes = Notes()
    with dask(*start), dask(*arguments) as worker:
        monkeypatch.setattr(notes, "estimated", lambda *_: worker.kill() if when == "play" else None)
        if when == "before":
            worker.kill()
            said = f"no Dask scheduler answers at {address}|the Dask scheduler {address} has no worker"
        elif when == "trials":
            worker_of_trials(worker)
            said = "a process that tried a scene beforehand died|has had no worker"
        else:
            said = f"{address} has had no worker for .* s: start one with dask worker {address} --nthreads 1"
        with pytest.raises(RunError, match=said):
            generated(scenario, tmp_path / "d", notes, address, scenes=100)


def worker_of_trials(worker: subprocess.Popen[bytes]) -> None:
    """Kill a worker two seconds from now, in the scenes that are tried."""
    threading.Timer(2.0, worker.kill).start()


@pytest.mark.exhaustive
@pytest.mark.usefixtures("impatient")
def test_workers_that_are_stopped_are_named(scenario: Path, tmp_path: Path) -> None:
    notes = Notes()
    pids = list[int]()

    def stop(*_: object) -> None:
        pids.extend(child.pid for child in children(psutil.Process()))
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        threading.Timer(12.0, wake).start()

    def wake() -> None:
        for pid in pids:
            os.kill(pid, signal.SIGCONT)

    notes.estimated = stop  # type: ignore[method-assign]
    outcome = generated(scenario, tmp_path / "d", notes)
    assert (outcome.episodes, outcome.failed) == (3, {})
    assert any("1 of 1 workers give no sign of life: tcp://127.0.0.1:" in text for text in notes.texts)
