"""One service as the broker knows it, and the words in which it is blamed."""

from __future__ import annotations

from dataclasses import dataclass, field

from caviar_broker.core.plan import Limits, ServicePlan
from caviar_broker.core.tasks import Task
from caviar_broker.core.transitions import PRESENT, SERVICE, ServiceEvent, ServiceState, step
from caviar_protocol.messages import Asset, Hello, Ready

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
class Peer:
    """A service that the run expects, and what has been heard of it."""

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
        """Whether messages can reach it."""
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
        self.heard_at, self.progress, self.phase, self.grace_ns = None, 0, "", 0
        self.restored = False

    def heartbeat(self, progress: int, phase: str, grace_ns: int, now: int) -> None:
        """A heartbeat came."""
        self.heard_at = now
        if progress != self.progress or phase != self.phase:
            self.advanced_at = now
        self.progress, self.phase, self.grace_ns = progress, phase, grace_ns

    def silent_until(self, since: int, limit: int) -> int:
        """When a silence that began at ``since`` or at its last progress becomes a stall [ns].

        A phase that declared a longer grace, such as compilation, has that (clause 14).
        """
        return max(since, self.advanced_at) + max(limit, self.grace_ns)

    def rejoin(self, limits: Limits) -> int:
        """How long its return is waited for once it is lost [ns]; 0: not at all."""
        return limits.rejoin if self.plan.rejoin is None else self.plan.rejoin

    @property
    def doing(self) -> str:
        """What its state means, for people."""
        return _DOING[self.state]

    def last_words(self, now: int) -> str:
        """What its heartbeats told last."""
        if self.heard_at is None:
            return "no heartbeat ever came"
        phase = f"phase {self.phase!r}" if self.phase else "no phase told"
        return f"last heartbeat {_seconds(now - self.heard_at)} ago: {phase}, progress {self.progress}"

    def blame_task(self, task: Task, problem: str, now: int, waiting: str = "") -> str:
        """Clause 14: service, frame, who lacks what, elapsed and budget, last heartbeat, phase, progress."""
        return (
            f"{self} {problem} in frame {task.frame}: {_seconds(now - task.started_at)} since its grant, "
            f"budget {_seconds(self.plan.budget_ns)}; {self.last_words(now)}"
        ) + (f"; {waiting}" if waiting else "")

    def blame(self, problem: str, now: int) -> str:
        """The same outside a frame."""
        return f"{self} {problem} for {_seconds(now - self.since)}; {self.last_words(now)}"


def _seconds(ns: int) -> str:
    return f"{ns / 1e9:.3g} s" if ns >= 1_000_000_000 else f"{ns / 1e6:.3g} ms"
