"""Frames without a clock are those of the clock: same products, seeds, notices and blame."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from caviar_clients.session import embedded
from caviar_clients.session.base import Frame
from caviar_clients.session.direct import DirectFrames
from caviar_clients.session.embedded import EmbeddedSession
from caviar_protocol.codec import encode_payload
from caviar_protocol.errors import RunError
from caviar_protocol.messages import Input
from caviar_protocol.scenario import Scenario, parse_scenario
from caviar_protocol.topics import Action, BeamChoice, Channel, Scene
from caviar_services.agent.base import Agent
from caviar_services.service import StepResult
from caviar_services.world.trajectory import TrajectoryWorld

pytestmark = pytest.mark.slow

SCENARIOS = Path(__file__).parents[2] / "deploy" / "caviar_scenarios"
INPUTS = (
    Input(topic="scene"),
    Input(topic="channel"),
    Input(topic="scene", lag=1, required=False),
    Input(topic="link", lag=1, required=False),
)


def scenario_of(name: str, *changes: tuple[str, str]) -> Scenario:
    """A shipped scenario with some text replaced."""
    text = (SCENARIOS / f"{name}.toml").read_text()
    for old, new in changes:
        assert old in text, f"{old!r} is not in {name}"
        text = text.replace(old, new, 1)
    return parse_scenario(text)


def seen(frame: Frame) -> tuple[Any, ...]:
    """All that an agent gets in a frame, without digests, which only the clock's run has."""
    inputs = tuple(
        (
            item.provenance.topic,
            item.provenance.source,
            item.provenance.status,
            item.provenance.frame,
            item.provenance.t_ns,
            item.provenance.age,
            item.provenance.fidelity,
            item.provenance.cause,
            encode_payload(item.payload) if item.present else None,
        )
        for item in frame.inputs
    )
    return (
        frame.episode,
        frame.number,
        frame.t_ns,
        frame.previous,
        frame.final,
        frame.budget_ns,
        frame.seed,
        frame.seed_episode,
        inputs,
    )


def played(
    scenario: Scenario,
    clock: bool,
    resets: list[int | None],
    steps: int,
    notices: list[str] | None = None,
) -> list[Any]:
    """What an agent sees that draws beams, episode by episode from ``resets``, with or without the clock."""
    rng, found = np.random.default_rng(1), list[Any]()
    with pytest.MonkeyPatch.context() as patch:
        if clock:
            patch.setattr(embedded, "plays_directly", lambda plan: False)
        session = EmbeddedSession(scenario, "agent", INPUTS)
    with session:
        for seed in resets:
            frame = session.reset(seed)
            found.append(seen(frame))
            for _ in range(steps):
                if frame.final:
                    break
                scene = frame.scene()
                names = [device.name for device in scene.devices]
                commands = [
                    BeamChoice(tx="bs", rx=name, tx_beam=int(rng.integers(8)), rx_beam=0)
                    for name in names
                    if name.startswith(("uav/", "car/"))
                ]
                frame = session.step({"action": Action(commands=tuple(sorted(commands, key=lambda c: c.rx)))})
                found.append(seen(frame))
        if notices is not None:
            notices += session.notices
    return found


@pytest.mark.parametrize("name", ["geometric", "smoke"])
def test_every_frame_of_every_episode_is_the_clocks(name: str) -> None:
    scenario = scenario_of(name)
    resets: list[int | None] = [3, None, 3, 2**60, None]  # ends early, repeats, goes on
    direct = played(scenario, False, resets, 7)
    assert direct == played(scenario, True, resets, 7)
    # The same seed leads to the same episode, and without one the next of its seed follows.
    assert direct[0][5:] == direct[16][5:]
    assert [frame[6:8] for frame in direct[::8]] == [(3, 0), (3, 1), (3, 0), (2**60, 0), (2**60, 1)]


def test_an_episode_to_its_end_is_the_clocks() -> None:
    scenario = scenario_of("smoke", ("frames = 100", "frames = 12"))
    direct = played(scenario, False, [5, None], 20)
    assert direct == played(scenario, True, [5, None], 20)
    assert [frame[4] for frame in direct] == [*[False] * 12, True] * 2


@pytest.mark.parametrize("clock", [False, True])
def test_what_a_service_without_a_consumer_would_ask_for_is_not_in_demand(
    clock: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The link takes the part `h` of a channel; nobody takes the link here."""
    if clock:
        monkeypatch.setattr(embedded, "plays_directly", lambda plan: False)
    inputs = (Input(topic="scene"), Input(topic="channel"))
    with EmbeddedSession(scenario_of("smoke"), "agent", inputs) as session:
        assert session.reset(seed=1).only("channel", Channel).h == ()


class Failing(TrajectoryWorld):
    """A world with a fault in frame 3 of every episode."""

    fault: ClassVar[str] = ""

    def step(self, frame: Any) -> StepResult:
        result = super().step(frame)
        if frame.number != 3:
            return result
        match type(self).fault:
            case "raises":
                raise RuntimeError("out of fuel")
            case "exits":
                raise SystemExit(0)
            case "nothing":
                return StepResult()
            case "nonsense":
                return StepResult(products={"scene": Action(commands=())})
            case "undeclared":
                return StepResult(products={**result.products, "action": Action(commands=())})
            case "not a number":
                scene = result.products["scene"]
                assert isinstance(scene, Scene)
                scene.position[:] = np.nan
        return result

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        if type(self).fault == "reset" and seed == 9:
            raise RuntimeError("no such place")
        super().reset(episode, seed, t0_ns)


@pytest.mark.parametrize("fault", ["raises", "exits", "nonsense", "undeclared", "not a number", "reset"])
def test_blame_is_the_clocks(fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Failing, "fault", fault)
    scenario = scenario_of("smoke", ('use = "trajectory"', f'use = "{__name__}:Failing"'))
    ends = []
    for clock in (False, True):
        with pytest.raises(RunError) as ended:
            played(scenario, clock, [1, 9], 5)
        ends.append(str(ended.value))
    assert ends[0] == ends[1]
    assert "world 'world'" in ends[0]


def test_a_frame_without_a_scene_is_skipped_as_by_the_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Failing, "fault", "nothing")
    scenario = scenario_of("smoke", ('use = "trajectory"', f'use = "{__name__}:Failing"'))
    direct, clock = list[str](), list[str]()
    frames = played(scenario, False, [1, None], 6, direct)
    assert frames == played(scenario, True, [1, None], 6, clock)
    assert [frame[1] for frame in frames[:5]] == [0, 1, 2, 4, 5]
    assert sorted(direct) == sorted(clock)
    assert "skipped: agent: world produced no scene in frame 3" in direct


class Ending(Agent):
    """A second agent, which ends episodes and chooses seeds."""

    seed: ClassVar[int] = 77

    def choose(self, frame: Any, scene: Any, pairs: Any) -> list[BeamChoice]:
        return []

    def step(self, frame: Any) -> StepResult:
        result = super().step(frame)
        if frame.number == 2:
            return StepResult(products=result.products, seed=5)  # too early: not used
        ends = frame.number == 4
        return StepResult(products=result.products, end_episode=ends, seed=self.seed if ends else -1)


SECOND = f"""
[services.second]
role = "agent"
use = "{__name__}:Ending"
budget_ms = 50
users = ["uav/*"]
"""


def test_another_agent_ends_an_episode_and_chooses_the_seed_as_with_the_clock() -> None:
    text = (SCENARIOS / "smoke.toml").read_text() + SECOND
    direct, clock = list[str](), list[str]()
    # The session's own resets choose no seed: it asks for the episode that follows.
    frames = played(parse_scenario(text), False, [None, None], 9, direct)
    assert frames == played(parse_scenario(text), True, [None, None], 9, clock)
    assert frames[5][4], "frame 5 is final"
    assert frames[6][6:8] == (77, 0)
    assert sorted(direct) == sorted(clock)


def test_two_seeds_for_one_episode_are_refused_as_by_the_clock() -> None:
    text = (SCENARIOS / "smoke.toml").read_text() + SECOND
    ends = []
    for clock in (False, True):
        with pytest.raises(RunError, match="choose different seeds, 77 and 8") as ended:
            played(parse_scenario(text), clock, [None, 8], 9)
        ends.append(str(ended.value))
    assert ends[0] == ends[1]


def test_a_frame_that_can_do_without_a_service_is_the_clocks_to_decide(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("played without a clock")

    monkeypatch.setattr(DirectFrames, "__init__", refuse)
    held = scenario_of("smoke", ('use = "free-space"', 'use = "free-space"\npolicy = "hold"'))
    assert len(played(held, False, [1], 3)) == 4
    with pytest.raises(AssertionError, match="without a clock"):
        played(scenario_of("smoke"), False, [1], 3)
