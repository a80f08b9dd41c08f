"""The processes of a Dask cluster that play episodes: here, or at a scheduler elsewhere.

Dask starts processes, finds free ones and moves tasks. What is done stands in the catalogue, and an episode
may be played twice without harm: so a worker that dies, hangs or loses its scheduler costs time alone.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any

from caviar_clients.datasets.cluster_watch import NO_WORKER_S, NOTE_S, TOPIC, ClusterWatch, Stall
from caviar_clients.datasets.episode import EpisodeResult, EpisodeTask, play_episode
from caviar_clients.datasets.local_cluster import (
    CONNECT_S,
    KNOWN_S,
    exit_of,
    noting_nanny,
    set_up_dask,
    start_workers,
)
from caviar_protocol.errors import CaviarError, RunError

# Part of the extra `datasets`: imported where it is used.
if TYPE_CHECKING:
    from distributed import Client, Future

ATTEMPTS = 5
"""Times that an episode is begun, where the processes that play it die."""
QUEUED = 2
"""Episodes that wait at each worker, so that none waits for this process."""
RECONNECT_S = 600.0
"""[s] for which a scheduler that is gone is waited for."""
ANSWER_S = 20.0
"""[s] within which a scheduler answers, and a worker hands over what came of an episode."""
STRAGGLER = 6.0
"""An episode that takes so many times as long as the mean, when no other is left to begin, is begun on a
second worker."""


class NoWorkerError(RunError):
    """A scheduler answers, and has no worker."""


class LostSchedulerError(Exception):
    """The scheduler is gone, or has forgotten the tasks that it was given."""


class Episodes:
    """Plays episodes on a cluster.

    Args:
        workers: Processes here; 0: as many as there are cores. Ignored where there is a scheduler.
        scheduler: Address of one that runs already, ``tcp://HOST:8786``; empty: a cluster of this machine.
        on_note: Called with what a user has to know: that a scheduler is waited for.
        on_return: Called when a scheduler that was lost is there again.
    """

    def __init__(
        self,
        workers: int,
        scheduler: str = "",
        on_note: Callable[[str], None] = lambda _: None,
        on_return: Callable[[], None] = lambda: None,
    ) -> None:
        self.workers = workers or len(os.sched_getaffinity(0))
        """Processes that play; of a scheduler elsewhere it is known once it is connected."""
        self._scheduler, self._note, self._returned = scheduler, on_note, on_return
        self._client: Client | None = None
        self._watch = ClusterWatch(scheduler, dict, on_note)
        self._stack = ExitStack()

    def __enter__(self) -> Episodes:
        set_up_dask()
        try:
            self._connect()
        except BaseException:
            self._disconnect(at_once=True)
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._disconnect(at_once=kind is not None)

    def run_on_each(
        self,
        function: Callable[..., Any],
        *arguments: Any,
        on_look: Callable[[int, int, str], None] = lambda done, of, phase: None,
    ) -> list[Any]:
        """Call a function once in every worker at the same time.

        Args:
            function: Which can be pickled.
            arguments: Of it.
            on_look: Called about every second with the number of results so far, that of the workers, and
                what a service says that it does where it prepares for seconds.

        Returns:
            What it returned, by worker; those that are gone meanwhile are left out.

        Raises:
            RunError: A worker died, all are gone, or a step of a service does not end.
        """
        client = self._connected
        pending = {
            client.submit(
                function, *arguments, workers=[address], pure=False, allow_other_workers=False
            ): address
            for address in self._last_seen()
        }
        self._watch.progressed(time.monotonic())
        found, workers = list[Any](), len(pending)
        on_look(0, workers, "")
        try:
            while pending:
                found += self._tried(pending)
                on_look(len(found), workers, self._watch.phase(time.monotonic()))
        except (LostSchedulerError, OSError, TimeoutError) as error:
            raise RunError(
                f"the Dask scheduler {self._where} was lost while scenes were tried "
                f"({error or 'it does not answer'}); start it again, and run the same command"
            ) from error
        if not found:
            raise RunError(
                f"all workers of the Dask scheduler {self._where} that tried scenes are gone; start others, "
                "with --nthreads 1, and run the same command"
            )
        return found

    def _tried(self, pending: dict[Future, str]) -> list[Any]:
        """Results of the trials that have ended, which are no longer pending, after a second at most."""
        ended = self._ended(pending)
        for future in ended:
            del pending[future]
        found = [self._result_of_trial(future) for future in ended]
        what = "scenes have been tried beforehand, at every worker,"
        for stall in self._watch.look(time.monotonic(), what, None).values():
            raise RunError(f"no scene can be played: {stall.error}")
        # No other worker may have the task of one that is gone.
        if there := self._watch.present:
            for future in [one for one, address in pending.items() if address not in there]:
                del pending[future]
        return found

    def _result_of_trial(self, future: Future) -> Any:
        if future.status == "finished":
            return future.result(timeout=ANSWER_S)
        error = future.exception(timeout=ANSWER_S)
        if isinstance(error, CaviarError):
            raise error
        if type(error).__name__ != "KilledWorker":  # of Dask: the process died, or its machine is gone
            raise RunError(f"no scene can be played: {type(error).__name__}: {error}") from error
        raise RunError(
            f"a process that tried a scene beforehand died ({self._exit_of(error)}); caviar run SCENARIO "
            "--embedded plays it in one process and shows what it prints"
        ) from error

    def play(self, tasks: Iterable[EpisodeTask]) -> Iterator[EpisodeResult]:
        """Play episodes, and yield what came of each, as they end.

        Args:
            tasks: The episodes, in the order in which they begin.

        Raises:
            RunError: The scheduler is gone and does not come back, or has no workers any more.
        """
        waiting, playing = deque[EpisodeTask](), _Playing()
        source = iter(tasks)
        self._watch.progressed(time.monotonic())
        while True:
            try:
                self._fill(source, waiting, playing)
                if not playing.tasks:
                    return
                for future in self._ended(playing.tasks):
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
                        self._watch.progressed(time.monotonic())
                        yield result
                        self._watch.progressed(time.monotonic())
                for episode, stall in self._stalls(playing).items():
                    playing.give_up(episode)
                    yield EpisodeResult(episode, stall.error)
                    self._end_process(stall.worker)
            except (LostSchedulerError, OSError, TimeoutError) as error:
                waiting.extend(playing.clear())
                self._reconnect(error)

    def _fill(self, source: Iterator[EpisodeTask], waiting: deque[EpisodeTask], playing: _Playing) -> None:
        while len(playing.tasks) < self.workers * QUEUED:
            task = next(source, None)
            # What ended with its process comes last and queues behind none: another may have ended that.
            if task is None and waiting and len(playing.tasks) < self.workers:
                task = waiting.popleft()
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

    def _stalls(self, playing: _Playing) -> dict[int, Stall]:
        episodes = {task.episode for task in playing.tasks.values()}
        now = time.monotonic()
        return self._watch.look(now, "no episode has ended", episodes, mean_s=playing.mean_s)

    def _end_process(self, worker: str) -> None:
        """End the process of a worker, which nothing else gets out of a step; Dask's nanny starts it anew.

        One that you started without a nanny is lost.
        """
        # The loop of a worker goes on beside a step. Dask's own restart waits for the step to end.
        with suppress(OSError, TimeoutError):
            self._connected.run(_exit, workers=[worker], wait=False, on_error="ignore")

    def _last_seen(self) -> dict[str, float]:
        """Workers by address, with the scheduler's time of their last sign of life [s]."""
        client = self._connected
        found = client.sync(client.scheduler.identity, n_workers=-1, callback_timeout=ANSWER_S)
        return {address: about["last_seen"] for address, about in found["workers"].items()}

    def _ended(self, tasks: Mapping[Future, object]) -> list[Future]:
        """Tasks of these that have ended, after a second at most."""
        from distributed import wait
        from distributed.client import FuturesCancelledError

        try:
            with suppress(TimeoutError), self._connected.as_current():
                wait(list(tasks), timeout=1.0, return_when="FIRST_COMPLETED")
        except FuturesCancelledError as error:
            raise LostSchedulerError("the connection to it is lost") from error
        ended = [future for future in tasks if future.status != "pending"]
        if any(future.status in ("cancelled", "lost") for future in ended) or (
            self._connected.status not in ("running", "connecting")
        ):
            raise LostSchedulerError("its tasks are gone")
        return ended

    def _result(self, future: Future, task: EpisodeTask, playing: _Playing) -> EpisodeResult | None:
        """Result of a task; None: it is begun once more."""
        if future.status == "finished":
            try:
                found: EpisodeResult = future.result(timeout=ANSWER_S)
            except TimeoutError:  # the worker that has it is stopped; the recording is there
                return self._again(task, playing, "whose results could not be had")
            return found
        error = future.exception()
        name = type(error).__name__
        if name != "KilledWorker":
            return EpisodeResult(task.episode, f"{name}: {error}")
        return self._again(task, playing, f"that died ({self._exit_of(error)})")

    def _exit_of(self, error: Any) -> str:
        """Say how the process of a `KilledWorker` of Dask ended."""
        return exit_of(error.last_worker.address, wait_s=0.0 if self._scheduler else KNOWN_S)

    def _again(self, task: EpisodeTask, playing: _Playing, why: str) -> EpisodeResult | None:
        if playing.attempts[task.episode] < ATTEMPTS:
            return None
        return EpisodeResult(
            task.episode,
            f"it was played {ATTEMPTS} times by processes {why}; play it alone with --workers 1 to see it",
        )

    # --- connection --------------------------------------------------------------------------------

    @property
    def _where(self) -> str:
        return self._scheduler or "of this machine"

    @property
    def _connected(self) -> Client:
        if self._client is None:
            raise LostSchedulerError("there is no connection")
        return self._client

    def _connect(self) -> None:
        from distributed import Client, Security

        if self._scheduler:
            if self._scheduler.startswith("tls:") and Security().tls_client_cert is None:
                raise RunError(
                    f"--scheduler {self._scheduler}: there is no certificate for TLS; set ca-file and "
                    "client of distributed.comm.tls in Dask's configuration, ~/.config/dask/tls.yaml"
                )
            try:
                self._client = Client(self._scheduler, timeout=CONNECT_S, set_as_default=False)
                self._stack.callback(self._client.close, timeout=5)
            except (OSError, TimeoutError, ValueError) as error:
                raise RunError(
                    f"no Dask scheduler answers at {self._scheduler} within {CONNECT_S:.0f} s: start it with "
                    "dask scheduler, and workers with dask worker ADDRESS --nthreads 1"
                ) from error
            try:
                self._client.wait_for_workers(1, timeout=CONNECT_S)
            except (OSError, TimeoutError) as error:
                raise NoWorkerError(
                    f"the Dask scheduler {self._scheduler} has no worker: start one with "
                    f"dask worker {self._scheduler} --nthreads 1"
                ) from error
            self._watch_workers()
            self.workers = len(self._last_seen())
            return
        self._client = start_workers(self.workers, self._stack)
        self._watch_workers()

    def _watch_workers(self) -> None:
        self._watch = ClusterWatch(self._scheduler, self._last_seen, self._note)
        self._watch.progressed(time.monotonic())
        self._connected.subscribe_topic(TOPIC, self._watch.tell)

    def _disconnect(self, *, at_once: bool = False) -> None:
        self._client, noting_nanny().at_once = None, at_once
        self._stack.close()

    def _reconnect(self, cause: Exception) -> None:
        self._note(
            f"the Dask scheduler {self._where} is gone ({cause or 'it does not answer'}): waiting for it, "
            f"{RECONNECT_S:.0f} s at most"
        )
        began = noted = time.monotonic()
        unmanned: float | None = None  # since when a scheduler has answered that has no worker
        while True:
            with suppress(Exception):  # what is left of a broken connection
                self._disconnect()
            self._stack = ExitStack()
            try:
                self._connect()
            except (RunError, OSError, TimeoutError) as error:
                now = time.monotonic()
                unmanned = (unmanned or now) if isinstance(error, NoWorkerError) else None
                if now > began + RECONNECT_S or (unmanned is not None and now > unmanned + NO_WORKER_S):
                    raise
                if now > noted + NOTE_S:
                    noted = now
                    self._note(f"waiting for {now - began:.0f} s: {error}")
                time.sleep(1.0)
            else:
                self._returned()
                return


class _Playing:
    """The tasks that are at the cluster."""

    def __init__(self) -> None:
        self.tasks: dict[Future, EpisodeTask] = {}
        self.attempts: dict[int, int] = {}
        self._begun: dict[Future, float] = {}
        self._twins: set[int] = set()
        self._ended = 0
        self.mean_s = 0.0
        """Time of an episode at the cluster so far [s]."""

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
        self.mean_s += (time.monotonic() - self._begun.pop(future) - self.mean_s) / self._ended
        twins = [other for other, its in self.tasks.items() if its.episode == task.episode]
        for twin in twins if future.status == "finished" else ():
            del self.tasks[twin], self._begun[twin]
            twin.release()
        return None if twins and future.status != "finished" else task

    def give_up(self, episode: int) -> None:
        """Take an episode from the workers."""
        for future in [one for one, task in self.tasks.items() if task.episode == episode]:
            del self.tasks[future], self._begun[future]
            future.release()

    def straggler(self, workers: int) -> EpisodeTask | None:
        """An episode that is worth a second worker."""
        if not self._ended or len(self.tasks) >= workers:
            return None
        now = time.monotonic()
        for future, task in self.tasks.items():
            late = now - self._begun[future] > STRAGGLER * max(self.mean_s, 1.0)
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


async def _exit() -> None:
    """End this process, as a fault would."""
    await asyncio.sleep(0.1)  # the scheduler has its answer first
    os._exit(1)
