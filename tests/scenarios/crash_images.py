"""Runs whose machine loses its power: each goes on from what its disk held then, to the undisturbed digest.

    sudo python tests/scenarios/crash_images.py --images 30 --seed 1

Each run is written to an ext4 file system in a file of its own. At a random moment the file system is stopped
by its shutdown call, which drops what was not synchronised, or the file is copied as it is. All processes
are killed, the image is mounted again, and `caviar run --resume` goes on. A line of JSON an image says
how many frames were finished, and with which the run went on. The exit status is 0 exactly if each came to
its end with the undisturbed digest and none lost more than its ``durability`` allows.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import random
import select
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from scenarios_support import SCENARIOS, Finished, caviar, marked, run, running

from caviar_broker.control.socket import ask
from caviar_broker.journal_format import JournalReader
from caviar_protocol.errors import RecordingError, RunError
from caviar_protocol.files import SYNC_PERIOD_S
from caviar_protocol.recording.integrity import recorded_until

EXT4_IOC_SHUTDOWN, NOLOGFLUSH = 0x8004587D, struct.pack("I", 2)
"""Stop a file system without writing its journal, as a loss of power does."""
IMAGE_BYTES = 512 << 20
FSCK_FAILED = 4
"""Exit status of ``e2fsck`` from which errors are left."""
OUT = "runs"
"""Folder of the runs in a file system."""
START_S = 120.0
"""[s] within which the first frame has to be finished."""


@dataclass
class Outcome:
    """What became of one image."""

    scenario: str
    durability: str
    how: str
    frames: int
    """Finished when the power went."""
    safe: int
    """Of these, those that the durability promises: but for one, all, or all of a period ago."""
    went_on_with: int
    """Frame that the resumed run began with."""
    recorded: int
    """Frames that could be read of the recording before."""
    status: int
    same_digest: bool
    said: str

    @property
    def holds(self) -> bool:
        """Whether the promise is kept."""
        return self.status == 0 and self.same_digest and self.went_on_with >= self.safe


def missing() -> str:
    """Why no file system can be mounted here; empty where one can."""
    if os.geteuid() != 0:
        return "mounting a file system needs root"
    tools = [tool for tool in ("mkfs.ext4", "e2fsck", "mount", "umount") if shutil.which(tool) is None]
    if tools:
        return f"{', '.join(tools)} not installed"
    with tempfile.TemporaryDirectory() as folder:
        try:
            with mounted(made(Path(folder, "image"), 8 << 20), Path(folder, "mnt")):
                return ""
        except subprocess.CalledProcessError as error:
            return f"loop mounts are not allowed: {error.stderr.decode().strip()}"


def made(image: Path, size: int = IMAGE_BYTES) -> Path:
    """A file with an empty ext4 file system."""
    with image.open("wb") as file:
        file.truncate(size)
    subprocess.run(["mkfs.ext4", "-q", "-F", image], check=True, capture_output=True)
    return image


@contextmanager
def mounted(image: Path, place: Path) -> Iterator[Path]:
    """The file system of an image, at a place, until the block is left."""
    place.mkdir(exist_ok=True)
    subprocess.run(["mount", "-o", "loop", image, place], check=True, capture_output=True)
    try:
        yield place
    finally:
        for _ in range(100):
            if subprocess.run(["umount", place], capture_output=True, check=False).returncode == 0:
                break
            select.select([], [], [], 0.1)
        else:
            raise RuntimeError(f"{place} cannot be unmounted")


class Watch:
    """When a run had how many frames finished."""

    def __init__(self, out: Path) -> None:
        self._out = out
        self.seen: list[tuple[float, int]] = [(0.0, 0)]

    def look(self) -> int:
        """Frames that are finished now."""
        for directory in self._out.glob("*/"):
            with suppress(RunError, OSError, ValueError):
                frames = ask(directory, do="status")["status"]["frames_finished"]
                self.seen.append((time.monotonic(), frames))
        return self.seen[-1][1]

    def at(self, instant: float) -> int:
        """Frames that were finished at an instant."""
        return max(frames for seen, frames in self.seen if seen <= instant)


def scenario_of(folder: Path, name: str, durability: str) -> Path:
    """A shipped scenario with another durability."""
    text = (SCENARIOS / f"{name}.toml").read_text().replace("file:", f"file:{SCENARIOS}/")
    path = folder / f"{name}-{durability}.toml"
    path.write_text(text.replace("[run]\n", f'[run]\ndurability = "{durability}"\n', 1))
    return path


def lose_power(mount: Path, image: Path, kept: Path, how: str, mark: str) -> None:
    """Stop the file system, or copy it; then kill every process of the run."""
    if how == "shutdown":
        fd = os.open(mount, os.O_RDONLY)
        fcntl.ioctl(fd, EXT4_IOC_SHUTDOWN, NOLOGFLUSH)
        os.close(fd)
    else:
        _signal_all(mark, signal.SIGSTOP)
        shutil.copyfile(image, kept)
        # Blocks may have been written while they were copied: a system mends that at its next start.
        checked = subprocess.run(["e2fsck", "-f", "-y", kept], capture_output=True, check=False)
        assert checked.returncode < FSCK_FAILED, checked.stdout.decode()
    while _signal_all(mark, signal.SIGKILL):
        select.select([], [], [], 0.05)


def _signal_all(mark: str, number: signal.Signals) -> bool:
    """Send a signal to every process of a run; whether there is one."""
    entries = marked(mark)
    for entry in entries:
        with suppress(ProcessLookupError):
            os.kill(int(entry.split()[0]), number)
    return bool(entries)


def crash(folder: Path, scenario: Path, frames: int, at: float, how: str, digest: str) -> Outcome:
    """One run, its loss of power after a share ``at`` of its frames, and what it came to."""
    image, kept, place = made(folder / "image"), folder / "kept", folder / "mnt"
    with mounted(image, place), running(scenario, place / OUT, "--frames", str(frames)) as (process, mark):
        watch, until = Watch(place / OUT), time.monotonic() + START_S
        while watch.look() < at * frames and process.poll() is None and time.monotonic() < until:
            select.select([], [], [], 0.002)
        now = time.monotonic()
        lose_power(place, image, kept, how, mark)
    if how == "shutdown":
        shutil.copyfile(image, kept)  # another mount namespace may still hold the one that was stopped
    durability = scenario.stem.rpartition("-")[2]
    promised = {"frame": now, "periodic": now - SYNC_PERIOD_S, "none": 0.0}[durability]
    with mounted(kept, place):
        directory = next(place.glob(f"{OUT}/*/"), place / "nothing")
        recorded = _recorded(directory)
        if (directory / "run.json").exists():
            resumed = caviar("run", "--resume", directory, timeout=300)
        else:  # it had not been written yet; the run begins again
            resumed = run(scenario, place / "again", "--frames", str(frames), timeout=300)
            directory = resumed.directory
        return Outcome(
            scenario.stem,
            durability,
            how,
            frames=watch.at(now),
            safe=max(0, watch.at(promised) - 1),
            went_on_with=_went_on_with(directory),
            recorded=recorded,
            status=resumed.status,
            same_digest=_digest(directory) == digest,
            said=_said(resumed, directory),
        )


def _recorded(directory: Path) -> int:
    with suppress(RecordingError):
        last, _ = recorded_until(directory)
        return 0 if last is None else last[1] + 1
    return 0


def _went_on_with(directory: Path) -> int:
    found = [entry.frame for entry in JournalReader(directory / "journal.msgpack") if entry.epoch > 1]
    return found[0] if found else 0


def _digest(directory: Path) -> str:
    try:
        return str(json.loads((directory / "summary.json").read_text())["digest"])
    except (OSError, ValueError):
        return ""


def _said(resumed: Finished, directory: Path) -> str:
    if resumed.status:
        return resumed.output[-600:]
    lines = (directory / "events.jsonl").read_text(errors="replace").splitlines()
    found = []
    for line in lines:
        with suppress(ValueError):
            notice = json.loads(line)
            if notice["kind"] == "damage":
                found.append(notice["text"])
    return " | ".join(found)


def undisturbed(scenario: Path, out: Path, frames: int) -> str:
    """Digest of a scenario that no power is lost in."""
    finished = run(scenario, out, "--frames", str(frames), timeout=300)
    assert finished.status == 0, finished.output
    return _digest(finished.directory)


def main(arguments: list[str] | None = None) -> int:
    """Make the images; the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scenario", action="append", help="by default smoke; may be repeated")
    parser.add_argument("--durability", action="append", help="by default frame and periodic")
    parser.add_argument("--frames", type=int, default=400)
    given = parser.parse_args(arguments)
    if reason := missing():
        sys.exit(f"crash images: {reason}")
    rng = random.Random(given.seed)
    say: Callable[[str], None] = lambda line: print(line, flush=True)  # noqa: E731, T201
    names, outcomes, digests = given.scenario or ["smoke"], list[Outcome](), dict[str, str]()
    for number in range(given.images):
        with tempfile.TemporaryDirectory(prefix="caviar-crash-") as folder:
            name = names[number % len(names)]
            durabilities = given.durability or ["frame", "periodic"]
            scenario = scenario_of(Path(folder), name, durabilities[number // len(names) % len(durabilities)])
            if name not in digests:
                digests[name] = undisturbed(scenario, Path(folder, "peace"), given.frames)
            how = ("shutdown", "copy")[number // len(names) // len(durabilities) % 2]
            share = rng.uniform(0.02, 0.9)
            outcomes.append(crash(Path(folder), scenario, given.frames, share, how, digests[name]))
            say(json.dumps(asdict(outcomes[-1]), ensure_ascii=False))
    kept = sum(outcome.holds for outcome in outcomes)
    say(f"{kept} of {len(outcomes)} images went on to the undisturbed digest within what is promised")
    return 0 if kept == len(outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
