"""The time of one episode: when a frame may begin, when a budget is up, and what happens then."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

from caviar_broker.core.decisions import DecisionTable, Task, milliseconds
from caviar_broker.core.events import Action, Latency, Notice, Overdue
from caviar_broker.core.plan import RunPlan, ServicePlan
from caviar_broker.core.transitions import TaskEvent, TaskState

if TYPE_CHECKING:
    from caviar_broker.core.dispatch import Turns


class PauseGate:
    """Lets frames begin, or holds them back until the user wants the next ones.

    A frame begins when somebody first asks for it. Frames that have begun are finished by everybody,
    so nobody is waited for, and nothing can stall, in a run that is paused.
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
        """Let no frame behind ``begun`` begin."""
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
        """Frames count from 0 again."""
        self.begun = -1

    def admits(self, frame: int, now: int) -> bool:
        """Whether a frame may begin, or has begun."""
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
    """Releases the frames of one episode (contract, clause 8).

    Frame 0 is released when somebody first asks for it. A later one is due as long after the one
    before as simulated time says, divided by the run's speed; when nobody is ready for it by then, all
    frames behind it slip by as much. A timer that fires late delays its own frame, not those behind it. As
    fast as possible, every frame is released at once.
    """

    def __init__(self, plan: RunPlan) -> None:
        self._plan = plan
        self._released_frame = -1
        self._reference = 0
        """When the frame released last should have been, slips included [ns]."""
        self._awaited = False
        self.lag_ns = 0
        """Sum of all slips [ns]."""

    def release(self, frame: int, now: int) -> int | None:
        """Ask for a frame: by how much it slips [ns], or None while its time has not come."""
        if not self._plan.realtime or frame <= self._released_frame:
            return 0
        due = now if self._released_frame < 0 else self._due()
        if now < due:
            self._awaited = True
            return None
        slip = 0 if self._awaited else now - due
        self._released_frame, self._reference, self._awaited = frame, due + slip, False
        self.lag_ns += slip
        return slip

    def tells(self, slip: int) -> bool:
        """Whether a slip is worth a notice of its own: a tenth of a period, in real time."""
        return slip > self._real_ns(self._plan.sampling_period_ns) // 10

    def next_instant(self) -> int | None:
        """When the frame that was asked for in vain will be due [ns]; None if there is none."""
        return self._due() if self._awaited else None

    def withdraw(self) -> None:
        """The frame that was asked for in vain is not wanted for now."""
        self._awaited = False

    def shift(self, held_ns: int) -> None:
        """The run was paused for so long [ns]: that is no slip."""
        self._reference += held_ns

    def _due(self) -> int:
        frame = self._released_frame
        return self._reference + self._real_ns(self._plan.t_ns(frame + 1) - self._plan.t_ns(frame))

    def _real_ns(self, simulated_ns: int) -> int:
        return simulated_ns if self._plan.speed == 1.0 else round(simulated_ns / self._plan.speed)


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
        book: DecisionTable,
        turns: Turns,
        gate: PauseGate,
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
