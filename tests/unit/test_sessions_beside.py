"""Sessions that take the places of several agents: frames, seeds, mistakes, with and without the clock."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager
from itertools import pairwise
from pathlib import Path

import pytest
from msgspec.structs import replace

from caviar_clients.session.connected import open_session
from caviar_clients.session.embedded import EmbeddedSession
from caviar_clients.session.prepared import prepare
from caviar_protocol.errors import PayloadError, ScenarioError
from caviar_protocol.messages import Input
from caviar_protocol.recording import Recording
from caviar_protocol.topics import Action, BeamChoice, Link, VelocityCommand
from caviar_services.service import Frame

FRAMES = 5
INPUTS = (Input(topic="scene"), Input(topic="link", lag=1, required=False))
EAST = Action(commands=(VelocityCommand(object="uav", velocity=(6.0, 0.0, 0.0)),))


def beams(tx_beam: int) -> Action:
    return Action(commands=(BeamChoice(tx="bs", rx="uav/rx", tx_beam=tx_beam, rx_beam=0),))


@contextmanager
def pair(directory: Path | None = None) -> Iterator[EmbeddedSession]:
    """Pilot and beams of the shipped scenario, decided here."""
    scenario = prepare(Path("uav-pair"), frames=FRAMES).scenario
    # What is measured is what the agents do: without the scenery nothing has to be loaded.
    world = replace(scenario.services["world"], settings={**scenario.services["world"].settings})
    world.settings.pop("scenery")
    scenario = replace(scenario, services={**scenario.services, "world": world})
    with closing(EmbeddedSession(scenario, "pilot", INPUTS, directory, beside=("beams",))) as session:
        yield session


def flown(session: EmbeddedSession, seed: int) -> list[tuple[float, int, float]]:
    """Place of the UAV, beam of the frame before, and |y| of each frame of an episode."""
    frame, seen = session.reset(seed), []
    while not frame.final:
        frame = session.step({"action": EAST}, {"beams": {"action": beams(frame.number)}})
        seen.append(_seen(frame))
    return seen


def _seen(frame: Frame) -> tuple[float, int, float]:
    link = frame.only("link", Link)
    assert link is not None
    x = float("nan") if frame.final else float(frame.scene().position[0, 0])
    return x, int(link.tx_beam[0]), float(link.abs_y[0])


def test_each_frame_has_the_decisions_of_both() -> None:
    """The UAV flies east as one agent says; the beams are those of the other one."""
    with pair() as session:
        seen = flown(session, seed=4)
    assert [beam for _, beam, _ in seen] == list(range(FRAMES))
    places = [x for x, *_ in seen[:-1]]  # the final frame has no scene
    assert all(after > before for before, after in pairwise(places))


def test_with_the_clock_and_a_recording_it_is_the_same(tmp_path: Path) -> None:
    """Frame by frame, over two episodes; the recording has both agents' actions."""
    with pair() as session:
        direct = [flown(session, seed=9), flown(session, seed=2)]
    with pair(tmp_path / "run") as session:
        clocked = [flown(session, seed=9), flown(session, seed=2)]
    assert repr(clocked) == repr(direct)
    found = {
        product.provenance.source
        for frame in Recording(tmp_path / "run").frames()
        for product in frame.products
        if product.provenance.topic == "action"
    }
    assert found == {"pilot", "beams"}


def test_an_episode_ends_early_for_both() -> None:
    """The seed of the next one is that of both agents."""
    with pair() as session:
        whole = flown(session, seed=7)
        session.reset(seed=7)
        session.step({"action": EAST}, {"beams": {"action": beams(0)}})
        assert repr(flown(session, seed=7)) == repr(whole)


def test_an_agent_that_is_not_beside_is_named() -> None:
    with pair() as session:
        session.reset(seed=1)
        with pytest.raises(PayloadError, match=r"'beam'.*beams"):
            session.step({"action": EAST}, {"beam": {"action": beams(0)}})


@pytest.mark.parametrize(
    ("agent", "beside", "expected"),
    [
        ("pilto", (), "has no agent 'pilto'; its agents are: pilot, beams"),
        ("pilot", ("beam",), "has no agent 'beam'; its agents are"),
        ("pilot", ("world",), "has no agent 'world'; its agents are"),
        ("pilot", ("pilot",), "write a tuple of names, each of them once"),
        ("pilot", ("beams", "beams"), "write a tuple of names, each of them once"),
        ("pilot", "beams", "beside='beams'; write a tuple of names"),
    ],
)
def test_places_that_are_not_there_are_refused(agent: str, beside: tuple[str, ...], expected: str) -> None:
    with pytest.raises(ScenarioError, match=expected):
        open_session(prepare("uav-pair"), agent, (Input(topic="scene"),), beside=beside)
