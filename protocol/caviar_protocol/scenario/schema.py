"""The types of a scenario file: what a run consists of, and the devices that it mounts.

TOML, validated as a whole before anything starts. A key that is not known here is an error that names the
file, the line and the key that was probably meant. `caviar_protocol.scenario` reads files,
`caviar_protocol.scenario.rules` holds the rules between keys.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterable, Sequence
from pathlib import PurePath
from typing import Annotated, Any, ClassVar, Literal

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from caviar_protocol.arrays import Position, quantity
from caviar_protocol.errors import ScenarioError
from caviar_protocol.files import Durability
from caviar_protocol.messages import Policy, Role
from caviar_protocol.scenario.conversion import Source
from caviar_protocol.space.codebooks import FILE, codebook_digest
from caviar_protocol.space.coordinates import Vector, multiply, quaternion_from_euler
from caviar_protocol.topics.channel import Carrier
from caviar_protocol.topics.scene import AntennaArray, AntennaDevice, CameraDevice, Device, LidarDevice

REMOTE = "remote"
"""What ``use`` says of a service that the user starts, anywhere: its place in the run is held free."""
REMOTE_REJOIN_S = 30.0
"""[s] that a remote service gets to come back, where ``rejoin_s`` is not given."""


# Each table repeats the options: msgspec does not inherit ``kw_only``.
class _Section(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Base of all tables of a scenario: unknown keys are refused."""


# 1e17 ns, of which 90 add up within 64 bits.
LONGEST_S = 1e8
"""[s] Longest wait and budget that a scenario may ask for, three years: nanoseconds are 64-bit numbers."""


class Timeouts(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Times for which the broker waits."""

    connect_s: Annotated[float, quantity("s", "wait for HELLO of every service", gt=0, le=LONGEST_S)] = 30.0
    ready_s: Annotated[float, quantity("s", "wait for READY", gt=0, le=LONGEST_S)] = 120.0
    """A grace that a service declares with its heartbeats comes on top."""
    reset_s: Annotated[float, quantity("s", "wait for RESET_DONE", gt=0, le=LONGEST_S)] = 60.0
    stall_s: Annotated[float, quantity("s", "wait without progress", gt=0, le=LONGEST_S)] = 30.0
    """For a service of policy ``wait`` that neither answers nor reports progress."""
    # None and not a number: the default depends on whether the user starts the service.
    rejoin_s: (
        Annotated[
            float,
            quantity("s", "wait for a service that died to come back; 0: the run ends", ge=0, le=LONGEST_S),
        ]
        | None
    ) = None
    """Absent: `REMOTE_REJOIN_S` for remote services, 0 for those that `caviar run` starts."""
    shutdown_s: Annotated[
        float, quantity("s", "wait for BYE; then the process is killed", gt=0, le=LONGEST_S)
    ] = 2.0
    heartbeat_s: Annotated[float, quantity("s", "between heartbeats", gt=0, le=LONGEST_S)] = 0.25
    liveness_s: Annotated[
        float, quantity("s", "silence after which a remote peer is gone", gt=0, le=LONGEST_S)
    ] = 1.5


class Limits(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Shares of the broker that one peer may use; a peer that exceeds a limit is disconnected and named."""

    connections: Annotated[int, quantity("1", "open connections in all", ge=1, le=1_000_000)] = 4096
    connections_before_hello: Annotated[
        int, quantity("1", "open connections of one address before HELLO", ge=1, le=1_000_000)
    ] = 256
    messages_before_hello: Annotated[int, quantity("1", "messages of a connection", ge=1, le=1_000_000)] = 16
    waiting_before_hello_mib: Annotated[
        int, quantity("MiB", "unread messages of a connection before HELLO", ge=1, le=1024)
    ] = 4
    messages_at_once: Annotated[
        int, quantity("1", "messages of a service, beyond answers", ge=100, le=1_000_000_000)
    ] = 4000
    """Bucket that ``messages_per_s`` fills; one message for each that the service was sent is free."""
    messages_per_s: Annotated[
        float, quantity("1/s", "messages of a service, beyond answers", gt=0, le=1e9)
    ] = 500.0
    part_mib: Annotated[
        int, quantity("MiB", "largest part of a message, such as a product", ge=4, le=1024)
    ] = 1024
    waiting_mib: Annotated[
        int, quantity("MiB", "unread messages of a service, or unsent ones to it", ge=2, le=2**20)
    ] = 1088
    observer_s: Annotated[
        float, quantity("s", "that an observer may take to acknowledge a frame", gt=0, le=LONGEST_S)
    ] = 10.0


class Run(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The run as a whole."""

    # The name of the run's directory has a date and a time after it, and 255 B at most.
    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,199}$(?!\n)")]
    """Name of the scenario, with which the run's directory begins."""
    frames: Annotated[int, quantity("frame", "frames of an episode", ge=1)]
    sampling_period_ns: Annotated[int, quantity("ns", "T_sam, from one frame to the next", gt=0)] = (
        100_000_000
    )
    instants_s: tuple[Annotated[float, quantity("s", "instant of a frame", ge=0)], ...] = ()
    """Instants of the frames of an episode, in place of ``frames`` and ``sampling_period_ns``, which
    follow from it. ``instants_ns`` and ``file:PATH.csv`` are read into it."""
    episodes: Annotated[int, quantity("1", "episodes of the run", ge=1)] = 1
    seed: Annotated[int, quantity("1", "seed of everything random", ge=0, le=2**63 - 1)] = 1
    # `fast` stays: scenarios of earlier versions have it.
    pace: Literal["free", "realtime", "fast"] | Annotated[float, quantity("1", "", ge=1e-6, le=1e6)] = "free"
    """When frames are released: ``free`` (``fast`` is its older name) as soon as they can be, ``realtime``
    as simulated time passes, a number that many times as fast. Never is a frame skipped (clause 8)."""
    record: tuple[str, ...] = ()
    """Topics that are produced because they shall be recorded, though no service consumes them (clause 5):
    ``lidar``, or with a part of it ``lidar.grid``."""
    checkpoint_frames: Annotated[int, quantity("frame", "from one checkpoint to the next", ge=0)] = 20
    """Services that can do so then save their state; 0: never."""
    max_faces: Annotated[
        int, quantity("1", "triangles of a mesh that a world announces while the run goes on", ge=1)
    ] = 2_000_000
    """One with more is refused, and its objects are boxes."""
    frames_in_flight: Annotated[int, quantity("frame", "frames that may overlap", ge=1, le=64)] = 4
    durability: Durability = "periodic"
    """What a loss of power costs: ``frame`` at most the frame in progress, ``periodic`` at most
    `caviar_protocol.files.SYNC_PERIOD_S` and a frame, ``none`` what the system had not written yet."""


class DeviceSpec(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A device, or one on each of several objects.

    With ``on`` the device is mounted: on the object of that name, or with ``*`` on up to
    ``count`` of the matching objects, those that came first; when one leaves, the next gets a
    device. A mounted device is named ``<object>/<name>``.

    Example:
        >>> antenna = DeviceSpec(name="rx", kind="antenna", on="car.*", count=2, mount="roof", role="rx")
        >>> mounted_device(antenna, "car.17", (4.5, 1.8, 1.5)).position
        (0.0, 0.0, 0.75)
    """

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$(?!\n)")]
    """Name of the device, after that of the object it is mounted on."""
    # One struct for all kinds: TOML has no types, and an error can name the kind that a key belongs to.
    kind: Literal["antenna", "lidar", "camera"]
    """What the device is; keys of the other kinds are refused."""
    on: str = ""
    """Name of the object that carries the device, or a pattern with ``*``; empty: fixed in the world."""
    count: Annotated[int, quantity("1", "objects that carry the device, of those that match", ge=1)] = 1
    mount: Literal["centre", "roof", "floor"] = "centre"
    """What ``position_m`` is relative to: a point of the parent's bounding box."""
    world: str = ""
    """The world that publishes a device; needed where ``on`` leaves it open."""
    position_m: Position = (0.0, 0.0, 0.0)
    """In the world's axes [m], or with ``on`` in the object's axes, from the mount point."""
    yaw_deg: Annotated[float, quantity("°", "counter-clockwise from +x")] = 0.0
    pitch_deg: Annotated[float, quantity("°", "positive lowers the nose")] = 0.0
    roll_deg: Annotated[float, quantity("°", "about +x")] = 0.0
    keeps_heading: bool = False
    """Whether a device with ``on`` keeps its angles in the world's axes while its object turns."""
    # antenna
    role: Literal["tx", "rx", "both", ""] = ""
    """Antennas: transmits, receives, or both. Antennas need it."""
    array: AntennaArray | None = None
    """Antennas: the elements; absent: one isotropic element."""
    power_dbm: Annotated[float, quantity("dBm", "transmit power", ge=-200, le=200)] = 0.0
    carriers: tuple[str, ...] = ()
    """Antennas: names of the carriers that they send and receive on; empty: all of the run."""
    # lidar
    beams: Annotated[int, quantity("1", "beams of a lidar, one above the other", ge=1, le=1024)] = 64
    azimuth_steps: Annotated[int, quantity("1", "rays of a beam in a turn", ge=1, le=36000)] = 1800
    elevation_deg: Annotated[tuple[float, float], quantity("°", "lowest and highest beam")] = (-25.0, 3.0)
    range_m: Annotated[tuple[float, float], quantity("m", "nearest and farthest hit")] = (0.0, 100.0)
    # camera
    size_px: Annotated[tuple[int, int], quantity("px", "width, height")] = (640, 480)
    field_of_view_deg: Annotated[float, quantity("°", "horizontal field of view", gt=0, lt=180)] = 90.0


class ServiceSpec(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One service of the run.

    Example:
        >>> ServiceSpec(role="agent", use="remote", budget_ms=20.0).remote
        True
    """

    unknown_key_hint: ClassVar[str] = "settings of the implementation stand in its table `settings`"

    role: Role
    """What the service does in the run."""
    use: str
    """Registered implementation of the role, or ``module:Class``; ``remote``: the user starts the service."""
    # Without a default: how long a part may take is a decision of each scenario.
    budget_ms: Annotated[
        float, quantity("ms", "wall time for a frame; misses are counted", gt=0, le=1e3 * LONGEST_S)
    ]
    policy: Policy = "wait"
    """What follows when the budget is up: ``wait`` for the answer, ``hold`` the last product, ``drop`` the
    product of this frame, ``abort`` the run (clause 9)."""
    max_in_flight: Annotated[
        int, quantity("1", "grants that it may have queued; more than 1 only under wait", ge=1, le=64)
    ] = 1
    users: tuple[str, ...] = ()
    """Agents: the receivers (or actuators) this agent owns, as patterns; empty: a default agent,
    which serves the receivers without another agent (clause 17)."""
    # Plain: only the process of the implementation imports the class that checks them.
    settings: dict[str, Any] = {}
    """Settings of the implementation, which its ``Settings`` class defines."""

    @property
    def remote(self) -> bool:
        """True if the user starts this service, and not `caviar run`."""
        return self.use == REMOTE


class ReplaySpec(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parts of a recorded run that a run repeats; `caviar replay` writes it."""

    recording: Annotated[str, Meta(min_length=1)]
    """Directory of the recorded run."""
    served: tuple[str, ...] = ()
    """Services whose products are the recorded ones; those that were held or absent are so again."""
    imposed: tuple[str, ...] = ()
    """Services that run again and take over their recorded decisions (contract, clause 6)."""
    digest: str = ""
    """Of the recorded run, as far as it is repeated."""


class Scenario(_Section, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A whole scenario file."""

    not_in_file: ClassVar[tuple[str, ...]] = ("source",)

    run: Run
    """The run as a whole."""
    services: dict[str, ServiceSpec]
    """Services by name."""
    timeouts: Timeouts = Timeouts()
    """How long the broker waits for what."""
    limits: Limits = Limits()
    """What one peer may use of the broker."""
    carriers: tuple[Carrier, ...] = ()
    """Radio carriers of every channel."""
    devices: tuple[DeviceSpec, ...] = ()
    """Antennas and sensors."""
    replay: ReplaySpec | None = None
    """What the run repeats of a recorded one."""
    source: Source = Source()
    """File and lines of the scenario, with which later checks name the place of an error."""


PATTERNS = "patterns/"
"""What the names of assets begin with that are patterns of antenna elements."""

# Mount point along z, in heights of the object's bounding box from its centre.
_HEIGHT = {"centre": 0.0, "roof": 0.5, "floor": -0.5}


def carries(spec: DeviceSpec, name: str) -> bool:
    """Return whether a device may be mounted on an object.

    Args:
        spec: The device of the scenario.
        name: Name of the object.

    Example:
        >>> carries(DeviceSpec(name="rx", kind="antenna", on="car.*"), "car.17")
        True
    """
    # The whole name comes first: names of objects may hold brackets, which are special in patterns.
    return name == spec.on or owned_by((spec.on,), name)


def is_made_by(spec: DeviceSpec, name: str) -> bool:
    """Return whether a device of a scene is one that the scenario says is made by ``spec``.

    Args:
        spec: The device of the scenario.
        name: Name of the device in the scene.

    Example:
        >>> is_made_by(DeviceSpec(name="rx", kind="antenna", on="car.*"), "car.17/rx")
        True
    """
    if not spec.on:
        return name == spec.name
    ending = f"/{spec.name}"
    return name.endswith(ending) and carries(spec, name.removesuffix(ending))


def fixed_device(spec: DeviceSpec) -> Device:
    """The device of a scenario that stands in the world, without ``on``.

    Args:
        spec: The device of the scenario.

    Raises:
        ScenarioError: An antenna has no role.

    Example:
        >>> mast = DeviceSpec(name="bs", kind="antenna", role="tx", position_m=(0.0, 0.0, 15.0))
        >>> fixed_device(mast).position
        (0.0, 0.0, 15.0)
    """
    return _device(spec, spec.name, "", 0.0)


def mounted_device(spec: DeviceSpec, parent: str, dimensions: Vector) -> Device:
    """The device of a scenario on one object.

    Args:
        spec: The device of the scenario, with ``on``.
        parent: Name of the object.
        dimensions: Of its bounding box (length, width, height) [m].

    Raises:
        ScenarioError: An antenna has no role.
    """
    return _device(spec, f"{parent}/{spec.name}", parent, dimensions[2])


def turned_back(device: Device, parent: Sequence[float]) -> Device:
    """A mounted device that keeps its heading: its orientation is turned against its object's.

    Args:
        device: As of `mounted_device`.
        parent: Orientation of the object, (w, x, y, z).

    Example:
        >>> spec = DeviceSpec(name="rx", kind="antenna", role="rx", on="car", keeps_heading=True)
        >>> device = mounted_device(spec, "car", (4.5, 1.8, 1.5))
        >>> turned_back(device, (0.0, 0.0, 0.0, 1.0)).orientation  # on a car that drives towards −x
        (0.0, 0.0, 0.0, -1.0)
    """
    w, x, y, z = parent
    return replace(device, orientation=multiply((w, -x, -y, -z), device.orientation))


def pattern_asset(path: str) -> str:
    """Name of the asset that a pattern file of a scenario travels as.

    Args:
        path: File of the pattern, as it stands in the scenario.

    Example:
        >>> pattern_asset("/home/me/measured/horn.csv")
        'patterns/horn.csv'
    """
    return f"{PATTERNS}{PurePath(path).name}"


def published_array(array: AntennaArray) -> AntennaArray:
    """An array of a scenario as it is in a scene: its files by the names of their assets, without paths.

    Args:
        array: Of a device of the scenario.
    """
    if digest := codebook_digest(array):
        array = msgspec.structs.replace(array, codebook=f"{FILE}#{digest}")
    if not array.pattern_file:
        return array
    return msgspec.structs.replace(array, pattern_file=pattern_asset(array.pattern_file))


def _device(spec: DeviceSpec, name: str, parent: str, height: float) -> Device:
    x, y, z = spec.position_m
    position = (x, y, z + _HEIGHT[spec.mount] * height)
    orientation = quaternion_from_euler(
        math.radians(spec.yaw_deg), math.radians(spec.pitch_deg), math.radians(spec.roll_deg)
    )
    match spec.kind:
        case "antenna":
            # The loader refuses it with file and line; a world that is given devices by a test gets here.
            if not spec.role:
                raise ScenarioError(
                    f'antenna {spec.name!r} lacks its role; write role = "tx", "rx" or "both"', key="devices"
                )
            return AntennaDevice(
                name=name,
                parent=parent,
                position=position,
                orientation=orientation,
                role=spec.role,
                array=published_array(spec.array or AntennaArray()),
                power_dbm=spec.power_dbm,
                carriers=spec.carriers,
            )
        case "lidar":
            return LidarDevice(
                name=name,
                parent=parent,
                position=position,
                orientation=orientation,
                beams=spec.beams,
                azimuth_steps=spec.azimuth_steps,
                elevation_min=math.radians(spec.elevation_deg[0]),
                elevation_max=math.radians(spec.elevation_deg[1]),
                min_range=spec.range_m[0],
                max_range=spec.range_m[1],
            )
        case "camera":
            return CameraDevice(
                name=name,
                parent=parent,
                position=position,
                orientation=orientation,
                width=spec.size_px[0],
                height=spec.size_px[1],
                field_of_view=math.radians(spec.field_of_view_deg),
            )


def owned_by(patterns: Iterable[str], name: str) -> bool:
    """Return whether one of the patterns matches a name (contract, clause 17).

    Args:
        patterns: Names with ``*`` and ``?``.
        name: Name of an object, a receiver or an actuator.

    Example:
        >>> owned_by(("beam:car.*", "motion:uav"), "beam:car.17/rx")
        True
    """
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)
