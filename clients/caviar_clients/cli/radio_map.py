"""``caviar plot map``: best server, gain, received power and SINR over a surface: PNG, NumPy archive."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib import metadata as distribution
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import TimeElapsedColumn, TimeRemainingColumn

from caviar_clients.cli.radio_map_inputs import Wanted, carrier_of, channel_of, noise_of, surface_of
from caviar_clients.cli.shared import print_line, progress_bar, require_installed, require_known
from caviar_clients.files import file_in, reserved, writing
from caviar_clients.plots.map import RadioMapView, draw_servers, draw_values
from caviar_clients.plots.rays import footprints
from caviar_clients.session.checks import checked_scenario
from caviar_clients.session.plausibility import implausible_values, in_hertz
from caviar_clients.session.scenes import is_recording, scene_at
from caviar_protocol.errors import RunError
from caviar_protocol.host import DISTRIBUTION
from caviar_protocol.topics import Scene
from caviar_services.channel.radio_map import (
    FLOOR_DB,
    BeamChoice,
    Coverage,
    RadioMap,
    decibels,
    radio_map,
    rays_at_once,
    transmitters_of,
)
from caviar_services.service import Preparation
from caviar_space.mitsuba_xml import find_scenery, read_scenery

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
    """What is mapped, and how finely."""

    metrics: tuple[str, ...] = ("gain",)
    """Keys of `METRICS`."""
    cells: Wanted = field(default_factory=Wanted)
    frame: int = 0
    """Instant of the first episode."""
    carrier: str | None = None
    """None: the first."""
    beam: BeamChoice = "best"
    samples: int = 10_000_000
    """Rays of each transmitter."""
    memory_gib: float = 2.0
    """Memory that the map may take [GiB]."""


def options_of(metrics: Sequence[str] | None, cells: Wanted, beam: str, **others: Any) -> MapOptions:
    """Make options from those of the command line.

    Args:
        metrics: Keys of `METRICS`; None: ``gain``.
        cells: Which cells.
        beam: ``best``, ``wide``, or the number of a beam.
        others: Fields of `MapOptions`.

    Raises:
        RunError: A value is none of those that an option takes.

    Example:
        >>> options_of(["rss", "rss"], Wanted(cell=2.0), "7", frame=3).metrics
        ('rss',)
    """
    chosen = tuple(dict.fromkeys(metrics or ("gain",)))
    for metric in chosen:
        require_known("--metric", metric, METRICS)
    # Negated comparisons, which NaN does not pass either.
    if not abs(cells.height) <= _FARTHEST_M:
        raise RunError(f"--height {cells.height:g}: write a height in metres, at most {_FARTHEST_M:,.0f}")
    if not 0 < cells.cell <= _FARTHEST_M:
        raise RunError(
            f"--cell {cells.cell:g}: write the side of a cell in metres, above 0, at most {_FARTHEST_M:,.0f}"
        )
    if cells.area is not None:
        x0, y0, x1, y1 = cells.area
        if not (x0 < x1 and y0 < y1 and all(map(math.isfinite, cells.area))):
            given = " ".join(f"{value:g}" for value in cells.area)
            raise RunError(f"--area {given}: write lowest x and y, then highest x and y, in metres")
    options = MapOptions(metrics=chosen, cells=cells, beam=_beam(beam), **others)
    if not 0 < options.memory_gib <= _MOST_GIB:
        raise RunError(
            f"--memory-gib {options.memory_gib:g}: write GiB, above 0 and at most {_MOST_GIB:,.0f}"
        )
    return options


def _beam(text: str) -> BeamChoice:
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
    if not is_recording(source):
        for warning in implausible_values(checked_scenario(source)):
            print_line(console, f"warning: {warning}")
    with reserved(*pictures.values(), arrays):
        mapped = _mapped(source, options, console)
        save(mapped.found, mapped.metadata, arrays)
        view = _view(mapped)
        for metric, file in pictures.items():
            _draw(view, mapped.found.coverage, metric, file)
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


def _mapped(source: Path, options: MapOptions, console: Console) -> _Mapped:
    scenes = scene_at(source, options.frame)
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
        surface, about, notes = surface_of(channel, instant.scene, find_scenery(assets), options.cells)
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
        "cell_m": options.cells.cell,
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


def _view(mapped: _Mapped) -> RadioMapView:
    found, drawn = mapped.found, None
    if mapped.scenery is not None:
        shapes = read_scenery(mapped.scenery).shapes
        drawn = footprints((shape.file, shape.to_world) for shape in shapes)
    x, y = found.surface.x.tolist(), found.surface.y.tolist()
    return RadioMapView(
        area=(x[0], y[0], x[-1], y[-1]),
        transmitters=found.names,
        positions=found.positions[:, :2],
        scene=mapped.scene,
        footprints=drawn,
        title=mapped.title,
    )


def _draw(view: RadioMapView, coverage: Coverage, metric: str, file: Path) -> None:
    if metric == "best-server":
        draw_servers(view, coverage.best_server, file)
        return
    values = {"gain": coverage.gain, "rss": coverage.rss, "sinr": coverage.sinr}[metric]
    reference = 1e-3 if metric == "rss" else 1.0
    draw_values(view, decibels(coverage.of_server(values), reference), METRICS[metric], file)


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
