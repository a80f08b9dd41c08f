"""Runs of the real command in real processes, and what is left of them."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from forked import MARK, Forked

ROOT = Path(__file__).parents[2]
SCENARIOS = ROOT / "deploy" / "caviar_scenarios"
HERE = Path(__file__).parent
PATIENCE = 4
PRELOAD = (
    "caviar_clients.cli.main",
    "caviar_clients.cli.run",
    "caviar_clients.cli.launch",
    "caviar_clients.cli.recordings",
    "caviar_clients.session.embedded",
    "caviar_broker.launch",
    "caviar_services.runner",
    "caviar_services.agent.baselines",
    "caviar_services.channel.statistical.free_space",
    "caviar_broker.policies",
    "caviar_services.link.beam_scores",
    "caviar_services.link.beams",
    "caviar_services.recorder.mcap",
    "caviar_services.world.trajectory",
    "lz4.frame",
    "mcap.writer",
    "numpy.ma",
    "pydantic.main",
    "pydantic.type_adapter",
)
"""What the command, the broker and the services import in most runs."""


@dataclass
class Finished:
    """A command that has ended."""

    status: int
    output: str
    directory: Path
    leftovers: list[str] = field(default_factory=list)


def environment(mark: str, **extra: str) -> dict[str, str]:
    """This process's environment, marked so that every descendant can be found."""
    path = os.pathsep.join(filter(None, [str(HERE), os.environ.get("PYTHONPATH", "")]))
    return os.environ | {MARK: mark, "PYTHONPATH": path, "COLUMNS": "200"} | extra


def caviar(*arguments: str | Path, timeout: float = 120.0, **extra: str) -> Finished:
    """Run ``caviar`` with these arguments, and find out what it left behind."""
    mark = uuid.uuid4().hex
    with started("caviar_clients", *arguments, mark=mark, stderr=subprocess.PIPE, **extra) as process:
        try:
            said, errors = process.communicate(timeout=timeout)
        finally:
            process.kill()
    return Finished(process.returncode, said + errors, Path(), marked(mark))


def started(
    *words: str | Path,
    mark: str,
    stdout: int | IO[str] = subprocess.PIPE,
    stderr: int = subprocess.STDOUT,
    **extra: str,
) -> subprocess.Popen[str]:
    """Start ``python -m`` with these words in the checkout: a fork (`Forked`)."""
    command = [sys.executable, "-m", *map(str, words)]
    return Forked(
        command, PRELOAD, env=environment(mark, **extra), cwd=ROOT,
        stdout=stdout, stderr=stderr, text=True,
    )  # fmt: skip


def run_as_printed(command: Sequence[str | Path], folder: Path) -> str:
    """Run a command of a page in a folder, with the environment activated; return what it printed."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        command, cwd=folder, env=os.environ | {"PATH": path, "COLUMNS": "200"},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=240,
    )  # fmt: skip
    assert done.returncode == 0, f"{command}\n{done.stdout}"
    return done.stdout


def blocks(page: Path) -> list[tuple[str, str]]:
    """Language and content of the fenced blocks of a page."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)


def follow(page: Path, folder: Path) -> None:
    """Follow the blocks of a page from top to bottom in a folder.

    A block whose first line is a comment with a file name is written to that file; other blocks of ``sh`` and
    ``python`` are run. What a block of ``text`` shows has to be in the output of the command before it, with
    anything for ``…``.
    """
    output = ""
    for language, content in blocks(page):
        name = re.match(r"# ([\w.-]+\.\w+)\n", content)
        if name:
            (folder / name[1]).write_text(content, "utf-8")
        elif language == "sh":
            output = run_as_printed(["bash", "-e", "-o", "pipefail", "-c", content], folder)
        elif language == "python":
            output = run_as_printed([sys.executable, "-c", content], folder)
        elif language == "text":
            for line in content.splitlines():
                assert _shown(line).search(output), f"{page} shows {line!r}; the command printed\n{output}"


def _shown(line: str) -> re.Pattern[str]:
    """A line of output, whatever its spaces, with anything for ``…``."""
    words = [re.escape(word).replace("…", ".*") for word in line.split()]
    return re.compile(r"\s+".join(words))


def run(scenario: Path, out: Path, *arguments: str | Path, timeout: float = 120.0, **extra: str) -> Finished:
    """``caviar run`` into an empty folder; the run's own directory is found there."""
    finished = caviar("run", scenario, "--out", out, *arguments, timeout=timeout, **extra)
    finished.directory = next(iter(sorted(out.glob("*/"))), Path())
    return finished


@contextmanager
def running(
    scenario: Path, out: Path, *arguments: str, **extra: str
) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """``caviar run`` as a process that can be disturbed, and the mark of its descendants."""
    mark = uuid.uuid4().hex
    process = started("caviar_clients", "run", scenario, "--out", out, *arguments, mark=mark, **extra)
    try:
        yield process, mark
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()
        for entry in marked(mark):
            os.kill(int(entry.split()[0]), signal.SIGKILL)


def marked(mark: str) -> list[str]:
    """Processes alive that carry the mark, each "PID command line"."""
    found = []
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit() or int(folder.name) == os.getpid():
            continue
        try:
            if (folder / "comm").read_text() == "forked\n":
                links = (str(link.readlink()) for link in (folder / "fd").iterdir())
                stated = (link.partition(f"memfd:{MARK}={mark} ")[2] for link in links)
                command = next(filter(None, stated), "")
            elif f"{MARK}={mark}".encode() in (folder / "environ").read_bytes():
                command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            else:
                continue
        except OSError:
            continue
        if command:
            found.append(f"{folder.name} {command}")
    return found


def pid_of(mark: str, word: str) -> int:
    """Process id of the marked process whose command line contains a word."""
    return next(int(entry.split()[0]) for entry in marked(mark) if word in entry)


def eventually(condition: Callable[[], object], within_s: float, what: str) -> None:
    """Wait until a condition holds; AssertionError naming it where it does not in time.

    A machine on which all cores are busy gets `PATIENCE` times as long.
    """
    until = time.monotonic() + PATIENCE * within_s
    while not condition():
        if time.monotonic() > until:
            raise AssertionError(f"not within {PATIENCE * within_s} s: {what}")
        select.select([], [], [], 0.05)  # leave the processor to what is waited for


RADIO = {"channel": "channel", "link": "link", "agent": "action"}
"""Services of ``smoke`` that runs about other things do without, and the topics of their products."""


def scenario_file(
    folder: Path,
    changes: Sequence[tuple[str, str]] = (),
    extra: str = "",
    base: str = "smoke",
    *,
    radio: bool = True,
) -> Path:
    """A shipped scenario with some text replaced, some appended, and `RADIO` left out on demand.

    Each service is a process that starts, in half a second of CPU.
    """
    text = (SCENARIOS / f"{base}.toml").read_text()
    for old, new in changes:
        assert old in text, f"{old!r} is not in {base}.toml"
        text = text.replace(old, new, 1)
    for service, topic in () if radio else RADIO.items():
        text, count = re.subn(rf"^\[services\.{service}\]\n(.+\n)*\n", "", text, flags=re.MULTILINE)
        assert count == 1, service
        text = re.sub(rf'^(record = .*), "{topic}"', r"\1", text, flags=re.MULTILINE)
    path = folder / "scenario.toml"
    path.write_text(text + "\n" + extra)
    return path


def frames_recorded(directory: Path) -> int:
    """Frames that can be read from a run's recording."""
    from caviar_protocol.recording import Recording

    return len(Recording(directory))


def recorded_below(out: Path) -> int:
    """Frames that can be read so far from the only run below a folder; 0 before there is one."""
    from caviar_protocol.errors import RecordingError

    try:
        return sum(frames_recorded(directory) for directory in out.glob("*/"))
    except RecordingError:
        return 0
