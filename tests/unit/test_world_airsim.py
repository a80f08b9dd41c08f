"""The world that steps a simulator over AirSim's RPC, against the bridge: no other simulator was at hand."""

from __future__ import annotations

import asyncio
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from airsim_harness import PERIOD_NS, START, Body, Flight
from link_builders import choices

from caviar_bridges.airsim.rpc import RpcServer
from caviar_bridges.airsim.world import AirSimObject, AirSimWorld, AirSimWorldSettings
from caviar_protocol.errors import PayloadError, RunError, ScenarioError
from caviar_protocol.space.coordinates import Vector
from caviar_protocol.topics import Scene, VelocityCommand, WaypointCommand
from caviar_services.service import Frame, Preparation, RunInfo
from caviar_services.testing import WorldConformance

CAR: Vector = (40.0, 90.0, 0.75)


@contextmanager
def simulated(drives: Vector = (0.0, 0.0, 0.0)) -> Iterator[int]:
    """A simulator in a thread, with a vehicle and a car that drives, and the port that it listens on."""
    loop, over = asyncio.new_event_loop(), asyncio.Event()
    ready = threading.Event()
    found: list[int] = []

    async def simulate() -> None:
        flight = Flight(Body(), cars={"Car_5": CAR}, drives=drives)
        server = RpcServer(flight.offer.handle, port=0)
        await server.start()
        found.append(server.port)
        ready.set()
        frames = asyncio.ensure_future(flight.run(10**9))
        await over.wait()
        frames.cancel()
        await server.close("the simulator has ended")

    thread = threading.Thread(target=lambda: loop.run_until_complete(simulate()))
    thread.start()
    assert ready.wait(10)
    try:
        yield found[0]
    finally:
        loop.call_soon_threadsafe(over.set)
        thread.join(10)
        loop.close()


def settings(port: int, **values: Any) -> AirSimWorldSettings:
    given: dict[str, Any] = {
        "vehicles": (AirSimObject(name="drone", airsim="uav"),),
        "objects": (AirSimObject(name="car.1", airsim="Car_5", kind="car", dimensions_m=(4.5, 1.8, 1.5)),),
        "origin_m": START,
    }
    return AirSimWorldSettings(address=f"127.0.0.1:{port}", **(given | values))


@contextmanager
def begun(port: int, **values: Any) -> Iterator[AirSimWorld]:
    world = AirSimWorld(settings(port, **values), RunInfo(name="world", sampling_period_ns=2 * PERIOD_NS))
    try:
        world.prepare(Preparation(demand={}, producers={"scene": ("world",)}))
        world.reset(0, 1, 0)
        yield world
    finally:
        world.close()


def scene(world: AirSimWorld, number: int, *commands: object) -> Scene:
    """The scene of a frame of 200 ms."""
    inputs = (choices("pilot", *commands),) if commands else ()
    frame = Frame(episode=0, number=number, t_ns=number * 2 * PERIOD_NS, inputs=inputs)
    found = world.step(frame).products["scene"]
    assert isinstance(found, Scene)
    return found


def test_objects_stand_where_the_simulator_has_them_and_move_as_it_moves_them() -> None:
    with simulated(drives=(3.0, -1.0, 0.0)) as port, begun(port) as world:
        first, second = scene(world, 0), scene(world, 1)
    assert first.names == ("car.1", "drone")
    assert first.classes == ("car", "uav")
    assert first.position[1] == pytest.approx(START)
    assert second.velocity[0] == pytest.approx([3.0, -1.0, 0.0])
    assert second.position[0] - first.position[0] == pytest.approx([0.6, -0.2, 0.0])
    heading = 2 * math.atan2(first.orientation[0][3], first.orientation[0][0])
    assert heading == pytest.approx(0.3)  # as the car of the harness stands


def test_commands_fly_a_vehicle_to_a_point_and_with_a_velocity() -> None:
    there = (START[0] + 4.0, START[1] + 3.0, START[2] + 5.0)
    with simulated() as port, begun(port) as world:
        for number in range(25):
            seen = scene(world, number, WaypointCommand(object="drone", position=there, speed=5.0))
        assert seen.position[1] == pytest.approx(there, abs=0.1)
        east = VelocityCommand(object="drone", velocity=(2.0, 0.0, 0.0))
        for number in range(25, 35):
            seen = scene(world, number, east)
        assert seen.velocity[1] == pytest.approx([2.0, 0.0, 0.0])
        assert seen.position[1] == pytest.approx(np.add(there, (3.6, 0.0, 0.0)), abs=0.3)
        scene(world, 35, WaypointCommand(object="drone", position=START, speed=1.0, at_once=True))
        assert scene(world, 36).position[1] == pytest.approx(START)


def test_an_object_that_the_simulator_lacks_is_named_with_the_nearest() -> None:
    with simulated() as port:
        lost = (AirSimObject(name="car.1", airsim="Car_6", kind="car"),)
        with pytest.raises(ScenarioError) as error, begun(port, objects=lost):
            pass
    assert error.value.key == "services.world.settings.objects[0].airsim"
    assert "has no object 'Car_6'; did you mean 'Car_5'?" in str(error.value)


def test_a_command_for_another_object_is_refused() -> None:
    with simulated() as port, begun(port) as world:
        scene(world, 0)
        stray = WaypointCommand(object="car.1", position=START, speed=1.0)
        with pytest.raises(PayloadError, match=r"'car\.1'.*'world'.*'drone'"):
            scene(world, 1, stray)


def test_a_simulator_that_ends_ends_the_run_with_its_address() -> None:
    with simulated() as port:
        world = AirSimWorld(settings(port), RunInfo(name="world"))
        world.prepare(Preparation(demand={}))
        world.reset(0, 1, 0)
        scene(world, 0)
    with pytest.raises(RunError, match=f"AirSim at 127.0.0.1:{port}"):
        scene(world, 1)
    world.close()


def test_a_simulator_that_is_not_there_is_named() -> None:
    with simulated() as port:
        pass
    world = AirSimWorld(settings(port), RunInfo(name="world"))
    with pytest.raises(RunError, match=f"no AirSim answers at 127.0.0.1:{port}"):
        world.prepare(Preparation(demand={}))


@pytest.fixture(scope="module", autouse=True)
def _conforming() -> Iterator[None]:
    """A simulator for the conformance tests."""
    with simulated() as port:
        TestAirSimWorld.settings = {
            "address": f"127.0.0.1:{port}",
            "vehicles": [{"name": "drone", "airsim": "uav"}],
            "objects": [{"name": "car.1", "airsim": "Car_5", "kind": "car"}],
        }
        yield


class TestAirSimWorld(WorldConformance):
    """As every world of the registry."""

    service_class = AirSimWorld
    devices = ()

    def test_another_process_goes_on_with_the_same_bytes(self, tmp_path: Path) -> None:
        """It cannot: its state is the simulator's. It says so in place of a scene."""
        with self.at_start(tmp_path) as service:
            later = self.frames_of(service, self.episodes[0], 3)[2]
            with pytest.raises(RunError, match="came back in frame 2"):
                service.step(later)
