"""World ``panda3d``: a game engine as a world, stepped by the run, with pictures by the engine.

Panda3D holds the level, its Bullet moves what drives and flies, and its software renderer takes pictures
where the run asks for ``camera``. The level goes to the other services as scenery, so that rays are traced
through what the engine shows.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
from msgspec.structs import replace

from caviar_bridges.panda3d.bodies import TICK_NS, Body, Physics
from caviar_bridges.panda3d.level import Level, empty_level, level_of_model, level_of_scenery
from caviar_bridges.panda3d.pictures import Pictures
from caviar_protocol.arrays import quantity
from caviar_protocol.errors import PayloadError, RunError
from caviar_protocol.messages import Input
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.coordinates import Pose, Vector, multiply, quaternion_from_euler
from caviar_protocol.topics import Action, Scene, VelocityCommand, WaypointCommand
from caviar_protocol.topics.link import MotionCommand
from caviar_services.checkpoint import restored, saved
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, StepResult
from caviar_services.world.base import ObjectState, World, WorldSettings
from caviar_services.world.trajectory import Length, NamedObject, unique_name
from caviar_space.meshes import SHAPES
from caviar_space.scenery import scenery_file

# [s] of its way at which a vehicle on a straight path goes on to the point after the next.
_LEAST_S = 0.05
# Part of the acceleration that the approach of a point counts on.
_BRAKES = 0.8
_REST: Vector = (0.0, 0.0, 0.0)


class DrivenObject(NamedObject, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A vehicle that drives along a path."""

    kind: str = "car"
    """Class of the object: ``car``, ``bus``, …; one without a mesh of its own is a box."""
    dimensions_m: tuple[Length, Length, Length] = (4.4, 1.8, 1.5)
    """Length, width, height."""
    path_m: Annotated[tuple[tuple[float, float, float], ...], msgspec.Meta(min_length=2)]
    """Points for the centre of the vehicle, which starts at the first one at full speed."""
    speed_m_s: Annotated[float, quantity("m/s", "on the way", gt=0)]
    max_acceleration_m_s2: Annotated[float, quantity("m/s2", "in any direction", gt=0)] = 5.0
    loop: bool = False
    """Whether it goes on from the last point to the first; else it stops at the last."""


class EngineFlownObject(NamedObject, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A UAV that agents fly."""

    start_m: tuple[float, float, float]
    """Centre of the object at the start of every episode."""
    start_yaw_deg: float = 0.0
    """Yaw at the start of every episode, counter-clockwise from +x [°]."""
    max_speed_m_s: Annotated[float, quantity("m/s", "in any direction", gt=0)]
    max_acceleration_m_s2: Annotated[float, quantity("m/s2", "in any direction", gt=0)]


class Panda3dSettings(WorldSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the world ``panda3d``."""

    model: str = ""
    """``file:PATH.egg``: what stands still, in a format that Panda3D loads; in place of ``scenery``. Tags
    ``material`` of its nodes name materials of ITU-R P.2040."""
    material: str = "concrete"
    """Of nodes of the model without such a tag."""
    driven: tuple[DrivenObject, ...] = ()
    """Vehicles along paths."""
    flown: tuple[EngineFlownObject, ...] = ()
    """UAVs, which agents fly."""


class _Order(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """Commands until an instant."""

    until_ns: Annotated[int, msgspec.Meta(ge=0)]
    commands: dict[str, VelocityCommand | WaypointCommand]


class _State(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    orders: tuple[_Order, ...]
    """Since the episode began, one after the other."""


class Panda3dWorld(World[Panda3dSettings]):
    """Vehicles and UAVs in Panda3D: topics ``scene`` and ``camera``.

    The pictures are of this world alone, and are not taken where no service asks for ``camera``.

    Args:
        settings: The level and what moves in it.
        run: What the world knows about the run.

    Raises:
        ScenarioError: Two objects have one name; names the key.

    Example:
        >>> car = DrivenObject(name="car.1", path_m=((0, 0, 0.75), (90, 0, 0.75)), speed_m_s=10)
        >>> Panda3dWorld(Panda3dSettings(driven=(car,)), RunInfo(name="world")).prefixes()
        ('car.1',)
    """

    Settings: ClassVar[type[msgspec.Struct]] = Panda3dSettings
    extra: ClassVar[str] = "panda3d"
    packages: ClassVar[tuple[str, ...]] = ("panda3d",)
    checkpoints: ClassVar[bool] = True
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="action", lag=1, required=False),)
    outputs: ClassVar[tuple[str, ...]] = ("scene", "camera")

    @classmethod
    def check_settings(cls, settings: Panda3dSettings, place: Place) -> None:
        """Refuse a model that is not there, or one beside scenery."""
        super().check_settings(settings, place)
        if settings.model and settings.scenery:
            raise place.at("model").error("stands beside scenery; write one of the two")
        if settings.model and not Path(settings.model).is_absolute():
            raise place.at("model").error(f'is {settings.model!r}; write "file:{settings.model}"')
        if settings.model and not Path(settings.model).is_file():
            raise place.at("model").error(f"there is no file {settings.model}; correct the path")

    @classmethod
    def placements(cls, settings: Panda3dSettings) -> Iterable[tuple[str, str, Sequence[Vector]]]:
        """The paths of vehicles, and where UAVs start."""
        for index, vehicle in enumerate(settings.driven):
            yield f"driven[{index}].path_m", vehicle.name, vehicle.path_m
        for index, uav in enumerate(settings.flown):
            yield f"flown[{index}].start_m", uav.name, [uav.start_m]

    @classmethod
    def known_objects(cls, settings: Panda3dSettings) -> Mapping[str, str] | None:
        """Vehicles and UAVs."""
        things: tuple[NamedObject, ...] = (*settings.driven, *settings.flown)
        return {(settings.prefix or "") + thing.name: thing.kind for thing in things}

    def __init__(self, settings: Panda3dSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._driven: dict[str, DrivenObject] = {}
        self._flown: dict[str, EngineFlownObject] = {}
        where = f"services.{run.name}.settings"
        for index, vehicle in enumerate(settings.driven):
            self._driven[unique_name(settings, vehicle, self._driven, f"{where}.driven[{index}]")] = vehicle
        for index, uav in enumerate(settings.flown):
            taken = {*self._driven, *self._flown}
            self._flown[unique_name(settings, uav, taken, f"{where}.flown[{index}]")] = uav
        self._alone = True
        self._begun = False
        self._pictures: Pictures | None = None
        self._physics: Physics | None = None
        self._bodies: dict[str, Body] = {}
        # Index of the point that each vehicle drives to.
        self._next: dict[str, int] = {}
        self._ticks = 0
        self._orders: list[_Order] = []

    def prefixes(self) -> tuple[str, ...]:
        """The setting, or all names, which are known."""
        return (self.settings.prefix,) if self.settings.prefix else (*self._driven, *self._flown)

    def mesh_classes(self) -> tuple[str, ...]:
        """The classes of the objects, those that have a mesh."""
        known = self.known_objects(self.settings) or {}
        return tuple(sorted(set(known.values()) & SHAPES.keys()))

    def scenery(self) -> Mapping[str, Path | bytes]:
        """As `World.scenery`, with the geometry of the model.

        Raises:
            SetupError: Panda3D is not installed.
        """
        return {**super().scenery(), **self._level.assets}

    @cached_property
    def _level(self) -> Level:
        # Once: `scenery` exports it and `prepare` plays in it.
        if self.settings.model:
            return level_of_model(Path(self.settings.model), self.settings.material)
        if self.settings.scenery:
            return level_of_scenery(scenery_file(self.settings.scenery))
        return empty_level()

    def prepare(self, preparation: Preparation) -> Prepared:
        """Load the level, and the renderer where the run asks for ``camera``.

        Raises:
            AssetError: Model or scenery are wrong.
            SetupError: Panda3D is not installed.
        """
        self.run.progress("loading the level", 60.0)
        self._alone = len(preparation.producers.get("scene", ())) <= 1
        level = self._level
        if "camera" in preparation.demand:
            self._pictures = Pictures(level.node)
            self._pictures.warm_up()
        prepared = super().prepare(preparation)
        if self.settings.model:
            shapes = sum(name.endswith(".ply") for name in level.assets)
            note = f"model: {Path(self.settings.model).name}, {shapes} shapes"
            prepared = Prepared(prefixes=prepared.prefixes, notes=(note,))
        return prepared

    def begin(self, episode: int, seed: int) -> None:
        """Every episode starts at the same places; then paths and commands decide."""
        # Anew: Bullet keeps the impulses of contacts, which the episode before would leave to this one.
        self._physics = Physics(self._level.node)
        self._ticks, self._orders, self._begun = 0, [], False
        self._bodies, self._next = {}, {}
        for name, vehicle in self._driven.items():
            body = self._bodies[name] = self._physics.add_vehicle(name, vehicle.dimensions_m)
            start, towards = vehicle.path_m[:2]
            x, y, z = (b - a for a, b in zip(start, towards, strict=True))
            scale = vehicle.speed_m_s / max(math.hypot(x, y, z), 1e-9)
            body.place(start, math.atan2(y, x), (scale * x, scale * y, scale * z))
            self._next[name] = 1
        for name, uav in self._flown.items():
            body = self._bodies[name] = self._physics.add_uav(name, uav.dimensions_m)
            body.place(uav.start_m, math.radians(uav.start_yaw_deg))

    def step(self, frame: Frame) -> StepResult:
        """The scene at the frame's instant, and its pictures.

        Raises:
            PayloadError: A command is for no object of this world, is not finite, is one of two for an
                object, or is neither waypoint nor velocity.
            RunError: The process before this one took the state of the engine with it.
        """
        if frame.number > 0 and not self._begun:
            raise RunError(
                f"world {self.run.name!r} came back in frame {frame.number}: what its engine was at is lost "
                "with the process that knew it; have states saved (run.checkpoint_frames above 0), and "
                "start the run again"
            )
        self._begun = True
        elapsed_ns = frame.t_ns - self._t0_ns
        started = time.perf_counter_ns()
        self._obey(_Order(elapsed_ns, self._commands(frame)))
        made = super().step(frame)
        moved = time.perf_counter_ns()
        contacts = self._physics.contacts() if self._physics else 0
        counts = {**made.counts, **({"contacts": contacts} if contacts else {})}
        measured = {"physics": moved - started}
        if self._pictures is None:
            return replace(made, counts=counts, measured=measured)
        scene = made.products["scene"]
        assert isinstance(scene, Scene)  # noqa: S101 - what `World.step` makes
        products = {**made.products, "camera": self._pictures.take(scene)}
        measured["pictures"] = time.perf_counter_ns() - moved
        return replace(made, products=products, counts=counts, measured=measured)

    def objects_at(self, elapsed_ns: int) -> Iterable[ObjectState]:
        """The bodies of the engine; between two of its ticks they go on as they are."""
        rest = (elapsed_ns - self._ticks * TICK_NS) / 1e9
        things: dict[str, NamedObject] = {**self._driven, **self._flown}
        for name, thing in things.items():
            pose, velocity, yaw_rate = self._bodies[name].state()
            if rest:
                x, y, z = (p + v * rest for p, v in zip(pose.position, velocity, strict=True))
                pose = Pose((x, y, z), multiply(quaternion_from_euler(yaw_rate * rest), pose.orientation))
            yield ObjectState(
                name=name,
                class_=thing.kind,
                position=pose.position,
                orientation=pose.orientation,
                velocity=velocity,
                dimensions=thing.dimensions_m,
                angular_velocity=(0.0, 0.0, yaw_rate),
            )

    def checkpoint(self) -> bytes:
        """All commands since the episode began: not all that Bullet's next step depends on can be read."""
        return saved(self, 1, _State(orders=tuple(self._orders)))

    def restore(self, state: bytes) -> None:
        """Play the episode again up to where it was, which takes the engine less than the episode did."""
        for order in restored(self, 1, _State, state).orders:
            self._obey(order)
        self._begun = True

    def close(self) -> None:
        """Release the renderer."""
        pictures, self._pictures = self._pictures, None
        if pictures is not None:
            pictures.close()

    def _obey(self, order: _Order) -> None:
        """Let the engine go on to the end of an order, and remember it."""
        placed = False
        for name, command in order.commands.items():
            if isinstance(command, WaypointCommand) and command.at_once:
                self._bodies[name].place(command.position, self._bodies[name].yaw)
                placed = True
        # Ticks count from the episode's start: two orders that say the same are one.
        if self._orders and not placed and self._orders[-1].commands == order.commands:
            self._orders.pop()
        self._orders.append(order)
        while self._physics and (self._ticks + 1) * TICK_NS <= order.until_ns:
            for name, uav in self._flown.items():
                wanted = _wanted(order.commands.get(name), self._bodies[name], uav)
                self._bodies[name].push(wanted, uav.max_acceleration_m_s2)
            for name, vehicle in self._driven.items():
                self._bodies[name].push(self._course(name, vehicle), vehicle.max_acceleration_m_s2)
            self._physics.tick()
            self._ticks += 1

    def _course(self, name: str, vehicle: DrivenObject) -> Vector:
        """Velocity with which a vehicle drives to its next point [m/s]."""
        body, path, speed = self._bodies[name], vehicle.path_m, vehicle.speed_m_s
        position, goal = body.position, self._next[name]
        last = not vehicle.loop and goal == len(path) - 1
        if not last:
            following = (goal + 1) % len(path)
            ahead = _towards(path[goal], path[following], speed, math.inf)
            # An acceleration a turns v into v' within T = |v' − v| / a, and the vehicle goes v·T/2 meanwhile.
            turn = speed * math.dist(ahead, body.velocity) / (2 * vehicle.max_acceleration_m_s2)
            near = min(max(turn, speed * _LEAST_S), math.dist(path[goal], path[following]) / 2)
            if math.dist(position, path[goal]) <= near:
                goal = self._next[name] = following
                last = not vehicle.loop and goal == len(path) - 1
        return _towards(position, path[goal], speed, vehicle.max_acceleration_m_s2 if last else math.inf)

    def _commands(self, frame: Frame) -> dict[str, VelocityCommand | WaypointCommand]:
        """Command for each UAV; beams and schedules are not for worlds."""
        found: dict[str, VelocityCommand | WaypointCommand] = {}
        agents: dict[str, str] = {}
        for agent, action in frame.payloads("action", Action).items():
            for command in action.commands:
                if not isinstance(command, MotionCommand):
                    continue
                name = command.object
                if name not in self._flown:
                    if not self._alone and not name.startswith(self.prefixes()):
                        continue  # for another world of the run
                    known = ", ".join(map(repr, self._flown)) or "none"
                    raise PayloadError(
                        f"agent {agent!r} commands the motion of {name!r}, which world {self.run.name!r} "
                        f"does not fly; it flies {known}"
                    )
                if name in found:
                    raise PayloadError(
                        f"agents {agents[name]!r} and {agent!r} both command the motion of {name!r}; "
                        f"let one of them own 'motion:{name}'"
                    )
                found[name], agents[name] = _checked(agent, command), agent
        return found


def _checked(agent: str, command: MotionCommand) -> VelocityCommand | WaypointCommand:
    if not isinstance(command, VelocityCommand | WaypointCommand):
        raise PayloadError(
            f"agent {agent!r} sends {type(command).__name__} to {command.object!r}, which world panda3d does "
            "not know; send waypoints or velocities"
        )
    values: tuple[Any, ...] = (
        command.velocity if isinstance(command, VelocityCommand) else (*command.position, command.speed)
    )
    if not all(map(math.isfinite, values)):
        raise PayloadError(f"agent {agent!r} commands {command}, which is not finite; command numbers")
    return command


def _wanted(command: VelocityCommand | WaypointCommand | None, body: Body, uav: EngineFlownObject) -> Vector:
    """Velocity that a command asks for [m/s], within what the UAV can do; without one it brakes."""
    if isinstance(command, WaypointCommand):
        speed = min(command.speed, uav.max_speed_m_s)
        return _towards(body.position, command.position, speed, uav.max_acceleration_m_s2)
    if command is None:
        return _REST
    x, y, z = command.velocity
    scale = min(1.0, uav.max_speed_m_s / max(math.hypot(x, y, z), 1e-9))
    return (scale * x, scale * y, scale * z)


def _towards(position: Vector, target: Vector, speed: float, braking: float) -> Vector:
    """Velocity [m/s] towards a point: what can still be braked away, v² = 2·a·d, and no more than to it."""
    x, y, z = (b - a for a, b in zip(position, target, strict=True))
    distance = math.hypot(x, y, z)
    if distance == 0.0:
        return _REST
    # Within the last tick the whole way, so that it does not swing about the point.
    reached = min(math.sqrt(2 * _BRAKES * braking * distance), distance / (TICK_NS / 1e9))
    scale = min(speed, reached) / distance
    return (scale * x, scale * y, scale * z)
