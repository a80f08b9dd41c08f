"""What a service does with each message, without sockets."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any, ClassVar

import pytest

from caviar_clients.session.embedded import OutsideSession
from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.errors import RunError
from caviar_protocol.messages import Grant, Reset
from caviar_protocol.topics import Carrier
from caviar_protocol.validation import ProductCheck
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.conversion import granted_frame
from caviar_services.service import Frame, NoSettings, RunInfo, Service, StepResult
from caviar_services.session import ServiceSession

SERVICE = FreeSpaceChannel(
    FreeSpaceSettings(), RunInfo(name="channel", carriers=(Carrier(name="c", frequency_hz=1e9),))
)
IDS = {"epoch": 1, "attempt": 1, "episode": 2}


def test_a_frame_has_the_budget_and_the_decisions_imposed_of_its_grant() -> None:
    reset = Reset(**IDS, seed=5, t0_ns=0, seed_episode=1)
    grant = Grant(**IDS, frame=3, t_ns=300, budget_ns=20_000_000, decisions={"rung": "low"})
    frame = granted_frame(SERVICE, reset, grant, ())
    assert (frame.budget_ns, frame.imposed) == (20_000_000, {"rung": "low"})
    assert (frame.episode, frame.number, frame.seed, frame.seed_episode) == (2, 3, 5, 1)


def test_by_default_there_is_no_limit_and_nothing_imposed() -> None:
    frame = granted_frame(SERVICE, Reset(**IDS, seed=5, t0_ns=0), Grant(**IDS, frame=0, t_ns=0), ())
    assert (frame.budget_ns, frame.imposed) == (0, {})


IDENTITY: dict[str, Any] = {"epoch": 4, "attempt": 2}
WELCOME = m.Welcome(
    version=m.PROTOCOL_VERSION, **IDENTITY, run="r", seed=1, heartbeat_ns=10**8, liveness_ns=10**9
)


class Town(Service[NoSettings]):
    """A sensor that needs scenery, and fails in frame 2."""

    role: ClassVar[m.Role] = "sensors"
    outputs: ClassVar[tuple[str, ...]] = ("lidar",)
    uses_scenery: ClassVar[bool] = True

    def step(self, frame: Frame) -> StepResult:
        if frame.number == 2:
            raise ValueError("no")
        return StepResult(counts={"frame": frame.number})


class Shell:
    """What a session sends, and the messages that bring it to where a test begins."""

    def __init__(self, folder: Path) -> None:
        self.sent: list[tuple[m.Message, tuple[Any, ...]]] = []
        self.session = ServiceSession(
            "sensor",
            "town",
            Town,
            lambda message, parts: self.sent.append((message, tuple(parts))),
            AssetStore(folder),
            fetch_timeout_s=5.0,
        )
        self.session.handle(WELCOME)

    def prepare(self, *assets: m.Asset) -> None:
        demand = (m.Demand(topic="lidar"),)
        self.session.receive(m.Prepare(**IDENTITY, demand=demand, assets=assets), (), 100.0)

    def start(self) -> None:
        self.prepare()
        self.session.receive(m.Reset(**IDENTITY, episode=0, seed=1, t0_ns=0))
        self.sent.clear()

    def grant(self, frame: int, **identity: int) -> m.Message:
        self.session.receive(m.Grant(**(IDENTITY | identity), episode=0, frame=frame, t_ns=frame))
        return self.sent.pop()[0]


@pytest.fixture(name="shell")
def joined(tmp_path: Path) -> Shell:
    return Shell(tmp_path)


def asset(name: str, content: bytes) -> m.Asset:
    return m.Asset(name=name, digest=hashlib.sha256(content).hexdigest(), size=len(content))


def test_scenery_is_asked_for_chunk_by_chunk_before_ready(shell: Shell) -> None:
    plaza = asset("a.ply", b"plaza")
    shell.prepare(plaza)
    assert shell.session.deadline == 105.0
    for offset, chunk, now in ((0, b"pla", 101.0), (3, b"za", 104.0)):
        assert shell.sent.pop() == (m.AssetGet(digest=plaza.digest, offset=offset), ())
        data = m.AssetData(digest=plaza.digest, offset=offset, size=5)
        shell.session.receive(data, (chunk,), now)
    assert isinstance(shell.sent.pop()[0], m.Ready)
    assert shell.session.deadline is None


def test_scenery_that_does_not_come_is_a_fault_at_the_deadline(shell: Shell) -> None:
    shell.prepare(asset("a.ply", b"plaza"))
    shell.session.expire(104.9)
    assert isinstance(shell.sent[-1][0], m.AssetGet)
    shell.session.expire(105.0)
    fault = shell.sent[-1][0]
    assert isinstance(fault, m.Fault)
    assert (fault.phase, fault.message) == ("prepare", "the broker did not deliver asset 'a.ply' within 5 s")


def test_another_message_than_the_scenery_is_a_fault(shell: Shell) -> None:
    shell.prepare(asset("a.ply", b"plaza"))
    fault = shell.grant(0)
    assert isinstance(fault, m.Fault)
    assert fault.message == "asked for asset 'a.ply', got GRANT"


def test_a_repeated_grant_gets_the_stored_answer_a_fault_too(shell: Shell) -> None:
    shell.start()
    done, fault = shell.grant(1), shell.grant(2)
    assert isinstance(done, m.Done)
    assert isinstance(fault, m.Fault)
    assert re.fullmatch(r"ValueError: no \(at \S*test_services_session\.py:58 in step\)", fault.message)
    assert shell.grant(1) is done
    assert shell.grant(2) is fault


def test_a_message_for_another_incarnation_is_not_used(shell: Shell) -> None:
    shell.start()
    answer = shell.grant(0, attempt=3)
    assert isinstance(answer, m.Error)
    assert answer.message == "GRANT is not used: this is attempt 2 in epoch 4"


def test_a_frame_is_answered_from_outside_once(tmp_path: Path) -> None:
    sent: list[m.Message] = []
    session = OutsideSession(
        "sensor", "town", Town, lambda message, _: sent.append(message), AssetStore(tmp_path),
        check=ProductCheck(), encodes=False,
    )  # fmt: skip
    session.handle(WELCOME)
    session.handle(m.Reset(**IDENTITY, episode=0, seed=1, t0_ns=0))
    session.handle(m.Grant(**IDENTITY, episode=0, frame=2, t_ns=0))
    assert session.frame is not None
    session.answer(StepResult(end_episode=True))
    done = sent[-1]
    assert isinstance(done, m.Done)
    assert (done.frame, done.end_episode) == (2, True)
    with pytest.raises(RunError, match="granted no frame"):
        session.answer(StepResult())
