"""Frame rate that each late policy would sustain for a recorded run, and the service that bounds it.

The product's own frame clock runs in virtual time between services that take as long as recorded.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import msgspec
from msgspec.structs import replace as replace_field

from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.core.plan import RunPlan, ServicePlan, plan_run
from caviar_broker.core.transitions import RunState
from caviar_clients.replay.recorded import RecordedRun, Timing, measured_rate, timings_of
from caviar_protocol import messages as m
from caviar_protocol.arrays import quantity
from caviar_protocol.errors import RunError
from caviar_protocol.messages import Hello, Policy

NO_DIGEST = "0" * 64
Takes = Callable[[str, int, int], int]
"""``takes(service, episode, frame)``: how long a service takes [ns]."""


@dataclass
class Played:
    """What became of a run in virtual time."""

    finished_ns: list[int] = field(default_factory=list)
    """When each frame was finished."""
    misses: dict[str, int] = field(default_factory=dict)
    substituted: dict[str, int] = field(default_factory=dict)
    """Frames in which products of a service were held or absent."""

    @property
    def rate(self) -> float:
        """Frames a second, behind the warm-up frames [1/s]; infinite where they take no time."""
        first = min(10, len(self.finished_ns) // 10)
        elapsed = self.finished_ns[-1] - self.finished_ns[first]
        return (len(self.finished_ns) - 1 - first) / elapsed * 1e9 if elapsed else float("inf")


class VirtualRun:
    """One run of a plan, from HELLO to BYE; nothing is computed, and no time passes.

    Args:
        plan: The run.
        hellos: What each service declares.
        lengths: Frames of each episode, for agents to end it; of an episode not among these, those of the
            plan.
        takes: How long services take.
    """

    def __init__(
        self, plan: RunPlan, hellos: Mapping[str, m.Hello], lengths: Mapping[int, int], takes: Takes
    ) -> None:
        self._plan, self._hellos, self._lengths, self._takes = plan, hellos, lengths, takes
        self._now = 0
        self._clock = FrameClock(plan, 0)
        self._queue: list[tuple[int, int, ev.Event]] = []
        self._ticket = itertools.count()
        self._busy = dict.fromkeys(hellos, 0)
        self._played = Played(misses=dict.fromkeys(hellos, 0), substituted=dict.fromkeys(hellos, 0))
        self._error = ""

    def run(self) -> Played:
        """Play it to its end. `RunError` where the core ends it early."""
        for hello in self._hellos.values():
            self._feed(ev.Joined(hello))
        while self._clock.state is not RunState.FINISHED:
            deadline = self._clock.next_deadline()
            event = self._queue[0][0] if self._queue else None
            if event is not None and (deadline is None or event <= deadline):
                self._now, _, what = heapq.heappop(self._queue)
                self._feed(what)
            elif deadline is not None:
                self._now = max(self._now, deadline)
                self._clock.expire(self._now)
                self._perform()
            else:
                raise RunError("the run in virtual time stands still")
        if self._error:
            raise RunError(f"the run in virtual time ended early: {self._error}")
        return self._played

    def _feed(self, event: ev.Event) -> None:
        self._clock.receive(event, self._now)
        self._perform()

    def _perform(self) -> None:
        while actions := self._clock.actions():
            for action in actions:
                self._act(action)

    def _act(self, action: ev.Action) -> None:
        match action:
            case ev.Send(service=name, message=message):
                self._deliver(name, message)
            case ev.Journal(number=number, outcome=outcome, service=name):
                self._after(0, ev.Journaled(number))
                if outcome in ("overdue", "skipped"):
                    self._played.substituted[name] += 1
            case ev.Latency(service=name, missed=missed):
                self._played.misses[name] += missed
            case ev.FrameFinished():
                self._played.finished_ns.append(self._now)
            case ev.Finished(error=error):
                self._error = error
            case ev.TurnAway(refusal=refusal):
                raise RunError(f"the run in virtual time refuses {action.name!r}: {refusal.message}")
            case _:
                pass

    def _deliver(self, name: str, message: m.Message) -> None:
        epoch = self._plan.epoch
        match message:
            case m.Prepare():
                self._after(0, ev.ReadyReceived(name, m.Ready(epoch=epoch, attempt=1)))
            case m.Reset(episode=episode):
                done = m.ResetDone(epoch=epoch, attempt=1, episode=episode)
                self._after(0, ev.ResetDoneReceived(name, done))
            case m.Grant():
                self._granted(name, message)
            case m.Shutdown():
                self._after(0, ev.ByeReceived(name))
            case _:
                pass

    def _granted(self, name: str, grant: m.Grant) -> None:
        """A service does one thing after the other."""
        takes = self._takes(name, grant.episode, grant.frame)
        self._busy[name] = max(self._now, self._busy[name]) + takes
        hello = self._hellos[name]
        topics = () if grant.final else hello.outputs
        last = self._lengths.get(grant.episode, self._plan.frames) - 1
        done = m.Done(
            epoch=grant.epoch,
            attempt=grant.attempt,
            episode=grant.episode,
            frame=grant.frame,
            products=tuple(m.ProductHeader(topic=topic, digest=NO_DIGEST) for topic in topics),
            end_episode=hello.role == "agent" and grant.frame == last,
        )
        self._after(self._busy[name] - self._now, ev.DoneReceived(name, done, ((),) * len(topics)))

    def _after(self, delay: int, event: ev.Event) -> None:
        heapq.heappush(self._queue, (self._now + delay, next(self._ticket), event))


POLICIES: tuple[Policy, ...] = ("wait", "hold", "drop")
STRICT = ("world", "recorder")
"""Roles for which there is no policy but to wait (clause 9)."""
MARGIN = 0.2
"""Beyond the 99th percentile that a suggested budget leaves."""
LONGEST = 1000
"""Frames that are played at most."""
TOLERANCE = 0.15
"""By which prediction and measurement may differ without a word."""
FACTOR_STEPS = 12
"""Halvings in the search for how much faster a service has to be."""


class ServiceForecast(msgspec.Struct, frozen=True, kw_only=True):
    """One service."""

    name: str
    p50_ms: float
    p99_ms: float
    budget_ms: float
    suggested_ms: Annotated[float, quantity("ms", "99th percentile and a margin of 20 %, rounded up")]
    alone: Annotated[float, quantity("1/s", "frame rate were it the only one to take time")]
    without: Annotated[float | None, quantity("1/s", "frame rate under wait if it took no time")]
    """None: without bound."""
    misses: dict[str, int]
    """Of each policy."""
    substituted: dict[str, int]
    """Frames in which its products were held or absent, of each policy."""


class Bound(msgspec.Struct, frozen=True, kw_only=True):
    """Which service bounds the frame rate under wait."""

    service: str
    gain: float
    """Factor by which the frame rate grew if it took no time."""
    realtime_factor: float | None
    """How many times as fast it has to be for real time; 1: it is; None: that alone does not suffice."""


class Forecast(msgspec.Struct, frozen=True, kw_only=True):
    """What a recorded run tells about runs like it."""

    run: str
    frames: int
    """That were played."""
    measured: Annotated[float, quantity("1/s", "frame rate of the recorded run")]
    predicted: Annotated[float, quantity("1/s", "frame rate of the recorded policies at full speed")]
    realtime: Annotated[float, quantity("1/s", "frame rate of real time")]
    rates: Annotated[dict[str, float], quantity("1/s", "frame rate of each policy")]
    bound: Bound
    services: list[ServiceForecast]
    notes: list[str]


def forecast(run: RecordedRun, margin: float = MARGIN) -> Forecast:
    """Play a recorded run under each policy, with its latencies as times of the services.

    Raises `RecordingError` where there are no latencies beside the recording.
    """
    timings = timings_of(run)
    stage = _Stage(run, timings)
    played = {policy: stage.play(policy) for policy in POLICIES}
    without = {name: stage.play("wait", {name: 0.0}).rate for name in timings}
    alone = {name: stage.play("wait", {n: 0.0 for n in timings if n != name}).rate for name in timings}
    rate, measured, predicted = played["wait"].rate, measured_rate(run), stage.play(None).rate
    realtime = 1e9 / run.scenario.run.sampling_period_ns
    slowest = max(timings, key=lambda name: (without[name], -alone[name]))
    return Forecast(
        run=run.recording.metadata.run,
        frames=stage.frames,
        measured=measured,
        predicted=predicted,
        realtime=realtime,
        rates={policy: result.rate for policy, result in played.items()},
        bound=Bound(
            service=slowest,
            gain=without[slowest] / rate if math.isfinite(without[slowest]) else math.inf,
            realtime_factor=stage.factor(slowest, realtime, rate),
        ),
        services=[
            ServiceForecast(
                name=name,
                p50_ms=timing.typical / 1e6,
                p99_ms=timing.p99 / 1e6,
                budget_ms=run.scenario.services[name].budget_ms,
                suggested_ms=rounded_up(timing.p99 / 1e6 * (1 + margin)),
                alone=alone[name],
                without=without[name] if math.isfinite(without[name]) else None,
                misses={policy: result.misses[name] for policy, result in played.items()},
                substituted={policy: result.substituted[name] for policy, result in played.items()},
            )
            for name, timing in timings.items()
        ],
        notes=[*_unexplained(run, measured, predicted), *_notes(run, timings, stage.frames)],
    )


def rounded_up(value: float) -> float:
    """To two digits, at least 0.1."""
    step = 10.0 ** (math.floor(math.log10(max(value, 0.1))) - 1)
    return round(math.ceil(max(value, 0.1) / step - 1e-9) * step, 6)


class _Stage:
    """Plays a recorded run under policies, with services that are faster or slower than they were."""

    def __init__(self, run: RecordedRun, timings: Mapping[str, Timing]) -> None:
        self._run, self._timings = run, timings
        self._hellos = {name: self._served(name) for name in timings}
        self._lengths = run.lengths
        self._plan = _plan(run, self._hellos)
        self.frames = min(sum(run.lengths.values()), self._plan.frames * self._plan.episodes)

    def _served(self, name: str) -> Hello:
        """What it declares; parts are of no matter here, and grants queue as far as the scenario says."""
        return replace_field(self._run.hellos[name], max_in_flight=64)

    def play(self, policy: Policy | None, factors: Mapping[str, float] | None = None) -> Played:
        """``policy``: of all services that may have it, or None for those of the scenario; ``factors``: by
        which a service's times are multiplied."""
        factors = factors or {}
        services = tuple(_under(service, policy) for service in self._plan.services)

        def takes(name: str, episode: int, frame: int) -> int:
            return round(self._timings[name].at(episode, frame) * factors.get(name, 1.0))

        plan = replace(self._plan, services=services)
        return VirtualRun(plan, self._hellos, self._lengths, takes).run()

    def factor(self, name: str, target: float, rate: float) -> float | None:
        """How many times as fast a service has to be for a frame rate; None: no factor suffices."""
        if rate >= target:
            return 1.0
        if self.play("wait", {name: 0.0}).rate < target:
            return None
        low, high = 0.0, 1.0  # share of its time: enough, and too much
        for _ in range(FACTOR_STEPS):
            middle = (low + high) / 2
            if self.play("wait", {name: middle}).rate >= target:
                low = middle
            else:
                high = middle
        return 1.0 / low if low else None


def _under(service: ServicePlan, policy: Policy | None) -> ServicePlan:
    """A service under a policy; only one that waits can have several grants."""
    if policy is None:
        return service
    if service.role in STRICT or policy == "wait":
        return replace(service, policy="wait")
    return replace(service, policy=policy, max_in_flight=1)


def _unexplained(run: RecordedRun, measured: float, predicted: float) -> list[str]:
    if (
        not measured
        or run.scenario.run.pace not in ("free", "fast")
        or abs(predicted / measured - 1.0) <= TOLERANCE
    ):
        return []
    text = f"the recorded run had {measured:.1f} frames/s where its latencies lead to {predicted:.1f}"
    return [f"{text}: services did not overlap, as in one process, or what is between them took time too"]


def _plan(run: RecordedRun, hellos: Mapping[str, Hello]) -> RunPlan:
    """As the broker plans the scenario, at full speed, with its first frames where there are many."""
    plan = plan_run(run.scenario, "virtual", {})
    frames = min(max(run.lengths.values()), LONGEST)
    return replace(
        plan,
        services=tuple(s for s in plan.services if s.name in hellos),
        frames=frames,
        episodes=max(1, min(len(run.lengths), LONGEST // frames)),
        realtime=False,
        limits=replace(plan.limits, stall=10**15, reset=10**15, ready=10**15),
    )


def _notes(run: RecordedRun, timings: Mapping[str, Timing], frames: int) -> list[str]:
    notes = []
    total = sum(run.lengths.values())
    if frames < total:
        notes.append(f"the first {frames} of {total} frames were played")
    for name, timing in timings.items():
        if not timing.exact:
            notes.append(f"latencies of {name} are not one a frame: they were taken in their order")
    for report in run.recording.entry(0).reports:
        if report.decisions and report.source in timings:
            notes.append(
                f"{report.source} decided for its recorded budget ({', '.join(report.decisions)}); with "
                "another one its latencies become others"
            )
    for name, spec in run.scenario.services.items():
        if spec.remote:
            notes.append(f"what {name} takes is not recorded: it is played as if it took nothing")
    return notes
