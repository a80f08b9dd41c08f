"""Who is there, who is silent, who is gone: progress, loss, and deadlines (clauses 14 and 15)."""

from __future__ import annotations

from caviar_broker.core import events as ev
from caviar_broker.core.episodes import Episodes
from caviar_broker.core.run import Peer, Run
from caviar_broker.core.transitions import RunState, ServiceEvent, ServiceState

MAX_LOSSES = 5
"""A service that was lost so often without an answer in between is not waited for again."""


class Liveness:
    """Notices of life and death, and what becomes of silence.

    Args:
        run: The run.
        episodes: What services owe now.
    """

    def __init__(self, run: Run, episodes: Episodes) -> None:
        self._run = run
        self._episodes = episodes

    # --- life and death ------------------------------------------------------------------------------

    def handle_heartbeat(self, event: ev.Progressed, now: int) -> None:
        """A heartbeat."""
        self._run.peers[event.service].heartbeat(event.progress, event.phase, event.grace_ns, now)

    def handle_violation(self, event: ev.Violated, now: int) -> None:
        """A service broke the protocol beyond repair."""
        self._run.fail(f"{self._run.peers[event.service]} {event.text}", event.service, now)

    def handle_bye(self, event: ev.ByeReceived, now: int) -> None:
        """A service leaves: after SHUTDOWN, or on its own account."""
        peer = self._run.peers[event.service]
        if peer.present and self._run.over:
            peer.move(ServiceEvent.BYE, now)
        elif peer.present:
            self.handle_loss(ev.Lost(event.service, f"it left: {event.reason or 'no reason given'}"), now)

    def handle_loss(self, event: ev.Lost, now: int) -> None:
        """A service died; the run ends, unless it can do without it or wait for its return."""
        run, peer = self._run, self._run.peers[event.service]
        # Several witnesses report one death: the descriptor of its process, the launcher, the connection.
        if peer.state in (ServiceState.LOST, ServiceState.LEFT):
            return
        dispatcher = self._episodes.dispatcher if run.takes_part(peer) else None
        owed = dispatcher.outstanding(peer.name) if dispatcher else []
        text = f"{peer} died while {peer.doing}: {event.verdict}; {peer.last_words(now)}"
        if owed and dispatcher:
            died = f"died ({event.verdict})"
            text = peer.blame_task(owed[0], died, now, dispatcher.table.describe_waiting(peer.name))
        peer.verdict = event.verdict
        # Counted before it is asked whether the service may come back.
        peer.losses += 1
        peer.move(ServiceEvent.LOST, now)
        if run.over:
            return
        run.notice("lost", peer.name, text, owed[0].frame if owed else -1)
        if not run.takes_part(peer):
            return
        if not self._may_return(peer):
            run.fail(text, peer.name, now)
            return
        limit = peer.rejoin(run.plan.timeouts) / 1e9
        text = f"{peer} is away; the run waits for it for at most {limit:g} s (timeouts.rejoin_s)"
        run.notice("away", peer.name, text, owed[0].frame if owed else -1)
        if dispatcher:
            dispatcher.suspend_service(peer.name)

    def _may_return(self, peer: Peer) -> bool:
        """Whether the loss of a service is survived for a while: it was ready once, perhaps under a
        broker before, or is started by hand and can be again; and it got somewhere."""
        was_ready = peer.ready is not None or peer.plan.remote or self._run.plan.epoch > 1
        return peer.rejoin(self._run.plan.timeouts) > 0 and was_ready and peer.losses < MAX_LOSSES

    # --- deadlines -----------------------------------------------------------------------------------

    def next_deadline(self) -> int | None:
        """When the silence of a service will be too long [ns]; None: none has to say anything."""
        run = self._run
        if run.state is RunState.FINISHED:
            return None
        if run.state is RunState.STOPPING:
            return run.since + run.plan.timeouts.shutdown
        # A disk that takes nothing stalls the run as a service does.
        waiting = run.ledger.waiting_since
        earliest = None if waiting is None else waiting + run.plan.timeouts.stall
        for peer in run.peers.values():
            due = self._due(peer)
            if due is not None and (earliest is None or due < earliest):
                earliest = due
        return earliest

    def expire(self, now: int) -> None:
        """Act on silence that has been too long: the run ends with blame."""
        run = self._run
        if run.state is RunState.STOPPING:
            if run.since + run.plan.timeouts.shutdown <= now:
                self._give_up_waiting(now)
            return
        if run.over:
            return
        # The longest silence is the cause; others may be silent because they wait for that service.
        silent = [(due, p) for p in run.peers.values() if (due := self._due(p)) is not None and due <= now]
        if silent:
            _, culprit = min(silent, key=lambda pair: pair[0])
            run.fail(self._blame(culprit, now), culprit.name, now)
        elif (since := run.ledger.waiting_since) is not None and since + run.plan.timeouts.stall <= now:
            waited = run.plan.timeouts.stall / 1e9
            run.fail(f"the journal was not written for {waited:g} s; the disk may be full or gone", "", now)

    def _due(self, peer: Peer) -> int | None:
        """When a service has to have shown life or progress [ns]."""
        timeouts = self._run.plan.timeouts
        if not self._run.takes_part(peer):
            return None
        match peer.state:
            case ServiceState.EXPECTED:
                return self._run.since + timeouts.connect
            case ServiceState.PREPARING:
                return peer.silent_until(peer.since, timeouts.ready)
            case ServiceState.RESETTING | ServiceState.RESTORING:
                return peer.silent_until(peer.since, timeouts.reset)
            case ServiceState.LOST:
                return peer.since + peer.rejoin(timeouts)
            case ServiceState.ACTIVE:
                dispatcher = self._episodes.dispatcher
                task = dispatcher.awaited(peer.name) if dispatcher else None
                since = task.started_at if task else self._saving_since(peer)
                return None if since is None else peer.silent_until(since, timeouts.stall)
            case _:
                return None  # it waits for others

    def _saving_since(self, peer: Peer) -> int | None:
        """Since when a service without which the run cannot go on saves its state [ns]."""
        return self._episodes.checkpoints.saving_since(peer) if peer.plan.is_indispensable else None

    def _blame(self, peer: Peer, now: int) -> str:
        timeouts, dispatcher = self._run.plan.timeouts, self._episodes.dispatcher
        task = dispatcher.awaited(peer.name) if dispatcher and peer.state is ServiceState.ACTIVE else None
        if dispatcher and task:
            waiting = dispatcher.table.describe_waiting(peer.name)
            return peer.blame_task(task, "makes no progress (timeouts.stall_s)", now, waiting)
        match peer.state:
            case ServiceState.ACTIVE:
                since = (now - (self._saving_since(peer) or now)) / 1e9
                words = f"makes no progress (timeouts.stall_s): {since:.3g} s since CHECKPOINT"
                return f"{peer} {words}; {peer.last_words(now)}"
            case ServiceState.EXPECTED:
                missing = [p for p in self._run.peers.values() if p.state is ServiceState.EXPECTED]
                names = ", ".join(str(p) for p in missing)
                remote = [p.name for p in missing if p.plan.remote]
                hint = f"; start {' and '.join(remote)} while the run waits" if remote else ""
                waited = f"{timeouts.connect / 1e9:g} s (timeouts.connect_s)"
                return f"{names} did not connect within {waited}{hint}"
            case ServiceState.LOST:
                waited = f"{peer.rejoin(timeouts) / 1e9:g} s (timeouts.rejoin_s)"
                return f"{peer} died and did not come back within {waited}: {peer.verdict}"
            case _:
                key = "ready_s" if peer.state is ServiceState.PREPARING else "reset_s"
                return peer.blame(f"makes no progress (timeouts.{key}) while {peer.doing}", now)

    def _give_up_waiting(self, now: int) -> None:
        for peer in self._run.peers.values():
            if peer.present:
                text = f"{peer} did not say BYE in time (timeouts.shutdown_s); {peer.last_words(now)}"
                self._run.notice("lost", peer.name, text)
                peer.move(ServiceEvent.LOST, now)
