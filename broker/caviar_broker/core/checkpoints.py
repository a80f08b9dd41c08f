"""CHECKPOINT and RESTORE: services with state get back to where they were (contract, clause 18)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from caviar_broker.core import events as ev
from caviar_broker.core.decisions import DecisionTable, GrantOrder, Inputs, Ledger, Task
from caviar_broker.core.graph import Graph
from caviar_broker.core.plan import RunPlan
from caviar_broker.core.run import Peer, Resumption, Run
from caviar_broker.core.transitions import ServiceEvent, ServiceState
from caviar_protocol.digest import RunDigest
from caviar_protocol.messages import Checkpoint, Done, Fault, Restore

MAX_HISTORY_BYTES = 64 * 2**20
"""[B] of products kept for a service, behind which its state is saved before its turn."""

PayloadSize = Callable[[Any], int]
"""Size of a product's payload [B], which only the shell can tell."""


@dataclass(slots=True)
class AnsweredGrant:
    """A grant, and what it was answered with."""

    order: GrantOrder
    digests: Mapping[str, str] | None
    """By topic; None: with FAULT."""
    chosen: Mapping[str, str] = field(default_factory=dict)
    """Decisions that were taken: imposed when it is granted again, since they may rest on wall time."""


@dataclass(slots=True)
class CheckpointHistory:
    """The last checkpoint of one service in one episode, and the grants that it answered since.

    They are sent again one after the other to an incarnation that has been reset.
    """

    frame: int = -1
    """Of the checkpoint; −1: there is none."""
    state: Any = None
    """As the service sent it, opaque."""
    grants: list[AnsweredGrant] = field(default_factory=list)
    weight: int = 0
    """Of their products [B]."""
    asked: int | None = None
    """Frame of the CHECKPOINT that is not answered yet."""
    asked_at: int = 0
    """When it was sent [ns]."""
    position: int = 0
    """The grant that is sent again next, or was and is not answered yet."""

    def remember(
        self,
        order: GrantOrder,
        digests: Mapping[str, str] | None,
        weigh: PayloadSize,
        chosen: Mapping[str, str] | None = None,
    ) -> None:
        """A grant was answered."""
        self.grants.append(AnsweredGrant(order, digests, chosen or {}))
        self.weight += sum(weigh(product.payload) for product in order.products)

    def due(self, period: int) -> bool:
        """Whether it is time to save the state."""
        return len(self.grants) >= period or self.weight > MAX_HISTORY_BYTES

    def saved(self, state: Any) -> None:
        """CHECKPOINT was answered; nothing had been granted meanwhile."""
        assert self.asked is not None, "a state that nobody asked for"
        assert self.asked == self.last, f"state after frame {self.asked}, not {self.last}"
        self.frame, self.state, self.asked = self.asked, state, None
        self.grants.clear()
        self.weight = 0

    def rewind(self) -> None:
        """The service lost its state."""
        self.asked, self.position = None, 0

    @property
    def pending(self) -> AnsweredGrant | None:
        """What is to be answered once more; None: the service is where it was."""
        return self.grants[self.position] if self.position < len(self.grants) else None

    @property
    def last(self) -> int:
        """The frame that the service completed last; −1: none."""
        return self.grants[-1].order.frame if self.grants else self.frame


CAPABILITY = "checkpoint"


class Checkpoints:
    """The memories of one episode, and what is done with them.

    Parameters
    ----------
    run
        The run.
    grant
        Sends a grant, with decisions imposed.
    returned
        Called with a service that is where it was.
    weigh
        Size of a payload [B].
    """

    def __init__(
        self,
        run: Run,
        grant: Callable[[GrantOrder, Mapping[str, str]], None],
        returned: Callable[[Peer, int], None],
        weigh: PayloadSize,
    ) -> None:
        self._run, self._grant, self._returned, self._weigh = run, grant, returned, weigh
        self._memories: dict[str, CheckpointHistory] = {}

    # --- keeping -------------------------------------------------------------------------------------

    def begin(self) -> None:
        """An episode begins, or is gone on with."""
        run, before = self._run, self._run.resumption
        self._memories = {}
        if before is not None and run.graph is not None:
            self._memories = memories_of(before, run.graph, run.plan, self._weigh)

    @property
    def memories(self) -> Mapping[str, CheckpointHistory]:
        """What is kept, by service."""
        return self._memories

    def digests(self, peer: Peer, answer: Done) -> dict[str, str]:
        """Digests by topic of what an answer holds and somebody asked for."""
        graph = self._run.graph
        wanted = graph.outputs[peer.name] if graph else ()
        return {header.topic: header.digest for header in answer.products if header.topic in wanted}

    def of(self, service: str) -> CheckpointHistory | None:
        """The memory that is kept for a service; None: it is not told to save its state."""
        return self._memories.get(service)

    def is_kept_for(self, peer: Peer) -> bool:
        """Whether a service can save its state, and the scenario wants it to."""
        able = peer.hello is not None and CAPABILITY in peer.hello.capabilities
        return able and peer.role != "recorder" and self._run.plan.remembers

    def reset(self, peer: Peer, *, begins: bool) -> None:
        """A service is reset: from here on it remembers, or has to be reminded."""
        if not self.is_kept_for(peer):
            self._memories.pop(peer.name, None)
        elif peer.name in self._memories:
            self._memories[peer.name].rewind()
        elif begins:
            self._memories[peer.name] = CheckpointHistory()

    def answered(
        self, peer: Peer, order: GrantOrder, digests: Mapping[str, str] | None, chosen: Mapping[str, str]
    ) -> None:
        """A grant was answered with these products, or with FAULT (None), after these decisions."""
        memory = self._memories.get(peer.name)
        if memory is not None:
            memory.remember(order, digests, self._weigh, chosen)

    # --- saving --------------------------------------------------------------------------------------

    def is_due(self, peer: Peer) -> bool:
        """Whether a service shall save its state before it is granted anything more."""
        memory = self._memories.get(peer.name)
        return memory is not None and memory.due(self._run.plan.checkpoint_frames)

    def ask(self, peer: Peer, now: int) -> None:
        """CHECKPOINT for a service that owes nothing, once."""
        run, memory = self._run, self._memories[peer.name]
        if memory.asked is None:
            memory.asked, memory.asked_at = memory.last, now
            run.send(peer, Checkpoint(**self._ids(peer), frame=memory.last))

    def saving_since(self, peer: Peer) -> int | None:
        """When a service that saves its state was told to [ns]; None: it does not."""
        memory = self._memories.get(peer.name)
        return memory.asked_at if memory is not None and memory.asked is not None else None

    def saved(self, event: ev.CheckpointReceived, now: int) -> bool:
        """CHECKPOINT_DONE: whether it was waited for."""
        run, peer, message = self._run, self._run.peers[event.service], event.message
        if not run.current(peer, message.epoch, message.attempt, "CHECKPOINT_DONE"):
            return False
        memory = self._memories.get(peer.name)
        asked = None if memory is None else memory.asked
        if memory is None or asked is None or (message.episode, message.frame) != (run.episode, asked):
            what = f"CHECKPOINT_DONE for episode {message.episode} frame {message.frame}"
            run.stale(peer, "CHECKPOINT_DONE", what)
            return False
        memory.saved(event.state)
        run.enter_journal("checkpoint", peer.name, message.frame, now, state=event.state)
        return True

    def is_concerned(self, peer: Peer, fault: Fault) -> bool:
        """Whether a FAULT answers CHECKPOINT or RESTORE, and not a grant."""
        memory = self._memories.get(peer.name)
        if memory is None or fault.episode != self._run.episode:
            return False
        restoring = peer.state is ServiceState.RESTORING and not peer.restored
        return fault.frame == (memory.frame if restoring else memory.asked)

    # --- restoring -----------------------------------------------------------------------------------

    def bring_back(self, peer: Peer, now: int) -> bool:
        """RESTORE and the grants since, for a service that has been reset; False where there are none."""
        memory = self._memories.get(peer.name)
        if memory is None or memory.last < 0:
            return False
        peer.move(ServiceEvent.RESTORE, now)
        peer.restored = False
        if memory.frame >= 0:
            restore = Restore(**self._ids(peer), frame=memory.frame)
            self._run.send(peer, restore, attachment=memory.state)
        else:
            self._next(peer, memory, now)
        return True

    def restored(self, peer: Peer, now: int) -> None:
        """READY, to RESTORE."""
        memory = self._memories.get(peer.name)
        if memory is None or memory.frame < 0 or memory.position or peer.restored:
            self._run.unexpected(peer, "READY", "once, after PREPARE, and once after RESTORE")
            return
        peer.restored = True
        self._next(peer, memory, now)

    def _next(self, peer: Peer, memory: CheckpointHistory, now: int) -> None:
        peer.since = now
        pending = memory.pending
        if pending is not None:
            peer.restored = True
            self._grant(pending.order, pending.chosen)
        else:
            peer.move(ServiceEvent.RESTORED, now)
            self._returned(peer, now)

    def repeated(self, peer: Peer, answer: Done | Fault, now: int) -> None:
        """DONE or FAULT of a service that is being brought back: was it the same as before?"""
        run, memory = self._run, self._memories.get(peer.name)
        kind = "DONE" if isinstance(answer, Done) else "FAULT"
        if not run.current(peer, answer.epoch, answer.attempt, kind):
            return
        pending = memory.pending if memory is not None and peer.restored else None
        expected = (run.episode, pending.order.frame) if pending else None
        if memory is None or pending is None or (answer.episode, answer.frame) != expected:
            what = f"{kind} for episode {answer.episode} frame {answer.frame}"
            run.stale(peer, kind, what, pending.order.frame if pending else -1)
            return
        if isinstance(answer, Fault):
            if pending.digests is not None and peer.plan.policy in ("wait", "abort"):
                text = f"failed in frame {answer.frame}, {answer.phase}: {answer.message}"
                run.fail(f"{peer} was restored and {text}", peer.name, now)
                return
            now_digests = None
        else:
            now_digests = self.digests(peer, answer)
        self._compare(peer, answer.frame, pending.digests, now_digests)
        memory.position += 1
        self._next(peer, memory, now)

    def _compare(
        self, peer: Peer, frame: int, before: Mapping[str, str] | None, again: Mapping[str, str] | None
    ) -> None:
        if before == again:
            return
        if before is None or again is None:
            what = "FAULT" if again is None else "products, and FAULT before"
        else:
            topics = sorted(t for t in {*before, *again} if before.get(t) != again.get(t))
            what = f"another {', '.join(topics)}"
        self._run.notice(
            "differs",
            peer.name,
            f"{peer} answered frame {frame} again after its restart, with {what}: it is not "
            "reproducible; the run goes on with what was decided",
            frame,
        )

    def _ids(self, peer: Peer) -> dict[str, Any]:
        run = self._run
        return {"epoch": run.plan.epoch, "attempt": peer.attempt, "episode": run.episode}


def memories_of(
    left: Resumption, graph: Graph, plan: RunPlan, weigh: PayloadSize
) -> dict[str, CheckpointHistory]:
    """What is kept for the services that can save their state, as it was."""
    book = DecisionTable(graph, plan, left.episode, RunDigest(), Ledger(), [])
    book.go_on(left.finished, left.frames, left.tasks, left.newest)
    inputs, found = Inputs(graph, book), {}
    for name, (frame, state) in left.states.items():
        memory = found[name] = CheckpointHistory(frame=frame, state=state)
        for number, digests in sorted(left.answered.get(name, {}).items()):
            if frame < number < left.finished:
                order = _order(name, number, memory.last, inputs)
                memory.remember(order, digests, weigh, left.chosen.get(name, {}).get(number))
    return found


def _order(service: str, frame: int, previous: int, inputs: Inputs) -> GrantOrder:
    task = Task(service, frame)
    lacked = inputs.undecided(task)
    assert lacked is None, f"frame {frame} is finished, and {service} lacks an input from {lacked}"
    provenances, products = inputs.gathered(task).provided(frame)
    return GrantOrder(service, frame, previous, False, tuple(provenances), tuple(products), ())
