"""The radio map of a scene: surfaces over its ground, and received power, SINR and best server of their
cells."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_protocol.errors import RunError
from caviar_protocol.space.codebooks import DFT
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import AntennaArray, AntennaDevice, Scene
from caviar_services.channel.paths import Antenna
from caviar_services.channel.radio_map.cell_gains import (
    CellGains,
    MeasurementSurface,
    PartDone,
    Shooting,
    cell_gains,
)
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings

PART = 1_000_000
"""Rays that are shot together at most."""

# Fewer rays than that at once are not worth a kernel: the memory is said to be too small.
_LEAST_PART = 20_000

# Memory of a ray and of a cell, and what each beam adds to both: measured, with room to spare.
_RAY_BYTES, _CELL_BYTES = 600, 300
_RAY_BEAM_BYTES, _CELL_BEAM_BYTES = 8, 20


FLOOR_DB = 40.0
"""[dB] below the noise down to which a cell has a signal: a ray of −174 dB in a building is none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Coverage:
    """Gains of T transmitters in a grid of cells, and their powers.

    A receiver has one isotropic element that takes waves of both polarisations.

    Example:
        >>> gains = np.array([[[1e-9, 4e-9]], [[3e-9, 1e-9]]])  # two transmitters, two cells
        >>> found = Coverage(gain=gains, interference_gain=gains, power_w=np.array([1.0, 2.0]), noise_w=1e-12)
        >>> found.best_server.tolist()
        [[1, 0]]
        >>> decibels(found.of_server(found.rss), reference=1e-3).round(1).tolist()  # [dBm]
        [[-52.2, -54.0]]
    """

    gain: Float64Array
    """Mean power gain over each cell with the beam that serves it, Shape ``[T, ny, nx]``; 0: no signal."""
    interference_gain: Float64Array
    """The same while a transmitter serves other cells, Shape ``[T, ny, nx]``."""
    power_w: Float64Array
    """Of the transmitters, Shape ``[T]``."""
    noise_w: float
    """Of the receiver, in the carrier's bandwidth."""

    @cached_property
    def rss(self) -> Float64Array:
        """Received power [W] from each transmitter that serves, Shape ``[T, ny, nx]``."""
        received: Float64Array = self.power_w[:, None, None] * self.gain
        return received

    @cached_property
    def sinr(self) -> Float64Array:
        """Received power over noise and what all other transmitters bring, Shape ``[T, ny, nx]``.

        SINR_k = P_k·g_k / (N_0 + Σ_{j≠k} P_j·i_j) with the gains g and i (`interference_gain`).
        """
        interference = self.power_w[:, None, None] * self.interference_gain
        # Not the sum less one's own: of float rounding, little would be left where one is far stronger.
        others = np.stack([np.delete(interference, t, axis=0).sum(axis=0) for t in range(len(self.power_w))])
        ratio: Float64Array = self.rss / (self.noise_w + others)
        return ratio

    @cached_property
    def best_server(self) -> Int32Array:
        """Index of the transmitter with the greatest received power, Shape ``[ny, nx]``.

        −1: no signal, or one that is more than `FLOOR_DB` below the noise.
        """
        floor = self.noise_w * 10 ** (-FLOOR_DB / 10)
        return np.where(self.rss.max(axis=0) > floor, self.rss.argmax(axis=0), -1).astype(np.int32)

    @property
    def has_signal(self) -> BoolArray:
        """Cells that any transmitter reaches, Shape ``[ny, nx]``."""
        return self.best_server >= 0

    def of_server(self, values: Float64Array) -> Float64Array:
        """Values of the best server, Shape ``[T, ny, nx]`` to ``[ny, nx]``; NaN where there is none."""
        chosen = np.take_along_axis(values, np.maximum(self.best_server, 0)[None], axis=0)[0]
        return np.where(self.has_signal, chosen, np.nan)


def decibels(values: Float64Array, reference: float = 1.0) -> Float64Array:
    """Levels of powers or gains.

    Args:
        values: Of any shape.
        reference: What 0 dB is.

    Returns:
        10·log10(values / reference) [dB]; NaN for 0 and for NaN.

    Example:
        >>> decibels(np.array([1e-9, 0.0])).tolist()
        [-90.0, nan]
    """
    positive = values > 0
    return np.where(positive, 10 * np.log10(np.where(positive, values, 1.0) / reference), np.nan)


BeamChoice = Literal["best", "wide"] | int
"""``best``: in each cell the beam of the transmitter's codebook that brings most. ``wide``: one element, no
beamforming. A number: that beam, everywhere."""


# The solver's test for obstacles of diffracted rays ends after 1 m on a mesh (`spawn_ray_to`, sionna-rt
# 2.2.0).
_NO_DIFFRACTION = (
    "diffraction is left out: Sionna RT's solver finds none over a surface that is not level; a plane has it"
)

_ALL_EDGES = "edges_within_m is left out: in maps all edges diffract"


@dataclass(frozen=True, kw_only=True, eq=False)
class RadioMap:
    """What T transmitters bring to a surface."""

    surface: MeasurementSurface
    names: tuple[str, ...]
    """Names of the transmitters."""
    positions: Float64Array
    """Of the transmitters [m], Shape ``[T, 3]``."""
    power_dbm: Float64Array
    """Shape ``[T]``."""
    coverage: Coverage
    beam: Int32Array
    """Beam that serves each cell, Shape ``[T, ny, nx]``; −1: none, or no signal."""
    rays: Int64Array
    """That passed through each cell, Shape ``[T, ny, nx]``: few rays, large error."""
    shooting: Shooting
    notes: tuple[str, ...]
    """What of the channel's settings the map leaves out, for the user."""


Area = tuple[float, float, float, float]
"""Lowest x and y, highest x and y [m]."""


def level_surface(area: Area, cell: float, z: float) -> MeasurementSurface:
    """A horizontal plane in square cells.

    Args:
        area: Lowest x and y, highest x and y [m]; what the last cell has too much is shared by both sides.
        cell: Side of a cell [m].
        z: Height [m].

    Example:
        >>> level_surface((0.0, 0.0, 10.0, 4.0), cell=2.0, z=1.5).shape
        (2, 5)
    """
    x, y = _edges(area, cell)
    return MeasurementSurface(x, y, np.full((len(y), len(x)), float(z)))


def draped_surface(area: Area, cell: float, height: float, ground: Float64Array) -> MeasurementSurface:
    """Square cells that follow the ground.

    Args:
        area: As in `level_surface`; ``cell`` likewise.
        cell: See ``area``.
        height: Of the cells' corners above the highest ground there [m].
        ground: Triangles [m], Shape ``[F, 3, 3]``.

    Example:
        >>> hill = np.array([[[0.0, 0, 7], [9, 0, 7], [0, 9, 7]]])
        >>> draped_surface((0.0, 0.0, 4.0, 4.0), 2.0, 1.5, hill).shape
        (2, 2)
    """
    x, y = _edges(area, cell)
    return MeasurementSurface(x, y, heights(ground, x, y) + height)


def cell_counts(area: Area, cell: float) -> tuple[int, int]:
    """Number of cells ``(ny, nx)`` that an area [m] needs in cells of one side [m].

    Example:
        >>> cell_counts((0.0, 0.0, 10.0, 5.0), 2.0)
        (3, 5)
    """
    x0, y0, x1, y1 = area
    return max(1, math.ceil((y1 - y0) / cell - 1e-9)), max(1, math.ceil((x1 - x0) / cell - 1e-9))


def _edges(area: Area, cell: float) -> tuple[Float64Array, Float64Array]:
    """Edges of columns and rows; what the last cell has too much is shared by both sides."""
    x0, y0, x1, y1 = area
    ny, nx = cell_counts(area, cell)
    left, bottom = (x0 + x1 - nx * cell) / 2, (y0 + y1 - ny * cell) / 2
    return np.linspace(left, left + nx * cell, nx + 1), np.linspace(bottom, bottom + ny * cell, ny + 1)


def heights(triangles: Float64Array, x: Float64Array, y: Float64Array) -> Float64Array:
    """Height of the highest triangle over each point of a grid.

    Args:
        triangles: Corners [m], Shape ``[F, 3, 3]``.
        x: Of the grid's columns [m], ascending.
        y: Of the grid's rows [m], ascending.

    Returns:
        Heights [m], Shape ``[len(y), len(x)]``; NaN where there is no triangle.

    Example:
        >>> slope = np.array([[[0.0, 0.0, 0.0], [4.0, 0.0, 2.0], [0.0, 4.0, 0.0]]])
        >>> heights(slope, np.array([1.0, 2.0]), np.array([1.0])).tolist()
        [[0.5, 1.0]]
    """
    found = np.full((len(y), len(x)), -np.inf)
    # Each triangle is looked at over the part of the grid in its bounding box alone.
    low, high = triangles[..., :2].min(axis=1), triangles[..., :2].max(axis=1)
    columns = np.searchsorted(x, [low[:, 0] - _RIM, high[:, 0] + _RIM])
    rows = np.searchsorted(y, [low[:, 1] - _RIM, high[:, 1] + _RIM])
    for f in np.flatnonzero((columns[0] < columns[1]) & (rows[0] < rows[1])).tolist():
        at = slice(*rows[:, f].tolist()), slice(*columns[:, f].tolist())
        found[at] = np.maximum(found[at], _height_over(triangles[f], x[at[1]], y[at[0]]))
    return np.where(np.isfinite(found), found, np.nan)


# [m]; a corner of a cell this near to the border of the ground is over it: areas mostly end where ground
# does.
_RIM = 1e-6


def _height_over(triangle: Float64Array, x: Float64Array, y: Float64Array) -> Float64Array:
    """Height of one triangle over a grid, −∞ beside it, by barycentric coordinates."""
    a, b, c = triangle
    (ux, uy, uz), (vx, vy, vz) = b - a, c - a
    area = ux * vy - uy * vx
    if abs(area) < 1e-12:  # upright: it has no height of its own
        return np.full((len(y), len(x)), -np.inf)
    px, py = np.meshgrid(x - a[0], y - a[1])
    s, t = (px * vy - py * vx) / area, (ux * py - uy * px) / area
    rim = _RIM * max(np.hypot(ux, uy), np.hypot(vx, vy)) / abs(area)
    inside = (s >= -rim) & (t >= -rim) & (s + t <= 1 + rim)
    return np.where(inside, a[2] + s * uz + t * vz, -np.inf)


def transmitters_of(scene: Scene, where: str, carrier: str) -> list[AntennaDevice]:
    """The transmitters of a scene that use a carrier.

    Args:
        scene: The scene.
        where: Where it is from, for errors.
        carrier: Name of the carrier.

    Raises:
        RunError: It has no transmitter, or one of dual polarization or with several panels.
    """
    found = [device for device in antennas(scene, "tx") if device.uses(carrier)]
    for device in found:
        if not device.array.is_uniform:
            raise RunError(
                f"{where}: transmitter {device.name!r} has dual polarization or several panels, of which no "
                "map is made; give it one of V, H, -45, +45, RHCP and LHCP and no panels"
            )
    if not found:
        raise RunError(
            f"{where} has no transmitter on carrier {carrier!r}; give a device of [[devices]] the role "
            '"tx", or choose another frame or carrier'
        )
    return found


def beams_of(array: AntennaArray, beam: BeamChoice, name: str) -> range:
    """Beams of the codebook to choose among; none for ``wide`` and for a single element.

    Args:
        array: Of the transmitter.
        beam: The user's choice.
        name: Of the transmitter, for errors.

    Raises:
        RunError: The codebook has no such beam, or is not that of the DFT.

    Example:
        >>> beams_of(AntennaArray(rows=2, columns=4), "best", "bs")
        range(0, 8)
    """
    if beam == "wide" or (beam == "best" and array.size == 1):
        return range(0)
    if array.codebook != DFT:
        raise RunError(
            f"--beam {beam}: maps are made of DFT beams, and {name!r} has the codebook {array.codebook!r}; "
            "write --beam wide"
        )
    if beam == "best":
        return range(array.size)
    if not 0 <= beam < array.size:
        raise RunError(f"--beam {beam}: the codebook of {name!r} has the beams 0 to {array.size - 1}")
    return range(beam, beam + 1)


def part_of(samples: int, cells: int, beams: int, memory: int) -> int:
    """Number of rays that are shot together.

    Args:
        samples: All rays of a transmitter.
        cells: Of the surface.
        beams: Of the transmitter's codebook that are mapped.
        memory: For rays, cells and beams together [bytes].

    Returns:
        Rays of a part, all of one size; 0 where not even a small part fits (`least_memory`).

    Example:
        >>> part_of(samples=3_000_000, cells=10_000, beams=0, memory=2**30)
        1000000
    """
    left = memory - cells * (_CELL_BYTES + _CELL_BEAM_BYTES * beams)
    fitting = left // (_RAY_BYTES + _RAY_BEAM_BYTES * beams)
    if fitting < _LEAST_PART:
        return 0
    part = int(min(samples, PART, fitting))
    # Parts of one size: a last one of another size would be another kernel to compile.
    return math.ceil(samples / math.ceil(samples / part))


def least_memory(cells: int, beams: int) -> int:
    """Memory [bytes] that a map of so many cells and beams needs for the smallest part of rays."""
    of_cells = cells * (_CELL_BYTES + _CELL_BEAM_BYTES * beams)
    return of_cells + _LEAST_PART * (_RAY_BYTES + _RAY_BEAM_BYTES * beams)


def rays_at_once(
    surface: MeasurementSurface, devices: Sequence[AntennaDevice], beam: BeamChoice, samples: int, memory: int
) -> int:
    """Number of rays of each transmitter that are shot together.

    Args:
        surface: Of the map.
        devices: The transmitters.
        beam: The user's choice.
        samples: Rays of each transmitter.
        memory: That the map may take [bytes].

    Raises:
        RunError: The map does not fit; the text names the side of a cell that would.
    """
    ny, nx = surface.shape
    beams = max(len(beams_of(device.array, beam, device.name)) for device in devices)
    part = part_of(samples, nx * ny, beams, memory)
    if part:
        return part
    needed = least_memory(nx * ny, beams)
    side = float(surface.x[1] - surface.x[0])
    # Memory grows with the number of cells, that is with one over the square of their side; 5 % to spare.
    enough = side * np.sqrt(needed / memory) * 1.05
    with_beams = f" and {beams} beams" if beams else ""
    raise RunError(
        f"{nx} × {ny} cells of {side:g} m{with_beams} need {needed / 2**30:.1f} GiB, --memory-gib allows "
        f"{memory / 2**30:.3g}; take cells of {rounded_up(enough):g} m (--cell), a smaller --area"
        + (", --beam wide" if beams > 1 else "")
        + " or more memory"
    )


def radio_map(
    channel: SionnaChannel,
    scene: Scene,
    surface: MeasurementSurface,
    samples: int,
    *,
    carrier: int,
    beam: BeamChoice,
    noise_w: float,
    part: int,
    done: PartDone,
) -> RadioMap:
    """Map what the transmitters of a scene bring to a surface.

    Args:
        channel: With its scene loaded.
        scene: Transmitters, and bodies that hide and reflect.
        surface: Of the map.
        samples: Rays of each transmitter.
        carrier: Index of the carrier among those of the run.
        beam: Of the transmitters.
        noise_w: Of a receiver [W].
        part: As in `cell_gains`; likewise ``done``, which counts the parts of all transmitters.
        done: See ``part``.

    Raises:
        RunError: The scene has no transmitter, or one of which no map is made.

    While another transmitter serves other cells with beams of its codebook, it interferes with each of these
    in turn: in the mean over a unitary codebook, that is the gain of one element.
    """
    devices = transmitters_of(scene, "the scene", channel.run.carriers[carrier].name)
    rt, s = channel.scene, channel.settings
    shooting = Shooting(
        samples=-(-samples // part) * part,  # whole parts
        max_depth=s.max_depth,
        seed=channel.launch_seed % 2**31,
        los=s.los,
        reflection=s.reflection,
        refraction=s.refraction,
        diffraction=s.diffraction and surface.is_level,
        free_edges=s.free_edges and surface.is_level,
        scattering=s.scattering,
    )
    # One carrier at a time: materials of the scene have those constants that it is tuned to.
    rt.make_room(scene, frozenset(s.without_body))
    rt.place(scene, frozenset(s.without_body))
    rt.tune(carrier)
    gain, interference, chosen, rays = [], [], [], []
    try:
        for t, device in enumerate(devices):
            antenna = Antenna.of(scene, device, channel.patterns)
            cleared = replace(antenna, position=rt.surfaces.cleared(antenna.position))
            beams = beams_of(device.array, beam, device.name)

            def counted(part: int, parts: int, t: int = t) -> None:
                done(t * parts + part, len(devices) * parts)

            found = cell_gains(rt, surface, cleared, beams, shooting, part, counted)
            served, index = _served(found, beams)
            air = _transmittance(channel, carrier, surface, antenna.position)
            gain.append(served * air)
            # The mean over a unitary codebook is the element's own gain (Parseval).
            interference.append((served if isinstance(beam, int) else found.element) * air)
            chosen.append(index)
            rays.append(found.rays)
    finally:
        rt.tune(0)
    power_dbm = np.array([device.power_dbm for device in devices])
    return RadioMap(
        surface=surface,
        names=tuple(device.name for device in devices),
        positions=np.array([Antenna.of(scene, device).position for device in devices]),
        power_dbm=power_dbm,
        coverage=Coverage(
            gain=np.stack(gain),
            interference_gain=np.stack(interference),
            power_w=10 ** ((power_dbm - 30) / 10),
            noise_w=noise_w,
        ),
        beam=np.stack(chosen),
        rays=np.stack(rays),
        shooting=shooting,
        notes=_left_out(s, surface),
    )


def _left_out(settings: SionnaSettings, surface: MeasurementSurface) -> tuple[str, ...]:
    """Notes on settings that a map of this surface leaves out."""
    if not settings.diffraction:
        return ()
    if not surface.is_level:
        return (_NO_DIFFRACTION,)
    return (_ALL_EDGES,) * (settings.edges_within_m is not None)


def _served(found: CellGains, beams: range) -> tuple[Float64Array, Int32Array]:
    """Gain of the beam that serves each cell, and its number."""
    if not len(found.beams):
        return found.element, np.full(found.element.shape, -1, np.int32)
    best = found.beams.argmax(axis=0)
    gain = np.take_along_axis(found.beams, best[None], axis=0)[0]
    return gain, np.where(gain > 0, beams.start + best, -1).astype(np.int32)


def _transmittance(
    channel: SionnaChannel, carrier: int, surface: MeasurementSurface, source: Float64Array
) -> Float64Array | float:
    """Share of the power that the air lets through on the straight line to each cell.

    Rays by way of reflections are longer; they lose as little here as the straight line does.
    """
    if channel.absorption_db_per_km is None:
        return 1.0
    km = np.linalg.norm(surface.centres - source, axis=-1) / 1e3
    absorbed: Float64Array = np.nan_to_num(channel.absorption_db_per_km[carrier] * km)
    return 10 ** (-absorbed / 10)


def rounded_up(value: float) -> float:
    """A value above 0, rounded up to two significant digits.

    Example:
        >>> rounded_up(0.1234)
        0.13
    """
    unit = 10 ** (np.floor(np.log10(value)) - 1)
    return float(np.ceil(value / unit) * unit)
