"""One service as the broker knows it, and the words in which it is blamed."""

from __future__ import annotations

from dataclasses import dataclass

from caviar_broker.core.plan import ServicePlan
from caviar_broker.core.tasks import Task
from caviar_broker.core.transitions import PRESENT, SERVICE, ServiceEvent, ServiceState, step
from caviar_protocol.messages import Asset, Hello, Ready


@dataclass(slots=True)
class Peer:
    """A service that the run expects, and what has been heard of it."""

    plan: ServicePlan
    state: ServiceState = ServiceState.EXPECTED
    hello: Hello | None = None
    ready: Ready | None = None
    assets: tuple[Asset, ...] = ()
    attempt: int = 0
    heard_at: int | None = None
    """When the last heartbeat came [ns]."""
    advanced_at: int = 0
    """When it last showed progress: a message of its own, or a heartbeat that counted on [ns]."""
    progress: int = 0
    phase: str = ""
    grace_ns: int = 0
    lost_at: int | None = None
    verdict: str = ""

    @property
    def name(self) -> str:
        """Name in the run."""
        return self.plan.name

    @property
    def present(self) -> bool:
        """Whether messages can reach it."""
        return self.state in PRESENT

    def move(self, event: ServiceEvent) -> None:
        """Take a transition of the table."""
        self.state = step(SERVICE, self.state, event)

    def heartbeat(self, progress: int, phase: str, grace_ns: int, now: int) -> None:
        """A heartbeat came."""
        self.heard_at = now
        if progress != self.progress or phase != self.phase:
            self.advanced_at = now
        self.progress, self.phase, self.grace_ns = progress, phase, grace_ns

    def silent_until(self, since: int, limit: int) -> int:
        """When a silence that began at ``since`` or at its last progress becomes a stall [ns]."""
        return max(since, self.advanced_at) + max(limit, self.grace_ns)

    def last_words(self, now: int) -> str:
        """What its heartbeats told last."""
        if self.heard_at is None:
            return "no heartbeat ever came"
        doing = f", which told of {self.phase!r} (progress {self.progress})" if self.phase else ""
        return f"last heartbeat {_seconds(now - self.heard_at)} ago{doing}"

    def blame_task(self, task: Task, problem: str, now: int) -> str:
        """Clause 14: service, frame, phase, elapsed and budget, last heartbeat and progress."""
        elapsed = now - (task.granted_at if task.granted_at is not None else now)
        return (
            f"{self.plan.role} {self.name!r} {problem} in frame {task.frame}, granted "
            f"{_seconds(elapsed)} ago with a budget of {_seconds(self.plan.budget_ns)}; {self.last_words(now)}"
        )

    def blame(self, problem: str, now: int) -> str:
        """The same outside a frame."""
        return f"{self.plan.role} {self.name!r} {problem}; {self.last_words(now)}"


def _seconds(ns: int) -> str:
    return f"{ns / 1e9:.3g} s" if ns >= 1_000_000_000 else f"{ns / 1e6:.3g} ms"
