"""A session in this process: the run goes on whenever its agent is asked, and rests otherwise."""

from __future__ import annotations

from collections import deque
from pathlib import Path

from msgspec.structs import replace

from caviar_broker.core import events as ev
from caviar_clients.embedded.run import EmbeddedRun
from caviar_clients.sessions.agent import declared
from caviar_clients.sessions.base import Frame, Session
from caviar_protocol.errors import RunError
from caviar_protocol.messages import Input
from caviar_protocol.scenario import Scenario
from caviar_services.service import StepResult

ENDLESS = 2**53
"""Episodes of a run that goes on until it is closed."""
TOLD = 100
"""Notices that are kept."""


class EmbeddedSession(Session):
    """A run in this process that plays as many episodes as are asked for.

    Parameters
    ----------
    scenario
        Checked, as `caviar_protocol.scenario.loader.load_scenario` returns it.
    agent
        Name of the agent whose place is taken.
    inputs
        What it consumes.
    directory
        Where recorder and journal write; None: nothing is written, which is a lot faster.
    with_scenery
        Whether `Session.scenery` is looked up.
    """

    def __init__(
        self,
        scenario: Scenario,
        agent: str,
        inputs: tuple[Input, ...],
        directory: Path | None = None,
        with_scenery: bool = False,
    ) -> None:
        super().__init__()
        self.notices: deque[str] = deque(maxlen=TOLD)
        """What the run told last."""
        if directory is not None:
            directory.mkdir(parents=True, exist_ok=True)
        endless = replace(scenario, run=replace(scenario.run, episodes=ENDLESS))
        self._seed = -1
        scenery_here = self._take_scenery if with_scenery else None
        cls = declared(inputs, lambda: self._seed, _decided_outside, scenery_here)
        self._run = EmbeddedRun(endless, directory, self._notice, seats={agent: cls})
        self._seat = self._run.seats[agent]
        self._steps = self._run.steps()

    def close(self) -> None:
        """End the run and close its services."""
        self._steps.close()

    def _begin(self, seed: int) -> None:
        self._seed = seed

    def _answer(self, result: StepResult) -> None:
        if self._run.outcome is not None:
            raise self._over()
        self._seat.answer(result)

    def _granted(self) -> Frame:
        for _ in self._steps:
            if self._seat.frame is not None:
                return self._seat.frame
        raise self._over()

    def _over(self) -> RunError:
        outcome = self._run.outcome
        return RunError(outcome.error if outcome and outcome.error else "the run is over; begin a new one")

    def _notice(self, notice: ev.Notice) -> None:
        self.notices.append(f"{notice.kind}: {notice.service}: {notice.text}")


def _decided_outside(_: Frame) -> StepResult:
    raise RunError("an embedded session answers through its seat")
