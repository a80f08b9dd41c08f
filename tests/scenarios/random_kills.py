"""One run whose processes are killed again and again, at random; its digest is that of one in peace.

    python tests/scenarios/random_kills.py --kills 200 --seed 1

SIGKILL meets any service, the recorder and the broker, most of the time while it has a grant to answer,
sometimes while another one is away already. Each kill is a line of JSON, with the victim's state; a table
is at the end. The exit status is 0 exactly if the run came to its end with the digest of the undisturbed
run, `caviar inspect --digest` says the same, and at least half of the kills met an outstanding grant.
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
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from scenarios_support import SCENARIOS, caviar, environment

from caviar_broker.deskplace import ask
from caviar_protocol.errors import RunError
from caviar_protocol.scenario_loader import load_scenario

FRAMES_A_KILL = 24
"""Frames of the run for each kill."""
GRANTED_SHARE = 0.8
"""Of the kills that wait until the victim has a grant."""
OVERLAP_SHARE = 0.15
"""Of the kills that are followed by another one before the run has gone on."""
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
    """One kill."""

    number: int
    victim: str
    pid: int
    frame: int
    """Frames that were finished."""
    state: str
    """``granted``: it owed an answer; ``idle``: it did not; ``away``: it had not come back yet;
    ``broker``: how many grants were outstanding is in `grants`."""
    grants: int
    overlap: bool
    """Whether the run had not gone on after the kill before."""
    at: float
    go_on_s: float | None = None


@dataclass
class Disturber:
    """Kills what belongs to one run, and watches it go on."""

    process: subprocess.Popen[str]
    directory: Path
    rng: random.Random
    kills: list[Kill] = field(default_factory=list)

    def status(self) -> Mapping[str, Any]:
        """What the broker's desk says; empty where no broker answers."""
        try:
            answer = ask(self.directory, do="status")
        except (RunError, OSError, ValueError):
            return {}
        return answer.get("status", {}) if answer.get("ok") else {}

    def until(self, condition: Callable[[Mapping[str, Any]], bool], seconds: float) -> Mapping[str, Any]:
        """The first status for which a condition holds, or the last one; empty once the run is over."""
        end, status = time.monotonic() + seconds, self.status()
        while not (status and condition(status)) and time.monotonic() < end and self.alive:
            select.select([], [], [], 0.001 if status else 0.02)
            status = self.status()
        return status

    @property
    def alive(self) -> bool:
        """Whether the launcher is."""
        return self.process.poll() is None

    def processes(self) -> dict[str, int]:
        """Process ids by name of the service, or ``broker``."""
        found = {}
        for pid in map(
            int, Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        ):
            try:
                words = Path(f"/proc/{pid}/cmdline").read_bytes().decode().split("\0")
            except OSError:
                continue
            if "caviar_broker" in words:
                found["broker"] = pid
            elif "caviar_services" in words:
                found[words[words.index("caviar_services") + 1]] = pid
        return found

    def kill_one(self, number: int, frame: int, victims: list[str], *, overlap: bool) -> Kill | None:
        """Kill somebody, at the frame or behind it; None where the run is over."""
        self.until(lambda status: finished(status) >= frame, GO_ON_S)
        victim = self.rng.choice(victims)
        if self.rng.random() < GRANTED_SHARE:
            status = self.until(lambda status: bool(grants_of(status).get(victim, victim == "broker")), 0.3)
        else:
            select.select([], [], [], self.rng.uniform(0.0, 0.02))
            status = self.status()
        pid = self.processes().get(victim)
        if pid is None or not self.alive:
            return None
        before = len(self.told())
        at = time.monotonic()
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            return None
        granted = grants_of(status)
        if victim == "broker":
            state, outstanding = "broker", sum(granted.values())
        else:
            state, outstanding = self.state_at_death(victim, before)
        kill = Kill(number, victim, pid, finished(status), state, outstanding, overlap, at)
        self.kills.append(kill)
        return kill

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

    def state_at_death(self, victim: str, before: int) -> tuple[str, int]:
        """What the broker says of the death: the frame that the victim owed."""
        until = time.monotonic() + 0.4
        while time.monotonic() < until and self.alive:
            for notice in self.told()[before:]:
                if notice["kind"] == "lost" and notice["service"] == victim:
                    return ("granted", 1) if notice["frame"] >= 0 else ("idle", 0)
            select.select([], [], [], 0.005)
        return "away", 0

    def wait_until_it_goes_on(self, kill: Kill) -> None:
        """Until frames are finished again, and everybody is there."""

        def goes_on(status: Mapping[str, Any]) -> bool:
            there = all(service["state"] == "active" for service in status["services"])
            return there and finished(status) > kill.frame + 1

        self.until(goes_on, GO_ON_S)
        kill.go_on_s = time.monotonic() - kill.at


def finished(status: Mapping[str, Any]) -> int:
    """The frame that the run has come to, by all its brokers."""
    return int(status["frame"]) if status else -1


def grants_of(status: Mapping[str, Any]) -> dict[str, int]:
    """Outstanding grants by service."""
    return {service["name"]: len(service["grants"]) for service in status.get("services", ())}


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
    victims = [*load_scenario(scenario).services, "broker"]
    rng = random.Random(seed)
    # Those that come late because somebody was waited for are made up for in the last third.
    at_frames = sorted(rng.sample(range(5, frames * 2 // 3), kills))
    command = [
        sys.executable,
        "-m",
        "caviar_clients",
        "run",
        str(scenario),
        "--out",
        str(out),
        "--frames",
        str(frames),
    ]
    log = out.parent / "disturbed.log"
    with log.open("w") as file:
        env = environment("random-kills")
        process = subprocess.Popen(command, env=env, stdout=file, stderr=file, text=True)
    try:
        while not (found := list(out.glob("*/"))) and process.poll() is None:
            select.select([], [], [], 0.05)
        disturber = Disturber(process, found[0], rng)
        overlap = False
        for number, frame in enumerate(at_frames, 1):
            kill = None
            while kill is None and disturber.alive:
                kill = disturber.kill_one(number, frame, victims, overlap=overlap)
            if kill is None:
                break
            overlap = rng.random() < OVERLAP_SHARE
            if not overlap:
                disturber.wait_until_it_goes_on(kill)
            say(json.dumps({k: round(v, 3) if isinstance(v, float) else v for k, v in vars(kill).items()}))
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
    """Kills by victim and state."""
    yield f"{'victim':<10} {'kills':>6} {'granted':>8} {'idle':>6} {'away':>6}   s to go on: median, most"
    by_victim = defaultdict(list)
    for kill in kills:
        by_victim[kill.victim].append(kill)
    for victim in [*sorted(by_victim), "all"]:
        own = kills if victim == "all" else by_victim[victim]
        granted = sum(kill.grants > 0 for kill in own)
        away = sum(kill.state == "away" for kill in own)
        times = [kill.go_on_s for kill in own if kill.go_on_s is not None]
        told = f"{statistics.median(times):.2f}, {max(times):.2f}" if times else "-"
        yield f"{victim:<10} {len(own):>6} {granted:>8} {len(own) - granted - away:>6} {away:>6}   {told}"


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
