"""Small worlds made on the spot, and models that answer in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from caviar_protocol.arrays import Float64Array
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Channel, Scene
from caviar_services.channel.base import ChannelModel
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.channel.statistical.geometric import GeometricChannel
from caviar_services.channel.statistical.waves import GeometricSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo

Point = Sequence[float]
Model = ChannelModel[Any]


@dataclass(frozen=True)
class Plate:
    """A flat piece of scenery: its corners in order."""

    name: str
    corners: Sequence[Point]
    material: str = "surface"
    faces: Sequence[Sequence[int]] = ()
    """Corners of its triangles; empty: those of a convex polygon."""


@dataclass(frozen=True)
class Material:
    """A radio material of the scenery."""

    permittivity: float
    conductivity: float
    thickness: float = 30.0
    """[m]; so thick that what enters a lossy one does not come back."""


CONDUCTOR = Material(1.0, 1e7)


@dataclass(frozen=True)
class Thing:
    """A moving box."""

    name: str
    position: Point
    size: Point = (4.5, 1.8, 1.5)
    quaternion: Point = (1.0, 0.0, 0.0, 0.0)
    velocity: Point = (0.0, 0.0, 0.0)
    turning: Point = (0.0, 0.0, 0.0)
    """Angular velocity [rad/s]."""


class Bench:
    """Makes worlds in a folder of its own, and models for them, each once."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._made = 0
        self._open: dict[str, Model] = {}

    def free_space(self, *frequencies: float) -> Model:
        """Rung ``free-space``."""
        return _ready(FreeSpaceChannel(FreeSpaceSettings(), _run(frequencies)), {})

    def geometric(self, *frequencies: float, **settings: Any) -> Model:
        """Rung ``geometric``."""
        return _ready(GeometricChannel(convert_settings(GeometricSettings, settings), _run(frequencies)), {})

    def traced(
        self,
        frequencies: float | Sequence[float],
        plates: Sequence[Plate] = (),
        materials: Mapping[str, Material] | None = None,
        **settings: Any,
    ) -> Model:
        """Rung ``siso-rt`` in a scenery of plates, whose materials are made here."""
        from caviar_services.channel.sionna.model import SionnaChannel
        from caviar_services.channel.sionna.settings import SionnaSettings

        carriers = (frequencies,) if isinstance(frequencies, int | float) else tuple(frequencies)
        given: dict[str, Any] = {"samples": 20_000, "bodies": 1, "receivers_at_once": 4, "max_depth": 1}
        given |= {"outside_itu_range": "nearest", **settings}
        given["materials"] = {
            name: {"relative_permittivity": m.permittivity, "conductivity_s_per_m": m.conductivity}
            for name, m in (materials or {}).items()
        }
        key = repr((carriers, sorted(given.items()), plates, materials))
        if key not in self._open:
            assets = self.scenery(plates, materials or {}) if plates else {}
            run = _run(carriers)
            self._open[key] = _ready(SionnaChannel(convert_settings(SionnaSettings, given), run), assets)
        return self._open[key]

    def scenery(self, plates: Sequence[Plate], materials: Mapping[str, Material]) -> dict[str, Path]:
        """Files of a scenery of plates, as assets of a run."""
        self._made += 1
        folder = self._folder / str(self._made) / "scenery"
        (folder / "meshes").mkdir(parents=True)
        parts = ['<scene version="2.1.0">']
        for name, material in materials.items():
            parts.append(
                f'<bsdf type="itu-radio-material" id="{name}"><string name="type" value="concrete"/>'
                f'<float name="thickness" value="{material.thickness}"/></bsdf>'
            )
        assets = {}
        for plate in plates:
            mesh = folder / "meshes" / f"{plate.name}.ply"
            mesh.write_text(_ply(plate))
            assets[f"scenery/meshes/{plate.name}.ply"] = mesh
            parts.append(
                f'<shape type="ply" id="mesh-{plate.name}">'
                f'<string name="filename" value="meshes/{plate.name}.ply"/>'
                f'<boolean name="face_normals" value="true"/><ref id="{plate.material}" name="bsdf"/></shape>'
            )
        xml = folder / "scene.xml"
        xml.write_text("\n".join([*parts, "</scene>"]))
        return {"scenery/scene.xml": xml, **assets}


def link(model: Model, tx: Point, rx: Point, *things: Thing) -> Channel:
    """The channel between two antennas."""
    return answer(model, world([antenna("t", "tx", tx), antenna("r", "rx", rx)], things))


def world(devices: Sequence[AntennaDevice], things: Sequence[Thing] = ()) -> Scene:
    """A scene."""
    things = sorted(things, key=lambda thing: thing.name)

    def column(field: str, width: int) -> Float64Array:
        return np.array([getattr(thing, field) for thing in things], np.float64).reshape(-1, width)

    return Scene(
        names=tuple(thing.name for thing in things),
        classes=("car",) * len(things),
        assets=("",) * len(things),
        position=column("position", 3),
        orientation=column("quaternion", 4),
        velocity=column("velocity", 3),
        dimensions=column("size", 3),
        devices=tuple(sorted(devices, key=lambda device: device.name)),
        angular_velocity=column("turning", 3) if any(any(thing.turning) for thing in things) else None,
    )


def antenna(
    name: str, role: str, position: Point, array: AntennaArray | None = None, parent: str = ""
) -> AntennaDevice:
    """An antenna device; isotropic and vertical where no array is given."""
    x, y, z = map(float, position)
    return AntennaDevice(
        name=name,
        role=role,  # type: ignore[arg-type]
        position=(x, y, z),
        array=array or AntennaArray(),
        parent=parent,
    )


def answer(model: Model, scene: Scene, number: int = 0) -> Channel:
    """What a model makes of a scene."""
    source = FrameInput(GrantInput(topic="scene", source="world", status=Status.FRESH), payload=scene)
    frame = Frame(
        episode=0,
        number=number,
        t_ns=number * 100_000_000,
        inputs=(source,),
        service=model.run.name,
        seed=model.run.seed,
    )
    channel = model.step(frame).products["channel"]
    if not isinstance(channel, Channel):
        raise TypeError(f"a channel model made a {type(channel).__name__}")
    return channel


def total(channel: Channel, carrier: int = 0) -> complex:
    """Sum of the amplitudes of the only pair."""
    return complex(channel.a[carrier].sum())


def square(half: float, height: float = 0.0) -> list[tuple[float, float, float]]:
    """Corners of a horizontal square about the origin, its normal up."""
    return [(x * half, y * half, height) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]


def room(size: Point) -> list[Plate]:
    """Six walls of a box with a corner at the origin."""
    x, y, z = size
    corners = [(0.0, 0.0), (x, 0.0), (x, y), (0.0, y)]
    plates = [
        Plate(name, [(a, b, height) for a, b in corners]) for name, height in (("floor", 0.0), ("ceiling", z))
    ]
    for i, ((a, b), (c, d)) in enumerate(zip(corners, corners[1:] + corners[:1], strict=True)):
        plates.append(Plate(f"wall{i}", [(a, b, 0.0), (c, d, 0.0), (c, d, z), (a, b, z)]))
    return plates


def _ply(plate: Plate) -> str:
    corners = plate.corners
    faces = plate.faces or [(0, i, i + 1) for i in range(1, len(corners) - 1)]
    lines = ["ply", "format ascii 1.0", f"element vertex {len(corners)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_index", "end_header"]
    lines += [" ".join(repr(float(x)) for x in corner) for corner in corners]
    lines += ["3 {} {} {}".format(*face) for face in faces]
    return "\n".join(lines) + "\n"


def _run(frequencies: Sequence[float]) -> RunInfo:
    carriers = tuple(Carrier(name=f"c{i}", frequency_hz=f) for i, f in enumerate(frequencies))
    return RunInfo(name="channel", seed=1, carriers=carriers)


def _ready(model: Model, assets: Mapping[str, Path]) -> Model:
    model.prepare(Preparation(demand={"channel": frozenset({"h"})}, assets=dict(assets)))
    return model
