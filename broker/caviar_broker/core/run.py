"""The state of one run: its services as the broker knows them, its seeds, and the actions to carry out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from caviar_broker.core.events import Action, Finished, Journal, Notice, Product, Send
from caviar_broker.core.graph import Graph
from caviar_broker.core.pace import PauseGate
from caviar_broker.core.plan import RunPlan, ServicePlan, Timeouts, duration
from caviar_broker.core.policy_swaps import PolicySwaps
from caviar_broker.core.tasks import GrantOrder, Ledger, Task
from caviar_broker.core.transitions import (
    PRESENT,
    RUN,
    SERVICE,
    RunEvent,
    RunState,
    ServiceEvent,
    ServiceState,
    step,
)
from caviar_protocol.digest import RunDigest
from caviar_protocol.errors import one_line
from caviar_protocol.messages import (
    Asset,
    Error,
    GeometryChange,
    Grant,
    Hello,
    Message,
    Ready,
    Shutdown,
    Stale,
)

_DOING = {
    ServiceState.EXPECTED: "being awaited",
    ServiceState.JOINED: "waiting for the others",
    ServiceState.PREPARING: "preparing",
    ServiceState.READY: "waiting for the others",
    ServiceState.RESETTING: "resetting",
    ServiceState.RESTORING: "being restored",
    ServiceState.ACTIVE: "idle in an episode",
    ServiceState.LOST: "lost",
    ServiceState.LEFT: "gone",
}


@dataclass(slots=True)
class Member:
    """A service as the broker knows it: its part in the run, its state, and what has been heard of it.

    What it may use of the broker, as its memory limit, is in `caviar_broker.security.limits.PeerLimits`.
    """

    plan: ServicePlan
    state: ServiceState = ServiceState.EXPECTED
    since: int = 0
    """When its state began [ns]."""
    hello: Hello | None = None
    outputs: frozenset[str] = frozenset()
    """Topics that it declared."""
    ready: Ready | None = None
    """Its last READY; kept when it is lost."""
    assets: tuple[Asset, ...] = ()
    attempt: int = 0
    heard_at: int | None = None
    """When the last heartbeat came [ns]."""
    advanced_at: int = 0
    """When it last showed progress: an offer of scenery, or a heartbeat that counted on [ns]."""
    progress: int = 0
    phase: str = ""
    grace_ns: int = 0
    verdict: str = ""
    """How its loss is known."""
    losses: int = 0
    """How often it was lost since it last answered a grant."""
    restored: bool = False
    """Whether it has the state that it was saved with, and is sent what it was granted since."""
    name: str = field(init=False)
    """Name in the run."""
    role: str = field(init=False)
    """Role in the run."""

    def __post_init__(self) -> None:
        self.name, self.role = self.plan.name, self.plan.role

    @property
    def present(self) -> bool:
        """True if messages can reach it."""
        return self.state in PRESENT

    def __str__(self) -> str:
        return f"{self.plan.role} {self.plan.name!r}"

    def move(self, event: ServiceEvent, now: int) -> None:
        """Take a transition of the table."""
        self.state, self.since = step(SERVICE, self.state, event), now

    def join(self, hello: Hello, now: int) -> None:
        """A new incarnation: what was heard of the one before does not count for it."""
        self.move(ServiceEvent.HELLO, now)
        self.hello, self.attempt = hello, self.attempt + 1
        self.outputs = frozenset(hello.outputs)
        # Silence and progress of the incarnation before would blame this one, or excuse it.
        self.heard_at, self.progress, self.phase, self.grace_ns = None, 0, "", 0
        self.restored = False

    def heartbeat(self, progress: int, phase: str, grace_ns: int, now: int) -> None:
        """A heartbeat came."""
        self.heard_at = now
        if progress != self.progress or phase != self.phase:
            self.advanced_at = now
        self.progress, self.phase, self.grace_ns = progress, phase, grace_ns

    def silent_until(self, since: int, limit: int) -> int:
        """Instant at which a silence that began at ``since`` or at its last progress becomes a stall [ns].

        A phase that declared a longer grace, such as compilation, has that (clause 14).
        """
        return max(since, self.advanced_at) + max(limit, self.grace_ns)

    def rejoin(self, timeouts: Timeouts) -> int:
        """Time for which its return is waited for once it is lost [ns]; 0: not at all."""
        return timeouts.rejoin if self.plan.rejoin is None else self.plan.rejoin

    @property
    def doing(self) -> str:
        """Its state in words."""
        return _DOING[self.state]

    def last_words(self, now: int) -> str:
        """Its last heartbeat in words."""
        if self.heard_at is None:
            return "no heartbeat ever came"
        phase = f"phase {self.phase!r}" if self.phase else "no phase stated"
        return f"last heartbeat {duration(now - self.heard_at)} ago: {phase}, progress {self.progress}"

    def blame_task(self, task: Task, problem: str, now: int, waiting: str = "") -> str:
        """Clause 14: service, frame, who lacks what, elapsed and budget, last heartbeat, phase, progress.

        Args:
            task: What the service works on.
            problem: What is wrong, as in "overran its budget".
            now: The time [ns].
            waiting: Which services wait for which input of it.
        """
        return (
            f"{self} {problem} in frame {task.frame}: {duration(now - task.started_at)} since its grant, "
            f"budget {duration(self.plan.budget_ns)}; {self.last_words(now)}"
        ) + (f"; {waiting}" if waiting else "")

    def blame(self, problem: str, now: int) -> str:
        """The same outside a frame."""
        return f"{self} {problem} for {duration(now - self.since)}; {self.last_words(now)}"


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """State of a run after a finished frame; a compacted journal begins with it."""

    episode: int
    finished: int
    """Frames of the episode that are finished."""
    finished_before: int
    """Frames of the episodes before."""
    digest: str
    """Of all finished frames."""
    seed: int
    """Of the episode."""
    seed_episode: int
    frames: int
    """Of the episode."""
    members: tuple[str, ...]
    """Services of the run."""


@dataclass(frozen=True, kw_only=True)
class Resumption:
    """State of a run that another broker left, as its journal has it."""

    episode: int
    seed: int
    """Of the episode."""
    seed_episode: int
    frames: int
    """Of the episode."""
    finished: int
    """Frames of the episode that are finished."""
    finished_before: int = 0
    """Frames of the episodes before."""
    digest: RunDigest
    """Of all finished frames."""
    entries: int
    """Number of the last journal entry."""
    wish: tuple[int, str] | None = None
    """Seed that an agent chose for the next episode, and the agent."""
    tasks: Mapping[str, Mapping[int, Task]] = field(default_factory=dict)
    """Decided tasks by service and frame: those of the last finished frame, and all from which the
    grants since the last checkpoints can be made."""
    newest: Mapping[tuple[str, str], tuple[Product, int]] = field(default_factory=dict)
    """Newest product and its journal entry by (service, topic)."""
    answered: Mapping[str, Mapping[int, Mapping[str, str] | None]] = field(default_factory=dict)
    """What services answered: digests by topic, None for FAULT, by service and frame."""
    chosen: Mapping[str, Mapping[int, Mapping[str, str]]] = field(default_factory=dict)
    """Decisions that services took, by service and frame."""
    states: Mapping[str, tuple[int, Any]] = field(default_factory=dict)
    """Last checkpoint: frame and state, by service; frame −1 where there is none."""
    geometry: tuple[tuple[str, GeometryChange], ...] = ()
    """What worlds announced of meshes in the finished frames of the episode, in order: world and meshes."""


class Run:
    """One run: its present state, its services, and the actions that wait to be carried out.

    Args:
        plan: The run.
        now: The time [ns].
        resumption: What another broker left of the run.
    """

    def __init__(self, plan: RunPlan, now: int, resumption: Resumption | None = None) -> None:
        self.plan = plan
        # Needed until the episode goes on, whose first tasks are made of it.
        self.resumption = resumption
        """What another broker left of the run, until it goes on."""
        self.state = RunState.JOINING
        self.since = now
        """When the present state began [ns]."""
        self.members = {service.name: Member(service, since=now) for service in plan.services}
        self.graph: Graph | None = None
        """Known once all services have joined."""
        self.episode = plan.first_episode
        self.seed = plan.seed
        """Of the present episode."""
        self.seed_episode = plan.first_episode
        """Episodes since the first one with this seed."""
        # Seed of the next episode, and the agent that chose it.
        self._wished: tuple[int, Member] | None = None
        self.digest = RunDigest()
        self.finished_before = 0
        """Frames of the episodes that are over."""
        self.gate = PauseGate()
        self.swaps = PolicySwaps(plan.policies)
        self.ledger = Ledger(kept=not plan.ephemeral)
        self.over = False
        """Whether the run has ended, although services may still be leaving."""
        if resumption is not None:
            self._continue(resumption)
        self.error = ""
        self.culprit = ""
        # One list for the life of the run: the parts of the core keep it and append.
        self.actions: list[Action] = []

    def _continue(self, before: Resumption) -> None:
        self.episode, self.seed, self.seed_episode = before.episode, before.seed, before.seed_episode
        self.digest, self.finished_before = before.digest, before.finished_before
        self.ledger.last = self.ledger.written = before.entries
        if before.wish is not None:
            self._wished = before.wish[0], self.members[before.wish[1]]

    def takes_part(self, member: Member) -> bool:
        """Return whether the run needs a service: all until the graph is known, then its own (clause 5)."""
        return self.graph is None or member.name in self.graph.inputs

    def scenery(self) -> tuple[Asset, ...]:
        """The scenery of all worlds, each file once, and pattern files that no world brings."""
        # A world's own file goes before the broker's, which is that of its name with the same digest.
        found = {pattern.name: pattern.asset for pattern in self.plan.patterns if pattern.asset}
        found |= {asset.name: asset for member in self.members.values() for asset in member.assets}
        return tuple(found[name] for name in sorted(found))

    # --- seeds (clause 16) -------------------------------------------------------------------------

    def wish(self, seed: int, member: Member, now: int) -> None:
        """An agent chooses the seed of the next episode."""
        # Two agents may end an episode in one frame; with the same seed there is nothing to decide.
        if self._wished is not None and self._wished[0] != seed and self._wished[1] is not member:
            other = self._wished[1]
            self.fail(
                f"{other} and {member} choose different seeds, {self._wished[0]} and {seed}", member.name, now
            )
        self._wished = seed, member

    def next_seed(self) -> None:
        """An episode begins: with the seed that was chosen, or the one before."""
        if self._wished is not None:
            self.seed, self.seed_episode, self._wished = self._wished[0], 0, None
        elif self.episode > self.plan.first_episode:
            self.seed_episode += 1

    # --- transitions of the run --------------------------------------------------------------------

    def enter(self, event: RunEvent, now: int) -> None:
        """Take a transition of the table."""
        self.state, self.since = step(RUN, self.state, event), now
        self.over = self.state in (RunState.STOPPING, RunState.FINISHED)

    def fail(self, error: str, culprit: str, now: int) -> None:
        """End the run with blame; the first blame counts.

        Args:
            error: What blames; its lines become one.
            culprit: The service whose fault it is; empty where it is none's.
            now: The time [ns].
        """
        # What fails later mostly follows from the first failure.
        if not self.over:
            self.error, self.culprit = one_line(error), culprit
            self.stop(self.error, now)

    def stop(self, reason: str, now: int) -> None:
        """End the run: SHUTDOWN to every service."""
        self.enter(RunEvent.STOP, now)
        # Also those that are not ready yet: they have joined, and wait for a word.
        for member in self.members.values():
            if member.present:
                self.send(member, Shutdown(reason=reason, grace_ns=self.plan.timeouts.shutdown))

    def finish_if_alone(self, now: int) -> None:
        """Finish the run once every service has left."""
        if self.state is RunState.STOPPING and not any(member.present for member in self.members.values()):
            self.enter(RunEvent.ALL_GONE, now)
            digest = "" if self.plan.ephemeral else self.digest.hexdigest()
            self.actions.append(Finished(self.error, self.culprit, digest))

    # --- what goes out -------------------------------------------------------------------------------

    def send(
        self, member: Member, message: Message, products: tuple[Product, ...] = (), attachment: Any = None
    ) -> None:
        """Have a message sent.

        Args:
            member: To which service.
            message: The message.
            products: Follow it, two parts each.
            attachment: State of the service, in one part.
        """
        self.actions.append(Send(member.name, message, products, attachment))

    def grant(self, order: GrantOrder, chosen: Mapping[str, str] | None = None) -> None:
        """Have GRANT sent; with ``chosen`` it was answered before, after these decisions."""
        plan, member = self.plan, self.members[order.service]
        # A replay imposes what was recorded; what a service chose before its restart goes before that.
        decisions = plan.imposed.get((order.service, self.episode, order.frame), {})
        if order.service in plan.policies:
            decisions = {**self.swaps.announced(order.service), **decisions}
        grant = Grant(
            epoch=plan.epoch,
            attempt=member.attempt,
            episode=self.episode,
            frame=order.frame,
            previous_frame=order.previous,
            t_ns=plan.t_ns(order.frame),
            budget_ns=member.plan.budget_ns,
            inputs=order.inputs,
            final=order.final,
            decisions={**decisions, **chosen} if chosen else dict(decisions),
            reports=order.reports,
        )
        self.actions.append(Send(member.name, grant, order.products))

    def ids(self, member: Member) -> dict[str, int]:
        """Fields that every message of an episode to a service carries (clause 1)."""
        return {"epoch": self.plan.epoch, "attempt": member.attempt, "episode": self.episode}

    def enter_journal(self, outcome: str, service: str, frame: int, now: int, **facts: Any) -> None:
        """Have something written down that is no decision about a task.

        Args:
            outcome: As `caviar_broker.core.events.Journal` has it.
            service: Which it concerns; empty for the run.
            frame: Frame that it is about; −1: none.
            now: The time [ns].
            facts: Further fields of the entry.
        """
        if not self.plan.ephemeral:
            number = self.ledger.enter(now)
            self.actions.append(Journal(number, self.episode, frame, service, outcome, **facts))

    def notice(self, kind: str, service: str, text: str, frame: int = -1) -> None:
        """Have the user notified."""
        self.actions.append(Notice(kind, service, one_line(text), self.episode, frame))

    # --- what came out of turn -----------------------------------------------------------------------

    def current(self, member: Member, epoch: int, attempt: int, kind: str, outstanding: int = -1) -> bool:
        """Clause 1: whether a message is of this broker's and this service's present incarnation.

        Args:
            member: The sender.
            epoch: Of the message.
            attempt: Of the message.
            kind: Name of the message, for the answer to a stale one.
            outstanding: Frame that the sender owes; −1: none.
        """
        if member.present and (epoch, attempt) == (self.plan.epoch, member.attempt):
            return True
        self.stale(member, kind, f"{kind} of epoch {epoch}, attempt {attempt}", outstanding)
        return False

    def stale(self, member: Member, kind: str, what: str, outstanding: int = -1) -> None:
        """Answer a message that matches nothing outstanding (clause 1)."""
        self.notice("stale", member.name, f"{what} matches nothing that is outstanding; not used")
        if member.present:
            self.send(member, Stale(of=kind, **self.ids(member), frame=outstanding))

    def unexpected(self, member: Member, kind: str, when: str) -> None:
        """Answer a message that came out of turn."""
        self.notice("stale", member.name, f"{kind} came out of turn: it is expected {when}; not used")
        if member.present:
            self.send(member, Error(code="unexpected", of=kind, message=f"{kind} is expected {when}"))
