"""The processes of a Dask cluster that play episodes: here, or at a scheduler elsewhere.

Dask starts processes, finds free ones and moves tasks. What is done stands in the catalogue, and an episode
may be played twice without harm: so a worker that dies, hangs or loses its scheduler costs time alone.
"""

from __future__ import annotations

import logging
import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any

from caviar_clients.datasets.episode import EpisodeResult, EpisodeTask, play_episode
from caviar_protocol.errors import RunError
from caviar_services.drjit_setup import THREADS_VARIABLE

# Part of the extra `datasets`: imported where it is used.
if TYPE_CHECKING:
    from distributed import Client, Future

ATTEMPTS = 5
"""Times that an episode is begun, where the processes that play it die."""
QUEUED = 2
"""Episodes that wait at each worker, so that none waits for this process."""
CONNECT_S = 10.0
RECONNECT_S = 600.0
"""[s] for which a scheduler that is gone is waited for."""
STRAGGLER = 6.0
"""An episode that takes so many times as long as the mean, when no other is left to begin, is begun on a
second worker."""

_CONFIG = {
    # Episodes are begun again by `Episodes`, which counts: one that kills its worker does so a few times.
    "distributed.scheduler.allowed-failures": 0,
    "distributed.worker.daemon": True,
    # Its samples of stacks grow by 0.3 MB an episode, for good (distributed 2026.8).
    "distributed.worker.profile.enabled": False,
    # A worker's memory is that of ray tracer and SUMO, of which Dask can spill nothing.
    "distributed.worker.memory.target": False,
    "distributed.worker.memory.spill": False,
    "distributed.worker.memory.pause": False,
    "distributed.worker.memory.terminate": False,
    "distributed.comm.timeouts.connect": f"{CONNECT_S:.0f}s",
    # One thread of the ray tracer in each process: two processes do 1.7 times the work of one with two.
    "distributed.nanny.pre-spawn-environ": {
        THREADS_VARIABLE: "1",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
    },
}


class LostSchedulerError(Exception):
    """The scheduler is gone, or has forgotten the tasks that it was given."""


class Episodes:
    """Plays episodes on a cluster.

    Args:
        workers: Processes here; 0: as many as there are cores. Ignored where there is a scheduler.
        scheduler: Address of one that runs already, ``tcp://HOST:8786``; empty: a cluster of this machine.
        on_note: Called with what a user has to know: that a scheduler is waited for.
    """

    def __init__(
        self, workers: int, scheduler: str = "", on_note: Callable[[str], None] = lambda _: None
    ) -> None:
        self.workers = workers or len(os.sched_getaffinity(0))
        """Processes that play; of a scheduler elsewhere it is known once it is connected."""
        self._scheduler, self._note = scheduler, on_note
        self._client: Client | None = None
        self._stack = ExitStack()

    def __enter__(self) -> Episodes:
        import dask

        dask.config.set(_CONFIG)
        for name in (
            "distributed",
            "distributed.nanny",
            "distributed.scheduler",
            "distributed.worker",
            "tornado",
        ):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._connect()
        return self

    def __exit__(self, *_: object) -> None:
        self._disconnect()

    def run_on_each(self, function: Callable[..., Any], *arguments: Any) -> list[Any]:
        """Call a function once in every worker at the same time.

        Args:
            function: Which can be pickled.
            arguments: Of it.

        Returns:
            What it returned, by worker.
        """
        client = self._connected
        addresses = list(client.scheduler_info(n_workers=-1)["workers"])
        futures = [
            client.submit(function, *arguments, workers=[address], pure=False, allow_other_workers=False)
            for address in addresses
        ]
        try:
            return list(client.gather(futures))
        except Exception as error:
            # Of Dask: the process died, or its machine is gone.
            if type(error).__name__ != "KilledWorker":
                raise
            raise RunError(
                "a process that tried a scene beforehand died, of a signal, a lack of memory or an exit of a "
                "service; play it alone with --workers 1 to see it"
            ) from error

    def play(self, tasks: Iterable[EpisodeTask]) -> Iterator[EpisodeResult]:
        """Play episodes, and yield what came of each, as they end.

        Args:
            tasks: The episodes, in the order in which they begin.

        Raises:
            RunError: The scheduler is gone and does not come back.
        """
        waiting, playing = deque[EpisodeTask](), _Playing()
        source = iter(tasks)
        while True:
            try:
                self._fill(source, waiting, playing)
                if not playing.tasks:
                    return
                for future in self._ended(playing):
                    task = playing.end(future)
                    if task is None:  # its twin was quicker
                        continue
                    try:
                        result = self._result(future, task, playing)
                    except (LostSchedulerError, OSError, TimeoutError):
                        waiting.append(task)  # it has ended, but its result is lost with the scheduler
                        raise
                    if result is None:
                        waiting.append(task)
                    else:
                        yield result
            except (LostSchedulerError, OSError, TimeoutError) as error:
                waiting.extend(playing.clear())
                self._reconnect(error)

    def _fill(self, source: Iterator[EpisodeTask], waiting: deque[EpisodeTask], playing: _Playing) -> None:
        while len(playing.tasks) < self.workers * QUEUED:
            task = waiting.popleft() if waiting else next(source, None)
            if task is None:
                if (straggler := playing.straggler(self.workers)) is not None:
                    playing.begin(self._submit(straggler), straggler)
                return
            try:
                future = self._submit(task)
            except (LostSchedulerError, OSError, TimeoutError):
                waiting.append(task)
                raise
            playing.begin(future, task)

    def _submit(self, task: EpisodeTask) -> Future:
        if self._connected.status != "running":
            raise LostSchedulerError("the connection to it is lost")
        future: Future = self._connected.submit(play_episode, task, pure=False)
        return future

    def _ended(self, playing: _Playing) -> list[Future]:
        from distributed import wait
        from distributed.client import FuturesCancelledError

        try:
            with suppress(TimeoutError), self._connected.as_current():
                wait(list(playing.tasks), timeout=1.0, return_when="FIRST_COMPLETED")
        except FuturesCancelledError as error:
            raise LostSchedulerError("the connection to it is lost") from error
        ended = [future for future in playing.tasks if future.status != "pending"]
        if any(future.status in ("cancelled", "lost") for future in ended) or (
            self._connected.status not in ("running", "connecting")
        ):
            raise LostSchedulerError("its tasks are gone")
        return ended

    def _result(self, future: Future, task: EpisodeTask, playing: _Playing) -> EpisodeResult | None:
        """What came of a task; None: it is begun once more."""
        if future.status == "finished":
            found: EpisodeResult = future.result()
            return found
        error = future.exception()
        name = type(error).__name__
        if name != "KilledWorker":
            return EpisodeResult(task.episode, f"{name}: {error}")
        if playing.attempts[task.episode] < ATTEMPTS:
            return None
        return EpisodeResult(
            task.episode,
            f"the process that played it died {ATTEMPTS} times, of a signal or a lack of memory; play "
            "it alone with --workers 1 to see it",
        )

    # --- connection --------------------------------------------------------------------------------

    @property
    def _connected(self) -> Client:
        if self._client is None:
            raise LostSchedulerError("there is no connection")
        return self._client

    def _connect(self) -> None:
        from distributed import Client, LocalCluster

        if self._scheduler:
            try:
                self._client = Client(self._scheduler, timeout=CONNECT_S, set_as_default=False)
                self._client.wait_for_workers(1, timeout=CONNECT_S)
            except (OSError, TimeoutError, ValueError) as error:
                raise RunError(
                    f"no Dask scheduler answers at {self._scheduler} within {CONNECT_S:.0f} s, or it has no "
                    f"worker: start it with "
                    "dask scheduler, and workers with dask worker ADDRESS --nthreads 1"
                ) from error
            self._stack.callback(self._client.close, timeout=5)
            self.workers = len(self._client.scheduler_info(n_workers=-1)["workers"])
            return
        cluster = self._stack.enter_context(
            LocalCluster(
                n_workers=self.workers,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:0",
                memory_limit=0,
                silence_logs=logging.CRITICAL,
            )
        )
        self._client = self._stack.enter_context(Client(cluster, set_as_default=False))

    def _disconnect(self) -> None:
        self._client = None
        self._stack.close()

    def _reconnect(self, cause: Exception) -> None:
        where = self._scheduler or "of this machine"
        self._note(
            f"the Dask scheduler {where} is gone ({cause}): waiting for it, {RECONNECT_S:.0f} s at most"
        )
        end = time.monotonic() + RECONNECT_S
        while True:
            with suppress(Exception):  # what is left of a broken connection
                self._disconnect()
            self._stack = ExitStack()
            try:
                self._connect()
            except (RunError, OSError, TimeoutError):
                if time.monotonic() > end:
                    raise
                time.sleep(1.0)
            else:
                return


class _Playing:
    """The tasks that are at the cluster."""

    def __init__(self) -> None:
        self.tasks: dict[Future, EpisodeTask] = {}
        self.attempts: dict[int, int] = {}
        self._begun: dict[Future, float] = {}
        self._twins: set[int] = set()
        self._ended = 0
        self._mean_s = 0.0

    def begin(self, future: Future, task: EpisodeTask) -> None:
        self.tasks[future] = task
        self._begun[future] = time.monotonic()
        if task.episode not in self._twins:
            self.attempts[task.episode] = self.attempts.get(task.episode, 0) + 1

    def end(self, future: Future) -> EpisodeTask | None:
        """The task that ended; None where another one has had its episode."""
        task = self.tasks.pop(future, None)
        if task is None:
            return None
        self._ended += 1
        self._mean_s += (time.monotonic() - self._begun.pop(future) - self._mean_s) / self._ended
        twins = [other for other, its in self.tasks.items() if its.episode == task.episode]
        for twin in twins if future.status == "finished" else ():
            del self.tasks[twin], self._begun[twin]
            twin.release()
        return None if twins and future.status != "finished" else task

    def straggler(self, workers: int) -> EpisodeTask | None:
        """An episode that is worth a second worker."""
        if not self._ended or len(self.tasks) >= workers:
            return None
        now = time.monotonic()
        for future, task in self.tasks.items():
            late = now - self._begun[future] > STRAGGLER * max(self._mean_s, 1.0)
            if late and task.episode not in self._twins:
                self._twins.add(task.episode)
                return task
        return None

    def clear(self) -> list[EpisodeTask]:
        """The tasks that were at a cluster that is gone, each once."""
        found = {task.episode: task for task in self.tasks.values()}
        self.tasks.clear()
        self._begun.clear()
        self._twins.clear()
        return list(found.values())
