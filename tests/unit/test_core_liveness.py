"""Death, return and silence (contract, clauses 14, 15 and 18)."""

from __future__ import annotations

from typing import Any

import pytest
from core_harness import MS, SECOND, Simulation, agent, loop, recorder, sensors, world

from caviar_broker.core import events as ev
from caviar_broker.core.membership import MAX_LOSSES
from caviar_broker.core.plan import Timeouts
from caviar_broker.core.transitions import RunState
from caviar_protocol import messages as m

REJOIN = Timeouts(rejoin=10 * SECOND)


def granted(service: str, frame: int, episode: int = 0) -> Any:
    return lambda run: any((g.episode, g.frame) == (episode, frame) for g in run.grants(service))


def digest(**changes: Any) -> str:
    return Simulation(loop(), **changes).join().run().outcome.digest


def test_clause_14_a_death_ends_the_run_with_blame() -> None:
    heart = {"heartbeat": (2 * MS, True), "latency": 20 * MS, "phase": "tracing"}
    run = Simulation(loop(channel=heart)).join().run(granted("channel", 2))
    run.run_to(run.now + 5 * MS)
    run.kill("channel", "process 17 was killed by SIGKILL")
    run.run()
    assert run.outcome.culprit == "channel"
    for part in ("'channel'", "SIGKILL", "frame 2", "5 ms since its grant", "phase 'tracing'", "link waits"):
        assert part in run.outcome.error
    assert run.notices("lost", "channel")


@pytest.mark.parametrize(
    ("state", "doing"),
    [
        (RunState.JOINING, "being awaited"),
        (RunState.PREPARING, "waiting for the others"),
        (RunState.RESETTING, "resetting"),
    ],
)
def test_clause_14_a_death_outside_frames_says_what_the_service_was_doing(
    state: RunState, doing: str
) -> None:
    services = loop(world={"ready_after": 20 * MS, "reset_after": 20 * MS}, agent={"reset_after": 20 * MS})
    run = Simulation(services)
    if state is not RunState.JOINING:
        run.join().run(lambda run: run.clock.state is state)
    run.kill("agent", "exit status 2")
    run.run()
    assert run.outcome.culprit == "agent"
    assert doing in run.outcome.error
    assert "exit status 2" in run.outcome.error


def test_the_first_blame_counts() -> None:
    run = Simulation(loop(world={"says_bye": False})).join().run(granted("channel", 1))
    run.kill("channel", "exit status 1")
    run.kill("world", "SIGTERM")
    assert run.run().outcome.culprit == "channel"


def test_a_service_that_leaves_on_its_own_account_ends_the_run() -> None:
    run = Simulation(loop()).join().run(granted("channel", 1))
    run.feed(ev.ByeReceived("agent", "bored"))
    assert run.run().outcome.culprit == "agent"
    assert "it left: bored" in run.outcome.error


def test_what_breaks_the_protocol_ends_the_run_naming_who_sent_it() -> None:
    run = Simulation(loop()).join().run(granted("channel", 1))
    run.feed(ev.Violated("channel", "sent what is not in the protocol: no map"))
    assert run.run().outcome.error == "channel 'channel' sent what is not in the protocol: no map"


@pytest.mark.parametrize("name", ["world", "channel", "agent", "link", "recorder"])
@pytest.mark.parametrize("overlap", [1, 4])
def test_clause_18_a_service_that_rejoins_gets_the_grant_it_owes_and_the_digest_is_the_same(
    name: str, overlap: int
) -> None:
    services = loop(**{name: {"latency": 20 * MS}})
    run = Simulation(services, frames=8, frames_in_flight=overlap, timeouts=REJOIN).join()
    run.run(granted(name, 3))
    run.run_to(run.now + 10 * MS)
    run.kill(name)
    run.after(SECOND, lambda: run.hello(name))
    run.run()
    assert run.outcome.error == ""
    assert run.outcome.digest == digest(frames=8)
    again = [g for g in run.grants(name) if g.frame == 3]
    assert [(g.attempt, g.previous_frame) for g in again] == [(1, 2), (2, -1)]
    assert again[0].inputs == again[1].inputs
    assert again[0].reports == again[1].reports
    assert next(g.attempt for g in run.grants(name) if g.frame > 3) == 2
    assert next(g.previous_frame for g in run.grants(name) if g.frame == 4) == 3


def test_clause_18_a_service_that_owed_nothing_steps_the_whole_gap_after_its_return() -> None:
    services = loop(link={"latency": lambda e, k: 500 * MS if k == 3 else MS})
    run = Simulation(services, frames=8, frames_in_flight=1, timeouts=REJOIN).join().run(granted("link", 3))
    run.kill("world")
    run.after(SECOND, lambda: run.hello("world"))
    run.run()
    assert [(g.frame, g.previous_frame) for g in run.grants("world")][3:6] == [(3, 2), (4, -1), (5, 4)]
    assert run.outcome.digest == digest(frames=8)


def test_clause_18_all_queued_grants_are_sent_again_in_order() -> None:
    services = loop(channel={"latency": 20 * MS, "max_in_flight": 3})
    run = Simulation(services, frames=8, timeouts=REJOIN).join().run(granted("channel", 4))
    owed = len(run.history.owed["channel"]) if run.history else 0
    assert owed > 1
    run.kill("channel")
    run.hello("channel")
    run.run()
    again = [(g.frame, g.previous_frame) for g in run.grants("channel") if g.attempt == 2][:owed]
    first = again[0][0]
    assert again == [(first + i, -1 if i == 0 else first + i - 1) for i in range(owed)]
    assert run.outcome.digest == digest(frames=8)


def test_clause_1_an_answer_of_the_incarnation_that_died_is_not_used() -> None:
    run = Simulation(loop(channel={"latency": 20 * MS}), timeouts=REJOIN).join().run(granted("channel", 1))
    run.kill("channel")
    old = m.Done(epoch=1, attempt=1, episode=0, frame=1)
    run.feed(ev.DoneReceived("channel", old))
    run.hello("channel")
    run.feed(ev.DoneReceived("channel", old))
    assert len(run.notices("stale", "channel")) == 2
    assert len(run.seen(m.Stale, "channel")) == 1, "who is gone is not answered"
    run.run()
    assert run.outcome.digest == digest()


def test_what_a_former_incarnation_told_does_not_count_for_the_next() -> None:
    heart = {"heartbeat": (SECOND, False), "grace": 1000 * SECOND, "phase": "compiling"}
    run = Simulation(loop(channel={"latency": 20 * MS} | heart), timeouts=REJOIN).join()
    run.run(granted("channel", 1))
    run.kill("channel")
    run.services["channel"].heartbeat = None
    run.services["channel"].ready_after = None
    run.hello("channel")
    run.run()
    assert run.now < 1000 * SECOND
    assert "no heartbeat ever came" in run.outcome.error


def test_the_time_to_come_back_is_limited() -> None:
    run = Simulation(loop(), timeouts=REJOIN).join().run(granted("channel", 1))
    run.kill("channel", "exit status 1")
    died = run.now
    run.run()
    assert run.now == died + 10 * SECOND
    assert run.outcome.error == (
        "channel 'channel' died and did not come back within 10 s (timeouts.rejoin_s): exit status 1"
    )


def test_a_service_that_dies_again_and_again_is_given_up() -> None:
    run = Simulation(loop(channel={"latency": 20 * MS}), timeouts=REJOIN).join().run(granted("channel", 1))
    for _ in range(MAX_LOSSES - 1):
        run.kill("channel")
        assert run.clock.error == ""
        run.hello("channel")
        attempt = run.attempt("channel")
        run.run(lambda run, attempt=attempt: run.grants("channel")[-1].attempt == attempt)
    run.kill("channel")
    assert run.run().outcome.culprit == "channel"


def test_a_service_that_gets_somewhere_may_die_more_often() -> None:
    run = Simulation(loop(channel={"latency": 20 * MS}), frames=9, timeouts=REJOIN).join()
    for frame in range(1, 2 * MAX_LOSSES):
        run.run(granted("channel", frame))
        run.kill("channel")
        run.hello("channel")
    assert run.run().outcome.error == ""


def test_after_a_return_the_time_counts_from_the_grant_that_was_sent_again() -> None:
    run = Simulation(loop(channel={"latency": 20 * MS}), timeouts=REJOIN).join().run(granted("channel", 1))
    run.kill("channel")
    run.after(SECOND, lambda: run.hello("channel"))
    run.run()
    (latency,) = [x for x in run.seen(ev.Latency, "channel") if x.frame == 1]
    assert (latency.elapsed_ns, latency.missed) == (20 * MS, True), "the frame did miss its budget"


def test_a_service_that_never_was_ready_is_not_waited_for() -> None:
    run = Simulation(loop(channel={"ready_after": None}), timeouts=REJOIN).join()
    run.run(lambda run: bool(run.seen(m.Prepare, "channel")))
    run.kill("channel")
    assert run.run().outcome.culprit == "channel"
    assert run.now < SECOND + 10 * SECOND


def test_a_service_that_comes_back_with_another_declaration_is_refused() -> None:
    run = Simulation(loop(), timeouts=REJOIN).join().run(granted("channel", 1))
    run.kill("channel")
    run.hello("channel", outputs=("channel", "lidar"))
    assert [t.refusal.code for t in run.seen(ev.TurnAway)] == ["declaration"]
    assert "other inputs or outputs" in run.run().outcome.error


def test_a_world_that_comes_back_with_other_scenery_is_refused() -> None:
    mesh = m.Asset(name="x.ply", digest="a" * 64, size=1)
    run = Simulation(loop(world={"assets": (mesh,)}), timeouts=REJOIN).join().run(granted("channel", 1))
    run.kill("world")
    run.services["world"].assets = (m.Asset(name="x.ply", digest="b" * 64, size=1),)
    run.hello("world")
    run.run()
    assert [r.code for r in run.seen(m.Refuse, "world")] == ["geometry"]
    assert "other scenery" in run.outcome.error


@pytest.mark.parametrize("gap", [0, 30 * MS, 300 * MS])
def test_a_service_may_die_between_two_episodes(gap: int) -> None:
    services = loop(link={"latency": 50 * MS}, world={"reset_after": 40 * MS})
    run = Simulation(services, episodes=2, frames=3, timeouts=REJOIN).join()
    run.run(granted("link", 2))  # the world is through with its episode
    run.kill("world")
    run.after(gap, lambda: run.hello("world"))
    run.run()
    assert run.outcome.error == ""
    assert run.outcome.digest == digest(episodes=2, frames=3)


def test_a_service_may_die_while_it_is_reset_and_the_episode_waits_for_it() -> None:
    run = Simulation(loop(world={"reset_after": 50 * MS}), timeouts=REJOIN).join()
    run.run(lambda run: run.clock.state is RunState.RESETTING)
    run.kill("world")
    run.after(SECOND, lambda: run.hello("world"))
    assert run.run().outcome.digest == digest()


def test_world_and_channel_may_die_together() -> None:
    services = loop(world={"latency": 9 * MS}, channel={"latency": 9 * MS})
    run = Simulation(services, timeouts=REJOIN).join().run(granted("channel", 2))
    run.kill("world")
    run.kill("channel")
    run.after(SECOND, lambda: run.hello("channel"))
    run.after(2 * SECOND, lambda: run.hello("world"))
    assert run.run().outcome.digest == digest()


def test_under_hold_frames_go_on_without_a_service_that_died() -> None:
    lidar = sensors(policy="hold", budget=20 * MS, latency=5 * MS)
    takes = (m.Input(topic="lidar", required=False),)
    services = [world(), lidar, agent(inputs=takes, latency=9 * MS), recorder()]
    run = Simulation(services, frames=40, timeouts=REJOIN).join().run(granted("lidar", 3))
    run.kill("lidar")
    run.after(200 * MS, lambda: run.hello("lidar"))
    run.run()
    assert run.outcome.error == ""
    assert "still busy with frame 3" in run.notices("skipped", "lidar")[0].text
    back = [g for g in run.grants("lidar") if g.attempt == 2]
    assert (back[0].frame, back[0].previous_frame) == (3, -1), "what it owes comes first, late or not"
    assert run.notices("late", "lidar")


def test_who_dies_while_the_run_stops_is_not_waited_for() -> None:
    run = (
        Simulation(loop(link={"says_bye": False}))
        .join()
        .run(lambda run: run.clock.state is RunState.STOPPING)
    )
    run.kill("link", "exit status 0")
    assert run.run().outcome.error == ""
    assert not run.notices("lost")


def test_nothing_happens_after_the_end() -> None:
    run = Simulation(loop()).join().run()
    told = len(run.log)
    for event in (
        ev.Lost("world", "exit status 0"),
        ev.ByeReceived("world"),
        ev.Journaled(10**6),
        ev.StopRequested("Ctrl-C"),
        ev.Violated("world", "x"),
        ev.Progressed("world", 1),
        ev.ReadyReceived("world", m.Ready(epoch=1, attempt=1)),
    ):
        run.feed(event)
    run.clock.expire(run.now + 10**15)
    run.perform()
    assert len(run.log) == told
    assert run.clock.next_deadline() is None


# --- services that the user starts ------------------------------------------------------------------

REMOTE = {"remote": True, "rejoin": 10 * SECOND}


def test_only_the_remote_service_of_a_run_may_come_back_where_the_run_says_nothing() -> None:
    run = Simulation(loop(agent=REMOTE), frames=8).join().run(granted("agent", 3))
    run.kill("agent")
    run.after(SECOND, lambda: run.hello("agent"))
    run.run(granted("link", 5))
    assert [n.text for n in run.notices("away", "agent")] == [
        "agent 'agent' is away; the run waits for it for at most 10 s (timeouts.rejoin_s)"
    ]
    assert [n.text for n in run.notices("back", "agent")] == ["agent 'agent' came back after 1 s"]
    run.kill("channel")
    assert run.run().outcome.culprit == "channel"
    assert not run.notices("away", "channel")


@pytest.mark.parametrize(
    ("remote", "local", "rejoin", "told"),
    [
        (True, True, 0, 10 * SECOND),
        (True, False, 0, 10 * SECOND),
        (False, False, SECOND, SECOND),
        (False, False, 0, 0),
        (False, True, SECOND, 0),
    ],
)
def test_welcome_says_for_how_long_a_service_may_come_back_by_itself(
    remote: bool, local: bool, rejoin: int, told: int
) -> None:
    """A local one is started again with its broker, and must not keep its successor out."""
    run = Simulation(loop(agent=REMOTE if remote else {}), timeouts=Timeouts(rejoin=rejoin))
    run.feed(ev.Joined(m.Hello(version=m.PROTOCOL_VERSION, name="agent", role="agent"), local))
    assert run.seen(m.Welcome, "agent")[0].rejoin_ns == told


def test_a_run_is_the_same_after_a_remote_service_came_back() -> None:
    run = Simulation(loop(agent={**REMOTE, "latency": 20 * MS}), frames=8).join().run(granted("agent", 3))
    run.kill("agent")
    run.after(SECOND, lambda: run.hello("agent"))
    assert run.run().outcome.digest == digest(frames=8)


def test_a_remote_service_that_stays_away_is_blamed_after_its_own_time() -> None:
    run = Simulation(loop(agent=REMOTE), timeouts=Timeouts(rejoin=SECOND)).join().run(granted("agent", 1))
    lost = run.now
    run.kill("agent", "its connection is gone")
    run.run()
    assert "agent 'agent' died and did not come back within 10 s (timeouts.rejoin_s)" in run.outcome.error
    assert run.log[-1][0] - lost >= 10 * SECOND


@pytest.mark.parametrize("state", [RunState.JOINING, RunState.PREPARING, RunState.RESETTING])
def test_a_remote_service_may_be_started_again_before_the_first_frame_too(state: RunState) -> None:
    services = loop(world={"ready_after": 20 * MS, "reset_after": 20 * MS}, agent=REMOTE)
    run = Simulation(services, frames=8)
    if state is RunState.JOINING:
        run.join("agent").step()
    else:
        run.join().run(lambda run: run.clock.state is state)
    run.kill("agent")
    assert run.notices("away", "agent")
    run.after(SECOND, lambda: run.hello("agent"))
    if state is RunState.JOINING:
        run.join("world", "channel", "link", "recorder")
    assert run.run().outcome.error == ""
    assert run.outcome.digest == digest(frames=8)


def test_a_remote_service_that_nobody_starts_is_named_with_the_remedy() -> None:
    run = Simulation(loop(agent=REMOTE)).join("world", "channel", "link", "recorder").run()
    assert run.outcome.culprit == "agent"
    assert run.outcome.error == (
        "agent 'agent' did not connect within 30 s (timeouts.connect_s); start agent while the run waits"
    )
