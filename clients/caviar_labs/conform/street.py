"""Contents of the scripted run: a base station, a car, a UAV, one carrier; a product of every topic; GRANTs.

Everything is small, asymmetric and moving, so that a swapped axis, a wrong sign or a stale frame shows. A
product has the same bytes at each call with the same arguments.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from caviar_labs.conform.canonical import product_digest
from caviar_labs.conform.client import Fields, pack, unpack
from caviar_protocol.arrays import Complex64Array, Complex128Array, Float64Array, Payload
from caviar_protocol.codec import encode_payload
from caviar_protocol.fields import PARTS_SINCE, parse_version
from caviar_protocol.multipath import first_tap, subcarrier_weights, tap_weights
from caviar_protocol.scenario import parse_scenario
from caviar_protocol.scenario.rules import resolved
from caviar_protocol.space.coordinates import quaternion_from_euler, rotation_matrix
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import (
    PARTS,
    TOPICS,
    Action,
    AntennaArray,
    AntennaDevice,
    BeamChoice,
    Camera,
    CameraDevice,
    CameraImage,
    Channel,
    ChannelMatrix,
    ChannelResponse,
    ChannelTaps,
    Depth,
    DepthImage,
    Intrinsics,
    Lidar,
    LidarDevice,
    LidarScan,
    Link,
    Scene,
    Segmentation,
    SegmentationImage,
)

PERIOD_NS = 100_000_000
"""[ns] between two frames."""
FREQUENCY_HZ = 28e9
C = 299_792_458.0
"""Speed of light [m/s]."""

SCENARIO = Path(__file__).with_name("street.toml").read_text("utf-8")
"""Scenario of the run, as TOML."""
SECTOR = f"""
[[devices]]
name = "sector"
kind = "antenna"
role = "tx"
position_m = [12.0, 6.0, 7.0]
yaw_deg = 250.0
pitch_deg = 5.0
power_dbm = 27.0

[devices.array]
rows = 2
columns = 3
polarization = "cross"
pattern_file = "{Path(__file__).with_name("sector.csv").as_posix()}"
panels = [{{ position_m = [0.0, 0.25, 0.0] }}, {{ position_m = [0.0, -0.25, 0.125], yaw_deg = 120.0 }}]
"""
"""A device that worlds of protocol 1.4 and later publish too: everything that 1.4 added to arrays."""
CAMERA_ORIENTATION = quaternion_from_euler(math.radians(70.0), math.radians(25.0), math.radians(-40.0))
WORLD = "traffic"
"""The world that publishes the devices."""

_NAMES = {"world": WORLD, "channel": "propagation", "sensors": "eyes", "agent": "pilot", "link": "radio"}
SOURCES = {name: [_NAMES[topic.role]] for name, topic in TOPICS.items()}
"""Names of the services that produce each topic."""
PREFIXES = {"air": ["uav."], "traffic": ["bs", "car."]}
"""Prefixes of object names that the worlds of the kit declare."""
DOUBLED = {**SOURCES, "scene": ["air", "traffic"], "action": ["copilot", "pilot"]}
"""The same with two worlds and two agents."""


Product = tuple[bytes, bytes]
"""Header and body of a payload."""


# Cached: a client asks for the same frames in nearly every case, and a channel takes the longest to make.
@cache
def product(topic: str, source: str, frame: int, parts: frozenset[str] = frozenset({"h"})) -> Product:
    """Make the product of a topic.

    Args:
        topic: Name of the topic.
        source: Service that produces it; two worlds or agents make different products.
        frame: Number of the frame.
        parts: Parts of a channel; other topics have none.

    Returns:
        Header and body, in canonical form.

    Example:
        >>> header, body = product("action", "pilot", 0)
        >>> unpack(header)["commands"][0]["rx"]
        'car.1/rx'
    """
    return encode_payload(_payload(topic, source, frame, parts))


def known_parts(topic: str, hello: Fields) -> list[str]:
    """List the parts of a topic that exist in the protocol version which a client states in HELLO.

    Example:
        >>> known_parts("channel", {"version": [1, 0]}), known_parts("channel", {"version": [1, 4]})
        (['h'], ['h', 'hf', 'taps'])
    """
    spoken = tuple(hello["version"])
    return [
        part
        for part in PARTS.get(topic, ())
        if spoken >= parse_version(PARTS_SINCE.get(f"{topic}.{part}", "1.0"))
    ]


def scenario_of(hello: Fields) -> str:
    """Scenario, as TOML, that the client which said this HELLO takes part in."""
    return SCENARIO + (SECTOR if hello["role"] == "world" and tuple(hello["version"]) >= (1, 4) else "")


def briefing(hello: Fields, directory: str = "") -> Fields:
    """Make ``scenario`` of WELCOME for a client.

    Args:
        hello: HELLO of the client.
        directory: Folder that a recorder writes to.

    Example:
        >>> made = briefing({"role": "agent", "name": "pilot", "version": [1, 4]})
        >>> [device["name"] for device in made["devices"]]
        ['bs', 'rx', 'lidar', 'camera']
    """
    plain = resolved(parse_scenario(scenario_of(hello)))
    # A world under test is itself the one that publishes the devices, whatever its name.
    world = hello["name"] if hello["role"] == "world" else WORLD
    fields: Fields = {
        "carriers": plain["carriers"],
        "devices": [device | {"world": world} for device in plain["devices"]],
        "episodes": plain["run"]["episodes"],
        "frames": plain["run"]["frames"],
        "sampling_period_ns": plain["run"]["sampling_period_ns"],
    }
    return fields | ({"directory": directory, "resolved": plain} if hello["role"] == "recorder" else {})


def unit_mesh(text: str) -> bytes:
    """Make the mesh of an object: a tetrahedron that fills the unit box.

    Args:
        text: A comment in it, by which its digest is unlike all others.
    """
    corners = ((-0.5, -0.5, -0.5), (0.5, 0.5, -0.5), (0.5, -0.5, 0.5), (-0.5, 0.5, 0.5))
    vertices = "".join(f"{x} {y} {z}\n" for x, y, z in corners)
    faces = "3 0 1 2\n3 0 3 1\n3 0 2 3\n3 1 3 2\n"
    return (
        f"ply\nformat ascii 1.0\ncomment {text}\nelement vertex 4\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face 4\nproperty list uchar int vertex_indices\nend_header\n{vertices}{faces}"
    ).encode()


def scenery(mark: str) -> dict[str, bytes]:
    """Make files of scenery by name.

    Args:
        mark: Text that makes their bytes, and so their digests, unlike all others.

    Returns:
        A Mitsuba scene with one mesh of ground, and a file without a byte, which needs no ASSET_DATA.
    """
    ground = ((-60, -40), (80, -40), (80, 30), (-60, 30))
    vertices = "".join(f"{x} {y} 0\n" for x, y in ground)
    mesh = (
        f"ply\nformat ascii 1.0\ncomment {mark}\nelement vertex 4\n"
        "property float x\nproperty float y\nproperty float z\n"
        f"element face 2\nproperty list uchar int vertex_indices\nend_header\n{vertices}3 0 1 2\n3 0 2 3\n"
    )
    scene = (
        f'<!-- {mark} -->\n<scene version="2.1.0">\n'
        '  <bsdf type="itu-radio-material" id="mat-concrete">\n'
        '    <string name="type" value="concrete"/>\n    <float name="thickness" value="0.2"/>\n  </bsdf>\n'
        '  <shape type="ply" id="mesh-ground">\n'
        '    <string name="filename" value="meshes/ground.ply"/>\n'
        '    <boolean name="face_normals" value="true"/>\n'
        '    <ref id="mat-concrete" name="bsdf"/>\n  </shape>\n</scene>\n'
    )
    return {
        "scenery/meshes/empty.txt": b"",
        "scenery/meshes/ground.ply": mesh.encode(),
        "scenery/street.xml": scene.encode(),
    }


def _payload(topic: str, source: str, frame: int, parts: frozenset[str]) -> Payload:
    match topic:
        case "scene":
            return _scene(source, frame)
        case "channel":
            return channel_of(frame, parts)
        case "action":
            return _action(source, frame)
        case "link":
            return _link(frame)
        case "lidar":
            return _lidar(frame)
        case _:
            return _images(topic, frame)


def _place(frame: int) -> tuple[float, float, float]:
    return (-12.0 + 0.9 * frame, 4.0 + 0.25 * frame, 0.75)


def _scene(source: str, frame: int) -> Scene:
    car = source != "air"
    name = "car.1" if car else "uav.1"
    # Written out and not mounted by the product's code, which the kit is there to be independent of.
    devices: list[Any] = [
        AntennaDevice(
            name=f"{name}/rx", parent=name, position=(0.2, 0.0, 0.9), role="rx", array=AntennaArray(columns=2)
        )
    ]
    if car:
        fixed = AntennaDevice(name="bs", position=(0.0, -10.0, 9.0), role="tx", array=AntennaArray(columns=4))
        camera = CameraDevice(
            name="car.1/camera",
            parent="car.1",
            position=(2.0, 0.0, 0.5),
            orientation=CAMERA_ORIENTATION,
            width=16,
            height=8,
        )
        lidar = LidarDevice(
            name="car.1/lidar", parent="car.1", position=(0.0, 0.2, 0.55), beams=2, azimuth_steps=12
        )
        devices = [fixed, camera, lidar, *devices]
    return Scene(
        names=(name,),
        classes=("car" if car else "uav",),
        assets=("",),
        position=np.array([_place(frame) if car else (6.0, 3.0 + 0.5 * frame, 20.0)]),
        orientation=np.array([[math.cos(0.1 * frame), 0.0, 0.0, math.sin(0.1 * frame)]]),
        velocity=np.array([[9.0, 2.5, 0.0]]),
        dimensions=np.array([[4.6, 1.9, 1.5]]),
        devices=tuple(devices),
    )


def channel_of(frame: int, parts: Collection[str]) -> Channel:
    """Make the channel of a frame: free space between ``bs`` and ``car.1/rx``, by the formulas of SPEC.md.

    Args:
        frame: Number of the frame.
        parts: Which of ``h``, ``hf`` and ``taps`` it has.
    """
    scene = _scene("traffic", frame)
    ends = {device.name: device_pose(scene, device).position for device in scene.devices}
    x, y, z = (a - b for a, b in zip(ends["car.1/rx"], ends["bs"], strict=True))
    distance = math.hypot(x, y, z)
    tau, zenith, azimuth = distance / C, math.acos(z / distance), math.atan2(y, x)
    # a = λ/(4πd)·exp(−j2πfτ), f_D = −f·v·k̂/c, with k̂ from the transmitter to the receiver.
    gain = C / FREQUENCY_HZ / (4 * math.pi * distance) * cmath.exp(-2j * math.pi * FREQUENCY_HZ * tau)
    vx, vy, vz = scene.velocity[0].tolist()
    shift = -FREQUENCY_HZ * (vx * x + vy * y + vz * z) / distance / C
    bare = Channel(
        rung="free-space",
        carriers=parse_scenario(SCENARIO).carriers,
        tx=("bs",),
        rx=("car.1/rx",),
        los=np.array([[True]]),
        offsets=np.array([0, 1], dtype="<i8"),
        id=np.array([7], dtype="<u8"),
        a=np.array([[gain]]),
        tau=np.array([tau]),
        aod=np.array([[zenith, azimuth]]),
        aoa=np.array([[math.pi - zenith, azimuth - math.pi if azimuth > 0 else azimuth + math.pi]]),
        doppler=np.array([[shift]]),
        interactions=np.zeros((1, 0), dtype="|u1"),
        points=np.zeros((1, 0, 3)),
        objects=np.zeros((1, 0), dtype="<i4"),
    )
    return replace(bare, **{part: made for part, made in parts_of(bare, scene).items() if part in parts})


def parts_of(channel: Channel, scene: Scene) -> dict[str, tuple[Any, ...]]:
    """Compute H, frequency responses and taps from a channel's paths by plane waves, as SPEC.md says.

    Args:
        channel: Its paths are read, not its parts.
        scene: Poses and arrays of its devices, which have one panel of one polarization.

    Returns:
        Entries of ``h``, ``hf`` and ``taps`` by the name of the part.
    """
    found: dict[str, tuple[Any, ...]] = {"h": (), "hf": (), "taps": ()}
    devices = {device.name: device for device in scene.devices if isinstance(device, AntennaDevice)}
    for c, carrier in enumerate(channel.carriers):
        for p in range(len(channel.tx) * len(channel.rx)):
            t, r = divmod(p, len(channel.rx))
            paths = slice(*channel.offsets[p : p + 2].tolist())
            sent = _steering(scene, devices[channel.tx[t]], channel.aod[paths])
            taken = _steering(scene, devices[channel.rx[r]], channel.aoa[paths])
            # Shape [P, N_r, N_t]: outer products of the steering vectors, weighted by the amplitudes.
            waves = channel.a[c, paths, None, None] * taken[:, :, None] * sent[:, None, :]
            tau, doppler = channel.tau[paths], channel.doppler[c, paths]
            found["h"] += (ChannelMatrix(carrier=c, tx=t, rx=r, h=waves.sum(0)),)
            if carrier.subcarriers:
                h = _summed(subcarrier_weights(carrier, tau, doppler), waves)
                found["hf"] += (ChannelResponse(carrier=c, tx=t, rx=r, h=h),)
            if carrier.taps:
                first = first_tap(carrier, tau)
                h = _summed(tap_weights(carrier, tau, doppler, first), waves)
                found["taps"] += (ChannelTaps(carrier=c, tx=t, rx=r, first=first, h=h),)
    return found


def _summed(weights: Complex128Array, waves: Complex128Array) -> Complex64Array:
    summed: Complex64Array = np.einsum("skp,pmn->skmn", weights, waves).astype("<c8")
    return summed


def _steering(scene: Scene, device: AntennaDevice, angles: Float64Array) -> Complex128Array:
    """exp(+j2π/λ·u·d) of each element towards (zenith, azimuth) in world axes, Shape ``[P, N]``."""
    array, (zenith, azimuth) = device.array, angles.T
    towards = np.stack(
        [np.sin(zenith) * np.cos(azimuth), np.sin(zenith) * np.sin(azimuth), np.cos(zenith)], 1
    )
    element = np.arange(array.size)
    y = (element // array.rows - (array.columns - 1) / 2) * array.horizontal_spacing
    z = ((array.rows - 1) / 2 - element % array.rows) * array.vertical_spacing
    own = towards @ rotation_matrix(device_pose(scene, device).orientation)
    phases: Complex128Array = np.exp(2j * np.pi * (own[:, 1, None] * y + own[:, 2, None] * z))
    return phases


def _action(source: str, frame: int) -> Action:
    receiver = "car.1/rx" if source == "pilot" else "uav.1/rx"
    return Action(commands=(BeamChoice(tx="bs", rx=receiver, tx_beam=frame % 4, rx_beam=1),))


def _link(frame: int) -> Link:
    floats: dict[str, Any] = {
        name: np.array([0.125 * (1 + index)])
        for index, name in enumerate(
            ("baseline_abs_y", "aod_azimuth", "aoa_azimuth", "snr", "snr_best", "spectral_efficiency")
        )
    }
    return Link(
        tx=("bs",),
        rx=("car.1/rx",),
        carrier=("mmwave",),
        has_path=np.array([True]),
        los=np.array([True]),
        tx_beam=np.array([1], dtype="<i4"),
        rx_beam=np.array([0], dtype="<i4"),
        abs_y=np.array([0.25]),
        top_tx_beam=np.array([[frame % 4, (frame + 1) % 4]], dtype="<i4"),
        top_rx_beam=np.array([[1, 0]], dtype="<i4"),
        top_abs_y=np.array([[0.5, 0.25]]),
        bit_rate=np.array([1e8]),
        reward=np.array([0.25]),
        **floats,
    )


def _lidar(frame: int) -> Lidar:
    points = np.array([[1.0, 2.0, 0.5], [3.0, -1.0, 0.25 * (frame % 7)]], dtype="<f4")
    scan = LidarScan(
        sensor="car.1/lidar",
        position=_place(frame),
        orientation=(1.0, 0.0, 0.0, 0.0),
        ray=np.array([3, 17], dtype="<i4"),
        points=points,
        points_world=points + np.float32(1.5),
        range=np.linalg.norm(points, axis=1).astype("<f4"),
        object=np.array([0, 1], dtype="<i4"),
    )
    return Lidar(object_names=("car.1", "ground"), scans=(scan,))


def _images(topic: str, frame: int) -> Payload:
    optics: dict[str, Any] = {
        "sensor": "car.1/camera",
        "intrinsics": Intrinsics(fx=16.0, fy=16.0, cx=2.0, cy=1.5),
        "position": _place(frame),
        "orientation": (1.0, 0.0, 0.0, 0.0),
    }
    pixels = (np.arange(12).reshape(3, 4) + frame) % 5
    if topic == "camera":
        return Camera(images=(CameraImage(**optics, rgb=np.stack([pixels] * 3, -1).astype("|u1")),))
    if topic == "depth":
        return Depth(images=(DepthImage(**optics, depth=pixels.astype("<f4") + np.float32(2)),))
    image = SegmentationImage(**optics, object=(pixels % 2).astype("<i4"))
    return Segmentation(object_names=("car.1", "ground"), images=(image,))


HELD_FOR = 2
"""Frames that a held product is older than a fresh one."""


@dataclass(frozen=True)
class Inputs:
    """Form of the inputs of a grant.

    Args:
        sources: Services that produce each topic.
        held: Whether a product is an older one, by `HELD_FOR` frames.
        without_optional: Whether inputs that are not required are absent.
        late: Whether beside each product stands one that came too late, of the frame before (recorders).
        spoil: ``header`` or ``body`` of the first product is cut; empty: neither.
        stranger: Whether payloads have a field, and an array, that this version does not know.
    """

    sources: Mapping[str, Sequence[str]] = field(default_factory=lambda: SOURCES)
    held: bool = False
    without_optional: bool = False
    late: bool = False
    spoil: str = ""
    stranger: bool = False

    def of(self, declared: Sequence[Fields], frame: int) -> tuple[list[Fields], list[bytes]]:
        """Make the entries of ``inputs`` and the parts after the header.

        Args:
            declared: Inputs that the client declared in HELLO; topic ``*`` stands for all.
            frame: Frame of the grant.
        """
        entries: list[Fields] = []
        parts: list[bytes] = []
        for item in declared:
            topics = sorted(SOURCES) if item["topic"] == "*" else [item["topic"]]
            for topic in topics:
                for source in self.sources.get(topic, ()):
                    for entry, product in self._entries(item, topic, source, frame):
                        entries.append(entry)
                        parts += product
        return entries, self._spoiled(parts)

    def _entries(
        self, item: Fields, topic: str, source: str, frame: int
    ) -> list[tuple[Fields, tuple[bytes, ...]]]:
        lag = int(item.get("lag", 0))
        computed, optional = frame - lag, not item.get("required", True)
        if computed < 0 or (self.without_optional and optional):
            # Of a topic with lag there is nothing before the first frame, also where it is required.
            cause = "no frame before the first" if computed < 0 else f"{source} missed frame {computed}"
            return [({"topic": topic, "source": source, "status": "absent", "cause": cause}, ())]
        held = HELD_FOR if self.held and computed >= HELD_FOR else 0
        status = "held" if held else "fresh"
        parts = frozenset(item.get("parts", ())) if topic == "channel" else frozenset()
        found = [self._entry(topic, source, status, computed - held, lag + held, parts)]
        if self.late and computed:
            found.append(self._entry(topic, source, "late", computed - 1, lag + 1, parts))
        return found

    def _entry(
        self, topic: str, source: str, status: str, frame: int, age: int, parts: frozenset[str]
    ) -> tuple[Fields, tuple[bytes, ...]]:
        header, body = product(topic, source, frame, parts) if parts else product(topic, source, frame)
        if self.stranger:
            header, body = _with_stranger(header, body)
        entry: Fields = {"topic": topic, "source": source, "status": status, "frame": frame}
        if frame:
            entry["t_ns"] = frame * PERIOD_NS
        if age:
            entry["age"] = age
        entry["digest"] = product_digest(header, body)
        if status == "held":
            entry["cause"] = f"{source} missed frame {frame + HELD_FOR}"
        if self.stranger:
            entry["colour"] = ["not known to this version"]
        return entry, (header, body)

    def _spoiled(self, parts: list[bytes]) -> list[bytes]:
        if self.spoil and parts:
            # The first product that has a body, so that both ways of cutting hit the same one.
            number = next((n for n in range(1, len(parts), 2) if parts[n]), 1) - (self.spoil == "header")
            parts[number] = parts[number][: len(parts[number]) // 2] if self.spoil == "body" else b"\xc1\xff"
        return parts


def _with_stranger(header: bytes, body: bytes) -> Product:
    """Add a field to a product, whose array comes after all others."""
    fields = unpack(header)
    # Arrays begin at multiples of 8 bytes (SPEC.md, Arrays).
    padded = body + bytes(-len(body) % 8)
    fields["strange"] = {"dtype": "<f8", "shape": [2], "offset": len(padded)}
    return pack(fields), padded + bytes(16)
