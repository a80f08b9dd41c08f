"""A channel model in a process of its own.

Not for speed: one model at a time is asked. But models of one process are not independent. Dr.Jit compiles
calls of shapes and materials for all that are alive, so that a second scene changes the kernels and the time
of the first one; memory of one cannot be told from that of the other; and what takes too long could not be
ended.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

from caviar_clients.tradeoff.ladder import Setting
from caviar_clients.tradeoff.scenes import Scenes
from caviar_clients.tradeoff.users import Key, Noise, UserChannel
from caviar_protocol.errors import CaviarError, RunError
from caviar_protocol.topics import Channel

_GOODBYE_S = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Sample:
    """One scene measured."""

    time_ms: float
    memory_mib: float | None
    """Growth of the resident memory at its peak; None where the system does not tell."""
    rung: str
    """As the product says."""
    receivers: int
    paths: int
    lost_paths: bool
    """Whether more paths were found than the setting allows, or some were not finite."""
    users: Mapping[Key, UserChannel]
    channel: Channel | None = None
    """The product, where it is asked for."""


@dataclass(frozen=True, kw_only=True)
class Loaded:
    """What loading took, the first scene included."""

    seconds: float
    memory_mib: float | None
    """Growth of the resident memory."""
    first: Sample


class Worker:
    """A model that is loaded, and asked for one scene after the other.

    With ``products`` samples hold the products too.

    Raises `RunError` with the reason where it cannot be loaded, or not within ``seconds``.
    """

    def __init__(
        self,
        setting: Setting,
        scenes: Scenes,
        receivers: int | None,
        noise: Noise,
        seconds: float,
        products: bool = False,
    ) -> None:
        context = multiprocessing.get_context("spawn")  # what is forked has no threads of Dr.Jit
        self.setting = setting
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, setting, scenes, receivers, noise, products), daemon=True
        )
        self._process.start()
        theirs.close()
        self.loaded: Loaded = self._answer(seconds)

    @property
    def pid(self) -> int:
        """Of its process, which may have ended."""
        return self._process.pid or 0

    def step(self, index: int, seconds: float) -> Sample:
        """The scene with this index. Raises `RunError` with the reason where it fails or takes too long."""
        with suppress(OSError):  # a process that died before is named by the read of its answer
            self._pipe.send(index)
        sample: Sample = self._answer(seconds)
        return sample

    def close(self) -> None:
        """End the process; again: nothing."""
        with suppress(OSError):
            self._pipe.send(None)
        self._pipe.close()
        self._process.join(_GOODBYE_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _answer(self, seconds: float) -> Any:
        try:
            late = not self._pipe.poll(seconds)
            answer = None if late else self._pipe.recv()
        except (EOFError, OSError) as error:
            self.close()
            code = self._process.exitcode or 0
            cause = f"signal {signal.Signals(-code).name}" if code < 0 else f"status {code}"
            raise RunError(f"its process ended with {cause}; was there enough memory?") from error
        if late:
            self._process.kill()  # it is in the middle of a scene, and hears nothing
            self.close()
            raise RunError(f"no answer within {seconds:.0f} s; give more with --minutes")
        if isinstance(answer, str):
            self.close()
            raise RunError(answer)
        return answer


def _serve(
    pipe: Connection,
    setting: Setting,
    scenes: Scenes,
    receivers: int | None,
    noise: Noise,
    products: bool,
) -> None:
    """Load, then answer until told to end or left alone; a text is the reason of a failure."""
    from caviar_clients.tradeoff.measure import Rung

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    with suppress(EOFError, BrokenPipeError):
        try:
            rung = Rung(setting, scenes, receivers, noise, products)
            pipe.send(rung.loaded)
            while (index := pipe.recv()) is not None:
                pipe.send(rung.sample(scenes.instants[index]))
            rung.close()
        except (CaviarError, RuntimeError, MemoryError) as error:  # Dr.Jit raises RuntimeError
            pipe.send(str(error) or type(error).__name__)
