"""Radio maps: what transmitters bring to every cell of a surface over a scene's ground, by shooting rays
through it, and received power, SINR and best server of the cells.

Sionna RT's `RadioMapSolver` shoots rays from a transmitter and adds up the power of those that pass through
each cell (A. Aoudia et al., "Sionna RT: Technical Report", 2025, section 4). It knows one precoding vector
and one polarisation model, so that a codebook of 64 beams would be shot 64 times. Here the field that leaves
is that of the channel engine's own element pattern (`Antenna.radiated`), and each ray that passes through a
cell is counted once for every beam (`cell_gains`), with the beam's gain in the direction in which it left: a
single-polarised array in the far field is the element times its array factor.

A surface is a grid of cells, level or draped over the ground. The solver intersects rays with a level one by
formula; of another one a mesh with two triangles for each cell stands in the scene while rays are shot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_protocol.errors import RunError
from caviar_protocol.space.codebooks import DFT
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import AntennaArray, AntennaDevice, Scene
from caviar_services.channel.paths import Antenna
from caviar_services.channel.propagation.patterns import spherical_basis
from caviar_services.channel.sionna import dr, mi
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.ray_launcher import spread_directions
from caviar_services.channel.sionna.scene import SionnaScene
from caviar_services.channel.sionna.scene_loading import Shape, mi_mesh
from caviar_services.channel.sionna.settings import SionnaSettings
from caviar_services.drjit_setup import aligned_columns, aligned_indices
from caviar_space.meshes import Mesh

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
    """Radio map: power of T transmitters on a surface."""

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


@dataclass(frozen=True, eq=False)
class MeasurementSurface:
    """Cells that are squares from above: ``nx`` along x, ``ny`` along y."""

    x: Float64Array
    """Edges of the columns [m], ascending, Shape ``[nx + 1]``."""
    y: Float64Array
    """Edges of the rows [m], ascending, Shape ``[ny + 1]``."""
    z: Float64Array
    """Height of the cells' corners [m], Shape ``[ny + 1, nx + 1]``; NaN where there is no ground."""

    @property
    def shape(self) -> tuple[int, int]:
        """``(ny, nx)``."""
        return len(self.y) - 1, len(self.x) - 1

    @property
    def is_level(self) -> bool:
        """True for a horizontal plane without a gap."""
        return bool((self.z == self.z[0, 0]).all())

    @property
    def centres(self) -> Float64Array:
        """Middle of each cell [m], Shape ``[ny, nx, 3]``; NaN heights where a corner has no ground."""
        x, y = np.meshgrid((self.x[:-1] + self.x[1:]) / 2, (self.y[:-1] + self.y[1:]) / 2)
        z = self.z
        return np.stack([x, y, (z[:-1, :-1] + z[:-1, 1:] + z[1:, :-1] + z[1:, 1:]) / 4], axis=-1)

    @property
    def covered(self) -> BoolArray:
        """Cells that have ground at all four corners, Shape ``[ny, nx]``."""
        there: BoolArray = np.isfinite(self.centres[..., 2])
        return there

    def triangles(self) -> tuple[Mesh, Int64Array]:
        """Two triangles for each covered cell, with upward normals, and the flat index of their cells,
        Shape ``[F]``."""
        _, nx = self.shape
        x, y = np.meshgrid(self.x, self.y)
        vertices = np.stack([x, y, self.z], axis=-1).reshape(-1, 3)
        cells = np.flatnonzero(self.covered)
        first = cells // nx * (nx + 1) + cells % nx
        squares = first[:, None] + [0, 1, nx + 2, 0, nx + 2, nx + 1]
        faces = squares.reshape(-1, 3).astype(np.int32)
        used, compact = np.unique(faces, return_inverse=True)
        return Mesh(vertices[used], compact.reshape(-1, 3).astype(np.int32)), np.repeat(cells, 2)


_SURFACE, _SOURCE = "caviar-measurement-surface", "caviar-map-source"

PartDone = Callable[[int, int], None]
"""``done(part, parts)``: called after each part of the rays."""


@dataclass(frozen=True, kw_only=True)
class Shooting:
    """Options of a radio map's rays, and their number."""

    samples: int
    """Rays of a transmitter; rounded up to whole parts."""
    max_depth: int
    seed: int
    los: bool = True
    reflection: bool = True
    refraction: bool = False
    diffraction: bool = False
    free_edges: bool = False
    """Whether edges at which one face ends and no other begins diffract, too."""
    scattering: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class CellGains:
    """Mean power gains over each cell of a surface, towards one isotropic element of both polarisations."""

    element: Float64Array
    """Of one element without beamforming, Shape ``[ny, nx]``. It is also the mean over all beams of a
    unitary codebook, by Parseval's theorem."""
    beams: Float64Array
    """Of each beam, Shape ``[B, ny, nx]``."""
    rays: Int64Array
    """That passed through each cell, Shape ``[ny, nx]``."""


def cell_gains(
    scene: SionnaScene,
    surface: MeasurementSurface,
    transmitter: Antenna,
    beams: range,
    shooting: Shooting,
    part: int,
    done: PartDone,
) -> CellGains:
    """Shoot the rays of one transmitter, at the carrier that the scene is tuned to.

    Args:
        scene: Loaded, with its bodies in place.
        surface: Whose cells are counted.
        transmitter: Where it is traced from.
        beams: Numbers of beams of the transmitter's codebook, B of them; none: only the element's gain.
        shooting: What rays do, and how many there are.
        part: Rays that are shot together.
        done: Called after each part.
    """
    from sionna.rt import Transmitter

    ny, nx = surface.shape
    parts = math.ceil(shooting.samples / part)
    total, rays = np.zeros((len(beams) + 1, ny * nx)), np.zeros(ny * nx, np.int64)
    rt_scene = scene.rt_scene
    place = (transmitter.position - scene.centre).tolist()
    rt_scene.add(Transmitter(_SOURCE, position=place))
    try:
        rt_scene.tx_array = _one_element(transmitter)
        solver: Any = _solver(rt_scene, surface, scene.centre, transmitter, beams)
        for number in range(parts):
            with _launched(spread_directions(part * parts, number, parts)):
                sums, passed = solver.shoot(part, shooting, shooting.seed + number)
            total += sums
            rays += passed
            done(number + 1, parts)
    finally:
        rt_scene.remove(_SOURCE)
    # Each part is an estimate of its own, with as many rays.
    total /= parts
    grids = total.reshape(-1, ny, nx)
    return CellGains(element=grids[0], beams=grids[1:], rays=rays.reshape(ny, nx))


def beam_gains(antenna: Antenna, beams: range, directions: Any) -> Any:
    """Power gain of beams of the DFT codebook over one element, towards R directions of the world.

    ``|atᵀ f|²`` with the steering vector at: N at the most, and 1 in the mean over the whole codebook. For a
    uniform planar array it is the product of two Dirichlet kernels, one along the columns and one along the
    rows (C. A. Balanis, Antenna Theory, 3rd ed., eq. 6-10c and section 6.10.1); beams are those of
    `caviar_protocol.space.antenna_arrays.dft_codebook`.

    Args:
        directions: Unit vectors, a `mitsuba.Vector3f` of width R.

    Returns:
        Of each beam the gains in all directions, one beam after the other, width ``len(beams)·R``.
    """
    array, count = antenna.array, dr.width(directions)
    index = dr.arange(mi.UInt, len(beams) * count)
    beam = dr.opaque(mi.UInt, beams.start) + index // dr.opaque(mi.UInt, count)
    towards = dr.gather(mi.Vector3f, directions, index % dr.opaque(mi.UInt, count))
    y_axis, z_axis = (dr.opaque(mi.Vector3f, antenna.rotation[:, axis].tolist()) for axis in (1, 2))
    across = dr.opaque(mi.Float, array.horizontal_spacing) * dr.dot(towards, y_axis)
    up = dr.opaque(mi.Float, array.vertical_spacing) * dr.dot(towards, z_axis)
    rows = dr.opaque(mi.UInt, array.rows)
    column, row = mi.Float(beam // rows), mi.Float(beam % rows)
    gains = _kernel_power(across - column / mi.Float(dr.opaque(mi.UInt, array.columns)), array.columns)
    gains *= _kernel_power(up + row / mi.Float(rows), array.rows)
    dr.eval(gains)
    return gains


def _kernel_power(x: Any, size: int) -> Any:
    """``|Σ_n exp(j2πnx)|² / size`` over ``size`` elements."""
    # The kernel has period 1; near 0 both sines vanish and the quotient is the number of elements.
    turned, count = x - dr.round(x), dr.opaque(mi.Float, size)
    sine = dr.sin(dr.pi * turned)
    power = dr.square(dr.sin(count * dr.pi * turned) / sine) / count
    return dr.select(dr.abs(turned) < 1e-7, count, power)


def _one_element(antenna: Antenna) -> Any:
    """A `sionna.rt.AntennaArray` of one element, which radiates what the channel engine's does.

    The device itself stands unturned in the ray tracer: angles are those of the world.
    """
    from sionna.rt import AntennaArray, AntennaPattern

    def pattern(theta: Any, phi: Any) -> tuple[Any, Any]:
        zenith, azimuth = np.array(theta, np.float64), np.array(phi, np.float64)
        sine = np.sin(zenith)
        towards = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=-1)
        field = antenna.radiated(towards)
        theta_hat, phi_hat = spherical_basis(towards)
        along = np.stack([(field * theta_hat).sum(-1), (field * phi_hat).sum(-1)])
        real, imaginary = aligned_columns(along.real), aligned_columns(along.imag)
        complex_of: Any = mi.Complex2f
        c_theta, c_phi = (complex_of(mi.Float(a), mi.Float(b)) for a, b in zip(real, imaginary, strict=True))
        return c_theta, c_phi

    radiated: Any = AntennaPattern()
    radiated.patterns = [pattern]
    return AntennaArray(radiated, mi.Point3f(0.0, 0.0, 0.0))


@contextmanager
def _launched(directions: Any) -> Iterator[None]:
    """While rays are shot, they leave in these directions, a `mitsuba.Vector3f`.

    Sionna RT's solver takes all points of a lattice at once, and the same ones in every call, so that parts
    would repeat each other. The function that it calls is replaced in its module and put back.
    """
    from sionna.rt.radio_map_solvers import radio_map_solver as module

    def spawn(_lattice: object, samples: int, sources: Any) -> Any:
        ray: Any = mi.Ray3f(o=dr.repeat(sources, samples), d=directions)
        ray.time = dr.zeros(mi.Float, samples)
        return ray

    before = module.spawn_ray_from_sources
    module.spawn_ray_from_sources = spawn
    try:
        yield
    finally:
        module.spawn_ray_from_sources = before


def _solver(
    rt_scene: Any, surface: MeasurementSurface, centre: Float64Array, antenna: Antenna, beams: range
) -> Any:
    """A solver for one transmitter, with the surface in the scene.

    Its ``shoot(samples, shooting, seed)`` returns sums, Shape ``[B + 1, cells]``, the element first, and how
    many rays passed through each cell.
    """
    from sionna.rt import RadioMapSolver

    cells = surface.shape[0] * surface.shape[1]
    geometry = _level(surface, centre) if surface.is_level else _draped(rt_scene, surface, centre)

    class Sums(geometry.map_class):  # type: ignore[misc,name-defined]
        """Adds up what passes through each cell, for one element and for every beam."""

        def __init__(self, samples: int) -> None:
            super().__init__(rt_scene, **geometry.map_arguments)
            # Opaque: as literals, each number of cells and beams would be another kernel to compile.
            self._samples, self._cells, self._beams = (
                dr.opaque(mi.UInt, count) for count in (samples, cells, len(beams))
            )
            self._ray = dr.arange(mi.UInt, samples)
            self.power = dr.zeros(mi.Float, (len(beams) + 1) * cells)
            self.rays = dr.zeros(mi.UInt, cells)
            self._beam_gains: Any = None

        def leave_towards(self, directions: Any) -> None:
            """Beam gains of the rays, which leave in these directions."""
            if len(beams):
                self._beam_gains = beam_gains(antenna, beams, mi.Vector3f(directions))

        def add_paths(
            self, e_fields: Any, array_w: Any, si: Any, k_world: Any, tx_indices: Any, active: Any,
            diffracted_paths: bool, solid_angle: Any = None, tx_positions: Any = None, wedges: Any = None,
            diff_point: Any = None, wedges_samples_cnt: Any = None, diffraction_angular_measure: Any = None,
        ) -> None:  # fmt: skip
            """Add up rays as `RadioMap.add_paths` does, for every beam."""
            # Width of the tube of a ray on the surface: of a diffracted one along the edge, else of its solid
            # angle.
            if diffracted_paths:
                source = dr.gather(mi.Point3f, tx_positions, tx_indices, active=active)
                width = self._diffraction_integration_weight(wedges, source, diff_point, k_world, si)
                width *= wedges.length * diffraction_angular_measure / wedges_samples_cnt
            else:
                width = solid_angle * dr.rcp(dr.abs(dr.dot(si.n, k_world)))
            cell, weight = geometry.cell(self, si, active)
            width *= weight * self._normalization_factor
            # Rays of one launch add up in single precision; parts are added in double precision outside.
            power = dr.squared_norm(e_fields[0]) * width
            dr.scatter_add(self.power, power, cell, active)
            dr.scatter_add(self.rays, mi.UInt(1), cell, active)
            self._add_beams(power, cell, active)

        def _add_beams(self, power: Any, cell: Any, active: Any) -> None:
            if not len(beams):
                return

            # One lane a ray, a loop over the beams: a lane for each beam would need the ray's field as often.
            def add(beam: Any) -> tuple[Any]:
                gain = dr.gather(mi.Float, self._beam_gains, beam * self._samples + self._ray, active)
                dr.scatter_add(self.power, gain * power, (beam + 1) * self._cells + cell, active)
                return (beam + 1,)

            dr.while_loop((mi.UInt(0),), lambda beam: beam < self._beams, add, labels=("beam",))

    # Sionna RT has no way to count rays otherwise: its steps are replaced, with the library's names and
    # arguments.
    class Solver(RadioMapSolver):  # type: ignore[misc]
        """Sionna RT's solver, whose rays are counted by `Sums`."""

        def shoot(self, samples: int, shooting: Shooting, seed: int) -> tuple[Any, Any]:
            self._sums = Sums(samples)
            self(
                rt_scene,
                **geometry.solver_arguments,
                samples_per_tx=samples,
                max_depth=shooting.max_depth,
                los=shooting.los,
                specular_reflection=shooting.reflection,
                diffuse_reflection=shooting.scattering,
                refraction=shooting.refraction,
                diffraction=shooting.diffraction,
                edge_diffraction=shooting.free_edges,
                seed=seed,
            )
            return np.array(self._sums.power).reshape(-1, cells), np.array(self._sums.rays)

        def _synthetic_array_weighting(self, scene: Any, k_tx: Any, *rest: Any) -> list[Any]:
            self._sums.leave_towards(k_tx)
            return [None]

        def _shoot_and_bounce(self, scene: Any, radio_map: Any, *rest: Any) -> Any:
            return super()._shoot_and_bounce(scene, self._sums, *rest)

        def _evaluate_first_order_diffraction(self, scene: Any, radio_map: Any, *rest: Any) -> None:
            super()._evaluate_first_order_diffraction(scene, self._sums, *rest)

    return Solver()


@dataclass(frozen=True, kw_only=True)
class _Geometry:
    """Surface in the form that the ray tracer's solver takes."""

    map_class: Any
    """The `sionna.rt.RadioMap` of such surfaces."""
    map_arguments: dict[str, Any]
    """Of its constructor, beside the scene."""
    solver_arguments: dict[str, Any]
    """Of the solver."""
    cell: Callable[[Any, Any, Any], tuple[Any, Any]]
    """From the map, where rays meet the surface and which of them do: the cell, and what its powers are
    weighted with, beside the map's own factor."""


def _level(surface: MeasurementSurface, centre: Float64Array) -> _Geometry:
    """A rectangle, which rays are intersected with by formula."""
    from sionna.rt.radio_map_solvers.planar_radio_map import PlanarRadioMap

    low, high = np.array([surface.x[0], surface.y[0]]), np.array([surface.x[-1], surface.y[-1]])
    ny, nx = surface.shape
    middle = np.append((low + high) / 2, surface.z[0, 0]) - centre
    size = high - low
    plane = {
        "center": mi.Point3f(*middle.tolist()),
        "orientation": mi.Point3f(0.0, 0.0, 0.0),
        # A little less: the number of cells is rounded up.
        "size": mi.Point2f(*(size * (1 - 1e-4 / np.array([nx, ny]))).tolist()),
        "cell_size": mi.Point2f(*(size / [nx, ny]).tolist()),
    }
    return _Geometry(
        map_class=PlanarRadioMap,
        map_arguments=plane,
        solver_arguments=plane,
        cell=lambda radio_map, si, active: (mi.UInt(radio_map._local_to_cell_ind(si.uv)), 1.0),
    )


def _draped(rt_scene: Any, surface: MeasurementSurface, centre: Float64Array) -> _Geometry:
    """A mesh in the scene, with two triangles for each cell."""
    from sionna.rt.radio_map_solvers.mesh_radio_map import MeshRadioMap
    from sionna.rt.scene_utils import extend_scene_with_mesh

    mesh, cell_of = surface.triangles()
    cells = surface.shape[0] * surface.shape[1]
    material = next(iter(rt_scene.objects.values())).radio_material  # never met: rays pass through
    measured = mi_mesh(Shape(_SURFACE, material, [_SURFACE], [mesh]), centre)
    measured.set_bsdf(material)
    index = mi.UInt(aligned_indices(cell_of))
    per_area = mi.Float(aligned_columns((1 / _areas(mesh, cell_of, cells))[None])[0])

    def cell(_: Any, si: Any, active: Any) -> tuple[Any, Any]:
        found = dr.gather(mi.UInt, index, si.prim_index, active)
        return found, dr.gather(mi.Float, per_area, found, active)

    return _Geometry(
        map_class=MeshRadioMap,
        map_arguments={"meas_surface": measured},
        solver_arguments={
            "measurement_surface": measured,
            "modified_scene": extend_scene_with_mesh(rt_scene.mi_scene, measured),
        },
        cell=cell,
    )


def _areas(mesh: Any, cell_of: Int64Array, cells: int) -> Float64Array:
    """Area [m²] of each cell, Shape ``[cells]``; infinite for a cell without triangles, whose gain is then
    0."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.bincount(cell_of, np.linalg.norm(normals, axis=1) / 2, minlength=cells)
    return np.where(areas > 0, areas, np.inf)
