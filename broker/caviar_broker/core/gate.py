"""The user's hand on the run: no new frame begins while it is paused."""

from __future__ import annotations


class Gate:
    """Lets frames begin, or holds them back until the user wants the next ones.

    A frame begins when somebody first asks for it. Frames that have begun are finished by everybody,
    so nobody is waited for, and nothing can stall, in a run that is paused.
    """

    def __init__(self) -> None:
        self.closed = False
        """Whether the run is paused."""
        self.steps = 0
        """Frames that may still begin although the run is paused."""
        self.begun = -1
        """The last frame of the episode that has begun, while the run is paused."""
        self._held_since: int | None = None

    def pause(self, begun: int) -> None:
        """Let no frame behind ``begun`` begin."""
        if not self.closed:
            self.closed, self.steps, self.begun, self._held_since = True, 0, begun, None

    def resume(self) -> None:
        """Let all frames begin."""
        self.closed, self.steps = False, 0

    def step(self, frames: int) -> None:
        """Let so many frames more begin; of a run that is not paused none is held back."""
        if self.closed:
            self.steps += frames

    def next_episode(self) -> None:
        """Frames count from 0 again."""
        self.begun = -1

    def admits(self, frame: int, now: int) -> bool:
        """Whether a frame may begin, or has begun."""
        if self.closed and frame > self.begun:
            if not self.steps:
                self._held_since = now if self._held_since is None else self._held_since
                return False
            self.steps -= 1
            self.begun = frame
        return True

    def held_ns(self, now: int) -> int:
        """For how long frames were held back that may begin now [ns]; counted once."""
        since, self._held_since = self._held_since, None
        return 0 if since is None else now - since
