"""What a session is: a run whose agent decides outside of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType

from caviar_protocol.arrays import Payload
from caviar_protocol.errors import PayloadError
from caviar_services.service import Frame as Frame
from caviar_services.service import StepResult

_NO_SEED = -1
_HIGHEST_SEED = 2**63 - 1


class Session(ABC):
    """One run, driven from grant to grant (contract, clause 16).

    Call `reset`, then `step` until a frame is ``final``, then `reset` again; `close` at the end. All
    of them raise `RunError` with the broker's blame where the run has ended.
    """

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self.scenery: Mapping[str, Path] = {}
        """Files of the run's scenery by asset name, behind the first `reset`; empty unless asked for."""

    def _take_scenery(self, assets: Mapping[str, Path]) -> None:
        self.scenery = assets

    def reset(self, seed: int | None = None) -> Frame:
        """Begin an episode; its frame 0. The same ``seed`` leads to the same episode.

        Without one the next episode follows on the last one's seed. An episode that is under way ends.
        """
        if seed is not None and not 0 <= seed <= _HIGHEST_SEED:
            raise PayloadError(f"seed={seed}; write a whole number from 0 to 2**63 - 1")
        chosen = _NO_SEED if seed is None else seed
        if self._frame is None:
            self._begin(chosen)
            self._frame = self._granted()
            if _begins(self._frame, seed):
                return self._frame
            # Whoever had the place before left the run in the middle of an episode.
        if self._frame.final:
            self._answer(StepResult(seed=chosen))
        else:
            self._answer(StepResult(end_episode=True, seed=chosen))
            while not self._granted().final:
                self._answer(StepResult(end_episode=True, seed=chosen))
            self._answer(StepResult())
        self._frame = self._granted()
        return self._frame

    def step(self, products: Mapping[str, Payload]) -> Frame:
        """Answer the frame, and the next one: with this one's link, and ``final`` behind the last."""
        self._answer(StepResult(products=products))
        self._frame = self._granted()
        return self._frame

    @abstractmethod
    def close(self) -> None:
        """End the run, or leave it; again: nothing."""

    @abstractmethod
    def _begin(self, seed: int) -> None:
        """Start or join the run; −1: no seed is chosen."""

    @abstractmethod
    def _answer(self, result: StepResult) -> None:
        """Answer the frame that is granted."""

    @abstractmethod
    def _granted(self) -> Frame:
        """Wait for the next grant."""

    def __enter__(self) -> Session:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _begins(frame: Frame, seed: int | None) -> bool:
    """Whether a frame is the first one of an episode, of this seed where one is chosen."""
    chosen = seed is None or (frame.seed, frame.seed_episode) == (seed, 0)
    return frame.number == 0 and not frame.final and chosen
