"""Pausing a run: frames that have begun are finished, no new one begins, and nothing stalls."""

from __future__ import annotations

import itertools

import pytest
from core_harness import MS, SECOND, Simulation, loop, recorder, world

from caviar_broker.core import events as ev
from caviar_broker.core.plan import Timeouts
from caviar_broker.core.transitions import RunState


def finished_frames(run: Simulation) -> list[tuple[int, int]]:
    return [(a.episode, a.frame) for _, a in run.log if isinstance(a, ev.FrameFinished)]


def digest_of(run: Simulation) -> str:
    return [a.digest for _, a in run.log if isinstance(a, ev.Finished)][-1]


def test_a_paused_run_finishes_what_has_begun_and_then_rests_without_stalling() -> None:
    """Far longer than ``stall_s``; afterwards the run is the one that was never paused."""
    timeouts = Timeouts(stall=SECOND)
    undisturbed = Simulation(loop(), timeouts=timeouts, frames=20)
    undisturbed.join().run()
    run = Simulation(loop(), timeouts=timeouts, frames=20)
    seen: list[tuple[int, int, bool]] = []
    run.after(20 * MS, lambda: run.feed(ev.PauseRequested()))
    for later in (1, 50):
        run.after(later * SECOND, lambda: seen.append(look_at(run)))
    run.after(60 * SECOND, lambda: run.feed(ev.ResumeRequested()))
    run.join().run()
    assert seen[0] == seen[1]
    begun, finished, paused = seen[0]
    assert paused
    assert begun + 1 == finished < 20
    assert finished > 0
    assert digest_of(run) == digest_of(undisturbed)


def look_at(run: Simulation) -> tuple[int, int, bool]:
    view = run.clock.status(run.now)
    assert view.waits == ()
    return view.frame, len(finished_frames(run)), view.paused


def test_steps_let_exactly_so_many_frames_begin_over_the_end_of_an_episode_too() -> None:
    run = Simulation(loop(), frames=3, episodes=2)
    counts: list[int] = []
    run.feed(ev.PauseRequested())
    for second, frames in ((1, 1), (2, 1), (3, 3)):
        run.after(second * SECOND, lambda n=frames: run.feed(ev.StepRequested(n)))
        run.after(second * SECOND + 900 * MS, lambda: counts.append(len(finished_frames(run))))
    run.after(10 * SECOND, lambda: run.feed(ev.ResumeRequested()))
    run.join().run()
    assert counts == [1, 2, 5]
    assert len(finished_frames(run)) == 6


def test_a_pause_is_no_slip_of_real_time() -> None:
    """Frames of 100 ms, paused for a second within frame 3: all after it come a second later, lag 0."""
    run = Simulation([world(), recorder()], frames=8, realtime=True, record=("scene",))
    run.after(330 * MS, lambda: run.feed(ev.PauseRequested()))
    run.after(1330 * MS, lambda: run.feed(ev.ResumeRequested()))
    run.join().run()
    instants = [now for now, a in run.log if isinstance(a, ev.FrameFinished)]
    gaps = [later - earlier for earlier, later in itertools.pairwise(instants)]
    assert sorted(gaps)[:-1] == pytest.approx([100 * MS] * 6, abs=2 * MS)
    assert max(gaps) == pytest.approx(1100 * MS, abs=20 * MS)
    assert [a.lag_ns for _, a in run.log if isinstance(a, ev.FrameFinished)] == [0] * 8


def test_a_stop_ends_a_paused_run() -> None:
    run = Simulation(loop(), frames=5)
    run.feed(ev.PauseRequested())
    run.after(SECOND, lambda: run.feed(ev.StopRequested("enough")))
    run.join().run()
    assert run.clock.state is RunState.FINISHED
    assert finished_frames(run) == []


def test_a_step_or_a_resume_of_a_run_that_is_not_paused_changes_nothing() -> None:
    run = Simulation(loop(), frames=5)
    run.feed(ev.StepRequested(2))
    run.feed(ev.ResumeRequested())
    run.join().run()
    assert len(finished_frames(run)) == 5


def test_the_view_tells_who_is_late_in_which_frame_and_who_lacks_what() -> None:
    slow = {"latency": lambda episode, frame: 500 * MS if frame == 2 else MS}
    run = Simulation(loop(channel=slow), frames=4)
    views = []
    run.after(250 * MS, lambda: views.append(run.clock.status(run.now)))
    run.join().run()
    wait = views[0].waits[0]
    assert (wait.service, wait.role, wait.frame, wait.late) == ("channel", "channel", 2, True)
    assert "link waits for channel of frame 2" in wait.missing
    assert wait.elapsed_s > wait.limit_s == 0.1
    assert "channel 'channel' is late in frame 2" in wait.text
    by_name = {service.name: service for service in views[0].services}
    assert by_name["channel"].grants[0].frame == 2
    assert by_name["channel"].state == "active"


def test_the_view_tells_who_has_not_come_yet() -> None:
    run = Simulation(
        [world(ready_after=None), recorder()], record=("scene",), timeouts=Timeouts(ready=SECOND)
    )
    views = []
    run.after(500 * MS, lambda: views.append(run.clock.status(run.now)))
    run.join().run()
    assert [(wait.service, wait.late) for wait in views[0].waits] == [("world", False)]
    assert "is preparing" in views[0].waits[0].text
