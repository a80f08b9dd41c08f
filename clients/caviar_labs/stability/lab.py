"""Little worlds made on the spot, and channel models that answer in them.

The cases of `caviar measure stability` and the tests of physics are made of these: plates for scenery, boxes
that move, antennas, one frame, its product. `formulas` says what the product should be.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from caviar_protocol.arrays import Complex128Array, Float64Array
from caviar_protocol.messages import GrantInput, Status
from caviar_protocol.scenario.conversion import convert_settings
from caviar_protocol.topics import AntennaArray, AntennaDevice, Carrier, Channel, Interaction, Scene
from caviar_protocol.topics.scene import Device
from caviar_services.channel.base import ChannelModel
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.channel.statistical.geometric import GeometricChannel
from caviar_services.channel.statistical.waves import GeometricSettings
from caviar_services.service import Frame, FrameInput, Preparation, RunInfo, StepResult

Array = NDArray[Any]
Point = Sequence[float] | Float64Array
"""[m]."""
Model = ChannelModel[Any]


# --- what stands and what moves -------------------------------------------------------------


@dataclass(frozen=True)
class Material:
    """A radio material by its constants, the same on all carriers."""

    permittivity: float
    """Relative."""
    conductivity: float
    """[S/m]."""
    thickness: float = 30.0
    """[m]; so thick that what enters a lossy one does not come back."""


CONDUCTOR = Material(1.0, 1e7)


@dataclass(frozen=True)
class Plate:
    """A flat piece of scenery."""

    name: str
    corners: Sequence[Point]
    """In order [m]."""
    material: Material | str = "concrete"
    """Constants, or the name of a material of ITU-R P.2040."""
    thickness: float = 20.0
    """Of a material by name [m]."""
    faces: Sequence[Sequence[int]] = ()
    """Corners of its triangles; empty: those of a convex polygon."""

    @property
    def made_of(self) -> Material | None:
        """Its constants; None: those of a material by name."""
        return self.material if isinstance(self.material, Material) else None


@dataclass(frozen=True)
class Thing:
    """A moving object, which is a box unless an asset has its mesh."""

    name: str
    position: Point
    size: Point = (4.5, 1.8, 1.5)
    """[m]."""
    quaternion: Point = (1.0, 0.0, 0.0, 0.0)
    velocity: Point = (0.0, 0.0, 0.0)
    """[m/s]."""
    turning: Point = (0.0, 0.0, 0.0)
    """Angular velocity [rad/s]."""
    asset: str = ""


def square(half: float, height: float = 0.0) -> list[tuple[float, float, float]]:
    """Corners of a horizontal square about the origin, its normal up; half of its side and its height [m].

    Example:
        >>> square(2.0)
        [(-2.0, -2.0, 0.0), (2.0, -2.0, 0.0), (2.0, 2.0, 0.0), (-2.0, 2.0, 0.0)]
    """
    return [(x * half, y * half, height) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]


def room(size: Sequence[float], material: Material | str = "concrete") -> list[Plate]:
    """Six walls of a box of these sides [m], one corner of which is the origin."""
    x, y, z = size
    corners = [(0.0, 0.0), (x, 0.0), (x, y), (0.0, y)]
    plates = [
        Plate(name, [(a, b, height) for a, b in corners], material)
        for name, height in (("floor", 0.0), ("ceiling", z))
    ]
    for i, ((a, b), (c, d)) in enumerate(zip(corners, corners[1:] + corners[:1], strict=True)):
        plates.append(Plate(f"wall{i}", [(a, b, 0.0), (c, d, 0.0), (c, d, z), (a, b, z)], material))
    return plates


def write_scenery(folder: Path, plates: Sequence[Plate]) -> dict[str, Path]:
    """Write a scenery of plates as Mitsuba's XML and meshes.

    Args:
        folder: Where ``scenery/`` is made.
        plates: Of names of their own. One with constants gets the material ``made-N``, plates of the same
            constants the same one; one with a name gets ``skin-PLATE``.

    Returns:
        Assets of a run, by name.
    """
    meshes = folder / "scenery" / "meshes"
    meshes.mkdir(parents=True, exist_ok=True)
    # In the order of their first plates: a later plate of the same constants is overwritten by the first one.
    skins = {_skin(plate, plates): plate for plate in reversed(plates)}
    parts = ['<scene version="2.1.0">']
    for skin, plate in reversed(skins.items()):
        # Constants of one's own replace those of any ITU material, in the settings.
        kind, thickness = plate.material, plate.thickness
        if plate.made_of is not None:
            kind, thickness = "concrete", plate.made_of.thickness
        parts.append(
            f'<bsdf type="itu-radio-material" id="{skin}"><string name="type" value="{kind}"/>'
            f'<float name="thickness" value="{thickness}"/></bsdf>'
        )
    assets = {"scenery/scene.xml": folder / "scenery" / "scene.xml"}
    for plate in plates:
        mesh = assets[f"scenery/meshes/{plate.name}.ply"] = meshes / f"{plate.name}.ply"
        mesh.write_text(_ply(plate))
        parts.append(
            f'<shape type="ply" id="mesh-{plate.name}">'
            f'<string name="filename" value="meshes/{plate.name}.ply"/>'
            f'<boolean name="face_normals" value="true"/>'
            f'<ref id="{_skin(plate, plates)}" name="bsdf"/></shape>'
        )
    assets["scenery/scene.xml"].write_text("\n".join([*parts, "</scene>"]))
    return assets


def _skin(plate: Plate, plates: Sequence[Plate]) -> str:
    """Name of the material of a plate."""
    if plate.made_of is None:
        return f"skin-{plate.name}"
    made = dict.fromkeys(plate.made_of for plate in plates if plate.made_of is not None)
    return f"made-{list(made).index(plate.made_of)}"


def _ply(plate: Plate) -> str:
    # ASCII with all digits: binary PLY of the project has float32, and cases are about the last digit.
    faces = plate.faces or [(0, i, i + 1) for i in range(1, len(plate.corners) - 1)]
    lines = ["ply", "format ascii 1.0", f"element vertex {len(plate.corners)}"]
    lines += [f"property double {axis}" for axis in "xyz"]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_index", "end_header"]
    lines += [" ".join(repr(float(x)) for x in corner) for corner in plate.corners]
    lines += ["3 {} {} {}".format(*face) for face in faces]
    return "\n".join(lines) + "\n"


def antenna(
    name: str, role: str, position: Point, array: AntennaArray | None = None, **more: Any
) -> AntennaDevice:
    """An antenna device; isotropic and vertical where no array is given.

    Args:
        name: Of the device.
        role: ``tx``, ``rx`` or ``both``.
        position: In the axes of its parent, if ``more`` names one, else in the world [m].
        array: Of its elements.
        more: Other fields of `AntennaDevice`.
    """
    x, y, z = map(float, position)
    return AntennaDevice(
        name=name,
        role=role,  # type: ignore[arg-type]
        position=(x, y, z),
        array=array or AntennaArray(),
        **more,
    )


def ends(
    tx: Point, rx: Point, sent: AntennaArray | None = None, taken: AntennaArray | None = None
) -> list[AntennaDevice]:
    """A transmitter ``t`` and a receiver ``r`` at these positions [m], with these arrays."""
    return [antenna("t", "tx", tx, sent), antenna("r", "rx", rx, taken)]


def scene(devices: Sequence[Device], things: Sequence[Thing] = ()) -> Scene:
    """The scene of these devices and objects."""
    things = sorted(things, key=lambda thing: thing.name)

    def column(field: str, width: int) -> Float64Array:
        return np.array([getattr(thing, field) for thing in things], np.float64).reshape(-1, width)

    return Scene(
        names=tuple(thing.name for thing in things),
        classes=("car",) * len(things),
        assets=tuple(thing.asset for thing in things),
        position=column("position", 3),
        orientation=column("quaternion", 4),
        velocity=column("velocity", 3),
        dimensions=column("size", 3),
        devices=tuple(sorted(devices, key=lambda device: device.name)),
        angular_velocity=column("turning", 3) if any(any(thing.turning) for thing in things) else None,
    )


# --- models ---------------------------------------------------------------------------------


def carriers(*frequencies: float) -> tuple[Carrier, ...]:
    """Carriers ``c0``, ``c1``, … at these frequencies [Hz]."""
    return tuple(Carrier(name=f"c{i}", frequency_hz=f) for i, f in enumerate(frequencies))


def free_space(*frequencies: float) -> Model:
    """Rung ``free-space`` at these carriers [Hz].

    Example:
        >>> channel = link(free_space(28e9), (0, 0, 10), (60, 80, 10))  # 100 m
        >>> round(float(-20 * np.log10(abs(channel.a[0, 0]))), 2)  # path loss [dB]
        101.39
    """
    return _prepared(FreeSpaceChannel(FreeSpaceSettings(), _run(frequencies)), {})


def geometric(*frequencies: float, seed: int = 1, **settings: Any) -> Model:
    """Rung ``geometric`` at these carriers [Hz].

    Example:
        >>> channel = link(geometric(28e9, components=3, k_factor_db=10.0), (0, 0, 10), (30, 40, 1.5))
        >>> len(channel.tau), round(float(abs(channel.a[0, 0]) ** 2), 3)  # the straight path has K / (K + 1)
        (3, 0.909)
    """
    converted = convert_settings(GeometricSettings, settings)
    return _prepared(GeometricChannel(converted, _run(frequencies, seed)), {})


def sionna(
    frequencies: float | Sequence[float], assets: Mapping[str, Path] | None = None, **settings: Any
) -> Model:
    """A ray-traced rung at one carrier or several [Hz], in the scenery of these assets.

    Args:
        frequencies: Of the carriers [Hz].
        assets: Of the run, by name; None: there is no scenery.
        settings: Of `SionnaChannel`; one that is None has its default there instead of the lab's.
    """
    from caviar_services.channel.sionna.model import SionnaChannel
    from caviar_services.channel.sionna.settings import SionnaSettings

    several = (frequencies,) if isinstance(frequencies, int | float) else tuple(frequencies)
    given = {"samples": 20_000, "bodies": 2, "receivers_at_once": 8, **settings}
    converted = convert_settings(SionnaSettings, {k: v for k, v in given.items() if v is not None})
    return _prepared(SionnaChannel(converted, _run(several)), assets or {})


class Lab:
    """Ray-traced models in sceneries of plates, each made once.

    Args:
        folder: Where sceneries are written.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._models: dict[str, Model] = {}

    def traced(
        self, frequencies: float | Sequence[float], plates: Sequence[Plate] = (), **settings: Any
    ) -> Model:
        """Rung ``siso-rt`` with one reflection at carriers [Hz], in a scenery of plates."""
        # A warm-up takes seconds, and most cases ask in one of a few worlds.
        key = repr((frequencies, sorted(settings.items()), plates))
        if key not in self._models:
            assets = write_scenery(self._folder / str(len(self._models)), plates) if plates else {}
            given: dict[str, Any] = {"bodies": 1, "receivers_at_once": 4, "max_depth": 1}
            given |= {"outside_itu_range": "nearest", **settings}
            given["materials"] = {
                _skin(plate, plates): {
                    "relative_permittivity": plate.made_of.permittivity,
                    "conductivity_s_per_m": plate.made_of.conductivity,
                }
                for plate in plates
                if plate.made_of is not None
            }
            self._models[key] = sionna(frequencies, assets, **given)
        return self._models[key]


def _run(frequencies: Sequence[float], seed: int = 1) -> RunInfo:
    return RunInfo(name="channel", seed=seed, carriers=carriers(*frequencies))


def _prepared(model: Model, assets: Mapping[str, Path]) -> Model:
    model.prepare(Preparation(demand={"channel": frozenset({"h"})}, assets=assets))
    return model


# --- answers --------------------------------------------------------------------------------


def measure(model: Model, at: Scene, number: int = 0) -> Channel:
    """The product of a model for a scene.

    Args:
        model: Prepared.
        at: The scene.
        number: Of the frame, which what is drawn depends on, with the run's seed.

    Example:
        >>> channel = measure(free_space(28e9), scene(ends((0, 0, 10), (30, 40, 10))))
        >>> round(float(channel.tau[0] * 299_792_458.0), 6)  # [m]
        50.0
    """
    return channel_of(model.step(frame_of(at, number, service=model.run.name, seed=model.run.seed)))


def frame_of(at: Scene, number: int = 0, **more: Any) -> Frame:
    """The frame of a scene, 100 ms after the one before, for a channel model.

    Args:
        at: The scene.
        number: Of the frame, in episode 0.
        more: Other fields of `Frame`.
    """
    provenance = GrantInput(topic="scene", source="world", status=Status.FRESH, frame=number)
    inputs = (FrameInput(provenance, payload=at),)
    return Frame(**{"episode": 0, "number": number, "t_ns": number * 100_000_000, "inputs": inputs, **more})


def channel_of(result: StepResult) -> Channel:
    """The channel product of a frame."""
    channel = result.products["channel"]
    if not isinstance(channel, Channel):
        raise TypeError(f"a channel model made a {type(channel).__name__}")
    return channel


def only_reflection(channel: Channel) -> int:
    """Row of the only path with a reflection. Raises `ValueError` where there is none, or another one."""
    (path,) = np.flatnonzero((channel.interactions == Interaction.REFLECTION).any(1)).tolist()
    return int(path)


def link(model: Model, tx: Point, rx: Point, *things: Thing) -> Channel:
    """The product for two antennas ``t`` and ``r`` at these positions [m]."""
    return measure(model, scene(ends(tx, rx), things))


def total(channel: Channel, carrier: int = 0) -> complex:
    """Sum of the amplitudes of the only pair: H of single elements.

    Example:
        >>> round(abs(total(link(free_space(28e9), (0, 0, 10), (60, 80, 10)))), 9)
        8.52e-06
    """
    return complex(channel.a[carrier].sum())


def pair_sums(channel: Channel, carrier: int = 0) -> Complex128Array:
    """Sum of the amplitudes of each pair, transmitters slowest, Shape ``[T·R]``."""
    return np.array([paths.sum() for paths in np.split(channel.a[carrier], channel.offsets[1:-1])])
