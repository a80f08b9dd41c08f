"""Agent ``waypoints``: flies an object from point to point, and points its users' beams at them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, ClassVar

import msgspec

from caviar_protocol.arrays import quantity
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.space.scene import Pair
from caviar_protocol.topics import BeamChoice, Scene, WaypointCommand
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.agent.baselines import straight_choices
from caviar_services.checkpoint import restored, saved
from caviar_services.service import Frame, RunInfo


class WaypointsSettings(AgentSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the agent ``waypoints``."""

    object: Annotated[str, msgspec.Meta(min_length=1)]
    """The object it flies, which a world of the run must fly by command; it owns ``motion:<object>``."""
    waypoints_m: Annotated[tuple[tuple[float, float, float], ...], msgspec.Meta(min_length=1)]
    """Where to, in this order; at the last one the object stays."""
    speed_m_s: Annotated[float, quantity("m/s", "on the way", gt=0)]
    reach_m: Annotated[float, quantity("m", "so near, a waypoint is reached", gt=0)] = 1.0


class _State(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    next: Annotated[int, msgspec.Meta(ge=0)]
    """Index of the waypoint that it flies to."""


class WaypointsAgent(Agent[WaypointsSettings]):
    """Goes to the next waypoint when one is reached; the beams are those of ``los-beam``."""

    Settings = WaypointsSettings
    checkpoints: ClassVar[bool] = True

    def __init__(self, settings: WaypointsSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._next = 0

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Every episode begins with the first waypoint."""
        self._next = 0

    def checkpoint(self) -> bytes:
        """The waypoint under way: which were reached does not follow from where the object is."""
        return saved(self, 1, _State(self._next))

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        self._next = restored(self, 1, _State, state).next

    def other_actuators(self) -> tuple[str, ...]:
        """The motion of the object."""
        return (f"motion:{self.settings.object}",)

    def other_commands(self, frame: Frame, scene: Scene) -> Iterable[WaypointCommand]:
        """Where to next; nothing while the object is not in the scene."""
        name = self.settings.object
        if name not in scene.names:
            return
        x, y, z = scene.position[scene.names.index(name)].tolist()
        yield WaypointCommand(object=name, position=self._target((x, y, z)), speed=self.settings.speed_m_s)

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """The straight-line pair of each user."""
        return straight_choices(scene, pairs)

    def _target(self, position: Vector) -> Vector:
        """The first waypoint not yet reached."""
        points = self.settings.waypoints_m
        while (
            self._next < len(points) - 1 and math.dist(position, points[self._next]) <= self.settings.reach_m
        ):
            self._next += 1
        return points[self._next]
