"""The time of one episode: when a frame may begin, when a budget is up, and what happens then."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from caviar_broker.core.decisions import DecisionBook
from caviar_broker.core.events import Action, Latency, Notice, Overdue
from caviar_broker.core.gate import Gate
from caviar_broker.core.pace import Pacer
from caviar_broker.core.plan import RunPlan, ServicePlan
from caviar_broker.core.tasks import Task, milliseconds
from caviar_broker.core.transitions import TaskEvent, TaskState
from caviar_broker.core.turns import Turns

# On the path of every frame: a member that is looked up in its class costs four times as much.
_GRANTED = TaskState.GRANTED


class Deadlines:
    """Pace and budgets of one episode (clauses 8, 9 and 13).

    What has to be said about tasks whose budget is up collects in `overruns`, `skips` and
    `aborted`.

    Parameters
    ----------
    plan, episode
        The run, and the number of the episode.
    book, turns
        What is decided, and who is woken when something is.
    gate
        Whether the run is paused.
    outstanding
        Tasks of each service for which DONE or FAULT is due, oldest first; as it changes.
    saving
        Services that save their state; as it changes.
    actions
        Where latencies and notices go.
    """

    def __init__(
        self,
        plan: RunPlan,
        episode: int,
        book: DecisionBook,
        turns: Turns,
        gate: Gate,
        outstanding: Mapping[str, Sequence[Task]],
        saving: Collection[str],
        actions: list[Action],
    ) -> None:
        self.overruns: list[tuple[Task, str]] = []
        """Granted tasks whose budget is up, and what is done about it; to be blamed (clause 14)."""
        self.skips: list[tuple[Task, str]] = []
        """Tasks that were never granted and whose budget is up, and why; to be blamed likewise."""
        self.aborted: Task | None = None
        """A task of a service with policy abort that missed its deadline."""
        self._plan, self._episode, self._book, self._turns, self._gate = plan, episode, book, turns, gate
        self._plans: Mapping[str, ServicePlan] = {p.name: p for p in plan.services}
        self._outstanding, self._saving, self._actions = outstanding, saving, actions
        self._pacer = Pacer(plan)
        book.lag_ns = lambda: self._pacer.lag_ns

    def released(self, task: Task, now: int) -> bool:
        """Whether the run is not paused, and real time has come to this frame (clause 8)."""
        if task.frame >= self._book.frames:
            return True
        if not self._gate.admits(task.frame, now):
            self._pacer.withdraw()
            return False
        self._pacer.shift(self._gate.held_ns(now))
        slip = self._pacer.release(task.frame, now)
        if slip is None:
            return False
        self._turns.wake(self._turns.waiting_for_pace)  # whoever asks first releases the frame for all
        if self._pacer.tells(slip):
            behind = milliseconds(self._pacer.lag_ns)
            self._notice("lag", task, f"{milliseconds(slip)} behind real time, {behind} since the start")
        return True

    def measure(self, task: Task, now: int) -> None:
        """A task was answered, or never will be: tell how long it took."""
        if self._plan.ephemeral:
            return
        elapsed = now - task.started_at
        missed = task.overran or elapsed > self._plans[task.service].budget_ns
        if missed and not task.overran:
            self.overruns.append((task, "answered before the frame went on"))
        self._actions.append(Latency(task.service, self._episode, task.frame, elapsed, missed))

    def expire(self, now: int) -> None:
        """Act on deadlines that have passed (clause 9)."""
        for name in self._outstanding:
            due = self._due(name)
            if due is not None and due[0] <= now:
                self._expired(due[1], due[0], now)
        instant = self._next_release()
        if instant is not None and instant <= now:
            self._turns.wake(self._turns.waiting_for_pace)

    def expire_before_answer(self, task: Task, now: int) -> None:
        """Act on the budget of a task whose answer comes now, if it is up: that answer is late (clause 11).

        The shell looks at deadlines every few milliseconds; an answer must not gain by coming in between.
        Under ``wait`` there is nothing to decide: `measure` counts the miss.
        """
        plan = self._plans[task.service]
        deadline = task.started_at + plan.budget_ns
        if now > deadline and plan.policy != "wait" and task.state is _GRANTED and not task.overran:
            self._expired(task, deadline, now)

    def next(self) -> int | None:
        """The earliest instant at which `expire` has something to do [ns]."""
        instant = self._next_release()
        for name in self._outstanding:
            due = self._due(name)
            if due is not None and (instant is None or due[0] < instant):
                instant = due[0]
        return instant

    def _next_release(self) -> int | None:
        """When the frame that somebody waits for will be due; None if nobody does."""
        return self._pacer.next_instant() if self._turns.waiting_for_pace else None

    def _due(self, name: str) -> tuple[int, Task] | None:
        """When the budget of what a service has to do next is up."""
        task = self._book.find(name, self._book.next[name])
        if task is None:
            return None
        budget = self._plans[name].budget_ns
        if task.state is _GRANTED:
            return None if task.overran else (task.started_at + budget, task)
        if task.state is TaskState.PENDING and task.eligible_at is not None:
            policy = self._plans[name].policy
            waits = policy == "wait" or (policy == "abort" and name in self._saving)
            return None if waits else (task.eligible_at + budget, task)
        return None

    def _expired(self, task: Task, deadline: int, now: int) -> None:
        self._actions.append(Overdue(task.service, self._episode, task.frame, deadline))
        plan, granted = self._plans[task.service], task.state is _GRANTED
        budget = milliseconds(plan.budget_ns)
        task.overran = granted
        if plan.policy == "abort":
            self.aborted = self.aborted or task
        elif plan.policy == "wait":
            self.overruns.append((task, "the frame waits"))
        elif granted:
            cause = f"{task.service} missed frame {task.frame} ({plan.policy}, budget {budget})"
            task.move(TaskEvent.DEADLINE)
            self.overruns.append((task, f"the frame goes on ({plan.policy})"))
            self._book.substitute(task, cause, "overdue", now)
            self._turns.decided(task.service)
        else:
            owed = self._outstanding[task.service]
            why = f"still busy with frame {owed[0].frame}" if owed else "not connected"
            if not owed and task.service in self._saving:
                why = "saving its state"
            cause = f"{task.service} missed frame {task.frame} ({plan.policy}, budget {budget}), {why}"
            elapsed = now - (task.eligible_at or now)
            self._actions.append(Latency(task.service, self._episode, task.frame, elapsed, missed=True))
            task.move(TaskEvent.DEADLINE)
            self.skips.append((task, cause))
            self._book.substitute(task, cause, "skipped", now)
            self._turns.decided(task.service)

    def _notice(self, kind: str, task: Task, text: str) -> None:
        self._actions.append(Notice(kind, task.service, text, self._episode, task.frame))
