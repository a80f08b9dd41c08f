"""What the parts of the frame clock share: the peers, the state of the run, and what shall be done."""

from __future__ import annotations

from typing import Any

from caviar_broker.core.events import Action, Finished, Journal, Notice, Product, Send
from caviar_broker.core.gate import Gate
from caviar_broker.core.graph import Graph
from caviar_broker.core.ledger import Ledger
from caviar_broker.core.peers import Peer
from caviar_broker.core.plan import RunPlan
from caviar_broker.core.resumption import Resumption
from caviar_broker.core.transitions import RUN, RunEvent, RunState, step
from caviar_protocol.digest import RunDigest
from caviar_protocol.messages import Error, Message, Shutdown, Stale


class Run:
    """One run: its present state, its services, and the actions that wait to be carried out."""

    def __init__(self, plan: RunPlan, now: int, resumption: Resumption | None = None) -> None:
        self.plan = plan
        self.resumption = resumption
        """What another broker left of the run, until it goes on."""
        self.state = RunState.JOINING
        self.since = now
        """When the present state began [ns]."""
        self.peers = {service.name: Peer(service, since=now) for service in plan.services}
        self.graph: Graph | None = None
        """Known once all services have joined."""
        self.episode = 0
        self.seed = plan.seed
        """Of the present episode."""
        self.seed_episode = 0
        """Episodes since the first one with this seed."""
        self._wished: tuple[int, Peer] | None = None
        """Seed of the next episode, and the agent that chose it."""
        self.digest = RunDigest()
        self.finished_before = 0
        """Frames of the episodes that are over."""
        self.gate = Gate()
        self.ledger = Ledger(kept=not plan.ephemeral)
        self.over = False
        """Whether the run has ended, if perhaps not everybody has left."""
        if resumption is not None:
            self._take_over(resumption)
        self.error = ""
        self.culprit = ""
        self.actions: list[Action] = []

    def _take_over(self, before: Resumption) -> None:
        self.episode, self.seed, self.seed_episode = before.episode, before.seed, before.seed_episode
        self.digest, self.finished_before = before.digest, before.finished_before
        self.ledger.last = self.ledger.written = before.entries
        if before.wish is not None:
            self._wished = before.wish[0], self.peers[before.wish[1]]

    def takes_part(self, peer: Peer) -> bool:
        """Whether the run needs a service: all until the graph is known, then those in it (clause 5)."""
        return self.graph is None or peer.name in self.graph.inputs

    # --- seeds (clause 16) -------------------------------------------------------------------------

    def wish(self, seed: int, peer: Peer, now: int) -> None:
        """An agent chooses the seed of the next episode."""
        if self._wished is not None and self._wished[0] != seed and self._wished[1] is not peer:
            other = self._wished[1]
            self.fail(
                f"{other} and {peer} choose different seeds, {self._wished[0]} and {seed}", peer.name, now
            )
        self._wished = seed, peer

    def next_seed(self) -> None:
        """An episode begins: with the seed that was chosen, or the one before."""
        if self._wished is not None:
            self.seed, self.seed_episode, self._wished = self._wished[0], 0, None
        elif self.episode:
            self.seed_episode += 1

    # --- transitions of the run --------------------------------------------------------------------

    def enter(self, event: RunEvent, now: int) -> None:
        """Take a transition of the table."""
        self.state, self.since = step(RUN, self.state, event), now
        self.over = self.state in (RunState.STOPPING, RunState.FINISHED)

    def fail(self, error: str, culprit: str, now: int) -> None:
        """End the run with blame; the first blame counts."""
        if not self.over:
            self.error, self.culprit = error, culprit
            self.stop(error, now)

    def stop(self, reason: str, now: int) -> None:
        """End the run: everybody shall leave."""
        self.enter(RunEvent.STOP, now)
        for peer in self.peers.values():
            if peer.present:
                self.send(peer, Shutdown(reason=reason, grace_ns=self.plan.limits.shutdown))

    def finish_if_alone(self, now: int) -> None:
        """The run is finished once everybody has left."""
        if self.state is RunState.STOPPING and not any(peer.present for peer in self.peers.values()):
            self.enter(RunEvent.ALL_GONE, now)
            digest = "" if self.plan.ephemeral else self.digest.hexdigest()
            self.actions.append(Finished(self.error, self.culprit, digest))

    # --- what goes out -------------------------------------------------------------------------------

    def send(
        self, peer: Peer, message: Message, products: tuple[Product, ...] = (), attachment: Any = None
    ) -> None:
        """Have a message sent."""
        self.actions.append(Send(peer.name, message, products, attachment))

    def enter_journal(self, outcome: str, service: str, frame: int, now: int, **facts: Any) -> None:
        """Have something written down that is no decision about a task."""
        if not self.plan.ephemeral:
            number = self.ledger.enter(now)
            self.actions.append(Journal(number, self.episode, frame, service, outcome, **facts))

    def notice(self, kind: str, service: str, text: str, frame: int = -1) -> None:
        """Have something told to the user."""
        self.actions.append(Notice(kind, service, text, self.episode, frame))

    # --- what came out of turn -----------------------------------------------------------------------

    def current(self, peer: Peer, epoch: int, attempt: int, kind: str, outstanding: int = -1) -> bool:
        """Clause 1: whether a message is of this broker's and this service's present incarnation."""
        if peer.present and (epoch, attempt) == (self.plan.epoch, peer.attempt):
            return True
        self.stale(peer, kind, f"{kind} of epoch {epoch}, attempt {attempt}", outstanding)
        return False

    def stale(self, peer: Peer, kind: str, what: str, outstanding: int = -1) -> None:
        """Answer a message that matches nothing outstanding (clause 1)."""
        self.notice("stale", peer.name, f"{what} matches nothing that is outstanding; not used")
        if peer.present:
            answer = Stale(
                of=kind,
                epoch=self.plan.epoch,
                attempt=peer.attempt,
                episode=self.episode,
                frame=outstanding,
            )
            self.send(peer, answer)

    def unexpected(self, peer: Peer, kind: str, when: str) -> None:
        """Answer a message that came out of turn."""
        self.notice("stale", peer.name, f"{kind} came out of turn: it is expected {when}; not used")
        if peer.present:
            self.send(peer, Error(code="unexpected", of=kind, message=f"{kind} is expected {when}"))
