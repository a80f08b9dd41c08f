"""The contract of sessions: a run whose agents decide outside of it, and the agents' part in that run."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import ClassVar

import msgspec

from caviar_protocol.arrays import Payload
from caviar_protocol.errors import PayloadError
from caviar_protocol.messages import Input, Role
from caviar_protocol.scenario.rules import BEAM
from caviar_services.service import Frame as Frame
from caviar_services.service import Preparation, Prepared, RunInfo, Service, StepResult

# On the wire: the agent chooses no seed, and the episode has that of the run.
_NO_SEED = -1
_HIGHEST_SEED = 2**63 - 1


class Session(ABC):
    """A run that a program steps, in place of one of its agents (contract, clause 16), or of several.

    Call `reset`, then `step` until a frame is ``final``, then `reset` again; `close` at the end, or use it as
    a context manager. All of them raise `RunError` with the broker's blame where the run has ended.

    Args:
        beside: Further agents whose places are taken. They consume what the first one does, and the program
            decides for all of them at once: frames are those of the first one.

    Example:
        >>> from caviar_clients.session.connected import open_session
        >>> from caviar_clients.session.prepared import prepare
        >>> from caviar_protocol.topics import Action
        >>> scenario, inputs = prepare("smoke", frames=3), (Input(topic="scene"),)
        >>> with open_session(scenario, "agent", inputs) as session:
        ...     frame = session.reset(seed=7)
        ...     while not frame.final:
        ...         frame = session.step({"action": Action(commands=())})
        >>> frame.number
        3
    """

    def __init__(self, beside: Sequence[str] = ()) -> None:
        self._frame: Frame | None = None
        self.beside = tuple(beside)
        """Agents that answer with the first one."""
        self.scenery: Mapping[str, Path] = {}
        """Files of the run's scenery by asset name, after the first `reset`; empty unless asked for."""

    def _take_scenery(self, assets: Mapping[str, Path]) -> None:
        self.scenery = assets

    def reset(self, seed: int | None = None) -> Frame:
        """Begin an episode. An episode that is under way ends.

        Args:
            seed: From 0 to 2⁶³ − 1; the same seed leads to the same episode. None: the episode that follows
                on the one before, of the same seed.

        Returns:
            Frame 0 of the episode.

        Raises:
            PayloadError: The seed is out of its range.
            RunError: The run has ended.
        """
        if seed is not None and not 0 <= seed <= _HIGHEST_SEED:
            raise PayloadError(f"seed={seed}; write a whole number from 0 to 2**63 - 1")
        chosen = _NO_SEED if seed is None else seed
        if self._frame is None:
            self._begin(chosen)
            self._frame = self._granted()
            begun = self._frame
            its_seed = seed is None or (begun.seed, begun.seed_episode) == (seed, 0)
            if begun.number == 0 and not begun.final and its_seed:
                return begun
            # An agent that had the place before left the run in the middle of an episode.
        if self._frame.final:
            self._answer_alike(StepResult(seed=chosen))
        else:
            self._answer_alike(StepResult(end_episode=True, seed=chosen))
            # Frames of the old episode may have been granted before the broker knew that it ends.
            while not self._granted().final:
                self._answer_alike(StepResult(end_episode=True, seed=chosen))
            self._answer_alike(StepResult())
        self._frame = self._granted()
        return self._frame

    def step(
        self, products: Mapping[str, Payload], beside: Mapping[str, Mapping[str, Payload]] | None = None
    ) -> Frame:
        """Answer the frame that is granted, and wait for the next one.

        Args:
            products: By topic, what the agent decided: ``{"action": Action(…)}``.
            beside: The same of the agents beside it, by name; one that is left out decides nothing.

        Returns:
            The next frame, with the link of the answered one; after the last frame of an episode one that
            is ``final`` and needs no answer.

        Raises:
            PayloadError: A product is not its topic's, or there is no such agent beside the first one.
            RunError: The run has ended, or no frame is granted.
        """
        given = beside or {}
        if not given.keys() <= set(self.beside):
            there = ", ".join(self.beside) or "none"
            raise PayloadError(f"no agent beside this one is {sorted(given)[0]!r}; there are: {there}")
        self._answer(
            StepResult(products=products),
            {name: StepResult(products=given.get(name, {})) for name in self.beside},
        )
        self._frame = self._granted()
        return self._frame

    @abstractmethod
    def close(self) -> None:
        """End the run, or leave it. A second call does nothing."""

    @abstractmethod
    def _begin(self, seed: int) -> None:
        """Start or join the run, with the seed of its first episode; −1: none is chosen."""

    def _answer_alike(self, result: StepResult) -> None:
        """Answer the frame that is granted, all agents with the same."""
        self._answer(result, dict.fromkeys(self.beside, result))

    @abstractmethod
    def _answer(self, result: StepResult, beside: Mapping[str, StepResult]) -> None:
        """Answer the frame that is granted; ``beside`` has an answer of each agent beside the first one."""

    @abstractmethod
    def _granted(self) -> Frame:
        """Wait for the next grant, of all agents."""

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


PATIENCE_S = 600.0
"""[s] that a run waits for a decision before it blames the agent: between two of them a program may learn, or
its user look at what it learned."""


class OutsideSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Users that the agent serves (contract, clause 17)."""

    users: tuple[str, ...] = ("*",)
    except_users: tuple[str, ...] = ()


class OutsideAgent(Service[OutsideSettings]):
    """An agent that decides outside of the run. `declared` makes the class for one session."""

    role: ClassVar[Role] = "agent"
    outputs: ClassVar[tuple[str, ...]] = ("action",)
    Settings = OutsideSettings
    decide: ClassVar[Callable[[Frame], StepResult]]
    scenery_here: ClassVar[Callable[[Mapping[str, Path]], None]]
    first_seed: ClassVar[Callable[[], int]]
    joined: ClassVar[Callable[[RunInfo], None]]

    def prepare(self, preparation: Preparation) -> Prepared:
        """Declare the actuators and, once `Session.reset` was called, the seed of the first episode."""
        type(self).joined(self.run)
        type(self).scenery_here(preparation.assets)
        self.run.progress("waiting for the first reset", PATIENCE_S)
        seed = type(self).first_seed()
        if self.settings.except_users:
            # The broker gives it what other agents do not own: which users that is, it knows alone.
            return Prepared(notes=("serves the users that no other agent owns",), seed=seed)
        # A bare pattern names users, whose beams are meant.
        owned = tuple(text if ":" in text else BEAM + text for text in self.settings.users)
        return Prepared(actuators=owned, seed=seed)

    def step(self, frame: Frame) -> StepResult:
        """Wait for the decision."""
        self.run.progress("waiting for a decision", PATIENCE_S)
        return type(self).decide(frame)


def failure_of(error: SystemExit | KeyboardInterrupt) -> RuntimeError:
    """Make the failure of a service whose code would end the program of the run without a word.

    Args:
        error: That the service raised.

    Raises:
        KeyboardInterrupt: It is Ctrl-C of the terminal, which Python raises in the main thread alone.
    """
    if isinstance(error, SystemExit):
        text = f"it called sys.exit({error.code!r})"
    elif threading.current_thread() is threading.main_thread():
        raise error
    else:
        text = "it raised KeyboardInterrupt"
    return RuntimeError(text).with_traceback(error.__traceback__)


def declared(
    inputs: tuple[Input, ...],
    first_seed: Callable[[], int],
    decide: Callable[[Frame], StepResult],
    scenery_here: Callable[[Mapping[str, Path]], None] | None = None,
    joined: Callable[[RunInfo], None] = lambda run: None,
) -> type[OutsideAgent]:
    """Make the class of an agent that decides outside of the run.

    Args:
        inputs: What it consumes.
        first_seed: Waits for the seed of the first episode; −1 for the run's.
        decide: Answers a frame.
        scenery_here: Gets the files of the run's scenery by asset name, before the first frame. None: they
            are not fetched.
        joined: Gets what the run says about itself, before anything else.
    """
    fields = {
        "inputs": inputs,
        "first_seed": staticmethod(first_seed),
        "decide": staticmethod(decide),
        "uses_scenery": scenery_here is not None,
        "scenery_here": staticmethod(scenery_here or (lambda _: None)),
        "joined": staticmethod(joined),
    }
    return type("OutsideAgent", (OutsideAgent,), fields)
