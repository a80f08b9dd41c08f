"""The radio map of a scene: every transmitter shot in turn; power, SINR and best server of each cell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from caviar_protocol.arrays import BoolArray, Float64Array, Int32Array, Int64Array
from caviar_protocol.errors import RunError
from caviar_protocol.space.scene import antennas
from caviar_protocol.topics import AntennaArray, AntennaDevice, Scene
from caviar_services.channel.paths import Antenna
from caviar_services.channel.radio_map.cell_gains import (
    CellGains,
    PartDone,
    Shooting,
    cell_gains,
    least_memory,
    part_of,
)
from caviar_services.channel.radio_map.measurement_surface import MeasurementSurface
from caviar_services.channel.sionna.model import SionnaChannel
from caviar_services.channel.sionna.settings import SionnaSettings


@dataclass(frozen=True, kw_only=True, eq=False)
class Coverage:
    """Gains of T transmitters in a grid of cells, and their powers.

    A receiver has one isotropic element that takes waves of both polarisations.
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
        """Index of the transmitter with the greatest received power, Shape ``[ny, nx]``; −1: no signal."""
        return np.where(self.rss.max(axis=0) > 0, self.rss.argmax(axis=0), -1).astype(np.int32)

    @property
    def has_signal(self) -> BoolArray:
        """Cells that any transmitter reaches, Shape ``[ny, nx]``."""
        return self.best_server >= 0

    def of_server(self, values: Float64Array) -> Float64Array:
        """Values of the best server, Shape ``[T, ny, nx]`` to ``[ny, nx]``; NaN where there is none."""
        chosen = np.take_along_axis(values, np.maximum(self.best_server, 0)[None], axis=0)[0]
        return np.where(self.has_signal, chosen, np.nan)


def decibels(values: Float64Array, reference: float = 1.0) -> Float64Array:
    """10·log10(values/reference) [dB]; NaN for 0 and for NaN."""
    positive = values > 0
    return np.where(positive, 10 * np.log10(np.where(positive, values, 1.0) / reference), np.nan)


BeamChoice = Literal["best", "wide"] | int
"""``best``: in each cell the beam of the transmitter's codebook that brings most. ``wide``: one element, no
beamforming. A number: that beam, everywhere."""


# Its test for what is in the way ends after 1 m there (`spawn_ray_to`, sionna-rt 2.2.0).
_NO_DIFFRACTION = (
    "diffraction is left out: Sionna RT's solver finds none over a surface that is not level; a plane has it"
)

_ALL_EDGES = "edges_within_m is left out: in maps all edges diffract"


@dataclass(frozen=True, kw_only=True, eq=False)
class RadioMap:
    """What T transmitters bring to a surface."""

    surface: MeasurementSurface
    names: tuple[str, ...]
    """Of the transmitters."""
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


def transmitters_of(scene: Scene, where: str) -> list[AntennaDevice]:
    """The transmitters of a scene.

    Raises `RunError`, which names ``where`` it is from, without one, and for one of dual polarization or of
    several panels.
    """
    found = list(antennas(scene, "tx"))
    for device in found:
        if not device.array.is_uniform:
            raise RunError(
                f"{where}: transmitter {device.name!r} has dual polarization or several panels, of which no "
                "map is made; give it one of V, H, -45, +45, RHCP and LHCP and no panels"
            )
    if not found:
        raise RunError(
            f'{where} has no transmitter; give a device of [[devices]] the role "tx", or choose another frame'
        )
    return found


def beams_of(array: AntennaArray, beam: BeamChoice, name: str) -> range:
    """Beams of the codebook to choose among; none for ``wide``, nor for a single element.

    Raises `RunError` naming the transmitter where its codebook lacks the beam.
    """
    if beam == "wide" or (beam == "best" and array.size == 1):
        return range(0)
    if beam == "best":
        return range(array.size)
    if not 0 <= beam < array.size:
        raise RunError(f"--beam {beam}: the codebook of {name!r} has the beams 0 to {array.size - 1}")
    return range(beam, beam + 1)


def rays_at_once(
    surface: MeasurementSurface, devices: Sequence[AntennaDevice], beam: BeamChoice, samples: int, memory: int
) -> int:
    """Rays that are shot together within ``memory`` [bytes].

    Raises `RunError` with the cell that would do where a map of this many cells does not fit.
    """
    ny, nx = surface.shape
    beams = max(len(beams_of(device.array, beam, device.name)) for device in devices)
    part = part_of(samples, nx * ny, beams, memory)
    if part:
        return part
    needed = least_memory(nx * ny, beams)
    side = float(surface.x[1] - surface.x[0])
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
        samples: Rays of each transmitter.
        carrier: Its index among those of the run.
        noise_w: Of a receiver [W].
        part, done: As in `cell_gains`; ``done`` counts the parts of all transmitters.

    While another transmitter serves other cells with beams of its codebook, it interferes with each of these
    in turn: in the mean over a unitary codebook, that is the gain of one element.
    """
    devices = transmitters_of(scene, "the scene")
    rt, s = channel.scene, channel.settings
    shooting = Shooting(
        samples=-(-samples // part) * part,
        max_depth=s.max_depth,
        seed=channel.launch_seed % 2**31,
        los=s.los,
        reflection=s.reflection,
        refraction=s.refraction,
        diffraction=s.diffraction and surface.is_level,
        free_edges=s.free_edges and surface.is_level,
        scattering=s.scattering,
    )
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
    """What of the settings a map of this surface has not."""
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
    """What the air lets through over the straight line to each cell; paths by reflection are longer."""
    if channel.absorption_db_per_km is None:
        return 1.0
    km = np.linalg.norm(surface.centres - source, axis=-1) / 1e3
    absorbed: Float64Array = np.nan_to_num(channel.absorption_db_per_km[carrier] * km)
    return 10 ** (-absorbed / 10)


def rounded_up(value: float) -> float:
    """A value above 0 with two significant digits, not less than it is."""
    unit = 10 ** (np.floor(np.log10(value)) - 1)
    return float(np.ceil(value / unit) * unit)
