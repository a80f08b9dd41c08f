"""A second opinion: what the clock tells services, held against what it decided before.

`History` knows the contract and the declarations, not the scheduler. It is fed with the clock's
actions one by one and raises AssertionError, naming the clause, at the first that contradicts.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from caviar_broker.core import events as ev
from caviar_broker.core.plan import RunPlan
from caviar_protocol import messages as m
from caviar_protocol.digest import RunDigest

if TYPE_CHECKING:
    from core_harness import Sim


class History:
    """Decisions, grants and answers of a run as its services and its journal see them."""

    def __init__(self, plan: RunPlan, services: Mapping[str, Sim]) -> None:
        self.plan, self.services = plan, services
        self.journaled = 0
        self.numbers = 0
        self.decisions: dict[tuple[int, int, str], ev.Journal] = {}
        """(episode, frame, service) to its one decision."""
        self.next_frame: dict[tuple[int, str], int] = {}
        self.owed: dict[str, list[tuple[int, int]]] = {}
        self.known: dict[tuple[int, str, str], list[tuple[int, int]]] = {}
        """(episode, service, topic) to (frame, journal number) of products in the journal."""
        self.frames: list[tuple[int, int]] = []
        self.episodes: list[int] = []
        self.granted: dict[tuple[str, int, int], m.Grant] = {}
        self.answered: dict[tuple[int, str], dict[int, m.Grant]] = {}
        """Grants that were answered, by (episode, service) and frame."""
        self.saved: dict[tuple[int, str], int] = {}
        """Frame of the last checkpoint by (episode, service)."""
        self.cancelled: set[tuple[str, int, int]] = set()
        self.finished = False

    def heard(self, event: ev.Event, attempts: Mapping[str, int]) -> None:
        """Take note of an answer to the oldest grant that is owed."""
        if isinstance(event, ev.DoneReceived | ev.FaultReceived):
            answer, owed = event.message, self.owed.get(event.service, [])
            current = (answer.epoch, answer.attempt) == (self.plan.epoch, attempts[event.service])
            if current and owed[:1] == [(answer.episode, answer.frame)]:
                owed.pop(0)
                key = (answer.episode, answer.frame)
                self.answered.setdefault((answer.episode, event.service), {})[answer.frame] = self.granted[
                    event.service, *key
                ]

    def saw(self, action: ev.Action) -> None:
        """Check one action and remember it."""
        assert not (self.finished and isinstance(action, ev.Send)), f"{action} after the end"
        match action:
            case ev.Journal():
                self._journal(action)
            case ev.Send(message=m.Grant() as grant):
                self._grant(action, grant)
            case ev.Send(message=m.Cancel() as cancel):
                self.cancelled.add((action.service, cancel.episode, cancel.frame))
            case ev.FrameFinished():
                self._frame(action)
            case ev.EpisodeFinished():
                assert action.episode == len(self.episodes), "episodes out of order"
                self.episodes.append(action.frames)
            case ev.Finished():
                assert not self.finished, "finished twice"
                self.finished = True
                self._finished(action)
            case _:
                pass

    def _journal(self, entry: ev.Journal) -> None:
        assert entry.number == self.numbers + 1, "journal entries are numbered without gaps"
        self.numbers = entry.number
        if entry.outcome in ("episode", "resumed", "end", "seed", "checkpoint", "geometry"):
            self._turn(entry)
            return
        key = (entry.episode, entry.frame, entry.service)
        if entry.outcome != "late":
            assert key not in self.decisions, f"{key} decided twice"
            first = self.next_frame.get((entry.episode, entry.service), 0)
            assert entry.frame == first, f"{entry.service} decides {entry.frame} before {first}"
            self.next_frame[entry.episode, entry.service] = first + 1
            for decision in entry.decisions:
                self._decision(entry, decision)
            self.decisions[key] = entry
        for product in entry.products:
            assert product.frame == entry.frame, "clause 11: a product stands under its true frame"
            known = self.known.setdefault((entry.episode, entry.service, product.topic), [])
            known.append((product.frame, entry.number))

    def _turn(self, entry: ev.Journal) -> None:
        """An entry about the run, or about the state of a service."""
        if entry.outcome == "checkpoint" and entry.frame >= 0:
            name, key = entry.service, (entry.episode, entry.service)
            assert not self.owed.get(name), f"{name} saved its state with {self.owed[name]} outstanding"
            answered = self.answered.get(key, {})
            assert entry.frame == max(answered), (
                f"{name} saved {entry.frame}, it has answered {max(answered)}"
            )
            self.saved[key] = entry.frame

    def _again(self, send: ev.Send, grant: m.Grant) -> bool:
        """A grant that was answered is only sent again to a service that has lost it, as it was."""
        before = self.answered.get((grant.episode, send.service), {}).get(grant.frame)
        if before is None:
            return False
        what = f"clause 18: {send.service} was granted frame {grant.frame} again"
        assert grant.attempt > before.attempt or grant.epoch > before.epoch, what
        assert grant.frame > self.saved.get((grant.episode, send.service), -1), f"{what} before its state"
        assert before.decisions.items() <= grant.decisions.items(), f"{what} with other decisions"
        for field in ("previous_frame", "inputs", "final", "t_ns"):
            assert getattr(grant, field) == getattr(before, field), f"{what} with another {field}"
        return True

    def _decision(self, entry: ev.Journal, decision: m.GrantInput) -> None:
        what = f"{decision} of {entry.service} in frame {entry.frame}"
        policy = self.services[entry.service].policy
        known = [f for f, _ in self.known.get((entry.episode, entry.service, decision.topic), [])]
        match decision.status:
            case m.Status.FRESH:
                assert decision.frame == entry.frame, f"clause 11: {what}"
                assert decision.age == 0, what
            case m.Status.HELD:
                assert policy == "hold", f"clause 9: {what}"
                assert decision.age == entry.frame - decision.frame >= 1, f"clause 9: {what}"
                assert decision.frame == max(known), f"clause 12: {what}, there is {max(known)}"
                assert decision.cause, f"clause 14: {what}"
            case m.Status.ABSENT:
                assert decision.cause, f"clause 14: {what}"
                assert decision.frame == -1, what
            case m.Status.LATE:
                raise AssertionError(f"clause 11: {what}")

    def _grant(self, send: ev.Send, grant: m.Grant) -> None:
        name, frame, episode = send.service, grant.frame, grant.episode
        sim = self.services[name]
        what = f"grant of frame {frame} of episode {episode} to {name}"
        if self._again(send, grant):
            return
        self.granted[name, episode, frame] = grant
        last = self.plan.frames if sim.role == "agent" else self.plan.frames - 1
        assert frame <= last, what
        assert grant.final == (frame == self.plan.frames) or grant.final, f"clause 16: {what}"
        assert not grant.final or sim.role == "agent", f"clause 16: {what}"
        owed = self.owed.setdefault(name, [])
        if (episode, frame) not in owed:  # else it is sent again after a rejoin
            owed.append((episode, frame))
            capacity = sim.max_in_flight if sim.policy == "wait" else 1
            assert len(owed) <= capacity, f"clause 7: {what}, owed are {owed}"
            assert owed == sorted(owed), f"{what} out of order"
            self._safe(name, episode, frame)
        for entry in grant.inputs:
            if entry.status is m.Status.LATE:
                assert sim.role == "recorder", f"clause 11: {what}"
                assert entry.frame <= frame, what
            else:
                self._input(what, sim, grant, entry)
        present = [i for i in grant.inputs if i.status is not m.Status.ABSENT]
        assert [(i.topic, i.source, i.frame) for i in present] == [
            (p.topic, p.source, p.frame) for p in send.products
        ], f"{what}: products do not follow their inputs"

    def _input(self, what: str, sim: Sim, grant: m.Grant, entry: m.GrantInput) -> None:
        declared = [i for i in sim.inputs if i.topic in (entry.topic, "*")]
        lags = {i.lag for i in declared} - ({0} if grant.final else set())
        for lag in sorted(lags):
            if grant.frame < lag:
                assert entry.status is m.Status.ABSENT, f"{what}: {entry} in the first frame"
                return
            decided = self.decisions.get((grant.episode, grant.frame - lag, entry.source))
            assert decided is not None, f"clause 7: {what} before {entry.topic} of {entry.source}"
            by_topic = {d.topic: d for d in decided.decisions}
            then = by_topic[entry.topic]
            if (then.status, then.frame, then.digest) == (entry.status, entry.frame, entry.digest):
                self._required(what, declared, entry)
                if lag or entry.status is m.Status.HELD:
                    self._in_journal(what, grant.episode, entry, decided)
                return
        raise AssertionError(f"{what}: {entry} was decided otherwise")

    def _required(self, what: str, declared: list[m.Input], entry: m.GrantInput) -> None:
        if entry.status is m.Status.ABSENT:
            assert not all(i.required for i in declared), f"clause 10: {what} without {entry.topic}"

    def _in_journal(self, what: str, episode: int, entry: m.GrantInput, decided: ev.Journal) -> None:
        number = decided.number
        if entry.status is m.Status.HELD:
            known = self.known[episode, entry.source, entry.topic]
            number = next(n for f, n in known if f == entry.frame)
        assert number <= self.journaled, f"clause 18: {what} relies on unwritten entry {number}"

    def _safe(self, name: str, episode: int, frame: int) -> None:
        own = self.decisions.get((episode, frame - 1, name))
        if own is not None:
            assert own.number <= self.journaled, f"clause 18: {name} granted {frame} too early"

    def _frame(self, action: ev.FrameFinished) -> None:
        assert (action.episode, action.frame) not in self.frames, "a frame finished twice"
        assert not self.frames or (action.episode, action.frame) > self.frames[-1], "frames out of order"
        self.frames.append((action.episode, action.frame))

    def _finished(self, action: ev.Finished) -> None:
        """Clause 20: the digest is what the journal gives, whatever the order of events was."""
        chain = RunDigest()
        for episode, frame in self.frames:
            entries = [e for (p, f, _), e in self.decisions.items() if (p, f) == (episode, frame)]
            fresh = [
                (d.topic, d.source, d.digest)
                for entry in entries
                for d in entry.decisions
                if d.status is m.Status.FRESH
            ]
            chain.add_frame(episode, frame, fresh)
        assert action.digest == chain.hexdigest(), "clause 20: the digest is another"
