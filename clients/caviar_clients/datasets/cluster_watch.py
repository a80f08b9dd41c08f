"""Watch of a generation: workers that are gone or give no sign of life, and steps that do not end.

`StepWatch` tells it in the process that plays an episode, `ClusterWatch` in the command. Times are arguments:
the command reads the clock.
"""

from __future__ import annotations

import logging
import re
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from caviar_protocol.errors import RunError

TOPIC = "caviar-waiting"
"""Of the events by which workers tell what they wait for."""
LOOK_S = 5.0
"""[s] without a result after which the scheduler is asked for its workers, between two such questions, and
between two reports of a step that goes on."""
REPORTED_S = 15.0
"""[s] without a report of a step after which it has ended, or its process gives no sign of life."""
NOTE_S = 30.0
"""[s] without a result after which a note says what is waited for, and between two such notes."""
SILENT_S = 30.0
"""[s] without a sign of life after which a worker is named."""
NO_WORKER_S = 60.0
"""[s] without any worker after which the command ends, where a scheduler elsewhere has them."""
NO_PROCESS_S = 300.0
"""The same for processes of this machine: Dask starts them anew, for which a busy machine takes a while."""
STALLED_S = 600.0
"""[s] in one step of a service after which its episode is given up, and its process is started anew."""
SHOWN = 3
"""Workers and episodes that a note names."""

_log = logging.getLogger("caviar.session")


class StepWatch:
    """Tells the command what an episode waits for, where a step of a service takes seconds.

    Outside of a worker of Dask it is a warning of the logger ``caviar.session``.

    Args:
        episode: Which is played in this process.
    """

    def __init__(self, episode: int) -> None:
        self._episode, self._since = episode, time.monotonic()
        self._worker = _worker_of_task()

    def frame_finished(self, _: object) -> None:
        """A frame ended: what is waited for from now on has begun now."""
        self._since = time.monotonic()

    def waits(self, text: str) -> None:
        """Tell what is waited for (`caviar_clients.session.watchdog.Watchdog`, in whose thread this runs).

        Args:
            text: Of the service, the frame, and the line of code.
        """
        if self._worker is None:
            _log.warning(text)
            return
        stands_s = time.monotonic() - self._since
        about = {"episode": self._episode, "text": text, "stands_s": stands_s, "worker": self._worker.address}
        self._worker.log_event(TOPIC, about)


def _worker_of_task() -> Any:
    """The worker of Dask that runs the task of this thread; None where there is none."""
    try:
        from distributed import get_worker

        return get_worker()
    except (ImportError, ValueError):
        return None


@dataclass(frozen=True)
class Stall:
    """A step of a service that does not end."""

    text: str
    """Service, frame and line of code."""
    stands_s: float
    """For how long [s]."""
    worker: str
    """Address of the process."""
    reported: float
    """When the worker reported it, of the clock of `ClusterWatch`."""

    @property
    def error(self) -> str:
        """Error of an episode that is given up for it."""
        return (
            f"given up after {self.stands_s:.0f} s in one step, {STALLED_S:.0f} s are the limit: {self.text}"
            "; mend the service, or ask less of it"
        )


@dataclass
class ClusterWatch:
    """Watches the workers of a scheduler while the command waits for results.

    Args:
        scheduler: Its address; empty: of processes of this machine.
        last_seen: Asks the scheduler for its workers: by address, when each gave its last sign of life, in
            any clock.
        note: Called with a line for the user.
        clock: Of the times that are arguments [s].

    Example:
        >>> watch = ClusterWatch("tcp://10.0.0.1:8786", dict, print)
        >>> watch.progressed(0.0)
        >>> watch.look(30.0, "no episode has ended", [3])
        no episode has ended for 30 s: episode 3 is at the workers; the scheduler tcp://10.0.0.1:8786 has \
had no worker for 30 s: start one with dask worker tcp://10.0.0.1:8786 --nthreads 1
        {}
    """

    scheduler: str
    last_seen: Callable[[], Mapping[str, float]]
    note: Callable[[str], None]
    clock: Callable[[], float] = time.monotonic
    _progressed: float = 0.0
    _looked: float = 0.0
    _noted: float = 0.0
    # When there was a worker for sure: a result came, or one was listed.
    _manned: float = 0.0
    # By address: the last sign of life in the scheduler's clock, and when it came in ours.
    _seen: dict[str, tuple[float, float]] = field(default_factory=dict)
    present: frozenset[str] = frozenset()
    """Addresses of the workers, when they were looked at; empty where they were not since the last result."""
    # Written by a thread of Dask, one item at a time.
    _stalls: dict[int, Stall] = field(default_factory=dict)

    def progressed(self, now: float) -> None:
        """A result came, or the wait begins.

        Args:
            now: Time [s].
        """
        self._progressed, self._manned, self.present = now, now, frozenset()

    def tell(self, event: tuple[float, Any]) -> None:
        """Take what a `StepWatch` tells, as a handler of Dask's events.

        Args:
            event: Time of the scheduler, and message.
        """
        match event[1]:
            case {"episode": int(episode), "text": str(text), "stands_s": float(s), "worker": str(worker)}:
                self._stalls[episode] = Stall(text, s, worker, self.clock())
            case _:  # of another version of CAVIAR at a worker: it tells nothing that could be used
                pass

    def phase(self, now: float) -> str:
        """Name what a service does that has prepared for seconds, as it says; empty: none has.

        Args:
            now: Time [s].
        """
        texts = (stall.text for stall in self._standing_now(now).values())
        said = (re.search(r"to prepare\b.*?\((.+?)\)", text) for text in texts)
        return next((found[1] for found in said if found), "")

    def look(
        self, now: float, what: str, episodes: Collection[int] | None, *, mean_s: float = 0.0
    ) -> dict[int, Stall]:
        """Look at the workers, where no result has come for a while, and tell the user what is waited for.

        Args:
            now: Time [s].
            what: Is waited for: ``no episode has ended``.
            episodes: That are at the workers; None: what any of them tells is looked at.
            mean_s: Time of an episode so far [s]: waits of up to twice as long get no note, if nothing is
                strange.

        Returns:
            Episodes in which one step of a service has taken `STALLED_S`.

        Raises:
            RunError: There has been no worker for `NO_WORKER_S`, or `NO_PROCESS_S`.
        """
        stalls = {n: s for n, s in self._standing_now(now).items() if episodes is None or n in episodes}
        over = {number: stall for number, stall in stalls.items() if stall.stands_s >= STALLED_S}
        for number in over:
            del self._stalls[number]
        # Of other episodes results may come meanwhile.
        if over or now - max(self._progressed, self._looked) < LOOK_S:
            return over
        self._looked = now
        seen = self.last_seen()
        self.present = frozenset(seen)
        self._manned = now if seen else self._manned
        self._seen = {
            address: old if (old := self._seen.get(address)) and old[0] == stamp else (stamp, now)
            for address, stamp in seen.items()
        }
        standing = [f"episode {number}: {stall.text}" for number, stall in sorted(stalls.items())[:SHOWN]]
        strange = [*self._without_workers(now), *self._silent(now), *standing]
        waited_s = now - self._progressed
        is_due = now - max(self._progressed, self._noted) >= NOTE_S
        if is_due and (strange or waited_s >= 2.0 * mean_s):
            self._noted = now
            at_workers = "" if episodes is None else f": {_at_workers(episodes)}"
            self.note("; ".join([f"{what} for {waited_s:.0f} s{at_workers}", *strange]))
        return {}

    def _standing_now(self, now: float) -> dict[int, Stall]:
        """Steps that go on, each with its time of now: a worker reports them every `LOOK_S`."""
        return {
            number: replace(stall, stands_s=stall.stands_s + now - stall.reported)
            for number, stall in self._stalls.copy().items()
            if now - stall.reported <= REPORTED_S
        }

    def _without_workers(self, now: float) -> list[str]:
        if self._seen:
            return []
        limit_s, empty_s = NO_WORKER_S if self.scheduler else NO_PROCESS_S, now - self._manned
        since = f"for {empty_s:.0f} s"
        if self.scheduler:
            start = f"start one with dask worker {self.scheduler} --nthreads 1"
            text = f"the scheduler {self.scheduler} has had no worker {since}: {start}"
        else:
            text = f"there has been no process that plays {since}, and Dask has not started one yet"
        if empty_s >= limit_s:
            then = "then the" if self.scheduler else "the"
            raise RunError(f"{text}; {then} same command goes on with what is left")
        return [text]

    def _silent(self, now: float) -> list[str]:
        silent = [(address, now - at) for address, (_, at) in self._seen.items() if now - at >= SILENT_S]
        if not silent:
            return []
        named = ", ".join(f"{address} for {silent_s:.0f} s" for address, silent_s in silent[:SHOWN])
        more = f" (and {len(silent) - SHOWN} more)" if len(silent) > SHOWN else ""
        return [f"{len(silent)} of {len(self._seen)} workers give no sign of life: {named}{more}"]


def _at_workers(episodes: Collection[int]) -> str:
    first = min(episodes, default=None)
    if first is None:
        return "nothing is at the workers"
    if len(episodes) == 1:
        return f"episode {first} is at the workers"
    return f"{len(episodes)} episodes are at the workers, episode {first} the first"
