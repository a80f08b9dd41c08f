"""Realtime pace: frames are released when their time has come, and slip rather than skip."""

from __future__ import annotations

from caviar_broker.core.plan import RunPlan


class Pacer:
    """Releases the frames of one episode (contract, clause 8).

    Frame 0 is released when somebody first asks for it. A later one is due as long after the one
    before as simulated time says, divided by the run's speed; when nobody is ready for it by then, all
    frames behind it slip by as much. A timer that fires late delays its own frame, not those behind it. As
    fast as possible, every frame is released at once.
    """

    def __init__(self, plan: RunPlan) -> None:
        self._plan = plan
        self._released_frame = -1
        self._reference = 0
        """When the frame released last should have been, slips included [ns]."""
        self._awaited = False
        self.lag_ns = 0
        """Sum of all slips [ns]."""

    def release(self, frame: int, now: int) -> int | None:
        """Ask for a frame: by how much it slips [ns], or None while its time has not come."""
        if not self._plan.realtime or frame <= self._released_frame:
            return 0
        due = now if self._released_frame < 0 else self._due()
        if now < due:
            self._awaited = True
            return None
        slip = 0 if self._awaited else now - due
        self._released_frame, self._reference, self._awaited = frame, due + slip, False
        self.lag_ns += slip
        return slip

    def tells(self, slip: int) -> bool:
        """Whether a slip is worth a notice of its own: a tenth of a period, in real time."""
        return slip > self._real_ns(self._plan.sampling_period_ns) // 10

    def next_instant(self) -> int | None:
        """When the frame that was asked for in vain will be due [ns]; None if there is none."""
        return self._due() if self._awaited else None

    def withdraw(self) -> None:
        """The frame that was asked for in vain is not wanted for now."""
        self._awaited = False

    def shift(self, held_ns: int) -> None:
        """The run was paused for so long [ns]: that is no slip."""
        self._reference += held_ns

    def _due(self) -> int:
        frame = self._released_frame
        return self._reference + self._real_ns(self._plan.t_ns(frame + 1) - self._plan.t_ns(frame))

    def _real_ns(self, simulated_ns: int) -> int:
        return simulated_ns if self._plan.speed == 1.0 else round(simulated_ns / self._plan.speed)
