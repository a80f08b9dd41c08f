"""Services that do their part, but late in one frame; and one that writes down what it was given.

Scenarios name them as ``late:Class``.
"""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any, ClassVar

import msgspec

from caviar_protocol.messages import Input, Role
from caviar_protocol.topics import Camera, Lidar
from caviar_services.agent.base import AgentSettings
from caviar_services.agent.baselines import LosBeamAgent
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.link.beams import BeamLink, BeamLinkSettings
from caviar_services.service import Frame, Service, StepResult


class _When(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """In which frame it is late, and by what. Structs have one base, so the others repeat it."""

    frame: int
    late_s: float


class _Late(Service[Any]):
    def step(self, frame: Frame) -> StepResult:
        if frame.number == self.settings.frame and not frame.final:
            threading.Event().wait(self.settings.late_s)
        return super().step(frame)  # type: ignore[safe-super]  # of the class that is mixed in


class LateChannelSettings(FreeSpaceSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of a channel."""

    frame: int
    late_s: float


class LateLinkSettings(BeamLinkSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of a link."""

    frame: int
    late_s: float


class LateAgentSettings(AgentSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Of an agent."""

    frame: int
    late_s: float


class LateChannel(_Late, FreeSpaceChannel):
    """Free space."""

    Settings = LateChannelSettings


class LateLink(_Late, BeamLink):
    """Beams."""

    Settings = LateLinkSettings


class LateAgent(_Late, LosBeamAgent):
    """Straight line."""

    Settings = LateAgentSettings


class _Blind(Service[Any]):
    role: ClassVar[Role] = "sensors"
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"),)
    outputs: ClassVar[tuple[str, ...]] = ("lidar",)

    def step(self, frame: Frame) -> StepResult:
        return StepResult(products={"lidar": Lidar(object_names=(), scans=())}, fidelity=str(frame.number))


class LateSensors(_Late, _Blind):
    """A LIDAR that sees nothing, and tells the frame as its quality."""

    Settings = _When


class SpySettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where it writes to."""

    file: str


class Spy(Service[SpySettings]):
    """Takes everything, and writes down where each input comes from: a line for each frame."""

    role: ClassVar[Role] = "sensors"
    inputs: ClassVar[tuple[Input, ...]] = (
        Input(topic="scene"),
        *(Input(topic=topic, required=False) for topic in ("channel", "lidar", "action", "link")),
    )
    outputs: ClassVar[tuple[str, ...]] = ("camera",)
    Settings: ClassVar[type[msgspec.Struct]] = SpySettings

    def step(self, frame: Frame) -> StepResult:
        told = {entry.provenance.topic: msgspec.to_builtins(entry.provenance) for entry in frame}
        with Path(self.settings.file).open("a") as file:
            file.write(json.dumps(told) + "\n")
        return StepResult(products={"camera": Camera(images=())})
