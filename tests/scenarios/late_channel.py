"""A channel that is late now and then; scenarios name it as ``late_channel:LateChannel``."""

from __future__ import annotations

import threading

from caviar_services.channel.statistical.free_space import FreeSpaceChannel
from caviar_services.service import Frame, StepResult

LATE = {3: 0.25, 8: 0.6, 15: 0.25}
"""[s] by frame."""


class LateChannel(FreeSpaceChannel):
    """Free space, with a pause in some frames."""

    def step(self, frame: Frame) -> StepResult:
        threading.Event().wait(LATE.get(frame.number, 0.0))
        return super().step(frame)
