"""The run as AirSim's calls see it: the newest frame, the vehicles, and the gate that lets frames go by.

All of it lives in one event loop, in which calls and frames come one after the other: nothing is locked.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from caviar_bridges.airsim.images import Products
from caviar_bridges.airsim.rpc import CallError
from caviar_bridges.airsim.wire import NedFrame
from caviar_bridges.manoeuvres import Command, Flown, Hover, Manoeuvre
from caviar_protocol.space.coordinates import Pose, Vector, euler_from_quaternion
from caviar_protocol.space.scene import object_pose
from caviar_protocol.topics import Lidar, Scene, WaypointCommand

OVER = "the run is over"


@dataclass(frozen=True)
class Snapshot:
    """Scene and products of one frame."""

    frame: int
    t_ns: int
    scene: Scene
    lidars: tuple[Lidar, ...] = ()
    images: Products = field(default_factory=dict)
    is_last_episode: bool = True


class FrameGate:
    """Lets frames go by, or holds them: the world waits for the commands of the frame that is held."""

    def __init__(self, *, paused: bool = False) -> None:
        self.paused = paused
        """Whether the next frame is held, once no more may go by."""
        self.held = asyncio.Event()
        """Set while a frame is held."""
        self._frames = 0
        self._until_ns: int | None = None
        self._changed = asyncio.Event()
        self._continued: asyncio.Future[None] | None = None

    @property
    def is_open(self) -> bool:
        """Tell whether frames go by, if only a few more."""
        return not self.paused or self._frames > 0 or self._until_ns is not None

    def pause(self) -> None:
        """Hold the next frame."""
        self.paused, self._frames, self._until_ns = True, 0, None
        self._end_continuing()

    def resume(self) -> None:
        """Let all frames go by."""
        self.paused, self._frames, self._until_ns = False, 0, None
        self._end_continuing()
        self._changed.set()

    def let(self, frames: int = 0, until_ns: int | None = None) -> asyncio.Future[None]:
        """Let frames go by, then pause.

        Args:
            frames: How many.
            until_ns: Or up to the first one at this simulated time [ns], or after it.

        Returns:
            Done when the gate is paused again.
        """
        self._end_continuing()
        self.paused, self._frames, self._until_ns = True, frames, until_ns
        self._continued = asyncio.get_running_loop().create_future()
        self._changed.set()
        return self._continued

    async def pass_frame(self, t_ns: int) -> None:
        """Wait until a frame may go by.

        Args:
            t_ns: Its simulated time [ns].
        """
        while not self._admits(t_ns):
            self._changed.clear()
            self.held.set()
            self._end_continuing()
            await self._changed.wait()
        self.held.clear()

    def _admits(self, t_ns: int) -> bool:
        if not self.paused:
            return True
        if self._until_ns is not None and t_ns >= self._until_ns:
            self._until_ns = None
        if self._until_ns is None and not self._frames:
            return False
        self._frames = max(0, self._frames - 1)
        return True

    def _end_continuing(self) -> None:
        continued, self._continued = self._continued, None
        if continued is not None and not continued.done():
            continued.set_result(None)


class Vehicle:
    """One vehicle: an object of the run that AirSim's clients fly.

    Args:
        name: What clients call it.
        object_name: Name of the object.
    """

    def __init__(self, name: str, object_name: str) -> None:
        self.name, self.object = name, object_name
        self.api_enabled, self.armed, self.landed = False, False, True
        self.home: Vector | None = None
        """Where it was in the first frame [m]."""
        self.home_yaw = 0.0
        """And how it headed [rad]."""
        self.flown: Flown | None = None
        """In the newest frame; None: it is not in the scene."""
        self.acceleration: Vector = (0.0, 0.0, 0.0)
        """Mean since the frame before [m/s²]."""
        self._place: tuple[Vector, float] | None = None
        self._placed: asyncio.Future[None] | None = None
        self._manoeuvre: Manoeuvre = Hover(object_name)
        self._done: asyncio.Future[bool] | None = None

    def begin(self, manoeuvre: Manoeuvre) -> asyncio.Future[bool]:
        """Fly a manoeuvre, in place of the one under way, whose call returns False.

        Returns:
            Its result, once it is done.
        """
        self._finish(result=False)
        self._manoeuvre = manoeuvre
        self._done = asyncio.get_running_loop().create_future()
        return self._done

    def put(self, position: Vector, yaw: float) -> asyncio.Future[None]:
        """Put the vehicle at a position [m] with a yaw [rad], at rest, in the frame after the next command.

        Returns:
            Done once a frame shows it there.
        """
        self.begin(Hover(self.object))
        self._place, self._placed = (position, yaw), asyncio.get_running_loop().create_future()
        return self._placed

    def reset(self) -> None:
        """Take back all that calls have changed."""
        self.begin(Hover(self.object))
        self.api_enabled, self.armed, self.landed = False, False, True
        self._place = None

    def see(self, snapshot: Snapshot) -> None:
        """Note the position of the vehicle in a frame."""
        before, scene = self.flown, snapshot.scene
        if self._place is None and self._placed is not None:
            if not self._placed.done():
                self._placed.set_result(None)
            self._placed = None
        if self.object not in scene.names:
            self.flown = None
            return
        index = scene.names.index(self.object)
        pose = object_pose(scene, index)
        x, y, z = scene.velocity[index].tolist()
        yaw = euler_from_quaternion(pose.orientation)[0]
        self.flown = Flown(snapshot.t_ns, pose.position, (x, y, z), yaw)
        if self.home is None:
            self.home, self.home_yaw = pose.position, yaw
        self.acceleration = (0.0, 0.0, 0.0)
        if before is not None and before.t_ns < snapshot.t_ns:
            seconds = (snapshot.t_ns - before.t_ns) / 1e9
            a, b, c = ((v - u) / seconds for u, v in zip(before.velocity, self.flown.velocity, strict=True))
            self.acceleration = (a, b, c)
        # Before the frame is held: a client that steps the world may wait for what this frame completes.
        self._manoeuvre.look(self.flown)
        if self._manoeuvre.result is not None:
            self._finish(self._manoeuvre.result)

    def command(self) -> Command | None:
        """Command for the newest frame; None while the vehicle is not in the scene."""
        if self.flown is None:
            return None
        if self._place is not None:
            (place, yaw), self._place = self._place, None
            return WaypointCommand(object=self.object, position=place, speed=1.0, at_once=True, yaw=yaw)
        return self._manoeuvre.fly(self.flown)

    def _finish(self, result: bool) -> None:
        done, self._done = self._done, None
        if done is not None and not done.done():
            done.set_result(result)


class Bridge:
    """State that calls and frames share.

    Args:
        vehicles: Object of each vehicle, by the name that clients use; the first one is meant where a call
            names none.
        origin: Of NED [m]; None: where the first vehicle is in the first frame.
        geo_origin: Latitude [°], longitude [°] and altitude [m] there.
        paused: Whether the first frame is held until a client lets it go.
    """

    def __init__(
        self,
        vehicles: Mapping[str, str],
        origin: Vector | None = None,
        geo_origin: Vector = (0.0, 0.0, 0.0),
        *,
        paused: bool = False,
    ) -> None:
        self.gate = FrameGate(paused=paused)
        self.vehicles = {name: Vehicle(name, thing) for name, thing in vehicles.items()}
        self.ending = False
        """Whether the episode is to end with the newest frame."""
        self._origin, self._geo_origin = origin, geo_origin
        self._snapshot: Snapshot | None = None
        self._came = asyncio.Event()
        self._begun = asyncio.Event()

    # --- frames ---------------------------------------------------------------------------------------

    async def decide(self, snapshot: Snapshot) -> tuple[list[Command], bool]:
        """Show a frame, hold it where the gate is closed, then command.

        Args:
            snapshot: The frame.

        Returns:
            Commands for the vehicles, sorted by object, and whether the episode ends.
        """
        self._snapshot = snapshot
        for vehicle in self.vehicles.values():
            vehicle.see(snapshot)
        if self._origin is None:
            self._origin = next((v.home for v in self.vehicles.values() if v.home is not None), None)
        self._came.set()
        self._came = asyncio.Event()
        await self.gate.pass_frame(snapshot.t_ns)
        commands = [command for v in self.vehicles.values() if (command := v.command()) is not None]
        ending, self.ending = self.ending, False
        return sorted(commands, key=lambda command: command.object), ending

    def begin_episode(self) -> None:
        """Forget the state of the episode before."""
        if self._snapshot is None:  # before the first one: a script may have taken over a vehicle already
            return
        self._snapshot, self.ending = None, False
        for vehicle in self.vehicles.values():
            vehicle.reset()
            vehicle.home, vehicle.flown = None, None
        self._begun.set()
        self._begun = asyncio.Event()

    # --- what calls ask -------------------------------------------------------------------------------

    async def newest(self) -> Snapshot:
        """The newest frame; the first one is waited for."""
        while self._snapshot is None:
            await self._came.wait()
        return self._snapshot

    async def next_episode(self) -> None:
        """End the episode, and wait for the first frame of the next one."""
        self.ending = True
        await self._begun.wait()
        await self.newest()

    async def ned(self) -> NedFrame:
        """The axes of clients.

        Raises:
            CallError: No vehicle has been in the scene yet.
        """
        await self.newest()
        if self._origin is None:
            names = ", ".join(repr(vehicle.object) for vehicle in self.vehicles.values())
            raise CallError(f"no world of the run has an object {names}, so that there is no origin")
        return NedFrame(self._origin, self._geo_origin)

    def vehicle(self, name: str) -> Vehicle:
        """The vehicle of a name; an empty one means the first.

        Raises:
            CallError: There is none.
        """
        if not name:
            return next(iter(self.vehicles.values()))
        if name not in self.vehicles:
            raise CallError(f"there is no vehicle {name!r:.80}; there are: {', '.join(self.vehicles)}")
        return self.vehicles[name]

    async def flown(self, name: str) -> tuple[Vehicle, Flown]:
        """A vehicle, and where it is in the newest frame.

        Raises:
            CallError: There is none, or it is not in the scene.
        """
        vehicle = self.vehicle(name)
        await self.newest()
        if vehicle.flown is None:
            raise CallError(f"object {vehicle.object!r} of vehicle {vehicle.name!r} is not in the scene")
        return vehicle, vehicle.flown

    async def pose_of(self, name: str) -> Pose | None:
        """Pose in ENU of an object, or of a vehicle by the name that clients use; None: there is none."""
        scene = (await self.newest()).scene
        found = self.vehicles[name].object if name in self.vehicles else name
        return object_pose(scene, scene.names.index(found)) if found in scene.names else None


def boxes_overlap(scene: Scene, first: int, second: int) -> bool:
    """Tell whether the boxes of two objects overlap.

    Args:
        scene: The scene.
        first, second: Indices of the objects.
    """
    # Upright boxes, as objects turn about the vertical alone: the axes that can separate them are the
    # vertical and the four horizontal ones of both boxes.
    apart = [b - a for a, b in zip(*(scene.position[i].tolist() for i in (first, second)), strict=True)]
    sizes = [scene.dimensions[i].tolist() for i in (first, second)]
    if abs(apart[2]) > (sizes[0][2] + sizes[1][2]) / 2:
        return False
    yaws = [euler_from_quaternion(scene.orientation[i].tolist())[0] for i in (first, second)]
    for axis in (yaw + turn for yaw in yaws for turn in (0.0, math.pi / 2)):
        reach = sum(
            (length * abs(math.cos(axis - yaw)) + width * abs(math.sin(axis - yaw))) / 2
            for yaw, (length, width, _) in zip(yaws, sizes, strict=True)
        )
        if abs(apart[0] * math.cos(axis) + apart[1] * math.sin(axis)) > reach:
            return False
    return True
