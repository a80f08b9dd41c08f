"""A replayed service serves the recorded bytes, whatever they are."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from recording_builders import PERIOD_NS, absent, frame, product, record, scene

from caviar_protocol import messages as m
from caviar_protocol.codec import decode_payload, encode_payload
from caviar_protocol.digest import payload_digest
from caviar_protocol.errors import DeclarationError, RecordingError, ScenarioError
from caviar_protocol.messages import Report, Status
from caviar_protocol.scenario.conversion import Place
from caviar_services.conversion import Encoded, encoded_done, plain_done
from caviar_services.registry import load
from caviar_services.replay import Replayer, ReplaySettings, use_of
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo, StepResult

GRANT = m.Grant(epoch=1, attempt=1, episode=0, frame=0, t_ns=0)
IDENTITY = {"epoch": 1, "attempt": 1}


def foreign(frame: int) -> tuple[bytes, bytes]:
    """A scene as another encoder writes it: the first key's length in a byte of its own."""
    header, body = encode_payload(scene(frame))
    assert header[1] >> 5 == 0b101, "a short text"
    turned = header[:1] + bytes([0xD9, header[1] & 0x1F]) + header[2:]
    assert encode_payload(decode_payload("scene", turned, body)) == (header, body)
    return turned, body


def item(frame: int, status: Status = Status.FRESH, of: int | None = None, source: str = "w") -> FrameInput:
    if status is Status.ABSENT:
        return absent("scene", source, "w failed")
    of = frame if of is None else of
    cause = "" if status is Status.FRESH else "w was late"
    return product("scene", source, foreign(of), of, status, used_in=frame, fidelity=f"f{of}", cause=cause)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes of a world with fresh, held and absent scenes; the second has another seed."""
    frames = []
    for episode, seed, inputs in (
        (0, 6, [item(0), item(1, Status.HELD, of=0), item(2, Status.ABSENT), item(3)]),
        (1, 9, [item(0), item(1)]),
    ):
        for number, each in enumerate(inputs):
            report = Report(source="w", decisions={"rung": f"r{number}"}, counts={"skipped": number})
            other = item(number, source="other")
            frames.append(frame(number, each, other, episode=episode, reports=(report,), seed=seed))
    return record(tmp_path_factory.mktemp("runs") / "run", frames)


def replayer(recording: Path, role: str = "world", name: str = "w") -> Replayer:
    cls = load(role, use_of(role, ["scene"]))
    service = cls(ReplaySettings(recording=str(recording)), RunInfo(name=name, frames=4))
    assert isinstance(service, Replayer)
    return service


def step(service: Replayer, number: int, episode: int = 0, *, final: bool = False) -> StepResult:
    return service.step(Frame(episode=episode, number=number, t_ns=number * PERIOD_NS, final=final))


def test_its_class_says_role_and_topics() -> None:
    cls = load("sensors", use_of("sensors", ["depth", "camera"]))
    assert (cls.role, cls.outputs, cls.inputs) == ("sensors", ("camera", "depth"), ())
    assert cls is load("sensors", use_of("sensors", ["camera", "depth"]))
    with pytest.raises(DeclarationError, match="world_scene"):
        load("world", "caviar_services.replay:world_weather")


def test_bytes_are_served_as_they_were_not_as_this_encoder_writes_them(recording: Path) -> None:
    service = replayer(recording)
    service.prepare(Preparation(demand={"scene": frozenset()}))
    done, parts = encoded_done(IDENTITY, service.run.name, GRANT, step(service, 3), 0)
    assert tuple(parts) == foreign(3)
    (header,) = done.products
    assert header == m.ProductHeader(topic="scene", digest=payload_digest(*foreign(3)), fidelity="f3")
    assert done.decisions == {"rung": "r3"}
    assert done.counts == {"skipped": 3}


def test_held_products_are_sent_again_and_absent_ones_are_not(recording: Path) -> None:
    service = replayer(recording)
    held = step(service, 1).products["scene"]
    assert isinstance(held, Encoded)
    assert (held.header, held.body) == foreign(0)
    assert step(service, 2).products == {}


def test_a_consumer_in_the_same_process_gets_the_payload(recording: Path) -> None:
    _, (payload,) = plain_done(IDENTITY, "w", GRANT, step(replayer(recording), 3))
    assert encode_payload(payload) == encode_payload(scene(3))


def test_an_agent_ends_episodes_where_they_ended_with_the_seeds_they_had(recording: Path) -> None:
    agent = replayer(recording, "agent")
    assert agent.prepare(Preparation(demand={})).seed == 6
    assert [step(agent, number).end_episode for number in range(4)] == [False, False, False, True]
    assert step(agent, 1, episode=1).end_episode
    assert step(agent, 4, final=True) == StepResult(seed=9)
    assert step(agent, 2, episode=1, final=True) == StepResult()
    assert not step(replayer(recording), 3).end_episode


def test_what_the_recording_does_not_hold_is_told(recording: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"no scene of 'lidar'.*--keep lidar"):
        replayer(recording, name="lidar").prepare(Preparation(demand={}))
    with pytest.raises(RecordingError, match="no frame 7"):
        step(replayer(recording), 7)
    nowhere = ReplaySettings(recording=str(tmp_path / "none"))
    with pytest.raises(ScenarioError, match="name the directory of a run"):
        Replayer.check_settings(nowhere, Place("services.w.settings"))


def test_scenery_that_was_not_copied_is_told(recording: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service = replayer(recording)
    asset = m.Asset(name="scenery/a.ply", digest="0" * 64, size=1)
    metadata = msgspec.structs.replace(service._recording.metadata, assets=(asset,))
    monkeypatch.setattr(service._recording, "metadata", metadata)
    with pytest.raises(RecordingError, match=r"scenery/a\.ply is not in it.*--keep w"):
        service.prepare(Preparation(demand={}))
