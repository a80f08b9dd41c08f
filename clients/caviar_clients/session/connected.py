"""Open a session: in this process, or at a broker, where the runner of all services serves in a thread."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from queue import Empty, SimpleQueue

from caviar_clients.session.base import Frame, Session, declared
from caviar_clients.session.embedded import EmbeddedSession
from caviar_clients.session.prepared import PreparedScenario
from caviar_protocol.errors import CaviarError, RunError, ScenarioError
from caviar_protocol.fields import MAX_IN_FLIGHT
from caviar_protocol.keys import Credentials
from caviar_protocol.messages import Input
from caviar_protocol.scenario import Scenario
from caviar_services.connection import Terminated, Termination
from caviar_services.runner import CONNECT_TIMEOUT_S as CONNECT_TIMEOUT_S
from caviar_services.runner import Runner
from caviar_services.service import RunInfo, StepResult

IMPLEMENTATION = "gymnasium"
LEAVE_S = 5.0
"""[s] that leaving a run may take."""
# [s] between looks at whether the runner still lives.
_POLL_S = 0.2


class ConnectedSession(Session):
    """An agent of the run that a broker serves, which plays the episodes of the scenario.

    It joins at once and gets ready at the first `reset`, whose seed becomes that of the first episode.

    Args:
        broker: ZeroMQ address of the broker.
        agent: Name of a service of the run that no process fills yet (``use = "remote"``).
        inputs: What the agent consumes.
        connect_timeout_s: Time in which the broker has to answer [s].
        credentials: For a broker with keys; None: what the environment says.
        with_scenery: Whether `Session.scenery` is fetched.
        beside: Further services of that kind; with keys, those of ``credentials`` are all of theirs.
        scenario: What the agent was made for; the first `reset` refuses a run of other devices. None: any.
    """

    def __init__(
        self,
        broker: str,
        agent: str,
        inputs: tuple[Input, ...],
        connect_timeout_s: float = CONNECT_TIMEOUT_S,
        credentials: Credentials | None = None,
        with_scenery: bool = False,
        beside: Sequence[str] = (),
        scenario: Scenario | None = None,
    ) -> None:
        super().__init__(beside)
        self._broker, self._scenario = broker, scenario
        self._grants: SimpleQueue[Frame | CaviarError] = SimpleQueue()
        self._results: SimpleQueue[StepResult | None] = SimpleQueue()
        self._seeds: SimpleQueue[int | None] = SimpleQueue()
        # Of the first episode, once it is known.
        self._seed: int | None = None
        # The newest, by episode and frame: a broker that lost the connection may ask for them again.
        self._decisions: OrderedDict[tuple[int, int], StepResult] = OrderedDict()
        self._termination = _Leaving(self)
        scenery_here = self._take_scenery if with_scenery else None
        cls = declared(inputs, self._first_seed, self._decided, scenery_here, self._joined)
        runner = Runner(
            agent,
            cls,
            IMPLEMENTATION,
            broker,
            connect_timeout_s,
            self._termination,
            own_process=False,
            credentials=credentials,
        )
        # A daemon: a program that forgets to close its session ends all the same.
        self._thread = threading.Thread(target=self._serve, args=(runner,), name="session", daemon=True)
        self._thread.start()
        self._others = {
            name: ConnectedSession(broker, name, inputs, connect_timeout_s, credentials) for name in beside
        }

    def close(self) -> None:
        """Leave the run; after the last frame of its last episode the run ends in order."""
        if self._frame is not None and self._frame.final and self._thread.is_alive():
            self._answer_alike(StepResult())
            with suppress(Empty):  # until the run is over, or the next episode begins
                self._grants.get(timeout=LEAVE_S)
        self._frame = None
        self.leave()
        for other in self._others.values():
            other.close()
        self._thread.join(LEAVE_S)

    def leave(self, error: CaviarError | None = None) -> None:
        """End the thread. May be called from the thread itself, or a signal handler.

        Args:
            error: Raised by the call that waits for a grant, or by the next one.
        """
        self._termination.requested = True
        if error is not None:
            self._grants.put(error)
        self._seeds.put(None)  # wakes the thread where it waits for the first reset
        self._results.put(None)  # and where it waits for a decision

    def _begin(self, seed: int) -> None:
        self._seeds.put(seed)
        for other in self._others.values():
            other._begin(seed)

    def _answer(self, result: StepResult, beside: Mapping[str, StepResult]) -> None:
        self._results.put(result)
        for name, other in self._others.items():
            other._answer(beside[name], {})

    def _granted(self) -> Frame:
        frame = self._own_granted()
        for other in self._others.values():
            its = other._own_granted()
            # Of a late policy one of them may have missed frames that the other was granted.
            while (its.episode, its.number) < (frame.episode, frame.number):
                other._answer(StepResult(), {})
                its = other._own_granted()
            while (frame.episode, frame.number) < (its.episode, its.number):
                self._results.put(StepResult())
                frame = self._own_granted()
        return frame

    def _own_granted(self) -> Frame:
        while True:
            # Without a timeout, Ctrl-C would wait until the next grant, and a thread that died be waited for.
            try:
                grant = self._grants.get(timeout=_POLL_S)
            except Empty:
                if not self._thread.is_alive() and self._grants.empty():
                    raise RunError("the session is closed; make a new one") from None
                continue
            if isinstance(grant, CaviarError):
                raise grant
            return grant

    # --- in the runner's thread --------------------------------------------------------------------

    def _serve(self, runner: Runner) -> None:
        try:
            runner.run()
        except CaviarError as error:
            self._grants.put(error)
        else:
            more = "; with more episodes (run.episodes of the scenario) it could be reset again"
            self._grants.put(RunError(f"the broker ended the run: {runner.ended}{more}"))

    def _joined(self, run: RunInfo) -> None:
        """Leave a run of another scenario: observations and actions would be of other users."""
        if self._scenario is None:
            return
        here, there = _arrays(self._scenario), _arrays(run)
        if here != there:
            error = ScenarioError(
                f"the run at {self._broker} has {_listed(there - here)} that scenario "
                f"{self._scenario.run.name!r} lacks, which has {_listed(here - there)}; give the environment "
                "the scenario that the broker runs"
            )
            self.leave(error)
            raise Terminated(str(error))

    def _first_seed(self) -> int:
        if self._seed is None:
            self._seed = self._seeds.get()
        if self._seed is None:
            raise Terminated("the session was closed before its first reset")
        return self._seed

    def _decided(self, frame: Frame) -> StepResult:
        key = frame.episode, frame.number
        if key not in self._decisions:
            self._grants.put(frame)
            result = self._results.get()
            if result is None:
                raise Terminated("the session was closed")
            self._decisions[key] = result
            if len(self._decisions) > MAX_IN_FLIGHT:
                self._decisions.popitem(last=False)
        return self._decisions[key]


class _Leaving(Termination):
    """Ends the thread of a session and never its process."""

    def __init__(self, session: ConnectedSession) -> None:
        super().__init__()
        self._session = session

    def end(self, status: int, last_words: str) -> None:
        self._session.leave(RunError(last_words))


def _arrays(known: Scenario | RunInfo) -> frozenset[str]:
    """Carriers and antennas, as what decides about observations and actions."""
    antennas = (device for device in known.devices if device.kind == "antenna")
    found = [
        f"{device.role} {f'{device.on}/' if device.on else ''}{device.name} ({device.count} × "
        f"{1 if device.array is None else device.array.size} elements)"
        for device in antennas
    ]
    return frozenset([*found, *(f"carrier {carrier.name}" for carrier in known.carriers)])


def _listed(names: frozenset[str]) -> str:
    return ", ".join(sorted(names)[:6]) or "nothing else"


def agent_of(scenario: Scenario, agent: str | None) -> str:
    """Find the agent whose place a session takes: the one named, the remote one, or the only one.

    Args:
        scenario: Has the agents.
        agent: Its name; None: it is to be found.

    Raises:
        ScenarioError: There is no such agent, or there are several; the text names those there are.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> agent_of(load_scenario("smoke"), None)
        'agent'
    """
    agents = {name: spec for name, spec in scenario.services.items() if spec.role == "agent"}
    remote = [name for name, spec in agents.items() if spec.remote]
    names = ", ".join(agents) or "none"
    if agent is not None:
        if agent not in agents:
            raise ScenarioError(f"the scenario has no agent {agent!r}; its agents are: {names}")
        return agent
    found = remote or list(agents)
    if len(found) != 1:
        raise ScenarioError(
            f"name the agent whose place is taken, agent=…; the scenario's agents are: {names}"
        )
    return found[0]


def open_session(
    scenario: Scenario | PreparedScenario,
    agent: str,
    inputs: tuple[Input, ...],
    broker: str | None = None,
    directory: Path | None = None,
    credentials: Credentials | None = None,
    with_scenery: bool = False,
    beside: Sequence[str] = (),
    connect_timeout_s: float = CONNECT_TIMEOUT_S,
) -> Session:
    """Open a session of one agent of a scenario, or of several.

    Args:
        scenario: Checked, as `prepare` returns it.
        agent: Name of the agent whose place is taken, as `agent_of` finds it.
        inputs: What the agent consumes.
        broker: ZeroMQ address of a broker that serves the scenario; None: the run is in this process.
        directory: Where a run in this process records; None: nowhere, which is a lot faster.
        credentials: For a broker with keys; None: what the environment says.
        with_scenery: Whether `Session.scenery` is fetched.
        beside: Further agents whose places are taken.
        connect_timeout_s: Time in which a broker has to answer [s].

    Raises:
        ScenarioError: The scenario has no such agents; or a broker and a directory are given, and a broker
            records where it was started.

    Example:
        >>> from caviar_protocol.scenario import load_scenario
        >>> open_session(load_scenario("smoke"), "agent", (Input(topic="scene"),)).close()
    """
    places = (agent, *((beside,) if isinstance(beside, str) else beside))
    plain = scenario if isinstance(scenario, Scenario) else scenario.scenario
    for place in places:
        agent_of(plain, place)
    if isinstance(beside, str) or len(set(places)) != len(places):
        raise ScenarioError(f"agent={agent!r}, beside={beside!r}; write a tuple of names, each of them once")
    if broker is None:
        return EmbeddedSession(scenario, agent, inputs, directory, with_scenery, beside)
    if directory is not None:
        raise ScenarioError("a connected run records where its broker says; leave directory=… out")
    return ConnectedSession(
        broker, agent, inputs, connect_timeout_s, credentials, with_scenery, beside, plain
    )
