"""What a radio map is made of: the channel of a run, its carrier and noise, and the cells."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from caviar_clients.cli.shared import require_known
from caviar_clients.session.plausibility import in_hertz
from caviar_clients.session.scenes import Scenes
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import RunError, ScenarioError
from caviar_protocol.scenario import ServiceSpec
from caviar_protocol.scenario.conversion import Place, convert_settings
from caviar_protocol.scenario.schema import PATTERNS
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import Carrier, Scene
from caviar_services.channel.adaptive.controller import AdaptiveSettings, models
from caviar_services.channel.radio_map import (
    Area,
    MeasurementSurface,
    cell_counts,
    draped_surface,
    heights,
    level_surface,
    rounded_up,
)
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.link.beams import BeamLink, BeamLinkSettings
from caviar_services.link.link_budget import noise_power
from caviar_services.registry import load
from caviar_services.service import RunInfo
from caviar_space.ground import ground
from caviar_space.mitsuba_xml import SceneryShape, read_scenery, world_mesh

_MOST_CELLS = 20_000_000
# [m] around devices and objects where there is no scenery.
_AROUND = 100.0

# Pieces of scenery that an error names.
_SHOWN_NAMES = 20

# [m] between lowest and highest ground; beyond, a level plane is hardly meant.
_RELIEF = 2.0


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """The cells that are wanted."""

    height: float = 1.5
    """[m] above the ground."""
    cell: float = 5.0
    """Side of a cell [m]."""
    surface: str = "plane"
    """``plane``, ``ground``, or the name of a piece of scenery that the cells follow."""
    area: Area | None = None
    """Lowest x and y, highest x and y [m]; None: all of the scenery."""


def carrier_of(carriers: Sequence[Carrier], name: str | None) -> int:
    """Find the carrier that is mapped.

    Args:
        carriers: Of the scenario.
        name: The one asked for; None: the first.

    Returns:
        Its index.

    Raises:
        ScenarioError: The scenario has no carrier.
        RunError: The carrier does not exist.
    """
    names = [carrier.name for carrier in carriers]
    if not names:
        raise ScenarioError(
            "a radio map needs a carrier; add [[carriers]] with name and frequency_hz", key="carriers"
        )
    if name is None:
        return 0
    require_known("--carrier", name, names)
    return names.index(name)


def channel_of(scenes: Scenes, scene: Scene) -> tuple[SionnaChannel, Mapping[str, Path]]:
    """Make the ray-traced channel of a run: of an adaptive one the highest rung that traces rays.

    Args:
        scenes: The scenario or the recording.
        scene: Has the objects.

    Returns:
        The channel, and its files by asset name: scenery, and patterns of antennas.

    Raises:
        RunError: The run has no channel that traces rays.
        ScenarioError: The channel has foliage or people who are screens, which a map leaves out.
    """
    refused = []
    for name, spec in scenes.services.items():
        if spec.role != "channel":
            continue
        cls, place = load("channel", spec.use), Place("services").at(name).at("settings")
        settings = convert_settings(cls.Settings, spec.settings, place)
        run = RunInfo(
            name=name,
            seed=scenes.seed,
            sampling_period_ns=scenes.sampling_period_ns,
            carriers=scenes.carriers,
            devices=scenes.devices,
        )
        if isinstance(settings, AdaptiveSettings):
            traced = [model for model in models(settings, place) if issubclass(model[0], SionnaChannel)]
            cls, settings = traced[-1] if traced else (cls, settings)
        if issubclass(cls, SionnaChannel) and isinstance(settings, SionnaSettings):
            if settings.foliage:
                raise place.at("foliage").error(
                    "radio maps have no volumes that attenuate; map a scenario without foliage, and without "
                    "the pieces of scenery and objects that are"
                )
            if settings.human_blockage is not None:
                raise place.at("human_blockage").error(
                    "radio maps have no people who are screens; map a scenario without human_blockage"
                )
            return cls(settings, run), scenes.assets
        if issubclass(cls, FreeSpaceChannel) and isinstance(settings, FreeSpaceSettings):
            # Free space is a ray tracer without interactions, in a scene without objects.
            nothing = SionnaSettings(
                atmosphere=settings.atmosphere,
                max_depth=0,
                reflection=False,
                bodies=0,
                without_body=tuple(sorted(set(scene.classes))),
            )
            patterns = {name: file for name, file in scenes.assets.items() if name.startswith(PATTERNS)}
            return SionnaChannel(nothing, run), patterns
        refused.append(f"channel {name!r} is {spec.use!r}, which traces no rays")
    what = "; ".join(refused) or f"{scenes.origin} has no channel"
    raise RunError(
        f"{what}; a radio map is made with the channel sionna-rt, adaptive or free-space, and of a recording "
        "without classes named module:Class, which are not loaded"
    )


def noise_of(services: Mapping[str, ServiceSpec], carrier: Carrier) -> tuple[float, str]:
    """Work out the noise power of a receiver from the settings of the first link.

    Args:
        services: Of the scenario.
        carrier: Has the bandwidth.

    Returns:
        Noise power [W], and in words what it follows from.
    """
    for name, spec in services.items():
        if spec.role == "link" and issubclass(load("link", spec.use), BeamLink):
            settings = convert_settings(
                BeamLinkSettings, spec.settings, Place("services").at(name).at("settings")
            )
            origin = f"of link {name!r}"
            break
    else:
        settings, origin = BeamLinkSettings(), "by default"
    figure, temperature = settings.noise_figure_db, settings.temperature_k
    return (
        noise_power(carrier, figure, temperature),
        f"{in_hertz(carrier.bandwidth_hz)}, noise figure {figure:g} dB and {temperature:g} K {origin}",
    )


def surface_of(
    channel: SionnaChannel, scene: Scene, description: Path | None, wanted: Wanted
) -> tuple[MeasurementSurface, str, tuple[str, ...]]:
    """Make the cells of a map.

    Args:
        channel: Has loaded its scene.
        scene: Has devices and objects, around which cells are where there is no scenery.
        description: File of the scenery; None: there is none.
        wanted: Which cells.

    Returns:
        The cells, in words what they are at or over, and notes for the user.

    Raises:
        RunError: There is no such surface, nothing of it is in the area, or there are too many cells.
    """
    area = wanted.area or _area(channel, scene)
    _check_size(area, wanted.cell)
    shapes = read_scenery(description).shapes if description else ()
    if wanted.surface == "plane":
        surface, ground_notes = _plane(area, wanted, shapes)
        about = f"plane at z = {surface.z[0, 0]:g} m"
        return surface, about, (*_beside(channel, area), *ground_notes)
    surface = draped_surface(area, wanted.cell, wanted.height, _ground(wanted.surface, shapes))
    if not surface.covered.any():
        raise RunError(
            f"--surface {wanted.surface!r}: none of it is in the area; choose another --area, "
            "--surface plane, or a piece of the scenery by its name"
        )
    return surface, f"{wanted.height:g} m above {wanted.surface!r}", ()


def _check_size(area: Area, cell: float) -> None:
    """Raise `RunError` with the cell that is large enough where there are too many."""
    x0, y0, x1, y1 = area
    # As a float first, which may be infinite: the whole numbers of rows and columns may not.
    count = max(1.0, (x1 - x0) / cell) * max(1.0, (y1 - y0) / cell)
    if count < _MOST_CELLS and math.prod(cell_counts(area, cell)) <= _MOST_CELLS:
        return
    enough = max(math.sqrt((x1 - x0) * (y1 - y0) / _MOST_CELLS), max(x1 - x0, y1 - y0) / _MOST_CELLS) * 1.01
    if not math.isfinite(enough):
        raise RunError(
            f"--area {x0:g} {y0:g} {x1:g} {y1:g} is {x1 - x0:g} × {y1 - y0:g} m; take a smaller one"
        )
    raise RunError(
        f"--cell {cell:g} makes {count:.2g} cells, at most {_MOST_CELLS:,} can be; take cells of "
        f"{rounded_up(enough):g} m or a smaller --area"
    )


def _beside(channel: SionnaChannel, area: Area) -> tuple[str, ...]:
    """A warning where no cell is over or under any scenery."""
    if not channel.scene.has_scenery:
        return ()
    (x0, y0, _), (x1, y1, _) = channel.scene.low.tolist(), channel.scene.high.tolist()
    if area[0] < x1 and area[2] > x0 and area[1] < y1 and area[3] > y0:
        return ()
    reach = f"x {x0:.4g} to {x1:.4g} m, y {y0:.4g} to {y1:.4g} m"
    return (f"warning: the area is beside the scenery, which reaches {reach}",)


def _plane(
    area: Area, wanted: Wanted, shapes: Sequence[SceneryShape]
) -> tuple[MeasurementSurface, tuple[str, ...]]:
    """A level surface above the lowest ground, and notes about ground that is above it."""
    pieces = ground((shape.file, shape.to_world) for shape in shapes)
    triangles = np.concatenate([np.zeros((0, 3, 3)), *map(_upward, pieces)])
    level = triangles[..., 2]
    surface = level_surface(area, wanted.cell, wanted.height + (float(level.min()) if level.size else 0.0))
    notes = []
    if level.size and np.ptp(level) > _RELIEF:
        notes.append(f"the ground rises by {np.ptp(level):.0f} m, --surface ground follows it")
    if level.size and level.max() > surface.z[0, 0]:
        # The height of the ground under every cell is looked up only where some ground is above the cells.
        x, y = surface.centres[0, :, 0], surface.centres[:, 0, 1]
        buried = np.count_nonzero(heights(triangles, x, y) > surface.z[0, 0]) / (len(x) * len(y))
        if buried:
            notes.append(f"{buried:.1%} of the cells are below what is taken as ground")
    return surface, tuple(notes)


def _upward(piece: Float64Array) -> Float64Array:
    """Upward triangles of a piece of ground: of a slab its top; all of a sheet that faces down."""
    upward = np.cross(piece[:, 1] - piece[:, 0], piece[:, 2] - piece[:, 0])[:, 2] > 0.0
    return piece[upward] if upward.any() else piece


def _ground(name: str, shapes: Sequence[SceneryShape]) -> Float64Array:
    """Triangles [m] that the cells are over: those of all ground, or of a piece of scenery."""
    if name == "ground":
        return np.concatenate([np.zeros((0, 3, 3)), *ground((s.file, s.to_world) for s in shapes)])
    named = [shape for shape in shapes if shape.name == name]
    if named:
        return _triangles(named)
    names = sorted(shape.name for shape in shapes)
    near = difflib.get_close_matches(name, ("plane", "ground", *names), n=1)
    pieces = ", ".join(names[:_SHOWN_NAMES]) + (f", … {len(names)} in all" * (len(names) > _SHOWN_NAMES))
    remedy = (
        f"did you mean {near[0]!r}?"
        if near
        else f"write plane, ground or the name of a piece of scenery: {pieces or 'there is none'}"
    )
    raise RunError(f"--surface {name!r} does not exist; {remedy}")


def _triangles(shapes: Sequence[SceneryShape]) -> Float64Array:
    """Triangles [m] of pieces of scenery, Shape ``[F, 3, 3]``."""
    meshes = [world_mesh(shape) for shape in shapes]
    return np.concatenate([np.zeros((0, 3, 3)), *(mesh.vertices[mesh.faces] for mesh in meshes)])


def _area(channel: SionnaChannel, scene: Scene) -> Area:
    """All of the scenery; without any, what is around devices and objects."""
    if channel.scene.has_scenery:
        low, high = channel.scene.low, channel.scene.high
    else:
        places = [device_pose(scene, device).position for device in scene.devices]
        around = np.concatenate([np.array(places).reshape(-1, 3), scene.position])
        low, high = around.min(axis=0) - _AROUND, around.max(axis=0) + _AROUND
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
