"""Grants and reports within an episode (contract, clauses 1, 6, 7, 8, 18 and 20)."""

from __future__ import annotations

from typing import Any

import pytest
from core_harness import MS, SECOND, Simulation, agent, channel, link, loop, recorder, sensors, world

from caviar_broker.core import events as ev
from caviar_broker.core.plan import Timeouts
from caviar_broker.core.tasks import Ledger
from caviar_broker.core.transitions import RunState
from caviar_protocol import messages as m
from caviar_protocol.digest import RunDigest
from caviar_protocol.messages import Status


def running(run: Simulation) -> bool:
    return run.clock.state is RunState.RUNNING


def granted(service: str, frame: int) -> Any:
    return lambda run: any(g.frame == frame for g in run.grants(service))


def done(service: str, frame: int, *, episode: int = 0, attempt: int = 1, epoch: int = 1) -> ev.DoneReceived:
    return ev.DoneReceived(service, m.Done(epoch=epoch, attempt=attempt, episode=episode, frame=frame))


# --- clause 1: identity ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "answer",
    [
        done("link", 3),
        done("world", 3),
        done("world", 0, episode=1),
        done("world", 0, attempt=2),
        done("world", 0, epoch=2),
    ],
    ids=["nothing owed", "another frame", "another episode", "another attempt", "another epoch"],
)
def test_clause_1_an_answer_that_matches_nothing_outstanding_is_stale_and_not_used(
    answer: ev.DoneReceived,
) -> None:
    run = Simulation(loop(world={"latency": 5 * MS})).join().run(running)
    run.feed(answer)
    stale = run.seen(m.Stale, answer.service)
    assert [(s.of, s.episode, s.frame) for s in stale] == [
        ("DONE", 0, 0 if answer.service == "world" else -1)
    ]
    assert run.notices("stale")
    run.run()
    assert run.outcome.digest == Simulation(loop()).join().run().outcome.digest


def test_clause_1_an_answer_given_twice_counts_once() -> None:
    run = Simulation(loop(world={"latency": 5 * MS})).join().run(granted("channel", 0))
    run.feed(done("world", 0))
    assert [s.of for s in run.seen(m.Stale, "world")] == ["DONE"]
    assert run.run().outcome.error == ""


def test_clause_1_a_stale_fault_does_no_harm() -> None:
    run = Simulation(loop(world={"latency": 5 * MS})).join().run(running)
    fault = m.Fault(epoch=1, attempt=1, episode=0, frame=4, phase="step", message="no")
    run.feed(ev.FaultReceived("world", fault))
    assert [s.of for s in run.seen(m.Stale, "world")] == ["FAULT"]
    assert run.run().outcome.error == ""


# --- clause 6: grant and report ------------------------------------------------------------------------


def test_clause_6_a_grant_tells_frame_time_budget_and_what_was_completed_last() -> None:
    run = Simulation(loop(), sampling_period_ns=7 * MS).join().run()
    found = [(g.frame, g.previous_frame, g.t_ns, g.budget_ns) for g in run.grants("world")]
    assert found == [(k, k - 1, 7 * MS * k, 100 * MS) for k in range(5)]


def test_clause_6_inputs_carry_provenance() -> None:
    run = Simulation(loop()).join().run()
    scene = run.inputs("channel", 3)["scene", "world"]
    assert (scene.status, scene.frame, scene.t_ns, scene.age) == (Status.FRESH, 3, 300 * MS, 0)
    back = run.inputs("agent", 3)["link", "link"]
    assert (back.status, back.frame, back.age) == (Status.FRESH, 2, 1)
    assert run.inputs("agent", 0)["link", "link"].cause == "there is no earlier frame"


def test_clause_6_decisions_of_a_replay_are_imposed() -> None:
    imposed = {("channel", 0, 2): {"rung": "siso-rt"}}
    run = Simulation(loop(), imposed=imposed).join().run()
    assert [g.decisions for g in run.grants("channel")] == [{}, {}, {"rung": "siso-rt"}, {}, {}]


def test_reports_of_a_frame_reach_the_recorder_with_that_frame() -> None:
    def report(episode: int, frame: int) -> dict[str, Any]:
        return {"counts": {"non-finite-paths": frame}, "decisions": {"rung": "free-space"}}

    run = Simulation(loop(channel={"report": report, "max_in_flight": 2})).join().run()
    for grant in run.grants("recorder"):
        assert [(r.source, r.counts) for r in grant.reports] == [
            ("channel", {"non-finite-paths": grant.frame})
        ]
    assert all(not g.reports for g in run.grants("agent"))


def test_a_topic_that_was_not_declared_ends_the_run_naming_the_service() -> None:
    run = Simulation(loop()).join().run(granted("channel", 0))
    header = m.ProductHeader(topic="chanel", digest="0" * 64)
    answer = m.Done(epoch=1, attempt=1, episode=0, frame=0, products=(header,))
    run.feed(ev.DoneReceived("channel", answer, (None,)))
    run.run()
    assert run.outcome.culprit == "channel"
    assert "'chanel'" in run.outcome.error


def test_a_topic_that_comes_twice_ends_the_run_naming_the_service() -> None:
    run = Simulation(loop()).join().run(granted("channel", 0))
    header = m.ProductHeader(topic="channel", digest="0" * 64)
    answer = m.Done(epoch=1, attempt=1, episode=0, frame=0, products=(header, header))
    run.feed(ev.DoneReceived("channel", answer, (None, None)))
    assert "twice" in run.run().outcome.error


def test_a_declared_product_that_is_missing_is_absent_and_its_consumer_skipped() -> None:
    run = Simulation(loop(channel={"omits": frozenset({(0, 2)})})).join().run()
    assert [g.frame for g in run.grants("link")] == [0, 1, 3, 4]
    assert run.inputs("recorder", 2)["channel", "channel"].cause == "channel produced no channel in frame 2"
    assert run.inputs("recorder", 2)["link", "link"].cause == "channel produced no channel in frame 2"
    assert run.outcome.error == ""


def test_products_that_nobody_asked_for_are_not_forwarded() -> None:
    camera = sensors("camera")
    camera.outputs = ("camera", "depth")
    wants = agent(inputs=(m.Input(topic="camera"),))
    run = Simulation([world(), camera, wants, recorder()]).join().run()
    assert set(run.inputs("recorder", 0)) == {("camera", "camera"), ("scene", "world")}


# --- clause 7: overlap ---------------------------------------------------------------------------------


def test_clause_7_a_grant_comes_as_soon_as_its_inputs_are_decided() -> None:
    run = Simulation([world(latency=3 * MS), channel(latency=5 * MS), agent(), link()]).join().run()
    assert run.time_of("channel", 0) == run.time_of("world", 0) + 3 * MS
    assert run.time_of("link", 0) == run.time_of("channel", 0) + 5 * MS
    assert run.time_of("agent", 0) == run.time_of("channel", 0), "the agent does not wait for the channel"


def test_clause_7_frames_overlap_as_far_as_the_graph_allows() -> None:
    slow = {"latency": 10 * MS}
    run = Simulation(loop(world=slow, channel=slow, recorder=slow), frames=20).join().run()
    took = run.now - run.time_of("world", 0)
    assert took == pytest.approx(20 * 10 * MS, rel=0.2), "a pipeline: each frame costs the slowest stage"


@pytest.mark.parametrize("overlap", [1, 2, 3, 7])
def test_clause_7_at_most_frames_in_flight_overlap(overlap: int) -> None:
    services = loop(link={"latency": 50 * MS})
    run = Simulation(services, frames=20, frames_in_flight=overlap).join().run(granted("link", 0))
    run.run_to(run.time_of("link", 0) + 40 * MS)
    assert max(g.frame for g in run.grants("world")) == overlap - 1
    assert run.run().outcome.error == ""


def test_clause_7_one_grant_is_outstanding_unless_more_are_planned() -> None:
    run = Simulation(loop(channel={"latency": 20 * MS})).join().run(granted("channel", 0))
    run.run_to(run.time_of("channel", 0) + 19 * MS)
    assert len(run.grants("channel")) == 1


def test_clause_7_grants_queue_up_to_max_in_flight_under_wait() -> None:
    run = Simulation(loop(channel={"latency": 20 * MS, "max_in_flight": 3})).join().run(granted("channel", 0))
    run.run_to(run.time_of("channel", 0) + 19 * MS)
    assert [(g.frame, g.previous_frame) for g in run.grants("channel")] == [(0, -1), (1, 0), (2, 1)]
    assert run.run().outcome.digest == Simulation(loop()).join().run().outcome.digest


def test_clause_7_no_more_grants_queue_than_the_service_says_it_can() -> None:
    services = loop(channel={"latency": 20 * MS, "max_in_flight": 3, "hello": {"max_in_flight": 1}})
    run = Simulation(services).join().run(granted("channel", 0))
    run.run_to(run.time_of("channel", 0) + 19 * MS)
    assert len(run.grants("channel")) == 1


def test_clause_7_a_queued_grant_is_measured_from_when_its_turn_came() -> None:
    run = Simulation(loop(channel={"latency": 20 * MS, "max_in_flight": 3, "budget": 25 * MS})).join().run()
    latencies = run.seen(ev.Latency, "channel")
    assert [x.elapsed_ns for x in latencies] == [20 * MS] * 5
    assert not any(x.missed for x in latencies)


def test_clause_7_a_queued_frame_whose_input_is_absent_is_skipped_in_its_turn() -> None:
    services = loop(world={"omits": frozenset({(0, 1)})}, channel={"latency": 20 * MS, "max_in_flight": 3})
    run = Simulation(services).join().run()
    assert [g.frame for g in run.grants("channel")] == [0, 2, 3, 4]
    assert run.outcome.error == ""


# --- clause 8: realtime pace -----------------------------------------------------------------------------


def test_clause_8_realtime_releases_frames_at_the_sampling_period() -> None:
    run = Simulation(loop(), realtime=True, frames=10).join().run()
    times = [run.time_of("world", k) for k in range(10)]
    assert times == [times[0] + k * 100 * MS for k in range(10)]
    assert [f.lag_ns for f in run.seen(ev.FrameFinished)] == [0] * 10
    assert not run.notices("lag")


@pytest.mark.parametrize(("speed", "period"), [(2.0, 50 * MS), (0.5, 200 * MS), (3.0, 33_333_333)])
def test_clause_8_a_factor_divides_the_time_between_frames(speed: float, period: int) -> None:
    run = Simulation(loop(), realtime=True, speed=speed, frames=10).join().run()
    times = [run.time_of("world", k) for k in range(10)]
    assert times == [times[0] + k * period for k in range(10)]
    assert run.seen(ev.FrameFinished)[-1].lag_ns == 0


def test_clause_8_a_slip_is_counted_in_real_time_at_any_pace() -> None:
    slow = {"latency": lambda e, k: 75 * MS if k == 2 else MS, "budget": SECOND}
    run = Simulation(loop(world=slow), realtime=True, speed=2.0, frames=6).join().run()
    first = run.time_of("world", 0)
    times = [run.time_of("world", k) - first for k in range(6)]
    assert times == [0, 50 * MS, 100 * MS, 175 * MS, 225 * MS, 275 * MS], "slips by 25 ms, skips nothing"
    assert [n.frame for n in run.notices("lag")] == [3]
    assert "25.0 ms behind real time" in run.notices("lag")[0].text
    assert run.seen(ev.FrameFinished)[-1].lag_ns == 25 * MS


def test_clause_8_an_overrun_slips_all_later_frames_and_reports_its_lag() -> None:
    slow = {"latency": lambda e, k: 250 * MS if k == 2 else MS, "budget": SECOND}
    run = Simulation(loop(world=slow), realtime=True, frames=6).join().run()
    first = run.time_of("world", 0)
    times = [run.time_of("world", k) - first for k in range(6)]
    assert times == [0, 100 * MS, 200 * MS, 450 * MS, 550 * MS, 650 * MS], "slips by 150 ms, skips nothing"
    assert [n.frame for n in run.notices("lag")] == [3]
    assert "150.0 ms behind real time" in run.notices("lag")[0].text
    assert run.seen(ev.FrameFinished)[-1].lag_ns == 150 * MS


def test_clause_8_a_timer_that_fires_late_delays_its_own_frame_only() -> None:
    services = loop(
        **{name: {"budget": SECOND} for name in ("world", "channel", "agent", "link", "recorder")}
    )
    run = Simulation(services, realtime=True, frames=5).join().run(granted("world", 1))
    first = run.time_of("world", 0)
    while run.clock.next_deadline() != first + 200 * MS:
        run.step()
    run.now = first + 203 * MS
    run.clock.expire(run.now)
    run.perform()
    run.run()
    assert [run.time_of("world", k) - first for k in (2, 3)] == [203 * MS, 300 * MS]
    assert run.seen(ev.FrameFinished)[-1].lag_ns == 0


def test_clause_8_a_frame_that_one_service_finds_due_is_released_for_all() -> None:
    # The answer of one source is handled after the frame's instant, but before its deadline fires.
    two = [world(budget=SECOND), world("uav", budget=SECOND, latency=lambda e, k: None if k == 0 else MS)]
    run = Simulation([*two, agent(budget=SECOND)], realtime=True).join().run(granted("uav", 0))
    run.run_to(run.now + 99 * MS)
    run.now += 2 * MS
    run.answer("uav", run.grants("uav")[0])
    run.journaled(run.seen(ev.Journal)[-1].number)
    assert run.time_of("world", 1) == run.time_of("uav", 1) == run.now
    assert run.run().outcome.error == ""


def test_clause_8_nobody_waits_for_a_frame_that_an_early_end_cut() -> None:
    services = loop(agent={"ends": frozenset({(0, 0)})}, link={"latency": 300 * MS, "budget": SECOND})
    run = Simulation(services, realtime=True).join().run(lambda run: bool(run.seen(ev.Latency, "agent")))
    run.run_to(run.now + 290 * MS)  # `step` asserts that no deadline stays
    assert run.run().outcome.error == ""
    assert [g.frame for g in run.grants("world")] == [0]


# --- clause 18: journal before grant -----------------------------------------------------------------------


def test_clause_18_the_next_frame_waits_for_the_journal() -> None:
    run = Simulation(loop(), journal_after=30 * MS).join().run()
    for name in ("world", "channel", "agent", "link"):
        assert run.time_of(name, 1) >= run.time_of(name, 0) + 31 * MS
    assert run.time_of("channel", 0) == run.time_of("world", 0) + MS, "within a frame nothing waits for it"


def test_clause_18_lag_1_products_stand_in_the_journal() -> None:
    run = Simulation(loop()).join().run()
    entries = {(e.service, e.frame): e for e in run.seen(ev.Journal)}
    ((header, body),) = [p.payload for p in entries["link", 2].products]
    assert header.startswith(b"link link 0 2 ")
    assert body == b""
    assert entries["world", 2].products == (), "no service takes a scene later"
    assert [d.topic for d in entries["world", 2].decisions] == ["scene"]


def test_clause_18_a_new_episode_waits_for_the_journal_of_the_one_before() -> None:
    run = Simulation(loop(), journal_after=500 * MS, episodes=2, frames=1).join().run()
    last = max(t for t, a in run.log if isinstance(a, ev.Journal) and a.episode == 0)
    assert run.time_of("world", 0, episode=1) == last + 500 * MS


def test_the_ledger_tells_since_when_nothing_was_confirmed() -> None:
    ledger = Ledger()
    assert [ledger.enter(10), ledger.enter(20)] == [1, 2]
    assert ledger.waiting_since == 10
    assert ledger.confirm(1, 30)
    assert ledger.waiting_since == 30, "something was confirmed, something is still waiting"
    assert not ledger.confirm(1, 40)
    assert ledger.confirm(2, 50)
    assert (ledger.written, ledger.waiting_since) == (2, None)


def test_a_journal_that_is_not_written_ends_the_run() -> None:
    run = Simulation(loop(), journal_after=10**6 * SECOND, timeouts=Timeouts(stall=30 * SECOND)).join().run()
    assert "journal was not written for 30 s" in run.outcome.error
    assert run.outcome.culprit == ""


# --- clause 20: the digest ------------------------------------------------------------------------------


def recomputed(run: Simulation) -> str:
    """The digest, from what the recorder was granted alone."""
    chain = RunDigest()
    for grant in run.grants("recorder"):
        fresh = [(i.topic, i.source, i.digest) for i in grant.inputs if i.status is Status.FRESH]
        chain.add_frame(grant.episode, grant.frame, fresh)
    return chain.hexdigest()


def test_clause_20_the_digest_chains_what_the_recorder_was_granted() -> None:
    run = Simulation(loop(), episodes=2).join().run()
    assert run.outcome.digest == recomputed(run) == run.clock.digest.hexdigest()


def test_clause_20_under_wait_the_digest_does_not_depend_on_timing() -> None:
    quick = Simulation(loop(), frames=12).join().run()
    uneven = {"latency": lambda e, k: (k * 37 % 11) * MS}
    services = loop(world=uneven, channel={"latency": 9 * MS, "max_in_flight": 4}, link=uneven)
    slow = Simulation(services, frames=12, journal_after=3 * MS, frames_in_flight=7, realtime=True)
    slow.join("recorder", "link", "agent", "channel", "world").run()
    assert quick.outcome.digest == slow.outcome.digest == recomputed(slow)


@pytest.mark.parametrize("writing", [1, 3, 40])
def test_clause_20_what_the_recorder_writes_after_an_early_end_counts(writing: int) -> None:
    """The agent fails in frame 3, while the recorder is still busy with a frame before that."""
    services = loop(agent={"faults": {(0, 3): "lost its mind"}}, recorder={"latency": writing * MS})
    run = Simulation(services).join().run()
    assert "lost its mind" in run.outcome.error
    assert run.outcome.digest == recomputed(run)


def test_clause_20_another_product_gives_another_digest() -> None:
    run = Simulation(loop(world={"omits": frozenset({(0, 4)})})).join().run()
    assert run.outcome.digest != Simulation(loop()).join().run().outcome.digest
    assert run.outcome.digest == recomputed(run)


def test_the_recorder_of_a_frame_is_granted_when_everybody_has_decided_it() -> None:
    sink = link("sink", outputs=(), latency=40 * MS)
    run = Simulation([world(), channel(), agent(), sink, recorder()]).join().run()
    assert run.time_of("recorder", 0) == run.time_of("sink", 0) + 40 * MS
