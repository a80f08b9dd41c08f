"""What a broker that goes on with a run knows of it (contract, clause 18).

It goes on behind the last frame that was finished. Whatever had been decided about later frames is
decided anew.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from caviar_broker.core.decisions import DecisionBook
from caviar_broker.core.events import Product
from caviar_broker.core.graph import Graph
from caviar_broker.core.inputs import Inputs
from caviar_broker.core.ledger import Ledger
from caviar_broker.core.memory import Memory, Weigh
from caviar_broker.core.plan import RunPlan
from caviar_broker.core.tasks import GrantOrder, Task
from caviar_protocol.digest import RunDigest


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """A run up to a finished frame, as a compacted journal opens with it."""

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
    """A run up to a frame."""

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

    def memories(self, graph: Graph, plan: RunPlan, weigh: Weigh) -> dict[str, Memory]:
        """What is kept for the services that can save their state, as it was."""
        book = DecisionBook(graph, plan, self.episode, RunDigest(), Ledger(), [])
        self.restore(book)
        inputs, found = Inputs(graph, book), {}
        for name, (frame, state) in self.states.items():
            memory = found[name] = Memory(frame=frame, state=state)
            for number, digests in sorted(self.answered.get(name, {}).items()):
                if frame < number < self.finished:
                    order = self._order(name, number, memory.last, inputs)
                    memory.remember(order, digests, weigh, self.chosen.get(name, {}).get(number))
        return found

    def restore(self, book: DecisionBook) -> None:
        """Have a new book go on behind the last finished frame."""
        book.go_on(self.finished, self.frames, self.tasks, self.newest)

    def _order(self, service: str, frame: int, previous: int, inputs: Inputs) -> GrantOrder:
        task = Task(service, frame)
        lacked = inputs.undecided(task)
        assert lacked is None, f"frame {frame} is finished, and {service} lacks an input from {lacked}"
        provenances, products = inputs.gathered(task).provided(frame)
        return GrantOrder(service, frame, previous, False, tuple(provenances), tuple(products), ())
