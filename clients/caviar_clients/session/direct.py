"""Frames in the order of the graph, without a clock: for a run in one process that nothing records.

Where every frame waits for every service and products have no digest, the frame clock has nothing to decide:
each service gets what its sources have just made. `DirectFrames` plays that order from the first RESET on.
Products, inputs, seeds and blame are those of the clock (contract, clauses 6, 10, 16 and 19).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field

from caviar_broker.core import events as ev
from caviar_broker.core.graph import Edge, Graph
from caviar_broker.core.plan import RunPlan
from caviar_clients.session.base import failure_of
from caviar_clients.session.watchdog import Work
from caviar_protocol import messages as m
from caviar_protocol.errors import RunError, one_line
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario.conversion import located
from caviar_protocol.validation import ContentCheck
from caviar_services.conversion import decoded
from caviar_services.service import Frame, FrameInput, StepResult
from caviar_services.session import ServiceSession

# On the path of every frame: a member that is looked up in its class costs four times as much.
_ABSENT, _FRESH = Status.ABSENT, Status.FRESH

_OWN = "caviar_services."
"""Where the services lie that come with CAVIAR; plug-ins lie elsewhere."""


def plays_directly(plan: RunPlan) -> bool:
    """Tell whether the frames of a run in one process need no clock.

    Args:
        plan: The run. Nothing of it may be recorded.

    Returns:
        False where a frame goes on without a service that fails, or where decisions are imposed: what
        becomes of such a frame is the clock's to say.
    """
    return all(service.is_indispensable for service in plan.services) and not (plan.imposed or plan.recorded)


@dataclass(eq=False)
class _Part:
    """A service's part of each frame."""

    name: str
    session: ServiceSession
    is_agent: bool
    budget_ns: int
    check: ContentCheck | None
    """Of its products; None: it is one of CAVIAR's own. Checks would take an eighth of a step of training."""
    outputs: tuple[str, ...]
    """Topics in demand."""
    inputs: tuple[tuple[Edge, _Part], ...] = ()
    sources: frozenset[str] = frozenset()
    """Services of whose products of the same frame it takes some."""
    lagged: tuple[tuple[Edge, _Part], ...] = ()
    completed: int = -1
    """Frame that it has computed last in the episode; −1: none."""
    decided: dict[str, FrameInput] = field(default_factory=dict)
    """What consumers in the same frame get of it, by topic."""
    before: dict[str, FrameInput] = field(default_factory=dict)
    """The same of the frame before."""


class DirectFrames:
    """The episodes of a run whose services are in this process, once they are prepared and reset.

    Args:
        plan: The run; see `plays_directly`.
        graph: Which service takes what from which.
        sessions: Of all services in the graph, by name.
        check: Looks at products of plug-ins before their consumers do.
        reset: RESET of the first episode, which all services have answered.
        sent: What sessions send is appended here.
        notice: Called with what the user may want to know.
    """

    def __init__(
        self,
        plan: RunPlan,
        graph: Graph,
        sessions: Mapping[str, ServiceSession],
        check: ContentCheck,
        reset: m.Reset,
        sent: deque[ev.Event],
        notice: Callable[[ev.Notice], None],
    ) -> None:
        self._plan, self._sent, self._notice = plan, sent, notice
        self._episode, self._seed, self._seed_episode = reset.episode, reset.seed, reset.seed_episode
        of = {service.name: service for service in plan.services}
        parts = {
            name: _Part(
                name,
                sessions[name],
                of[name].role == "agent",
                of[name].budget_ns,
                None if sessions[name].cls.__module__.startswith(_OWN) else check,
                graph.outputs[name],
            )
            for name in graph.order
        }
        for name, part in parts.items():
            part.inputs = tuple((edge, parts[edge.source]) for edge in graph.inputs[name])
            part.sources = frozenset(edge.source for edge, _ in part.inputs if not edge.lag)
            part.lagged = tuple(pair for pair in part.inputs if pair[0].lag)
        self._parts = tuple(parts.values())
        # Frames of the episode; becomes less when an agent ends it early.
        self._frames = plan.frames
        # Seed that an agent chose for the next episode, and which one did.
        self._wished: tuple[int, _Part] | None = None
        self.outcome: ev.Finished | None = None
        """How the run ended; None while it goes on."""
        self.at_work: Work | None = None
        """What a service handles just now, for the watchdog; None between services."""

    def play(self) -> Generator[None, None, None]:
        """Play episodes until one fails; yield when services outside have a frame, and after each episode.

        They answer it before the next step.
        """
        while self.outcome is None:
            yield from self._play_episode()
            yield

    def _play_episode(self) -> Generator[None, None, None]:
        self._frames, number = self._plan.frames, 0
        # Frames that services outside have not answered: one of each is offered before the first is waited
        # for, since agents that are asked at once decide together.
        offered: dict[str, tuple[_Part, Frame]] = {}
        while number <= self._frames:
            final = number == self._frames
            for part in self._parts:
                if offered and not part.sources.isdisjoint(offered):
                    yield
                    if not self._take_answers(offered):
                        return
                if final and not part.is_agent:
                    continue
                frame = self._granted(part, number, final=final)
                if frame is None:
                    continue
                result = self._computed(part, frame)
                if result is not None:
                    self._take(part, frame, result)
                elif self.outcome is None:
                    offered[part.name] = part, frame
                if self.outcome is not None:
                    return
            if offered:
                yield
                if not self._take_answers(offered):
                    return
            for part in self._parts:
                part.decided, part.before = {}, part.decided
            number += 1
        self._begin_next(self._frames)

    def _take_answers(self, offered: dict[str, tuple[_Part, Frame]]) -> bool:
        """Take what services outside answered; whether the run goes on."""
        for part, frame in offered.values():
            result = part.session.answered()
            if result is None:
                return False
            self._take(part, frame, result)
        offered.clear()
        return self.outcome is None

    def _take(self, part: _Part, frame: Frame, result: StepResult) -> None:
        """Take what a service makes of a frame."""
        if frame.final:
            if result.products:
                topics = ", ".join(sorted(result.products))
                self._tell("discarded", part, f"answered its final grant with {topics}", frame.number)
            self._choose_seed(part, frame.number, result, ends=True)
            return
        if part.is_agent:
            if result.end_episode:
                self._frames = frame.number + 1
            self._choose_seed(part, frame.number, result, ends=frame.number + 1 == self._frames)
        self._decide(part, frame, result)

    # --- one service's part ------------------------------------------------------------------------

    def _granted(self, part: _Part, number: int, *, final: bool) -> Frame | None:
        """The frame as a service is granted it; None: it is skipped, since a required input is absent."""
        inputs, cause = [], ""
        for edge, source in part.lagged if final else part.inputs:
            if not edge.lag:
                item = source.decided[edge.topic]
            elif number:
                item = self._older(source.before[edge.topic])
            else:
                first = "there is no earlier frame"
                inputs.append(
                    FrameInput(GrantInput(topic=edge.topic, source=source.name, status=_ABSENT, cause=first))
                )
                continue
            if edge.required and not item.present:
                cause = cause or item.provenance.cause
            inputs.append(item)
        if cause:
            self._tell("skipped", part, cause, number)
            for topic in part.outputs:
                part.decided[topic] = _absent(part, topic, cause)
            return None
        previous, part.completed = part.completed, number
        return Frame(
            episode=self._episode,
            number=number,
            t_ns=self._plan.t_ns(number),
            previous=previous,
            final=final,
            budget_ns=part.budget_ns,
            inputs=tuple(inputs),
            service=part.name,
            seed=self._seed,
            seed_episode=self._seed_episode,
        )

    def _older(self, item: FrameInput) -> FrameInput:
        """A product of the frame before, as a consumer of this one gets it."""
        if not item.present:
            return item
        was = item.provenance
        entry = GrantInput(
            topic=was.topic,
            source=was.source,
            status=_FRESH,
            frame=was.frame,
            t_ns=was.t_ns,
            age=1,
            fidelity=was.fidelity,
        )
        return item.under(entry)

    def _computed(self, part: _Part, frame: Frame) -> StepResult | None:
        """Result of a service for a frame; None: it failed, or answers from outside."""
        self.at_work = part.name, frame
        try:
            result = part.session.compute(frame)
        except (SystemExit, KeyboardInterrupt) as error:
            part.session.report(failure_of(error), "step", frame.episode, frame.number)
            result = None
        self.at_work = None
        while self._sent:
            event = self._sent.popleft()
            if isinstance(event, ev.FaultReceived):
                self._fail(event, frame.inputs)
        return result

    def _decide(self, part: _Part, frame: Frame, result: StepResult) -> None:
        """Note what consumers get of a service."""
        number, products, decided = frame.number, result.products, part.decided
        for topic in part.outputs:
            payload = products.get(topic)
            if payload is None:
                cause = f"{part.name} produced no {topic} in frame {number}"
                decided[topic] = _absent(part, topic, cause)
                continue
            entry = GrantInput(
                topic=topic,
                source=part.name,
                status=_FRESH,
                frame=number,
                t_ns=frame.t_ns,
                age=0,
                fidelity=result.fidelity,
            )
            decided[topic] = FrameInput(entry, payload=decoded(payload), check=part.check)
        # One that is not in demand is left out; one that was not declared is a mistake.
        if len(products) > len(part.outputs) or not products.keys() <= decided.keys():
            strange = sorted(products.keys() - set(part.session.cls.outputs))
            if strange:
                text = f"answered frame {number} with {strange[0]!r}, which it did not declare"
                self._end(f"{self._called(part)} {text}", part.name)

    # --- from one episode to the next --------------------------------------------------------------

    def _choose_seed(self, part: _Part, number: int, result: StepResult, *, ends: bool) -> None:
        seed = result.seed
        if seed < 0:
            return
        if not ends:
            text = f"chose the seed {seed}, which only an agent may where it ends an episode; not used"
            self._tell("discarded", part, text, number)
        elif self._wished is not None and self._wished[0] != seed and self._wished[1] is not part:
            known, other = self._wished
            both = f"{self._called(other)} and {self._called(part)}"
            self._end(f"{both} choose different seeds, {known} and {seed}", part.name)
        else:
            self._wished = seed, part

    def _begin_next(self, frames: int) -> None:
        """End the episode and reset all services to the next one."""
        ids = {"epoch": self._plan.epoch, "episode": self._episode}
        for part in self._parts:
            self._order(part, m.EpisodeEnd(**ids, attempt=part.session.attempt, frames=frames))
        if self._episode + 1 == self._plan.episodes:
            self._end("", "")
            return
        self._episode += 1
        if self._wished is not None:
            self._seed, self._seed_episode, self._wished = self._wished[0], 0, None
        else:
            self._seed_episode += 1
        ids["episode"] = self._episode
        for part in self._parts:
            part.completed, part.before = -1, {}
            attempt = part.session.attempt
            seeds = {"seed": self._seed, "seed_episode": self._seed_episode}
            self._order(part, m.Reset(**ids, attempt=attempt, t0_ns=0, **seeds))
        while self._sent:
            event = self._sent.popleft()
            if isinstance(event, ev.FaultReceived):
                self._fail(event, ())
            elif not isinstance(event, ev.ResetDoneReceived):
                raise RunError(f"a service sent {event} between episodes")

    def _order(self, part: _Part, message: m.Message) -> None:
        self.at_work = part.name, message
        part.session.handle(message)
        self.at_work = None

    # --- blame ---------------------------------------------------------------------------------------

    def _called(self, part: _Part) -> str:
        return f"{part.session.cls.role} {part.name!r}"

    def _fail(self, event: ev.FaultReceived, inputs: tuple[FrameInput, ...]) -> None:
        """End the run with the blame that the clock would give."""
        fault = event.message
        part = next(part for part in self._parts if part.name == event.service)
        if any(item.provenance.source == fault.culprit for item in inputs):
            wrong = next(other for other in self._parts if other.name == fault.culprit)
            text = f"made a wrong product: {fault.message} (refused by {self._called(part)})"
            self._end(f"{self._called(wrong)} {text}", wrong.name)
            return
        at = f"frame {fault.frame}, " if fault.frame >= 0 else ""
        text = f"{fault.phase}: {located(fault.message, part.name, self._plan.source)}"
        self._end(f"{self._called(part)} failed in {at}{text}", part.name)

    def _end(self, error: str, culprit: str) -> None:
        if self.outcome is None:  # what fails later mostly follows from the first failure
            self.outcome = ev.Finished(one_line(error), culprit, "")

    def _tell(self, kind: str, part: _Part, text: str, frame: int) -> None:
        self._notice(ev.Notice(kind, part.name, one_line(text), self._episode, frame))


def _absent(part: _Part, topic: str, cause: str) -> FrameInput:
    return FrameInput(GrantInput(topic=topic, source=part.name, status=_ABSENT, cause=cause))
