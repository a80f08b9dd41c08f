"""A service's side of a run without I/O: what a `Service` does with each message, from WELCOME to BYE.

`ServiceSession` turns messages of the broker into calls of a service, and what the service makes of them
into messages. It reads no socket and arms no timer. The shells around it move the messages: `runner.Runner`
over ZeroMQ, and the embedded run between the frame clock and the services of one process.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

from caviar_protocol import messages as m
from caviar_protocol.assets import AssetStore
from caviar_protocol.codec import message_type
from caviar_protocol.digest import geometry_digest
from caviar_protocol.errors import AssetError, ProtocolError, RunError
from caviar_protocol.fields import MAX_IN_FLIGHT
from caviar_protocol.host import trim_memory
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.space.codebooks import add_codebook_files
from caviar_protocol.validation import ContentCheck
from caviar_services.conversion import (
    Answer,
    Answers,
    content_rules,
    encoded_done,
    fault_from,
    frame_inputs,
    granted_frame,
    is_needed,
    missing_codebooks,
    plain_done,
    run_info,
    sorted_products,
)
from caviar_services.run_time_geometry import AnnouncedMeshes, AssetFetcher, FetchedFile, FollowedMeshes
from caviar_services.service import (
    Frame,
    Preparation,
    Prepared,
    Progress,
    Service,
    StepResult,
    no_orders,
    no_progress,
    returned,
)

TRIM_EVERY = 10
"""Frames after which a service releases what it does not need."""
TRIM_S = 1.0
"""[s] from one return of free memory to the system to the next. Megabytes come and go in each frame in ever
other sizes, and what they leave behind would creep up for hours. A return costs 0.1 ms, and 0.5 ms of page
faults after it: after every tenth frame that would be a twentieth of a small service's work."""
FETCH_TIMEOUT_S = 30.0
"""[s] until the broker has to answer a request for scenery."""

Send: TypeAlias = Callable[[m.Message, Sequence[Any]], None]
"""``send(message, parts)``: hand a message, and the parts after it, to the broker."""


class ServiceSession:
    """One service in one run, driven by the messages of its broker.

    Args:
        name: Name of the service in the run.
        use: What the implementation is called, for HELLO and error texts.
        cls: The implementation.
        send: Takes the answers. An exception of it that is an `Exception` counts as the service's fault.
        store: Where the files of scenery are.
        progress: Called with what the service does. No progress is reported by default.
        attend: Looks for orders of the broker in the middle of a step (`RunInfo.attend`).
        check: Check of products that all services of one process share: it looks at each product once, and a
            frame that is granted twice is computed twice. None: the service has a process of its own.
        encodes: Whether products travel as bytes, with digests; else parts of GRANT and DONE are payloads.
        tunes_memory: Whether garbage collection and allocator of the process may be tuned for this service.
        fetch_timeout_s: Time that the broker has to answer a request for scenery [s].

    Example:
        >>> from caviar_protocol.assets import AssetStore
        >>> from caviar_services.agent.baselines import RandomAgent
        >>> sent = []
        >>> session = ServiceSession(
        ...     "agent", "random", RandomAgent, lambda message, parts: sent.append(message), AssetStore()
        ... )
        >>> times = {"heartbeat_ns": 100_000_000, "liveness_ns": 1_500_000_000}
        >>> version = m.PROTOCOL_VERSION
        >>> session.handle(m.Welcome(version=version, epoch=1, attempt=1, run="demo", seed=1, **times))
        >>> session.handle(m.Prepare(epoch=1, attempt=1, demand=(m.Demand(topic="action"),)))
        >>> session.handle(m.Reset(epoch=1, attempt=1, episode=0, seed=1, t0_ns=0))
        >>> [type(message).__name__ for message in sent]
        ['Ready', 'ResetDone']
    """

    def __init__(
        self,
        name: str,
        use: str,
        cls: type[Service[Any]],
        send: Send,
        store: AssetStore,
        *,
        progress: Progress = no_progress,
        attend: Callable[[], None] = no_orders,
        check: ContentCheck | None = None,
        encodes: bool = True,
        tunes_memory: bool = False,
        fetch_timeout_s: float = FETCH_TIMEOUT_S,
    ) -> None:
        self.name, self.use, self.cls = name, use, cls
        self._send, self._store, self._progress, self._attend = send, store, progress, attend
        self._encodes, self._tunes_memory = encodes, tunes_memory
        self._check = check or ContentCheck()
        # A frame clock in the same process repeats no GRANT: answers would be kept for nothing.
        self._answers = Answers() if check is None else None
        self._service: Service[Any] | None = None
        self._identity: dict[str, Any] = {}  # epoch and attempt, which stand in every message (clause 1)
        self._reset_to: m.Reset | None = None
        self._found: dict[str, Path] = {}  # the service's own files, by digest
        # When free memory is given back next [s].
        self._trim_at = 0.0
        self.failed = False
        """Whether the service failed, and said so with a FAULT."""
        self._files = AssetFetcher(store, send, fetch_timeout_s)
        self._scenery = AssetFetcher(store, send, fetch_timeout_s, self._note_fetching)
        self._followed = FollowedMeshes(store, self._files, lambda: self.running, self._loaded_meshes)
        self._announced = AnnouncedMeshes(store)
        self._handlers: Mapping[type, Callable[[Any, Sequence[Any], float], None]] = {
            m.Welcome: self._welcome,
            m.Prepare: self._prepare,
            m.AssetGet: self._serve_asset,
            m.AssetData: self._asset_data,
            m.Reset: self._reset,
            m.Grant: self._grant,
            m.Geometry: self._geometry,
            m.EpisodeEnd: self._episode_end,
            m.Checkpoint: self._checkpoint,
            m.Restore: self._restore,
            m.Error: self._error,
            # Advisory: a step that has begun is finished, and what is stale is over.
            m.Cancel: _ignore,
            m.Stale: _ignore,
            m.Shutdown: lambda message, parts, now: self.leave(message.reason),
        }

    @property
    def joined(self) -> bool:
        """Whether WELCOME came."""
        return bool(self._identity)

    @property
    def attempt(self) -> int:
        """Incarnation of the service that the broker knows; 0 before WELCOME."""
        attempt: int = self._identity.get("attempt", 0)
        return attempt

    @property
    def deadline(self) -> float | None:
        """When `expire` is due, on the clock of ``now`` [s]; None while nothing is awaited."""
        both = (self._scenery.deadline, self._files.deadline)
        return min((due for due in both if due is not None), default=None)

    def hello(self, host: str = "", pid: int = 0) -> m.Hello:
        """HELLO, with which a service joins.

        Args:
            host: Identity of the machine, where the broker may watch the process.
            pid: Process id there.
        """
        cls = self.cls
        return m.Hello(
            version=m.PROTOCOL_VERSION,
            name=self.name,
            role=cls.role,
            inputs=cls.inputs,
            outputs=cls.outputs,
            capabilities=tuple(
                c
                for c in m.CAPABILITIES
                if (c != "checkpoint" or cls.checkpoints) and (c != "geometry" or cls.changes_geometry)
            ),
            implementation=self.use,
            max_in_flight=MAX_IN_FLIGHT,
            host=host,
            pid=pid,
        )

    def receive(self, message: m.Message, parts: Sequence[Any] = (), now: float = 0.0) -> None:
        """Handle a message if it is for this incarnation; answer another one with ERROR.

        Args:
            message: From the broker.
            parts: What came after it.
            now: Time on any monotonic clock [s]; see `deadline`.
        """
        mine = self._identity
        if not mine:
            self.handle(message, parts, now)
            return
        # On the path of every frame: two look-ups cost half of a loop over the keys.
        epoch, attempt = mine["epoch"], mine["attempt"]
        if isinstance(message, m.Welcome):
            self._unexpected(message, "it is not for a service that is in the run")
        elif getattr(message, "epoch", epoch) != epoch or getattr(message, "attempt", attempt) != attempt:
            self._unexpected(message, f"this is attempt {attempt} in epoch {epoch}")
        else:
            self.handle(message, parts, now)

    def handle(self, message: m.Message, parts: Sequence[Any] = (), now: float = 0.0) -> None:
        """Handle a message that is known to be for this incarnation. Arguments as for `receive`."""
        handler = self._handlers.get(type(message))
        if handler is None:
            self._unexpected(message, "it is not for a service that is in the run")
        elif self._scenery.awaited and type(message) not in _WHILE_FETCHING:
            self._refuse_scenery(message_type(message))
        else:
            handler(message, parts, now)

    def expire(self, now: float) -> None:
        """Report the files that have not come by `deadline`."""
        with self._reporting("files"):
            self._files.expire(now)
        self._scenery.expire(now)

    def leave(self, reason: str) -> None:
        """Say BYE, if the service is in the run."""
        if self._identity:  # the broker knows no service before WELCOME
            self._send(m.Bye(**self._identity, reason=reason), ())

    def close(self) -> None:
        """Let the service release what it holds. Further calls do nothing."""
        # Forgotten first: a `close` that fails is not tried again.
        service, self._service = self._service, None
        if service is not None:
            service.close()

    # --- joining and preparing ---------------------------------------------------------------------

    def _welcome(self, welcome: m.Welcome, _: Sequence[Any], __: float) -> None:
        # Before the service is made: what goes wrong there is reported with epoch and attempt.
        self._identity = {"epoch": welcome.epoch, "attempt": welcome.attempt}
        # A FAULT, not an exception: the broker ends the run and names the key, whatever machine this is.
        with self._reporting("settings"):
            settings = convert_settings(self.cls.Settings, welcome.settings)
            run = run_info(self.name, welcome, self._progress, self._attend)
            self._service = self.cls(settings, run)

    def _prepare(self, order: m.Prepare, _: Sequence[Any], now: float) -> None:
        with self._reporting("prepare"):
            service = self.running
            # Before its rules are adopted: what an idle service would ask for is not in demand.
            if not is_needed(service, order):
                self._ready(m.Ready(**self._identity))
                return
            # Worlds are prepared before anything is known about scenes, and a shared check is for all.
            if self._answers is not None or service.role != "world":
                self._check.adopt(content_rules(service, order))
            offered = [self._store.add(name, content) for name, content in sorted(service.scenery().items())]
            if offered:
                self._send(m.AssetOffer(**self._identity, assets=tuple(offered)), ())
            self._found = {}
            if own := [*missing_codebooks(service), *service.own_files]:
                self._files.fetch(own, partial(self._own_file, order, offered), now)
            else:
                self._fetch_scenery(order, offered, now)

    def _own_file(self, order: m.Prepare, offered: Sequence[m.Asset], file: FetchedFile, now: float) -> None:
        """Take one of the service's own files; with the last one go on preparing."""
        with self._reporting("prepare"):
            if file.path is None:
                self._files.stop()
                raise AssetError(file.reason)
            self._found[file.digest] = file.path
            if not self._files.awaited:
                self._fetch_scenery(order, offered, now)

    def _fetch_scenery(self, order: m.Prepare, offered: Sequence[m.Asset], now: float) -> None:
        # By content, not by name: what an earlier run fetched is not fetched again.
        if not self.running.needs_assets:
            self._load(order, offered)
        elif missing := [asset for asset in order.assets if not self._store.holds(asset)]:
            self._scenery.fetch(missing, partial(self._scenery_file, order), now)
        else:
            self._load(order, order.assets)

    def _note_fetching(self, number: int, count: int) -> None:
        self._progress(f"fetching scenery, file {number} of {count}", 0.0)

    def _scenery_file(self, order: m.Prepare, file: FetchedFile, _: float) -> None:
        """Take one file of the scenery; with the last one go on preparing."""
        with self._reporting("prepare"):
            if file.path is None:
                # So that an answer that comes after all is «not asked for» instead of half of a file.
                self._scenery.stop()
                raise AssetError(file.reason)
            if not self._scenery.awaited:
                self._load(order, order.assets)

    def _refuse_scenery(self, what: str) -> None:
        """Report what came in place of a file of the scenery, and fetch no more of it."""
        name = self._scenery.name
        self._scenery.stop()
        with self._reporting("prepare"):
            raise ProtocolError(f"asked for {name}, got {what}")

    def _asset_data(self, data: m.AssetData, parts: Sequence[Any], now: float) -> None:
        if data.digest == self._files.awaited:
            with self._reporting("files"):
                self._files.data(data, parts[0], now)
        elif not self._scenery.awaited:
            self._unexpected(data, "no asset was asked for")
        elif data.digest != self._scenery.awaited:
            self._refuse_scenery(f"that of digest {data.digest}")
        else:
            with self._reporting("prepare"):
                self._scenery.data(data, parts[0], now)

    def _error(self, error: m.Error, _: Sequence[Any], now: float) -> None:
        if error.code == "refused-mesh":
            with self._reporting("geometry"):
                self.running.mesh_refused(error.subject, error.message)
            return
        if error.subject and error.subject == self._files.awaited:
            with self._reporting("files"):
                self._files.fail(error.message, now)
        if error.subject and error.subject == self._scenery.awaited:
            self._scenery.fail(f"the broker cannot deliver {self._scenery.name}: {error.message}", now)

    def _load(self, order: m.Prepare, assets: Sequence[m.Asset]) -> None:
        add_codebook_files(self._found[digest] for digest in missing_codebooks(self.running))
        files = self._store.folder_of(assets) if assets else {}
        demand = {entry.topic: frozenset(entry.parts) for entry in order.demand}
        preparation = Preparation(
            demand=demand,
            assets=files,
            producers=order.producers,
            files=self._found,
            max_faces=order.max_faces,
        )
        prepared = returned(Prepared, self.running.prepare(preparation), self.running, "prepare")
        self._followed.begin(assets)
        self._ready(
            m.Ready(
                **self._identity,
                geometry=geometry_digest(assets),
                prefixes=prepared.prefixes,
                actuators=prepared.actuators,
                notes=prepared.notes,
                seed=prepared.seed,
            )
        )

    def _ready(self, ready: m.Ready) -> None:
        if self._tunes_memory:
            # What was loaded stays: collections look only at what frames leave behind, all of it, soon.
            gc.collect()
            gc.freeze()
        self._send(ready, ())

    def _serve_asset(self, get: m.AssetGet, _: Sequence[Any], __: float) -> None:
        try:
            chunk, size = self._store.read(get.digest, get.offset)
        except AssetError as error:
            refusal = m.Error(code="unknown-asset", of="ASSET_GET", subject=get.digest, message=str(error))
            self._send(refusal, ())
        else:
            self._send(m.AssetData(digest=get.digest, offset=get.offset, size=size), (chunk,))

    # --- frames ------------------------------------------------------------------------------------

    def _reset(self, reset: m.Reset, _: Sequence[Any], __: float) -> None:
        with self._reporting("reset", reset.episode):
            self._progress(f"reset to episode {reset.episode}", 0.0)
            if self._answers is not None:
                self._answers.clear()
            self._followed.reset()
            self._announced.reset()
            self.running.reset(reset.seed_episode, reset.seed, reset.t0_ns)
            self._reset_to = reset
            self._send(m.ResetDone(**self._identity, episode=reset.episode), ())

    def _grant(self, grant: m.Grant, parts: Sequence[Any], now: float) -> None:
        reset, answers = self._reset_to, self._answers
        if reset is None or grant.episode != reset.episode:
            self._unexpected(grant, f"there was no RESET to episode {grant.episode}")
            return
        if answers is None:
            self._step(reset, grant, parts)
        elif answers.is_new(grant.frame):
            self._progress(f"frame {grant.frame}", 0.0)
            self._check.begin(grant.inputs)
            if (answer := self._step(reset, grant, parts)) is not None:
                answers.put(grant.frame, answer)
        elif (kept := answers.get(grant.frame)) is not None:
            self._send(*kept)
        else:
            self._unexpected(grant, f"frame {grant.frame} was answered long ago")
        if grant.decisions and (wanted := self.running.wanted_files(grant.decisions)):
            self._files.fetch(wanted, self._wanted_file, now)
        if grant.frame % TRIM_EVERY == TRIM_EVERY - 1:
            with self._reporting("release", grant.episode, grant.frame):
                self.running.release_memory()
                if self._tunes_memory and now >= self._trim_at:
                    trim_memory()
                    self._trim_at = now + TRIM_S

    def _wanted_file(self, file: FetchedFile, _: float) -> None:
        self.running.take_file(file.digest, file.path, file.reason)

    def compute(self, frame: Frame) -> StepResult | None:
        """Have the service compute a frame that no GRANT granted: in one process, without a clock.

        Args:
            frame: Of the episode that the last RESET began.

        Returns:
            What the service made of it; None: it failed, and FAULT was sent.
        """
        phase = "step"
        try:
            result = returned(StepResult, self.running.step(frame), self.running, "step")
            phase = "encode"
            sorted_products(self.use, result)  # each is of its topic's class
            phase = "release"
            if frame.number % TRIM_EVERY == TRIM_EVERY - 1:
                self.running.release_memory()
        except Exception as error:
            self.report(error, phase, frame.episode, frame.number)
            return None
        return result

    def answered(self) -> StepResult | None:
        """The answer from outside to the frame that `compute` was given last; None: there is none."""
        return None

    def _step(self, reset: m.Reset, grant: m.Grant, parts: Sequence[Any]) -> Answer | None:
        """Have the service compute a frame; DONE with its products, or FAULT, as it was sent."""
        phase = "step"
        # Without `_reporting`: its context costs as much as a small service.
        try:
            self._followed.begin_frame(grant.frame)
            frame = self._frame(reset, grant, parts)
            began = time.monotonic_ns()
            result = returned(StepResult, self.running.step(frame), self.running, "step")
            step_ns = time.monotonic_ns() - began
            phase = "encode"
            answer: Answer = self._done(grant, result, step_ns)
            self._send(*answer)
        except Exception as error:
            self.failed = True
            answer = fault_from(error, self._identity, phase, grant.episode, grant.frame, self.cls), ()
            self._send(*answer)
        return answer

    def _frame(self, reset: m.Reset, grant: m.Grant, parts: Sequence[Any]) -> Frame:
        inputs = frame_inputs(grant, parts, self._check, encoded=self._encodes)
        return granted_frame(self.running, reset, grant, inputs)

    def _done(self, grant: m.Grant, result: StepResult, step_ns: int) -> tuple[m.Done, Sequence[Any]]:
        geometry, digest = self._announced.change(grant.frame, result), self._followed.digest
        if self._encodes:
            return encoded_done(self._identity, self.use, grant, result, step_ns, geometry, digest)
        return plain_done(self._identity, self.use, grant, result, geometry, digest)

    # --- meshes that come while the run goes on (clause 4) -------------------------------------------

    def _geometry(self, order: m.Geometry, _: Sequence[Any], now: float) -> None:
        reset = self._reset_to
        if reset is None or order.episode != reset.episode:
            self._unexpected(order, f"there was no RESET to episode {order.episode}")
        elif not self.cls.changes_geometry:
            self._unexpected(order, f"{self.use} named no capability 'geometry'")
        else:
            with self._reporting("geometry", order.episode):
                self._progress(f"loading the meshes of frame {order.frame}", 0.0)
                self._followed.order(order, now)

    def _loaded_meshes(self, order: m.Geometry, digest: str) -> None:
        done = m.GeometryDone(**self._identity, episode=order.episode, frame=order.frame, geometry=digest)
        self._send(done, ())

    def _episode_end(self, end: m.EpisodeEnd, _: Sequence[Any], __: float) -> None:
        with self._reporting("end of episode", end.episode):
            self.running.end_episode(end.frames)

    # --- state (clause 18) -------------------------------------------------------------------------

    def _checkpoint(self, order: m.Checkpoint, _: Sequence[Any], __: float) -> None:
        if not self._keeps_state(order):
            return
        with self._reporting("checkpoint", order.episode, order.frame):
            self._progress(f"saving the state after frame {order.frame}", 0.0)
            state = self.running.checkpoint()
            self._send(m.CheckpointDone(**self._identity, episode=order.episode, frame=order.frame), (state,))

    def _restore(self, order: m.Restore, parts: Sequence[Any], _: float) -> None:
        if not self._keeps_state(order):
            return
        with self._reporting("restore", order.episode, order.frame):
            self._progress(f"restoring the state after frame {order.frame}", 0.0)
            self._followed.completed = order.frame
            self.running.restore(bytes(parts[0]))  # a copy: the message's buffer is freed after this
            if self._answers is not None:
                self._answers.clear(order.frame)
            self._send(m.Ready(**self._identity), ())

    def _keeps_state(self, order: m.Checkpoint | m.Restore) -> bool:
        reset = self._reset_to
        if not self.cls.checkpoints:
            self._unexpected(order, f"{self.use} has no state, and named no capability 'checkpoint'")
        elif reset is None or order.episode != reset.episode:
            self._unexpected(order, f"there was no RESET to episode {order.episode}")
        else:
            return True
        return False

    # --- what all handlers need --------------------------------------------------------------------

    @property
    def running(self) -> Service[Any]:
        """The service. Raises `RunError` before it is made, and where that failed."""
        if self._service is None:
            raise RunError(f"{self.name!r} could not be set up")
        return self._service

    @contextmanager
    def _reporting(self, phase: str, episode: int = 0, frame: int = -1) -> Iterator[None]:
        """Send an exception as FAULT; it goes no further."""
        try:
            yield
        except Exception as error:
            self.report(error, phase, episode, frame)

    def report(self, error: Exception, phase: str, episode: int, frame: int) -> None:
        """Send FAULT that says what an exception says.

        Args:
            error: The exception.
            phase: What the service was doing: ``"step"``.
            episode: In which it came.
            frame: In which it came; −1: in none.
        """
        self.failed = True
        self._send(fault_from(error, self._identity, phase, episode, frame, self.cls), ())

    def _unexpected(self, message: m.Message, why: str) -> None:
        kind = message_type(message)
        self._send(m.Error(code="unexpected", of=kind, message=f"{kind} is not used: {why}"), ())


# What may come between a request for scenery and its answer; anything else is a mistake of the broker.
_WHILE_FETCHING = frozenset({m.AssetData, m.AssetGet, m.Cancel, m.Error, m.Shutdown, m.Stale})


def _ignore(_: m.Message, __: Sequence[Any], ___: float) -> None:
    """A message that asks for nothing."""
