"""Services that go wrong in every way a service can; scenarios name them as ``faulty:Class``."""

from __future__ import annotations

import hashlib
import os
import sys
import threading
from typing import Any, ClassVar

import msgspec

from caviar_protocol.messages import Input, Role
from caviar_services.service import Frame, Service, StepResult


class FaultSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """In which frame it goes wrong."""

    frame: int = 5


class _Faulty(Service[FaultSettings]):
    role: ClassVar[Role] = "sensors"
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"),)
    outputs: ClassVar[tuple[str, ...]] = ("lidar",)
    Settings: ClassVar[type[msgspec.Struct]] = FaultSettings

    def step(self, frame: Frame) -> StepResult:
        if frame.number == self.settings.frame:
            self.go_wrong()
        return StepResult()

    def go_wrong(self) -> None:
        raise NotImplementedError


class Raises(_Faulty):
    """Raises an unforeseen exception."""

    def go_wrong(self) -> None:
        raise ZeroDivisionError("the sensor's focal length is 0")


class Leaves(_Faulty):
    """Ends its program, as a script does."""

    def go_wrong(self) -> None:
        sys.exit(0)


class Exits(_Faulty):
    """Ends its process without a word to the broker."""

    def go_wrong(self) -> None:
        os.write(1, b"segmentation of the world failed\n")
        os._exit(3)


class Crashes(_Faulty):
    """Dies in a library, after a word to its user."""

    def go_wrong(self) -> None:
        print("the focal length is 0")  # noqa: T201 - as a user's own service does
        os.abort()


class DiesInSilence(_Faulty):
    """Ends its process without any word."""

    def go_wrong(self) -> None:
        os._exit(3)


class NeverAnswers(_Faulty):
    """Waits for something that never comes; its heartbeats go on."""

    def go_wrong(self) -> None:
        threading.Event().wait()


class Computes(_Faulty):
    """Computes for minutes in a library of C, where the interpreter handles no signal."""

    def go_wrong(self) -> None:
        hashlib.pbkdf2_hmac("sha256", b"a", b"b", 2**31 - 1)


class Circular(_Faulty):
    """Needs what is made from its own output in the same frame."""

    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="camera"),)
    outputs: ClassVar[tuple[str, ...]] = ("lidar",)


class CircularToo(_Faulty):
    """The other half of the circle."""

    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="lidar"),)
    outputs: ClassVar[tuple[str, ...]] = ("camera",)


def undeclared(_: Any) -> None:
    """Not a service at all."""
