"""The time of an episode: when a frame may begin, when a budget is up, and what follows from that.

A frame begins when the user's pause and real time let it (`PauseGate`, `Pacer`). From its grant on a service
has its budget (`Deadlines`).
"""

from __future__ import annotations

from caviar_broker.core.decisions import DecisionTable, Participant, Task
from caviar_broker.core.events import Action, Latency, Notice, Overdue
from caviar_broker.core.plan import RunPlan, milliseconds
from caviar_broker.core.transitions import TaskEvent, TaskState

# On the path of every frame: a member that is looked up in its class costs four times as much.
_GRANTED, _PENDING = TaskState.GRANTED, TaskState.PENDING


class PauseGate:
    """Lets frames begin, or holds them back until the user wants the next ones.

    A frame begins when a service first asks for it. Frames that have begun are finished by all services,
    so no service is waited for, and nothing can stall, in a run that is paused.
    """

    def __init__(self) -> None:
        self.closed = False
        """Whether the run is paused."""
        self.steps = 0
        """Frames that may still begin although the run is paused."""
        self.begun = -1
        """The last frame of the episode that has begun, while the run is paused."""
        self._held_since: int | None = None

    def pause(self, begun: int) -> None:
        """Let no frame after ``begun`` begin."""
        if not self.closed:
            self.closed, self.steps, self.begun, self._held_since = True, 0, begun, None

    def resume(self) -> None:
        """Let all frames begin."""
        self.closed, self.steps = False, 0

    def step(self, frames: int) -> None:
        """Let so many frames more begin; of a run that is not paused none is held back."""
        if self.closed:
            self.steps += frames

    def next_episode(self) -> None:
        """Count frames from 0 again."""
        self.begun = -1

    def admits(self, frame: int, now: int) -> bool:
        """Whether a frame may begin, or has begun, at the time ``now`` [ns]."""
        if self.closed and frame > self.begun:
            if not self.steps:
                self._held_since = now if self._held_since is None else self._held_since
                return False
            self.steps -= 1
            self.begun = frame
        return True

    def held_ns(self, now: int) -> int:
        """For how long frames were held back that may begin now [ns]; counted once."""
        since, self._held_since = self._held_since, None
        return 0 if since is None else now - since


class Pacer:
    """Releases the frames of one episode in real time (contract, clause 8).

    Frame 0 is released when a service first asks for it. A later one is due as long after the one
    before as simulated time says, divided by the run's speed; when no service is ready for it by then, all
    frames after it slip by as much. A timer that fires late delays its own frame, not those after it. As
    fast as possible, every frame is released at once.

    Args:
        plan: The run, with its pace and the simulated time of its frames.
    """

    def __init__(self, plan: RunPlan) -> None:
        self._plan = plan
        self._released_frame = -1
        # When the frame released last should have been, slips included [ns].
        self._reference = 0
        self._awaited = False
        self.lag_ns = 0
        """Sum of all slips [ns]."""

    def release(self, frame: int, now: int) -> int | None:
        """Ask for a frame: by how much it slips [ns], or None while its time has not come."""
        # A frame is released by the first service that asks; the others follow without a look at the clock.
        if not self._plan.realtime or frame <= self._released_frame:
            return 0
        due = now if self._released_frame < 0 else self._due()
        if now < due:
            self._awaited = True
            return None
        # A frame that was asked for in vain is released late by the timer alone, which is no slip of the run.
        slip = 0 if self._awaited else now - due
        self._released_frame, self._reference, self._awaited = frame, due + slip, False
        self.lag_ns += slip
        return slip

    def is_notable(self, slip: int) -> bool:
        """Whether a slip [ns] is worth a notice of its own: more than a tenth of a period, in real time."""
        return slip > self._real_ns(self._plan.sampling_period_ns) // 10

    def next_instant(self) -> int | None:
        """When the frame that was asked for in vain will be due [ns]; None if there is none."""
        return self._due() if self._awaited else None

    def withdraw(self) -> None:
        """Forget that a frame was asked for in vain."""
        self._awaited = False

    def shift(self, held_ns: int) -> None:
        """Move all later frames by the time of a pause [ns], which is no slip."""
        self._reference += held_ns

    def _due(self) -> int:
        frame = self._released_frame
        return self._reference + self._real_ns(self._plan.t_ns(frame + 1) - self._plan.t_ns(frame))

    def _real_ns(self, simulated_ns: int) -> int:
        return simulated_ns if self._plan.speed == 1.0 else round(simulated_ns / self._plan.speed)


class Deadlines:
    """Pace and budgets of one episode (clauses 8, 9 and 13).

    What has to be said about tasks whose budget is up collects in `overruns`, `skips` and `aborted`.

    Args:
        plan: The run.
        episode: Number of the episode.
        table: The services' tasks; a deadline that a policy lets pass is decided there.
        gate: Whether the run is paused.
        actions: Where latencies and notices go.
    """

    def __init__(
        self, plan: RunPlan, episode: int, table: DecisionTable, gate: PauseGate, actions: list[Action]
    ) -> None:
        self.overruns: list[tuple[Task, str]] = []
        """Granted tasks whose budget is up, and what is done about it; to be blamed (clause 14)."""
        self.skips: list[tuple[Task, str]] = []
        """Tasks that were never granted and whose budget is up, and why; to be blamed likewise."""
        self.aborted: Task | None = None
        """A task of a service with policy abort that missed its deadline."""
        self._plan, self._episode, self._table, self._gate = plan, episode, table, gate
        self._actions = actions
        self._pacer = Pacer(plan)
        table.lag_ns = lambda: self._pacer.lag_ns

    # --- pace --------------------------------------------------------------------------------------

    def release(self, task: Task, now: int) -> bool:
        """Whether the run is not paused, and real time has come to the task's frame (clause 8)."""
        if task.frame >= self._table.frames:
            return True
        if not self._gate.admits(task.frame, now):
            self._pacer.withdraw()
            return False
        self._pacer.shift(self._gate.held_ns(now))
        slip = self._pacer.release(task.frame, now)
        if slip is None:
            return False
        if self._pacer.is_notable(slip):
            behind = milliseconds(self._pacer.lag_ns)
            text = f"{milliseconds(slip)} behind real time, {behind} since the start"
            self._actions.append(Notice("lag", task.service, text, self._episode, task.frame))
        return True

    def next_release(self) -> int | None:
        """When the frame that a service asked for in vain will be due [ns]; None if there is none."""
        return self._pacer.next_instant()

    # --- budgets -----------------------------------------------------------------------------------

    def measure(self, task: Task, now: int) -> None:
        """Report how long a task took that was answered, or never will be."""
        # No reader gets the latencies of a run in one process that writes no files.
        if self._plan.ephemeral:
            return
        elapsed = now - task.started_at
        plan = self._table.participants[task.service].plan
        missed = task.overran or elapsed > plan.budget_ns
        missed = missed and not self._plan.is_warm_up(plan, self._episode, task.frame)
        if missed and not task.overran:
            self.overruns.append((task, "answered before the frame went on"))
        self._actions.append(Latency(task.service, self._episode, task.frame, elapsed, missed))

    def next(self) -> int | None:
        """The earliest instant at which a budget is up [ns]; None if none runs."""
        # A loop, not `min` over a generator: asked once in `LOOK_NS` for every service.
        instant = None
        for participant in self._table.participants.values():
            due = _budget_end(participant)
            if due is not None and (instant is None or due[0] < instant):
                instant = due[0]
        return instant

    def expire(self, now: int) -> None:
        """Act on budgets that are up (clause 9)."""
        for participant in self._table.participants.values():
            due = _budget_end(participant)
            if due is not None and due[0] <= now:
                self._expire(participant, due[1], due[0], now)

    def expire_before_answer(self, participant: Participant, now: int) -> None:
        """Act on the budget of the task that is answered now, if it is up: that answer is late (clause 11).

        The shell looks at deadlines every few milliseconds; an answer must not gain by coming in between.
        Under ``wait`` there is nothing to decide: `measure` counts the miss.
        """
        task, plan = participant.outstanding[0], participant.plan
        deadline = task.started_at + plan.budget_ns
        if now > deadline and not plan.waits_for_answer and task.state is _GRANTED and not task.overran:
            self._expire(participant, task, deadline, now)

    def _expire(self, participant: Participant, task: Task, deadline: int, now: int) -> None:
        plan, granted = participant.plan, task.state is _GRANTED
        # Noted before the policy is asked: `measure` counts a miss under each of them.
        task.overran = granted
        if self._plan.is_warm_up(plan, self._episode, task.frame):
            return
        self._actions.append(Overdue(task.service, self._episode, task.frame, deadline))
        if plan.ends_run_when_late:
            self.aborted = self.aborted or task
            return
        if plan.waits_for_answer:
            self.overruns.append((task, "the frame waits"))
            return
        # The cause travels with the held or absent product to consumers and into the recording (clause 9).
        cause = (
            f"{task.service} missed frame {task.frame} ({plan.policy}, budget {milliseconds(plan.budget_ns)})"
        )
        task.move(TaskEvent.DEADLINE)
        if granted:
            self.overruns.append((task, f"the frame goes on ({plan.policy})"))
            self._table.decide_without_answer(task, cause, "overdue", now)
            return
        if participant.outstanding:
            cause += f", still busy with frame {participant.outstanding[0].frame}"
        else:
            cause += ", saving its state" if participant.saving else ", not connected"
        elapsed = now - (task.eligible_at or now)
        self._actions.append(Latency(task.service, self._episode, task.frame, elapsed, missed=True))
        self.skips.append((task, cause))
        self._table.decide_without_answer(task, cause, "skipped", now)


def _budget_end(participant: Participant) -> tuple[int, Task] | None:
    """When the budget of what a service has to do next is up [ns], and the task; None: no budget runs."""
    task, plan = participant.tasks.get(participant.next_frame), participant.plan
    if task is None:
        return None
    if task.state is _GRANTED:
        return None if task.overran else (task.started_at + plan.budget_ns, task)
    if task.state is _PENDING and task.eligible_at is not None:
        waits = plan.waits_for_answer or (plan.ends_run_when_late and participant.saving)
        return None if waits else (task.eligible_at + plan.budget_ns, task)
    return None
