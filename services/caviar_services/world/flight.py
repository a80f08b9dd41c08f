"""World ``flight``: objects that agents fly, a UAV for instance, beside scripted ones.

A flown object obeys one motion command per frame; without one it brakes and hovers.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, ClassVar

import msgspec
from msgspec.structs import replace

from caviar_protocol.arrays import quantity
from caviar_protocol.errors import PayloadError, RunError, ScenarioError
from caviar_protocol.messages import Input
from caviar_protocol.space.coordinates import Vector, quaternion_from_euler
from caviar_protocol.topics import Action, VelocityCommand, WaypointCommand
from caviar_services.checkpoint import restored, saved
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, StepResult
from caviar_services.world.base import ObjectState
from caviar_services.world.flight_dynamics import Flyer, FlyerState, Limits, Motion
from caviar_services.world.scenery import Obstacles, scenery_assets, scenery_triangles
from caviar_services.world.trajectory import (
    MovingObject,
    NamedObject,
    TrajectorySettings,
    TrajectoryWorld,
    unique_name,
)


class FlownObject(NamedObject, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One object that agents fly, and what it is capable of."""

    start_m: tuple[float, float, float]
    """Centre of the object at the start of every episode."""
    start_yaw_deg: float = 0.0
    """Yaw at the start of every episode, counter-clockwise from +x [°]."""
    max_speed_m_s: Annotated[float, quantity("m/s", "in any direction", gt=0)]
    max_acceleration_m_s2: Annotated[float, quantity("m/s2", "in any direction", gt=0)]
    clearance_m: Annotated[float, quantity("m", "least distance of the centre from scenery", gt=0)] = 1.0
    minimum_m: tuple[float, float, float] | None = None
    """Least x, y and z of the centre; unset: no bounds but the ground at z = 0. Faces of scenery
    that lie at this height or lower are no obstacles."""
    maximum_m: tuple[float, float, float] | None = None
    """Greatest x, y and z of the centre; unset: no bounds."""


class FlightSettings(TrajectorySettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the world ``flight``."""

    objects: tuple[MovingObject, ...] = ()
    """Scripted objects, as in the world ``trajectory``."""
    flown: tuple[FlownObject, ...]
    """Objects that agents fly."""


class _State(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    elapsed_ns: Annotated[int, msgspec.Meta(ge=0)]
    """Since the beginning of the episode."""
    flyers: dict[str, FlyerState]


class FlightWorld(TrajectoryWorld):
    """Objects that agents fly, with limited speed and acceleration, clear of the scenery.

    Beside other worlds of a run, commands for objects of no name of its own are left to them.

    Args:
        settings: The objects, what they are capable of, and the scenery.
        run: What the world knows about the run.

    Raises:
        ScenarioError: Two objects have one name, or limits contradict each other; names the key.

    Example:
        >>> uav = FlownObject(name="uav", start_m=(0, 0, 30), max_speed_m_s=10, max_acceleration_m_s2=2)
        >>> FlightWorld(FlightSettings(flown=(uav,)), RunInfo(name="world")).prefixes()
        ('uav',)
    """

    Settings: ClassVar[type[msgspec.Struct]] = FlightSettings
    checkpoints: ClassVar[bool] = True
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="action", lag=1, required=False),)

    def __init__(self, settings: FlightSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._flown: dict[str, FlownObject] = {}
        self._flyers: dict[str, Flyer] = {}
        self._elapsed_ns = 0
        self._begun = False
        self._alone = True
        for index, thing in enumerate(settings.flown):
            key = f"services.{run.name}.settings.flown[{index}]"
            name = unique_name(settings, thing, {*self._flown, *self._tracks}, key)
            self._flown[name] = thing
            self._flyers[name] = Flyer(_limits(thing, key))

    @classmethod
    def placements(cls, settings: TrajectorySettings) -> Iterable[tuple[str, str, Sequence[Vector]]]:
        """The waypoints of scripted objects, and where flown ones start."""
        yield from super().placements(settings)
        if isinstance(settings, FlightSettings):
            for index, thing in enumerate(settings.flown):
                yield f"flown[{index}].start_m", thing.name, [thing.start_m]

    @classmethod
    def known_objects(cls, settings: TrajectorySettings) -> Mapping[str, str] | None:
        """Scripted and flown ones."""
        flown = settings.flown if isinstance(settings, FlightSettings) else ()
        own = {(settings.prefix or "") + thing.name: thing.kind for thing in flown}
        return {**(super().known_objects(settings) or {}), **own}

    def prepare(self, preparation: Preparation) -> Prepared:
        """Load the scenery as obstacles, and see that every flown object starts clear of it.

        Raises:
            AssetError: A file of the scenery is missing or wrong.
            ScenarioError: An object starts too near to the scenery; names the key.
        """
        self._alone = len(preparation.producers.get("scene", ())) <= 1
        triangles = scenery_triangles(scenery_assets(self.settings.scenery))
        for index, (name, flyer) in enumerate(self._flyers.items()):
            thing = self._flown[name]
            # The ground below the bounds cannot be reached: most triangles of a flat street are left out so.
            flyer.obstacles = Obstacles(triangles[triangles[..., 2].max(axis=1) > flyer.limits.low[2]])
            distance = flyer.obstacles.distance(thing.start_m, flyer.limits.kept)
            if distance < flyer.limits.kept:
                raise ScenarioError(
                    f"{list(thing.start_m)} is {distance:.3f} m from the scenery, and {name!r} keeps "
                    f"{flyer.limits.kept:.3f} m; start farther away",
                    key=f"services.{self.run.name}.settings.flown[{index}].start_m",
                )
        return super().prepare(preparation)

    def begin(self, episode: int, seed: int) -> None:
        """Every episode starts at the same place; then commands decide."""
        self._elapsed_ns, self._begun = 0, False
        for name, thing in self._flown.items():
            self._flyers[name].reset(thing.start_m, math.radians(thing.start_yaw_deg))

    def step(self, frame: Frame) -> StepResult:
        """The scene at the frame's instant, the commands having acted since the one before.

        Raises:
            PayloadError: A command is for no object of this world, is not finite, is one of two for an
                object, or puts an object where it cannot be.
            RunError: The process before this one took the state of the flight with it.
        """
        if frame.number > 0 and not self._begun:
            raise RunError(
                f"world {self.run.name!r} came back in frame {frame.number}: where its objects had been "
                "flown to is lost with the process that knew it; have states saved "
                "(run.checkpoint_frames above 0), and start the run again"
            )
        # `restore` sets it too: where states are saved, a world that is started again is not lost.
        self._begun = True
        motions = self._motions(frame)
        self._place(motions)
        counts: Counter[str] = Counter()
        elapsed_ns = frame.t_ns - self._t0_ns
        length_ns = elapsed_ns - self._elapsed_ns
        for name, flyer in self._flyers.items():
            counts.update(flyer.fly(motions.get(name), length_ns))
        self._elapsed_ns = elapsed_ns
        made = super().step(frame)
        return replace(made, counts={**made.counts, **counts})

    def _place(self, motions: Mapping[str, Motion]) -> None:
        """Put the objects where they are to be at once; they hover there."""
        for name, motion in motions.items():
            if motion.at_once and motion.target is not None:
                flyer = self._flyers[name]
                limits, target = flyer.limits, motion.target
                inside = all(a <= x <= b for a, x, b in zip(limits.low, target, limits.high, strict=True))
                if not inside or flyer.obstacles.distance(target, limits.kept) < limits.kept:
                    raise PayloadError(
                        f"{name!r} cannot be at {list(target)}: it keeps within {list(limits.low)} and "
                        f"{list(limits.high)}, and {limits.kept:.3f} m clear of scenery; choose another point"
                    )
                flyer.reset(target, flyer.state.yaw)

    def checkpoint(self) -> bytes:
        """The motion of each flown object: it follows from all commands since the episode began."""
        flyers = {name: flyer.state for name, flyer in self._flyers.items()}
        return saved(self, 1, _State(elapsed_ns=self._elapsed_ns, flyers=flyers))

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        was = restored(self, 1, _State, state)
        self._elapsed_ns, self._begun = was.elapsed_ns, True
        for name, flyer in self._flyers.items():
            flyer.state = was.flyers[name]

    def _motions(self, frame: Frame) -> dict[str, Motion]:
        """Commands for each flown object; beams and schedules are not for worlds."""
        found: dict[str, tuple[str, Motion]] = {}
        for agent, action in frame.payloads("action", Action).items():
            for command in action.commands:
                if not isinstance(command, VelocityCommand | WaypointCommand):
                    continue
                name = command.object
                if name not in self._flyers:
                    # It may be meant for another world of the run; alone, no other can fly it.
                    if not self._alone and not name.startswith(self.prefixes()):
                        continue
                    known = ", ".join(map(repr, self._flyers)) or "none"
                    raise PayloadError(
                        f"agent {agent!r} commands the motion of {name!r}, which world {self.run.name!r} "
                        f"does not fly; it flies {known}"
                    )
                if name in found:
                    raise PayloadError(
                        f"agents {found[name][0]!r} and {agent!r} both command the motion of {name!r}; "
                        f"let one of them own 'motion:{name}'"
                    )
                found[name] = agent, _motion(command, agent)
        return {name: motion for name, (_, motion) in found.items()}

    def objects_at(self, elapsed_ns: int) -> Iterable[ObjectState]:
        """The scripted objects, and the flown ones where they are now."""
        yield from super().objects_at(elapsed_ns)
        for name, flyer in self._flyers.items():
            thing = self._flown[name]
            yield ObjectState(
                name=name,
                kind=thing.kind,
                position=flyer.state.position,
                orientation=quaternion_from_euler(flyer.state.yaw),
                velocity=flyer.state.velocity,
                dimensions=thing.dimensions_m,
                yaw_rate=flyer.state.yaw_rate,
            )


def _motion(command: VelocityCommand | WaypointCommand, agent: str) -> Motion:
    if isinstance(command, WaypointCommand):
        motion = Motion(target=command.position, speed=command.speed, at_once=command.at_once)
        values: tuple[float, ...] = (*command.position, command.speed)
    else:
        motion = Motion(velocity=command.velocity)
        values = command.velocity
    if not all(map(math.isfinite, values)):
        raise PayloadError(f"agent {agent!r} commands {command}, which is not finite; command numbers")
    return motion


def _limits(thing: FlownObject, key: str) -> Limits:
    # The clearance is that of the centre: with less than half the diagonal a corner might touch a wall.
    half = math.hypot(*thing.dimensions_m) / 2
    if thing.clearance_m < half:
        raise ScenarioError(
            f"{thing.clearance_m} m is less than half the diagonal of the object; write at least "
            f"{math.ceil(half * 100) / 100}",
            key=f"{key}.clearance_m",
        )
    low = thing.minimum_m or (-math.inf, -math.inf, thing.dimensions_m[2] / 2)
    high = thing.maximum_m or (math.inf, math.inf, math.inf)
    if not all(a <= x <= b for a, x, b in zip(low, thing.start_m, high, strict=True)):
        raise ScenarioError(
            f"{list(thing.start_m)} is not within {list(low)} and {list(high)}; start inside",
            key=f"{key}.start_m",
        )
    return Limits(
        speed=thing.max_speed_m_s,
        acceleration=thing.max_acceleration_m_s2,
        clearance=thing.clearance_m,
        low=low,
        high=high,
    )
