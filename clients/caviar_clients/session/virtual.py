"""A run in virtual time: the broker's own frame clock between services that take as long as they are said to.

Nothing is computed, and no time passes.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace

from caviar_broker.core import events as ev
from caviar_broker.core.clock import FrameClock
from caviar_broker.core.plan import RunPlan, ServicePlan, plan_run
from caviar_broker.core.transitions import RunState
from caviar_protocol import messages as m
from caviar_protocol.errors import RunError
from caviar_protocol.messages import Policy
from caviar_protocol.scenario import Scenario

NO_DIGEST = "0" * 64
STRICT = ("world", "recorder")
"""Roles for which there is no policy but to wait (clause 9)."""
LONGEST = 1000
"""Frames of a run in virtual time, at most."""
Takes = Callable[[str, int, int], int]
"""``takes(service, episode, frame)``: how long a service takes [ns]."""


@dataclass
class Played:
    """What became of a run in virtual time."""

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
