"""World ``sumo``: road traffic and people of Eclipse SUMO, in this process.

``sumo-actuated`` is the world ``sumo`` whose vehicles and traffic lights agents command. It is an
implementation of its own because commands close the loop: a frame waits for the actions of the one
before, while frames of ``sumo`` overlap.
"""

from __future__ import annotations

import cmath
import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any, ClassVar, NamedTuple

import msgspec
from msgspec.structs import replace

from caviar_protocol.arrays import Vector3, quantity
from caviar_protocol.errors import RunError, ScenarioError
from caviar_protocol.messages import Input
from caviar_protocol.seeding import derive_seed
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.topics import Action
from caviar_protocol.topics.scene import BESIDE_ROAD_PREFIX, SIMULATOR_SAYS_PREFIX
from caviar_services.checkpoint import restored, saved
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, StepResult
from caviar_services.world.base import ObjectState, World, WorldSettings, turning
from caviar_services.world.carriages import LENGTHS_M, Ways, carriage_count, carriages
from caviar_services.world.sumo_commands import Commanded, carry_out, traffic_commands
from caviar_services.world.sumo_conventions import (
    Heading,
    People,
    Placement,
    body_pose,
    check_spacing,
    distance_to_line,
    heading,
    in_scene,
    object_class,
    step_length_ms,
)
from caviar_services.world.sumo_inputs import Inputs, checked_inputs
from caviar_services.world.sumo_process import Simulation, TrafficStates, load_libsumo
from caviar_space.meshes import SHAPES

_NS_PER_MS = 1_000_000
# A vehicle that turns by more in a step has not turned: SUMO has put it elsewhere.
_JUMP_DEG = 90.0

# Vehicles up to this length [m] turn at a junction with their rear on their own lane or the next.
_LONG_M = 10.0

# Steps between two reports of progress on the way to a distant instant; a step takes some 0.3 ms.
_REPORT_EVERY = 1000

Files = str | tuple[str, ...]


class SumoSettings(WorldSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the world ``sumo``; files are written ``file:PATH``, relative to the scenario."""

    net: str = ""
    """Road network, ``.net.xml``. One of `net` and `config` is needed."""
    config: str = ""
    """Configuration, ``.sumocfg``; the other settings go before what it says."""
    routes: Files = ()
    """Vehicle types, routes, flows: ``.rou.xml``."""
    additional: Files = ()
    """Additional files: stops, detectors, vehicle types."""
    step_ms: Annotated[int | None, quantity("ms", "SUMO's step; unset: the sampling period")] = None
    begin_s: Annotated[
        float, quantity("s", "SUMO's time at frame 0; it runs up to there first, to fill the roads")
    ] = 0.0
    between_episodes_s: Annotated[
        float | None,
        quantity("s", "episodes share one traffic and begin so far apart in it; unset: each has its own"),
    ] = None
    offset_m: Annotated[Vector3, quantity("m", "where the network's origin lies; z: the ground")] = (
        0.0,
        0.0,
        0.0,
    )
    yaw_deg: Annotated[float, quantity("°", "the network is turned by, counter-clockwise")] = 0.0
    classes: dict[str, str] = msgspec.field(default_factory=dict)
    """Class of an object by the id of its vehicle type, or by vClass: ``{ Lorry = "truck" }``."""
    meshes: tuple[str, ...] = ("bicycle", "bus", "car", "motorcycle", "pedestrian", "truck")
    """Classes that have a mesh of their own; objects of others are boxes."""
    carriages: Annotated[
        dict[str, float],
        quantity(
            "m",
            "length of the carriages of long vehicles by vehicle type or vClass, 0: one rigid body; trains, "
            "trams and lorries with trailers have carriages unless it says otherwise",
        ),
    ] = msgspec.field(default_factory=dict)
    options: tuple[str, ...] = ()
    """More of SUMO's command line: ``["--lanechange.duration", "2"]``."""

    def __post_init__(self) -> None:
        for name, length in self.carriages.items():
            if not (length == 0 or 1 <= length <= 1000):
                raise ValueError(
                    f"carriages.{name} is {length:g} m; write 1 to 1000 m, or 0 for one rigid body"
                )


class _Kind(NamedTuple):
    """Class and size of an object, which do not change while it is there."""

    class_: str
    dimensions: Vector
    carriages: int = 1
    """Of each this many, end to end."""


class _State(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """State of a simulation.

    SUMO's own snapshots do not lead back there: what it reads of route files while it goes on from one
    moves its generator of random numbers, and makes flows anew (measured with 1.28, and its issue 16989).
    The same steps from the same seed do, at some 0.3 ms a step.
    """

    steps: Annotated[int, msgspec.Meta(ge=0)]
    """After frame 0."""
    arrived: tuple[str, ...]
    """Objects of the last frame, those that came first in front."""
    traffic: str
    """Digest of all vehicles and persons there."""
    commanded: tuple[Commanded, ...] = ()
    """What agents have commanded since frame 0."""


class SumoWorld(World[SumoSettings]):
    """Traffic of a SUMO network.

    Every frame shows the vehicles and persons that are in the network; a person inside a
    vehicle is not shown, nor a vehicle that SUMO is moving elsewhere (teleporting). People stand upright and
    walk smoothly after the places where SUMO has them (`people`).

    Args:
        settings: Files of SUMO, its step, where the network lies, and classes of objects.
        run: What the world knows about the run.

    Raises:
        ScenarioError: There is neither a network nor a configuration, SUMO's step does not fit the sampling
            period, or a class has no mesh; names the key.

    Example:
        >>> world = SumoWorld(SumoSettings(net="/maps/town.net.xml"), RunInfo(name="traffic"))
        >>> world.prefixes()
        ('traffic.',)
    """

    Settings = SumoSettings
    extra: ClassVar[str] = "world"
    packages: ClassVar[tuple[str, ...]] = ("eclipse-sumo", "libsumo")
    checkpoints: ClassVar[bool] = True

    def __init__(self, settings: SumoSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._step_ms = step_length_ms(run.sampling_period_ns, settings.step_ms)
        self._prefix = f"{run.name}." if settings.prefix is None else settings.prefix
        self._placement = Placement(settings.offset_m, math.radians(settings.yaw_deg))
        self._simulation: Simulation | None = None
        self._steps = 0
        self._angles: dict[str, float] = {}
        self._vehicles: dict[str, _Kind] = {}
        self._persons: dict[str, _Kind] = {}
        self._people = People(self._step_ms / 1000.0)
        self._commanded: list[Commanded] = []
        self._trails: dict[str, list[complex]] = {}
        self._beside_road: set[str] = set()
        if settings.between_episodes_s is not None:
            check_spacing(settings.between_episodes_s, self._step_ms)
        if not settings.net and not settings.config:
            raise ScenarioError('needs net = "file:….net.xml" or config = "file:….sumocfg"', key="settings")
        for name in settings.meshes:
            if name not in SHAPES:
                raise ScenarioError(
                    f"no mesh is there for {name!r}; known: {', '.join(SHAPES)}", key="settings.meshes"
                )

    def prefixes(self) -> tuple[str, ...]:
        """The setting, or the world's name and a dot."""
        return (self._prefix,)

    def mesh_classes(self) -> tuple[str, ...]:
        """As the settings say."""
        return self.settings.meshes

    def prepare(self, preparation: Preparation) -> Prepared:
        """Check the files and load the library; an episode's reset starts SUMO.

        Raises:
            ScenarioError: A file is missing or wrong; names file, key and line.
            SetupError: libsumo is not installed.
        """
        self._simulation = Simulation(load_libsumo())
        version = self._simulation.api.getVersion()[1]
        notes = self._inputs.notes
        base = super().prepare(preparation)
        return Prepared(
            prefixes=base.prefixes, notes=(*base.notes, f"{version}, steps of {self._step_ms} ms", *notes)
        )

    @cached_property
    def _inputs(self) -> Inputs:
        s = self.settings
        named = {key: _tuple(getattr(s, key)) for key in ("config", "net", "routes", "additional")}
        return checked_inputs(named, s.options)

    def begin(self, episode: int, seed: int) -> None:
        """Start SUMO with the episode's seed, and run it up to ``begin_s``; where episodes share one traffic,
        from its saved state."""
        self._steps, self._vehicles, self._persons = 0, {}, {}
        simulation = self._started()
        self.run.progress("start SUMO", 0.0)
        if (states := self.traffic_states(seed)) is not None:
            if not states.file(episode).exists():
                states.make(episode + 1, self._passed)
            simulation.start(states.arguments(episode))
            # Note the vehicles and persons of a saved state, in the order of their departure.
            for domain, known in (
                (simulation.api.vehicle, self._vehicles),
                (simulation.api.person, self._persons),
            ):
                names = domain.getIDList()
                if domain is simulation.api.vehicle:
                    names = sorted(names, key=lambda name: (simulation.api.vehicle.getDeparture(name), name))
                for name in names:
                    known[name] = self._kind(domain, name)
            self._begin_here(simulation)
            return
        simulation.start(self._arguments(derive_seed(seed, episode, self.run.name)))
        # Compared in milliseconds, to half a step: SUMO adds its steps up in floating point.
        target_ms = self.settings.begin_s * 1e3
        while round(simulation.api.simulation.getTime() * 1e3) + self._step_ms / 2 < target_ms:
            self._step(simulation)
            if self._steps % _REPORT_EVERY == 0:
                self.run.progress(f"fill the roads: {simulation.api.simulation.getTime():.0f} s", 0.0)
        self._begin_here(simulation)

    def _begin_here(self, simulation: Simulation) -> None:
        """Count steps from here on; nothing turns, and people are where SUMO has them."""
        self._steps, self._angles, self._trails = 0, {}, {}
        self._ways = Ways(simulation.api)
        self._commanded = []
        self._people.clear()
        self._walk(simulation)

    def step(self, frame: Frame) -> StepResult:
        """See `World.step`; the report counts what SUMO did with people that no person does.

        Args:
            frame: The frame.
        """
        self._beside_road.clear()
        made = super().step(frame)
        counts = {**made.counts, **self._people.taken_counts()}
        said = self._started().said
        counts.update({SIMULATOR_SAYS_PREFIX + text: times for text, times in said.items()})
        counts.update({BESIDE_ROAD_PREFIX + name: 1 for name in sorted(self._beside_road)})
        said.clear()
        return replace(made, counts=counts)

    def traffic_states(self, seed: int) -> TrafficStates | None:
        """The saved states of the traffic that all episodes share; None where each has its own.

        Args:
            seed: Of the run.

        Raises:
            SetupError: libsumo is not installed.
        """
        spacing = self.settings.between_episodes_s
        if spacing is None:
            return None
        version = self._started().api.getVersion()[1]
        options = self._options(derive_seed(seed, 0, self.run.name))
        return TrafficStates(self._files(), options, version, self.settings.begin_s, spacing)

    def _passed(self, now_s: float, end_s: float) -> None:
        self.run.progress(f"one traffic for all episodes: {now_s:.0f} of {end_s:.0f} s", 0.0)

    def objects_at(self, elapsed_ns: int) -> Iterable[ObjectState]:
        """Vehicles, then persons, each in the order of their departure."""
        simulation = self._started()
        steps, rest = divmod(elapsed_ns, self._step_ms * _NS_PER_MS)
        if rest:
            raise RunError(
                f"world {self.run.name!r} was granted t = {elapsed_ns} ns, no multiple of its step of "
                f"{self._step_ms} ms; choose step_ms so that it divides all instants"
            )
        if steps < self._steps:
            raise RunError(f"world {self.run.name!r} was granted t = {elapsed_ns} ns after a later instant")
        while self._steps < steps:
            self._step(simulation)
            self._walk(simulation)
        return self._objects()

    def _objects(self) -> list[ObjectState]:
        """As they are now."""
        simulation = self._started()
        return [
            *self._vehicle_states(simulation.api.vehicle, simulation.api),
            *self._person_states(simulation.api.person),
        ]

    def checkpoint(self) -> bytes:
        """State: how far it went, and where that led."""
        state = _State(
            steps=self._steps,
            arrived=self._mounts.arrived,
            traffic=self._traffic(),
            commanded=tuple(self._commanded),
        )
        return saved(self, 1, state)

    def restore(self, state: bytes) -> None:
        """Go the same way again, in steps as small as before and with the same commands.

        Raises `RunError` where it led elsewhere: files or SUMO have changed.
        """
        was = restored(self, 1, _State, state)
        simulation = self._started()
        self._commanded = list(was.commanded)
        commanded = {entry.step: entry.commands for entry in was.commanded}
        while self._steps < was.steps:
            carry_out(simulation.api, commanded.get(self._steps, ()), self._prefix)
            self._step(simulation)
            self._walk(simulation)
            if self._steps % _REPORT_EVERY == 0:
                self.run.progress(f"the same traffic again: step {self._steps} of {was.steps}", 0.0)
        if self._traffic() != was.traffic:
            raise RunError(
                f"world {self.run.name!r} has other traffic {was.steps} steps after frame 0 than it had "
                "before it was started again: its files, or SUMO, have changed; start the run again"
            )
        self._people.taken_counts()  # of frames that were reported
        simulation.said.clear()
        # Which objects came first follows from all frames before, which are not computed again.
        self._mounts.clear(was.arrived)

    def _traffic(self) -> str:
        """Digest of all objects as they are."""
        found = hashlib.sha256()
        for state in self._objects():
            found.update(repr(state).encode())
        return found.hexdigest()

    def close(self) -> None:
        """End SUMO."""
        if self._simulation is not None:
            self._simulation.close()

    def _started(self) -> Simulation:
        if self._simulation is None:
            self._simulation = Simulation(load_libsumo())
        return self._simulation

    def _arguments(self, seed: int) -> list[str]:
        files = (word for option, names in self._files().items() for word in (option, ",".join(names)))
        return [*files, *self._options(seed)]

    def _files(self) -> Mapping[str, Sequence[str]]:
        return self._inputs.files

    def _options(self, seed: int) -> list[str]:
        quiet = ["--no-step-log", "--duration-log.disable"]
        step = ["--step-length", f"{self._step_ms / 1000:.3f}", "--seed", str(seed)]
        return [*quiet, *step, *self.settings.options, *self._inputs.switched_off]

    def _step(self, simulation: Simulation) -> None:
        api = simulation.api
        # Before the step: SUMO has no yaw rate, so it is the difference of two angles.
        self._angles = {name: api.vehicle.getAngle(name) for name in api.vehicle.getIDList()}
        simulation.step()
        self._steps += 1
        # Type and size once, when an object departs: SUMO does not change them on the way.
        for name in api.simulation.getDepartedIDList():
            self._vehicles[name] = self._kind(api.vehicle, name)
        for name in api.simulation.getDepartedPersonIDList():
            self._persons[name] = self._kind(api.person, name)

    def _kind(self, domain: Any, name: str) -> _Kind:
        class_ = object_class(domain.getTypeID(name), domain.getVehicleClass(name), self.settings.classes)
        length, width, height = domain.getLength(name), domain.getWidth(name), domain.getHeight(name)
        base_type, vehicle_class = domain.getTypeID(name).partition("@")[0], domain.getVehicleClass(name)
        chosen = {**LENGTHS_M, **self.settings.carriages}
        count = carriage_count(length, chosen.get(base_type, chosen.get(vehicle_class, 0.0)))
        return _Kind(class_, (length / count, width, height), count)

    def _walk(self, simulation: Simulation) -> None:
        """Let people walk after the places where SUMO has them now."""
        persons, seen = simulation.api.person, []
        for name in persons.getIDList():
            place = persons.getPosition3D(name)
            if persons.getVehicle(name) or place[0] == simulation.api.INVALID_DOUBLE_VALUE:
                continue
            # `yaw = 90° − angle`, within SUMO's own axes.
            yaw = heading(persons.getAngle(name), 0.0, Placement()).yaw
            self._people.step(name, place, yaw, persons.getSpeed(name))
            seen.append(name)
        self._people.keep(seen)

    def _vehicle_states(self, domain: Any, api: Any) -> Iterator[ObjectState]:
        present = _present(self._vehicles, domain.getIDList())
        for name in self._trails.keys() - self._vehicles.keys():
            del self._trails[name]
        for name, (class_, dimensions, count) in present:
            bumper = domain.getPosition3D(name)
            if bumper[0] == api.INVALID_DOUBLE_VALUE:  # on its way elsewhere, by no road
                continue
            if count > 1:
                yield from self._carriages(name, class_, dimensions, count)
                continue
            angle = domain.getAngle(name)
            towards = heading(angle, domain.getSlope(name), self._placement)
            speed = domain.getSpeed(name)
            pose = body_pose(bumper, towards, dimensions[0], dimensions[2], self._placement)
            if dimensions[0] > _LONG_M:
                # Note a long vehicle whose rear is beside the way that its front has gone: it is one
                # rigid box.
                length, width, _ = dimensions
                front = complex(bumper[0], bumper[1])
                rear = front - cmath.rect(length, math.radians(90.0 - angle))
                trail = self._trails.setdefault(name, [rear])
                trail.append(front)
                if distance_to_line(rear, trail) > width:
                    self._beside_road.add(self._prefix + name)
                while len(trail) > 2 and abs(trail[1] - front) > 2 * length:
                    del trail[0]
            fx, fy, fz = towards.forward
            yield ObjectState(
                name=self._prefix + name,
                class_=class_,
                position=pose.position,
                orientation=pose.orientation,
                velocity=(speed * fx, speed * fy, speed * fz),
                dimensions=dimensions,
                angular_velocity=(0.0, 0.0, self._yaw_rate(name, angle)),
            )

    def _carriages(self, name: str, class_: str, dimensions: Vector, count: int) -> Iterator[ObjectState]:
        domain, (length, _, height) = self._started().api.vehicle, dimensions
        way = self._ways.behind(name, count * length)
        placed = [in_scene(point, self._placement) for point in way]
        for number, body in enumerate(carriages(placed, count * length, count, domain.getSpeed(name))):
            dx, dy, dz = (a - b for a, b in zip(body.front, body.rear, strict=True))
            towards = Heading(math.atan2(dy, dx), math.atan2(dz, math.hypot(dx, dy)))
            pose = body_pose(body.front, towards, length, height, Placement())
            yield ObjectState(
                name=f"{self._prefix}{name}{f'/{number}' if number else ''}",
                class_="container" if number and class_ == "truck" else class_,  # a trailer has no cab
                position=pose.position,
                orientation=pose.orientation,
                velocity=body.velocity,
                dimensions=dimensions,
                angular_velocity=(0.0, 0.0, turning(body.yaw_rate)),
            )

    def _person_states(self, domain: Any) -> Iterator[ObjectState]:
        turn = self._placement.yaw
        c, s = math.cos(turn), math.sin(turn)
        for name, (class_, dimensions, _) in _present(self._persons, domain.getIDList()):
            if name not in self._people:  # rides in a vehicle
                continue
            body = self._people.body(name)
            vx, vy, vz = body.velocity
            # The middle of the body is where SUMO has the person: a length of 0 has no front. Models of
            # pedestrians do not agree on whether it is the front, half a length of 0.2 m away.
            towards = Heading(body.yaw + turn, 0.0)
            pose = body_pose(body.position, towards, 0.0, dimensions[2], self._placement)
            yield ObjectState(
                name=self._prefix + name,
                class_=class_,
                position=pose.position,
                orientation=pose.orientation,
                velocity=(c * vx - s * vy, s * vx + c * vy, vz),
                dimensions=dimensions,
                angular_velocity=(0.0, 0.0, turning(body.yaw_rate)),
            )

    def _yaw_rate(self, vehicle: str, angle: float) -> float:
        """[rad/s] Of a vehicle whose angle [°] is this, clockwise: over the last step. One that SUMO puts
        elsewhere has none."""
        turned = math.remainder(angle - self._angles.get(vehicle, angle), 360.0)
        return turning(-math.radians(turned) * 1000.0 / self._step_ms) if abs(turned) < _JUMP_DEG else 0.0


def _present(known: dict[str, _Kind], present: Sequence[str]) -> list[tuple[str, _Kind]]:
    """Forget what has left. What is there stays in the order of departure, which `getIDList` lacks."""
    names = set(present)
    for name in [name for name in known if name not in names]:
        del known[name]
    return list(known.items())


def _tuple(files: Files) -> tuple[str, ...]:
    if isinstance(files, str):
        return (files,) if files else ()
    return files


class ActuatedSumoWorld(SumoWorld):
    """Traffic of a SUMO network that obeys `DriveCommand` and `SignalCommand`.

    Commands are carried out at the beginning of the frame after the one in which they were decided. Traffic
    lights have the names of SUMO behind the world's prefix.

    Args:
        settings: Those of the world ``sumo``.
        run: What the world knows about the run.

    Example:
        >>> world = ActuatedSumoWorld(SumoSettings(net="/maps/town.net.xml"), RunInfo(name="traffic"))
        >>> [entry.topic for entry in world.inputs]
        ['action']
    """

    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="action", lag=1, required=False),)

    def __init__(self, settings: SumoSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._alone = True
        self._knows_past = False

    def prepare(self, preparation: Preparation) -> Prepared:
        """See `SumoWorld.prepare`.

        Args:
            preparation: Who else brings scenes, among others.
        """
        self._alone = len(preparation.producers.get("scene", ())) <= 1
        return super().prepare(preparation)

    def begin(self, episode: int, seed: int) -> None:
        """See `SumoWorld.begin`.

        Args:
            episode, seed: Which.
        """
        self._knows_past = False
        super().begin(episode, seed)

    def step(self, frame: Frame) -> StepResult:
        """See `SumoWorld.step`; commands act from the state of the frame before on.

        Args:
            frame: With the actions of the frame before.

        Raises:
            PayloadError: A command is for what is not there, or has a value that is not.
            RunError: The process before this one took the commands of the episode with it.
        """
        if frame.number > 0 and not self._knows_past:
            raise RunError(
                f"world {self.run.name!r} came back in frame {frame.number}: what agents had commanded is "
                "lost with the process that knew it; have states saved (run.checkpoint_frames above 0), "
                "and start the run again"
            )
        self._knows_past = True
        actions = frame.payloads("action", Action)
        commands = traffic_commands(actions, self.run.name, self._prefix, alone=self._alone)
        if commands:
            carry_out(self._started().api, commands, self._prefix)
            self._commanded.append(Commanded(step=self._steps, commands=commands))
        return super().step(frame)

    def restore(self, state: bytes) -> None:
        """See `SumoWorld.restore`.

        Args:
            state: Of `checkpoint`, with all commands of the episode.
        """
        super().restore(state)
        self._knows_past = True
