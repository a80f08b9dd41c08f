"""A vehicle that flies as in the world ``flight``, frames of it, and a bridge between them and calls."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from caviar_bridges.airsim.bridge import Bridge, Snapshot
from caviar_bridges.airsim.calls import Offer, StateCalls
from caviar_bridges.airsim.motion_calls import Habits, MotionCalls
from caviar_bridges.airsim.sensor_calls import SensorCalls
from caviar_bridges.manoeuvres import Flown
from caviar_protocol.space.coordinates import Vector, quaternion_from_euler
from caviar_protocol.topics import CameraDevice, LidarDevice, Scene, VelocityCommand, WaypointCommand
from caviar_services.world.flight_dynamics import Flyer, Limits, Motion, motion_of

PERIOD_NS = 100_000_000
START: Vector = (35.0, 75.0, 1.5)


class Body:
    """One object that obeys commands within limits of speed and acceleration."""

    def __init__(self, name: str = "uav", start: Vector = START, yaw: float = math.pi / 2) -> None:
        self.name = name
        low, high = (-200.0, -200.0, start[2]), (200.0, 200.0, 100.0)
        self.flyer = Flyer(Limits(speed=15.0, acceleration=5.0, clearance=1.0, low=low, high=high))
        self.flyer.reset(start, yaw)

    def move(self, commands: Sequence[object], length_ns: int = PERIOD_NS) -> None:
        """Obey the command for this object, if any, for a time."""
        motion: Motion | None = None
        for command in commands:
            if isinstance(command, WaypointCommand) and command.object == self.name:
                if command.at_once:
                    assert command.yaw is not None
                    self.flyer.reset(command.position, command.yaw)
                motion = motion_of("pilot", command)
            if isinstance(command, VelocityCommand) and command.object == self.name:
                motion = motion_of("pilot", command)
        self.flyer.fly(motion, length_ns)

    def flown(self, t_ns: int) -> Flown:
        """Where it is."""
        state = self.flyer.state
        return Flown(t_ns, state.position, state.velocity, state.yaw)


def scene(*bodies: Body, cars: Mapping[str, Vector] | None = None) -> Scene:
    """The bodies, parked cars, and a camera and a LIDAR on the first body."""
    rows = [
        (
            body.name,
            "uav",
            body.flyer.state.position,
            body.flyer.state.yaw,
            body.flyer.state.velocity,
            (0.6, 0.6, 0.25),
        )
        for body in bodies
    ] + [(name, "car", place, 0.3, (0.0, 0.0, 0.0), (4.5, 1.8, 1.5)) for name, place in (cars or {}).items()]
    rows.sort()
    first = bodies[0].name
    return Scene(
        names=tuple(row[0] for row in rows),
        classes=tuple(row[1] for row in rows),
        assets=("",) * len(rows),
        position=np.array([row[2] for row in rows]),
        orientation=np.array([quaternion_from_euler(row[3]) for row in rows]),
        velocity=np.array([row[4] for row in rows]),
        dimensions=np.array([row[5] for row in rows]),
        devices=(
            CameraDevice(name=f"{first}/front", parent=first, width=4, height=3),
            LidarDevice(name=f"{first}/lidar", parent=first),
        ),
    )


class Flight:
    """A run in miniature: frame by frame the bridge decides, and the bodies move.

    Args:
        bodies: What is flown; each is the vehicle of its name.
        cars: Positions of cars in frame 0, by name.
        drives: Their velocity [m/s].
        walls: Triangles of the scenery.
        products: Further fields of each snapshot.
    """

    def __init__(
        self,
        *bodies: Body,
        cars: Mapping[str, Vector] | None = None,
        paused: bool = False,
        drives: Vector = (0.0, 0.0, 0.0),
        walls: np.ndarray | None = None,
        **products: Any,
    ) -> None:
        self.bodies = bodies or (Body(),)
        self.bridge = Bridge({body.name: body.name for body in self.bodies}, paused=paused)
        further = {"front_center": "uav/front"}
        sensors = SensorCalls(
            self.bridge, further, load_scenery=lambda: np.zeros((0, 3, 3)) if walls is None else walls
        )
        motion = MotionCalls(self.bridge, Habits())
        self.offer = Offer({**StateCalls(self.bridge).offered(), **sensors.offered(), **motion.offered()})
        self.cars, self.drives, self.products = cars or {}, drives, products
        self.frame, self.ended = 0, False
        self.log: list[Sequence[object]] = []

    async def call(self, method: str, *params: object) -> Any:
        """A call of a client."""
        return await self.offer.handle(method, params)

    async def step(self) -> None:
        """One frame."""
        seconds = self.frame * PERIOD_NS / 1e9
        shift = [seconds * speed for speed in self.drives]
        cars = {name: (x + shift[0], y + shift[1], z + shift[2]) for name, (x, y, z) in self.cars.items()}
        seen = scene(*self.bodies, cars=cars)
        shot = Snapshot(self.frame, self.frame * PERIOD_NS, seen, **self.products)
        commands, self.ended = await self.bridge.decide(shot)
        self.log.append(commands)
        for body in self.bodies:
            body.move(commands)
        self.frame += 1
        await asyncio.sleep(0)  # what waits for this frame goes on

    async def run(self, frames: int = 10_000) -> None:
        """Frames until it is cancelled."""
        for _ in range(frames):
            await self.step()

    async def during(self, *calls: tuple[object, ...]) -> list[Any]:
        """Results of calls, one after the other, while frames go by."""
        running = asyncio.ensure_future(self.run())
        try:
            return [await self.call(*call) for call in calls]  # type: ignore[arg-type]
        finally:
            running.cancel()

    async def ready(self) -> None:
        """Show the first frame, take over all vehicles, and arm them."""
        await self.step()
        for body in self.bodies:
            await self.call("enableApiControl", True, body.name)
            await self.call("armDisarm", True, body.name)
