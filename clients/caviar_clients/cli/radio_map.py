"""``caviar plot map``: best server, gain, received power and SINR over a surface: PNG, NumPy archive."""

from __future__ import annotations

import difflib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib import metadata as distribution
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import TimeElapsedColumn, TimeRemainingColumn

from caviar_clients.cli.shared import print_line, progress_bar, require_installed, require_known
from caviar_clients.files import file_in, reserved, writing
from caviar_clients.plots.map import RadioMapView, draw_servers, draw_values
from caviar_clients.plots.rays import footprints
from caviar_clients.session.plausibility import in_hertz
from caviar_clients.session.prepared import PreparedScenario, prepare
from caviar_clients.session.scenes import Scenes, is_recording, scene_at
from caviar_protocol.arrays import Float64Array
from caviar_protocol.errors import RunError, ScenarioError
from caviar_protocol.host import DISTRIBUTION
from caviar_protocol.scenario import ServiceSpec
from caviar_protocol.scenario.conversion import Place, convert_settings
from caviar_protocol.scenario.schema import PATTERNS
from caviar_protocol.space.scene import device_pose
from caviar_protocol.topics import Carrier, Scene
from caviar_services.channel.adaptive.controller import AdaptiveSettings, models
from caviar_services.channel.radio_map import (
    FLOOR_DB,
    Area,
    BeamChoice,
    MeasurementSurface,
    RadioMap,
    cell_counts,
    decibels,
    draped_surface,
    heights,
    level_surface,
    radio_map,
    rays_at_once,
    rounded_up,
    transmitters_of,
)
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.channel.statistical.free_space import FreeSpaceChannel, FreeSpaceSettings
from caviar_services.link.beams import BeamLink, BeamLinkSettings
from caviar_services.link.link_budget import noise_power
from caviar_services.registry import load
from caviar_services.service import Preparation, RunInfo
from caviar_space.ground import ground
from caviar_space.mitsuba_xml import SceneryShape, find_scenery, read_scenery, world_mesh

_MOST_CELLS = 20_000_000
# [m] around devices and objects where there is no scenery.
_AROUND = 100.0

# Pieces of scenery that an error names.
_SHOWN_NAMES = 20

# [m] between lowest and highest ground; beyond, a level plane is hardly meant.
_RELIEF = 2.0


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
    channel: SionnaChannel, scene: Scene, description: Path | None, wanted: MapOptions
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
    area: Area, wanted: MapOptions, shapes: Sequence[SceneryShape]
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
    """Area of the scenery; without any, that around devices and objects."""
    if channel.scene.has_scenery:
        low, high = channel.scene.low, channel.scene.high
    else:
        places = [device_pose(scene, device).position for device in scene.devices]
        around = np.concatenate([np.array(places).reshape(-1, 3), scene.position])
        low, high = around.min(axis=0) - _AROUND, around.max(axis=0) + _AROUND
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


FORMAT = "caviar-radio-map-1"

ARRAYS: Mapping[str, tuple[tuple[str, ...], str, str]] = {
    "x": (("x",), "m", "middle of each column, east"),
    "y": (("y",), "m", "middle of each row, north"),
    "z": (("y", "x"), "m", "height of the middle of each cell; NaN where there is no ground"),
    "transmitter": (("transmitter",), "", "names"),
    "position": (("transmitter", "xyz"), "m", "of the transmitters"),
    "power": (("transmitter",), "dBm", "of the transmitters"),
    "gain": (("transmitter", "y", "x"), "dB", "mean path gain, serving beam; NaN: no signal"),
    "interference_gain": (
        ("transmitter", "y", "x"), "dB", "the same while a transmitter serves other cells",
    ),
    "rss": (("transmitter", "y", "x"), "dBm", "received power with the serving beam"),
    "sinr": (("transmitter", "y", "x"), "dB", "of each transmitter, all others interfering"),
    "best_server": (("y", "x"), "index", "transmitter of the greatest received power; -1: no signal"),
    "beam": (("transmitter", "y", "x"), "index", "serving beam of the codebook; -1: none"),
    "rays": (("transmitter", "y", "x"), "count", "that passed through a cell"),
}  # fmt: skip
"""Axes, unit and meaning of each array of a file."""


def save(found: RadioMap, about: Mapping[str, Any], file: Path) -> None:
    """Write a map as an archive of NumPy: the arrays of `ARRAYS`, and ``metadata`` as JSON.

    Args:
        found: The map.
        about: Becomes part of the metadata.
        file: ``….npz``.

    Raises:
        RunError: The file cannot be written.
    """
    surface, coverage = found.surface, found.coverage
    centres = surface.centres
    arrays = {
        "x": centres[0, :, 0],
        "y": centres[:, 0, 1],
        "z": centres[..., 2],
        "transmitter": np.array(found.names),
        "position": found.positions,
        "power": found.power_dbm,
        "gain": decibels(coverage.gain).astype(np.float32),
        "interference_gain": decibels(coverage.interference_gain).astype(np.float32),
        "rss": decibels(coverage.rss, 1e-3).astype(np.float32),
        "sinr": decibels(coverage.sinr).astype(np.float32),
        "best_server": coverage.best_server,
        "beam": found.beam,
        "rays": found.rays,
    }
    metadata = {
        "format": FORMAT,
        "caviar": distribution.version(DISTRIBUTION),
        **about,
        "shooting": asdict(found.shooting),
        "arrays": {
            name: {"axes": axes, "unit": unit, "meaning": meaning}
            for name, (axes, unit, meaning) in ARRAYS.items()
        },
    }
    # A text of JSON, and no pickled object: an archive from elsewhere can be opened without running its code.
    with writing(file), file.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, metadata=np.array(json.dumps(metadata)), **arrays)


METRICS = {
    "gain": "Path gain of the best server [dB]",
    "rss": "Received power from the best server [dBm]",
    "sinr": "SINR of the best server [dB]",
    "best-server": "",
}
"""What can be drawn, and the label of its colour bar."""

# Fewer rays in a cell leave errors of decibels, of which the user is warned.
_FEW_RAYS = 10
# [m]; farther away, positions in the ray tracer, which are float32, are decimetres apart.
_FARTHEST_M = 1e6
_MOST_GIB = 1e6


@dataclass(frozen=True, kw_only=True)
class MapOptions:
    """Subject of a map, and how fine it is."""

    metrics: tuple[str, ...] = ("gain",)
    """Keys of `METRICS`."""
    height: float = 1.5
    """[m] above the ground."""
    cell: float = 5.0
    """Side of a cell [m]."""
    surface: str = "plane"
    """``plane``, ``ground``, or the name of a piece of scenery that the cells follow."""
    area: Area | None = None
    """Lowest x and y, highest x and y [m]; None: all of the scenery."""
    frame: int = 0
    """Instant of the first episode."""
    carrier: str | None = None
    """None: the first."""
    beam: BeamChoice = "best"
    samples: int = 10_000_000
    """Rays of each transmitter."""
    memory_gib: float = 2.0
    """Memory that the map may take [GiB]."""

    def __post_init__(self) -> None:
        """Refuse values that the command line cannot.

        Raises:
            RunError: A value is none of those that an option takes.
        """
        for metric in self.metrics:
            require_known("--metric", metric, METRICS)
        # Negated comparisons, which NaN does not pass either.
        if not abs(self.height) <= _FARTHEST_M:
            raise RunError(f"--height {self.height:g}: write a height in metres, at most {_FARTHEST_M:,.0f}")
        if not 0 < self.cell <= _FARTHEST_M:
            side = "write the side of a cell in metres, above 0, at most"
            raise RunError(f"--cell {self.cell:g}: {side} {_FARTHEST_M:,.0f}")
        if self.area is not None:
            x0, y0, x1, y1 = self.area
            if not (x0 < x1 and y0 < y1 and all(map(math.isfinite, self.area))):
                given = " ".join(f"{value:g}" for value in self.area)
                raise RunError(f"--area {given}: write lowest x and y, then highest x and y, in metres")
        if not 0 < self.memory_gib <= _MOST_GIB:
            limits = f"above 0 and at most {_MOST_GIB:,.0f}"
            raise RunError(f"--memory-gib {self.memory_gib:g}: write GiB, {limits}")


def beam_choice(text: str) -> BeamChoice:
    """Read the option ``--beam``: ``best``, ``wide``, or the number of a beam.

    Raises:
        RunError: It is none of these.

    Example:
        >>> beam_choice("best"), beam_choice("7")
        ('best', 7)
    """
    if text == "best" or text == "wide":
        return "best" if text == "best" else "wide"
    if not (text.isdecimal() and len(text) < 10):
        raise RunError(f"--beam {text!r:.40}: write best, wide, or the number of a beam of the codebook")
    return int(text)


def draw_radio_map(source: Path, out: Path | None, options: MapOptions, console: Console) -> list[Path]:
    """Map a scenario or a recording, and write pictures and arrays.

    Args:
        source: A scenario, or the directory of a run that recorded ``scene``.
        out: File of the picture, into whose name go those of several metrics; the arrays are beside it, in a
            file ``….npz``. None: ``radio-map.png`` in this folder, or in that of the run.
        options: What is mapped.
        console: Where progress, warnings and figures are shown.

    Returns:
        The files: a picture for each metric, and the arrays.

    Raises:
        SetupError: The ray tracer or Matplotlib is not installed.
        ScenarioError: The scenario is wrong, or cannot be mapped.
        RunError: An option names nothing, or a file cannot be written; nothing was computed then.
    """
    require_installed("a radio map", ("channel", "plot"))
    picture = out or (source if is_recording(source) and source.is_dir() else Path()) / "radio-map.png"
    if picture.is_dir():
        raise RunError(f"--out {picture} {file_in(picture, 'radio-map.png')}")
    if picture.suffix.lower() != ".png":
        raise RunError(f"--out {picture}: a radio map is a PNG; write a name that ends in .png")
    several = len(options.metrics) > 1
    pictures = {
        metric: picture.with_stem(f"{picture.stem}-{metric}") if several else picture
        for metric in options.metrics
    }
    arrays = picture.with_suffix(".npz")
    prepared = None if is_recording(source) else prepare(source)
    for warning in prepared.warnings if prepared else ():
        print_line(console, f"warning: {warning}")
    with reserved(*pictures.values(), arrays):
        mapped = _mapped(source, prepared, options, console)
        save(mapped.found, mapped.metadata, arrays)
        found, drawn = mapped.found, None
        if mapped.scenery is not None:
            shapes = read_scenery(mapped.scenery).shapes
            drawn = footprints((shape.file, shape.to_world) for shape in shapes)
        x, y = found.surface.x.tolist(), found.surface.y.tolist()
        view = RadioMapView(
            area=(x[0], y[0], x[-1], y[-1]),
            transmitters=found.names,
            positions=found.positions[:, :2],
            scene=mapped.scene,
            footprints=drawn,
            title=mapped.title,
        )
        coverage = found.coverage
        for metric, file in pictures.items():
            if metric == "best-server":
                draw_servers(view, coverage.best_server, file)
                continue
            values = {"gain": coverage.gain, "rss": coverage.rss, "sinr": coverage.sinr}[metric]
            served = decibels(coverage.of_server(values), 1e-3 if metric == "rss" else 1.0)
            draw_values(view, served, METRICS[metric], file)
    for line in _summary(mapped):
        print_line(console, line)
    return [*pictures.values(), arrays]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Mapped:
    found: RadioMap
    notes: tuple[str, ...]
    """What is unusual about the cells, and what of the settings the map leaves out."""
    metadata: dict[str, Any]
    scene: Scene
    title: str
    scenery: Path | None


def _mapped(
    source: Path, prepared: PreparedScenario | None, options: MapOptions, console: Console
) -> _Mapped:
    scenes = scene_at(source, options.frame, prepared)
    instant = scenes.instants[0]
    index = carrier_of(scenes.carriers, options.carrier)
    carrier = scenes.carriers[index]
    where = f"frame {options.frame} of {scenes.origin}"
    devices = transmitters_of(instant.scene, where, carrier.name)
    channel, assets = channel_of(scenes, instant.scene)
    noise_w, noise = noise_of(scenes.services, carrier)
    times = (TimeElapsedColumn(), "left", TimeRemainingColumn())
    with progress_bar(console, *times, transient=True) as bar:
        task = bar.add_task("loading the scene", total=None)
        preparation = Preparation(demand={}, assets=assets)
        channel.load_patterns(preparation)
        channel.load_scene(preparation)
        surface, about, notes = surface_of(channel, instant.scene, find_scenery(assets), options)
        # The rays of a transmitter are shot in parts that fit into the memory, and their powers are added.
        memory = int(options.memory_gib * 2**30)
        part = rays_at_once(surface, devices, options.beam, options.samples, memory)
        bar.update(task, description="shooting rays")
        found = radio_map(
            channel, instant.scene, surface, options.samples,
            carrier=index, beam=options.beam, noise_w=noise_w, part=part,
            done=lambda done, parts: bar.update(task, completed=done, total=parts),
        )  # fmt: skip
    metadata = {
        "scenario": scenes.name,
        "source": scenes.origin,
        "frame": instant.frame,
        "t_ns": instant.t_ns,
        "carrier": carrier.name,
        "frequency_hz": carrier.frequency_hz,
        "bandwidth_hz": carrier.bandwidth_hz,
        "surface": about,
        "cell_m": options.cell,
        "beam": options.beam,
        "noise": noise,
        "noise_w": noise_w,
    }
    at = f"frame {instant.frame}, t = {instant.t_ns * 1e-9:.2f} s, {in_hertz(carrier.frequency_hz)}"
    beams = {"best": "best beam of each cell", "wide": "one element"}
    served = beams.get(str(options.beam), f"beam {options.beam}")
    return _Mapped(
        found=found,
        notes=(*notes, *found.notes),
        metadata=metadata,
        scene=instant.scene,
        title=f"{scenes.name}: {at}\n{about}, {served}",
        scenery=find_scenery(assets),
    )


def _summary(mapped: _Mapped) -> Iterator[str]:
    """Lines for the screen."""
    found, coverage = mapped.found, mapped.found.coverage
    cells, reached = found.surface.covered, coverage.has_signal
    ny, nx = found.surface.shape
    share = np.count_nonzero(reached) / max(int(np.count_nonzero(cells)), 1)
    yield f"{nx} × {ny} cells of {mapped.metadata['cell_m']:g} m, {mapped.metadata['surface']}"
    yield f"noise {10 * math.log10(coverage.noise_w) + 30:.1f} dBm: {mapped.metadata['noise']}"
    yield from mapped.notes
    yield f"{share:.1%} of the cells have a signal, which is at most {FLOOR_DB:g} dB below the noise"
    if not reached.any():
        heights = ", ".join(
            f"{name!r} at z = {at[2]:g} m" for name, at in zip(found.names, found.positions, strict=True)
        )
        yield (
            f"warning: no ray passed through a cell, with {heights}; see whether a transmitter stands below "
            "the ground or inside of something, and whether --height and --area are where its waves go"
        )
    # Cells at the edges of shadows have few rays in every map: a tenth of all passes without a warning.
    few = np.count_nonzero(found.rays.max(axis=0)[reached] < _FEW_RAYS) / max(int(reached.sum()), 1)
    if few > 0.1:
        yield (
            f"fewer than {_FEW_RAYS} rays passed through {few:.0%} of these; their errors are decibels. Give "
            "more --samples or a larger --cell"
        )
    for t, name in enumerate(found.names):
        served = coverage.best_server == t
        if served.any():
            gain, sinr = (np.median(decibels(v[t][served])) for v in (coverage.gain, coverage.sinr))
            of = np.count_nonzero(served) / np.count_nonzero(reached)
            yield f"{name} serves {of:.1%} of these: median path gain {gain:.1f} dB, SINR {sinr:.1f} dB"
