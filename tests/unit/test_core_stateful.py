"""Random runs in virtual time: whatever happens in whatever order, the invariants hold and the run ends.

Every step is followed by `FrameClock.validate` and held against `core_history.History`, which knows
what was decided before. The machine plays all services and the shell: it answers, fails, is silent,
dies, comes back, lets time pass and deadlines fire late.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from contextlib import closing
from typing import Any

import pytest
from core_harness import MS, SECOND, Sim, Simulation
from hypothesis import HealthCheck, Phase, assume, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from caviar_broker.core import events as ev
from caviar_broker.core.plan import Timeouts
from caviar_broker.core.transitions import RunState
from caviar_broker.journal import CheckpointFiles, JournalFile
from caviar_broker.resume import read_resumption
from caviar_protocol import messages as m

pytestmark = pytest.mark.slow

ANSWERED = m.Prepare | m.Reset | m.Grant | m.Shutdown | m.Checkpoint | m.Restore
BETWEEN = (RunState.RESETTING, RunState.RUNNING)
TOPICS = ("scene", "channel", "lidar", "action", "link")
POLICIES: tuple[m.Policy, ...] = ("wait", "wait", "hold", "hold", "drop", "abort")


@st.composite
def graphs(draw: st.DrawFn, policies: tuple[m.Policy, ...] = POLICIES) -> list[Sim]:
    """One or two worlds, up to three producers, one or two agents, perhaps a sink and a recorder.

    Within a frame inputs are of topics before, with lag 1 of any, its own included.
    """

    def policy() -> dict[str, Any]:
        chosen = draw(st.sampled_from(policies))
        n = draw(st.integers(1, 3)) if chosen == "wait" else 1
        return {"policy": chosen, "max_in_flight": n, "budget": draw(st.integers(1, 30)) * MS}

    def inputs(before: list[str]) -> tuple[m.Input, ...]:
        now = draw(st.lists(st.sampled_from(before), unique=True, max_size=3)) if before else []
        then = draw(st.lists(st.sampled_from(TOPICS), unique=True, max_size=2))
        found = [(topic, 0) for topic in now] + [(topic, 1) for topic in then if topic not in now]
        return tuple(
            m.Input(topic=topic, lag=lag, required=topic in before and draw(st.booleans()))
            for topic, lag in found
        )

    worlds = [Sim(f"world-{i}", "world", outputs=("scene",)) for i in range(draw(st.integers(1, 2)))]
    services, before = list(worlds), ["scene"]
    for i, topic in enumerate(draw(st.lists(st.sampled_from(TOPICS[1:3]), max_size=3))):
        # A source of a topic that takes it would be a cycle.
        sources = [t for t in before if t != topic]
        services.append(Sim(f"sensors-{i}", "sensors", inputs(sources), (topic,), **policy()))
        before = list(dict.fromkeys([*before, topic]))
    for i in range(draw(st.integers(1, 2))):
        services.append(Sim(f"agent-{i}", "agent", inputs(before), ("action",), **policy()))
    if draw(st.booleans()):
        services.append(Sim("link", "link", inputs([*before, "action"]), ("link",), **policy()))
    if draw(st.booleans()):
        everything = (m.Input(topic="*", required=False),)
        services.append(Sim("recorder", "recorder", everything, max_in_flight=draw(st.integers(1, 2))))
    for service in services:
        service.stateful = service.role != "recorder" and draw(st.booleans())
    return draw(st.permutations(services))


def plans() -> st.SearchStrategy[dict[str, Any]]:
    return st.fixed_dictionaries(
        {
            "frames": st.integers(1, 5),
            "episodes": st.integers(1, 2),
            "frames_in_flight": st.integers(1, 4),
            "realtime": st.booleans(),
            "checkpoint_frames": st.integers(0, 3),
            "record": st.lists(st.sampled_from(["scene"]), max_size=1).map(tuple),
            "sampling_period_ns": st.just(20 * MS),
        }
    )


class Puppets(Simulation):
    """A simulation in which nothing happens by itself: services answer when the test says so."""

    def __init__(self, services: list[Sim], **plan: Any) -> None:
        super().__init__(services, **plan)
        self.inbox: dict[str, list[m.Message]] = {name: [] for name in self.services}
        self.to_restore: dict[str, Any] = {}
        self.unwritten: list[int] = []

    def perform(self) -> None:
        seen = len(self.log)
        super().perform()
        self._queue.clear()  # the harness's own journal
        self.unwritten += [a.number for _, a in self.log[seen:] if isinstance(a, ev.Journal)]

    def _deliver(self, name: str, message: m.Message, state: Any = None) -> None:
        if isinstance(message, m.Restore):
            self.to_restore[name] = state
        if name in self.alive and isinstance(message, ANSWERED):
            self.inbox[name].append(message)

    def react(self, name: str, **answer: Any) -> None:
        """A service handles the oldest message that it has not handled."""
        message = self.inbox[name].pop(0)
        ids = {"epoch": 1, "attempt": self.attempt(name)}
        match message:
            case m.Prepare():
                self.feed(ev.ReadyReceived(name, m.Ready(**ids)))
            case m.Reset():
                self.was_reset(name, message, m.ResetDone(**ids, episode=message.episode))
            case m.Checkpoint():
                self.saved(name, message)
            case m.Restore():
                self.restored(name, self.to_restore[name], ids)
            case m.Grant():
                sim, at = self.services[name], (message.episode, message.frame)
                sim.faults = {at: "told to"} if answer.get("fails") else {}
                sim.omits = frozenset({at} if answer.get("omits") else ())
                sim.ends = frozenset({at} if answer.get("ends") else ())
                self.answer(name, message)
            case _:
                self.feed(ev.ByeReceived(name))

    def write(self, count: int) -> None:
        """The journal gets so many entries further."""
        numbers, self.unwritten = self.unwritten[:count], self.unwritten[count:]
        self.journaled(numbers[-1])

    def die(self, name: str) -> None:
        self.inbox[name].clear()
        self.kill(name)

    def pass_time(self, delta: int) -> None:
        """Time passes; deadlines fire when they are up."""
        until = self.now + delta
        while (due := self.clock.next_deadline()) is not None and due <= until:
            self.fire(due)
        self.now = until

    def fire(self, at: int) -> None:
        """One call of `expire`; a deadline that has passed does not stay."""
        self.now = max(self.now, at)
        self.clock.expire(self.now)
        self.perform()
        later = self.clock.next_deadline()
        assert later is None or later > self.now, "a deadline that has passed stays"

    def everybody_answers(self) -> None:
        """From here on all do their work at once, the journal too."""
        while self.clock.state is not RunState.FINISHED:
            ready = [name for name, inbox in self.inbox.items() if inbox]
            if self.unwritten:
                self.write(len(self.unwritten))
            elif ready:
                self.react(ready[0])
            else:
                self.pass_deadline()

    def pass_deadline(self) -> None:
        due = self.clock.next_deadline()
        assert due is not None, f"no service is waited for in {self.clock.state}"
        self.fire(due)


class Runs(RuleBasedStateMachine):
    """Any order and lateness of events."""

    run: Puppets

    @initialize(
        services=graphs(), plan=plans(), rejoin=st.sampled_from([0, 5 * SECOND]), journal=st.booleans()
    )
    def begin(self, services: list[Sim], plan: dict[str, Any], rejoin: int, journal: bool) -> None:
        timeouts = Timeouts(
            connect=2 * SECOND, ready=SECOND, reset=SECOND, stall=SECOND, shutdown=SECOND, rejoin=rejoin
        )
        self.prompt_journal = journal
        self.run = Puppets(services, timeouts=timeouts, **plan)
        for name in self.run.services:
            self.run.hello(name)
        assume(self.run.clock.graph is not None)

    def names(self, condition: Callable[[str], bool]) -> list[str]:
        return [name for name in self.run.services if condition(name)]

    @invariant()
    def the_run_ends_or_waits_for_something(self) -> None:
        run = getattr(self, "run", None)
        if run is None:
            return
        if self.prompt_journal and run.unwritten:
            run.write(len(run.unwritten))
        if run.clock.state is RunState.FINISHED:
            assert run.clock.next_deadline() is None
        else:
            assert run.clock.next_deadline() is not None, "a silent hang"

    @rule(data=st.data(), quirk=st.sampled_from(["", "", "", "", "", "", "omits", "fails", "ends"]))
    @precondition(lambda self: any(self.run.inbox.values()))
    def somebody_answers(self, data: st.DataObject, quirk: str) -> None:
        name = data.draw(st.sampled_from(self.names(lambda n: bool(self.run.inbox[n]))))
        strict = self.run.services[name].policy in ("wait", "abort")
        if quirk == "fails" and strict:
            quirk = "omits"
        self.run.react(name, **({quirk: True} if quirk else {}))

    @rule(data=st.data(), times=st.integers(2, 12))
    @precondition(lambda self: any(self.run.inbox.values()))
    def many_answer(self, data: st.DataObject, times: int) -> None:
        for _ in range(times):
            waiting = self.names(lambda n: bool(self.run.inbox[n]))
            if waiting:
                self.run.react(data.draw(st.sampled_from(waiting)))
            if self.prompt_journal and self.run.unwritten:
                self.run.write(len(self.run.unwritten))

    @rule(count=st.integers(1, 20))
    @precondition(lambda self: self.run.unwritten)
    def the_journal_gets_on(self, count: int) -> None:
        self.run.write(count)

    @rule(delta=st.sampled_from([1, MS, 7 * MS, 20 * MS, 40 * MS, 200 * MS]))
    def time_passes(self, delta: int) -> None:
        self.run.pass_time(delta)

    @rule(delta=st.sampled_from([MS, 25 * MS, 100 * MS]))
    def the_shell_is_late(self, delta: int) -> None:
        self.run.now += delta

    @rule()
    @precondition(lambda self: self.run.clock.next_deadline() is not None)
    def the_next_deadline_comes(self) -> None:
        due = self.run.clock.next_deadline()
        assert due is not None
        if due - self.run.now < 300 * MS:  # leave the long ones to the end
            self.run.fire(due)

    @rule(data=st.data())
    @precondition(lambda self: self.run.plan.timeouts.rejoin and self.run.clock.state is RunState.RUNNING)
    def somebody_dies(self, data: st.DataObject) -> None:
        alive = self.names(lambda n: n in self.run.alive)
        if alive:
            self.run.die(data.draw(st.sampled_from(alive)))

    @rule(data=st.data())
    @precondition(lambda self: len(self.run.alive) < len(self.run.services))
    def somebody_comes_back(self, data: st.DataObject) -> None:
        self.run.hello(data.draw(st.sampled_from(self.names(lambda n: n not in self.run.alive))))

    @rule(data=st.data(), progress=st.integers(0, 3), grace=st.sampled_from([0, 0, 50 * MS, 2 * SECOND]))
    def a_heart_beats(self, data: st.DataObject, progress: int, grace: int) -> None:
        name = data.draw(st.sampled_from(sorted(self.run.services)))
        self.run.feed(ev.Progressed(name, progress, "step", grace))

    @rule(
        data=st.data(),
        episode=st.integers(0, 2),
        frame=st.integers(0, 6),
        attempt=st.integers(1, 3),
        fault=st.booleans(),
    )
    def something_stale_comes(
        self, data: st.DataObject, episode: int, frame: int, attempt: int, fault: bool
    ) -> None:
        name = data.draw(st.sampled_from(sorted(self.run.services)))
        owed = [g for g in self.run.inbox[name] if isinstance(g, m.Grant)][:1]
        ids = {"epoch": 1, "attempt": attempt, "episode": episode, "frame": frame}
        if any((g.attempt, g.episode, g.frame) == (attempt, episode, frame) for g in owed):
            return
        if fault:
            self.run.feed(ev.FaultReceived(name, m.Fault(**ids, phase="step", message="stale")))
        else:
            self.run.feed(ev.DoneReceived(name, m.Done(**ids)))

    @rule()
    @precondition(lambda self: len(self.run.log) > 200)
    def the_user_wants_to_stop(self) -> None:
        self.run.feed(ev.StopRequested("Ctrl-C"))

    def teardown(self) -> None:
        """Whether now all work or all are silent, the run comes to its end."""
        run = getattr(self, "run", None)
        if run is None:
            return
        if run.now % 2:
            run.everybody_answers()
        for _ in range(1000):
            if run.clock.state is RunState.FINISHED:
                break
            run.pass_deadline()
        finished = [a for _, a in run.log if isinstance(a, ev.Finished)]
        assert len(finished) == 1
        assert finished[0].error or len(run.seen(ev.EpisodeFinished)) == run.plan.episodes


# Shrinking takes minutes here and the printed steps tell enough, so that it is left out.
PHASES = (Phase.explicit, Phase.reuse, Phase.generate)


def play(examples: int) -> None:
    """So many random runs."""
    run_state_machine_as_test(
        Runs,
        settings=settings(
            max_examples=examples,
            stateful_step_count=60,
            deadline=None,
            phases=PHASES,
            suppress_health_check=list(HealthCheck),
        ),
    )


@pytest.mark.parametrize("examples", [100, pytest.param(2000, marks=pytest.mark.exhaustive)])
def test_any_order_and_lateness_of_events_keeps_the_invariants(examples: int) -> None:
    play(examples)


@given(
    services=graphs(policies=("wait",)),
    plan=plans(),
    timing=st.randoms(use_true_random=False),
    ends=st.sets(st.tuples(st.integers(0, 1), st.integers(0, 4)), max_size=2),
    kills=st.lists(st.tuples(st.integers(0, 300), st.integers(0, 9)), max_size=3),
)
@settings(max_examples=80, deadline=None, phases=PHASES, suppress_health_check=list(HealthCheck))
def test_clauses_18_and_20_under_wait_equal_inputs_give_equal_digests_kills_or_not(
    services: list[Sim],
    plan: dict[str, Any],
    timing: random.Random,
    ends: set[tuple[int, int]],
    kills: list[tuple[int, int]],
) -> None:
    for sim in services:
        sim.ends = frozenset(ends) if sim.role == "agent" else frozenset()
        sim.stateful &= plan["checkpoint_frames"] > 0  # who never saves its state is promised nothing
    quick = Simulation(services, **plan).join().run()
    assume(quick.clock.graph is not None)  # two sources may want each other's topic: a cycle
    assert quick.outcome.error == ""

    for sim in services:
        times: dict[tuple[int, int], int] = {}
        sim.latency = lambda e, k, times=times: times.setdefault((e, k), timing.randrange(40 * MS))
        sim.ready_after, sim.reset_after = timing.randrange(9 * MS), timing.randrange(9 * MS)
    other = plan | {"frames_in_flight": timing.randint(1, 5), "realtime": timing.random() < 0.5}
    timeouts = Timeouts(rejoin=20 * SECOND)
    slow = Simulation(services, timeouts=timeouts, journal_after=timing.randrange(20 * MS), **other)
    for sim in services:
        slow.join(sim.name, at=timing.randrange(20 * MS))

    def kill(index: int) -> None:
        name = services[index % len(services)].name
        member = slow.clock.member(name)
        if member is not None and member.present and member.ready is not None and slow.clock.state in BETWEEN:
            slow.kill(name)
            slow.after(timing.randrange(100 * MS), lambda: slow.hello(name))

    for at, index in kills:
        slow.after(at * MS, lambda index=index: kill(index))
    slow.run()
    assert slow.outcome.error == ""
    assert slow.outcome.digest == quick.outcome.digest


@given(
    services=graphs(policies=("wait",)),
    plan=plans().map(lambda plan: plan | {"checkpoint_frames": max(1, plan["checkpoint_frames"])}),
    timing=st.randoms(use_true_random=False),
    ends=st.sets(st.tuples(st.integers(0, 1), st.integers(0, 4)), max_size=2),
    crashes=st.lists(st.integers(5, 200), min_size=1, max_size=3),
)
@settings(max_examples=60, deadline=None, phases=PHASES, suppress_health_check=list(HealthCheck))
def test_clauses_18_and_20_under_wait_brokers_that_die_do_not_change_the_digest(
    tmp_path_factory: pytest.TempPathFactory,
    services: list[Sim],
    plan: dict[str, Any],
    timing: random.Random,
    ends: set[tuple[int, int]],
    crashes: list[int],
) -> None:
    for sim in services:
        sim.ends = frozenset(ends) if sim.role == "agent" else frozenset()
        sim.stateful = sim.role != "recorder"
    quick = Simulation(services, **plan).join().run()
    assume(quick.clock.graph is not None)
    folder = tmp_path_factory.mktemp("run")
    path, files = folder / "journal.msgpack", CheckpointFiles(folder)
    for epoch, crash in enumerate([*crashes, None], 1):
        for sim in services:
            times: dict[tuple[int, int], int] = {}
            sim.latency = lambda e, k, times=times: times.setdefault((e, k), timing.randrange(20 * MS))
        before = read_resumption(path, files).resumption if epoch > 1 else None
        with closing(JournalFile(path, epoch, files)) as journal:
            settings = {"journal": journal, "resumption": before, "epoch": epoch, "strict": False}
            run = Simulation(services, journal_after=timing.randrange(9 * MS), **settings, **plan).join()
            until = run.now + (timing.randrange(crash + 1) if crash is not None else 40) * MS
            run.run_to(until)
            snapshot = run.clock.snapshot()
            if snapshot is not None:  # nothing of what may be needed goes
                journal.compact(snapshot)
            run.run() if crash is None else run.run_to(max(until, SECOND + crash * MS))
    assert run.outcome.error == ""
    assert run.outcome.digest == quick.outcome.digest
    assert run.notices("differs") == []
