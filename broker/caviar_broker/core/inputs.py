"""What a grant is made of: its inputs, what they rely on, and which of them is missing."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from caviar_broker.core.decisions import DecisionBook
from caviar_broker.core.events import Product
from caviar_broker.core.graph import Edge, Graph
from caviar_broker.core.tasks import Decision, Task, provenance
from caviar_protocol.messages import GrantInput


class Gathered(msgspec.Struct, frozen=True):
    """Inputs of a task, all of them decided."""

    decisions: list[tuple[Edge, Decision]]
    cause: str | None
    """Why the first required input is absent (clause 10); frame 0 has no earlier one."""
    entry: int
    """Number of the last journal entry that a grant relies on from before its frame (clause 18): the
    service's own, lag 1 inputs and held products."""

    def provided(self, frame: int) -> tuple[list[GrantInput], list[Product]]:
        """Provenance of every input, and the products of those that are not absent."""
        inputs = [provenance(edge.topic, edge.source, decision, frame) for edge, decision in self.decisions]
        return inputs, [decision.product for _, decision in self.decisions if decision.product is not None]


class Inputs:
    """Inputs of the tasks of one episode, as far as they are decided (clauses 6, 7, 10 and 18)."""

    def __init__(self, graph: Graph, book: DecisionBook) -> None:
        self._book = book
        self._all, self._consumers = graph.inputs, graph.consumers
        self._lagged = {name: tuple(e for e in edges if e.lag) for name, edges in graph.inputs.items()}

    def taken(self, task: Task) -> Iterable[Edge]:
        """Edges that count in this frame: behind the last frame only those with lag 1 (clause 16)."""
        edges = self._all if task.frame < self._book.frames else self._lagged
        return edges[task.service]

    def gathered(self, task: Task) -> Gathered | None:
        """What is decided about its inputs; None while one of them is not (clause 7)."""
        frame, undecided = task.frame, self._book.next
        edges = (self._all if frame < self._book.frames else self._lagged)[task.service]
        for edge in edges:
            if frame - edge.lag >= undecided[edge.source] and frame >= edge.lag:
                return None
        # The service's own last decision is relied on too. What was decided in this very frame would be
        # decided again. Entries become safe in order, so nothing is missing between them.
        book = self._book
        cause, entry = None, book.entry(task.service, frame - 1)
        decisions = []
        for edge in edges:
            decision = book.decision(edge, frame)
            decisions.append((edge, decision))
            if decision.product is None and edge.required and frame >= edge.lag and cause is None:
                cause = decision.cause
            if edge.lag and (of_input := book.entry(edge.source, frame - edge.lag)) > entry:
                entry = of_input
            if decision.journal > entry:
                entry = decision.journal
        return Gathered(decisions, cause, entry)

    def lacking(self, source: str) -> str:
        """Who waits for which input of a source now; empty if nobody does."""
        found = []
        for name in self._consumers[source]:
            frame = self._book.next[name]
            for edge in self._all[name]:
                lacks = frame <= self._book.frames and not self._book.decided(edge, frame)
                if lacks and edge.source == source:
                    found.append(f"{name} waits for {edge.topic} of frame {frame - edge.lag}")
        return ", ".join(found)
