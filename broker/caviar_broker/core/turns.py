"""Whose turn it is: which frame a service may have next, and who has to be looked at again."""

from __future__ import annotations

from caviar_broker.core.decisions import DecisionBook
from caviar_broker.core.graph import Graph
from caviar_broker.core.plan import RunPlan
from caviar_broker.core.tasks import Task


class Turns:
    """Turns of the services of one episode (clauses 7 and 16).

    After something happened only services that may be concerned are looked at again. Who waits for another
    service's decision, for the journal, for real time or for frames to be finished is remembered until that
    comes. A service that lacks several inputs waits for one of them at a time, for the last one of a frame
    first, so few answers bring it back in vain.
    """

    def __init__(self, graph: Graph, plan: RunPlan, book: DecisionBook) -> None:
        self._roles = roles = {service.name: service.role for service in plan.services}
        self.agents = tuple(name for name in graph.order if roles[name] == "agent")
        self.recorders = tuple(name for name in graph.order if roles[name] == "recorder")
        self.others = tuple(name for name in reversed(graph.order) if name not in self.recorders)
        """All but the recorders, those behind others in the graph first."""
        self.concerned = set(graph.order)
        """Services for which something may have changed."""
        self.waiting_for_journal: set[str] = set()
        self.waiting_for_pace: set[str] = set()
        self._waiting_for_frames: set[str] = set()
        self._finished = 0
        """Finished frames when somebody was last woken for them."""
        self._awaiting: dict[str, set[str]] = {name: set() for name in graph.order}
        """Who waits for the next decision of each service."""
        self._graph, self._plan, self._book = graph, plan, book

    def candidate(self, name: str, in_flight: int) -> Task | None:
        """The next task of a service behind those in flight; None: it has to wait for others, or is through.

        No agent runs ahead of one that may end the episode, and no recorder of what may be cut then.
        """
        book = self._book
        frame, role = book.next[name] + in_flight, self._roles[name]
        if frame >= book.frames and (role != "agent" or frame > book.frames):
            return None
        if frame >= book.finished_frames + self._plan.frames_in_flight + (frame == book.frames):
            self._waiting_for_frames.add(name)
            return None
        if role == "agent":
            for agent in self.agents:
                if book.next[agent] < frame:
                    self.waits_for(agent, name)
                    return None
        elif role == "recorder":
            for other in self.others:
                if book.next[other] <= frame:
                    self.waits_for(other, name)
                    return None
        return book.task(name, frame)

    def waits_for(self, source: str, name: str) -> None:
        """A service can have no turn before the next decision of another."""
        self._awaiting[source].add(name)

    def decided(self, name: str) -> None:
        """A service's task was decided: whom may that concern?"""
        if not self._waits_for_last_input(name):
            self.concerned.add(name)
        self.wake(self._awaiting[name])
        if self._book.finished_frames != self._finished:
            self._finished = self._book.finished_frames
            self.wake(self._waiting_for_frames)

    def _waits_for_last_input(self, name: str) -> bool:
        """Whether a service, which has just decided a frame, waits for its last input now, as most do."""
        book, edges = self._book, self._graph.latest[name]
        frame = book.next[name]
        if edges and frame < book.frames and not book.decided(edges[0], frame):
            self.waits_for(edges[0].source, name)
            return True
        return False

    def wake(self, waiting: set[str]) -> None:
        """What these services waited for has come."""
        if waiting:
            self.concerned |= waiting
            waiting.clear()

    def wake_all(self) -> None:
        """Everything may have changed."""
        decisions = self._awaiting.values()
        for waiting in (
            self.waiting_for_journal,
            self.waiting_for_pace,
            self._waiting_for_frames,
            *decisions,
        ):
            waiting.clear()
        self.concerned.update(self._graph.order)
