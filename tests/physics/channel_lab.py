"""A bench for channel models: small scenes made on the spot, and formulas that know nothing of the code.

Rotations, Fresnel coefficients and images are written out here once more, from textbooks, so that
a sign that is wrong in the services cannot be wrong here in the same way.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Channel, Scene
from caviar_services.channel.base import ChannelModel
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

C = 299_792_458.0
EPSILON_0 = 8.8541878128e-12

Array = np.ndarray[tuple[int, ...], np.dtype[Any]]


# --- formulas ------------------------------------------------------------------------------


def turn(yaw: float, pitch: float, roll: float) -> Array:
    """Rz(yaw) · Ry(pitch) · Rx(roll), written out."""
    cz, sz, cy, sy, cx, sx = *_cs(yaw), *_cs(pitch), *_cs(roll)
    rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    return rz @ ry @ rx


def _cs(angle: float) -> tuple[float, float]:
    return float(np.cos(angle)), float(np.sin(angle))


def permittivity(a: float, b: float, c: float, d: float, frequency: float) -> complex:
    """Complex relative permittivity of a material of ITU-R P.2040-3, table 3."""
    ghz = frequency / 1e9
    return complex(a * ghz**b, -(c * ghz**d) / (2 * np.pi * frequency * EPSILON_0))


def mirrored(point: Array, origin: Array, normal: Array) -> Array:
    """Image of a point in a plane."""
    return point - 2 * np.dot(point - origin, normal) * normal


def reflected(field: Array, k_in: Array, normal: Array, eta: complex) -> Array:
    """Field behind a plane of a half-space of relative permittivity ``eta`` (Fresnel)."""
    k_out = k_in - 2 * np.dot(k_in, normal) * normal
    cosine = abs(np.dot(k_in, normal))
    root = np.sqrt(eta - (1 - cosine**2))
    across = (cosine - root) / (cosine + root)
    along = (eta * cosine - root) / (eta * cosine + root)
    s = np.cross(k_in, normal)
    s = s / np.linalg.norm(s)
    return across * np.dot(field, s) * s + along * np.dot(field, np.cross(k_in, s)) * np.cross(k_out, s)


def vertical(k: Array) -> Array:
    """Field of an upright vertical isotropic element towards k: θ̂."""
    theta, phi = np.arccos(k[2]), np.arctan2(k[1], k[0])
    return np.array([np.cos(theta) * np.cos(phi), np.cos(theta) * np.sin(phi), -np.sin(theta)])


def horizontal(k: Array) -> Array:
    """Field of an upright horizontal isotropic element towards k: φ̂."""
    phi = np.arctan2(k[1], k[0])
    return np.array([-np.sin(phi), np.cos(phi), 0.0])


def unit(vector: Array) -> Array:
    return vector / np.linalg.norm(vector)


def spherical_wave(length: float, frequency: float) -> complex:
    """λ/(4πd) · exp(−j2πd/λ)."""
    wavelength = C / frequency
    return complex(wavelength / (4 * np.pi * length) * np.exp(-2j * np.pi * ((length / wavelength) % 1.0)))


# --- scenes --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Plate:
    """A flat piece of scenery: corners in order, of a material."""

    name: str
    corners: Sequence[Sequence[float]]
    material: str = "concrete"
    thickness: float = 20.0
    """[m]; so thick that what enters a lossy material does not come back."""


def write_scenery(folder: Path, plates: Sequence[Plate]) -> dict[str, Path]:
    """Assets of a scenery of plates."""
    meshes = folder / "scenery" / "meshes"
    meshes.mkdir(parents=True, exist_ok=True)
    parts = ['<scene version="2.1.0">']
    for plate in plates:
        parts.append(
            f'<bsdf type="itu-radio-material" id="skin-{plate.name}">'
            f'<string name="type" value="{plate.material}"/>'
            f'<float name="thickness" value="{plate.thickness}"/></bsdf>'
        )
    for plate in plates:
        (meshes / f"{plate.name}.ply").write_text(_ply(plate.corners))
        parts.append(
            f'<shape type="ply" id="mesh-{plate.name}">'
            f'<string name="filename" value="meshes/{plate.name}.ply"/>'
            f'<boolean name="face_normals" value="true"/><ref id="skin-{plate.name}" name="bsdf"/></shape>'
        )
    xml = folder / "scenery" / "scene.xml"
    xml.write_text("\n".join([*parts, "</scene>"]))
    names = {f"scenery/meshes/{plate.name}.ply": meshes / f"{plate.name}.ply" for plate in plates}
    return {"scenery/scene.xml": xml, **names}


def _ply(corners: Sequence[Sequence[float]]) -> str:
    lines = ["ply", "format ascii 1.0", f"element vertex {len(corners)}"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"element face {len(corners) - 2}", "property list uchar int vertex_index", "end_header"]
    lines += [" ".join(str(x) for x in corner) for corner in corners]
    lines += [f"3 0 {i} {i + 1}" for i in range(1, len(corners) - 1)]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class Thing:
    """A moving object."""

    name: str
    position: Sequence[float]
    size: Sequence[float] = (4.5, 1.8, 1.5)
    quaternion: Sequence[float] = (1.0, 0.0, 0.0, 0.0)
    velocity: Sequence[float] = (0.0, 0.0, 0.0)
    turning: Sequence[float] = (0.0, 0.0, 0.0)
    """Angular velocity [rad/s]."""


def scene(devices: Sequence[AntennaDevice], things: Sequence[Thing] = ()) -> Scene:
    things = sorted(things, key=lambda thing: thing.name)

    def stacked(field: str, width: int) -> Array:
        return np.array([getattr(thing, field) for thing in things], np.float64).reshape(-1, width)

    return Scene(
        names=tuple(thing.name for thing in things),
        classes=("car",) * len(things),
        assets=("",) * len(things),
        position=stacked("position", 3),
        orientation=stacked("quaternion", 4),
        velocity=stacked("velocity", 3),
        dimensions=stacked("size", 3),
        devices=tuple(sorted(devices, key=lambda device: device.name)),
        angular_velocity=stacked("turning", 3) if any(any(thing.turning) for thing in things) else None,
    )


def antenna(
    name: str, role: str, position: Any, array: AntennaArray | None = None, **more: Any
) -> AntennaDevice:
    return AntennaDevice(
        name=name,
        role=role,  # type: ignore[arg-type]
        position=tuple(float(x) for x in position),
        array=array or AntennaArray(),
        **more,
    )


# --- models --------------------------------------------------------------------------------


def free_space(*frequencies: float) -> ChannelModel[Any]:
    model = FreeSpaceChannel(FreeSpaceSettings(), RunInfo(name="channel", carriers=carriers(*frequencies)))
    model.prepare(Preparation(demand={"channel": frozenset({"h"})}))
    return model


def geometric(*frequencies: float, seed: int = 1, **settings: Any) -> ChannelModel[Any]:
    from caviar_services.channel.statistical.geometric import GeometricChannel
    from caviar_services.channel.statistical.waves import GeometricSettings

    run = RunInfo(name="channel", seed=seed, carriers=carriers(*frequencies))
    model = GeometricChannel(msgspec.convert(settings, GeometricSettings), run)
    model.prepare(Preparation(demand={"channel": frozenset({"h"})}))
    return model


def sionna(
    frequency: float | Sequence[float], assets: Mapping[str, Path] | None = None, **settings: Any
) -> ChannelModel[Any]:
    from caviar_services.channel.sionna.model import SionnaChannel
    from caviar_services.channel.sionna.settings import SionnaSettings

    settings = {"samples": 20_000, "bodies": 2, "receivers_at_once": 8, **settings}
    frequencies = [frequency] if isinstance(frequency, int | float) else frequency
    run = RunInfo(name="channel", seed=1, carriers=carriers(*frequencies))
    model = SionnaChannel(msgspec.convert(settings, SionnaSettings), run)
    model.prepare(Preparation(demand={"channel": frozenset({"h"})}, assets=assets or {}))
    return model


def carriers(*frequencies: float) -> tuple[Carrier, ...]:
    return tuple(Carrier(name=f"c{i}", frequency_hz=f) for i, f in enumerate(frequencies))


def measure(model: ChannelModel[Any], at: Scene, number: int = 0) -> Channel:
    """The product for a scene; what is drawn depends on the run's seed and the frame's number."""
    source = FrameInput(GrantInput(topic="scene", source="world", status=Status.FRESH), payload=at)
    frame = Frame(
        episode=0,
        number=number,
        t_ns=number * 100_000_000,
        inputs=(source,),
        service=model.run.name,
        seed=model.run.seed,
    )
    channel = model.step(frame).products["channel"]
    assert isinstance(channel, Channel)
    return channel


def total(channel: Channel, carrier: int = 0) -> Array:
    """H of single elements: sum of the amplitudes of each pair, Shape ``[pairs]``."""
    return np.array(
        [
            channel.a[carrier, i:j].sum()
            for i, j in zip(channel.offsets[:-1], channel.offsets[1:], strict=True)
        ]
    )
