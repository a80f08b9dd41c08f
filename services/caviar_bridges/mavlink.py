"""Agent ``mavlink``: a ground station or a companion computer flies an object of the world, over MAVLink.

Towards its peer the agent is a vehicle (https://mavlink.io/en/messages/common.html): it sends its state, and
takes off, lands and obeys set-points as in offboard flight. Modes have the numbers of PX4. Beams are those of
``los-beam``. What the peer sends is recorded, but not repeatable: equal seeds give equal digests only where
the peer sends the same in the same frames.
"""

from __future__ import annotations

import dataclasses
import logging
import math
import socket
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Any, ClassVar, NamedTuple

import msgspec
from msgspec.structs import replace

from caviar_bridges.airsim.wire import GEO_ORIGIN, NedFrame
from caviar_bridges.manoeuvres import Flown, FlyPath, Land, Manoeuvre
from caviar_protocol.arrays import quantity
from caviar_protocol.errors import RunError, ScenarioError, SetupError
from caviar_protocol.host import install_command
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.coordinates import Pose, Vector, euler_from_quaternion, rotated, unrotated
from caviar_protocol.space.scene import Pair, object_pose
from caviar_protocol.topics import AttitudeCommand, BeamChoice, Scene, VelocityCommand, WaypointCommand
from caviar_protocol.topics.link import MotionCommand
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.agent.baselines import straight_choices
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, StepResult
from caviar_space.engine_axes import NED, Motion

SETPOINTS = "mavlink-setpoints"
"""Count of the set-points that came in a frame."""

IGNORED = "mavlink-ignored"
"""Count of the set-points, commands and datagrams that the agent does not understand, or does not obey."""

MOST_NAMED = 200
"""Refusals that are named, each once."""

_log = logging.getLogger("caviar.service")

# Bits of POSITION_TARGET_TYPEMASK: what is to be ignored.
_NO_POSITION, _NO_VELOCITY, _NO_YAW, _NO_YAW_RATE = 0b111, 0b111000, 1 << 10, 1 << 11
# Bit of ATTITUDE_TARGET_TYPEMASK.
_NO_ATTITUDE, _NO_THROTTLE = 0b10000000, 0b01000000

# Least time between two heartbeats [ns] of simulated time.
_HEARTBEAT_NS = 1_000_000_000

# Modes of PX4, as main and sub mode: https://github.com/PX4/PX4-Autopilot, px4_custom_mode.h.
_HOLD, _TAKEOFF, _LAND, _OFFBOARD = (4, 3), (4, 2), (4, 6), (6, 0)

# [m] above where it landed at which a vehicle flies, and of its lower face above z = 0 at which it does not.
_ON_GROUND = 0.1

_GRAVITY = 9.80665
_LARGEST_DATAGRAM = 65536


class MavlinkSettings(AgentSettings, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the agent ``mavlink``."""

    object: Annotated[str, msgspec.Meta(min_length=1)]
    """The object that is flown; it owns ``motion:<object>``."""
    listen: str = "127.0.0.1:14540"
    """Host and UDP port on which set-points are taken. They are not authenticated: on another address than
    this machine's own, every host that reaches it flies the object."""
    send: str = ""
    """Host and UDP port to which telemetry goes; empty: to the peer that sent last."""
    speed_m_s: Annotated[float, quantity("m/s", "to positions that are sent", gt=0)] = 5.0
    hover_thrust: Annotated[float, quantity("1", "normalized thrust that hovers", gt=0, le=1)] = 0.5
    system: Annotated[int, quantity("1", "MAVLink system number", ge=1, le=255)] = 1
    origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Where the origin of the local NED frame lies, in world axes."""
    geo_origin: tuple[float, float, float] = GEO_ORIGIN
    """Latitude [°], longitude [°] and altitude above mean sea level [m] there."""
    takeoff_m: Annotated[float, quantity("m", "that a take-off goes up where it names no altitude", gt=0)] = (
        2.5
    )
    climb_m_s: Annotated[float, quantity("m/s", "of take-off and landing", gt=0)] = 1.0


class _BodyVelocity(NamedTuple):
    """A set-point in axes of the heading, which turns."""

    velocity: Vector
    """Forward, right, down [m/s]."""
    yaw: float | None
    yaw_rate: float | None


class MavlinkAgent(Agent[MavlinkSettings]):
    """A vehicle that a MAVLink peer flies: its set-points become commands, and the scene telemetry.

    The last set-point holds until the next one; a take-off or landing under way comes first. A vehicle that
    begins an episode in the air is armed, one on the ground is not. Accelerations of set-points are not used.

    Args:
        settings: The object, the ports, and the users that the agent serves.
        run: What the agent knows about the run.

    Example:
        >>> agent = MavlinkAgent(MavlinkSettings(object="uav"), RunInfo(name="pilot"))
        >>> agent.other_actuators()
        ('motion:uav',)
    """

    Settings = MavlinkSettings
    extra: ClassVar[str] = "mavlink"
    packages: ClassVar[tuple[str, ...]] = ("pymavlink",)

    @classmethod
    def check_settings(cls, settings: MavlinkSettings, place: Place) -> None:
        """Raise `ScenarioError` for addresses that are none."""
        _address(settings.listen, place.at("listen"))
        if settings.send:
            _address(settings.send, place.at("send"))

    def __init__(self, settings: MavlinkSettings, run: RunInfo) -> None:
        super().__init__(settings, run)
        self._socket: socket.socket | None = None
        self._dialect: Any = None
        self._link: Any = None
        self._peer: tuple[str, int] | None = None
        self._setpoint: MotionCommand | _BodyVelocity | None = None
        self._manoeuvre: Manoeuvre | None = None
        self._flown: Flown | None = None
        """In this frame; None: it is not in the scene."""
        self._home: Vector | None = None
        self._armed = False
        self._ground: float | None = None
        """Height at which it stands [m]; None: it flies."""
        self._ned = NedFrame(settings.origin_m, settings.geo_origin)
        self._named: set[str] = set()
        self._next_heartbeat_ns = 0
        self._counts: Counter[str] = Counter()

    def prepare(self, preparation: Preparation) -> Prepared:
        """Load pymavlink, and listen.

        Raises:
            SetupError: pymavlink is not installed, or the port is taken.
        """
        try:
            from pymavlink.dialects.v20 import common
        except ImportError as error:
            raise SetupError(
                f"the agent `mavlink` needs pymavlink; run: {install_command('mavlink')}"
            ) from error
        place = self.run.settings_place
        self._dialect = common
        self._link = common.MAVLink(None, srcSystem=self.settings.system, srcComponent=1)
        self._link.robust_parsing = True
        self._peer = _address(self.settings.send, place.at("send")) if self.settings.send else None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(_address(self.settings.listen, place.at("listen")))
        except OSError as error:
            raise SetupError(
                f"cannot listen on {self.settings.listen} ({error}); end what has the port, or set another "
                f"one in {place.at('listen').key}"
            ) from error
        prepared = super().prepare(preparation)
        host, port = self._socket.getsockname()
        note = f"MAVLink set-points for {self.settings.object} on udp {host}:{port}"
        return dataclasses.replace(prepared, notes=(*prepared.notes, note))

    @property
    def port(self) -> int:
        """UDP port on which it listens; 0 before `prepare`."""
        return int(self._socket.getsockname()[1]) if self._socket else 0

    def reset(self, episode: int, seed: int, t0_ns: int) -> None:
        """Each episode begins without a set-point: the object hovers."""
        self._setpoint, self._manoeuvre, self._home, self._next_heartbeat_ns = None, None, None, 0

    def close(self) -> None:
        """Close the port."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def step(self, frame: Frame) -> StepResult:
        """Telemetry of the frame out, set-points in."""
        self._counts.clear()
        made = super().step(frame)
        return replace(made, counts={**made.counts, **self._counts})

    def other_actuators(self) -> tuple[str, ...]:
        """The motion of the object."""
        return (f"motion:{self.settings.object}",)

    def other_commands(self, frame: Frame, scene: Scene) -> Iterable[MotionCommand]:
        """Commands of the vehicle; none while the object is not in the scene, or while it hovers."""
        if self._socket is None:
            raise RunError("the agent `mavlink` was not prepared; call prepare before the first frame")
        self._look(frame.t_ns, scene)
        self._receive(self._socket)
        if self._flown is None:
            return
        self._send_state(self._socket, frame.t_ns, scene)
        if self._manoeuvre is not None:
            yield self._manoeuvre.fly(self._flown)
        elif isinstance(self._setpoint, _BodyVelocity):
            yield self._in_world(self._setpoint, self._flown.yaw)
        elif self._setpoint is not None:
            yield self._setpoint

    def _look(self, t_ns: int, scene: Scene) -> None:
        """Note the position of the vehicle, whether it stands, and whether its manoeuvre is over."""
        name = self.settings.object
        if name not in scene.names:
            self._flown = None
            return
        index = scene.names.index(name)
        pose = object_pose(scene, index)
        vx, vy, vz = scene.velocity[index].tolist()
        self._flown = Flown(t_ns, pose.position, (vx, vy, vz), euler_from_quaternion(pose.orientation)[0])
        height = pose.position[2]
        if self._home is None:
            self._home = pose.position
            stands = height - float(scene.dimensions[index][2]) / 2 <= _ON_GROUND
            self._ground, self._armed = (height if stands else None), not stands
        if self._ground is not None and height > self._ground + _ON_GROUND:
            self._ground, self._next_heartbeat_ns = None, 0
        if self._manoeuvre is None:
            return
        self._manoeuvre.look(self._flown)
        if self._manoeuvre.result is not None:
            if isinstance(self._manoeuvre, Land) and self._manoeuvre.result:
                self._ground = height
            self._begin(None)

    def _begin(self, manoeuvre: Manoeuvre | None) -> None:
        """Fly a manoeuvre, or hover, until the next set-point."""
        self._manoeuvre, self._setpoint, self._next_heartbeat_ns = manoeuvre, None, 0

    def _in_world(self, wanted: _BodyVelocity, yaw: float) -> VelocityCommand:
        """A velocity command of a set-point in axes of the heading."""
        # At the middle of the frame, so that a turn becomes an arc and no polygon around it.
        turned = (wanted.yaw_rate or 0.0) * self.run.sampling_period_ns / 2e9
        forward, right, down = wanted.velocity
        half = (yaw + turned) / 2
        velocity = rotated((math.cos(half), 0.0, 0.0, math.sin(half)), (forward, -right, -down))
        return VelocityCommand(
            object=self.settings.object, velocity=velocity, yaw=wanted.yaw, yaw_rate=wanted.yaw_rate
        )

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """The straight-line pair of each user."""
        return straight_choices(scene, pairs)

    # --- in -------------------------------------------------------------------------------------------------

    def _receive(self, port: socket.socket) -> None:
        """Take all messages that came since the frame before."""
        while True:
            try:
                data, sender = port.recvfrom(_LARGEST_DATAGRAM)
            except BlockingIOError:
                return
            except ConnectionError:  # what was sent to a peer that is gone comes back as an error
                continue
            if not self.settings.send:
                self._peer = sender
            try:
                messages = self._link.parse_buffer(data) or []
            except self._dialect.MAVError:
                self._counts[IGNORED] += 1
                continue
            for message in messages:
                self._take(port, message)

    def _take(self, port: socket.socket, message: Any) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT":
            return
        if getattr(message, "target_system", self.settings.system) not in (0, self.settings.system):
            return
        if kind in ("COMMAND_LONG", "COMMAND_INT"):
            self._obey(port, message)
            return
        setpoint: MotionCommand | _BodyVelocity | None = None
        if kind == "SET_POSITION_TARGET_LOCAL_NED":
            setpoint = self._position_target(message)
        elif kind == "SET_ATTITUDE_TARGET":
            setpoint = self._attitude_target(message)
        else:
            self._refuse(port, f"message {kind}", "is not offered")
            return
        if setpoint is None:
            frame = f" in frame {message.coordinate_frame}" if hasattr(message, "coordinate_frame") else ""
            self._refuse(
                port, f"{kind}{frame} with mask {message.type_mask:#x}", "is not offered, or no numbers"
            )
        elif not self._armed:
            self._refuse(port, "a set-point", "comes while not armed")
        elif self._manoeuvre is not None:
            self._refuse(port, "a set-point", "comes during take-off or landing")
        else:
            self._counts[SETPOINTS] += 1
            if self._setpoint is None:
                self._next_heartbeat_ns = 0
            self._setpoint = setpoint

    def _refuse(self, port: socket.socket, what: str, why: str) -> None:
        """Count a request that is not obeyed, and name it once, to the peer as well."""
        self._counts[IGNORED] += 1
        if what + why in self._named or len(self._named) >= MOST_NAMED:
            return
        self._named.add(what + why)
        _log.warning(
            "%r: %s %s; it is ignored, and further ones are only counted", self.settings.object, what, why
        )
        words = f"ignored: {what} {why}"[:50].encode()
        self._post(port, self._link.statustext_encode(self._dialect.MAV_SEVERITY_WARNING, words))

    def _position_target(self, message: Any) -> MotionCommand | _BodyVelocity | None:
        name, mask, dialect = self.settings.object, message.type_mask, self._dialect
        place, speed = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
        yaw = None if mask & _NO_YAW else math.pi / 2 - message.yaw
        yaw_rate = None if mask & _NO_YAW_RATE else -message.yaw_rate
        if not all(map(math.isfinite, (yaw or 0.0, yaw_rate or 0.0))):
            return None
        has_velocity = not mask & _NO_VELOCITY and all(map(math.isfinite, speed))
        if message.coordinate_frame in (dialect.MAV_FRAME_BODY_NED, dialect.MAV_FRAME_BODY_FRD):
            # A heading along the course would turn the axes in which the course is given.
            keeps = 0.0 if yaw is None and yaw_rate is None else yaw_rate
            return _BodyVelocity(speed, yaw, keeps) if has_velocity and mask & _NO_POSITION else None
        if message.coordinate_frame != dialect.MAV_FRAME_LOCAL_NED:
            return None
        if not mask & _NO_POSITION and all(map(math.isfinite, place)):
            position = self._ned.point_to_enu(place)
            return WaypointCommand(object=name, position=position, speed=self.settings.speed_m_s, yaw=yaw)
        if has_velocity:
            velocity = self._ned.velocity_to_enu(speed)
            return VelocityCommand(object=name, velocity=velocity, yaw=yaw, yaw_rate=yaw_rate)
        return None

    def _attitude_target(self, message: Any) -> MotionCommand | None:
        norm = math.hypot(*message.q)
        if message.type_mask & (_NO_ATTITUDE | _NO_THROTTLE) or not abs(norm - 1.0) < 1e-2:
            return None
        if not 0.0 <= message.thrust <= 1.0:
            return None
        w, x, y, z = (part / norm for part in message.q)
        orientation = NED.to_enu(Pose((0.0, 0.0, 0.0), (w, x, y, z))).orientation
        thrust = message.thrust / self.settings.hover_thrust * _GRAVITY
        return AttitudeCommand(object=self.settings.object, orientation=orientation, thrust=thrust)

    def _obey(self, port: socket.socket, message: Any) -> None:
        """Carry a command out, and acknowledge what came of it."""
        d = self._dialect
        offered = {
            d.MAV_CMD_COMPONENT_ARM_DISARM: self._arm,
            d.MAV_CMD_DO_SET_MODE: self._set_mode,
            d.MAV_CMD_NAV_TAKEOFF: self._take_off,
            d.MAV_CMD_NAV_LAND: self._land,
        }
        obey = offered.get(message.command)
        if obey is None:
            result, why = d.MAV_RESULT_UNSUPPORTED, "is not offered"
        elif self._flown is None:
            result, why = d.MAV_RESULT_TEMPORARILY_REJECTED, "comes while the object is not in the scene"
        else:
            why = obey(message, self._flown)
            result = d.MAV_RESULT_DENIED if why else d.MAV_RESULT_ACCEPTED
        if why:
            entry = d.enums["MAV_CMD"].get(message.command)
            self._refuse(port, entry.name if entry else f"command {message.command}", why)
        self._post(port, self._link.command_ack_encode(message.command, result))

    # Each carries a command out, or says why not.

    def _arm(self, message: Any, flown: Flown) -> str:
        if message.param1 == 0.0 and self._ground is None:
            return "to disarm comes in the air"
        self._armed = message.param1 != 0.0
        self._begin(self._manoeuvre if self._armed else None)
        return ""

    def _set_mode(self, message: Any, flown: Flown) -> str:
        mode = (message.param2, message.param3)
        if not int(message.param1) & self._dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            return "has no custom mode of PX4"
        if mode == _TAKEOFF:
            return self._climb(flown, math.nan)
        if mode == _LAND:
            return self._land(message, flown)
        if mode == _HOLD:
            self._begin(None)
            return ""
        if mode != _OFFBOARD:
            return f"to mode {mode[0]:g}/{mode[1]:g} is not offered"
        self._manoeuvre, self._next_heartbeat_ns = None, 0
        return ""

    def _take_off(self, message: Any, flown: Flown) -> str:
        if message.get_type() == "COMMAND_LONG":
            return self._climb(flown, message.param7)
        d = self._dialect
        above_sea = message.frame in (d.MAV_FRAME_GLOBAL, d.MAV_FRAME_GLOBAL_INT)
        home = self._ned.geo_point(self._home or flown.position)["altitude"] if above_sea else 0.0
        return self._climb(flown, message.z - home)

    def _climb(self, flown: Flown, altitude: float) -> str:
        """Go up to an altitude above home [m], as peers send it to what is not PX4; NaN: as settings say."""
        if not self._armed:
            return "comes while not armed"
        x, y, z = flown.position
        up = self.settings.takeoff_m if self._ground is not None else 0.0
        height = (self._home or flown.position)[2] + altitude if math.isfinite(altitude) else z + up
        if height <= z and self._ground is not None:
            return "goes to no altitude above the ground"
        # What flies higher already stays there.
        path = FlyPath(self.settings.object, [(x, y, max(z, height))], self.settings.climb_m_s, reach=0.1)
        self._begin(path)
        return ""

    def _land(self, message: Any, flown: Flown) -> str:
        if self._ground is None:
            self._begin(Land(self.settings.object, self.settings.climb_m_s, math.inf))
        return ""

    # --- out ------------------------------------------------------------------------------------------------

    def _send_state(self, port: socket.socket, t_ns: int, scene: Scene) -> None:
        index, link = scene.names.index(self.settings.object), self._link
        ms = (t_ns // 1_000_000) & 0xFFFFFFFF
        pose = object_pose(scene, index)
        x, y, z = (a - b for a, b in zip(pose.position, self.settings.origin_m, strict=True))
        there = NED.from_enu(Pose((x, y, z), pose.orientation))
        vx, vy, vz = scene.velocity[index].tolist()
        ox, oy, oz = (
            scene.angular_velocity[index].tolist() if scene.angular_velocity is not None else (0.0,) * 3
        )
        motion = NED.motion_from_enu(Motion((vx, vy, vz), (ox, oy, oz)))
        geo = _degrees_e7(self._ned, pose.position)
        if t_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = t_ns + _HEARTBEAT_NS
            self._send_status(port, t_ns, geo)
        self._post(port, link.local_position_ned_encode(ms, *there.position, *motion.velocity))
        yaw, pitch, roll = euler_from_quaternion(there.orientation)
        rates = unrotated(there.orientation, motion.angular_velocity)
        self._post(port, link.attitude_encode(ms, roll, pitch, yaw, *rates))
        relative = pose.position[2] - (self._home or pose.position)[2]
        speeds = (round(100 * part) for part in motion.velocity)
        heading = round(100 * math.degrees(yaw)) % 36000
        self._post(port, link.global_position_int_encode(ms, *geo, round(1000 * relative), *speeds, heading))

    def _send_status(self, port: socket.socket, t_ns: int, geo: Sequence[int]) -> None:
        """Send the messages of each second: mode, health, landed state, the fix, and home."""
        d, link = self._dialect, self._link
        mode, landed = _HOLD, d.MAV_LANDED_STATE_IN_AIR
        if isinstance(self._manoeuvre, Land):
            mode, landed = _LAND, d.MAV_LANDED_STATE_LANDING
        elif self._manoeuvre is not None:
            mode, landed = _TAKEOFF, d.MAV_LANDED_STATE_TAKEOFF
        elif self._setpoint is not None:
            mode = _OFFBOARD
        if self._ground is not None:
            landed = d.MAV_LANDED_STATE_ON_GROUND
        flags = d.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | d.MAV_MODE_FLAG_GUIDED_ENABLED
        flags |= d.MAV_MODE_FLAG_SAFETY_ARMED if self._armed else 0
        state = d.MAV_STATE_ACTIVE if self._armed else d.MAV_STATE_STANDBY
        kind, autopilot = d.MAV_TYPE_QUADROTOR, d.MAV_AUTOPILOT_GENERIC
        custom = mode[0] << 16 | mode[1] << 24
        self._post(port, link.heartbeat_encode(kind, autopilot, flags, custom, state, 3))
        # The battery is not known: scenes do not have it.
        unknown_mv, unknown = 0xFFFF, -1
        sensors = (
            d.MAV_SYS_STATUS_SENSOR_GPS
            | d.MAV_SYS_STATUS_AHRS
            | d.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL
            | d.MAV_SYS_STATUS_SENSOR_Z_ALTITUDE_CONTROL
            | d.MAV_SYS_STATUS_PREARM_CHECK
        )
        status = (sensors, sensors, sensors, 0, unknown_mv, unknown, unknown, 0, 0, 0, 0, 0, 0)
        self._post(port, link.sys_status_encode(*status))
        self._post(port, link.extended_sys_state_encode(d.MAV_VTOL_STATE_UNDEFINED, landed))
        us, not_known = t_ns // 1000, 0xFFFF
        fix = (d.GPS_FIX_TYPE_3D_FIX, *geo, not_known, not_known, not_known, not_known, 0xFF)
        self._post(port, link.gps_raw_int_encode(us, *fix))
        home = self._home or self.settings.origin_m
        place = self._ned.pose(Pose(home, (1.0, 0.0, 0.0, 0.0)))["position"].values()
        there = _degrees_e7(self._ned, home)
        nothing = ((math.nan,) * 4, math.nan, math.nan, math.nan)
        self._post(port, link.home_position_encode(*there, *place, *nothing))

    def _post(self, port: socket.socket, message: Any) -> None:
        if self._peer is None:
            return
        self._link.seq = (self._link.seq + 1) & 0xFF
        try:
            port.sendto(message.pack(self._link), self._peer)
        except (BlockingIOError, ConnectionError):
            return  # telemetry: the next frame brings newer


def _degrees_e7(ned: NedFrame, position: Vector) -> tuple[int, int, int]:
    """Latitude and longitude [1e-7 °] and altitude [mm] of a position in ENU [m]."""
    geo = ned.geo_point(position)
    return round(1e7 * geo["latitude"]), round(1e7 * geo["longitude"]), round(1e3 * geo["altitude"])


def _address(text: str, place: Place) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ScenarioError(
            f'{text!r} is no address; write "HOST:PORT", such as "127.0.0.1:14540"', key=place.key
        )
    return host, int(port)
