"""Checkpoints: CHECKPOINT and RESTORE bring a service with state back to where it was (contract, clause 18).

A service that loses its state gets its last checkpoint and, one after the other, the grants that it answered
since. `CheckpointHistory` is what is kept for that; `Checkpoints` asks for states and restores services.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from caviar_broker.core import events as ev
from caviar_broker.core.decisions import DecisionTable
from caviar_broker.core.graph import Graph
from caviar_broker.core.pace import Pacer
from caviar_broker.core.plan import RunPlan
from caviar_broker.core.run import Member, Resumption, Run
from caviar_broker.core.tasks import GrantOrder
from caviar_broker.core.transitions import ServiceEvent, ServiceState
from caviar_protocol.messages import Checkpoint, Done, Fault, Restore

CAPABILITY = "checkpoint"
MAX_HISTORY_BYTES = 64 * 2**20
"""[B] of products kept for a service, beyond which its state is saved before its turn."""

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
    """The last checkpoint of one service in one episode, and the grants that it answered since."""

    frame: int = -1
    """Of the checkpoint; −1: there is none."""
    state: Any = None
    """As the service sent it, opaque."""
    grants: list[AnsweredGrant] = field(default_factory=list)
    size: int = 0
    """Of their products [B]."""
    asked: int | None = None
    """Frame of the CHECKPOINT that is not answered yet."""
    asked_at: int = 0
    """When it was sent [ns]."""
    position: int = 0
    """The grant that is sent again next, or was and is not answered yet."""

    def add(self, grant: AnsweredGrant, payload_size: PayloadSize) -> None:
        """Keep a grant that was answered."""
        self.grants.append(grant)
        self.size += sum(payload_size(product.payload) for product in grant.order.products)

    def is_due(self, period: int) -> bool:
        """Return whether it is time to save the state, at the latest after ``period`` frames."""
        # The second bound is for large products: what is granted again is kept in memory until then.
        return len(self.grants) >= period or self.size > MAX_HISTORY_BYTES

    def save(self, state: Any) -> None:
        """Keep the answer to CHECKPOINT; nothing had been granted meanwhile."""
        # `handle_checkpoint_done` has sorted out what was not asked for: here it would be a fault of the
        # core.
        assert self.asked is not None, "a state that was not asked for"
        assert self.asked == self.last, f"state after frame {self.asked}, not {self.last}"
        self.frame, self.state, self.asked = self.asked, state, None
        self.grants.clear()
        self.size = 0

    def rewind(self) -> None:
        """Begin again with the first grant: the service lost its state."""
        self.asked, self.position = None, 0

    @property
    def pending(self) -> AnsweredGrant | None:
        """The grant to be answered once more; None: the service is where it was."""
        return self.grants[self.position] if self.position < len(self.grants) else None

    @property
    def last(self) -> int:
        """The frame that the service completed last; −1: none."""
        return self.grants[-1].order.frame if self.grants else self.frame


class Checkpoints:
    """The checkpoint histories of one episode, and what is done with them.

    Args:
        run: The run.
        return_service: Called with a service that is where it was.
        payload_size: Size of a payload [B].
    """

    def __init__(
        self,
        run: Run,
        return_service: Callable[[Member, int], None],
        payload_size: PayloadSize,
    ) -> None:
        self._run, self._return_service = run, return_service
        self._payload_size = payload_size
        self.histories: dict[str, CheckpointHistory] = {}
        """Of each service that is asked to save its state."""

    def begin_episode(self) -> None:
        """Start with nothing, or with what another broker left of the episode."""
        run, before = self._run, self._run.resumption
        # State does not outlive an episode: RESET begins anew, and nothing of the one before is granted
        # again.
        self.histories = {}
        if before is not None and run.graph is not None:
            self.histories = histories_of(before, run.graph, run.plan, self._payload_size)

    def reset(self, member: Member, *, begins: bool) -> None:
        """Note that a service is reset, as an episode ``begins`` or within one."""
        # A recorder's state is its recording, which it continues by itself.
        able = member.hello is not None and CAPABILITY in member.hello.capabilities
        if not (able and member.role != "recorder" and self._run.plan.remembers):
            # It may have had one: this incarnation can lack the capability that the one before had.
            self.histories.pop(member.name, None)
        elif member.name in self.histories:
            self.histories[member.name].rewind()
        elif begins:
            self.histories[member.name] = CheckpointHistory()

    def add(self, member: Member, order: GrantOrder, answer: Done | Fault) -> None:
        """Keep a grant and its answer, for a service that saves its state."""
        history = self.histories.get(member.name)
        if history is not None:
            # What was decided from wall time, as the rung of an adaptive channel, is imposed when it is
            # granted again.
            chosen = answer.decisions if isinstance(answer, Done) else {}
            history.add(AnsweredGrant(order, self._digests(member, answer), chosen), self._payload_size)

    def _digests(self, member: Member, answer: Done | Fault) -> dict[str, str] | None:
        """Digests by topic of what an answer holds and a service takes; None for FAULT."""
        if isinstance(answer, Fault):
            return None
        # Only topics in demand: others were dropped when they came, so that a difference has no consequence.
        graph = self._run.graph
        wanted = graph.outputs[member.name] if graph else ()
        return {header.topic: header.digest for header in answer.products if header.topic in wanted}

    # --- saving --------------------------------------------------------------------------------------

    def is_due(self, member: Member) -> bool:
        """Return whether a service shall save its state before it is granted anything more."""
        history = self.histories.get(member.name)
        return history is not None and history.is_due(self._run.plan.checkpoint_frames)

    def request(self, member: Member, now: int) -> None:
        """Send CHECKPOINT to a service that owes nothing, once."""
        history = self.histories[member.name]
        # Called with each answer while several grants are outstanding; the first call alone asks.
        if history.asked is None:
            history.asked, history.asked_at = history.last, now
            self._run.send(member, Checkpoint(**self._run.ids(member), frame=history.last))

    def saving_since(self, member: Member) -> int | None:
        """Instant at which a service was asked to save its state, which it does [ns]; None: it does not."""
        history = self.histories.get(member.name)
        return history.asked_at if history is not None and history.asked is not None else None

    def handle_checkpoint_done(self, event: ev.CheckpointReceived, now: int) -> bool:
        """Take CHECKPOINT_DONE: whether it was waited for."""
        run, member, message = self._run, self._run.members[event.service], event.message
        if not run.current(member, message.epoch, message.attempt, "CHECKPOINT_DONE"):
            return False
        history = self.histories.get(member.name)
        asked = None if history is None else history.asked
        if history is None or asked is None or (message.episode, message.frame) != (run.episode, asked):
            what = f"CHECKPOINT_DONE for episode {message.episode} frame {message.frame}"
            run.stale(member, "CHECKPOINT_DONE", what)
            return False
        history.save(event.state)
        run.enter_journal("checkpoint", member.name, message.frame, now, state=event.state)
        return True

    def concerns(self, member: Member, fault: Fault) -> bool:
        """Return whether a FAULT answers CHECKPOINT or RESTORE, and not a grant."""
        history = self.histories.get(member.name)
        if history is None or fault.episode != self._run.episode:
            return False
        # RESTORE and CHECKPOINT name the frame after which the state was taken, a grant names the next one.
        restoring = member.state is ServiceState.RESTORING and not member.restored
        return fault.frame == (history.frame if restoring else history.asked)

    # --- restoring -----------------------------------------------------------------------------------

    def resumes_with(self, member: Member) -> int | None:
        """The first frame that a service is granted again once it is reset; None: it has no state to get."""
        history = self.histories.get(member.name)
        return None if history is None or history.last < 0 else history.frame + 1

    def restore(self, member: Member, now: int) -> bool:
        """Send RESTORE, or the first grant again, to a service that was reset; False where there is none."""
        history = self.histories.get(member.name)
        if history is None or history.last < 0:
            return False
        member.move(ServiceEvent.RESTORE, now)
        member.restored = False
        if history.frame >= 0:
            message = Restore(**self._run.ids(member), frame=history.frame)
            self._run.send(member, message, attachment=history.state)
        else:
            self._grant_next(member, history, now)
        return True

    def handle_ready(self, member: Member, now: int) -> None:
        """Take READY, the answer to RESTORE."""
        history = self.histories.get(member.name)
        if history is None or history.frame < 0 or history.position or member.restored:
            self._run.unexpected(member, "READY", "once, after PREPARE, and once after RESTORE")
            return
        member.restored = True
        self._grant_next(member, history, now)

    def _grant_next(self, member: Member, history: CheckpointHistory, now: int) -> None:
        # Each grant that is repeated has the whole time for a reset: a long history is no stall.
        member.since = now
        pending = history.pending
        if pending is not None:
            member.restored = True
            self._run.grant(pending.order, pending.chosen)
        else:
            member.move(ServiceEvent.RESTORED, now)
            self._return_service(member, now)

    def handle_repeated_answer(self, member: Member, answer: Done | Fault, now: int) -> None:
        """Take DONE or FAULT of a service that is being restored, and compare it with the one before."""
        run, history = self._run, self.histories.get(member.name)
        kind = "DONE" if isinstance(answer, Done) else "FAULT"
        if not run.current(member, answer.epoch, answer.attempt, kind):
            return
        pending = history.pending if history is not None and member.restored else None
        expected = (run.episode, pending.order.frame) if pending else None
        if history is None or pending is None or (answer.episode, answer.frame) != expected:
            what = f"{kind} for episode {answer.episode} frame {answer.frame}"
            run.stale(member, kind, what, pending.order.frame if pending else -1)
            return
        # Under hold and drop the frame did without the answer once, and its decision stands whatever comes
        # now.
        if isinstance(answer, Fault) and pending.digests is not None and member.plan.is_indispensable:
            text = f"failed in frame {answer.frame}, {answer.phase}: {answer.message}"
            run.fail(f"{member} was restored and {text}", member.name, now)
            return
        # The answer itself goes nowhere: consumers have had the first one, and the journal has its decisions.
        self._compare(member, answer.frame, pending.digests, self._digests(member, answer))
        history.position += 1
        self._grant_next(member, history, now)

    def _compare(
        self, member: Member, frame: int, before: Mapping[str, str] | None, again: Mapping[str, str] | None
    ) -> None:
        if before == again:
            return
        if before is None or again is None:
            what = "FAULT" if again is None else "products, and FAULT before"
        else:
            topics = sorted(t for t in {*before, *again} if before.get(t) != again.get(t))
            what = f"another {', '.join(topics)}"
        text = (
            f"{member} answered frame {frame} again after its restart, with {what}: it is not "
            "reproducible; the run continues with what was decided"
        )
        self._run.notice("differs", member.name, text, frame)


def histories_of(
    before: Resumption, graph: Graph, plan: RunPlan, payload_size: PayloadSize
) -> dict[str, CheckpointHistory]:
    """The histories of the services of a run that goes on, as they were under the broker before."""
    # A table of its own, thrown away: it knows how the inputs of a frame are made from decisions.
    run = Run(plan, 0, before)
    run.graph = graph
    table = DecisionTable(run, Pacer(plan))
    table.resume(before.finished, before.frames, before.tasks, before.newest)
    found = {}
    for name, (frame, state) in before.states.items():
        history = found[name] = CheckpointHistory(frame=frame, state=state)
        chosen, participant = before.chosen.get(name, {}), table.participants[name]
        for number, digests in sorted(before.answered.get(name, {}).items()):
            if frame < number < before.finished:
                lacked = table.undecided_source(participant, number)
                assert lacked is None, f"frame {number} is finished, and {name} lacks an input"
                inputs = table.gather_inputs(participant, number)
                order = GrantOrder(name, number, history.last, False, inputs.inputs, inputs.products)
                history.add(AnsweredGrant(order, digests, chosen.get(number, {})), payload_size)
    return found
