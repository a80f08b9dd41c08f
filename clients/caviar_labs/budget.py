"""Frame rate that each late policy would sustain for a recorded run, and the service that bounds it.

The broker's own frame clock runs in virtual time between services that take as long as recorded
(`VirtualRun`): nothing is computed, and no time passes.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated

import msgspec
from msgspec import structs

from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.core.plan import RunPlan, ServicePlan, plan_run
from caviar_broker.core.transitions import RunState
from caviar_clients.replay.recorded import RecordedRun
from caviar_labs.latencies import Timing, measured_rate, timings_of
from caviar_protocol import messages as m
from caviar_protocol.arrays import quantity
from caviar_protocol.errors import RunError
from caviar_protocol.messages import Hello, Policy
from caviar_protocol.scenario import Scenario

POLICIES: tuple[Policy, ...] = ("wait", "hold", "drop")
MARGIN = 0.2
"""Share of the 99th percentile that a suggested budget leaves beyond it."""
TOLERANCE = 0.15
"""Relative difference of prediction and measurement from which a note says so."""
FACTOR_STEPS = 12
"""Halvings in the search for how much faster a service has to be: a step of 1/4096 of its time."""

NO_DIGEST = "0" * 64
STRICT = ("world", "recorder")
"""Roles for which there is no policy but to wait (clause 9)."""
LONGEST = 1000
"""Frames of a run in virtual time, at most."""
Takes = Callable[[str, int, int], int]
"""``takes(service, episode, frame)``: how long a service takes [ns]."""


class ServiceForecast(msgspec.Struct, frozen=True, kw_only=True):
    """Time of a service, and frame rates of the run with it alone and without it."""

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
    """The service that bounds the frame rate under wait."""

    service: str
    gain: float
    """Factor by which the frame rate grew if it took no time."""
    realtime_factor: float | None
    """How many times as fast it has to be for real time; 1: it is; None: that alone does not suffice."""


class Forecast(msgspec.Struct, frozen=True, kw_only=True):
    """Frame rates that runs like a recorded one sustain, by policy."""

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
    """Play a recorded run under each late policy, with its latencies as times of the services.

    Args:
        run: What was recorded.
        margin: Share of the 99th percentile that a suggested budget leaves beyond it.

    Raises:
        RecordingError: There are no latencies beside the recording.
        RunError: The run in virtual time ends early.

    Example:
        >>> from caviar_protocol.recording import Recording
        >>> found = forecast(RecordedRun(Recording("runs/smoke-20261122-101500")))
        >>> sorted(found.rates)
        ['drop', 'hold', 'wait']
    """
    timings = timings_of(run)
    stage = _Stage(run, timings)
    played = {policy: stage.play(policy) for policy in POLICIES}
    without = {name: stage.play("wait", {name: 0.0}).rate for name in timings}
    alone = {name: stage.play("wait", {n: 0.0 for n in timings if n != name}).rate for name in timings}
    rate, measured, predicted = played["wait"].rate, measured_rate(run), stage.play(None).rate
    realtime = 1e9 / run.scenario.run.sampling_period_ns
    # Of services without which the run is equally fast, the one that is slowest alone.
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
    """Round up to two digits, and to 0.1 at least.

    Example:
        >>> rounded_up(12.31), rounded_up(0.03)
        (13.0, 0.1)
    """
    step = 10.0 ** (math.floor(math.log10(max(value, 0.1))) - 1)
    # Less a billionth: 0.12 / 0.01 is a little more than 12.
    return round(math.ceil(max(value, 0.1) / step - 1e-9) * step, 6)


class _Stage:
    """Plays a recorded run under policies, with services that are faster or slower than they were."""

    def __init__(self, run: RecordedRun, timings: Mapping[str, Timing]) -> None:
        self._run, self._timings = run, timings
        self._hellos = {name: self._served(name) for name in timings}
        self._lengths = run.lengths
        self._plan = virtual_plan(run.scenario, self._hellos, run.lengths)
        self.frames = min(sum(run.lengths.values()), self._plan.frames * self._plan.episodes)

    def _served(self, name: str) -> Hello:
        """HELLO of a service, which takes as many grants in flight as the scenario allows."""
        return structs.replace(self._run.hellos[name], max_in_flight=64)

    def play(self, policy: Policy | None, factors: Mapping[str, float] | None = None) -> Played:
        """Play the run.

        Args:
            policy: Of all services that may have it; None: those of the scenario.
            factors: What the times of services are multiplied by.
        """
        factors = factors or {}

        def takes(name: str, episode: int, frame: int) -> int:
            return round(self._timings[name].at(episode, frame) * factors.get(name, 1.0))

        return VirtualRun(under_policy(self._plan, policy), self._hellos, self._lengths, takes).run()

    def factor(self, name: str, target: float, rate: float) -> float | None:
        """Search how many times as fast a service has to be for a frame rate.

        Args:
            name: Of the service.
            target: Frame rate that is wanted [1/s].
            rate: Frame rate under wait as it is [1/s].

        Returns:
            1 where it is fast enough; None where no factor suffices.
        """
        if rate >= target:
            return 1.0
        if self.play("wait", {name: 0.0}).rate < target:
            return None
        # By bisection: the frame rate falls with the time of a service, in steps that no formula has.
        low, high = 0.0, 1.0  # share of its time: enough, and too much
        for _ in range(FACTOR_STEPS):
            middle = (low + high) / 2
            if self.play("wait", {name: middle}).rate >= target:
                low = middle
            else:
                high = middle
        return 1.0 / low if low else None


def _unexplained(run: RecordedRun, measured: float, predicted: float) -> list[str]:
    # A run in real time waits for its clock: its rate says nothing of its services.
    if (
        not measured
        or run.scenario.run.pace not in ("free", "fast")
        or abs(predicted / measured - 1.0) <= TOLERANCE
    ):
        return []
    text = f"the recorded run had {measured:.1f} frames/s where its latencies lead to {predicted:.1f}"
    return [f"{text}: services did not overlap, as in one process, or what is between them took time too"]


def _notes(run: RecordedRun, timings: Mapping[str, Timing], frames: int) -> list[str]:
    notes = []
    total = sum(run.lengths.values())
    if frames < total:
        notes.append(f"the first {frames} of {total} frames were played")
    for name, timing in timings.items():
        if not timing.exact:
            notes.append(f"latencies of {name} are not one a frame: they were taken in their order")
    # The first frame has what every frame has: a service decides in all of them, or in none.
    for report in run.recording.entry(0).reports:
        # An agent decides with the policy that it has, whatever its budget.
        by_budget = run.scenario.services[report.source].role != "agent"
        if report.decisions and by_budget and report.source in timings:
            notes.append(
                f"{report.source} decided for its recorded budget ({', '.join(report.decisions)}); with "
                "another one its latencies become others"
            )
    for name, spec in run.scenario.services.items():
        if spec.remote:
            notes.append(f"what {name} takes is not recorded: it is played as if it took nothing")
    return notes


@dataclass
class Played:
    """Frames and misses of a run in virtual time."""

    finished_ns: list[int] = field(default_factory=list)
    """When each frame was finished [ns]."""
    misses: dict[str, int] = field(default_factory=dict)
    """Deadlines that each service missed."""
    substituted: dict[str, int] = field(default_factory=dict)
    """Frames in which products of a service were held or absent."""

    @property
    def rate(self) -> float:
        """Frame rate after the warm-up frames [1/s]; infinite where frames take no time."""
        # A tenth of a short run, at most ten frames: as `Statistics` leaves them out of a measured rate.
        first = min(10, len(self.finished_ns) // 10)
        elapsed = self.finished_ns[-1] - self.finished_ns[first]
        return (len(self.finished_ns) - 1 - first) / elapsed * 1e9 if elapsed else float("inf")


class VirtualRun:
    """One run of a plan, from HELLO to BYE.

    Args:
        plan: The run, as `virtual_plan` makes it.
        hellos: What each service declares, by name.
        lengths: Frames of each episode, for agents to end it; other episodes have those of the plan.
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
        """Play the run to its end.

        Raises:
            RunError: The clock ends the run early, or waits for nothing.
        """
        for hello in self._hellos.values():
            self._feed(ev.Joined(hello))
        while self._clock.state is not RunState.FINISHED:
            deadline = self._clock.next_deadline()
            event = self._queue[0][0] if self._queue else None
            # An answer at its deadline is in time.
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
            # A journal takes no time here; without its answer the clock would hold back what depends on it.
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
        """Answer a grant once the service has done all it was granted before: it does one at a time."""
        # A final grant carries the link to an agent, which answers without a product.
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
        # The ticket keeps events of one instant in their order; without it tuples would compare events.
        heapq.heappush(self._queue, (self._now + delay, next(self._ticket), event))


def virtual_plan(scenario: Scenario, services: Collection[str], lengths: Mapping[int, int]) -> RunPlan:
    """Plan a run in virtual time as the broker plans a scenario: at full speed, and without a limit of time.

    Args:
        scenario: What was run.
        services: Names of the services that take part.
        lengths: Frames of each episode; of many, the first `LONGEST` are planned.
    """
    plan = plan_run(scenario, "virtual", {})
    frames = min(max(lengths.values()), LONGEST)
    return replace(
        plan,
        services=tuple(s for s in plan.services if s.name in services),
        frames=frames,
        episodes=max(1, min(len(lengths), LONGEST // frames)),
        realtime=False,
        # [ns] Eleven days: a service that is slow in virtual time is slow, and not lost.
        timeouts=replace(plan.timeouts, stall=10**15, reset=10**15, ready=10**15),
    )


def under_policy(plan: RunPlan, policy: Policy | None) -> RunPlan:
    """Put the services of a plan under one late policy.

    Args:
        plan: The run.
        policy: Of all services but worlds and recorders, which wait; None: each keeps its own.
    """
    return replace(plan, services=tuple(_under(service, policy) for service in plan.services))


def _under(service: ServicePlan, policy: Policy | None) -> ServicePlan:
    """A service under a policy; only one that waits can have several grants in flight."""
    if policy is None:
        return service
    if service.role in STRICT or policy == "wait":
        return replace(service, policy="wait")
    return replace(service, policy=policy, max_in_flight=1)
