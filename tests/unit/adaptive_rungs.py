"""Rungs for the adaptive channel that take a stated time of a clock that only they move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import msgspec
import numpy as np

from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.topics import AntennaDevice, Carrier, Channel, Scene
from caviar_services.channel.adaptive.channel import AdaptiveChannel
from caviar_services.channel.base import Modelled
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo, StepResult

MS = 1_000_000
DEVICES = (
    DeviceSpec(name="bs", kind="antenna", role="tx", position_m=(0.0, 0.0, 10.0)),
    DeviceSpec(name="rx", kind="antenna", role="rx", on="car", count=2),
)


class Time:
    """Wall time of a test."""

    now_ns = 0
    load = 1.0
    """Everything takes so much longer."""

    @classmethod
    def read(cls) -> int:
        """The clock of `AdaptiveChannel`."""
        return cls.now_ns


class TimedSettings(FreeSpaceSettings, frozen=True, kw_only=True):
    """How long a frame takes, and how wrong it is."""

    takes_ms: float = 1.0
    error: float = 0.0
    """Relative, of the amplitudes of odd frames; even frames are exact to a tenth of it."""
    remembers: bool = False
    """A scene in which nothing moved takes no time."""
    bodies: int = 0
    """Boxes that a scene may have."""


class TimedRung(FreeSpaceChannel):
    """Free space, after a while, with an error."""

    Settings: ClassVar[type[msgspec.Struct]] = TimedSettings
    _seen: bytes = b""

    @property
    def room(self) -> Mapping[str, int]:
        bodies: int = getattr(self.settings, "bodies", 0)
        return {"": bodies} if bodies else {}

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        self._seen = b""

    def model(
        self,
        frame: Frame,
        scene: Scene,
        transmitters: Sequence[AntennaDevice],
        receivers: Sequence[AntennaDevice],
    ) -> Modelled:
        made = super().model(frame, scene, transmitters, receivers)
        settings: Any = self.settings
        remembered = settings.remembers and self._seen == scene.position.tobytes()
        self._seen = scene.position.tobytes()
        Time.now_ns += 0 if remembered else round(settings.takes_ms * Time.load * MS)
        factor = 1 + settings.error * (1.0 if frame.number % 2 else 0.1)
        channel = made.channel
        h = tuple(msgspec.structs.replace(matrix, h=matrix.h * factor) for matrix in channel.h)
        channel = msgspec.structs.replace(channel, a=channel.a * factor, h=h)
        return Modelled(channel=channel, counts=made.counts, measured={"paths": 1})


def rung(label: str, takes_ms: float, error: float = 0.0, **more: Any) -> dict[str, Any]:
    """A rung of a ladder, as in a scenario."""
    settings = {"takes_ms": takes_ms, "error": error}
    return {"label": label, "use": "adaptive_rungs:TimedRung", "settings": settings, **more}


LADDER = [rung("low", 10, 0.1), rung("middle", 30, 0.01), rung("high", 100)]


def adaptive(
    *, h: bool = True, ladder: Sequence[Mapping[str, Any]] = LADDER, **settings: Any
) -> AdaptiveChannel:
    """A prepared adaptive channel on a clock of zero load."""
    Time.now_ns, Time.load = 0, 1.0
    run = RunInfo(name="channel", carriers=(Carrier(name="c", frequency_hz=28e9),), devices=DEVICES)
    made = AdaptiveChannel(
        convert_settings(AdaptiveChannel.Settings, {"ladder": list(ladder), **settings}), run
    )
    made.clock = Time.read
    made.prepare(Preparation(demand={"channel": frozenset({"h"} if h else ())}))
    made.reset(0, 1, 0)
    return made


def frame(number: int, budget_ms: float = 0.0, imposed: str = "") -> Frame:
    """Two cars with receivers, which drive."""
    names = ("car.1", "car.2")
    scene = Scene(
        names=names,
        classes=("car", "car"),
        assets=("", ""),
        position=np.array([[20.0 + number, 3.0, 0.7], [-14.0, 5.0 + number, 0.8]]),
        orientation=np.tile([1.0, 0, 0, 0], (2, 1)),
        velocity=np.array([[10.0, 0, 0], [0, 10.0, 0]]),
        dimensions=np.tile([4.0, 2.0, 1.5], (2, 1)),
        devices=(
            AntennaDevice(name="bs", role="tx", position=(0.0, 0.0, 10.0)),
            *(
                AntennaDevice(name=f"{name}/rx", parent=name, role="rx", position=(0.0, 0.0, 1.0))
                for name in names
            ),
        ),
    )
    return Frame(
        episode=0,
        number=number,
        t_ns=number * 100 * MS,
        budget_ns=round(budget_ms * MS),
        imposed={"rung": imposed} if imposed else {},
        inputs=(FrameInput(GrantInput(topic="scene", source="w", status=Status.FRESH), payload=scene),),
    )


def labels(results: Sequence[StepResult]) -> list[str]:
    """The rungs that computed these frames."""
    return [result.decisions["rung"] for result in results]


def channel_of(result: StepResult) -> Channel:
    """The product of a frame."""
    product = result.products["channel"]
    assert isinstance(product, Channel)
    return product
