"""Begin of the frames of an episode: the user's pause (`PauseGate`) and real time (`Pacer`)."""

from __future__ import annotations

from caviar_broker.core.plan import RunPlan


class PauseGate:
    """Lets frames begin, or holds them back until the user wants the next ones.

    A frame begins when a service first asks for it. Frames that have begun are finished by all services,
    so no service is waited for, and nothing can stall, in a run that is paused.
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
        """Let no frame after ``begun`` begin."""
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
        """Count frames from 0 again."""
        self.begun = -1

    def admits(self, frame: int, now: int) -> bool:
        """Return whether a frame may begin, or has begun, at the time ``now`` [ns]."""
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


class Pacer:
    """Releases the frames of one episode in real time (contract, clause 8).

    Frame 0 is released when a service first asks for it. A later one is due as long after the one
    before as simulated time says, divided by the run's speed; when no service is ready for it by then, all
    frames after it slip by as much. A timer that fires late delays its own frame, not those after it. As
    fast as possible, every frame is released at once.

    Args:
        plan: The run, with its pace and the simulated time of its frames.
    """

    def __init__(self, plan: RunPlan) -> None:
        self._plan = plan
        self._released_frame = -1
        # When the frame released last should have been, slips included [ns].
        self._reference = 0
        self._awaited = False
        self.lag_ns = 0
        """Sum of all slips [ns]."""

    def release(self, frame: int, now: int) -> int | None:
        """Ask for a frame: by how much it slips [ns], or None while its time has not come."""
        # A frame is released by the first service that asks; the others follow without a look at the clock.
        if not self._plan.realtime or frame <= self._released_frame:
            return 0
        due = now if self._released_frame < 0 else self._due()
        if now < due:
            self._awaited = True
            return None
        # A frame that was asked for in vain is released late by the timer alone, which is no slip of the run.
        slip = 0 if self._awaited else now - due
        self._released_frame, self._reference, self._awaited = frame, due + slip, False
        self.lag_ns += slip
        return slip

    def is_notable(self, slip: int) -> bool:
        """Return whether a slip [ns] is worth a notice of its own: more than a tenth of a period, in real
        time."""
        return slip > self._real_ns(self._plan.sampling_period_ns) // 10

    def next_instant(self) -> int | None:
        """Instant at which the frame is due that was asked for in vain [ns]; None if there is none."""
        return self._due() if self._awaited else None

    def withdraw(self) -> None:
        """Forget that a frame was asked for in vain."""
        self._awaited = False

    def shift(self, held_ns: int) -> None:
        """Move all later frames by the time of a pause [ns], which is no slip."""
        self._reference += held_ns

    def _due(self) -> int:
        frame = self._released_frame
        return self._reference + self._real_ns(self._plan.t_ns(frame + 1) - self._plan.t_ns(frame))

    def _real_ns(self, simulated_ns: int) -> int:
        return simulated_ns if self._plan.speed == 1.0 else round(simulated_ns / self._plan.speed)
