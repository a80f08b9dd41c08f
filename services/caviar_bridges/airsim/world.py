"""World ``airsim``: objects and vehicles of a simulator that serves AirSim's RPC, stepped by the run.

The simulator is paused; each frame lets it go on by the time of the frame, and reads where things are.
Scenery, sensors and channel are those of the run: the scenario names the scenery that fits the simulator's
level.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar

import msgspec

from caviar_bridges.airsim.rpc import HOST, PORT, CallError, RpcClient, address_of
from caviar_bridges.airsim.wire import NOWHERE, NedFrame, vector, vector_map
from caviar_protocol.arrays import quantity
from caviar_protocol.errors import PayloadError, RunError, ScenarioError, suggestion
from caviar_protocol.messages import Input
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.coordinates import Pose, Vector
from caviar_protocol.topics import Action, VelocityCommand, WaypointCommand
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, StepResult
from caviar_services.world.base import ObjectState, World, WorldSettings
from caviar_services.world.trajectory import NamedObject, unique_name
from caviar_space.engine_axes import NED, Motion

FOREVER_S = 3e38
"""[s] of AirSim's calls without a time limit."""
NO_TURN: dict[str, object] = {"is_rate": True, "yaw_or_rate": 0.0}
"""AirSim's ``YawMode`` that leaves the yaw to the vehicle."""


class AirSimObject(NamedObject, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An object of the simulator."""

    airsim: str = ""
    """What it is called there; empty: as here."""


class AirSimWorldSettings(WorldSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the world ``airsim``."""

    address: str = f"{HOST}:{PORT}"
    """``HOST:PORT`` of the simulator."""
    vehicles: tuple[AirSimObject, ...] = ()
    """Multirotors, which agents fly."""
    objects: tuple[AirSimObject, ...] = ()
    """Other objects, which move as the simulator has it."""
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the simulator's origin is in the axes of the run."""
    timeout_s: Annotated[float, quantity("s", "wall time of a call at most", gt=0, le=3600)] = 60.0


class AirSimWorld(World[AirSimWorldSettings]):
    """Steps a simulator, and publishes its vehicles and objects.

    What it is at after an episode lies in the simulator: a world that is started again ends the run.

    Args:
        settings: Address, vehicles and objects.
        run: What the world knows about the run.

    Raises:
        ScenarioError: Two objects have one name; names the key.

    Example:
        >>> settings = AirSimWorldSettings(vehicles=(AirSimObject(name="uav", airsim="Drone1"),))
        >>> AirSimWorld(settings, RunInfo(name="world")).prefixes()
        ('uav',)
    """

    Settings: ClassVar[type[msgspec.Struct]] = AirSimWorldSettings
    inputs: ClassVar[tuple[Input, ...]] = (Input(topic="action", lag=1, required=False),)

    @classmethod
    def check_settings(cls, settings: AirSimWorldSettings, place: Place) -> None:
        """Refuse an address that is none."""
        super().check_settings(settings, place)
        try:
            address_of(settings.address)
        except ValueError as error:
            raise place.at("address").error(str(error)) from error

    @classmethod
    def known_objects(cls, settings: AirSimWorldSettings) -> Mapping[str, str] | None:
        """Vehicles and objects."""
        things = (*settings.vehicles, *settings.objects)
        return {(settings.prefix or "") + thing.name: thing.kind for thing in things}

    def __init__(self, settings: AirSimWorldSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._ned = NedFrame(settings.origin_m)
        self._client: RpcClient | None = None
        self._vehicles: dict[str, AirSimObject] = {}
        self._objects: dict[str, AirSimObject] = {}
        for kind, found in (("vehicles", self._vehicles), ("objects", self._objects)):
            for index, thing in enumerate(getattr(settings, kind)):
                key = f"services.{run.name}.settings.{kind}[{index}]"
                found[unique_name(settings, thing, {*self._vehicles, *self._objects}, key)] = thing
        self._elapsed_ns = 0
        self._places: dict[str, tuple[int, Vector]] = {}
        self._commanded: dict[str, object] = {}
        self._begun = False
        self._alone = True

    def prefixes(self) -> tuple[str, ...]:
        """Names of all vehicles and objects."""
        return (*self._vehicles, *self._objects)

    def mesh_classes(self) -> tuple[str, ...]:
        """No classes: all objects are boxes."""
        return ()

    def prepare(self, preparation: Preparation) -> Prepared:
        """Connect to the simulator.

        Raises:
            RunError: It is not there.
        """
        self._alone = len(preparation.producers.get("scene", ())) <= 1
        host, port = address_of(self.settings.address)
        self._client = RpcClient(host, port, self.settings.timeout_s)
        self._call("ping")
        return super().prepare(preparation)

    def begin(self, episode: int, seed: int) -> None:
        """Reset the simulator, pause it, and take over the vehicles.

        Raises:
            ScenarioError: It has no object of a name; names the key.
        """
        self._call("simPause", True)
        self._call("reset")
        self._call("simPause", True)
        self._elapsed_ns, self._begun = 0, False
        self._places, self._commanded = {}, {}
        known = self._call("simListSceneObjects", ".*")
        for index, thing in enumerate(self.settings.objects):
            if _name(thing) not in known:
                raise ScenarioError(
                    f"the simulator at {self.settings.address} has no object {_name(thing)!r}; "
                    f"{suggestion(_name(thing), known)}",
                    key=f"services.{self.run.name}.settings.objects[{index}].airsim",
                )
        for thing in self._vehicles.values():
            self._call("enableApiControl", True, _name(thing))
            self._call("armDisarm", True, _name(thing))

    def step(self, frame: Frame) -> StepResult:
        """Pass commands on, let the simulator go on to the frame's instant, and read the scene.

        Raises:
            PayloadError: A command is for no object of this world.
            RunError: The simulator does not answer; or this world was started again within an episode.
        """
        if frame.number > 0 and not self._begun:
            raise RunError(
                f"world {self.run.name!r} came back in frame {frame.number}: what the simulator was at is "
                "not known any more; start the run again"
            )
        self._begun = True
        for agent, action in frame.payloads("action", Action).items():
            for command in action.commands:
                if isinstance(command, VelocityCommand | WaypointCommand):
                    self._command(agent, command)
        return super().step(frame)

    def objects_at(self, elapsed_ns: int) -> Iterable[ObjectState]:
        """Vehicles with the velocities that the simulator has, and objects with those of their positions."""
        if elapsed_ns > self._elapsed_ns:
            self._call("simContinueForTime", (elapsed_ns - self._elapsed_ns) / 1e9)
        self._elapsed_ns = elapsed_ns
        for name, thing in self._vehicles.items():
            moving = self._call("getMultirotorState", _name(thing))["kinematics_estimated"]
            velocity, turning = (_vector(moving, key) for key in ("linear_velocity", "angular_velocity"))
            found = NED.motion_to_enu(Motion(velocity, turning))
            yield _state(name, thing, self._pose(moving), found.velocity, found.angular_velocity[2])
        for name, thing in self._objects.items():
            pose = self._pose(self._call("simGetObjectPose", _name(thing)))
            yield _state(name, thing, pose, self._velocity(name, elapsed_ns, pose.position))

    def close(self) -> None:
        """Let the simulator go on by itself, and hang up."""
        client, self._client = self._client, None
        if client is not None:
            try:
                if self._begun:
                    client.call("simPause", False)
            except RunError:
                pass  # it has ended before the run did, which is nothing to end a run with
            finally:
                client.close()

    def _velocity(self, name: str, elapsed_ns: int, position: Vector) -> Vector:
        """Mean since the frame before [m/s]; 0 in the first."""
        before_ns, before = self._places.get(name, (elapsed_ns, position))
        self._places[name] = elapsed_ns, position
        if before_ns == elapsed_ns:
            return (0.0, 0.0, 0.0)
        seconds = (elapsed_ns - before_ns) / 1e9
        x, y, z = ((new - old) / seconds for old, new in zip(before, position, strict=True))
        return (x, y, z)

    def _command(self, agent: str, command: VelocityCommand | WaypointCommand) -> None:
        thing = self._vehicles.get(command.object)
        if thing is None:
            if self._alone:
                known = ", ".join(map(repr, self._vehicles)) or "none"
                raise PayloadError(
                    f"agent {agent!r} commands the motion of {command.object!r}, which world "
                    f"{self.run.name!r} does not fly; it flies {known}"
                )
            return
        # Each call replaces the one before: an equal command goes on as it is, but for a velocity, which has
        # a time.
        same = self._commanded.get(command.object) == command
        self._commanded[command.object] = command
        if isinstance(command, VelocityCommand):
            # Longer than the frame, or the vehicle would brake before the next command comes.
            duration_s = 2 * self.run.sampling_period_ns / 1e9
            velocity = self._ned.velocity(command.velocity)
            self._begin("moveByVelocity", *velocity, duration_s, 0, NO_TURN, _name(thing))
        elif command.at_once:
            # An orientation that is not a number stays as it is.
            pose = {**NOWHERE, "position": vector_map(self._ned.point(command.position))}
            self._call("simSetVehiclePose", pose, True, _name(thing))
        elif not same:
            point = self._ned.point(command.position)
            rest = (command.speed, FOREVER_S, 0, NO_TURN, -1, 1, _name(thing))
            self._begin("moveToPosition", *point, *rest)

    def _pose(self, pose: Mapping[str, Any]) -> Pose:
        try:
            return self._ned.pose_to_enu(pose)
        except CallError as error:
            raise RunError(f"the simulator at {self.settings.address} sent no pose: {error}") from error

    def _call(self, method: str, *params: object) -> Any:
        return self._connected.call(method, *params)

    def _begin(self, method: str, *params: object) -> None:
        self._connected.begin(method, *params)

    @property
    def _connected(self) -> RpcClient:
        if self._client is None:
            raise RunError(f"world {self.run.name!r} is not connected to {self.settings.address}")
        return self._client


def _name(thing: AirSimObject) -> str:
    return thing.airsim or thing.name


def _vector(parts: Mapping[str, Any], key: str) -> Vector:
    try:
        return vector(parts.get(key), key)
    except CallError as error:
        raise RunError(f"the simulator sent no motion: {error}") from error


def _state(
    name: str, thing: AirSimObject, pose: Pose, velocity: Vector, yaw_rate: float = 0.0
) -> ObjectState:
    return ObjectState(
        name=name,
        class_=thing.kind,
        position=pose.position,
        orientation=pose.orientation,
        velocity=velocity,
        dimensions=thing.dimensions_m,
        angular_velocity=(0.0, 0.0, yaw_rate),
    )
