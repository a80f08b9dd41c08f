"""Agent ``mavlink``: set-points in, telemetry out, over UDP of this machine."""

from __future__ import annotations

import contextlib
import math
import socket
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from caviar_bridges.mavlink import MavlinkAgent, MavlinkSettings
from caviar_protocol.errors import ScenarioError, SetupError
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.coordinates import quaternion_from_euler, rotated
from caviar_protocol.topics import Action, AttitudeCommand, Scene, VelocityCommand, WaypointCommand
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo, StepResult
from caviar_services.world.flight import FlightSettings, FlightWorld, FlownObject

common = pytest.importorskip("pymavlink.dialects.v20.common", reason="needs pymavlink, the extra mavlink")

PERIOD_NS = 100_000_000
POSITION_ONLY, VELOCITY_ONLY = 0b110111111000, 0b110111000111


class Peer:
    """A ground station."""

    def __init__(self, port: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(2.0)
        self.link = common.MAVLink(None, srcSystem=255, srcComponent=190)
        self._to = ("127.0.0.1", port)

    def send(self, message: Any) -> None:
        self.socket.sendto(message.pack(self.link), self._to)

    def receive(self, count: int) -> dict[str, Any]:
        """The next messages, by type."""
        found = {}
        for _ in range(count):
            for message in self.link.parse_buffer(self.socket.recv(65536)):
                found[message.get_type()] = message
        return found

    def position_target(self, mask: int, *values: float, frame: int = 1) -> Any:
        numbers = (*values, *(0.0,) * (9 - len(values)))
        return self.link.set_position_target_local_ned_encode(0, 1, 1, frame, mask, *numbers, 0.0, 0.0)


@pytest.fixture
def pilot() -> Iterator[MavlinkAgent]:
    settings = MavlinkSettings(object="uav", listen="127.0.0.1:0", origin_m=(10.0, 20.0, 5.0))
    agent = MavlinkAgent(settings, RunInfo(name="pilot"))
    agent.prepare(Preparation(demand={}))
    agent.reset(0, 1, 0)
    yield agent
    agent.close()


@pytest.fixture
def peer(pilot: MavlinkAgent) -> Iterator[Peer]:
    made = Peer(pilot.port)
    yield made
    made.socket.close()


def scene(**changes: Any) -> Scene:
    return Scene(
        names=("uav",),
        classes=("uav",),
        assets=("",),
        position=np.array([[13.0, 24.0, 35.0]]),
        orientation=np.array([quaternion_from_euler(0.4, 0.2, -0.1)]),
        velocity=np.array([[1.0, 2.0, 3.0]]),
        dimensions=np.array([[0.6, 0.6, 0.25]]),
        devices=(),
        **changes,
    )


def step(agent: MavlinkAgent, number: int = 0, seen: Scene | None = None) -> StepResult:
    entry = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=number)
    inputs = (FrameInput(entry, payload=seen or scene()),)
    return agent.step(Frame(episode=0, number=number, t_ns=number * PERIOD_NS, inputs=inputs))


def commands(agent: MavlinkAgent, number: int = 0) -> tuple[Any, ...]:
    action = step(agent, number).products["action"]
    assert isinstance(action, Action)
    return action.commands


def arrived(agent: MavlinkAgent, number: int = 0) -> tuple[tuple[Any, ...], dict[str, int]]:
    """Commands and counts of the frame in which something came: UDP takes a moment, even here."""
    until = time.monotonic() + 2.0
    while time.monotonic() < until:
        made = step(agent, number)
        if {"mavlink-setpoints", "mavlink-ignored"} & made.counts.keys():
            action = made.products["action"]
            assert isinstance(action, Action)
            return action.commands, dict(made.counts)
    raise AssertionError("nothing came")


def test_without_a_set_point_there_is_no_command(pilot: MavlinkAgent) -> None:
    assert commands(pilot) == ()


def test_a_position_in_ned_is_a_waypoint_in_enu_that_holds(pilot: MavlinkAgent, peer: Peer) -> None:
    peer.send(peer.position_target(POSITION_ONLY, 4.0, 3.0, -30.0))
    found, counts = arrived(pilot)
    assert counts == {"mavlink-setpoints": 1, "frames-without-users": 1}
    expected = WaypointCommand(object="uav", position=(13.0, 24.0, 35.0), speed=5.0)
    assert found == (expected,)
    assert commands(pilot, 1) == (expected,)
    pilot.reset(1, 1, 0)
    assert commands(pilot) == ()


def test_a_velocity_in_ned_is_one_in_enu(pilot: MavlinkAgent, peer: Peer) -> None:
    peer.send(peer.position_target(VELOCITY_ONLY, 0.0, 0.0, 0.0, 1.5, -2.0, 0.5))
    assert arrived(pilot)[0] == (VelocityCommand(object="uav", velocity=(-2.0, 1.5, -0.5)),)


def test_an_attitude_with_thrust_points_the_thrust_as_in_ned(pilot: MavlinkAgent, peer: Peer) -> None:
    """Nose north, pitched down by 0.3 rad: in NED pitch −0.3; thrust half: it has the weight."""
    quaternion = quaternion_from_euler(0.0, -0.3, 0.0)  # the formula is that of aerospace angles
    peer.send(peer.link.set_attitude_target_encode(0, 1, 1, 0b111, quaternion, 0.0, 0.0, 0.0, 0.5))
    (command,), _ = arrived(pilot)
    assert isinstance(command, AttitudeCommand)
    assert command.thrust == pytest.approx(9.80665)
    up = rotated(command.orientation, (0.0, 0.0, 1.0))
    assert up == pytest.approx((0.0, math.sin(0.3), math.cos(0.3)), abs=1e-6)  # to the north and up


@pytest.mark.parametrize("wrong", ["frame", "mask", "nan", "bytes", "command"])
def test_what_is_not_understood_is_counted_and_changes_nothing(
    pilot: MavlinkAgent, peer: Peer, wrong: str
) -> None:
    if wrong == "frame":
        peer.send(peer.position_target(POSITION_ONLY, 1.0, 1.0, 1.0, frame=8))
    elif wrong == "mask":
        peer.send(peer.position_target(0b111111, 1.0, 1.0, 1.0))
    elif wrong == "nan":
        peer.send(peer.position_target(POSITION_ONLY, math.nan, 1.0, 1.0))
    elif wrong == "command":
        peer.send(peer.link.command_long_encode(1, 1, common.MAV_CMD_NAV_RETURN_TO_LAUNCH, 0, *(0.0,) * 7))
    else:
        peer.socket.sendto(b"\xfd" + bytes(40), ("127.0.0.1", pilot.port))
    found, counts = arrived(pilot)
    assert found == ()
    assert counts["mavlink-ignored"] >= 1


class Ground:
    """A quadrotor of the world ``flight`` that stands on the ground, and the agent, frame by frame."""

    def __init__(self, pilot: MavlinkAgent, peer: Peer) -> None:
        uav = FlownObject(
            name="uav",
            start_m=(10.0, 20.0, 0.125),
            start_yaw_deg=90.0,
            dimensions_m=(0.6, 0.6, 0.25),
            max_speed_m_s=8,
            max_acceleration_m_s2=4,
            dynamics="quadrotor",
        )
        self.world = FlightWorld(FlightSettings(flown=(uav,)), RunInfo(name="world"))
        self.world.reset(0, 1, 0)
        self.pilot, self.peer, self.number, self.action = pilot, peer, 0, None
        self.newest: dict[str, Any] = {}

    def frames(self, count: int) -> Scene:
        """So many frames; the last scene."""
        for _ in range(count):
            entry = GrantInput(topic="action", source="pilot", status=Status.FRESH, frame=self.number - 1)
            inputs = (FrameInput(entry, payload=self.action),) if self.action else ()
            seen = self.world.step(
                Frame(
                    episode=0,
                    number=self.number,
                    t_ns=self.number * PERIOD_NS,
                    previous=self.number - 1,
                    inputs=inputs,
                )
            ).products["scene"]
            self.action = step(self.pilot, self.number, seen).products["action"]
            self.number += 1
            self.peer.socket.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                while True:
                    self.newest |= {
                        m.get_type(): m for m in self.peer.link.parse_buffer(self.peer.socket.recv(65536))
                    }
            self.peer.socket.settimeout(2.0)
        assert isinstance(seen, Scene)
        return seen

    def command(self, command: int, *values: float) -> int:
        """The result with which a command is acknowledged."""
        self.newest.pop("COMMAND_ACK", None)
        numbers = (*values, *(math.nan,) * (7 - len(values)))
        self.peer.send(self.peer.link.command_long_encode(1, 1, command, 0, *numbers))
        until = time.monotonic() + 2.0
        while "COMMAND_ACK" not in self.newest and time.monotonic() < until:
            self.frames(1)
        return int(self.newest["COMMAND_ACK"].result)

    @property
    def state(self) -> tuple[bool, int, int]:
        """Whether it is armed, main mode and landed state, as telemetry says in the newest frames."""
        self.frames(11)
        beat = self.newest["HEARTBEAT"]
        armed = bool(beat.base_mode & common.MAV_MODE_FLAG_SAFETY_ARMED)
        return armed, beat.custom_mode >> 16 & 0xFF, self.newest["EXTENDED_SYS_STATE"].landed_state


def test_a_vehicle_takes_off_flies_in_body_axes_and_lands_as_it_says(pilot: MavlinkAgent, peer: Peer) -> None:
    flight, accepted, denied = Ground(pilot, peer), common.MAV_RESULT_ACCEPTED, common.MAV_RESULT_DENIED
    on_ground, in_air = common.MAV_LANDED_STATE_ON_GROUND, common.MAV_LANDED_STATE_IN_AIR
    arm, land = common.MAV_CMD_COMPONENT_ARM_DISARM, common.MAV_CMD_NAV_LAND
    assert flight.command(common.MAV_CMD_NAV_TAKEOFF) == denied  # not armed
    assert flight.state == (False, 4, on_ground)
    assert flight.command(arm, 1.0) == accepted
    assert flight.command(common.MAV_CMD_NAV_TAKEOFF) == accepted
    assert flight.frames(80).position[0, 2] == pytest.approx(2.625, abs=0.2)
    assert flight.state == (True, 4, in_air)
    assert flight.command(arm, 0.0) == denied  # it flies
    before = flight.frames(1)
    # Forward at 3 m/s while the heading, which is north at first, turns to the right by 30 °/s.
    target = peer.position_target(0b010111000111, 0, 0, 0, 3.0, 0.0, 0.0, frame=8)
    target.yaw_rate = math.radians(30.0)
    peer.send(target)
    flight.frames(1)
    after = flight.frames(61)
    (x, y, _), radius = (after.position[0] - before.position[0]).tolist(), 3.0 / math.radians(30.0)
    assert (x, y) == pytest.approx((2 * radius, 0.0), abs=1.5)  # half a circle to the east, from a standstill
    assert flight.state == (True, 6, in_air)
    assert flight.command(land) == accepted
    flight.frames(60)
    assert flight.state == (True, 4, on_ground)
    assert flight.command(arm, 0.0) == accepted
    assert flight.state == (False, 4, on_ground)
    assert flight.newest["GLOBAL_POSITION_INT"].relative_alt == pytest.approx(0, abs=50)


def test_set_points_for_another_vehicle_are_not_taken(pilot: MavlinkAgent, peer: Peer) -> None:
    other = peer.position_target(POSITION_ONLY, 9.0, 9.0, 9.0)
    other.target_system = 7
    peer.send(other)
    peer.send(peer.position_target(VELOCITY_ONLY, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0))
    found, counts = arrived(pilot)
    assert found == (VelocityCommand(object="uav", velocity=(0.0, 1.0, 0.0)),)
    assert counts["mavlink-setpoints"] == 1


def test_telemetry_is_the_scene_in_ned(pilot: MavlinkAgent, peer: Peer) -> None:
    peer.send(peer.link.command_long_encode(1, 1, common.MAV_CMD_COMPONENT_ARM_DISARM, 0, 1.0, *(0.0,) * 6))
    turning = np.array([[0.1, 0.2, 0.3]])
    until = time.monotonic() + 2.0
    while pilot._peer is None and time.monotonic() < until:
        step(pilot, 12, scene(angular_velocity=turning))
    found = peer.receive(9)
    assert found["COMMAND_ACK"].result == common.MAV_RESULT_ACCEPTED
    assert found["HEARTBEAT"].type == common.MAV_TYPE_QUADROTOR
    assert found["SYS_STATUS"].battery_remaining == -1
    home, globe = found["HOME_POSITION"], found["GLOBAL_POSITION_INT"]
    assert (globe.lat - home.latitude, globe.relative_alt, globe.hdg) == (
        0,
        0,
        round(9000 - 40 / math.pi * 180),
    )
    assert (home.x, home.y, home.z, home.altitude) == (4.0, 3.0, -30.0, 152_000)
    assert home.latitude == pytest.approx(1e7 * (47.641468 + math.degrees(4.0 / 6_378_137)), abs=1)
    assert found["EXTENDED_SYS_STATE"].landed_state == common.MAV_LANDED_STATE_IN_AIR
    place = found["LOCAL_POSITION_NED"]
    assert (place.time_boot_ms, place.x, place.y, place.z) == (1200, 4.0, 3.0, -30.0)
    assert (place.vx, place.vy, place.vz) == (2.0, 1.0, -3.0)
    attitude = found["ATTITUDE"]
    # Of ENU yaw, pitch and roll: heading 90° − yaw; pitch as a pilot has it, nose down negative.
    assert attitude.yaw == pytest.approx(math.pi / 2 - 0.4)
    assert attitude.pitch == pytest.approx(-0.2)
    assert attitude.roll == pytest.approx(-0.1)
    forward, left, up = (rotated(quaternion_from_euler(0.4, 0.2, -0.1), axis) for axis in np.eye(3).tolist())
    rates = [float(turning[0] @ axis) for axis in (forward, left, up)]
    assert (attitude.rollspeed, attitude.pitchspeed, attitude.yawspeed) == pytest.approx(
        (rates[0], -rates[1], -rates[2]), abs=1e-6
    )


def test_a_ground_station_flies_a_quadrotor(peer: Peer, pilot: MavlinkAgent) -> None:
    """Closed loop with the world: the position that telemetry tells becomes the one that was sent."""
    uav = FlownObject(
        name="uav", start_m=(10.0, 20.0, 15.0), max_speed_m_s=8, max_acceleration_m_s2=4, dynamics="quadrotor"
    )
    world = FlightWorld(FlightSettings(flown=(uav,)), RunInfo(name="world"))
    world.reset(0, 1, 0)
    peer.send(peer.position_target(POSITION_ONLY, 12.0, -6.0, -20.0))
    action: Any = None
    telemetry: dict[str, Any] = {}
    for number in range(130):
        entry = GrantInput(topic="action", source="pilot", status=Status.FRESH, frame=number - 1)
        inputs = (FrameInput(entry, payload=action),) if action else ()
        frame = Frame(episode=0, number=number, t_ns=number * PERIOD_NS, previous=number - 1, inputs=inputs)
        seen = world.step(frame).products["scene"]
        assert isinstance(seen, Scene)
        if number == 0:
            arrived(pilot)
        action = step(pilot, number, seen).products["action"]
        telemetry = {**telemetry, **peer.receive(1)}
        peer.socket.setblocking(False)
        try:
            while True:
                telemetry |= {
                    message.get_type(): message for message in peer.link.parse_buffer(peer.socket.recv(65536))
                }
        except BlockingIOError:
            peer.socket.settimeout(2.0)
    place = telemetry["LOCAL_POSITION_NED"]
    assert (place.x, place.y, place.z) == pytest.approx((12.0, -6.0, -20.0), abs=0.3)


def test_wrong_addresses_are_refused_by_their_key() -> None:
    place = Place("services").at("pilot").at("settings")
    settings = MavlinkSettings(object="uav", listen="14540")
    with pytest.raises(ScenarioError, match='"HOST:PORT"') as error:
        MavlinkAgent.check_settings(settings, place)
    assert error.value.key == "services.pilot.settings.listen"
    with pytest.raises(ScenarioError, match="is no address"):
        MavlinkAgent.check_settings(replace(settings, listen="127.0.0.1:1", send="here:x"), place)


def test_a_port_that_is_taken_is_named(pilot: MavlinkAgent) -> None:
    other = MavlinkAgent(MavlinkSettings(object="uav", listen=f"127.0.0.1:{pilot.port}"), RunInfo(name="b"))
    with pytest.raises(SetupError, match=r"127\.0\.0\.1:\d+.*services\.b\.settings\.listen"):
        other.prepare(Preparation(demand={}))
    other.close()
