"""Agent ``mavlink``: a ground station or a companion computer flies an object of the world, over MAVLink.

Towards its peer the agent is a vehicle: it sends HEARTBEAT, LOCAL_POSITION_NED, ATTITUDE and SYS_STATUS, and
obeys SET_POSITION_TARGET_LOCAL_NED and SET_ATTITUDE_TARGET (https://mavlink.io/en/messages/common.html) as in
offboard flight. Beams are those of ``los-beam``. What the peer sends is recorded, but not repeatable: equal
seeds give equal digests only where the peer sends the same in the same frames.
"""

from __future__ import annotations

import dataclasses
import math
import socket
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated, Any, ClassVar

import msgspec
from msgspec.structs import replace

from caviar_protocol.arrays import quantity
from caviar_protocol.errors import RunError, ScenarioError, SetupError
from caviar_protocol.host import install_command
from caviar_protocol.scenario.conversion import Place
from caviar_protocol.space.coordinates import Pose, Vector, euler_from_quaternion, unrotated
from caviar_protocol.space.engine_axes import NED, Motion
from caviar_protocol.space.scene import Pair, object_pose
from caviar_protocol.topics import AttitudeCommand, BeamChoice, Scene, VelocityCommand, WaypointCommand
from caviar_protocol.topics.link import MotionCommand
from caviar_services.agent.base import Agent, AgentSettings
from caviar_services.agent.baselines import straight_choices
from caviar_services.service import Frame, Preparation, Prepared, RunInfo, StepResult

SETPOINTS = "mavlink-setpoints"
"""Count of the set-points that came in a frame."""

IGNORED = "mavlink-ignored"
"""Count of the set-points, commands and datagrams that the agent does not understand."""

# Bits of POSITION_TARGET_TYPEMASK: what is to be ignored.
_NO_POSITION, _NO_VELOCITY = 0b111, 0b111000
# Bit of ATTITUDE_TARGET_TYPEMASK.
_NO_ATTITUDE, _NO_THROTTLE = 0b10000000, 0b01000000

# Least time between two heartbeats [ns] of simulated time.
_HEARTBEAT_NS = 1_000_000_000

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


class MavlinkAgent(Agent[MavlinkSettings]):
    """Passes set-points of a MAVLink peer on as commands, and the scene as telemetry.

    The last set-point holds until the next one. Yaw and accelerations of set-points are not used.

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
        self._command: MotionCommand | None = None
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
        self._command, self._next_heartbeat_ns = None, 0

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
        """The last set-point; none while the object is not in the scene, or before the first one."""
        if self._socket is None:
            raise RunError("the agent `mavlink` was not prepared; call prepare before the first frame")
        self._receive(self._socket)
        if self.settings.object not in scene.names:
            return
        self._send_state(self._socket, frame.t_ns, scene)
        if self._command is not None:
            yield self._command

    def choose(self, frame: Frame, scene: Scene, pairs: Sequence[Pair]) -> Iterator[BeamChoice]:
        """The straight-line pair of each user."""
        return straight_choices(scene, pairs)

    # --- in -------------------------------------------------------------------------------------------------

    def _receive(self, port: socket.socket) -> None:
        """Take all that came since the frame before."""
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
        command: MotionCommand | None = None
        if kind == "SET_POSITION_TARGET_LOCAL_NED":
            command = self._position_target(message)
        elif kind == "SET_ATTITUDE_TARGET":
            command = self._attitude_target(message)
        elif kind == "COMMAND_LONG":
            self._acknowledge(port, message)
            return
        if command is None:
            self._counts[IGNORED] += 1
        else:
            self._counts[SETPOINTS] += 1
            self._command = command

    def _position_target(self, message: Any) -> MotionCommand | None:
        name, mask = self.settings.object, message.type_mask
        place, speed = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
        if message.coordinate_frame != self._dialect.MAV_FRAME_LOCAL_NED:
            return None
        if not mask & _NO_POSITION and all(map(math.isfinite, place)):
            x, y, z = (a + b for a, b in zip(_to_enu(place), self.settings.origin_m, strict=True))
            return WaypointCommand(object=name, position=(x, y, z), speed=self.settings.speed_m_s)
        if not mask & _NO_VELOCITY and all(map(math.isfinite, speed)):
            return VelocityCommand(object=name, velocity=_to_enu(speed))
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

    def _acknowledge(self, port: socket.socket, message: Any) -> None:
        """Answer a peer that arms or sets a mode before it flies; there is nothing to be done for it."""
        known = (self._dialect.MAV_CMD_COMPONENT_ARM_DISARM, self._dialect.MAV_CMD_DO_SET_MODE)
        accepted = message.command in known
        if not accepted:
            self._counts[IGNORED] += 1
        result = self._dialect.MAV_RESULT_ACCEPTED if accepted else self._dialect.MAV_RESULT_UNSUPPORTED
        self._post(port, self._link.command_ack_encode(message.command, result))

    # --- out ------------------------------------------------------------------------------------------------

    def _send_state(self, port: socket.socket, t_ns: int, scene: Scene) -> None:
        index, dialect = scene.names.index(self.settings.object), self._dialect
        if t_ns >= self._next_heartbeat_ns:
            self._next_heartbeat_ns = t_ns + _HEARTBEAT_NS
            mode = dialect.MAV_MODE_FLAG_SAFETY_ARMED | dialect.MAV_MODE_FLAG_GUIDED_ENABLED
            self._post(
                port,
                self._link.heartbeat_encode(
                    dialect.MAV_TYPE_QUADROTOR,
                    dialect.MAV_AUTOPILOT_GENERIC,
                    mode,
                    0,
                    dialect.MAV_STATE_ACTIVE,
                    3,
                ),
            )
            self._post(port, self._status())
        ms = (t_ns // 1_000_000) & 0xFFFFFFFF
        pose = object_pose(scene, index)
        x, y, z = (a - b for a, b in zip(pose.position, self.settings.origin_m, strict=True))
        there = NED.from_enu(Pose((x, y, z), pose.orientation))
        vx, vy, vz = scene.velocity[index].tolist()
        ox, oy, oz = (
            scene.angular_velocity[index].tolist() if scene.angular_velocity is not None else (0.0,) * 3
        )
        motion = NED.motion_from_enu(Motion((vx, vy, vz), (ox, oy, oz)))
        self._post(port, self._link.local_position_ned_encode(ms, *there.position, *motion.velocity))
        yaw, pitch, roll = euler_from_quaternion(there.orientation)
        rates = unrotated(there.orientation, motion.angular_velocity)
        self._post(port, self._link.attitude_encode(ms, roll, pitch, yaw, *rates))

    def _status(self) -> Any:
        """SYS_STATUS with a battery that is not known: scenes do not have it."""
        unknown_mv, unknown = 0xFFFF, -1
        return self._link.sys_status_encode(0, 0, 0, 0, unknown_mv, unknown, unknown, 0, 0, 0, 0, 0, 0)

    def _post(self, port: socket.socket, message: Any) -> None:
        if self._peer is None:
            return
        self._link.seq = (self._link.seq + 1) & 0xFF
        try:
            port.sendto(message.pack(self._link), self._peer)
        except (BlockingIOError, ConnectionError):
            return  # telemetry: the next frame brings newer


def _to_enu(vector: Sequence[float]) -> Vector:
    x, y, z = vector
    return NED.to_enu(Pose((x, y, z), (1.0, 0.0, 0.0, 0.0))).position


def _address(text: str, place: Place) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise ScenarioError(
            f'{text!r} is no address; write "HOST:PORT", such as "127.0.0.1:14540"', key=place.key
        )
    return host, int(port)
