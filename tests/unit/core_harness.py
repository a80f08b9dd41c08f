"""A run in virtual time: the frame clock between simulated services, with every action checked.

`Simulation` is a shell like any other: it performs actions, feeds events and the time, and calls
`expire` when a deadline is up. Services are `Sim` objects that say how long they take, when they fail
and when they are silent. After every step `FrameClock.validate` is called, and `History` holds what
the clock sent the services against what it decided before.
"""

from __future__ import annotations

import hashlib
import heapq
import itertools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from core_history import History

from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.core.plan import Feature, RunPlan, ServicePlan, Timeouts
from caviar_broker.core.run import Resumption
from caviar_broker.core.transitions import RunState
from caviar_broker.journal import JournalFile
from caviar_protocol import messages as m
from caviar_protocol.digest import geometry_digest, payload_digest

MS = 1_000_000
SECOND = 1000 * MS


class SilentHangError(AssertionError):
    """Nothing is under way, no deadline is set, and the run is not over."""


@dataclass
class Sim:
    """One simulated service: its declaration and its behaviour.

    ``latency`` maps (episode, frame) to the time a frame takes [ns]; None: it never answers.
    """

    name: str
    role: m.Role
    inputs: tuple[m.Input, ...] = ()
    outputs: tuple[str, ...] = ()
    policy: m.Policy = "wait"
    use: str = ""
    """Implementation that the scenario names."""
    remote: bool = False
    rejoin: int | None = None
    """How long its return is waited for [ns], instead of what the timeouts say."""
    budget: int = 100 * MS
    max_in_flight: int = 1
    hello: Mapping[str, Any] = field(default_factory=dict)
    latency: int | Callable[[int, int], int | None] = MS
    faults: Mapping[tuple[int, int], str] = field(default_factory=dict)
    """(episode, frame) in which it answers with FAULT."""
    ends: frozenset[tuple[int, int]] = frozenset()
    """(episode, frame) with which it ends the episode."""
    omits: frozenset[tuple[int, int]] = frozenset()
    """(episode, frame) in which it produces nothing."""
    ready_after: int | None = MS
    reset_after: int | None = MS
    says_bye: bool = True
    assets: tuple[m.Asset, ...] = ()
    ready: Mapping[str, Any] = field(default_factory=dict)
    report: Callable[[int, int], Mapping[str, Any]] = lambda episode, frame: {}
    heartbeat: tuple[int, bool] | None = None
    """(period [ns], whether progress counts on); None: no heartbeats."""
    phase: str = "step"
    grace: int = 0
    stateful: bool = False
    """Whether its products depend on all that it was granted in the episode, and it can save that."""
    saving: int | None = MS
    """How long CHECKPOINT and RESTORE take [ns]; None: they are never answered."""
    features: tuple[Feature, ...] = ()
    """What the scenario needs it to know."""
    loads: int | None = None
    """How long it takes to load the meshes of GEOMETRY [ns]; None: it cannot, and does not name that."""
    loads_wrong: bool = False
    """Whether it says another digest than that of what it was sent."""
    refused: Mapping[str, str] = field(default_factory=dict)
    """Why a file that it announces is no mesh, by name: what the shell finds out."""
    forgets: bool = False
    """Whether a restored state is another than that which was saved."""

    def plan(self) -> ServicePlan:
        return ServicePlan(
            name=self.name,
            role=self.role,
            use=self.use,
            remote=self.remote,
            rejoin=self.rejoin,
            budget_ns=self.budget,
            policy=self.policy,
            max_in_flight=self.max_in_flight,
            features=self.features,
        )

    def takes(self, episode: int, frame: int) -> int | None:
        return self.latency if isinstance(self.latency, int) else self.latency(episode, frame)


def world(name: str = "world", **kw: Any) -> Sim:
    return Sim(name, "world", outputs=("scene",), **kw)


def channel(name: str = "channel", **kw: Any) -> Sim:
    return Sim(name, "channel", inputs=(m.Input(topic="scene"),), outputs=("channel",), **kw)


def sensors(name: str = "lidar", **kw: Any) -> Sim:
    return Sim(name, "sensors", inputs=(m.Input(topic="scene"),), outputs=("lidar",), **kw)


def agent(name: str = "agent", **kw: Any) -> Sim:
    inputs = (m.Input(topic="scene"), m.Input(topic="link", lag=1, required=False))
    return Sim(name, "agent", **{"inputs": inputs, "outputs": ("action",), **kw})


def link(name: str = "link", **kw: Any) -> Sim:
    inputs = (m.Input(topic="channel"), m.Input(topic="action", required=False))
    return Sim(name, "link", **{"inputs": inputs, "outputs": ("link",), **kw})


def recorder(name: str = "recorder", **kw: Any) -> Sim:
    return Sim(name, "recorder", inputs=(m.Input(topic="*", required=False),), **kw)


def loop(**overrides: Mapping[str, Any]) -> list[Sim]:
    """The run of design.md: world, channel, agent, link (lag 1 to the agent) and recorder."""
    makers = {"world": world, "channel": channel, "agent": agent, "link": link, "recorder": recorder}
    return [make(**overrides.get(name, {})) for name, make in makers.items()]


def product_of(source: str, topic: str, episode: int, frame: int, inputs: Iterable[m.GrantInput]) -> bytes:
    """What a deterministic service makes of its inputs: the header of a product without arrays."""
    return f"{source} {topic} {episode} {frame} {[(i.topic, i.source, i.digest) for i in inputs]}".encode()


class Simulation:
    """A run of simulated services in virtual time; `run` drives it to its end."""

    def __init__(
        self,
        services: Iterable[Sim],
        *,
        timeouts: Timeouts | None = None,
        journal_after: int = 0,
        strict: bool = True,
        journal: JournalFile | None = None,
        resumption: Resumption | None = None,
        **plan: Any,
    ) -> None:
        self.services = {sim.name: sim for sim in services}
        settings = {"frames": 5, "sampling_period_ns": 100 * MS} | plan
        self.plan = RunPlan(
            run="virtual",
            services=tuple(s.plan() for s in self.services.values()),
            timeouts=timeouts or Timeouts(),
            **settings,
        )
        self.now = SECOND  # not 0, so that a forgotten offset shows
        self.clock = FrameClock(self.plan, self.now, resumption=resumption)
        self.history = History(self.plan, self.services) if strict else None
        self.journal = journal
        self._entries: list[ev.Journal] = []
        self.journal_after = journal_after
        self.log: list[tuple[int, ev.Action]] = []
        self.busy_until: dict[str, int] = {}
        self.alive: set[str] = set()
        self._queue: list[tuple[int, int, Callable[[], None]]] = []
        self._ticket = itertools.count()
        self._progress: dict[str, int] = {}
        self.scenery: dict[str, tuple[m.Asset, ...]] = {}
        """Assets of the last PREPARE of each service."""
        self.held: dict[str, list[tuple[int, str]]] = {}
        """Geometry that services loaded since RESET: frame and digest."""
        self.states: dict[str, str] = {}
        """What is in the memory of stateful services."""

    # --- driving -------------------------------------------------------------------------------

    def join(self, *names: str, at: int = 0) -> Simulation:
        """Let services say HELLO; all of them where none is named."""
        for name in names or self.services:
            self.after(at, lambda name=name: self.hello(name))
        return self

    def hello(self, name: str, **changes: Any) -> None:
        sim = self.services[name]
        fields = {
            "version": m.PROTOCOL_VERSION,
            "name": name,
            "role": sim.role,
            "inputs": sim.inputs,
            "outputs": sim.outputs,
            "max_in_flight": sim.max_in_flight,
            "capabilities": ("checkpoint",) * sim.stateful + ("geometry",) * (sim.loads is not None),
        }
        self.alive.add(name)
        self.feed(ev.Joined(m.Hello(**(fields | dict(sim.hello) | changes))))
        if sim.heartbeat:
            self._beat(name, self.attempt(name))

    def after(self, delay: int, act: Callable[[], None]) -> None:
        heapq.heappush(self._queue, (self.now + delay, next(self._ticket), act))

    def feed(self, event: ev.Event) -> None:
        """One event, now, and whatever follows from it at once."""
        if self.history is not None:
            self.history.heard(event, {n: self.attempt(n) if n in self.alive else -1 for n in self.services})
        self.clock.receive(event, self.now)
        self.perform()

    def perform(self) -> None:
        self.clock.validate()
        for action in self.clock.actions():
            self.log.append((self.now, action))
            if self.history is not None:
                self.history.saw(action)
            match action:
                case ev.Send():
                    self._deliver(action.service, action.message, action.attachment)
                case ev.Journal(number=number):
                    self._entries.append(action)
                    self.after(self.journal_after, lambda number=number: self.journaled(number))
                case _:
                    pass

    def journaled(self, number: int) -> None:
        if self.history is not None:
            self.history.journaled = max(self.history.journaled, number)
        if self.journal is not None:
            self.journal.write([entry for entry in self._entries if entry.number <= number])
            self._entries = [entry for entry in self._entries if entry.number > number]
        self.feed(ev.Journaled(number))

    def step(self) -> bool:
        """Go on to the next thing that happens; False once the run is over."""
        if self.clock.state is RunState.FINISHED:
            return False
        deadline = self.clock.next_deadline()
        event = self._queue[0][0] if self._queue else None
        if deadline is None and event is None:
            raise SilentHangError(f"in {self.clock.state}")
        if event is not None and (deadline is None or event <= deadline):
            self.now, _, act = heapq.heappop(self._queue)
            act()
        else:
            assert deadline is not None
            self.now = max(self.now, deadline)
            self.clock.expire(self.now)
            self.perform()
            later = self.clock.next_deadline()
            assert later is None or later > self.now, "a deadline that has passed stays"
        return True

    def run(
        self, until: Callable[[Simulation], bool] = lambda run: False, steps: int = 100_000
    ) -> Simulation:
        """Until the run is over, or ``until`` says so."""
        for _ in range(steps):
            if until(self) or not self.step():
                return self
        raise AssertionError(f"no end after {steps} steps")

    def run_to(self, instant: int) -> Simulation:
        """Whatever happens up to an instant."""
        while True:
            events = [self._queue[0][0]] if self._queue else []
            deadline = self.clock.next_deadline()
            due = min(events + ([] if deadline is None else [deadline]), default=instant + 1)
            if due > instant or not self.step():
                self.now = max(self.now, instant)
                return self

    # --- the services ----------------------------------------------------------------------------

    def attempt(self, name: str) -> int:
        member = self.clock.member(name)
        assert member is not None
        return member.attempt

    def _deliver(self, name: str, message: m.Message, state: Any = None) -> None:
        if name not in self.alive:
            return
        sim, attempt = self.services[name], self.attempt(name)
        ids = {"epoch": self.plan.epoch, "attempt": attempt}
        match message:
            case m.Prepare() if sim.ready_after is not None:
                self.scenery[name] = message.assets
                own = geometry_digest(message.assets) if sim.loads is not None else ""
                fields = {"geometry": own, **sim.ready}
                self._later(name, sim.ready_after, lambda: self._get_ready(sim, m.Ready(**ids, **fields)))
            case m.Reset() if sim.reset_after is not None:
                done = m.ResetDone(**ids, episode=message.episode)
                self._later(name, sim.reset_after, lambda: self.was_reset(name, message, done))
            case m.Checkpoint() if sim.saving is not None:
                self._later(name, sim.saving, lambda: self.saved(name, message))
            case m.Restore() if sim.saving is not None:
                self._later(name, sim.saving, lambda: self.restored(name, state, ids))
            case m.Grant():
                takes = sim.takes(message.episode, message.frame)
                if takes is not None:
                    self._later(name, takes, lambda: self.answer(name, message))
            case m.Geometry() if sim.loads is not None:
                # Beside its frames, as a service fetches files.
                load = partial(self.loaded, name, message)
                self.after(sim.loads, lambda: self._if_alive(name, attempt, load))
            case m.Shutdown() if sim.says_bye:
                self._later(name, 0, lambda: self.feed(ev.ByeReceived(name, "told to")))
            case _:
                pass

    def was_reset(self, name: str, message: m.Reset, done: m.ResetDone) -> None:
        self.held.pop(name, None)
        self.states[name] = f"{name} reset to {message.seed} {message.seed_episode}"
        self.feed(ev.ResetDoneReceived(name, done))

    def loaded(self, name: str, message: m.Geometry) -> None:
        ids = {f: getattr(message, f) for f in ("epoch", "attempt", "episode", "frame")}
        digest = geometry_digest([*self.scenery[name], *message.assets])
        self.held.setdefault(name, []).append((message.frame, digest))
        told = "f" * 64 if self.services[name].loads_wrong else digest
        self.feed(ev.GeometryDoneReceived(name, m.GeometryDone(**ids, geometry=told)))

    def geometry_of(self, name: str, frame: int) -> str:
        """Digest of the geometry that a service computes a frame with; empty: that of READY."""
        held = [digest for first, digest in self.held.get(name, ()) if first <= frame]
        return held[-1] if held and held[-1] != geometry_digest(self.scenery[name]) else ""

    def saved(self, name: str, message: m.Checkpoint) -> None:
        ids = {f: getattr(message, f) for f in ("epoch", "attempt", "episode", "frame")}
        self.feed(ev.CheckpointReceived(name, m.CheckpointDone(**ids), self.states[name].encode()))

    def restored(self, name: str, state: Any, ids: Mapping[str, int]) -> None:
        self.states[name] = state.decode() + " roughly" * self.services[name].forgets
        self.feed(ev.ReadyReceived(name, m.Ready(**ids)))

    def _later(self, name: str, takes: int, act: Callable[[], None]) -> None:
        """A service does one thing at a time, and nothing once its process is gone."""
        attempt = self.attempt(name)
        self.busy_until[name] = max(self.now, self.busy_until.get(name, 0)) + takes

        self.after(self.busy_until[name] - self.now, lambda: self._if_alive(name, attempt, act))

    def _if_alive(self, name: str, attempt: int, act: Callable[[], None]) -> None:
        if name in self.alive and attempt == self.attempt(name):
            act()

    def _get_ready(self, sim: Sim, message: m.Ready) -> None:
        if sim.assets:
            self.feed(ev.AssetsOffered(sim.name, sim.assets))
        self.feed(ev.ReadyReceived(sim.name, message))

    def answer(self, name: str, grant: m.Grant, **changes: Any) -> None:
        """DONE or FAULT to a grant, as the service would send it."""
        sim, at = self.services[name], (grant.episode, grant.frame)
        ids = {f: getattr(grant, f) for f in ("epoch", "attempt", "episode", "frame")} | changes
        if at in sim.faults:
            fault = m.Fault(**ids, phase="step", message=sim.faults[at])
            self.feed(ev.FaultReceived(name, fault))
            return
        said: Any = grant.inputs
        if sim.stateful:
            told = [(i.topic, i.source, i.digest) for i in grant.inputs]
            text = f"{self.states[name]} {grant.frame} {grant.previous_frame} {told}"
            self.states[name] = hashlib.sha256(text.encode()).hexdigest()
            said = [m.GrantInput(topic="", source=self.states[name], status=m.Status.ABSENT)]
        topics = () if grant.final or at in sim.omits else sim.outputs
        made = {t: product_of(name, t, *at, said) for t in topics}
        headers = tuple(m.ProductHeader(topic=t, digest=payload_digest(h, b"")) for t, h in made.items())
        fields = {"products": headers, "end_episode": at in sim.ends, **sim.report(*at)} | ids
        if sim.loads is not None and sim.role != "world":
            fields["geometry_digest"] = self.geometry_of(name, grant.frame)
        payloads = tuple((header, b"") for header in made.values())
        self.feed(ev.DoneReceived(name, m.Done(**fields), payloads, dict(sim.refused)))

    def kill(self, name: str, verdict: str = "exit status 1") -> None:
        self.alive.discard(name)
        self.busy_until.pop(name, None)
        self.feed(ev.Lost(name, verdict))

    def _beat(self, name: str, attempt: int) -> None:
        sim = self.services[name]
        if sim.heartbeat is None or name not in self.alive or attempt != self.attempt(name):
            return
        period, advances = sim.heartbeat
        self._progress[name] = self._progress.get(name, 0) + advances
        self.feed(ev.Progressed(name, self._progress[name], sim.phase, sim.grace))
        if self.clock.state is not RunState.FINISHED:
            self.after(period, lambda: self._beat(name, attempt))

    # --- what was seen ---------------------------------------------------------------------------

    def seen(self, kind: type, service: str | None = None) -> list[Any]:
        """Actions of a kind, or messages of a kind that were sent."""
        found: list[Any] = []
        for _, action in self.log:
            thing = action.message if isinstance(action, ev.Send) and kind is not ev.Send else action
            owner = getattr(action, "service", None)
            if isinstance(thing, kind) and service in (None, owner):
                found.append(thing)
        return found

    def grants(self, service: str) -> list[m.Grant]:
        return self.seen(m.Grant, service)

    def notices(self, kind: str, service: str | None = None) -> list[ev.Notice]:
        return [n for n in self.seen(ev.Notice, service) if n.kind == kind]

    def time_of(self, service: str, frame: int, episode: int = 0) -> int:
        """When a frame was granted to a service."""
        for now, action in self.log:
            if isinstance(action, ev.Send) and action.service == service:
                grant = action.message
                if isinstance(grant, m.Grant) and (grant.episode, grant.frame) == (episode, frame):
                    return now
        raise AssertionError(f"{service} was never granted frame {frame}")

    def time_sent(self, kind: type) -> int:
        """When the first message of a kind was sent."""
        return next(t for t, a in self.log if isinstance(a, ev.Send) and isinstance(a.message, kind))

    def inputs(self, service: str, frame: int, episode: int = 0) -> dict[tuple[str, str], m.GrantInput]:
        """Inputs of a grant by (topic, source)."""
        for grant in self.grants(service):
            if (grant.episode, grant.frame) == (episode, frame):
                return {(i.topic, i.source): i for i in grant.inputs if i.status is not m.Status.LATE}
        raise AssertionError(f"{service} was never granted frame {frame}")

    @property
    def outcome(self) -> ev.Finished:
        finished = self.seen(ev.Finished)
        assert len(finished) == 1, f"finished {len(finished)} times"
        return finished[0]
