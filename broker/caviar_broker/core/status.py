"""The status of a run: what each service does, and which ones the run waits for (contract, clause 14)."""

from __future__ import annotations

import msgspec

from caviar_broker.core.episodes import Episodes
from caviar_broker.core.plan import duration
from caviar_broker.core.run import Member, Run
from caviar_broker.core.tasks import Task
from caviar_broker.core.transitions import RunState, ServiceState, TaskState

_UNDER_WAY = {
    ServiceState.EXPECTED: "has not connected",
    ServiceState.PREPARING: "is preparing",
    ServiceState.RESETTING: "is resetting",
    ServiceState.LOST: "is away",
}


class GrantStatus(msgspec.Struct, frozen=True, kw_only=True):
    """A grant that a service has not answered."""

    frame: int
    state: str
    """``granted``; ``overdue`` where its frame has gone on without it, ``abandoned`` after the end."""
    elapsed_s: float
    budget_s: float


class ServiceStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One service of the run."""

    name: str
    role: str
    use: str
    policy: str
    state: str
    since_s: float
    """How long it has been in that state [s]."""
    attempt: int
    phase: str
    progress: int
    heartbeat_age_s: float | None
    """Since its last heartbeat [s]; None: none ever came."""
    grants: tuple[GrantStatus, ...]
    """Oldest first."""


class Wait(msgspec.Struct, frozen=True, kw_only=True):
    """One service that the run waits for now."""

    service: str
    role: str
    frame: int
    """-1 where it is not a frame that it works on."""
    phase: str
    progress: int
    heartbeat_age_s: float | None
    elapsed_s: float
    limit_s: float
    """Its budget in a frame, otherwise how long the run waits at most [s]."""
    late: bool
    """Whether that is up."""
    missing: str
    """Which services wait for which input of it; empty if none does."""
    text: str


class RunStatus(msgspec.Struct, frozen=True, kw_only=True):
    """The run as a whole."""

    run: str
    epoch: int
    state: str
    since_s: float
    paused: bool
    steps: int
    """Frames that will still begin although it is paused."""
    episode: int
    episodes: int
    frame: int
    """The last frame of the episode that has begun; -1: none."""
    frames: int
    pace: str
    services: tuple[ServiceStatus, ...]
    waits: tuple[Wait, ...]
    """Who is waited for, longest first."""
    error: str
    culprit: str


def status_of(run: Run, episodes: Episodes, now: int) -> RunStatus:
    """The view of a run at the time ``now`` [ns].

    Args:
        run: The run.
        episodes: Its episode and what services owe.
        now: The time [ns].
    """
    # Looked up in one go between two events, so that no figure contradicts another.
    dispatcher = episodes.dispatcher
    waits = [
        wait for member in run.members.values() if (wait := _wait(run, episodes, member, now)) is not None
    ]
    return RunStatus(
        run=run.plan.run,
        epoch=run.plan.epoch,
        state=run.state.name.lower(),
        since_s=_s(now - run.since),
        paused=run.gate.closed,
        steps=run.gate.steps,
        episode=run.episode,
        episodes=run.plan.episodes,
        frame=dispatcher.begun if dispatcher is not None else -1,
        frames=dispatcher.table.frames if dispatcher is not None else run.plan.frames,
        pace="realtime" if run.plan.realtime else "free",
        services=tuple(_service(member, episodes, now) for member in run.members.values()),
        waits=tuple(sorted(waits, key=lambda wait: (not wait.late, -wait.elapsed_s))),
        error=run.error,
        culprit=run.culprit,
    )


def _service(member: Member, episodes: Episodes, now: int) -> ServiceStatus:
    return ServiceStatus(
        name=member.name,
        role=member.role,
        use=member.plan.use,
        policy=member.plan.policy,
        state=member.state.name.lower(),
        since_s=_s(now - member.since),
        attempt=member.attempt,
        phase=member.phase,
        progress=member.progress,
        heartbeat_age_s=_age(member, now),
        grants=tuple(
            GrantStatus(
                frame=task.frame,
                state=task.state.name.lower(),
                elapsed_s=_s(now - task.started_at),
                budget_s=_s(member.plan.budget_ns),
            )
            for task in _owed(member, episodes)
        ),
    )


def _wait(run: Run, episodes: Episodes, member: Member, now: int) -> Wait | None:
    """Return whether the run waits for a service, and the words for that."""
    if not run.takes_part(member):
        return None
    # First what keeps the run from its end, then services that are not there, then those at work.
    if run.state is RunState.STOPPING:
        if not member.present:
            return None
        limit = run.plan.timeouts.shutdown
        text = f"{member} has not said BYE for {duration(now - run.since)}; {member.last_words(now)}"
        return _of(member, -1, now - run.since, limit, "", text, now)
    # What an early end cut is not waited for, though its answer is due.
    owed = [task for task in _owed(member, episodes) if task.state is not TaskState.ABANDONED]
    dispatcher = episodes.dispatcher
    lacking = dispatcher.table.describe_waiting(member.name) if dispatcher is not None else ""
    # Before what it owes: a service that is lost owes its grants too, and its return comes first.
    if member.state in _UNDER_WAY:
        timeouts = run.plan.timeouts
        limit = {
            ServiceState.EXPECTED: timeouts.connect,
            ServiceState.PREPARING: timeouts.ready,
            ServiceState.RESETTING: timeouts.reset,
            ServiceState.LOST: member.rejoin(timeouts),
        }[member.state]
        text = f"{member} {_UNDER_WAY[member.state]}, for {duration(now - member.since)} now, "
        text += f"at most {duration(limit)}; {member.last_words(now)}"
        text += f"; {member.verdict}" if member.state is ServiceState.LOST else ""
        text += f"; {lacking}" if lacking and owed else ""
        return _of(member, owed[0].frame if owed else -1, now - member.since, limit, lacking, text, now)
    loading = episodes.geometry.awaited_since(member)
    if not owed and loading is not None and member.plan.is_indispensable:
        limit = run.plan.timeouts.stall
        text = f"{member} loads meshes that a world announced, for {duration(now - loading)} now, at most "
        text += f"{duration(limit)}; {member.last_words(now)}{'; ' * bool(lacking)}{lacking}"
        return _of(member, -1, now - loading, limit, lacking, text, now)
    if not owed:
        return None
    task = owed[0]
    late = now - task.started_at > member.plan.budget_ns
    problem = "is late" if late else "is at work"
    text = member.blame_task(task, problem, now, lacking)
    return _of(member, task.frame, now - task.started_at, member.plan.budget_ns, lacking, text, now)


def _of(member: Member, frame: int, elapsed: int, limit: int, lacking: str, text: str, now: int) -> Wait:
    return Wait(
        service=member.name,
        role=member.role,
        frame=frame,
        phase=member.phase,
        progress=member.progress,
        heartbeat_age_s=_age(member, now),
        elapsed_s=_s(elapsed),
        limit_s=_s(limit),
        late=elapsed > limit,
        missing=lacking,
        text=text,
    )


def _owed(member: Member, episodes: Episodes) -> list[Task]:
    dispatcher = episodes.dispatcher
    if dispatcher is None or member.name not in dispatcher.table.participants:
        return []
    return dispatcher.outstanding(member.name)


def _age(member: Member, now: int) -> float | None:
    return None if member.heard_at is None else _s(now - member.heard_at)


def _s(ns: int) -> float:
    # Microseconds: more digits would change with every look and say nothing.
    return round(ns / 1e9, 6)
