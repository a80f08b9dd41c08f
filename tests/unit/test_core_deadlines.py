"""Budgets, deadlines and late answers (contract, clauses 9 to 14)."""

from __future__ import annotations

import re
from typing import Any

import pytest
from core_harness import MS, SECOND, Sim, Simulation, agent, link, loop, recorder, sensors, world

from caviar_broker.core import events as ev
from caviar_broker.core.plan import Timeouts
from caviar_protocol import messages as m
from caviar_protocol.messages import Status


def slow_at(*frames: int, takes: int | None = 70 * MS) -> Any:
    """1 ms a frame, except in some."""
    return lambda episode, frame: takes if frame in frames else MS


def lidar_run(frames: int = 8, *, pause: int = 10 * MS, **lidar: Any) -> Simulation:
    """World, LIDAR with a budget of 20 ms, an agent that takes ``pause`` for what it gets, a recorder."""
    takes = (m.Input(topic="lidar", required=False), m.Input(topic="scene"))
    services = [
        world(),
        sensors(**({"budget": 20 * MS} | lidar)),
        agent(inputs=takes, latency=pause),
        recorder(),
    ]
    return Simulation(services, frames=frames).join().run()


def got(run: Simulation, frame: int, by: str = "agent") -> m.GrantInput:
    return run.inputs(by, frame)["lidar", "lidar"]


# --- clause 9: the policies --------------------------------------------------------------------------


def test_clause_9_under_wait_the_frame_waits_and_the_miss_is_counted_and_blamed() -> None:
    run = lidar_run(latency=slow_at(3), pause=MS)
    assert got(run, 3).status is Status.FRESH
    assert run.time_of("agent", 3) == run.time_of("lidar", 3) + 70 * MS
    assert [(x.frame, x.elapsed_ns) for x in run.seen(ev.Latency, "lidar") if x.missed] == [(3, 70 * MS)]
    (miss,) = run.notices("miss")
    assert miss.frame == 3
    for part in ("sensors 'lidar'", "frame 3", "budget 20 ms", "no heartbeat ever came"):
        assert part in miss.text
    assert "agent waits for lidar of frame 3" in miss.text


def test_clause_9_under_wait_a_stall_ends_the_run_with_blame() -> None:
    heart = {"heartbeat": (SECOND, False), "phase": "tracing"}
    services = loop(channel={"latency": slow_at(2, takes=None)} | heart)
    run = Simulation(services, timeouts=Timeouts(stall=30 * SECOND)).join().run()
    assert run.outcome.culprit == "channel"
    for part in ("channel 'channel'", "frame 2", "budget 100 ms", "phase 'tracing'", "progress 0"):
        assert part in run.outcome.error
    assert "link waits for channel of frame 2" in run.outcome.error
    assert "last heartbeat" in run.outcome.error
    assert run.now == run.time_of("channel", 2) + 30 * SECOND


def test_clause_9_progress_is_no_stall() -> None:
    heart = {"heartbeat": (SECOND, True)}
    services = loop(channel={"latency": slow_at(2, takes=100 * SECOND)} | heart)
    run = Simulation(services, timeouts=Timeouts(stall=30 * SECOND)).join().run()
    assert run.outcome.error == ""


def test_clause_14_compilation_has_its_declared_grace() -> None:
    heart = {"heartbeat": (SECOND, False), "grace": 200 * SECOND}
    services = loop(channel={"latency": slow_at(2, takes=100 * SECOND)} | heart)
    run = Simulation(services, timeouts=Timeouts(stall=30 * SECOND)).join().run()
    assert run.outcome.error == ""


def test_clause_9_under_hold_consumers_get_the_newest_earlier_product_at_the_deadline() -> None:
    run = lidar_run(latency=slow_at(3, takes=25 * MS), policy="hold", pause=MS)
    held = got(run, 3)
    assert (held.status, held.frame, held.t_ns, held.age) == (Status.HELD, 2, 200 * MS, 1)
    assert held.cause == "lidar missed frame 3 (hold, budget 20.0 ms)"
    assert run.time_of("agent", 3) == run.time_of("lidar", 3) + 20 * MS
    assert [x.elapsed_ns for x in run.seen(ev.Latency, "lidar") if x.missed] == [25 * MS], "as it was"


def test_clause_9_under_hold_with_nothing_to_hold_it_is_absent() -> None:
    run = lidar_run(latency=slow_at(0, takes=25 * MS), policy="hold")
    assert got(run, 0).status is Status.ABSENT
    assert got(run, 0).cause == "lidar missed frame 0 (hold, budget 20.0 ms)"


def test_clause_9_under_drop_it_is_absent() -> None:
    run = lidar_run(latency=slow_at(3, takes=25 * MS), policy="drop")
    assert (got(run, 2).status, got(run, 3).status) == (Status.FRESH, Status.ABSENT)


def test_clause_9_under_abort_the_run_ends_with_blame() -> None:
    run = lidar_run(latency=slow_at(3), policy="abort")
    assert run.outcome.culprit == "lidar"
    assert "overran its budget (policy abort) in frame 3" in run.outcome.error
    assert run.time_sent(m.Shutdown) == run.time_of("lidar", 3) + 20 * MS
    assert [x.frame for x in run.seen(ev.Latency, "lidar") if x.missed] == [3]


def test_an_answer_at_the_very_deadline_is_in_time() -> None:
    for policy in ("wait", "hold", "drop", "abort"):
        run = lidar_run(latency=20 * MS, policy=policy)
        assert not any(x.missed for x in run.seen(ev.Latency, "lidar"))
        assert not run.notices("miss")
        assert run.outcome.error == ""


@pytest.mark.parametrize(
    ("policy", "status"),
    [("hold", Status.HELD), ("drop", Status.ABSENT), ("wait", Status.FRESH), ("abort", None)],
)
def test_clause_11_an_answer_after_its_deadline_is_late_though_the_shell_looked_at_no_deadline_since(
    policy: str, status: Status | None
) -> None:
    slow = sensors(latency=slow_at(3, takes=None), budget=20 * MS, policy=policy)
    takes = (m.Input(topic="lidar", required=False), m.Input(topic="scene"))
    run = Simulation([world(), slow, agent(inputs=takes), recorder()]).join()
    run.run(lambda run: len(run.grants("lidar")) == 4)
    run.now = run.time_of("lidar", 3) + 20 * MS + 1
    run.answer("lidar", run.grants("lidar")[3])
    run.run()
    late = [x for x in run.seen(ev.Latency, "lidar") if x.frame == 3]
    assert [(x.elapsed_ns, x.missed) for x in late] == [(20 * MS + 1, True)]
    if status is None:
        assert "overran its budget (policy abort) in frame 3" in run.outcome.error
    else:
        assert got(run, 3).status is status
        assert run.outcome.error == ""


def test_clause_13_an_overrun_that_no_deadline_caught_is_counted_and_told() -> None:
    run = Simulation(loop(channel={"latency": slow_at(1, takes=None)})).join()
    run.run(lambda run: len(run.grants("channel")) == 2)
    run.now += 150 * MS
    run.answer("channel", run.grants("channel")[1])
    assert [x.missed for x in run.seen(ev.Latency, "channel")] == [False, True]
    assert "answered before the frame went on" in run.notices("miss", "channel")[0].text


@pytest.mark.parametrize("caught", [True, False], ids=["deadline", "answer"])
@pytest.mark.parametrize("policy", ["wait", "hold"])
def test_clause_13_only_under_wait_the_first_frame_of_a_run_is_no_miss(policy: str, caught: bool) -> None:
    """Caught by its deadline, or answered before that was looked at; where others go on it is a miss."""
    slow = None if caught else slow_at(0, takes=None)
    services = loop(channel={"latency": slow or slow_at(0, takes=250 * MS), "policy": policy})
    run = Simulation(services, frames=1, episodes=2).join()
    if not caught:
        run.run(lambda run: bool(run.grants("channel")))
        run.now += 250 * MS
        run.answer("channel", run.grants("channel")[0])
    run.run(lambda run: len(run.seen(ev.Latency, "channel")) == (2 if caught else 1))
    missed = [(x.episode, x.missed) for x in run.seen(ev.Latency, "channel")]
    assert missed == [(0, policy == "hold"), (1, True)][: len(missed)]
    assert len(run.notices("miss", "channel")) == sum(was for _, was in missed)


def test_clause_6_the_budget_counts_from_the_grant_not_from_when_inputs_were_there() -> None:
    # The LIDAR needs 15 of its 20 ms; the scene of the next frame is there long before it can start.
    run = lidar_run(latency=15 * MS, policy="hold")
    assert not run.notices("miss")
    assert all(got(run, k).status is Status.FRESH for k in range(8))


def test_a_fault_under_hold_holds_and_blames() -> None:
    run = lidar_run(policy="hold", faults={(0, 3): "lens cap"})
    assert (got(run, 3).status, got(run, 3).frame) == (Status.HELD, 2)
    assert got(run, 3).cause == "lidar failed in frame 3: step: lens cap"
    assert [n.text for n in run.notices("fault")] == ["step: lens cap"]


@pytest.mark.parametrize("policy", ["wait", "abort"])
def test_a_fault_under_wait_and_abort_ends_the_run_with_the_words_of_the_service(policy: str) -> None:
    run = lidar_run(policy=policy, faults={(0, 3): "lens cap"})
    assert run.outcome.culprit == "lidar"
    assert run.outcome.error == "sensors 'lidar' failed in frame 3, step: lens cap"


# --- clause 10: consequences -------------------------------------------------------------------------


def test_clause_10_a_consumer_without_a_required_input_is_not_granted_and_the_blame_stays() -> None:
    takes = (m.Input(topic="lidar"),)
    link_ = link(inputs=(m.Input(topic="action"),), policy="hold")
    lidar = sensors(policy="drop", budget=20 * MS, latency=slow_at(3, takes=25 * MS))
    run = Simulation([world(), lidar, agent(inputs=takes), link_, recorder()], frames=6, record=("link",))
    run.join().run()
    assert [g.frame for g in run.grants("agent")] == [0, 1, 2, 4, 5, 6]
    assert [g.frame for g in run.grants("link")] == [0, 1, 2, 4, 5]
    cause = "lidar missed frame 3 (drop, budget 20.0 ms)"
    for key in (("action", "agent"), ("link", "link")):
        entry = run.inputs("recorder", 3)[key]
        assert (entry.status, entry.cause) == (Status.ABSENT, cause), "by consequence, under hold too"
    assert not any(x.missed for name in ("agent", "link") for x in run.seen(ev.Latency, name))
    assert {(n.service, n.text) for n in run.notices("skipped")} == {("agent", cause), ("link", cause)}


def test_clause_10_an_optional_input_that_is_absent_skips_nobody() -> None:
    run = lidar_run(latency=slow_at(3, takes=25 * MS), policy="drop")
    assert [g.frame for g in run.grants("agent")] == [*range(8), 8]


def test_clause_10_a_required_lag_1_input_does_not_skip_the_first_frame() -> None:
    takes = (m.Input(topic="scene"), m.Input(topic="link", lag=1))
    run = Simulation(loop(agent={"inputs": takes})).join().run()
    assert [g.frame for g in run.grants("agent")] == [0, 1, 2, 3, 4, 5]


# --- clauses 11 and 12: late products ----------------------------------------------------------------


def test_clause_11_a_late_product_never_goes_back_into_its_frame() -> None:
    run = lidar_run(latency=slow_at(3, takes=25 * MS), policy="hold")
    entries = [e for e in run.seen(ev.Journal) if (e.service, e.frame) == ("lidar", 3)]
    assert [e.outcome for e in entries] == ["overdue", "late"]
    assert got(run, 3, by="recorder").status is Status.HELD
    assert "answered after 25.0 ms" in run.notices("late", "lidar")[0].text


def test_clause_11_a_late_product_is_recorded_as_late_once_under_its_true_frame() -> None:
    run = lidar_run(latency=slow_at(3, takes=25 * MS), policy="drop")
    late = [(g.frame, i) for g in run.grants("recorder") for i in g.inputs if i.status is Status.LATE]
    assert [(i.topic, i.source, i.frame) for _, i in late] == [("lidar", "lidar", 3)]
    assert late[0][0] >= 3
    assert late[0][1].age == late[0][0] - 3


def test_clause_11_a_late_product_is_held_later_under_its_true_frame() -> None:
    # Frame 3 comes 50 ms late; by then frames 4 and 5 have gone on without it, and 7 fails.
    run = lidar_run(latency=slow_at(3), policy="hold", faults={(0, 4): "x", (0, 5): "x", (0, 6): "x"})
    held = {k: got(run, k).frame for k in range(3, 7) if got(run, k).status is Status.HELD}
    assert held[3] == 2
    assert held[6] == 3


def test_clause_11_nobody_who_is_late_gets_a_new_grant() -> None:
    run = lidar_run(frames=12, latency=slow_at(3), policy="hold")
    start = run.time_of("lidar", 3)
    later = [g.frame for g in run.grants("lidar") if g.frame > 3]
    assert run.time_of("lidar", later[0]) >= start + 70 * MS
    assert later[0] > 4, "frames went on meanwhile"
    skipped = [n for n in run.notices("skipped", "lidar") if n.frame < later[0]]
    assert "still busy with frame 3" in skipped[0].text
    missed = [x.frame for x in run.seen(ev.Latency, "lidar") if x.missed]
    assert sorted(missed) == [3, *(n.frame for n in skipped)], "each frame that missed counts once"


def test_clause_14_a_frame_that_is_skipped_for_a_busy_service_tells_its_last_heartbeat() -> None:
    heart = {"heartbeat": (8 * MS, False), "phase": "tracing"}
    run = lidar_run(frames=12, latency=slow_at(3), policy="hold", **heart)
    skipped = [n for n in run.notices("skipped", "lidar") if "still busy with frame 3" in n.text]
    assert skipped
    for notice in skipped:
        age = re.search(r"busy with frame 3; last heartbeat (\S+) ms ago: phase 'tracing', ", notice.text)
        assert age is not None, notice.text
        assert 0 <= float(age[1]) <= 8
    assert not [n.text for n in run.notices("miss", "lidar") if "still busy" in n.text]


def test_clause_11_previous_frame_tells_the_gap() -> None:
    run = lidar_run(frames=12, latency=slow_at(3), policy="hold")
    gap = next(g for g in run.grants("lidar") if g.frame > 3)
    assert gap.previous_frame == 3, "the late frame was completed, the skipped ones were not"


def test_clause_11_a_late_product_after_the_last_grant_of_the_recorder_is_told() -> None:
    lidar = sensors(policy="drop", budget=20 * MS, latency=slow_at(4, takes=60 * MS))
    takes = (m.Input(topic="lidar", required=False),)
    run = Simulation([world(), lidar, agent(inputs=takes), recorder()], frames=5, episodes=2).join().run()
    first = [n for n in run.notices("discarded", "lidar") if n.episode == 0]
    assert [(n.frame, n.text) for n in first] == [
        (4, "lidar came after the recorder's last grant; not recorded")
    ]


def test_clause_12_a_held_product_is_never_older_than_one_that_was_there() -> None:
    run = lidar_run(frames=12, latency=slow_at(2, 7, takes=25 * MS), policy="hold")
    ages = [(k, got(run, k).frame) for k in range(12) if got(run, k).status is Status.HELD]
    assert ages == sorted(ages)
    assert [frame for _, frame in ages] == sorted(frame for _, frame in ages)


def test_clause_18_a_late_product_is_journaled_before_anybody_may_hold_it() -> None:
    lidar = sensors(policy="hold", budget=20 * MS, latency=slow_at(1, takes=30 * MS), faults={(0, 2): "x"})
    takes = (m.Input(topic="lidar", required=False),)
    run = (
        Simulation([world(), lidar, agent(inputs=takes, latency=5 * MS)], frames=6, journal_after=9 * MS)
        .join()
        .run()
    )
    assert got(run, 2).frame == 1
    late = next(t for t, a in run.log if isinstance(a, ev.Journal) and a.outcome == "late")
    assert run.time_of("agent", 2) >= late + 9 * MS


def test_the_deadline_of_a_frame_runs_though_the_only_source_is_late() -> None:
    # Nothing else could release the frame under realtime pace.
    alone = Sim(
        "alone", "agent", outputs=("action",), policy="hold", budget=20 * MS, latency=slow_at(1, takes=None)
    )
    run = Simulation([alone, recorder()], realtime=True, record=("action",)).join().run()
    assert run.outcome.error == ""
    assert [f.frame for f in run.seen(ev.FrameFinished)] == [0, 1, 2, 3, 4]


def test_nothing_is_kept_of_what_came_late() -> None:
    tardy = {"policy": "hold", "latency": lambda e, k: 45 * MS if k % 5 == 2 else MS}
    run = lidar_run(frames=60, **tardy)  # `validate` asserts that tasks are released
    assert len(run.notices("late")) == 12


def test_an_agent_that_is_late_does_not_stop_the_run() -> None:
    services = loop(agent={"policy": "hold", "budget": 10 * MS, "latency": slow_at(1, 5, takes=35 * MS)})
    run = Simulation(services, frames=8).join().run()
    assert run.outcome.error == ""
    assert len(run.seen(ev.FrameFinished)) == 8
    assert run.notices("late", "agent")
