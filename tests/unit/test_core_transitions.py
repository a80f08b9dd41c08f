"""The tables of transitions: complete, and nothing in them that never happens."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum
from typing import Any

import pytest
from core_harness import MS, SECOND, Simulation, agent, loop, sensors, world

from caviar_broker.core import events as ev
from caviar_broker.core import run, tasks, transitions
from caviar_broker.core.plan import Timeouts
from caviar_broker.core.transitions import (
    DECIDED,
    OUTSTANDING,
    PRESENT,
    RUN,
    SERVICE,
    TASK,
    IllegalTransitionError,
    RunEvent,
    RunState,
    ServiceState,
    TaskState,
    step,
)
from caviar_protocol import messages as m


def test_what_is_not_in_a_table_is_not_allowed() -> None:
    with pytest.raises(IllegalTransitionError, match=r"ALL_GONE.*RUNNING"):
        step(RUN, RunState.RUNNING, RunEvent.ALL_GONE)


def test_the_tables_end_where_they_should() -> None:
    assert {s for s in RunState if not any(state is s for state, _ in RUN)} == {RunState.FINISHED}
    assert {s for s in ServiceState if not any(state is s for state, _ in SERVICE)} == {ServiceState.LEFT}
    ends = {s for s in TaskState if not any(state is s for state, _ in TASK)}
    assert ends == {
        TaskState.DONE,
        TaskState.LATE,
        TaskState.FAILED,
        TaskState.SKIPPED,
        TaskState.DISCARDED,
    }


def test_the_groups_of_states_agree_with_the_tables() -> None:
    answers = {transitions.TaskEvent.ANSWER, transitions.TaskEvent.FAULT}
    assert {state for state, event in TASK if event in answers} == OUTSTANDING
    assert {TaskState.OVERDUE} == DECIDED & OUTSTANDING, "the frame went on, the answer is still due"
    leaving = {state for state, event in SERVICE if event is transitions.ServiceEvent.BYE}
    assert leaving == PRESENT


def stopped_at(instant: int) -> Simulation:
    simulation = Simulation(loop(), journal_after=MS).join("world", "channel", "agent")
    simulation.join("link", "recorder", at=2 * MS)
    simulation.after(instant, lambda: simulation.feed(ev.StopRequested("Ctrl-C")))
    return simulation


def killed_at(instant: int) -> Simulation:
    services = loop(
        world={"ready_after": 3 * MS}, channel={"ready_after": 4 * MS}, agent={"reset_after": 3 * MS}
    )
    simulation = Simulation(services).join("world", "channel", "link", at=2 * MS)
    simulation.join("agent", "recorder", at=3 * MS)
    simulation.after(instant, lambda: simulation.kill("agent"))
    return simulation


def hold_run(*, ends: int | None = None, **lidar: Any) -> Simulation:
    takes = (m.Input(topic="scene"), m.Input(topic="lidar", lag=1, required=False))
    wish = frozenset() if ends is None else frozenset({(0, ends)})
    slow = agent(inputs=takes, latency=50 * MS, ends=wish)
    services = [world(), sensors(policy="hold", budget=20 * MS, **lidar), slow]
    return Simulation(services, episodes=2).join()


def at(frame: int, takes: int) -> Callable[[int, int], int]:
    return lambda episode, k: takes if (episode, k) == (0, frame) else MS


def rejoining_between_episodes() -> Simulation:
    services = loop(link={"latency": 50 * MS}, world={"reset_after": 400 * MS})
    simulation = Simulation(services, episodes=2, frames=2, timeouts=Timeouts(rejoin=SECOND)).join()
    simulation.run(lambda s: any(g.frame == 1 for g in s.grants("link")))
    simulation.kill("world")
    simulation.hello("world")
    return simulation


def restored(*, until: int, **how: Any) -> Simulation:
    """A link that dies with a state to get back, and something happens so much later."""
    services = loop(link={"stateful": True, "latency": 5 * MS, "saving": 20 * MS} | how)
    plan = {"frames": 6, "checkpoint_frames": 2, "timeouts": Timeouts(rejoin=SECOND)}
    simulation = Simulation(services, **plan).join()
    simulation.run(lambda s: any(g.frame == 3 for g in s.grants("link")))
    simulation.kill("link")
    simulation.hello("link")
    return simulation.run_to(simulation.now + until)


def killed_while_restored() -> Simulation:
    simulation = restored(until=10 * MS)
    simulation.kill("link")
    simulation.hello("link")
    return simulation


def leaving_while_restored() -> Simulation:
    simulation = restored(until=10 * MS)
    simulation.feed(ev.StopRequested("Ctrl-C"))
    return simulation


def an_episode_that_ends_while_somebody_is_restored() -> Simulation:
    """No service needs the world any more, which dies with nothing outstanding."""
    services = loop(world={"stateful": True, "saving": 400 * MS}, link={"latency": 50 * MS})
    plan = {"frames": 4, "episodes": 2, "checkpoint_frames": 3, "timeouts": Timeouts(rejoin=5 * SECOND)}
    simulation = Simulation(services, **plan).join()
    simulation.run(lambda s: any(g.frame == 3 for g in s.grants("link")))
    simulation.kill("world")
    simulation.hello("world")
    return simulation


SCENARIOS: list[Callable[[], Simulation]] = [
    *[lambda t=t: stopped_at(t * MS) for t in range(12)],
    *[lambda t=t: killed_at(t * MS) for t in range(16)],
    lambda: Simulation(loop(), episodes=2).join(),
    lambda: Simulation(loop()),
    rejoining_between_episodes,
    lambda: restored(until=0),
    killed_while_restored,
    leaving_while_restored,
    an_episode_that_ends_while_somebody_is_restored,
    lambda: hold_run(latency=at(2, 60 * MS)),
    lambda: hold_run(latency=at(2, 60 * MS), faults={(0, 2): "late fault"}),
    lambda: hold_run(faults={(0, 2): "fault"}, omits=frozenset({(0, 1)})),
    lambda: hold_run(latency=at(2, 170 * MS)),
    lambda: hold_run(latency=at(2, 15 * MS), ends=0),
    lambda: hold_run(latency=at(2, 300 * MS), ends=0),
    lambda: hold_run(latency=at(3, 49 * MS), ends=0),
    lambda: hold_run(latency=at(3, 49 * MS), ends=0, faults={(0, 3): "after the end"}),
    lambda: Simulation(
        loop(agent={"ends": frozenset({(0, 1)}), "latency": 30 * MS}, world={"latency": 20 * MS})
    ).join(),
    lambda: Simulation(
        loop(channel={"omits": frozenset({(0, 1)})}, world={"latency": 20 * MS}, link={"latency": 60 * MS})
    ).join(),
]


def test_every_entry_of_every_table_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: set[tuple[Enum, Enum]] = set()

    def recording(table: Any, state: Any, event: Any) -> Any:
        seen.add((state, event))
        return step(table, state, event)

    for module in (tasks, run):
        monkeypatch.setattr(module, "step", recording)
    for scenario in SCENARIOS:
        scenario().run()
    never = {key for key in (*RUN, *SERVICE, *TASK) if key not in seen}
    assert not never
