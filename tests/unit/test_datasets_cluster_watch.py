"""What a generation tells while it waits, and when it stops waiting."""

from __future__ import annotations

import itertools
from pathlib import Path
from queue import SimpleQueue

import pytest

from caviar_broker.core.plan import briefings, plan_run
from caviar_clients.datasets import cluster_watch
from caviar_clients.datasets.cluster_watch import (
    LOOK_S,
    NO_PROCESS_S,
    NO_WORKER_S,
    REPORTED_S,
    STALLED_S,
    ClusterWatch,
    StepWatch,
)
from caviar_clients.session.watchdog import Watchdog
from caviar_protocol import messages as m
from caviar_protocol.errors import RunError
from caviar_protocol.scenario import load_scenario

ADDRESS = "tcp://10.0.0.1:8786"


class Cluster:
    """A scheduler whose workers a test has, the time, and what the user was told."""

    def __init__(self, scheduler: str = ADDRESS, workers: int = 2) -> None:
        self.now = 1000.0
        self.seen = {f"tcp://10.0.0.2:{port}": 0.0 for port in range(workers)}
        self.stopped = set[str]()
        self.asked = 0
        self.told = list[tuple[float, str]]()
        self.watch = ClusterWatch(scheduler, self.last_seen, self.note, lambda: self.now)
        self.watch.progressed(self.now)

    def last_seen(self) -> dict[str, float]:
        self.asked += 1
        # Its clock is another one.
        self.seen |= dict.fromkeys(self.seen.keys() - self.stopped, self.now - 7e5)
        return dict(self.seen)

    def note(self, text: str) -> None:
        self.told.append((self.now - 1000.0, text))

    def wait(self, seconds: float, mean_s: float = 0.0) -> dict[int, cluster_watch.Stall]:
        """Let time pass, second by second, until an episode is given up."""
        for _ in range(round(seconds)):
            self.now += 1.0
            if found := self.watch.look(self.now, "no episode has ended", [4, 3, 5], mean_s=mean_s):
                return found
        return {}

    def stands(self, episode: int, stands_s: float) -> None:
        about = {"episode": episode, "text": "waiting for agent 'a'", "stands_s": stands_s, "worker": "w"}
        self.watch.tell((0.0, about))


def test_every_wait_is_told_each_half_minute_with_what_is_waited_for() -> None:
    cluster = Cluster()
    cluster.wait(100.0)
    what = "3 episodes are at the workers, episode 3 the first"
    assert cluster.told == [(s, f"no episode has ended for {s:.0f} s: {what}") for s in (30.0, 60.0, 90.0)]
    assert cluster.asked == 100 // LOOK_S
    cluster.watch.progressed(cluster.now)
    cluster.wait(20.0)
    assert len(cluster.told) == 3


def test_a_wait_that_episodes_of_such_length_explain_is_not_told() -> None:
    cluster = Cluster()
    cluster.wait(79.0, mean_s=40.0)
    assert cluster.told == []
    cluster.wait(1.0, mean_s=40.0)
    assert len(cluster.told) == 1


@pytest.mark.parametrize(
    ("scheduler", "limit_s", "said"),
    [
        (
            ADDRESS,
            NO_WORKER_S,
            rf"{ADDRESS} has had no worker for 60 s: start one with dask worker {ADDRESS}",
        ),
        ("", NO_PROCESS_S, "there has been no process that plays for 300 s"),
    ],
)
def test_a_cluster_without_workers_ends_the_command(scheduler: str, limit_s: float, said: str) -> None:
    cluster = Cluster(scheduler)
    cluster.seen.clear()
    cluster.wait(limit_s - 1.0)
    assert [at for at, _ in cluster.told][:1] == [30.0]
    assert "no worker for 30 s" in cluster.told[0][1] or not scheduler
    with pytest.raises(RunError, match=f"{said}.*the same command goes on with what is left"):
        cluster.wait(LOOK_S)


def test_a_worker_that_comes_back_in_time_is_waited_for() -> None:
    cluster = Cluster()
    workers = cluster.seen.copy()
    for _ in range(5):
        cluster.seen.clear()
        cluster.wait(NO_WORKER_S - 10.0)
        cluster.seen |= workers
        cluster.wait(10.0)
    assert cluster.watch.present == set(workers)


def test_workers_that_are_stopped_are_named() -> None:
    cluster = Cluster(workers=3)
    cluster.wait(20.0)
    cluster.stopped = {"tcp://10.0.0.2:0", "tcp://10.0.0.2:1"}
    cluster.wait(70.0)
    said = [text.partition("; ")[2] for _, text in cluster.told]
    assert said[0] == ""
    assert said[2] == (
        "2 of 3 workers give no sign of life: tcp://10.0.0.2:0 for 70 s, tcp://10.0.0.2:1 for 70 s"
    )


def test_a_step_that_takes_long_is_told_and_in_the_end_its_episode_is_given_up() -> None:
    cluster = Cluster()
    cluster.stands(9, 2.0 * STALLED_S)  # of another command at the same scheduler
    for stands_s in range(5, round(STALLED_S), 5):
        assert cluster.wait(5.0) == {}
        cluster.stands(3, float(stands_s))
        cluster.watch.progressed(cluster.now - 40.0 if stands_s < 300 else cluster.now)  # of others
    assert cluster.told
    assert all("; episode 3: waiting for agent 'a'" in text for _, text in cluster.told)
    found = cluster.wait(LOOK_S)
    assert (list(found), found[3].worker, found[3].stands_s) == ([3], "w", STALLED_S)
    assert cluster.wait(10.0) == {}


def test_a_step_that_has_ended_is_not_told_any_more() -> None:
    cluster = Cluster()
    cluster.stands(3, 595.0)
    cluster.now += REPORTED_S
    assert cluster.wait(60.0) == {}
    assert not any("waiting for agent" in text for _, text in cluster.told)


def test_what_a_worker_of_another_version_tells_is_left_aside() -> None:
    cluster = Cluster()
    cluster.watch.tell((0.0, {"episode": "3"}))
    cluster.watch.tell((0.0, None))
    assert cluster.wait(40.0) == {}


def test_outside_of_a_worker_waits_are_warnings(caplog: pytest.LogCaptureFixture) -> None:
    StepWatch(3).waits("waiting for agent 'a'")
    assert [(record.name, record.message) for record in caplog.records] == [
        ("caviar.session", "waiting for agent 'a'")
    ]


def test_a_worker_tells_since_when_the_last_frame_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    told = list[object]()

    class Worker:
        address = "tcp://10.0.0.2:1"

        def log_event(self, topic: str, message: object) -> None:
            told.append((topic, message))

    times = itertools.count(100.0, 10.0)
    monkeypatch.setattr(cluster_watch.time, "monotonic", lambda: next(times))
    monkeypatch.setattr(cluster_watch, "_worker_of_task", Worker)
    watch = StepWatch(3)
    watch.frame_finished(None)
    watch.waits("waiting")
    about = {"episode": 3, "text": "waiting", "stands_s": 10.0, "worker": Worker.address}
    assert told == [(cluster_watch.TOPIC, about)]


def test_what_a_service_does_that_prepares_is_found_in_what_a_worker_tells() -> None:
    scenario, told, phase = load_scenario("smoke"), SimpleQueue[str](), "launching, part 3 of 40, 9 s left"
    plan, cluster = plan_run(scenario, "run", briefings(scenario, Path())), Cluster()

    def phase_while(task: m.Message) -> str:
        work = ("channel", task)
        with Watchdog(plan, {}, lambda: work, told.put) as watchdog:
            watchdog.progress("channel", phase)
            watchdog.stop()
            about = {"episode": 3, "text": told.get(timeout=30), "stands_s": 12.0, "worker": "w"}
        cluster.watch.tell((0.0, about))
        return cluster.watch.phase(cluster.now)

    assert phase_while(m.Prepare(epoch=1, attempt=1)) == phase
    assert cluster.watch.phase(cluster.now + 2 * REPORTED_S) == ""
    assert phase_while(m.Grant(epoch=1, attempt=1, episode=0, frame=3, t_ns=0)) == ""
