"""One run whose processes are killed again and again, several at once; its digest is that of one in peace.

    python tests/scenarios/random_kills.py --kills 200 --seed 1

SIGKILL meets 1 to 7 processes at the same time: any services, the recorder and the broker, most of the time
while one of them has a grant to answer, sometimes while the run has not gone on after the kill before. The
launcher is suspended (SIGSTOP) during some kills, and continues (SIGCONT) when all of it is over. Each kill
is a line of JSON; a table is at the end. The exit status is 0 exactly if the run came to its end with the
digest of the undisturbed run, `caviar inspect --digest` says the same, and at least half of the kills met an
outstanding grant.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import select
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scenarios_support import SCENARIOS, caviar, marked, started

from caviar_broker.control.socket import ask
from caviar_protocol.errors import RunError
from caviar_protocol.scenario import load_scenario

FRAMES_A_KILL = 24
"""Frames of the run for each kill."""
GRANTED_SHARE = 0.8
"""Of the kills that wait until the victim has a grant."""
OVERLAP_SHARE = 0.15
"""Of the kills that are followed by another one before the run has gone on."""
SUSPENDED_SHARE = 0.15
"""Of the kills during which the launcher is suspended."""
SUSPENDED_S = 1.5
"""[s] of that at most: longer than the broker waits for what the launcher knows of a death."""
GO_ON_S = 60.0
"""[s] within which a run has to go on."""
ADDER = """
[services.sensors]
role = "sensors"
use = "stateful:Adding"
budget_ms = 50
settings = { seconds = 0.006 }
"""
REJOIN = """
[timeouts]
rejoin_s = 30.0
"""


@dataclass
class Kill:
    """Processes that were killed at the same time."""

    number: int
    victims: list[str]
    frame: int
    """Frames that were finished."""
    grants: int
    """Outstanding: of the victims, or of all services where the broker is among the victims."""
    suspended_s: float
    """For how long the launcher was suspended meanwhile; 0: it was not."""
    overlap: bool
    """Whether the run had not gone on after the kill before."""
    at: float
    go_on_s: float | None = None


@dataclass
class Disturber:
    """Kills what belongs to one run, and watches it go on."""

    process: subprocess.Popen[str]
    mark: str
    directory: Path
    rng: random.Random
    kills: list[Kill] = field(default_factory=list)

    def status(self) -> Mapping[str, Any]:
        """What the broker answers over its control socket; empty where none does."""
        try:
            answer = ask(self.directory, do="status")
        except (RunError, OSError, ValueError):
            return {}
        return answer.get("status", {}) if answer.get("ok") else {}

    def until(self, condition: Callable[[Mapping[str, Any]], bool], seconds: float) -> Mapping[str, Any]:
        """The first status for which a condition holds, or the last one; empty once the run is over."""
        end, status = time.monotonic() + seconds, self.status()
        while not (status and condition(status)) and time.monotonic() < end and self.alive:
            wait(0.001 if status else 0.02)
            status = self.status()
        return status

    @property
    def alive(self) -> bool:
        """Whether the launcher is."""
        return self.process.poll() is None

    def processes(self) -> dict[str, int]:
        """Process ids by name of the service, or ``broker``."""
        found = {}
        for entry in marked(self.mark):
            pid, *words = entry.split()
            if "caviar_broker" in words:
                found["broker"] = int(pid)
            elif "caviar_services" in words:
                found[words[words.index("caviar_services") + 1]] = int(pid)
        return found

    def kill_some(self, number: int, frame: int, names: list[str], *, overlap: bool) -> Kill | None:
        """Kill one to all of these, at the frame or after it; None where no victim lives."""
        self.until(lambda status: finished(status) >= frame, GO_ON_S)
        victims = self.rng.sample(names, self.rng.randint(1, len(names)))
        suspended_s = self.rng.uniform(0.0, SUSPENDED_S) if self.rng.random() < SUSPENDED_SHARE else 0.0
        if self.rng.random() < GRANTED_SHARE:
            status = self.until(lambda status: owed_by(victims, status) > 0, 0.3)
        else:
            wait(self.rng.uniform(0.0, 0.02))
            status = self.status()
        pids, before, at = self.processes(), len(self.told()), time.monotonic()
        victims = [victim for victim in victims if victim in pids]
        if suspended_s and self.alive:
            self.process.send_signal(signal.SIGSTOP)
        struck = [victim for victim in victims if kill(pids[victim])]
        if suspended_s and self.alive:
            wait(suspended_s)
            self.process.send_signal(signal.SIGCONT)
        if not struck:
            return None
        grants = owed_by(struck, status) if "broker" in struck else self.owed_at_death(struck, before)
        done = Kill(number, struck, finished(status), grants, suspended_s, overlap, at)
        self.kills.append(done)
        return done

    def told(self) -> list[Mapping[str, Any]]:
        """The run's notices."""
        try:
            lines = (self.directory / "events.jsonl").read_text().splitlines()
        except OSError:
            return []
        found = []
        for line in lines:
            try:
                found.append(json.loads(line))
            except ValueError:  # a broker was killed while it wrote
                continue
        return found

    def owed_at_death(self, victims: list[str], before: int) -> int:
        """How many of the victims owed an answer, by what the broker says of their deaths."""
        until, lost = time.monotonic() + 0.4, dict[str, int]()
        while len(lost) < len(victims) and time.monotonic() < until and self.alive:
            for notice in self.told()[before:]:
                if notice["kind"] == "lost" and notice["service"] in victims:
                    lost[notice["service"]] = notice["frame"]
            wait(0.005)
        return sum(frame >= 0 for frame in lost.values())

    def wait_until_it_goes_on(self, kill: Kill) -> None:
        """Until frames are finished again, and everybody is there."""

        def goes_on(status: Mapping[str, Any]) -> bool:
            there = all(service["state"] == "active" for service in status["services"])
            return there and finished(status) > kill.frame + 1

        self.until(goes_on, GO_ON_S)
        kill.go_on_s = time.monotonic() - kill.at


def wait(seconds: float) -> None:
    """Leave the processor to others."""
    select.select([], [], [], seconds)


def kill(pid: int) -> bool:
    """Whether a process was there to be killed."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return False
    return True


def finished(status: Mapping[str, Any]) -> int:
    """The frame that the run has come to, by all its brokers."""
    return int(status["frame"]) if status else -1


def grants_of(status: Mapping[str, Any]) -> dict[str, int]:
    """Outstanding grants by service."""
    return {service["name"]: len(service["grants"]) for service in status.get("services", ())}


def owed_by(victims: list[str], status: Mapping[str, Any]) -> int:
    """Grants that no service will answer once these are gone: without a broker, all of them."""
    grants = grants_of(status)
    return sum(number for name, number in grants.items() if name in victims or "broker" in victims)


def scenario_for(folder: Path, given: Path | None, frames: int) -> Path:
    """A scenario whose services are waited for when they die: the given one, or smoke with a sensor
    that has state."""
    path = folder / "scenario.toml"
    if given is not None:
        text = given.read_text().replace('"file:', f'"file:{given.resolve().parent}/')
        text = text if "[timeouts]" in text else text + REJOIN
    else:
        text = (
            (SCENARIOS / "smoke.toml")
            .read_text()
            .replace("frames = 100\n", "frames = 100\ncheckpoint_frames = 20\n")
        )
        text = text.replace('"action", "link"]', '"action", "link", "lidar"]') + ADDER + REJOIN
    path.write_text(text)
    scenario = load_scenario(path)
    assert (scenario.timeouts.rejoin_s or 0.0) > 0.0, "give the scenario timeouts.rejoin_s"
    assert scenario.run.episodes == 1
    assert frames > 0
    return path


def disturb(
    scenario: Path, out: Path, frames: int, kills: int, seed: int, say: Callable[[str], None]
) -> tuple[int, str, Disturber]:
    """Run a scenario while its processes are killed: exit status, output, and who was killed."""
    names = [*load_scenario(scenario).services, "broker"]
    rng = random.Random(seed)
    # Those that come late because a victim was waited for are made up for in the last third.
    at_frames = sorted(rng.sample(range(5, frames * 2 // 3), kills))
    log, mark = out.parent / "disturbed.log", uuid.uuid4().hex
    with log.open("w") as file:
        words = ("caviar_clients", "run", scenario, "--out", out, "--frames", str(frames))
        process = started(*words, mark=mark, stdout=file)
    try:
        while not (found := list(out.glob("*/"))) and process.poll() is None:
            wait(0.05)
        disturber = Disturber(process, mark, found[0], rng)
        overlap = False
        for number, frame in enumerate(at_frames, 1):
            done = None
            while done is None and disturber.alive:
                done = disturber.kill_some(number, frame, names, overlap=overlap)
            if done is None:
                break
            overlap = rng.random() < OVERLAP_SHARE
            if not overlap:
                disturber.wait_until_it_goes_on(done)
            say(json.dumps({k: round(v, 3) if isinstance(v, float) else v for k, v in vars(done).items()}))
        process.wait(300)
    finally:
        process.kill()
        process.wait()
    return process.returncode, log.read_text(), disturber


def digest_of(directory: Path) -> str:
    """What a run's summary says."""
    path = directory / "summary.json"
    return str(json.loads(path.read_text())["digest"]) if path.exists() else ""


def table(kills: list[Kill]) -> Iterator[str]:
    """Kills by the number of processes, and by victim."""
    yield f"{'':<12} {'kills':>6} {'broker':>7} {'granted':>8} {'suspended':>10}   s to go on: median, most"
    for count in sorted({len(kill.victims) for kill in kills}):
        yield row(f"{count} at once", [kill for kill in kills if len(kill.victims) == count])
    for victim in sorted({victim for kill in kills for victim in kill.victims}):
        yield row(victim, [kill for kill in kills if victim in kill.victims])
    yield row("all", kills)


def row(name: str, kills: list[Kill]) -> str:
    """Some kills in figures."""
    broker = sum("broker" in kill.victims for kill in kills)
    granted, suspended = sum(kill.grants > 0 for kill in kills), sum(kill.suspended_s > 0 for kill in kills)
    times = [kill.go_on_s for kill in kills if kill.go_on_s is not None]
    told = f"{statistics.median(times):.2f}, {max(times):.2f}" if times else "-"
    return f"{name:<12} {len(kills):>6} {broker:>7} {granted:>8} {suspended:>10}   {told}"


def main(arguments: list[str] | None = None) -> int:
    """Run it; the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--scenario", type=Path, help="with timeouts.rejoin_s; by default smoke and a sensor")
    parser.add_argument("--frames", type=int, help=f"by default {FRAMES_A_KILL} for each kill")
    parser.add_argument("--out", type=Path, help="folder for both runs; by default a temporary one")
    given = parser.parse_args(arguments)
    frames = given.frames or 100 + FRAMES_A_KILL * given.kills
    root = given.out or Path(tempfile.mkdtemp(prefix="caviar-kills-"))
    for name in ("peace", "disturbed"):
        (root / name).mkdir(parents=True, exist_ok=True)
    say: Callable[[str], None] = lambda line: print(line, flush=True)  # noqa: E731, T201
    scenario = scenario_for(root, given.scenario, frames)
    started = time.monotonic()
    peace = caviar("run", scenario, "--out", root / "peace", "--frames", str(frames), timeout=1200)
    assert peace.status == 0, peace.output
    wanted = digest_of(next((root / "peace").glob("*/")))
    say(f"undisturbed: {frames} frames in {time.monotonic() - started:.1f} s, digest {wanted}")
    started = time.monotonic()
    status, output, disturber = disturb(scenario, root / "disturbed", frames, given.kills, given.seed, say)
    inspected = caviar("inspect", "--digest", disturber.directory)
    told, kills = digest_of(disturber.directory), disturber.kills
    granted = sum(kill.grants > 0 for kill in kills)
    differs = [notice["text"] for notice in disturber.told() if notice["kind"] == "differs"]
    say(f"disturbed: {time.monotonic() - started:.1f} s, seed {given.seed}, {disturber.directory}")
    for line in table(kills):
        say(line)
    recomputed = inspected.output.split()[0] if inspected.output.split() else ""
    checks = {
        f"{given.kills} kills": len(kills) == given.kills,
        f"at least {given.kills // 2} of them with a grant outstanding": granted >= given.kills // 2,
        "the run came to its end": status == 0,
        "its digest is that of the undisturbed run": told == wanted,
        "`caviar inspect --digest` says the same": (inspected.status, recomputed) == (0, wanted),
        "no answer differed when it was given again": not differs,
    }
    for what, holds in checks.items():
        say(f"{'yes' if holds else 'NO '} {what}")
    if status:
        say(output[-3000:])
    return 0 if all(checks.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
