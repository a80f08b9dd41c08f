"""Worlds and frames as the runner makes them, for tests."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from caviar_protocol.codec import encode_payload
from caviar_protocol.scenario import DeviceSpec
from caviar_protocol.topics import Scene
from caviar_services.service import Frame, RunInfo
from caviar_services.world.base import ObjectState, World, WorldSettings

T_SAM_NS = 100_000_000


class ScriptedWorld(World[WorldSettings]):
    """A world whose frames are given."""

    Settings = WorldSettings

    def __init__(
        self,
        frames: Sequence[Iterable[ObjectState]],
        devices: Sequence[DeviceSpec] = (),
        settings: WorldSettings | None = None,
    ) -> None:
        super().__init__(settings or WorldSettings(), RunInfo(name="world", devices=tuple(devices)))
        self.frames = [list(frame) for frame in frames]

    def prefixes(self) -> tuple[str, ...]:
        return ("car.",)

    def mesh_classes(self) -> tuple[str, ...]:
        return ("car",)

    def begin(self, episode: int, seed: int) -> None:
        self.begun = (episode, seed)

    def objects_at(self, elapsed_ns: int) -> Iterable[ObjectState]:
        return self.frames[elapsed_ns // T_SAM_NS]


def state(name: str, **changes: object) -> ObjectState:
    """A car at the origin, unless said otherwise."""
    plain = ObjectState(name, "car", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (4.0, 2.0, 1.5))
    return plain._replace(**changes)


def scene_at(world: World, number: int, previous: int | None = None, t0_ns: int = 0) -> Scene:
    """The world's scene of a frame."""
    frame = Frame(
        episode=0,
        number=number,
        t_ns=t0_ns + number * T_SAM_NS,
        previous=number - 1 if previous is None else previous,
    )
    scene = world.step(frame).products["scene"]
    assert isinstance(scene, Scene)
    return scene


def wire_bytes(scene: Scene) -> bytes:
    """What would travel; raises for what may not."""
    return b"".join(encode_payload(scene))
