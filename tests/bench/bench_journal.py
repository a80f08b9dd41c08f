"""What a journal costs: its growth over a long run, how soon it is read, and what each durability takes.

    python tests/bench/bench_journal.py --frames 1000000
    python tests/bench/bench_journal.py --durability --repeats 5

The first writes the entries of so many frames of `smoke`'s services, one of which saves its state, through
the journal of a broker, and then reads it as a broker that resumes does. The second runs `smoke` under each
durability, one after the other.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from caviar_broker.core.events import Journal, Product
from caviar_broker.core.run import Snapshot
from caviar_broker.journal import CheckpointFiles, JournalFile, JournalWriter
from caviar_broker.resume import read_resumption
from caviar_protocol.digest import RunDigest, payload_digest
from caviar_protocol.files import Durability
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario import find_scenario

SERVICES = {"world": "scene", "channel": "channel", "agent": "action", "link": "link", "recorder": ""}
STATEFUL, CHECKPOINT_FRAMES = "world", 20
PAYLOAD = (b"\x80", b"x" * 900)
"""Of the product with lag 1, as the link's of two users."""


def entries_of(frame: int, last: int, frames: int) -> Iterator[Journal]:
    """The journal's entries of one frame, after the one with the number ``last``."""
    if frame == 0:
        facts = {"seed": 1, "seed_episode": 0, "frames": frames}
        yield Journal(last + 1, 0, 0, "", "episode", facts=facts, members=tuple(SERVICES))
        yield Journal(last + 2, 0, -1, STATEFUL, "checkpoint")
        last += 2
    for number, (service, topic) in enumerate(SERVICES.items(), last + 1):
        digest = payload_digest(*PAYLOAD) if topic == "link" else hashlib.sha256(b"%d" % frame).hexdigest()
        fresh = GrantInput(
            topic=topic,
            source=service,
            status=Status.FRESH,
            frame=frame,
            t_ns=frame * 100_000_000,
            digest=digest,
        )
        product = Product(topic, service, frame, frame * 100_000_000, digest, "", PAYLOAD)
        yield Journal(
            number,
            0,
            frame,
            service,
            "done",
            decisions=(fresh,) if topic else (),
            products=(product,) if topic == "link" else (),
        )
    if frame % CHECKPOINT_FRAMES == CHECKPOINT_FRAMES - 1:
        yield Journal(last + len(SERVICES) + 1, 0, frame, STATEFUL, "checkpoint", state=b"state" * 200)


def grow(folder: Path, frames: int, durability: Durability) -> dict[str, float]:
    """Write so many frames and read them back: sizes [B] and times [s]."""
    files = CheckpointFiles(folder, durable=durability != "none")
    path, digest, most, written, last = folder / "journal.msgpack", RunDigest(), 0, 0, 0
    began = time.perf_counter()
    with closing(JournalFile(path, 1, files, durable=durability != "none")) as file:
        journal = JournalWriter(file, durability)
        for frame in range(frames):
            entries = list(entries_of(frame, last, frames))
            last = entries[-1].number
            told = [(d.topic, e.service, d.digest) for e in entries for d in e.decisions]
            digest.add_frame(0, frame, told)
            snapshot = None
            if journal.wants_snapshot:
                snapshot = Snapshot(
                    episode=0,
                    finished=frame + 1,
                    finished_before=0,
                    digest=digest.hexdigest(),
                    seed=1,
                    seed_episode=0,
                    frames=frames,
                    members=tuple(SERVICES),
                )
            before = file.size
            journal.write(entries, (0, frame), snapshot)
            written += max(0, file.size - before)
            most = max(most, file.size)
        journal.close()
    wrote = time.perf_counter() - began
    began = time.perf_counter()
    left = read_resumption(path, CheckpointFiles(folder))
    read = time.perf_counter() - began
    found = left.resumption
    if found is None or found.finished != frames or found.digest.hexdigest() != digest.hexdigest():
        raise SystemExit("what was read is not what was written")
    return {
        "frames": frames,
        "bytes_per_frame": written / frames,
        "most_bytes": most,
        "bytes_at_end": path.stat().st_size,
        "write_s": wrote,
        "resume_s": read,
    }


def run_smoke(folder: Path, durability: str, frames: int) -> float:
    """Frames a second of `smoke` under a durability."""
    scenario, figures = folder / f"{durability}.toml", folder / "figures.json"
    text = find_scenario("smoke").read_text()
    scenario.write_text(text.replace("[run]\n", f'[run]\ndurability = "{durability}"\n', 1))
    command = [sys.executable, "-m", "caviar_clients", "run", str(scenario), "--frames", str(frames)]
    command += ["--out", str(folder / "runs"), "--json", str(figures)]
    subprocess.run(command, check=True, capture_output=True)
    return float(json.loads(figures.read_text())["frames_per_second"])


def say(line: str) -> None:
    """Print a result."""
    sys.stdout.write(f"{line}\n")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--durability", action="store_true", help="the cost of each durability instead")
    parser.add_argument("--repeats", type=int, default=5)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        if not given.durability:
            say(json.dumps(grow(Path(folder), given.frames, "periodic"), indent=1))
            return
        figures: dict[str, list[float]] = {"none": [], "periodic": [], "frame": []}
        for _ in range(given.repeats):
            for durability, rates in figures.items():
                rates.append(run_smoke(Path(folder), durability, min(given.frames, 1000)))
        for durability, rates in figures.items():
            say(f"{durability}: median {statistics.median(rates):.1f} frames/s of {sorted(rates)}")


if __name__ == "__main__":
    main()
