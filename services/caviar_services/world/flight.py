"""World ``flight``: objects that agents fly, a UAV for instance, beside scripted ones.

A flown object obeys one motion command per frame; without one it brakes and hovers. As a point it has
bounded speed and acceleration and keeps clear of obstacles (`flight_dynamics`); as a quadrotor it is a rigid
body with rotors in wind (`quadrotor`), which may touch what is in its way.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, ClassVar, Literal

import msgspec
from msgspec.structs import replace

from caviar_protocol.arrays import quantity
from caviar_protocol.errors import DeclarationError, PayloadError, RunError, ScenarioError
from caviar_protocol.messages import Input
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.coordinates import Vector, quaternion_from_euler, rotated
from caviar_protocol.topics import (
    Action,
    DriveCommand,
    WaypointCommand,
)
from caviar_protocol.topics.link import MotionCommand
from caviar_protocol.topics.scene import LEFT_GEOFENCE_PREFIX, OUTSIDE_GEOFENCE_PREFIX
from caviar_services.checkpoint import restored, saved
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, StepResult
from caviar_services.world.base import ObjectState, turning
from caviar_services.world.flight_dynamics import (
    Flyer,
    FlyerState,
    Limits,
    motion_of,
    order_of,
    place_outside,
)
from caviar_services.world.quadrotor.airframe import GRAVITY, Airframe, plant_named
from caviar_services.world.quadrotor.control import Battery, Controller, QuadrotorState
from caviar_services.world.quadrotor.fleet import Fleet
from caviar_services.world.quadrotor.flyer import SLICE_NS, Quadrotor
from caviar_services.world.quadrotor.surroundings import OnCollision, Wind
from caviar_services.world.trajectory import (
    MovingObject,
    NamedObject,
    TrajectorySettings,
    TrajectoryWorld,
    unique_name,
)
from caviar_space.obstacles import Obstacles
from caviar_space.scenery import scenery_assets, scenery_triangles

_log = logging.getLogger("caviar.service")

# Triangles at most this high above the ground [m] are the ground.
_FLAT = 1e-3

# Greatest thrust over the weight of a quadrotor that can be controlled.
_LEAST_RATIO = 1.2


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
    dynamics: Literal["point", "quadrotor"] = "point"
    """``point``: bounded speed and acceleration, upright, clear of scenery. ``quadrotor``: a rigid body with
    four rotors, which tilts, is moved by the wind, and may collide; ``clearance_m`` is asked for at its start
    alone, and ``max_acceleration_m_s2`` bounds what its controller strives for."""
    airframe: Airframe | None = None
    """Of a quadrotor; unset: the defaults."""
    controller: Controller | None = None
    """Of a quadrotor; unset: the defaults."""
    battery: Battery | None = None
    """Of a quadrotor; unset: the defaults."""
    engine: str | None = None
    """What integrates the rigid body of a quadrotor: ``caviar``, ``mujoco``, which the extra of that name
    brings, or another plug-in of the group ``caviar.plants``; unset: ``caviar``."""
    on_collision: OnCollision | None = None
    """What a quadrotor does that touches scenery, an object of this world, or the ground at more than 2 m/s.
    ``stop``: it comes to rest there, and flies on where the way is free. ``bounce``: it rebounds. ``land``:
    it goes down with 1 m/s and stays there. ``fall``: its rotors stop. ``ignore``: it passes through, but for
    the ground. Unset: ``stop``. Each collision is counted."""
    restitution: (
        Annotated[float, quantity("1", "speed after a bounce over that before", ge=0, le=1)] | None
    ) = None
    """Of a quadrotor that bounces; unset: 0.5."""


_QUADROTOR_KEYS = ("airframe", "controller", "battery", "engine", "on_collision", "restitution")


class FlightSettings(TrajectorySettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the world ``flight``."""

    objects: tuple[MovingObject, ...] = ()
    """Scripted objects, as in the world ``trajectory``."""
    flown: tuple[FlownObject, ...]
    """Objects that agents fly."""
    wind: Wind = Wind()
    """The air, which moves quadrotors."""


class _State(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    elapsed_ns: Annotated[int, msgspec.Meta(ge=0)]
    """Since the beginning of the episode."""
    flyers: dict[str, FlyerState]
    quadrotors: dict[str, QuadrotorState] = {}


class FlightWorld(TrajectoryWorld):
    """Objects that agents fly, as points clear of the scenery or as quadrotors.

    Beside other worlds of a run, commands for objects of no name of its own are left to them.

    Args:
        settings: The objects, what they are capable of, and the scenery.
        run: What the world knows about the run.

    Raises:
        ScenarioError: Two objects have one name, limits contradict each other, or a quadrotor cannot fly as
            they say; names the key.

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
        # Objects of which a command to a place outside of their bounds was warned of in this episode.
        self._warned: set[str] = set()
        quadrotors: dict[str, Quadrotor] = {}
        for index, thing in enumerate(settings.flown):
            key = f"services.{run.name}.settings.flown[{index}]"
            name = unique_name(settings, thing, {*self._flown, *self._tracks}, key)
            self._flown[name] = thing
            if thing.dynamics == "point":
                self._flyers[name] = Flyer(_limits(thing, key))
            else:
                quadrotors[name] = _quadrotor(thing, settings.wind, key)
        radii = {name: math.hypot(*self._flown[name].dimensions_m) / 2 for name in quadrotors}
        self._fleet = Fleet(quadrotors, radii, super().objects_at, run.name)

    @classmethod
    def check_settings(cls, settings: TrajectorySettings, place: Place) -> None:
        """Raise `ScenarioError` for what a point does not have."""
        super().check_settings(settings, place)
        if not isinstance(settings, FlightSettings):
            return
        for index, thing in enumerate(settings.flown):
            where = place.at("flown").at(index)
            given = [key for key in _QUADROTOR_KEYS if getattr(thing, key) is not None]
            if thing.dynamics == "point" and given:
                raise where.at(given[0]).error('is for quadrotors; write dynamics = "quadrotor" beside it')
            try:
                plant_named(thing.engine or "caviar")
            except DeclarationError as error:
                raise where.at("engine").error(str(error)) from error
        if settings.wind != Wind() and all(thing.dynamics == "point" for thing in settings.flown):
            raise place.at("wind").error('moves quadrotors alone; write dynamics = "quadrotor" in [[flown]]')

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
        tops = triangles[..., 2].max(axis=1)
        for index, (name, thing) in enumerate(self._flown.items()):
            # The ground below the bounds cannot be reached: most triangles of a flat street are left out so.
            if name in self._flyers:
                limits, floor = self._flyers[name].limits, self._flyers[name].limits.low[2]
            else:
                uav = self._fleet.quadrotors[name]
                limits, floor = uav.limits, uav.floor - thing.dimensions_m[2] / 2 + _FLAT
            obstacles = Obstacles(triangles[tops > floor])
            if name in self._flyers:
                self._flyers[name].obstacles = obstacles
            else:
                self._fleet.obstacles[name] = obstacles
            distance = obstacles.distance(thing.start_m, limits.kept)
            if distance < limits.kept:
                raise ScenarioError(
                    f"{list(thing.start_m)} is {distance:.3f} m from the scenery, and {name!r} keeps "
                    f"{limits.kept:.3f} m; start farther away",
                    key=f"services.{self.run.name}.settings.flown[{index}].start_m",
                )
        return super().prepare(preparation)

    def begin(self, episode: int, seed: int) -> None:
        """Every episode starts at the same place; then commands decide."""
        self._elapsed_ns, self._begun = 0, False
        self._warned.clear()
        starts = {
            name: (thing.start_m, math.radians(thing.start_yaw_deg)) for name, thing in self._flown.items()
        }
        for name, flyer in self._flyers.items():
            flyer.reset(*starts[name])
        self._fleet.begin(episode, seed, starts)

    def step(self, frame: Frame) -> StepResult:
        """The scene at the frame's instant, the commands having acted since the one before.

        Raises:
            PayloadError: A command is for no object of this world, is not finite, is one of two for an
                object, is none that the object can obey, or puts an object where it cannot be.
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
        commands = self._commands(frame)
        motions = {name: motion_of(*commands[name]) for name in self._flyers if name in commands}
        orders = {name: order_of(*commands[name]) for name in self._fleet.quadrotors if name in commands}
        self._place(commands)
        counts = self._outside(frame, commands)
        elapsed_ns = frame.t_ns - self._t0_ns
        length_ns = elapsed_ns - self._elapsed_ns
        for name, flyer in self._flyers.items():
            counts.update(flyer.fly(motions.get(name), length_ns))
        counts.update(self._fleet.fly(orders, elapsed_ns))
        self._elapsed_ns = elapsed_ns
        self._report_exits(frame, counts)
        made = super().step(frame)
        return replace(made, counts={**made.counts, **counts})

    def _outside(self, frame: Frame, commands: Mapping[str, tuple[str, MotionCommand]]) -> Counter[str]:
        """Count commands to places outside of the bounds; warn of the first of an object and episode."""
        counts = Counter[str]()
        for name, (agent, command) in commands.items():
            limits = self._limits(name)
            if (place := place_outside(command, limits)) is None:
                continue
            counts[OUTSIDE_GEOFENCE_PREFIX + name] = 1
            if name not in self._warned:
                self._warned.add(name)
                _log.warning(
                    "episode %d, frame %d: agent %r commands %r to %s m, outside of its geofence from %s to "
                    "%s m; it keeps within, and further such commands of the episode are only counted",
                    *(frame.episode, frame.number, agent, name, list(place)),
                    *(list(limits.low), list(limits.high)),
                )
        return counts

    def _report_exits(self, frame: Frame, counts: Mapping[str, int]) -> None:
        """Warn of each quadrotor that drifted out of its bounds in a frame."""
        for name, seen in self._fleet.seen.items():
            if counts.get(LEFT_GEOFENCE_PREFIX + name):
                limits = self._limits(name)
                _log.warning(
                    "episode %d, frame %d: %r left its geofence from %s to %s m, and is at %s m",
                    *(frame.episode, frame.number, name, list(limits.low), list(limits.high)),
                    [round(at, 3) for at in seen.body.position],
                )

    def _limits(self, name: str) -> Limits:
        return (self._flyers.get(name) or self._fleet.quadrotors[name]).limits

    def _place(self, commands: Mapping[str, tuple[str, MotionCommand]]) -> None:
        """Put the objects where they are to be at once; they hover there."""
        for name, (_, command) in commands.items():
            if isinstance(command, WaypointCommand) and command.at_once:
                flyer, uav = self._flyers.get(name), self._fleet.quadrotors.get(name)
                limits = self._limits(name)
                obstacles = flyer.obstacles if flyer else self._fleet.obstacles[name]
                target = command.position
                if limits.excess(target) > 0.0 or obstacles.distance(target, limits.kept) < limits.kept:
                    raise PayloadError(
                        f"{name!r} cannot be at {list(target)}: it keeps within {list(limits.low)} and "
                        f"{list(limits.high)}, and {limits.kept:.3f} m clear of scenery; choose another point"
                    )
                if flyer:
                    flyer.reset(target, flyer.state.yaw if command.yaw is None else command.yaw)
                elif uav:
                    uav.place(target, command.yaw)

    def checkpoint(self) -> bytes:
        """The motion of each flown object: it follows from all commands since the episode began."""
        flyers = {name: flyer.state for name, flyer in self._flyers.items()}
        quadrotors = {name: uav.state for name, uav in self._fleet.quadrotors.items()}
        return saved(self, 1, _State(elapsed_ns=self._elapsed_ns, flyers=flyers, quadrotors=quadrotors))

    def restore(self, state: bytes) -> None:
        """See `checkpoint`."""
        was = restored(self, 1, _State, state)
        self._elapsed_ns, self._begun = was.elapsed_ns, True
        for name, flyer in self._flyers.items():
            flyer.state = was.flyers[name]
        self._fleet.resume(was.quadrotors, was.elapsed_ns)

    def _commands(self, frame: Frame) -> dict[str, tuple[str, MotionCommand]]:
        """Agent and command for each flown object; beams and schedules are not for worlds."""
        found: dict[str, tuple[str, MotionCommand]] = {}
        for agent, action in frame.payloads("action", Action).items():
            for command in action.commands:
                if isinstance(command, DriveCommand) and command.object in self._flown:
                    raise PayloadError(
                        f"agent {agent!r} sends DriveCommand to {command.object!r}, which flies; "
                        "send waypoints"
                    )
                if not isinstance(command, MotionCommand):
                    continue
                name = command.object
                if name not in self._flown:
                    # It may be meant for another world of the run; alone, no other can fly it.
                    if not self._alone and not name.startswith(self.prefixes()):
                        continue
                    known = ", ".join(map(repr, self._flown)) or "none"
                    raise PayloadError(
                        f"agent {agent!r} commands the motion of {name!r}, which world {self.run.name!r} "
                        f"does not fly; it flies {known}"
                    )
                if name in found:
                    raise PayloadError(
                        f"agents {found[name][0]!r} and {agent!r} both command the motion of {name!r}; "
                        f"let one of them own 'motion:{name}'"
                    )
                found[name] = agent, command
        return found

    def objects_at(self, elapsed_ns: int) -> Iterable[ObjectState]:
        """The scripted objects, and the flown ones where they are now."""
        yield from super().objects_at(elapsed_ns)
        for name, flyer in self._flyers.items():
            thing = self._flown[name]
            yield ObjectState(
                name=name,
                class_=thing.kind,
                position=flyer.state.position,
                orientation=quaternion_from_euler(flyer.state.yaw),
                velocity=flyer.state.velocity,
                dimensions=thing.dimensions_m,
                angular_velocity=(0.0, 0.0, flyer.state.yaw_rate),
            )
        for name, seen in self._fleet.seen.items():
            body = seen.body
            x, y, z = rotated(body.orientation, body.rates)
            yield ObjectState(
                name=name,
                class_=self._flown[name].kind,
                position=body.position,
                orientation=body.orientation,
                velocity=body.velocity,
                dimensions=self._flown[name].dimensions_m,
                angular_velocity=(turning(x), turning(y), turning(z)),
            )


def _quadrotor(thing: FlownObject, wind: Wind, key: str) -> Quadrotor:
    airframe, controller = thing.airframe or Airframe(), thing.controller or Controller()
    limits = _limits(thing, key)
    if airframe.thrust_ratio <= _LEAST_RATIO:
        raise ScenarioError(
            f"four rotors at {airframe.max_rotor_rad_s:g} rad/s lift {airframe.thrust_ratio:.2f} of the "
            f"weight, and control needs {_LEAST_RATIO}; raise max_rotor_rad_s or thrust_n_s2, or lower "
            "mass_kg",
            key=f"{key}.airframe.max_rotor_rad_s",
        )
    steepest = GRAVITY * math.tan(math.radians(controller.max_tilt_deg))
    if limits.acceleration > steepest:
        raise ScenarioError(
            f"{limits.acceleration:g} m/s² is more than a tilt of {controller.max_tilt_deg:g}° gives; write "
            f"at most {math.floor(steepest * 100) / 100}, or raise controller.max_tilt_deg",
            key=f"{key}.max_acceleration_m_s2",
        )
    radius = math.hypot(*thing.dimensions_m) / 2
    # Contacts are looked for once a slice: in it the centre must not get past the middle of a wall's surface.
    fastest = radius / (SLICE_NS * 1e-9)
    if limits.speed > fastest:
        raise ScenarioError(
            f"{limits.speed:g} m/s would pass through a wall between two looks; write at most {fastest:.0f}",
            key=f"{key}.max_speed_m_s",
        )
    return Quadrotor(
        airframe,
        controller,
        thing.battery or Battery(),
        limits,
        wind,
        thing.on_collision or "stop",
        0.5 if thing.restitution is None else thing.restitution,
        thing.dimensions_m[2],
        plant_named(thing.engine or "caviar")(airframe),
    )


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
