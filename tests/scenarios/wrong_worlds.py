"""Producers that are wrong in one way each; scenarios name them as ``wrong_worlds:World`` or ``:Liar``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, cast

import msgspec
import numpy as np
from msgspec.structs import replace

from caviar_protocol.codec import encode_payload
from caviar_protocol.messages import Input, Role
from caviar_protocol.topics import Lidar, LidarScan, Scene
from caviar_services import conversion
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.conversion import Encoded
from caviar_services.service import Frame, RunInfo, Service, StepResult
from caviar_services.world.trajectory import TrajectorySettings, TrajectoryWorld


def _changed(field: str, value: Callable[[Any], Any]) -> Callable[[Scene], Scene]:
    """One array of the scene, computed from what it is."""
    return lambda scene: replace(scene, **{field: value(getattr(scene, field))})


def _reversed(scene: Scene) -> Scene:
    """All objects, in the opposite order."""
    arrays = {name: getattr(scene, name)[::-1].copy() for name in ("position", "orientation", "velocity")}
    return replace(
        scene,
        names=scene.names[::-1],
        classes=scene.classes[::-1],
        assets=scene.assets[::-1],
        dimensions=scene.dimensions[::-1].copy(),
        **arrays,
    )


def _renamed(*names: str) -> Callable[[Scene], Scene]:
    return lambda scene: replace(scene, names=names)


def _mounted_at_the_centre(scene: Scene) -> Scene:
    return replace(scene, devices=tuple(replace(d, position=(0.0, 0.0, 0.0)) for d in scene.devices))


WRONG: dict[str, Callable[[Scene], Scene]] = {
    "orientation of length 2": _changed("orientation", lambda q: 2 * q),
    "orientation of length 3": _changed("orientation", lambda q: 3 * q),
    "orientation of zeros": _changed("orientation", np.zeros_like),
    "negative dimensions": _changed("dimensions", np.negative),
    "dimensions of 1e300": _changed("dimensions", lambda d: d * 1e300),
    "a position beyond the planets": _changed("position", lambda p: p + 1e200),
    "names unsorted": _reversed,
    "a name twice": _renamed("car", "car"),
    "a name without the prefix": _renamed("bike", "uav"),
    "no devices": lambda scene: replace(scene, devices=()),
    "a mount ignored": _mounted_at_the_centre,
    "a mesh never offered": lambda scene: replace(scene, assets=("objects/tank.ply", "")),
}
"""What each wrong world does to a right scene of ``smoke``."""


class WrongSettings(TrajectorySettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the trajectories, and what is to be wrong."""

    wrong: str = ""
    since: int = 0
    """First frame in which it is."""


class World(TrajectoryWorld):
    """The world of ``smoke``, wrong in one way."""

    Settings: ClassVar[type[msgspec.Struct]] = WrongSettings

    def __init__(self, settings: WrongSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        if settings.wrong == "a false digest":
            _lie()

    def step(self, frame: Frame) -> StepResult:
        result = super().step(frame)
        settings = self.settings
        if not isinstance(settings, WrongSettings) or frame.number < settings.since:
            return result
        scene = result.products["scene"]
        assert isinstance(scene, Scene)
        if settings.wrong == "a position that is not a number":
            return StepResult(products={"scene": _with_nan(scene)})
        change = WRONG.get(settings.wrong)
        return result if change is None else StepResult(products={"scene": change(scene)})


class LiarSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Has none."""


class Liar(Service[LiarSettings]):
    """A sensor whose large products, which no service but the recorder gets, have false digests."""

    role: ClassVar[Role] = "sensors"
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="scene"),)
    outputs: ClassVar[tuple[str, ...]] = ("lidar",)
    Settings: ClassVar[type[msgspec.Struct]] = LiarSettings

    def step(self, frame: Frame) -> StepResult:
        """A scan of five thousand points."""
        _lie()
        points = np.ones((5000, 3), "<f4")
        scan = LidarScan(
            sensor="uav/lidar",
            position=(0.0, 0.0, 0.0),
            orientation=(1.0, 0.0, 0.0, 0.0),
            ray=np.arange(5000, dtype="<i4"),
            points=points,
            points_world=points,
            range=np.ones(5000, "<f4"),
            object=np.zeros(5000, "<i4"),
        )
        return StepResult(products={"lidar": Lidar(object_names=("car",), scans=(scan,))})


def _lie() -> None:
    """From now on this process, which is the service's own, states a digest of its own choice."""
    conversion.payload_digest = lambda header, body: "0" * 64


def _with_nan(scene: Scene) -> Encoded:
    """What no service of this package sends: the encoder refuses it, so its bytes are put there."""
    header, body = encode_payload(replace(scene, position=np.full_like(scene.position, 12345.0)))
    number, nan = (np.array(value).tobytes() for value in (12345.0, np.nan))
    return Encoded(topic="scene", header=header, body=body.replace(number, nan, 1))


class PartlessSettings(FreeSpaceSettings, frozen=True, kw_only=True):
    """Settings of the free-space channel, and what it leaves out."""

    lacks: str
    """Part of the channel."""


class Partless(FreeSpaceChannel):
    """A channel without a part that is in demand."""

    Settings: ClassVar[type[msgspec.Struct]] = PartlessSettings

    def step(self, frame: Frame) -> StepResult:
        made, lacks = super().step(frame), cast(PartlessSettings, self.settings).lacks
        return replace(made, products={"channel": replace(made.products["channel"], **{lacks: ()})})


class Patternless(TrajectoryWorld):
    """A world that offers no pattern files, as one on another machine that does not have them."""

    def scenery(self) -> Mapping[str, Path | bytes]:
        return {name: file for name, file in super().scenery().items() if not name.startswith("patterns/")}
