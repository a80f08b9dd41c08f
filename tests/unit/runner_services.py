"""Services for the tests of the runner, named ``sensors:runner_services:Class``."""

from __future__ import annotations

import ctypes
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import msgspec
import numpy as np

from caviar_protocol.errors import RunError, ScenarioError
from caviar_protocol.messages import Input, Role
from caviar_protocol.topics import Action, Lidar, LidarScan
from caviar_services.service import Frame, Preparation, Prepared, Service, StepResult


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where it goes wrong, if anywhere."""

    wrong: str = ""


def say(word: str) -> None:
    """Tell the test where the service is."""
    sys.stdout.write(f"{word}\n")
    sys.stdout.flush()


def cloud(value: float) -> Lidar:
    """A scan of one point."""
    points = np.array([[value, 2.0, 3.0]], np.float32)
    scan = LidarScan(
        sensor="roof",
        position=(0.0, 0.0, 1.5),
        orientation=(1.0, 0.0, 0.0, 0.0),
        ray=np.zeros(1, np.int32),
        points=points,
        points_world=points,
        range=np.ones(1, np.float32),
        object=np.zeros(1, np.int32),
    )
    return Lidar(object_names=("car",), scans=(scan,))


class Sensors(Service[Settings]):
    """Counts its steps, and tells of them in its products."""

    role: ClassVar[Role] = "sensors"
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"),)
    outputs: ClassVar[tuple[str, ...]] = ("lidar",)
    uses_scenery: ClassVar[bool] = True
    Settings: ClassVar[type[msgspec.Struct]] = Settings
    steps = 0

    def fail_in(self, place: str) -> None:
        if self.settings.wrong == place:
            raise ZeroDivisionError(f"nothing to divide in {place}")

    def prepare(self, preparation: Preparation) -> Prepared:
        self.fail_in("prepare")
        return Prepared(notes=tuple(f"{n}={p.read_bytes()[:20]!r}" for n, p in preparation.assets.items()))

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        self.fail_in("reset")

    def step(self, frame: Frame) -> StepResult:
        self.fail_in("step")
        self.steps += 1
        match self.settings.wrong:
            case "non-finite":
                return StepResult(products={"lidar": cloud(float("nan"))})
            case "wrong type":
                return StepResult(products={"lidar": Action(commands=())})
            case "nothing":
                return None  # type: ignore[return-value]
            case "told by name":
                raise ScenarioError("the mast is 3 m too low", "town.toml", "devices.0", 7)
        return StepResult(
            products={"lidar": cloud(float(self.steps))},
            counts={"steps": self.steps},
            measured={"scan": time.monotonic_ns()},
            decisions={"rung": "fast"},
        )

    def close(self) -> None:
        say("closed")


class World(Service[Settings]):
    """Brings scenery."""

    role: ClassVar[Role] = "world"
    outputs: ClassVar[tuple[str, ...]] = ("scene",)
    Settings: ClassVar[type[msgspec.Struct]] = Settings

    def scenery(self) -> Mapping[str, Path | bytes]:
        if self.settings.wrong == "name":
            return {"../escape.ply": b"x"}
        return {"scenery/town.xml": b"<scene/>", "empty": b""}

    def prepare(self, preparation: Preparation) -> Prepared:
        return Prepared(prefixes=("town/",), notes=tuple(sorted(preparation.assets)))

    def step(self, frame: Frame) -> StepResult:
        return StepResult()


class _Stuck(Sensors):
    """Says "stuck" and then is."""

    place: ClassVar[str] = "step"

    def step(self, frame: Frame) -> StepResult:
        self.stick("step")
        return super().step(frame)

    def prepare(self, preparation: Preparation) -> Prepared:
        self.stick("prepare")
        return super().prepare(preparation)

    def stick(self, place: str) -> None:
        if place == (self.settings.wrong or "step"):
            say("stuck")
            self.never_return()

    def never_return(self) -> None:
        raise NotImplementedError


class WaitsForever(_Stuck):
    """In a wait of Python's own."""

    def never_return(self) -> None:
        threading.Event().wait()


class Attends(_Stuck):
    """In a wait for something outside of the run, in which it looks for orders."""

    def never_return(self) -> None:
        while not self.run.directory.joinpath("go").exists():
            self.run.progress("waiting", 0.0)
            self.run.attend()
            time.sleep(0.02)


class SleepsInC(_Stuck):
    """In a compiled call that has released the interpreter, and that signals do not end."""

    def never_return(self) -> None:
        libc = ctypes.CDLL(None)
        while True:
            libc.sleep(60)


class ComputesInC(_Stuck):
    """In numerical code."""

    def never_return(self) -> None:
        matrix = np.ones((1500, 1500))
        while True:
            matrix = np.linalg.matrix_power(matrix / 1500.0, 64)


class HoldsTheInterpreter(_Stuck):
    """In a compiled call that holds the interpreter for a second, and then goes on."""

    def never_return(self) -> None:
        ctypes.PyDLL(None).usleep(1_000_000)


class IgnoresClosing(Sensors):
    """Hangs when it shall close."""

    def close(self) -> None:
        threading.Event().wait()


class Leaves(Sensors):
    """Ends the process in the middle of a frame, as some libraries do."""

    def step(self, frame: Frame) -> StepResult:
        sys.exit("the simulator has quit")


class Environment(Sensors):
    """Fails while it is made."""

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        raise OSError(f"no GPU in {Path.cwd()}")


class Keeps(Sensors):
    """Tells when it is asked to give back memory, and fails to."""

    def release_memory(self) -> None:
        say(f"released after {self.steps}")
        raise MemoryError("nothing to give")


class Reader(Sensors):
    """Looks into its input."""

    role: ClassVar[Role] = "link"

    def step(self, frame: Frame) -> StepResult:
        frame.scene()
        return StepResult()


if "SlowStart" in " ".join(sys.argv):
    say("loaded")


class SlowStart(Sensors):
    """Tells when it is loaded, so before it connects."""


class HoldsForever(_Stuck):
    """In a compiled call that holds the interpreter and never returns: only SIGKILL ends it."""

    def never_return(self) -> None:
        while True:
            ctypes.PyDLL(None).sleep(60)


class Stateful(Sensors):
    """Its state is the number of its steps."""

    checkpoints: ClassVar[bool] = True

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        self.steps = 0

    def checkpoint(self) -> bytes:
        self.fail_in("checkpoint")
        return str(self.steps).encode()

    def restore(self, state: bytes) -> None:
        if not state.isdigit():
            raise RunError(f"{state!r} is no number of steps; start the run again")
        self.steps = int(state)
