"""Episodes: their begin, their end, and an agent that ends one early (contract, clauses 16 and 17)."""

from __future__ import annotations

import pytest
from core_harness import MS, SECOND, Simulation, agent, channel, link, loop, recorder, sensors, world

from caviar_broker.core import events as ev
from caviar_broker.core.plan import Timeouts
from caviar_broker.core.transitions import RunState
from caviar_protocol import messages as m
from caviar_protocol.messages import Status


def ends(*at: tuple[int, int]) -> dict[str, frozenset[tuple[int, int]]]:
    return {"ends": frozenset(at)}


def test_clause_16_reset_comes_before_frame_0_and_episode_end_after_the_last() -> None:
    run = Simulation(loop(), episodes=2, frames=2, seed=5).join().run()
    kinds = [
        (type(a.message).__name__, a.message.episode, getattr(a.message, "frame", None))
        for a in run.seen(ev.Send, "world")
        if isinstance(a.message, m.Reset | m.Grant | m.EpisodeEnd)
    ]
    assert kinds == [
        (kind, episode, frame)
        for episode in (0, 1)
        for kind, frame in (("Reset", None), ("Grant", 0), ("Grant", 1), ("EpisodeEnd", None))
    ]
    assert [(r.seed, r.t0_ns) for r in run.seen(m.Reset, "world")] == [(5, 0), (5, 0)]
    assert [e.frames for e in run.seen(m.EpisodeEnd, "world")] == [2, 2]
    assert [(e.episode, e.frames) for e in run.seen(ev.EpisodeFinished)] == [(0, 2), (1, 2)]


def test_clause_16_no_frame_is_granted_before_all_are_reset() -> None:
    run = Simulation(loop(link={"reset_after": 500 * MS})).join().run()
    done = next(t for t, a in run.log if isinstance(a, ev.Send) and isinstance(a.message, m.Reset)) + 500 * MS
    assert run.time_of("world", 0) == done


def test_clause_16_an_agent_gets_one_grant_more_with_the_last_link_and_takes_no_action() -> None:
    run = Simulation(loop(), frames=3).join().run()
    grants = run.grants("agent")
    assert [(g.frame, g.final) for g in grants] == [(0, False), (1, False), (2, False), (3, True)]
    last = grants[-1].inputs
    assert [(i.topic, i.status, i.frame) for i in last] == [("link", Status.FRESH, 2)]
    assert all(not g.final for name in ("world", "channel", "link", "recorder") for g in run.grants(name))
    assert len(run.grants("recorder")) == 3


def test_clause_16_products_of_a_final_grant_are_told_and_not_used() -> None:
    run = Simulation(loop(agent={"latency": lambda e, k: None if k == 3 else MS}), frames=3).join()
    run.run(lambda run: bool(run.grants("agent")) and run.grants("agent")[-1].final)
    header = m.ProductHeader(topic="action", digest="0" * 64)
    run.feed(
        ev.DoneReceived("agent", m.Done(epoch=1, attempt=1, episode=0, frame=3, products=(header,)), (1,))
    )
    assert "final grant" in run.notices("discarded", "agent")[0].text
    assert run.run().outcome.digest == Simulation(loop(), frames=3).join().run().outcome.digest


def test_clause_16_an_agent_ends_the_episode_early() -> None:
    run = Simulation(loop(agent=ends((0, 2))), frames=10, episodes=2).join().run()
    assert [(e.episode, e.frames) for e in run.seen(ev.EpisodeFinished)] == [(0, 3), (1, 10)]
    first = [g for g in run.grants("agent") if g.episode == 0]
    assert [(g.frame, g.final) for g in first] == [(0, False), (1, False), (2, False), (3, True)]
    assert [(i.topic, i.frame) for i in first[-1].inputs] == [("link", 2)]
    assert run.outcome.error == ""


def test_clause_16_what_ran_ahead_of_an_early_end_is_cancelled_and_its_answer_not_used() -> None:
    slow = {"latency": 30 * MS}
    run = Simulation(loop(agent=ends((0, 1)) | slow, world={"latency": 20 * MS}), frames=10).join().run()
    ahead = [g.frame for g in run.grants("world") if g.frame > 1]
    assert ahead, "the world did run ahead"
    cancelled = [c.frame for c in run.seen(m.Cancel, "world")]
    assert cancelled == ahead[-1:], "what was answered before needs no CANCEL"
    assert [n.frame for n in run.notices("discarded", "world")] == cancelled
    assert [f.frame for f in run.seen(ev.FrameFinished)] == [0, 1]
    assert [g.frame for g in run.grants("recorder")] == [0, 1]
    assert run.outcome.digest == Simulation(loop(), frames=2).join().run().outcome.digest


def test_clause_16_a_fault_after_an_early_end_does_no_harm() -> None:
    world_ = {"latency": 20 * MS, "faults": {(0, 3): "no more waypoints"}}
    run = Simulation(loop(agent=ends((0, 1)) | {"latency": 25 * MS}, world=world_), frames=10).join().run()
    assert run.outcome.error == ""
    assert run.notices("fault", "world")[0].text == "step: no more waypoints"


@pytest.mark.parametrize("overlap", [1, 4])
def test_clause_16_an_early_end_in_frame_0_and_in_the_last_frame(overlap: int) -> None:
    run = Simulation(loop(agent=ends((0, 0), (1, 4))), episodes=2, frames_in_flight=overlap).join().run()
    assert [e.frames for e in run.seen(ev.EpisodeFinished)] == [1, 5]
    assert run.outcome.error == ""


def test_clause_16_every_agent_gets_its_final_grant_when_another_ends_the_episode() -> None:
    quick, slow = agent("quick"), agent("slow", latency=50 * MS, **ends((0, 3)))
    run = Simulation([world(), channel(), quick, slow, link(), recorder()], frames=10).join().run()
    for name in ("quick", "slow"):
        assert [g.frame for g in run.grants(name)] == [0, 1, 2, 3, 4]
        assert [g.final for g in run.grants(name)] == [False, False, False, False, True]
    assert not run.seen(m.Cancel, "quick")


def test_clause_16_no_agent_runs_ahead_of_another_that_may_end_the_episode() -> None:
    both = [agent("a", inputs=(m.Input(topic="scene"),)), agent("b", latency=80 * MS)]
    run = Simulation([world(), channel(), *both, link()], frames=6).join().run()
    for frame in range(1, 7):
        assert run.time_of("a", frame) >= run.time_of("b", frame - 1) + 80 * MS


def test_clause_16_ending_the_episode_with_the_final_grant_changes_nothing() -> None:
    both = [agent("a", latency=9 * MS), agent("b", **ends((0, 2), (0, 3)))]
    run = Simulation([world(), channel(), *both, link()], frames=6).join().run()
    assert run.seen(ev.EpisodeFinished)[0].frames == 3
    assert [g.frame for g in run.grants("a")] == [0, 1, 2, 3]


def test_clause_16_two_agents_may_end_the_episode_in_one_frame() -> None:
    both = [agent("a", **ends((0, 2))), agent("b", latency=9 * MS, **ends((0, 2)))]
    run = Simulation([world(), channel(), *both, link()], frames=6).join().run()
    assert run.seen(ev.EpisodeFinished)[0].frames == 3
    assert run.outcome.error == ""


def test_clause_16_an_agent_that_is_late_ends_the_episode_where_the_agents_have_come_to() -> None:
    late = agent(
        "late", policy="drop", budget=10 * MS, latency=lambda e, k: 45 * MS if k == 1 else MS, **ends((0, 1))
    )
    other = agent("other", latency=9 * MS)
    run = Simulation([world(), channel(), late, other, link(), recorder()], frames=50).join().run()
    frames = run.seen(ev.EpisodeFinished)[0].frames
    assert 2 < frames < 10, "its wish came late, and counts from then on"
    assert run.grants("other")[-1].final
    assert run.grants("other")[-1].frame == frames
    assert [f.frame for f in run.seen(ev.FrameFinished)] == list(range(frames))
    assert run.outcome.error == ""


def test_clause_16_a_late_end_gives_the_others_their_final_grant_though_a_scene_is_under_way() -> None:
    late = agent(
        "late", policy="drop", budget=10 * MS, latency=lambda e, k: 45 * MS if k == 1 else MS, **ends((0, 1))
    )
    slow_world = world(latency=lambda e, k: 300 * MS if k == 3 else MS)
    run = Simulation([slow_world, late, agent("other")], frames=50).join().run()
    frames = run.seen(ev.EpisodeFinished)[0].frames
    assert frames == 3
    assert run.time_of("other", 3) == run.time_of("late", 1) + 45 * MS
    assert run.grants("other")[-1].final


def test_somebody_who_is_no_agent_cannot_end_the_episode() -> None:
    run = Simulation(loop(world=ends((0, 1)))).join().run()
    assert run.seen(ev.EpisodeFinished)[0].frames == 5


def test_reset_waits_for_a_late_answer_of_the_episode_before() -> None:
    tardy = sensors(policy="hold", budget=5 * MS, latency=lambda e, k: 400 * MS if (e, k) == (0, 4) else MS)
    services = [world(), agent(inputs=(m.Input(topic="lidar", required=False),)), tardy, recorder()]
    run = Simulation(services, episodes=2).join().run()
    reset = [t for t, a in run.log if isinstance(a, ev.Send) and isinstance(a.message, m.Reset)]
    assert max(reset) == run.time_of("lidar", 4) + 400 * MS
    assert run.outcome.error == ""


def test_a_service_that_never_answers_is_blamed_when_the_next_episode_needs_it() -> None:
    dead = sensors(policy="hold", budget=5 * MS, latency=lambda e, k: None if k == 1 else MS)
    services = [world(), agent(inputs=(m.Input(topic="lidar", required=False),)), dead]
    run = Simulation(services, episodes=2, timeouts=Timeouts(stall=30 * SECOND)).join().run()
    assert run.outcome.culprit == "lidar"
    assert "frame 1" in run.outcome.error
    assert run.now >= run.time_of("lidar", 1) + 30 * SECOND


def test_the_end_of_the_run_does_not_wait_for_whom_it_can_do_without() -> None:
    dead = sensors(policy="hold", budget=5 * MS, latency=lambda e, k: None if k == 1 else MS)
    services = [world(), agent(inputs=(m.Input(topic="lidar", required=False),)), dead, recorder()]
    run = Simulation(services).join().run()
    assert run.outcome.error == ""
    assert run.now < SECOND + 200 * MS
    assert run.notices("late", "lidar")[-1].text == "was never answered"


def test_the_end_of_the_run_waits_for_an_answer_after_an_early_end() -> None:
    services = loop(agent=ends((0, 0)), world={"latency": lambda e, k: 300 * MS if k else MS})
    run = Simulation(services).join().run()
    assert run.outcome.error == ""
    assert run.time_sent(m.Shutdown) == run.time_of("world", 1) + 300 * MS


def test_reset_done_of_another_episode_is_out_of_turn() -> None:
    run = Simulation(loop(world={"reset_after": None})).join()
    run.run(lambda run: run.clock.state is RunState.RESETTING)
    run.feed(ev.ResetDoneReceived("world", m.ResetDone(epoch=1, attempt=1, episode=1)))
    assert run.seen(m.Error, "world")[0].of == "RESET_DONE"
    assert run.clock.state is RunState.RESETTING


def test_answers_after_the_end_of_the_run_are_stale() -> None:
    run = Simulation(loop(world={"latency": 50 * MS})).join()
    run.run(lambda run: bool(run.grants("world")))
    run.feed(ev.StopRequested("Ctrl-C"))
    run.run()
    assert run.outcome.error == "Ctrl-C"
    assert run.seen(ev.Finished)


def test_messages_while_the_run_stops_do_no_harm() -> None:
    run = Simulation(loop(world={"says_bye": False, "reset_after": None})).join()
    run.run(lambda run: run.clock.state is RunState.RESETTING)
    run.feed(ev.StopRequested("Ctrl-C"))
    run.feed(ev.ResetDoneReceived("world", m.ResetDone(epoch=1, attempt=1, episode=0)))
    fault = m.Fault(epoch=1, attempt=1, phase="close", message="too late")
    run.feed(ev.FaultReceived("world", fault))
    assert run.clock.error == "Ctrl-C"
    assert "too late" in run.notices("fault", "world")[0].text
    run.feed(ev.ByeReceived("world"))
    assert run.run().outcome.error == "Ctrl-C"


def seeds_of(run: Simulation) -> list[tuple[int, int, int]]:
    """(episode, seed, episodes since that seed was set), as the world was told."""
    return [(r.episode, r.seed, r.seed_episode) for r in run.seen(m.Reset, "world")]


def says(seeds: dict[tuple[int, int], int]) -> dict[str, object]:
    return {"report": lambda episode, frame: {"seed": seeds.get((episode, frame), -1)}}


def test_clause_16_unless_an_agent_chooses_a_seed_all_episodes_have_the_run_s() -> None:
    run = Simulation(loop(), episodes=3, frames=1, seed=5).join().run()
    assert seeds_of(run) == [(0, 5, 0), (1, 5, 1), (2, 5, 2)]


def test_clause_16_an_agent_chooses_seeds_as_it_ends_episodes() -> None:
    chosen = says({(0, 1): 70, (2, 4): 71, (4, 4): 70}) | ends((0, 1))
    run = Simulation(loop(agent=chosen), episodes=6, frames=4, seed=5).join().run()
    assert seeds_of(run) == [(0, 5, 0), (1, 70, 0), (2, 70, 1), (3, 71, 0), (4, 71, 1), (5, 70, 0)]
    assert run.outcome.error == ""


def test_clause_16_an_agent_chooses_the_seed_of_the_first_episode() -> None:
    run = Simulation(loop(agent={"ready": {"seed": 70}}), episodes=2, frames=1, seed=5).join().run()
    assert seeds_of(run) == [(0, 70, 0), (1, 70, 1)]


def test_clause_16_agents_that_choose_different_seeds_end_the_run_with_both_named() -> None:
    peers = [*loop(agent=says({(0, 2): 70})), agent("other", outputs=("action",), **says({(0, 2): 71}))]
    run = Simulation(peers, episodes=2, frames=2).join().run()
    assert "'agent'" in run.outcome.error
    assert "'other'" in run.outcome.error
    assert "70" in run.outcome.error
    assert "71" in run.outcome.error


@pytest.mark.parametrize("name", ["agent", "world"])
def test_clause_16_a_seed_chosen_out_of_turn_is_told_and_not_used(name: str) -> None:
    run = Simulation(loop(**{name: says({(0, 1): 70})}), episodes=2, frames=3, seed=5).join().run()
    assert seeds_of(run) == [(0, 5, 0), (1, 5, 1)]
    assert "70" in run.notices("discarded", name)[0].text
