"""A service with state that outlives a frame; scenarios name it as ``stateful:Adding``."""

from __future__ import annotations

import hashlib
import json
import time
from typing import ClassVar

import msgspec

from caviar_protocol.messages import Input, Role
from caviar_protocol.topics import Lidar
from caviar_services.service import Frame, Service, StepResult


class AddingSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How long a frame takes."""

    seconds: float = 0.002


class Adding(Service[AddingSettings]):
    """Its product is a digest of all that it ever took in during the episode, frame by frame."""

    role: ClassVar[Role] = "sensors"
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"), Input(topic="link", lag=1, required=False))
    outputs: ClassVar[tuple[str, ...]] = ("lidar",)
    checkpoints: ClassVar[bool] = True
    Settings: ClassVar[type[msgspec.Struct]] = AddingSettings

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        self._sum, self._frames = f"{episode} {seed}", 0

    def step(self, frame: Frame) -> StepResult:
        assert frame.previous == self._frames - 1, f"{frame.number} after {frame.previous}: a gap"
        until = time.monotonic() + self.settings.seconds
        told = [(i.provenance.topic, i.provenance.source, i.provenance.digest) for i in frame.inputs]
        self._sum = hashlib.sha256(f"{self._sum} {told}".encode()).hexdigest()
        self._frames = frame.number + 1
        while time.monotonic() < until:
            pass
        return StepResult(products={"lidar": Lidar(object_names=(self._sum,), scans=())})

    def checkpoint(self) -> bytes:
        return json.dumps([self._sum, self._frames]).encode()

    def restore(self, state: bytes) -> None:
        self._sum, self._frames = json.loads(state)
