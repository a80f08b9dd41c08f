"""Says which service a run in one process waits for, where a step takes long or never returns.

The services of such a run are called one after the other, and none of them can be interrupted: while one
computes, the run itself does nothing. The watchdog looks at the run from a thread of its own.
"""

from __future__ import annotations

import math
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from queue import Empty, SimpleQueue
from typing import Any, TypeAlias

from caviar_broker.core.plan import RunPlan, duration
from caviar_protocol import messages as m
from caviar_protocol.codec import message_type
from caviar_services.conversion import place_in
from caviar_services.service import Frame, Service

LOOK_S = 1.0
"""[s] between two looks at the run: each costs some 20 µs."""
STEP_S = 5.0
"""[s] in a frame, beyond a longer budget, after which a service is named."""
LOAD_S = 10.0
"""[s] after which a service is named that prepares, resets or closes: ray tracers load for seconds."""
STOP_S = 0.5
"""[s] from the order to stop until the service is named whose work keeps the run from its end."""

Work: TypeAlias = tuple[str, m.Message | Frame | None]
"""A service, and what it handles: a message, a frame that came without one, or None while it closes."""


class Watchdog:
    """Watches one run for as long as a ``with`` block lasts.

    Args:
        plan: The run, with budgets and roles of its services.
        classes: Their implementations, by name: the text names the line of their code that runs.
        present: Returns what a service handles now, None where none is at work. It is called from another
            thread, and returns the same object for as long as the work lasts.
        tell: Called with each text from the thread of the watchdog: ``waiting for agent 'agent' in frame 3,
            for 5 s now (budget 20 ms)``. Then again whenever the time has doubled, and after `stop`.
        again_s: Time from one text to the next at most [s].

    Example:
        >>> from pathlib import Path
        >>> from caviar_broker.core.plan import briefings, plan_run
        >>> from caviar_protocol.scenario import load_scenario
        >>> scenario, told = load_scenario("smoke"), SimpleQueue()
        >>> plan = plan_run(scenario, "run", briefings(scenario, Path()))
        >>> work = ("channel", m.Reset(epoch=1, attempt=1, episode=2, seed=1, t0_ns=0))
        >>> with Watchdog(plan, {}, lambda: work, told.put) as watchdog:
        ...     watchdog.stop()
        ...     told.get().partition(", for")[0]
        "waiting for channel 'channel' to reset to episode 2"
    """

    def __init__(
        self,
        plan: RunPlan,
        classes: Mapping[str, type[Service[Any]]],
        present: Callable[[], Work | None],
        tell: Callable[[str], None],
        again_s: float = math.inf,
    ) -> None:
        self._services = {service.name: service for service in plan.services}
        self._classes, self._present, self._tell = classes, present, tell
        self._again_s = again_s
        self._phases: dict[str, str] = {}
        # Its `put` may be called from a signal handler that interrupts another `put`; a lock may not.
        self._orders: SimpleQueue[str] = SimpleQueue()
        self._watched = 0
        self._thread = threading.Thread(target=self._watch, name="caviar-watchdog", daemon=True)

    def __enter__(self) -> Watchdog:
        self._watched = threading.get_ident()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._orders.put("end")
        self._thread.join()

    def stop(self) -> None:
        """Name what keeps the run from its end, if it has not ended within `STOP_S`. May be called from a
        signal handler."""
        self._orders.put("stop")

    def progress(self, service: str, phase: str) -> None:
        """Note what a service says that it does."""
        self._phases[service] = phase

    # --- in the watchdog's thread ------------------------------------------------------------------

    def _watch(self) -> None:
        seen: Work | None = None
        since = told_at = 0.0
        wait_s, stopping = LOOK_S, False
        while True:
            try:
                order = self._orders.get(timeout=wait_s)
            except Empty:
                order = ""
            if order == "end":
                return
            if order == "stop":  # most steps end within a moment, and nothing is to be said
                wait_s, stopping = STOP_S, True
                continue
            now, work = time.monotonic(), self._present()
            if work is not seen:  # its time counts from here: the run itself reads no clock for this
                seen, since, told_at = work, now - wait_s, 0.0
            elapsed = now - since
            if work is not None and (stopping or elapsed >= self._due_s(work, told_at)):
                told_at = elapsed
                self._tell(self._text(work, elapsed))
            wait_s, stopping = LOOK_S, False

    def _due_s(self, work: Work, told_at: float) -> float:
        return max(self._patience_s(work), min(2.0 * told_at, told_at + self._again_s))

    def _patience_s(self, work: Work) -> float:
        service, task = work
        if isinstance(task, m.Grant | Frame):
            return max(STEP_S, self._services[service].budget_ns / 1e9)
        return LOAD_S

    def _text(self, work: Work, elapsed: float) -> str:
        name, task = work
        service = self._services[name]
        text = f"waiting for {service.role} {name!r} {_doing(task)}"
        if elapsed >= 1.0:
            text += f", for {elapsed:.0f} s now"
        if isinstance(task, m.Grant | Frame):
            text += f" (budget {duration(service.budget_ns)})"
        elif phase := self._phases.get(name):
            text += f" ({phase})"
        frame = sys._current_frames().get(self._watched)
        place = place_in(
            self._classes.get(name), ((f.f_code, line) for f, line in traceback.walk_stack(frame))
        )
        return f"{text}, at {place}" if place else text


def _doing(task: m.Message | Frame | None) -> str:
    """Work of a service in words, after «waiting for …»."""
    match task:
        case None:
            return "to close"
        case m.Grant(episode=episode, frame=frame) | Frame(episode=episode, number=frame):
            return f"in frame {frame}" + (f" of episode {episode}" if episode else "")
        case m.Welcome():
            return "to read its settings"
        case m.Prepare():
            return "to prepare"
        case m.Reset(episode=episode):
            return f"to reset to episode {episode}"
        case m.EpisodeEnd(episode=episode):
            return f"to end episode {episode}"
        case _:
            return f"to handle {message_type(task)}"
