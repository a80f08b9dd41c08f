"""The fault matrix: who is wronged, how, under which policy, and what a run has to show for it."""

from __future__ import annotations

import itertools
import os
import select
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
from fault_nursery import Case, Result
from scenarios_support import HERE, SCENARIOS

from caviar_protocol.digest import RunDigest
from caviar_protocol.messages import Status
from caviar_protocol.recording import Recording

FRAMES = 40
LENIENT_FRAMES = 80
"""Where frames go on without the victim, which needs time to come back."""
FAULT_FRAME = 10
HANG_S = 60.0
"""[s] after which a case is ended: it hangs."""
FAULTS = ("kill", "stop", "garbage", "flood", "disconnect")
POLICIES = {
    "world": ("wait", "abort"),
    "channel": ("wait", "hold", "drop", "abort"),
    "sensors": ("wait", "hold", "drop", "abort"),
    "link": ("wait", "hold", "drop", "abort"),
    "agent": ("wait", "hold", "drop", "abort"),
    "recorder": ("wait", "abort"),
}
"""What the roles allow (contract, clause 9). The services of the scenario are named after their roles."""
TOPICS = {"channel": "channel", "sensors": "lidar", "link": "link", "agent": "action"}
"""What those produce that a run can do without for a frame."""
WORDS = {
    "kill": "it was killed by SIGKILL",
    "stop": "is stopped (SIGSTOP or SIGTSTP)",
    "garbage": "not in the protocol",
    "flood": "it was cut off: it sends messages faster",
    "disconnect": "",
}
"""What the run says of a service that is wronged so."""
SENSORS = """
[services.sensors]
role = "sensors"
use = "stateful:Adding"
budget_ms = 50
settings = { seconds = 0.008 }
"""


@dataclass
class Nursery:
    """Runs cases, one at a time (`fault_nursery`)."""

    process: subprocess.Popen[bytes]

    @classmethod
    def start(cls) -> Nursery:
        """A new one."""
        path = os.pathsep.join(filter(None, [str(HERE), os.environ.get("PYTHONPATH", "")]))
        command = [sys.executable, str(HERE / "fault_nursery.py")]
        pipe = subprocess.PIPE
        environment = os.environ | {"PYTHONPATH": path}
        return cls(subprocess.Popen(command, stdin=pipe, stdout=pipe, env=environment, bufsize=0))

    def run(self, case: Case) -> Result:
        """Run a case."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(msgspec.json.encode(case) + b"\n")
        line = b""
        while not line.endswith(b"\n"):
            ready, _, _ = select.select([self.process.stdout], [], [], case.limit_s + 10.0)
            assert ready, "the nursery itself hangs"
            part = os.read(self.process.stdout.fileno(), 1 << 16)
            assert part, "the nursery has ended"
            line += part
        return msgspec.json.decode(line, type=Result)

    def close(self) -> None:
        """End it."""
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                stream.close()
        self.process.wait(10)


def scenario(
    folder: Path,
    victim: str = "",
    policy: str = "wait",
    rejoin_s: float = 20.0,
    *,
    budget_ms: float = 0.0,
    frames: int = FRAMES,
    remote: bool = False,
) -> Path:
    """Smoke with a sensor that has state, and the policy of one of its services."""
    text = (SCENARIOS / "smoke.toml").read_text()
    text = text.replace("frames = 100\n", f"frames = {frames}\ncheckpoint_frames = 7\n")
    text = text.replace('"action", "link"]', '"action", "link", "lidar"]') + SENSORS
    if victim:
        head, mark, tail = text.partition(f"[services.{victim}]\n")
        assert mark, victim
        lines = tail.splitlines()
        if budget_ms:
            line = next(number for number, told in enumerate(lines) if told.startswith("budget_ms"))
            lines[line] = f"budget_ms = {budget_ms:g}"
        if remote:
            line = next(number for number, told in enumerate(lines) if told.startswith("use"))
            lines[line] = 'use = "remote"'
        text = head + mark + "\n".join([f'policy = "{policy}"', *lines]) + "\n"
    text += f"\n[timeouts]\nrejoin_s = {rejoin_s:g}\nstall_s = 5.0\n"
    path = folder / f"{victim or 'all'}-{policy}-{rejoin_s:g}-{budget_ms:g}{'-remote' * remote}.toml"
    path.write_text(text)
    return path


def told(result: Result, kind: str, service: str = "") -> list[str]:
    """Texts of the notices of a kind about a service."""
    return [n["text"] for n in result.notices if n["kind"] == kind and n["service"] == service]


def assert_whole(result: Result, directory: Path, frames: int = FRAMES) -> Recording:
    """No hang, no process left; the recording has every frame, and the digest that the broker chained.

    Of a run that ended early the recorder may have a frame more, whose DONE the broker did not wait for.
    """
    assert result.leftovers == []
    assert result.fault_at > 0.0, "nothing went wrong"
    recording = Recording(directory)
    report = recording.run_digest()
    assert report.damage == ()
    assert frames <= result.frames <= len(recording)
    assert digest_of(recording, result.frames) == result.digest
    assert result.error or report.digest == result.digest
    return recording


def digest_of(recording: Recording, frames: int) -> str:
    """Of the first frames of a recording."""
    chain = RunDigest()
    for frame in itertools.islice(recording.frames(), frames):
        fresh = [(i.topic, i.source, i.digest) for i in frame.inputs if i.status is Status.FRESH]
        chain.add_frame(frame.episode, frame.number, fresh)
    return chain.hexdigest()


def assert_same(result: Result, directory: Path, digest: str) -> None:
    """The run came to its end as if nothing had happened."""
    assert (result.error, result.digest) == ("", digest)
    assert_whole(result, directory)
    assert not [n for n in result.notices if n["kind"] == "differs"]


def assert_blamed(result: Result, directory: Path, victim: str, words: Sequence[str]) -> None:
    """The run ended early and names the service that it is due to; what there was until then is recorded."""
    assert result.culprit == victim, result.error
    for word in (repr(victim), *words):
        assert word in result.error
    assert_whole(result, directory, FAULT_FRAME - 3)  # later ones may have been on their way


def assert_went_on(result: Result, directory: Path, victim: str, policy: str) -> None:
    """The run came to its end; frames that were decided without the victim say so, and blame it alone."""
    assert result.error == ""
    recording = assert_whole(result, directory, LENIENT_FRAMES)
    lacking = [
        entry for frame in recording.frames() for entry in frame.inputs if entry.status is not Status.FRESH
    ]
    own = [entry for entry in lacking if entry.source == victim and entry.topic == TOPICS[victim]]
    assert own, f"no frame was decided without {victim}"
    assert {entry.status for entry in own} <= ALLOWED[policy]
    for entry in lacking:
        assert victim in (entry.source, *entry.cause.split()) or repr(victim) in entry.cause, entry


ALLOWED = {"hold": {Status.HELD, Status.LATE, Status.ABSENT}, "drop": {Status.ABSENT, Status.LATE}}
