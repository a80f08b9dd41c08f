"""Budgets of an episode: when one is up, and what follows from that."""

from __future__ import annotations

from caviar_broker.core.decisions import DecisionTable
from caviar_broker.core.events import Latency, Overdue
from caviar_broker.core.pace import Pacer
from caviar_broker.core.plan import milliseconds
from caviar_broker.core.run import Run
from caviar_broker.core.tasks import Participant, Task
from caviar_broker.core.transitions import TaskEvent, TaskState

# On the path of every frame: a member that is looked up in its class costs four times as much.
_GRANTED, _PENDING = TaskState.GRANTED, TaskState.PENDING


class Deadlines:
    """Pace and budgets of one episode (clauses 8, 9 and 13).

    Args:
        run: The run.
        table: The services' tasks; a deadline that a policy lets pass is decided there.
        pacer: Releases the frames of the episode.
    """

    def __init__(self, run: Run, table: DecisionTable, pacer: Pacer) -> None:
        self._run, self._table, self._pacer = run, table, pacer
        self._plan, self._episode, self._gate, self._actions = run.plan, run.episode, run.gate, run.actions

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
            self._run.notice("lag", task.service, text, task.frame)
        return True

    def next_release(self) -> int | None:
        """Instant at which the frame is due that a service asked for in vain [ns]; None if there is none."""
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
            self._blame_overrun(task, "answered before the frame went on", now)
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
            member = self._run.members[task.service]
            waiting = self._table.describe_waiting(task.service)
            text = member.blame_task(task, "overran its budget (policy abort)", now, waiting)
            self._run.fail(text, task.service, now)
            return
        if plan.waits_for_answer:
            self._blame_overrun(task, "the frame waits", now)
            return
        # The cause travels with the held or absent product to consumers and into the recording (clause 9).
        cause = (
            f"{task.service} missed frame {task.frame} ({plan.policy}, budget {milliseconds(plan.budget_ns)})"
        )
        task.move(TaskEvent.DEADLINE)
        if granted:
            self._blame_overrun(task, f"the frame goes on ({plan.policy})", now)
            self._table.decide_without_answer(task, cause, "overdue", now)
            return
        if participant.outstanding:
            cause += f", still busy with frame {participant.outstanding[0].frame}"
        else:
            cause += ", saving its state" if participant.saving else ", not connected"
        elapsed = now - (task.eligible_at or now)
        self._actions.append(Latency(task.service, self._episode, task.frame, elapsed, missed=True))
        heard = self._run.members[task.service].last_words(now)
        self._run.notice("skipped", task.service, f"{cause}; {heard}", task.frame)
        self._table.decide_without_answer(task, cause, "skipped", now)

    def _blame_overrun(self, task: Task, remedy: str, now: int) -> None:
        """Report a granted task whose budget is up, and what is done about it (clause 14)."""
        waiting = self._table.describe_waiting(task.service)
        text = self._run.members[task.service].blame_task(task, "overran its budget", now, waiting)
        self._run.notice("miss", task.service, f"{text}; {remedy}", task.frame)


def _budget_end(participant: Participant) -> tuple[int, Task] | None:
    """End of the budget of the next task of a service [ns], and the task; None: no budget runs."""
    task, plan = participant.tasks.get(participant.next_frame), participant.plan
    if task is None:
        return None
    if task.state is _GRANTED:
        return None if task.overran else (task.started_at + plan.budget_ns, task)
    if task.state is _PENDING and task.eligible_at is not None:
        waits = plan.waits_for_answer or (plan.ends_run_when_late and participant.saving)
        return None if waits else (task.eligible_at + plan.budget_ns, task)
    return None
