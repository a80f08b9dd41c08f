"""Clause 18: services with state save it, and get back to where they were, in virtual time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from core_harness import MS, SECOND, Simulation, loop

from caviar_broker.core import events as ev
from caviar_broker.core.checkpoints import MAX_HISTORY_BYTES
from caviar_broker.core.plan import Timeouts
from caviar_protocol import messages as m

REJOIN = Timeouts(rejoin=5 * SECOND)
STATEFUL = {name: {"stateful": True} for name in ("world", "channel", "agent", "link")}


def simulation(**plan: Any) -> Simulation:
    settings = {"frames": 9, "checkpoint_frames": 3, "timeouts": REJOIN} | plan
    services: dict[str, dict[str, Any]] = settings.pop("services", STATEFUL)
    return Simulation(loop(**services), **settings).join()


def granted(name: str, frame: int, episode: int = 0) -> Callable[[Simulation], bool]:
    def reached(run: Simulation) -> bool:
        return any((g.episode, g.frame) == (episode, frame) for g in run.grants(name))

    return reached


def undisturbed(**plan: Any) -> str:
    run = simulation(**plan).run()
    assert run.outcome.error == ""
    return str(run.outcome.digest)


def test_a_service_saves_its_state_after_so_many_frames_and_is_granted_nothing_meanwhile() -> None:
    run = simulation(services=STATEFUL | {"link": {"stateful": True, "saving": 40 * MS}}).run()
    assert [c.frame for c in run.seen(m.Checkpoint, "link")] == [2, 5]
    asked = [t for t, a in run.log if isinstance(a, ev.Send) and isinstance(a.message, m.Checkpoint)]
    saved = [a for _, a in run.log if isinstance(a, ev.Journal) and a.outcome == "checkpoint" and a.state]
    assert {(a.service, a.frame) for a in saved} >= {("link", 2), ("link", 5), ("world", 2), ("world", 5)}
    assert run.time_of("link", 3) >= asked[0] + 40 * MS
    assert run.outcome.error == ""


def test_nobody_saves_without_the_capability_or_where_the_scenario_says_never() -> None:
    assert simulation(services={}).run().seen(m.Checkpoint) == []
    assert simulation(checkpoint_frames=0).run().seen(m.Checkpoint) == []


def test_a_service_with_grants_queued_answers_them_all_before_it_saves() -> None:
    services = STATEFUL | {"world": {"stateful": True, "max_in_flight": 3, "latency": MS}}
    run = simulation(services=services).run()
    assert run.outcome.error == ""
    assert [c.frame for c in run.seen(m.Checkpoint, "world")]  # the history checks that none was outstanding


def test_much_to_remember_is_reason_to_save_early() -> None:
    run = simulation(frames=4, checkpoint_frames=100)
    run.clock._episodes.checkpoints._payload_size = lambda payload: MAX_HISTORY_BYTES  # type: ignore[attr-defined]
    run.run()
    assert [c.frame for c in run.seen(m.Checkpoint, "channel")] == [1]


@pytest.mark.parametrize("name", ["world", "channel", "agent", "link"])
@pytest.mark.parametrize("frame", [0, 1, 2, 3, 5, 8])
def test_a_service_that_is_killed_gets_its_state_back_and_the_digest_is_the_same(
    name: str, frame: int
) -> None:
    run = simulation().run(granted(name, frame))
    run.kill(name)
    run.after(200 * MS, lambda: run.hello(name))
    run.run()
    assert run.outcome.error == ""
    assert run.outcome.digest == undisturbed()
    assert run.notices("differs") == []
    if frame > 3:
        assert [r.frame for r in run.seen(m.Restore, name)] == [5 if frame > 5 else 2]


def test_decisions_that_were_taken_are_imposed_when_a_frame_is_granted_again() -> None:
    def rung(episode: int, frame: int) -> dict[str, Any]:
        return {"decisions": {"rung": f"of frame {frame}"}} if frame % 2 else {}

    services = STATEFUL | {"channel": {"stateful": True, "report": rung}}
    run = simulation(services=services).run(granted("channel", 5))
    run.kill("channel")
    run.after(200 * MS, lambda: run.hello("channel"))
    run.run()
    repeated = [g for g in run.grants("channel") if g.attempt == 2]
    assert [(g.frame, g.decisions) for g in repeated][:4] == [
        (3, {"rung": "of frame 3"}),
        (4, {}),
        (5, {}),
        (6, {}),
    ]


@pytest.mark.parametrize("times", [1, 2])
def test_a_service_that_dies_while_it_is_being_restored_is_restored_again(times: int) -> None:
    run = simulation().run(granted("link", 5))
    run.kill("link")
    run.hello("link")
    for _ in range(times):
        restores = len(run.seen(m.Restore, "link"))
        run.run(lambda r, n=restores: len(r.seen(m.Restore, "link")) > n)
        run.kill("link", "again")
        run.hello("link") if times == 1 else None
        if times == 2:
            break
    run.run()
    if times == 1:
        assert run.outcome.error == ""
        assert run.outcome.digest == undisturbed()
    else:
        assert "did not come back" in run.outcome.error


def test_a_service_that_dies_while_it_saves_is_restored_from_before() -> None:
    run = simulation(services=STATEFUL | {"link": {"stateful": True, "saving": 20 * MS}})
    run.run(lambda r: len(r.seen(m.Checkpoint, "link")) == 2)
    run.kill("link")
    run.hello("link")
    run.run()
    assert [r.frame for r in run.seen(m.Restore, "link")] == [2]
    assert run.outcome.digest == undisturbed()


def test_a_service_that_is_not_reproducible_is_told_of_and_the_run_goes_on() -> None:
    services = STATEFUL | {"link": {"stateful": True, "forgets": True}}
    run = simulation(services=services).run(granted("link", 5))
    run.kill("link")
    run.hello("link")
    run.run()
    assert run.outcome.error == ""
    told = run.notices("differs", "link")
    assert [n.frame for n in told] == [3, 4]
    assert "another link" in told[0].text


def test_a_service_that_never_saves_ends_the_run_with_blame() -> None:
    services = STATEFUL | {"link": {"stateful": True, "saving": None}}
    run = simulation(services=services, timeouts=Timeouts(stall=SECOND)).run()
    assert run.outcome.culprit == "link"
    assert "CHECKPOINT" in run.outcome.error


def test_memory_does_not_reach_into_the_next_episode() -> None:
    plan: dict[str, Any] = {"episodes": 2, "frames": 5}
    run = simulation(**plan).run(granted("link", 1, episode=1))
    run.kill("link")
    run.hello("link")
    run.run()
    assert run.seen(m.Restore, "link") == []
    assert run.outcome.digest == undisturbed(**plan)


def test_a_state_that_nobody_asked_for_is_stale() -> None:
    run = simulation().run(granted("link", 1))
    ids = {"epoch": 1, "attempt": 1, "episode": 0, "frame": 0}
    run.feed(ev.CheckpointReceived("link", m.CheckpointDone(**ids), "state"))
    assert [s.of for s in run.seen(m.Stale, "link")] == ["CHECKPOINT_DONE"]


@pytest.mark.parametrize("kind", [m.Checkpoint, m.Restore])
def test_a_service_that_cannot_save_or_restore_its_state_ends_the_run_with_its_words(kind: type) -> None:
    services = STATEFUL | {"link": {"stateful": True, "saving": None if kind is m.Checkpoint else MS}}
    run = simulation(services=services)
    if kind is m.Restore:
        run.run(granted("link", 5))
        run.kill("link")
        run.services["link"].saving = None
        run.hello("link")
    run.run(lambda r: bool(r.seen(kind, "link")))
    asked = run.seen(kind, "link")[-1]
    ids = {f: getattr(asked, f) for f in ("epoch", "attempt", "episode", "frame")}
    run.feed(ev.FaultReceived("link", m.Fault(**ids, phase="state", message="the disk is full")))
    run.run()
    assert run.outcome.culprit == "link"
    assert "state: the disk is full" in run.outcome.error
