"""What a grant is made of: its inputs, what they rely on, and which of them is missing."""

from __future__ import annotations

from collections.abc import Iterable

from caviar_broker.core.decisions import DecisionBook
from caviar_broker.core.events import Product
from caviar_broker.core.graph import Edge, Graph
from caviar_broker.core.tasks import Task, provenance
from caviar_protocol.messages import GrantInput


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

    def decided(self, task: Task) -> bool:
        """Whether all of them are decided, so that the task can be granted or skipped (clause 7)."""
        frame, decided = task.frame, self._book.next
        for edge in self.taken(task):
            lag = edge.lag
            if frame - lag >= decided[edge.source] and frame >= lag:
                return False
        return True

    def missing(self, task: Task) -> str | None:
        """Cause of the first required input that is absent (clause 10); frame 0 has no earlier one."""
        for edge in self.taken(task):
            if edge.required and task.frame >= edge.lag:
                decision = self._book.decision(edge, task.frame)
                if decision.product is None:
                    return decision.cause
        return None

    def latest_entry(self, task: Task) -> int:
        """Number of the last journal entry that a grant relies on from before its frame (clause 18).

        That is the service's own last decision, lag 1 inputs and held products; what was decided in
        this very frame would be decided again. Entries become safe in order, so nothing is missing
        between them.
        """
        frame = task.frame
        latest = self._book.entry(task.service, frame - 1)
        for edge in self.taken(task):
            if edge.lag:
                latest = max(latest, self._book.entry(edge.source, frame - edge.lag))
            latest = max(latest, self._book.decision(edge, frame).journal)
        return latest

    def provide(self, task: Task) -> tuple[list[GrantInput], list[Product]]:
        """Provenance of every input, and the products of those that are not absent."""
        inputs: list[GrantInput] = []
        products: list[Product] = []
        for edge in self.taken(task):
            decision = self._book.decision(edge, task.frame)
            inputs.append(provenance(edge.topic, edge.source, decision, task.frame))
            if decision.product is not None:
                products.append(decision.product)
        return inputs, products

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
