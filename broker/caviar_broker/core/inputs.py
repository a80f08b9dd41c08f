"""What a grant is made of: its inputs, what they rely on, and which of them is missing."""

from __future__ import annotations

from collections.abc import Sequence

from caviar_broker.core.decisions import DecisionBook
from caviar_broker.core.graph import Edge, Graph
from caviar_broker.core.tasks import Gathered, Task


class Inputs:
    """Inputs of the tasks of one episode, as far as they are decided (clauses 6, 7, 10 and 18)."""

    def __init__(self, graph: Graph, book: DecisionBook) -> None:
        self._book = book
        self._all, self._consumers = graph.inputs, graph.consumers
        self._latest = graph.latest
        self._lagged = {name: tuple(e for e in edges if e.lag) for name, edges in graph.inputs.items()}

    def taken(self, task: Task) -> Sequence[Edge]:
        """Edges that count in this frame: behind the last frame only those with lag 1 (clause 16)."""
        edges = self._all if task.frame < self._book.frames else self._lagged
        return edges[task.service]

    def undecided(self, task: Task) -> str | None:
        """A source that has not decided yet what this task gets of it; None: all have (clause 7)."""
        frame, undecided = task.frame, self._book.next
        # From behind: once the last one is decided, so are mostly the others, and nobody looks in vain.
        edges = self._latest[task.service] if frame < self._book.frames else self._lagged[task.service]
        for edge in edges:
            if frame - edge.lag >= undecided[edge.source] and frame >= edge.lag:
                return edge.source
        return None

    def gathered(self, task: Task) -> Gathered:
        """What is decided about its inputs; all of them must be."""
        # The service's own last decision is relied on too. What was decided in this very frame would be
        # decided again. Entries become safe in order, so nothing is missing between them.
        book, frame = self._book, task.frame
        cause, entry = None, book.entry(task.service, frame - 1)
        decisions = []
        for edge in self.taken(task):
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
